"""Numbers of a scene that a fit may free: a caster's pose, a light's, those of a bias.

Each is an amount added to the scene as it starts, in a step that moves edges by about a pixel.
"""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from shadows import Bias, Light

from ..options import hint
from .image_fit import Problem, Vector
from .shadow_view import ShadowView

_AXES = "xyz"
_TURN = 0.02  # radians
_SHIFT = 0.01  # of the scene's size
_SHARE = 0.05  # of intensity

Value = Float[Array, ""]


class State(NamedTuple):
    """What numbers are added to.

    Attributes:
        turn: Of the caster about its middle: an axis times an angle in radians.
        shift: Of the caster, world units.
        light: The light.
        bias: The bias.
        vertex: Shifts of single vertices, before the caster turns, world units.
    """

    turn: Float[Array | np.ndarray, "3"]
    shift: Float[Array | np.ndarray, "3"]
    light: Light
    bias: Bias
    vertex: Float[Array | np.ndarray, "single 3"] = np.zeros((0, 3), np.float32)


class Number(NamedTuple):
    """One number that is free.

    Attributes:
        name: As ``turn.y`` or ``light.position.x``.
        field: Of the state or of its light.
        part: Of that field, its place; -1 where it is one number.
        step: What one unit of a fit's vector adds, in the field's own unit.
        unit: In which it is told.
        told: Of that unit in one of the field's.
    """

    name: str
    field: str
    part: int | tuple[int, int]
    step: float
    unit: str
    told: float = 1.0

    def add(self, state: State, amount: Value) -> State:
        """Return the state with so many steps added."""
        amount = self.step * amount
        if self.field in State._fields:
            field = jnp.asarray(getattr(state, self.field), amount.dtype)
            return state._replace(**{self.field: field.at[self.part].add(amount)})
        of, name = self.field.split(".", 1)
        light = getattr(state, of)
        where = lambda light: getattr(light, name)
        old = jnp.asarray(where(light), amount.dtype)
        if name == "direction":
            across = _across(old)[jnp.asarray(self.part)]
            new = jnp.cos(amount) * old + jnp.sin(amount) * across
            new = new / jnp.linalg.norm(new)
        elif name == "color":
            new = old * jnp.exp(amount)
        else:
            new = old + amount if self.part == -1 else old.at[self.part].add(amount)
        return state._replace(**{of: eqx.tree_at(where, light, new)})


def vertex_numbers(vertices: Sequence[int], *, size: float) -> tuple[Number, ...]:
    """Return the three numbers of each single vertex.

    Args:
        vertices: As they are told.
        size: Of the scene, world units.
    """
    return tuple(
        Number(f"vertex.{vertex}.{axis}", "vertex", (row, k), _SHIFT * size, "world")
        for row, vertex in enumerate(vertices)
        for k, axis in enumerate(_AXES)
    )


def numbers_of(state: State, free: Sequence[str], *, size: float) -> tuple[Number, ...]:
    """Return the numbers that names stand for.

    Args:
        state: Whose light says what there is.
        free: As ``turn``, ``turn.y``, ``light.position``.
        size: Of the scene, world units.

    Raises:
        ValueError: If a name is not one of them.
    """
    known = _known(state, size)
    chosen: list[Number] = []
    for name in free:
        found = [n for n in known if n.name == name or n.name.startswith(f"{name}.")]
        if not found:
            groups = {n.name for n in known} | {n.name.rsplit(".", 1)[0] for n in known}
            raise ValueError(f"--free: no number '{name}'; {hint(name, sorted(groups))}")
        chosen += [n for n in found if n not in chosen]
    return tuple(chosen)


def _known(state: State, size: float) -> list[Number]:
    degrees, light = 180 / np.pi, state.light
    known = [Number(f"turn.{a}", "turn", k, _TURN, "degrees", degrees) for k, a in enumerate(_AXES)]
    known += [Number(f"shift.{a}", "shift", k, _SHIFT * size, "world") for k, a in enumerate(_AXES)]
    if hasattr(light, "position"):
        known += [
            Number(f"light.position.{a}", "light.position", k, _SHIFT * size, "world")
            for k, a in enumerate(_AXES)
        ]
    if hasattr(light, "direction"):
        known += [
            Number(f"light.direction.{a}", "light.direction", k, _TURN, "degrees", degrees)
            for k, a in enumerate("uv")
        ]
    for name in ("inner_angle", "outer_angle", "vertical_fov"):
        if hasattr(light, name):
            known.append(Number(f"light.{name}", f"light.{name}", -1, _TURN, "degrees", degrees))
    if hasattr(light, "radius"):
        known.append(Number("light.radius", "light.radius", -1, _SHIFT * size, "world"))
    known.append(Number("light.intensity", "light.color", -1, _SHARE, "%", 100.0))
    return known


