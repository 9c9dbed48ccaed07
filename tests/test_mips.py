"""Mips and trilinear lookup: against the oracle, means kept, levels, and their derivatives."""

import functools
import itertools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from tangentspace.mips import Mips, build_mips, mip_level, sample_trilinear, texel_footprint
from tangentspace.texture import clamp, mirror, repeat, sample_bilinear

from .texture_reference import mips_reference, trilinear_reference
from .tools import assert_close

WRAPS = {"repeat": repeat, "clamp": clamp, "mirror": mirror}
SIZES = [(1, 1), (1, 6), (7, 1), (3, 5), (9, 20), (16, 8)]
SIZE = (9, 20)

build = jax.jit(build_mips)


@functools.cache
def sampler(wrap_u="repeat", wrap_v="repeat"):
    wraps = {"wrap_u": WRAPS[wrap_u], "wrap_v": WRAPS[wrap_v]}
    return jax.jit(functools.partial(sample_trilinear, **wraps))


def image(size=SIZE, channels=2, dtype=np.float64):
    return np.random.default_rng(0).uniform(-1, 1, (*size, channels)).astype(dtype)


def pixels(count=120, dtype=np.float64):
    """Points and footprints, from a tenth of a texel to several images."""
    rng = np.random.default_rng(1)
    uvs = rng.uniform(-1.5, 2.5, (count, 2))
    lengths = np.exp(rng.uniform(np.log(0.005), np.log(4), (count, 1, 1)))
    steps = lengths * rng.normal(size=(count, 2, 2))
    return tuple(a.astype(dtype) for a in (uvs, steps[:, 0], steps[:, 1]))


# Known answers


@pytest.mark.parametrize("size", SIZES)
def test_levels_against_the_oracle(size, dtype):
    texels = image(size, dtype=dtype)
    levels, expected = build(texels).levels, mips_reference(texels)
    assert [level.shape for level in levels] == [level.shape for level in expected]
    for level, reference in zip(levels, expected, strict=True):
        assert level.dtype == dtype
        assert_close(level, reference, ulps=8)


@pytest.mark.parametrize("modes", list(itertools.product(WRAPS, WRAPS)), ids="-".join)
def test_lookup_against_the_oracle(modes, dtype):
    texels, view = image(dtype=dtype), pixels(dtype=dtype)
    values = sampler(*modes)(build(texels), *view)
    assert values.dtype == dtype
    expected = trilinear_reference(texels, *(a.astype(np.float64) for a in view), modes)
    assert_close(values, expected, ulps=128)  # measured 60 in float32, of places


@pytest.mark.parametrize("size", SIZES)
def test_any_size_against_the_oracle(size):
    texels, view = image(size), pixels(40)
    expected = trilinear_reference(texels, *view, ("repeat", "repeat"))
    assert_close(sampler()(build(texels), *view), expected)


@pytest.mark.parametrize(
    ("across", "down", "expected"),
    [
        ((1 / 64, 0), (0, 1 / 16), 0),  # one texel
        ((2 / 64, 0), (0, 1 / 16), 1),
        ((1 / 64, 0), (0, 3 / 16), math.log2(3)),
        ((3 / 64, 4 / 16), (0, 0), math.log2(5)),  # the length, not a side
        ((0.001, 0), (0, 0.001), 0),  # magnified
        ((0, 0), (0, 0), 0),
        ((100, 0), (0, 0), 6),  # beyond the last level
    ],
)
def test_level_is_that_of_the_longer_footprint(across, down, expected, dtype):
    across, down = np.array(across, dtype), np.array(down, dtype)
    level = mip_level(across, down, (16, 64))
    assert level.dtype == dtype
    assert_close(level, expected, ulps=4)
    assert_close(mip_level(down, across, (16, 64)), expected, ulps=4)


def test_footprint_is_measured_in_texels(dtype):
    across, down = np.array([[3 / 64, 4 / 16], [0, 0]], dtype), np.array([[0.01, 0], [0, 0]], dtype)
    assert_close(texel_footprint(across, down, (16, 64)), [5, 0], ulps=4)


def test_levels_show_what_they_should():
    """A checkerboard of texels is gray from half a footprint on."""
    board = (np.indices((8, 8)).sum(axis=0) % 2)[..., None].astype(float)
    at = lambda texels: sampler()(
        build(board), np.array([0.5 / 8, 0.5 / 8]), np.array([texels / 8, 0.0]), np.zeros(2)
    )
    assert_close(at(1.0), [1.0], ulps=0)
    assert_close(at(2**0.5), [0.75], ulps=4)
    assert_close(at(2.0), [0.5], ulps=0)
    assert_close(at(50.0), [0.5], ulps=0)


# Laws


@pytest.mark.parametrize("size", SIZES)
def test_every_level_has_the_mean_of_the_image(size):
    texels = image(size)
    for level in build(texels).levels:
        assert_close(np.mean(level, axis=(0, 1)), texels.mean(axis=(0, 1)))


@pytest.mark.parametrize("size", SIZES)
def test_one_color_at_every_level(size, dtype):
    """To the last bit, also from odd sizes: a flat normal map stays flat from afar."""
    texels = np.full((*size, 1), 1 / 3, dtype)
    assert_close(build(texels).texels, texels[0, 0, 0], ulps=0)
    assert_close(sampler()(build(texels), *pixels(40, dtype)), texels[0, 0, 0], ulps=0)


