"""Normal maps: from stored values to vectors and back, from heights, blended and scaled.

A texel ``c`` in [0, 1] stores the vector ``2 c - 1`` in tangent space: x along the tangent (u),
y along the bitangent (v, upwards; green is +Y, as in OpenGL and glTF), z along the surface
normal. Values are raw, never sRGB. A vector out of a map need not have unit length: it is
normalized after all lookups, so that these stay linear.

An image of n bits has an even number of levels and none at 1/2, so it cannot store a flat
surface: 8-bit (128, 128, 255) decodes to x = y = +1/255, a tilt of 0.318 degrees (16 bits:
0.0012). That is what graphics drivers shade, and here it is the default too; ``snap_flat`` moves
the two levels next to 1/2 onto it, no farther than what rounding to levels had moved them.

References:
    The Khronos Group, "glTF 2.0 Specification", section 3.9.3. C. Barre-Brisebois and S. Hill,
    "Blending in Detail", 2012.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ._math import dot, safe_divide, safe_normalize, stack_last
from .texture import Wrap, repeat

Vectors = Float[Array | np.ndarray, "... 3"]
Scalars = Float[Array | np.ndarray, "..."] | float

_GRAZING = 1e-6  # z of a unit normal from which on it has no slope


def decode_normals(
    texels: Float[Array | np.ndarray, "... channels"],
) -> Float[Array, "... channels"]:
    """Turn stored values in [0, 1] into vectors: ``2 c - 1``, not normalized.

    Works for two-channel maps as well; ``rebuild_z`` then adds the third component.
    (1/2, 1/2, 1) is exactly (0, 0, 1).

    Differentiability:
        Linear.
    """
    return 2 * jnp.asarray(texels) - 1


def encode_normals(
    normals: Float[Array | np.ndarray, "... channels"],
) -> Float[Array, "... channels"]:
    """Turn unit vectors into values to store, in [0, 1]: ``(n + 1) / 2``.

    Differentiability:
        Linear.
    """
    return 0.5 * (jnp.asarray(normals) + 1)


def quantize(texels: Float[Array | np.ndarray, "..."], *, bits: int) -> Float[Array, "..."]:
    """Round values to what an image of so many bits per channel can store.

    Args:
        texels: Values; below 0 and above 1 they are clipped.
        bits: 8 or 16, or any number from 1 to 16.

    Returns:
        Values in [0, 1]; 1/2 becomes the level above it.

    Raises:
        ValueError: If there is no such number of bits.

    Differentiability:
        None: the derivative of a step is zero.
    """
    levels = _levels(bits, "quantize")
    return jnp.floor(jnp.clip(jnp.asarray(texels), 0, 1) * levels + 0.5) / levels


def snap_flat(texels: Float[Array | np.ndarray, "..."], *, bits: int = 8) -> Float[Array, "..."]:
    """Move the two levels next to 1/2 onto it, so that a flat map is exactly flat.

    Args:
        texels: Values out of an image of so many bits per channel.
        bits: Of the image, from 1 to 16.

    Returns:
        The same values, but for the two levels next to 1/2, which become 1/2.

    Raises:
        ValueError: If there is no such number of bits.

    Differentiability:
        Zero where values are moved, one elsewhere.
    """
    texels = jnp.asarray(texels)
    near = jnp.abs(texels - 0.5) < 0.75 / _levels(bits, "snap_flat")
    return jnp.where(near, 0.5, texels)


def flip_green(normals: Vectors) -> Float[Array, "... 3"]:
    """Turn vectors of a -Y map (DirectX) into those of a +Y map (OpenGL), or back."""
    x, y, z = _components(normals, "flip_green", "normals")
    return stack_last(x, -y, z)


def rebuild_z(xy: Float[Array | np.ndarray, "... 2"]) -> Float[Array, "... 3"]:
    """Add the z that a two-channel map leaves out: ``sqrt(max(1 - x^2 - y^2, 0))``.

    Args:
        xy: Decoded vectors.

    Returns:
        Vectors of unit length, or with z = 0 where x and y are already longer than that.

    Raises:
        ValueError: If ``xy`` has the wrong shape.

    Differentiability:
        Smooth inside the unit circle; on it and outside, the derivative of z is zero.
    """
    if not jnp.shape(xy) or jnp.shape(xy)[-1] != 2:
        raise ValueError(f"rebuild_z: expected `xy` of shape (..., 2), got {jnp.shape(xy)}")
    xy = jnp.asarray(xy)
    x, y = xy[..., 0], xy[..., 1]
    squared = 1 - x * x - y * y
    outside = squared <= 0
    z = jnp.where(outside, 0.0, jnp.sqrt(jnp.where(outside, 1.0, squared)))
    return stack_last(x, y, z)


def normals_from_heights(
    heights: Float[Array | np.ndarray, "height width"],
    *,
    scale: Scalars = 1.0,
    wrap_u: Wrap = repeat,
    wrap_v: Wrap = repeat,
) -> Float[Array, "height width 3"]:
    """Compute the normals of a height field, ``n ~ (-dh/du, -dh/dv, 1)``, one per texel.

    Central differences; beyond its borders the image continues as told.

    Args:
        heights: Heights at the texel centres, row 0 on top.
        scale: Length of a height of 1, where the whole image is 1 wide and 1 high: for a world
            height and an image stretched over so much of the world, their ratio.
        wrap_u: ``repeat``, ``clamp`` or ``mirror``, to the left and to the right.
        wrap_v: The same above and below.

    Returns:
        Unit normals.

    Raises:
        ValueError: If ``heights`` is no image with at least one texel.

    Differentiability:
        Smooth in ``heights`` and ``scale``.
    """
    shape = jnp.shape(heights)
    if len(shape) != 2 or 0 in shape:
        expected = f"expected `heights` of shape (height, width), each > 0, got {shape}"
        raise ValueError(f"normals_from_heights: {expected}")
    heights = jnp.asarray(heights) * scale
    rows, columns = (jnp.arange(n, dtype=jnp.int32) for n in shape)
    right, left = (heights[:, wrap_u(columns + step, shape[1])] for step in (1, -1))
    lower, upper = (heights[wrap_v(rows + step, shape[0])] for step in (1, -1))
    slope_u, slope_v = (right - left) * (shape[1] / 2), (upper - lower) * (shape[0] / 2)
    return safe_normalize(stack_last(-slope_u, -slope_v, jnp.ones_like(slope_u)))


def blend_normals(base: Vectors, detail: Vectors) -> Float[Array, "... 3"]:
    """Put a detail map's normals on top of a base map's (reoriented normal mapping).

    The detail is turned by the shortest rotation that takes (0, 0, 1) to the base normal, so
    a flat base gives the detail, and a flat detail the base.

    Args:
        base: Unit normals.
        detail: Unit normals.

    Returns:
        Unit normals.

    Raises:
        ValueError: If an array has the wrong shape.

    Differentiability:
        Smooth but for the base (0, 0, -1), which no shortest rotation leads to: there the
        result is opposite to ``detail`` in z, and the derivative in ``base`` zero.
    """
    x, y, z = _components(base, "blend_normals", "base")
    bent = stack_last(x, y, z + 1)
    x, y, z = _components(detail, "blend_normals", "detail")
    turned = stack_last(-x, -y, z)
    return bent * safe_divide(dot(bent, turned), bent[..., 2])[..., None] - turned


def scale_normals(normals: Vectors, strength: Scalars) -> Float[Array, "... 3"]:
    """Make a map stronger or weaker: x and y times ``strength``, normalized, as in glTF.

    Args:
        normals: Normals of any length.
        strength: 1 leaves them, 0 gives a flat map, a negative one swaps dents and bumps.

    Returns:
        Unit normals; zero where nothing is left to normalize.

    Raises:
        ValueError: If ``normals`` has the wrong shape.

    Differentiability:
        Smooth but where nothing is left; the derivative there is zero.
    """
    x, y, z = _components(normals, "scale_normals", "normals")
    return safe_normalize(stack_last(x * strength, y * strength, z))


class Slopes(NamedTuple):
    """Slopes of the height field that has given normals.

    Attributes:
        slopes: (dh/du, dh/dv); zero where there is none.
        valid: Whether the normal looks up, so that there is a slope.
    """

    slopes: Float[Array, "... 2"]
    valid: Bool[Array, "..."]


def slopes_from_normals(normals: Vectors) -> Slopes:
    """Return the slopes ``(-x / z, -y / z)`` of normals.

    Args:
        normals: Normals of any length.

    Returns:
        The slopes, with a flag where z is below 1e-6, as no height field has such normals.

    Raises:
        ValueError: If ``normals`` has the wrong shape.

    Differentiability:
        Smooth where valid; elsewhere the derivative is zero.
    """
    x, y, z = _components(normals, "slopes_from_normals", "normals")
    valid = z >= _GRAZING
    safe = jnp.where(valid, z, 1.0)
    slope_u, slope_v = (jnp.where(valid, -part / safe, 0.0) for part in (x, y))
    return Slopes(jnp.stack([slope_u, slope_v], axis=-1), valid)


def normals_from_slopes(slopes: Float[Array | np.ndarray, "... 2"]) -> Float[Array, "... 3"]:
    """Return the unit normals ``(-p, -q, 1) / sqrt(1 + p^2 + q^2)`` of slopes (p, q).

    Every pair of slopes is a normal that looks up: free unknowns for a fit.

    Args:
        slopes: (dh/du, dh/dv).

    Raises:
        ValueError: If ``slopes`` has the wrong shape.

    Differentiability:
        Smooth.
    """
    shape = jnp.shape(slopes)
    if not shape or shape[-1] != 2:
        raise ValueError(f"normals_from_slopes: expected `slopes` of shape (..., 2), got {shape}")
    slopes = jnp.asarray(slopes)
    p, q = slopes[..., 0], slopes[..., 1]
    z = 1 / jnp.sqrt(1 + p * p + q * q)
    return stack_last(-p * z, -q * z, z)


def _components(
    vectors: Vectors, name: str, argument: str
) -> tuple[Float[Array, "..."], Float[Array, "..."], Float[Array, "..."]]:
    shape = jnp.shape(vectors)
    if not shape or shape[-1] != 3:
        raise ValueError(f"{name}: expected `{argument}` of shape (..., 3), got {shape}")
    vectors = jnp.asarray(vectors)
    return vectors[..., 0], vectors[..., 1], vectors[..., 2]


def _levels(bits: int, name: str) -> int:
    """Return the highest level, as a number."""
    if not 1 <= bits <= 16:
        raise ValueError(f"{name}: expected `bits` from 1 to 16, got {bits}")
    return 2**bits - 1
