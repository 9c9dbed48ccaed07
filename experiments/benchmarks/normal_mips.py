"""Judge the mips of normal maps: ``python -m experiments.benchmarks.normal_mips --out FILE.json``.

Highlights of bumpy planes, seen so that a pixel covers a fraction of a texel up to sixteen,
by five ways to filter the map, against the mean over many points in each pixel. Errors are
root mean squares over pixels and lights, relative to that of the truth. The chart goes
beside the file, under the same name.
"""

import functools
import json
from pathlib import Path
from typing import Annotated, NamedTuple

import jax
import jax.numpy as jnp
import matplotlib.figure
import numpy as np
import tyro
from jaxtyping import Array, Float

from tangentspace._math import safe_normalize
from tangentspace.lighting import blinn_phong
from tangentspace.mips import build_mips, sample_trilinear, texel_footprint
from tangentspace.normal_filtering import build_normal_mips, mean_length, toksvig_gloss
from tangentspace.normal_map import (
    decode_normals,
    encode_normals,
    normals_from_heights,
    normals_from_slopes,
    scale_normals,
    slopes_from_normals,
)
from tangentspace.texture import sample_bilinear

from ..checks import check_out
from ..console import say_table, stage
from ..files.images import atomic_path, linear_to_srgb
from ..provenance import commit, device, versions

FOOTPRINTS = (0.25, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0)
SHININESS = (30.0, 100.0, 500.0)
STYLES = {
    "mean, not normalized": ("0.55", "s", ":"),
    "mean, normalized": ("#e69f00", "D", "--"),
    "LEAN, one exponent": ("#cc79a7", "^", "-."),
    "Toksvig, whole length": ("#009e73", "v", "--"),
    "Toksvig, as here": ("#0072b2", "o", "-"),
}
_MAP_SIZE, _PIXELS, _TURN, _RMS_TILT = 256, 48, 0.3, 12.0
# Directions to light and camera; the last pair misses the mean normal's highlight.
_PAIRS = (
    ((0.3, 0.2, 1.0), (-0.2, -0.1, 1.0)),
    ((0.8, 0.3, 0.7), (-0.7, -0.3, 0.7)),
    ((0.0, 0.6, 0.8), (0.1, -0.2, 1.0)),
    ((0.4, -0.3, 1.0), (0.3, 0.1, 1.0)),
)


class Filtered(NamedTuple):
    """What a filter makes of a map: a normal and a length of the mean for each pixel."""

    normal: Float[Array, "height width 3"]
    length: Float[Array, "height width"] | float = 1.0


class Grid(NamedTuple):
    """Where pixels of a plane lie in its texture."""

    uvs: Float[Array, "height width 2"]
    uv_dx: Float[Array, "height width 2"]
    uv_dy: Float[Array, "height width 2"]


def bump_maps(size: int = _MAP_SIZE) -> dict[str, Float[Array, "size size 3"]]:
    """Return texels of four maps whose normals lean by 12 degrees, in the root mean square."""
    rng = np.random.default_rng(0)
    frequency = np.abs(np.fft.fftfreq(size) * 256)  # cycles in 256 texels

    def noise(low: float, high: float, stretch: float = 1.0) -> np.ndarray:
        radius = np.hypot(stretch * frequency[:, None], frequency)
        kept = (low <= radius) & (radius < high)
        return np.fft.ifft2(np.fft.fft2(rng.normal(size=(size, size))) * kept).real

    waves = np.abs(np.sin(np.pi / 16 * np.arange(size)))
    heights = {
        "bumps": noise(1.0, 24.0),
        "grain": noise(30.0, 90.0),
        "scratches": noise(20.0, 90.0, stretch=6.0),
        "quilt": np.sqrt(waves[:, None] * waves),
    }
    maps = {}
    for name, height in heights.items():
        slopes = slopes_from_normals(normals_from_heights(height.astype(np.float32))).slopes
        steepness = jnp.sqrt(jnp.mean(jnp.sum(slopes**2, axis=-1)))
        leaning = slopes * (jnp.tan(jnp.deg2rad(_RMS_TILT)) / steepness)
        maps[name] = encode_normals(normals_from_slopes(leaning))
    return maps


def pixel_grid(footprint: float, *, pixels: int = _PIXELS, size: int = _MAP_SIZE) -> Grid:
    """Return square pixels whose sides are so many texels long, turned a little."""
    cosine, sine = np.cos(_TURN), np.sin(_TURN)
    steps = np.array([[cosine, sine], [sine, -cosine]], np.float32) * (footprint / size)
    column, row = np.meshgrid(np.arange(pixels) + 0.5, np.arange(pixels) + 0.5)
    uvs = np.stack([column, row], axis=-1).astype(np.float32) @ steps + np.float32(0.123)
    across, down = (np.broadcast_to(step, uvs.shape) for step in steps)
    return Grid(jnp.asarray(uvs), jnp.asarray(across), jnp.asarray(down))


