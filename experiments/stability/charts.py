"""The atlas as a heat map of verdicts, and what ranges of parameters do as curves."""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib.figure
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.patches import Patch, Rectangle

from ..files.images import atomic_path
from .cells import FINE, KNOWN, UNCONFIRMED, UNEXPECTED, VERDICTS, Cell

COLORS = {FINE: "#e4e4e4", KNOWN: "#56b4e9", UNCONFIRMED: "#f0e442", UNEXPECTED: "#d55e00"}
MARKS = {FINE: "", KNOWN: "k", UNCONFIRMED: "n", UNEXPECTED: "!"}
_LINES = ("#0072b2", "#e69f00", "#009e73", "#cc79a7", "#56b4e9", "#d55e00", "#000000")
_MARKERS = "osD^vP*"
_NAIVE = "(the row's naive way)"
Groups = dict[tuple[int, str], dict[str, list[Cell]]]
_MANY = 15  # techniques from which on a scene is a line of the matrix


def worst(cells: Sequence[Cell]) -> Cell:
    """Return the cell of the worst verdict, and of those the one with the largest value."""
    return max(cells, key=lambda cell: (VERDICTS.index(cell.verdict), cell.value))


def grouped(cells: Sequence[Cell]) -> Groups:
    """Return cells by row and scene, then by technique and, if there are several, metric."""
    found: Groups = {}
    for cell in sorted(cells, key=lambda cell: cell.row):
        of_scene = found.setdefault((cell.row, cell.scene), {})
        of_scene.setdefault(cell.technique, []).append(cell)
    return found


def matrix(groups: Groups) -> tuple[Groups, Groups, list[str]]:
    """Return the scenes of many techniques, all others, and the techniques of the former.

    The naive ways, each of one scene, share a column.
    """
    few = {key: cells for key, cells in groups.items() if len(cells) < _MANY}
    many: Groups = {key: {} for key, cells in groups.items() if len(cells) >= _MANY}
    uses = Counter(name for key in many for name in groups[key])
    for key, of_scene in many.items():
        for name, cells in groups[key].items():
            lone = "(" in name and uses[name] == 1 and len(many) > 1
            of_scene[_NAIVE if lone else name] = cells
    columns = list(dict.fromkeys(name for cells in many.values() for name in cells))
    return many, few, sorted(columns, key=lambda name: "(" in name)


def save_atlas(cells: Sequence[Cell], path: Path) -> None:
    """Write the heat map: scenes against techniques, the worse of both precisions.

    Args:
        cells: Of rows of the catalogue.
        path: Ends in .png or .pdf.
    """
    many, few, columns = matrix(grouped(cells))
    widest = max([len(columns), *(6 * len(of) for of in few.values())], default=1)
    lines = len(many) + len(few) + 2
    figure = matplotlib.figure.Figure(
        figsize=(3.0 + 0.235 * widest, 3.2 + 0.25 * lines), layout="constrained", dpi=130
    )
    FigureCanvasAgg(figure)
    heights = [len(lines) for lines in (many, few) if lines]
    places = figure.subplots(len(heights), 1, height_ratios=heights, squeeze=False)[:, 0]
    for place, count in zip(places, heights, strict=True):
        place.set(xlim=(0, widest), ylim=(count, 0))
        place.axis("off")
    if many:
        _draw_matrix(places[0], many, columns)
    if few:
        _draw_lists(places[-1], few, float(widest))
    figure.legend(
        handles=[Patch(color=COLORS[v], label=f"{MARKS[v] or 'blank'}: {v}") for v in VERDICTS],
        loc="outside lower center", ncols=4, frameon=False, fontsize=9,
    )  # fmt: skip
    figure.suptitle(
        "Known failures, row of the catalogue beside the scene, over all techniques; in "
        "parentheses naive ways that are not of the toolkit; white: not measured"
    )
    with atomic_path(path) as temporary:
        figure.savefig(temporary, format=path.suffix[1:])


