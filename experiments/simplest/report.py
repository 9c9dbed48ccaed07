"""What is written and shown about the least model: simplest.json, comparison.png, a table."""

import shlex
from collections import Counter
from pathlib import Path
from typing import Any

import matplotlib.figure
import numpy as np
from jaxtyping import Float
from matplotlib.backends.backend_agg import FigureCanvasAgg

from ..console import say, say_table
from ..files.images import atomic_path
from .choice import choose
from .find import Simplest
from .search import Tried
from .sight import Picture, shown

_BACKGROUND = 0.93  # as shown, where there is no surface
_UNITS = {
    "rmse": "RMSE of the shown picture",
    "flip": "mean FLIP",
    "error": "share of pixels off by more than a tenth",
}


def content(found: Simplest, scene: str, image_size: int) -> dict[str, Any]:
    """Return what simplest.json holds.

    Args:
        found: The least model.
        scene: As ``render`` takes it.
        image_size: Pixels on each side.
    """
    words = [scene, "--image-size", str(image_size), str(image_size)]
    words += found.choice.arguments(found.sight.looks)
    command = shlex.join(["python", "-m", "experiments", "render", *words, "--out", "image.exr"])
    return {
        "scene": scene,
        "measure": found.measure,
        "tolerance": found.tolerance,
        "image_size": image_size,
        "choice": _model(found.model.name, found.error, found.cost)
        | found.model._asdict()
        | {"stages_ms": {" ".join(stage): ms for stage, ms in found.stages_ms.items()}},
        "render": words,
        "command": command,
        "next_simpler_failed": _other(found.failed),
        "going_further": _other(found.further),
        "tried": [_other(tried) for tried in found.tried],
        "skipped": [{"model": m.name, "because": why} for m, why in found.skipped.items()],
        "models": len(found.tried) + len(found.skipped),
    }


def print_result(found: Simplest) -> None:
    """Print what was tried, what was skipped and why, and what was chosen."""
    rows = sorted(found.tried, key=lambda tried: tried.cost)
    say_table(
        f"tried, cheapest first ({_UNITS[found.measure]}; tolerance {found.tolerance:g})",
        ["model", "ms", "error", "expected", "meets it"],
        [
            [
                t.model.name, f"{t.cost:.2f}", f"{t.error:.4f}", f"{t.expected:.4f}",
                "chosen" if t.model == found.model
                else "yes" if t.error <= found.tolerance else "no",
            ]
            for t in rows
        ],
    )  # fmt: skip
    reasons = Counter(found.skipped.values())
    say_table(
        f"skipped: {sum(reasons.values())} of {len(found.tried) + len(found.skipped)} models",
        ["because", "models"],
        [[why, str(count)] for why, count in reasons.most_common()],
    )
    say(f"least model: {found.model.name}, error {found.error:.4g}, {found.cost:.3g} ms")
    failed, further = found.failed, found.further
    if failed is not None:
        by = f"{failed.error / found.tolerance:.3g} times" if found.tolerance else "infinitely"
        say(f"next simpler: {failed.model.name}, {failed.cost:.3g} ms, misses: {by} the tolerance")
    if further is not None:
        more = f"{further.cost / found.cost:.3g} times the time for an error of {further.error:.4g}"
        say(f"going further: {further.model.name}, {more}")


def save_comparison(found: Simplest, image_size: int, path: Path) -> None:
    """Save truth, the choice and the next simpler model, and where they are wrong.

    Args:
        found: The least model.
        image_size: Pixels on each side.
        path: PNG file.
    """
    sight = found.sight
    models = [("chosen", found.model, found.error, found.cost)]
    if found.failed is not None:
        failed = found.failed
        models.append(("next simpler, misses", failed.model, failed.error, failed.cost))
    pictures, differences = [("truth", sight.truth)], []
    for role, model, error, cost in models:
        choice = choose(model, sight, found.slope)
        picture = shown(np.asarray(choice.render(sight.scene, image_size).color))
        pictures.append((f"{role}:\n{model.name}\n{error:.4f}, {cost:.1f} ms", picture))
        differences.append(_signed(picture - sight.truth, sight.covered))
    figure = matplotlib.figure.Figure(
        figsize=(4.4 * len(pictures), 9.8), layout="constrained", dpi=110
    )
    FigureCanvasAgg(figure)
    axes = figure.subplots(2, len(pictures), squeeze=False)
    for place, (title, picture) in zip(axes[0], pictures, strict=True):
        on_gray = np.where(sight.covered[..., None], picture, _BACKGROUND)
        place.imshow(np.clip(on_gray, 0, 1), interpolation="nearest")
        place.set_title(title, fontsize=10)
        place.set_axis_off()
    _draw_tried(found, axes[1, 0])
    most = max(0.02, float(np.quantile(np.abs(differences), 0.999)))
    for place, difference in zip(axes[1, 1:], differences, strict=True):
        drawn = place.imshow(
            difference, cmap="PuOr_r", vmin=-most, vmax=most, interpolation="nearest"
        )
        place.set_axis_off()
        label = "shown less true: too dark < 0 < too light"
        figure.colorbar(drawn, ax=place, location="bottom", label=label, shrink=0.8)
    figure.suptitle(
        f"{sight.scene.name}: the least model with {_UNITS[found.measure]} of at most "
        f"{found.tolerance:g}"
    )
    with atomic_path(path) as temporary:
        figure.savefig(temporary, format="png")


def _draw_tried(found: Simplest, place: Any) -> None:
    """Draw the error of what was tried against its time."""
    least = min((t.error for t in found.tried if t.error > 0), default=1.0)
    for label, color, marker, size, chosen in (
        ("misses", "#d55e00", "x", 40, lambda t: t.error > found.tolerance),
        ("meets it", "#0072b2", "o", 40, lambda t: t.error <= found.tolerance),
        ("chosen", "#000000", "*", 160, lambda t: t.model == found.model),
    ):
        some = [t for t in found.tried if chosen(t)]
        errors = [max(t.error, 0.3 * least) for t in some]
        place.scatter(
            [t.cost for t in some], errors, s=size, color=color, marker=marker, label=label
        )
    if found.tolerance > 0:
        place.axhline(found.tolerance, color="0.4", linestyle="--", linewidth=1, label="tolerance")
    place.set(xscale="log", yscale="log", title="tried", xlabel="time, ms")
    place.set_ylabel(_UNITS[found.measure])
    place.grid(True, which="both", color="0.92")
    place.set_axisbelow(True)
    place.legend(frameon=False)
    place.spines[["top", "right"]].set_visible(False)


def _signed(difference: Picture, covered: np.ndarray) -> Float[np.ndarray, "height width"]:
    """Return the difference of the channel that differs most, where there is a surface."""
    chosen = np.argmax(np.abs(difference), axis=-1)[..., None]
    return np.where(covered, np.take_along_axis(difference, chosen, axis=-1)[..., 0], 0)


def _model(name: str, error: float, cost: float) -> dict[str, Any]:
    return {"name": name, "error": error, "ms": cost}


def _other(tried: Tried | None) -> dict[str, Any] | None:
    if tried is None:
        return None
    return _model(tried.model.name, tried.error, tried.cost) | {"expected_error": tried.expected}
