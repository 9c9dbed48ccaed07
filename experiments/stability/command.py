"""The command ``stability``: the failure catalogue run over all techniques."""

import json
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any

import jax
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import tyro

from ..checks import check_folder, make_folder
from ..console import say, say_table, stage
from ..files.images import atomic_path
from ..frontier.store import Key, Store
from ..options import hint
from ..provenance import commit, device, versions
from ..scenes import SHADOW_SCENES
from .atlas import ABSENT, MISSING, TASKS, Task
from .cells import UNCONFIRMED, UNEXPECTED, VERDICTS, Cell
from .charts import save_atlas, save_ranges
from .fit_starts import fit_starts
from .page import save_page
from .shadow_rows import IMAGE
from .views import precision

Job = tuple[Task, Any]


def stability(
    scenes: Annotated[
        tuple[str, ...],
        tyro.conf.Positional,
        tyro.conf.arg(
            metavar="SCENE", help="Scenes of the failure catalogue, or parameters that are varied.",
            help_behavior_hint="(default: all)",
        ),
    ] = (),
    /,
    *,
    out: Annotated[Path, tyro.conf.arg(metavar="DIR", help="Folder for tables and charts; a "
                                       "run that was stopped goes on in its folder.")],
    quick: Annotated[
        bool, tyro.conf.arg(help="Single precision, fewer techniques, no cube of maps.")
    ] = False,
) -> None:  # fmt: skip
    """Run the catalogue of known failures over all techniques that it applies to.

    Each scene has a metric that sees its failure. A cell is fine, fails as known, does not
    fail though the catalogue says so, or fails unexpectedly; whatever is not finite, value or
    derivative, is unexpected, and then the command ends with exit code 1. Parameters are also
    varied up to their limits. Last, a bias is fitted from many starts on every embedded scene.
    Writes stability.parquet and stability_ranges.parquet, the same as stability.html, with charts
    stability.png and stability_ranges.png (and .pdf), stability_fits.parquet, and stability.json.
    """
    check_folder(out)
    jobs = list(chosen(scenes, quick=quick))
    make_folder(out)
    store = Store(out)
    with stage("measuring") as tell:
        cells = run(jobs, store, quick=quick, tell=tell)
    write(cells, out)
    summarize(cells)
    if not quick and not scenes:
        with stage("fitting from many starts") as tell:
            rows = run_fits(store, tell=tell)
        write_table(rows, out / "stability_fits.parquet")
        summarize_fits(rows)
    say(f"tables and charts: {out} (start with stability.html)")
    if any(cell.broken for cell in cells):
        raise SystemExit(1)


def chosen(names: Sequence[str], *, quick: bool) -> Iterator[Job]:
    """Return what to measure, each in one type.

    Raises:
        ValueError: If there is nothing of a name.
    """
    known = {task.name for task in TASKS}
    for name in names:
        if name not in known:
            raise ValueError(f"stability: no scene '{name}'; {hint(name, sorted(known))}")
    for dtype in (np.float32,) if quick else (np.float32, np.float64):
        for task in TASKS:
            wanted = task.name in names if names else not (quick and task.slow)
            if wanted and dtype in task.dtypes:
                yield task, dtype


def run(
    jobs: Sequence[Job], store: Store, *, quick: bool, tell: Any = lambda text: None
) -> list[Cell]:
    """Return all cells; what the store does not hold is measured."""
    cells: list[Cell] = []
    start, last = time.perf_counter(), None
    for done, (task, dtype) in enumerate(jobs):
        if last not in (None, dtype):
            jax.clear_caches()  # of the other type: gigabytes of programs
        last = dtype
        kind = "range" if task.sweep else "row"
        method = f"{np.dtype(dtype).name} {'quick' if quick else 'all'} {task.rows}"
        key = Key(kind, task.name, method, IMAGE[0])
        found = store.get(key)
        if found is None:
            spent = time.perf_counter() - start
            tell(f"{done} of {len(jobs)}, {spent:.0f} s: {task.name}, {np.dtype(dtype).name}")
            with precision(dtype):
                measured = task.measure(dtype, quick)
            store.put(key, {"cells": [list(cell) for cell in measured]})
            cells += measured
        else:
            cells += [Cell(*fields) for fields in found["cells"]]
    return cells


def run_fits(store: Store, *, tell: Any = lambda text: None) -> list[dict[str, Any]]:
    """Return a row for each embedded scene and setting of fits; measured once."""
    rows = []
    for scene in SHADOW_SCENES:
        key = Key("fits", scene, "constant and slope", 512)
        found = store.get(key)
        if found is None:
            tell(scene)
            found = {"rows": fit_starts(scene)}
            store.put(key, found)
        rows += found["rows"]
    return rows


