"""Bumps by surface gradient: true normals of displaced surfaces, laws, singular frames."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from tangentspace.surface_gradient import (
    gradient_from_normal,
    gradient_from_parameters,
    gradient_from_slopes,
    gradient_from_volume,
    perturb_by_gradient,
)

from .tools import assert_close

Z = np.array([0.0, 0.0, 1.0])

perturb = jax.jit(perturb_by_gradient)
from_parameters = jax.jit(gradient_from_parameters)
from_normal = jax.jit(gradient_from_normal)
from_volume = jax.jit(gradient_from_volume)
from_slopes = jax.jit(gradient_from_slopes)


@functools.partial(jax.jit, static_argnums=0)
def all_derivatives(function, *given):
    """Gradients of the sum of the vector's components, reverse and forward."""
    total = lambda *given: jnp.sum(function(*given).vector)
    every = tuple(range(len(given)))
    return jax.grad(total, every)(*given), jax.jacfwd(total, every)(*given)


def unit(vectors):
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def generic(count=6):
    """Unit normals, two changes of position in their plane at 20 to 160 degrees, slopes."""
    rng = np.random.default_rng(0)
    n, t = np.linalg.qr(rng.normal(size=(count, 3, 3)))[0][..., :2].transpose(2, 0, 1)
    b = np.cross(n, t)
    angle = rng.uniform(0.35, 2.8, (count, 1))
    dp_du = rng.uniform(0.5, 2, (count, 1)) * t
    dp_dv = rng.uniform(0.5, 2, (count, 1)) * (np.cos(angle) * t + np.sin(angle) * b)
    return n, dp_du, dp_dv, *rng.normal(size=(2, count))


# Known answers


def test_a_slope_tilts_the_normal_against_it(dtype):
    """A ramp that rises by 3/4 per length: its normal is (-3, 0, 4) / 5, whatever the chart."""
    n, x, y = (np.array(v, dtype) for v in ([0, 0, 1], [1, 0, 0], [0, 1, 0]))
    zero, slope = dtype(0), dtype(0.75)
    expected = np.array([-0.6, 0, 0.8])
    charts = {
        "lengths": (x, y, slope, zero),
        "stretched": (4 * x, 0.5 * y, 4 * slope, zero),
        "sheared": (x, x + y, slope, slope),
        "mirrored": (-x, y, -slope, zero),
        "rows downwards": (x, -y, slope, zero),
        "swapped": (y, x, zero, slope),
    }
    for chart in charts.values():
        gradient = from_parameters(n, *chart)
        assert gradient.valid
        assert gradient.vector.dtype == dtype
        assert_close(perturb(n, gradient.vector), expected, ulps=4)
    slopes = from_slopes(np.array([0.75, 0], dtype), x, y)
    assert_close(perturb(n, slopes), expected, ulps=4)
    volume = from_volume(n, np.array([0.75, 0, 9], dtype))
    assert_close(perturb(n, volume), expected, ulps=4)


def sphere(uv):
    u, v = uv
    return 2 * jnp.stack([jnp.cos(v) * jnp.cos(u), jnp.cos(v) * jnp.sin(u), jnp.sin(v)])


def height(point):
    """Defined in space: no chart needed."""
    x, y, z = point
    return 0.1 * jnp.sin(3 * x + 1) * jnp.cos(2 * y) + 0.05 * z * x


def test_normals_of_a_displaced_sphere():
    """The error shrinks with the height's square; the curvature is what is neglected."""
    at = jnp.array([0.7, 0.4])
    position, (dp_du, dp_dv) = sphere(at), jax.jacfwd(sphere)(at).T
    normal = position / 2
    dh_du, dh_dv = jax.grad(lambda uv: height(sphere(uv)))(at)

    def truth(scale):
        moved = lambda uv: sphere(uv) * (1 + scale * (height(sphere(uv)) - height(position)) / 2)
        return unit(np.cross(*jax.jacfwd(moved)(at).T))

    def bumped(scale):
        chart = from_parameters(normal, dp_du, dp_dv, scale * dh_du, scale * dh_dv).vector
        volume = from_volume(normal, scale * jax.grad(height)(position))
        assert_close(chart, volume)  # the same vector, from texture space and from space
        return perturb(normal, chart)

    # Moved by a height that is zero here, with the slope that it has: exact for any scale.
    for scale in (1.0, 5.0):
        assert np.linalg.norm(bumped(scale) - normal) > 0.05
        assert_close(bumped(scale), truth(scale))


def test_a_plane_is_exact_at_any_height():
    plane = lambda uv: jnp.stack([uv[0] + 0.3 * uv[1], 0.8 * uv[1], 0 * uv[0]])
    at = jnp.array([0.4, -0.2])
    moved = lambda uv: plane(uv) + height(plane(uv) + 0.5) * jnp.asarray(Z)
    truth = unit(np.cross(*jax.jacfwd(moved)(at).T))
    slopes = jax.grad(lambda uv: height(plane(uv) + 0.5))(at)
    gradient = from_parameters(jnp.asarray(Z), *jax.jacfwd(plane)(at).T, *slopes)
    assert_close(perturb(Z, gradient.vector), truth)


# Laws


def test_a_change_of_parameters_changes_nothing():
    """As from texture space to pixels; also where it mirrors."""
    n, dp_du, dp_dv, dh_du, dh_dv = generic()
    before = from_parameters(n, dp_du, dp_dv, dh_du, dh_dv).vector
    for (a, b), (c, d) in ([[2, 1], [-1, 3]], [[0, 1], [1, 0]], [[0.01, 0], [0, -50]]):
        changed = (a * dp_du + b * dp_dv, c * dp_du + d * dp_dv)
        heights = (a * dh_du + b * dh_dv, c * dh_du + d * dh_dv)
        assert_close(from_parameters(n, *changed, *heights).vector, before, ulps=256)  # 22


