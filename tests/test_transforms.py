"""Matrices and cameras: known answers, corners, laws, derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from shadows.lights import DirectionalLight
from shadows.transforms import (
    OrthographicCamera,
    PerspectiveCamera,
    look_at,
    orthographic,
    perspective,
    texel_from_clip,
    transform_points,
)

from .tools import assert_close

UP, RIGHT = np.array([0.0, 1.0, 0.0]), np.array([1.0, 0.0, 0.0])


def ndc(matrix, points):
    """Apply a matrix in float64 NumPy, and divide by w."""
    points = np.asarray(points, np.float64)
    clip = np.concatenate([points, np.ones((*points.shape[:-1], 1))], -1) @ np.asarray(matrix).T
    return clip[..., :3] / clip[..., 3:]


def corners(low, high):
    """The eight corners of the box between two points."""
    return np.stack(np.meshgrid(*zip(low, high, strict=True), indexing="ij"), -1).reshape(-1, 3)


# Known answers


def test_look_at_from_the_front_is_a_translation(dtype):
    position, target, up = np.array([[0, 0, 5], [0, 0, 0], [0, 1, 0]], dtype)
    expected = np.eye(4)
    expected[2, 3] = -5
    matrix = look_at(position, target, up)
    assert_close(matrix, expected, ulps=1)
    assert matrix.dtype == dtype


def test_look_at_from_the_right_turns_x_to_the_viewer():
    """Seen from +x: the world's -z is on the right, its +y up, its +x towards the eye."""
    matrix = look_at(np.array([4.0, 1, 2]), np.array([0.0, 1, 2]), UP)
    assert_close(matrix[:3, :3], np.array([[0, 0, -1], [0, 1, 0], [1, 0, 0.0]]), ulps=1)
    assert_close(transform_points(matrix, np.array([1.0, 2, 1])), [1, 1, -3, 1], ulps=4)


@pytest.mark.parametrize("direction", [(0, 1, 0), (0, -3, 0), (1e-6, 1, 0), (0, 0, 1), (1, 2, 3)])
@pytest.mark.parametrize("up", [(0, 1, 0), (0, -2, 0), (0, 0, 1)])
def test_every_direction_has_a_right_handed_frame(direction, up, dtype):
    position = np.array([1, -2, 0.5], dtype)
    direction = np.array(direction, dtype)
    matrix = np.asarray(look_at(position, position + direction, np.array(up, dtype)), np.float64)
    rotation = matrix[:3, :3]
    eps = np.finfo(dtype).eps
    # 2 eps measured: the position is added to the direction.
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=8 * eps)
    np.testing.assert_allclose(np.linalg.det(rotation), 1, atol=8 * eps)
    along = direction / np.linalg.norm(direction)
    np.testing.assert_allclose(rotation @ along, [0, 0, -1], atol=8 * eps)
    np.testing.assert_allclose(matrix @ [*position, 1], [0, 0, 0, 1], atol=8 * eps)
    sideways = np.linalg.norm(np.cross(up, along)) > 1e-3
    if sideways:
        upwards = rotation @ np.array(up, float)
        assert abs(upwards[0]) < 8 * eps
        assert upwards[1] > 0


def test_perspective_maps_the_frustum_s_corners_to_ndc_s():
    fov, aspect, near, far = 0.9, 1.5, 0.5, 20.0
    matrix = perspective(fov, aspect, near, far)
    for distance, depth in ((near, -1), (far, 1)):
        height = distance * np.tan(0.5 * fov)
        width = aspect * height
        points = [[width, height, -distance], [-width, height, -distance], [0, -height, -distance]]
        expected = np.array([[1, 1, depth], [-1, 1, depth], [0, -1, depth]])
        assert_close(ndc(matrix, points), expected, ulps=8)


def test_clip_w_is_the_distance_along_the_line_of_sight():
    clip = transform_points(perspective(0.7, 1.0, 0.1, 10.0), np.array([3.0, -2.0, -7.0]))
    assert_close(clip[3], 7.0, ulps=0)


def test_orthographic_maps_the_box_to_ndc():
    matrix = orthographic(-2.0, 4.0, 1.0, 2.0, 0.5, 8.0)
    points = corners((-2, 1, -0.5), (4, 2, -8))
    assert_close(ndc(matrix, points), corners((-1, -1, -1), (1, 1, 1)) * 1.0, ulps=4)


@pytest.mark.parametrize(
    "matrix", [perspective(1.0, 1.0, 0.5, 20.0), orthographic(-1.0, 1.0, -1.0, 1.0, 0.5, 20.0)]
)
def test_near_is_window_depth_0_and_far_is_1(matrix):
    clip = transform_points(texel_from_clip(8, 8) @ matrix, np.array([[0, 0, -0.5], [0, 0, -20.0]]))
    assert_close(clip[:, 2] / clip[:, 3], [0, 1], ulps=8)


