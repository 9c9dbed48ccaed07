"""Texture lookup: against the oracle, at borders and far away, its laws and derivatives."""

import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from jax.test_util import check_grads

from tangentspace.texture import (
    Texture,
    bilinear_taps,
    clamp,
    gather_taps,
    mirror,
    repeat,
    sample_bilinear,
    sample_nearest,
)

from .texture_reference import bilinear_reference, nearest_reference, wrap_reference
from .tools import assert_close

WRAPS = {"repeat": repeat, "clamp": clamp, "mirror": mirror}
PAIRS = list(itertools.product(WRAPS, WRAPS))
SAMPLES = {"nearest": sample_nearest, "bilinear": sample_bilinear}
REFERENCES = {"nearest": nearest_reference, "bilinear": bilinear_reference}
SIZES = [(1, 1), (1, 4), (5, 1), (3, 7), (8, 8)]


@functools.cache
def compiled(name, wrap_u="repeat", wrap_v="repeat"):
    wraps = {"wrap_u": WRAPS[wrap_u], "wrap_v": WRAPS[wrap_v]}
    return jax.jit(functools.partial(SAMPLES[name], **wraps))


def image(size=(3, 7), channels=3, dtype=np.float64):
    return np.random.default_rng(0).uniform(-1, 1, (*size, channels)).astype(dtype)


def places(count=300, low=-2.3, high=3.1, dtype=np.float64):
    """Points in the image and round it, in the given precision."""
    return np.random.default_rng(1).uniform(low, high, (count, 2)).astype(dtype)


def centres(height, width):
    """Uvs of the texels' centres, like the texels: row 0 on top."""
    u, v = (np.arange(width) + 0.5) / width, 1 - (np.arange(height) + 0.5) / height
    return np.stack(np.meshgrid(u, v), axis=-1)


# Known answers


@pytest.mark.parametrize("modes", PAIRS, ids="-".join)
@pytest.mark.parametrize("name", SAMPLES)
def test_against_the_oracle(name, modes, dtype):
    texels, uvs = image(dtype=dtype), places(dtype=dtype)
    values = compiled(name, *modes)(texels, uvs)
    assert values.dtype == dtype
    # Measured 35 in float32: of a place up to 20 texels away, multiplied by a slope of 2.
    assert_close(values, REFERENCES[name](texels, uvs, modes), ulps=64)


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("name", SAMPLES)
def test_any_size_against_the_oracle(name, size):
    texels, uvs = image(size, channels=2), places(40)
    for mode in WRAPS:
        expected = REFERENCES[name](texels, uvs, (mode, mode))
        assert_close(compiled(name, mode, mode)(texels, uvs), expected)


@pytest.mark.parametrize("name", SAMPLES)
def test_centres_give_the_texels(name, dtype):
    """Row 0 is at the top, at large v, and column 0 on the left."""
    texels = image((4, 8), dtype=dtype)  # places are exact in powers of two
    assert_close(compiled(name)(texels, centres(4, 8).astype(dtype)), texels, ulps=0)
    top_left = compiled(name)(texels, np.array([1 / 16, 7 / 8], dtype))
    assert_close(top_left, texels[0, 0], ulps=0)


def test_nearest_takes_the_square_that_holds_the_point():
    texels = image((2, 4))
    step = 1e-9
    u = np.array([0.25 - step, 0.25, 0.5 - step, 0.5])
    row = sample_nearest(texels, np.stack([u, np.full(4, 0.75)], axis=-1))
    assert_close(row, texels[0, [0, 1, 1, 2]], ulps=0)
    v = np.array([0.0, 0.5 - step, 0.5, 1 - step, 1.0])
    column = sample_nearest(texels, np.stack([np.full(5, 0.1), v], axis=-1))
    assert_close(column, texels[[1, 1, 0, 0, 1], 0], ulps=0)


@pytest.mark.parametrize("mode", WRAPS)
def test_wraps_against_the_oracle(mode):
    sizes = [1, 2, 3, 7, 8, 1000, 4096]
    indices = np.array([*range(-20, 21), -12345, 98765, -(2**30), 2**30], np.int32)
    expected = [[wrap_reference(mode, int(i), size) for i in indices] for size in sizes]
    each = [WRAPS[mode](jnp.asarray(indices), size) for size in sizes]
    together = WRAPS[mode](jnp.asarray(indices)[None], jnp.asarray(sizes, jnp.int32)[:, None])
    assert together.dtype == each[0].dtype == jnp.int32
    assert_close(together, expected)
    assert_close(jnp.stack(each), expected)


