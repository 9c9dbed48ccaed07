"""Normals of a map at a pixel: the prescribed formulas, the inverse, flat maps, no frames."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from tangentspace._math import safe_normalize
from tangentspace.pixel_frame import perturb_normal, unperturb_normal

from .tools import assert_close

IDENTITY = np.array([1.0, 0.0, 0.0, 1.0]), np.array([0.0, 0.0, 1.0])


def unit(vectors):
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def random_frames(count=50, dtype=np.float64, seed=0):
    """Frames as interpolation leaves them: neither unit nor perpendicular."""
    random = np.random.default_rng(seed)
    normal = unit(random.normal(size=(count, 3))) * random.uniform(0.7, 1, (count, 1))
    tangent = np.cross(normal, random.normal(size=(count, 3)))
    tangent = unit(tangent) * random.uniform(0.7, 1, (count, 1)) + 0.1 * normal
    tangent = np.hstack([tangent, random.choice([-1.0, 1.0], (count, 1))])
    in_map = unit(random.normal(loc=[0, 0, 2], size=(count, 3)))
    return tuple(array.astype(dtype) for array in (in_map, tangent, normal))


@pytest.mark.parametrize(
    ("in_map", "handedness", "expected"),
    [
        ([1, 0, 0], 1, [1, 0, 0]),
        ([0, 1, 0], 1, [0, 1, 0]),
        ([0, 1, 0], -1, [0, -1, 0]),
        ([0, 0, 1], -1, [0, 0, 1]),
        ([0, 3, 4], 1, [0, 0.6, 0.8]),
    ],
)
def test_axes(in_map, handedness, expected, dtype):
    tangent, normal = np.array([1, 0, 0, handedness], dtype), np.array([0, 0, 1], dtype)
    perturbed = perturb_normal(np.array(in_map, dtype), tangent, normal)
    assert perturbed.dtype == dtype
    assert_close(perturbed, np.array(expected), ulps=1)


def test_is_the_prescribed_sum():
    in_map, tangent, normal = random_frames()
    bitangent = tangent[:, 3:] * np.cross(normal, tangent[:, :3])
    x, y, z = in_map.T[..., None]
    expected = unit(x * tangent[:, :3] + y * bitangent + z * normal)
    assert_close(perturb_normal(in_map, tangent, normal), expected, ulps=4)


def test_inverse_is_the_prescribed_one():
    """The rows of the reference's header, and the sign of the determinant."""
    towards, tangent, normal = random_frames()
    t, bitangent = tangent[:, :3], tangent[:, 3:] * np.cross(normal, tangent[:, :3])
    rows = np.cross(bitangent, normal), np.cross(normal, t), np.cross(t, bitangent)
    sign = np.where(np.sum(t * rows[0], axis=-1) < 0, -1, 1)
    local = np.stack([np.sum(towards * row, axis=-1) for row in rows], axis=-1)
    expected = unit(sign[:, None] * local)
    assert_close(unperturb_normal(towards, tangent, normal), expected, ulps=16)


def test_there_and_back(dtype):
    in_map, tangent, normal = random_frames(dtype=dtype)
    perturbed = perturb_normal(in_map, tangent, normal)
    assert_close(unperturb_normal(perturbed, tangent, normal), in_map, ulps=32)
    back = perturb_normal(unperturb_normal(in_map, tangent, normal), tangent, normal)
    assert_close(back, in_map, ulps=32)


def test_a_flat_map_changes_nothing(dtype):
    _, tangent, normal = random_frames(dtype=dtype)
    flat = np.array([0, 0, 1], dtype)
    assert_close(perturb_normal(flat, tangent, normal), safe_normalize(normal), ulps=0)
    nothing = np.zeros_like(tangent)
    assert_close(
        jax.jit(perturb_normal)(flat, tangent, normal),
        jax.jit(perturb_normal)(flat, nothing, normal),
        ulps=0,
    )


def test_the_length_of_the_map_does_not_count():
    in_map, tangent, normal = random_frames()
    assert_close(
        perturb_normal(3 * in_map, tangent, normal), perturb_normal(in_map, tangent, normal)
    )


def test_leading_axes_broadcast():
    in_map, tangent, normal = random_frames(6)
    grid = perturb_normal(in_map.reshape(2, 3, 3), tangent[0], normal[0])
    assert grid.shape == (2, 3, 3)
    assert_close(grid[1, 2], perturb_normal(in_map[5], tangent[0], normal[0]))


NO_FRAMES = {
    "no tangent": ([0, 0, 0, 1], [0, 0, 0.5]),
    "no handedness": ([1, 0, 0, 0], [0, 0, 0.5]),
    "tangent along the normal": ([0, 0, -1, 1], [0, 0, 0.5]),
    "tangent along the normal up to rounding": ([0.1, 0.2, 0.3, 1], [0.3, 0.6, 0.9]),
    "no normal": ([1, 0, 0, 1], [0, 0, 0]),
}


@pytest.mark.parametrize("name", NO_FRAMES)
def test_without_a_frame_the_normal_stays(name, dtype):
    tangent, normal = (np.array(vector, dtype) for vector in NO_FRAMES[name])
    in_map = np.array([0.6, 0, 0.8], dtype)
    expected = normal / max(np.linalg.norm(normal), 1e-9)
    assert_close(perturb_normal(in_map, tangent, normal), expected, ulps=2)
    assert_close(unperturb_normal(in_map, tangent, normal), np.array([0, 0, 1]), ulps=0)
    for function in (perturb_normal, unperturb_normal):
        mixed = lambda *arrays, function=function: jnp.sum(function(*arrays) * expected[::-1])
        of_map, of_tangent, of_normal = jax.grad(mixed, (0, 1, 2))(in_map, tangent, normal)
        assert_close(of_map, 0.0, ulps=0)
        assert_close(of_tangent, 0.0, ulps=0)
        assert np.all(np.isfinite(of_normal))


def test_without_a_vector_the_normal_stays(dtype):
    tangent, normal = (array.astype(dtype) for array in IDENTITY)
    nothing = np.zeros(3, dtype)
    assert_close(perturb_normal(nothing, tangent, normal), normal, ulps=0)
    assert_close(unperturb_normal(nothing, tangent, normal), np.array([0, 0, 1]), ulps=0)


def test_one_bad_pixel_leaves_the_others_their_derivatives():
    in_map, tangent, normal = random_frames(3)
    bad = tangent * [[1], [0], [1]]
    gradient = jax.grad(lambda t: jnp.sum(perturb_normal(in_map, t, normal)[:, 0]))
    assert_close(gradient(bad)[::2], gradient(tangent)[::2], ulps=4)
    assert_close(gradient(bad)[1], 0.0, ulps=0)


@pytest.mark.parametrize("function", [perturb_normal, unperturb_normal])
def test_derivatives(function):
    check_grads(jax.jit(function), random_frames(5), 1, ("fwd", "rev"), eps=1e-5)


def test_the_interpolated_handedness_counts_by_its_size():
    """Across a face of both signs the bitangent shrinks and turns, as in the usual shader."""
    _, normal = IDENTITY
    tangent = np.array([1.0, 0.0, 0.0, 0.5])
    expected = unit(np.array([0.0, 0.5, 1.0]))
    assert_close(perturb_normal(np.array([0.0, 1.0, 1.0]), tangent, normal), expected, ulps=1)
