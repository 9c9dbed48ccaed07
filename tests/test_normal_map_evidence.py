"""What a fit says of how well it knows, against dense derivatives and against trials."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.normal_map_fits.normal_map_evidence import (
    gather_evidence,
    seen_texels,
    undetermined,
)
from experiments.normal_map_fits.normal_map_information import texel_information, to_texels
from experiments.normal_map_fits.normal_map_task import Task, Unknowns
from shadows.lights import DirectionalLight
from tangentspace.normal_map import normals_from_slopes
from tangentspace.shading import LambertShading, PhongShading

from .test_normal_map_views import quick, studio, unit
from .tools import assert_close

SIZE = (5, 6)
LAMPS = tuple(
    DirectionalLight(unit(*towards), np.ones(3, np.float32))
    for towards in ((0.8, 1.0, 0.1), (-0.5, 1.0, 0.6), (-0.2, 1.0, -0.7))
)


@pytest.fixture(autouse=True)
def _single_precision():
    with jax.enable_x64(False):
        yield


def guess(model, lights, *, seed=1, bent=0.3):
    """Return unknowns as a fit holds them."""
    slopes = bent * np.random.default_rng(seed).normal(size=(*SIZE, 2))
    numbers = jax.tree.map(lambda leaf: jnp.asarray(leaf, float), (model, tuple(lights)))
    return Unknowns(jnp.asarray(slopes, float), *numbers)


@quick
def images(view, unknowns):
    """Return what the unknowns look like."""
    normals = view.normals(view.look_up(unknowns.slopes))
    colors = view.colors(normals, unknowns.lights, unknowns.shading)
    return jnp.stack([jnp.stack(channels) for channels in colors])


def task_of(view, unknowns, *, noise=0.0, seed=2):
    clean = images(view, unknowns)
    dirt = noise * np.random.default_rng(seed).standard_normal(clean.shape)
    return Task(view, clean + jnp.asarray(dirt, clean.dtype))


def one_to_one(lights, lit=None):
    """Return a view with one pixel on the centre of each texel."""
    count = SIZE[0] * SIZE[1]
    view = studio(lights, pixels=count)
    indices = (np.arange(count, dtype=np.int32) + np.arange(4, dtype=np.int32)[:, None]) % count
    weights = np.zeros((4, count), np.float32)
    weights[0] = 1
    lit = np.ones((len(lights), count)) if lit is None else lit
    return eqx.tree_at(
        lambda v: (v.indices, v.weights, v.lit),
        view,
        (jnp.asarray(indices), jnp.asarray(weights), jnp.asarray(lit, jnp.float32)),
    )


# Information


@functools.cache
def dense():
    """Each texel's information, and the same from all derivatives one by one, in double."""
    with jax.enable_x64(True):
        view = studio(LAMPS, dtype=np.float64)
        lit = np.random.default_rng(3).integers(0, 2, (3, 60)).astype(float)
        view = eqx.tree_at(lambda v: v.lit, view, jnp.asarray(lit))
        unknowns = guess(PhongShading(), LAMPS)
        task = Task(view, jnp.asarray(np.random.default_rng(4).uniform(size=(3, 3, 60))))
        found = texel_information(task, unknowns)
        residuals = lambda s: jnp.stack(
            task.residuals(Unknowns(s, unknowns.shading, unknowns.lights))
        )
        rows = np.asarray(quick(jax.jacfwd(residuals))(unknowns.slopes)).reshape(-1, *SIZE, 2)
        by_normal = np.asarray(quick(jax.jacfwd(normals_from_slopes))(unknowns.slopes))
        metric = np.einsum("ijxijk,ijxijl->ijkl", by_normal, by_normal)
        squares = np.sum(np.asarray(quick(residuals)(unknowns.slopes)) ** 2)
        return found, np.einsum("rijk,rijl->ijkl", rows, rows), metric, squares, rows, view


def test_the_information_is_that_of_the_dense_jacobian():
    found, expected, metric, squares, _, view = dense()
    assert found.slopes.dtype == np.float64
    assert np.linalg.det(expected).max() > 0.1
    np.testing.assert_allclose(found.slopes, expected, rtol=1e-9, atol=1e-9)  # measured 1e-13
    np.testing.assert_allclose(found.metric, metric, rtol=1e-9, atol=1e-9)
    assert found.squares == pytest.approx(squares, rel=1e-9)
    assert found.tells.shape == view.lit.shape


