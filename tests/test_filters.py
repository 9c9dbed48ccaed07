"""Filters: against the oracle, at the map's borders, and the whole lookup's derivatives."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from shadows import (
    BilinearFilter,
    CombinedBias,
    ConstantBias,
    DirectionalLight,
    HardCompare,
    NearestFilter,
    NormalOffsetBias,
    ShadowMap,
    SlopeBias,
    SoftCompare,
    SpotLight,
    compare_taps,
    look_up,
    receive,
    texel_from_clip,
)

from .reference import look_up_reference
from .tools import assert_close

HEIGHT, WIDTH = 12, 16
FILTERS = {"nearest": NearestFilter(), "bilinear": BilinearFilter()}
UP = jnp.array([0.0, 0.0, 1.0])

locate = jax.jit(receive)
look = jax.jit(
    lambda shadow_map, receiver, filter, compare: look_up(
        shadow_map, receiver, filter=filter, compare=compare
    )
)


def random_map(dtype=np.float64):
    """Depths in [0.2, 0.8], an eighth of them cleared."""
    rng = np.random.default_rng(0)
    depth = rng.uniform(0.2, 0.8, (HEIGHT, WIDTH))
    depth[rng.random(depth.shape) < 0.125] = 1.0
    return ShadowMap(jnp.asarray(depth, dtype), jnp.eye(4, dtype=dtype))


def receivers(column, row, depth, dtype=np.float64):
    """Points at the given places of a map whose clip space is the world."""
    matrix = texel_from_clip(HEIGHT, WIDTH, dtype=dtype)
    x, y = 2 * column / WIDTH - 1, 1 - 2 * row / HEIGHT
    position = jnp.asarray(np.stack([x, y, 2 * depth - 1], axis=-1), dtype)
    normal = jnp.broadcast_to(-UP.astype(dtype), position.shape)
    return locate(position, normal, normal, matrix)


def random_places(count=400, beyond=3.0):
    """Places in the map and up to ``beyond`` texels outside of it."""
    rng = np.random.default_rng(1)
    low, high = [-beyond, -beyond, 0.1], [WIDTH + beyond, HEIGHT + beyond, 0.9]
    return rng.uniform(low, high, (count, 3)).T


# Known answers


@pytest.mark.parametrize("name", FILTERS)
def test_against_the_oracle(name, dtype):
    column, row, depth = random_places()
    shadow_map = random_map(dtype)
    receiver = receivers(column, row, depth, dtype)
    lit = look(shadow_map, receiver, FILTERS[name], HardCompare())
    assert lit.dtype == dtype
    places = (np.asarray(x, np.float64) for x in (receiver.column, receiver.row, receiver.depth))
    stored = np.asarray(shadow_map.depth, np.float64)
    expected = look_up_reference(stored, *places, bilinear=name == "bilinear")
    assert 0.1 < expected.mean() < 0.9
    assert_close(lit, expected)


@pytest.mark.parametrize("name", FILTERS)
def test_bias_against_the_oracle(name):
    column, row, depth = random_places()
    shadow_map = random_map()
    receiver = receivers(column, row, depth).less_depth(jnp.asarray(0.15))
    lit = look(shadow_map, receiver, FILTERS[name], HardCompare())
    stored, bilinear = np.asarray(shadow_map.depth), name == "bilinear"
    assert_close(lit, look_up_reference(stored, column, row, depth, bias=0.15, bilinear=bilinear))


@pytest.mark.parametrize("name", FILTERS)
def test_one_dark_texel_lies_where_the_convention_says(name):
    """Row 0 on top, column 0 on the left, the texel's centre at half integers."""
    shadow_map = ShadowMap(jnp.ones((HEIGHT, WIDTH)).at[2, 5].set(0.1), jnp.eye(4))
    column = np.array([5.5, 5.5, 6.5, 5.5, 5.75])
    row = np.array([2.5, 9.5, 2.5, 3.5, 2.75])
    lit = look(shadow_map, receivers(column, row, np.full(5, 0.5)), FILTERS[name], HardCompare())
    shared = 0.0 if name == "nearest" else 1 - 0.75**2
    assert_close(lit, np.array([0.0, 1.0, 1.0, 1.0, shared]))
    # The upper left of the image is at NDC (-1, +1).
    assert_close(receivers(np.zeros(1), np.zeros(1), np.zeros(1)).position, [[-1.0, 1.0, -1.0]])


