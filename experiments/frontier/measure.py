"""The two measurements of a method on a view: how wrong it is, and what it costs.

Three programs make a method: the light's pass, what the filter makes of the map, and the image
that asks it. They are compiled once for each shape and kept, for both measurements and for the
next scene.
"""

import time
from collections.abc import Callable
from functools import partial
from typing import Any

import flip_evaluator
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from shadows.bias import Bias, CombinedBias, ConstantBias, SlopeBias
from shadows.compare import Compare, HardCompare, SoftCompare
from shadows.filters import Filter
from shadows.layouts import Layout
from shadows.lights import Light
from shadows.plane_bias import AdaptiveBias
from shadows.render import shade, surface_visibility
from shadows.shadow_map import ShadowMap, render_shadow_map
from shadows.surface import Surface
from shadows.transforms import Camera
from tangentspace.mesh import Mesh

from ..files.images import linear_to_srgb
from ..metrics import shadow_errors, soft_shadow_errors
from .methods import Method
from .view import View

Shared = tuple[Light, Surface, ShadowMap, Any]
_FACTORS, _LENGTHS = (0.5, 0.75, 1.0, 1.5), (0.0, 0.3, 1.0, 2.0)  # reaches, texels
_TOLERANCES = (0.0, 0.1, 0.3, 1.0, 3.0)  # texels


class Programs:
    """Compiled programs by what they are made of, with what compiling them took."""

    def __init__(self) -> None:
        """Begin with none."""
        self._kept: dict[tuple, tuple[Any, dict[str, Any]]] = {}

    def get(self, name: str, function: Callable, *arguments: Any) -> tuple[Any, dict[str, Any]]:
        """Return a program and its cost apart from its runs; compiled if it is new.

        Args:
            name: What tells it from others that take the same arrays.
            function: What to compile.
            arguments: Arrays, of which shapes and types count.
        """
        leaves, tree = jax.tree.flatten(arguments)
        key = (name, tree, tuple((leaf.shape, leaf.dtype) for leaf in leaves))
        if key not in self._kept:
            start = time.perf_counter()
            program = jax.jit(function).lower(*arguments).compile()
            memory = program.memory_analysis()
            cost = {
                "compile_s": time.perf_counter() - start,
                "temporary_bytes": getattr(memory, "temp_size_in_bytes", 0),
            }
            self._kept[key] = program, cost
        return self._kept[key]


class Passes:
    """A method on a view: its programs and their arguments."""

    def __init__(self, view: View, method: Method, programs: Programs) -> None:
        """Draw the map and prepare it."""
        self._view, self._method, self._programs = view, method, programs
        self.filter = method.filter().for_light(view.light)
        reach = jnp.float32(self.filter.reach())
        scene = view.scene
        self._draw = self._get(
            f"draw {method.map_size}",
            partial(_draw, method.map_size),
            (view.layout, scene.mesh, scene.camera, view.light, reach),
        )
        shadow_map = self._draw()
        self._prepare = self._get(f"prepare {method.name}", self.filter.prepare, (shadow_map,))
        self._kept = shadow_map, self._prepare()

    def image(self, bias: Bias) -> "Timed":
        """Return the program that asks the map: visibility and color."""
        return self._get(f"image {self._method.name}", _image, (bias, self.filter, self._shared()))

    def gradient(self, bias: Bias) -> "Timed":
        """Return the program of a loss against truth and its derivative in a bias."""
        share = jnp.asarray(self._view.share, jnp.float32)
        return self._get(
            f"gradient {self._method.name}",
            _loss_gradient,
            (bias, self.filter, share, self._shared()),
        )

    @property
    def stages(self) -> "dict[str, Timed]":
        """The programs before the image."""
        return {"draw": self._draw, "prepare": self._prepare}

    @property
    def kept_bytes(self) -> int:
        """What lies in memory between images."""
        return sum(leaf.nbytes for leaf in jax.tree.leaves(self._kept))

    def _shared(self) -> Shared:
        return self._view.light, self._view.surface, *self._kept

    def _get(self, name: str, function: Callable, arguments: tuple) -> "Timed":
        arguments = jax.tree.map(jnp.asarray, arguments)
        return Timed(*self._programs.get(name, function, *arguments), arguments)


class Timed:
    """A compiled program with its arguments."""

    def __init__(self, program: Any, cost: dict[str, Any], arguments: tuple) -> None:
        """Bind them."""
        self._program, self.cost, self._arguments = program, cost, arguments

    def __call__(self) -> Any:
        """Run it to its end."""
        return jax.block_until_ready(self._program(*self._arguments))


