"""Cube maps: OpenGL's orientation, no seams, exactness, mirrors, skies, derivatives, errors."""

import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from shadows.transforms import (
    OrthographicCamera,
    PerspectiveCamera,
    look_at,
    perspective,
    transform_points,
)
from tangentspace._math import safe_normalize
from tangentspace.environment import (
    CubeMap,
    cube_directions,
    cube_map_from_function,
    opengl_border,
    reflect_environment,
    sample_cube_map,
    skybox,
    smooth_border,
    view_directions,
)

from .tools import assert_close

BORDERS = [opengl_border, smooth_border]
FACES = ["+x", "-x", "+y", "-y", "+z", "-z"]
look_up = eqx.filter_jit(sample_cube_map)
mirror = eqx.filter_jit(reflect_environment)
sky = eqx.filter_jit(skybox)
build = eqx.filter_jit(cube_map_from_function)
UP = np.array([0.0, 1.0, 0.0])


@jax.jit
def camera_matrix(eye, target, far=10.0, aspect=1.5):
    """A camera's clip_from_world, built in one go."""
    return PerspectiveCamera(look_at(eye, target, UP), 1.0, 0.1, far).clip_from_world(aspect)


def random_map(size=8, *, border=opengl_border, dtype=np.float64, channels=2):
    texels = np.random.default_rng(0).random((6, size, size, channels))
    return CubeMap(jnp.asarray(texels, dtype), border)


def unit(vectors):
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def random_directions(count=4000, *, seed=1):
    return unit(np.random.default_rng(seed).normal(size=(count, 3)))


def smooth_image(directions):
    """Something smooth, the same from all sides."""
    x, y, z = (directions[..., k] for k in range(3))
    return jnp.stack([jnp.sin(3 * x + 2 * y + z), 0.3 * x + 0.5 * y - 0.8 * z], axis=-1)


# Known answers

# From table 8.19 of OpenGL 4.6: the direction at row 0 and column 0, and how it changes along
# a row and along a column, each face 2 wide.
OPENGL_FACES = {
    "+x": ((1, 1, 1), (0, 0, -1), (0, -1, 0)),
    "-x": ((-1, 1, -1), (0, 0, 1), (0, -1, 0)),
    "+y": ((-1, 1, -1), (1, 0, 0), (0, 0, 1)),
    "-y": ((-1, -1, 1), (1, 0, 0), (0, 0, -1)),
    "+z": ((-1, 1, 1), (1, 0, 0), (0, -1, 0)),
    "-z": ((1, 1, -1), (-1, 0, 0), (0, -1, 0)),
}


@pytest.mark.parametrize("face", FACES)
def test_faces_are_turned_as_in_opengl(face, dtype):
    size = 5
    start, along_row, along_column = (np.array(a, float) for a in OPENGL_FACES[face])
    row, column = (np.mgrid[:size, :size, :1] + 0.5)[:2] * 2 / size
    directions = (start + column * along_row + row * along_column).astype(dtype)
    cube_map = random_map(size, dtype=dtype)
    colors = look_up(cube_map, directions)
    assert colors.dtype == dtype
    assert_close(colors, cube_map.faces[FACES.index(face)], ulps=4)  # measured 0.6
    centres = np.asarray(jax.jit(lambda: cube_directions(size, dtype=dtype))())
    assert_close(centres[FACES.index(face)], unit(directions), ulps=4)  # measured 1


def test_a_corner_shows_the_mean_of_its_three_texels():
    cube_map = random_map(4)
    faces = np.asarray(cube_map.faces)
    meeting = faces[0, 0, 0], faces[2, -1, -1], faces[4, 0, -1]  # +x, +y, +z
    for border in BORDERS:
        corner = look_up(CubeMap(faces, border), np.ones(3))
        assert_close(corner, np.mean(meeting, axis=0), ulps=4)