def test_gradients_lie_in_the_tangent_plane_and_answer_the_slopes():
    n, dp_du, dp_dv, dh_du, dh_dv = generic()
    gradient = np.asarray(from_parameters(n, dp_du, dp_dv, dh_du, dh_dv).vector)
    for change, expected in ((n, np.zeros(6)), (dp_du, dh_du), (dp_dv, dh_dv)):
        assert_close(np.sum(gradient * change, axis=1), expected, ulps=64)


def test_layers_add():
    """The gradients of two heights are together that of their sum, from any source."""
    n, dp_du, dp_dv, *first = generic()
    second = np.random.default_rng(1).normal(size=(2, 6))
    layer = lambda slopes: from_parameters(n, dp_du, dp_dv, *slopes).vector
    assert_close(layer(first) + 2 * layer(second), layer(first + 2 * second), ulps=128)
    ready = from_normal(n, perturb(n, layer(first)))
    assert np.all(ready.valid)
    assert_close(ready.vector, layer(first), ulps=1024)  # 75 measured, at a tilt of 86 degrees


def test_no_slope_leaves_the_normal(dtype):
    n = generic()[0].astype(dtype)
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    assert_close(perturb(n, np.zeros((6, 3), dtype)), n, ulps=1)
    gradient = from_normal(n, 7 * n)
    assert gradient.vector.dtype == dtype
    assert_close(gradient.vector, np.zeros((6, 3)), ulps=2)


def test_perturbing_by_a_gradient_from_a_normal_gives_that_normal(dtype):
    n = generic()[0]
    bumped = unit(n + np.random.default_rng(2).normal(0, 0.4, (6, 3)))
    assert np.all(np.sum(n * bumped, axis=1) > 0.3)
    n, bumped = n.astype(dtype), bumped.astype(dtype)
    gradient = from_normal(n, 3 * bumped)
    assert np.all(gradient.valid)
    assert_close(perturb(n, gradient.vector), bumped, ulps=8)


def test_scale_of_the_scene_does_not_matter():
    """In float32 too, from atoms to planets."""
    n, dp_du, dp_dv, *slopes = (a.astype(np.float32) for a in generic())
    before = from_parameters(n, dp_du, dp_dv, *slopes)
    for scale in np.array([2.0**-40, 2.0**40], np.float32):
        after = from_parameters(n, *(scale * a for a in (dp_du, dp_dv, *slopes)))
        assert np.all(after.valid)
        assert_close(after.vector, before.vector, ulps=8)


# Singular input


SINGULAR = {
    "no change in u": (Z, np.zeros(3), np.array([0.0, 1, 0])),
    "no change at all": (Z, np.zeros(3), np.zeros(3)),
    "parallel": (Z, np.array([1.0, 2, 0]), np.array([-3.0, -6, 0])),
    "seen from its edge": (Z, np.array([0.6, 0.8, 0]), np.array([0.6, 0.8, 1])),
    "no normal": (np.zeros(3), np.array([1.0, 0, 0]), np.array([0.0, 1, 0])),
}


@pytest.mark.parametrize("case", SINGULAR)
def test_singular_frames_are_flagged_and_flat(case, dtype):
    vectors = [v.astype(dtype) for v in SINGULAR[case]]
    gradient = from_parameters(*vectors, dtype(3), dtype(-2))
    assert not gradient.valid
    assert_close(gradient.vector, np.zeros(3), ulps=0)
    derivatives = all_derivatives(gradient_from_parameters, *vectors, dtype(3), dtype(-2))
    for g in jax.tree.leaves(derivatives):
        assert_close(g, np.zeros_like(g), ulps=0)


@pytest.mark.parametrize("bumped", [[1.0, 0, 0], [0.6, 0, -0.8], [0, 0, 0]])
def test_normals_below_the_surface_are_flagged(bumped, dtype):
    n, bumped = Z.astype(dtype), np.array(bumped, dtype)
    gradient = from_normal(n, bumped)
    assert not gradient.valid
    assert_close(gradient.vector, np.zeros(3), ulps=0)
    for g in jax.tree.leaves(all_derivatives(gradient_from_normal, n, bumped)):
        assert_close(g, np.zeros(3), ulps=0)


def test_one_singular_row_leaves_the_others_alone():
    given = list(generic())
    good, _ = all_derivatives(gradient_from_parameters, *given)
    given[1][2] = 0
    spoiled, _ = all_derivatives(gradient_from_parameters, *given)
    for a, b in zip(spoiled, good, strict=True):
        assert_close(np.delete(a, 2, axis=0), np.delete(b, 2, axis=0))
        assert_close(a[2], np.zeros_like(a[2]), ulps=0)


# Derivatives


def test_derivatives_are_the_finite_differences():
    n, *rest = generic(3)

    def all_of_it(n, dp_du, dp_dv, dh_du, dh_dv, volume, slopes):
        gradient = gradient_from_parameters(n, dp_du, dp_dv, dh_du, dh_dv).vector
        gradient = gradient + gradient_from_volume(n, volume)
        bumped = perturb_by_gradient(n, gradient + gradient_from_slopes(slopes, dp_du, dp_dv))
        return bumped, gradient_from_normal(n, bumped + 3 * n).vector

    rng = np.random.default_rng(3)
    arguments = (n, *rest, rng.normal(size=(3, 3)), rng.normal(size=(3, 2)))
    check_grads(jax.jit(all_of_it), arguments, 1, ("fwd", "rev"), eps=1e-6, atol=1e-6, rtol=1e-6)
