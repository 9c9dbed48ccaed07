"""``python -m experiments fit-bias``: a bias fitted and judged, with the pictures to see it."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import jax
import numpy as np
import tyro

from shadows.bias import Bias, CombinedBias
from shadows.render import check_techniques

from ..checks import check_folder, check_reach, check_scene, check_size, check_target, make_folder
from ..console import say, say_notes, say_table, stage
from ..figures import error_picture, on_background, save_comparison, save_curve
from ..files.images import atomic_path, read_image, write_exr, write_png
from ..metrics import ShadowErrors
from ..options import parse_techniques
from ..provenance import commit, device, versions
from ..rendering.prepare_scene import prepare_scene
from ..rendering.render_command import (
    ImageSize,
    MapSize,
    SceneName,
    image_channels,
    shadow_map_channels,
)
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
from .bias_study import Study, Techniques, TruthGoal, prepare_study, with_target
from .fit_bias import BiasFit, fit_bias
from .sweep_bias import BiasSweep, sweep_bias

_TOO_LARGE = 16.0  # times the fitted bias, to show what is lost
_NAMES = {
    "before": "zero bias",
    "after": "fitted bias",
    "too_large": f"{_TOO_LARGE:g} x fitted bias",
    "sweep_best": "best of sweep",
}


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
    bias: BiasWords = ("constant", "slope"),
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
    """
    check_folder(out)
    check_size("--image-size", *image_size)
    check_size("--shadow-map-size", shadow_map_size)
    terms = CombinedBias(parse_techniques(Bias, bias or (), option="--bias"))
    lookup, comparison = parse_lookup(filter, compare)
    check_techniques(terms, lookup)
    free_numbers(terms, free or None, filter=lookup, compare=comparison)
    model = parse_shading(shading)
    goal = None if target is None else read_image(target)
    if goal is not None and target is not None:
        check_target(target, goal, image_size)
    with stage(f"loading {scene}"):
        loaded = prepare_scene(load_scene(scene))
        maps = choose_layout(loaded, layout)
        check_scene(loaded, maps)
        check_reach(lookup, maps, shadow_map_size)
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
    pictures = _Pictures(study, out)
    pictures.write("before", CombinedBias())
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
    biases = {"before": CombinedBias(), "after": fitted.techniques, "sweep_best": swept.techniques}
    errors = {name: study.errors(choice) for name, choice in biases.items()}
    with stage("drawing"):
        pictures.write("sweep_best", swept.techniques)
        large = _scaled(fitted.techniques, _TOO_LARGE)
        pictures.write("too_large", large)
        pictures.write_comparison({**errors, "too_large": study.errors(large)})
        _write_curve(study, fitted, errors, out)
    settings = {
        "scene": scene, "target": None if target is None else str(target), "bias": list(bias or ()),
        "filter": list(filter), "compare": list(compare), "layout": list(layout),
        "image_size": list(image_size), "shadow_map_size": shadow_map_size,
        "shading": list(shading),
    }  # fmt: skip
    summary = _summary(study, biases, errors, fitted, swept)
    _write_json(out / "summary.json", {"settings": settings, **summary, **_made_with()})
    _print_table(study, errors, fitted, swept, summary)
    say(f"pictures and numbers: {out} (start with comparison.png; figures in summary.json)")


class _Pictures:
    """Writes the pictures of a study as they become known, and keeps them for the overview."""

    def __init__(self, study: Study, out: Path) -> None:
        self._study, self._out = study, out
        self._covered = np.asarray(study.unbiased.surface.covered)
        self._panels: dict[str, np.ndarray] = {}

    def write(self, name: str, bias: CombinedBias | Techniques) -> None:
        """Write an image and its error picture."""
        visibility = self._study.visibility(bias)
        color = self._write_image(name, visibility)
        errors = error_picture(color, visibility, self._study.truth, self._covered)
        write_png(self._out / f"error_{name}.png", errors)
        self._panels[f"error_{name}"] = errors

    def write_truth(self) -> None:
        """Write the image under ray-traced visibility, and the shadow map."""
        self._write_image("truth", self._study.truth.astype(np.float32))
        shadow_maps = self._study.unbiased.shadow_maps
        write_exr(self._out / "shadow_map.exr", shadow_map_channels(shadow_maps))

    def write_comparison(self, errors: Mapping[str, ShadowErrors]) -> None:
        """Write all of it on one page."""
        titles = {
            **{name: _NAMES[name] for name in ("before", "after", "too_large")},
            "truth": "ray-traced truth",
            **{f"error_{name}": f"{_NAMES[name]}: {errors[name].acne:.2%} acne, "
               f"{errors[name].leak:.2%} leak" for name in _NAMES},
        }  # fmt: skip
        save_comparison(
            self._out / "comparison.png",
            {title: self._panels[name] for name, title in titles.items()},
            title=f"{self._study.scene.name}: shadow bias before and after the fit",
        )

    def _write_image(self, name: str, visibility: np.ndarray) -> np.ndarray:
        color = self._study.picture(visibility)
        picture = on_background(color, self._covered)
        image = self._study.unbiased._replace(color=color, visibilities=(visibility,))
        write_exr(self._out / f"{name}.exr", image_channels(image))
        write_png(self._out / f"{name}.png", picture)
        self._panels[name] = picture
        return color


