"""The fit of a normal map: the map it finds, beside what, and from what it keeps its hands."""

import dataclasses
import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import experiments.normal_map_fits.fit_normal_map
from experiments.normal_map_fits.fit_normal_map import MapFit, objective
from experiments.normal_map_fits.normal_map_evidence import gather_evidence, undetermined
from experiments.normal_map_fits.normal_map_information import to_texels
from experiments.normal_map_fits.normal_map_study import (
    MapStudy,
    angles,
    errors_of,
    load_study,
    make_study,
    mapped_material,
    texels_of,
)
from experiments.normal_map_fits.normal_map_task import Task, Unknowns, free_leaves, free_names
from experiments.rendering.prepare_scene import prepare_scene
from experiments.scenes.relief import shadowed_relief
from shadows.lights import DirectionalLight, PointLight, SpotLight
from tangentspace.normal_map import (
    decode_normals,
    encode_normals,
    normals_from_slopes,
    slopes_from_normals,
)
from tangentspace.shading import BlinnPhongShading, LambertShading, PhongShading
from tangentspace.texture import Texture, clamp

from .test_normal_map_evidence import LAMPS, SIZE
from .test_normal_map_views import LIGHTS, float32, quick, studio, unit
from .tools import assert_close

IMAGE, SIDE = (64, 64), 32


@pytest.fixture(autouse=True)
def _single_precision():
    with jax.enable_x64(False):
        yield


def finished(fit, most=600):
    while not fit.converged and fit.steps < most:
        fit.advance(100)
    return fit


@functools.cache
def prepared():
    """The relief with posts on it, which throw shadows under each of its six lights."""
    with jax.enable_x64(False):
        return prepare_scene(shadowed_relief(size=SIDE), tangents=True)


@functools.cache
def relief_study(noise=0.0):
    with jax.enable_x64(False):
        return make_study(prepared(), PhongShading(), image_size=IMAGE, noise=noise)


@functools.cache
def relief_fit(noise=0.0):
    """Return the study, the task and the finished fit of the relief."""
    study = relief_study(noise)
    task = Task(study.seen.view, study.targets)
    return study, task, finished(MapFit(task, study.shading, study.lights))


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


# Six lights


def test_six_lights_without_noise_give_the_map():
    study, task, fit = relief_fit()
    evidence = gather_evidence(task, fit.unknowns)
    errors = errors_of(study, fit.unknowns.slopes)[evidence.known]
    assert fit.converged
    assert fit.steps <= 200  # measured 36 and 61
    assert evidence.known.mean() > 0.98
    assert errors.mean() <= 0.01  # measured 1e-4
    assert errors.max() <= 2  # measured 0.005
    flat = angles(study.truth, np.array([0.0, 0.0, 1.0]))
    assert flat.mean() > 10  # where it started


def test_one_percent_of_noise_gives_the_error_that_is_predicted():
    study, task, fit = relief_fit(0.01)
    evidence = gather_evidence(task, fit.unknowns)
    known = evidence.known
    errors = errors_of(study, fit.unknowns.slopes)[known]
    assert errors.mean() <= 1.5  # measured 0.17
    assert evidence.noise == pytest.approx(0.01, rel=0.03)  # measured 0.008
    assert 0.5 < rms(errors) / rms(evidence.standard_error[known]) < 2  # measured 1.25


def test_texels_in_shadow_are_told_by_fewer_lights_and_fitted_from_the_others():
    study, task, fit = relief_fit()
    evidence = gather_evidence(task, fit.unknowns)
    lit = np.asarray(task.view.lit)
    assert ((lit == 0).mean(axis=1) > 0.005).all()  # under every light
    some = evidence.known & (evidence.lights < 6)
    assert some.sum() > 30
    errors = errors_of(study, fit.unknowns.slopes)
    assert errors[some].mean() <= 0.01  # measured 0.0002
    assert (evidence.lights == 6).mean() > 0.8


