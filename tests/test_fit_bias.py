"""The fit, the sweep that judges it, and the study on which both work."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import experiments.bias_fits.fit_bias
from experiments.bias_fits.bias_space import BiasSpace, soft_residual
from experiments.bias_fits.bias_study import ImageGoal, TruthGoal, with_target
from experiments.bias_fits.fit_bias import fit_bias
from experiments.bias_fits.sweep_bias import sweep_bias
from experiments.files.images import read_image, write_exr, write_png
from experiments.metrics import shadow_errors
from experiments.scene import Material, Scene
from experiments.scenes import SHADOW_SCENES
from shadows.bias import CombinedBias, ConstantBias, NormalOffsetBias, SlopeBias
from shadows.compare import HardCompare
from shadows.filters import NearestFilter
from shadows.lights import DirectionalLight
from shadows.transforms import PerspectiveCamera, look_at
from shadows.visibility import surface_visibility
from shadows.window_filters import BilinearFilter
from tangentspace.shapes import merge, plane

from .studies import BOTH, study, study_of, thinned
from .tools import assert_close

LINEAR = BilinearFilter()


@pytest.fixture(autouse=True)
def _single_precision():
    with jax.enable_x64(False):
        yield


@functools.cache
def outcome(name):
    """Return the trial of an embedded scene, thinned, with its fit and sweep."""
    trial = thinned(study(name).trial)
    return trial, fit_bias(trial, BOTH, LINEAR), sweep_bias(trial, BOTH, LINEAR)


def hard_error(trial, bias, filter=LINEAR):
    return float(jax.jit(lambda trial, bias: trial.error(bias, filter))(trial, bias))


def flat_scene(*heights, light=(0.0, 1.0, 0.0)):
    """Return squares one above the other, seen from just below the highest."""
    squares = [plane(4.0) for _ in heights]
    squares = [
        square._replace(positions=square.positions + np.array([0, height, 0], np.float32))
        for square, height in zip(squares, heights, strict=True)
    ]
    mesh = merge(*squares)
    eye, target = np.array([0.0, 0.9, 1.0]), np.array([0.0, 0.0, 0.0])
    view = np.asarray(look_at(eye, target, np.array([0.0, 1.0, 0.0])), np.float32)
    camera = PerspectiveCamera(view, 0.7, 0.1, 20.0)
    direction = np.array(light, np.float32)
    lights = (DirectionalLight(direction / np.linalg.norm(direction)),)
    return Scene("flat", mesh, np.zeros(len(mesh.faces), np.int32), (Material(),), camera, lights)


# Known answers


@pytest.mark.parametrize("name", SHADOW_SCENES)
def test_a_fit_is_as_good_as_the_best_of_the_sweep_at_a_fraction_of_its_cost(name):
    trial, fit, sweep = outcome(name)
    assert hard_error(trial, CombinedBias()) > 0.3
    assert fit.error <= 1.02 * sweep.error  # measured 1 at all
    assert fit.error < 0.01
    assert sweep.converged
    assert fit.steps <= 60  # measured 10 to 21
    assert fit.evaluations <= sweep.evaluations / 5
    assert [level.softness for level in fit.levels] == sorted(
        (level.softness for level in fit.levels), reverse=True
    )


@pytest.mark.parametrize("name", ["default", "spot"])
def test_a_fit_says_the_error_of_the_bias_that_it_returns(name):
    trial, fit, sweep = outcome(name)
    for found in (fit, sweep):
        assert_close(np.float32(hard_error(trial, found.bias)), found.error)
        constant, slope = map(float, jax.tree.leaves(found.bias))
        values = {"constant.length": constant, "slope.factor": slope}
        assert found.values == pytest.approx(values, rel=1e-6)
    assert fit.units == {"constant.length": "world length", "slope.factor": "texel footprints"}


def test_a_fit_keeps_the_best_of_its_way():
    trial, _, _ = outcome("default")
    fit = fit_bias(trial, BOTH, LINEAR, levels=(0.3, 3000.0))  # far too soft in the end
    good, bad = (level.error for level in fit.levels)
    assert fit.error <= good < 0.02 < bad


def test_a_sweep_tries_the_best_bias_of_its_grid():
    _, _, sweep = outcome("sphere")
    assert sweep.points.shape == (len(sweep.errors), 2)
    assert sweep.errors.min() >= sweep.error
    assert sweep.errors.max() > 0.3
    assert sweep.evaluations >= len(sweep.errors)


def test_a_sweep_goes_as_far_as_the_best_bias_is():
    """A shadow that 40 footprints of bias would not lose, and a target that has lost it."""
    box = study("thin-box")
    length = 40 * float(box.trial.footprint_length)
    far = CombinedBias((ConstantBias(length),))
    trial = with_target(box, box.picture(box.visibility(far))).trial
    sweep = sweep_bias(trial, CombinedBias((ConstantBias(),)), LINEAR)
    assert sweep.error <= 0.02 * hard_error(trial, CombinedBias())
    assert sweep.values["constant.length"] == pytest.approx(length, rel=0.02)


@pytest.mark.parametrize("form", [".exr", ".png"])
def test_a_fit_to_an_image_finds_the_bias_that_it_was_made_with(tmp_path, form):
    default = study("default")
    known = CombinedBias((ConstantBias(0.002), SlopeBias(1.5)))
    color = default.picture(default.visibility(known))
    path = tmp_path / f"target{form}"
    if form == ".exr":
        write_exr(path, {name: color[..., k] for k, name in enumerate("RGB")})
    else:
        write_png(path, color)
    target = with_target(default, read_image(path), limit=np.inf if form == ".exr" else 1.0)
    fit = fit_bias(target.trial, BOTH, LINEAR)
    sweep = sweep_bias(target.trial, BOTH, LINEAR)
    assert fit.error <= 1.02 * sweep.error  # measured 0.51 and 0.9: the bias is not on the grid
    assert fit.error <= 0.05 * target.objective(CombinedBias())
    # On the floor, most of the picture, the two add up.
    step = float(default.trial.footprint_length)
    total = fit.values["constant.length"] / step + fit.values["slope.factor"]
    assert total == pytest.approx(0.002 / step + 1.5, abs=0.05)  # measured 0.01


def test_a_bias_that_moves_the_texel_is_fitted():
    trial = thinned(study("thin-box").trial)
    bias = CombinedBias((NormalOffsetBias(),))
    fit, sweep = fit_bias(trial, bias, LINEAR), sweep_bias(trial, bias, LINEAR)
    assert fit.error <= 1.02 * sweep.error
    assert fit.error < 0.02 * hard_error(trial, CombinedBias())
    assert 0.3 < fit.values["normal-offset.offset"] < 1.5


def test_nearest_lookup_is_fitted_and_wants_half_the_slope():
    linear = study("grazing-plane").trial
    taps = NearestFilter().read(linear.shadow_map, linear.receiver)
    trial = thinned(linear._replace(reading=taps))
    bias = CombinedBias((SlopeBias(),))
    fit = fit_bias(trial, bias, NearestFilter())
    assert fit.error == 0
    assert fit.values["slope.factor"] <= 1.25  # measured 1.16; one in 32 of the first solution
    assert hard_error(trial, CombinedBias((SlopeBias(0.8),)), NearestFilter()) > 0.005


def test_a_number_that_is_not_free_keeps_its_value():
    trial, _, _ = outcome("default")
    bias = CombinedBias((ConstantBias(0.0005), SlopeBias(7.0)))
    for found in (
        fit_bias(trial, bias, LINEAR, free=["slope.factor"]),
        sweep_bias(trial, bias, LINEAR, free=["slope.factor"]),
    ):
        assert [*found.values] == ["slope.factor"]
        constant, slope = map(float, jax.tree.leaves(found.bias))
        assert constant == np.float32(0.0005)
        assert 0.5 < slope < 5
        assert_close(np.float32(hard_error(trial, found.bias)), found.error)


# What the data does not tell


@pytest.mark.parametrize(
    ("name", "told"),
    [("grazing-plane", False), ("default", True), ("thin-box", True), ("sphere", True)],
)
def test_a_fit_says_what_the_data_cannot_tell_apart(name, told):
    said = outcome(name)[1].untold
    if told:
        assert said == ()
        return
    (sentence,) = said
    for word in ("cannot tell", "constant.length", "slope.factor"):
        assert word in sentence


def test_one_number_is_told_where_two_are_not():
    trial, _, _ = outcome("grazing-plane")
    assert fit_bias(trial, BOTH, LINEAR, free=["slope.factor"]).untold == ()


def test_where_everything_is_dark_no_bias_is_needed_and_it_is_said():
    dark = study_of(flat_scene(0.0, 1.0))
    assert not dark.truth.any()
    fit = fit_bias(thinned(dark.trial), BOTH, LINEAR)
    assert fit.error == 0
    assert [*fit.values.values()] == [0, 0]
    (sentence,) = fit.untold
    assert sentence.startswith("the data does not depend on constant.length or slope.factor")


def test_where_everything_is_lit_a_fit_is_finite_and_says_what_is_not_told():
    lit = study_of(flat_scene(0.0))
    assert lit.truth[np.asarray(lit.unbiased.surface.covered)].all()
    fit = fit_bias(thinned(lit.trial), BOTH, LINEAR)
    assert fit.error == 0
    assert np.isfinite([*fit.values.values()]).all()
    assert len(fit.untold) == 1


# Errors


@pytest.mark.parametrize("search", [fit_bias, sweep_bias])
@pytest.mark.parametrize(
    ("bias", "free", "says"),
    [
        (CombinedBias(), None, "has no numbers to fit"),
        (BOTH, ["slope.facto"], "free slope.facto: .* did you mean 'slope.factor'"),
        (BOTH, ["slope.factor", "x"], "free x: .* choose from: constant.length, slope.factor"),
        (BOTH, [], "free: names no number"),
        (CombinedBias((SlopeBias(), SlopeBias())), None, "slope.factor twice"),
    ],
)
def test_numbers_that_cannot_be_fitted_are_named(search, bias, free, says):
    trial, _, _ = outcome("default")
    with pytest.raises(ValueError, match=says):
        search(trial, bias, LINEAR, free=free)


def test_a_target_of_another_size_or_with_holes_is_refused():
    default = study("default")
    with pytest.raises(ValueError, match=r"expected height x width \(128, 128\).*\(64, 128\)"):
        with_target(default, np.zeros((64, 128, 3), np.float32))
    with pytest.raises(ValueError, match="NaN"):
        with_target(default, np.full((128, 128, 3), np.nan, np.float32))


def test_a_view_without_a_lit_surface_is_refused():
    with pytest.raises(ValueError, match="flat: no visible surface faces the light"):
        study_of(flat_scene(0.0, light=(0.0, -1.0, 0.0)))


# Goals


def test_a_trial_counts_what_the_metrics_count():
    default = study("default")
    goal = default.trial.goal
    assert isinstance(goal, TruthGoal)
    rng = np.random.default_rng(0)
    visibility = rng.choice(np.array([0, 0.25, 0.5, 0.75, 1], np.float32), len(goal.truth))
    image = np.zeros(default.facing.shape, np.float32)
    image[default.facing] = visibility
    errors = shadow_errors(image, default.truth, np.asarray(default.unbiased.surface.covered))
    assert_close(np.asarray(goal.error(jnp.asarray(visibility))), errors.error)
    zero = default.errors(CombinedBias())
    assert_close(np.float32(hard_error(default.trial, CombinedBias())), zero.error)
    assert_close(np.float32(default.objective(CombinedBias())), zero.error)


@pytest.mark.parametrize(
    "bias",
    [
        CombinedBias(),
        CombinedBias((ConstantBias(0.01), SlopeBias(1.0))),
        CombinedBias((NormalOffsetBias(2.0),)),
        CombinedBias((NormalOffsetBias(3.0), SlopeBias(0.5))),
    ],
)
def test_a_trial_sees_what_a_whole_rendering_shows(bias):
    default = study("default")
    surface, (shadow_map,) = default.unbiased.surface, default.unbiased.shadow_maps
    whole = jax.jit(
        lambda surface, shadow_map, bias: surface_visibility(
            surface,
            default.scene.lights[0],
            shadow_map,
            bias=bias,
            filter=LINEAR,
            compare=HardCompare(),
        )
    )(surface, shadow_map, bias)
    differ = np.abs(np.asarray(whole) - default.visibility(bias)) > 1e-6
    assert differ.mean() < 1e-3  # compiled apart, rounding decides between equal depths


def test_the_goal_of_an_image_is_its_difference_in_radiance():
    default = study("default")
    zero, known = CombinedBias(), CombinedBias((SlopeBias(2.0),))
    before, after = (default.picture(default.visibility(bias)) for bias in (zero, known))
    target = with_target(default, after)
    assert isinstance(target.trial.goal, ImageGoal)
    assert target.objective(known) < 1e-6
    rms = np.sqrt(np.mean((before - after)[default.facing].astype(np.float64) ** 2))
    assert_close(np.float32(target.objective(zero)), rms)


def test_a_target_that_saturates_hides_what_is_brighter():
    default = study("default")
    known = CombinedBias((SlopeBias(2.0),))
    color = default.picture(default.visibility(known))
    limit = float(0.5 * color.max())
    cut = np.minimum(color, np.float32(limit))
    assert with_target(default, cut, limit=limit).objective(known) < 1e-6
    assert with_target(default, cut).objective(known) > 0.01


# Derivatives and transformations


def test_forward_and_reverse_derivatives_agree_with_finite_differences():
    with jax.enable_x64(True):
        trial = jax.tree.map(
            lambda a: jnp.asarray(a, jnp.float64 if np.asarray(a).dtype == np.float32 else None),
            thinned(study("default").trial, 200),
        )
        space = BiasSpace.of(BOTH, LINEAR, trial)
        residual = lambda vector: soft_residual(vector, space, trial, jnp.asarray(0.5))
        point, step = jnp.array([0.7, 0.4]), 1e-6
        forward = np.asarray(jax.jit(jax.jacfwd(residual))(point))
        reverse = np.asarray(jax.jit(jax.jacrev(residual))(point))
        value = jax.jit(residual)
        central = np.stack(
            [(value(point + step * e) - value(point - step * e)) / (2 * step) for e in jnp.eye(2)],
            axis=-1,
        )
    assert forward.dtype == np.float64
    assert np.abs(forward).max() > 0.1
    assert_close(reverse, forward)
    np.testing.assert_allclose(central, forward, atol=1e-8)  # measured 2e-9


def test_the_residual_is_traced_once_for_all_levels(monkeypatch):
    traces = []

    def counted(*args):
        traces.append(args)
        return soft_residual(*args)

    monkeypatch.setattr(experiments.bias_fits.fit_bias, "soft_residual", counted)
    trial = thinned(study("default").trial, 301)  # a shape that no other test compiles
    fit_bias(trial, BOTH, LINEAR, levels=(1.0,))
    once = len(traces)
    assert once > 0
    fit = fit_bias(trial, BOTH, LINEAR, levels=(0.9, 0.5, 0.25, 0.1))
    assert len(fit.levels) == 4
    assert len(traces) == once


def test_a_fit_reports_every_level():
    trial, _, _ = outcome("default")
    said = []
    fit = fit_bias(trial, BOTH, LINEAR, levels=(1.0, 0.1), report=said.append)
    assert len(said) == len(fit.levels) == 2
    assert "softness 1" in said[0]
    assert fit.steps == sum(level.steps for level in fit.levels)


def test_zero_area_faces_change_nothing():
    scene = flat_scene(0.0, 1.0, light=(0.6, 1.0, 0.2))
    mesh = scene.mesh
    lone = mesh._replace(faces=np.concatenate([mesh.faces, np.array([[0, 0, 1]] * 3, np.int32)]))
    one, other = study_of(scene), study_of(scene._replace(mesh=lone))
    np.testing.assert_array_equal(one.truth, other.truth)
    for a, b in zip(jax.tree.leaves(one.trial), jax.tree.leaves(other.trial), strict=True):
        np.testing.assert_array_equal(a, b)
