"""Scattered points: the pattern's promises, and lookups against the oracle at each point."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from shadows import BilinearFilter, HardCompare, PoissonFilter, ShadowMap, SoftCompare, look_up
from shadows.disc_filters import poisson_disc, read_disc

from .reference import look_up_reference
from .test_filters import BLOCKED, HEIGHT, WIDTH, look, random_map, random_places, receivers
from .tools import assert_close

COUNTS = [2, 3, 16, 50, 128]


# The pattern


def test_pattern_is_always_the_same():
    """Also in another order of asking: it is part of what a result depends on."""
    again = {count: poisson_disc.__wrapped__(count) for count in COUNTS[::-1]}
    for count in COUNTS:
        assert_close(again[count], poisson_disc(count), ulps=0)
    assert_close(poisson_disc(2)[0], [0.425161, -0.565012], ulps=1e10)  # six digits


@pytest.mark.parametrize("count", COUNTS)
def test_pattern_has_the_moments_of_the_disc(count):
    """Middle 0 and mean square distance 1/2, and no point outside."""
    points = poisson_disc(count)
    squared = np.sum(points**2, axis=1)
    assert points.shape == (count, 2)
    assert_close(points.mean(axis=0), np.zeros(2), ulps=2)
    assert_close(squared.mean(), 0.5, ulps=4)
    assert squared.max() <= 1  # 0.98 measured over 1 to 128 points


@pytest.mark.parametrize("count", COUNTS)
def test_points_keep_their_distance(count):
    """At best ``sqrt(2 / sqrt(3) * pi / count)``, 1.9 over the root; chance gives a tenth."""
    points = poisson_disc(count)
    apart = np.linalg.norm(points[:, None] - points, axis=-1) + 9 * np.eye(count)
    assert apart.min() > 1.25 / np.sqrt(count)  # least of 1 to 128 points: 1.30


def test_one_point_is_the_middle():
    assert_close(poisson_disc(1), np.zeros((1, 2)), ulps=0)


# Known answers


@pytest.mark.parametrize("taps", [3, 16])
@pytest.mark.parametrize("radius", [0.7, 3.0])
def test_poisson_is_the_mean_of_bilinear_lookups(radius, taps, dtype):
    shadow_map = random_map(dtype)
    receiver = receivers(*random_places(beyond=5.0), dtype)
    lit = look(shadow_map, receiver, PoissonFilter(radius, taps), HardCompare())
    places = (receiver.column, receiver.row, receiver.depth)
    stored, column, row, depth = (np.asarray(a, float) for a in (shadow_map.depth, *places))
    lookups = [
        look_up_reference(stored, column + radius * x, row + radius * y, depth, bilinear=True)
        for x, y in poisson_disc(taps)
    ]
    assert lit.dtype == dtype
    assert 0.2 < float(lit.mean()) < 0.9
    assert_close(lit, np.mean(lookups, axis=0), ulps=16)  # 2.8 measured
    assert 0 <= float(lit.min()) <= float(lit.max()) <= 1 + 8 * jnp.finfo(dtype).eps


@pytest.mark.parametrize("filter", [PoissonFilter(0.0), PoissonFilter(5.0, taps=1)])
def test_without_width_it_is_bilinear(filter):
    shadow_map, receiver = random_map(), receivers(*random_places())
    expected = look(shadow_map, receiver, BilinearFilter(), HardCompare())
    assert_close(look(shadow_map, receiver, filter, HardCompare()), expected, ulps=8)


def test_a_map_of_one_depth_is_lit_before_it_and_dark_behind():
    shadow_map = ShadowMap(jnp.full((HEIGHT, WIDTH), 0.5), jnp.eye(4))
    column, row = np.random.default_rng(2).uniform(4, [WIDTH - 4, HEIGHT - 4], (50, 2)).T
    depth = np.where(np.arange(50) % 2, 0.4999, 0.5001)
    lit = look(shadow_map, receivers(column, row, depth), PoissonFilter(2.9), HardCompare())
    assert_close(lit, (np.arange(50) % 2).astype(float), ulps=4)


@pytest.mark.parametrize("taps", [1, 16])
def test_beyond_its_reach_of_the_map_all_is_lit(taps):
    filter = PoissonFilter(2.0, taps)
    far = float(filter.reach()) - 0.5 + np.array([1e-6, 1e12])
    column = np.concatenate([-far, WIDTH + far, *[np.full(2, 5.5)] * 2])
    row = np.concatenate([*[np.full(2, 5.5)] * 2, -far, HEIGHT + far])
    at = receivers(column, row, np.full(8, 0.5))
    assert_close(look(BLOCKED, at, filter, HardCompare()), np.ones(8), ulps=0)
    outside = receivers(np.full(2, 5.0), np.full(2, 5.0), np.array([-0.01, 1.01]))
    assert_close(look(BLOCKED, outside, filter, HardCompare()), np.ones(2), ulps=0)


# Laws


def test_offsets_lead_from_the_receiver_to_texel_centres():
    """That is what its plane is followed along."""
    receiver = receivers(*random_places())
    for tap in PoissonFilter(2.7).read(random_map(), receiver):
        for place, offset in ((receiver.column, tap.across), (receiver.row, tap.down)):
            centre = place + offset - 0.5
            assert_close(centre, np.round(centre))
            assert float(jnp.abs(offset).max()) <= float(PoissonFilter(2.7).reach())


def test_reach_holds_for_every_number_of_points():
    for taps in (1, *COUNTS, 120):  # 120 reach farthest of all
        assert np.abs(poisson_disc(taps)).max() * 2.0 + 1 <= PoissonFilter(2.0, taps).reach()


def test_continuous_in_place_and_radius():
    shadow_map, (column, row, depth) = random_map(), random_places()

    def lit(shift, radius):
        at = receivers(column + shift, row + shift, depth)
        return look(shadow_map, at, PoissonFilter(radius), HardCompare())

    for radius in (0.0, 1.0, 2.5):
        assert float(jnp.abs(lit(1e-9, radius) - lit(-1e-9, radius)).max()) < 1e-8  # 4e-9
        assert float(jnp.abs(lit(0.0, radius) - lit(0.0, radius + 1e-9)).max()) < 1e-8
    assert float(jnp.abs(lit(0.0, 1.0) - lit(0.0, 2.5)).max()) > 0.1


def test_each_receiver_may_have_its_radius():
    shadow_map, receiver = random_map(), receivers(*random_places())
    radius = jnp.asarray(np.random.default_rng(3).choice([0.0, 1.0, 3.0], 400))
    each = read_disc(shadow_map, receiver, poisson_disc(5), radius)
    for value in (0.0, 1.0, 3.0):
        alike = read_disc(shadow_map, receiver, poisson_disc(5), value)
        for one, other in zip(each, alike, strict=True):
            assert_close(one.stored[:, radius == value], other.stored[:, radius == value], ulps=0)
            assert_close(one.weight[:, radius == value], other.weight[:, radius == value], ulps=4)


# Derivatives


@pytest.mark.parametrize("compare", [HardCompare(), SoftCompare(20.0)], ids=["hard", "soft"])
def test_derivative_in_the_radius(compare):
    """Also with a hard comparison: the points' weights change."""
    receiver = receivers(*random_places(30, beyond=1.0))
    weights = jnp.asarray(np.random.default_rng(3).normal(size=30))

    @jax.jit
    def loss(radius):
        filter = PoissonFilter(radius, taps=8)
        return weights @ look_up(random_map(), receiver, filter=filter, compare=compare)

    radius, step = jnp.asarray(1.837), 1e-6
    numerical = (loss(radius + step) - loss(radius - step)) / (2 * step)
    assert abs(float(numerical)) > 0.05
    np.testing.assert_allclose(jax.jit(jax.grad(loss))(radius), numerical, rtol=1e-6)
    forward = jax.jit(jax.jacfwd(loss))(radius)
    np.testing.assert_allclose(forward, jax.jit(jax.grad(loss))(radius), rtol=1e-12)
    assert bool(jnp.isfinite(jax.grad(loss)(jnp.asarray(0.0))))


