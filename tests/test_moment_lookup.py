"""Prefiltered maps: blur, mips, linear depth and lookup, against the oracle; derivatives."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.options import parse_technique, techniques
from shadows import (
    AdaptiveBias,
    AnalyticBias,
    BilinearFilter,
    ConstantBias,
    ESMFilter,
    EVSM2Filter,
    EVSM4Filter,
    Filter,
    HardCompare,
    MSMFilter,
    ShadowMap,
    VSMFilter,
    check_techniques,
    depth_ratio,
    linear_depth,
    look_up,
    orthographic,
    perspective,
    receive,
    texel_from_clip,
)

from .moment_reference import kernel_reference, linear_reference, lookup_reference
from .tools import assert_close

HEIGHT, WIDTH = 12, 16
UP = jnp.array([0.0, 0.0, 1.0])
KINDS = {
    "vsm": VSMFilter,
    "esm": ESMFilter,
    "evsm2": EVSM2Filter,
    "evsm4": EVSM4Filter,
    "msm": MSMFilter,
}
FILTERS = {
    "vsm": VSMFilter(radius=2),
    "vsm mips": VSMFilter(radius=1, mips=2, level=1.25),
    "vsm last mip": VSMFilter(radius=1, mips=2, level=2.0),
    "esm": ESMFilter(radius=1, exponent=30.0),
    "esm gaussian": ESMFilter(radius=3, exponent=30.0, blur="gaussian"),
    "evsm2": EVSM2Filter(radius=1, exponent=15.0),
    "evsm4": EVSM4Filter(radius=2, exponent=15.0, blur="gaussian"),
    "msm": MSMFilter(radius=1),
    "msm mips": MSMFilter(radius=0, mips=1, level=0.5),
}

locate = jax.jit(receive)
look = jax.jit(
    lambda shadow_map, receiver, filter: look_up(
        shadow_map, receiver, filter=filter, compare=HardCompare()
    )
)
prepare = jax.jit(lambda filter, shadow_map: filter.prepare(shadow_map))


def random_map(dtype=np.float64, seed=0):
    """Depths in [0.1, 0.6], one in twenty cleared."""
    rng = np.random.default_rng(seed)
    depth = rng.uniform(0.1, 0.6, (HEIGHT, WIDTH))
    depth[rng.random(depth.shape) < 0.05] = 1.0
    return ShadowMap(jnp.asarray(depth, dtype), jnp.eye(4, dtype=dtype))


def receivers(column, row, depth, dtype=np.float64):
    """Points at the given places of a map whose clip space is the world."""
    matrix = texel_from_clip(HEIGHT, WIDTH, dtype=dtype)
    x, y = 2 * column / WIDTH - 1, 1 - 2 * row / HEIGHT
    position = jnp.asarray(np.stack([x, y, 2 * depth - 1], axis=-1), dtype)
    normal = jnp.broadcast_to(-UP.astype(dtype), position.shape)
    return locate(position, normal, normal, matrix)


def ask(shadow_map, column, row, depth, filter):
    """Visibility at a few places; as many are asked as elsewhere, so that programs are shared."""
    places = (np.resize(x, 300) for x in (column, row, depth))
    return look(shadow_map, receivers(*places), filter)[: len(column)]


def random_places(count=300, beyond=2.0):
    """Places in the map and up to ``beyond`` texels outside of it."""
    rng = np.random.default_rng(1)
    low, high = [-beyond, -beyond, 0.3], [WIDTH + beyond, HEIGHT + beyond, 0.95]
    return rng.uniform(low, high, (count, 3)).T


# Known answers


PRECISIONS = [(name, np.float64) for name in FILTERS]
PRECISIONS += [(name, np.float32) for name in ("vsm", "esm", "evsm4", "msm")]


@pytest.mark.parametrize(("name", "dtype"), PRECISIONS)
def test_against_the_oracle(name, dtype):
    column, row, depth = random_places()
    shadow_map, filter = random_map(dtype), FILTERS[name]
    receiver = receivers(column, row, depth, dtype)
    lit = look(shadow_map, receiver, jax.tree.map(lambda x: jnp.asarray(x, dtype), filter))
    assert lit.dtype == dtype
    places = (np.asarray(x, np.float64) for x in (receiver.column, receiver.row, receiver.depth))
    stored = np.asarray(shadow_map.depth, np.float64)
    expected = np.array(
        [lookup_reference(filter, stored, *place) for place in zip(*places, strict=True)]
    )
    assert 0.2 < np.mean(expected) < 0.95
    # Measured: 2e-6 in single precision, MSM; 2e-15 in double.
    np.testing.assert_allclose(lit, expected, atol=1e-5 if dtype == np.float32 else 1e-12)


@pytest.mark.parametrize("name", KINDS)
def test_depth_is_linear_in_a_perspective_map(name):
    clip = np.array(perspective(1.2, 1.0, 0.5, 20.0), np.float64)
    clip[:2, 3] = [0.2, -0.1]
    rng = np.random.default_rng(2)
    window = rng.uniform(0.88, 0.97, (HEIGHT, WIDTH))
    shadow_map = ShadowMap(jnp.asarray(window), jnp.asarray(clip))
    column, row, _ = random_places(100, beyond=0.0)
    depth = rng.uniform(0.93, 1.0, 100)
    receiver = receivers(column, row, depth)._replace(texel_from_world=shadow_map.texel_from_world)
    filter = KINDS[name](radius=1)
    linear = linear_reference(window, clip)
    assert 0.15 < linear.min() < 0.3
    places = zip(column, row, linear_reference(depth, clip), strict=True)
    expected = [lookup_reference(filter, linear, *place) for place in places]
    assert 0.2 < np.mean(expected) < 0.9
    np.testing.assert_allclose(look(shadow_map, receiver, filter), expected, atol=1e-9)


def test_depth_ratio_is_far_over_near():
    assert_close(depth_ratio(jnp.eye(4)), 1.0, ulps=0)
    matrices = [perspective(1.2, 0.7, 0.5, 20.0), perspective(0.3, 1.0, 2.0, 3.0)]
    matrices.append(orthographic(-1.0, 2.0, -1.0, 1.0, 0.5, 20.0))
    texel = texel_from_clip(HEIGHT, WIDTH) @ jnp.stack(matrices)
    assert_close(depth_ratio(texel), [40.0, 1.5, 1.0])
    endless = texel[0].at[2].set(texel[0, 3] + jnp.array([0.0, 0, 0, -1]))
    assert_close(depth_ratio(endless), 1.0, ulps=0)


def test_linear_depth():
    window = jnp.linspace(0, 1, 7)
    assert_close(linear_depth(window, 1.0), window)
    assert_close(linear_depth(window, 40.0), window / (40 - 39 * window))
    assert_close(linear_depth(jnp.array([-3.0, 0.0, 1.0, 2.0]), 40.0), [0.0, 0, 1, 1], ulps=0)


@pytest.mark.parametrize("blur", ["box", "gaussian"])
@pytest.mark.parametrize("radius", [0, 1, 2, 5])
def test_blur_of_one_texel(radius, blur):
    """Its weights sum to 1, fall from the middle, and reach as far as the radius says."""
    size = 16
    deep = jnp.full((size, size), 0.5).at[8, 7].set(1.0)
    filter = VSMFilter(radius=radius, blur=blur)
    mean = np.asarray(prepare(filter, ShadowMap(deep, jnp.eye(4)))[0][0])
    weights = kernel_reference(radius, blur)
    assert len(weights) == 2 * radius + 1
    window = slice(8 - radius, 9 + radius), slice(7 - radius, 8 + radius)
    assert_close(mean[window], np.outer(weights, weights))
    assert_close(mean.sum(), 1.0)
    assert (np.diff(weights[: radius + 1]) > -1e-15).all()


def test_gaussian_blur_is_close_to_a_gaussian():
    weights, places = kernel_reference(8, "gaussian"), np.arange(-8, 9)
    assert_close(weights @ places**2, 8.0)  # radius^2 / 12 * (1 + 4 / radius)
    gaussian = np.exp(-0.5 * places**2 / 8) / np.sqrt(2 * np.pi * 8)
    assert np.abs(weights - gaussian).max() < 0.04 * gaussian.max()  # measured 3.6 %


def test_mips_are_means():
    rng = np.random.default_rng(3)
    depth = rng.uniform(size=(HEIGHT, WIDTH))
    levels = prepare(VSMFilter(radius=0, mips=2), ShadowMap(jnp.asarray(depth), jnp.eye(4)))
    signed = 2 * depth - 1
    assert [level[0].shape for level in levels] == [(12, 16), (6, 8), (3, 4)]
    for k, level in enumerate(levels):
        for power, image in enumerate(level, 1):
            blocks = (signed**power).reshape(12 // 2**k, 2**k, 16 // 2**k, 2**k)
            assert_close(image, blocks.mean(axis=(1, 3)))


@pytest.mark.parametrize("name", KINDS)
def test_bias_moves_the_receiver(name):
    column, row, depth = random_places()
    receiver = receivers(column, row, depth)
    moved = receivers(column, row, depth - 0.15)
    found = look(random_map(), receiver.less_depth(jnp.asarray(0.15)), KINDS[name]())
    assert_close(found, look(random_map(), moved, KINDS[name]()), ulps=1e6)


# Outside nothing is known to block.

BLOCKED = ShadowMap(jnp.zeros((HEIGHT, WIDTH), float), jnp.eye(4))


@pytest.mark.parametrize("name", KINDS)
def test_outside_the_image_is_lit(name):
    far = 1e12  # no integer holds that
    column = np.array([-0.5, WIDTH + 0.5, 4.5, 4.5, -far, far, 8.0])
    row = np.array([4.5, 4.5, -1.0, HEIGHT + 1, 3.0, far, 8.0])
    exact = {"min_variance": 0.0} if "v" in name else {}
    lit = ask(BLOCKED, column, row, np.full(7, 0.5), KINDS[name](**exact))
    assert_close(lit[:6], np.ones(6), ulps=0)
    assert float(lit[6]) < 1e-6


@pytest.mark.parametrize("name", KINDS)
def test_border_is_that_of_the_bilinear_filter(name):
    column = np.array([0.5, 0.25, 0.0, -0.25, -0.5, WIDTH - 0.25, WIDTH])
    place = column, np.full(7, 6.5), np.full(7, 0.9)
    found, expected = (ask(BLOCKED, *place, filter) for filter in (KINDS[name](), BilinearFilter()))
    np.testing.assert_allclose(found, expected, atol=1e-3)


@pytest.mark.parametrize("name", KINDS)
def test_beyond_the_depths_of_the_map_is_lit(name):
    middle, depth = np.full(3, 5.0), np.array([-0.01, 0.5, 1.01])
    found = ask(BLOCKED, middle, middle, depth, KINDS[name]())
    np.testing.assert_allclose(found, [1, 0, 1], atol=1e-3)


@pytest.mark.parametrize("name", KINDS)
def test_empty_map_is_lit(name):
    empty = ShadowMap(jnp.ones((HEIGHT, WIDTH), float), jnp.eye(4))
    lit = look(empty, receivers(*random_places()), KINDS[name]())
    np.testing.assert_allclose(lit, np.ones(300), atol=3e-7)  # measured 1.3e-7, MSM's bias


# Laws


@pytest.mark.parametrize("name", ["vsm", "evsm4"])
def test_reading_serves_while_only_depth_moves(name):
    filter, receiver = KINDS[name](), receivers(*random_places())
    kept = filter.read(filter.prepare(random_map()), receiver)
    for depth in (-0.2, 0.0, 0.3):
        biased = receiver.less_depth(jnp.asarray(depth))
        found = filter.visibility(kept, biased, HardCompare())
        assert_close(found, look(random_map(), biased, filter), ulps=1e4)


@pytest.mark.parametrize("name", ["vsm mips", "esm gaussian"])
def test_each_point_is_read_in_its_own_map(name):
    """Blurred apart, read apart: as if each map were the only one."""
    filter, places = FILTERS[name], random_places()
    maps = [random_map(seed=k) for k in range(3)]
    near, far = 0.5, np.array([0.5001, 5.0, 20.0])
    matrices = jnp.stack([perspective(1.0, 1.0, near, f) for f in far])
    maps = [m._replace(clip_from_world=c) for m, c in zip(maps, matrices, strict=True)]
    every = ShadowMap(jnp.stack([m.depth for m in maps]), matrices)
    index = jnp.asarray(np.random.default_rng(4).integers(0, 3, 300))
    receiver = receivers(*places)
    found = look(
        every, receiver._replace(texel_from_world=every.texel_from_world, map_index=index), filter
    )
    alone = [look(m, receiver._replace(texel_from_world=m.texel_from_world), filter) for m in maps]
    assert_close(found, np.choose(index, alone), ulps=1e4)
    assert float(jnp.abs(alone[0] - alone[1]).max()) > 0.1


@pytest.mark.parametrize("name", ["vsm mips", "esm gaussian"])
def test_transposed_map_transposed_places(name):
    column, row, depth = random_places()
    square, filter = random_map().depth[:, :HEIGHT], FILTERS[name]

    def lit(stored, column, row):
        receiver = receivers(column, row, depth)._replace(
            column=jnp.asarray(column), row=jnp.asarray(row)
        )
        return look(ShadowMap(stored, jnp.eye(4)), receiver, filter)

    assert_close(lit(square.T, row, column), lit(square, column, row), ulps=1e6)


@pytest.mark.parametrize("mips", [0, 2])
def test_lookup_is_continuous(mips):
    """Across the lines through texel centres, where one set of four gives way to the next."""
    filter = VSMFilter(radius=1, mips=mips, level=0.7 if mips else 0.0)
    column, row, depth = random_places()
    for axis in (column, row):
        axis[:] = np.floor(axis) + 0.5
    below, above = (
        look(random_map(), receivers(column + step, row + step, depth), filter)
        for step in (-1e-9, 1e-9)
    )
    assert float(jnp.abs(below - above).max()) < 1e-7


def test_levels_are_continuous():
    receiver, depth = receivers(*random_places()), random_map()
    at = lambda level: look(depth, receiver, VSMFilter(radius=0, mips=2, level=level))
    for level in (1.0, 2.0):
        assert_close(at(level - 1e-9 if level == 2 else level + 1e-9), at(level), ulps=1e9)
    assert_close(at(1 - 1e-9), at(1.0), ulps=1e9)
    assert_close(at(0.0), look(depth, receiver, VSMFilter(radius=0)), ulps=64)


def plane_map(size=32, slope=(0.012, 0.007)):
    """A map that sees one plane, and receivers on it, away from the border."""
    column, row = np.meshgrid(np.arange(size) + 0.5, np.arange(size) + 0.5)
    of = lambda column, row: 0.2 + slope[0] * column + slope[1] * row
    places = np.random.default_rng(5).uniform(8, size - 8, (400, 2)).T
    matrix = texel_from_clip(size, size)
    x, y = 2 * places[0] / size - 1, 1 - 2 * places[1] / size
    position = jnp.asarray(np.stack([x, y, 2 * of(*places) - 1], axis=-1))
    # Of the plane in clip space, where depth is z: per unit of x, of y, of z.
    normal = np.array([slope[0] * size, -slope[1] * size, -1.0])
    normal = jnp.broadcast_to(jnp.asarray(normal / np.sqrt(normal @ normal)), position.shape)
    to_light = jnp.broadcast_to(-UP, position.shape)
    receiver = locate(position, normal, to_light, matrix)
    return ShadowMap(jnp.asarray(of(column, row)), jnp.eye(4)), receiver


@pytest.mark.parametrize(
    ("name", "blur"), [(name, "box") for name in KINDS] + [("vsm", "gaussian")]
)
def test_a_plane_does_not_shade_itself(name, blur):
    """Means see to that themselves; sharper bounds want the bias of the reach."""
    shadow_map, receiver = plane_map()
    filter = KINDS[name](radius=4, blur=blur)
    found = look(shadow_map, receiver, filter)
    least = {"evsm4": 0.97, "msm": 0.77}.get(name, 1 - 1e-9)  # measured 0.9705 and 0.777
    assert float(found.min()) > least
    biased = AnalyticBias()(receiver, filter.reach())
    assert_close(look(shadow_map, biased, filter), np.ones(400), ulps=1e4)


# Options


def test_found_by_name():
    found = techniques(Filter)
    assert {name: found.get(name) for name in KINDS} == KINDS
    words = ["evsm4", ".radius=3", ".blur=gaussian", ".exponent=20", ".negative_exponent=4"]
    chosen = parse_technique(Filter, words, option="--filter")
    expected = EVSM4Filter(radius=3, blur="gaussian", exponent=20.0, negative_exponent=4.0)
    assert chosen == expected


def test_biases_that_follow_the_plane_are_refused():
    with pytest.raises(ValueError, match="AdaptiveBias compares texel by texel, which VSMFilter"):
        check_techniques(AdaptiveBias(), VSMFilter())
    for bias in (AnalyticBias(), ConstantBias(0.1)):
        check_techniques(bias, VSMFilter())


def test_reach():
    assert VSMFilter(radius=3).reach() == 4
    assert MSMFilter(radius=0).reach() == 1
    # The coarser level's next texel is two texels wide, and its farther one half a texel less.
    assert float(VSMFilter(radius=3, mips=2, level=0.5).reach()) == 3 + 2.5
    assert float(VSMFilter(radius=3, mips=2, level=jnp.asarray(2.0)).reach()) == 3 + 5.5


def test_many_filters_at_once():
    """Numbers of the filter as an axis, the mip level among them."""
    receiver, shadow_map = receivers(*random_places(50)), random_map()
    levels, bleeding = jnp.array([0.0, 0.5, 1.25, 2.0]), jnp.array([0.0, 0.1, 0.2, 0.3])
    make = lambda level, share: VSMFilter(radius=1, mips=2, level=level, bleeding=share)
    found = jax.vmap(lambda *numbers: look(shadow_map, receiver, make(*numbers)))(levels, bleeding)
    for row, level, share in zip(found, levels.tolist(), bleeding.tolist(), strict=True):
        assert_close(row, look(shadow_map, receiver, make(level, share)), ulps=1e4)


REFUSED = [
    (VSMFilter, {"radius": -1}, "`radius` to be a whole number of texels of at least 0, got -1"),
    (VSMFilter, {"radius": 1.5}, "`radius` to be a whole number of texels of at least 0, got 1.5"),
    (VSMFilter, {"mips": -2}, "`mips` to be a whole number of levels of at least 0, got -2"),
    (VSMFilter, {"blur": "tent"}, "`blur` box or gaussian, got 'tent'"),
    (VSMFilter, {"level": 0.5}, "`level` from 0 to 0 (`mips`), got 0.5"),
    (VSMFilter, {"mips": 2, "level": 2.5}, "`level` from 0 to 2 (`mips`), got 2.5"),
    (VSMFilter, {"bleeding": 1.0}, "`bleeding` from 0 to below 1, got 1.0"),
    (VSMFilter, {"min_variance": -1e-9}, "`min_variance` from 0 to 1, got -1e-09"),
    (ESMFilter, {"exponent": 89.0}, "`exponent` from 0 to 88.72, got 89.0"),
    (ESMFilter, {"exponent": np.float32(np.nan)}, "`exponent` from 0 to 88.72, got nan"),
    (EVSM2Filter, {"exponent": 50.0}, "`exponent` from 0 to 42, got 50.0"),
    (EVSM4Filter, {"exponent": 50.0}, "`exponent` from 0 to 42, got 50.0"),
    (EVSM4Filter, {"negative_exponent": -1.0}, "`negative_exponent` from 0 to 42, got -1.0"),
    (MSMFilter, {"moment_bias": 1.5}, "`moment_bias` from 0 to 1, got 1.5"),
]


@pytest.mark.errors
@pytest.mark.parametrize(("kind", "options", "text"), REFUSED)
def test_illegal_options(kind, options, text):
    with pytest.raises(ValueError, match=f"^{kind.__name__}: expected {re.escape(text)}$"):
        kind(**options)


@pytest.mark.errors
def test_maps_too_small():
    with pytest.raises(ValueError, match=r"`radius` below the map's 12 x 16 texels, got 12"):
        VSMFilter(radius=12).prepare(random_map())
    with pytest.raises(ValueError, match=r"halved 3 times \(`mips`\), got 12 x 16 texels"):
        VSMFilter(mips=3).prepare(random_map())


def test_numbers_inside_a_program_are_not_checked():
    """A fit may try what a user may not ask for; the level is held to what there is."""
    lit = jax.jit(
        lambda x: look(random_map(), receivers(*random_places()), VSMFilter(mips=1, level=x))
    )
    assert_close(lit(7.0), lit(1.0), ulps=0)
