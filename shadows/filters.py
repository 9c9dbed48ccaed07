"""Filters: which texels of the map a receiver asks, and with which weights.

Comparisons are blended, never depths (percentage-closer filtering). Outside the map's
image, and beyond its depths, nothing is known to block, so a point there is lit; that no
light arrives there may be the light's own affair.

A new filter is a new subclass of ``Filter``.
"""

import abc
import functools
import operator
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .compare import Compare
from .shadow_map import Receiver, ShadowMap


class Tap(NamedTuple):
    """One texel asked; it stays the same while only depth biases move.

    Attributes:
        stored: Depth of the texel; 1 outside the map.
        weight: Its weight, relative to those of the receiver's other taps.
    """

    stored: Float[Array, "*points"]
    weight: Float[Array, "*points"]


class Filter(eqx.Module):
    """A pattern of texels round a receiver."""

    @abc.abstractmethod
    def taps(self, shadow_map: ShadowMap, receiver: Receiver) -> tuple[Tap, ...]:
        """Read the map around each receiver."""


class NearestFilter(Filter):
    """The one texel that the receiver falls in.

    Differentiability:
        None in the receiver's position across texels; visibility jumps between them.
    """

    def taps(self, shadow_map: ShadowMap, receiver: Receiver) -> tuple[Tap, ...]:
        """Read one texel."""
        stored = _fetch(shadow_map, jnp.floor(receiver.column), jnp.floor(receiver.row))
        return (Tap(stored, jnp.ones_like(stored)),)


class BilinearFilter(Filter):
    """The 2x2 texels whose centres surround the receiver, bilinear weights of the results.

    As a hardware shadow sampler with linear filtering (OpenGL's ``sampler2DShadow``).

    Differentiability:
        Continuous in the receiver's position, and smooth between texel centres.
    """

    def taps(self, shadow_map: ShadowMap, receiver: Receiver) -> tuple[Tap, ...]:
        """Read four texels."""
        left, top = jnp.floor(receiver.column - 0.5), jnp.floor(receiver.row - 0.5)
        right_weight, bottom_weight = receiver.column - 0.5 - left, receiver.row - 0.5 - top
        across = ((left, 1 - right_weight), (left + 1, right_weight))
        down = ((top, 1 - bottom_weight), (top + 1, bottom_weight))
        return tuple(
            Tap(_fetch(shadow_map, column, row), column_weight * row_weight)
            for row, row_weight in down
            for column, column_weight in across
        )


def compare_taps(
    taps: tuple[Tap, ...], receiver: Receiver, compare: Compare
) -> Float[Array, "*points"]:
    """Compare a receiver with what was read; 1 = lit.

    Args:
        taps: From a filter, for this receiver or for one that differs in depth alone.
        receiver: After its bias.
        compare: Hard or soft.

    Returns:
        Visibility in [0, 1]; 1 where the receiver lies outside of what the map can tell.
    """
    total = functools.reduce(operator.add, (tap.weight for tap in taps))
    weighted = (tap.weight * compare(tap.stored, receiver) for tap in taps)
    # The division is also where XLA stops fusing; without one it computes the comparison
    # again for each color channel.
    visibility = functools.reduce(operator.add, weighted) / total
    return jnp.where(receiver.outside, 1.0, visibility)


def look_up(
    shadow_map: ShadowMap, receiver: Receiver, *, filter: Filter, compare: Compare
) -> Float[Array, "*points"]:
    """Return the visibility of receivers in [0, 1] (1 = lit).

    Args:
        shadow_map: The light's map.
        receiver: Points located in that map, after their bias.
        filter: Which texels are asked.
        compare: How depths become visibility.

    Differentiability:
        In the map's depths, the receiver's depth, bias and position, and the softness, as
        far as ``filter`` and ``compare`` have derivatives there.
    """
    return compare_taps(filter.taps(shadow_map, receiver), receiver, compare)


def _fetch(
    shadow_map: ShadowMap, column: Float[Array, "*points"], row: Float[Array, "*points"]
) -> Float[Array, "*points"]:
    """Read depths at whole texel coordinates; 1 outside."""
    height, width = shadow_map.depth.shape
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    index = jnp.where(inside, row, 0).astype(jnp.int32) * width + jnp.where(
        inside, column, 0
    ).astype(jnp.int32)
    depth = shadow_map.depth.reshape(-1).at[index].get(mode="promise_in_bounds")
    return jnp.where(inside, depth, 1.0)