def test_the_radius_is_a_leaf_and_the_taps_are_not():
    assert jax.tree.leaves(PoissonFilter(1.5, taps=7)) == [1.5]
    traces = []

    @eqx.filter_jit
    def traced(filter, receiver):
        traces.append(filter.taps)
        return look_up(random_map(), receiver, filter=filter, compare=HardCompare())

    receiver = receivers(*random_places())
    for radius in (0.5, 1.5):
        traced(PoissonFilter(jnp.asarray(radius)), receiver)
    assert traces == [16]


# Errors


@pytest.mark.errors
@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"radius": -0.5}, "expected `radius` of at least 0, got -0.5"),
        ({"radius": float("nan")}, "expected `radius` of at least 0, got nan"),
        ({"radius": np.float32(-1)}, "expected `radius` of at least 0, got -1.0"),
        ({"taps": 0}, "expected `taps` from 1 to 128, got 0"),
        ({"taps": 129}, "expected `taps` from 1 to 128, got 129"),
        ({"taps": 2.5}, "expected `taps` from 1 to 128, got 2.5"),
        ({"taps": True}, "expected `taps` from 1 to 128, got True"),
    ],
)
def test_illegal_options_are_named(options, says):
    with pytest.raises(ValueError, match=f"^PoissonFilter: {says}$"):
        PoissonFilter(**options)
