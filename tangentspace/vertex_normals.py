"""Normals of faces and of vertices, differentiable in the positions.

Faces are counter-clockwise seen from outside, so ``cross(p1 - p0, p2 - p0)`` points out.
All is computed from unit edge vectors: the result does not depend on the mesh's size.
"""

import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Int

from ._math import dot, safe_norm, safe_normalize

Positions = Float[Array | np.ndarray, "vertices 3"]
Faces = Int[Array | np.ndarray, "faces 3"]


def face_normals(positions: Positions, faces: Faces) -> Float[Array, "faces 3"]:
    """Compute one unit normal per face.

    Args:
        positions: Vertex positions.
        faces: Vertex indices, counter-clockwise seen from outside. Not differentiated.

    Returns:
        Unit normals; zero where a face is degenerate: a corner repeated, or a sine at its
        first corner below 8 units of rounding, whose direction would be noise.

    Raises:
        ValueError: If an array has the wrong shape or ``faces`` name a missing vertex. Where
            ``faces`` are traced, under ``jit``, their values cannot be checked.

    Differentiability:
        Smooth in ``positions``; the derivative is zero at degenerate faces.
    """
    positions = _checked(positions, faces, "face_normals")
    return _normals_and_edges(positions, faces)[0]


def vertex_normals(positions: Positions, faces: Faces) -> Float[Array, "vertices 3"]:
    """Compute one unit normal per vertex: the faces' normals, weighted by their angle there.

    The angle makes the result independent of how the surface is cut into triangles.

    Args:
        positions: Vertex positions.
        faces: Vertex indices, counter-clockwise seen from outside. Not differentiated.

    Returns:
        Unit normals; zero at vertices of no face, or only of degenerate ones, or whose
        faces cancel out.

    Raises:
        ValueError: If an array has the wrong shape or ``faces`` name a missing vertex. Where
            ``faces`` are traced, under ``jit``, their values cannot be checked.

    Differentiability:
        Smooth in ``positions`` but where a face degenerates; a degenerate face contributes
        nothing, neither to values nor to derivatives.

    References:
        G. Thuermer and C. Wuethrich, "Computing Vertex Normals from Polygonal Facets",
        Journal of Graphics Tools 3(1), 1998.
    """
    positions = _checked(positions, faces, "vertex_normals")
    normals, edges = _normals_and_edges(positions, faces)
    degenerate = jnp.all(normals == 0, axis=-1, keepdims=True)
    to_next, to_previous = edges, -jnp.roll(edges, 1, axis=1)
    sine = safe_norm(jnp.cross(to_next, to_previous))
    # The angle's derivative has no limit at (0, 0): there a harmless cosine stands in.
    angles = jnp.arctan2(sine, jnp.where(degenerate, 1.0, dot(to_next, to_previous)))
    weighted = angles[..., None] * normals[:, None, :]
    return safe_normalize(jnp.zeros_like(positions).at[faces].add(weighted))


def _normals_and_edges(
    positions: Float[Array, "vertices 3"], faces: Faces
) -> tuple[Float[Array, "faces 3"], Float[Array, "faces 3 3"]]:
    """Return unit face normals (0 if degenerate) and the unit edges, corner to next corner."""
    corners = positions[faces]
    edges = safe_normalize(jnp.roll(corners, -1, axis=1) - corners)
    rounding = 8 * float(jnp.finfo(positions.dtype).eps)
    normals = safe_normalize(jnp.cross(edges[:, 0], -edges[:, 2]), eps=rounding**2)
    return normals, edges


def _checked(positions: Positions, faces: Faces, name: str) -> Float[Array, "vertices 3"]:
    """Return the positions as a JAX array; refuse wrong shapes and missing vertices."""
    if positions.ndim != 2 or positions.shape[1] != 3:
        expected = f"expected `positions` of shape (vertices, 3), got {positions.shape}"
        raise ValueError(f"{name}: {expected}; give one row of x, y, z per vertex")
    if faces.ndim != 2 or faces.shape[1] != 3:
        expected = f"expected `faces` of shape (faces, 3), got {faces.shape}"
        raise ValueError(f"{name}: {expected}; split larger polygons into triangles")
    if not isinstance(faces, Tracer):
        known = np.asarray(faces)
        outside = (known < 0) | (known >= len(positions))
        if outside.any():
            expected = f"expected `faces` to index {len(positions)} vertices"
            raise ValueError(f"{name}: {expected}, got {known[outside][0]}; repair those faces")
    return jnp.asarray(positions)