def _write_curve(
    study: Study, fitted: BiasFit, errors: Mapping[str, ShadowErrors], out: Path
) -> None:
    """Follow acne and leak while the fitted bias grows from zero to 64 times itself."""
    scales = np.concatenate([[0], np.geomspace(1 / 16, 64, 61)])
    curve = [study.errors(_scaled(fitted.techniques, scale)) for scale in scales]
    save_curve(
        out / "acne_leak_curve.png",
        scales=scales,
        acne=np.array([e.acne for e in curve]),
        leak=np.array([e.leak for e in curve]),
        marks={_NAMES[name]: (e.acne, e.leak) for name, e in errors.items()},
        title=f"{study.scene.name}: a larger bias trades acne for leaks",
    )


def _scaled(techniques: Techniques, scale: float) -> Techniques:
    bias, filter, compare = techniques
    return jax.tree.map(lambda number: number * np.float32(scale), bias), filter, compare


def _summary(
    study: Study,
    biases: Mapping[str, CombinedBias | Techniques],
    errors: Mapping[str, ShadowErrors],
    fitted: BiasFit,
    swept: BiasSweep,
) -> dict[str, Any]:
    def each(field: str) -> dict[str, float]:
        return {name: getattr(e, field) for name, e in errors.items()}

    fields = ("acne", "leak", "error", "acne_interior", "leak_interior", "error_interior")
    return {
        **{field: each(field) for field in fields},
        "contact_gap": {name: study.contact_gap(bias) for name, bias in biases.items()},
        "objective": {
            "name": study.trial.goal.unit,
            "before": study.objective(CombinedBias()),
            "after": fitted.error,
            "sweep_best": swept.error,
        },
        "parameters": {
            name: {"after": value, "sweep_best": swept.values[name], "unit": fitted.units[name]}
            for name, value in fitted.values.items()
        },
        "levels": [level._asdict() for level in fitted.levels],
        "undetermined": list(fitted.untold),
        "steps": fitted.steps,
        "evaluations": {"fit": fitted.evaluations, "sweep": swept.evaluations},
        "seconds": {"fit": fitted.seconds, "sweep": swept.seconds},
        "compile_seconds": {"fit": fitted.compile_seconds, "sweep": swept.compile_seconds},
        "sweep_converged": swept.converged,
        "pixels": {"lit": errors["after"].lit, "dark": errors["after"].dark},
        "notes": list(study.scene.notes),
    }


def _made_with() -> dict[str, Any]:
    return {"versions": versions(), "device": device(), "commit": commit()}


def _write_json(path: Path, content: Mapping[str, Any]) -> None:
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(content, indent=2) + "\n", "utf-8")


def _print_table(
    study: Study,
    errors: Mapping[str, ShadowErrors],
    fitted: BiasFit,
    swept: BiasSweep,
    summary: Mapping[str, Any],
) -> None:
    cost = {
        "before": ("", ""),
        "after": (str(fitted.evaluations), f"{fitted.seconds:.2f}"),
        "sweep_best": (str(swept.evaluations), f"{swept.seconds:.2f}"),
    }
    rows = [
        [
            _NAMES[name], f"{e.acne:.3%}", f"{e.leak:.3%}", f"{e.error:.3%}",
            f"{e.error_interior:.3%}", f"{summary['contact_gap'][name]:.3g}", *cost[name],
        ]
        for name, e in errors.items()
    ]  # fmt: skip
    header = ["bias", "acne", "leak", "error", "off edges", "gap", "tried", "seconds"]
    say_table(study.scene.name, header, rows)
    if not isinstance(study.trial.goal, TruthGoal):
        name, *figures = summary["objective"].values()
        said = ", ".join(f"{_NAMES[k]} {v:.4g}" for k, v in zip(errors, figures, strict=True))
        say(f"{name}: {said}")
    for name, parameter in summary["parameters"].items():
        say(f"{name} = {parameter['after']:.5g} {parameter['unit']}")
    words = ", ".join(f"{level.softness:g} {level.result}" for level in fitted.levels)
    say(f"{fitted.steps} solver steps at softness {words}")
    for sentence in fitted.untold:
        say(f"undetermined: {sentence}")
