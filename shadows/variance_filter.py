"""Variance shadow maps: mean and variance of the depth bound the share that blocks."""

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ._checks import check_field
from .moment_filter import MomentFilter, Moments
from .transforms import Scalar


class VSMFilter(MomentFilter):
    """Chebyshev's bound on the lit share, from the mean and variance of the depth; needs no bias.

    Exact for one plane that blocks and one that receives; where blockers lie at several
    depths light bleeds through them.

    Attributes:
        min_variance: Least variance: 1e-6 is a standard deviation of a thousandth of the
            depth range. Hides rounding; makes shadows lighter near their casters.
        bleeding: Visibility that counts as none; the rest is stretched to [0, 1], so that
            penumbrae darken.

    Differentiability:
        Where a receiver is nearer than the mean it is lit and its derivatives are zero; they
        are continuous there for positive variance. Finite everywhere.

    References:
        W. Donnelly, A. Lauritzen, "Variance Shadow Maps", I3D 2006; A. Lauritzen,
        "Summed-Area Variance Shadow Maps", GPU Gems 3, 2007, section 8.4.3 (bleeding).
    """

    needs_bias: ClassVar[bool] = False
    min_variance: Scalar = eqx.field(default=1e-6, metadata={"unit": "squared depth range"})
    bleeding: Scalar = eqx.field(default=0.0, metadata={"unit": "share"})

    def __check_init__(self) -> None:
        """Refuse a negative variance, and a share that is not in [0, 1)."""
        check_field(self, "min_variance", "from 0 to 1", lambda x: 0 <= x <= 1)
        check_field(self, "bleeding", "from 0 to below 1", lambda x: 0 <= x < 1)

    def moments(self, depth: Float[Array, "..."]) -> Moments:
        """Return the depth and its square."""
        return depth, depth * depth

    def lit(self, moments: Moments, depth: Float[Array, "*points"]) -> Float[Array, "*points"]:
        """Return the bound, its lowest part cut off."""
        mean, second = moments
        # Four times: signed depths range over 2.
        bound = chebyshev_bound(mean, second, depth, min_variance=4 * self.min_variance)
        return jnp.clip((bound - self.bleeding) / (1 - self.bleeding), 0, 1)


def chebyshev_bound(
    mean: Float[Array, "*points"],
    second: Float[Array, "*points"],
    value: Float[Array, "*points"],
    *,
    min_variance: Scalar | Float[Array, "*points"] = 0.0,
) -> Float[Array, "*points"]:
    """Return the largest share that any distribution with two moments has at or above a value.

    ``variance / (variance + (value - mean)^2)`` above the mean, 1 up to it (Cantelli).

    Args:
        mean: Of the distribution.
        second: Mean of the square.
        value: What is exceeded, as the depth of a receiver.
        min_variance: Least variance.

    Differentiability:
        Finite everywhere; at variance 0 and ``value == mean`` it is 1, with derivative 0.
    """
    variance = jnp.maximum(second - mean * mean, min_variance)
    above = value - mean
    squared = above * above
    lit = (above <= 0) | (variance + squared <= 0)
    return jnp.where(lit, 1.0, variance / jnp.where(lit, 1.0, variance + squared))
