"""Filters of a regular window of texels: 2x2 bilinear, boxes and tents of any radius.

All are separable: a weight for each column of the window times one for each row, smooth
in the receiver's place. They are what a box or a tent, moved with the receiver, covers of
each texel (or, for the tent, what its bilinear taps weigh), so visibility has no jumps.
"""

import abc
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ._checks import check_field
from .filters import Tap, TapFilter, read_texel
from .shadow_map import Receiver, ShadowMap
from .transforms import Scalar


class WindowFilter(TapFilter):
    """Texels of a square window round the receiver, with a weight for each row and column."""

    @abc.abstractmethod
    def weights(self, fraction: Float[Array, "*points"]) -> list[Float[Array, "*points"]]:
        """Return the weight of each column (or row) of the window, an even number of them.

        Args:
            fraction: Where the receiver lies between the two middle texel centres, in [0, 1).
        """

    def read(self, prepared: ShadowMap, receiver: Receiver) -> tuple[Tap, ...]:
        """Read the window."""
        columns, rows = (self._axis(place) for place in (receiver.column, receiver.row))
        return tuple(
            tap
            for row, down_weight in rows
            for column, across_weight in columns
            for tap in read_texel(prepared, receiver, column, row, across_weight * down_weight)
        )

    def _axis(self, place: Float[Array, "*points"]) -> list[tuple[Array, Array]]:
        """Return coordinate and weight of each column or row."""
        first = jnp.floor(place - 0.5)
        weights = self.weights(place - 0.5 - first)
        before = len(weights) // 2 - 1
        return [(first + (k - before), weight) for k, weight in enumerate(weights)]


class BilinearFilter(WindowFilter):
    """The 2x2 texels whose centres surround the receiver, bilinear weights of the results.

    As a hardware shadow sampler with linear filtering (OpenGL's ``sampler2DShadow``).

    Differentiability:
        Continuous in the receiver's position, and smooth between texel centres.
    """

    wide: ClassVar[bool] = False

    def reach(self) -> Scalar:
        """Return one texel."""
        return 1.0

    def weights(self, fraction: Float[Array, "*points"]) -> list[Float[Array, "*points"]]:
        """Return two weights."""
        return [1 - fraction, fraction]


class PCFFilter(WindowFilter):
    """The mean of 2x2 bilinear lookups at the (2 radius + 1)^2 texels round the receiver.

    Attributes:
        radius: Texels to each side; 0 is the bilinear filter, 1 is known as PCF 3x3.

    References:
        W. Reeves, D. Salesin, R. Cook, "Rendering Antialiased Shadows with Depth Maps",
        SIGGRAPH 1987.
    """

    radius: int = eqx.field(static=True, default=1, metadata={"whole": "texels"})

    def __check_init__(self) -> None:
        """Refuse a radius that is no whole number from 0 to 16."""
        expected = "to be a whole number of texels from 0 to 16"
        check_field(self, "radius", expected, lambda radius: 0 <= radius <= 16, whole=True)

    def reach(self) -> Scalar:
        """Return the radius and one texel."""
        return self.radius + 1.0

    def weights(self, fraction: Float[Array, "*points"]) -> list[Float[Array, "*points"]]:
        """Return the share of each texel that a box of 2 radius + 1 texels covers."""
        return [1 - fraction, *[jnp.ones_like(fraction)] * (2 * self.radius), fraction]


class TentFilter(WindowFilter):
    """A tent over the texels round the receiver, in the closed forms of 3x3, 5x5 and 7x7.

    The weights of a row sum to 4, 12 and 52 (their products to 16, 144 and 2704).

    Attributes:
        radius: 1 for 3x3, 2 for 5x5, 3 for 7x7.

    References:
        I. Castano, "Shadow Mapping Summary - Part 1", The Witness, 2013.
    """

    radius: int = eqx.field(static=True, default=1, metadata={"whole": "texels"})

    def __check_init__(self) -> None:
        """Refuse a radius that is not 1, 2 or 3."""
        check_field(self, "radius", "1, 2 or 3", lambda radius: 1 <= radius <= 3, whole=True)

    def reach(self) -> Scalar:
        """Return the radius and one texel."""
        return self.radius + 1.0

    def weights(self, fraction: Float[Array, "*points"]) -> list[Float[Array, "*points"]]:
        """Return the weights, as whole numbers at texel centres."""
        s, t = fraction, 1 - fraction
        if self.radius == 1:
            return [t, 1 + t, 1 + s, s]
        if self.radius == 2:
            return [t, 1 + 2 * t, 3 + t, 3 + s, 1 + 2 * s, s]
        return [t, 1 + 4 * t, 5 + 7 * t, 12 + 4 * t, 12 + 4 * s, 5 + 7 * s, 1 + 4 * s, s]