def test_between_two_texels_stands_their_mean_across_the_border():
    texels = image((1, 4), channels=1)
    at_edge = np.array([0.0, 0.5])
    expected = {"repeat": texels[0, [0, 3]].mean(0), "clamp": texels[0, 0], "mirror": texels[0, 0]}
    for mode in WRAPS:
        assert_close(compiled("bilinear", mode, mode)(texels, at_edge), expected[mode], ulps=4)


# Laws


@pytest.mark.parametrize("name", SAMPLES)
@given(
    modes=st.sampled_from(PAIRS),
    value=st.floats(-10, 10, width=32, allow_subnormal=False),
    uv=st.tuples(*2 * [st.floats(width=32, allow_nan=True)]),
)
def test_one_color_everywhere(name, modes, value, uv):
    """To the last bit, wherever the point is: a flat normal map changes nothing."""
    texels = np.full((3, 7, 1), value, np.float32)
    looked_up = compiled(name, *modes)(texels, np.array(uv, np.float32))
    assert_close(looked_up, texels[0, 0], ulps=0)


@pytest.mark.parametrize("mode", WRAPS)
@given(uv=st.tuples(*2 * [st.floats(-4, 4)]), turns=st.tuples(*2 * [st.integers(-3, 3)]))
def test_symmetry(mode, uv, turns):
    uv, turns = np.array(uv), np.array(turns)
    moved = {
        "repeat": uv + turns,
        "mirror": np.where(turns % 2 == 0, uv, -uv) + 2 * turns,
        "clamp": np.clip(uv, 0, 1),
    }
    look = functools.partial(compiled("bilinear", mode, mode), image((8, 8)))
    assert_close(look(moved[mode]), look(uv), ulps=1024)  # of places 80 texels away


@pytest.mark.parametrize("name", SAMPLES)
def test_flipped_and_turned_images(name):
    texels, uvs = image((5, 5)), places(50)
    look = compiled(name)
    assert_close(look(texels[:, ::-1], uvs * [-1, 1] + [1, 0]), look(texels, uvs))
    assert_close(look(texels[::-1], uvs * [1, -1] + [0, 1]), look(texels, uvs))
    turned = np.stack([1 - uvs[:, 1], 1 - uvs[:, 0]], axis=-1)
    assert_close(look(np.swapaxes(texels, 0, 1), turned), look(texels, uvs))


def test_planes_are_kept_between_the_centres():
    u, v = np.moveaxis(centres(8, 6), -1, 0)
    texels = (0.3 + 2 * u - 0.7 * v)[..., None]
    uvs = places(100, 0.1, 0.9)
    expected = 0.3 + uvs @ [[2.0], [-0.7]]
    assert_close(compiled("bilinear")(texels, uvs), expected)


@pytest.mark.parametrize("mode", WRAPS)
def test_bilinear_is_continuous_across_centres_and_borders(mode):
    texels = image((4, 8))
    lines = np.random.default_rng(2).integers(-8, 16, (100, 2)) * [1 / 16, 1 / 8]
    values = [compiled("bilinear", mode, mode)(texels, lines + step) for step in (-1e-9, 1e-9)]
    assert float(jnp.abs(values[0] - values[1]).max()) < 1e-7  # measured 3e-8


@pytest.mark.parametrize("modes", PAIRS, ids="-".join)
def test_prepared_taps_give_the_same(modes, dtype):
    texels, uvs = image(dtype=dtype), places(dtype=dtype)
    wraps = {"wrap_u": WRAPS[modes[0]], "wrap_v": WRAPS[modes[1]]}
    taps = bilinear_taps(texels.shape[:2], uvs, **wraps)
    assert taps.indices.shape == taps.weights.shape == (300, 4)
    assert taps.weights.dtype == dtype
    assert float(taps.weights.min()) >= 0
    assert_close(taps.weights.sum(axis=-1), np.ones(300), ulps=4)
    expected = compiled("bilinear", *modes)(texels, uvs)
    assert_close(gather_taps(texels, taps), expected, ulps=32)