def test_nearest_changes_at_whole_numbers():
    shadow_map = ShadowMap(jnp.ones((HEIGHT, WIDTH)).at[2, 5].set(0.1), jnp.eye(4))
    column = np.array([5 - 1e-9, 5 + 1e-9, 6 - 1e-9, 6 + 1e-9])
    at = receivers(column, np.full(4, 2.5), np.full(4, 0.5))
    assert_close(look(shadow_map, at, NearestFilter(), HardCompare()), np.array([1.0, 0, 0, 1]))


# Outside nothing is known to block.

BLOCKED = ShadowMap(jnp.zeros((HEIGHT, WIDTH)), jnp.eye(4))


@pytest.mark.parametrize("name", FILTERS)
def test_outside_the_image_is_lit(name):
    far = 1e12  # no integer holds that
    column = np.array([-1.0, WIDTH + 1, 4.5, 4.5, -far, far, 8.0])
    row = np.array([4.5, 4.5, -1.0, HEIGHT + 1, 3.0, far, 8.0])
    at = receivers(column, row, np.full(7, 0.5))
    expected = np.array([1.0, 1, 1, 1, 1, 1, 0])
    assert_close(look(BLOCKED, at, FILTERS[name], HardCompare()), expected, ulps=0)


def test_at_the_border_the_outside_counts_as_lit():
    """Half a texel from the side, 2x2 lookup begins to blend with what lies outside."""
    column = np.array([0.5, 0.25, 0.0, -0.25, -0.5, WIDTH - 0.25, WIDTH])
    row = np.full(7, 6.5)
    at = receivers(column, row, np.full(7, 0.5))
    nearest = np.array([0.0, 0, 0, 1, 1, 0, 1])
    assert_close(look(BLOCKED, at, NearestFilter(), HardCompare()), nearest, ulps=0)
    bilinear = np.array([0.0, 0.25, 0.5, 0.75, 1.0, 0.25, 0.5])
    assert_close(look(BLOCKED, at, BilinearFilter(), HardCompare()), bilinear, ulps=8)


@pytest.mark.parametrize("name", FILTERS)
def test_beyond_the_depths_of_the_map_is_lit(name):
    at = receivers(np.full(3, 5.0), np.full(3, 5.0), np.array([-0.01, 0.5, 1.01]))
    lit = look(BLOCKED, at, FILTERS[name], HardCompare())
    assert_close(lit, np.array([1.0, 0.0, 1.0]), ulps=8)


@pytest.mark.parametrize("name", FILTERS)
@pytest.mark.parametrize("compare", [HardCompare(), SoftCompare(0.5)])
def test_behind_a_spot_light_the_shadow_test_says_lit(name, compare):
    """That no light arrives there is told by the light's radiance, which is 0."""
    light = SpotLight(jnp.array([0.0, 2.0, 0.0]), jnp.array([0.0, -1.0, 0.0]), outer_angle=0.6)
    clip = light.clip_from_world(np.array([[-1.0, 0, -1], [1, 0, 1], [0, 1, 0]]))
    rng = np.random.default_rng(2)
    position = jnp.asarray(rng.uniform([-2, 2, -2], [2, 6, 2], (50, 3)))
    normal = jnp.broadcast_to(-UP, position.shape)
    matrix = texel_from_clip(HEIGHT, WIDTH) @ clip
    receiver = locate(position, normal, light.to_light(position), matrix)
    blocked = BLOCKED._replace(clip_from_world=clip)
    assert_close(look(blocked, receiver, FILTERS[name], compare), np.ones(50), ulps=0)
    assert_close(light.radiance(position), np.zeros((50, 3)), ulps=0)


# Laws


@pytest.mark.parametrize("name", FILTERS)
def test_weights_sum_to_1(name):
    shadow_map, receiver = random_map(), receivers(*random_places())
    taps = FILTERS[name].read(shadow_map, receiver)
    assert len(taps) == {"nearest": 1, "bilinear": 4}[name]
    assert_close(sum(tap.weight for tap in taps), np.ones(400), ulps=4)
    assert all(float(tap.weight.min()) >= 0 for tap in taps)


