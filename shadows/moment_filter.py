"""Filters that blur the map beforehand: means over texels, which one lookup reads.

Depths must not be blurred, but what is stored here may: numbers of each texel's depth
(its powers, or exponentials) whose mean over a window bounds the share of the window
that blocks a receiver. Blur and mips are made once per light, so a wide filter costs a
lookup no more than a narrow one. ``variance_filter``, ``exponential_filters`` and
``four_moment_filter`` say what is stored and what follows from it.

Depths are linear in the distance along the light's axis, also in a perspective map, and
signed: -1 at the near end of the map and 1 at the far end, where float32 keeps most bits
of a variance. A texel without a surface is one at the far end. The map's border repeats.
"""

import abc
import functools
import math
from typing import ClassVar, Literal, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from ._checks import check_field
from .compare import Compare
from .filters import Filter, keep_bias_slope
from .shadow_map import Receiver, ShadowMap
from .transforms import Scalar

Moments = tuple[Float[Array, "..."], ...]


class MomentReading(NamedTuple):
    """What was read at the receivers; it stays the same while only depths and biases move.

    Attributes:
        moments: Means around each receiver.
        inside: Share of the 2x2 lookup that lies inside the image.
    """

    moments: Moments
    inside: Float[Array, "*points"]


class MomentFilter(Filter):
    """A map of means, blurred beforehand.

    Attributes:
        radius: Texels to each side that the blur reaches.
        blur: ``box``, or ``gaussian``: four boxes in turn, which together reach as far.
        mips: Smaller images beside the blurred one, each of half the size.
        level: Which of them is looked up, between two of them a blend; 0 is the full size.

    Differentiability:
        In the map's depths, the receiver's place, depth and bias, and the numbers; the
        lookup is continuous, and smooth between texel centres.
    """

    compares: ClassVar[bool] = False
    radius: int = eqx.field(static=True, default=2, metadata={"whole": "texels"})
    blur: Literal["box", "gaussian"] = eqx.field(
        static=True, default="box", metadata={"choices": ("box", "gaussian")}
    )
    mips: int = eqx.field(static=True, default=0, metadata={"whole": "levels"})
    level: Scalar = eqx.field(default=0.0, metadata={"unit": "level"})

    def __check_init__(self) -> None:
        """Refuse what is no whole number, and a level that there is not."""
        for option, unit in (("radius", "texels"), ("mips", "levels")):
            expected = f"to be a whole number of {unit} of at least 0"
            check_field(self, option, expected, lambda number: number >= 0, whole=True)
        if self.blur not in ("box", "gaussian"):
            raise ValueError(
                f"{type(self).__name__}: expected `blur` box or gaussian, got {self.blur!r}"
            )
        expected = f"from 0 to {self.mips} (`mips`)"
        check_field(self, "level", expected, lambda level: 0 <= level <= self.mips)

    @abc.abstractmethod
    def moments(self, depth: Float[Array, "..."]) -> Moments:
        """Return what is averaged.

        Args:
            depth: Of texels, linear, in [-1, 1].
        """

    @abc.abstractmethod
    def lit(self, moments: Moments, depth: Float[Array, "*points"]) -> Float[Array, "*points"]:
        """Return the visibility in [0, 1] that means tell.

        Args:
            moments: Means of ``moments`` over texels.
            depth: Of receivers, linear, in [-1, 1].
        """

    def reach(self) -> Scalar:
        """Return the radius and one texel, or what the coarser of two mips reads."""
        known = isinstance(self.level, int | float)
        coarser = np.ceil(self.level) if known else jnp.ceil(self.level)
        return self.radius + 1.5 * 2.0**coarser - 0.5

    def prepare(self, shadow_map: ShadowMap) -> tuple[Moments, ...]:
        """Return the blurred images, those of the full size first.

        Raises:
            ValueError: If the map is too small for the radius, or its sides cannot be halved
                as often as there are mips.
        """
        self._check_size(*shadow_map.depth.shape[-2:])
        ratio = depth_ratio(shadow_map.texel_from_world)[..., None, None]
        pad = [(0, 0)] * (shadow_map.depth.ndim - 2) + [(self.radius, self.radius)] * 2

        def stored(depth: Float[Array, "..."]) -> Moments:
            return self.moments(jnp.pad(_signed(linear_depth(depth, ratio)), pad, mode="edge"))

        own = stored(shadow_map.depth)
        if shadow_map.neighbor is not None:
            share = jnp.pad(shadow_map.neighbor.share, pad, mode="edge")
            layers = zip(own, stored(shadow_map.neighbor.depth), strict=True)
            own = tuple(share * nearest + (1 - share) * other for nearest, other in layers)
        levels = [tuple(self._blurred(image) for image in own)]
        for _ in range(self.mips):
            levels.append(tuple(_halved(image) for image in levels[-1]))
        return tuple(levels)

    def read(self, prepared: tuple[Moments, ...], receiver: Receiver) -> MomentReading:
        """Read 2x2 texels at each receiver, in one level or two."""
        height, width = prepared[0][0].shape[-2:]
        inside = _share_inside(receiver.column, width) * _share_inside(receiver.row, height)
        if self.mips == 0:
            return MomentReading(_bilinear(prepared[0], receiver, 0), inside)
        level = jnp.clip(jnp.asarray(self.level, inside.dtype), 0, self.mips)
        finer = jnp.minimum(jnp.floor(level), self.mips - 1)
        share = level - finer

        def between(k: int) -> Moments:
            fine, coarse = (_bilinear(prepared[j], receiver, j) for j in (k, k + 1))
            return tuple((1 - share) * a + share * b for a, b in zip(fine, coarse, strict=True))

        branches = [functools.partial(between, k) for k in range(self.mips)]
        return MomentReading(lax.switch(finer.astype(jnp.int32), branches), inside)

    @keep_bias_slope
    def visibility(
        self, reading: MomentReading, receiver: Receiver, compare: Compare
    ) -> Float[Array, "*points"]:
        """Return what the means tell of receivers after their bias; nothing is compared."""
        ratio = depth_ratio(receiver.texel_from_world)
        if receiver.map_index is not None:
            ratio = ratio[receiver.map_index]
        depth = _signed(linear_depth(receiver.depth - receiver.depth_bias, ratio))
        inside, outside = reading.inside, 1 - reading.inside
        # Divided by a sum that is 1: without, XLA computes it again for each color channel.
        lit = (inside * self.lit(reading.moments, depth) + outside) / (inside + outside)
        return jnp.where(receiver.outside, 1.0, lit)

    def _blurred(self, image: Float[Array, "..."]) -> Float[Array, "..."]:
        # Windows of XLA's own: as fast backwards as forwards, where sums of shifted images
        # have derivatives that take ten times as long.
        parts = 1 if self.blur == "box" else 4
        widths = [1 + (2 * self.radius + k) // parts for k in range(parts)]
        for axis in (-1, -2):
            for width in widths:
                if width > 1:
                    image = _window(image, {axis: width})
        return image

    def _check_size(self, height: int, width: int) -> None:
        name, size = type(self).__name__, f"{height} x {width} texels"
        if self.radius >= min(height, width):
            raise ValueError(f"{name}: expected `radius` below the map's {size}, got {self.radius}")
        if height % 2**self.mips or width % 2**self.mips:
            raise ValueError(
                f"{name}: expected a map whose sides can be halved {self.mips} times (`mips`), "
                f"got {size}"
            )


def depth_ratio(texel_from_world: Float[Array, "*maps 4 4"]) -> Float[Array, "*maps"]:
    """Return how much farther the far end of a map is than its near end; 1 for parallel light.

    In perspective w grows with the distance, and the window depth is ``a - b / w``; w is
    ``b / a`` at the near end and ``b / (a - 1)`` at the far end.

    Args:
        texel_from_world: ``shadow_map.texel_from_world``; of a map without a far end the
            ratio is taken as 1.

    Differentiability:
        Smooth in the matrix of a perspective map; zero derivative for parallel light.
    """
    depth, w = texel_from_world[..., 2, :3], texel_from_world[..., 3, :3]
    squared = jnp.sum(w * w, axis=-1)
    excess = jnp.sum((depth - w) * w, axis=-1)  # a - 1 times that
    perspective = (squared > 0) & (excess > 0)
    return jnp.where(perspective, 1 + squared / jnp.where(perspective, excess, 1), 1.0)


def linear_depth(
    depth: Float[Array, "..."], ratio: Float[Array, "..."] | float
) -> Float[Array, "..."]:
    """Return the share of the way from the near end of a map to its far end, in [0, 1].

    Args:
        depth: Window depth; what lies before the near end or behind the far end is moved there.
        ratio: ``depth_ratio``; 1 leaves the depth as it is.
    """
    depth = jnp.clip(depth, 0, 1)
    return depth / (depth + ratio * (1 - depth))


def _signed(depth: Float[Array, "..."]) -> Float[Array, "..."]:
    return 2 * depth - 1


def _window(image: Float[Array, "..."], widths: dict[int, int], *, step: int = 1) -> Array:
    """Return means over windows along axes; divided first, so that no sum overflows."""
    size = [1] * image.ndim
    for axis, width in widths.items():
        size[axis] = width
    strides = [step if width > 1 else 1 for width in size]
    return lax.reduce_window(image / math.prod(size), 0.0, lax.add, size, strides, "VALID")


def _halved(image: Float[Array, "..."]) -> Float[Array, "..."]:
    return _window(image, {-1: 2, -2: 2}, step=2)


def _share_inside(place: Float[Array, "*points"], size: int) -> Float[Array, "*points"]:
    """Return the weight, along one axis, of those of the 2 nearest texels that exist."""
    return jnp.clip(place + 0.5, 0, 1) * jnp.clip(size + 0.5 - place, 0, 1)


def _bilinear(images: Moments, receiver: Receiver, level: int) -> Moments:
    """Read the 2x2 texels round each receiver in images of a level; the border repeats."""
    height, width = images[0].shape[-2:]
    left, to_right, across = _nearest_two(receiver.column / 2**level, width)
    top, to_low, down = _nearest_two(receiver.row / 2**level, height)
    corner = top * width + left
    if receiver.map_index is not None:
        corner = corner + receiver.map_index * (height * width)
    to_left, to_top, total = 1 - to_right, 1 - to_low, (1 - to_low) + to_low

    def read(image: Float[Array, "..."]) -> Float[Array, "*points"]:
        texels = image.reshape(-1)
        at = lambda offset: texels.at[corner + offset].get(mode="promise_in_bounds")
        # Weighted sums: a difference of texels that are powers of ten apart loses the smaller.
        high, low = (to_left * at(row) + to_right * at(row + across) for row in (0, down * width))
        # Divided by a sum that is 1: without, XLA reads and blends again for each use.
        return (to_top * high + to_low * low) / total

    return tuple(read(image) for image in images)


def _nearest_two(
    place: Float[Array, "*points"], size: int
) -> tuple[Int[Array, "*points"], Float[Array, "*points"], int]:
    """Return the first of two texels, the weight of the second, and how far off that is."""
    place = jnp.clip(place - 0.5, 0, size - 1)
    first = jnp.minimum(place.astype(jnp.int32), max(size - 2, 0))
    return first, place - first.astype(place.dtype), int(size > 1)