@jax.jit
def filters(texels: Float[Array, "size size 3"], grid: Grid) -> dict[str, Filtered]:
    """Return what each filter makes of a map, by its name."""
    mean = decode_normals(sample_trilinear(build_normal_mips(texels), *grid))
    footprint = texel_footprint(grid.uv_dx, grid.uv_dy, (len(texels), len(texels)))
    slopes = slopes_from_normals(decode_normals(texels)).slopes
    moments = build_mips(jnp.concatenate([slopes, slopes**2], axis=-1))
    first, second = jnp.split(sample_trilinear(moments, *grid), 2, axis=-1)
    variance = jnp.maximum(jnp.mean(second - first**2, axis=-1), 0)
    normal = safe_normalize(mean)
    results = (
        Filtered(mean),
        Filtered(normal),
        Filtered(normals_from_slopes(first), 1 / (1 + variance)),
        Filtered(normal, mean_length(mean)),
        Filtered(normal, mean_length(mean, footprint=footprint)),
    )
    return dict(zip(STYLES, results, strict=True))


class Lighting(NamedTuple):
    """Unit directions to light and camera, the same for all pixels or for each its own."""

    to_light: Float[Array, "*cases 3"]
    to_camera: Float[Array, "*cases 3"]


def four_lights() -> Lighting:
    """Return four pairs of directions, one of which misses the mean normal's highlight."""
    vectors = np.array(_PAIRS, np.float32)
    vectors /= np.linalg.norm(vectors, axis=-1, keepdims=True)
    return Lighting(*jnp.asarray(np.moveaxis(vectors, 1, 0)))


def highlights(
    filtered: Filtered, lighting: Lighting, shininess: tuple[float, ...]
) -> Float[Array, "cases exponents height width"]:
    """Shade white Blinn-Phong highlights on black, with the exponents that a filter asks for."""

    def one(to_light: Array, to_camera: Array, exponent: Array) -> Array:
        gloss = toksvig_gloss(filtered.length, exponent)
        return blinn_phong(
            filtered.normal,
            to_light,
            to_camera,
            ambient=0.0,
            albedo=0.0,
            specular=1.0,
            shininess=exponent,
            gloss=gloss,
        )[..., 0]

    over_exponents = jax.vmap(one, in_axes=(None, None, 0))
    return jax.vmap(over_exponents, in_axes=(0, 0, None))(
        *lighting, jnp.asarray(shininess, jnp.float32)
    )


@functools.partial(jax.jit, static_argnames="shininess")
def supersampled(
    texels: Float[Array, "size size 3"],
    grid: Grid,
    offsets: Float[Array, "samples 2"],
    lighting: Lighting,
    shininess: tuple[float, ...],
) -> Float[Array, "cases exponents height width"]:
    """Return highlights averaged over points in each pixel."""
    normals = scale_normals(decode_normals(texels), 1.0)

    def add(total: Array, offset: Array) -> tuple[Array, None]:
        uvs = grid.uvs + offset[0] * grid.uv_dx + offset[1] * grid.uv_dy
        sample = Filtered(safe_normalize(sample_bilinear(normals, uvs)))
        return total + highlights(sample, lighting, shininess), None

    shape = (len(lighting.to_light), len(shininess), *grid.uvs.shape[:2])
    return jax.lax.scan(add, jnp.zeros(shape, texels.dtype), offsets)[0] / len(offsets)


def offsets_in_pixel(footprint: float) -> Float[np.ndarray, "samples 2"]:
    """Return points in a pixel, two to a texel on each side and at least four."""
    count = max(4, round(2 * footprint))
    places = ((np.arange(count) + 0.5) / count - 0.5).astype(np.float32)
    return np.stack(np.meshgrid(places, places), axis=-1).reshape(-1, 2)


def relative_errors(
    maps: dict[str, Float[Array, "size size 3"]],
    footprint: float,
    shininess: tuple[float, ...],
    *,
    pixels: int = _PIXELS,
) -> dict[str, Float[np.ndarray, "maps exponents"]]:
    """Return the root mean square error of each filter, relative to that of the truth."""
    lighting, offsets = four_lights(), offsets_in_pixel(footprint)
    errors = {name: [] for name in STYLES}
    for texels in maps.values():
        grid = pixel_grid(footprint, pixels=pixels, size=len(texels))
        truth = np.asarray(supersampled(texels, grid, offsets, lighting, shininess))
        for name, filtered in filters(texels, grid).items():
            error = np.asarray(_highlights(filtered, lighting, shininess)) - truth
            errors[name].append(np.sqrt(_mean(error**2) / _mean(truth**2)))
    return {name: np.array(rows) for name, rows in errors.items()}


_highlights = jax.jit(highlights, static_argnames="shininess")


def _mean(squares: np.ndarray) -> np.ndarray:
    """Average over lights and pixels."""
    return squares.mean(axis=(0, 2, 3))