@pytest.mark.parametrize("name", FILTERS)
def test_taps_serve_while_only_depth_moves(name):
    shadow_map, receiver = random_map(), receivers(*random_places())
    kept = FILTERS[name].read(shadow_map, receiver)
    for depth in (-0.2, 0.0, 0.3):
        biased = receiver.less_depth(jnp.asarray(depth))
        expected = look(shadow_map, biased, FILTERS[name], SoftCompare(40.0))
        assert_close(compare_taps(kept, biased, SoftCompare(40.0)), expected, ulps=8)


def test_bilinear_is_continuous():
    """Across the lines through texel centres, where one set of four gives way to the next."""
    column, row, depth = random_places()
    for axis in (column, row):
        axis[:] = np.floor(axis) + 0.5
        below, above = (
            look(random_map(), receivers(*places, depth), BilinearFilter(), HardCompare())
            for places in ((column - 1e-9, row - 1e-9), (column + 1e-9, row + 1e-9))
        )
        assert float(jnp.abs(below - above).max()) < 1e-8  # measured 4e-9
        axis += 0.3


def test_bilinear_is_bilinear():
    """In between, second differences vanish along each axis."""
    rng = np.random.default_rng(3)
    base = rng.integers(-1, 10, (200, 2)) + 0.5
    steps = np.array([0.1, 0.5, 0.9])
    for axis in (0, 1):
        others = rng.uniform(0.1, 0.9, (200, 1))
        moved = np.broadcast_to(base[:, None], (200, 3, 2)) + others[..., None]
        moved[..., axis] = base[:, None, axis] + steps
        at = receivers(moved[..., 0], moved[..., 1], np.full((200, 3), 0.5))
        lit = look(random_map(), at, BilinearFilter(), HardCompare())
        assert_close(lit[:, 0] + lit[:, 2], 2 * lit[:, 1])
        assert float(jnp.abs(lit[:, 0] - lit[:, 2]).max()) > 0.5


@pytest.mark.parametrize("name", FILTERS)
def test_transposed_map_transposed_places(name):
    column, row, depth = random_places()
    inside = (column > 0) & (column < HEIGHT) & (row > 0) & (row < HEIGHT)
    square = random_map().depth[:, :HEIGHT]

    def lit(stored, column, row):
        receiver = receivers(column, row, depth)._replace(
            column=jnp.asarray(column), row=jnp.asarray(row)
        )
        return look(ShadowMap(stored, jnp.eye(4)), receiver, FILTERS[name], HardCompare())

    assert inside.sum() > 100
    assert_close(lit(square.T, row, column), lit(square, column, row), ulps=8)


# Derivatives: the whole chain, from the light to the visibility of points on a slope.

TARGETS = np.array([[-2.0, -1.0, -2.0], [2.0, -1.0, 2.0], [2.0, 1.0, -2.0], [-2.0, 1.0, 2.0]])
LIGHTS = {
    "parallel": DirectionalLight(jnp.array([0.3, 0.9, 0.2])),
    "spot": SpotLight(jnp.array([0.7, 4.0, 0.6]), jnp.array([-0.1, -1.0, -0.2]), outer_angle=0.7),
}


BIASES = {
    "parallel": lambda leaves: NormalOffsetBias(leaves["texels"]),
    "spot": lambda leaves: CombinedBias(
        (ConstantBias(leaves["length"]), SlopeBias(leaves["factor"]))
    ),
}


def chain(leaves, name):
    """Visibility of points as a function of everything, the light's place included."""
    light = eqx.tree_at(lambda light: light.direction, LIGHTS[name], leaves["direction"])
    if name == "spot":
        light = eqx.tree_at(lambda light: light.position, light, leaves["light position"])
    clip = light.clip_from_world(jnp.asarray(TARGETS))
    matrix = texel_from_clip(HEIGHT, WIDTH) @ clip
    position, normal = leaves["position"], leaves["normal"]
    receiver = receive(position, normal, light.to_light(position), matrix)
    return look_up(
        ShadowMap(leaves["depths"], clip),
        BIASES[name](leaves)(receiver),
        filter=BilinearFilter(),
        compare=SoftCompare(leaves["softness"]),
    )