def test_texels_that_no_pixel_shows_keep_their_start_to_the_bit():
    study, task, _ = relief_fit()
    pixels = task.view.lit.shape[1]
    hole = np.zeros((SIDE, SIDE), bool)
    hole[9:17, 12:23] = True
    inside = hole.ravel()[np.asarray(task.view.indices)].any(axis=0)
    # Pixels that show the hole become copies of others: so nothing is compiled again.
    chosen = np.where(inside, np.flatnonzero(~inside)[np.arange(pixels) % 100], np.arange(pixels))
    task = jax.tree.map(lambda a: a[..., chosen], task)
    slopes = 0.2 * np.random.default_rng(5).normal(size=(SIDE, SIDE, 2)).astype(np.float32)
    fit = finished(MapFit(task, study.shading, study.lights, slopes=jnp.asarray(slopes)))
    shown = to_texels(task.view, np.ones(pixels))
    assert not shown[hole].any()
    found = np.asarray(fit.unknowns.slopes)
    np.testing.assert_array_equal(found[shown == 0], slopes[shown == 0])
    evidence = gather_evidence(task, fit.unknowns)
    for flag in (evidence.seen, evidence.known, np.isfinite(evidence.standard_error)):
        assert not flag[shown == 0].any()
    errors = errors_of(study, fit.unknowns.slopes)
    assert errors[evidence.known & (shown > 2)].max() <= 2  # measured 0.004


def test_any_start_leads_to_the_same_map():
    study, task, fit = relief_fit()
    slopes = np.random.default_rng(0).normal(size=(SIDE, SIDE, 2))
    other = finished(
        MapFit(task, study.shading, study.lights, slopes=jnp.asarray(slopes, jnp.float32))
    )
    assert errors_of(study, other.start.slopes).mean() > 10
    known = gather_evidence(task, fit.unknowns).known
    assert errors_of(study, other.unknowns.slopes)[known].max() <= 0.05  # measured 0.005
    normals = [np.asarray(normals_from_slopes(f.unknowns.slopes)) for f in (fit, other)]
    assert angles(*normals)[known].max() <= 0.05  # measured 0.007


def test_a_fit_that_starts_at_the_truth_is_done():
    study, task, _ = relief_fit()
    slopes, _ = slopes_from_normals(study.truth.astype(np.float32))
    fit = MapFit(task, study.shading, study.lights, slopes=slopes)
    fit.advance(50)
    assert fit.converged
    assert fit.steps == 0
    np.testing.assert_array_equal(fit.unknowns.slopes, slopes)


def test_pixels_in_shadow_do_not_pull():
    study, task, fit = relief_fit()
    rng = np.random.default_rng(0)
    wild = rng.choice(np.float32([-1e6, -3, 0, 50, 1e6]), task.targets.shape)
    dark = np.asarray(task.view.lit)[:, None] == 0
    targets = jnp.asarray(np.where(dark, wild, task.targets))
    assert (np.asarray(targets) != np.asarray(task.targets)).mean() > 0.01
    other = MapFit(Task(task.view, targets), study.shading, study.lights)
    finished(other)
    assert other.steps == fit.steps
    np.testing.assert_array_equal(other.unknowns.slopes, fit.unknowns.slopes)


# Lights and materials of other kinds


MODELS = {
    "lambert": LambertShading(float32(0.9, 0.6, 0.4), ambient=0.05),
    "blinn-phong": BlinnPhongShading(specular=0.1, shininess=8.0),
}


def hills(seed=0, bent=0.3):
    """Return slopes of a map of the studio."""
    rng = np.random.default_rng(seed)
    return jnp.asarray(bent * rng.normal(size=(*SIZE, 2)), jnp.float32)


@quick
def images(view, slopes, model, lights):
    colors = view.colors(view.normals(view.look_up(slopes)), lights, model)
    return jnp.stack([jnp.stack(channels) for channels in colors])


def studio_task(model, lights, *, colored=False):
    view = studio(lights, pixels=600, map_size=SIZE, colored=colored)
    return Task(view, images(view, hills(), model, lights))


def map_errors(fit, truth):
    found, true = (np.asarray(normals_from_slopes(s)) for s in (fit.unknowns.slopes, truth))
    return angles(found, true)


@pytest.mark.parametrize("name", MODELS)
def test_colored_lights_of_all_kinds_on_a_colored_texture_give_the_map(name):
    assert {type(light) for light in LIGHTS} == {DirectionalLight, PointLight, SpotLight}
    task = studio_task(MODELS[name], LIGHTS, colored=True)
    fit = finished(MapFit(task, MODELS[name], LIGHTS))
    evidence = gather_evidence(task, fit.unknowns)
    errors = map_errors(fit, hills())
    assert evidence.known.mean() > 0.9
    assert errors[evidence.known].mean() <= 0.01  # measured 0.0010
    assert errors[evidence.known].max() <= 2  # measured 0.004


