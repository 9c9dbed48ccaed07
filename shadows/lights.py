"""Lights: where their light comes from, how much arrives, and the camera of their shadow map.

``clip_from_world`` is fitted to the world-space points it is given (usually all vertices),
so that the map wastes neither texels nor depth on empty space. ``radiance`` is what
arrives unblocked: that nothing arrives outside a spot's cone is told here, not by the
shadow test. A new light is a new subclass of ``Light``.
"""

import abc

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from tangentspace._math import dot, safe_normalize

from .transforms import Scalar, Vector, look_at, orthographic, perspective, transform_points

Points = Float[Array | np.ndarray, "points 3"]


class Light(eqx.Module):
    """What every light answers; all quantities in world space."""

    @abc.abstractmethod
    def to_light(self, positions: Float[Array, "... 3"]) -> Float[Array, "... 3"]:
        """Return unit vectors from the positions towards the light."""

    @abc.abstractmethod
    def radiance(self, positions: Float[Array, "... 3"]) -> Float[Array, "... 3"]:
        """Return the linear RGB light that arrives at the positions if nothing blocks it."""

    @abc.abstractmethod
    def clip_from_world(self, points: Points) -> Float[Array, "4 4"]:
        """Return the matrix of a shadow map that covers the lit part of the points."""


class DirectionalLight(Light):
    """Parallel light, as from the sun.

    Attributes:
        direction: Unit vector from any surface towards the light.
        color: Linear RGB that arrives.
    """

    direction: Vector
    color: Vector = eqx.field(default_factory=lambda: np.ones(3, np.float32))

    def to_light(self, positions: Float[Array, "... 3"]) -> Float[Array, "... 3"]:
        """Return the light's direction at every position."""
        return jnp.broadcast_to(self.direction, positions.shape)

    def radiance(self, positions: Float[Array, "... 3"]) -> Float[Array, "... 3"]:
        """Return the light's color at every position."""
        return jnp.broadcast_to(self.color, positions.shape)

    def clip_from_world(self, points: Points) -> Float[Array, "4 4"]:
        """Return an orthographic matrix fitted to the points."""
        target = 0.5 * (jnp.min(points, axis=0) + jnp.max(points, axis=0))
        view_from_world = look_at(target + self.direction, target, np.array([0.0, 1.0, 0.0]))
        view = transform_points(view_from_world, points)[:, :3]
        low, high = _padded_box(view)
        clip_from_view = orthographic(low[0], high[0], low[1], high[1], -high[2], -low[2])
        return clip_from_view @ view_from_world


class SpotLight(Light):
    """A light at a point that shines into a cone; its brightness does not fall with distance.

    Attributes:
        position: World space.
        direction: Unit vector from the light along the cone's axis.
        inner_angle: Half angle up to which the light is full, radians.
        outer_angle: Half angle at which it has faded to nothing, radians, below pi / 2.
        color: Linear RGB on the axis.
    """

    position: Vector
    direction: Vector
    inner_angle: Scalar = 0.0
    outer_angle: Scalar = np.pi / 4
    color: Vector = eqx.field(default_factory=lambda: np.ones(3, np.float32))

    def to_light(self, positions: Float[Array, "... 3"]) -> Float[Array, "... 3"]:
        """Return unit vectors towards the light's position."""
        return safe_normalize(self.position - positions)

    def radiance(self, positions: Float[Array, "... 3"]) -> Float[Array, "... 3"]:
        """Return the color, faded towards the cone's edge as ``KHR_lights_punctual`` says."""
        cos_angle = -dot(self.to_light(positions), jnp.asarray(self.direction))
        cos_outer = jnp.cos(jnp.asarray(self.outer_angle))
        width = jnp.maximum(jnp.cos(jnp.asarray(self.inner_angle)) - cos_outer, 1e-4)
        fade = jnp.clip((cos_angle - cos_outer) / width, 0.0, 1.0) ** 2
        return fade[..., None] * self.color

    def clip_from_world(self, points: Points) -> Float[Array, "4 4"]:
        """Return a perspective matrix that covers the cone, or less where the points do."""
        target = self.position + jnp.asarray(self.direction)
        return _frustum(points, self.position, target, jnp.tan(jnp.asarray(self.outer_angle)))


class PointLight(Light):
    """A light at a point that shines in every direction; no fall-off with distance.

    One perspective shadow map serves it as long as it stands outside the points that it
    lights and sees them within 80 degrees of the direction of their centre.

    Attributes:
        position: World space.
        color: Linear RGB that arrives.
    """

    position: Vector
    color: Vector = eqx.field(default_factory=lambda: np.ones(3, np.float32))

    def to_light(self, positions: Float[Array, "... 3"]) -> Float[Array, "... 3"]:
        """Return unit vectors towards the light's position."""
        return safe_normalize(self.position - positions)

    def radiance(self, positions: Float[Array, "... 3"]) -> Float[Array, "... 3"]:
        """Return the light's color at every position."""
        return jnp.broadcast_to(self.color, positions.shape)

    def clip_from_world(self, points: Points) -> Float[Array, "4 4"]:
        """Return a perspective matrix that looks at the middle of the points."""
        target = 0.5 * (jnp.min(points, axis=0) + jnp.max(points, axis=0))
        return _frustum(points, self.position, target, jnp.tan(jnp.deg2rad(80.0)))


def _padded_box(points: Points) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
    """Return corners of the box round the points, 1 % wider; no side is flat."""
    low, high = jnp.min(points, axis=0), jnp.max(points, axis=0)
    size = high - low
    padding = jnp.maximum(0.005 * size, 5e-4 * jnp.max(size))
    return low - padding, high + padding


def _frustum(
    points: Points, position: Vector, target: Vector, largest_tangent: Scalar
) -> Float[Array, "4 4"]:
    """Return a square perspective matrix round the points, no wider than asked."""
    view_from_world = look_at(position, target, np.array([0.0, 1.0, 0.0]))
    view = transform_points(view_from_world, points)[:, :3]
    distance = -view[:, 2]
    farthest = jnp.max(distance)
    far = jnp.where(farthest > 0, 1.01 * farthest, 1.0)
    near = jnp.maximum(0.99 * jnp.min(distance), 1e-3 * far)
    in_front = jnp.maximum(distance, near)
    tangent = jnp.max(jnp.maximum(jnp.abs(view[:, 0]), jnp.abs(view[:, 1])) / in_front)
    tangent = jnp.minimum(1.01 * tangent, largest_tangent)
    return perspective(2 * jnp.arctan(tangent), 1.0, near, far) @ view_from_world