def accuracy(view: View, method: Method, programs: Programs) -> dict[str, Any]:
    """Return how wrong a method is, at the best of the biases that suit its filter.

    Returns:
        ``rmse`` of the visibility where a surface is; ``acne`` and ``leak``, shares of pixels,
        or under an area light means; ``error`` and ``error_interior``, wrong pixels, and those
        away from edges; ``flip`` of the picture; and the ``bias``.
    """
    passes = Passes(view, method, programs)
    covered = np.asarray(view.surface.covered)
    best: tuple[float, Bias, np.ndarray, np.ndarray] | None = None
    for bias in _biases(passes.filter):
        visibility, color = map(np.asarray, passes.image(bias)())
        rmse = soft_shadow_errors(visibility, view.share, covered).rmse
        if best is None or rmse < best[0]:
            best = rmse, bias, visibility, color
    assert best is not None
    rmse, bias, visibility, color = best
    soft = soft_shadow_errors(visibility, view.share, covered)
    hard = shadow_errors(visibility, view.share > 0.5, covered)
    shown = [linear_to_srgb(np.clip(image, 0, 1)) for image in (view.color, color)]
    _, flip, _ = flip_evaluator.evaluate(shown[0], shown[1], "LDR", applyMagma=False)
    return {
        "rmse": rmse,
        "rmse_penumbra": soft.rmse_penumbra if view.soft else None,
        "acne": soft.acne if view.soft else hard.acne,
        "leak": soft.leak if view.soft else hard.leak,
        "error": hard.error,
        "error_interior": hard.error_interior,
        "flip": float(flip),
        "bias": _said(bias),
    }


def timing(view: View, method: Method, programs: Programs, *, runs: int) -> dict[str, Any]:
    """Return what a method costs, compiled and warm.

    Args:
        view: Where.
        method: What.
        programs: Compiled so far.
        runs: Of each program, twice; half of them after the other half.

    Returns:
        Of each program quartiles in ms, seconds of compilation and temporary bytes;
        ``total_ms``, the median of light pass, preparation and image together; ``kept_bytes``;
        and whether the medians of the total's halves lie within its quartiles (``stable``).
    """
    passes = Passes(view, method, programs)
    bias = _biases(passes.filter)[0]
    stages = passes.stages | {"image": passes.image(bias), "gradient": passes.gradient(bias)}
    halves = [{name: _run(timed, runs) for name, timed in stages.items()} for _ in range(2)]
    figures: dict[str, Any] = {}
    for name, timed in stages.items():
        quartiles = np.percentile([half[name] for half in halves], [25, 50, 75])
        figures[name] = timed.cost | {"ms": [round(float(t), 4) for t in quartiles]}
    parts = ("draw", "prepare", "image")
    totals = [np.sum([half[part] for part in parts], axis=0) for half in halves]
    low, median, high = np.percentile(totals, [25, 50, 75])
    return figures | {
        "total_ms": float(median),
        "kept_bytes": passes.kept_bytes,
        "stable": all(bool(low <= np.median(half) <= high) for half in totals),
    }


def _run(timed: Timed, runs: int) -> list[float]:
    timed()
    times = []
    for _ in range(runs):
        start = time.perf_counter()
        timed()
        times.append(1e3 * (time.perf_counter() - start))
    return times


def _biases(filter: Filter) -> list[Bias]:
    """Return the biases that are tried, the default one's like first."""
    if not filter.needs_bias:
        return [CombinedBias()]
    if filter.compares and filter.wide:
        return [AdaptiveBias(t) for t in sorted(_TOLERANCES, key=lambda t: abs(t - 0.3))]
    pairs = [(factor, length) for factor in _FACTORS for length in _LENGTHS]
    return [
        CombinedBias((SlopeBias(factor, unit="reach"), ConstantBias(length, unit="texel")))
        for factor, length in sorted(pairs, key=lambda pair: (abs(pair[0] - 1), pair[1]))
    ]


def _said(bias: Bias) -> str:
    terms = bias.terms if isinstance(bias, CombinedBias) else (bias,)
    said = [
        f"{type(term).__name__} {float(jax.tree.leaves(term)[0]):g} {getattr(term, 'unit', '')}"
        for term in terms
    ]
    return " and ".join(said) or "none"


def _draw(
    map_size: int, layout: Layout, mesh: Mesh, camera: Camera, light: Light, reach: Array
) -> ShadowMap:
    """Return the light's map; the pass is the same for every filter."""
    matrices = layout.matrices(
        light, mesh.positions, camera, aspect=1.0, map_size=map_size, reach=reach
    )
    return render_shadow_map(mesh.positions, mesh.faces, matrices, map_size=map_size)


def _visibility(
    bias: Bias, filter: Filter, compare: Compare, shared: Shared
) -> Float[Array, "height width"]:
    light, surface, shadow_map, prepared = shared
    return surface_visibility(
        surface, light, shadow_map, bias=bias, filter=filter, compare=compare, prepared=prepared
    )


def _image(
    bias: Bias, filter: Filter, shared: Shared
) -> tuple[Float[Array, "height width"], Float[Array, "height width 3"]]:
    light, surface, _, _ = shared
    seen = _visibility(bias, filter, HardCompare(), shared)
    return seen, shade(surface, (light,), (seen,))


def _loss_gradient(
    bias: Bias, filter: Filter, share: Float[Array, "height width"], shared: Shared
) -> tuple[Array, Array]:
    """Return a loss against truth, and its derivative in a constant bias beside the given one."""

    def loss(length: Array) -> Array:
        both = CombinedBias((bias, ConstantBias(length)))
        return jnp.mean((_visibility(both, filter, SoftCompare(0.5), shared) - share) ** 2)

    return jax.value_and_grad(loss)(jnp.zeros((), share.dtype))