def write_table(records: Sequence[dict[str, Any]], path: Path) -> None:
    """Write rows as Parquet."""
    with atomic_path(path) as temporary:
        pq.write_table(pa.Table.from_pylist(list(records)), temporary)


def write(cells: Sequence[Cell], out: Path) -> None:
    """Write the tables, what they were made with, the page and the charts."""
    rows = [cell for cell in cells if not cell.parameter]
    ranges = [cell for cell in cells if cell.parameter]
    for name, some in (("stability", rows), ("stability_ranges", ranges)):
        if not some:
            continue
        records = [cell.record() for cell in some]
        if some is rows:
            records = [{k: v for k, v in record.items() if k not in _VARIED} for record in records]
        write_table(records, out / f"{name}.parquet")
    made_with = {"versions": versions(), "device": device(), "commit": commit()}
    summary = {
        "verdicts": Counter(cell.verdict for cell in cells),
        "not_finite": sum(cell.broken for cell in cells),
        "absent": {str(row): why for row, why in ABSENT.items()},
        "missing": {str(row): why for row, why in MISSING.items()},
        "unexpected": [cell.record() for cell in cells if cell.verdict == UNEXPECTED],
    }
    with atomic_path(out / "stability.json") as temporary:
        text = json.dumps(_without_nan(summary | made_with), indent=1)
        temporary.write_text(text + "\n", "utf-8")
    save_page(rows, ranges, out / "stability.html")
    for suffix in (".png", ".pdf"):
        if rows:
            save_atlas(rows, out / f"stability{suffix}")
        if ranges:
            save_ranges(ranges, out / f"stability_ranges{suffix}")


_VARIED = ("parameter", "setting")


def _without_nan(tree: Any) -> Any:
    """Return the same with None for NaN, which JSON does not know."""
    if isinstance(tree, dict):
        return {key: _without_nan(value) for key, value in tree.items()}
    if isinstance(tree, list):
        return [_without_nan(value) for value in tree]
    return None if isinstance(tree, float) and np.isnan(tree) else tree


def summarize(cells: Sequence[Cell]) -> None:
    """Print how many cells there are of each verdict, and those that nobody foretold."""
    counts = Counter((cell.verdict, cell.dtype) for cell in cells)
    dtypes = sorted({cell.dtype for cell in cells})
    say_table(
        "cells",
        ["verdict", *dtypes],
        [[verdict, *(str(counts[verdict, dtype]) for dtype in dtypes)] for verdict in VERDICTS],
    )
    unconfirmed: dict[tuple, list[Cell]] = {}
    for cell in cells:
        if cell.verdict == UNCONFIRMED and cell.dtype == dtypes[0]:
            key = cell.scene, str(cell.row), cell.metric, cell.parameter
            unconfirmed.setdefault(key, []).append(cell)
    if unconfirmed:
        most = {key: max(cell.value for cell in some) for key, some in unconfirmed.items()}
        lines = [
            [*key, str(len(some)), f"{most[key]:.3g} of {some[0].limit:g}"]
            for key, some in unconfirmed.items()
        ]
        header = ["scene", "row", "metric", "parameter", "cells", "largest value"]
        say_table(f"{UNCONFIRMED}, {dtypes[0]}", header, lines)
    unexpected = [_line(cell) for cell in cells if cell.verdict == UNEXPECTED]
    if unexpected:
        header = ["scene", "row", "technique", "type", "metric", "value"]
        say_table(UNEXPECTED, header, unexpected)
    broken = sum(cell.broken for cell in cells)
    say(f"not finite, value or derivative: {broken} of {len(cells)} cells")


def summarize_fits(rows: Sequence[dict[str, Any]]) -> None:
    """Print from how many starts the best was reached."""
    settings = list(dict.fromkeys((r["levels"], r["scale"], r["noise"]) for r in rows))
    scenes = list(dict.fromkeys(row["scene"] for row in rows))
    reached = {(r["levels"], r["scale"], r["noise"], r["scene"]): r["reached"] for r in rows}
    say_table(
        "starts from which a fit reaches 1.05 times the best error",
        ["softness", "starts to", "noise", *scenes],
        [
            [levels, f"{scale:g}", f"{noise:g}"]
            + [f"{reached[levels, scale, noise, scene]:.0%}" for scene in scenes]
            for levels, scale, noise in settings
        ],
    )


def _line(cell: Cell) -> list[str]:
    technique = cell.technique
    if cell.parameter:
        technique += f", {cell.parameter} {cell.setting:g}"
    return [
        cell.scene, str(cell.row), technique, cell.dtype, cell.metric,
        f"{cell.value:.3g} of {cell.limit:g}",
    ]  # fmt: skip
