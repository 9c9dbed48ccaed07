"""The search against trying all: ``python -m experiments.simplest.evidence --out DIR``.

On each scene every model is measured once; then the search runs on these measurements, so that
both judge by the same errors and times, for several tolerances. Run it on an idle machine; a run
that was stopped goes on in its folder with the next scene.

The same measurements say which single model serves most scenes: what ``render`` does if it is
told nothing.
"""

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from ..checks import check_folder, make_folder
from ..console import say_table, stage
from ..files.images import atomic_path
from ..frontier.programs import Programs
from ..frontier.store import Key, Store
from ..provenance import commit, device, versions
from ..scenes import load_scene
from .bench import Bench, Measured
from .models import Model, all_models
from .search import Search
from .sight import Measure, look_at_scene
from .theory import Theory

SCENES = (
    "default", "sphere", "stacked", "thin-box", "grazing-plane", "skylights", "avenue",
    "contact-wall", "two-occluders", "box-corner", "coarse-sphere", "bumpy", "displaced",
    "mirror", "shadowed-relief", "spot", "projector", "room", "soft-lamp", "tall-and-short",
)  # fmt: skip
_MOST = 0.9  # of the scenes
RENDERED = {  # what ``render`` takes under hard and area lights
    "hard": Model("plain", "bilinear", 1024, "slope"),
    "area": Model("plain", "pcss 8", 1024, "adaptive"),
}
TOLERANCES = (0.05, 0.02, 0.01, 0.005, 0.0025)


def evidence(
    *,
    out: Annotated[Path, tyro.conf.arg(metavar="DIR", help="Folder for evidence.json and for "
                                       "what was measured.")],
    scenes: Annotated[
        tuple[str, ...],
        tyro.conf.arg(metavar="SCENE", help="Scenes or mesh files, beside those chosen here."),
    ] = (),
    only: Annotated[bool, tyro.conf.arg(help="None but these scenes.")] = False,
    measure: Annotated[Measure, tyro.conf.arg(help="Of errors.")] = "rmse",
    image_size: Annotated[
        int, tyro.conf.arg(metavar="N", help="Pixels on each side of the image.")
    ] = 256,
    runs: Annotated[int, tyro.conf.arg(help="Warm runs of each stage, at least.")] = 5,
) -> None:  # fmt: skip
    """Compare the search with exhaustive search on twenty scenes and more."""
    check_folder(out)
    make_folder(out)
    store, programs, rows = Store(out), Programs(), []
    found_on: dict[str, dict[str, dict[Model, Measured]]] = {"hard": {}, "area": {}}
    for name in (*(() if only else SCENES), *scenes):
        with stage(name) as tell:
            sight = look_at_scene(load_scene(name), image_size)
            theory = Theory(sight, measure)
            models = all_models(sight.looks, sight.layout)
            key = Key("exhaustive", name, measure, image_size)
            found = store.get(key)
            if found is None:
                bench = Bench(sight, theory.slope, measure=measure, runs=runs, programs=programs)
                store.put(key, dict(_measure_all(bench, models, tell)))
                found = store.get(key) or {}
            measured = {m: _told(found[m.name]) for m in models}
            found_on["area" if theory.soft else "hard"][Path(name).name] = {
                m._replace(look=sight.looks[0]): of_m for m, of_m in measured.items()
                if m.look == sight.looks[-1]
            }  # fmt: skip
            for tolerance in TOLERANCES:
                search = Search(sight, theory, models, measure)
                rows.append({"scene": Path(name).name} | compare(search, measured, tolerance))
    alone = [
        {"light": light, "of": of} | one_for_all(found, tolerance)
        for light, scenes in found_on.items() if scenes
        for tolerance in TOLERANCES
        for of, found in {
            "all": list(scenes.values()),
            "render": [{RENDERED[light]: scene[RENDERED[light]]} for scene in scenes.values()],
        }.items()
    ]  # fmt: skip
    made_with = {"versions": versions(), "device": device(), "commit": commit()}
    what = {"rows": rows, "one_for_all": alone, "measure": measure, "image_size": image_size}
    with atomic_path(out / "evidence.json") as temporary:
        temporary.write_text(json.dumps(what | made_with, indent=1) + "\n", "utf-8")
    _print(rows)
    _print_alone(alone)


