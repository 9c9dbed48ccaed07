"""Time every shadow technique: ``python -m experiments.benchmarks.techniques --out FILE.json``.

An image of 512 x 512 pixels with a map of 1024 x 1024 texels, both rasterizations kept:
what a technique costs from there on, with its gradient in a bias,
and the bytes that it keeps beside the map. What a filter prepares from the map
alone is timed apart. Run it on an idle machine.
"""

import json
import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import tyro
from jaxtyping import Array

from shadows.appearance import Appearance
from shadows.bias import AnalyticBias, Bias, CombinedBias, ConstantBias
from shadows.compare import SoftCompare
from shadows.filters import Filter
from shadows.layouts import Layout, SingleLayout
from shadows.light_map import LightMap, look_up_light, shade_with_light_map
from shadows.lights import Light, PointLight
from shadows.medium import Medium
from shadows.render import Rendering, shade
from shadows.shadow_map import ShadowMap, render_shadow_map
from shadows.shafts import add_shafts
from shadows.silhouettes import mesh_edges
from shadows.surface import Surface, render_surface
from shadows.visibility import default_bias, surface_visibility
from shadows.volumes import volume_visibility
from shadows.window_filters import BilinearFilter, PCFFilter, TentFilter

from ..baking.bake_light import bake_light_map
from ..checks import check_out
from ..console import say_table, stage
from ..files.images import atomic_path
from ..options import techniques
from ..provenance import commit, device, versions
from ..rendering.prepare_scene import prepare_scene
from ..scene import Scene
from ..scenes import load_scene
from .stages import measure

_IMAGE, _MAP = (512, 512), 1024
_SOFT = SoftCompare(0.5)
_WIDER = {"pcf 5x5": PCFFilter(2), "tent 5x5": TentFilter(2), "tent 7x7": TentFilter(3)}


def bench_techniques(
    *,
    out: Annotated[Path, tyro.conf.arg(metavar="FILE", help="Where to write the figures, .json.")],
    runs: Annotated[int, tyro.conf.arg(help="Warm runs of each.")] = 11,
) -> None:
    """Time filters, biases and layouts on the scene ``default``."""
    check_out(out, ".json")
    scene = prepare_scene(load_scene("default"))
    filters = {name: make() for name, make in _makers(Filter).items()} | _WIDER
    with_bias = {name: (filter, default_bias(filter)) for name, filter in filters.items()}
    biases = {"no bias": CombinedBias()} | {n: make() for n, make in _makers(Bias).items()}
    with_filter = {name: (BilinearFilter(), bias) for name, bias in biases.items()}
    rows = {
        "filters": _rows(scene, "bilinear", with_bias, runs),
        "biases": _rows(scene, "no bias", with_filter, runs),
        "layouts": _layouts(scene, runs),
        "other ways": _others(scene, runs),
    }
    made_with = {"versions": versions(), "device": device(), "commit": commit()}
    with atomic_path(out) as temporary:
        temporary.write_text(json.dumps(rows | made_with, indent=1) + "\n", "utf-8")
    for kind in ("filters", "biases", "layouts", "other ways"):
        _print(kind, rows[kind])


def _makers(base: type) -> dict[str, Callable[[], Any]]:
    return dict(techniques(base))


def _rows(
    scene: Scene, reference: str, chosen: Mapping[str, tuple[Filter, Bias]], runs: int
) -> list[dict[str, Any]]:
    rows = []
    base = None
    names = [reference, *(name for name in chosen if name != reference)]
    for name in names:
        with stage(f"timing {name}"):
            first = _time(scene, {reference: chosen[reference], name: chosen[name]}, runs)
        base = first[reference]["image"]["ms"][1]
        row = first[name]
        rows.append({"technique": name, **row, "image / reference": row["image"]["ms"][1] / base})
    return rows


