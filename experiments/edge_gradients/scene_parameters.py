"""The numbers of a scene by dotted names, ``light.position.x``: how each moves an image.

- ``mesh.shift.x`` (world length), ``mesh.turn.y`` (degrees, about the middle of what turns) and
  ``mesh.scale`` (share, about the same) move the casters. Parts are what hangs together, those
  of the largest boxes first; ``mesh`` is all of them but the first, which is taken for the floor
  (a mesh of one part moves as a whole), and ``part2.shift.x`` moves one alone.
- ``light.FIELD`` is any number of a light, with ``.x .y .z`` or ``.r .g .b`` where it has three;
  directions keep unit length. The second light is ``light2``.
- ``camera.position.x``, ``camera.vertical_fov`` and ``camera.half_height``.
- Numbers of bias, filter and comparison have the names that ``fit-bias --free`` knows:
  ``constant.length``, ``soft.softness``.
"""

import dataclasses
import difflib
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from shadows.bias import CombinedBias
from shadows.compare import Compare
from shadows.filters import Filter
from shadows.lights import Light
from shadows.transforms import Camera, OrthographicCamera, Scalar
from tangentspace._math import safe_normalize
from tangentspace.mesh import Mesh

from ..mesh_parts import Part, used_vertices
from ..options import numbers
from ..scene import Scene

_STEP = 0.5  # of a pixel; what is farther from its axis than the casters' middle moves more
_RELATIVE_STEP = 0.01
_UNITS = {"position": "world length", "direction": "radian", "inner_angle": "radian",
          "outer_angle": "radian", "vertical_fov": "radian", "color": "unit of color",
          "up": "unit"}  # fmt: skip


class Setup(NamedTuple):
    """What an image is made from and can move."""

    mesh: Mesh
    camera: Camera
    lights: tuple[Light, ...]
    bias: CombinedBias
    filter: Filter
    compare: Compare

    @classmethod
    def of(cls, scene: Scene, bias: CombinedBias, filter: Filter, compare: Compare) -> "Setup":
        """Return a scene's, all numbers as arrays of their own type."""
        setup = cls(scene.mesh, scene.camera, scene.lights, bias, filter, compare)
        # Of a type that does not follow others', so that no function is compiled twice.
        return jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.asarray(leaf).dtype), setup)


class Parameter(NamedTuple):
    """One number.

    Attributes:
        name: Dotted.
        unit: What a change of 1 is.
        move: Returns the setup, changed by so much.
        step: Change that moves edges by about half a pixel.
        traced: Whether rays know of it, too.
    """

    name: str
    unit: str
    move: Callable[[Setup, Scalar | Float[Array, ""]], Setup]
    step: float
    traced: bool = True

    def velocity(self, setup: Setup) -> Setup:
        """Return how fast each floating-point number of a setup moves, and None for others."""
        floats, others = eqx.partition(setup, eqx.is_inexact_array)
        moved = lambda change: eqx.filter(
            self.move(eqx.combine(floats, others), change), eqx.is_inexact_array
        )
        change = jnp.zeros((), jnp.asarray(setup.mesh.positions).dtype)
        return jax.jvp(moved, (change,), (jnp.ones_like(change),))[1]


def scene_parameters(setup: Setup, parts: Sequence[Part], image_height: int) -> list[Parameter]:
    """Return all numbers of a setup that move its image.

    Args:
        setup: What moves.
        parts: ``mesh_parts`` of its mesh.
        image_height: Pixels, for the steps of differences.
    """
    casters = used_vertices(setup.mesh)
    if len(parts) > 1:
        casters &= ~parts[0].vertices
    middle, arm = _middle_and_arm(setup.mesh, casters)
    pixel = _STEP * _pixel_length(setup.camera, middle, image_height)
    found = list(_of_part("mesh", setup.mesh, casters, pixel))
    for k, part in enumerate(parts):
        found += _of_part(f"part{k + 1}", setup.mesh, part.vertices, pixel)
    for k, light in enumerate(setup.lights):
        far = float(np.linalg.norm(getattr(light, "position", middle) - middle))
        steps = {"position": pixel * far / arm, "direction": pixel / arm}
        name = f"light{'' if k == 0 else k + 1}"
        found += _of_fields(name, light, lambda setup, k=k: setup.lights[k], steps)
    found += [
        Parameter(f"camera.position.{axis}", "world length", _eye_moved(k), pixel)
        for k, axis in enumerate("xyz")
    ]
    found += _of_fields("camera", setup.camera, lambda setup: setup.camera, {})
    for k in range(len(setup.bias.terms)):
        found += _of_technique(setup, lambda setup, k=k: setup.bias.terms[k])
    found += _of_technique(setup, lambda setup: setup.filter)
    found += _of_technique(setup, lambda setup: setup.compare)
    return found


def choose_parameters(names: Sequence[str], known: Sequence[Parameter]) -> list[Parameter]:
    """Return the parameters of these names, each once.

    Raises:
        ValueError: If there is none of a name.
    """
    by_name = {parameter.name: parameter for parameter in known}
    for name in names:
        if name not in by_name:
            nearest = difflib.get_close_matches(name, by_name, n=3, cutoff=0.0)
            raise ValueError(f"--of {name}: no such parameter; nearest: {', '.join(nearest)}")
    return [by_name[name] for name in dict.fromkeys(names)]


