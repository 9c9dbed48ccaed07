"""Bounds from prefiltered moments: exact distributions, laws, derivatives, float32."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from shadows import (
    ESMFilter,
    EVSM2Filter,
    EVSM4Filter,
    MSMFilter,
    VSMFilter,
    chebyshev_bound,
    moment_shadow_intensity,
)

from .moment_reference import lit_reference
from .tools import assert_close

# Without what hides rounding: bounds of the distribution itself.
EXACT = {
    "vsm": VSMFilter(min_variance=0.0),
    "esm": ESMFilter(exponent=20.0),
    "evsm2": EVSM2Filter(min_variance=0.0),
    "evsm4": EVSM4Filter(min_variance=0.0),
    "msm": MSMFilter(moment_bias=0.0),
}
DEFAULTS = {
    "vsm": VSMFilter(bleeding=0.1),
    "esm": ESMFilter(),
    "evsm2": EVSM2Filter(),
    "evsm4": EVSM4Filter(),
    "msm": MSMFilter(),
}
FILTERS = {**EXACT, **{f"{name} default": filter for name, filter in DEFAULTS.items()}}


def mean_moments(filter, depths, weights):
    """Means of what the filter stores, over the last axis."""
    stored = filter.moments(2 * jnp.asarray(depths) - 1)
    return tuple(jnp.sum(jnp.asarray(weights) * image, axis=-1) for image in stored)


@jax.jit
def lit(filter, depths, weights, z):
    """Share lit of distributions (last axis) at depths in [0, 1]."""
    depth, *moments = jnp.broadcast_arrays(
        2 * jnp.asarray(z) - 1, *mean_moments(filter, depths, weights)
    )
    return filter.lit(tuple(moments), depth)


def random_distributions(count, points, seed=0):
    """Depths, weights that sum to 1, and depths of receivers."""
    rng = np.random.default_rng(seed)
    weights = rng.uniform(0.05, 1, (count, points))
    weights /= weights.sum(axis=1, keepdims=True)
    return rng.uniform(0, 1, (count, points)), weights, rng.uniform(0, 1, count)


def lit_share(depths, weights, z):
    """The exact share at or behind a depth."""
    return np.sum(weights * (depths >= z[:, None]), axis=1)


# Known answers

# depths, their weights, the receiver's depth; shadow by VSM, ESM, EVSM4, 4MSM, and 4MSM
# with a bias of 3e-5 towards (1/2, 1/2, 1/2, 1/2) in depths from 0 to 1.
TABLE = [
    ([0.3, 0.7], [0.5, 0.5], 0.7, [0.5, 0.499832, 0.5, 0.5, 0.499968]),
    ([0.3, 0.7], [0.5, 0.5], 0.9, [0.8, 0.990839, 1.0, 1.0, 0.999908]),
    ([0.2, 0.5, 0.8], [0.4, 0.3, 0.3], 0.8, [0.636842, 0.699254, 0.7, 0.7, 0.699930]),
    ([0.1, 0.4, 0.6], [0.5, 0.25, 0.25], 0.95, [0.903743, 0.999768, 1.0, 0.994711, 0.994689]),
]


@pytest.mark.parametrize(("depths", "weights", "z", "shadows"), TABLE)
def test_exact_distributions(depths, weights, z, shadows):
    depths, weights = np.array(depths), np.array(weights)
    msm = MSMFilter(moment_bias=1e-10)
    found = [1 - lit(EXACT[name], depths, weights, z) for name in ("vsm", "esm", "evsm4")]
    found.append(1 - lit(msm, depths, weights, z))
    moments = tuple(jnp.asarray(weights @ depths**j) for j in (1, 2, 3, 4))
    half = (0.5, 0.5, 0.5, 0.5)
    found.append(moment_shadow_intensity(moments, jnp.asarray(z), bias=3e-5, target=half))
    np.testing.assert_allclose(found, shadows, atol=1e-6)  # the table has six digits


@pytest.mark.parametrize("name", FILTERS)
def test_against_the_oracle(name):
    depths, weights, z = random_distributions(300, 5)
    expected = [lit_reference(FILTERS[name], *row) for row in zip(depths, weights, z, strict=True)]
    assert 0.3 < np.mean(expected) < 0.9
    np.testing.assert_allclose(lit(FILTERS[name], depths, weights, z), expected, atol=1e-9)


def test_light_bleeds_through_two_blockers():
    """Both block all light; their spread is what Chebyshev takes for a penumbra."""
    depths, weights, z = np.array([0.2, 0.6]), np.array([0.5, 0.5]), 0.95
    variance, distance = 0.2**2, 0.55
    bled = variance / (variance + distance**2)
    assert_close(lit(EXACT["vsm"], depths, weights, z), bled)
    for bleeding in (0.05, 0.1):
        reduced = lit(VSMFilter(bleeding=bleeding), depths, weights, z)
        assert_close(reduced, (bled - bleeding) / (1 - bleeding))
    assert float(lit(VSMFilter(bleeding=0.2), depths, weights, z)) == 0
    for name in ("esm", "evsm2", "evsm4", "msm"):
        assert float(lit(EXACT[name], depths, weights, z)) < 1e-3  # measured at most 5e-4, ESM


def test_min_variance_is_of_the_depth_under_every_warp():
    """On one depth, to first order the same bound: the warp's slope scales the variance."""
    depths, weights, behind = np.array([0.5]), np.array([1.0]), 1e-4
    expected = 1e-6 / (1e-6 + behind**2)
    for filter in (
        VSMFilter(min_variance=1e-6),
        EVSM2Filter(exponent=0.5, min_variance=1e-6),
        EVSM4Filter(exponent=0.5, negative_exponent=0.5, min_variance=1e-6),
    ):
        found = lit(filter, depths, weights, 0.5 + behind)
        np.testing.assert_allclose(found, expected, rtol=1e-4)  # measured 2e-6


