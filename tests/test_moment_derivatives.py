"""Derivatives of prefiltered visibility in the light, the map and the options; singular points."""

import dataclasses
import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from shadows import (
    ConstantBias,
    DirectionalLight,
    ESMFilter,
    EVSM2Filter,
    EVSM4Filter,
    HardCompare,
    MSMFilter,
    ShadowMap,
    SpotLight,
    VSMFilter,
    look_up,
    receive,
    texel_from_clip,
)

HEIGHT, WIDTH = 12, 16
UP = jnp.array([0.0, 0.0, 1.0])
TARGETS = np.array([[-2.0, -1.0, -2.0], [2.0, -1.0, 2.0], [2.0, 1.0, -2.0], [-2.0, 1.0, 2.0]])
LIGHTS = {
    "parallel": DirectionalLight(jnp.array([0.3, 0.9, 0.2])),
    "spot": SpotLight(jnp.array([0.7, 4.0, 0.6]), jnp.array([-0.1, -1.0, -0.2]), outer_angle=0.7),
}
SINGLE = {
    "vsm": VSMFilter(min_variance=0.0),
    "esm": ESMFilter(),
    "evsm2": EVSM2Filter(min_variance=0.0),
    "evsm4": EVSM4Filter(),
    "msm": MSMFilter(),
    "msm unbiased": MSMFilter(moment_bias=0.0),
}
CHAINS = {
    "vsm": ("spot", VSMFilter(radius=1, mips=2, level=0.6, bleeding=0.05)),
    "esm": ("spot", ESMFilter(radius=2, exponent=20.0, blur="gaussian")),
    "evsm4": ("parallel", EVSM4Filter(radius=1, exponent=8.0)),
    "msm": ("parallel", MSMFilter(radius=1)),
}


def chain(leaves, name):
    """Visibility of points as a function of everything, the light's place included."""
    light_name, filter = CHAINS[name]
    light = eqx.tree_at(lambda light: light.direction, LIGHTS[light_name], leaves["direction"])
    if light_name == "spot":
        light = eqx.tree_at(lambda light: light.position, light, leaves["light position"])
    clip = light.clip_from_world(jnp.asarray(TARGETS))
    matrix = texel_from_clip(HEIGHT, WIDTH) @ clip
    position = leaves["position"]
    normal = jnp.broadcast_to(jnp.array([0.0, 1.0, 0.0]), position.shape)
    receiver = receive(position, normal, light.to_light(position), matrix)
    filter = dataclasses.replace(filter, **{key: leaves[key] for key in numbers_of(filter)})
    shadow_map = ShadowMap(leaves["depths"], clip)
    moved = ConstantBias(leaves["length"])(receiver)
    return look_up(shadow_map, moved, filter=filter, compare=HardCompare())


def numbers_of(filter):
    fields = dataclasses.fields(filter)
    moving = [field.name for field in fields if "unit" in field.metadata]
    return moving if filter.mips else [name for name in moving if name != "level"]


def generic_leaves(name):
    light, filter = CHAINS[name]
    rng = np.random.default_rng(6)
    stored = (0.3, 0.7) if light == "spot" else (0.15, 0.5)
    leaves = {key: getattr(filter, key) for key in numbers_of(filter)}
    leaves |= {
        "length": 0.02,
        "direction": LIGHTS[light].direction,
        "depths": rng.uniform(*stored, (HEIGHT, WIDTH)),
        "position": rng.uniform(-0.9, 0.9, (7, 3)) * [1.0, 0.2, 1.0],
    }
    if light == "spot":
        leaves["light position"] = LIGHTS[light].position
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
    assert 0.05 < float(value.min()) < 0.7 < float(value.max())
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


IDLE = {"min_variance", "moment_bias"}  # against rounding; moved in test_moment_filters.py


@pytest.mark.parametrize(
    ("name", "leaf"), [(name, leaf) for name in CHAINS for leaf in generic_leaves(name)]
)
def test_derivative_of_visibility(name, leaf):
    forward, reverse, numerical = (np.asarray(jacobian[leaf]) for jacobian in jacobians(name))
    scale = np.abs(numerical).max()
    assert scale > 1e-3 or leaf in IDLE
    if leaf != "moment_bias":
        np.testing.assert_allclose(forward, numerical, rtol=1e-6, atol=1e-6 * scale)
    np.testing.assert_allclose(reverse, forward, rtol=1e-9, atol=1e-11 * scale)


@pytest.mark.parametrize("name", CHAINS)
def test_degenerate_points_have_finite_derivatives(name):
    """Behind, beside and at the light, out of the map, at the stored depth, over nothing."""
    light = LIGHTS[CHAINS[name][0]]
    at_light = jnp.asarray(getattr(light, "position", jnp.zeros(3)))
    points = {
        "behind": at_light - 2 * light.direction,
        "beside": at_light + jnp.cross(light.direction, UP),
        "at the light": at_light,
        "far off": jnp.array([1e9, 0.0, -1e9]),
        "origin": jnp.zeros(3),
    }
    of, _, pull = compiled(name)
    bad = {}
    for stored in (0.0, 0.5, 1.0):
        leaves = generic_leaves(name) | {"length": jnp.zeros(())}
        half = leaves["depths"].at[:, ::2].set(1.0)
        leaves["depths"] = half if stored == 0.5 else jnp.full_like(half, stored)
        for row, position in enumerate(points.values()):
            leaves["position"] = leaves["position"].at[row].set(position)
        assert bool(jnp.isfinite(of(leaves)).all())
        derivatives = pull(leaves, jnp.ones(7))
        bad[stored] = [leaf for leaf, d in derivatives.items() if not bool(jnp.isfinite(d).all())]
    assert not any(bad.values()), f"derivatives that are not finite: {bad}"


@pytest.mark.parametrize("name", SINGLE)
def test_receivers_at_the_only_depth_there_is(name):
    """No variance, and nothing between receiver and mean: lit, with finite derivatives."""
    position = jnp.asarray(np.random.default_rng(7).uniform(-1.1, 1.1, (100, 3)), jnp.float32)
    position = position.at[:, 2].set(0.0)
    normal = jnp.broadcast_to(-UP.astype(jnp.float32), position.shape)

    def of(depth, filter, position):
        shadow_map = ShadowMap(depth, jnp.eye(4, dtype=depth.dtype))
        receiver = receive(position, normal, normal, shadow_map.texel_from_world)
        return look_up(shadow_map, receiver, filter=filter, compare=HardCompare())

    def value_and_slopes(*point):
        lit, pull = jax.vjp(of, *point)
        return lit, pull(jnp.ones_like(lit))

    options = {"xla_backend_optimization_level": 0}
    compiled = jax.jit(value_and_slopes, compiler_options=options)
    depth = jnp.full((HEIGHT, WIDTH), 0.5, jnp.float32)
    lit, slopes = compiled(depth, jax.tree.map(jnp.float32, SINGLE[name]), position)
    np.testing.assert_allclose(lit, np.ones(100), atol=1e-6)  # measured 6e-7, MSM's bias
    assert all(bool(jnp.isfinite(slope).all()) for slope in jax.tree.leaves(slopes))
