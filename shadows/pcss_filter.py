"""Penumbrae of an area light from one shadow map: percentage-closer soft shadows.

The blockers near a receiver tell how wide its penumbra is, and a disc of that width is
filtered. Distances are world lengths along the ray to the light, not depths of the buffer.
What counts as a blocker is soft, so that the width changes smoothly with the light's size
and with everything that moves.
"""

import dataclasses
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ._checks import check_field
from .area_lights import AreaLight
from .compare import Compare, SoftCompare
from .disc_filters import poisson_disc, read_disc
from .filters import Filter, compare_taps, keep_bias_slope
from .lights import Light
from .shadow_map import Receiver, ShadowMap
from .transforms import Scalar

_SIZE = 0.1  # of lights that have none


class PCSSFilter(Filter):
    """A disc as wide as the penumbra that an area light casts from the blockers found.

    On a straight edge at the distance d_B from the light, a receiver at d_R gets a penumbra
    of ``(d_R - d_B) * light_size / d_B``; under parallel light, of ``(d_R - d_B) * light_size``.

    Attributes:
        light_size: Diameter of the light, world length; of parallel light, the tangent of
            the full angle that it fills. None for an area light's own, and 0.1 for lights
            that have none.
        blocker_softness: Width of the step from what blocks to what does not.
        search_taps: Points at which blockers are looked for.
        taps: Points of the filter.
        widest: Largest radius of search and filter.

    Differentiability:
        In the light's size, depths and positions; zero where the widest radius is met.

    References:
        R. Fernando, "Percentage-Closer Soft Shadows", SIGGRAPH 2005 sketches.
    """

    reads_anew: ClassVar[bool] = True
    light_size: Scalar | None = eqx.field(
        default=None, metadata={"unit": "world length", "default": "the light's own or 0.1"}
    )
    blocker_softness: Scalar = eqx.field(default=0.5, metadata={"unit": "half texels"})
    search_taps: int = eqx.field(static=True, default=16, metadata={"whole": "points"})
    taps: int = eqx.field(static=True, default=16, metadata={"whole": "points"})
    widest: int = eqx.field(static=True, default=32, metadata={"whole": "texels"})

    def __check_init__(self) -> None:
        """Refuse negative sizes, and numbers of taps out of range."""
        for field, least in (("light_size", 0), ("blocker_softness", 0), ("widest", 1)):
            check_field(self, field, f"of at least {least}", lambda x, least=least: x >= least)
        for field in ("search_taps", "taps"):
            check_field(self, field, "from 1 to 128", lambda taps: 1 <= taps <= 128, whole=True)

    def for_light(self, light: Light) -> "PCSSFilter":
        """Return the filter with the light's size, where that was left open."""
        if self.light_size is not None:
            return self
        size = light.diameter if isinstance(light, AreaLight) else _SIZE
        return dataclasses.replace(self, light_size=size)

    def reach(self) -> Scalar:
        """Return the widest radius and one texel."""
        return self.widest + 1.0

    def read(self, prepared: ShadowMap, receiver: Receiver) -> ShadowMap:
        """Return the map: where it is read depends on the receiver's depth."""
        return prepared

    @keep_bias_slope
    def visibility(
        self, reading: ShadowMap, receiver: Receiver, compare: Compare
    ) -> Float[Array, "*points"]:
        """Look for blockers, and filter as wide as they say."""
        # The farthest that a blocker may be: at the near end of the map.
        farthest = _ray_length(receiver, receiver.depth)
        search = self._radius(receiver, farthest)
        taps = read_disc(reading, receiver, _seeking(self.search_taps), search)
        soft = SoftCompare(self.blocker_softness)
        found, length = 0.0, 0.0
        for tap in taps:
            # Nothing for the receiver's own surface, which would pull the mean towards it.
            blocked = jnp.maximum(1 - 2 * tap.lit(receiver, soft), 0) ** 2
            weight = tap.weight * blocked
            # How far the blocker is from the receiver, not from its plane at that texel.
            drop = receiver.depth - receiver.depth_bias - tap.stored
            gap = _ray_length(receiver, jnp.maximum(drop, 0))
            found, length = found + weight, length + weight * gap
        found, length = jnp.sum(found, axis=0), jnp.sum(length, axis=0)
        none = found <= 1e-6 * self.search_taps
        gap = jnp.where(none, 0.0, length / jnp.where(none, 1, found))
        taps = read_disc(reading, receiver, poisson_disc(self.taps), self._radius(receiver, gap))
        return jnp.mean(compare_taps(taps, receiver, compare), axis=0)

    def _radius(self, receiver: Receiver, gap: Float[Array, "*points"]) -> Float[Array, "*points"]:
        """Return half the penumbra's width, in texels, of a blocker so far from the receiver."""
        left = jnp.maximum(1 - gap * receiver.nearness, 1e-3)
        widening = jnp.where(receiver.nearness > 0, receiver.nearness / left, 1.0)
        size = _SIZE if self.light_size is None else self.light_size
        width = gap * widening * size
        return jnp.clip(0.5 * width / receiver.texel_length, 0.0, self.widest)


def _seeking(count: int) -> Float[np.ndarray, "points 2"]:
    """Return the search pattern, turned away from the filter's so that they do not repeat."""
    return poisson_disc(count) @ np.array([[0.6, 0.8], [-0.8, 0.6]])


def _ray_length(receiver: Receiver, drop: Float[Array, "..."]) -> Float[Array, "..."]:
    """Return the world length along the ray to the light over which the depth drops so far."""
    rate = receiver.depth_rate + receiver.nearness * drop
    none = rate <= 0
    return jnp.where(none, 0.0, drop / jnp.where(none, 1, rate))
