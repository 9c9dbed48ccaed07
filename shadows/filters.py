"""Filters: what of the map a receiver asks, and how the answers become one visibility.

A filter works in three stages, so that nothing is computed again that stays: ``prepare``
sees the map alone (once per light), ``read`` the map and the receivers' places (once while
only depth biases move), ``visibility`` the receivers' depths. Outside the map's image, and
beyond its depths, nothing is known to block, so a point there is lit; that no light
arrives there may be the light's own affair.

A new filter is a new subclass of ``Filter``, or of one of those that share a way:
``TapFilter`` blends comparisons, never depths (percentage-closer filtering), ``window_filters``
holds those of regular windows, ``disc_filters`` those of scattered points, and
``moment_filter`` those that blur the map beforehand.
"""

import abc
import functools
import operator
from collections.abc import Callable, Sequence
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, PyTree

from tangentspace._math import safe_divide

from .compare import Compare
from .lights import Light
from .shadow_map import Receiver, ShadowMap
from .surface_planes import SurfacePlanes
from .transforms import Scalar


class Filter(eqx.Module):
    """A way to ask a shadow map.

    Attributes:
        compares: Whether it compares depths, so that a ``Compare`` and biases that follow
            the receiver's plane mean something to it.
        wide: Whether it reads farther than 2x2 texels, where one depth serves all badly.
        reads_anew: Whether what it reads depends on the receiver's depth.
        needs_bias: Whether surfaces shade themselves under it without a bias.
    """

    compares: ClassVar[bool] = True
    wide: ClassVar[bool] = True
    reads_anew: ClassVar[bool] = False
    needs_bias: ClassVar[bool] = True

    def for_light(self, light: Light) -> "Filter":
        """Return the filter with what it leaves to the light; most leave nothing."""
        del light
        return self

    @abc.abstractmethod
    def reach(self) -> Scalar:
        """Return the texels from a receiver to the farthest texel centre, along either axis."""

    def prepare(self, shadow_map: ShadowMap) -> PyTree:
        """Return what is read, from the map alone."""
        return shadow_map

    @abc.abstractmethod
    def read(self, prepared: Any, receiver: Receiver) -> PyTree:
        """Read around each receiver; its depth and bias do not matter."""

    @abc.abstractmethod
    def visibility(
        self, reading: Any, receiver: Receiver, compare: Compare
    ) -> Float[Array, "*points"]:
        """Return the visibility in [0, 1] of receivers after their bias (1 = lit)."""


class TapPlane(NamedTuple):
    """The plane of what a texel sees, as in ``SurfacePlanes``.

    Attributes:
        depth_per_column: Change of the depth from one column to the next.
        depth_per_row: From one row to the next.
        farthest: Depth beyond which the surface does not go on.
    """

    depth_per_column: Float[Array, "*points"]
    depth_per_row: Float[Array, "*points"]
    farthest: Float[Array, "*points"]


class Tap(NamedTuple):
    """One texel asked, or a layer of it; it stays the same while only depth biases move.

    Attributes:
        stored: Depth of the texel; 1 outside the map.
        weight: Its weight, relative to those of the receiver's other taps.
        across: Columns from the receiver to the place where that depth was seen.
        down: Rows from the receiver to there.
        plane: What the surface is round that place; None of a map without planes.
    """

    stored: Float[Array, "*points"]
    weight: Float[Array, "*points"]
    across: Float[Array, "*points"]
    down: Float[Array, "*points"]
    plane: TapPlane | None = None

    def lit(self, receiver: Receiver, compare: Compare) -> Float[Array, "*points"]:
        """Return the visibility of a receiver by this texel.

        The receiver's plane is compared with the depth where that was seen; if the map has
        planes, the texel's too, with the receiver. Where the surface ends on the way, it is
        taken to go on in the receiver's plane, or flat, whichever lights more.
        """
        visible = compare(self.stored, receiver.at_texel(self.across, self.down))
        if self.plane is None:
            return visible
        column, row, farthest = self.plane
        deeper = -self.across * column - self.down * row
        part = jnp.maximum(farthest - self.stored, 0)
        part = jnp.where(deeper > part, safe_divide(part, deeper), 1)
        there = receiver.at_texel((1 - part) * self.across, (1 - part) * self.down).depth
        nearer = receiver._replace(depth=jnp.minimum(there, receiver.depth))
        return jnp.maximum(visible, compare(self.stored + part * deeper, nearer))


