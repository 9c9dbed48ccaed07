"""A shadow filter with its numbers and its size of map: how wrong it is, and what it costs.

Three programs make a picture: the light's pass, what the filter makes of the map, and the
image that asks it. A fourth is the derivative in a bias.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from shadows.bias import Bias, CombinedBias, ConstantBias, SlopeBias
from shadows.compare import Compare, HardCompare, SoftCompare
from shadows.filters import Filter
from shadows.layouts import CubeLayout, Layout
from shadows.lights import Light
from shadows.plane_bias import AdaptiveBias
from shadows.render import shade
from shadows.shadow_map import ShadowMap, render_shadow_map
from shadows.surface import Surface
from shadows.transforms import Camera
from shadows.visibility import surface_visibility
from tangentspace.mesh import Mesh

from ..metrics import soft_shadow_errors
from ..options import parse_technique
from .errors import errors
from .light_form import light_form
from .light_motion import move_light, slope_error
from .pictures import picture
from .programs import Programs, Timed, time_stages
from .view import View

Shared = tuple[Light, Surface, ShadowMap, Any]
Drawn = tuple[ShadowMap, Light]
_FACTORS, _LENGTHS = (0.5, 0.75, 1.0, 1.5), (0.0, 0.3, 1.0, 2.0)  # reaches, texels
_TOLERANCES = (0.0, 0.1, 0.3, 1.0, 3.0)  # texels
_LARGEST_IN_CUBE = 1024
_SOFT = SoftCompare(0.5)  # of derivatives


class Method(NamedTuple):
    """A filter with its numbers, and the map that it asks.

    Attributes:
        technique: Name of the filter.
        label: Name with its size, ``pcf 5x5``.
        words: What ``--filter`` takes.
        map_size: Texels on each side.
        judges_gradient: Whether to measure how right its gradients are, too, which takes as long
            as all else.
    """

    technique: str
    label: str
    words: tuple[str, ...]
    map_size: int
    judges_gradient: bool = False

    @property
    def kind(self) -> str:
        """What it is among others in the table."""
        return "shadow"

    @property
    def name(self) -> str:
        """As in tables, ``pcf 5x5 @ 512``; tells methods apart."""
        return f"{self.label} @ {self.map_size}"

    def filter(self) -> Filter:
        """Make the filter."""
        return parse_technique(Filter, self.words, option="--filter")

    def applies(self, view: View) -> bool:
        """Whether it is for a view: a cube of maps of 2048 would have 25 million texels."""
        return self.map_size <= _LARGEST_IN_CUBE or not isinstance(view.layout, CubeLayout)

    def accuracy(self, view: View, programs: Programs) -> tuple[dict[str, Any], bytes]:
        """Return how wrong it is, at the best of the biases that suit its filter.

        Returns:
            The figures of ``errors`` for the bias of least ``rmse``; that ``bias``; and, if it is
            to, ``gradient_error``: how far derivatives of the visibility in the light's place are
            from those of truth, as ``slope_error`` says. And its picture.
        """
        passes = Passes(view, self, programs)
        covered = np.asarray(view.surface.covered)
        best: tuple[float, Bias, np.ndarray, np.ndarray] | None = None
        for bias in biases(passes.filter):
            visibility, color = map(np.asarray, passes.image(bias)())
            rmse = soft_shadow_errors(visibility, view.share, covered).rmse
            if best is None or rmse < best[0]:
                best = rmse, bias, visibility, color
        assert best is not None
        _, bias, visibility, color = best
        passes.gradient(bias)  # compiled for ``timing``, which is to be alone
        figures = errors(view, visibility, color) | {"bias": _said(bias)}
        if self.judges_gradient:
            changes = passes.changes(bias)
            figures["gradient_error"] = slope_error(changes, view.patterns, view.slopes)
        return figures, picture(view, visibility, color)

    def timing(self, view: View, programs: Programs, *, runs: int) -> dict[str, Any]:
        """Return a round of ``time_stages``, and ``kept_bytes``.

        Args:
            view: Where.
            programs: Compiled so far.
            runs: Of each program, as ``time_stages`` takes them.
        """
        passes = Passes(view, self, programs)
        bias = biases(passes.filter)[0]
        stages = passes.stages | {"image": passes.image(bias), "gradient": passes.gradient(bias)}
        return {"stages": time_stages(stages, runs=runs), "kept_bytes": passes.kept_bytes}


class Passes:
    """A method on a view: its programs and their arguments."""

    def __init__(self, view: View, method: Method, programs: Programs) -> None:
        """Draw the map and prepare it."""
        self._view, self._method, self._programs = view, method, programs
        self._light = light_form(view.light)
        self.filter = method.filter().for_light(view.light)
        scene, reach = view.scene, jnp.float32(self.filter.reach())
        self._drawing = (view.layout, scene.mesh, scene.camera, view.light, reach)
        draw = partial(draw_map, method.map_size)
        self._draw = programs.get(f"draw {method.map_size}", draw, *self._drawing)
        self._map = self._draw()
        self._prepare = programs.get(f"prepare {method.name}", prepare_map, self.filter, self._map)
        self._prepared = self._prepare()

    def image(self, bias: Bias) -> Timed:
        """Return the program that asks the map: visibility and color."""
        name = f"image {self._method.name}"
        return self._programs.get(name, _image, bias, self.filter, self._shared())

    def gradient(self, bias: Bias) -> Timed:
        """Return the program of a loss against truth and its derivative in a bias."""
        name, share = f"gradient {self._method.name}", np.asarray(self._view.share, np.float32)
        return self._programs.get(name, _loss_gradient, bias, self.filter, share, self._shared())

    def changes(self, bias: Bias) -> Float[np.ndarray, "2 height width"]:
        """Return the derivatives of the visibility as the light moves, at a soft comparison."""
        changes, size = [], self._method.map_size
        for step in jnp.eye(2):
            drawn = self._programs.get(
                f"draw change {size}", partial(_draw_change, size),
                step, self._view.center, *self._drawing,
            )  # fmt: skip
            change = self._programs.get(
                f"change {self._method.name}", _change,
                bias, self.filter, self._view.surface, *drawn(),
            )  # fmt: skip
            changes.append(np.asarray(change()))
        return np.stack(changes)

    @property
    def stages(self) -> dict[str, Timed]:
        """The programs before the image."""
        return {"draw": self._draw, "prepare": self._prepare}

    @property
    def kept_bytes(self) -> int:
        """What lies in memory between images."""
        return sum(leaf.nbytes for leaf in jax.tree.leaves((self._map, self._prepared)))

    def _shared(self) -> Shared:
        return self._light, self._view.surface, self._map, self._prepared


def biases(filter: Filter) -> list[Bias]:
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


def draw_map(
    map_size: int, layout: Layout, mesh: Mesh, camera: Camera, light: Light, reach: Array
) -> ShadowMap:
    """Return the light's map; the pass is the same for every filter."""
    matrices = layout.matrices(
        light, mesh.positions, camera, aspect=1.0, map_size=map_size, reach=reach
    )
    return render_shadow_map(mesh.positions, mesh.faces, matrices, map_size=map_size)


