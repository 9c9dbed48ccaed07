"""Ranges of a parameter, each on the scene where it hurts, up to the ends of what is allowed."""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np

from shadows import (
    AdaptiveBias,
    AnalyticBias,
    Bias,
    BilinearFilter,
    CombinedBias,
    ConstantBias,
    ESMFilter,
    EVSM2Filter,
    EVSM4Filter,
    Filter,
    MSMFilter,
    NormalOffsetBias,
    PCFFilter,
    PoissonFilter,
    ReceiverPlaneBias,
    VSMFilter,
    look_at,
    perspective,
)

from ..scene import Scene
from ..scenes import load_scene
from ..scenes.bias_failures import tilted_plane
from . import detectors
from .cells import Cell, not_finite
from .combinations import CONSTANT, DepthUnitsBias
from .detectors import Image, Sight
from .frame_rows import corners_without_tangent, shrunk_uvs
from .shadow_rows import IMAGE, MAP, look, shadowed_twice
from .views import View, view_of, visibility

Measure = Callable[[Image, Sight], float]
SOFTNESSES = (1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 0.1, 0.5, 1.0, 3.0, 10.0)
RATIOS = (350.0, 1e3, 1e4, 1e5)  # the nearest post lies at 1 / 335 of the far end
ELEVATIONS = (0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 45.0, 80.0)
_FAR = 130.0  # of the lamp's map, world units
_FOLLOWED = 0.99995  # sine of the steepest angle to the light that biases follow
UV_AREAS = (1.0, 1e-2, 1e-4, 1e-6, 1e-8, 1e-12, 0.0)


def softness(dtype: Any) -> list[Cell]:
    """Softness of the comparison, where a caster touches the floor."""
    seen, sight = _look(load_scene("contact-halo"), dtype)
    base = _base(12, "contact-halo", dtype, "halo", 0.3, "softness")
    return [
        _measured(
            base._replace(setting=value, said="too soft for a contact" if value > 1 else ""),
            "bilinear, analytic", seen, sight, AnalyticBias(), BilinearFilter(),
            detectors.halo, softness=value, geometry=True,
        )
        for value in SOFTNESSES
    ]  # fmt: skip


def exponents(dtype: Any) -> list[Cell]:
    """Exponents of the exponential filters, at a contact and under two blockers."""
    cells = []
    for scene, row, metric, measure, limit in (
        ("contact-halo", 12, "halo", detectors.halo, 0.3),
        ("two-occluders", 10, "bleeding", detectors.bleeding, 0.05),
    ):
        seen, sight = _look(load_scene(scene), dtype, twice=scene == "two-occluders")
        base = _base(row, scene, dtype, metric, limit, "exponent")
        for name, make, values in (
            ("esm", lambda c: ESMFilter(exponent=c), (1.0, 5.0, 10.0, 20.0, 40.0, 80.0, 88.72)),
            ("evsm2", lambda c: EVSM2Filter(exponent=c), (1.0, 5.0, 10.0, 20.0, 40.0, 42.0)),
            ("evsm4", lambda c: EVSM4Filter(exponent=c), (1.0, 5.0, 10.0, 20.0, 40.0, 42.0)),
        ):
            for value in values:
                low = "a small exponent" if value < 40 or row == 10 else ""
                cell = base._replace(setting=value, said=low if name != "evsm4" else "", may="blur")
                no_bias = CombinedBias()
                cells.append(_measured(cell, name, seen, sight, no_bias, make(value), measure))
    return cells


def radius(dtype: Any) -> list[Cell]:
    """Radius of a filter on a slanted plane, with one depth and with the plane's."""
    seen, sight = _look(load_scene("wide-kernel"), dtype)
    base = _base(7, "wide-kernel", dtype, "soft acne", 0.02, "radius")
    cells = []
    for value in (0.0, 0.5, 1.0, 2.0, 4.0, 8.0):
        cell = base._replace(setting=value)
        wide = PoissonFilter(value, taps=8)
        said = cell._replace(said="one depth for many texels" if value > 1 else "")
        cells += [
            _measured(said, "poisson, constant 0.02", seen, sight, ConstantBias(0.02), wide),
            _measured(cell, "poisson, adaptive", seen, sight, AdaptiveBias(), wide),
            _measured(cell, "poisson, analytic", seen, sight, AnalyticBias(), wide),
        ]
    return cells


