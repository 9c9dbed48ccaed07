"""Rows of the catalogue that are distributions of depth within a texel: numbers, not geometry.

What a filter answers is asked of it directly: ``moments`` of depths, their means, ``lit``.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from shadows.exponential_filters import ESMFilter, EVSM2Filter, EVSM4Filter
from shadows.four_moment_filter import MSMFilter
from shadows.moment_filter import MomentFilter
from shadows.variance_filter import VSMFilter

from .cells import Cell, not_finite
from .views import on_device, quick

LAYERS, WEIGHTS, RECEIVER = (0.1, 0.4, 0.6), (0.5, 0.25, 0.25), 0.95
_TEXELS = 4096  # texels of rows 14 and 15


def three_layers(dtype: Any) -> list[Cell]:
    """Row 11: three layers of depth before a receiver; what light is left."""
    base = Cell(11, "three layers", "", np.dtype(dtype).name, "leak", 0.0, 1e-3)
    filters = {
        "vsm": (VSMFilter(), 0.096257, "three layers of depth"),
        "esm": (ESMFilter(), np.nan, ""),
        "esm 20": (ESMFilter(exponent=20.0), 0.000232, ""),
        "evsm2": (EVSM2Filter(), np.nan, ""),
        "evsm4": (EVSM4Filter(), 0.0, ""),
        "msm": (MSMFilter(), 0.005289, "three layers of depth"),
    }
    depths, weights = (jnp.asarray(x, dtype) for x in (LAYERS, WEIGHTS))
    receiver = jnp.asarray(RECEIVER, dtype)
    cells = []
    for name, (filter, predicted, said) in filters.items():
        value, back = _layers_lit(on_device(filter, dtype), depths, weights, receiver)
        cells.append(
            base._replace(
                technique=name,
                value=float(value),
                predicted=predicted,
                said=said,
                values_not_finite=not_finite(value),
                slopes_not_finite=not_finite(back),
            )
        )
    return cells


@quick
def _layers_lit(
    filter: MomentFilter, depths: Any, weights: Any, receiver: Any
) -> tuple[jax.Array, Any]:
    """Return the visibility behind layers of depth, and its gradient."""

    def lit(arguments: Any) -> Any:
        filter, depths, receiver = arguments
        means = tuple(jnp.sum(weights * stored) for stored in filter.moments(2 * depths - 1))
        return filter.lit(means, 2 * receiver - 1)

    return eqx.filter_value_and_grad(lit)((filter, depths, receiver))


@quick
def _all_lit(filter: MomentFilter, stored: Any, receiver: Any) -> tuple[jax.Array, Any]:
    """Return visibilities of texels of one depth each, and the gradient of their sum."""

    def total(arguments: Any) -> Any:
        filter, stored, receiver = arguments
        lit = filter.lit(filter.moments(stored), receiver)
        return jnp.sum(lit), lit

    (_, lit), slopes = eqx.filter_value_and_grad(total, has_aux=True)((filter, stored, receiver))
    return lit, slopes


def overflow(dtype: Any) -> list[Cell]:
    """Row 13: exponents at their limit and beyond, at both ends of the depth."""
    base = Cell(13, "ends of the depth", "", np.dtype(dtype).name, "not finite", 0.0, 0.0)
    depths = jnp.linspace(-1, 1, 65, dtype=dtype)
    cells = []
    for name, filter in {
        "esm 88.72": ESMFilter(exponent=88.72),
        "evsm2 42": EVSM2Filter(exponent=42.0),
        "evsm4 42/42": EVSM4Filter(exponent=42.0, negative_exponent=42.0),
    }.items():
        lit, slopes = _all_lit(on_device(filter, dtype), *jnp.meshgrid(depths, depths))
        flaws = not_finite(filter.moments(depths), lit), not_finite(slopes)
        cells.append(
            base._replace(
                technique=name,
                value=float(sum(flaws)),
                values_not_finite=flaws[0],
                slopes_not_finite=flaws[1],
                note="at the largest exponent that the filter takes",
            )
        )
    unit = np.linspace(0, 1, 65)
    single = np.dtype(dtype) == np.float32
    naive = {
        "(esm 100)": (100 * unit, dtype, single),
        "(evsm 50)": (2 * 50 * (2 * unit - 1), dtype, single),
        "(evsm 10, float16)": (2 * 10 * (2 * unit - 1), np.float16, True),
    }
    for name, (powers, kind, said) in naive.items():
        with np.errstate(over="ignore"):
            count = not_finite(np.exp(powers.astype(kind)))
        why = "above the type's largest number" if said else ""
        note = "the toolkit's filters refuse it" if name != "(evsm 10, float16)" else ""
        cells.append(
            base._replace(
                technique=name,
                value=float(count),
                said=why,
                values_not_finite=count,
                documented=False,
                note=note,
            )
        )
    return cells


def single_depths(dtype: Any) -> list[Cell]:
    """Row 14: texels of a single depth, of which four moments are singular.

    Receivers lie halfway between the depth and the far end, all in shadow.
    """
    base = Cell(14, "one depth a texel", "", np.dtype(dtype).name, "leak", 0.0, 0.05)
    rng = np.random.default_rng(1)
    depths = rng.uniform(size=_TEXELS)
    receivers = depths + 0.5 * (1 - depths)
    stored, behind = (jnp.asarray(2 * x - 1, dtype) for x in (depths, receivers))
    cells = []
    for bias in (0.0, 3e-7, 3e-6, 3e-5):
        filter = MSMFilter(moment_bias=bias)
        lit, slopes = _all_lit(on_device(filter, dtype), stored, behind)
        cells.append(
            base._replace(
                technique=f"msm {bias:g}",
                value=float(jnp.mean(lit)),
                said="no moment bias" if bias == 0 and dtype == np.float32 else "",
                values_not_finite=not_finite(lit),
                slopes_not_finite=not_finite(slopes),
            )
        )
    if np.dtype(dtype) == np.float32:
        unit, signed = (0.5,) * 4, (0.0, 0.375, 0.0, 0.375)
        for name, scale, bias, target, predicted in (
            ("(0 to 1, bias 0)", 1, 0.0, unit, 0.695),
            ("(0 to 1, bias 3e-06)", 1, 3e-6, unit, 0.009),
            ("(-1 to 1, bias 3e-07)", 2, 3e-7, signed, 0.0014),
        ):
            depth, place = ((scale * x - scale + 1).astype(np.float32) for x in (depths, receivers))
            share = _indefinite(depth, place, bias, target)
            cells.append(
                base._replace(
                    technique=f"{name[:-1]}, Cholesky)",
                    metric="share without roots",
                    value=share,
                    limit=0.02,
                    said="no moment bias" if bias == 0 else "",
                    predicted=predicted,
                    documented=False,
                )
            )
    return cells


def _indefinite(
    depth: np.ndarray, receiver: np.ndarray, bias: float, target: tuple[float, ...]
) -> float:
    """Return the share of depths for which the published algorithm has no real roots in float32.

    Cholesky's factors of the moments' matrix, a polynomial from them, and its discriminant.
    """
    share, z = np.float32(bias), receiver
    b1, b2, b3, b4 = (
        (1 - share) * depth**k + share * np.float32(t) for k, t in enumerate(target, start=1)
    )
    with np.errstate(all="ignore"):
        below, variance = b3 - b1 * b2, b2 - b1 * b1
        last = (b4 - b2 * b2) * variance - below * below
        factor = below / variance
        c1 = z - b1
        c2 = (z * z - b2 - factor * c1) * variance / last
        c1 = c1 / variance - factor * c2
        c0 = 1 - c1 * b1 - c2 * b2
        p, q = c1 / c2, c0 / c2
        return float(np.mean(~(0.25 * p * p - q >= 0)))


def half_precision(dtype: Any) -> list[Cell]:
    """Row 15: the variance of texels of one depth, in a type of few bits."""
    base = Cell(15, "variance of one depth", "", np.dtype(dtype).name, "share below zero", 0.0, 0.3)
    depths = np.random.default_rng(1).uniform(size=_TEXELS)
    cells = []
    stored = depths.astype(np.float16)
    variance = (stored * stored).astype(np.float64) - stored.astype(np.float64) ** 2
    share, name = float(np.mean(variance < 0)), "(vsm, float16)"
    cells.append(
        base._replace(
            technique=name, value=share, said="too few bits", predicted=0.51, documented=False
        )
    )
    for name, filter in {"vsm": VSMFilter(), "msm": MSMFilter()}.items():
        stored = jnp.asarray(2 * depths - 1, dtype)
        lit, slopes = _all_lit(on_device(filter, dtype), stored, stored)
        cells.append(
            base._replace(
                technique=name,
                metric="acne",
                value=float(jnp.mean(lit < 0.5)),
                limit=0.02,
                values_not_finite=not_finite(lit),
                slopes_not_finite=not_finite(slopes),
                note="receivers at their own depth; float16 is not a type of the toolkit",
            )
        )
    return cells
