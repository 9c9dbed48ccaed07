"""Tangent frames of triangles and of vertices, differentiable in positions, normals and UVs.

The tangent points along growing u, the bitangent along growing v; v points up. The
``handedness`` is -1 where the texture is mirrored, so that for orthonormal frames
``bitangent = handedness * cross(normal, tangent)``. Where no frame exists, ``valid`` is
False, the vectors are zero, and so are their derivatives.

A face has no frame where its triangle, in space or in UVs, is a point, a line or not finite;
a line is what is not higher than some 8 units of rounding of its longest edge, a millionth of
it in single precision, since rounding would decide what is left.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ._columns import columns_of
from ._math import dot, safe_normalize, stack_last
from ._sides import angle_seen_along, rounding, sides_of
from .vertex_normals import Faces, Positions, _checked

Normals = Float[Array | np.ndarray, "vertices 3"]
Uvs = Float[Array | np.ndarray, "vertices 2"]
Vectors = Float[Array | np.ndarray, "... 3"]

# Contributions that add up to less than this share of their weights have canceled: what is
# left of them is the rounding of the UVs, magnified.
_CANCELED = 1e-3


class TriangleFrames(NamedTuple):
    """One frame per face: each edge is ``du * tangent + dv * bitangent``.

    Attributes:
        tangent: ``dp/du``, neither of unit length nor at right angles to the other.
        bitangent: ``dp/dv``.
        handedness: +1, or -1 where the texture is mirrored, or 0 where not valid.
        valid: Whether the triangle has an area, both in space and in UVs.
    """

    tangent: Float[Array, "faces 3"]
    bitangent: Float[Array, "faces 3"]
    handedness: Float[Array, " faces"]
    valid: Bool[Array, " faces"]


class VertexFrames(NamedTuple):
    """One orthonormal frame per vertex.

    Attributes:
        tangent: Unit vector along growing u; zero where not valid.
        bitangent: ``handedness * cross(normal, tangent)``; zero where not valid.
        normal: The normals given, at unit length; zero where they are zero or not finite.
        handedness: +1, or -1 where the texture is mirrored; +1 where not valid.
        valid: Whether the vertex has a frame.
    """

    tangent: Float[Array, "vertices 3"]
    bitangent: Float[Array, "vertices 3"]
    normal: Float[Array, "vertices 3"]
    handedness: Float[Array, " vertices"]
    valid: Bool[Array, " vertices"]


class OrthonormalFrames(NamedTuple):
    """Frames of unit vectors at right angles to each other.

    Attributes:
        tangent: Unit vectors; zero where the tangent had no part across the normal.
        bitangent: Unit vectors; zero where it had no part across the other two.
        normal: Unit vectors; zero where the normal was zero.
    """

    tangent: Float[Array, "... 3"]
    bitangent: Float[Array, "... 3"]
    normal: Float[Array, "... 3"]


def triangle_frames(positions: Positions, uvs: Uvs, faces: Faces) -> TriangleFrames:
    """Compute ``dp/du`` and ``dp/dv`` of every face.

    Args:
        positions: Vertex positions.
        uvs: Texture coordinates, v upwards.
        faces: Vertex indices, counter-clockwise seen from outside. Not differentiated.

    Raises:
        ValueError: If an array has the wrong shape or ``faces`` name a missing vertex. Where
            ``faces`` are traced, under ``jit``, their values cannot be checked.

    Differentiability:
        Smooth in ``positions`` and ``uvs`` where valid; the derivative is zero elsewhere.
    """
    positions = _checked(positions, faces, "triangle_frames")
    uvs = _checked_attribute("uvs", uvs, (len(positions), 2), "triangle_frames")
    sides = sides_of(positions, uvs, faces)
    scale = jnp.where(sides.valid, 1 / sides.uv_area, 0.0)
    handedness = jnp.where(sides.valid, jnp.sign(sides.uv_area), 0.0)
    tangent, bitangent = sides.along_u() * scale, sides.along_v() * scale
    return TriangleFrames(tangent.rows(), bitangent.rows(), handedness, sides.valid)


def vertex_frames(positions: Positions, normals: Normals, uvs: Uvs, faces: Faces) -> VertexFrames:
    """Compute one orthonormal frame per vertex from the faces round it.

    Each face contributes the direction of its ``dp/du`` within the plane of the vertex's
    normal, weighted by the face's angle at the vertex, seen along that normal: as
    MikkTSpace does, whose tangents these are wherever its corners of one vertex agree. An
    angle does not depend on how the surface is cut into triangles.

    A vertex has no frame where it belongs to no face that has one; where its normal is zero or
    not finite; where the contributions cancel, as round an unsplit pole; and where faces of both
    handednesses meet, which one frame cannot serve: ``split_mirrored`` parts them.

    Args:
        positions: Vertex positions.
        normals: Vertex normals, of any length.
        uvs: Texture coordinates, v upwards.
        faces: Vertex indices, counter-clockwise seen from outside. Not differentiated.

    Raises:
        ValueError: If an array has the wrong shape or ``faces`` name a missing vertex. Where
            ``faces`` are traced, under ``jit``, their values cannot be checked.

    Differentiability:
        Smooth in ``positions``, ``normals`` and ``uvs`` where valid, except where the normal
        sees a face edge-on. Faces without a frame add nothing to derivatives, and where
        ``valid`` is False those of the tangent and the bitangent are zero.

    References:
        M. S. Mikkelsen, "Simulation of Wrinkled Surfaces Revisited", master's thesis, 2008.
    """
    positions = _checked(positions, faces, "vertex_frames")
    count = len(positions)
    normals = _checked_attribute("normals", normals, (count, 3), "vertex_frames")
    uvs = _checked_attribute("uvs", uvs, (count, 2), "vertex_frames")

    sides = sides_of(positions, uvs, faces)
    mirrored = sides.uv_area < 0
    along_u, _ = (sides.along_u() * jnp.where(mirrored, -1.0, 1.0)).unit(0.0)
    finite = jnp.isfinite(dot(normals, normals))
    normal = safe_normalize(jnp.where(finite[:, None], normals, 0.0))
    columns = columns_of(normal)
    sums = jnp.zeros_like(positions)
    weights = jnp.zeros(2 * count, positions.dtype)  # of faces as they are, then of mirrored
    for corner, edges in enumerate(sides.corners()):
        at = faces[:, corner]
        up = columns.take(at)
        tangent, exists = along_u.across(up).unit(rounding(positions))
        angle = jnp.where(sides.valid & exists, angle_seen_along(up, *edges, sides.cross), 0.0)
        sums = sums.at[at].add((tangent * angle).rows())
        weights = weights.at[at + jnp.where(mirrored, count, 0)].add(jax.lax.stop_gradient(angle))

    plain, turned = weights[:count], weights[count:]
    total = columns_of(sums)
    remains = total.dot(total) > (_CANCELED * (plain + turned)) ** 2
    valid = remains & ((plain > 0) != (turned > 0)) & (columns.dot(columns) > 0)
    tangent, _ = (total * valid.astype(positions.dtype)).unit(0.0)
    handedness = jnp.where(valid & (turned > 0), -1.0, 1.0).astype(positions.dtype)
    bitangent = columns.cross(tangent) * handedness
    return VertexFrames(tangent.rows(), bitangent.rows(), normal, handedness, valid)


def gram_schmidt(tangent: Vectors, bitangent: Vectors, normal: Vectors) -> OrthonormalFrames:
    """Make frames orthonormal, keeping the normal's direction and the handedness.

    ``T' = T - <N, T> N`` and ``B' = B - <N, B> N - <T', B> T'``, each of unit length before
    it is used. Leading axes broadcast.

    Args:
        tangent: Vectors along growing u, of any length.
        bitangent: Vectors along growing v, of any length.
        normal: Normals, of any length.

    Differentiability:
        Smooth; zero where a result is zero. In ``bitangent`` the derivative vanishes: the
        tangent and the normal leave it nothing but its sign.
    """
    normal = safe_normalize(normal)
    eps = rounding(normal) ** 2
    tangent = safe_normalize(_across(safe_normalize(tangent), normal), eps=eps)
    bitangent = _across(_across(safe_normalize(bitangent), normal), tangent)
    return OrthonormalFrames(tangent, safe_normalize(bitangent, eps=eps), normal)


def to_world(
    vectors_tangent: Vectors, tangent: Vectors, bitangent: Vectors, normal: Vectors
) -> Float[Array, "... 3"]:
    """Take vectors from tangent space to the space of the frames: ``x T + y B + z N``.

    Args:
        vectors_tangent: Vectors in tangent space. Leading axes broadcast.
        tangent: The frames' first axes.
        bitangent: The frames' second axes.
        normal: The frames' third axes.
    """
    x, y, z = (jnp.asarray(vectors_tangent)[..., axis, None] for axis in range(3))
    return x * tangent + y * bitangent + z * normal


def to_tangent(
    vectors_world: Vectors, tangent: Vectors, bitangent: Vectors, normal: Vectors
) -> Float[Array, "... 3"]:
    """Take vectors to tangent space: their inner products with the frames' axes.

    The transpose of ``to_world``, and its inverse where the frames are orthonormal.

    Args:
        vectors_world: Vectors in the space of the frames. Leading axes broadcast.
        tangent: The frames' first axes.
        bitangent: The frames' second axes.
        normal: The frames' third axes.
    """
    return stack_last(*(dot(axis, vectors_world) for axis in (tangent, bitangent, normal)))


def _across(vectors: Float[Array, "... 3"], unit: Float[Array, "... 3"]) -> Float[Array, "... 3"]:
    """Return the part of vectors at right angles to unit vectors."""
    return vectors - dot(vectors, unit)[..., None] * unit


def _checked_attribute(
    argument: str, values: Float[Array | np.ndarray, "..."], shape: tuple[int, int], name: str
) -> Float[Array, "..."]:
    """Return a vertex attribute as a JAX array; refuse a wrong shape."""
    if values.shape != shape:
        raise ValueError(
            f"{name}: expected `{argument}` of shape {shape}, got {values.shape}; "
            "give one row per vertex"
        )
    return jnp.asarray(values)
