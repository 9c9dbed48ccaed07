"""Rows about maps and fits: mips of normals, light maps, and what a fit's gradient is worth."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.ndimage import minimum_filter

from shadows import (
    BilinearFilter,
    ConstantBias,
    HardCompare,
    NearestFilter,
    SlopeBias,
    SoftCompare,
    look_up,
    look_up_light,
)
from shadows.light_map import LightMap
from tangentspace._math import dot

from ..baking.bake_light import LightBake, bake_light_map
from ..benchmarks.normal_mips import bump_maps, relative_errors
from ..scenes import load_scene
from ..truth.rays import trace_visibility
from .cells import Cell, not_finite
from .shadow_rows import IMAGE, MAP, look
from .views import View, on_device, quick, view_of

SOFTNESSES = (1e-6, 1e-4, 1e-2, 0.1, 0.5, 1.0, 3.0, 10.0, 100.0)
_STEPS, _RATE = 400, 0.05


def glossy_mips(dtype: Any) -> list[Cell]:
    """Row 40: highlights of exponent 100 where a pixel covers four texels."""
    base = Cell(40, "glossy-bumps", "", np.dtype(dtype).name, "relative RMSE", 0.0, 0.5)
    maps = {"bumps": jnp.asarray(bump_maps(128)["bumps"], dtype)}
    errors = relative_errors(maps, 4.0, (100.0,), pixels=24)
    said = "keeps a mirror's highlight"
    cells = []
    for name, figures in errors.items():
        value = float(figures[0, 0])
        plain = said if name.startswith("mean") else ""
        cells.append(
            base._replace(
                technique=name,
                value=value,
                said=plain,
                values_not_finite=not_finite(figures),
                note="the benchmark's bumps in float32, 4 texels to a pixel, exponent 100",
            )
        )
    return cells


def light_map_seams(dtype: Any) -> list[Cell]:
    """Row 41: light of a map against rays, near the edges of charts and away from shadows'."""
    scene = load_scene("no-gutter")
    base = Cell(41, scene.name, "", np.dtype(dtype).name, "error at chart edges", 0.0, 0.02)
    bare = scene._replace(mesh=scene.mesh._replace(uvs=None))
    cells = []
    for name, bake, said in (
        ("no gutter, no margin", bake_light_map(scene, size=32, margin=0), "charts touch"),
        ("no gutter, margin 4", bake_light_map(scene, size=32, margin=4), "charts touch"),
        ("gutter, no margin", bake_light_map(bare, size=32, margin=0), "nothing round a chart"),
        ("gutter, margin 4", bake_light_map(bare, size=32, margin=4), ""),
    ):
        found, texels = _at_edges(bake, dtype)
        cells.append(
            base._replace(
                technique=name,
                value=found,
                said=said,
                values_not_finite=not_finite(texels),
                note="a map of 32 texels; mean difference of light at the edges of faces",
            )
        )
    return cells


def _at_edges(bake: LightBake, dtype: Any) -> tuple[float, np.ndarray]:
    seen = view_of(bake.scene, None, dtype, image=IMAGE, map_size=MAP)
    surface, light = seen.surface, seen.light
    lit = trace_visibility(*seen.points(), light, seen.occluders())
    cosine = np.clip(np.asarray(dot(surface.face_normal, light.to_light(surface.position))), 0, 1)
    truth = lit * cosine
    mesh = bake.scene.mesh._replace(tangents=None)
    texels, uvs = (jnp.asarray(x, dtype) for x in bake.light_map)
    found = np.asarray(look_up_light(mesh, surface, LightMap(texels, uvs)))[..., 0]
    covered = np.asarray(surface.covered)
    apart = minimum_filter(lit.astype(int), size=5) == (-minimum_filter(-lit.astype(int), size=5))
    edge = covered & apart & (np.asarray(surface.weights).min(axis=-1) < 0.04)
    return float(np.abs(found - truth)[edge].mean()), found