def test_an_edge_shows_the_mean_of_both_sides_as_opengl_does():
    cube_map = random_map(4)
    faces = np.asarray(cube_map.faces)
    height = (2 * np.arange(4) + 1) / 4 - 1
    edge = look_up(cube_map, np.stack([np.ones(4), -height, np.ones(4)], axis=-1))
    assert_close(edge, (faces[0, :, 0] + faces[4, :, -1]) / 2, ulps=4)


@pytest.mark.parametrize("size", [1, 2, 7])
@pytest.mark.parametrize("border", BORDERS)
def test_one_color_all_round(border, size, dtype):
    color = np.array([0.25, 3.0], dtype)
    cube_map = CubeMap(np.broadcast_to(color, (6, size, size, 2)), border)
    colors = look_up(cube_map, random_directions(50).astype(dtype))
    assert_close(colors, np.broadcast_to(color, (50, 2)), ulps=4)


# Laws


def edges_and_corners():
    """Points on the 12 edges and 8 corners of the cube, and what leads off each face there."""
    rng = np.random.default_rng(2)
    for axes in [(0, 1), (0, 2), (1, 2)]:
        for signs in itertools.product([-1, 1], repeat=2):
            points = rng.uniform(-1, 1, (200, 3))
            points[:, axes] = signs
            yield points, axes
    for signs in itertools.product([-1, 1], repeat=3):
        yield np.array([signs], float), (0, 1, 2)


@pytest.mark.parametrize("border", BORDERS)
@pytest.mark.parametrize("size", [1, 2, 9])
def test_no_seam_on_any_edge_or_corner(border, size, dtype):
    """Seen from each of the faces that meet there, random texels have the same color."""
    cube_map = random_map(size, border=border, dtype=dtype)
    tiny = 4 * np.finfo(dtype).eps  # times size / 2 texels, so far the point moves
    for points, axes in edges_and_corners():
        sides = []
        for axis in axes:
            onto = points.astype(dtype)
            onto[:, axis] *= 1 + tiny
            sides.append(np.asarray(look_up(cube_map, onto)))
        for side in sides[1:]:
            assert_close(side, sides[0], ulps=128)  # measured 33


@pytest.mark.parametrize("border", BORDERS)
def test_a_blend_of_texels_stays_in_their_range(border):
    cube_map = random_map(3, border=border)
    points = np.concatenate([points for points, _ in edges_and_corners()])
    shaken = points + np.random.default_rng(3).uniform(-0.4, 0.4, points.shape)
    colors = np.asarray(look_up(cube_map, shaken))
    assert colors.min() >= np.min(cube_map.faces)
    assert colors.max() <= np.max(cube_map.faces)


def errors(size, border):
    """The largest errors of a smooth image inside the faces, and near and on edges."""
    built = build(smooth_image, size)
    directions = random_directions(20000)
    off_middle = np.sort(np.abs(directions), axis=1)
    inside = off_middle[:, 1] / off_middle[:, 2] < 1 - 2 / size
    on_edges = unit(np.concatenate([points for points, _ in edges_and_corners()]))
    found = []
    for where in (directions[inside], directions[~inside], on_edges):
        colors = look_up(CubeMap(built.faces, border), where)
        found.append(np.abs(colors - smooth_image(where)).max())
    return found


@pytest.mark.parametrize("size", [16, 64])
def test_a_smooth_image_is_as_exact_at_edges_as_inside(size):
    inside, near, on_edge = errors(size, smooth_border)
    assert near <= inside  # measured 0.53 and 0.47 of it
    assert on_edge <= inside  # measured 0.56 and 0.55


def test_order_of_the_error():
    """Second order in the texels' size; but first order on edges filtered as OpenGL does."""
    for border, order in [(smooth_border, 2), (opengl_border, 1)]:
        ratio = np.array(errors(16, border)) / np.array(errors(64, border))
        assert ratio[0] > 4**2 * 0.8  # measured 15.8
        assert 0.8 < ratio[2] / 4**order < 1.2  # measured 1.02 and 1.00


