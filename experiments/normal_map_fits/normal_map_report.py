"""What a fit of a normal map leaves in its folder, and what it says."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from ..console import say, say_table
from ..files.images import write_exr
from ..files.map_files import write_normal_map
from ..panels import Curve, Panel, save_curves, save_panels, shown
from .normal_map_evidence import ENOUGH_LIGHTS, Evidence
from .normal_map_study import MapStudy, errors_of, texels_of
from .normal_map_task import Task, Unknowns


def write_results(
    out: Path,
    study: MapStudy,
    task: Task,
    ends: tuple[Unknowns, Unknowns],
    evidence: Evidence,
    history: Sequence[Mapping[str, int | float]],
) -> None:
    """Write the map, how well each texel is known, and the pictures."""
    start, unknowns = ends
    texels = texels_of(unknowns.slopes)
    write_normal_map(out / "normal_map.exr", texels)
    write_normal_map(out / "normal_map.png", texels)
    error = np.where(np.isfinite(evidence.standard_error), evidence.standard_error, 180.0)
    write_exr(
        out / "evidence.exr",
        {
            "seen.Y": evidence.seen.astype(np.float32),
            "lights.Y": evidence.lights.astype(np.float32),
            "standard_error.Y": error.astype(np.float32),
        },
    )
    maps = [
        Panel("start", texels_of(start.slopes)),
        Panel("fitted map", texels),
        Panel("lights that tell of the texel", evidence.lights.astype(float), "lights"),
    ]
    if study.truth is not None:
        errors = np.where(evidence.seen, errors_of(study, unknowns.slopes), np.nan)
        mean = np.nanmean(errors[evidence.known]) if evidence.known.any() else np.nan
        largest = float(np.nanquantile(errors, 0.999)) or 1e-6
        maps[2:2] = [Panel("true map", np.asarray(0.5 * study.truth + 0.5))]
        maps.append(Panel(f"error, mean {mean:.2g} degrees", errors, "degrees", largest))
    else:
        maps.append(Panel("standard error", evidence.standard_error, "degrees"))
    first = study.images[0]
    exposure = 1 / max(float(np.quantile(first, 0.99)), 1e-6)
    before, after = (_image(study, task, u) for u in ends)
    difference = np.abs(after - first).mean(axis=-1)
    images = [
        Panel("flat map, light 1", shown(exposure * before)),
        Panel("fitted map, light 1", shown(exposure * after)),
        Panel("target, light 1", shown(exposure * first)),
        Panel("target, last light", shown(exposure * study.images[-1])),
        Panel("difference, light 1", difference, "linear radiance"),
    ]
    save_panels(
        out / "comparison.png",
        [maps, images],
        title=f"{study.scene.name}: normal map from {len(study.lights)} images",
    )
    if "mean_error" in history[0]:
        label, key = "mean error of the map (degrees)", "mean_error"
    else:
        label, key = "half the sum of squares (linear radiance squared)", "loss"
    curve = Curve([row["seconds"] for row in history], [row[key] for row in history])
    save_curves(
        out / "progress_curve.png",
        {"LBFGS": curve},
        label=label,
        title=f"{study.scene.name}: how the fit came down",
    )


def tell(study: MapStudy, summary: Mapping[str, Any], seconds: Mapping[str, float]) -> None:
    """Say the figures, and what the images cannot tell."""
    rows = [
        [k, f"{count}", f"{count / summary['texels']:.1%}"]
        for k, count in summary["lights"].items()
        if count
    ]
    say_table(study.scene.name, ["lights that tell of a texel", "texels", "share"], rows)
    for name in ("known", "seen"):
        error = summary.get(f"error_degrees_{name}")
        if error is not None and error["mean"] is not None:
            words = f"under {ENOUGH_LIGHTS} lights or more" if name == "known" else "seen at all"
            say(f"texels {words}: mean error {error['mean']:.4f}, max {error['max']:.3f} degrees")
    if summary["standard_error_degrees"] is not None:
        say(f"standard error of a known texel: {summary['standard_error_degrees']:.4f} degrees")
    for name, value in summary["numbers"].items():
        say(f"{name}: {_words(value['start'])} -> {_words(value['fit'])}")
    unseen = summary["texels"] - summary["seen"]
    if unseen:
        say(f"unseen: {unseen} texels that no pixel shows keep their start")
    unclear = summary["seen"] - summary["known"]
    if unclear:
        say(
            f"undetermined: {unclear} texels are told of by fewer than {ENOUGH_LIGHTS} lights; "
            "two leave pairs of normals that explain both colors, one a curve of them"
        )
    for sentence in summary["undetermined"]:
        say(f"undetermined: {sentence}")
    if not summary["converged"]:
        say("not converged: the solver stopped before its tolerance")
    say(
        f"{summary['steps']} solver steps, {seconds['fit']:.1f} s, "
        f"and {seconds['compile']:.1f} s of compilation"
    )


def _image(study: MapStudy, task: Task, unknowns: Unknowns) -> Float[np.ndarray, "height width 3"]:
    """Return the picture of the mapped pixels under the first light; the rest as in the target."""
    residuals = jax.jit(Task.residuals)(task, unknowns)[:3]
    image = study.images[0].copy()
    image[study.seen.inside] += np.stack([np.asarray(r) for r in residuals], axis=-1)
    return image


def _words(value: float | list) -> str:
    return " ".join(f"{number:.4g}" for number in np.atleast_1d(value))
