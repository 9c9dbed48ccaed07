"""Comparisons: the soft one, its limit, its derivative in closed form, what never blocks."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from shadows import ConstantBias, HardCompare, SoftCompare, receive, texel_from_clip

from .tools import assert_close

SIZE, RANGE = 64, 10.0
# Parallel light from +z on [-1, 1]^2: a texel is 2 / SIZE wide, depth 1 is RANGE long.
MATRIX = texel_from_clip(SIZE, SIZE) @ jnp.diag(jnp.array([1.0, 1.0, -2 / RANGE, 1.0]))
HALF_TEXEL = 1 / SIZE / RANGE  # as a window depth
TOWARDS = jnp.array([0.0, 0.0, 1.0])


def receivers(tilt_degrees, count=1):
    """Points in the middle of the map, on planes tilted along its columns."""
    angle = jnp.deg2rad(jnp.broadcast_to(jnp.asarray(tilt_degrees, float), (count,)))
    normal = jnp.stack([jnp.sin(angle), jnp.zeros(count), jnp.cos(angle)], axis=-1)
    shape = (count, 3)
    return receive(jnp.zeros(shape), normal, jnp.broadcast_to(TOWARDS, shape), MATRIX)


@jax.jit
def visibility(margin, length, softness, tilt):
    """Of a point that lies ``margin`` before what is stored there, under a constant bias."""
    receiver = ConstantBias(length)(receivers(tilt))
    return SoftCompare(softness)(receiver.depth + margin, receiver)[0]


# Known answers


def test_hard_comparison_lets_equal_depths_pass(dtype):
    receiver = jax.tree.map(lambda x: x.astype(dtype) if x.dtype == float else x, receivers(30, 4))
    stored = receiver.depth + jnp.asarray([-0.1, -1e-5, 0, 0.1], dtype)
    lit = HardCompare()(stored, receiver)
    assert lit.dtype == dtype
    assert_close(lit, np.array([0.0, 0, 1, 1]), ulps=0)


@pytest.mark.parametrize("tilt", [0.0, 40.0, -75.0])
def test_width_is_half_a_texel_along_the_surface(tilt):
    """The sigmoid's unit is the length of half a texel on the tilted surface."""
    width = 0.7 * HALF_TEXEL / np.cos(np.deg2rad(tilt))
    for share in (-2.0, 0.0, 0.3):
        expected = 1 / (1 + np.exp(-share))
        assert_close(visibility(share * width, 0.0, 0.7, tilt), expected, ulps=2**12)


# Laws


@pytest.mark.parametrize("tilt", [0.0, 40.0])
def test_softness_to_0_is_the_hard_comparison(tilt):
    margins = HALF_TEXEL * jnp.array([-1.0, -1e-3, 0.0, 1e-3, 1.0])
    receiver = receivers(tilt, 5)
    hard = HardCompare()(receiver.depth + margins, receiver)
    soft = jax.jit(lambda softness: SoftCompare(softness)(receiver.depth + margins, receiver))
    assert_close(hard, np.array([0.0, 0, 1, 1, 1]), ulps=0)
    assert_close(soft(0.0), hard, ulps=0)
    off_the_step = np.array([0, 1, 3, 4])
    errors = [
        float(jnp.abs(soft(softness) - hard)[off_the_step].max())
        for softness in (1.0, 1e-1, 1e-2, 1e-3, 1e-4)
    ]
    assert errors == sorted(errors, reverse=True)
    assert errors[-1] < 1e-3  # sigmoid(-7.6) at 40 degrees: measured 4.7e-4
    assert_close(soft(1e-6)[off_the_step], hard[off_the_step], ulps=0)


def test_monotone_in_bias_and_in_depth():
    lengths = jnp.linspace(-0.5, 0.5, 40)
    rising = jax.vmap(lambda length: visibility(0.0, length, 20.0, 30.0))(lengths)
    assert float(jnp.min(jnp.diff(rising))) > 0
    margins = jnp.linspace(-0.05, 0.05, 40)
    rising = jax.vmap(lambda margin: visibility(margin, 0.0, 20.0, 30.0))(margins)
    assert float(jnp.min(jnp.diff(rising))) > 0
    assert 0 < float(rising[0]) < 0.5 < float(rising[-1]) < 1


