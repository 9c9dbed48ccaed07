"""Procedural bumps: round bumps in a grid over the texture, lit in tangent space.

The shader pair of the lecture on bump mapping, to the letter: no exponent, the mirrored
*incoming* light against the direction *from* the eye, both directions normalized at the
vertices, interpolated, and not normalized again; color clamped to 1. The listing's
``cross(NN, t)`` is read as ``cross(NN, TN)`` and its normal matrix as 3x3. Its
``LightPosition`` is used as a direction, the same for all vertices, in camera space.

References:
    R. J. Rost, "OpenGL Shading Language", 2002-2006, "Bump Mapping" (3Dlabs).
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ._math import dot, safe_normalize, stack_last
from .lighting import Colors, Scalars, reflect
from .tangent_lighting import (
    Matrix,
    Vectors,
    normal_matrix,
    transform_directions,
    view_positions,
)

Uvs = Float[Array | np.ndarray, "... 2"]


class BumpVectors(NamedTuple):
    """What the vertex stage hands on, in tangent space.

    Attributes:
        to_light: From the surface to the light; unit length at the vertices.
        from_eye: From the eye to the surface; unit length at the vertices.
    """

    to_light: Float[Array, "... 3"]
    from_eye: Float[Array, "... 3"]


def bump_normals(
    uvs: Uvs, *, density: Scalars = 16.0, size: Scalars = 0.15
) -> Float[Array, "... 3"]:
    """Return the tangent-space unit normals of a grid of round bumps, flat between them.

    With ``p`` the place in the cell, from -1/2 to 1/2 each way, the normal is
    ``normalize(p, 1)`` where ``|p|^2 < size`` and ``(0, 0, 1)`` elsewhere.

    Args:
        uvs: Texture coordinates.
        density: Bumps per unit of u and of v.
        size: Squared radius of a bump, cells; from 1/4 on neighbours touch, from 1/2 on
            the cells are full.

    Returns:
        Unit normals, of the floating-point type of ``uvs``.

    Differentiability:
        Smooth in ``uvs`` and ``density`` inside a bump, zero outside. The normal jumps at
        the rim, which belongs to the outside, and on the border of a full cell, which
        belongs to the cell on the side of larger coordinates; the derivatives there are
        those of the side it belongs to. What a moved rim changes is not seen: the
        derivative in ``size`` is zero.
    """
    scaled = jnp.asarray(uvs) * jnp.asarray(density)[..., None]
    place = scaled - jnp.floor(scaled) - 0.5
    x, y = place[..., 0], place[..., 1]
    squared = x * x + y * y
    shrink = 1 / jnp.sqrt(squared + 1)
    flat = squared >= size
    x, y = jnp.where(flat, 0.0, x), jnp.where(flat, 0.0, y)
    shrink = jnp.where(flat, 1.0, shrink)
    return stack_last(x * shrink, y * shrink, shrink)


def bump_vectors(
    positions: Vectors,
    normals: Vectors,
    tangents: Vectors,
    *,
    view_from_model: Matrix,
    light_view: Vectors,
) -> BumpVectors:
    """Run the vertex stage: unit directions to the light and from the eye, in tangent space.

    Args:
        positions: Model space.
        normals: Model space, of any length.
        tangents: Model space, of any length; to the letter the normal matrix takes them
            too, so under non-uniform scale they leave the surface's plane.
        view_from_model: Camera space from model space.
        light_view: Direction to the light in camera space, of any length.

    Returns:
        The vectors, for the rasterizer to interpolate.

    Differentiability:
        Smooth; a vector that vanishes, such as the normal of a vertex without faces,
        counts as zero and has derivative zero.
    """
    matrix = normal_matrix(view_from_model)
    normal = safe_normalize(transform_directions(matrix, normals))
    tangent = safe_normalize(transform_directions(matrix, tangents))
    bitangent = jnp.cross(normal, tangent)
    from_eye = view_positions(view_from_model, positions)
    return BumpVectors(
        *(
            safe_normalize(
                stack_last(dot(tangent, vector), dot(bitangent, vector), dot(normal, vector))
            )
            for vector in (light_view, from_eye)
        )
    )


def shade_bumps(
    vectors: BumpVectors,
    uvs: Uvs,
    *,
    density: Scalars = 16.0,
    size: Scalars = 0.15,
    albedo: Colors | tuple[float, float, float] = (0.7, 0.6, 0.18),
    specular: Scalars = 0.5,
) -> Float[Array, "... 3"]:
    """Run the fragment stage: ``min(albedo * max(<n, l>, 0) + specular * max(<e, r>, 0), 1)``.

    Here ``n`` is the bump's normal, ``l`` the direction to the light, ``e`` the direction
    from the eye and ``r = reflect(l, n)``.

    Args:
        vectors: As interpolated; not normalized again.
        uvs: Texture coordinates, as interpolated.
        density: Bumps per unit of u and of v.
        size: Squared radius of a bump, cells.
        albedo: Color of the surface, linear RGB or one number.
        specular: Factor on the highlight.

    Returns:
        Linear RGB, at most 1.

    Differentiability:
        As ``bump_normals``; the derivative is zero where a cosine is not positive or a
        channel has reached 1.
    """
    normal = bump_normals(uvs, density=density, size=size)
    diffuse = _positive(dot(normal, vectors.to_light))
    highlight = specular * _positive(dot(vectors.from_eye, reflect(vectors.to_light, normal)))
    color = diffuse[..., None] * jnp.asarray(albedo, normal.dtype) + highlight[..., None]
    color = jnp.broadcast_to(color, normal.shape)
    return jnp.where(color >= 1, 1.0, color)


def _positive(cosine: Float[Array, "..."]) -> Float[Array, "..."]:
    """Clamp below at 0, with derivative 0 there (``jnp.maximum`` halves it)."""
    return jnp.where(cosine > 0, cosine, 0.0)