def test_a_light_that_does_not_count_tells_nothing():
    found, *_, view = dense()
    lit = np.asarray(view.lit, bool)
    assert not found.tells[~lit].any()
    assert found.tells[lit].mean() > 0.9


def test_a_light_from_behind_tells_nothing_of_a_matte_normal():
    below = DirectionalLight(unit(0.1, -1.0, 0.2), np.ones(3, np.float32))
    lights = (*LAMPS[:2], below)
    unknowns = guess(LambertShading(), lights)
    found = texel_information(task_of(one_to_one(lights), unknowns), unknowns)
    assert found.tells[:2].mean() > 0.9
    assert not found.tells[2].any()


def test_values_at_pixels_are_summed_at_texels_by_their_weights():
    view = studio(LAMPS)
    values = np.random.default_rng(0).normal(size=60)
    expected = np.zeros(30)
    for k in range(60):
        for corner in range(4):
            expected[view.indices[corner, k]] += float(view.weights[corner, k]) * values[k]
    np.testing.assert_allclose(to_texels(view, values), expected.reshape(SIZE), atol=1e-12)
    assert to_texels(view, np.ones(60)).sum() == pytest.approx(60, rel=1e-6)


# Evidence


def test_a_texel_is_known_from_three_lights_on():
    lights = (*LAMPS, DirectionalLight(unit(0.3, 1.0, 0.9), np.ones(3, np.float32)))
    number = np.arange(30) % 5  # of lights that reach a texel
    order = np.argsort(np.random.default_rng(0).random((4, 30)), axis=0)
    lit = order < number
    view = one_to_one(lights, lit)
    unknowns = guess(PhongShading(), lights, bent=0.1)
    evidence = gather_evidence(task_of(view, unknowns, noise=0.01), unknowns)
    np.testing.assert_array_equal(evidence.lights.ravel(), number)
    np.testing.assert_array_equal(evidence.known.ravel(), number >= 3)
    assert evidence.seen.all()
    finite = np.isfinite(evidence.standard_error).ravel()
    np.testing.assert_array_equal(finite, number >= 2)  # a gray light alone tells one number
    assert (evidence.standard_error[np.isfinite(evidence.standard_error)] > 0).all()


def test_a_texel_is_seen_from_half_a_pixel_on():
    view = one_to_one(LAMPS)
    shares = np.linspace(0.05, 0.95, 30).astype(np.float32)
    weights = np.zeros((4, 30), np.float32)
    weights[0], weights[1] = shares, 0
    view = eqx.tree_at(lambda v: v.weights, view, jnp.asarray(weights))
    np.testing.assert_array_equal(seen_texels(view).ravel(), shares >= 0.5)
    unknowns = guess(PhongShading(), LAMPS)
    evidence = gather_evidence(task_of(view, unknowns), unknowns)
    np.testing.assert_array_equal(evidence.seen.ravel(), shares >= 0.5)
    assert np.isinf(evidence.standard_error[~evidence.seen]).all()
    assert not evidence.known[~evidence.seen].any()


@pytest.mark.parametrize("sigma", [0.003, 0.03])
def test_the_noise_is_read_off_the_residuals_at_the_best_fit(sigma):
    """At the truth the residuals are the noise itself; a fit takes two numbers a texel."""
    view = studio(LAMPS, pixels=600)
    unknowns = guess(PhongShading(), LAMPS)
    evidence = gather_evidence(task_of(view, unknowns, noise=sigma), unknowns)
    residuals, texels = 3 * 3 * 600, evidence.seen.sum()
    expected = sigma * np.sqrt(residuals / (residuals - 2 * texels))
    assert evidence.noise == pytest.approx(expected, rel=0.01)  # measured 1e-4


