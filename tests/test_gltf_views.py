"""Cameras and punctual lights of glTF scenes, and what stands in for missing ones."""

import jax.numpy as jnp
import numpy as np

from experiments.files.gltf import load_gltf
from shadows.lights import DirectionalLight, PointLight, SpotLight
from shadows.transforms import OrthographicCamera, PerspectiveCamera

from .gltf_files import SHEET, Builder, f32, quaternion, sheet_scene
from .tools import assert_close


def camera_scene(tmp_path, lens, **node):
    build = Builder()
    kind = next(iter(lens))
    build.add("cameras", {"type": kind, **lens})
    build.node(mesh=build.mesh(build.primitive()))
    build.node(camera=0, **node)
    return load_gltf(build.glb(tmp_path / "camera.glb"))


LENS = {"perspective": {"yfov": 0.7, "znear": 0.5, "zfar": 20.0, "aspectRatio": 2}}


def test_a_perspective_camera_looks_along_its_nodes_minus_z(tmp_path):
    """Turned by 90 degrees about y, -z of the node is -x of the world."""
    place = {"translation": [5, 0.5, 0], "rotation": quaternion([0, 1, 0], 90), "scale": [2, 3, 4]}
    scene = camera_scene(tmp_path, LENS, **place)
    camera = scene.camera
    assert isinstance(camera, PerspectiveCamera)
    numbers = np.array([camera.vertical_fov, camera.near, camera.far])
    assert_close(numbers, f32([0.7, 0.5, 20]))
    seen = np.asarray(camera.view_from_world) @ [0, 0.5, 1, 1]
    assert_close(seen, [-1, 0, -5, 1], ulps=64 * 2**29)  # float32 matrix
    assert len(scene.mesh.faces) == 2
    assert len(scene.lights) == 1


def test_a_camera_without_far_plane_sees_all_points(tmp_path):
    lens = {"perspective": {"yfov": 0.7, "znear": 0.5}}
    camera = camera_scene(tmp_path, lens, translation=[0, 0, 50]).camera
    assert 50 < camera.far < 60


def test_an_orthographic_camera(tmp_path):
    lens = {"orthographic": {"xmag": 3.0, "ymag": 2.0, "znear": 0.0, "zfar": 9.0}}
    camera = camera_scene(tmp_path, lens, translation=[0, 0, 4]).camera
    assert isinstance(camera, OrthographicCamera)
    assert_close(np.array([camera.half_height, camera.near, camera.far]), f32([2, 0, 9]))
    clip = np.asarray(camera.clip_from_world(1.5)) @ [3, 2, 4, 1]
    assert_close(clip, [1, 1, -1, 1], ulps=64 * 2**29)  # float32 matrix


def test_the_first_camera_of_the_tree_is_used(tmp_path):
    build = Builder()
    for fov in (0.3, 0.6):
        build.add("cameras", {"type": "perspective", "perspective": {"yfov": fov, "znear": 1}})
    second = build.node(camera=0)
    first = build.node(camera=1)
    shape = build.node(mesh=build.mesh(build.primitive()))
    build.document["scenes"] = [{"nodes": []}, {"nodes": [shape, first, second]}]
    build.document["scene"] = 1
    scene = load_gltf(build.glb(tmp_path / "a.glb"))
    assert isinstance(scene.camera, PerspectiveCamera)
    assert_close(scene.camera.vertical_fov, np.float32(0.6))
    assert "2 cameras: the first is used" in scene.notes


def test_light_without_camera_gets_a_camera_that_sees_the_mesh_and_no_floor(tmp_path):
    scene = sheet_scene(tmp_path)
    assert len(scene.mesh.faces) == len(scene.face_materials) == 2
    clip = np.c_[SHEET["POSITION"], np.ones(4)] @ np.asarray(scene.camera.clip_from_world(1.0)).T
    assert np.abs(clip[:, :3] / clip[:, 3:]).max() <= 1


def test_neither_camera_nor_light_gets_a_floor(tmp_path):
    build = Builder()
    build.node(mesh=build.mesh(build.primitive()))
    scene = load_gltf(build.glb(tmp_path / "a.glb"))
    assert len(scene.mesh.faces) == 4
    assert scene.mesh.uvs is not None
    assert scene.mesh.tangents is not None
    assert len(scene.mesh.positions) == len(scene.mesh.uvs) == len(scene.mesh.tangents) == 8
    assert len(scene.materials) == 2


def test_lights_keep_their_places_colors_and_ratios(tmp_path):
    """At the sheet's middle: 3 lux of sun, 40 cd at distance 2 are 10, 8 cd at 2 are 2."""
    build = Builder()
    build.node(mesh=build.mesh(build.primitive()), translation=[-0.5, -0.5, 0])
    sun = build.light(type="directional", intensity=3, color=[1, 0.5, 0])
    bulb = build.light(type="point", intensity=40, color=[0.5, 1, 0.25])
    cone = {"innerConeAngle": 0.2, "outerConeAngle": 0.6}
    spot = build.light(type="spot", intensity=8, spot=cone)
    build.node(extensions=sun, rotation=quaternion([1, 0, 0], -90))
    build.node(extensions=bulb, translation=[0, 0, 2])
    build.node(extensions=spot, translation=[0, 2, 0], rotation=quaternion([1, 0, 0], -90))
    build.node(extensions=build.light(type="point", intensity=0))
    scene = load_gltf(build.glb(tmp_path / "a.glb"))
    point, directional, spotlight = scene.lights
    assert isinstance(point, PointLight)
    assert isinstance(directional, DirectionalLight)
    assert isinstance(spotlight, SpotLight)
    assert_close(point.color, [0.5, 1, 0.25])
    assert_close(point.position, [0, 0, 2])
    assert_close(directional.color, f32([0.3, 0.15, 0]))
    assert_close(directional.direction, [0, 1, 0])
    assert_close(spotlight.color, f32([0.2] * 3))
    assert_close(spotlight.direction, [0, -1, 0])
    assert_close(spotlight.position, [0, 2, 0])
    angles = np.array([spotlight.inner_angle, spotlight.outer_angle])
    assert_close(angles, f32([0.2, 0.6]))
    middle = spotlight.radiance(jnp.zeros((1, 3)))
    assert_close(np.asarray(middle), [[0.2] * 3], ulps=64 * 2**29)  # float32 color
    assert "1 of 4 lights give no light: left out" in scene.notes
    assert any(note.startswith("light intensities scaled by 0.1:") for note in scene.notes)
