"""Windows of texels: against sums of bilinear lookups, the closed forms, and steps known."""

import jax.numpy as jnp
import numpy as np
import pytest

from shadows import (
    BilinearFilter,
    HardCompare,
    PCFFilter,
    ShadowMap,
    SoftCompare,
    TentFilter,
)

from .reference import look_up_reference
from .test_filters import BLOCKED, HEIGHT, WIDTH, look, random_map, random_places, receivers
from .tools import assert_close

BOXES = {f"pcf {radius}": PCFFilter(radius) for radius in (1, 2, 4)}
TENTS = {f"tent {radius}": TentFilter(radius) for radius in (1, 2, 3)}
FILTERS = {"bilinear": BilinearFilter(), **BOXES, **TENTS}
TOTALS = {1: 16, 2: 144, 3: 2704}  # of the products of a tent's weights


def stored_places(shadow_map, receiver):
    """The map, and what of the receivers the oracle takes, in double precision."""
    places = (receiver.column, receiver.row, receiver.depth)
    return [np.asarray(a, np.float64) for a in (shadow_map.depth, *places)]


def bilinear_taps(radius, fraction):
    """Where bilinear lookups give a tent, and their weights: the published closed forms.

    From the texel centre on the left of the receiver, which lies ``fraction`` farther right.
    """
    s = fraction
    if radius == 1:
        weights = [3 - 2 * s, 1 + 2 * s]
        return [(2 - s) / weights[0] - 1, s / weights[1] + 1], weights
    if radius == 2:
        weights = [4 - 3 * s, 7 + 0 * s, 1 + 3 * s]
        return [(3 - 2 * s) / weights[0] - 2, (3 + s) / 7, s / weights[2] + 2], weights
    weights = [6 - 5 * s, 28 - 11 * s, 17 + 11 * s, 1 + 5 * s]
    seconds = [5 - 4 * s, 16 - 4 * s, 5 + 7 * s, s]
    places = [a / b + first for a, b, first in zip(seconds, weights, (-3, -1, 1, 3), strict=True)]
    return places, weights


# Known answers


@pytest.mark.parametrize("radius", [0, 1, 2, 4])
def test_pcf_is_the_mean_of_bilinear_lookups(radius, dtype):
    """At each texel of the window; also beyond the border, and where texels are cleared."""
    shadow_map = random_map(dtype)
    receiver = receivers(*random_places(beyond=6.0), dtype)
    lit = look(shadow_map, receiver, PCFFilter(radius), HardCompare())
    stored, column, row, depth = stored_places(shadow_map, receiver)
    shifts = np.arange(-radius, radius + 1)
    lookups = [
        look_up_reference(stored, column + i, row + j, depth, bilinear=True)
        for i in shifts
        for j in shifts
    ]
    assert lit.dtype == dtype
    assert_close(lit, np.mean(lookups, axis=0), ulps=16)  # 4.5 measured


@pytest.mark.parametrize("radius", [1, 2, 3])
def test_tent_is_its_bilinear_taps(radius, dtype):
    shadow_map = random_map(dtype)
    receiver = receivers(*random_places(beyond=6.0), dtype)
    lit = look(shadow_map, receiver, TentFilter(radius), HardCompare())
    stored, column, row, depth = stored_places(shadow_map, receiver)
    axes = []
    for place in (column, row):
        first = np.floor(place - 0.5) + 0.5
        places, weights = bilinear_taps(radius, place - first)
        axes.append([(first + offset, w) for offset, w in zip(places, weights, strict=True)])
    expected = sum(
        across_weight * weight * look_up_reference(stored, u, v, depth, bilinear=True)
        for u, across_weight in axes[0]
        for v, weight in axes[1]
    )
    assert_close(lit, expected / TOTALS[radius], ulps=16)  # 3.6 measured


@pytest.mark.parametrize("radius", [1, 2, 3])
def test_weights_of_a_tent_sum_to_16_144_2704(radius):
    taps = TentFilter(radius).read(random_map(), receivers(*random_places()))
    assert len(taps) == (2 * radius + 2) ** 2
    assert_close(
        sum(tap.weight for tap in taps), np.full(400, float(TOTALS[radius])), ulps=8
    )  # 4 measured


