"""Pictures and charts of a bias fit; colors that survive color blindness and gray print."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import matplotlib.figure
import matplotlib.patches
import numpy as np
from jaxtyping import Bool, Float

from .files.images import atomic_path, linear_to_srgb

ACNE_COLOR = "#e69f00"  # light orange: truth lit, method dark
LEAK_COLOR = "#0072b2"  # dark blue: truth dark, method lit
_BACKGROUND = 0.85  # linear gray behind the scene, in pictures only
_ACNE = np.array([0.791, 0.347, 0.0])
_LEAK = np.array([0.0, 0.168, 0.445])
_SHARES = ("share of truth-lit pixels that are dark", "share of truth-dark pixels that are lit")

Image = Float[np.ndarray, "height width 3"]
Mask = Bool[np.ndarray, "height width"]


def on_background(color: Image, covered: Mask | Float[np.ndarray, "height width"]) -> Image:
    """Put a light gray behind what is covered, wholly or by a share."""
    behind = (1 - np.asarray(covered, np.float32))[..., None] * np.float32(_BACKGROUND)
    return np.where(np.asarray(covered)[..., None] > 0, color, np.float32(0)) + behind


def error_picture(
    color: Image, visibility: Float[np.ndarray, "height width"], truth: Mask, covered: Mask
) -> Image:
    """Return the image in pale gray with acne in orange and leaks in blue, linear RGB."""
    picture = _pale(color, covered)
    picture[covered & truth & (visibility <= 0.5)] = _ACNE
    picture[covered & ~truth & (visibility >= 0.5)] = _LEAK
    return picture.astype(np.float32)


def soft_error_picture(
    color: Image,
    visibility: Float[np.ndarray, "height width"],
    truth: Float[np.ndarray, "height width"],
    covered: Mask,
) -> Image:
    """Return the image in pale gray, the more orange or blue the more too dark or too light.

    The colors are full where visibility and truth differ by a quarter or more.
    """
    wrong = np.where(covered, visibility - truth, 0.0)[..., None]
    share = np.minimum(4 * np.abs(wrong), 1)
    picture = (1 - share) * _pale(color, covered) + share * np.where(wrong < 0, _ACNE, _LEAK)
    return picture.astype(np.float32)


def save_comparison(
    path: Path,
    panels: Mapping[str, Image],
    *,
    title: str,
    legend: tuple[str, str] = ("lit in truth, dark here", "dark in truth, lit here"),
) -> None:
    """Save pictures in rows of four, each under its title.

    Args:
        path: PNG file.
        panels: Linear RGB.
        title: Over all.
        legend: What acne and leak are in the error pictures.
    """
    rows = -(-len(panels) // 4)
    figure = matplotlib.figure.Figure(figsize=(16, 4.25 * rows + 0.7), layout="constrained")
    for index, (name, picture) in enumerate(panels.items()):
        axes = figure.add_subplot(rows, 4, index + 1)
        axes.imshow(linear_to_srgb(np.clip(picture, 0, 1)), interpolation="nearest")
        axes.set_title(name, fontsize=11)
        axes.set_axis_off()
    figure.suptitle(title, fontsize=13)
    figure.legend(
        handles=[
            _swatch(ACNE_COLOR, f"acne: {legend[0]}"),
            _swatch(LEAK_COLOR, f"leak: {legend[1]}"),
        ],
        loc="outside lower center",
        ncols=2,
        frameon=False,
    )
    _save(figure, path)


def save_curve(
    path: Path,
    *,
    scales: Float[np.ndarray, " points"],
    acne: Float[np.ndarray, " points"],
    leak: Float[np.ndarray, " points"],
    marks: Mapping[str, tuple[float, float]],
    title: str,
    shares: tuple[str, str] = _SHARES,
) -> None:
    """Save the acne-leak curve over a bias that grows, with marked biases on it.

    Args:
        path: PNG file.
        scales: Multiples of the fitted bias.
        acne: At each.
        leak: At each.
        marks: Acne and leak of the biases to mark.
        title: What the chart shows.
        shares: What acne and leak are, in words.
    """
    figure = matplotlib.figure.Figure(figsize=(7, 5.2), layout="constrained")
    axes = figure.add_subplot()
    curve = np.stack([100 * acne, 100 * leak], axis=1)
    axes.plot(*curve.T, color="0.45", lw=1.4, zorder=1, label="multiples of the fitted bias")
    last = np.full(2, np.inf)
    for scale in 2.0 ** np.arange(-3, 7):
        place = curve[np.argmin(np.abs(scales - scale))]
        if np.linalg.norm(np.log(place + 0.05) - np.log(last + 0.05)) < 0.3:
            continue  # its label would lie on the last one
        axes.plot(*place, marker=".", color="0.45", ms=6, zorder=1)
        axes.annotate(
            f"{scale:g}x",
            place,
            xytext=(7, 4),
            textcoords="offset points",
            color="0.35",
            fontsize=9,
        )
        last = place
    for (name, (x, y)), style in zip(marks.items(), _styles(), strict=False):
        axes.plot(100 * x, 100 * y, label=f"{name}: {x:.2%} acne, {y:.2%} leak", **style)
    axes.set_xscale("symlog", linthresh=0.05)
    axes.set_yscale("symlog", linthresh=0.05)
    ticks = [0, 0.05, 0.1, 0.5, 1, 5, 10, 50, 100]
    axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    axes.set_yticks(ticks, [f"{tick:g}" for tick in ticks])
    axes.minorticks_off()
    axes.set_xlim(-0.01, 110)
    axes.set_ylim(-0.01, 110)
    axes.set_xlabel(f"acne: {shares[0]} (%)")
    axes.set_ylabel(f"leak: {shares[1]} (%)")
    axes.grid(color="0.9")
    axes.legend(frameon=False, fontsize=9)
    axes.set_title(title, fontsize=11)
    _save(figure, path)


def save_error_curve(
    path: Path,
    *,
    values: Float[np.ndarray, " points"],
    errors: Float[np.ndarray, " points"],
    marks: Mapping[str, tuple[float, float]],
    own: float | None,
    labels: tuple[str, str],
    title: str,
) -> None:
    """Save the error over one number, with marked values.

    Args:
        path: PNG file.
        values: Of the number, sorted.
        errors: At each.
        marks: Value and error of those to mark.
        own: What the number stands for, where the scene has it.
        labels: Of the two axes.
        title: What the chart shows.
    """
    figure = matplotlib.figure.Figure(figsize=(7, 5.2), layout="constrained")
    axes = figure.add_subplot()
    axes.plot(values, errors, color="0.45", lw=1.4, zorder=1, label="sweep")
    if own is not None:
        axes.axvline(own, color="0.45", ls="--", lw=1, zorder=0, label=f"the light's own: {own:g}")
    for (name, (x, y)), style in zip(marks.items(), _styles(), strict=False):
        axes.plot(x, y, label=f"{name}: {x:.4g}, error {y:.4g}", **style)
    axes.set_ylim(bottom=0)
    axes.set_xlabel(labels[0])
    axes.set_ylabel(labels[1])
    axes.grid(color="0.9")
    axes.legend(frameon=False, fontsize=9)
    axes.set_title(title, fontsize=11)
    _save(figure, path)


def _styles() -> list[dict[str, Any]]:
    """Return the markers of what was before, after, and the best of a sweep."""
    shared = {"ls": "", "mec": "black"}
    return [
        {**shared, "marker": "o", "mfc": ACNE_COLOR, "ms": 9, "zorder": 2},
        {**shared, "marker": "*", "mfc": LEAK_COLOR, "ms": 17, "zorder": 2},
        {**shared, "marker": "D", "mfc": "none", "ms": 11, "zorder": 3},
    ]


def _pale(color: Image, covered: Mask) -> Image:
    """Return the image in pale gray."""
    gray = 0.6 + 0.35 * np.clip(color.mean(axis=-1, keepdims=True), 0, 1)
    return on_background(np.repeat(gray, 3, axis=-1), covered)


def _swatch(color: str, label: str) -> matplotlib.patches.Patch:
    return matplotlib.patches.Patch(color=color, label=label)


def _save(figure: matplotlib.figure.Figure, path: Path) -> None:
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=110)
