"""The scenes on which a normal map is recovered: what they promise."""

import numpy as np
import pytest

from experiments.normal_map_evidence import seen_texels
from experiments.normal_map_information import to_texels
from experiments.relief import relief, relief_texels, shadowed_relief
from experiments.scenes import load_scene
from shadows.lights import DirectionalLight
from tangentspace.texture import clamp

from .test_fit_normal_map import SIDE, relief_study


def normals_of(texels):
    return 2.0 * texels.astype(np.float64) - 1


@pytest.mark.parametrize("size", [16, 32, 256])
def test_texels_are_unit_normals_that_look_up(size):
    texels = relief_texels(size)
    assert texels.shape == (size, size, 3)
    assert texels.dtype == np.float32
    assert texels.min() >= 0
    assert texels.max() <= 1
    normals = normals_of(texels)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=-1), 1, atol=1e-6)
    tilt = np.rad2deg(np.arccos(normals[..., 2]))
    assert tilt.max() <= 59.001
    np.testing.assert_array_equal(texels, relief_texels(size))


def test_the_map_is_steep_and_differs_everywhere():
    normals = normals_of(relief_texels(256))
    tilt = np.rad2deg(np.arccos(normals[..., 2]))
    assert tilt.max() == pytest.approx(59, abs=0.01)
    assert 15 < tilt.mean() < 40
    assert (tilt > 45).mean() > 0.02
    assert np.abs(normals[..., 0].mean()) < 0.01
    assert np.abs(normals[..., 1].mean()) < 0.01


@pytest.mark.parametrize("size", [16, 32])
def test_the_map_is_of_one_height_field_with_green_upwards(size):
    """Where nothing is too steep the slopes have no curl, with v growing up the image."""
    x, y, z = np.moveaxis(normals_of(relief_texels(size)), -1, 0)
    slope_u, slope_v = -x / z, -y / z
    up = np.roll(slope_u, 1, 0) - np.roll(slope_u, -1, 0)
    right = np.roll(slope_v, -1, 1) - np.roll(slope_v, 1, 1)
    assert np.abs(up).max() > 0.1
    np.testing.assert_allclose(up, right, atol=1e-5)  # measured CU


@pytest.mark.parametrize("make", [relief, shadowed_relief])
def test_scenes_are_lit_from_six_sides(make):
    scene = make(size=16)
    assert len(scene.lights) == 6
    assert all(isinstance(light, DirectionalLight) for light in scene.lights)
    towards = np.stack([light.direction for light in scene.lights]).astype(np.float64)
    np.testing.assert_allclose(np.linalg.norm(towards, axis=1), 1, atol=1e-6)
    np.testing.assert_allclose(towards[:, 1], np.sin(np.deg2rad(50)), atol=1e-6)
    turns = np.rad2deg(np.arctan2(towards[:, 0], towards[:, 2]))
    np.testing.assert_allclose(np.diff(turns) % 360, 60, atol=1e-4)
    assert all(np.array_equal(light.color, np.ones(3)) for light in scene.lights)


@pytest.mark.parametrize("make", [relief, shadowed_relief])
def test_the_patch_alone_is_mapped(make):
    scene = make(size=16)
    mapped, *others = scene.materials
    assert mapped.normal_texture.texels.shape == (16, 16, 3)
    assert (mapped.normal_texture.wrap_u, mapped.normal_texture.wrap_v) == (clamp, clamp)
    assert all(material.normal_texture is None for material in others)
    patch = np.unique(scene.mesh.faces[scene.face_materials == 0])
    uvs, positions = scene.mesh.uvs[patch], scene.mesh.positions[patch]
    assert (uvs.min(), uvs.max()) == (0, 1)
    np.testing.assert_allclose(uvs[:, 0], 0.5 + 0.5 * positions[:, 0], atol=1e-6)
    np.testing.assert_allclose(uvs[:, 1], 0.5 - 0.5 * positions[:, 2], atol=1e-6)
    normals = scene.mesh.normals[patch]
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-6)
    assert normals[:, 1].min() > 0.9
    assert normals[:, 1].min() < 0.99  # gently curved


def test_posts_stand_on_the_patch():
    plain, posts = relief(size=16), shadowed_relief(size=16)
    faces = posts.face_materials == 1
    assert not plain.face_materials.any()
    assert faces.sum() == 3 * 12
    tops = posts.mesh.positions[np.unique(posts.mesh.faces[faces])]
    assert tops[:, 1].min() == pytest.approx(0, abs=1e-6)
    assert 0.3 < tops[:, 1].max() < 1
    count = len(plain.mesh.positions)
    np.testing.assert_array_equal(posts.mesh.positions[:count], plain.mesh.positions)


@pytest.mark.parametrize("name", ["relief", "shadowed-relief"])
def test_scenes_are_found_by_name(name):
    scene = load_scene(name)
    assert scene.name == name
    assert scene.materials[0].normal_texture.texels.shape == (256, 256, 3)


def test_the_plain_patch_is_seen_and_lit_everywhere():
    seen = relief_study("relief").seen
    assert seen.visibility[:, seen.inside].all()
    assert seen_texels(seen.view).all()
    assert to_texels(seen.view, np.ones(seen.inside.sum())).min() > 1


def test_posts_throw_shadows_under_every_light_and_leave_three():
    seen = relief_study("shadowed-relief").seen
    dark = 1 - seen.visibility[:, seen.inside].mean(axis=1)
    assert (dark > 0.005).all()  # measured DK
    assert (dark < 0.2).all()
    reached = np.stack([to_texels(seen.view, lit) >= 0.5 for lit in np.asarray(seen.view.lit)])
    assert (reached.sum(axis=0) >= 3)[seen_texels(seen.view)].mean() > 0.99
    assert seen_texels(seen.view).sum() > 0.98 * SIDE**2
