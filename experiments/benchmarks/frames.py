"""Time the tangent frames: ``python -m experiments.benchmarks.frames --out FILE.json``.

A torus, its faces and vertices in the order that made them and in random order: vertex
frames, and with them the gradient of a sum of tangents and bitangents; and the tangents of
MikkTSpace, grouping included. Run it on an idle machine.
"""

import json
import time
from pathlib import Path
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from tangentspace.frames import vertex_frames
from tangentspace.mesh import Mesh
from tangentspace.shapes import torus

from ..checks import check_out
from ..console import say_table, stage
from ..files.images import atomic_path
from ..provenance import commit, device, versions
from .stages import measure


def bench_frames(
    *,
    out: Annotated[Path, tyro.conf.arg(metavar="FILE", help="Where to write the figures, .json.")],
    faces: Annotated[int, tyro.conf.arg(help="Faces of the mesh, about.")] = 1_000_000,
    runs: Annotated[int, tyro.conf.arg(help="Warm runs of each.")] = 20,
) -> None:
    """Time vertex frames, their gradient and MikkTSpace's tangents, single precision."""
    check_out(out, ".json")
    around = max(3, round((faces / 4) ** 0.5))
    mesh = torus(major_segments=2 * around, minor_segments=around)
    rows = []
    for name, ordered in {"in order": mesh, "shuffled": _shuffled(mesh)}.items():
        with stage(f"timing frames, {name}"):
            rows.append(
                {"mesh": name, **_time_frames(ordered, runs), **_time_mikktspace(ordered, runs)}
            )
    made_with = {"versions": versions(), "device": device(), "commit": commit()}
    with atomic_path(out) as temporary:
        temporary.write_text(json.dumps({"frames": rows, **made_with}, indent=1) + "\n", "utf-8")
    timed = ["frames", "frames and gradient", "mikktspace"]
    say_table(
        f"{rows[0]['faces']} faces, ms: median (quartiles)",
        ["mesh", *timed, "gradient / frames", "compile s"],
        [
            [
                row["mesh"],
                *("{1:.0f} ({0:.0f}-{2:.0f})".format(*row[name]["ms"]) for name in timed),
                f"{row['gradient / frames']:.2f}",
                f"{row['frames']['compile_s']:.1f}, {row['frames and gradient']['compile_s']:.1f}",
            ]
            for row in rows
        ],
    )


def _time_frames(mesh: Mesh, runs: int) -> dict[str, Any]:
    """Time the frames and their gradient, compiled, with all arrays as arguments."""
    positions, normals, faces, uvs = map(jnp.asarray, mesh[:4])
    weights = jnp.asarray(np.random.default_rng(0).normal(size=positions.shape), jnp.float32)

    def loss(
        positions: jax.Array,
        normals: jax.Array,
        uvs: jax.Array,
        faces: jax.Array,
        weights: jax.Array,
    ) -> jax.Array:
        frames = vertex_frames(positions, normals, uvs, faces)
        return jnp.sum(weights * (frames.tangent + frames.bitangent))

    arguments = (positions, normals, uvs, faces)
    measured = measure(
        {
            "frames": (vertex_frames, arguments),
            "frames and gradient": (jax.value_and_grad(loss, (0, 1, 2)), (*arguments, weights)),
        },
        runs=runs,
    )
    ratio = measured["frames and gradient"]["ms"][1] / measured["frames"]["ms"][1]
    sizes = {"faces": len(mesh.faces), "vertices": len(mesh.positions)}
    return {**sizes, **measured, "gradient / frames": ratio}


def _time_mikktspace(mesh: Mesh, runs: int) -> dict[str, Any]:
    """Time the tangents per corner, on the host; the first call, which compiles, apart."""
    from tangentspace.mikktspace import corner_tangents

    seconds = []
    for _ in range(runs + 1):
        start = time.perf_counter()
        corner_tangents(mesh)
        seconds.append(time.perf_counter() - start)
    quartiles = (1e3 * np.percentile(seconds[1:], [25, 50, 75])).round(3).tolist()
    return {"mikktspace": {"first_s": seconds[0], "ms": quartiles}}


def _shuffled(mesh: Mesh) -> Mesh:
    """Return the mesh with vertices and faces in random order: the worst for caches."""
    rng = np.random.default_rng(0)
    order = rng.permutation(len(mesh.positions))
    faces = np.argsort(order)[rng.permutation(mesh.faces)].astype(np.int32)
    return Mesh(mesh.positions[order], mesh.normals[order], faces, np.asarray(mesh.uvs)[order])


if __name__ == "__main__":
    tyro.cli(bench_frames)