class TapFilter(Filter):
    """A pattern of texels round a receiver, compared one by one."""

    @abc.abstractmethod
    def read(self, prepared: ShadowMap, receiver: Receiver) -> tuple[Tap, ...]:
        """Read the map around each receiver."""

    def visibility(
        self, reading: tuple[Tap, ...], receiver: Receiver, compare: Compare
    ) -> Float[Array, "*points"]:
        """Return the weighted mean of the comparisons."""
        return compare_taps(reading, receiver, compare)


class NearestFilter(TapFilter):
    """The one texel that the receiver falls in.

    Differentiability:
        None in the receiver's position across texels; visibility jumps between them.
    """

    wide: ClassVar[bool] = False

    def reach(self) -> Scalar:
        """Return half a texel."""
        return 0.5

    def read(self, prepared: ShadowMap, receiver: Receiver) -> tuple[Tap, ...]:
        """Read one texel."""
        column, row = jnp.floor(receiver.column), jnp.floor(receiver.row)
        return read_texel(prepared, receiver, column, row, jnp.ones_like(column))


def read_texel(
    shadow_map: ShadowMap,
    receiver: Receiver,
    column: Float[Array, "*points"],
    row: Float[Array, "*points"],
    weight: Float[Array, "*points"],
) -> tuple[Tap, ...]:
    """Read a texel of the map.

    Args:
        shadow_map: The map.
        receiver: From which the texel is seen.
        column: Whole number, from the left; may lie outside.
        row: Whole number, from the top; may lie outside.
        weight: Of the texel.

    Returns:
        The texel; of a map with shares, its two layers with their parts of the weight.
    """
    across, down = column + 0.5 - receiver.column, row + 0.5 - receiver.row
    read = lambda image, outside=1.0: fetch(image, column, row, receiver, outside=outside)

    def tap(depth: Array, planes: SurfacePlanes | None, weight: Array) -> Tap:
        if planes is None:
            return Tap(read(depth), weight, across, down)
        u, v = across, down
        if planes.across is not None and planes.down is not None:
            u, v = u + read(planes.across, 0.0), v + read(planes.down, 0.0)
        slope = read(planes.depth_per_column, 0.0), read(planes.depth_per_row, 0.0)
        plane = TapPlane(*slope, read(planes.farthest))
        return Tap(read(planes.depth), weight, u, v, plane)

    planes, neighbor = (None if receiver.plane is None else shadow_map.planes), shadow_map.neighbor
    if neighbor is None:
        return (tap(shadow_map.depth, planes, weight),)
    share = read(neighbor.share)
    return (
        tap(shadow_map.depth, planes, weight * share),
        tap(neighbor.depth, None if planes is None else neighbor.planes, weight * (1 - share)),
    )


def compare_taps(
    taps: Sequence[Tap], receiver: Receiver, compare: Compare
) -> Float[Array, "*points"]:
    """Compare a receiver with what was read; 1 = lit.

    Args:
        taps: From a filter, for this receiver or for one that differs in depth alone.
        receiver: After its bias.
        compare: Hard or soft.

    Returns:
        Visibility in [0, 1]; 1 where the receiver lies outside of what the map can tell.
    """
    return _compared(receiver.depth_bias, taps, receiver, compare)


def _compare(
    depth_bias: Float[Array, "*points"], taps: Sequence[Tap], receiver: Receiver, compare: Compare
) -> Float[Array, "..."]:
    receiver = receiver._replace(depth_bias=depth_bias)
    total = functools.reduce(operator.add, (tap.weight for tap in taps))
    weighted = (tap.weight * tap.lit(receiver, compare) for tap in taps)
    # The division is also where XLA stops fusing; without one it computes the comparison
    # again for each color channel.
    visibility = functools.reduce(operator.add, weighted) / total
    return jnp.where(receiver.outside, 1.0, visibility)