def _time(
    scene: Scene, chosen: Mapping[str, tuple[Filter, Bias]], runs: int
) -> dict[str, dict[str, Any]]:
    """Time some techniques in turn."""
    functions, prepared_bytes = {}, {}
    for name, (filter, bias) in chosen.items():
        kept = _kept(scene, scene.lights[0], SingleLayout(), filter, bias)
        prepare, image, loss = _functions(scene.lights[0], filter, bias)
        surface, shadow_map = kept
        prepared = jax.jit(prepare)(shadow_map)
        leaves = [leaf for leaf in jax.tree.leaves(prepared) if eqx.is_array(leaf)]
        prepared_bytes[name] = int(sum(leaf.nbytes for leaf in leaves))
        gain = jnp.float32(1.0)
        functions |= {
            f"{name}: prepare": (prepare, (shadow_map,)),
            f"{name}: image": (image, (surface, prepared)),
            f"{name}: loss": (loss, (gain, surface, prepared)),
            f"{name}: gradient": (jax.value_and_grad(loss), (gain, surface, prepared)),
        }
    measured = measure(functions, runs=runs)
    parts = ("prepare", "image", "loss", "gradient")
    return {
        name: {part: measured[f"{name}: {part}"] for part in parts}
        | {
            "kept_bytes": prepared_bytes[name],
            "gradient / loss": measured[f"{name}: gradient"]["ms"][1]
            / measured[f"{name}: loss"]["ms"][1],
        }
        for name in chosen
    }


def _kept(
    scene: Scene, light: Light, layout: Layout, filter: Filter, bias: Bias
) -> tuple[Surface, ShadowMap]:
    """Make the two passes that a fit or an animation of the bias keeps."""

    @eqx.filter_jit
    def passes(mesh: Any, camera: Any, light: Light) -> tuple[Surface, ShadowMap]:
        matrices = layout.matrices(
            light, mesh.positions, camera, aspect=1.0, map_size=_MAP, reach=filter.reach()
        )
        shadow_map = render_shadow_map(
            mesh.positions, mesh.faces, matrices, map_size=_MAP, casters=bias.casters
        )
        return render_surface(mesh, camera, image_size=_IMAGE), shadow_map

    return passes(*jax.tree.map(jnp.asarray, (scene.mesh, scene.camera, light)))


def _functions(light: Light, filter: Filter, bias: Bias) -> tuple[Any, Any, Any]:
    """Return what prepares, what shades the image, and a loss that has a gradient."""
    light = jax.tree.map(jnp.asarray, light)

    def visibility(bias: Bias, filter: Filter, surface: Surface, prepared: Any) -> Array:
        shadow_map, of_filter = prepared
        how = {"bias": bias, "filter": filter, "compare": _SOFT, "prepared": of_filter}
        return surface_visibility(surface, light, shadow_map, **how)

    def prepare(shadow_map: ShadowMap) -> Any:
        return shadow_map, filter.prepare(bias.prepare(shadow_map))

    def image(surface: Surface, prepared: Any) -> Array:
        return shade(surface, (light,), (visibility(bias, filter, surface, prepared),))

    def loss(gain: Array, surface: Surface, prepared: Any) -> Array:
        # Every technique takes a constant bias, so one number moves them all.
        both = CombinedBias((bias, ConstantBias(gain * 1e-3)))
        return jnp.mean((visibility(both, filter, surface, prepared) - 0.5) ** 2)

    return prepare, image, loss


def _layouts(scene: Scene, runs: int) -> list[dict[str, Any]]:
    """Time the light pass and the image under each layout, with a lamp for the cube."""
    rows = []
    filter, bias = BilinearFilter(), AnalyticBias()
    for name, cls in _makers(Layout).items():
        lamp = PointLight(np.array([0.3, 1.1, 0.2], np.float32))
        light = lamp if name == "cube" else scene.lights[0]
        layout = cls()
        with stage(f"timing {name}"):
            surface, shadow_map = _kept(scene, light, layout, filter, bias)
            prepare, image, _ = _functions(light, filter, bias)

            def draw(mesh: Any, matrices: Array) -> ShadowMap:
                return render_shadow_map(mesh.positions, mesh.faces, matrices, map_size=_MAP)

            mesh = jax.tree.map(jnp.asarray, scene.mesh)
            functions = {
                "light pass": (draw, (mesh, shadow_map.clip_from_world)),
                "image": (image, (surface, prepare(shadow_map))),
            }
            rows.append(
                {
                    "technique": name,
                    "maps": int(np.prod(shadow_map.depth.shape[:-2])),
                    "kept_bytes": int(shadow_map.depth.nbytes),
                    **measure(functions, runs=runs),
                }
            )
    return rows


