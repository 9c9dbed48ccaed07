"""Fits from shadows, Adam beside them: ``python -m experiments.benchmarks.edge_fits``.

A pose of one number and of six, a light, and all vertices of a caster, with images of the
commands' usual size. Compared by evaluations of images and derivatives: Adam takes the gradient
of one loss, least squares one derivative image for each number, so its evaluations cost more,
the more numbers there are; seconds say how much.
"""

import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import matplotlib.figure
import numpy as np
import tyro
from matplotlib.backends.backend_agg import FigureCanvasAgg

from ..checks import check_folder, make_folder
from ..console import say_table
from ..edge_fits import fit_light_command, fit_pose_command, fit_vertices_command
from ..files.images import atomic_path
from ..json_file import read_json, write_json
from ..provenance import commit, device, versions

_DEGREES = 0.01  # left of a pose
_LEAST = 3e-9  # of the chart
_COLORS = {"least squares": ("#0072b2", "o"), "Adam": ("#d55e00", None)}


class Task(NamedTuple):
    """A fit.

    Attributes:
        title: What it is called.
        run: Writes its figures into a folder, with so many evaluations of Adam beside it.
        steps: Of Adam.
        ours: What is compared with it.
    """

    title: str
    run: Callable[[Path, int], None]
    steps: int
    ours: str = "Levenberg-Marquardt"


TASKS = {
    "turn": Task(
        "a turn, 70 degrees off",
        lambda out, steps: fit_pose_command.fit(out=out, free=("turn.y",), adam=steps),
        200,
    ),
    "pose": Task(
        "a pose: six numbers", lambda out, steps: fit_pose_command.fit(out=out, adam=steps), 200
    ),
    "light": Task(
        "a spot light: eight numbers",
        lambda out, steps: fit_light_command.fit(out=out, adam=steps),
        200,
    ),
    "vertices": Task(
        "all vertices of a ball",
        lambda out, steps: fit_vertices_command.fit(out=out, adam=steps),
        200,
        "L-BFGS",
    ),
}


def bench_edge_fits(
    *,
    tasks: Annotated[tuple[str, ...], tyro.conf.arg(help="Which fits.")] = tuple(TASKS),
    out: Annotated[Path, tyro.conf.arg(metavar="DIR", help="Where results are written.")] = Path(
        "experiments/results"
    ),
) -> None:
    """Fit, and chart how fits and Adam come down."""
    unknown = [name for name in tasks if name not in TASKS]
    if unknown or not tasks:
        raise ValueError(f"--tasks: expected some of {', '.join(TASKS)}, got {tasks}")
    check_folder(out)
    make_folder(out)
    rows = {name: _measure(TASKS[name]) for name in tasks}
    made_with = {"versions": versions(), "device": device(), "commit": commit()}
    write_json(out / "edge_fits.json", {"fits": rows, **made_with})
    save_chart(rows, out / "edge_fits.png")
    optional = lambda value, form: "-" if value is None else format(value, form)
    say_table(
        f"evaluations of images and derivatives; until all turns are within {_DEGREES:g} degrees "
        "for good",
        ["fit", "evaluations", "s", "rms", "worst turn, deg", "until", "Adam: rms", "until"],
        [
            [
                row["title"], str(row["evaluations"]), f"{row['seconds']:.1f}",
                f"{row['rms']:.2g}", optional(row["worst_turn"], ".1e"),
                optional(row["until"], "d"), f"{min(row['adam_rms']):.2g}",
                optional(row["adam_until"], "d"),
            ]
            for row in rows.values()
        ],
    )  # fmt: skip


def _measure(task: Task) -> dict[str, Any]:
    with tempfile.TemporaryDirectory() as folder:
        task.run(Path(folder), task.steps)
        found = read_json(Path(folder) / "summary.json")
    turns = {
        k: row["step"]
        for k, (name, row) in enumerate(found.get("numbers", {}).items())
        if name.startswith("turn.")
    }
    worst = lambda vector: max(abs(vector[k]) * step for k, step in turns.items())
    if "stages" in found:
        stages = [s for s in found["stages"] if s["start"] == found["best_start"]]
        evaluations = np.cumsum([s["evaluations"] for s in stages]).tolist()
        rms, adam = [s["rms"] for s in stages], found["adam"]["rms"]
        curve = [[1, *evaluations], [adam[0], *rms]]  # both begin at the same start
        left = [worst(s["vector"]) for s in stages] if turns else []
        adam_left = [worst(vector) for vector in found["adam"]["vectors"]] if turns else []
    else:
        evaluations = [row["evaluations"] for row in found["history"]]
        rms, adam = [row["rms"] for row in found["history"]], found["adam"]
        curve, left, adam_left = [evaluations, rms], [], []
    return {
        "title": task.title,
        "ours": task.ours,
        "evaluations": evaluations[-1],
        "seconds": found["seconds"] if "seconds" in found else found["history"][-1]["seconds"],
        "rms": rms[-1],
        "curve": curve,
        "worst_turn": left[-1] if turns else None,
        "until": _until(evaluations, left),
        "adam_rms": adam,
        "adam_until": _until(list(range(1, 1 + len(adam_left))), adam_left),
    }


def _until(evaluations: list[int], left: list[float]) -> int | None:
    """Return after how many evaluations what is left stays small; None if it never does."""
    large = [k for k, value in enumerate(left) if value > _DEGREES]
    first = large[-1] + 1 if large else 0
    return evaluations[first] if first < len(left) else None


def save_chart(rows: Mapping[str, Mapping[str, Any]], path: Path) -> None:
    """Write how the images' difference falls with evaluations, a plot for each fit."""
    figure = matplotlib.figure.Figure(
        figsize=(1 + 3.2 * len(rows), 3.8), layout="constrained", dpi=120
    )
    FigureCanvasAgg(figure)
    plots = figure.subplots(1, len(rows), sharey=True, squeeze=False)[0]
    for place, row in zip(plots, rows.values(), strict=True):
        curves = {
            "least squares": row["curve"],
            "Adam": (range(1, 1 + len(row["adam_rms"])), row["adam_rms"]),
        }
        for name, (evaluations, rms) in curves.items():
            color, marker = _COLORS[name]
            label = row["ours"] if name == "least squares" else name
            place.plot(evaluations, rms, color=color, marker=marker, markersize=4, label=label)
        place.set(xscale="log", yscale="log", xlabel="evaluations of images and derivatives")
        place.set_ylim(bottom=_LEAST)
        place.set_title(row["title"], fontsize=10)
        place.grid(color="0.92")
        place.spines[["top", "right"]].set_visible(False)
        place.legend(frameon=False, fontsize=8, loc="lower left")
    plots[0].set_ylabel("root mean square of fit less target")
    figure.suptitle("How fits from shadows come down, and Adam beside them")
    with atomic_path(path) as temporary:
        figure.savefig(temporary, format=path.suffix[1:])


if __name__ == "__main__":
    tyro.cli(bench_edge_fits)