def _none() -> Int[np.ndarray, "0"]:
    return np.zeros(0, np.int32)


class SceneProblem(Problem):
    """Images under each light as a function of a scene's numbers.

    Attributes:
        view: What is seen, and what casts.
        positions: Of all that casts, as it starts, world space.
        caster: Its vertices that a pose moves.
        states: One for each image.
        numbers: Which are free, in every state alike.
        single: Vertices that are shifted by themselves.
        rows: Of ``State.vertex``, for each of them.
    """

    view: ShadowView
    positions: Float[Array | np.ndarray, "vertices 3"]
    caster: Int[Array | np.ndarray, " chosen"]
    states: tuple[State, ...]
    numbers: tuple[Number, ...] = eqx.field(static=True)
    single: Int[Array | np.ndarray, " moved"] = eqx.field(default_factory=_none)
    rows: Int[Array | np.ndarray, " moved"] = eqx.field(default_factory=_none)

    @property
    def names(self) -> tuple[str, ...]:
        """Of the free numbers."""
        return tuple(number.name for number in self.numbers)

    def told(self, vector: Float[np.ndarray, " numbers"]) -> Float[np.ndarray, " numbers"]:
        """Return amounts in the units in which they are told."""
        return np.asarray(vector) * [number.step * number.told for number in self.numbers]

    def state(self, vector: Vector, image: int = 0) -> State:
        """Return the scene with the numbers added."""
        state = self.states[image]
        for k, number in enumerate(self.numbers):
            state = number.add(state, vector[k])
        return state

    def images(self, vector: Vector) -> Float[Array, "images height width"]:
        """Return an image under each light."""
        vector = vector.astype(jnp.asarray(self.positions).dtype)
        images = []
        for k in range(len(self.states)):
            state = self.state(vector, k)
            images.append(self.view.image(self.posed(state), state.light, state.bias))
        return jnp.stack(images)

    def posed(self, state: State) -> Float[Array, "vertices 3"]:
        """Return the positions with the caster turned about its middle and shifted."""
        positions, turn = jnp.asarray(self.positions), jnp.asarray(state.turn)
        if self.single.size > 0:
            positions = positions.at[self.single].add(jnp.asarray(state.vertex)[self.rows])
        if self.caster.size == 0:
            return positions
        caster = positions[self.caster]
        middle = 0.5 * (jnp.min(caster, axis=0) + jnp.max(caster, axis=0))
        turned = jnp.matmul(caster - middle, rotation(turn).T, precision="highest")
        return positions.at[self.caster].set(middle + turned + state.shift)


def rotation(vector: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """Return the rotation about a vector by its length, radians; smooth at 0 too.

    References:
        J. J. Craig, "Introduction to Robotics", section 2.8 (Rodrigues' formula).
    """
    x, y, z = vector
    zero = jnp.zeros_like(x)
    across = jnp.stack(
        [jnp.stack([zero, -z, y]), jnp.stack([z, zero, -x]), jnp.stack([-y, x, zero])]
    )
    squared = jnp.sum(vector * vector)
    small = squared < 1e-6
    angle = jnp.sqrt(jnp.where(small, 1.0, squared))
    sine = jnp.where(small, 1 - squared / 6, jnp.sin(angle) / angle)
    cosine = jnp.where(small, 0.5 - squared / 24, (1 - jnp.cos(angle)) / angle**2)
    turned = sine * across + cosine * jnp.matmul(across, across, precision="highest")
    return jnp.eye(3, dtype=vector.dtype) + turned


def _across(direction: Float[Array, "3"]) -> Float[Array, "2 3"]:
    """Return two unit vectors across a unit vector."""
    # Least along the direction; which one is a discrete choice.
    axis = jnp.eye(3, dtype=direction.dtype)[jnp.argmin(jnp.abs(direction))]
    first = jnp.cross(direction, axis)
    first = first / jnp.linalg.norm(first)
    return jnp.stack([first, jnp.cross(direction, first)])