def _others(scene: Scene, runs: int) -> list[dict[str, Any]]:
    """Time an image whose shadows need no map or more than one lookup, the eye's pass kept."""
    light, bias = scene.lights[0], AnalyticBias()
    surface, shadow_map = _kept(scene, light, SingleLayout(), BilinearFilter(), bias)
    with stage("baking a light map"):
        start = time.perf_counter()
        bake = bake_light_map(scene, size=_IMAGE[0])
        seconds = time.perf_counter() - start
    mesh, camera, light = jax.tree.map(jnp.asarray, (scene.mesh, scene.camera, light))
    unwrapped, light_map = jax.tree.map(jnp.asarray, (bake.scene.mesh, bake.light_map))
    unwrapped_surface = jax.jit(partial(render_surface, image_size=_IMAGE))(unwrapped, camera)
    edges = mesh_edges(scene.mesh.positions, scene.mesh.faces)
    prepare, image, _ = _functions(light, BilinearFilter(), bias)

    def each_frame(surface: Surface, mesh: Any) -> Array:
        matrix = light.clip_from_world(mesh.positions)
        drawn = render_shadow_map(mesh.positions, mesh.faces, matrix, map_size=_MAP)
        return image(surface, prepare(drawn))

    def by_light_map(surface: Surface, mesh: Any, light_map: LightMap) -> Array:
        return shade_with_light_map(surface, look_up_light(mesh, surface, light_map))

    def by_volumes(surface: Surface, mesh: Any) -> Array:
        visibility = volume_visibility(mesh, camera, surface, light, edges=edges)
        return shade(surface, (light,), (visibility,))

    def with_shafts(surface: Surface, shadow_map: ShadowMap) -> Array:
        color = image(surface, prepare(shadow_map))
        drawn = Rendering(color, (), surface, Appearance(surface.normal), (shadow_map,))
        return add_shafts(drawn, camera, light, Medium(0.2), background_distance=6.0).color

    measured = measure(
        {
            "shadow map, drawn each frame": (each_frame, (surface, mesh)),
            "light map": (by_light_map, (unwrapped_surface, unwrapped, light_map)),
            "shadow volumes": (by_volumes, (surface, mesh)),
            "map kept, shafts of 32 steps": (with_shafts, (surface, shadow_map)),
        },
        runs=runs,
    )
    kept = {
        "light map": np.asarray(light_map.texels).nbytes,
        "map kept, shafts of 32 steps": shadow_map.depth.nbytes,
    }
    rows = [
        {"technique": name, "kept_bytes": int(kept.get(name, 0)), "image": row}
        for name, row in measured.items()
    ]
    rows[1]["bake_s"] = seconds
    return rows


def _print(kind: str, rows: list[dict[str, Any]]) -> None:
    def spread(row: Mapping[str, Any], part: str) -> str:
        return "{1:.1f} ({0:.1f}-{2:.1f})".format(*row[part]["ms"]) if part in row else ""

    parts = [p for p in ("prepare", "light pass", "image", "loss", "gradient") if p in rows[0]]
    ratios = [r for r in ("image / reference", "gradient / loss") if r in rows[0]]
    say_table(
        f"{kind}: image {_IMAGE[0]}x{_IMAGE[1]}, map {_MAP}, passes kept; ms: median (quartiles)",
        ["technique", *parts, *ratios, "kept MB", "compile s"],
        [
            [
                row["technique"],
                *(spread(row, part) for part in parts),
                *(f"{row[ratio]:.2f}" for ratio in ratios),
                f"{row['kept_bytes'] / 1e6:.1f}",
                f"{row['image']['compile_s']:.1f}",
            ]
            for row in rows
        ],
    )


if __name__ == "__main__":
    tyro.cli(bench_techniques)
