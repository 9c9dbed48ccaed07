"""What a bias fit leaves behind: pictures, a curve, summary.json and a table."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from shadows.area_lights import AreaLight

from ..console import say, say_table
from ..figures import (
    error_picture,
    on_background,
    save_comparison,
    save_curve,
    save_error_curve,
    soft_error_picture,
)
from ..files.images import write_exr, write_png
from ..json_file import write_json
from ..metrics import ShadowErrors, SoftShadowErrors
from ..options import numbers, technique_name
from ..provenance import commit, device, versions
from ..rendering.render_command import image_channels, shadow_map_channels
from ..truth.area import LIGHT_SAMPLES
from .bias_study import ImageGoal, Study, Techniques
from .fit_bias import BiasFit
from .sweep_bias import BiasSweep

_TOO_LARGE = 16.0  # times what was fitted, to show what is lost
_SOFT_LEGEND = ("darker than truth, in full from a quarter", "lighter than truth")
_SOFT_SHARES = ("mean of what is missing in visibility", "mean of what is too much in visibility")


class Outcome(NamedTuple):
    """A fit and the sweep that judges it.

    Attributes:
        study: What both worked on.
        start: What they are compared with: zero bias, or where no bias was fitted, the start.
        fitted: The fit.
        swept: The sweep.
        of_bias: Whether a bias was fitted.
    """

    study: Study
    start: Techniques
    fitted: BiasFit
    swept: BiasSweep
    of_bias: bool

    @property
    def compared(self) -> dict[str, Techniques]:
        """What is judged, by its name in summary.json."""
        return {
            "before": self.start,
            "after": self.fitted.techniques,
            "sweep_best": self.swept.techniques,
        }

    @property
    def names(self) -> dict[str, str]:
        """The same names, and that of a picture, in words."""
        before, after = ("zero bias", "fitted bias") if self.of_bias else ("start", "fitted")
        return {
            "before": before,
            "after": after,
            "too_large": f"{_TOO_LARGE:g} x {after}",
            "sweep_best": "best of sweep",
        }

    def scaled(self, scale: float) -> Techniques:
        """Return the result with its bias, or what else was fitted, so many times as large."""
        bias, filter, compare = self.fitted.techniques
        if self.of_bias:
            return jax.tree.map(lambda number: number * np.float32(scale), bias), filter, compare
        free = self.fitted.values
        return bias, _scaled(filter, free, scale), _scaled(compare, free, scale)

    def judge(self, choice: Techniques) -> ShadowErrors | SoftShadowErrors:
        """Return acne and leak: shares of pixels, or under an area light mean distances."""
        return self.study.soft_errors(choice) if self.study.soft else self.study.errors(choice)


def _scaled(technique: Any, free: Mapping[str, float], scale: float) -> Any:
    """Return a technique with its free numbers so many times as large."""
    kind = technique_name(type(technique))
    fields = [name.partition(".")[2] for name in free if name.partition(".")[0] == kind]
    larger = {field: getattr(technique, field) * np.float32(scale) for field in fields}
    return dataclasses.replace(technique, **larger) if fields else technique


class Pictures:
    """Writes the pictures of a study as they become known, and keeps them for the overview."""

    def __init__(self, study: Study, out: Path) -> None:
        """Write to a folder."""
        self._study, self._out = study, out
        self._covered = np.asarray(study.unbiased.surface.covered)
        self._panels: dict[str, np.ndarray] = {}

    def write(self, name: str, choice: Techniques) -> None:
        """Write an image and its error picture."""
        study, visibility = self._study, self._study.visibility(choice)
        color = self._write_image(name, visibility)
        if study.soft:
            errors = soft_error_picture(color, visibility, study.share, self._covered)
        else:
            errors = error_picture(color, visibility, study.truth, self._covered)
        write_png(self._out / f"error_{name}.png", errors)
        self._panels[f"error_{name}"] = errors

    def write_truth(self) -> None:
        """Write the image under ray-traced visibility, and the shadow map."""
        self._write_image("truth", self._study.share.astype(np.float32))
        shadow_maps = self._study.unbiased.shadow_maps
        write_exr(self._out / "shadow_map.exr", shadow_map_channels(shadow_maps))

    def write_comparison(self, outcome: Outcome) -> None:
        """Write all of it on one page, with what is too large."""
        large = outcome.scaled(_TOO_LARGE)
        self.write("too_large", large)
        choices, names = {**outcome.compared, "too_large": large}, outcome.names
        errors = {name: outcome.judge(choices[name]) for name in names}
        titles = {
            **{name: names[name] for name in ("before", "after", "too_large")},
            "truth": "ray-traced truth",
            **{f"error_{name}": f"{names[name]}: {errors[name].acne:.2%} acne, "
               f"{errors[name].leak:.2%} leak" for name in names},
        }  # fmt: skip
        panels = {title: self._panels[name] for name, title in titles.items()}
        scene, what = self._study.scene.name, "shadow bias" if outcome.of_bias else "soft shadow"
        title, path = f"{scene}: {what} before and after the fit", self._out / "comparison.png"
        if self._study.soft:
            save_comparison(path, panels, title=title, legend=_SOFT_LEGEND)
        else:
            save_comparison(path, panels, title=title)

    def _write_image(self, name: str, visibility: np.ndarray) -> np.ndarray:
        color = self._study.picture(visibility)
        picture = on_background(color, self._covered)
        image = self._study.unbiased._replace(color=color, visibilities=(visibility,))
        write_exr(self._out / f"{name}.exr", image_channels(image))
        write_png(self._out / f"{name}.png", picture)
        self._panels[name] = picture
        return color


def write_curve(outcome: Outcome, out: Path) -> None:
    """Follow acne and leak over the bias, or the error over the one number of a filter."""
    study, names = outcome.study, outcome.names
    if not outcome.of_bias:
        if len(outcome.fitted.values) == 1:
            _write_error_curve(outcome, out)
        return
    scales = np.concatenate([[0], np.geomspace(1 / 16, 64, 61)])
    curve = [outcome.judge(outcome.scaled(scale)) for scale in scales]
    marked = {names[name]: outcome.judge(choice) for name, choice in outcome.compared.items()}
    words: dict[str, Any] = {"shares": _SOFT_SHARES} if study.soft else {}
    save_curve(
        out / "acne_leak_curve.png",
        scales=scales,
        acne=np.array([e.acne for e in curve]),
        leak=np.array([e.leak for e in curve]),
        marks={name: (e.acne, e.leak) for name, e in marked.items()},
        title=f"{study.scene.name}: a larger bias trades acne for leaks",
        **words,
    )


def _write_error_curve(outcome: Outcome, out: Path) -> None:
    study, fitted, swept = outcome.study, outcome.fitted, outcome.swept
    ((name, value),) = fitted.values.items()
    start = {**numbers(outcome.start[1]), **numbers(outcome.start[2])}[name][0]
    save_error_curve(
        out / "error_curve.png",
        values=swept.points[:, 0],
        errors=swept.errors,
        marks={
            "start": (start, study.objective(outcome.start)),
            "fitted": (value, fitted.error),
            "best of sweep": (swept.values[name], swept.error),
        },
        own=_light_size(study) if name.endswith(".light_size") else None,
        labels=(f"{name}, {fitted.units[name]}", study.trial.goal.unit),
        title=f"{study.scene.name}: the error over {name}",
    )


def write_summary(outcome: Outcome, settings: Mapping[str, Any], out: Path) -> dict[str, Any]:
    """Write every figure to summary.json, and return them."""
    made_with = {"versions": versions(), "device": device(), "commit": commit()}
    summary = _summary(outcome)
    content = {"settings": settings, **summary, **made_with}
    write_json(out / "summary.json", content)
    return summary


def _hard_summary(outcome: Outcome) -> dict[str, Any]:
    errors = {name: outcome.study.errors(choice) for name, choice in outcome.compared.items()}
    fields = ("acne", "leak", "error", "acne_interior", "leak_interior", "error_interior")
    return {
        **{field: {name: getattr(e, field) for name, e in errors.items()} for field in fields},
        "pixels": {"lit": errors["after"].lit, "dark": errors["after"].dark},
    }


def _summary(outcome: Outcome) -> dict[str, Any]:
    study, _, fitted, swept, _ = outcome
    return {
        **(_soft_summary(outcome) if study.soft else _hard_summary(outcome)),
        "contact_gap": {n: study.contact_gap(choice) for n, choice in outcome.compared.items()},
        "objective": {
            "name": study.trial.goal.unit,
            "before": study.objective(outcome.start),
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
        "notes": list(study.scene.notes),
    }


def _soft_summary(outcome: Outcome) -> dict[str, Any]:
    """Return the figures that under an area light take the place of those of hard shadows."""
    study = outcome.study
    errors = {name: study.soft_errors(choice) for name, choice in outcome.compared.items()}
    fields = ("acne", "leak", "rmse", "rmse_penumbra")
    return {
        **{field: {name: getattr(e, field) for name, e in errors.items()} for field in fields},
        "pixels": {"surface": errors["after"].surface, "penumbra": errors["after"].penumbra},
        "light": {"diameter": _light_size(study), "samples": LIGHT_SAMPLES},
    }


def _light_size(study: Study) -> float | None:
    """Return the diameter of an area light."""
    light = study.scene.lights[0]
    return float(light.diameter) if isinstance(light, AreaLight) else None


def print_table(outcome: Outcome, summary: Mapping[str, Any]) -> None:
    """Show the figures that matter most."""
    study, _, fitted, swept, _ = outcome
    cost = {
        "before": ("", ""),
        "after": (str(fitted.evaluations), f"{fitted.seconds:.2f}"),
        "sweep_best": (str(swept.evaluations), f"{swept.seconds:.2f}"),
    }
    rows = [[outcome.names[name], *_cells(summary, name), *cost[name]] for name in outcome.compared]
    columns = ["rmse", "in penumbra"] if study.soft else ["error", "off edges"]
    header = ["bias", "acne", "leak", *columns, "gap", "tried", "seconds"]
    say_table(study.scene.name, header, rows)
    if study.soft or isinstance(study.trial.goal, ImageGoal):
        figures = [study.objective(outcome.start), fitted.error, swept.error]
        names = (outcome.names[name] for name in outcome.compared)
        said = ", ".join(f"{k} {v:.4g}" for k, v in zip(names, figures, strict=True))
        say(f"{study.trial.goal.unit}: {said}")
    size = _light_size(study)
    for name, value in fitted.values.items():
        told = f"{name} = {value:.5g} {fitted.units[name]}"
        if size and name.endswith(".light_size"):
            told += f" ({value / size - 1:+.1%} of the light's {size:.5g})"
        say(told)
    words = ", ".join(f"{level.softness:g} {level.result}" for level in fitted.levels)
    say(f"{fitted.steps} solver steps at softness {words}")
    for sentence in fitted.untold:
        say(f"undetermined: {sentence}")


def _cells(summary: Mapping[str, Any], name: str) -> list[str]:
    """Return the errors in a row of the table."""
    columns = {"acne": ".3%", "leak": ".3%"}
    if "rmse" in summary:
        columns |= {"rmse": ".4f", "rmse_penumbra": ".4f"}
    else:
        columns |= {"error": ".3%", "error_interior": ".3%"}
    columns["contact_gap"] = ".3g"
    return [format(summary[column][name], form) for column, form in columns.items()]