@pytest.mark.parametrize("radius", [0, 1, 2, 4])
def test_weights_of_a_box_sum_to_its_area(radius):
    taps = PCFFilter(radius).read(random_map(), receivers(*random_places()))
    assert_close(sum(tap.weight for tap in taps), np.full(400, (2 * radius + 1.0) ** 2), ulps=8)


@pytest.mark.parametrize("name", FILTERS)
def test_no_weight_is_negative(name):
    taps = FILTERS[name].read(random_map(), receivers(*random_places()))
    assert all(float(tap.weight.min()) >= 0 for tap in taps)


def test_radius_0_is_bilinear():
    shadow_map, receiver = random_map(), receivers(*random_places())
    expected = look(shadow_map, receiver, BilinearFilter(), HardCompare())
    assert_close(look(shadow_map, receiver, PCFFilter(0), HardCompare()), expected, ulps=0)


def half_dark(column):
    """Visibility across a map that blocks from column 8 on."""
    stored = jnp.ones((HEIGHT, WIDTH)).at[:, WIDTH // 2 :].set(0.2)
    at = receivers(column, np.full(len(column), 6.2), np.full(len(column), 0.5))
    return lambda filter: look(ShadowMap(stored, jnp.eye(4)), at, filter, HardCompare())


@pytest.mark.parametrize("radius", [0, 1, 2])
def test_edge_under_a_box_is_a_ramp(radius):
    """Over 2 radius + 1 texels, from 1 to 0, straight."""
    column = np.linspace(3.0, 13.0, 101)
    expected = np.clip((WIDTH / 2 - column) / (2 * radius + 1) + 0.5, 0, 1)
    assert_close(half_dark(column)(PCFFilter(radius)), expected, ulps=16)


@pytest.mark.parametrize(("radius", "moment"), [(1, 2 / 4), (2, 14 / 12), (3, 82 / 52)])
def test_edge_under_a_tent_falls_symmetrically(radius, moment):
    """From 1 to 0 within radius + 1 texels; steepest in the middle, as wide as its moments say.

    The moment is that of the weights at a texel centre, 1 2 1, 1 3 4 3 1, 1 5 12 16 12 5 1.
    """
    column = WIDTH / 2 + np.linspace(-4.5, 4.5, 10)
    lit = np.asarray(half_dark(column)(TentFilter(radius)))
    assert_close(lit + lit[::-1], np.ones(10), ulps=8)
    away = np.abs(column - WIDTH / 2) >= radius + 0.5
    assert_close(lit[away], (column < WIDTH / 2)[away].astype(float), ulps=0)
    drop = -np.diff(lit)
    assert np.all(np.diff(drop[: len(drop) // 2 + 1]) >= 0)
    weights = np.linspace(-4, 4, 9) ** 2
    assert_close(weights @ drop, moment, ulps=16)


@pytest.mark.parametrize("name", FILTERS)
def test_a_map_of_one_depth_is_lit_before_it_and_dark_behind(name):
    """Where no texel outside is read."""
    shadow_map = ShadowMap(jnp.full((HEIGHT, WIDTH), 0.5), jnp.eye(4))
    rng = np.random.default_rng(2)
    column, row = rng.uniform(5.5, [WIDTH - 5.5, HEIGHT - 5.5], (50, 2)).T
    depth = np.where(np.arange(50) % 2, 0.4999, 0.5001)
    lit = look(shadow_map, receivers(column, row, depth), FILTERS[name], HardCompare())
    assert_close(lit, (np.arange(50) % 2).astype(float), ulps=0)


@pytest.mark.parametrize("name", FILTERS)
def test_beyond_its_reach_of_the_map_all_is_lit(name):
    reach = float(FILTERS[name].reach())
    far = reach - 0.5 + np.array([1e-6, 1e12])
    column = np.concatenate([-far, WIDTH + far, *[np.full(2, 5.5)] * 2])
    row = np.concatenate([*[np.full(2, 5.5)] * 2, -far, HEIGHT + far])
    at = receivers(column, row, np.full(8, 0.5))
    assert_close(look(BLOCKED, at, FILTERS[name], HardCompare()), np.ones(8), ulps=0)
    # A little nearer something is read.
    near = reach - 0.5 - 1e-3
    at = receivers(np.array([-near, 5.5]), np.array([5.5, HEIGHT + near]), np.full(2, 0.5))
    assert float(look(BLOCKED, at, FILTERS[name], HardCompare()).max()) < 1


# Laws


@pytest.mark.parametrize("name", FILTERS)
def test_reach_is_the_farthest_texel_with_a_weight(name):
    column, row, depth = random_places()
    column[:2] = row[2:4] = 5.5 + np.array([1e-9, -1e-9])
    taps = FILTERS[name].read(random_map(), receivers(column, row, depth))
    reach = float(FILTERS[name].reach())
    for offset in ("across", "down"):
        farthest = max(
            float(jnp.max(jnp.where(tap.weight > 0, jnp.abs(getattr(tap, offset)), 0)))
            for tap in taps
        )
        assert reach - 1e-8 < farthest <= reach


@pytest.mark.parametrize("name", FILTERS)
def test_continuous_across_the_lines_through_texel_centres(name):
    """Where one window gives way to the next, and across texel borders."""
    column, row, depth = random_places()
    for offset in (0.5, 0.0):
        for axis in (column, row):
            axis[:] = np.floor(axis) + offset
            below, above = (
                look(random_map(), receivers(*places, depth), FILTERS[name], HardCompare())
                for places in ((column - 1e-9, row - 1e-9), (column + 1e-9, row + 1e-9))
            )
            assert float(jnp.abs(below - above).max()) < 1e-8  # measured 4e-9
            axis += 0.3


@pytest.mark.parametrize("name", FILTERS)
def test_whole_texels_translate(name):
    column, row, depth = random_places(beyond=0.0)
    padded = jnp.ones((HEIGHT + 9, WIDTH + 9)).at[4:-5, 4:-5].set(random_map().depth)
    at = receivers(column, row, depth)
    moved = at._replace(column=at.column + 4, row=at.row + 4)
    lit = look(random_map(), at, FILTERS[name], HardCompare())
    assert 0.1 < float(lit.mean()) < 0.9
    after = look(ShadowMap(padded, jnp.eye(4)), moved, FILTERS[name], HardCompare())
    assert_close(after, lit, ulps=32)  # 8 measured


@pytest.mark.parametrize("name", FILTERS)
def test_mirrored_and_transposed_maps(name):
    column, row, depth = random_places(beyond=0.0)
    at = receivers(column, row, depth)
    stored = random_map().depth
    lit = look(random_map(), at, FILTERS[name], HardCompare())
    for changed, places in {
        "mirrored": (stored[:, ::-1], {"column": WIDTH - at.column}),
        "upside down": (stored[::-1], {"row": HEIGHT - at.row}),
        "transposed": (stored.T, {"column": at.row, "row": at.column}),
    }.values():
        moved = at._replace(**places)
        after = look(ShadowMap(changed, jnp.eye(4)), moved, FILTERS[name], HardCompare())
        assert_close(after, lit, ulps=16)


@pytest.mark.parametrize("name", FILTERS)
def test_a_soft_comparison_is_blended_like_a_hard_one(name):
    """The sum over the taps, texel by texel, of their comparisons."""
    shadow_map, receiver = random_map(), receivers(*random_places())
    soft = SoftCompare(40.0)
    taps = FILTERS[name].read(shadow_map, receiver)
    total = sum(tap.weight for tap in taps)
    expected = sum(tap.weight * soft(tap.stored, receiver) for tap in taps) / total
    lit = look(shadow_map, receiver, FILTERS[name], soft)
    assert_close(lit, expected, ulps=16)
    assert 0.1 < float(lit.min()) < float(jnp.median(lit)) < 1


# Errors


@pytest.mark.errors
@pytest.mark.parametrize("radius", [-1, 17, 1.5, True, "2"])
def test_pcf_refuses_a_radius_that_is_none(radius):
    with pytest.raises(ValueError, match=rf"^PCFFilter: expected `radius` .*16, got {radius}$"):
        PCFFilter(radius)


@pytest.mark.errors
@pytest.mark.parametrize("radius", [0, 4, -1, 1.5, "2"])
def test_tent_refuses_a_radius_that_has_no_closed_form(radius):
    message = rf"^TentFilter: expected `radius` 1, 2 or 3, got {radius}$"
    with pytest.raises(ValueError, match=message):
        TentFilter(radius)
