"""The chart: error against time, a panel for each scene, the Pareto front drawn."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib.figure
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.ticker import LogLocator, NullFormatter

from ..files.images import atomic_path

ERRORS = ("rmse", "error", "flip")
COLORS = ("#0072b2", "#e69f00", "#009e73", "#cc79a7", "#56b4e9", "#d55e00", "#000000", "#999933")
_MARKERS = "osD^vP*X<>ph"  # those of one color unlike each other
_COLUMNS = 3
_PLAIN_SIZE = 40  # of marks without a map

Row = Mapping[str, Any]


class _Panel(NamedTuple):
    title: str
    cost: str
    error: str
    rows: Sequence[Row]


def front(rows: Sequence[Row], error: str, *, cost: str = "total_ms") -> list[Row]:
    """Return the rows than which no other is as cheap and closer, or as close and cheaper.

    Args:
        rows: Of one scene; those without the cost or the error do not count.
        error: Column.
        cost: Column.
    """
    best: list[Row] = []
    known = [row for row in rows if row.get(error) is not None and row.get(cost) is not None]
    for row in sorted(known, key=lambda row: (row[cost], row[error])):
        if not best or row[error] < best[-1][error]:
            best.append(row)
    return best


def save_chart(rows: Sequence[Row], path: Path, *, error: str = "rmse") -> None:
    """Write the chart as PNG or PDF.

    Args:
        rows: Of ``frontier``'s table.
        path: Ends in .png or .pdf.
        error: Which column is drawn upwards; an error of 0 is drawn at the bottom.
    """
    panels = list(_panels(rows, error))
    families = list(dict.fromkeys((row["kind"], row["technique"]) for row in rows))
    columns = min(_COLUMNS, len(panels) + 1)
    lines = -(-(len(panels) + 1) // columns)  # one place is the legend's
    figure = matplotlib.figure.Figure(
        figsize=(4.2 * columns, 3.4 * lines), layout="constrained", dpi=110
    )
    FigureCanvasAgg(figure)
    axes = figure.subplots(lines, columns, squeeze=False).ravel()
    marks: dict[str, Any] = {}
    for place, panel in zip(axes, panels, strict=False):
        marks |= _draw(place, panel, error, families)
    for place in axes[len(panels) :]:
        place.axis("off")
    order = [technique for _, technique in families if technique in marks]
    order += [name for name in marks if name not in order]
    axes[len(panels)].legend(
        [marks[name] for name in order], order, loc="center", frameon=False, ncols=2
    )
    figure.suptitle(
        "Error against time: shadow filters each at its best bias; larger marks are larger maps"
    )
    with atomic_path(path) as temporary:
        figure.savefig(temporary, format=path.suffix[1:])


def _panels(rows: Sequence[Row], error: str) -> Sequence[_Panel]:
    """Return what each panel shows: a scene's shadows, or how its normal map is lit."""
    found = []
    for scene in dict.fromkeys(row["scene"] for row in rows):
        of_scene = [row for row in rows if row["scene"] == scene and row[error] is not None]
        shadows = [row for row in of_scene if row["kind"] != "shading"]
        lit = [row for row in of_scene if row["kind"] == "shading"]
        if shadows:
            cost = "light pass, preparation and image, ms"
            found.append(_Panel(scene, cost, _label(error), shadows))
        if lit:
            of_color = "RMSE of color" if error == "rmse" else _label(error)
            found.append(_Panel(f"{scene}: its normal map", "lighting, ms", of_color, lit))
    return found


def _draw(
    place: Any, panel: _Panel, error: str, families: Sequence[tuple[str, str]]
) -> dict[str, Any]:
    """Draw a panel; return what stands for each family in the legend."""
    positive = [row[error] for row in panel.rows if row[error] > 0]
    floor = 0.6 * min(positive, default=1.0)
    marks = {}
    for k, (kind, technique) in enumerate(families):
        mine = [row for row in panel.rows if (row["kind"], row["technique"]) == (kind, technique)]
        color = COLORS[k % len(COLORS)]
        if mine:
            marks[technique] = place.scatter(
                [row["total_ms"] for row in mine],
                [max(row[error], floor) for row in mine],
                s=[_size(row["map_size"]) for row in mine],
                marker=_MARKERS[k % len(_MARKERS)],
                facecolors="white" if kind == "peer" else color,
                edgecolors=color if kind == "peer" else "white",
                linewidths=1.2 if kind == "peer" else 0.4, alpha=0.85,
            )  # fmt: skip
    best = front(panel.rows, error)
    (marks["none faster and closer"],) = place.plot(
        [row["total_ms"] for row in best],
        [max(row[error], floor) for row in best],
        color="0.35", linewidth=1, zorder=0,
    )  # fmt: skip
    place.set(xscale="log", yscale="log", title=panel.title)
    if len(positive) < len(panel.rows):
        place.axhline(floor, color="0.75", linestyle=":", linewidth=1, zorder=0)
        place.annotate("0", (1.01, floor), xycoords=("axes fraction", "data"), va="center")
    place.grid(True, which="both", color="0.92")
    place.spines[["top", "right"]].set_visible(False)
    for axis in (place.xaxis, place.yaxis):
        axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter(NullFormatter())
    place.set_xlabel(panel.cost)
    place.set_ylabel(panel.error)
    return marks


def _size(map_size: int | None) -> float:
    return _PLAIN_SIZE if map_size is None else 12 + 22 * np.log2(map_size / 128)


def _label(error: str) -> str:
    return {
        "rmse": "RMSE of visibility",
        "error": "share of wrong pixels",
        "flip": "mean FLIP of the picture",
    }[error]
