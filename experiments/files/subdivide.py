"""Finer meshes of the same shape: each triangle cut in four at the middles of its edges."""

from typing import NamedTuple

import numpy as np
import trimesh
from jaxtyping import Float, Int

from tangentspace.mesh import Mesh

from .smooth_normals import unit


class SubdividedMesh(NamedTuple):
    """A mesh cut finer, and where its faces come from.

    Attributes:
        mesh: NumPy arrays of the types that the original had.
        parent_faces: For each face, the face of the original that it is a part of, as an
            index for what is stored per face, such as materials.
    """

    mesh: Mesh
    parent_faces: Int[np.ndarray, " faces"]


def subdivide(mesh: Mesh, levels: int, *, max_faces: int = 4_000_000) -> SubdividedMesh:
    """Cut each face in four, ``levels`` times; the surface stays where it is.

    New vertices lie in the middle of edges, and so do their uvs; normals and tangents are those
    that the coarse face has there, of unit length. Vertices that stand apart, such as those on
    both sides of a seam, stay apart, and their children stay at one place. The original
    vertices come first, unchanged. The ``4 ** levels`` parts of a face follow each other in
    its place: of each cut those at its first, second and third corner, then the middle one.

    Args:
        mesh: NumPy arrays.
        levels: How often to cut, >= 0.
        max_faces: The most faces that may come out.

    Raises:
        ValueError: If ``levels`` is negative or the faces would be too many.
    """
    if levels < 0:
        raise ValueError(f"subdivide: expected `levels` of at least 0, got {levels}")
    count = len(mesh.faces)
    if count * 4**levels > max_faces:
        raise ValueError(
            f"subdivide: {levels} levels make {count * 4**levels} faces out of {count},"
            f" more than `max_faces` of {max_faces}; give fewer levels, or allow more faces"
        )
    columns, faces = _columns(mesh), np.asarray(mesh.faces)
    for _ in range(levels):
        columns, faces = trimesh.remesh.subdivide(columns, faces)[:2]
    parents = np.arange(count).repeat(4**levels)
    return SubdividedMesh(_mesh_like(mesh, columns, faces), parents)


def _columns(mesh: Mesh) -> Float[np.ndarray, "vertices n"]:
    """Return all that the vertices have, side by side."""
    parts = mesh.positions, mesh.normals, mesh.uvs, mesh.tangents
    return np.concatenate([np.asarray(part) for part in parts if part is not None], axis=1)


def _mesh_like(
    mesh: Mesh, columns: Float[np.ndarray, "vertices n"], faces: Int[np.ndarray, "faces 3"]
) -> Mesh:
    """Return a mesh with the fields that ``mesh`` has, whose vertices are the first ones."""
    kept, arrays, start = len(mesh.positions), {}, 0
    for name, old in mesh._asdict().items():
        if old is None or name == "faces":
            continue
        values = columns[:, start : start + old.shape[1]].astype(old.dtype)
        start += old.shape[1]
        if name in ("normals", "tangents"):
            values[kept:, :3] = unit(values[kept:, :3])[0]
        if name == "tangents":  # +1 between ends of different handedness
            values[kept:, 3] = np.where(values[kept:, 3] < 0, -1, 1)
        arrays[name] = values
    return mesh._replace(faces=faces.astype(mesh.faces.dtype), **arrays)
