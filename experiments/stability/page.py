"""The atlas as one page of HTML that needs nothing else."""

from collections import Counter
from collections.abc import Sequence
from html import escape
from pathlib import Path

from ..files.images import atomic_path
from ..scenes.failure_scenes import FAILURES
from .atlas import ABSENT, MISSING
from .cells import UNEXPECTED, VERDICTS, Cell
from .charts import COLORS, MARKS, grouped, matrix, worst

_STYLE = """
body { font: 14px/1.4 system-ui, sans-serif; margin: 2em; color: #222 }
h2 { margin-top: 2em } table { border-collapse: collapse } .wide { overflow-x: auto }
td, th { padding: 2px 6px; border: 1px solid #fff; text-align: center; font-size: 12px }
th.name, td.name { text-align: left; white-space: nowrap; font-weight: normal }
th.turned { vertical-align: bottom; font-weight: normal }
th.turned span { writing-mode: vertical-rl; transform: rotate(180deg); white-space: nowrap }
td.cell { min-width: 3.4em; white-space: nowrap; cursor: help }
.key span { padding: 2px 8px; margin-right: 1em }
tbody tr:hover td.name { background: #eee }
"""


def save_page(rows: Sequence[Cell], ranges: Sequence[Cell], path: Path) -> None:
    """Write the tables of rows and of ranges.

    Args:
        rows: Cells of rows of the catalogue.
        ranges: Cells in which a parameter varies.
        path: Of the page.
    """
    many, few, columns = matrix(grouped(rows))
    counts = Counter(cell.verdict for cell in [*rows, *ranges])
    key = "".join(
        f'<span style="{_paint(v)}">{MARKS[v] or "blank"}: {v}, {counts[v]}</span>'
        for v in VERDICTS
    )
    parts = [
        "<!doctype html><html lang=en><meta charset=utf-8><title>Stability</title>",
        f"<style>{_STYLE}</style><h1>Known failures over all techniques</h1>",
        "<p>A line is a scene of the failure catalogue with the number of its row. A cell holds "
        "the metric's value in the worse of both precisions; point at it for the rest. In "
        "parentheses stand naive ways that are not of the toolkit.</p>",
        f"<p class=key>{key}</p><div class=wide><table><thead><tr><th class=name>row, scene, "
        "metric</th>",
        *(f"<th class=turned><span>{escape(name)}</span></th>" for name in columns),
        "</tr></thead><tbody>",
        *(_line(scene, cells, columns) for scene, cells in many.items()),
        "</tbody></table></div><h2>Rows of few techniques</h2>",
        *(_short(scene, cells) for scene, cells in few.items()),
        "<h2>Ranges of parameters</h2>",
        *_ranges(ranges),
        "<h2>Not in the toolkit</h2><ul>",
        *(f"<li>row {row}: {escape(why)}</li>" for row, why in (ABSENT | MISSING).items()),
        "</ul></html>",
    ]
    with atomic_path(path) as temporary:
        temporary.write_text("\n".join(parts) + "\n", "utf-8")


def _line(scene: tuple[int, str], cells: dict[str, list[Cell]], columns: Sequence[str]) -> str:
    metric = next(iter(cells.values()))[0].metric
    fails = FAILURES[scene[1]].fails if scene[1] in FAILURES else ""
    label = escape(f"{scene[0]} {scene[1]}, {metric}")
    name = f'<td class=name title="{escape(fails)}">{label}</td>'
    found = (_cell(cells[column]) if column in cells else "<td></td>" for column in columns)
    return f"<tr>{name}{''.join(found)}</tr>"


def _short(scene: tuple[int, str], cells: dict[str, list[Cell]]) -> str:
    fails = FAILURES[scene[1]].fails if scene[1] in FAILURES else ""
    metrics = " and ".join(dict.fromkeys(cell.metric for some in cells.values() for cell in some))
    name = f"{scene[0]} <b>{escape(scene[1])}</b>, {escape(metrics)}"
    title = f"<p>{name}{'; ' if fails else ''}{escape(fails)}</p><table><tr>"
    heads = "".join(f"<th>{escape(name)}</th>" for name in cells)
    return f"{title}{heads}</tr><tr>{''.join(map(_cell, cells.values()))}</tr></table>"


def _ranges(cells: Sequence[Cell]) -> list[str]:
    parts = []
    tables: dict[tuple[str, str, str], list[Cell]] = {}
    for cell in cells:
        tables.setdefault((cell.parameter, cell.scene, cell.metric), []).append(cell)
    for (parameter, scene, metric), mine in tables.items():
        settings = sorted({cell.setting for cell in mine})
        heads = "".join(f"<th>{setting:g}</th>" for setting in settings)
        parts.append(f"<p><b>{parameter}</b>, {scene}, {metric}</p><table>")
        parts.append(f"<tr><th></th>{heads}</tr>")
        for technique in dict.fromkeys(cell.technique for cell in mine):
            at = [[c for c in mine if (c.technique, c.setting) == (technique, s)] for s in settings]
            found = "".join(_cell(some) if some else "<td></td>" for some in at)
            parts.append(f"<tr><td class=name>{escape(technique)}</td>{found}</tr>")
        parts.append("</table>")
    return parts


def _cell(cells: Sequence[Cell]) -> str:
    shown = worst(cells)
    text = "&#10;&#10;".join(_tip(cell) for cell in cells)
    label = f"{_figure(shown.value)} {MARKS[shown.verdict]}".strip()
    return f'<td class=cell style="{_paint(shown.verdict)}" title="{text}">{label}</td>'


def _figure(value: float) -> str:
    return "&lt;.001" if 0 < abs(value) < 1e-3 else f"{value:.2g}"


def _tip(cell: Cell) -> str:
    parts = [
        f"{cell.technique}, {cell.dtype}: {cell.verdict}",
        f"{cell.metric} {cell.value:.4g}, limit {cell.limit:g}",
    ]
    if cell.predicted == cell.predicted:
        parts.append(f"catalogue: {cell.predicted:.3g}")
    if cell.values_not_finite or cell.slopes_not_finite:
        counts = f"{cell.values_not_finite} values, {cell.slopes_not_finite} derivatives"
        parts.append(f"not finite: {counts}")
    parts += [text for text in (cell.said, cell.may, cell.note) if text]
    return "&#10;".join(escape(part) for part in parts)


def _paint(verdict: str) -> str:
    color = "; color: #fff" if verdict == UNEXPECTED else ""
    return f"background: {COLORS[verdict]}{color}"