def test_viewport_puts_row_0_on_top(dtype):
    viewport = texel_from_clip(4, 6, dtype=dtype)
    assert viewport.dtype == dtype
    ndc_points = np.array([[-1, 1, -1], [1, -1, 1], [0, 0, 0], [-1 + 1 / 6, 1 - 1 / 4, 0]])
    expected = np.array([[0, 0, 0], [6, 4, 1], [3, 2, 0.5], [0.5, 0.5, 0.5]])
    for w in (1, 4):
        clip = (np.concatenate([ndc_points, np.ones((4, 1))], axis=1) * w).astype(dtype)
        texel = clip @ np.asarray(viewport).T
        assert_close(texel[:, 3], w, ulps=0)
        assert_close(texel[:, :3], expected * w, ulps=2)


def test_transform_points_keeps_leading_axes_and_w():
    rng = np.random.default_rng(0)
    matrix, points = jnp.asarray(rng.normal(size=(4, 4))), rng.normal(size=(2, 3, 3))
    expected = np.einsum("ij,...j->...i", matrix, np.concatenate([points, np.ones((2, 3, 1))], -1))
    assert_close(transform_points(matrix, points), expected)


# Cameras


EYE, TARGET = np.array([1.0, 2.0, 6.0]), np.array([0.0, 1.0, -1.0])


def cameras():
    view = look_at(EYE, TARGET, UP)
    return {
        "perspective": PerspectiveCamera(view, 0.8, 0.5, 30.0),
        "orthographic": OrthographicCamera(view, 2.0, 0.5, 30.0),
    }


@pytest.mark.parametrize("kind", ["perspective", "orthographic"])
def test_camera_sees_its_target_in_the_middle_and_up_above_it(kind):
    matrix = cameras()[kind].clip_from_world(1.5)
    middle, above, beside = ndc(matrix, [TARGET, TARGET + 0.1 * UP, TARGET + 0.1 * RIGHT])
    assert_close(middle[:2], [0, 0])
    assert above[1] > 0.01
    assert_close(above[0], 0)
    assert beside[0] > 0.01


def test_aspect_is_width_over_height():
    for camera in cameras().values():
        square, wide = (
            ndc(camera.clip_from_world(aspect), np.array([0.2, 1.3, 0.4])) for aspect in (1.0, 2.0)
        )
        assert_close(wide * [2, 1, 1], square)


def test_perspective_camera_s_vertical_field_of_view():
    top = np.array([0, np.tan(0.4), -1.0])
    view = np.asarray(look_at(EYE, TARGET, UP))
    world = view[:3, :3].T @ (7 * top) + EYE
    assert_close(ndc(cameras()["perspective"].clip_from_world(1.5), world)[1], 1.0)


def test_orthographic_camera_s_half_height():
    view = np.asarray(look_at(EYE, TARGET, UP))
    world = view[:3, :3].T @ np.array([3.0, 2.0, -9.0]) + EYE
    assert_close(ndc(cameras()["orthographic"].clip_from_world(1.5), world)[:2], [1, 1])


def test_to_camera_is_the_unit_vector_to_the_viewer():
    positions = jnp.asarray(np.random.default_rng(0).normal(size=(5, 7, 3)))
    to_eye = EYE - positions
    expected = to_eye / np.linalg.norm(to_eye, axis=-1, keepdims=True)
    assert_close(cameras()["perspective"].to_camera(positions), expected)
    backwards = (EYE - TARGET) / np.linalg.norm(EYE - TARGET)
    expected = np.broadcast_to(backwards, positions.shape)
    assert_close(cameras()["orthographic"].to_camera(positions), expected)


# Derivatives


@pytest.mark.parametrize("up", [UP, np.array([1.0, 3.0, 0.5])])
def test_look_at_derivative(up):
    check_grads(jax.jit(look_at), (EYE, TARGET, up), 1, ("fwd", "rev"), atol=1e-7, rtol=1e-7)


def test_look_at_derivative_is_finite_where_up_is_parallel():
    jacobians = jax.jit(jax.jacrev(look_at, argnums=(0, 1, 2)))(EYE, EYE - 3 * UP, UP)
    for jacobian in jacobians:
        assert np.all(np.isfinite(jacobian))
    assert_close(jacobians[2], np.zeros((4, 4, 3)), ulps=0)


def test_projection_derivatives():
    frustum, box = (0.8, 1.5, 0.5, 20.0), (-2.0, 4.0, 1.0, 2.5, 0.5, 8.0)
    for function, planes in ((perspective, frustum), (orthographic, box)):
        check_grads(jax.jit(function), planes, 1, ("fwd", "rev"), atol=1e-6, rtol=1e-6)


def test_light_s_matrix_has_the_derivative_of_its_direction():
    points = np.random.default_rng(0).normal(size=(50, 3))

    @jax.jit
    def matrix(direction):
        return DirectionalLight(direction).clip_from_world(points)

    check_grads(matrix, (np.array([0.5, 0.7, -0.3]),), 1, ("rev",), atol=1e-6, rtol=1e-6)


# Transformations


def test_cameras_pass_through_jit_and_vmap():
    camera = cameras()["perspective"]
    expected = camera.clip_from_world(1.5)
    assert_close(jax.jit(lambda camera: camera.clip_from_world(1.5))(camera), expected)
    fovs = jnp.asarray([0.8, 1.2])
    matrices = jax.vmap(
        lambda fov: PerspectiveCamera(camera.view_from_world, fov, 0.5, 30.0).clip_from_world(1.5)
    )(fovs)
    assert_close(matrices[0], expected)
    assert_close(matrices[1, 3], expected[3])