GLOSSY = PhongShading(albedo=0.5, specular=0.4, shininess=2.0)
MATTE = LambertShading(albedo=0.5, ambient=0.05)
JOINT = {
    "material and directions": (GLOSSY, ("albedo", "specular", "light.direction"), 0.01),
    "colors": (MATTE, ("light.color",), 0.001),
}


def begin(case):
    """Return a task and a fit that starts from wrong numbers, all those that are free."""
    rng = np.random.default_rng(3)
    model, names, _ = JOINT[case]
    start, lights = model, list(LAMPS)
    for name in names:
        if name.startswith("light."):
            field = name.removeprefix("light.")
            for k, light in enumerate(lights):
                value = getattr(light, field) + 0.15 * rng.normal(size=3).astype(np.float32)
                if field == "direction":
                    value = unit(*value)
                lights[k] = dataclasses.replace(light, **{field: value})
        else:
            start = dataclasses.replace(start, **{name: getattr(start, name) * 1.4})
    task = studio_task(model, LAMPS)
    return task, MapFit(task, start, lights, free=names)


@functools.cache
def joint_fit(case):
    task, fit = begin(case)
    return task, finished(fit, 1000)


@pytest.mark.parametrize("case", JOINT)
def test_numbers_are_recovered_beside_the_map(case):
    model, names, tolerance = JOINT[case]
    task, fit = joint_fit(case)
    truth = Unknowns(hills(), model, LAMPS)
    labels = []
    for label, where in free_leaves(truth, names):
        start, found, true = (np.asarray(where(u)) for u in (fit.start, fit.unknowns, truth))
        assert np.abs(start - true).max() > 0.05
        np.testing.assert_allclose(found, true, atol=tolerance)
        labels.append(label)
    assert len(labels) == sum(3 if name.startswith("light.") else 1 for name in names)
    assert map_errors(fit, truth.slopes).mean() <= 0.5  # measured 0.0009
    assert undetermined(task, fit.unknowns, names) == []


def test_what_is_not_free_stays_to_the_bit():
    for case, fixed in (("material and directions", GLOSSY), ("colors", MATTE)):
        _, fit = joint_fit(case)
        names = set(free_names(fixed, LAMPS)) - set(JOINT[case][1])
        assert len(names) == 3
        for label, where in free_leaves(fit.start, sorted(names)):
            found, start = (np.asarray(where(u)) for u in (fit.unknowns, fit.start))
            assert_close(found, start, ulps=2 if label.endswith("direction") else 0)


def test_directions_keep_unit_length():
    _, fit = joint_fit("material and directions")
    for light in fit.unknowns.lights:
        assert float(np.linalg.norm(light.direction)) == pytest.approx(1, abs=1e-6)


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("albdo", r"--free albdo: no such number; did you mean 'albedo'\?"),
        ("light.colour", r"did you mean 'light\.color'\?"),
        ("light.position", "--free light.position: no such number"),
        ("light 1 color", "no such number"),
        ("", "no such number"),
    ],
)
def test_a_name_that_does_not_exist_is_refused(name, says):
    with pytest.raises(ValueError, match=says):
        MapFit(studio_task(GLOSSY, LAMPS), GLOSSY, LAMPS, free=("albedo", name))


def test_names_are_those_of_the_model_and_of_its_lights():
    assert free_names(LambertShading(), LAMPS) == [
        "albedo",
        "ambient",
        "light.color",
        "light.direction",
    ]
    assert {"specular", "shininess", "light.position", "light.outer_angle"} <= set(
        free_names(GLOSSY, LIGHTS)
    )
    leaves = free_leaves(Unknowns(hills(), GLOSSY, LIGHTS), ["light.position", "shininess"])
    assert [label for label, _ in leaves] == ["light 2 position", "light 3 position", "shininess"]


# Stopping


def test_a_fit_stopped_and_continued_is_that_of_one_that_never_was(tmp_path):
    """Across two anchors, with numbers free beside the map."""
    (_, unstopped), (_, stopped) = begin("colors"), begin("colors")
    unstopped.advance(30)
    assert unstopped.steps == 30
    for steps in (13, 12):
        stopped.advance(steps)
        stopped.store(tmp_path / "state.eqx")
        _, stopped = begin("colors")
        stopped.restore(tmp_path / "state.eqx")
    assert stopped.steps == 25
    stopped.advance(5)
    assert stopped.steps == unstopped.steps
    for found, expected in zip(
        jax.tree.leaves(stopped.unknowns), jax.tree.leaves(unstopped.unknowns), strict=True
    ):
        np.testing.assert_array_equal(found, expected)