@pytest.mark.parametrize("modes", [("repeat", "mirror"), ("clamp", "clamp")], ids="-".join)
def test_magnified_is_bilinear(modes):
    texels, (uvs, uv_dx, uv_dy) = image(), pixels()
    length = texel_footprint(uv_dx, uv_dy, SIZE)[:, None]
    steps = uv_dx / length, uv_dy / length * 0.9
    wraps = {"wrap_u": WRAPS[modes[0]], "wrap_v": WRAPS[modes[1]]}
    expected = sample_bilinear(texels, uvs, **wraps)
    assert_close(sampler(*modes)(build(texels), uvs, *steps), expected, ulps=8)


def test_lookup_is_continuous_in_the_footprint():
    """Also where one level gives way to the next."""
    mips, (uvs, uv_dx, _) = build(image()), pixels()
    unit = uv_dx / np.asarray(texel_footprint(uv_dx, uv_dx, SIZE))[:, None]
    for length in 2.0 ** np.arange(6):
        near = [sampler()(mips, uvs, (length + e) * unit, 0 * unit) for e in (-1e-9, 1e-9)]
        assert float(jnp.abs(near[0] - near[1]).max()) < 1e-8  # measured 1e-9


@pytest.mark.parametrize("mode", WRAPS)
def test_far_points_and_footprints_are_texels_of_the_image(mode, dtype):
    texels = image(dtype=dtype)
    odd = np.array([0.0, 1e6, 3e38, -np.inf, np.nan], dtype)
    uvs, steps = (np.stack(np.meshgrid(a, odd), -1).reshape(-1, 2) for a in (odd, odd[::-1]))
    values = np.asarray(sampler(mode, mode)(build(texels), uvs, steps, steps[::-1]))
    assert np.isfinite(values).all()
    assert values.min() >= texels.min()
    assert values.max() <= texels.max()


# Derivatives


def test_derivatives_of_the_lookup():
    mips, (uvs, uv_dx, uv_dy) = build(image((6, 5))), pixels(12)
    lengths = texel_footprint(uv_dx, uv_dy, (6, 5)) / np.linspace(0.2, 3.9, 12)
    view = (uvs, uv_dx / lengths[:, None], uv_dy / lengths[:, None])
    assert sum(mip_level(*view[1:], (6, 5)) % 1 > 0) == 9  # two magnified
    look = lambda texels, *view: sampler()(Mips(texels, (6, 5)), *view)
    check_grads(look, (mips.texels, *view), 1, ("fwd", "rev"), eps=1e-7, rtol=1e-5)


@pytest.mark.parametrize("size", [(6, 5), (8, 4)])
def test_derivatives_of_the_mips(size):
    check_grads(lambda texels: build(texels).texels, (image(size),), 1, ("fwd", "rev"))


def test_derivative_of_the_level():
    level = lambda across, down: mip_level(across, down, (64, 64))
    steps = np.array([0.05, 0.02]), np.array([-0.01, 0.03])
    check_grads(level, steps, 1, ("fwd", "rev"))
    check_grads(lambda *steps: texel_footprint(*steps, (64, 64)), steps, 1, ("fwd", "rev"))


ODD_STEPS = [[0.0, 0.0], [1e-30, 0.0], [np.inf, 0.0], [np.nan, 1.0], [-np.inf, np.nan]]


@pytest.mark.parametrize("derivative", [jax.jacrev, jax.jacfwd])
def test_where_the_level_is_clamped_its_derivative_is_zero(derivative, dtype):
    """No footprint, what is none, magnification, and beyond the last level."""
    mips, uv = build(image(dtype=dtype)), np.array([0.3, 0.4], dtype)
    look = lambda *steps: sample_trilinear(mips, uv, *steps).sum()
    steps = jnp.asarray([*ODD_STEPS, [1e-3, 0.0], [40.0, 0.0]], dtype)
    slopes = jax.jit(jax.vmap(derivative(look, argnums=(0, 1))))(steps, steps)
    for slope in slopes:
        assert_close(slope, np.zeros(steps.shape), ulps=0)


def test_derivatives_of_odd_footprints_are_finite(dtype):
    steps = jnp.asarray(ODD_STEPS, dtype)
    length = lambda *steps: texel_footprint(*steps, SIZE).sum()
    for slope in jax.grad(length, argnums=(0, 1))(steps, jnp.zeros_like(steps)):
        assert np.isfinite(slope).all()


# Transformations


def test_vmap_and_leading_axes():
    mips, view = build(image()), pixels(24)
    expected = sampler()(mips, *view)
    shaped = sampler()(mips, *(a.reshape(2, 12, 2) for a in view))
    assert_close(shaped.reshape(24, 2), expected, ulps=8)
    one_by_one = jax.vmap(functools.partial(sample_trilinear, mips))(*map(jnp.asarray, view))
    assert_close(one_by_one, expected, ulps=8)


# Errors


@pytest.mark.errors
def test_wrong_arguments_are_refused():
    mips, uv = build(image()), np.zeros((3, 2))
    with pytest.raises(ValueError, match=r"^build_mips: expected `texels`.*got \(3, 4\)"):
        build_mips(np.zeros((3, 4)))
    with pytest.raises(ValueError, match=r"^sample_trilinear: expected `uvs`.*got \(3,\)"):
        sample_trilinear(mips, np.zeros(3), uv, uv)
    with pytest.raises(ValueError, match=r"^sample_trilinear: expected `uv_dx`.*got \(2,\)"):
        sample_trilinear(mips, uv, np.zeros(2), np.zeros(2))
    with pytest.raises(ValueError, match=r"^texel_footprint: expected.*\(3, 2\) and \(2,\)"):
        sample_trilinear(mips, uv, uv, np.zeros(2))
    with pytest.raises(ValueError, match=r"^texel_footprint: expected `uv.*got \(3, 3\)"):
        mip_level(np.zeros((3, 3)), np.zeros((3, 3)), SIZE)
