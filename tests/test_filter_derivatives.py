"""Derivatives of filters that compare, and of biases with them, in everything there is.

From the light to the visibility of points on slopes: against central differences in double
precision, forward and reverse. (Filters of means have theirs in ``test_moment_derivatives``.)
"""

import dataclasses
import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.options import techniques
from shadows import (
    AdaptiveBias,
    BilinearFilter,
    CombinedBias,
    ConstantBias,
    Filter,
    HardCompare,
    MidpointBias,
    NearestFilter,
    NormalOffsetBias,
    PCFFilter,
    PCSSFilter,
    PoissonFilter,
    ReceiverPlaneBias,
    ShadowMap,
    SlopeBias,
    SoftCompare,
    TentFilter,
    look_up,
    receive,
    texel_from_clip,
)

from .test_filters import HEIGHT, LIGHTS, TARGETS, WIDTH

UP = jnp.array([0.0, 0.0, 1.0])
# Light, filter and biases; each bias and each filter once at least.
CHAINS = {
    "nearest": ("parallel", NearestFilter(), SlopeBias(0.4, unit="world")),
    "bilinear": ("spot", BilinearFilter(), ConstantBias(0.3, unit="texel")),
    "pcf": ("spot", PCFFilter(1), AdaptiveBias(0.2, unit="reach")),
    "tent": ("parallel", TentFilter(1), ReceiverPlaneBias(0.8)),
    "poisson": ("spot", PoissonFilter(1.37, taps=6), NormalOffsetBias(0.3, unit="reach")),
    "pcss": (
        "spot",
        PCSSFilter(4.0, 0.3, taps=5, search_taps=7, widest=6),
        CombinedBias((AdaptiveBias(0.02), MidpointBias(0.1))),
    ),
    "pcss parallel": (
        "parallel",
        PCSSFilter(1.5, 0.3, taps=5, search_taps=7, widest=6),
        ConstantBias(0.05),
    ),
}


def chain(leaves, name):
    """Visibility of points as a function of everything, the light's place included."""
    light = eqx.tree_at(lambda light: light.direction, LIGHTS[CHAINS[name][0]], leaves["direction"])
    if hasattr(light, "position"):
        light = eqx.tree_at(lambda light: light.position, light, leaves["light position"])
    clip = light.clip_from_world(jnp.asarray(TARGETS))
    position = leaves["position"]
    towards = light.to_light(position)
    receiver = receive(position, leaves["normal"], towards, texel_from_clip(HEIGHT, WIDTH) @ clip)
    filter, bias = leaves["filter"], leaves["bias"]
    return look_up(
        bias.prepare(ShadowMap(leaves["depths"], clip, leaves["second depths"])),
        bias(receiver, filter.reach()),
        filter=filter,
        compare=SoftCompare(leaves["softness"]),
    )


def generic_leaves(name):
    light, filter, bias = CHAINS[name]
    rng = np.random.default_rng(4)
    normal = rng.uniform(-0.4, 0.4, (7, 3)) + np.array([0.0, 1.0, 0.0])
    depths = rng.uniform(0.3, 0.7, (HEIGHT, WIDTH))
    leaves = {
        "filter": filter,
        "bias": bias,
        "softness": 2.0,
        "direction": LIGHTS[light].direction,
        "depths": depths,
        "second depths": depths + rng.uniform(0.05, 0.2, depths.shape),
        "position": rng.uniform(-0.9, 0.9, (7, 3)) * [1.0, 0.2, 1.0],
        "normal": normal / np.linalg.norm(normal, axis=-1, keepdims=True),
    }
    if light == "spot":
        leaves["light position"] = LIGHTS[light].position
    return jax.tree.map(lambda x: jnp.asarray(x, float), leaves)


def idle(name):
    """Leaves that this chain does not use."""
    if not isinstance(CHAINS[name][2], CombinedBias):
        yield "second depths"


