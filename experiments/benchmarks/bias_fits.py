"""Judge the bias fit: ``python -m experiments.benchmarks.bias_fits --out FILE.json``.

For every embedded scene and given mesh: the error under hard comparison of the fit and of
the best of the sweep, solver steps, biases tried, and run times without compilation. Run it
on an idle machine.
"""

import json
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from shadows.bias import CombinedBias, ConstantBias, SlopeBias
from shadows.window_filters import BilinearFilter
from tangentspace.shading import BlinnPhongShading

from ..bias_fits.bias_study import prepare_study
from ..bias_fits.fit_bias import fit_bias
from ..bias_fits.sweep_bias import sweep_bias
from ..checks import check_out
from ..console import say_table, stage
from ..files.images import atomic_path
from ..provenance import commit, device, versions
from ..scenes import SHADOW_SCENES, load_scene


def bench_fit(
    *,
    out: Annotated[Path, tyro.conf.arg(metavar="FILE", help="Where to write the figures, .json.")],
    meshes: Annotated[
        tuple[str, ...], tyro.conf.arg(metavar="MESH", help="Mesh files to fit as well.")
    ] = (),
    runs: Annotated[int, tyro.conf.arg(help="Fits and sweeps timed of each, in turn.")] = 5,
) -> None:
    """Fit constant and slope on every scene, 512 x 512 pixels and a map of 1024."""
    check_out(out, ".json")
    rows = []
    for name in (*SHADOW_SCENES, *meshes):
        with stage(f"fitting {Path(name).stem}"):
            rows.append(_row(name, runs))
    made_with = {"versions": versions(), "device": device(), "commit": commit()}
    with atomic_path(out) as temporary:
        temporary.write_text(json.dumps({"fits": rows, **made_with}, indent=1) + "\n", "utf-8")
    say_table(
        "error under hard comparison; seconds are medians without compilation",
        ["scene", "zero", "fit", "sweep", "fit/sweep", "steps", "tried", "of", "s", "of", "share"],
        [
            [
                row["scene"],
                f"{row['zero_error']:.2%}",
                f"{row['fit_error']:.4%}",
                f"{row['sweep_error']:.4%}",
                "-" if row["error_ratio"] is None else f"{row['error_ratio']:.3f}",
                str(row["steps"]),
                str(row["fit_evaluations"]),
                str(row["sweep_evaluations"]),
                f"{row['fit_seconds'][1]:.2f}",
                f"{row['sweep_seconds'][1]:.2f}",
                f"{row['time_ratio']:.2f}",
            ]
            for row in rows
        ],
    )


def _row(name: str, runs: int) -> dict[str, Any]:
    lookup, terms = BilinearFilter(), CombinedBias((ConstantBias(), SlopeBias()))
    study = prepare_study(
        load_scene(name),
        image_size=(512, 512),
        map_size=1024,
        filter=lookup,
        shading=BlinnPhongShading(),
    )
    both = [
        (fit_bias(study.trial, terms, lookup), sweep_bias(study.trial, terms, lookup))
        for _ in range(runs)
    ]
    fitted, swept = both[0]
    seconds = np.array([[fit.seconds, sweep.seconds] for fit, sweep in both])
    quartiles = np.percentile(seconds, [25, 50, 75], axis=0).round(4)
    return {
        "scene": study.scene.name,
        "faces": len(study.scene.mesh.faces),
        "zero_error": study.errors(CombinedBias()).error,
        "fit_error": fitted.error,
        "sweep_error": swept.error,
        "error_ratio": fitted.error / swept.error if swept.error else None,
        "sweep_converged": swept.converged,
        "parameters": {
            key: [value, fitted.units[key], swept.values[key]]
            for key, value in fitted.values.items()
        },
        "steps": fitted.steps,
        "fit_evaluations": fitted.evaluations,
        "sweep_evaluations": swept.evaluations,
        "fit_seconds": quartiles[:, 0].tolist(),
        "sweep_seconds": quartiles[:, 1].tolist(),
        "time_ratio": float(np.median(seconds[:, 0] / seconds[:, 1])),
        "undetermined": list(fitted.untold),
    }


if __name__ == "__main__":
    tyro.cli(bench_fit)
