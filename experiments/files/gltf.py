"""Scenes from glTF 2.0 (.gltf, .glb): meshes and materials; cameras and lights beside it.

glTF is right-handed with y up, as the world here; faces are counter-clockwise. Its UVs have
v downwards, so ``v = 1 - v_gltf``. Tangents need no change of sign: glTF's bitangent
``w * cross(normal, tangent)`` is where the normal map's green points, up in the image
(specification 3.7.2.1, 3.9.3), and that is increasing v here: ``handedness = w``.
"""

import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Int

from tangentspace.mesh import Mesh
from tangentspace.shapes import merge, transform_mesh
from tangentspace.texture import Texture

from ..scene import Material, Scene
from .framing import frame_mesh, framing_camera, key_light
from .gltf_data import GltfData, Node, read_gltf, scene_nodes
from .gltf_views import read_camera, read_lights
from .map_files import color_map
from .mesh_build import BuiltMesh, SceneFileError, build_mesh, reading
from .normal_texels import LoadedMap, normal_map
from .texture_file import Pixels

_STRIP, _FAN, _TRIANGLES = 5, 6, 4
_UNUSED = {
    "animations": "animations ignored: the nodes stay where the file puts them",
    "skins": "skins ignored: the mesh stays in its bind pose",
}


class _Part(NamedTuple):
    """A primitive of triangles in world space; missing normals are NaN."""

    mesh: Mesh
    material: int | None


class _Look(NamedTuple):
    """A material and the UV set that its textures use."""

    material: Material
    uv_set: int


_ReadTexture = Callable[[int, Callable[[Pixels, str], LoadedMap]], Texture | None]


def load_gltf(path: Path) -> Scene:
    """Load a scene from a .gltf or .glb file.

    A file with neither camera nor light is put on a floor and framed (``frame_mesh``); if
    it has one of them, only the other is added. What the scene types cannot hold (skins,
    morph targets, animations, vertex colors, transparency) is passed over and noted.

    Args:
        path: The file; buffers and images may lie beside it.

    Raises:
        SceneFileError: If the file is damaged, needs what is missing or not supported, or
            holds no triangles, vertices that are not finite, or indices out of range.
    """
    path = Path(path)
    with reading(path, "glTF"):
        data, notes = read_gltf(path)
        nodes = scene_nodes(data)
        built = _build(data, nodes, notes)
        positions = np.asarray(built.mesh.positions)
        lights, light_notes = read_lights(data, nodes, positions)
        with_camera = [node for node in nodes if "camera" in node.content]
        camera = read_camera(data, with_camera[0], positions) if with_camera else None
    mesh, face_materials, materials, notes = built
    notes += light_notes
    if len(with_camera) > 1:
        notes += (f"{len(with_camera)} cameras: the first is used",)
    if camera is None and not lights:
        return frame_mesh(
            mesh, path.stem, notes, face_materials=face_materials, materials=materials
        )
    camera = camera or framing_camera(positions)
    return Scene(
        path.stem, mesh, face_materials, materials, camera, lights or (key_light(),), notes
    )


def _build(data: GltfData, nodes: list[Node], notes: tuple[str, ...]) -> BuiltMesh:
    """Return all triangles of the scene as one mesh."""
    said = [*notes, *(text for kind, text in _UNUSED.items() if data.items(kind))]
    read_texture = functools.cache(functools.partial(_texture, data, said))
    looks: dict[int | None, _Look] = {}
    parts: list[_Part] = []
    for node in nodes:
        if "mesh" not in node.content:
            continue
        for primitive in data.items("meshes")[node.content["mesh"]]["primitives"]:
            if primitive.get("mode", _TRIANGLES) not in (_TRIANGLES, _STRIP, _FAN):
                said.append("points and lines left out")
            elif np.linalg.det(node.world_from_node[:3, :3]) == 0:
                said.append("parts scaled to nothing left out")
            else:
                index = primitive.get("material")
                if index not in looks:
                    looks[index] = _look(data, index, read_texture, said)
                part = _part(data, primitive, looks[index], said)
                with np.errstate(invalid="ignore", over="ignore"):
                    parts.append(_Part(transform_mesh(part, node.world_from_node), index))
    if not parts:
        raise SceneFileError(f"{data.path}: has no faces in its scene; a mesh is needed")
    slots = list(looks)
    face_materials = [np.full(len(p.mesh.faces), slots.index(p.material)) for p in parts]
    return build_mesh(
        data.path,
        merge(*_with_equal_tangents(parts, looks, said)),
        np.concatenate(face_materials),
        tuple(look.material for look in looks.values()),
        tuple(dict.fromkeys(said)),
    )