def _draw_matrix(place: Any, many: Groups, columns: Sequence[str]) -> None:
    for column, technique in enumerate(columns):
        place.text(column + 0.5, -0.3, technique, rotation=90, ha="center", va="bottom", fontsize=7)
    for line, (key, of_scene) in enumerate(many.items()):
        _name(place, line, key)
        for column, technique in enumerate(columns):
            if technique in of_scene:
                _box(place, float(column), line, 1.0, worst(of_scene[technique]))


def _draw_lists(place: Any, few: Groups, widest: float) -> None:
    wide = widest / max(len(of_scene) for of_scene in few.values())
    for line, (key, of_scene) in enumerate(few.items()):
        _name(place, line, key)
        for column, (technique, some) in enumerate(of_scene.items()):
            _box(place, column * wide, line, wide, worst(some), technique)


def _name(place: Any, line: int, key: tuple[int, str]) -> None:
    place.text(-0.4, line + 0.5, f"{key[1]}  {key[0]}", ha="right", va="center", fontsize=8)


def _box(axes: Any, left: float, top: int, width: float, cell: Cell, text: str = "") -> None:
    verdict = cell.verdict
    axes.add_patch(
        Rectangle((left, top), width, 1, facecolor=COLORS[verdict], edgecolor="white", linewidth=1)
    )
    mark = MARKS[verdict]
    label = f"{text}  {mark}".strip() if text else mark
    color = "white" if verdict == UNEXPECTED else "black"
    axes.text(
        left + width / 2, top + 0.53, label, ha="center", va="center", color=color,
        fontsize=6.5 if text else 7, fontweight="bold" if verdict == UNEXPECTED else "normal",
        clip_on=True,
    )  # fmt: skip


def save_ranges(cells: Sequence[Cell], path: Path) -> None:
    """Write a panel of curves for each parameter and scene, in single precision.

    Args:
        cells: Of ranges of parameters.
        path: Ends in .png or .pdf.
    """
    single = [cell for cell in cells if cell.dtype == "float32"] or list(cells)
    panels = list(dict.fromkeys((cell.parameter, cell.scene, cell.metric) for cell in single))
    columns = min(4, len(panels))
    lines = -(-len(panels) // columns)
    figure = matplotlib.figure.Figure(
        figsize=(4.0 * columns, 3.3 * lines), layout="constrained", dpi=120
    )
    FigureCanvasAgg(figure)
    axes = figure.subplots(lines, columns, squeeze=False).ravel()
    for place, panel in zip(axes, panels, strict=False):
        mine = [c for c in single if (c.parameter, c.scene, c.metric) == panel]
        settings = sorted({cell.setting for cell in mine})
        even = settings[0] == 0 or settings[-1] <= 100 * settings[0]
        steps = settings[0] == 0 and len(settings) > 6  # on no scale would they all be seen
        for k, technique in enumerate(dict.fromkeys(cell.technique for cell in mine)):
            some = [cell for cell in mine if cell.technique == technique]
            place.plot(
                [settings.index(cell.setting) if steps else cell.setting for cell in some],
                [cell.value for cell in some],
                color=_LINES[k % len(_LINES)], marker=_MARKERS[k % len(_MARKERS)],
                markersize=5 + 0.8 * (len(_MARKERS) - k), markerfacecolor="none", linewidth=1,
                label=technique,
            )  # fmt: skip
        place.axhline(mine[0].limit, color="0.5", linewidth=1, linestyle="--")
        if not even:
            place.set_xscale("log")
        elif steps:
            place.set_xticks(range(len(settings)), [f"{setting:g}" for setting in settings])
        place.set_ylim(
            0 - 0.05 * place.get_ylim()[1], max(place.get_ylim()[1], 1.4 * mine[0].limit)
        )
        place.set_title(panel[1], fontsize=10)
        place.set_xlabel(panel[0])
        place.set_ylabel(panel[2])
        place.grid(color="0.92")
        place.spines[["top", "right"]].set_visible(False)
        place.legend(fontsize=7, frameon=False)
    for place in axes[len(panels) :]:
        place.axis("off")
    figure.suptitle("Ranges of parameters; above the dashed line a technique fails")
    with atomic_path(path) as temporary:
        figure.savefig(temporary, format=path.suffix[1:])