def generic_leaves(name):
    rng = np.random.default_rng(4)
    normal = rng.uniform(-0.4, 0.4, (7, 3)) + np.array([0.0, 1.0, 0.0])
    leaves = {
        "softness": 2.0,
        "direction": LIGHTS[name].direction,
        "depths": rng.uniform(0.3, 0.7, (HEIGHT, WIDTH)),
        "position": rng.uniform(-0.9, 0.9, (7, 3)) * [1.0, 0.2, 1.0],
        "normal": normal / np.linalg.norm(normal, axis=-1, keepdims=True),
    }
    if name == "spot":
        leaves |= {"length": 0.1, "factor": 0.7, "light position": LIGHTS[name].position}
    else:
        leaves["texels"] = 0.4
    return {key: jnp.asarray(value, float) for key, value in leaves.items()}


@functools.cache
def compiled(name):
    """The chain, its derivative along a direction, and its pullback.

    Compiled without optimization: it runs a few hundred times on a few numbers.
    """
    of = lambda leaves: chain(leaves, name)
    push = lambda leaves, step: jax.jvp(of, (leaves,), (step,))[1]
    pull = lambda leaves, weights: jax.vjp(of, leaves)[1](weights)[0]
    options = {"xla_backend_optimization_level": 0}
    return [jax.jit(function, compiler_options=options) for function in (of, push, pull)]


@functools.cache
def jacobians(name):
    """Jacobians at a generic point: forward mode, reverse mode, central differences."""
    leaves = generic_leaves(name)
    of, push, pull = compiled(name)
    value = of(leaves)
    assert 0.05 < float(value.min()) < float(value.max()) < 0.95
    flat, unflatten = ravel_pytree(leaves)
    steps = [unflatten(row) for row in np.eye(len(flat))]
    ends = [
        [of(unflatten(flat + sign * 1e-6 * row)) for row in np.eye(len(flat))] for sign in (1, -1)
    ]
    columns = np.stack([push(leaves, step) for step in steps])
    rows = [pull(leaves, weights) for weights in jnp.eye(len(value))]
    differences = (np.array(ends[0]) - np.array(ends[1])) / 2e-6
    stacked = lambda columns: jax.vmap(unflatten, in_axes=1)(jnp.asarray(columns))
    return stacked(columns), jax.tree.map(lambda *x: jnp.stack(x), *rows), stacked(differences)


@pytest.mark.parametrize(
    ("name", "leaf"), [(name, leaf) for name in LIGHTS for leaf in generic_leaves(name)]
)
def test_derivative_of_visibility(name, leaf):
    forward, reverse, numerical = (np.asarray(jacobian[leaf]) for jacobian in jacobians(name))
    scale = np.abs(numerical).max()
    assert scale > 1e-3
    np.testing.assert_allclose(forward, numerical, rtol=1e-6, atol=1e-6 * scale)
    np.testing.assert_allclose(reverse, forward, rtol=1e-10, atol=1e-12 * scale)


@pytest.mark.parametrize("softness", [0.0, 0.5])
@pytest.mark.parametrize("name", LIGHTS)
def test_degenerate_points_have_finite_derivatives(name, softness):
    """Behind, beside and at the light, without a normal, edge-on, cleared: one row each."""
    light = LIGHTS[name]
    at_light = jnp.asarray(getattr(light, "position", jnp.zeros(3)))
    towards = light.to_light(jnp.zeros((1, 3)))[0]
    edge = jnp.cross(towards, UP)
    points = {
        "behind": (at_light - 2 * light.direction, UP),
        "beside": (at_light + jnp.cross(light.direction, UP), UP),
        "at the light": (at_light, UP),
        "at the light without a normal": (at_light, jnp.zeros(3)),
        "empty pixel": (jnp.zeros(3), jnp.zeros(3)),
        "edge-on": (jnp.zeros(3), edge / jnp.sqrt(jnp.sum(edge**2))),
        "facing": (jnp.zeros(3), towards),
    }
    leaves = generic_leaves(name) | {"softness": jnp.asarray(softness, float)}
    leaves["depths"] = leaves["depths"].at[:, ::2].set(1.0)
    of, _, pull = compiled(name)
    bad = {}
    for row, (point, (position, normal)) in enumerate(points.items()):
        leaves["position"] = generic_leaves(name)["position"].at[row].set(position)
        leaves["normal"] = generic_leaves(name)["normal"].at[row].set(normal)
        assert bool(jnp.isfinite(of(leaves)).all())
        derivatives = pull(leaves, jnp.ones(len(points)))
        bad[point] = [leaf for leaf, d in derivatives.items() if not bool(jnp.isfinite(d).all())]
    assert not any(bad.values()), f"derivatives that are not finite: {bad}"