def test_the_state_of_a_fit_of_other_numbers_is_refused(tmp_path):
    task, fit = joint_fit("colors")
    fit.store(tmp_path / "state.eqx")
    other = MapFit(task, MATTE, LAMPS, free=("albedo",))
    before = np.asarray(other.unknowns.slopes)
    with pytest.raises(ValueError, match=r"state\.eqx: cannot be continued from"):
        other.restore(tmp_path / "state.eqx")
    np.testing.assert_array_equal(other.unknowns.slopes, before)


def test_the_objective_is_traced_once_whatever_the_steps(monkeypatch):
    traces = []

    def counted(*args):
        traces.append(args)
        return objective(*args)

    monkeypatch.setattr(experiments.normal_map_fits.fit_normal_map, "objective", counted)
    _, fit = begin("colors")
    fit.advance(1)
    assert fit.converged is False
    once = len(traces)
    assert once > 0
    for steps in (1, 5, 20):  # over an anchor
        fit.advance(steps)
    assert fit.steps == 27
    assert len(traces) == once


def test_what_is_left_of_the_loss_is_the_noise():
    _, task, fit = relief_fit(0.01)
    value = quick(lambda task, unknowns: jnp.sum(jnp.stack(task.residuals(unknowns)) ** 2))
    before, after = (float(value(task, u)) for u in (fit.start, fit.unknowns))
    assert after < 0.01 * before
    residuals = float(np.asarray(task.view.lit).sum()) * 3
    assert after == pytest.approx(1e-4 * (residuals - 2 * SIDE**2), rel=0.05)  # measured 0.003


# Studies


def test_made_images_are_those_of_the_map_and_dark_where_a_caster_hides_the_light():
    study = relief_study()
    assert len(study.images) == len(study.lights) == 6
    for image, visibility, values in zip(
        study.images, study.seen.visibility, np.asarray(study.targets), strict=True
    ):
        inside = study.seen.inside
        assert image.shape == (*IMAGE, 3)
        assert not image[~inside].any()
        np.testing.assert_array_equal(image[inside].T, values)
        np.testing.assert_allclose(image[inside & ~visibility], 0.1, rtol=1e-6)  # ambient
        assert image[inside & visibility].min() > 0.1


def test_noise_is_as_strong_as_told_and_the_same_every_time():
    clean, noisy = relief_study(), relief_study(0.01)
    difference = np.asarray(noisy.targets) - np.asarray(clean.targets)
    assert difference.std() == pytest.approx(0.01, rel=0.02)
    assert abs(difference.mean()) < 1e-4
    again = make_study(prepared(), PhongShading(), image_size=IMAGE, noise=0.01)
    np.testing.assert_array_equal(again.targets, noisy.targets)


def test_the_truth_is_the_map_and_errors_are_angles_to_it():
    study = relief_study()
    texels = shadowed_relief(size=SIDE).materials[0].normal_texture.texels
    np.testing.assert_allclose(study.truth, 2.0 * texels - 1, atol=1e-6)
    slopes, _ = slopes_from_normals(study.truth.astype(np.float32))
    assert errors_of(study, slopes).max() < 1e-4
    flat = errors_of(study, jnp.zeros((SIDE, SIDE, 2)))
    np.testing.assert_allclose(flat, np.rad2deg(np.arccos(study.truth[..., 2])), atol=1e-3)
    np.testing.assert_allclose(texels_of(slopes), texels, atol=1e-6)


def test_angles_are_exact_from_nothing_to_opposite():
    degrees = np.array([0, 1e-7, 1e-3, 1, 90, 179.9, 180])
    turned = np.deg2rad(degrees)
    normals = np.stack([np.sin(turned), 0 * turned, np.cos(turned)], axis=-1)
    found = angles(normals, np.array([0.0, 0.0, 1.0]))
    np.testing.assert_allclose(found, degrees, rtol=1e-6, atol=1e-12)


