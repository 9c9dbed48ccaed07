"""Run a fit of a scene's numbers to images, judge it, and leave what it found in a folder."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from ..console import say, say_table, stage
from ..json_file import check_settings, read_json, write_json
from ..panels import Curve, Panel, save_curves, save_panels, shown
from ..provenance import commit, device, versions
from .adam import History, adam
from .determined import Determined, determined, sentences
from .image_fit import ImageFit, Stage, check_edges, fit_images, images_and_derivatives
from .scene_numbers import SceneProblem

_NOISE = 0.01  # what standard errors are told for where no noise is stated
_LEFT = 0.02  # of the target's contrast; a fit that leaves more ended in a valley, or is no model

Images = Float[np.ndarray, "images height width"]


class Fit(NamedTuple):
    """What is fitted, and to what.

    Attributes:
        title: What it is called.
        problem: Images as a function of numbers.
        targets: What they should be.
        starts: Where to begin.
        truth: The numbers of the targets, if they were made.
        noise: Stated for each pixel; 0 for none.
        steps: Of Adam beside it; 0 for none.
    """

    title: str
    problem: SceneProblem
    targets: Images
    starts: Sequence[Float[np.ndarray, " numbers"]]
    truth: Float[np.ndarray, " numbers"] | None
    noise: float
    steps: int


def run_fit(fit: Fit, out: Path, settings: Mapping[str, Any], *, resume: bool) -> dict[str, Any]:
    """Fit, print, write pictures and figures; return the figures.

    Args:
        fit: What is fitted.
        out: A folder that is there.
        settings: Of the command; a continued fit must have the same.
        resume: Go on after the stages that are stored in the folder.

    Raises:
        ValueError: If nothing moves in the images, or the stored fit is another.
    """
    done: list[Stage] = []
    if resume:
        check_settings(out / "settings.json", settings)
        done = [Stage(**entry) for entry in read_json(out / "stages.json")]
        done = [entry._replace(vector=tuple(entry.vector)) for entry in done]
    with stage("compiling, and looking at the starts"):
        looks = [images_and_derivatives(fit.problem, start) for start in fit.starts]
    check_edges(fit.problem, [jacobian for _, jacobian in looks])
    write_json(out / "settings.json", settings)
    keep = lambda stages: write_json(out / "stages.json", [s._asdict() for s in stages])
    with stage("fitting") as report:
        found = fit_images(
            fit.problem, fit.targets, fit.starts, done=done, keep=keep, report=report
        )
    _, jacobian = images_and_derivatives(fit.problem, found.vector)
    known = determined(jacobian, fit.noise or _NOISE)
    history = None
    if fit.steps:
        with stage("Adam beside it") as report:
            history = adam(
                fit.problem, fit.targets, fit.starts[found.best], steps=fit.steps, report=report
            )
    summary = _summary(fit, found, known)
    if history is not None:
        summary["adam"] = history._asdict()
    write_json(
        out / "summary.json",
        {"settings": settings, **summary}
        | {"versions": versions(), "device": device(), "commit": commit()},
    )
    _draw(fit, found, [images for images, _ in looks], history, out)
    _tell(fit, found, known, summary)
    say(f"pictures and figures: {out} (start with comparison.png)")
    return summary


def _summary(fit: Fit, found: ImageFit, known: Determined) -> dict[str, Any]:
    told, names = fit.problem.told, fit.problem.names
    errors = told(known.standard_errors)
    numbers = {
        name: {
            "unit": number.unit,
            "step": number.step * number.told,
            "start": float(told(fit.starts[found.best])[k]),
            "fit": float(told(found.vector)[k]),
            "true": None if fit.truth is None else float(told(fit.truth)[k]),
            "standard_error": float(errors[k]) if np.isfinite(errors[k]) else None,
        }
        for k, (name, number) in enumerate(zip(names, fit.problem.numbers, strict=True))
    }
    rms = found.stages[-1].rms
    return {
        "numbers": numbers,
        "rms": rms,
        "left": rms / max(float(np.std(fit.targets)), 1e-12),
        "evaluations": found.evaluations,
        "seconds": sum(s.seconds for s in found.stages),
        "best_start": found.best,
        "ends": _ends(found, len(fit.starts)),
        "singular_values": known.singular.tolist(),
        "combinations": known.directions.tolist(),
        "sentences": sentences(known, names) + _valleys(fit, found),
        "stages": [s._asdict() for s in found.stages],
    }


def _ends(found: ImageFit, starts: int) -> list[float]:
    """Return what each start had left at its last stage."""
    return [[s.rms for s in found.stages if s.start == k][-1] for k in range(starts)]


def _valleys(fit: Fit, found: ImageFit) -> list[str]:
    """Say where a fit seems to have ended in a valley that is not the lowest."""
    rms, contrast = found.stages[-1].rms, float(np.std(fit.targets))
    if rms > max(_LEFT * contrast, 1.5 * fit.noise):
        return [
            f"left over: {rms / contrast:.1%} of the target's contrast (rms {rms:.3g}); the fit "
            "may have ended in a valley that is not the lowest; try more --starts"
        ]
    return []


def _tell(fit: Fit, found: ImageFit, known: Determined, summary: Mapping[str, Any]) -> None:
    header = ["number", "start", "fit", "true", "error", "standard error", "unit"]
    rows = []
    for name, row in summary["numbers"].items():
        true, spread = row["true"], row["standard_error"]
        error = "" if true is None else f"{row['fit'] - true:.3g}"
        rows.append(
            [
                name,
                f"{row['start']:.5g}",
                f"{row['fit']:.6g}",
                "" if true is None else f"{true:.6g}",
                error,
                "undetermined" if spread is None else f"{spread:.2g}",
                row["unit"],
            ]
        )
    say_table(fit.title, header, rows)
    noise = fit.noise or _NOISE
    say(f"standard errors: if each pixel has noise of {noise:g} of white, independent of others")
    values = " ".join(f"{value:.3g}" for value in known.singular)
    say(f"singular values (change of the images per step of each combination): {values}")
    for sentence in summary["sentences"]:
        say(sentence)
    if len(fit.starts) > 1:
        ends = ", ".join(f"{end:.2g}" for end in summary["ends"])
        say(f"starts ended at rms {ends}; the best was {found.best + 1} of {len(fit.starts)}")
    say(
        f"rms {summary['rms']:.3g}, {summary['evaluations']} evaluations of images and "
        f"derivatives, {summary['seconds']:.1f} s with compilation"
    )
    if "adam" in summary:
        history = summary["adam"]
        say(f"Adam: rms {min(history['rms']):.3g} after {len(history['rms'])} evaluations")


def _draw(
    fit: Fit, found: ImageFit, starts: Sequence[Images], history: History | None, out: Path
) -> None:
    first = starts[found.best]
    draw_images(out, fit.title, first, fit.targets, found.images)
    own = [s for s in found.stages if s.start == found.best]
    before = float(np.sqrt(np.mean((first - fit.targets) ** 2)))
    curves = {
        "Levenberg-Marquardt, blurred to sharp": Curve(
            [1, *(1 + np.cumsum([s.evaluations for s in own]))],
            [before, *(s.rms for s in own)],
        )
    }
    if history is not None:
        name = f"Adam, {history.rate:g} steps of the numbers"
        curves[name] = Curve(list(range(1, len(history.rms) + 1)), history.rms)
    draw_progress(out, fit.title, curves)


def draw_images(out: Path, title: str, start: Images, targets: Images, end: Images) -> None:
    """Write comparison.png: a row for each image."""
    scale = 1 / max(float(np.quantile(targets, 0.99)), 1e-6)
    gray = lambda image: shown(np.repeat(scale * np.asarray(image)[..., None], 3, axis=-1))
    rows = []
    for before, target, after in zip(start, targets, end, strict=True):
        largest = float(np.abs(before - target).max()) or 1e-6
        rows.append(
            [
                Panel("start", gray(before)),
                Panel("target", gray(target)),
                Panel("fit", gray(after)),
                Panel("start less target", np.abs(before - target), "linear radiance", largest),
                Panel("fit less target", np.abs(after - target), "linear radiance", largest),
            ]
        )
    save_panels(out / "comparison.png", rows, title=title)


def draw_progress(out: Path, title: str, curves: Mapping[str, Curve]) -> None:
    """Write progress_curve.png."""
    save_curves(
        out / "progress_curve.png",
        curves,
        label="root mean square of fit less target (linear radiance)",
        across="evaluations of images and derivatives",
        title=f"{title}: how the fit came down",
    )
