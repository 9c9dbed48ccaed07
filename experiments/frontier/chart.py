"""The chart: error against time, a panel for each scene, the Pareto front drawn."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib.figure
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg

from ..files.images import atomic_path

ERRORS = ("rmse", "error", "flip")
_COLORS = ("#0072b2", "#e69f00", "#009e73", "#cc79a7", "#56b4e9", "#d55e00", "#000000", "#999933")
_MARKERS = "osD^vP*X<>ph"  # those of one color unlike each other
_COLUMNS = 3


def front(rows: Sequence[Mapping[str, Any]], error: str) -> list[Mapping[str, Any]]:
    """Return the rows than which no other is as fast and closer, or as close and faster."""
    best: list[Mapping[str, Any]] = []
    for row in sorted(rows, key=lambda row: (row["total_ms"], row[error])):
        if not best or row[error] < best[-1][error]:
            best.append(row)
    return best


def save_chart(rows: Sequence[Mapping[str, Any]], path: Path, *, error: str = "rmse") -> None:
    """Write the chart as PNG or PDF.

    Args:
        rows: Of ``frontier``'s table.
        path: Ends in .png or .pdf.
        error: Which column is drawn upwards.
    """
    scenes = list(dict.fromkeys(row["scene"] for row in rows))
    families = list(dict.fromkeys(row["technique"] for row in rows))
    columns = min(_COLUMNS, len(scenes) + 1)
    lines = -(-(len(scenes) + 1) // columns)  # one panel is the legend
    figure = matplotlib.figure.Figure(
        figsize=(4.2 * columns, 3.4 * lines), layout="constrained", dpi=110
    )
    FigureCanvasAgg(figure)
    axes = figure.subplots(lines, columns, squeeze=False).ravel()
    for place, scene in zip(axes, scenes, strict=False):
        of_scene = [row for row in rows if row["scene"] == scene]
        for k, family in enumerate(families):
            mine = [row for row in of_scene if row["technique"] == family]
            place.scatter(
                [row["total_ms"] for row in mine],
                [row[error] for row in mine],
                s=[12 + 22 * np.log2(row["map_size"] / 128) for row in mine],
                color=_COLORS[k % len(_COLORS)], marker=_MARKERS[k % len(_MARKERS)],
                alpha=0.85, linewidths=0.4, edgecolors="white", label=family,
            )  # fmt: skip
        best = front(of_scene, error)
        place.plot(
            [row["total_ms"] for row in best],
            [row[error] for row in best],
            color="0.35", linewidth=1, zorder=0, label="none faster and closer",
        )  # fmt: skip
        place.set(xscale="log", yscale="log", title=scene)
        place.grid(True, which="both", color="0.92")
        place.spines[["top", "right"]].set_visible(False)
        place.set_xlabel("light pass, preparation and image, ms")
        place.set_ylabel(_label(error))
    for place in axes[len(scenes) :]:
        place.axis("off")
    handles, labels = axes[0].get_legend_handles_labels()
    axes[len(scenes)].legend(handles, labels, loc="center", frameon=False, ncols=2)
    figure.suptitle(
        "Shadow filters: error against time, each at its best bias; larger marks are larger maps"
    )
    with atomic_path(path) as temporary:
        figure.savefig(temporary, format=path.suffix[1:])


def _label(error: str) -> str:
    return {
        "rmse": "RMSE of visibility",
        "error": "share of wrong pixels",
        "flip": "mean FLIP of the picture",
    }[error]
