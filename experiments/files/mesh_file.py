"""Scenes from files: OBJ, PLY, STL, glTF and GLB.

World space is the file's own, right-handed, taken as y up. A mesh that comes without camera
and light is put on a floor and framed (``framing``). What was odd in the file is in the
scene's notes; what makes it unusable is one ``ValueError`` line.
"""

import io
from pathlib import Path

import numpy as np
import trimesh

from tangentspace.mesh import Mesh

from ..scene import Scene
from .framing import frame_mesh
from .gltf import load_gltf
from .mesh_build import PLAIN, BuiltMesh, SceneFileError, build_mesh, build_polygons, reading
from .obj import read_obj
from .ply import read_ply

SUFFIXES = (".obj", ".ply", ".stl", ".gltf", ".glb")


def load_scene_file(path: Path | str) -> Scene:
    """Load a scene from a file; its suffix says the format.

    UV seams and vertex order are kept; all objects become one mesh; normals that the file
    lacks are smooth, weighted by angle.

    Args:
        path: A file with one of ``SUFFIXES``.

    Returns:
        The scene, named after the file; its arrays are float32 and int32.

    Raises:
        ValueError: If the file is missing, a directory, of an unknown kind, damaged, or
            holds no faces, vertices that are not finite, or indices out of range.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if not path.exists():
        raise SceneFileError(f"{path}: no such file; check the path")
    if path.is_dir():
        raise SceneFileError(f"{path}: is a directory; name a file in it")
    if suffix not in SUFFIXES:
        raise SceneFileError(
            f"{path}: unknown kind of file '{path.suffix}'; supported: {', '.join(SUFFIXES)}"
        )
    if suffix in (".gltf", ".glb"):
        return load_gltf(path)
    with reading(path, suffix[1:].upper()):
        mesh, face_materials, materials, notes = _READERS[suffix](path)
    return frame_mesh(mesh, path.stem, notes, face_materials=face_materials, materials=materials)


def _load_stl(path: Path) -> BuiltMesh:
    """Read with trimesh; each triangle keeps its own three vertices."""
    content = path.read_bytes()
    binary_size = 84 + 50 * int.from_bytes(content[80:84], "little")
    if len(content) != binary_size:
        # trimesh would take what is not binary for text, and pass over a solid without end.
        if not content.lstrip().lower().startswith(b"solid"):
            raise SceneFileError(
                f"{path}: is no STL file, or is cut short ({len(content)} bytes, its header says "
                f"{binary_size}); export it again"
            )
        content = content.decode("utf-8", "replace").lower().encode()
        if content.rfind(b"vertex") > content.rfind(b"endsolid"):
            raise SceneFileError(f"{path}: is cut short (no `endsolid`); export it again")
    scene = trimesh.load_scene(io.BytesIO(content), file_type="stl", process=False)
    triangles = [np.zeros((0, 3, 3)), *(np.asarray(s.triangles) for s in scene.geometry.values())]
    positions = np.concatenate(triangles).reshape(-1, 3)
    faces = np.arange(len(positions)).reshape(-1, 3)
    raw = Mesh(positions, np.full_like(positions, np.nan), faces)
    return build_mesh(path, raw, np.zeros(len(faces), np.int32), (PLAIN,))


_READERS = {
    ".obj": lambda path: build_polygons(path, read_obj(path)),
    ".ply": lambda path: build_polygons(path, read_ply(path)),
    ".stl": _load_stl,
}
