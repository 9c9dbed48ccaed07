"""From a normal map's vector to the pixel's normal and back, as MikkTSpace prescribes.

At a pixel the vertices' tangent ``T`` (with its handedness ``w``) and normal ``N`` are
interpolated and *not* normalized, nor made perpendicular; ``B = w * cross(N, T)``; and the
normal ``(x, y, z)`` from the map becomes ``normalize(x T + y B + z N)``. A baker must apply the
exact inverse, or the map does not reproduce what was baked.

Leading axes broadcast. Where ``T``, ``B`` and ``N`` span no space (``T`` or ``N`` is zero, the
two are parallel up to rounding, or ``w`` is zero) a map has no meaning: the interpolated
normal stays as it is, and its inverse is the flat (0, 0, 1).
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ._math import dot, safe_normalize

Vectors = Float[Array | np.ndarray, "... 3"]
Tangents = Float[Array | np.ndarray, "... 4"]


def perturb_normal(
    normal_tangent: Vectors, tangent: Tangents, normal: Vectors
) -> Float[Array, "... 3"]:
    """Take normals of a normal map out of tangent space.

    Args:
        normal_tangent: Decoded vectors of the map, z outwards, of any length.
        tangent: Interpolated tangents and handedness, not normalized.
        normal: Interpolated normals, not normalized, in the space of ``tangent``.

    Returns:
        Unit normals in that space. A flat map, (0, 0, 1), gives exactly the normalized
        ``normal``. Zero only where ``normal`` is zero and nothing else is known.

    Differentiability:
        Smooth in all arguments; where the frame spans no space only ``normal`` counts, and
        where the result is zero the derivative is zero.
    """
    bitangent, normal, spans = _frame(tangent, normal)
    x, y, z = (jnp.asarray(normal_tangent)[..., i, None] for i in range(3))
    perturbed = x * tangent[..., :3] + y * bitangent + z * normal
    usable = spans & jnp.any(perturbed != 0, axis=-1)
    return safe_normalize(jnp.where(usable[..., None], perturbed, normal))


def unperturb_normal(
    normal_world: Vectors, tangent: Tangents, normal: Vectors
) -> Float[Array, "... 3"]:
    """Take normals into tangent space: the exact inverse of `perturb_normal`, for bakers.

    Args:
        normal_world: Normals in the space of the frame, of any length.
        tangent: Interpolated tangents and handedness, not normalized.
        normal: Interpolated normals, not normalized.

    Returns:
        Unit normals in tangent space; (0, 0, 1) where the frame spans no space or
        ``normal_world`` is zero.

    Differentiability:
        Smooth in all arguments; the derivative is zero where the answer is (0, 0, 1) for
        want of a frame or of a normal.
    """
    bitangent, normal, spans = _frame(tangent, normal)
    normal_world, sign = jnp.asarray(normal_world), jnp.sign(jnp.asarray(tangent)[..., 3:])
    # The inverse of the matrix with columns T, B, N, times its determinant's magnitude.
    rows = (
        jnp.cross(bitangent, normal),
        jnp.cross(normal, tangent[..., :3]),
        jnp.cross(tangent[..., :3], bitangent),
    )
    local = sign * jnp.stack([dot(row, normal_world) for row in rows], axis=-1)
    unit = safe_normalize(jnp.where(spans[..., None], local, 0.0))
    found = jnp.any(unit != 0, axis=-1, keepdims=True)
    return jnp.where(found, unit, jnp.array([0, 0, 1], unit.dtype))


def _frame(
    tangent: Tangents, normal: Vectors
) -> tuple[Float[Array, "... 3"], Float[Array, "... 3"], Bool[Array, "..."]]:
    """Return the bitangent, the normal as a JAX array, and if the frame spans space."""
    tangent, normal = jnp.asarray(tangent), jnp.asarray(normal)
    direction, handedness = tangent[..., :3], tangent[..., 3:]
    across = jnp.cross(normal, direction)
    lengths = dot(normal, normal) * dot(direction, direction)
    rounding = 8 * float(jnp.finfo(across.dtype).eps)
    spans = (dot(across, across) > rounding**2 * lengths) & (handedness[..., 0] != 0)
    return handedness * across, normal, spans
