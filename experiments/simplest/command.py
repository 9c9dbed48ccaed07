"""The command ``simplest``: the least model of a scene that meets a tolerance."""

import json
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from ..checks import check_folder, check_size, make_folder
from ..console import say, say_notes, stage
from ..files.images import atomic_path
from ..provenance import commit, device, versions
from ..rendering.render_command import SceneName
from ..scenes import load_scene
from .find import simplest as find
from .report import content, print_result, save_comparison
from .sight import Measure


def simplest(
    scene: SceneName = "default",
    /,
    *,
    tolerance: Annotated[
        float, tyro.conf.arg(metavar="ERROR", help="Largest error, in the measure's unit.")
    ],
    out: Annotated[Path, tyro.conf.arg(metavar="DIR", help="Folder for the results.")],
    measure: Annotated[
        Measure,
        tyro.conf.arg(
            help="Of the picture as a screen shows it (sRGB in [0, 1]), where a surface is: root "
            "mean square error, mean FLIP, or the share of pixels off by more than 0.1."
        ),
    ] = "rmse",
    budget_ms: Annotated[
        float | None,
        tyro.conf.arg(
            metavar="MS", help="Most that a model may cost.", help_behavior_hint="(default: no end)"
        ),
    ] = None,
    techniques: Annotated[
        tuple[str, ...],
        tyro.conf.arg(
            metavar="NAME", help="Filters to choose from.", help_behavior_hint="(default: all)"
        ),
    ] = (),
    image_size: Annotated[
        int, tyro.conf.arg(metavar="N", help="Pixels on each side of the image.")
    ] = 512,
    runs: Annotated[int, tyro.conf.arg(help="Warm runs of each stage, at least.")] = 5,
) -> None:  # fmt: skip
    """Find the least model of a scene that meets a tolerance.

    Does it need its normal map, a filter, a slope term, 1024^2 texels, soft shadows, shadows
    at all? The cheapest model whose picture is close enough to the true one: with ray-traced
    shadows and all maps. Cost is the warm time of light pass, preparation, lookup and shading;
    timings want an idle machine. Theory says what cannot do, the rest is measured. Writes
    simplest.json, with the words of ``render`` that show the chosen picture, and
    comparison.png. Exit code 3: no model meets the tolerance (within the budget).
    """
    check_folder(out)
    check_size("--image-size", image_size)
    if not 0 <= tolerance < np.inf:
        raise ValueError(f"--tolerance: expected a finite error of at least 0, got {tolerance}")
    if budget_ms is not None and not budget_ms > 0:
        raise ValueError(f"--budget-ms: expected a time above 0 ms, got {budget_ms}")
    if runs < 1:
        raise ValueError(f"--runs: expected at least 1, got {runs}")
    loaded = load_scene(scene)
    say_notes(loaded.notes)
    with stage("searching") as tell:
        found = find(
            loaded, tolerance, measure=measure, image_size=image_size, runs=runs, tell=tell,
            techniques=techniques, budget_ms=np.inf if budget_ms is None else budget_ms,
        )  # fmt: skip
    make_folder(out)
    result: dict[str, Any] = content(found, scene, image_size) | {"budget_ms": budget_ms}
    made_with = {"versions": versions(), "device": device(), "commit": commit()}
    with atomic_path(out / "simplest.json") as temporary:
        temporary.write_text(json.dumps(result | made_with, indent=1) + "\n", "utf-8")
    with stage("drawing"):
        save_comparison(found, image_size, out / "comparison.png")
    print_result(found)
    say(result["command"])