def _compare_with_slope(
    depth_bias: Float[Array, "*points"], taps: Sequence[Tap], receiver: Receiver, compare: Compare
) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    """Return the visibility and its derivative in the bias, in one pass over the taps.

    As the parts of complex numbers: XLA on a CPU makes one loop of what has one result, and
    of two results a loop for each tap.
    """
    total = functools.reduce(operator.add, (tap.weight for tap in taps))

    def both(tap: Tap) -> Array:
        def lit(depth_bias: Array) -> Array:
            moved = receiver._replace(depth_bias=depth_bias)
            return tap.weight * tap.lit(moved, compare)

        return lax.complex(*jax.jvp(lit, (depth_bias,), (jnp.ones_like(depth_bias),)))

    mean = functools.reduce(operator.add, map(both, taps)) / total
    visibility = jnp.where(receiver.outside, 1.0, mean.real)
    return visibility, jnp.where(receiver.outside, 0.0, mean.imag)


def keep_slope(function: Callable, with_slope: Callable | None = None) -> Callable:
    """Return a function whose reverse pass keeps one derivative in its first argument.

    Without, it keeps several arrays for each tap, or computes them again.

    Args:
        function: Of a number for each point, of which a point's result depends on its own,
            and of anything else.
        with_slope: The same with the derivative in that number beside the result; None for
            the derivative that JAX makes.
    """
    kept = eqx.filter_custom_jvp(function)

    def both(numbers: Array, *rest: Any) -> tuple[Array, Array]:
        if with_slope is not None:
            return with_slope(numbers, *rest)
        return jax.jvp(lambda x: function(x, *rest), (numbers,), (jnp.ones_like(numbers),))

    @kept.def_jvp
    def rule(primals: tuple, tangents: tuple) -> tuple[Array, Array | None]:
        (numbers, *rest), (number_tangent, *rest_tangents) = primals, tangents
        if number_tangent is None:
            value, change = function(numbers, *rest), None
        else:
            value, slope = both(numbers, *rest)
            change = slope * number_tangent
        if jax.tree.leaves(rest_tangents):
            is_none = lambda tangent: tangent is None
            known = jax.tree.map(lambda t: t is not None, rest_tangents, is_leaf=is_none)
            moved, still = eqx.partition(rest, known)
            of_rest = lambda moved: function(numbers, *eqx.combine(moved, still))
            _, more = jax.jvp(of_rest, (moved,), (rest_tangents,))
            change = more if change is None else change + more
        return value, change

    return kept


_compared = keep_slope(_compare, _compare_with_slope)


def keep_bias_slope(visibility: Callable) -> Callable:
    """Decorate a filter's ``visibility``: ``keep_slope`` in the receiver's bias."""

    @keep_slope
    def after_bias(
        depth_bias: Array, filter: Filter, reading: Any, receiver: Receiver, compare: Compare
    ) -> Array:
        return visibility(filter, reading, receiver._replace(depth_bias=depth_bias), compare)

    @functools.wraps(visibility)
    def kept(filter: Filter, reading: Any, receiver: Receiver, compare: Compare) -> Array:
        return after_bias(receiver.depth_bias, filter, reading, receiver, compare)

    return kept


def look_up(
    shadow_map: ShadowMap, receiver: Receiver, *, filter: Filter, compare: Compare
) -> Float[Array, "*points"]:
    """Return the visibility of receivers in [0, 1] (1 = lit).

    Args:
        shadow_map: The light's map.
        receiver: Points located in that map, after their bias.
        filter: What is asked.
        compare: How depths become visibility, where the filter compares.

    Differentiability:
        In the map's depths, the receiver's depth, bias and position, and the softness, as
        far as ``filter`` and ``compare`` have derivatives there.
    """
    reading = filter.read(filter.prepare(shadow_map), receiver)
    return filter.visibility(reading, receiver, compare)


def fetch(
    image: Float[Array, "*maps map_height map_width"],
    column: Float[Array, "*points"],
    row: Float[Array, "*points"],
    receiver: Receiver,
    *,
    outside: float = 1.0,
) -> Float[Array, "*points"]:
    """Read an image over the map at whole texel coordinates.

    Args:
        image: Depths, or anything else that there is for each texel.
        column: Whole number, from the left; may lie outside.
        row: Whole number, from the top; may lie outside.
        receiver: Tells which of several maps is read.
        outside: What is read outside the image.
    """
    height, width = image.shape[-2:]
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    index = jnp.where(inside, row, 0).astype(jnp.int32) * width + jnp.where(
        inside, column, 0
    ).astype(jnp.int32)
    if receiver.map_index is not None:
        index = index + receiver.map_index * (height * width)
    values = image.reshape(-1).at[index].get(mode="promise_in_bounds")
    return jnp.where(inside, values, outside)
