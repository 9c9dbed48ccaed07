"""The scenes on which a normal map is recovered: what they promise."""

import jax.numpy as jnp
import numpy as np
import pytest

from experiments.scenes import load_scene
from experiments.scenes.relief import relief, relief_texels, shadowed_relief
from experiments.truth.rays import Occluders, trace_visibility
from shadows.lights import DirectionalLight
from shadows.transforms import transform_points
from tangentspace.texture import clamp


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
    np.testing.assert_allclose(up, right, atol=1e-5)  # measured 2e-7


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


def middles(mesh, faces):
    """Return the faces' middles and their unit normals."""
    corners = mesh.positions[mesh.faces[faces]].astype(np.float64)
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return corners.mean(axis=1), across / np.linalg.norm(across, axis=1, keepdims=True)


@pytest.mark.parametrize("make", [relief, shadowed_relief])
def test_only_posts_throw_shadows_on_the_patch(make):
    scene = make(size=16)
    patch = np.flatnonzero(scene.face_materials == 0)
    occluders = Occluders(scene.mesh.positions, scene.mesh.faces)
    for light in scene.lights:
        lit = trace_visibility(*middles(scene.mesh, patch), patch, light, occluders)
        if make is relief:
            assert lit.all()
        else:
            assert 0.005 < 1 - lit.mean() < 0.2  # measured 0.03


def test_the_camera_sees_all_of_the_patch_and_nothing_hides_it():
    scene = relief(size=16)
    points, normals = middles(scene.mesh, slice(None))
    clip = np.asarray(transform_points(scene.camera.clip_from_world(1.0), scene.mesh.positions))
    assert np.abs(clip[:, :2] / clip[:, 3:]).max() < 1
    assert (np.abs(clip[:, :2] / clip[:, 3:]).max(axis=0) > 0.8).all()
    eye = np.asarray(scene.camera.to_camera(jnp.asarray(points, jnp.float32)))
    assert np.sum(eye * normals, axis=1).min() > 0.5
