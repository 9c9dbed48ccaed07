"""The command ``frontier``: error against time of every shadow technique, on scenes."""

import json
import time
from collections.abc import Iterator, Sequence
from itertools import product
from pathlib import Path
from typing import Annotated, Any

import pyarrow as pa
import pyarrow.parquet as pq
import tyro

from ..checks import check_folder, make_folder
from ..console import say, say_table, stage
from ..files.images import atomic_path
from ..provenance import commit, device, versions
from .chart import ERRORS, front, save_chart
from .measure import Programs, accuracy, timing
from .methods import Method, methods
from .store import Key, Store
from .view import View, load_view

SCENES = ("default", "sphere", "stacked", "thin-box", "spot", "room", "soft-lamp")
_QUICK_SCENES = ("default", "soft-lamp")


def frontier(
    scenes: Annotated[
        tuple[str, ...],
        tyro.conf.Positional,
        tyro.conf.arg(
            metavar="SCENE", help="Scenes or mesh files.",
            help_behavior_hint=f"(default: {' '.join(SCENES)})",
        ),
    ] = (),
    /,
    *,
    out: Annotated[Path, tyro.conf.arg(metavar="DIR", help="Folder for tables and charts; a "
                                       "run that was stopped goes on in its folder.")],
    quick: Annotated[
        bool, tyro.conf.arg(help="Two scenes, one size of each filter, two of the map.")
    ] = False,
    techniques: Annotated[
        tuple[str, ...],
        tyro.conf.arg(metavar="NAME", help="Filters.", help_behavior_hint="(default: all)"),
    ] = (),
    image_size: Annotated[
        int, tyro.conf.arg(metavar="N", help="Pixels on each side of the image.")
    ] = 512,
    runs: Annotated[int, tyro.conf.arg(help="Warm runs of each program, twice.")] = 5,
) -> None:  # fmt: skip
    """Chart error against time for every shadow filter, number of taps and size of map.

    For each: the light's pass, the filter's preparation and the image, timed warm; and the
    error against ray-traced truth at the best of the biases that suit the filter. Timings
    want an idle machine. Writes frontier.parquet, a row for each scene and method,
    frontier.json, and a chart, frontier.png and frontier.pdf.
    """
    check_folder(out)
    if image_size < 1 or runs < 1:
        raise ValueError("frontier: expected --image-size and --runs of at least 1")
    chosen = methods(techniques, quick=quick)
    names = scenes or (_QUICK_SCENES if quick else SCENES)
    make_folder(out)
    store = Store(out)
    with stage("measuring") as tell:
        run(names, chosen, store, image_size=image_size, runs=runs, tell=tell)
    rows = list(table(names, chosen, store, image_size))
    write(rows, out)
    for scene in names:
        _print(scene, [row for row in rows if row["scene"] == scene])
    say(f"tables and charts: {out} (start with frontier.png)")


def run(
    scenes: Sequence[str],
    chosen: Sequence[Method],
    store: Store,
    *,
    image_size: int,
    runs: int,
    tell: Any = lambda text: None,
) -> None:
    """Measure what the store does not hold, one after another."""
    programs = Programs()
    todo = [
        (scene, method, kind)
        for scene, method, kind in product(scenes, chosen, ("accuracy", "timing"))
        if store.get(Key(kind, scene, method.name, image_size)) is None
    ]
    view: tuple[str, View] | None = None
    start = time.perf_counter()
    for done, (scene, method, kind) in enumerate(todo):
        spent = time.perf_counter() - start
        left = f", {spent / done * (len(todo) - done):.0f} s left" if done > 4 else ""
        tell(f"{done} of {len(todo)}{left}: {scene}, {method.name}")
        if view is None or view[0] != scene:
            view = scene, load_view(scene, image_size)
        if kind == "accuracy":
            figures = accuracy(view[1], method, programs)
        else:
            figures = timing(view[1], method, programs, runs=runs)
        store.put(Key(kind, scene, method.name, image_size), figures)


def table(
    scenes: Sequence[str], chosen: Sequence[Method], store: Store, image_size: int
) -> Iterator[dict[str, Any]]:
    """Return a flat row for each scene and method."""
    for scene, method in product(scenes, chosen):
        keys = [Key(kind, scene, method.name, image_size) for kind in ("accuracy", "timing")]
        found, cost = (store.get(key) or {} for key in keys)
        row = {
            "scene": scene, "technique": method.technique, "setting": method.label,
            "map_size": method.map_size, "image_size": image_size, **found,
            "total_ms": cost["total_ms"], "kept_bytes": cost["kept_bytes"],
            "stable": cost["stable"],
        }  # fmt: skip
        for part in ("draw", "prepare", "image", "gradient"):
            quartiles = zip(("low", "median", "high"), cost[part]["ms"], strict=True)
            row |= {f"{part}_ms_{name}": value for name, value in quartiles}
            row |= {f"{part}_{name}": cost[part][name] for name in ("compile_s", "temporary_bytes")}
        yield row


def write(rows: Sequence[dict[str, Any]], out: Path) -> None:
    """Write the table, its JSON with what made it, and the chart."""
    made_with = {"versions": versions(), "device": device(), "commit": commit()}
    with atomic_path(out / "frontier.parquet") as temporary:
        pq.write_table(pa.Table.from_pylist(list(rows)), temporary)
    with atomic_path(out / "frontier.json") as temporary:
        temporary.write_text(json.dumps({"rows": list(rows)} | made_with, indent=1) + "\n", "utf-8")
    for suffix in (".png", ".pdf"):
        save_chart(rows, out / f"frontier{suffix}")


def _print(scene: str, rows: Sequence[dict[str, Any]]) -> None:
    """Print the methods that no other beats in both time and error."""
    best = sorted(front(rows, "rmse"), key=lambda row: row["total_ms"])
    say_table(
        f"{scene}: none is both faster and closer to truth",
        ["method", "map", "ms", *ERRORS, "bias", "steady"],
        [
            [
                row["setting"], str(row["map_size"]), f"{row['total_ms']:.1f}",
                *(f"{row[error]:.4f}" for error in ERRORS),
                row["bias"], "yes" if row["stable"] else "no",
            ]
            for row in best
        ],
    )  # fmt: skip
