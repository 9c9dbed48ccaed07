"""``python -m experiments fit-bias``: a bias fitted and judged, with the pictures to see it."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from shadows.area_lights import AreaLight
from shadows.bias import Bias, CombinedBias
from shadows.filters import Filter
from shadows.lights import Light
from shadows.visibility import check_techniques, default_bias

from ..checks import check_folder, check_reach, check_scene, check_size, check_target, make_folder
from ..console import say, say_notes, stage
from ..files.images import read_image
from ..options import parse_techniques, technique_name, techniques
from ..rendering.prepare_scene import prepare_scene
from ..rendering.render_command import ImageSize, MapSize, SceneName
from ..scenes import load_scene
from ..technique_words import (
    BiasWords,
    CompareWords,
    FilterWords,
    LayoutWords,
    ShadingWords,
    choose_layout,
    parse_lookup,
    parse_shading,
)
from .bias_space import free_numbers
from .bias_study import prepare_study, with_target
from .fit_bias import fit_bias
from .fit_bias_report import Outcome, Pictures, print_table, write_curve, write_summary
from .sweep_bias import sweep_bias


def fit(
    scene: SceneName = "default",
    /,
    *,
    out: Annotated[Path, tyro.conf.arg(metavar="DIR", help="Folder for pictures and numbers.")],
    target: Annotated[
        Path | None,
        tyro.conf.arg(
            metavar="IMAGE",
            help="Fit to this picture of the same view, EXR or PNG, instead of ray-traced truth.",
        ),
    ] = None,
    bias: Annotated[
        BiasWords,
        tyro.conf.arg(
            help_behavior_hint="(default: constant and slope; as render's where an area light "
            "is the truth and --free names none of the bias)"
        ),
    ] = None,
    free: Annotated[
        tuple[str, ...],
        tyro.conf.arg(
            metavar="NAME",
            help="Numbers to fit, of bias, filter or comparison, as constant.length or "
            "poisson.radius; the others keep their values.",
            help_behavior_hint="(default: all of the bias)",
        ),
    ] = (),
    layout: LayoutWords = (),
    filter: FilterWords = ("bilinear",),
    compare: CompareWords = (),
    image_size: ImageSize = (512, 512),
    shadow_map_size: MapSize = 1024,
    shading: ShadingWords = ("blinn-phong",),
) -> None:
    """Fit a shadow bias so that acne and leaks are least, and compare with a full sweep.

    Starts from zero bias. Writes before, after, truth and error pictures, the acne-leak
    curve, EXR files, and summary.json with every figure. In the table, "off edges" is the
    error more than three pixels away from the edges of true shadows, and "gap" the world
    length of shadow lost where casters touch.

    Of an area light the truth is the share that each pixel sees, and acne and leak are by how
    much the pixels are too dark and too light, on average.
    """
    check_folder(out)
    check_size("--image-size", *image_size)
    check_size("--shadow-map-size", shadow_map_size)
    parse_techniques(Bias, bias or (), option="--bias")
    lookup, comparison = parse_lookup(filter, compare)
    model = parse_shading(shading)
    goal = None if target is None else read_image(target)
    if goal is not None and target is not None:
        check_target(target, goal, image_size)
    with stage(f"loading {scene}"):
        loaded = prepare_scene(load_scene(scene))
        maps = choose_layout(loaded, layout)
        check_scene(loaded, maps)
        check_reach(lookup, maps, shadow_map_size)
        of_bias = _of_bias(free, loaded.lights[0])
        words = _bias_words(lookup, of_bias) if bias is None else bias
        terms = CombinedBias(parse_techniques(Bias, words, option="--bias"))
        check_techniques(terms, lookup)
        lookup = lookup.for_light(loaded.lights[0])
        free_numbers(terms, free or None, filter=lookup, compare=comparison)
    say_notes(loaded.notes)
    with stage("rendering both passes and tracing the truth"):
        study = prepare_study(
            loaded,
            image_size=image_size,
            map_size=shadow_map_size,
            filter=lookup,
            shading=model,
            bias=terms,
            compare=comparison,
            layout=maps,
        )
        if goal is not None and target is not None:
            limit = 1.0 if target.suffix.lower() == ".png" else np.inf
            study = with_target(study, goal, limit=limit)
    make_folder(out)
    start = (CombinedBias() if of_bias else terms, lookup, comparison)
    pictures = Pictures(study, out)
    pictures.write("before", start)
    pictures.write_truth()
    with stage("fitting") as report:
        fitted = fit_bias(
            study.trial, terms, lookup, free=free or None, compare=comparison, report=report
        )
    pictures.write("after", fitted.techniques)
    with stage("sweeping") as report:
        swept = sweep_bias(
            study.trial, terms, lookup, free=free or None, compare=comparison, report=report
        )
    outcome = Outcome(study, start, fitted, swept, of_bias)
    with stage("drawing"):
        pictures.write("sweep_best", swept.techniques)
        pictures.write_comparison(outcome)
        write_curve(outcome, out)
    settings = {
        "scene": scene, "target": None if target is None else str(target), "bias": list(words),
        "filter": list(filter), "compare": list(compare), "layout": list(layout),
        "image_size": list(image_size), "shadow_map_size": shadow_map_size,
        "shading": list(shading),
    }  # fmt: skip
    print_table(outcome, write_summary(outcome, settings, out))
    say(f"pictures and numbers: {out} (start with comparison.png; figures in summary.json)")


def _of_bias(free: Sequence[str], light: Light) -> bool:
    """Tell whether a bias is fitted, and not the numbers of a filter alone to an area light."""
    kinds = {name.partition(".")[0] for name in free}
    return not (isinstance(light, AreaLight) and kinds) or not kinds.isdisjoint(techniques(Bias))


def _bias_words(filter: Filter, of_bias: bool) -> tuple[str, ...]:
    """Return the bias that is meant where none is named."""
    if of_bias:
        return ("constant", "slope")
    return (technique_name(type(default_bias(filter))),) if filter.needs_bias else ()
