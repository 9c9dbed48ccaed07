"""Pictures and charts in panels; colors that survive color blindness and print."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import matplotlib.axes
import matplotlib.figure
import numpy as np
from jaxtyping import Float

from .files.images import atomic_path, linear_to_srgb

COLORS = ("#0072b2", "#e69f00", "#009e73", "#cc79a7", "#56b4e9", "#d55e00", "#000000")
_ERROR_MAP = "viridis"

Grid = Float[np.ndarray, "height width"]
Rgb = Float[np.ndarray, "height width 3"]


class Panel(NamedTuple):
    """A picture with its title.

    Attributes:
        title: Says what it shows.
        values: Raw RGB in [0, 1] to show as it is, or numbers for a color scale.
        unit: Of the numbers.
        largest: Upper end of the scale; None for the largest finite number.
    """

    title: str
    values: Rgb | Grid
    unit: str = ""
    largest: float | None = None


def shown(color: Rgb) -> Rgb:
    """Return linear radiance as a screen shows it."""
    return linear_to_srgb(np.clip(color, 0, 1))


def save_panels(path: Path, rows: Sequence[Sequence[Panel]], *, title: str) -> None:
    """Save rows of pictures on one page; numbers have a color scale with their unit."""
    columns = max(len(row) for row in rows)
    size = (4.1 * columns, 3.9 * len(rows) + 0.5)
    figure = matplotlib.figure.Figure(figsize=size, layout="constrained")
    axes = figure.subplots(len(rows), columns, squeeze=False)
    for place in axes.flat:
        place.set_axis_off()
    for row, places in zip(rows, axes, strict=True):
        for panel, place in zip(row, places, strict=False):
            _draw(figure, place, panel)
    figure.suptitle(title, fontsize=13)
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=100)


class Curve(NamedTuple):
    """How a solver came down.

    Attributes:
        seconds: Run time, without compilation; or what ``save_curves`` is told.
        errors: At each; mean error in degrees, or what ``save_curves`` is told.
    """

    seconds: Sequence[float]
    errors: Sequence[float]


def save_curves(
    path: Path,
    curves: Mapping[str, Curve],
    *,
    label: str,
    title: str,
    across: str = "run time without compilation (s)",
) -> None:
    """Save error against seconds, one line for each solver, on a logarithmic scale."""
    figure = matplotlib.figure.Figure(figsize=(7.5, 5), layout="constrained")
    axes = figure.add_subplot()
    markers = "osD^vXP"
    for k, (name, curve) in enumerate(curves.items()):
        axes.plot(
            curve.seconds,
            curve.errors,
            color=COLORS[k % len(COLORS)],
            marker=markers[k % len(markers)],
            ms=4,
            lw=1.5,
            label=name,
        )
    axes.set_yscale("log")
    axes.set_xlabel(across)
    axes.set_ylabel(label)
    axes.grid(color="0.9")
    axes.legend(frameon=False)
    axes.set_title(title, fontsize=11)
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=110)


def _draw(figure: matplotlib.figure.Figure, axes: matplotlib.axes.Axes, panel: Panel) -> None:
    axes.set_title(panel.title, fontsize=10)
    if panel.values.ndim == 3:
        axes.imshow(np.clip(panel.values, 0, 1), interpolation="nearest")
        return
    finite = panel.values[np.isfinite(panel.values)]
    largest = panel.largest
    if largest is None:
        largest = float(finite.max(initial=0.0)) or 1.0
    picture = axes.imshow(panel.values, cmap=_ERROR_MAP, vmin=0, vmax=largest)
    bar = figure.colorbar(picture, ax=axes, shrink=0.85)
    bar.set_label(panel.unit)