def test_taps_take_the_type_asked_for():
    taps = bilinear_taps((3, 7), places(), dtype=np.float32)
    assert taps.weights.dtype == np.float32
    assert taps.indices.dtype == np.int32
    assert gather_taps(image(dtype=np.float32), taps).dtype == np.float32


@pytest.mark.parametrize("name", SAMPLES)
def test_types_are_those_of_the_texels(name):
    assert SAMPLES[name](image(dtype=np.float32), places()).dtype == np.float32
    assert SAMPLES[name](image(), places(dtype=np.float32)).dtype == np.float64


def test_a_texture_is_a_pytree_of_its_texels():
    texture = Texture(jnp.asarray(image()), wrap_v=clamp)
    assert [leaf.shape for leaf in jax.tree.leaves(texture)] == [(3, 7, 3)]
    assert (texture.wrap_u, texture.wrap_v) == (repeat, clamp)


# Far away


FAR = [1e6, -1e6, 1e9, 3e38, -3e38, np.inf, -np.inf, np.nan]


@pytest.mark.parametrize("mode", WRAPS)
@pytest.mark.parametrize("name", SAMPLES)
def test_far_points_are_texels_of_the_image(name, mode, dtype):
    """Where coordinates have no digits left of a texel, any texel will do, but only one."""
    texels = image(dtype=dtype)
    uvs = np.array(list(itertools.product(FAR, FAR)), dtype)
    values = np.asarray(compiled(name, mode, mode)(texels, uvs))
    assert np.isfinite(values).all()
    assert values.min() >= texels.min()
    assert values.max() <= texels.max()


@pytest.mark.parametrize("name", SAMPLES)
def test_under_clamp_far_points_are_the_edge(name, dtype):
    texels = image(dtype=dtype)
    uvs = np.array([[-1e6, 1e6], [np.inf, -np.inf], [-3e38, 0.5], [5.0, 7.0]], dtype)
    expected = texels[[0, 2, 1, 0], [0, 6, 0, 6]]
    assert_close(compiled(name, "clamp", "clamp")(texels, uvs), expected, ulps=0)


@pytest.mark.parametrize("name", SAMPLES)
def test_a_million_repetitions_away_the_image_is_the_same(name):
    """In float32, where a coordinate of a million has steps of 1/16."""
    texels = image((8, 8), dtype=np.float32)
    uvs = np.random.default_rng(3).integers(0, 16, (60, 2)).astype(np.float32) / 16
    for far in (1e6, -1e6):
        away = (uvs + np.float32(far)).astype(np.float32)
        assert_close(compiled(name)(texels, away), compiled(name)(texels, uvs), ulps=0)


@pytest.mark.parametrize("name", SAMPLES)
def test_a_texel_that_is_not_finite_shows_where_it_is_touched(name):
    texels = image((8, 8))
    texels[2, 5] = np.nan
    values = np.asarray(compiled(name)(texels, centres(8, 8) + 0.01))
    bad = np.argwhere(np.isnan(values).any(axis=-1)).tolist()
    assert bad == ([[2, 5]] if name == "nearest" else [[2, 4], [2, 5], [3, 4], [3, 5]])


# Derivatives


@pytest.mark.parametrize("modes", PAIRS, ids="-".join)
def test_derivatives(modes):
    check_grads(compiled("bilinear", *modes), (image(), places(20)), 1, ("fwd", "rev"))


def test_derivatives_of_prepared_lookups():
    taps = bilinear_taps((3, 7), places(20))
    look = lambda texels: gather_taps(texels, taps)
    check_grads(look, (image(),), 1, ("fwd", "rev"))
    weights = lambda uvs: bilinear_taps((3, 7), uvs).weights
    check_grads(weights, (places(20),), 1, ("fwd", "rev"))


def test_nearest_is_linear_in_texels_and_flat_in_uvs():
    look = lambda texels, uvs: (compiled("nearest")(texels, uvs) ** 2).sum()
    texels, uvs = image(), places(500, 0, 1)
    in_texels, in_uvs = jax.grad(look, argnums=(0, 1))(texels, uvs)
    counts = np.zeros((3, 7, 1))
    np.add.at(counts, (2 - (uvs[:, 1] * 3).astype(int), (uvs[:, 0] * 7).astype(int)), 1)
    assert_close(in_texels, 2 * counts * texels)
    assert_close(in_uvs, np.zeros((500, 2)), ulps=0)


