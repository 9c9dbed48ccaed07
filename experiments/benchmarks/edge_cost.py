"""Time images with and without edges: ``python -m experiments.benchmarks.edge_cost --out F.json``.

A mesh over a floor, 512x512 pixels, antialiased with its shadow; the value and derivatives of the
mean square against another image, in all vertices. First with memory from the system for each
call, as any program has it, then with memory that is kept, as the fits have it. Run it on an
idle machine.
"""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from shadows.render import render
from shadows.silhouettes import MeshEdges, mesh_edges

from ..checks import check_out
from ..console import say_table, stage
from ..files.images import atomic_path
from ..memory import keep_freed_memory
from ..provenance import commit, device, versions
from ..scenes import load_scene
from .stages import measure

_IMAGE = (512, 512)
_MAPS = (256, 1024)
_SHIFT = np.array([0.05, 0.0, 0.02], np.float32)  # world units, of the other image's mesh


def bench(
    *,
    out: Annotated[Path, tyro.conf.arg(metavar="FILE", help="Where to write the figures, .json.")],
    mesh: Annotated[
        str, tyro.conf.arg(metavar="MESH", help="What stands on the floor.")
    ] = "sphere",
    runs: Annotated[int, tyro.conf.arg(help="Warm runs of each.")] = 15,
) -> None:
    """Time an image and its derivatives, with and without edges."""
    check_out(out, ".json")
    scene = load_scene(mesh)
    rows = []
    for memory in ("from the system", "kept"):
        if memory == "kept" and not keep_freed_memory():
            break
        for size in _MAPS:
            with stage(f"{mesh}, map {size}, memory {memory}"):
                measured = measure(_functions(scene, size), runs=runs)
            rows.append({"map": size, "memory": memory, **measured, **_ratios(measured)})
    made_with = {"versions": versions(), "device": device(), "commit": commit()}
    results = {"mesh": Path(mesh).stem, "faces": len(scene.mesh.faces), "rows": rows, **made_with}
    with atomic_path(out) as temporary:
        temporary.write_text(json.dumps(results, indent=1) + "\n", "utf-8")
    _print(results)


def _functions(scene: Any, size: int) -> dict[str, tuple[Callable, tuple]]:
    """Return what is timed: images and derivatives, of positions, an image and edges."""
    mesh, camera, light = jax.tree.map(jnp.asarray, (scene.mesh, scene.camera, scene.lights[0]))
    edges = jax.tree.map(jnp.asarray, mesh_edges(scene.mesh.positions, scene.mesh.faces))

    def image(positions: jax.Array, edges: MeshEdges | None) -> jax.Array:
        moved = mesh._replace(positions=positions)
        options = {"image_size": _IMAGE, "map_size": size}
        return render(moved, camera, light, **options, edges=edges).color

    def loss(positions: jax.Array, other: jax.Array, edges: MeshEdges | None) -> jax.Array:
        return jnp.mean((image(positions, edges) - other) ** 2)

    def change(positions: jax.Array, edges: MeshEdges | None) -> tuple[jax.Array, jax.Array]:
        way = (jnp.broadcast_to(_SHIFT, positions.shape),)
        return jax.jvp(lambda positions: image(positions, edges), (positions,), way)

    other = jax.jit(lambda *arguments: image(*arguments))(mesh.positions + _SHIFT, edges)
    functions: dict[str, tuple[Callable, tuple]] = {}
    for name, some in (("without", None), ("with", edges)):
        functions[f"image {name}"] = image, (mesh.positions, some)
        functions[f"gradient {name}"] = jax.value_and_grad(loss), (mesh.positions, other, some)
        functions[f"forward {name}"] = change, (mesh.positions, some)
    return functions


def _ratios(measured: dict[str, Any]) -> dict[str, float]:
    median = {name: row["ms"][1] for name, row in measured.items()}
    return {
        "with / without": median["image with"] / median["image without"],
        "gradient / image": median["gradient with"] / median["image with"],
    }


def _print(results: dict[str, Any]) -> None:
    names = ["image", "gradient", "forward"]
    cells = [f"{name} {some}" for name in names for some in ("without", "with")]
    say_table(
        f"{results['mesh']}, {results['faces']} faces, image {_IMAGE[0]}x{_IMAGE[1]}, without and "
        "with edges: median ms, seconds of compilation",
        ["map", "memory", *cells, "with / without", "gradient / image"],
        [
            [
                str(row["map"]),
                row["memory"],
                *(f"{row[cell]['ms'][1]:.1f}, {row[cell]['compile_s']:.0f}" for cell in cells),
                f"{row['with / without']:.2f}",
                f"{row['gradient / image']:.2f}",
            ]
            for row in results["rows"]
        ],
    )


if __name__ == "__main__":
    tyro.cli(bench)
