"""What a fit of a normal map may move, and what its guesses are compared with."""

from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from shadows.lights import Light
from tangentspace._math import safe_normalize
from tangentspace.shading import Shading

from ..options import hint
from .normal_map_views import Slopes, Vector, View


class Unknowns(eqx.Module):
    """What a fit may move.

    Attributes:
        slopes: Of the map's height field, two per texel.
        shading: The lighting model.
        lights: One for each image.
    """

    slopes: Slopes | Float[Array, "height width 2 2"]
    shading: Shading
    lights: tuple[Light, ...]


class Anchor(eqx.Module):
    """Unknowns to take steps from.

    Attributes:
        start: The unknowns at no step.
        scale: For each texel a matrix from steps to slopes, for each other number how far a
            step of one moves it, and None for what is fixed.
    """

    start: Unknowns
    scale: Unknowns

    def unknowns(self, steps: Unknowns) -> Unknowns:
        """Return the unknowns after steps; the lights' directions have unit length."""
        numbers = (self.start.shading, self.start.lights)
        shading, lights = jax.tree.map(
            lambda begun, scale, step: begun if scale is None else begun + scale * step,
            numbers,
            (self.scale.shading, self.scale.lights),
            (steps.shading, steps.lights),
        )
        matrix, (a, b) = self.scale.slopes, (steps.slopes[..., k] for k in (0, 1))
        moved = jnp.stack([matrix[..., k, 0] * a + matrix[..., k, 1] * b for k in (0, 1)], axis=-1)
        return Unknowns(
            self.start.slopes + moved, shading, tuple(_of_unit_direction(light) for light in lights)
        )


class Task(eqx.Module):
    """What guesses are compared with.

    Attributes:
        view: The pixels.
        targets: Linear RGB of each pixel in each image.
    """

    view: View
    targets: Float[Array, "lights 3 pixels"]

    def residuals(self, unknowns: Unknowns) -> list[Float[Array, " pixels"]]:
        """Return color minus target for each light and channel, 0 where a light does not count."""
        return self.residuals_at(self.view.look_up(unknowns.slopes), unknowns)

    def residuals_at(self, looked_up: Vector, unknowns: Unknowns) -> list[Float[Array, " pixels"]]:
        """Return what ``residuals`` does, for normals that were looked up in another map."""
        normals = self.view.normals(looked_up)
        colors = self.view.colors(normals, unknowns.lights, unknowns.shading)
        return [
            lit * (color - target)
            for lit, channels, targets in zip(self.view.lit, colors, self.targets, strict=True)
            for color, target in zip(channels, targets, strict=True)
        ]


def free_names(shading: Shading, lights: Sequence[Light]) -> list[str]:
    """Return the names that can be free beside the map."""
    fields = {f"light.{name}" for light in lights for name in vars(light)}
    return [*vars(shading), *sorted(fields)]


def free_leaves(
    unknowns: Unknowns, free: Sequence[str]
) -> list[tuple[str, Callable[[Unknowns], Array]]]:
    """Return each free leaf's name, as ``light 2 direction``, and a function that picks it.

    Raises:
        ValueError: If a name is not one of the model's or of its lights'.
    """
    known = free_names(unknowns.shading, unknowns.lights)
    leaves = []
    for name in free:
        if name not in known:
            raise ValueError(f"--free {name}: no such number; {hint(name, known)}")
        if name in vars(unknowns.shading):
            leaves.append((name, lambda u, name=name: getattr(u.shading, name)))
            continue
        field = name.removeprefix("light.")
        for k, light in enumerate(unknowns.lights):
            if field in vars(light):
                pick = lambda u, k=k, field=field: getattr(u.lights[k], field)
                leaves.append((f"light {k + 1} {field}", pick))
    return leaves


def _of_unit_direction(light: Light) -> Light:
    """Return the light with its direction, if it has one, scaled to unit length."""
    direction = getattr(light, "direction", None)
    if direction is None:
        return light
    return eqx.tree_at(lambda li: li.direction, light, safe_normalize(direction))
