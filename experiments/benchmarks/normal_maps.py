"""Compare solvers of maps: ``python -m experiments.benchmarks.normal_maps --out FILE.json``.

A chart of mean error against seconds lies beside the file. Run it on an idle machine.
"""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx
import tyro
from jaxtyping import Array, Float

from tangentspace.shading import PhongShading

from ..checks import check_out
from ..console import say, say_table, stage
from ..files.images import atomic_path
from ..normal_map_fits.fit_normal_map import SOLVER
from ..normal_map_fits.normal_map_study import MapStudy, make_study
from ..normal_map_fits.normal_map_views import Slopes
from ..panels import COLORS, Curve, save_curves
from ..provenance import commit, device, versions
from ..rendering.prepare_scene import prepare_scene
from ..scene import Scene
from ..scenes.relief import relief, shadowed_relief
from .normal_map_race import (
    Entry,
    FitWalk,
    Problem,
    adam_walk,
    flat_problem,
    half_squares,
    known_texels,
    optimistix_walk,
    race,
    residuals,
)

_RATES = (0.02, 0.005, 0.05, 0.1, 0.2)  # of Adam; the first is a usual guess
_NOISE = 0.01  # of white


def bench_normal_map(
    *,
    out: Annotated[Path, tyro.conf.arg(metavar="FILE", help="Where to write the figures, .json.")],
    quick: Annotated[bool, tyro.conf.arg(help="A small map and few steps, to try it.")] = False,
) -> None:
    """Recover the map of ``relief`` with every solver, and harder ones with the project's own."""
    check_out(out, ".json")
    size, image_size, most = (64, (96, 96), 60) if quick else (256, (384, 384), 300)
    with stage("making images"):
        plain = _study(relief(size=size), image_size)
        others = {
            f"relief, noise {_NOISE:.0%} of white": _study(relief(size=size), image_size, _NOISE),
            "shadowed-relief": _study(shadowed_relief(size=size), image_size),
        }
    with stage("comparing solvers") as report:
        report("compiling")
        rows = [{"scene": "relief"} | row for row in race(_all(plain, most), report)]
    charted = _without_slower_adams(rows)[: len(COLORS)]
    for name, study in others.items():
        with stage(name) as report:
            rows += [{"scene": name} | row for row in race([_own(study, most)], report)]
    content = {
        "settings": {"map_size": [size] * 2, "image_size": list(image_size), "lights": 6},
        "fits": rows,
        "versions": versions(),
        "device": device(),
        "commit": commit(),
    }
    with atomic_path(out) as temporary:
        temporary.write_text(json.dumps(content, indent=1) + "\n", "utf-8")
    chart = out.with_suffix(".png")
    curves = {
        row["solver"]: Curve(row["curve"]["seconds"], row["curve"]["mean_error_degrees"])
        for row in charted
    }
    title = f"relief: a map of {size} x {size} texels from six images"
    save_curves(chart, curves, label="mean error of the map (degrees)", title=title)
    _say_rows(rows)
    say(f"figures: {out}; chart: {chart}")


def _study(scene: Scene, image_size: tuple[int, int], noise: float = 0.0) -> MapStudy:
    prepared = prepare_scene(scene, tangents=True)
    return make_study(prepared, PhongShading(), image_size=image_size, noise=noise)


def _own(study: MapStudy, most: int) -> Entry:
    return Entry("MapFit", FitWalk(study), study, known_texels(study), chunk=10, most=most)


def _all(study: MapStudy, most: int) -> list[Entry]:
    """Return all solvers, compiled and at their start; what fails early comes last."""
    problem, known = flat_problem(study), known_texels(study)
    rtol, atol = SOLVER.rtol, SOLVER.atol
    entries = [_own(study, most)]

    def add(name: str, walk: Any, *, chunk: int = 10, most: int = most) -> None:
        entries.append(Entry(name, walk, study, known, chunk=chunk, most=most))

    for kind in (optx.LBFGS, optx.NonlinearCG):
        walk = optimistix_walk(kind(rtol=rtol, atol=atol), half_squares, problem)
        add(kind.__name__, walk)
    for rate in _RATES:
        add(f"Adam, {rate:g}", adam_walk(rate, half_squares, problem))
    # Without a tolerance the inner solver does not call its limit a failure.
    always = lx.Normal(lx.CG(rtol=0.0, atol=0.0, max_steps=40))
    solver = optx.LevenbergMarquardt(rtol=rtol, atol=atol, linear_solver=always)
    name = "LevenbergMarquardt, 40 CG steps"
    add(name, optimistix_walk(solver, _stacked, problem), chunk=1, most=8)
    solver = optx.LBFGS(rtol=1e-6, atol=1e-6)
    add("LBFGS on the mean", optimistix_walk(solver, _mean_square, problem), most=60)
    within = lx.Normal(lx.CG(rtol=0.1, atol=1e-3, max_steps=60))
    for kind in (optx.LevenbergMarquardt, optx.GaussNewton):
        walk = optimistix_walk(kind(rtol=rtol, atol=atol, linear_solver=within), _stacked, problem)
        add(f"{kind.__name__}, CG to 10 %", walk, chunk=1, most=8)
    return entries


def _stacked(slopes: Slopes, problem: Problem) -> Float[Array, "residuals pixels"]:
    """Return all residuals in one array, which least-squares solvers compile in half the time."""
    return jnp.stack(residuals(slopes, problem))


def _mean_square(slopes: Slopes, problem: Problem) -> Float[Array, ""]:
    return 2 * half_squares(slopes, problem) / problem[0].targets.size


def _without_slower_adams(rows: Sequence[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """Return the rows with no more of Adam than the usual rate and the best."""
    adams = [row for row in rows if row["solver"].startswith("Adam")]
    best = min(adams, key=lambda row: row["mean_error_degrees"])
    return [row for row in rows if row not in adams or row in (adams[0], best)]


def _say_rows(rows: Sequence[Mapping[str, Any]]) -> None:
    def seconds_to(row: Mapping[str, Any], degrees: float) -> str:
        curve = row["curve"]
        below = np.asarray(curve["mean_error_degrees"]) <= degrees
        return f"{curve['seconds'][np.argmax(below)]:.1f}" if below.any() else "-"

    columns = ["mean", "max", "s", "s to 1", "s to 0.1", "ms/step", "compile s"]
    say_table(
        "errors in degrees, seconds without compilation, steps: median (quartiles)",
        ["solver", "scene", "steps", *columns, "result"],
        [
            [
                row["solver"],
                row["scene"],
                str(row["steps"]),
                f"{row['mean_error_degrees']:.4f}",
                f"{row['max_error_degrees']:.2f}",
                f"{row['seconds']:.1f}",
                seconds_to(row, 1.0),
                seconds_to(row, 0.1),
                "{1:.0f} ({0:.0f}-{2:.0f})".format(*row["ms_per_step"]),
                f"{row['compile_s']:.1f}",
                row["result"].partition(".")[0],
            ]
            for row in rows
        ],
    )


if __name__ == "__main__":
    tyro.cli(bench_normal_map)
