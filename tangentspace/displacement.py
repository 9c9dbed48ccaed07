"""Displacement: vertices moved along their normals by a height map, normals and frames following.

A vertex moves by ``scale * (h(uv) - midlevel)`` along its unit normal. Only vertices move, so
the mesh must be as fine as the map's detail: subdivide it first.

Meshes repeat vertices where uvs or normals differ. Such copies at one place must move as one,
or the surface tears there: they take the mean of their heights. Copies with equal normals (a
seam of the uvs) also share the new normal. Copies with different normals (a hard edge) keep
normals of their own, and move together along the mean ``m`` of the different normals, by
``m / <m, m>``: where all heights agree, each side lands as far along its own normal as it
would alone, so that a box becomes a larger box. At acute corners this is a long way; it is
limited to 4 times the height and falls to 0 as normals cancel.

The change of the normals is found by weighting the faces' normals by angle, on the surface
before and after, and added to the normals that the mesh has: one constant height leaves a
plane's or sphere's normals as they are, whatever the triangles. Tangents are sheared
along the old normals into the new tangent planes, ``t' = normalize(n' x (t x n))``, as
displacement itself shears the surface; handedness is kept.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float, Int

from ._math import dot, safe_divide, safe_normalize
from .mesh import Mesh
from .texture import Wrap, repeat, sample_bilinear
from .vertex_normals import vertex_normals

Scalar = Float[Array | np.ndarray, ""] | float

_LONGEST_MITER = 4.0  # of a corner's way to the height, as in vector graphics
_SAME_NORMAL = 1e-3  # distance of unit normals that files round apart


class Seams(NamedTuple):
    """Which copies of vertices belong together; kept, they serve while a mesh is fitted.

    Attributes:
        point: For each vertex, the first one at the same position.
        smooth: For each vertex, the first one at the same position with the same normal.
    """

    point: Int[Array | np.ndarray, " vertices"]
    smooth: Int[Array | np.ndarray, " vertices"]


def find_seams(mesh: Mesh) -> Seams:
    """Find the copies of vertices: equal positions, and among these equal normals.

    Args:
        mesh: The mesh before displacement. Positions count as equal if all their digits are,
            normals if they differ by less than 0.001 (0.06 degrees).

    Returns:
        NumPy arrays.

    Raises:
        ValueError: If the mesh's arrays are being traced.
    """
    if isinstance(mesh.positions, Tracer) or isinstance(mesh.normals, Tracer):
        raise ValueError(
            "find_seams: expected positions and normals of known values, got traced ones;"
            " find the seams once, before `jit` or `grad`, and pass them to `displace`"
        )
    point = _first_of_equal(np.asarray(mesh.positions))
    normals = np.asarray(mesh.normals, np.float64)
    smooth = np.arange(len(point))
    left = smooth.copy()
    while len(left):
        _, first, inverse = np.unique(point[left], return_index=True, return_inverse=True)
        leader = left[first][inverse]
        distance = np.linalg.norm(normals[left] - normals[leader], axis=1)
        same = (distance < _SAME_NORMAL) | (left == leader)
        smooth[left[same]] = leader[same]
        left = left[~same]
    return Seams(point, smooth)


def displace(
    mesh: Mesh,
    heights: Float[Array | np.ndarray, "height width"],
    *,
    scale: Scalar,
    midlevel: Scalar = 0.0,
    wrap_u: Wrap = repeat,
    wrap_v: Wrap = repeat,
    seams: Seams | None = None,
) -> Mesh:
    """Move the vertices of a mesh along their normals by a height map.

    Args:
        mesh: A mesh with uvs. A vertex whose normal is zero stays, unless copies of it move.
        heights: The map, row 0 on top; looked up bilinearly.
        scale: Way for a height of 1, in the mesh's unit of length.
        midlevel: The height that does not move.
        wrap_u: How the map continues to the left and to the right.
        wrap_v: How it continues above and below.
        seams: From ``find_seams``, if the mesh's arrays are traced, or to save the time.

    Returns:
        The mesh with new positions, normals and, where it has them, tangents. Normals are
        zero where they were; tangents where none is left to follow.

    Raises:
        ValueError: If the mesh has no uvs, ``heights`` has the wrong shape, or ``seams`` are
            not given and cannot be found.

    Differentiability:
        Smooth in ``heights``, ``scale``, ``midlevel``, positions and normals but where a
        face degenerates, and where the limit at acute corners sets in; in uvs as
        ``sample_bilinear``.
    """
    if mesh.uvs is None:
        raise ValueError("displace: expected a mesh with `uvs`, got None; unwrap it first")
    if jnp.ndim(heights) != 2:
        expected = f"expected `heights` of shape (height, width), got {jnp.shape(heights)}"
        raise ValueError(f"displace: {expected}; give one channel")
    texels = jnp.asarray(heights)[..., None]
    height = sample_bilinear(texels, mesh.uvs, wrap_u=wrap_u, wrap_v=wrap_v)[..., 0]
    return displace_vertices(mesh, scale * (height - midlevel), seams=seams)


def displace_vertices(
    mesh: Mesh,
    heights: Float[Array | np.ndarray, " vertices"],
    *,
    seams: Seams | None = None,
) -> Mesh:
    """Move the vertices of a mesh along their normals, each by a height of its own.

    Args:
        mesh: A mesh; needs no uvs. A vertex whose normal is zero stays, unless copies move.
        heights: Way of each vertex, in the mesh's unit of length; copies take the mean.
        seams: From ``find_seams``, if the mesh's arrays are traced, or to save the time.

    Returns:
        As ``displace``.

    Raises:
        ValueError: If there is not one height per vertex, or ``seams`` are not given and
            cannot be found.

    Differentiability:
        As ``displace``.
    """
    count = len(mesh.positions)
    if jnp.shape(heights) != (count,):
        expected = f"expected `heights` of shape ({count},), got {jnp.shape(heights)}"
        raise ValueError(f"displace_vertices: {expected}; give one per vertex")
    seams = find_seams(mesh) if seams is None else seams
    normals = safe_normalize(mesh.normals)
    way = _way_of_points(normals, jnp.asarray(heights), seams)
    positions = jnp.asarray(mesh.positions) + way
    turned = _turned_normals(normals, mesh, positions, seams)
    tangents = None
    if mesh.tangents is not None:
        tangent, handedness = mesh.tangents[:, :3], jnp.asarray(mesh.tangents[:, 3:])
        followed = safe_normalize(jnp.cross(turned, jnp.cross(tangent, normals)))
        tangents = jnp.concatenate([followed, handedness], axis=1)
    return mesh._replace(positions=positions, normals=turned, tangents=tangents)


def _way_of_points(
    normals: Float[Array, "vertices 3"], heights: Float[Array, " vertices"], seams: Seams
) -> Float[Array, "vertices 3"]:
    """Return the way of each vertex, the same for all at one place."""
    exists = _nonzero(normals)
    different = exists & (seams.smooth == np.arange(len(seams.smooth)))
    height = _mean_at(seams.point, heights[:, None], exists)
    normal = _mean_at(seams.point, normals, different)
    squared = dot(normal, normal)[:, None]
    return height * normal / jnp.maximum(squared, 1 / _LONGEST_MITER**2)


def _mean_at(
    point: Int[Array | np.ndarray, " vertices"],
    values: Float[Array, "vertices n"],
    counted: Bool[Array, " vertices"],
) -> Float[Array, "vertices n"]:
    """Return the mean over the counted vertices at the same place, 0 if there is none."""
    share = counted[:, None].astype(values.dtype)
    total = jnp.zeros_like(values).at[point].add(share * values)
    count = jnp.zeros_like(share).at[point].add(share)
    return safe_divide(total, count)[point]


def _turned_normals(
    normals: Float[Array, "vertices 3"],
    mesh: Mesh,
    positions: Float[Array, "vertices 3"],
    seams: Seams,
) -> Float[Array, "vertices 3"]:
    """Return the mesh's normals after its positions moved."""
    smooth = jnp.asarray(seams.smooth)
    faces = smooth[jnp.asarray(mesh.faces)]
    before = vertex_normals(mesh.positions, faces)[smooth]
    after = vertex_normals(positions, faces)[smooth]
    inside_out = dot(normals, before) < 0  # faces counter-clockwise seen from inside
    change = jnp.where(inside_out[:, None], before - after, after - before)
    known = _nonzero(before) & _nonzero(after)
    turned = safe_normalize(normals + jnp.where(known[:, None], change, 0.0))
    return jnp.where(_nonzero(normals)[:, None], turned, 0.0)


def _nonzero(vectors: Float[Array, "vertices 3"]) -> Bool[Array, " vertices"]:
    return (vectors[:, 0] != 0) | (vectors[:, 1] != 0) | (vectors[:, 2] != 0)


def _first_of_equal(rows: Float[np.ndarray, "rows n"]) -> Int[np.ndarray, " rows"]:
    """Return for each row the first one that is equal to it."""
    order = np.lexsort(rows.T)
    sorted_rows = rows[order]
    starts = np.concatenate([[True], np.any(sorted_rows[1:] != sorted_rows[:-1], axis=1)])
    first = np.empty(len(rows), int)
    first[order] = order[np.maximum.accumulate(np.where(starts, np.arange(len(rows)), 0))]
    return first
