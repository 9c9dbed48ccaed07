"""``python -m experiments fit-pose``: the pose of a caster from its shadows alone."""

from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from ..checks import make_folder
from ..console import say_notes, stage
from ..mesh_parts import split_caster
from ..rendering.render_command import ImageSize, MapSize, SceneName
from ..technique_words import BiasWords, CompareWords, FilterWords, LayoutWords, ShadingWords
from .fit_options import (
    Adam,
    Noise,
    Options,
    Resume,
    Start,
    Starts,
    Targets,
    as_arrays,
    load,
    parse_start,
    scene_size,
    targets_of,
)
from .run_fit import Fit, run_fit
from .scene_numbers import SceneProblem, State, numbers_of
from .shadow_view import ShadowView

_USUAL_START = ("turn.y=70",)


def fit(
    scene: SceneName = "bracket",
    /,
    *,
    out: Annotated[Path, tyro.conf.arg(metavar="DIR", help="Folder for pictures and figures.")],
    target: Targets = (),
    free: Annotated[
        tuple[str, ...],
        tyro.conf.arg(metavar="NAME", help="turn, shift, or one of them as turn.y; also light.*"),
    ] = ("turn", "shift"),
    start: Annotated[Start, tyro.conf.arg(help_behavior_hint="(default: turn.y=70)")] = (),
    starts: Starts = 1,
    noise: Noise = 0.0,
    adam: Adam = 0,
    layout: LayoutWords = (),
    bias: BiasWords = None,
    filter: FilterWords = ("bilinear",),
    compare: CompareWords = (),
    shading: ShadingWords = ("blinn-phong",),
    image_size: ImageSize = (512, 512),
    shadow_map_size: MapSize = 256,
    resume: Resume = False,
) -> None:
    """Find how a caster is turned and shifted from the shadow that it throws.

    The camera sees the ground alone: the part of the mesh with the largest box. All else is
    the caster, which moves as one. A pose is a turn about the middle of the caster's box (an
    axis times degrees, world axes) and a shift, both from the scene as it is; each light
    gives an image. Writes comparison.png, progress_curve.png, summary.json; stages.json lets a
    stopped fit go on.
    """
    options = Options(
        scene, out, target, starts, noise, adam, layout, bias, filter, compare, shading,
        image_size, shadow_map_size,
    )  # fmt: skip
    with stage(f"loading {scene}"):
        loaded, technique, chosen_bias, pictures = load(options)
        casts, caster = split_caster(loaded.mesh)
        view = ShadowView.of(loaded, technique, image_size=image_size, seen=~casts)
        zero = np.zeros(3, np.float32)
        states = tuple(State(zero, zero, light, chosen_bias) for light in loaded.lights)
        numbers = numbers_of(states[0], free, size=scene_size(loaded, caster))
        problem = as_arrays(
            SceneProblem(view, np.asarray(loaded.mesh.positions), caster, states, numbers)
        )
        words = start
        if not start and not pictures and any(n.name == "turn.y" for n in numbers):
            words = _USUAL_START
        first = parse_start(words, numbers)
    say_notes(loaded.notes)
    rng = np.random.default_rng(0)
    others = [_by_chance(problem, rng) for _ in range(starts - 1)]
    with stage("making the targets") if not pictures else stage("reading the targets"):
        targets = targets_of(problem, pictures, noise)
    make_folder(out)
    truth = None if pictures else np.zeros(len(numbers))
    title = f"{loaded.name}: pose from {len(targets)} image{'s' * (len(targets) > 1)} of shadows"
    run_fit(
        Fit(title, problem, targets, [first, *others], truth, noise, adam),
        out,
        options.settings | {"free": list(free), "start": list(start)},
        resume=resume,
    )


def _by_chance(problem: SceneProblem, rng: np.random.Generator) -> np.ndarray:
    """Return any turn, and shifts of up to a tenth."""
    turn = rng.standard_normal(3)
    turn *= np.pi * rng.random() / np.linalg.norm(turn)
    vector = np.zeros(len(problem.numbers))
    for k, number in enumerate(problem.numbers):
        if number.field == "turn":
            vector[k] = turn[number.part] / number.step
        else:
            vector[k] = rng.uniform(-10, 10)
    return vector