def _of_part(
    name: str, mesh: Mesh, mine: Bool[np.ndarray, " vertices"], pixel: float
) -> Iterator[Parameter]:
    """Return how some vertices shift, turn and grow."""
    middle, arm = _middle_and_arm(mesh, mine)

    def moved(setup: Setup, *, turn: Any = None, scale: Any = 1.0, shift: Any = 0.0) -> Setup:
        mesh = setup.mesh
        linear = jnp.eye(3, dtype=mesh.positions.dtype) if turn is None else turn
        apply = lambda vectors: jnp.matmul(vectors, linear.T, precision="highest")
        choose = lambda new, old: jnp.where(mine[:, None], new, old)
        positions = middle + shift + scale * apply(mesh.positions - middle)
        mesh = mesh._replace(
            positions=choose(positions, mesh.positions),
            normals=choose(apply(mesh.normals), mesh.normals),
        )
        if mesh.tangents is not None:
            tangents = [apply(mesh.tangents[:, :3]), mesh.tangents[:, 3:]]
            tangents = jnp.concatenate(tangents, axis=1)
            mesh = mesh._replace(tangents=choose(tangents, mesh.tangents))
        return setup._replace(mesh=mesh)

    for k, axis in enumerate("xyz"):
        along = np.eye(3, dtype=middle.dtype)[k]
        shift = lambda setup, length, along=along: moved(setup, shift=length * along)
        yield Parameter(f"{name}.shift.{axis}", "world length", shift, pixel)
    for k, axis in enumerate("xyz"):
        turn = lambda setup, degrees, k=k: moved(
            setup, turn=_rotation(k, jnp.asarray(degrees, setup.mesh.positions.dtype))
        )
        yield Parameter(f"{name}.turn.{axis}", "degree", turn, float(np.rad2deg(pixel / arm)))
    scale = lambda setup, share: moved(setup, scale=1 + share)
    yield Parameter(f"{name}.scale", "its own size", scale, pixel / arm)


def _rotation(axis: int, degrees: Float[Array, ""]) -> Float[Array, "3 3"]:
    j, k = (axis + 1) % 3, (axis + 2) % 3
    angle = jnp.deg2rad(degrees)
    cos, sin = jnp.cos(angle), jnp.sin(angle)
    matrix = jnp.eye(3, dtype=angle.dtype).at[[j, k], [j, k]].set(cos)
    return matrix.at[j, k].set(-sin).at[k, j].set(sin)


def _eye_moved(axis: int) -> Callable[[Setup, Any], Setup]:
    def move(setup: Setup, length: Any) -> Setup:
        view = setup.camera.view_from_world
        view = jnp.asarray(view).at[:3, 3].add(-length * view[:3, axis])
        return setup._replace(
            camera=eqx.tree_at(lambda camera: camera.view_from_world, setup.camera, view)
        )

    return move


def _of_fields(
    name: str, owner: Any, find: Callable[[Setup], Any], steps: Mapping[str, float]
) -> Iterator[Parameter]:
    """Return the numbers and the vectors of three of a light or a camera."""
    for field in dataclasses.fields(owner):
        value = np.asarray(getattr(owner, field.name))
        if field.name in ("near", "far") or value.shape not in ((), (3,)):
            continue
        unit = _UNITS.get(field.name, "world length")
        axes = "rgb" if field.name == "color" else "xyz"
        for k, axis in enumerate([f".{axis}" for axis in axes] if value.ndim else [""]):
            step = steps.get(field.name, _RELATIVE_STEP * max(float(np.abs(value).max()), 0.1))
            move = _field_moved(find, field.name, k if value.ndim else None)
            yield Parameter(f"{name}.{field.name}{axis}", unit, move, float(step))


def _of_technique(setup: Setup, find: Callable[[Setup], Any]) -> Iterator[Parameter]:
    technique = find(setup)
    if any(getattr(technique, field.name) is None for field in dataclasses.fields(technique)):
        return  # it takes its numbers from the light
    for name, (value, unit) in numbers(technique).items():
        step = _RELATIVE_STEP * max(abs(value), 0.1)
        move = _field_moved(find, name.partition(".")[2], None)
        yield Parameter(name, unit, move, step, traced=False)


def _field_moved(
    find: Callable[[Setup], Any], field: str, axis: int | None
) -> Callable[[Setup, Any], Setup]:
    """Return a function that adds to a field; directions keep unit length."""
    where = lambda setup: getattr(find(setup), field)

    def move(setup: Setup, change: Any) -> Setup:
        value = jnp.asarray(where(setup))
        moved = value + change if axis is None else value.at[axis].add(change)
        return eqx.tree_at(where, setup, safe_normalize(moved) if field == "direction" else moved)

    return move


def _middle_and_arm(
    mesh: Mesh, mine: Bool[np.ndarray, " vertices"]
) -> tuple[Float[np.ndarray, "3"], float]:
    """Return the middle of some vertices' box and half of its diagonal, 1 if that is 0."""
    positions = np.asarray(mesh.positions)[mine]
    low, high = positions.min(axis=0), positions.max(axis=0)
    return 0.5 * (low + high), 0.5 * float(np.linalg.norm(high - low)) or 1.0


def _pixel_length(camera: Camera, middle: Float[np.ndarray, "3"], height: int) -> float:
    """Return the world length of a pixel at a point."""
    if isinstance(camera, OrthographicCamera):
        return 2 * float(camera.half_height) / height
    view = np.asarray(camera.view_from_world)
    distance = max(-float(view[2, :3] @ middle + view[2, 3]), float(camera.near))
    return 2 * distance * float(np.tan(0.5 * camera.vertical_fov)) / height