def prepare_map(filter: Filter, shadow_map: ShadowMap) -> Any:
    """Return what the filter makes of the map."""
    return filter.prepare(shadow_map)


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
        return jnp.mean((_visibility(both, filter, _SOFT, shared) - share) ** 2)

    return jax.value_and_grad(loss)(jnp.zeros((), share.dtype))


def _draw_change(
    map_size: int, step: Array, center: Array,
    layout: Layout, mesh: Mesh, camera: Camera, light: Light, reach: Array,
) -> tuple[Drawn, Drawn]:  # fmt: skip
    """Return the light's map and the light, and how they change as the light begins to move."""

    def draw(angles: Array) -> Drawn:
        moved = move_light(light, angles, center)
        return draw_map(map_size, layout, mesh, camera, moved, reach), light_form(moved)

    return jax.jvp(draw, (jnp.zeros_like(step),), (step,))


def _change(
    bias: Bias, filter: Filter, surface: Surface, drawn: Drawn, change: Drawn
) -> Float[Array, "height width"]:
    """Return the derivative of the visibility as the map and the light change."""

    def seen(drawn: Drawn) -> Array:
        shadow_map, light = drawn
        prepared = filter.prepare(shadow_map)
        return _visibility(bias, filter, _SOFT, (light, surface, shadow_map, prepared))

    _, tangent = jax.jvp(seen, (drawn,), (change,))
    return tangent