def test_every_lookup_hands_its_weight_to_the_texels():
    texels, uvs = image(), places()
    gradient = jax.grad(lambda texels: compiled("bilinear")(texels, uvs).sum())(texels)
    assert float(gradient.min()) >= 0
    assert_close(gradient.sum(axis=(0, 1)), np.full(3, 300.0))


def test_at_centres_the_derivative_is_that_of_the_right_and_upper_side():
    texels = image((4, 8), channels=1)
    look = lambda uv: compiled("bilinear")(texels, uv)[0]
    slope = jax.grad(look)(jnp.array([3.5 / 8, 1 - 1.5 / 4]))
    right, upper = texels[1, 4] - texels[1, 3], texels[0, 3] - texels[1, 3]
    assert_close(slope, np.concatenate([right * 8, upper * 4]))


@pytest.mark.parametrize("mode", WRAPS)
def test_far_away_derivatives_are_zero(mode):
    texels = jnp.asarray(image())
    look = lambda texels, uvs: compiled("bilinear", mode, mode)(texels, uvs).sum()
    uvs = jnp.asarray(list(itertools.product(FAR[2:], FAR[2:])))
    in_texels, in_uvs = jax.grad(look, argnums=(0, 1))(texels, uvs)
    assert np.isfinite(in_texels).all()
    assert_close(in_uvs[:, 1:], np.zeros((len(uvs), 1)), ulps=0)


# Transformations


@pytest.mark.parametrize("name", SAMPLES)
def test_vmap_and_leading_axes(name):
    texels, uvs = image(), places(24)
    expected = SAMPLES[name](texels, uvs)
    shaped = SAMPLES[name](texels, uvs.reshape(2, 3, 4, 2))
    assert_close(shaped, np.asarray(expected).reshape(2, 3, 4, 3), ulps=0)
    one_by_one = jax.vmap(functools.partial(SAMPLES[name], jnp.asarray(texels)))(jnp.asarray(uvs))
    assert_close(one_by_one, expected, ulps=16)
    images = jnp.stack([jnp.asarray(texels), 2 * jnp.asarray(texels)])
    both = jax.vmap(SAMPLES[name], in_axes=(0, None))(images, jnp.asarray(uvs))
    assert_close(both[1], 2 * expected, ulps=16)


# Errors

WRONG = {
    "gray": ((np.zeros((3, 4)), np.zeros(2)), r"`texels` of shape \(height, width, channels\)"),
    "empty": ((np.zeros((0, 4, 3)), np.zeros(2)), r"`texels`.*, each > 0, got \(0, 4, 3\)"),
    "bytes": ((np.zeros((3, 4, 3), np.uint8), np.zeros(2)), "`texels` of floating-point type"),
    "three": ((np.zeros((3, 4, 3)), np.zeros(3)), r"`uvs` of shape \(..., 2\), got \(3,\)"),
    "scalar": ((np.zeros((3, 4, 3)), np.zeros(())), r"`uvs` of shape \(..., 2\), got \(\)"),
    "whole": ((np.zeros((3, 4, 3)), np.zeros(2, int)), "`uvs` of floating-point type, got int64"),
}


@pytest.mark.errors
@pytest.mark.parametrize("case", WRONG)
@pytest.mark.parametrize("name", SAMPLES)
def test_wrong_arguments_are_refused(name, case):
    arguments, message = WRONG[case]
    with pytest.raises(ValueError, match=f"^sample_{name}: expected {message}"):
        jax.eval_shape(SAMPLES[name], *arguments)


@pytest.mark.errors
def test_prepared_lookups_refuse_wrong_arguments():
    with pytest.raises(ValueError, match=r"^bilinear_taps: expected `size`.*, got \(0, 4\)"):
        bilinear_taps((0, 4), np.zeros(2))
    with pytest.raises(ValueError, match=r"^bilinear_taps: expected `uvs`.*, got \(3,\)"):
        bilinear_taps((3, 4), np.zeros(3))
    with pytest.raises(ValueError, match=r"^gather_taps: expected `texels`.*, got \(3, 4\)"):
        gather_taps(np.zeros((3, 4)), bilinear_taps((3, 4), np.zeros(2)))
