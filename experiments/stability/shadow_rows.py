"""Rows of the catalogue that a picture of a scene shows: every shadow technique on each.

A row says which techniques should fail and why, from the catalogue; what another row says of a
technique (no bias, a bias as thick as a caster) counts too where its metric sees that as well.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from tangentspace._math import dot

from ..scenes import load_scene
from ..truth.rays import nearest_occluder_distance, trace_visibility
from . import detectors
from .cells import Cell, not_finite
from .combinations import CONSTANT, FILTERS, Technique, combinations
from .detectors import Mask, Sight
from .naive_ways import NAIVE_WAYS, blockers, by_volumes
from .views import View, lightings, view_of, visibility

IMAGE, MAP = (96, 96), 256
Said = Callable[[Technique], str]


class ShadowRow(NamedTuple):
    """A row, its scene, and the metric that sees the failure.

    Attributes:
        row: Number in the catalogue.
        scene: Name.
        metric: Name of the metric.
        measure: The metric.
        limit: Largest value that is no failure; the reason stands beside it.
        said: Why a technique should fail here; empty if the row does not say so.
        may: Why it may fail by what other rows say.
        predicted: The catalogue's value for a technique; NaN if it gives none.
        special: Which pixels the row is about; None for all.
    """

    row: int
    scene: str
    metric: str
    measure: Callable[[np.ndarray, Sight], float]
    limit: float
    said: Said
    may: Said
    predicted: Callable[[Technique], float] = lambda technique: np.nan
    special: Callable[[View], Mask] | None = None


def _of(reason: str, **fields: tuple[str, ...]) -> Said:
    """Return a reason for techniques whose filter or bias is one of these."""
    return lambda t: reason if all(getattr(t, k) in names for k, names in fields.items()) else ""


def _any(*said: Said) -> Said:
    return lambda technique: next((why for one in said if (why := one(technique))), "")


def _nothing(technique: Technique) -> str:
    return ""


def _unbiased(technique: Technique) -> str:
    return "no bias" if technique.unbiased else ""


def _one_depth(technique: Technique) -> str:
    one = technique.bias in ("constant", "slope", "normal-offset", "(depth units)")
    return "one depth for many texels" if technique.wide and one else ""


def _too_soft(technique: Technique) -> str:
    return "too soft for a contact" if technique.softness > 1 or technique.exponent else ""


_LAYERS = ("front-face-culling", "midpoint", "second-depth")
_OFFSETS = ("constant", "slope", "analytic", "normal-offset", "(larger slope)", "(depth units)")

# What other rows say of metrics that see darkness, and of those that see light.
may_darken = _any(
    lambda t: "no bias (row 1)" if t.bias == "none" and FILTERS[t.filter].needs_bias else "",
    _of("as large at every slope (row 6)", bias=("constant",)),
    _of("in units of depth (row 18)", bias=("(depth units)",)),
    _of("one of two slopes (row 2)", bias=("(larger slope)",)),
    _of("its plane is not the surface (row 8)", bias=("receiver-plane",)),
    lambda t: f"{why} (row 7)" if (why := _one_depth(t)) else "",
    lambda t: "over-soft (row 43)" if t.softness else "",
)
may_leak = _any(
    _of("moves off the contact (row 3)", bias=_OFFSETS),
    _of("a second layer (row 4)", bias=_LAYERS),
    lambda t: f"{why} (row 12)" if (why := _too_soft(t)) else "",
    _of("light bleeds (row 10)", filter=("vsm", "esm", "evsm2")),
    _of("a shadow narrower than the filter", filter=("pcf 9x9",)),
)
_narrow = _of(
    "a shadow narrower than the filter",
    filter=("pcf 5x5", "tent", "poisson", "pcss", "evsm4", "msm"),
)


def _striped(technique: Technique) -> float:
    if technique.unbiased and technique.filter == "nearest":
        return 0.5
    return 0.0 if technique.bias in ("analytic", "adaptive") else np.nan


def _detached(technique: Technique) -> float:
    length = CONSTANT * np.sin(np.deg2rad(50.0)) - 0.02
    return length if technique.bias == "constant" else np.nan


def _smooth_lit(seen: View) -> Mask:
    """Return what smooth normals turn to the light though the faces are turned away."""
    to_light = seen.light.to_light(seen.surface.position)
    smooth = np.asarray(dot(seen.surface.normal, to_light) > 0.02)
    return smooth & np.asarray(seen.surface.covered) & ~np.asarray(seen.facing)


def _bent(seen: View) -> Mask:
    """Return where smooth normals are off the faces' by five degrees and more."""
    cosine = np.asarray(dot(seen.surface.normal, seen.surface.face_normal))
    return cosine < np.cos(np.deg2rad(5.0))


