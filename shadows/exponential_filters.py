"""Exponential shadow maps: means of exponentials of the depth, which sharpen its order.

``ESMFilter`` compares a receiver with the mean itself, a soft maximum of the depths;
``EVSM2Filter`` and ``EVSM4Filter`` take Chebyshev's bound of exponentials. All exponents are
about the middle of the depth range, where float32 holds them up to 88.7 from end to end,
and receivers are compared in the logarithm or as ratios, so that nothing overflows.
"""

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from ._checks import check_field
from .moment_filter import MomentFilter, Moments
from .transforms import Scalar
from .variance_filter import chebyshev_bound

_ESM_LIMIT = 88.72  # exp(88.7228) is float32's largest number
_EVSM_LIMIT = 42.0  # of half the logarithm, 44.36; the rest is left to derivatives


class ESMFilter(MomentFilter):
    """The mean of ``exp(exponent * (stored - depth))``, at most 1; needs no bias.

    For depths in [0, 1]. Receivers behind every texel of the window are right; one in
    front of some is too bright, most where a caster touches what it shades.

    Attributes:
        exponent: Sharpness; the higher, the less light leaks and the harder the edge.

    Differentiability:
        Zero where the mean reaches 1; finite everywhere.

    References:
        T. Annen, T. Mertens, H.-P. Seidel, E. Flerackers, J. Kautz, "Exponential Shadow
        Maps", Graphics Interface 2008.
    """

    needs_bias: ClassVar[bool] = False
    exponent: Scalar = eqx.field(default=80.0, metadata={"unit": "per depth range"})

    def __check_init__(self) -> None:
        """Refuse an exponent that float32 cannot hold."""
        _check_exponent(self, "exponent", _ESM_LIMIT)

    def moments(self, depth: Float[Array, "..."]) -> Moments:
        """Return the exponential of the depth."""
        return (jnp.exp(0.5 * self.exponent * depth),)

    def lit(self, moments: Moments, depth: Float[Array, "*points"]) -> Float[Array, "*points"]:
        """Return the mean over the receiver's own exponential, from their logarithms."""
        excess = jnp.log(moments[0]) - 0.5 * self.exponent * depth
        return jnp.exp(jnp.minimum(excess, 0.0))


class EVSM2Filter(MomentFilter):
    """Chebyshev's bound of the exponential of the depth; needs no bias.

    Far less light bleeds through several blockers than with the depth itself; near contacts
    it leaks.

    Attributes:
        exponent: Of the signed depth in [-1, 1]; the higher, the less light bleeds.
        min_variance: Least variance of the depth, as ``VSMFilter``; scaled by the slope of
            the exponential at the receiver.

    Differentiability:
        As ``VSMFilter``.

    References:
        A. Lauritzen, M. McCool, "Layered Variance Shadow Maps", Graphics Interface 2008.
    """

    needs_bias: ClassVar[bool] = False
    exponent: Scalar = eqx.field(default=40.0, metadata={"unit": "per half depth range"})
    min_variance: Scalar = eqx.field(default=1e-8, metadata={"unit": "squared depth range"})

    def __check_init__(self) -> None:
        """Refuse an exponent whose squares float32 cannot hold, and a negative variance."""
        _check_exponent(self, "exponent", _EVSM_LIMIT)
        check_field(self, "min_variance", "from 0 to 1", lambda x: 0 <= x <= 1)

    def moments(self, depth: Float[Array, "..."]) -> Moments:
        """Return the exponential and its square."""
        warped = jnp.exp(self.exponent * depth)
        return warped, warped * warped

    def lit(self, moments: Moments, depth: Float[Array, "*points"]) -> Float[Array, "*points"]:
        """Return the bound."""
        mean, second = moments
        return self._bound(mean, second, jnp.exp(self.exponent * depth), self.exponent)

    def _bound(
        self,
        mean: Float[Array, "*points"],
        second: Float[Array, "*points"],
        value: Float[Array, "*points"],
        exponent: Scalar,
        *,
        sign: int = 1,
    ) -> Float[Array, "*points"]:
        """Return the bound for ``sign`` times an exponential of the depth."""
        # Any scale gives the same bound; by the larger of the two nothing overflows.
        scale = lax.stop_gradient(1 / jnp.maximum(mean, value))
        mean, second, value = mean * scale, second * scale * scale, value * scale
        slope = 2 * exponent * value  # by depths in [0, 1]
        least = self.min_variance * slope * slope
        return chebyshev_bound(sign * mean, second, sign * value, min_variance=least)


class EVSM4Filter(EVSM2Filter):
    """The smaller of two bounds, of a rising and of a falling exponential of the depth.

    The second closes most of the leaks near contacts that the first one leaves.

    Attributes:
        negative_exponent: Of the falling exponential.
    """

    needs_bias: ClassVar[bool] = True  # the second bound is the tighter one on slopes
    negative_exponent: Scalar = eqx.field(default=5.0, metadata={"unit": "per half depth range"})

    def __check_init__(self) -> None:
        """Refuse an exponent whose squares float32 cannot hold."""
        _check_exponent(self, "negative_exponent", _EVSM_LIMIT)

    def moments(self, depth: Float[Array, "..."]) -> Moments:
        """Return both exponentials and their squares."""
        falling = jnp.exp(-self.negative_exponent * depth)
        return *super().moments(depth), falling, falling * falling

    def lit(self, moments: Moments, depth: Float[Array, "*points"]) -> Float[Array, "*points"]:
        """Return the smaller bound."""
        rising = super().lit(moments[:2], depth)
        mean, second = moments[2:]
        value = jnp.exp(-self.negative_exponent * depth)
        falling = self._bound(mean, second, value, self.negative_exponent, sign=-1)
        return jnp.minimum(rising, falling)


def _check_exponent(filter: MomentFilter, field: str, limit: float) -> None:
    check_field(filter, field, f"from 0 to {limit:g}", lambda exponent: 0 <= exponent <= limit)