def _part(data: GltfData, primitive: dict[str, Any], look: _Look, said: list[str]) -> Mesh:
    """Return a primitive's mesh in its node's space, double precision; add to what is said."""
    attributes = primitive["attributes"]
    arrays = {name: data.numbers(index).astype(np.float64) for name, index in attributes.items()}
    positions = arrays["POSITION"]
    indices = np.arange(len(positions))
    if "indices" in primitive:
        indices = data.numbers(primitive["indices"])[:, 0].astype(np.int64)
    wrong = int((indices >= len(positions)).sum())
    if wrong:
        raise SceneFileError(
            f"{data.path}: {wrong} face indices out of range, they name none of the "
            f"{len(positions)} vertices of their mesh; export it again"
        )
    if "COLOR_0" in arrays:
        said.append("vertex colors ignored")
    if "targets" in primitive:
        said.append("morph targets ignored: the mesh keeps its base shape")
    uvs = arrays.get(f"TEXCOORD_{look.uv_set}")
    if uvs is not None:
        uvs = uvs * [1, -1] + [0, 1]
    elif look.material.base_color_texture is not None or look.material.normal_texture is not None:
        said.append(f"a textured part has no UV set {look.uv_set}: zero is used")
    return Mesh(
        positions,
        arrays.get("NORMAL", np.full_like(positions, np.nan)),
        _triangles(indices, primitive.get("mode", _TRIANGLES)),
        uvs,
        arrays.get("TANGENT"),
    )


def _triangles(indices: Int[np.ndarray, " indices"], mode: int) -> Int[np.ndarray, "faces 3"]:
    """Return the triangles of a list, strip or fan (specification 3.7.2.1)."""
    if mode == _TRIANGLES:
        return indices[: len(indices) // 3 * 3].reshape(-1, 3)
    i = np.arange(max(len(indices) - 2, 0))
    if mode == _STRIP:
        return indices[np.stack([i, i + 1 + i % 2, i + 2 - i % 2], axis=1)]
    return indices[np.stack([i + 1, i + 2, np.zeros_like(i)], axis=1)]


def _with_equal_tangents(
    parts: list[_Part], looks: dict[int | None, _Look], said: list[str]
) -> list[Mesh]:
    """Return meshes that all have tangents, or none of them if a normal map lacks them."""
    meshes = [part.mesh for part in parts]
    mapped = [looks[part.material].material.normal_texture is not None for part in parts]
    given = [mesh.tangents is not None for mesh in meshes]
    if not any(given):
        return meshes
    if any(map_ and not has for map_, has in zip(mapped, given, strict=True)):
        said.append("tangents ignored: some parts with a normal texture have none")
        return [mesh._replace(tangents=None) for mesh in meshes]
    return [
        mesh if has else mesh._replace(tangents=np.full((len(mesh.positions), 4), np.nan))
        for mesh, has in zip(meshes, given, strict=True)
    ]


def _look(data: GltfData, index: int | None, read_texture: _ReadTexture, said: list[str]) -> _Look:
    """Return a material; where its textures use different UV sets, the normal map's stays."""
    if index is None:
        return _Look(Material(), 0)
    content = data.items("materials")[index]
    surface = content.get("pbrMetallicRoughness", {})
    if content.get("alphaMode", "OPAQUE") != "OPAQUE":
        said.append("transparency ignored: all faces are opaque")
    normal, color = content.get("normalTexture"), surface.get("baseColorTexture")
    sets = [texture.get("texCoord", 0) for texture in (normal, color) if texture]
    if len(set(sets)) > 1:
        said.append("color textures on another UV set than their normal texture ignored")
        color = None
    red, green, blue, _ = map(float, surface.get("baseColorFactor", [1, 1, 1, 1]))
    scale = (normal or {}).get("scale", 1)
    return _Look(
        Material(
            base_color=None if red == green == blue == 1 else (red, green, blue),
            base_color_texture=read_texture(color["index"], color_map) if color else None,
            normal_texture=read_texture(normal["index"], normal_map) if normal else None,
            normal_scale=None if scale == 1 else float(scale),
        ),
        sets[0] if sets else 0,
    )


def _texture(
    data: GltfData, said: list[str], index: int, check: Callable[[Pixels, str], LoadedMap]
) -> Texture | None:
    """Return a texture, or None where there is none that can be read."""
    try:
        pixels = data.pixels(index)
        if pixels is None:
            said.append("textures in formats of extensions ignored")
            return None
        texels, notes = check(pixels, f"texture {index}")
    except SceneFileError:
        raise
    except ValueError as error:
        raise SceneFileError(f"{data.path}: {error}") from error
    said += notes
    wrap_u, wrap_v = data.wraps(index)
    return Texture(texels, wrap_u, wrap_v)
