"""Gradients across the edge of a quad's shadow: the closed form, under every light and filter."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.edge_gradients.quad_shadow import (
    CAMERAS,
    CORNERS,
    LIGHTS,
    exact_mean,
    rendered_mean,
)
from experiments.options import techniques
from shadows import Filter

FILTERS = techniques(Filter)


def moved(numbers, light):
    """Shift the caster, move one of its corners, move the light."""
    shift, corner, lamp = numbers
    corners = (jnp.asarray(CORNERS, shift.dtype) + shift).at[2].add(corner)
    light = jax.tree.map(lambda leaf: jnp.asarray(leaf, shift.dtype), light)
    if hasattr(light, "position"):
        light = eqx.tree_at(lambda light: light.position, light, light.position + lamp)
    return corners, light


def still(dtype):
    return (jnp.zeros(3, dtype), jnp.zeros(3, dtype), jnp.zeros(3, dtype))


def exact(light, camera):
    of = lambda numbers: exact_mean(*moved(numbers, light), camera)
    return jax.jit(jax.value_and_grad(of))(still(jnp.float64))


def rendered(light, camera, dtype=jnp.float32, **options):
    camera = jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype), camera)
    of = lambda numbers: rendered_mean(*moved(numbers, light), camera, **options)
    return jax.jit(jax.value_and_grad(of))(still(dtype))


def off(change, expected):
    """Return the largest error of the three derivatives, relative to the longest part of each."""
    return [
        float(np.abs(a - b).max() / np.abs(b).max())
        for a, b in zip(change, expected, strict=True)
        if np.abs(b).max() > 0
    ]


@pytest.mark.parametrize(
    ("kind", "measure"),
    [("point", "lit area"), ("spot", "mean image"), ("directional", "mean image")],
)
def test_derivatives_are_those_of_the_closed_form(kind, measure):
    """Measured: at most 0.5 %."""
    light, camera = LIGHTS[kind], CAMERAS[measure]
    value, change = exact(light, camera)
    found, found_change = rendered(light, camera, map_size=512, image_size=512)
    assert float(found) == pytest.approx(float(value), rel=2e-3)
    assert max(off(found_change, change)) < 0.01


def of_corner(mean, dtype):
    """Return how a mean changes as a corner of the caster moves along x."""

    def at(x):
        shift, corner, lamp = still(dtype)
        numbers = shift, corner.at[0].set(x), lamp
        return mean(*moved(numbers, LIGHTS["directional"]))

    start, rate = jnp.zeros((), dtype), jnp.ones((), dtype)
    return float(jax.jit(lambda: jax.jvp(at, (start,), (rate,))[1])())


@pytest.mark.parametrize("name", FILTERS)
def test_every_filter_sees_the_edge_move(name):
    """Without coverage none does; one shows it."""
    camera = CAMERAS["lit area"]
    expected = of_corner(lambda *scene: exact_mean(*scene, camera), jnp.float64)
    options = {"map_size": 256, "image_size": 256, "filter": FILTERS[name]()}  # pyright: ignore[reportAbstractUsage]
    camera = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), camera)
    found = of_corner(lambda *scene: rendered_mean(*scene, camera, **options), jnp.float32)
    # Measured: evsm2 8.5 % (light leaks beside the edge), the others below 5 %.
    assert found == pytest.approx(expected, rel=0.12 if name == "evsm2" else 0.05)
    if name == "bilinear":
        options["covered"] = False
        without = of_corner(lambda *scene: rendered_mean(*scene, camera, **options), jnp.float32)
        assert abs(without) < 0.1 * abs(expected)
