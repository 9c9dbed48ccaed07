"""Time the stages: ``python -m experiments.benchmarks.stages --out FILE.json [--mesh MESH]``.

Compilation apart from warm runs, quartiles of many runs, compared things interleaved, peak
memory of the compiled program beside the time. Run it on an idle machine.
"""

import json
import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from shadows.bias import CombinedBias, ConstantBias, SlopeBias
from shadows.compare import SoftCompare
from shadows.lights import Light
from shadows.rasterize import rasterize
from shadows.render import Rendering, render
from shadows.transforms import Camera, transform_points
from shadows.window_filters import BilinearFilter
from tangentspace.mesh import Mesh
from tangentspace.shading import BlinnPhongShading
from tangentspace.shapes import icosphere, merge, plane, transform_mesh

from ..bias_fits.bias_study import Trial, prepare_study, with_target
from ..checks import check_out
from ..console import say_table, stage
from ..files.framing import frame_mesh
from ..files.images import atomic_path
from ..provenance import commit, device, versions
from ..scene import Scene
from ..scenes import load_scene

_IMAGE = (512, 512)
_MAP = 1024


def bench(
    *,
    out: Annotated[Path, tyro.conf.arg(metavar="FILE", help="Where to write the figures, .json.")],
    mesh: Annotated[
        str | None, tyro.conf.arg(metavar="MESH", help="A large mesh to time as well.")
    ] = None,
    runs: Annotated[int, tyro.conf.arg(help="Warm runs of each.")] = 21,
) -> None:
    """Time rasterization, rendering and the gradient in a bias."""
    check_out(out, ".json")
    scenes = {"sphere": load_scene("sphere"), "spheres": _spheres()}
    if mesh is not None:
        scenes = {
            Path(mesh).stem: load_scene(mesh),
            f"8 x {Path(mesh).stem}": _eight(mesh),
        } | scenes
    results: dict[str, Any] = {"rasterize": [], "render": []}
    for name, scene in scenes.items():
        with stage(f"rasterizing {name}"):
            results["rasterize"] += [{"scene": name, **row} for row in _time_rasterize(scene, runs)]
        with stage(f"rendering {name}"):
            results["render"].append({"scene": name, **_time_render(scene, runs)})
    made_with = {"versions": versions(), "device": device(), "commit": commit()}
    with atomic_path(out) as temporary:
        temporary.write_text(json.dumps({**results, **made_with}, indent=1) + "\n", "utf-8")
    _print(results)


def measure(functions: Mapping[str, tuple[Callable, tuple]], *, runs: int) -> dict[str, Any]:
    """Time functions in turn, so that a change of the machine's speed meets all of them.

    Args:
        functions: What to compile and the arguments to call it with.
        runs: Warm calls of each.

    Returns:
        For each: quartiles of the milliseconds of a warm call, seconds of compilation, and
        the bytes that the compiled program needs beside arguments and results.
    """
    compiled, results = {}, {}
    for name, (function, arguments) in functions.items():
        start = time.perf_counter()
        compiled[name] = jax.jit(function).lower(*arguments).compile()
        results[name] = {"compile_s": time.perf_counter() - start}
        memory = compiled[name].memory_analysis()
        results[name]["temporary_bytes"] = getattr(memory, "temp_size_in_bytes", None)
        jax.block_until_ready(compiled[name](*arguments))
    times: dict[str, list[float]] = {name: [] for name in functions}
    for _ in range(runs):
        for name, (_, arguments) in functions.items():
            start = time.perf_counter()
            jax.block_until_ready(compiled[name](*arguments))
            times[name].append(1e3 * (time.perf_counter() - start))
    for name, milliseconds in times.items():
        low, median, high = np.percentile(milliseconds, [25, 50, 75])
        results[name] |= {"ms": [round(float(t), 3) for t in (low, median, high)]}
    return results


def _time_rasterize(scene: Scene, runs: int) -> list[dict[str, Any]]:
    """Time the light's pass at four sizes."""
    positions, faces = jnp.asarray(scene.mesh.positions), jnp.asarray(scene.mesh.faces)
    clip = transform_points(scene.lights[0].clip_from_world(positions), positions)
    sizes = (256, 512, 1024, 2048)
    functions = {
        str(size): (partial(rasterize, image_size=(size, size)), (clip, faces)) for size in sizes
    }
    measured = measure(functions, runs=runs)
    return [{"faces": len(scene.mesh.faces), "size": size, **measured[str(size)]} for size in sizes]


