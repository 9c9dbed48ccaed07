"""The command ``frontier``: error against time of every shadow technique, on scenes."""

import json
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from itertools import product
from pathlib import Path
from typing import Annotated, Any, cast

import pyarrow as pa
import pyarrow.parquet as pq
import tyro

from ..checks import check_folder, make_folder
from ..console import say, say_notes, say_table, stage
from ..files.images import atomic_path
from ..provenance import commit, device, versions
from ..scenes import load_scene
from .chart import ERRORS, front, save_chart
from .cluster import connect, measure_on
from .errors import FIGURES
from .methods import methods
from .page import save_page
from .peers import PEERS, absent
from .programs import pace_shift, summarize
from .run import ACCURACY, TIMINGS, Cell, Contender, measure_here, run
from .shading_method import SHADING_METHODS
from .store import Key, Store

SCENES = ("default", "bumpy", "stacked", "thin-box", "sphere", "spot", "soft-lamp")
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
    runs: Annotated[
        int, tyro.conf.arg(help="Warm runs of each program, in each of two rounds.")
    ] = 3,
    scheduler: Annotated[
        str | None,
        tyro.conf.arg(metavar="ADDRESS", help="Dask scheduler whose workers measure, as in "
                      "tcp://host:8786.", help_behavior_hint="(default: this process measures)"),
    ] = None,
) -> None:  # fmt: skip
    """Chart error against time for every shadow filter, number of taps and size of map.

    For each: the light's pass, the filter's preparation and the image, timed warm; and the
    error against ray-traced truth at the best of the biases that suit the filter. Timings
    want an idle machine. Writes frontier.parquet, a row for each scene and method,
    frontier.json, a chart, frontier.png and frontier.pdf, and frontier.html, a chart to explore.
    """
    check_folder(out)
    if image_size < 1 or runs < 1:
        raise ValueError("frontier: expected --image-size and --runs of at least 1")
    names = scenes or (_QUICK_SCENES if quick else SCENES)
    for name in names:
        load_scene(name)  # so that a wrong name is told now, not after an hour
    chosen = contenders(techniques, quick=quick)
    cells = [
        Cell(what, scene, contender, image_size, runs)
        for scene, contender, what in product(names, chosen, (ACCURACY, *TIMINGS))
    ]
    measured = measure_here
    if scheduler is not None:
        measured = partial(measure_on, connect(scheduler))
    make_folder(out)
    store = Store(out)
    with stage("measuring") as tell:
        run(cells, store, measured=measured, tell=tell)
    rows = list(table(names, chosen, store, image_size))
    write(rows, out, pictures=_pictures(rows, store))
    for scene in names:
        _print(scene, [row for row in rows if row["scene"] == scene])
    say(f"tables and charts: {out} (start with frontier.html)")


def contenders(techniques: Sequence[str] = (), *, quick: bool = False) -> tuple[Contender, ...]:
    """Return all that is compared, or only filters of some names.

    Peers that cannot run here are named to the user.
    """
    filters = methods(techniques, quick=quick)
    if techniques:
        return filters
    missing = absent()
    say_notes([f"{name} left out: {reason}" for name, reason in missing.items()])
    peers = [peer for peer in PEERS if peer.technique not in missing]
    return *filters, *SHADING_METHODS, *cast(Sequence[Contender], peers)


def table(
    scenes: Sequence[str], chosen: Sequence[Contender], store: Store, image_size: int
) -> Iterator[dict[str, Any]]:
    """Yield a flat row for each scene and contender that is for it."""

    def get(what: str, scene: str, contender: Contender) -> dict[str, Any]:
        return store.get(Key(what, scene, contender.name, image_size)) or {}

    timed = {pair: [get(what, *pair) for what in TIMINGS] for pair in product(scenes, chosen)}
    timed = {pair: rounds for pair, rounds in timed.items() if all(rounds)}
    shift = pace_shift([one["stages"] for one in rounds] for rounds in timed.values())
    for (scene, contender), rounds in timed.items():
        found = get(ACCURACY, scene, contender)
        cost = summarize([one["stages"] for one in rounds], shift=shift)
        row = {
            "scene": scene, "kind": contender.kind, "name": contender.name,
            "technique": contender.technique, "setting": contender.label,
            "map_size": contender.map_size, "image_size": image_size,
            **dict.fromkeys(FIGURES), **found,
            "total_ms": cost["total_ms"][1], "total_ms_low": cost["total_ms"][0],
            "total_ms_high": cost["total_ms"][2],
            "kept_bytes": rounds[0]["kept_bytes"], "stable": cost["stable"],
            "pace_shift": shift,
        }  # fmt: skip
        for part in ("draw", "prepare", "image", "gradient"):
            of_part = cost[part] or {"ms": [None] * 3, "compile_s": None, "temporary_bytes": None}
            quartiles = zip(("low", "median", "high"), of_part["ms"], strict=True)
            row |= {f"{part}_ms_{name}": value for name, value in quartiles}
            row |= {f"{part}_{name}": of_part[name] for name in ("compile_s", "temporary_bytes")}
        yield row


def _pictures(rows: Sequence[dict[str, Any]], store: Store) -> dict[tuple[str, str], bytes]:
    found = {}
    for row in rows:
        key = Key(ACCURACY, row["scene"], row["name"], row["image_size"])
        picture = store.picture(key)
        if picture is not None:
            found[row["scene"], row["name"]] = picture
    return found


def write(
    rows: Sequence[dict[str, Any]], out: Path, *, pictures: Mapping[tuple[str, str], bytes]
) -> None:
    """Write the table, its JSON with what made it, the chart and the page."""
    made_with = {"versions": versions(), "device": device(), "commit": commit()}
    with atomic_path(out / "frontier.parquet") as temporary:
        made = {name: json.dumps(value) for name, value in made_with.items()}
        pq.write_table(pa.Table.from_pylist(list(rows)).replace_schema_metadata(made), temporary)
    with atomic_path(out / "frontier.json") as temporary:
        temporary.write_text(json.dumps({"rows": list(rows)} | made_with, indent=1) + "\n", "utf-8")
    for suffix in (".png", ".pdf"):
        save_chart(rows, out / f"frontier{suffix}")
    save_page(rows, pictures, out / "frontier.html", made_with=made_with)


def _print(scene: str, rows: Sequence[dict[str, Any]]) -> None:
    """Print the methods that no other beats in both time and error."""
    for title, kinds in ((scene, ("shadow", "peer")), (f"{scene}, its normal map", ("shading",))):
        best = front([row for row in rows if row["kind"] in kinds], "rmse")
        if best:
            say_table(
                f"{title}: none is both faster and closer to truth",
                ["method", "map", "ms", *ERRORS, "bias", "steady"],
                [
                    [
                        row["setting"], str(row["map_size"] or ""), f"{row['total_ms']:.1f}",
                        *("" if row[error] is None else f"{row[error]:.4f}" for error in ERRORS),
                        row["bias"] or "", "yes" if row["stable"] else "no",
                    ]
                    for row in best
                ],
            )  # fmt: skip