def test_length_does_not_matter(dtype):
    cube_map, directions = random_map(dtype=dtype), random_directions(100).astype(dtype)
    for length in (1e-20, 7.0, 1e20):
        far = look_up(cube_map, directions * dtype(length))
        assert_close(far, look_up(cube_map, directions), ulps=16)  # measured 3.8


def test_leading_axes_and_image_types():
    directions = random_directions(6).astype(np.float32)
    cube_map = random_map(dtype=np.float64)
    colors = look_up(cube_map, directions.reshape(2, 3, 3))
    assert colors.dtype == np.float64  # that of the faces
    assert_close(colors.reshape(6, 2), look_up(cube_map, directions), ulps=0)
    assert look_up(cube_map, directions[0]).shape == (2,)


# Mirror and sky


def test_a_mirror_shows_what_lies_in_the_mirror_direction():
    cube_map = random_map()
    to_camera = np.array([[0.6, 0.8, 0.0], UP])
    directions = np.array([[-0.6, 0.8, 0.0], UP])
    assert_close(mirror(cube_map, UP, to_camera), look_up(cube_map, directions), ulps=4)


CAMERAS = {
    "perspective": lambda view: PerspectiveCamera(view, 0.9, 0.1, 50.0),
    "orthographic": lambda view: OrthographicCamera(view, 2.0, 0.1, 50.0),
}


@pytest.mark.parametrize("camera", CAMERAS)
def test_view_directions_lead_away_from_the_eye(camera):
    """Points on the ray are seen at its pixel, and the eye sees them in that direction."""
    eye = np.array([1.0, 2.0, 3.0])

    @jax.jit
    def directions_and_back():
        made = CAMERAS[camera](look_at(eye, np.array([0.3, 0.1, -0.4]), UP))
        directions = safe_normalize(view_directions(made.clip_from_world(6 / 4), 4, 6))
        points = eye + 5 * directions
        clip = transform_points(made.clip_from_world(6 / 4), points)
        return directions, -made.to_camera(points), clip

    directions, expected, clip = map(np.asarray, directions_and_back())
    assert_close(directions, expected, ulps=8)  # measured 1
    if camera == "perspective":
        x, y = np.moveaxis(clip[..., :2] / clip[..., 3:], -1, 0)
        assert_close(x, np.tile((2 * np.arange(6) + 1) / 6 - 1, (4, 1)), ulps=16)  # measured 1.5
        assert_close(y.T, np.tile(1 - (2 * np.arange(4) + 1) / 4, (6, 1)), ulps=16)


def test_the_sky_is_infinitely_far():
    cube_map, towards = random_map(), np.array([1.0, -0.5, 0.7])
    eye = np.array([5.0, -3.0, 2.0])
    here = sky(cube_map, camera_matrix(np.zeros(3), towards), 3, 3)
    there = sky(cube_map, camera_matrix(eye, eye + towards, 1000.0), 3, 3)
    assert here.shape == (3, 3, 2)
    assert_close(there, here, ulps=32)  # measured 2
    assert_close(here[1, 1], look_up(cube_map, towards), ulps=16)


def test_a_camera_along_minus_z_sees_the_convention():
    """Right of the image is +x, its top is +y: columns of the -z face run to the left."""
    cube_map, clip_from_view = random_map(8), jax.jit(perspective)(np.pi / 2, 1.0, 0.1, 10.0)
    seen = sky(cube_map, clip_from_view, 8, 8)
    assert_close(seen, cube_map.faces[5, :, ::-1], ulps=16)  # measured 2.2


# Derivatives


@pytest.mark.parametrize("border", BORDERS)
def test_derivatives(border):
    cube_map, directions = random_map(5, border=border), random_directions(40)

    def sample(faces, directions):
        return sample_cube_map(CubeMap(faces, border), directions)

    args = (cube_map.faces, jnp.asarray(directions))
    check_grads(jax.jit(sample), args, 1, ("fwd", "rev"), eps=1e-7, rtol=1e-6, atol=1e-6)