def normal_mips_error(
    *,
    out: Annotated[Path, tyro.conf.arg(metavar="FILE", help="Where to write the figures, .json.")],
) -> None:
    """Compare ways to filter normal maps with supersampling."""
    check_out(out, ".json")
    maps, errors = bump_maps(), []
    for footprint in FOOTPRINTS:
        with stage(f"pixels of {footprint:g} texels"):
            errors.append(relative_errors(maps, footprint, SHININESS))
    table = {name: np.sqrt([np.mean(e[name] ** 2, axis=0) for e in errors]) for name in STYLES}
    with stage("chart"):
        _save_chart(out.with_suffix(".png"), table, maps["bumps"])
    record = {
        "footprints": FOOTPRINTS,
        "shininess": SHININESS,
        "maps": list(maps),
        "relative_rmse": {name: rows.round(4).tolist() for name, rows in table.items()},
        "by_map": {
            name: np.stack([e[name] for e in errors], axis=1).round(4).tolist() for name in STYLES
        },
    }
    made_with = {"versions": versions(), "device": device(), "commit": commit()}
    with atomic_path(out) as temporary:
        temporary.write_text(json.dumps({**record, **made_with}, indent=1) + "\n", "utf-8")
    for column, exponent in enumerate(SHININESS):
        say_table(
            f"relative error of the highlight, exponent {exponent:g}; texels per pixel:",
            ["filter", *(f"{footprint:g}" for footprint in FOOTPRINTS)],
            [[name, *(f"{x:.3f}" for x in table[name][:, column])] for name in STYLES],
        )


def _save_chart(
    path: Path,
    table: dict[str, Float[np.ndarray, "footprints exponents"]],
    texels: Float[Array, "size size 3"],
) -> None:
    """Save the curves, and below them one highlight as each filter shows it."""
    panels = _spots(texels)
    figure = matplotlib.figure.Figure(figsize=(14, 8.5), layout="constrained")
    rows = figure.add_gridspec(2, 12, height_ratios=(1.1, 1))
    curves = [figure.add_subplot(rows[0, 4 * k : 4 * k + 4]) for k in range(len(SHININESS))]
    pictures = [figure.add_subplot(rows[1, 3 * k : 3 * k + 3]) for k in range(len(panels))]
    for column, (axes, exponent) in enumerate(zip(curves, SHININESS, strict=True)):
        for name, (color, marker, line) in STYLES.items():
            axes.plot(FOOTPRINTS, table[name][:, column], line, color=color, marker=marker, ms=6)
        axes.set_xscale("log", base=2)
        axes.set_yscale("log")
        axes.set_xticks(FOOTPRINTS, [f"{footprint:g}" for footprint in FOOTPRINTS])
        axes.set_title(f"exponent {exponent:g}", fontsize=11)
        axes.set_xlabel("texels per pixel")
        axes.grid(color="0.9")
        axes.set_ylim(0.004, 5)
    curves[0].set_ylabel("RMS error of the highlight, relative")
    handles = curves[0].get_lines()
    figure.legend(handles, list(STYLES), loc="outside upper center", ncols=5, frameon=False)
    for axes, (name, panel) in zip(pictures, panels.items(), strict=True):
        axes.imshow(linear_to_srgb(np.clip(panel, 0, 1)), cmap="gray", vmin=0, vmax=1)
        axes.set_title(name, fontsize=11)
        axes.set_axis_off()
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=110)


def _spots(texels: Float[Array, "size size 3"]) -> dict[str, Float[np.ndarray, "height width"]]:
    """Return pictures of a lamp mirrored in bumps, eight texels to a pixel, exponent 100."""
    pixels, footprint, exponents = 96, 8.0, (100.0,)
    grid = pixel_grid(footprint, pixels=pixels, size=len(texels))
    places = (np.arange(pixels) + 0.5) / pixels * 2 - 1
    x, y = np.meshgrid(places, -places)
    to_lamp = np.stack([-x, -y, np.full_like(x, 0.8)], axis=-1)
    to_lamp /= np.linalg.norm(to_lamp, axis=-1, keepdims=True)
    to_camera = np.broadcast_to(np.array([0.0, 0.0, 1.0], np.float32), to_lamp.shape)
    lighting = Lighting(jnp.asarray(to_lamp, jnp.float32)[None], jnp.asarray(to_camera)[None])
    truth = supersampled(texels, grid, offsets_in_pixel(footprint), lighting, exponents)
    filtered = filters(texels, grid)
    shown = {"truth: 256 points per pixel": truth} | {
        name: _highlights(filtered[name], lighting, exponents)
        for name in ("Toksvig, as here", "mean, normalized", "mean, not normalized")
    }
    brightest = float(truth.max())
    return {name: np.asarray(image[0, 0]) / brightest for name, image in shown.items()}


if __name__ == "__main__":
    tyro.cli(normal_mips_error)