def _time_render(scene: Scene, runs: int) -> dict[str, Any]:
    """Time the whole image, its two rasterizations, and value and gradient over kept passes."""
    arrays = jax.tree.map(jnp.asarray, (scene.mesh, scene.camera, scene.lights[0]))
    bias = jax.tree.map(jnp.float32, CombinedBias((ConstantBias(0.001), SlopeBias(1.0))))
    soft, lookup = SoftCompare(jnp.float32(0.5)), BilinearFilter()

    def passes(mesh: Mesh, camera: Camera, light: Light) -> tuple:
        light_clip = transform_points(light.clip_from_world(mesh.positions), mesh.positions)
        eye_clip = transform_points(camera.clip_from_world(1.0), mesh.positions)
        return (
            rasterize(light_clip, mesh.faces, image_size=(_MAP, _MAP)),
            rasterize(eye_clip, mesh.faces, image_size=_IMAGE),
        )

    def whole(mesh: Mesh, camera: Camera, light: Light, bias: CombinedBias) -> Rendering:
        return render(
            mesh,
            camera,
            light,
            image_size=_IMAGE,
            map_size=_MAP,
            bias=bias,
            filter=lookup,
            compare=soft,
        )

    study = prepare_study(
        scene, image_size=_IMAGE, map_size=_MAP, filter=lookup, shading=BlinnPhongShading()
    )
    trial = with_target(study, study.picture(study.truth.astype(np.float32))).trial

    def loss(bias: CombinedBias, trial: Trial) -> jax.Array:
        return jnp.mean(trial.goal.residual(trial.visibility(bias, lookup, soft)) ** 2)

    measured = measure(
        {
            "two rasterizations": (passes, arrays),
            "whole image": (whole, (*arrays, bias)),
            "loss, passes kept": (loss, (bias, trial)),
            "loss and gradient": (jax.value_and_grad(loss), (bias, trial)),
        },
        runs=runs,
    )
    median = {name: row["ms"][1] for name, row in measured.items()}
    return {
        "faces": len(scene.mesh.faces),
        **measured,
        "image / rasterizations": median["whole image"] / median["two rasterizations"],
        "gradient / loss": median["loss and gradient"] / median["loss, passes kept"],
    }


def _spheres() -> Scene:
    """Twenty-five spheres over a floor, half a million faces."""
    ball = icosphere(0.16, subdivisions=5)
    matrices = [np.eye(4) for _ in range(25)]
    for index, matrix in enumerate(matrices):
        matrix[:3, 3] = [0.4 * (index % 5) - 0.8, 0.3, 0.4 * (index // 5) - 0.8]
    scene = load_scene("sphere")
    parts = [plane(2.0), *(transform_mesh(ball, matrix) for matrix in matrices)]
    return scene._replace(mesh=merge(*parts), name="spheres")


def _eight(path: str) -> Scene:
    """Eight of a mesh side by side, framed as one."""
    scene = load_scene(path)
    # The last two faces and four vertices are the floor that a lone mesh is put on.
    positions, normals = scene.mesh.positions[:-4], scene.mesh.normals[:-4]
    faces = scene.mesh.faces[:-2]
    width = 1.05 * np.max(np.ptp(positions, axis=0))
    offsets = [np.array([k % 4, 0, k // 4], np.float32) * np.float32(width) for k in range(8)]
    mesh = Mesh(
        np.concatenate([positions + offset for offset in offsets]),
        np.tile(normals, (8, 1)),
        np.concatenate([faces + k * len(positions) for k in range(8)]).astype(np.int32),
    )
    return frame_mesh(mesh, scene.name, ())


def _print(results: Mapping[str, Any]) -> None:
    def spread(row: Mapping[str, Any]) -> str:
        low, median, high = row["ms"]
        return f"{median:.1f} ({low:.1f}-{high:.1f})"

    say_table(
        "depth and face ids from the light, ms: median (quartiles)",
        ["scene", "faces", "size", "ms", "compile s", "temporary MB"],
        [
            [
                row["scene"],
                str(row["faces"]),
                str(row["size"]),
                spread(row),
                f"{row['compile_s']:.1f}",
                f"{(row['temporary_bytes'] or 0) / 1e6:.0f}",
            ]
            for row in results["rasterize"]
        ],
    )
    timed = ["two rasterizations", "whole image", "loss, passes kept", "loss and gradient"]
    ratios = ["image / rasterizations", "gradient / loss"]
    say_table(
        f"image {_IMAGE[0]}x{_IMAGE[1]}, map {_MAP}, soft 2x2 comparison, ms: median (quartiles)",
        ["scene", "faces", *timed, *ratios],
        [
            [
                row["scene"],
                str(row["faces"]),
                *(spread(row[name]) for name in timed),
                *(f"{row[name]:.2f}" for name in ratios),
            ]
            for row in results["render"]
        ],
    )


if __name__ == "__main__":
    tyro.cli(bench)