# Laws


@pytest.mark.parametrize("points", [1, 2, 3, 8])
@pytest.mark.parametrize("name", EXACT)
def test_never_darker_than_the_truth(name, points):
    """Cantelli's, Markov's and Hamburger's bounds hold for every distribution."""
    depths, weights, z = random_distributions(2000, points)
    found = np.asarray(lit(EXACT[name], depths, weights, z))
    excess = found - lit_share(depths, weights, z)
    assert excess.min() > -1e-7  # measured -2e-8, MSM at two depths
    assert found.max() <= 1
    told = points == 1 or (points == 2 and name == "msm")
    assert told or excess.max() > 0.05


def test_chebyshev_is_reached_by_two_depths():
    depths, weights, _ = random_distributions(200, 2)
    z = depths.max(axis=1)
    exact = lit_share(depths, weights, z)
    moments = (np.sum(weights * depths**j, axis=1) for j in (1, 2))
    bound = chebyshev_bound(*map(jnp.asarray, (*moments, z)))
    np.testing.assert_allclose(bound, exact, atol=1e-9)  # measured 3e-12


def test_four_moments_tell_three_depths():
    """The receiver's depth among them, the distribution is the only one with its moments."""
    depths, weights, _ = random_distributions(500, 3, seed=2)
    depths = np.sort(depths, axis=1)
    for k in range(3):
        exact = weights[:, :k].sum(axis=1)
        apart = np.diff(depths, axis=1).min(axis=1) > 0.05
        found = 1 - np.asarray(lit(EXACT["msm"], depths, weights, depths[:, k]))
        assert np.abs(found - exact)[apart].max() < 1e-6  # measured 3e-8


def test_four_moments_tell_no_less_than_two():
    depths, weights, z = random_distributions(5000, 6)
    more, less = (np.asarray(lit(EXACT[name], depths, weights, z)) for name in ("msm", "vsm"))
    assert (more - less).max() < 1e-9
    assert (less - more).max() > 0.2


