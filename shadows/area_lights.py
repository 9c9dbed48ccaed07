"""Area lights: discs and rectangles that cast penumbrae.

Shading and the one shadow map take the light from its centre; what its size does to a
shadow is up to a filter (``PCSSFilter`` takes it from the light), or to as many maps or rays as
``sample_points`` gives points.

They shine to one side, as a sheet of paper lit from behind: what arrives falls with the cosine
of the angle to their normal, as their apparent size does, and is 0 behind them. As under all
lights here, it does not fall with distance.
"""

import abc

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from tangentspace._math import dot, safe_norm, safe_normalize

from ._checks import check_field
from .lights import Light, Points, SpotLight
from .transforms import Scalar, Vector, look_at

_GOLDEN = 0.5 * (np.sqrt(5.0) - 1)
_WIDEST = np.deg2rad(80.0)  # half angle of the shadow map


class AreaLight(Light):
    """A flat light.

    Attributes:
        position: Its centre, world space.
        direction: Unit normal of the side that shines, world space.
        color: Linear RGB that arrives straight before it.
    """

    position: eqx.AbstractVar[Vector]
    direction: eqx.AbstractVar[Vector]
    color: eqx.AbstractVar[Vector]

    @property
    @abc.abstractmethod
    def diameter(self) -> Scalar:
        """World length: of the disc whose points are as far from its centre, by rms."""

    @abc.abstractmethod
    def sample_points(self, count: int) -> Float[Array, "{count} 3"]:
        """Return points spread evenly over the light, world space; always the same.

        Args:
            count: At least 1.

        Differentiability:
            Smooth in the light's pose and linear in its size.
        """

    def to_light(self, positions: Float[Array, "... 3"]) -> Float[Array, "... 3"]:
        """Return unit vectors towards the light's centre."""
        return safe_normalize(jnp.asarray(self.position) - positions)

    def radiance(self, positions: Float[Array, "... 3"]) -> Float[Array, "... 3"]:
        """Return the color times the cosine at the light's centre; 0 behind the light."""
        cosine = -dot(self.to_light(positions), safe_normalize(self.direction))
        return jnp.maximum(cosine, 0)[..., None] * jnp.asarray(self.color)

    def clip_from_world(self, points: Points) -> Float[Array, "4 4"]:
        """Return a perspective matrix from the centre, up to 80 degrees off the normal."""
        direction = safe_normalize(self.direction)
        return SpotLight(self.position, direction, outer_angle=_WIDEST).clip_from_world(points)

    def _lattice(self, count: int) -> Float[Array, "2 {count}"]:
        """Return points spread evenly over the unit square: a golden-ratio lattice."""
        if count < 1:
            name = f"{type(self).__name__}.sample_points"
            raise ValueError(f"{name}: expected `count` of at least 1, got {count}")
        steps = np.arange(count) + 0.5
        lattice = np.stack([steps / count, (steps * _GOLDEN) % 1])
        return jnp.asarray(lattice, jnp.result_type(self.position))

    def _placed(
        self, up: Vector, across: Float[Array, " points"], along: Float[Array, " points"]
    ) -> Float[Array, "points 3"]:
        """Return points of the light's plane, given along two axes of which one is upwards."""
        view_from_world = look_at(self.position, self.position + jnp.asarray(self.direction), up)
        right, above = view_from_world[0, :3], view_from_world[1, :3]
        return jnp.asarray(self.position) + across[:, None] * right + along[:, None] * above


class DiscLight(AreaLight):
    """A round light.

    Attributes:
        position: Its centre, world space.
        direction: Unit normal of the side that shines, world space.
        radius: World length.
        color: Linear RGB that arrives straight before it.
    """

    position: Vector
    direction: Vector
    radius: Scalar
    color: Vector = eqx.field(default_factory=lambda: np.ones(3, np.float32))

    def __check_init__(self) -> None:
        """Refuse a negative radius."""
        check_field(self, "radius", "of at least 0", lambda radius: radius >= 0)

    @property
    def diameter(self) -> Scalar:
        """Twice the radius, world length."""
        return 2 * self.radius

    def sample_points(self, count: int) -> Float[Array, "{count} 3"]:
        """Return points on a spiral, each with the same share of the disc's area."""
        share, turn = self._lattice(count)
        distance, angle = jnp.asarray(self.radius) * jnp.sqrt(share), 2 * jnp.pi * turn
        across, along = distance * jnp.cos(angle), distance * jnp.sin(angle)
        return self._placed(np.array([0, 1, 0], np.float32), across, along)


class RectangleLight(AreaLight):
    """A rectangular light.

    Attributes:
        position: Its centre, world space.
        direction: Unit normal of the side that shines, world space.
        width: World length across ``up``.
        height: World length along ``up``.
        up: Direction, world space; its part in the light's plane is along the height.
        color: Linear RGB that arrives straight before it.
    """

    position: Vector
    direction: Vector
    width: Scalar
    height: Scalar
    up: Vector = eqx.field(default_factory=lambda: np.array([0, 1, 0], np.float32))
    color: Vector = eqx.field(default_factory=lambda: np.ones(3, np.float32))

    def __check_init__(self) -> None:
        """Refuse negative sides."""
        for field in ("width", "height"):
            check_field(self, field, "of at least 0", lambda length: length >= 0)

    @property
    def diameter(self) -> Scalar:
        """World length: of the disc that spreads as far; 1.15 times the side of a square."""
        sides = jnp.stack([jnp.asarray(self.width), jnp.asarray(self.height)])
        return np.sqrt(2 / 3) * safe_norm(sides)

    def sample_points(self, count: int) -> Float[Array, "{count} 3"]:
        """Return points on a lattice, each with the same share of the rectangle's area."""
        u, v = self._lattice(count)
        width, height = jnp.asarray(self.width), jnp.asarray(self.height)
        return self._placed(self.up, width * (u - 0.5), height * (v - 0.5))
