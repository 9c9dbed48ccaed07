"""Bumps from heights by surface gradients, with UVs, without them, and in layers.

A surface moved by a height ``h`` along its unit normal ``n`` has, to first order in ``h``,
the normal ``normalize(n - g)``, where the surface gradient ``g`` is the gradient of ``h``
within the tangent plane. It does not depend on the parameters ``h`` was differentiated by:
texture coordinates, pixels or a volume around the mesh give the same vector. Gradients add,
so that layers of bumps are a sum; a layer's strength is a factor.

All in one space, in which heights are lengths; normals have unit length.

References:
    J. F. Blinn, "Simulation of Wrinkled Surfaces", SIGGRAPH 1978; M. S. Mikkelsen, "Bump
    Mapping Unparametrized Surfaces on the GPU", 2010, and "Surface Gradient-Based Bump
    Mapping Framework", Journal of Computer Graphics Techniques 9(3), 2020.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ._math import dot, safe_divide, safe_norm, safe_normalize

Vectors = Float[Array | np.ndarray, "... 3"]
Scalars = Float[Array | np.ndarray, "..."]


class SurfaceGradient(NamedTuple):
    """A surface gradient, and whether there was one.

    Attributes:
        vector: In the tangent plane; height per length.
        valid: False where the input defines none.
    """

    vector: Float[Array, "... 3"]
    valid: Bool[Array, "..."]


def perturb_by_gradient(normal: Vectors, surface_gradient: Vectors) -> Float[Array, "... 3"]:
    """Return the bumped unit normals ``normalize(n - g)``.

    Args:
        normal: Unit normals; where zero, and the gradient too, the result is zero.
        surface_gradient: The gradient, or the sum of several.

    Differentiability:
        Smooth, since ``n`` and ``g`` are orthogonal and their difference never vanishes.
    """
    return safe_normalize(jnp.asarray(normal) - jnp.asarray(surface_gradient))


def gradient_from_parameters(
    normal: Vectors, dp_du: Vectors, dp_dv: Vectors, dh_du: Scalars, dh_dv: Scalars
) -> SurfaceGradient:
    """Return the surface gradient of a height known by its derivatives in two parameters.

    ``g = (cross(dp_dv, n) dh_du + cross(n, dp_du) dh_dv) / <n, cross(dp_du, dp_dv)>``. The
    parameters may be texture coordinates, with ``dp_du`` and ``dp_dv`` the unnormalized
    frame of a triangle, or the image's x and y, with differences of position and height
    between pixels of one surface (either direction of y, and mirrored charts, give the
    same): then the mesh needs no UVs.

    Args:
        normal: Unit normals.
        dp_du: Change of the position per unit of the first parameter.
        dp_dv: Change of the position per unit of the second.
        dh_du: Change of the height per unit of the first parameter.
        dh_dv: Change of the height per unit of the second.

    Returns:
        The gradient; zero and not ``valid`` where the two changes of position vanish, are
        parallel, or span a plane that contains the normal (a surface seen from its edge),
        to 8 units of rounding.

    Differentiability:
        Smooth where ``valid``, zero elsewhere.
    """
    along_u, along_v = safe_normalize(dp_du), safe_normalize(dp_dv)
    area = dot(normal, jnp.cross(along_u, along_v))
    valid = jnp.abs(area) > 8 * jnp.finfo(area.dtype).eps
    slope_u = safe_divide(jnp.asarray(dh_du), safe_norm(dp_du))
    slope_v = safe_divide(jnp.asarray(dh_dv), safe_norm(dp_dv))
    across = _times(slope_u, jnp.cross(along_v, normal)) + _times(
        slope_v, jnp.cross(normal, along_u)
    )
    vector = across / jnp.where(valid, area, 1.0)[..., None]
    return SurfaceGradient(jnp.where(valid[..., None], vector, 0.0), valid)


def gradient_from_slopes(
    slopes: Float[Array | np.ndarray, "... 2"], tangent: Vectors, bitangent: Vectors
) -> Float[Array, "... 3"]:
    """Return the surface gradient of slopes along an orthonormal frame: ``x t + y b``.

    Args:
        slopes: Height per length along tangent and bitangent; of a tangent-space normal
            ``(x, y, z)`` they are ``(-x / z, -y / z)``.
        tangent: Unit tangents.
        bitangent: Unit bitangents.

    Differentiability:
        Linear in each argument.
    """
    slopes = jnp.asarray(slopes)
    return _times(slopes[..., 0], jnp.asarray(tangent)) + _times(
        slopes[..., 1], jnp.asarray(bitangent)
    )


def gradient_from_volume(normal: Vectors, gradient: Vectors) -> Float[Array, "... 3"]:
    """Return the surface gradient of a height defined in space, such as a volume of noise.

    Args:
        normal: Unit normals.
        gradient: Gradient of the height in space, at the surface.

    Returns:
        The part of the gradient in the tangent plane; no UVs are needed.

    Differentiability:
        Smooth.
    """
    return jnp.asarray(gradient) - _times(dot(normal, gradient), jnp.asarray(normal))


def gradient_from_normal(normal: Vectors, bumped: Vectors) -> SurfaceGradient:
    """Return the surface gradient that bumps ``normal`` to ``bumped``, to add more to it.

    Args:
        normal: Unit normals.
        bumped: Normals of any length, in the same space.

    Returns:
        ``n - m / <n, m>``, the inverse of ``perturb_by_gradient``; zero and not ``valid``
        where the bumped normal does not lie above the surface (it is 89.99 degrees or more
        from the normal, or vanishes): no height has that normal.

    Differentiability:
        Smooth where ``valid``, zero elsewhere.
    """
    unit = safe_normalize(bumped)
    height = dot(normal, unit)
    valid = height > 1e-4
    vector = jnp.asarray(normal) - unit / jnp.where(valid, height, 1.0)[..., None]
    return SurfaceGradient(jnp.where(valid[..., None], vector, 0.0), valid)


def _times(scalars: Float[Array, "..."], vectors: Float[Array, "... 3"]) -> Float[Array, "... 3"]:
    return scalars[..., None] * vectors