def test_derivatives_of_mirror_and_sky():
    cube_map, to_camera = random_map(5), random_directions(20)
    normals = random_directions(20, seed=7)
    matrix = camera_matrix(np.array([1.0, 0.23, 0.37]), np.zeros(3))
    tolerances = {"eps": 1e-7, "rtol": 1e-6, "atol": 1e-6}
    check_grads(
        lambda n, v: mirror(cube_map, n, v), (normals, to_camera), 1, ("fwd", "rev"), **tolerances
    )
    check_grads(lambda m: sky(cube_map, m, 3, 3), (matrix,), 1, ("fwd", "rev"), **tolerances)


def test_a_direction_where_faces_meet_has_the_derivative_of_one_of_them():
    """That of x before y before z; it is the limit from inside that face."""
    cube_map = random_map(5)
    slope = jax.jit(jax.jacfwd(lambda d: sample_cube_map(cube_map, d)))
    inwards = {  # away from the edge on the face that decides
        (1.0, 1.0, 0.3): (1.0, 1 - 1e-9, 0.3),
        (-1.0, 0.3, 1.0): (-1.0, 0.3, 1 - 1e-9),
        (0.3, -1.0, -1.0): (0.3, -1.0, -1 + 1e-9),
        (-1.0, 1.0, -1.0): (-1.0, 1 - 1e-9, -1 + 1e-9),
    }
    for tie, near in inwards.items():
        assert_close(slope(np.array(tie)), slope(np.array(near)), ulps=1e9)  # 1e-8 away


def test_zero_direction_is_black_with_zero_derivative(dtype):
    directions = random_directions(3).astype(dtype)
    directions[1] = 0
    cube_map = random_map(dtype=dtype)
    assert_close(look_up(cube_map, directions)[1], np.zeros(2), ulps=0)

    def total(faces, directions):
        return jnp.sum(sample_cube_map(CubeMap(faces), directions) ** 2)

    for_faces, for_directions = jax.jit(jax.grad(total, (0, 1)))(cube_map.faces, directions)
    assert_close(for_directions[1], np.zeros(3), ulps=0)
    good = directions[[0, 2]]
    others_faces, others = jax.jit(jax.grad(total, (0, 1)))(cube_map.faces, good)
    assert_close(for_faces, others_faces, ulps=4)
    assert_close(for_directions[np.array([0, 2])], others, ulps=4)


def test_not_a_number_stays_with_its_direction():
    directions = random_directions(3)
    directions[1, 2] = np.nan
    colors = np.asarray(look_up(random_map(), directions))
    assert np.isfinite(colors).all(axis=1).tolist() == [True, False, True]


# Errors


@pytest.mark.errors
@pytest.mark.parametrize("shape", [(6, 4, 4), (5, 4, 4, 3), (6, 4, 3, 3), (6, 0, 0, 3)])
def test_faces_of_a_wrong_shape_are_named(shape):
    with pytest.raises(ValueError, match=r"sample_cube_map: expected `faces` of shape \(6, size"):
        sample_cube_map(CubeMap(np.zeros(shape)), np.ones(3))


@pytest.mark.errors
@pytest.mark.parametrize("directions", [np.ones(2), np.float64(1.0)])
def test_directions_of_a_wrong_shape_are_named(directions):
    with pytest.raises(ValueError, match="expected `directions` of shape"):
        sample_cube_map(random_map(), directions)


@pytest.mark.errors
def test_a_function_of_a_wrong_shape_is_named():
    with pytest.raises(ValueError, match=r"shape \(6, 4, 4, channels\), got \(6, 4, 4\)"):
        cube_map_from_function(lambda directions: directions[..., 0], 4)
