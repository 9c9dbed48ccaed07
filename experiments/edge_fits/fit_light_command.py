"""``python -m experiments fit-light``: a light from the shadows that it throws."""

from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from ..checks import make_folder
from ..console import say_notes, stage
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

_AWAY = 8.0  # steps that every number starts away from the truth, one up, one down
_FAR = 20.0  # most steps of starts by chance


def fit(
    scene: SceneName = "spot",
    /,
    *,
    out: Annotated[Path, tyro.conf.arg(metavar="DIR", help="Folder for pictures and figures.")],
    target: Targets = (),
    free: Annotated[
        tuple[str, ...],
        tyro.conf.arg(
            metavar="NAME",
            help="Numbers of the light, as light.position, light.direction.u, light.outer_angle, "
            "light.intensity.",
            help_behavior_hint="(default: all that it has)",
        ),
    ] = ("light",),
    start: Annotated[
        Start,
        tyro.conf.arg(
            help_behavior_hint="(default: 8 steps up or down each, if the target is made)"
        ),
    ] = (),
    starts: Starts = 1,
    noise: Noise = 0.0,
    adam: Adam = 0,
    layout: LayoutWords = (),
    bias: BiasWords = None,
    filter: FilterWords = ("bilinear",),
    compare: CompareWords = (),
    shading: ShadingWords = ("blinn-phong",),
    image_size: ImageSize = (512, 512),
    shadow_map_size: MapSize = 512,
    resume: Resume = False,
) -> None:
    """Find where a light is, where it points, how wide and bright it is, from one image.

    The first of the scene's lights, alone. Numbers are told as amounts added to the scene's
    own: world units, degrees, percent; u and v are two turns across the direction. Writes
    comparison.png, progress_curve.png, summary.json; stages.json lets a stopped fit go on.
    """
    options = Options(
        scene, out, target, starts, noise, adam, layout, bias, filter, compare, shading,
        image_size, shadow_map_size,
    )  # fmt: skip
    with stage(f"loading {scene}"):
        loaded, technique, chosen_bias, pictures = load(options)
        view = ShadowView.of(loaded, technique, image_size=image_size)
        zero, vertices = np.zeros(3, np.float32), np.arange(len(loaded.mesh.positions))
        state = State(zero, zero, loaded.lights[0], chosen_bias)
        numbers = numbers_of(state, free, size=scene_size(loaded, vertices))
        problem = as_arrays(
            SceneProblem(view, np.asarray(loaded.mesh.positions), vertices[:0], (state,), numbers)
        )
        first = parse_start(start, numbers)
        if not start and not pictures:
            first = _AWAY * (-1.0) ** np.arange(len(numbers))
    say_notes(loaded.notes)
    rng = np.random.default_rng(0)
    others = [first + rng.uniform(-_FAR, _FAR, len(numbers)) for _ in range(starts - 1)]
    with stage("making the target") if not pictures else stage("reading the target"):
        targets = targets_of(problem, pictures, noise)
    make_folder(out)
    truth = None if pictures else np.zeros(len(numbers))
    run_fit(
        Fit(
            f"{loaded.name}: light from shadows", problem, targets,
            [first, *others], truth, noise, adam,
        ),
        out,
        options.settings | {"free": list(free), "start": list(start)},
        resume=resume,
    )  # fmt: skip