@functools.cache
def compiled(name):
    """The chain, its derivative along a direction, and its pullback.

    Compiled without optimization: it runs on a few numbers.
    """
    of = lambda leaves: chain(leaves, name)
    push = lambda leaves, step: jax.jvp(of, (leaves,), (step,))[1]
    pull = lambda leaves, weights: jax.vjp(of, leaves)[1](weights)[0]
    options = {"xla_backend_optimization_level": 0}
    return [jax.jit(function, compiler_options=options) for function in (of, push, pull)]


def paths(name):
    flat = jax.tree_util.tree_leaves_with_path(generic_leaves(name))
    return [jax.tree_util.keystr(path, simple=True, separator=".") for path, _ in flat]


def test_every_filter_that_compares_and_every_number_is_moved():
    """A new filter wants a line in the table above."""
    known = {type(filter) for _, filter, _ in CHAINS.values()}
    ours = [cls for cls in techniques(Filter).values() if cls.__module__.startswith("shadows.")]
    assert {cls for cls in ours if cls.compares} == known
    for name, (_, filter, _) in CHAINS.items():
        for field in dataclasses.fields(filter):
            assert ("unit" in field.metadata) == (f"filter.{field.name}" in paths(name))


@pytest.mark.parametrize(
    ("name", "leaf"), [(name, leaf) for name in CHAINS for leaf in paths(name)]
)
def test_derivative_of_visibility(name, leaf):
    """Along random directions: how all points change, and what each asks of the leaf."""
    leaves, (of, push, pull) = generic_leaves(name), compiled(name)
    value = of(leaves)
    assert 0.05 < float(value.min()) < float(value.max()) < 0.95
    flat, tree = jax.tree.flatten(leaves)
    where = paths(name).index(leaf)
    rng = np.random.default_rng(5)
    weights = jnp.asarray(rng.normal(size=7))
    for _ in range(2):
        step = jnp.asarray(rng.normal(size=flat[where].shape))
        moved = lambda by, step=step: tree.unflatten(
            [x + by * step if k == where else x for k, x in enumerate(flat)]
        )
        direction = tree.unflatten(
            [step if k == where else jnp.zeros_like(x) for k, x in enumerate(flat)]
        )
        forward = push(leaves, direction)
        reverse = jnp.sum(jax.tree.leaves(pull(leaves, weights))[where] * step)
        numerical = (of(moved(1e-6)) - of(moved(-1e-6))) / 2e-6
        scale = float(jnp.abs(numerical).max())
        assert (scale > 1e-3) == (leaf not in idle(name))
        np.testing.assert_allclose(forward, numerical, rtol=1e-6, atol=1e-6 * scale)
        np.testing.assert_allclose(reverse, weights @ forward, rtol=1e-9, atol=1e-12)


def singular_points(light):
    """Behind, beside and at the light, without a normal, edge-on, far off: one row each."""
    at_light = jnp.asarray(getattr(light, "position", jnp.zeros(3)))
    towards = light.to_light(jnp.zeros((1, 3)))[0]
    edge = jnp.cross(towards, UP)
    return [
        (at_light - 2 * light.direction, UP),
        (at_light + jnp.cross(light.direction, UP), UP),
        (at_light, UP),
        (at_light, jnp.zeros(3)),
        (jnp.zeros(3), edge / jnp.sqrt(jnp.sum(edge**2))),
        (jnp.zeros(3), towards),
        (jnp.array([1e9, 0.0, -1e9]), UP),
    ]


@pytest.mark.parametrize("softness", [0.0, 0.5])
@pytest.mark.parametrize("name", CHAINS)
def test_singular_points_have_finite_derivatives(name, softness):
    """Also with a hard comparison, half of the map cleared, and sizes of nothing."""
    leaves, (of, _, pull) = generic_leaves(name), compiled(name)
    leaves["softness"] = jnp.asarray(softness, float)
    leaves["depths"] = leaves["depths"].at[:, ::2].set(1.0)
    points = singular_points(LIGHTS[CHAINS[name][0]])
    leaves["position"], leaves["normal"] = (jnp.stack(rows) for rows in zip(*points, strict=True))
    for filter in (leaves["filter"], jax.tree.map(jnp.zeros_like, leaves["filter"])):
        changed = leaves | {"filter": filter}
        lit = of(changed)
        assert bool(jnp.all((lit >= 0) & (lit <= 1 + 1e-12)))
        for derivative in jax.tree.leaves(pull(changed, jnp.ones(7))):
            assert bool(jnp.isfinite(derivative).all())