def _measure_all(
    bench: Bench, models: Sequence[Model], tell: Callable[[str], None]
) -> Iterator[tuple[str, tuple[float, list]]]:
    """Yield every model's name and what was found of it, in a form for JSON."""
    for k, model in enumerate(models):
        tell(f"{k} of {len(models)}: {model.name}")
        error, ms = bench.measure(model)
        yield model.name, (error, list(ms.items()))


def _told(found: Sequence) -> Measured:
    error, ms = found
    return Measured(error, {tuple(stage): time for stage, time in ms})


def compare(search: Search, measured: Mapping[Model, Measured], tolerance: float) -> dict[str, Any]:
    """Return what a search finds among measured models, and the cheapest there is."""
    end = search.run(lambda k: measured[search.models[k]], tolerance=tolerance)
    enough = {m: found for m, found in measured.items() if found.error <= tolerance}
    cheapest = min(enough, key=lambda m: enough[m].cost, default=None)
    mine = None if end is None else search.models[end.best]
    return {
        "tolerance": tolerance,
        "choice": None if mine is None else mine.name,
        "error": None if mine is None else measured[mine].error,
        "ms": None if mine is None else measured[mine].cost,
        "cheapest": None if cheapest is None else cheapest.name,
        "cheapest_ms": None if cheapest is None else measured[cheapest].cost,
        "ratio": _ratio(mine, cheapest, measured),
        "tried": len(search.tried),
        "models": len(measured),
    }


def one_for_all(scenes: Sequence[Mapping[Model, Measured]], tolerance: float) -> dict[str, Any]:
    """Return the cheapest model that is enough on nine of ten scenes, or else on most.

    Args:
        scenes: What was measured on each, of the same models or more.
        tolerance: Largest error.
    """
    shared = [m for m in scenes[0] if all(m in scene for scene in scenes)]
    errors = np.array([[scene[m].error for scene in scenes] for m in shared])
    costs = np.array([[scene[m].cost for scene in scenes] for m in shared])
    enough, cost = np.sum(errors <= tolerance, axis=1), np.median(costs, axis=1)
    best = int(np.lexsort((cost, -np.minimum(enough, _MOST * len(scenes))))[0])
    return {
        "tolerance": tolerance,
        "model": shared[best].name,
        "enough": int(enough[best]),
        "scenes": len(scenes),
        "median_ms": float(cost[best]),
        "median_error": float(np.median(errors[best])),
        "worst_error": float(errors[best].max()),
    }


def _ratio(mine: Model | None, cheapest: Model | None, measured: Mapping[Model, Measured]) -> float:
    """Return the cost over the least that is enough; 1 if both find none, infinity if one does."""
    if mine is None or cheapest is None:
        return 1.0 if mine is cheapest else float("inf")
    return measured[mine].cost / measured[cheapest].cost


def _print(rows: list[dict[str, Any]]) -> None:
    say_table(
        "the search against trying every model",
        ["scene", "tolerance", "choice", "ms", "cheapest", "ms", "ratio", "tried", "of"],
        [
            [
                row["scene"], f"{row['tolerance']:g}", row["choice"] or "none reaches it",
                _number(row["ms"]), row["cheapest"] or "none", _number(row["cheapest_ms"]),
                f"{row['ratio']:.2f}", str(row["tried"]), str(row["models"]),
            ]
            for row in rows
        ],
    )  # fmt: skip
    ratios = np.array([row["ratio"] for row in rows])
    shares = np.array([row["tried"] / row["models"] for row in rows])
    missed = sum(1 for row in rows if row["choice"] is not None and row["error"] > row["tolerance"])
    say_table(
        f"all {len(rows)}",
        ["", "figure"],
        [
            ["share that costs at most 1.2 of the cheapest", f"{np.mean(ratios <= 1.2):.3f}"],
            ["mean share of models that were tried", f"{shares.mean():.3f}"],
            ["largest such share", f"{shares.max():.3f}"],
            ["choices that miss the tolerance", str(missed)],
        ],
    )


def _print_alone(rows: list[dict[str, Any]]) -> None:
    say_table(
        "one model for all scenes",
        ["light", "of", "tolerance", "model", "enough on", "median ms", "median error", "worst"],
        [
            [
                row["light"], row["of"], f"{row['tolerance']:g}", row["model"],
                f"{row['enough']} of {row['scenes']}", f"{row['median_ms']:.1f}",
                f"{row['median_error']:.4f}", f"{row['worst_error']:.4f}",
            ]
            for row in rows
        ],
    )  # fmt: skip


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.2f}"


if __name__ == "__main__":
    tyro.cli(evidence)