def _followed(seen: View) -> Mask:
    """Return where slopes are followed by biases, up to 100."""
    to_light = seen.light.to_light(seen.surface.position)
    return np.abs(np.asarray(dot(seen.surface.face_normal, to_light))) > 0.01


def _behind(seen: View) -> Mask:
    """Return what faces a spot light but lies behind it."""
    away = np.asarray(seen.surface.position - seen.light.position) @ np.asarray(
        seen.light.direction
    )
    return np.asarray(seen.facing) & (away < -0.05)


def shadowed_twice(seen: View) -> Mask:
    """Return what lies in the shadow of two closed bodies, four faces."""
    return blockers(seen) >= 4


def _between_sides(seen: View) -> Mask:
    """Return what lies near the planes in which two sides of a cube meet."""
    offset = np.abs(np.asarray(seen.surface.position - seen.light.position))
    low, high = np.sort(offset, axis=-1)[..., 1:].transpose(2, 0, 1)
    return low > 0.95 * high


ROWS = (
    ShadowRow(1, "tilted-plane", "acne", detectors.acne, 0.02, _unbiased, may_darken, _striped),
    ShadowRow(
        2, "turned-plane", "acne", detectors.acne, 0.02,
        _of("follows one of two slopes", bias=("(larger slope)",)), may_darken, _striped,
    ),
    ShadowRow(
        3, "contact-wall", "gap", detectors.gap, 0.03,
        _of("moves along ray or normal", bias=("constant", "slope", "normal-offset")),
        may_leak, _detached,
    ),
    ShadowRow(
        3, "contact-plate", "leak", detectors.leak, 0.1,
        _of("moves farther than the plate is high", bias=("constant",)),
        _any(may_leak, _narrow),
    ),
    ShadowRow(
        4, "box-corner", "contact leak", detectors.contact_leak, 0.1,
        _of("the box's back is the floor", bias=_LAYERS), may_leak,
    ),
    ShadowRow(
        4, "open-fold", "leak", detectors.leak, 0.1,
        _of("an open sheet has one layer", bias=_LAYERS), may_leak,
    ),
    ShadowRow(
        5, "thin-wall", "contact leak", detectors.contact_leak, 0.1,
        lambda t: "" if t.bias == "none" else "a bias above the thickness", may_leak,
    ),
    ShadowRow(
        6, "coarse-sphere", "acne", detectors.acne, 0.02,
        _of("not as the surface turns away", bias=("constant", "slope")), may_darken,
    ),
    ShadowRow(7, "wide-kernel", "soft acne", detectors.soft_acne, 0.02, _one_depth, may_darken),
    ShadowRow(
        8, "crease", "soft acne", detectors.soft_acne, 0.01,
        _of("its plane is not the surface", bias=("receiver-plane",)), may_darken,
    ),
    ShadowRow(
        9, "edge-on-triangle", "wrong", detectors.wrong, 0.02,
        _of("slopes without bound", bias=("receiver-plane", "adaptive")), may_darken,
        special=_followed,
    ),
    ShadowRow(
        10, "two-occluders", "bleeding", detectors.bleeding, 0.05,
        _of("light bleeds through two blockers", filter=("vsm", "esm", "evsm2")), may_leak,
        special=shadowed_twice,
    ),
    ShadowRow(12, "contact-halo", "halo", detectors.halo, 0.3, _too_soft, may_leak),
    ShadowRow(
        18, "near-far", "inner acne", detectors.inner_acne, 0.02,
        _of("too small afar", bias=("(depth units)",)), may_darken, special=_followed,
    ),
    ShadowRow(
        19, "behind-spot", "dark behind", detectors.soft_acne, 0.002, _nothing, _nothing,
        special=_behind,
    ),
    ShadowRow(
        20, "room", "wrong, soft", detectors.soft_wrong, 0.008, _nothing,
        _any(may_darken, may_leak),
        special=_between_sides,
    ),
    ShadowRow(
        25, "near-plane-triangle", "wrong", detectors.wrong, 0.02, _nothing,
        _any(may_darken, may_leak),
    ),
    ShadowRow(26, "t-junction", "inner leak", detectors.inner_leak, 0.002, _nothing, may_leak),
    ShadowRow(
        27, "eye-in-shadow", "wrong", detectors.wrong, 0.02, _nothing, _any(may_darken, may_leak),
    ),
    ShadowRow(
        28, "low-poly-sphere", "dark blocks", detectors.darkness, 0.02,
        lambda t: "faces turn away before smooth normals do", _nothing, special=_smooth_lit,
    ),
    ShadowRow(
        30, "bent-normals", "leak", detectors.leak, 0.1, _nothing, _any(may_leak, _narrow),
        special=_bent,
    ),
)  # fmt: skip


