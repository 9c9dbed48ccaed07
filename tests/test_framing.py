"""The floor, camera and light that a mesh alone is given."""

import jax.numpy as jnp
import numpy as np
import pytest

from experiments.files.framing import frame_mesh, framing_camera
from shadows.transforms import PerspectiveCamera, transform_points
from tangentspace.shapes import icosphere, plane, torus

from .tools import assert_close

FLOOR_VERTICES, FLOOR_FACES = 4, 2


def to_light(scene):
    return np.asarray(scene.lights[0].to_light(jnp.zeros((1, 3))))[0]


def ndc(camera, points):
    clip = np.asarray(transform_points(camera.clip_from_world(1.0), jnp.asarray(points)))
    return clip[:, :3] / clip[:, 3:]


def shadow_on_floor(scene):
    positions = np.asarray(scene.mesh.positions)
    points, height = positions[:-FLOOR_VERTICES], positions[-1, 1]
    direction = to_light(scene).astype(np.float64)
    return points - (points[:, 1:2] - height) * (direction / direction[1])


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_the_frame_holds_mesh_and_shadow_at_every_scale(scale):
    ring = torus()
    tilt = np.array([[1, 0, 0], [0, 0.8, -0.6], [0, 0.6, 0.8]])
    ring = ring._replace(
        positions=(scale * (np.asarray(ring.positions) @ tilt.T + [3, -2, 1])).astype(np.float32),
        normals=(np.asarray(ring.normals) @ tilt.T).astype(np.float32),
    )
    scene = frame_mesh(ring, "ring")
    seen = np.concatenate([ring.positions, shadow_on_floor(scene).astype(np.float32)])
    inside = ndc(scene.camera, seen)
    assert np.abs(inside).max() <= 1
    # The margin of 5 % is used up on two opposite sides; measured: 0.95 to 1.2e-7.
    assert np.isclose(np.abs(inside[:, :2]).max(), 0.95, atol=1e-6)
    floor = scene.mesh.positions[-FLOOR_VERTICES:]
    assert (floor[:, 1] == ring.positions[:, 1].min()).all()
    middle = 0.5 * (ring.positions.min(axis=0) + ring.positions.max(axis=0))
    radius = np.linalg.norm(ring.positions - middle, axis=1).max()
    sides = np.abs(floor - middle)[:, [0, 2]] / radius
    assert_close(sides, np.full((FLOOR_VERTICES, 2), 4, np.float32))
    corners = scene.mesh.positions[scene.mesh.faces[-FLOOR_FACES:]]
    up = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert (up[:, 1] > 0).all()
    assert_close(scene.mesh.normals[-FLOOR_VERTICES:], [[0, 1, 0]] * 4)


def test_the_shadow_is_seen_and_the_floor_is_not_cut():
    ball = icosphere()
    scene = frame_mesh(ball, "ball")
    # Most of the shadow lies clear of the ball's disk in the image; measured: 0.64.
    shadow, outline = ndc(scene.camera, shadow_on_floor(scene)), ndc(scene.camera, ball.positions)
    centre = 0.5 * (outline.max(axis=0) + outline.min(axis=0))[:2]
    radius = np.abs(outline[:, :2] - centre).max()
    assert np.mean(np.linalg.norm(shadow[:, :2] - centre, axis=1) > radius) > 0.6
    # What the bottom row of the image sees of the floor is in front of nothing but the eye.
    world_from_clip = np.linalg.inv(np.asarray(scene.camera.clip_from_world(1.0), np.float64))
    ends = world_from_clip @ np.array([[0, -1, -1, 1], [0, -1, 1, 1]]).T
    near, far = (ends[:3] / ends[3]).T
    assert near[1] > scene.mesh.positions[-1, 1] > far[1]
    view_from_world = jnp.asarray(scene.camera.view_from_world)
    distance = -transform_points(view_from_world, scene.mesh.positions)[:, 2]
    assert float(distance.max()) < scene.camera.far


def test_elevations_of_light_and_camera():
    scene = frame_mesh(icosphere(), "ball")
    x, y, z = to_light(scene)
    assert_close(np.rad2deg(np.arcsin(y)), 50.0)
    assert x < 0 < z
    assert isinstance(scene.camera, PerspectiveCamera)
    assert_close(scene.camera.vertical_fov, np.float32(np.deg2rad(40)))
    right, up, back = np.asarray(scene.camera.view_from_world)[:3, :3]
    assert right[1] == 0
    assert up[1] > 0 < back[1]
    assert right @ to_light(scene) < 0


def test_a_flat_level_mesh_hovers_over_its_floor():
    scene = frame_mesh(plane(), "plane")
    # The radius of the square is sqrt(2).
    assert_close(np.asarray(scene.mesh.positions)[-FLOOR_VERTICES:, 1], -np.sqrt(0.5))
    assert "the mesh is flat and level: the floor lies half its radius below it" in scene.notes


def test_materials_of_the_mesh_come_before_the_floors():
    ball = icosphere(subdivisions=0)
    scene = frame_mesh(ball, "ball", ("said",))
    assert scene.notes == ("said",)
    np.testing.assert_array_equal(scene.face_materials, [0] * 20 + [1, 1])
    assert len(scene.materials) == 2


def test_camera_of_points_on_one_line_of_sight_is_finite():
    back = framing_camera(icosphere().positions).view_from_world[2, :3]
    line = np.outer([0.0, 1.0], back)
    assert np.isfinite(np.asarray(framing_camera(line).clip_from_world(1.0))).all()