def test_the_standard_error_is_the_error_of_repeated_trials():
    """With a pixel on each texel the least-squares solution is a 2x2 system for each."""
    sigma, trials = 1e-3, 400
    view = one_to_one(LAMPS)
    unknowns = guess(PhongShading(), LAMPS)
    information = texel_information(task_of(view, unknowns), unknowns)
    clean = task_of(view, unknowns)
    residuals = lambda s: jnp.stack(clean.residuals(Unknowns(s, unknowns.shading, unknowns.lights)))
    rows = np.asarray(quick(jax.jacfwd(residuals))(unknowns.slopes))
    rows = np.moveaxis(rows.reshape(9, 30, 30, 2)[:, np.arange(30), np.arange(30)], 1, 0)
    dirt = sigma * np.random.default_rng(0).standard_normal((30, 9, trials))
    steps = np.linalg.pinv(rows) @ dirt
    metric = information.metric.reshape(30, 2, 2)
    squared = np.einsum("tan,tab,tbn->tn", steps, metric, steps)
    expected = np.rad2deg(np.sqrt(squared.mean(axis=1)))
    evidence = gather_evidence(task_of(view, unknowns, noise=sigma), unknowns)
    found = evidence.standard_error.ravel() * sigma / evidence.noise
    assert expected.max() > 1.3 * expected.min()
    np.testing.assert_allclose(found, expected, rtol=0.15)  # measured 0.06
    # The same noise, seen in the residuals of one trial.
    assert evidence.noise == pytest.approx(sigma * np.sqrt(270 / 210), rel=0.15)


def test_without_a_lit_pixel_nothing_is_known():
    view = one_to_one(LAMPS, np.zeros((3, 30)))
    unknowns = guess(PhongShading(), LAMPS)
    evidence = gather_evidence(task_of(view, unknowns), unknowns)
    assert not evidence.known.any()
    assert evidence.lights.max() == 0
    assert evidence.seen.all()
    assert np.isinf(evidence.standard_error).all()
    assert evidence.noise == 0


# What the images cannot tell

MATTE = LambertShading(ambient=0.05)
GLOSSY = PhongShading(albedo=0.5, specular=0.3, shininess=4.0)


def unclear(model, names, *, lights=LAMPS):
    view = studio(lights, pixels=600)
    unknowns = guess(model, lights)
    return undetermined(task_of(view, unknowns), unknowns, names)


@pytest.mark.parametrize(
    ("model", "names"),
    [
        (MATTE, []),
        (MATTE, ["albedo"]),
        (MATTE, ["ambient"]),
        (MATTE, ["light.color"]),
        (GLOSSY, ["albedo"]),
        (GLOSSY, ["albedo", "specular", "shininess"]),
        (GLOSSY, ["light.color"]),
        (GLOSSY, ["light.direction"]),
        (GLOSSY, ["albedo", "light.color"]),  # the highlight gives the light away
    ],
)
def test_what_the_images_tell_is_not_called_undetermined(model, names):
    assert unclear(model, names) == []


@pytest.mark.parametrize(
    ("model", "names", "named"),
    [
        (MATTE, ["albedo", "light.color"], ["albedo", "light 1 color", "light 3 color"]),
        (MATTE, ["light.direction"], ["light 2 direction"]),
        (GLOSSY, ["albedo", "specular", "light.color"], ["albedo", "specular", "light 2 color"]),
    ],
)
def test_a_mix_that_gives_the_same_images_is_called_undetermined(model, names, named):
    sentences = " ".join(unclear(model, names))
    for name in (*named, "the map", "another mix gives the same images"):
        assert name in sentences


def test_brighter_lights_on_a_darker_surface_are_indeed_the_same_images():
    view, bright = studio(LAMPS, pixels=600), 2.0
    unknowns = guess(MATTE, LAMPS)
    other = eqx.tree_at(lambda u: u.shading.albedo, unknowns, unknowns.shading.albedo / bright)
    colors = lambda u: [light.color for light in u.lights]
    other = eqx.tree_at(colors, other, [bright * color for color in colors(other)])
    assert_close(images(view, other), images(view, unknowns))


def test_a_number_that_no_pixel_shows_is_said_to_change_nothing():
    mirrorless = PhongShading(specular=0.0, shininess=4.0)
    assert unclear(mirrorless, ["shininess"]) == ["shininess: changes nothing"]
    view = studio(LAMPS, pixels=600)
    view = eqx.tree_at(lambda v: v.lit, view, view.lit.at[1].set(0))
    unknowns = guess(GLOSSY, LAMPS)
    sentences = undetermined(task_of(view, unknowns), unknowns, ["light.color"])
    assert sentences
    assert {s.partition(":")[0] for s in sentences} == {"light 2 color"}


def test_a_name_that_does_not_exist_is_refused():
    with pytest.raises(ValueError, match=r"--free albdo: no such number; did you mean 'albedo'\?"):
        unclear(GLOSSY, ["albdo"])
    with pytest.raises(ValueError, match=r"choose from: .*light\.color"):
        unclear(GLOSSY, ["roughness"])