def test_a_scale_of_the_map_counts():
    """The truth is what the renderer shows, also where the material weakens its map."""
    scene = shadowed_relief(size=SIDE)
    look = dataclasses.replace(scene.materials[0], normal_scale=0.5)
    study = make_study(
        prepare_scene(scene._replace(materials=(look, scene.materials[1])), tangents=True),
        PhongShading(),
        image_size=IMAGE,
    )
    normals = 2.0 * scene.materials[0].normal_texture.texels - 1
    weaker = normals * [0.5, 0.5, 1]
    weaker /= np.linalg.norm(weaker, axis=-1, keepdims=True)
    np.testing.assert_allclose(study.truth, weaker, atol=1e-6)


def test_given_images_are_taken_as_they_are():
    study = relief_study()
    given = load_study(prepared(), PhongShading(), study.images[:4], shadow_margin=0)
    assert isinstance(given, MapStudy)
    assert given.truth is None
    assert len(given.lights) == 4
    np.testing.assert_array_equal(given.targets, study.targets[:4])
    np.testing.assert_array_equal(given.seen.view.lit, study.seen.view.lit[:4])
    assert given.seen.view.map_size == (SIDE, SIDE)
    other = load_study(prepared(), PhongShading(), study.images[:1], map_size=(5, 7))
    assert other.seen.view.map_size == (5, 7)
    assert int(other.seen.view.indices.max()) < 35


def test_pixels_that_the_format_cuts_off_do_not_count():
    study = relief_study()
    cut = [np.minimum(image, 1.0) for image in study.images[:2]]
    given = load_study(prepared(), PhongShading(), cut, limit=1.0, shadow_margin=0)
    bright = np.stack([image[study.seen.inside].max(axis=-1) >= 1 for image in study.images[:2]])
    assert 0.05 < bright.mean() < 0.9
    lit = np.asarray(given.seen.view.lit, bool)
    assert not lit[bright].any()
    before = np.asarray(study.seen.view.lit[:2], bool)
    assert lit[before & ~bright].mean() > 0.98  # all but those within one 8-bit level of white


BAD = {
    "more images than lights": (
        lambda images: [*images, images[0]],
        "--images: got 7 images, but shadowed-relief has 6",
    ),
    "sizes": (
        lambda images: [images[0], images[1][:, :-2]],
        r"--images: expected images of one size, got 64 x 62, 64 x 64",
    ),
    "NaN": (
        lambda images: [images[0], np.where(images[1] > 1, np.nan, images[1])],
        "--images: have pixels that are NaN or infinite",
    ),
    "infinite": (
        lambda images: [np.where(images[1] > 1, np.inf, images[1]).astype(np.float32)],
        "--images: have pixels that are NaN or infinite",
    ),
}


@pytest.mark.parametrize("flaw", BAD)
def test_images_that_cannot_be_used_are_refused(flaw):
    change, says = BAD[flaw]
    images = change(list(relief_study().images))
    with pytest.raises(ValueError, match=says) as refusal:
        load_study(prepared(), PhongShading(), images)
    assert "\n" not in str(refusal.value)


def test_a_scene_without_a_map_has_no_images_to_make():
    scene = prepared()
    look = dataclasses.replace(scene.materials[0], normal_texture=None)
    bare = scene._replace(materials=(look, scene.materials[1]))
    with pytest.raises(
        ValueError, match=r"shadowed-relief: has no normal map to make images from; .*--images"
    ):
        make_study(bare, PhongShading(), image_size=IMAGE)


def test_a_map_that_looks_down_is_refused():
    scene = shadowed_relief(size=SIDE)
    texels = scene.materials[0].normal_texture.texels.copy()
    texels[3, 4] = [0.5, 0.6, 0.1]
    look = dataclasses.replace(scene.materials[0], normal_texture=Texture(texels, clamp, clamp))
    scene = prepare_scene(scene._replace(materials=(look, scene.materials[1])), tangents=True)
    with pytest.raises(ValueError, match="relief: its normal map has normals that do not look up"):
        make_study(scene, PhongShading(), image_size=IMAGE)


def test_the_mapped_material_is_the_first_with_a_map():
    scene = shadowed_relief(size=SIDE)
    plain = dataclasses.replace(scene.materials[0], normal_texture=None)
    assert mapped_material(scene._replace(materials=(plain, plain, scene.materials[0]))) == 2
    assert mapped_material(scene._replace(materials=(plain, plain))) == 0
    assert np.abs(np.asarray(decode_normals(encode_normals(np.eye(3)))) - np.eye(3)).max() == 0
    assert eqx.tree_equal(plain, plain)
