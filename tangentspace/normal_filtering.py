"""Highlights of normal maps seen from afar: what bumps finer than a pixel do to the lobe.

The mean of unit normals is shorter than 1, and the more so the more they spread. Shading with
its direction alone shows the highlight of a mirror where there should be the wide one of a
rough surface; the length tells how wide. With ``r`` that length, the normals spread with
variance ``(1 - r) / r`` about either axis, a lobe of exponent ``s`` with ``1 / s``, and the
two add up to a lobe of exponent ``gloss * s`` (Toksvig). In this order:

1. ``build_normal_mips`` normalizes texel by texel before it averages, so that a length tells
   of the spread alone and not of rounding to 8 bits;
2. ``sample_trilinear`` and ``decode_normals`` give the mean, ``mean_length`` its length;
3. ``toksvig_gloss`` gives the factor on the exponent that the lighting models take.

Interpolation between texels shortens the mean too, though a surface seen through a magnifying
glass is no rougher. On average it spreads the normals of a smooth surface by 1/6 of the squared
distance of texels, while a pixel of ``f`` texels covers ``f^2 / 12``. So of the variance only
the share ``f^2 / (f^2 + 2)`` counts, which is 1 from afar. Against supersampling that leaves a
quarter to a third of the error where a pixel is half a texel wide, and nowhere adds more than
a twentieth. The moments of slopes that LEAN mapping keeps, reduced to one exponent, gave the
same errors within 6 % on average, for more texels: ``experiments/benchmarks/normal_mips.py``.

References:
    M. Toksvig, "Mipmapping Normal Maps", Journal of Graphics Tools 10(3), 2005. M. Olano and
    D. Baker, "LEAN Mapping", I3D 2010.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ._math import safe_norm
from .mips import Mips, build_mips
from .normal_map import decode_normals, encode_normals, scale_normals

Scalars = Float[Array | np.ndarray, "..."] | float

_SHORTEST = 1e-6  # length of a mean below which normals are as good as evenly spread


def build_normal_mips(
    texels: Float[Array | np.ndarray, "height width 3"], *, strength: Scalars = 1.0
) -> Mips:
    """Average a normal map down, after normalizing each texel.

    Args:
        texels: Stored values in [0, 1].
        strength: Factor on x and y (``scale_normals``): it changes how far normals spread, so
            it cannot come after the average.

    Returns:
        Values to decode after the lookup.

    Raises:
        ValueError: If ``texels`` has the wrong shape or no floating-point type.

    Differentiability:
        Smooth but at normals of length zero, where the derivative is zero.
    """
    if len(jnp.shape(texels)) != 3 or jnp.shape(texels)[-1] != 3:
        expected = f"expected `texels` of shape (height, width, 3), got {jnp.shape(texels)}"
        raise ValueError(f"build_normal_mips: {expected}")
    return build_mips(encode_normals(scale_normals(decode_normals(texels), strength)))


def mean_length(
    normals_mean: Float[Array | np.ndarray, "... 3"], *, footprint: Scalars | None = None
) -> Float[Array, "..."]:
    """Return the length that the mean of the normals under a pixel has.

    Args:
        normals_mean: As looked up and decoded, not normalized.
        footprint: Length of the pixel's footprint in texels (``texel_footprint``), to take
            back what interpolation does; None keeps the length as it is.

    Returns:
        Lengths in [0, 1]; exactly 1 everywhere on a flat map.

    Raises:
        ValueError: If ``normals_mean`` has the wrong shape.

    Differentiability:
        Smooth for lengths between 1e-6 and 1; beyond, the derivative in ``normals_mean`` is
        zero.
    """
    shape = jnp.shape(normals_mean)
    if not shape or shape[-1] != 3:
        raise ValueError(f"mean_length: expected `normals_mean` of shape (..., 3), got {shape}")
    length = safe_norm(normals_mean)
    length = jnp.where(length > _SHORTEST, jnp.where(length < 1, length, 1.0), _SHORTEST)
    if footprint is None:
        return length
    share = 1 - 2 / (jnp.square(footprint) + 2)
    return length / (length + share * (1 - length))


def toksvig_gloss(length: Scalars, shininess: Scalars) -> Float[Array, "..."]:
    """Return the factor by which the spread of normals lowers a highlight's exponent.

    ``r / (r + shininess * (1 - r))``.

    Args:
        length: Length ``r`` of the mean normal, in (0, 1], from ``mean_length``.
        shininess: Exponent of a highlight round the half vector (Blinn-Phong), > 0; Phong's
            round the mirror direction is as wide with a quarter of the exponent.

    Returns:
        Factors in (0, 1]; exactly 1 where the length is 1.

    Differentiability:
        Smooth.
    """
    length = jnp.asarray(length)
    return length / (length + (1 - length) * shininess)