@pytest.mark.parametrize("tilt", [0.0, 45.0, 89.0])
@pytest.mark.parametrize("softness", [0.0, 0.5, 2.0, 100.0, 1e6])
def test_cleared_texels_never_block(softness, tilt):
    """Whatever the softness: nothing was drawn there, so there is nothing to be soft about."""
    receiver = receivers(tilt)
    compare = jax.jit(lambda stored: SoftCompare(softness)(stored, receiver))
    assert_close(compare(jnp.ones(1)), np.ones(1), ulps=1)
    assert_close(HardCompare()(jnp.ones(1), receiver), np.ones(1), ulps=0)


def test_cleared_texels_never_block_what_lies_deepest():
    """Also at the far plane itself, and with a bias against light."""
    receiver = receivers(0.0)._replace(depth=jnp.ones(1), depth_bias=jnp.full(1, -0.3))
    assert_close(HardCompare()(jnp.ones(1), receiver), np.ones(1), ulps=0)
    assert_close(SoftCompare(0.5)(jnp.ones(1), receiver), np.ones(1), ulps=1)


# Derivatives


@pytest.mark.parametrize("tilt", [0.0, 40.0])
def test_derivative_in_closed_form(tilt):
    """V (1 - V) / width in the margin; times depth per length in the bias."""
    softness, margin = 0.8, 0.3 * HALF_TEXEL
    width = softness * HALF_TEXEL / np.cos(np.deg2rad(tilt))
    value = visibility(margin, 0.0, softness, tilt)
    slopes = jax.grad(visibility, (0, 1, 2))(margin, 0.0, softness, tilt)
    steepness = value * (1 - value) / width
    expected = steepness, steepness / RANGE, -steepness * margin / softness
    for slope, law in zip(slopes, expected, strict=True):
        assert float(slope) == pytest.approx(float(law), rel=1e-12)


def test_derivatives_at_a_generic_point():
    # The tilt in radians: one radian of it changes about as much as the others.
    turned = lambda margin, length, softness, tilt: visibility(
        margin * HALF_TEXEL, length / SIZE, softness, jnp.rad2deg(tilt)
    )
    check_grads(turned, (0.3, 0.2, 1.3, 0.5), 1, ("fwd", "rev"))


@pytest.mark.parametrize("margin", [-1.0, 0.0, 1.0])
def test_softness_0_has_zero_derivatives(margin):
    for derivative in jax.grad(visibility, (0, 1, 2, 3))(margin * HALF_TEXEL, 0.0, 0.0, 30.0):
        assert float(derivative) == 0.0


FLAT = {
    "at the light": lambda r: r._replace(depth_rate=jnp.zeros(1)),
    "facing": lambda r: r,
    "nothing known": lambda r: r._replace(
        depth_rate=jnp.zeros(1), texel_length=jnp.zeros(1), depth=jnp.zeros(1)
    ),
}


@pytest.mark.parametrize("softness", [0.0, 0.5])
@pytest.mark.parametrize("case", FLAT)
def test_finite_where_the_width_vanishes(case, softness):
    """With no slope and no depth per length the width is 0: the hard comparison."""
    receiver = FLAT[case](receivers(0.0))
    floats = (
        "depth",
        "depth_bias",
        "depth_per_column",
        "depth_per_row",
        "depth_rate",
        "texel_length",
    )

    def value(softness, stored, *fields):
        changed = receiver._replace(**dict(zip(floats, fields, strict=True)))
        return SoftCompare(softness)(stored, changed)[0]

    fields = [getattr(receiver, name) for name in floats]
    arguments = (softness, jnp.full(1, 0.3), *fields)
    derivatives = jax.jit(jax.grad(value, tuple(range(len(arguments)))))(*arguments)
    for derivative in derivatives:
        assert bool(jnp.isfinite(derivative).all())
    hard = float(HardCompare()(jnp.full(1, 0.3), receiver)[0])
    assert float(value(*arguments)) == pytest.approx(hard, abs=1e-12)


# Transformations


def test_vmap_over_softness_is_a_loop():
    softness = jnp.array([0.0, 0.1, 0.5, 3.0])
    of = functools.partial(visibility, 0.2 * HALF_TEXEL, 0.01)
    looped = jnp.stack([of(value, 30.0) for value in softness])
    assert_close(jax.vmap(of, (0, None))(softness, 30.0), looped, ulps=4)
