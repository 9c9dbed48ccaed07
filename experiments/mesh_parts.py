"""What hangs together in a mesh: which part is the ground, and what casts on it."""

from typing import NamedTuple

import numpy as np
import scipy.sparse
from jaxtyping import Bool, Float, Int

from shadows.silhouettes import MeshEdges, mesh_edges
from tangentspace.mesh import Mesh

_MOST_PARTS = 9


class Part(NamedTuple):
    """Faces that hang together.

    Attributes:
        vertices: Which of the mesh's.
        faces: How many.
        size: Of its box, world lengths.
    """

    vertices: Bool[np.ndarray, " vertices"]
    faces: int
    size: Float[np.ndarray, "3"]


def mesh_parts(mesh: Mesh, edges: MeshEdges) -> list[Part]:
    """Return the nine parts of a mesh with the largest boxes, or all, the largest first."""
    positions, faces = np.asarray(mesh.positions), np.asarray(mesh.faces)
    start, end = np.asarray(edges.vertices).T
    links = scipy.sparse.coo_array((np.ones(len(start)), (start, end)), shape=(len(positions),) * 2)
    count, part = scipy.sparse.csgraph.connected_components(links, directed=False)
    part_of_face = part[start[edges.edge_ids[:, 0]]]
    low, high = np.full((count, 3), np.inf), np.full((count, 3), -np.inf)
    for corner in faces.T:
        np.minimum.at(low, part_of_face, positions[corner])
        np.maximum.at(high, part_of_face, positions[corner])
    known, first = np.unique(part_of_face, return_index=True)
    known = known[np.argsort(first)]
    size = high[known] - low[known]
    parts = []
    for k in np.argsort(-np.linalg.norm(size, axis=1), kind="stable")[:_MOST_PARTS]:
        mine = part_of_face == known[k]
        parts.append(Part(used_vertices(mesh, mine), int(mine.sum()), size[k]))
    return parts


def split_caster(mesh: Mesh) -> tuple[Bool[np.ndarray, " faces"], Int[np.ndarray, " caster"]]:
    """Return which faces cast, and their vertices: all but the part with the largest box.

    Raises:
        ValueError: If there is one part alone, or parts share vertices.
    """
    parts = mesh_parts(mesh, mesh_edges(mesh.positions, mesh.faces))
    if len(parts) < 2:
        raise ValueError("mesh: expected a caster over a ground, got one connected part")
    casts = ~parts[0].vertices[np.asarray(mesh.faces)[:, 0]]
    caster = used_vertices(mesh, casts)
    if np.any(caster & parts[0].vertices):
        raise ValueError("mesh: the caster shares vertices with the ground; split them")
    return casts, np.flatnonzero(caster)


def used_vertices(
    mesh: Mesh, faces: Bool[np.ndarray, " faces"] | slice = slice(None)
) -> Bool[np.ndarray, " vertices"]:
    """Return which vertices some faces use."""
    used = np.zeros(len(mesh.positions), bool)
    used[np.asarray(mesh.faces)[faces]] = True
    return used