def measure_row(row: ShadowRow, dtype: Any, *, quick: bool) -> list[Cell]:
    """Return a cell for each technique; the last is what leads from geometry to all of them."""
    scene, kind = load_scene(row.scene), np.dtype(dtype).name
    sizes: dict[str, Any] = {"image": IMAGE, "map_size": MAP}
    seen = view_of(scene, None, dtype, **sizes)
    sight = look(seen, row.special)
    base = Cell(row.row, row.scene, "", kind, row.metric, 0.0, row.limit)
    cells, total = [], None
    for technique in combinations(quick=quick, several=len(lightings(scene)) == 1):
        cell, at_seen = judge(row, base, seen, sight, technique)
        total = at_seen if total is None else jax.tree.map(jnp.add, total, at_seen)
        cells.append(cell)
    cells += _further(row, base, seen, sight)
    others = [] if quick or row.row == 19 else list(lightings(scene))[1:]
    for lighting in others:
        other = view_of(scene, lighting, dtype, **sizes)
        beside = look(other, row.special)
        for filter, bias in (("bilinear", "analytic"), ("pcf 5x5", "adaptive")):
            technique = Technique(filter, bias, lighting=lighting)
            cells.append(judge(row, base, other, beside, technique)[0])
    flaws = not_finite(seen.pull(total))
    geometry = base._replace(
        technique="derivatives in the geometry", metric="not finite", limit=0.0
    )
    return [*cells, geometry._replace(value=float(flaws), slopes_not_finite=flaws)]


def judge(
    row: ShadowRow, base: Cell, seen: View, sight: Sight, technique: Technique
) -> tuple[Cell, Any]:
    """Return a technique's cell, and the derivatives of its mean in what is seen."""
    bias, filter = technique.make()
    hard, softness = technique.softness == 0, technique.softness or 0.5
    lit, at_seen, slopes = visibility(seen, bias, filter, hard=hard, softness=softness)
    values, flaws = not_finite(lit), not_finite(at_seen, slopes)
    if hard and filter.compares:  # which has no derivatives worth the name
        soft, at_seen, slopes = visibility(seen, bias, filter, hard=False)
        values, flaws = values + not_finite(soft), flaws + not_finite(at_seen, slopes)
    cell = base._replace(
        technique=technique.name,
        value=row.measure(np.asarray(lit, np.float64), sight),
        said=row.said(technique),
        may=row.may(technique),
        predicted=row.predicted(technique),
        values_not_finite=values,
        slopes_not_finite=flaws,
    )
    return cell, at_seen


def look(seen: View, special: Callable[[View], Mask] | None = None) -> Sight:
    """Return what a view's pictures are judged by, traced with rays."""
    points, occluders = seen.points(), seen.occluders()
    cosine = np.asarray(dot(seen.surface.face_normal, seen.light.to_light(seen.surface.position)))
    facing = np.asarray(seen.facing)
    return Sight(
        truth=trace_visibility(*points, seen.light, occluders),
        facing=facing,
        distance=nearest_occluder_distance(*points, seen.light, occluders),
        sine=np.sqrt(np.clip(1 - cosine.astype(np.float64) ** 2, 0, 1)),
        special=np.ones_like(facing) if special is None else special(seen),
    )


def _further(row: ShadowRow, base: Cell, seen: View, sight: Sight) -> list[Cell]:
    """Return the cells of what is no filter with a bias."""
    volumes = by_volumes(seen).astype(np.float64)
    cells = [
        base._replace(
            technique="shadow volumes",
            value=row.measure(volumes, sight),
            said=row.said(Technique("bilinear", "analytic")) if row.row == 28 else "",
            values_not_finite=not_finite(volumes),
        )
    ]
    if row.row in NAIVE_WAYS:
        name, said, way = NAIVE_WAYS[row.row]
        values = way(seen)
        cells.append(base._replace(technique=name, said=said, value=row.measure(values, sight)))
    return cells