@pytest.mark.parametrize("name", ["pcf", "poisson", "pcss"])
def test_a_hard_comparison_has_derivatives_in_places_alone(name):
    """Weights change with the place; a depth moves nothing but the width of a penumbra."""
    light, filter, _ = CHAINS[name]
    leaves = generic_leaves(name)
    clip = LIGHTS[light].clip_from_world(jnp.asarray(TARGETS))
    towards = LIGHTS[light].to_light(leaves["position"])

    @jax.jit
    def loss(depths, length, position):
        shadow_map = ShadowMap(depths, clip)
        receiver = receive(position, leaves["normal"], towards, shadow_map.texel_from_world)
        moved = ConstantBias(length)(receiver)
        return jnp.sum(look_up(shadow_map, moved, filter=filter, compare=HardCompare()))

    arguments = leaves["depths"], jnp.asarray(0.1), leaves["position"]
    *depths, place = (
        float(jnp.abs(slope).max()) for slope in jax.grad(loss, argnums=(0, 1, 2))(*arguments)
    )
    assert place > 0.1
    assert (max(depths) > 0) == (name == "pcss")


def test_the_derivative_in_a_bias_is_kept_as_one_image():
    """The reverse pass of 16 taps needs no array for each of them; 13 images measured before."""
    filter, compare, size = PCFFilter(1), SoftCompare(0.5), (256, 256)
    rng = np.random.default_rng(0)
    place = rng.uniform(0, WIDTH, (2, *size))
    position = jnp.asarray(np.stack([*(2 * place / WIDTH - 1), np.zeros(size)], -1), jnp.float32)
    up = jnp.broadcast_to(jnp.float32([0, 0, -1]), (*size, 3))
    depth = jnp.asarray(rng.uniform(0.4, 0.6, (HEIGHT, WIDTH)), jnp.float32)
    shadow_map = ShadowMap(depth, jnp.eye(4, dtype=jnp.float32))

    @jax.jit
    def read(shadow_map):
        receiver = receive(position, up, up, shadow_map.texel_from_world)
        return receiver, filter.read(shadow_map, receiver)

    def loss(length, receiver, taps):
        receiver = AdaptiveBias(length)(receiver, filter.reach())
        return jnp.mean(filter.visibility(taps, receiver, compare) ** 2)

    arguments = (jnp.float32(0.1), *read(shadow_map))
    compiled = jax.jit(jax.grad(loss)).lower(*arguments).compile()
    images = compiled.memory_analysis().temp_size_in_bytes / (4 * size[0] * size[1])
    assert images < 8  # 4.0 measured


def test_second_derivatives_in_a_bias():
    """Forward over reverse, with all else fixed, against differences of the first."""
    leaves = generic_leaves("bilinear")
    scale = 1.0 + 0.1 * np.arange(7)

    @jax.jit
    def loss(length):
        moved = leaves | {"bias": ConstantBias(length, unit="texel")}
        return jnp.sum(scale * chain(moved, "bilinear") ** 2)

    at, step = jnp.float64(0.3), 1e-5
    slope = jax.jit(jax.grad(loss))
    first = (loss(at + step) - loss(at - step)) / (2 * step)
    second = (slope(at + step) - slope(at - step)) / (2 * step)
    assert abs(float(second)) > 1e-3
    np.testing.assert_allclose(slope(at), first, rtol=1e-7)  # 2e-10 measured
    np.testing.assert_allclose(jax.jit(jax.hessian(loss))(at), second, rtol=1e-7)  # 2e-9