def test_evsm4_is_never_lighter_than_evsm2():
    depths, weights, z = random_distributions(5000, 6)
    four, two = (np.asarray(lit(DEFAULTS[name], depths, weights, z)) for name in ("evsm4", "evsm2"))
    assert (four <= two).all()
    assert (two - four).max() > 0.2


@pytest.mark.parametrize("name", FILTERS)
def test_the_deeper_the_darker(name):
    depths, weights, _ = random_distributions(50, 6)
    z = np.linspace(0, 1, 401)
    columns = lit(FILTERS[name], depths[:, None], weights[:, None], z)
    assert float(jnp.diff(columns, axis=1).max()) < 1e-9
    assert_close(columns[:, 0], np.ones(50), ulps=1e8)  # MSM's bias: 3e-9
    assert float(columns[:, -1].mean()) < 0.3  # measured 0.24, VSM


@pytest.mark.parametrize("name", ["vsm", "msm"])
def test_scale_and_origin_of_the_depth_do_not_matter(name):
    depths, weights, z = random_distributions(500, 6)
    moved = lambda x: 0.2 + 0.5 * x
    expected = lit(EXACT[name], depths, weights, z)
    found = lit(EXACT[name], moved(depths), weights, moved(z))
    np.testing.assert_allclose(found, expected, atol=1e-9)  # measured 2e-11


@pytest.mark.parametrize("name", DEFAULTS)
def test_one_depth_is_a_step(name):
    """Lit in front of it and at it, dark behind: what the defaults leave to rounding."""
    z = np.array([0.3, 0.5, 0.55])
    found = lit(DEFAULTS[name], np.array([0.5]), np.array([1.0]), z)
    np.testing.assert_allclose(found, [1, 1, 0], atol=0.02)  # measured 0.018, ESM


# Single precision


def random_texels(count):
    """Depths, weights and a receiver halfway between the deepest and the far end: all dark."""
    rng = np.random.default_rng(1)
    depths = rng.uniform(size=(400_000, count))
    first = rng.uniform(size=(400_000, 1)) if count == 2 else np.ones((400_000, 1))
    weights = np.concatenate([first, 1 - first], axis=1)[:, :count]
    z = 0.5 * (depths.max(axis=1) + 1)
    return (x.astype(np.float32) for x in (depths, weights, z))


# depths in a texel; share of invalid ones (%), mean leak, its 99th percentile
STABILITY = [(1, 3e-7, 0.14, 1e-3, 1e-3), (2, 3e-7, 0.008, 0.0026, 0.051)]
STABILITY += [(1, 3e-6, 0.0, 2e-3, 5e-3), (2, 3e-6, 0.0, 0.0063, 0.182)]


@pytest.mark.parametrize(("count", "bias", "invalid", "leak", "high_leak"), STABILITY)
def test_moments_in_single_precision(count, bias, invalid, leak, high_leak):
    """Published: depths in [-1, 1] with a bias of 3e-7 and of 3e-6; here none is invalid.

    Beyond the table: gradients are finite as well.
    """
    texels = tuple(random_texels(count))
    filter = jax.tree.map(jnp.float32, MSMFilter(moment_bias=bias))
    found = np.asarray(lit(filter, *texels))
    assert found.dtype == np.float32
    wrong = ~np.isfinite(found) | (found < 0) | (found > 1)
    assert 100 * wrong.mean() <= invalid
    assert wrong.sum() == 0
    assert found.mean() <= 1.05 * leak
    assert np.percentile(found, 99) <= 1.05 * high_leak
    slopes = jax.jit(jax.grad(lambda *x: jnp.sum(lit(filter, *x)), argnums=(0, 1, 2)))(*texels)
    assert all(bool(jnp.isfinite(slope).all()) for slope in slopes)


