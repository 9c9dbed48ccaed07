"""Which edges bound what a light sees of a mesh: the silhouettes that shadows grow from.

An edge counts by what its faces make of it. Turn every face to the light, reversing those
that look away, and let it run once along each of its edges, counter-clockwise as the light
sees it. Where two neighbouring faces look the same way their runs cancel; at a silhouette
they add to 2, at the border of an open mesh there is 1. Any number of faces may share an
edge, and how a face is wound does not matter.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Int

Positions = Float[Array | np.ndarray, "vertices 3"]
Faces = Int[Array | np.ndarray, "faces 3"]


class MeshEdges(NamedTuple):
    """Which faces share which edges.

    Attributes:
        vertices: The two ends of each edge.
        edge_ids: The edge from each corner of a face to the next one.
        directions: +1 where the face runs along that edge from the first end to the second,
            -1 where against it, 0 where both ends are at one place.
    """

    vertices: Int[Array | np.ndarray, "edges 2"]
    edge_ids: Int[Array | np.ndarray, "faces 3"]
    directions: Int[Array | np.ndarray, "faces 3"]


def mesh_edges(positions: Positions, faces: Faces) -> MeshEdges:
    """Find the edges of a mesh, once for all lights, views and frames.

    Vertices at the very same place count as one, so that neither seams of UVs nor hard edges
    cut the surface; while the mesh moves they must stay together.

    Args:
        positions: Vertex positions, NumPy or concrete arrays.
        faces: Vertex indices, NumPy or concrete arrays.

    Returns:
        The edges, as NumPy arrays.

    Raises:
        ValueError: If the arrays are traced, have the wrong shape, hold no face, or a face
            names a missing vertex.
    """
    if isinstance(positions, Tracer) or isinstance(faces, Tracer):
        raise ValueError(
            "mesh_edges: expected concrete `positions` and `faces`, got traced ones; call it "
            "outside `jit` and pass what it returns as `edges`"
        )
    positions, faces = np.asarray(positions), np.asarray(faces)
    if positions.ndim != 2 or positions.shape[1] != 3:
        raise ValueError(
            f"mesh_edges: expected `positions` of shape (vertices, 3), got {positions.shape}"
        )
    if faces.ndim != 2 or faces.shape[1] != 3 or not len(faces):
        raise ValueError(f"mesh_edges: expected `faces` (faces > 0, 3), got {faces.shape}")
    if faces.min() < 0 or faces.max() >= len(positions):
        raise ValueError(
            f"mesh_edges: expected `faces` from 0 to {len(positions) - 1} (the vertices there "
            f"are), got {faces.min()} to {faces.max()}"
        )
    start = _first_at_place(positions)[faces]
    end = np.roll(start, -1, axis=1)
    directions = np.sign(end - start).astype(np.int32)
    low, high = np.minimum(start, end), np.maximum(start, end)
    keys, edge_ids = np.unique(low * len(positions) + high, return_inverse=True)
    vertices = np.stack(np.divmod(keys, len(positions)), axis=-1)
    return MeshEdges(
        vertices.astype(np.int32), edge_ids.reshape(faces.shape).astype(np.int32), directions
    )


def turned_to_light(
    positions: Positions, faces: Faces, light: Float[Array, "4"]
) -> Int[Array, " faces"]:
    """Return how each face must be turned for the light to see it counter-clockwise.

    Args:
        positions: Vertex positions.
        faces: Vertex indices.
        light: The light as a homogeneous point: its position and 1, or, for parallel light,
            the direction towards it and 0; in the positions' space.

    Returns:
        +1 where the face is so already (seen edge-on, either way counts), -1 where not; 0
        where a corner is not finite.
    """
    x, y, z = jnp.asarray(positions).T
    corners = jnp.asarray(faces).T
    a, b, c = (
        [axis.at[corner].get(mode="promise_in_bounds") for axis in (x, y, z)] for corner in corners
    )
    u, v = ([q - p for p, q in zip(a, other, strict=True)] for other in (b, c))
    normal = [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]]
    towards = [light[k] - light[3] * a[k] for k in range(3)]
    height = normal[0] * towards[0] + normal[1] * towards[1] + normal[2] * towards[2]
    turned = jnp.where(jnp.isfinite(height), jnp.where(height < 0, -1, 1), 0)
    return turned.astype(jnp.int32)


def silhouette(edges: MeshEdges, turned: Int[Array, " faces"]) -> Int[Array, " edges"]:
    """Return how often the turned faces run along each edge, less how often against it.

    Args:
        edges: Of the mesh.
        turned: What ``turned_to_light`` returns.

    Returns:
        0 where faces cancel; 2 or -2 at a silhouette of a closed mesh; 1 or -1 at a border.
    """
    runs = turned[:, None] * jnp.asarray(edges.directions)
    count = edges.vertices.shape[0]
    return jnp.zeros(count, runs.dtype).at[jnp.asarray(edges.edge_ids)].add(runs)


def _first_at_place(
    positions: Float[np.ndarray, "vertices 3"],
) -> Int[np.ndarray, " vertices"]:
    """Return, for each vertex, the first one at the same place."""
    order = np.lexsort(positions.T)  # stable, so equals are in rising order
    ordered = positions[order]
    new = np.concatenate([[True], np.any(ordered[1:] != ordered[:-1], axis=1)])[: len(order)]
    first = np.empty(len(order), np.int64)
    first[order] = order[new][np.cumsum(new) - 1]
    return first
