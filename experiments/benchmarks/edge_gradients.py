"""Gradients of random scenes against rays: ``python -m experiments.benchmarks.edge_gradients``.

How fast the mean over a window of the image changes as a caster or the light moves, and the image
of derivatives, with coverage and without, each against differences of supersampled ray-traced
images; with coverage also against differences of the renderings themselves. Scenes whose change
does not stand out from the truth's own noise are counted, no more.
"""

import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import matplotlib.figure
import numpy as np
import tyro
from matplotlib.backends.backend_agg import FigureCanvasAgg

from ..checks import check_folder, make_folder
from ..console import say, say_table, stage
from ..edge_gradients.motion_study import Figures, Settings, measure_scenes
from ..edge_gradients.random_scenes import LIGHT_KINDS, MOTIONS
from ..files.images import atomic_path
from ..json_file import write_json
from ..provenance import commit, device, versions

_MEDIAN, _PERCENTILE, _IMAGE = 0.01, 0.05, 0.1  # the limits that are aimed at
_WAYS = {
    "with coverage": ("#0072b2", "o", "with coverage"),
    "own differences": ("#009e73", "^", "with coverage, against its own differences"),
    "without": ("#d55e00", "s", "without coverage"),
}
_LEAST, _MOST = 1e-4, 1e2  # of the chart


def bench_edge_gradients(
    *,
    scenes: Annotated[int, tyro.conf.arg(help="How many random scenes.")] = 100,
    out: Annotated[Path, tyro.conf.arg(metavar="DIR", help="Where results are written.")] = Path(
        "experiments/results"
    ),
) -> None:
    """Measure gradients of random scenes."""
    if scenes < 1:
        raise ValueError(f"--scenes: expected at least 1, got {scenes}")
    check_folder(out)
    make_folder(out)
    settings, rows = Settings(), []
    start = time.perf_counter()
    with stage("measuring scenes") as tell:
        for row in measure_scenes(range(scenes), settings):
            rows.append(row)
            tell(f"{len(rows)} of {scenes}")
    results = {
        "summary": {name: summary(some) for name, some in groups(rows).items()},
        "scenes": [row._asdict() | {"clear": row.clear} for row in rows],
        "settings": settings._asdict(),
        "seconds": round(time.perf_counter() - start, 1),
        "versions": versions(),
        "device": device(),
        "commit": commit(),
    }
    write_json(out / "edge_gradients.json", results)
    save_chart(rows, out / "edge_gradients.png")
    _print(results["summary"])


def groups(rows: Sequence[Figures]) -> dict[str, list[Figures]]:
    """Return all rows, those of each kind of light, and those of each motion."""
    found = {"all": list(rows)}
    found |= {kind: [row for row in rows if row.light_kind == kind] for kind in LIGHT_KINDS}
    found |= {f"moves: {name}": [row for row in rows if row.moves == name] for name in MOTIONS}
    return {name: some for name, some in found.items() if any(row.clear for row in some)}


def summary(rows: Sequence[Figures]) -> dict[str, Any]:
    """Return the figures of some scenes, at least one of them clear."""
    clear = [row for row in rows if row.clear]

    def of(way: str) -> dict[str, float]:
        errors, distances = (
            [getattr(row, name)[way] for row in clear] for name in ("off", "image_off")
        )
        found = "plain" if way == "without" else "covered"
        return {
            "median": float(np.median(errors)),
            "percentile_95": float(np.percentile(errors, 95)),
            "sign_right": float(np.mean([getattr(row, found) * row.change > 0 for row in clear])),
            "image_median": float(np.median(distances)),
            "image_percentile_95": float(np.percentile(distances, 95)),
        }

    return {
        "scenes": len(rows),
        "clear": len(clear),
        "noise_median": float(np.median([row.noise / abs(row.change) for row in clear])),
        "image_noise_median": float(np.median([row.image_noise for row in clear])),
        **{way: of(way) for way in _WAYS},
    }


def save_chart(rows: Sequence[Figures], path: Path) -> None:
    """Write the errors in rising order, of the change and of the derivative image.

    Args:
        rows: At least one of them clear.
        path: Ends in .png or .pdf.
    """
    clear = [row for row in rows if row.clear]
    figure = matplotlib.figure.Figure(figsize=(10.5, 4.4), layout="constrained", dpi=120)
    FigureCanvasAgg(figure)
    changes, images = figure.subplots(1, 2, sharey=True)
    share = (np.arange(len(clear)) + 0.5) / len(clear) * 100
    for place, kind in ((changes, "off"), (images, "image_off")):
        for way, (color, marker, name) in _WAYS.items():
            values = np.clip(np.sort([getattr(row, kind)[way] for row in clear]), _LEAST, _MOST)
            place.plot(
                share, values, color=color, marker=marker, markersize=3.5, linewidth=1, label=name
            )
        place.set(yscale="log", ylim=(_LEAST, _MOST), xlim=(0, 100), xlabel="share of scenes, %")
        place.grid(color="0.92")
        place.spines[["top", "right"]].set_visible(False)
    _limit(changes, 50, _MEDIAN, "median 1 %")
    _limit(changes, 95, _PERCENTILE, "95th percentile 5 %")
    images.axhline(_IMAGE, color="black", linewidth=1, linestyle="--")
    images.text(12, 1.1 * _IMAGE, "95th percentile 10 %", va="bottom", fontsize=8)
    changes.set_title("Change of the mean over a window", fontsize=10)
    images.set_title("Derivative image, means of 4x4 pixels, L1", fontsize=10)
    changes.set_ylabel("relative error")
    changes.legend(frameon=False, fontsize=9, loc="upper left")
    figure.suptitle(
        f"Derivatives of {len(clear)} random scenes, against differences of ray-traced images"
    )
    with atomic_path(path) as temporary:
        figure.savefig(temporary, format=path.suffix[1:])


def _limit(place: Any, share: float, error: float, text: str) -> None:
    """Draw a corner that the curve must pass below."""
    place.plot(
        [0, share, share], [error, error, _LEAST], color="black", linewidth=1, linestyle="--"
    )
    place.text(12, 1.1 * error, text, ha="left", va="bottom", fontsize=8)


def _print(summaries: Mapping[str, Mapping[str, Any]]) -> None:
    columns = ("median", "percentile_95", "sign_right", "image_median", "image_percentile_95")
    percent = lambda value: f"{100 * value:.3g}"
    for way in _WAYS:
        say_table(
            f"{_WAYS[way][2]}; errors in %",
            [
                "scenes", "all", "above noise", "median", "95th percentile", "sign right",
                "image L1, median", "95th percentile",
            ],
            [
                [name, str(row["scenes"]), str(row["clear"])]
                + [percent(row[way][column]) for column in columns]
                for name, row in summaries.items()
            ],
        )  # fmt: skip
    noise = summaries["all"]
    say(
        f"the truth's own noise, medians: {percent(noise['noise_median'])} % of the change, "
        f"{percent(noise['image_noise_median'])} % of the derivative image"
    )


if __name__ == "__main__":
    tyro.cli(bench_edge_gradients)
