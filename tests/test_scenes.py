"""The embedded scenes show what their docstrings say."""

import jax
import numpy as np
import pytest

from experiments.scene import Material
from experiments.scenes import EMBEDDED, SHADOW_SCENES, load_scene
from experiments.scenes.failure_scenes import FAILURE_SCENES
from shadows.area_lights import AreaLight
from shadows.bias import CombinedBias, ConstantBias, SlopeBias
from shadows.lights import DirectionalLight, PointLight, SpotLight
from shadows.projector import Projector
from tangentspace.environment import sample_cube_map
from tangentspace.mikktspace import with_tangents
from tangentspace.normal_map import decode_normals
from tangentspace.pixel_frame import perturb_normal
from tangentspace.texture import clamp, repeat, sample_bilinear

from .studies import study
from .test_mtl import texels_of
from .tools import assert_close

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
    if isinstance(light, PointLight):
        assert np.isfinite(light.position).all()
        return
    assert isinstance(light, DirectionalLight | SpotLight | Projector | AreaLight)
    np.testing.assert_allclose(np.linalg.norm(light.direction), 1, rtol=1e-6)


@pytest.mark.parametrize("name", SHADOW_SCENES)
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
    with pytest.raises(ValueError, match=f"choose from: {', '.join(EMBEDDED | FAILURE_SCENES)}$"):
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


@pytest.mark.parametrize("name", SHADOW_SCENES)
def test_scenes_of_shadows_have_no_maps_to_pay_for(name):
    scene = load_scene(name)
    assert scene.materials == (Material(),)
    assert scene.environment is None


def cells(scene):
    """Return the faces of each of the 8 real and of the 8 flat cells."""
    faces = np.asarray(scene.mesh.faces)
    return [np.split(faces[scene.face_materials == kind], 8) for kind in (0, 1)]


def test_normal_cells_are_turned_and_mirrored_in_all_ways():
    scene = load_scene("normal-cells")
    positions, uvs = np.asarray(scene.mesh.positions), np.asarray(scene.mesh.uvs)
    found = set()
    for real, flat in zip(*cells(scene), strict=True):
        axes = []
        for faces in (real, flat):
            used = np.unique(faces)
            middle = positions[used].mean(axis=0)
            design = np.c_[uvs[used] - 0.5, np.ones(len(used))]
            axes.append(np.linalg.lstsq(design, positions[used] - middle, rcond=None)[0][:2, :2])
        np.testing.assert_allclose(axes[0], axes[1], atol=1e-4)  # du and dv in x, y; 1e-8
        np.testing.assert_allclose(np.abs(axes[1]).sum(axis=1), 0.5, atol=1e-6)
        found.add(tuple(np.sign(np.round(axes[1], 3)).astype(int).ravel()))
        # The flat cell lies to the right of the real one, in the plane of its edge.
        right = positions[flat].mean(axis=(0, 1)) - positions[real].mean(axis=(0, 1))
        assert 0.4 < right[0] < 0.6
        assert np.ptp(positions[flat][..., 2]) == 0
        assert np.ptp(positions[real][..., 2]) > 0.07
    assert len(found) == 8
    determinants = [a * d - b * c for a, b, c, d in found]
    assert sorted(determinants) == [-1] * 4 + [1] * 4


def test_normal_cells_maps_hold_the_normals_of_the_real_cells():
    scene = load_scene("normal-cells")
    mesh = scene.mesh
    texels = texels_of(scene.materials[1].normal_texture)
    flat = mesh._replace(faces=np.concatenate(cells(scene)[1]))
    tangents = with_tangents(flat).tangents
    assert tangents is not None
    for real, faces in zip(*cells(scene), strict=True):
        used = np.unique(real)
        leaning = decode_normals(
            sample_bilinear(texels, mesh.uvs[used], wrap_u=clamp, wrap_v=clamp)
        )
        frame = np.repeat(np.asarray(tangents)[faces[:1, 0]], len(used), axis=0)
        normals = perturb_normal(leaning, frame, mesh.normals[np.repeat(faces[0, 0], len(used))])
        off = np.linalg.norm(np.asarray(normals) - mesh.normals[used], axis=1)
        assert np.rad2deg(off).max() < 0.1  # measured 0.042
        assert np.rad2deg(np.arccos(mesh.normals[used, 2].min())) > 30


def test_no_bump_of_normal_cells_throws_a_shadow():
    scene = load_scene("normal-cells")
    light = to_sun(scene)
    steepest = np.arccos(np.asarray(scene.mesh.normals)[:, 2].min())
    assert steepest < np.pi / 2 - np.arccos(light[2]) - np.deg2rad(10)


def test_bumpy_tiles_its_normal_map_without_a_seam():
    scene = load_scene("bumpy")
    texture = scene.materials[1].normal_texture
    texels = texels_of(texture)
    assert texture.wrap_u is texture.wrap_v is repeat
    normals = 2 * texels - 1
    np.testing.assert_allclose(np.linalg.norm(normals, axis=-1), 1, atol=1e-6)
    assert_close(normals[[0, -1]], np.broadcast_to(np.float32([0, 0, 1]), (2, 64, 3)))
    assert_close(normals[:, [0, -1]], np.broadcast_to(np.float32([0, 0, 1]), (64, 2, 3)))
    assert np.rad2deg(np.arccos(normals[..., 2].min())) > 35
    uvs = np.asarray(scene.mesh.uvs)[4:]  # behind the floor's
    np.testing.assert_allclose(np.ptp(uvs, axis=0), [12, 5], rtol=1e-6)
    # Knobs rise: on the right of the middle the normals lean to the right, above it up.
    assert normals[32, 44, 0] > 0.3
    assert normals[20, 32, 1] > 0.3


def test_mirror_stands_under_its_own_sun():
    scene = load_scene("mirror")
    assert scene.environment is not None
    assert [material.reflectivity for material in scene.materials] == [None, 0.8]
    directions = np.array([to_sun(scene), [0, 1, 0], [0, -1, 0]], np.float32)
    sun, zenith, ground = np.asarray(sample_cube_map(scene.environment, directions))
    assert sun.min() > 2.5
    assert zenith[2] > 2 * zenith[0]
    assert ground.max() < 0.3
    assert scene.environment.faces.dtype == np.float32


def test_displaced_rises_from_a_level_sheet():
    scene = load_scene("displaced")
    (material,) = scene.materials
    heights = texels_of(material.height_texture)
    assert heights.shape == (128, 128, 1)
    assert heights.min() >= 0
    edge = np.concatenate([heights[[0, -1]].ravel(), heights[:, [0, -1]].ravel()])
    assert edge.max() < 0.05 < 0.9 < heights.max() < 1.1  # the border stays down
    assert np.ptp(scene.mesh.positions[:, 1]) == 0
    assert np.unravel_index(heights.argmax(), heights.shape)[0] > 64  # low in the image: small v
