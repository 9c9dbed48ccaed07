"""Depth comparison: the hard step of shadow mapping, and the soft one that has a gradient.

A new comparison is a new subclass of ``Compare``.
"""

import abc

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .shadow_map import Receiver
from .transforms import Scalar

_LIT = 100.0  # the sigmoid of this is 1, in double precision too


class Compare(eqx.Module):
    """Turns stored depths into visibility."""

    @abc.abstractmethod
    def __call__(
        self, stored: Float[Array, "*points"], receiver: Receiver
    ) -> Float[Array, "*points"]:
        """Return the visibility in [0, 1] (1 = lit) of each receiver for each stored depth."""


class HardCompare(Compare):
    """Lit where the receiver is not deeper than the stored depth.

    Differentiability:
        None: the derivative is zero wherever it exists.
    """

    def __call__(
        self, stored: Float[Array, "*points"], receiver: Receiver
    ) -> Float[Array, "*points"]:
        """Return 0 or 1."""
        return (_margin(stored, receiver) >= 0).astype(stored.dtype)


class SoftCompare(Compare):
    """A sigmoid of the margin between the stored depth and the receiver's.

    ``visibility = sigmoid(margin / (softness * width))``, where ``width`` is the depth over
    half a texel of the receiver's surface: ``half * sqrt(slope**2 + 1)`` with the slope per
    texel, so that the step is as soft on a wall as on a floor, and positive everywhere.
    Softness 0 is the hard comparison. A texel without a surface blocks nothing at any softness.

    Attributes:
        softness: Width of the step, in half texels along the surface.

    Differentiability:
        Smooth for softness > 0; zero derivatives at softness 0.
    """

    softness: Scalar = eqx.field(default=0.5, metadata={"unit": "half texels"})

    def __call__(
        self, stored: Float[Array, "*points"], receiver: Receiver
    ) -> Float[Array, "*points"]:
        """Return visibility between 0 and 1."""
        margin = _margin(stored, receiver)
        across = 0.5 * jnp.abs(receiver.depth_rate) * receiver.texel_length
        squared = receiver.footprint**2 + across**2
        flat = squared <= 0
        width = self.softness * jnp.sqrt(jnp.where(flat, 1, squared))
        hard = flat | (width <= 0)
        scaled = jnp.where(stored >= 1, _LIT, margin / jnp.where(hard, 1, width))
        return jnp.where(hard, (margin >= 0).astype(stored.dtype), jax.nn.sigmoid(scaled))


def _margin(stored: Float[Array, "*points"], receiver: Receiver) -> Float[Array, "*points"]:
    """Return by how much the stored depth exceeds the receiver's, its bias taken off.

    A texel that no surface was drawn to (depth 1) blocks nothing: its margin is 1 or more.
    """
    reference = receiver.depth - receiver.depth_bias
    return stored - reference + (stored >= 1)
