"""Lighting with a normal map: the lecture's two shaders, and the same per fragment.

The shaders: the vertex stage takes the directions to light and camera into the tangent
space of each vertex; the rasterizer interpolates them; the fragment stage normalizes and
lights them with the normal that the texel holds. Per fragment, the other way round: the
texel's normal goes to camera space, where light and camera are.

Camera space has the eye at the origin. The uniforms are those of the lecture:
``view_from_model`` (affine), its ``normal_matrix``, and the light's direction in camera
space, from the surface to the light. What its listing writes otherwise is read as meant:
directions have w = 0, so its vec4s are 3-vectors, ``mat4(T, B, N)`` is the 3x3 matrix with
these columns, and the normal is ``vec4(2 * color - 1, 0)``.

Where the frame in camera space is orthonormal (rigid motions, uniform scale, handedness of
either sign) both forms light a vertex alike. Between vertices they differ, since other
things are interpolated. Under non-uniform scale only the form per fragment is that of the
stretched surface: the shaders transpose a frame that is no longer orthogonal.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from ._math import dot, safe_normalize, stack_last
from .lighting import ShadingFunction, phong
from .normal_map import decode_normals

Vectors = Float[Array | np.ndarray, "... 3"]
Matrix = Float[Array | np.ndarray, "4 4"]


class TangentSpaceVectors(NamedTuple):
    """What the vertex stage hands on; not normalized, so that it interpolates linearly.

    Attributes:
        to_light_tangent: From the surface to the light, as long as it was given.
        to_camera_tangent: From the surface to the eye, as long as the distance.
    """

    to_light_tangent: Float[Array, "... 3"]
    to_camera_tangent: Float[Array, "... 3"]


def normal_matrix(view_from_model: Matrix) -> Float[Array, "3 3"]:
    """Return the inverse transpose of the matrix's linear part, which transforms normals.

    Args:
        view_from_model: An affine transform, or any other matrix between two spaces.

    Returns:
        The inverse transpose. Of a matrix that is singular, or cannot be told from one by
        its rounded entries, the cofactors up to a positive factor: they take the normals
        of a surface that is flattened to a plane to that plane's normal (of either sign),
        and are zero where it is flattened to a line.

    Differentiability:
        Smooth where the matrix is regular, finite everywhere; where it is singular the
        derivative is that of the cofactors.
    """
    # Columns of largest entry 1. The inverse does not depend on the scales used in between.
    linear = jnp.asarray(view_from_model)[:3, :3]
    largest = lax.stop_gradient(jnp.max(jnp.abs(linear), axis=0))
    scale = jnp.where(largest == 0, 1.0, largest)
    x, y, z = (linear / scale).T
    rounding = 8 * jnp.finfo(linear.dtype).eps
    cofactors = jnp.stack([jnp.cross(y, z), jnp.cross(z, x), jnp.cross(x, y)], axis=-1)
    parallel = jnp.max(jnp.abs(cofactors), axis=0) <= rounding  # what is left has no direction
    cofactors = jnp.where(parallel, 0.0, cofactors)
    determinant = dot(x, cofactors[:, 0])
    singular = jnp.abs(determinant) <= rounding
    return cofactors / jnp.where(singular, 1.0, determinant) / scale


def transform_directions(
    matrix: Float[Array | np.ndarray, "3 3"], directions: Vectors
) -> Float[Array, "... 3"]:
    """Apply a 3x3 matrix to directions, in full precision on every device."""
    x, y, z = (dot(directions, row) for row in jnp.asarray(matrix))
    return stack_last(x, y, z)


def view_positions(view_from_model: Matrix, positions: Vectors) -> Float[Array, "... 3"]:
    """Apply an affine matrix to positions, in full precision on every device."""
    x, y, z = (dot(positions, row[:3]) + row[3] for row in jnp.asarray(view_from_model)[:3])
    return stack_last(x, y, z)


def tangent_space_vectors(
    positions: Vectors,
    normals: Vectors,
    tangents: Vectors,
    bitangents: Vectors,
    *,
    view_from_model: Matrix,
    to_light_view: Vectors,
) -> TangentSpaceVectors:
    """Run the vertex stage: directions to light and camera, in each vertex's tangent space.

    Args:
        positions: Model space.
        normals: Model space, of any length.
        tangents: Model space, of any length.
        bitangents: Model space, of any length.
        view_from_model: Camera space from model space.
        to_light_view: Direction to the light in camera space, of any length: one for all
            vertices, or one each as a light at a point has.

    Returns:
        The vectors, for the rasterizer to interpolate.

    Differentiability:
        Smooth; a normal, tangent or bitangent that is zero gives a zero component, whose
        derivative is zero.
    """
    linear = jnp.asarray(view_from_model)[:3, :3]
    normal = safe_normalize(transform_directions(normal_matrix(view_from_model), normals))
    tangent = safe_normalize(transform_directions(linear, tangents))
    bitangent = safe_normalize(transform_directions(linear, bitangents))
    to_camera = -view_positions(view_from_model, positions)
    return TangentSpaceVectors(
        *(
            stack_last(dot(tangent, vector), dot(bitangent, vector), dot(normal, vector))
            for vector in (to_light_view, to_camera)
        )
    )


def shade_tangent_space(
    vectors: TangentSpaceVectors, normal_color: Vectors, *, shading: ShadingFunction = phong
) -> Float[Array, "... 3"]:
    """Run the fragment stage on interpolated vectors and the texel of the normal map.

    Args:
        vectors: As interpolated; normalized here.
        normal_color: Texels of the normal map, in [0, 1]; the normal is
            ``normalize(2 * color - 1)``.
        shading: A function of ``tangentspace.lighting``. Its defaults are the lecture's for
            ``phong``: ambient 0.1, diffuse 0.5, specular 0.9, no exponent.

    Returns:
        Linear RGB, not clamped to 1.

    Differentiability:
        That of ``shading``. A vector that vanishes, such as the normal of the color
        (1/2, 1/2, 1/2), counts as zero and has derivative zero.
    """
    to_light, to_camera = (safe_normalize(vector) for vector in vectors)
    return shading(safe_normalize(decode_normals(normal_color)), to_light, to_camera)


def view_normal(
    normal_color: Vectors,
    tangent: Vectors,
    bitangent: Vectors,
    normal: Vectors,
    *,
    view_from_model: Matrix,
) -> Float[Array, "... 3"]:
    """Take the normal map's normals to camera space, right under any affine transform.

    The normal is built in model space and transformed as normals are, so that its bumps
    are stretched with the surface, as if they were part of it.

    Args:
        normal_color: Texels of the normal map, in [0, 1].
        tangent: Model space, as interpolated.
        bitangent: Model space, as interpolated.
        normal: Model space, as interpolated.
        view_from_model: Camera space from model space, or world space from model space if
            light and camera are there.

    Returns:
        Unit normals; zero where the normal vanishes.

    Differentiability:
        Smooth; zero where the normal vanishes.
    """
    x, y, z = jnp.split(decode_normals(normal_color), 3, axis=-1)
    bumped = x * jnp.asarray(tangent) + y * jnp.asarray(bitangent) + z * jnp.asarray(normal)
    return safe_normalize(transform_directions(normal_matrix(view_from_model), bumped))


def shade_camera_space(
    positions: Vectors,
    normal_view: Vectors,
    *,
    view_from_model: Matrix,
    to_light_view: Vectors,
    shading: ShadingFunction = phong,
) -> Float[Array, "... 3"]:
    """Light fragments in camera space, from normals that ``view_normal`` gave.

    Args:
        positions: Model space, as interpolated.
        normal_view: Unit normals in camera space.
        view_from_model: Camera space from model space.
        to_light_view: Direction to the light in camera space, of any length.
        shading: A function of ``tangentspace.lighting``; the default is the lecture form.

    Returns:
        Linear RGB, not clamped to 1.
    """
    to_camera = safe_normalize(-view_positions(view_from_model, positions))
    return shading(normal_view, safe_normalize(to_light_view), to_camera)