LIMITS = {
    "esm": ESMFilter(exponent=88.72),
    "evsm2": EVSM2Filter(exponent=42.0),
    "evsm4": EVSM4Filter(exponent=42.0, negative_exponent=42.0),
}


@pytest.mark.parametrize("name", LIMITS)
def test_the_largest_exponents_in_single_precision(name):
    """Over the whole range of depths, its ends included."""
    rng = np.random.default_rng(3)
    depths = rng.uniform(0, 1, (1000, 3)).astype(np.float32)
    depths[::5, 0], depths[1::5, 1], depths[2::7] = 0, 1, rng.integers(0, 2, 143)[:, None]
    weights = np.full((1000, 3), 1 / 3, np.float32)
    z = rng.uniform(0, 1, 1000).astype(np.float32)
    z[::3], z[1::6] = 0, 1
    filter = jax.tree.map(jnp.float32, LIMITS[name])
    found = lit(filter, depths, weights, z)
    assert found.dtype == np.float32
    rows = zip(depths, weights / np.sum(weights, axis=1, keepdims=True), z, strict=True)
    expected = np.array([lit_reference(filter, *(np.float64(x) for x in row)) for row in rows])
    np.testing.assert_allclose(found, expected, atol=1e-4)
    total = lambda *x: jnp.sum(lit(*x))
    slopes = jax.tree.leaves(
        jax.jit(jax.grad(total, argnums=(0, 1, 2, 3)))(
            filter, *map(jnp.asarray, (depths, weights, z))
        )
    )
    assert all(bool(jnp.isfinite(slope).all()) for slope in slopes)


# Derivatives


def numbers(filter):
    """What of a filter a derivative of its bound exists in."""
    fields = dataclasses.fields(filter)
    return [f.name for f in fields if "unit" in f.metadata and f.name != "level"]


def bounds(point, filter):
    """The bound of each row, from moments, depth and numbers of its own."""

    def one(options, moments, depth):
        return dataclasses.replace(filter, **options).lit(moments, depth)

    return jax.vmap(one)(*point)


# Width of the distributions, and relative step of the differences: the narrow ones have so
# little variance that what hides rounding counts.
WIDE, NARROW = (1.0, 1e-6), (1e-3, 1e-7)
CASES = [(name, *WIDE) for name in DEFAULTS] + [("msm", 1e-3, 1e-6)]
CASES += [(name, *NARROW) for name in DEFAULTS if name != "msm"]


@pytest.mark.parametrize(("name", "width", "step"), CASES)
def test_derivatives_in_moments_depth_and_numbers(name, width, step):
    filter = DEFAULTS[name]
    depths, weights, z = random_distributions(60, 6, seed=6)
    depths, z = (0.5 + width * (x - 0.5) for x in (depths, z))
    options = {key: jnp.full(60, float(getattr(filter, key))) for key in numbers(filter)}
    point = (options, mean_moments(filter, depths, weights), jnp.asarray(2 * z - 1))
    of = jax.jit(lambda point: bounds(point, filter))
    forward = jax.jit(lambda point, step: jax.jvp(of, (point,), (step,))[1])
    reverse = jax.tree.leaves(jax.grad(lambda point: jnp.sum(of(point)))(point))
    paths, structure = jax.tree_util.tree_flatten_with_path(point)
    leaves = [leaf for _, leaf in paths]
    assert 0.05 < float(of(point).mean()) < 0.995
    for k, (path, leaf) in enumerate(paths):
        told = jax.tree_util.keystr(path)
        # Of moments, a difference is the variance.
        small = step * width if "[1]" in told else step
        ends = [
            of(jax.tree.unflatten(structure, [*leaves[:k], factor * leaf, *leaves[k + 1 :]]))
            for factor in (1 + small, 1 - small)
        ]
        numerical = np.asarray(ends[0] - ends[1]) / (2 * small)
        ones = [np.full(60, float(j == k)) for j in range(len(leaves))]
        found = np.asarray(leaf * forward(point, jax.tree.unflatten(structure, ones)))
        np.testing.assert_allclose(found, numerical, rtol=1e-5, atol=1e-14 / small, err_msg=told)
        np.testing.assert_allclose(leaf * reverse[k], found, rtol=1e-9, atol=1e-10)
        assert width == 1 or "[0]" not in told or np.abs(numerical).max() > 1e-3


