"""Measurements of models: the picture, how wrong it is, and the time that each stage takes.

The time of a model is that of its light pass, of what the filter makes of the map, of the
lookup and of the shading with its textures, each compiled and warm, over several runs. A
stage that models share is timed once, so that models differ only where they are different.
The eye's pass is the same for all, and not counted.
"""

import functools
from functools import partial
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from shadows.bias import Bias
from shadows.compare import HardCompare
from shadows.filters import Filter
from shadows.lights import Light
from shadows.shadow_map import ShadowMap
from shadows.surface import Surface
from shadows.visibility import surface_visibility

from ..frontier.programs import Programs, Timed, run_times
from ..frontier.shadow_method import draw_map, prepare_map
from ..options import parse_technique
from ..technique_words import parse_bias
from .models import Model, bias_words, filters
from .sight import Measure, Picture, Sight, shade_picture, shading_arguments, shown

Stage = tuple[str, ...]  # its kind, and what tells it from others of its kind


class Measured(NamedTuple):
    """What was found of a model.

    Attributes:
        error: Distance of its picture from truth.
        ms: Time of each of its stages.
    """

    error: float
    ms: dict[Stage, float]

    @property
    def cost(self) -> float:
        """Its time, ms."""
        return sum(self.ms.values())


def stages(model: Model) -> list[Stage]:
    """Return the stages of a model; models with a stage in common share its time."""
    shade = ("shade", model.look)
    if not model.filter:
        return [shade]
    size = str(model.map_size)
    return [
        ("draw", size),
        ("prepare", model.filter, size),
        ("look up", model.filter, size, model.bias),
        shade,
    ]


class Bench:
    """Measures models on one scene; what was timed is kept."""

    def __init__(
        self, sight: Sight, slope: float, *, measure: Measure, runs: int, programs: Programs
    ) -> None:
        """Begin with nothing measured.

        Args:
            sight: The scene.
            slope: Of the constant bias, see ``bias_words``.
            measure: Of the error.
            runs: Of each stage, at least.
            programs: Compiled so far.
        """
        self.sight, self.slope = sight, slope
        self._measure: Measure = measure
        self._runs, self._programs = runs, programs
        self._ms: dict[Stage, float] = {}
        self._maps: dict[tuple[Stage, int], _Map] = {}  # of the last filter and size

    def measure(self, model: Model) -> Measured:
        """Return a model's error and time."""
        picture, timed = self._made(model)
        for stage, programs in timed.items():
            if stage not in self._ms:
                # The lower quartile, which other load disturbs less.
                times = [np.quantile(run_times(p, self._runs), 0.25) for p in programs]
                self._ms[stage] = float(sum(times))
        error = self.sight.error(picture, self._measure)
        return Measured(error, {stage: self._ms[stage] for stage in timed})

    def _made(self, model: Model) -> tuple[Picture, dict[Stage, list[Timed]]]:
        """Return a model's picture, and for each stage its program for each light."""
        timed: dict[Stage, list[Timed]] = {stage: [] for stage in stages(model)}
        visibilities = []
        for index, seen in enumerate(self.sight.seen):
            if model.filter:
                visibilities.append(self._shadow(model, index, timed))
            else:
                visibilities.append(jnp.asarray(seen.facing, jnp.float32))
        arguments = (*shading_arguments(self.sight, model.look), tuple(visibilities))
        shade = self._programs.get(f"simplest shade {model.look}", shade_picture, *arguments)
        timed[("shade", model.look)] = [shade]
        return shown(np.asarray(shade())), timed

    def _shadow(self, model: Model, index: int, timed: dict[Stage, list[Timed]]) -> Array:
        """Return a light's visibility under a model, and note the programs that made it."""
        draw_stage, prepare_stage, look_up_stage, _ = stages(model)
        key = prepare_stage, index
        if key not in self._maps:
            self._maps = {of: made for of, made in self._maps.items() if of[0] == prepare_stage}
            self._maps[key] = self._map(model, index)
        made, light = self._maps[key], self.sight.seen[index].light
        filter, bias = techniques(model, self.slope)
        look_up = self._programs.get(
            f"simplest look up {model.filter} {model.map_size}", _look_up,
            bias, filter.for_light(light), light, self.sight.surface, made.drawn, made.prepared,
        )  # fmt: skip
        for stage, program in (
            (draw_stage, made.draw), (prepare_stage, made.prepare), (look_up_stage, look_up)
        ):  # fmt: skip
            timed[stage].append(program)
        return look_up()

    def _map(self, model: Model, index: int) -> "_Map":
        """Draw a light's map and prepare it."""
        scene, light = self.sight.scene, self.sight.seen[index].light
        filter = techniques(model, self.slope)[0].for_light(light)
        draw = self._programs.get(
            f"simplest draw {model.map_size}",
            partial(draw_map, model.map_size),
            self.sight.layout, scene.mesh, scene.camera, light, jnp.float32(filter.reach()),
        )  # fmt: skip
        drawn = draw()
        name = f"simplest prepare {model.filter} {model.map_size}"
        prepare = self._programs.get(name, prepare_map, filter, drawn)
        return _Map(draw, prepare, drawn, prepare())


class _Map(NamedTuple):
    """A light's map, as a filter asks it, and the programs that made it."""

    draw: Timed
    prepare: Timed
    drawn: ShadowMap
    prepared: Any


def techniques(model: Model, slope: float) -> tuple[Filter, Bias]:
    """Make a model's filter and bias."""
    return _parsed(model.filter, model.bias, slope)


@functools.lru_cache(256)
def _parsed(filter_name: str, bias: str, slope: float) -> tuple[Filter, Bias]:
    filter = parse_technique(Filter, filters()[filter_name].words, option="--filter")
    return filter, parse_bias(bias_words(bias, slope), filter)


def _look_up(
    bias: Bias, filter: Filter, light: Light, surface: Surface, shadow_map: ShadowMap, kept: Any
) -> Float[Array, "height width"]:
    return surface_visibility(
        surface, light, shadow_map, bias=bias, filter=filter, compare=HardCompare(), prepared=kept
    )
