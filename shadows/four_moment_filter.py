"""Moment shadow maps: four moments of the depth, and the least shadow that fits them.

Of all distributions of depth with the four moments read, one shades a receiver least. It
has three points of support, the receiver's depth among them, and is found without its
other two where they are not needed: in depths measured from the mean in standard
deviations, whether the receiver lies between the two, before or behind them is a sign.
"""

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from ._checks import check_field
from .moment_filter import MomentFilter, Moments
from .transforms import Scalar

_TARGET = (0.0, 0.375, 0.0, 0.375)


class MSMFilter(MomentFilter):
    """The least shadow of any distribution of depths with the four moments read.

    Never darker than the truth but for the moment bias and rounding; light leaks where
    depths lie in three layers or more.

    Attributes:
        moment_bias: How far the moments are moved towards those of a spread-out depth;
            hides rounding, and leaks light.

    Differentiability:
        As ``moment_shadow_intensity``.

    References:
        C. Peters, R. Klein, "Moment Shadow Mapping", I3D 2015 (Hamburger's four moments);
        C. Peters, C. Muenstermann, N. Wetzstein, R. Klein, "Improved Moment Shadow Maps for
        Translucent Occluders, Soft Shadows and Single Scattering", JCGT 6(1), 2017.
    """

    moment_bias: Scalar = eqx.field(default=3e-7, metadata={"unit": "share"})

    def __check_init__(self) -> None:
        """Refuse a share that is not in [0, 1]."""
        check_field(self, "moment_bias", "from 0 to 1", lambda x: 0 <= x <= 1)

    def moments(self, depth: Float[Array, "..."]) -> Moments:
        """Return four powers of the depth."""
        square = depth * depth
        return depth, square, square * depth, square * square

    def lit(self, moments: Moments, depth: Float[Array, "*points"]) -> Float[Array, "*points"]:
        """Return what the least shadow leaves."""
        return 1 - moment_shadow_intensity(moments, depth, bias=self.moment_bias)


def moment_shadow_intensity(
    moments: Moments,
    depth: Float[Array, "*points"],
    *,
    bias: Scalar = 0.0,
    target: tuple[float, float, float, float] = _TARGET,
) -> Float[Array, "*points"]:
    """Return the least share below a depth of any distribution with four moments.

    Args:
        moments: Means of the first four powers of the depth.
        depth: Of the receivers, in the same range.
        bias: How far the moments are moved towards the target's.
        target: Four moments of a distribution; the default suits depths in [-1, 1] as well as
            any known.

    Returns:
        Shadow intensity in [0, 1].

    Differentiability:
        Smooth but where the number of points of support below the depth changes, and there
        continuous. Finite everywhere: where rounding left no variance, or none beyond that of
        two points, the least that the bias vouches for takes its place, without derivative.
    """
    b1, b2, b3, b4 = (b + bias * (t - b) for b, t in zip(moments, target, strict=True))
    # Pivots of the matrix of moments: those of a mixture are at least its parts' share.
    spread, spread_beyond = _target_pivots(target)
    rounding = 0.25 * float(jnp.finfo(depth.dtype).eps)
    variance = jnp.maximum(b2 - b1 * b1, jnp.maximum(bias * spread, rounding))
    scale = lax.rsqrt(variance)
    precision = scale * scale
    covariance = b3 - b1 * b2
    beyond = b4 - b2 * b2 - covariance * covariance * precision
    beyond = jnp.maximum(beyond, jnp.maximum(bias * spread_beyond, rounding))
    place = (depth - b1) * scale
    skew = (covariance * precision - 2 * b1) * scale
    excess = beyond * precision * precision  # kurtosis - skew^2 - 1

    # The sign of ``apart`` tells whether the receiver lies outside of the other two points.
    apart = place * place - skew * place - 1
    weight = excess / (excess * (1 + place * place) + apart * apart)
    between = apart < 0
    place_in, skew_in = jnp.where(between, place, 0), jnp.where(between, skew, 0)
    low = _lower_weight(place_in, skew_in, jnp.where(between, -apart, 1), excess, weight)
    behind = jnp.where(place > 0, 1 - weight, 0.0)
    return jnp.clip(jnp.where(between, low, behind), 0, 1)


def _lower_weight(
    place: Float[Array, "*points"],
    skew: Float[Array, "*points"],
    apart: Float[Array, "*points"],
    excess: Float[Array, "*points"],
    weight: Float[Array, "*points"],
) -> Float[Array, "*points"]:
    """Return the weight of the lower of two points with the receiver's depth between them.

    The two are the roots of ``apart x^2 - middle x - (excess + apart)``; one goes to infinity
    where ``apart`` goes to 0. The other's weight is computed, and the axis mirrored for it.
    """
    middle = excess * place + apart * skew
    mirrored = middle < 0
    place = jnp.where(mirrored, -place, place)
    root = jnp.sqrt(middle * middle + 4 * apart * (excess + apart))
    total = jnp.abs(middle) + root
    # Two quotients: the square of one divisor of all would leave the exponent's range.
    near = (0.5 * place * total + apart) / (place * total + 2 * (excess + apart))
    near = near * (total / root)
    return jnp.where(mirrored, 1 - weight - near, near)


def _target_pivots(target: tuple[float, float, float, float]) -> tuple[float, float]:
    """Return the variance of a distribution, and what its fourth moment has beyond need."""
    t1, t2, t3, t4 = target
    variance = t2 - t1**2
    return variance, t4 - t2**2 - (t3 - t1 * t2) ** 2 / variance