def hard_gradient(dtype: Any) -> list[Cell]:
    """Row 42: whether the derivative of acne in a bias is exactly zero."""
    seen = view_of(load_scene("tilted-plane"), None, dtype)
    base = Cell(42, "tilted-plane", "", np.dtype(dtype).name, "share of zero slopes", 0.0, 0.5)
    cells = []
    for name, compare, said in (
        ("hard", HardCompare(), "a step has no slope"),
        ("soft 0.5", SoftCompare(0.5), ""),
        ("soft 0", SoftCompare(0.0), "a step has no slope"),
    ):
        slopes = []
        for length in (0.0, 0.01, 0.02, 0.05):
            slopes.append(_slope(on_device(compare, dtype), jnp.asarray(length, dtype), seen))
        cells.append(
            base._replace(
                technique=name,
                value=float(np.mean(np.array(slopes) == 0)),
                said=said,
                slopes_not_finite=not_finite(slopes),
                note=f"dL/db at no bias: {slopes[0]:.3g} of visibility per unit",
            )
        )
    return cells


def _slope(compare: Any, length: jax.Array, seen: View) -> float:
    return float(_mean_slope(compare, length, seen.seen, seen.facing))


@quick
def _mean_slope(compare: Any, length: jax.Array, seen: Any, facing: jax.Array) -> jax.Array:
    def mean(length: jax.Array) -> jax.Array:
        moved = ConstantBias(length)(seen.receiver)
        return jnp.mean(
            jnp.where(
                facing, look_up(seen.two, moved, filter=BilinearFilter(), compare=compare), 0.0
            )
        )

    return jax.grad(mean)(length)


def fits(dtype: Any) -> list[Cell]:
    """Row 43: what biases fitted at each softness get wrong that the closed form gets right."""
    seen = view_of(load_scene("contact-wall"), None, dtype)
    sight = look(seen)
    base = Cell(43, "contact-wall", "", np.dtype(dtype).name, "error over closed form", 0.0, 0.02)
    truth = jnp.asarray(sight.truth, dtype)
    cells = []
    for softness in SOFTNESSES:
        factor, slope = _fitted(jnp.asarray(softness, dtype), truth, seen.seen, seen.facing)
        error = [_hard_error(x, truth, seen.seen, seen.facing) for x in (factor, 1 + 0 * factor)]
        far = softness < 1e-2 or softness > 1
        cells.append(
            base._replace(
                technique=f"soft {softness:g}",
                value=float(error[0] - error[1]),
                said=("vanishing slopes" if softness < 1e-2 else "over-soft") if far else "",
                values_not_finite=not_finite(factor),
                slopes_not_finite=not_finite(slope),
                note=f"{_STEPS} steps of Adam from no bias; factor {float(factor):.3g}, the "
                f"closed form 1; slope at the start {float(slope):.2g}",
            )
        )
    return cells


@quick
def _hard_error(factor: jax.Array, truth: jax.Array, seen: Any, facing: jax.Array) -> jax.Array:
    moved = SlopeBias(factor)(seen.receiver)
    lit = look_up(seen.two, moved, filter=NearestFilter(), compare=HardCompare())
    return jnp.sum(jnp.where(facing, jnp.abs(lit - truth), 0)) / jnp.sum(facing)


@quick
def _fitted(
    softness: jax.Array, truth: jax.Array, seen: Any, facing: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Return the fitted factor of a slope bias under nearest lookup, and the first slope."""

    def loss(factor: jax.Array) -> jax.Array:
        moved = SlopeBias(factor)(seen.receiver)
        compare = SoftCompare(softness)
        lit = look_up(seen.two, moved, filter=NearestFilter(), compare=compare)
        return jnp.mean(jnp.where(facing, (lit - truth) ** 2, 0.0))

    def step(state: Any, k: jax.Array) -> tuple[Any, Any]:
        factor, mean, square = state
        slope = jax.grad(loss)(factor)
        mean, square = 0.9 * mean + 0.1 * slope, 0.99 * square + 0.01 * slope**2
        fair = square / (1 - 0.99 ** (k + 1))
        safe = jnp.where(fair > 0, jnp.sqrt(jnp.where(fair > 0, fair, 1)), 1)
        return (factor - _RATE * mean / (1 - 0.9 ** (k + 1)) / safe, mean, square), slope

    zero = jnp.zeros_like(softness)
    steps = jnp.arange(_STEPS, dtype=softness.dtype)
    (factor, _, _), slopes = jax.lax.scan(step, (zero, zero, zero), steps)
    return factor, slopes[0]
