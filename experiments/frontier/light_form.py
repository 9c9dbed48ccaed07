"""Lights of every kind in one form, so that programs compiled for one serve all."""

from typing import Any, cast

import jax.numpy as jnp
from jaxtyping import Array, Float

from shadows.area_lights import AreaLight, DiscLight, RectangleLight
from shadows.lights import DirectionalLight, Light, PointLight, Points, SpotLight
from shadows.transforms import Scalar, Vector
from tangentspace._math import dot, safe_normalize

_KINDS = (DirectionalLight, PointLight, SpotLight, DiscLight, RectangleLight)  # and none below them


class LightForm(Light):
    """What reaches surfaces from a light of any kind; it draws no map.

    Attributes:
        position: Homogeneous; at infinity for parallel light.
        axis: Unit vector of the brightest way.
        color: Linear RGB on that way.
        gain: By which light grows with the cosine of the angle to the axis, up to 1.
        offset: Light at a cosine of 0; below 0 for none.
        squared: 1 where light is the square of that, 0 where it is not.
    """

    position: Float[Array, "4"]
    axis: Vector
    color: Vector
    gain: Scalar
    offset: Scalar
    squared: Scalar

    def to_light(self, positions: Float[Array, "... 3"]) -> Float[Array, "... 3"]:
        """Return unit vectors from the positions towards the light."""
        return safe_normalize(self.position[:3] - self.position[3] * positions)

    def radiance(self, positions: Float[Array, "... 3"]) -> Float[Array, "... 3"]:
        """Return the linear RGB light that arrives at the positions if nothing blocks it."""
        cosine = -dot(self.to_light(positions), jnp.asarray(self.axis))
        bright = jnp.clip(self.gain * cosine + self.offset, 0.0, 1.0)
        bright = bright * (1 + self.squared * (bright - 1))
        return bright[..., None] * self.color

    def clip_from_world(self, points: Points) -> Float[Array, "4 4"]:
        """Refuse, as what reaches surfaces does not say how wide a light's map is.

        Raises:
            ValueError: Always.
        """
        raise ValueError("LightForm.clip_from_world: expected the light itself, got its form")


def light_form(light: Light) -> Light:
    """Return a light in the one form, or itself if it is of a kind that has none.

    Args:
        light: A filter's numbers that depend on its kind must have been taken from it before.
    """
    if type(light) not in _KINDS:
        return light
    any_light = cast(Any, light)
    color = jnp.asarray(any_light.color)
    axis, gain, offset, squared = jnp.zeros_like(color), 0.0, 1.0, 0.0
    if isinstance(light, DirectionalLight):
        place = jnp.append(jnp.asarray(light.direction), 0.0)
    else:
        place = jnp.append(jnp.asarray(any_light.position), 1.0)
    if isinstance(light, AreaLight):
        axis, gain, offset = safe_normalize(light.direction), 1.0, 0.0
    if isinstance(light, SpotLight):
        cos_outer = jnp.cos(jnp.asarray(light.outer_angle))
        width = jnp.maximum(jnp.cos(jnp.asarray(light.inner_angle)) - cos_outer, 1e-4)
        axis, gain, offset, squared = light.direction, 1 / width, -cos_outer / width, 1.0
    numbers = (jnp.asarray(number, color.dtype) for number in (gain, offset, squared))
    return LightForm(place, jnp.asarray(axis), color, *numbers)