def near_to_far(dtype: Any) -> list[Cell]:
    """How much farther the far end of a lamp's map is than its near end."""
    seen, sight = _look(load_scene("near-far"), dtype)
    sight = sight._replace(special=sight.sine < _FOLLOWED)
    light = seen.light
    base = _base(18, "near-far", dtype, "", 0.0, "far / near")
    towards = np.asarray(light.position + light.direction, np.float64)
    view = look_at(np.asarray(light.position, np.float64), towards, np.array([0.0, 1.0, 0.0]))
    cells = []
    for ratio in RATIOS:
        angle = 2 * float(light.outer_angle)
        matrix = perspective(angle, 1.0, _FAR / ratio, _FAR) @ jnp.asarray(view)
        moved = seen.with_matrices(matrix)
        for name, bias, filter, said in (
            ("bilinear, (depth units)", DepthUnitsBias(), BilinearFilter(), "too small or large"),
            ("bilinear, constant", ConstantBias(CONSTANT), BilinearFilter(), "too small afar"),
            ("bilinear, analytic", AnalyticBias(), BilinearFilter(), ""),
            ("pcf 5x5, adaptive", AdaptiveBias(), PCFFilter(2), ""),
            ("vsm, no bias", CombinedBias(), VSMFilter(), ""),
            ("msm, analytic", AnalyticBias(), MSMFilter(), ""),
        ):
            for metric, limit, measure in (
                ("inner acne", 0.02, detectors.inner_acne),
                ("leak", 0.25, detectors.leak),
            ):
                cell = base._replace(metric=metric, limit=limit, setting=ratio, may=said)
                if metric == "leak" and not filter.compares:
                    cell = cell._replace(may="a shadow narrower than the filter")
                cells.append(_measured(cell, name, moved, sight, bias, filter, measure))
    return cells


def elevation(dtype: Any) -> list[Cell]:
    """Elevation of the sun over a plane."""
    cells = []
    for degrees in ELEVATIONS:
        seen, sight = _look(tilted_plane(90.0 - degrees), dtype)
        base = _base(1, "tilted-plane", dtype, "acne", 0.02, "elevation")
        cell = base._replace(setting=degrees)
        beyond = "slopes above 100 are not followed" if degrees < 0.573 else ""
        for name, bias, filter in (
            ("bilinear, constant", ConstantBias(CONSTANT), BilinearFilter()),
            ("bilinear, analytic", AnalyticBias(), BilinearFilter()),
            ("bilinear, normal-offset", NormalOffsetBias(), BilinearFilter()),
            ("pcf 5x5, receiver-plane", ReceiverPlaneBias(), PCFFilter(2)),
            ("pcf 5x5, adaptive", AdaptiveBias(), PCFFilter(2)),
            ("vsm, no bias", CombinedBias(), VSMFilter()),
            ("msm, analytic", AnalyticBias(), MSMFilter()),
        ):
            why = "a length for every slope" if name == "bilinear, constant" else beyond
            measure = detectors.acne
            cell = cell._replace(may=why)
            cells.append(_measured(cell, name, seen, sight, bias, filter, measure, geometry=True))
    return cells


def uv_area(dtype: Any) -> list[Cell]:
    """Area of a triangle in texture coordinates, down to none."""
    base = _base(32, "equal-uvs", dtype, "corners without T", 0.0, "uv area")
    cells = []
    for area in UV_AREAS:
        may = "a line or a point, to rounding; it says so" if area < 1e-3 else ""
        for name, count, flaws in corners_without_tangent(shrunk_uvs(area), dtype):
            cells.append(
                base._replace(
                    technique=name,
                    value=float(count),
                    setting=area,
                    may=may,
                    values_not_finite=flaws[0],
                    slopes_not_finite=flaws[1],
                )
            )
    return cells


SWEEPS: dict[str, Callable[[Any], list[Cell]]] = {
    sweep.__name__: sweep
    for sweep in (softness, exponents, radius, near_to_far, elevation, uv_area)
}


def _base(row: int, scene: str, dtype: Any, metric: str, limit: float, parameter: str) -> Cell:
    return Cell(row, scene, "", np.dtype(dtype).name, metric, 0.0, limit, parameter=parameter)


def _look(scene: Scene, dtype: Any, *, twice: bool = False) -> tuple[View, Sight]:
    seen = view_of(scene, None, dtype, image=IMAGE, map_size=MAP)
    return seen, look(seen, shadowed_twice if twice else None)


def _measured(
    base: Cell,
    name: str,
    seen: View,
    sight: Sight,
    bias: Bias,
    filter: Filter,
    measure: Measure = detectors.soft_acne,
    *,
    softness: float = 0.0,
    geometry: bool = False,
) -> Cell:
    """Return a cell: hard where no softness is given, its derivatives from a soft comparison.

    Args:
        base: What the cell has besides.
        name: Of the technique.
        seen: What it is asked about.
        sight: What its picture is judged by.
        bias: Its bias.
        filter: Its filter.
        measure: The metric.
        softness: Of the comparison; 0 for a hard one.
        geometry: Whether derivatives in light, camera and vertices are looked at too.
    """
    hard = softness == 0
    lit, at_seen, slopes = visibility(seen, bias, filter, hard=hard, softness=softness or 0.5)
    values, flaws = not_finite(lit), not_finite(at_seen, slopes)
    if hard and filter.compares:
        soft, at_seen, slopes = visibility(seen, bias, filter, hard=False)
        values, flaws = values + not_finite(soft), flaws + not_finite(at_seen, slopes)
    if geometry:
        flaws += not_finite(seen.pull(at_seen))
    return base._replace(
        technique=name,
        value=measure(np.asarray(lit, np.float64), sight),
        values_not_finite=values,
        slopes_not_finite=flaws,
    )