# Depths of texels, weights, receiver: one depth and at it, nothing there, two alike, the ends.
SINGULAR = [
    ([0.5, 0.5], [0.5, 0.5], 0.5),
    ([0.5, 0.5], [0.5, 0.5], 0.75),
    ([0.5, 0.5], [0.5, 0.5], 0.25),
    ([1.0, 1.0], [0.5, 0.5], 1.0),
    ([1.0, 1.0], [0.5, 0.5], 0.5),
    ([0.0, 0.0], [0.5, 0.5], 0.0),
    ([0.0, 0.0], [0.5, 0.5], 1.0),
    ([0.0, 1.0], [0.5, 0.5], 0.0),
    ([0.0, 1.0], [0.5, 0.5], 0.5),
    ([0.0, 1.0], [0.5, 0.5], 1.0),
    ([0.25, 0.75], [1.0, 0.0], 0.25),
    ([0.25, 0.75], [1.0, 1e-30], 0.75),
]


@pytest.mark.parametrize("name", [*FILTERS, *(f"{name} limit" for name in LIMITS)])
def test_singular_points_are_finite(name, dtype):
    known = FILTERS | {f"{name} limit": filter for name, filter in LIMITS.items()}
    filter = jax.tree.map(lambda x: jnp.asarray(x, dtype), known[name])
    depths, weights, z = (jnp.asarray(x, dtype) for x in zip(*SINGULAR, strict=True))
    found = lit(filter, depths, weights, z)
    assert found.dtype == dtype
    assert bool(((found >= 0) & (found <= 1)).all())
    in_front = found[jnp.array([0, 2, 3, 4, 5, 7])]
    np.testing.assert_allclose(in_front, np.ones(6), atol=1e-6)  # measured 5e-7, MSM
    options = {"xla_backend_optimization_level": 0}
    derive = jax.jit(jax.jacrev(lit, argnums=(0, 1, 2, 3)), compiler_options=options)
    slopes = derive(filter, depths, weights, z)
    bad = [
        jax.tree_util.keystr(path)
        for path, slope in jax.tree_util.tree_flatten_with_path(slopes)[0]
        if not bool(jnp.isfinite(slope).all())
    ]
    assert not bad


def test_squares_that_vanish_are_finite(dtype):
    """Above a mean of 0 by less than what has a square: lit, as at the mean."""
    zero, tiny = jnp.zeros((), dtype), jnp.asarray(np.finfo(dtype).tiny, dtype)
    value, slopes = jax.value_and_grad(chebyshev_bound, argnums=(0, 1, 2))(zero, zero, tiny)
    assert float(value) == 1
    assert all(float(slope) == 0 for slope in slopes)


def test_an_exponent_that_a_fit_tries_stays_finite():
    """Beyond what a user may ask for; values are right, as receivers are compared in the log."""
    filter = ESMFilter(exponent=jnp.float32(120.0))
    depths = jnp.array([[0.0, 0.0], [1.0, 1.0], [0.5, 0.5]], jnp.float32)
    weights, z = jnp.full((3, 2), 0.5, jnp.float32), jnp.array([1.0, 0.0, 0.51], jnp.float32)
    np.testing.assert_allclose(lit(filter, depths, weights, z), [0, 1, np.exp(-1.2)], rtol=1e-5)
    slopes = jax.jacrev(lit, argnums=(0, 1, 2, 3))(filter, depths, weights, z)
    assert all(bool(jnp.isfinite(slope).all()) for slope in jax.tree.leaves(slopes))
