"""Highlights from afar: the flat map, the factor's limits, supersampling, derivatives."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from experiments.benchmarks.normal_mips import STYLES, bump_maps, relative_errors
from tangentspace.lighting import blinn_phong
from tangentspace.mips import sample_trilinear
from tangentspace.normal_filtering import build_normal_mips, mean_length, toksvig_gloss
from tangentspace.normal_map import decode_normals, encode_normals, quantize, scale_normals

from .tools import assert_close

UP = np.array([0.0, 0.0, 1.0])


def normals(size=(8, 8), spread=0.4):
    slopes = np.random.default_rng(0).normal(size=(*size, 2)) * spread
    vectors = np.concatenate([slopes, np.ones((*size, 1))], axis=-1)
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


# Known answers


@pytest.mark.parametrize(
    ("length", "shininess", "gloss"),
    [(1.0, 100.0, 1.0), (0.5, 1.0, 0.5), (0.5, 3.0, 0.25), (0.9, 36.0, 0.2), (0.9, 0.0, 1.0)],
)
def test_gloss_is_toksvigs_factor(length, shininess, gloss, dtype):
    factor = toksvig_gloss(np.asarray(length, dtype), shininess)
    assert factor.dtype == dtype
    assert_close(factor, gloss, ulps=8)


def test_length_of_two_normals_leaning_apart(dtype):
    """At an angle of 60 degrees on either side, the mean has half the length."""
    apart = np.array([[np.sqrt(0.75), 0, 0.5], [-np.sqrt(0.75), 0, 0.5]], dtype)
    length = mean_length(apart.mean(axis=0))
    assert length.dtype == dtype
    assert_close(length, 0.5, ulps=4)
    # With the variance of 1 about either axis: half of it at a footprint of sqrt(2) texels.
    for footprint, expected in ((2**0.5, 1 / 1.5), (0.0, 1.0), (1e9, 0.5)):
        assert_close(mean_length(apart.mean(axis=0), footprint=footprint), expected, ulps=8)


@pytest.mark.parametrize("shininess", [1.0, 100.0, 1e5])
def test_a_flat_map_changes_nothing(shininess, dtype):
    texels = np.broadcast_to(np.array([0.5, 0.5, 1.0], dtype), (5, 6, 3))
    view = np.random.default_rng(0).uniform(-1, 1, (3, 50, 2)).astype(dtype)
    for strength in (1.0, 0.3, 4.0):
        mips = build_normal_mips(texels, strength=strength)
        mean = decode_normals(sample_trilinear(mips, *view))
        assert_close(mean, np.broadcast_to(UP, (50, 3)), ulps=0)
        for footprint in (None, 0.0, 3.0):
            gloss = toksvig_gloss(mean_length(mean, footprint=footprint), shininess)
            assert_close(gloss, np.ones(50), ulps=0)


def test_a_gloss_of_1_is_the_plain_highlight():
    vectors = np.broadcast_to(UP, (4, 3)), normals((4,)), normals((4,), 0.2)
    plain = blinn_phong(*vectors, shininess=50.0)
    gloss = toksvig_gloss(np.ones(4), 50.0)
    assert_close(blinn_phong(*vectors, shininess=50.0, gloss=gloss), plain, ulps=4)


def test_a_gaussian_spread_of_normals_widens_the_lobe_as_told():
    """Slopes of variance ``v`` turn an exponent ``s`` into ``s / (1 + s v)``, if they are small."""
    rng, variance, shininess = np.random.default_rng(0), 0.01, 100.0
    slopes = rng.normal(size=(400_000, 2)) * np.sqrt(variance)
    spread = np.concatenate([slopes, np.ones((len(slopes), 1))], axis=-1)
    spread /= np.linalg.norm(spread, axis=-1, keepdims=True)
    gloss = float(toksvig_gloss(mean_length(spread.mean(axis=0)), shininess))
    assert abs(gloss - 1 / (1 + shininess * variance)) < 0.01  # measured 0.006
    for degrees in (0, 6, 12):
        half = np.array([np.sin(np.deg2rad(degrees)), 0, np.cos(np.deg2rad(degrees))])
        lobe = np.mean(np.maximum(spread @ half, 0) ** shininess)
        widened = (gloss * shininess + 1) / (shininess + 1) * half[2] ** (gloss * shininess)
        assert abs(lobe - widened) < 0.02 * gloss  # measured 0.007


# Laws


def test_gloss_falls_with_spread_and_exponent_and_stays_a_factor():
    lengths, exponents = np.linspace(0.01, 1, 50)[:, None], np.geomspace(1, 1e4, 30)
    gloss = np.asarray(jax.vmap(lambda s: toksvig_gloss(lengths[:, 0], s))(exponents)).T
    assert gloss.min() > 0
    assert gloss.max() == 1.0
    assert (np.diff(gloss, axis=0) > 0).all()
    assert (np.diff(gloss[:-1], axis=1) < 0).all()


@pytest.mark.parametrize("vector", [[0.0, 0, 0], [1e-20, 0, 0], [0, 0, 1.2], [0.6, 0, 0.8]])
def test_lengths_are_between_0_and_1(vector, dtype):
    """Also for no normal at all, and for those that rounding made longer than 1."""
    for footprint in (None, 0.0, 2.0):
        length = mean_length(np.array(vector, dtype), footprint=footprint)
        assert 0 < float(length) <= 1
        assert 0 < float(toksvig_gloss(length, 1000.0)) <= 1


def test_mips_are_those_of_unit_normals():
    """Rounding to 8 bits makes vectors shorter, which is no spread; strength comes before."""
    exact = normals((4, 4))
    stored = quantize(encode_normals(exact), bits=8)
    assert float(jnp.abs(mean_length(decode_normals(stored)) - 1).max()) > 1e-3
    mips = build_normal_mips(stored)
    assert_close(mean_length(decode_normals(mips.levels[0])), np.ones((4, 4)), ulps=8)
    for strength in (0.5, 2.0):
        mean = decode_normals(build_normal_mips(encode_normals(exact), strength=strength).levels[2])
        assert_close(mean[0, 0], np.mean(scale_normals(exact, strength), axis=(0, 1)))


@pytest.mark.parametrize(
    ("footprint", "limits"),
    [
        (0.25, (1.0, 0.2, 0.2)),  # measured 0.98, 0.09, 0.15
        (1.0, (0.9, 0.6, 1.0)),  # 0.81, 0.48, 0.97
        (4.0, (0.7, 0.8, 1.06)),  # 0.62, 0.69, 1.03
    ],
)
def test_the_highlight_is_nearer_to_supersampling(footprint, limits):
    """Than that of a mean alone, normalized or not, at every distance and for all bumps."""
    errors = relative_errors(bump_maps(64), footprint, (30.0, 300.0), pixels=16)
    assert list(errors) == list(STYLES)
    here = errors["Toksvig, as here"]
    assert here.shape == (4, 2)
    others = ("mean, normalized", "mean, not normalized", "Toksvig, whole length")
    worst = [float((here / errors[name]).max()) for name in others]
    assert all(ratio < limit for ratio, limit in zip(worst, limits, strict=True)), worst


# Derivatives


def test_derivatives():
    means = 0.9 * normals((5,))
    footprints = jnp.linspace(0.3, 4, 5)
    check_grads(mean_length, (means,), 1, ("fwd", "rev"))
    length = lambda means, footprints: mean_length(means, footprint=footprints)
    check_grads(length, (means, footprints), 1, ("fwd", "rev"))
    check_grads(toksvig_gloss, (np.linspace(0.2, 0.9, 5), np.full(5, 30.0)), 1, ("fwd", "rev"))
    build = lambda texels, strength: build_normal_mips(texels, strength=strength).texels
    texels = np.asarray(encode_normals(normals((3, 4))))
    check_grads(jax.jit(build), (texels, np.array(0.7)), 1, ("fwd", "rev"))


@pytest.mark.parametrize("footprint", [None, 0.0, 2.0])
@pytest.mark.parametrize("vector", [[0.0, 0, 0], [0, 0, 1.0], [0, 0, 1.1], [1e-20, 0, 0]])
def test_where_the_length_is_clamped_its_derivative_is_zero(vector, footprint, dtype):
    length = functools.partial(mean_length, footprint=footprint)
    for derivative in (jax.jacrev, jax.jacfwd):
        assert_close(derivative(length)(jnp.asarray(vector, dtype)), np.zeros(3), ulps=0)


# Errors


@pytest.mark.errors
def test_wrong_arguments_are_refused():
    with pytest.raises(ValueError, match=r"^mean_length: expected `normals_mean`.*got \(4,\)"):
        mean_length(np.zeros(4))
    for shape in ((4, 4), (4, 4, 2)):
        with pytest.raises(ValueError, match=r"^build_normal_mips: expected `texels`.*got \(4, 4"):
            build_normal_mips(np.zeros(shape))
    with pytest.raises(ValueError, match=r"^build_mips: expected `texels`.*got \(0, 4, 3\)"):
        build_normal_mips(np.zeros((0, 4, 3)))
