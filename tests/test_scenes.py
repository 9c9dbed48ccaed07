"""The embedded scenes show what their docstrings say."""

import jax
import numpy as np
import pytest

from experiments.scenes import EMBEDDED, load_scene
from shadows.bias import CombinedBias, ConstantBias, SlopeBias
from shadows.lights import DirectionalLight, SpotLight

from .studies import study

ZERO = CombinedBias()
FLOOR = 0.0


@pytest.fixture(autouse=True)
def _single_precision():
    with jax.enable_x64(False):
        yield


def to_sun(scene):
    """Return the direction to the scene's parallel light."""
    light = scene.lights[0]
    assert isinstance(light, DirectionalLight)
    return np.asarray(light.direction)


def surface(of):
    """Return positions, normals towards the camera and whether there is a surface."""
    seen = of.unbiased.surface
    return np.asarray(seen.position), np.asarray(seen.face_normal), np.asarray(seen.covered)


@pytest.mark.parametrize("name", EMBEDDED)
def test_a_scene_is_found_by_its_name_and_always_the_same(name):
    scene, again = load_scene(name), EMBEDDED[name]()
    assert scene.name == name
    for one, other in zip(jax.tree.leaves(scene), jax.tree.leaves(again), strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("name", EMBEDDED)
def test_a_scene_is_sound(name):
    scene = load_scene(name)
    positions, _, faces, *_ = scene.mesh
    assert np.isfinite(positions).all()
    assert positions.dtype == np.float32
    assert set(np.unique(faces)) == set(range(len(positions)))
    assert len(scene.face_materials) == len(faces)
    assert (positions[:, 1] >= FLOOR - 1e-6).all()
    light = scene.lights[0]
    assert isinstance(light, DirectionalLight | SpotLight)
    np.testing.assert_allclose(np.linalg.norm(light.direction), 1, rtol=1e-6)


@pytest.mark.parametrize("name", EMBEDDED)
def test_zero_bias_shows_acne_and_a_camera_sees_light_and_shadow(name):
    errors = study(name).errors(ZERO)
    assert errors.acne > 0.2  # measured 0.49 to 0.51
    assert errors.lit > 0.2 * study(name).facing.size
    assert (errors.dark > 100) == (name != "grazing-plane")


@pytest.mark.parametrize(("name", "hint"), [("spehre", "'sphere'"), ("thinbox", "'thin-box'")])
def test_a_name_that_is_nearly_right_gets_a_suggestion(name, hint):
    with pytest.raises(ValueError, match=f"scene '{name}': .*did you mean {hint}?"):
        load_scene(name)


def test_a_name_that_is_nothing_lists_all_scenes():
    with pytest.raises(ValueError, match=f"choose from: {', '.join(EMBEDDED)}$"):
        load_scene("xyz")


def test_what_is_no_embedded_scene_is_a_file(tmp_path):
    (tmp_path / "mesh.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    assert load_scene(str(tmp_path / "mesh.obj")).name == "mesh"
    with pytest.raises(ValueError, match=r"sphere\.obj: no such file"):
        load_scene("sphere.obj")
    (tmp_path / "mesh").write_text("v 0 0 0")
    with pytest.raises(ValueError, match="unknown kind of file"):
        load_scene(str(tmp_path / "mesh"))


def test_grazing_plane_is_a_bare_floor_under_low_light():
    plane = study("grazing-plane")
    assert np.ptp(load_scene("grazing-plane").mesh.positions[:, 1]) == 0
    elevation = np.rad2deg(np.arcsin(to_sun(plane.scene)[1]))
    np.testing.assert_allclose(elevation, 8, rtol=1e-5)
    assert plane.truth[surface(plane)[2]].all()
    assert plane.errors(CombinedBias((SlopeBias(2.0),))).error == 0


def test_thin_box_loses_shadow_to_a_bias_larger_than_its_boxes():
    box = study("thin-box")
    position, normal, covered = surface(box)
    # The shadow that the plate, 0.04 thick, throws on the floor behind it.
    floor = covered & (position[..., 1] < 1e-4) & (normal[..., 1] > 0.9)
    contact = floor & ~box.truth & (position[..., 2] > 1.1)
    assert contact.sum() > 20
    small, large = (
        box.visibility(CombinedBias((ConstantBias(length),)))[contact].mean()
        for length in (0.01, 0.1)
    )
    assert small < 0.2  # measured 0.11, along the edge
    assert large > 0.9  # measured 1


def test_sphere_shows_every_slope_towards_the_light():
    ball = study("sphere")
    _, normal, covered = surface(ball)
    cosine = normal[covered] @ to_sun(ball.scene)
    counts, _ = np.histogram(cosine[cosine > 0], bins=10, range=(0, 1))
    assert (counts > 0).all()
    heights = load_scene("sphere").mesh.positions[:, 1]
    np.testing.assert_allclose(heights[heights > FLOOR].min(), 0.2, atol=1e-3)  # it hovers


def test_stacked_has_three_depths_behind_one_texel():
    stack = study("stacked")
    position, normal, covered = surface(stack)
    up = covered & (normal[..., 1] > 0.99) & ~stack.truth
    low_top = up & (np.abs(position[..., 1] - 0.32) < 1e-3)
    assert low_top.sum() > 20  # the low plate lies in the shadow of the high one
    # Of the shadowed points of the low plate, some have the floor behind them: the ray goes on
    # down past the plate and meets the floor within the scene.
    ray = to_sun(stack.scene)
    foot = position[low_top] - position[low_top][:, 1:2] / ray[1] * ray
    assert (np.abs(foot[:, ::2]) < 2).all()


def test_spot_has_texels_that_grow_with_distance():
    spot = study("spot")
    light = spot.scene.lights[0]
    assert isinstance(light, SpotLight)
    length = np.asarray(spot.trial.receiver.texel_length)
    distance = np.linalg.norm(np.asarray(spot.trial.receiver.position) - light.position, axis=-1)
    assert np.corrcoef(length, distance)[0, 1] > 0.95
    assert length.max() > 1.4 * length.min()


def test_default_shows_acne_at_zero_bias_and_leaks_at_a_large_one():
    default = study("default")
    small, large = (default.errors(CombinedBias((SlopeBias(f),))) for f in (1.75, 16 * 1.75))
    assert small.error < 0.01
    assert large.leak > 0.05
    assert large.leak > 5 * small.leak
