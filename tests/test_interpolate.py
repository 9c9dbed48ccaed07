"""Weights, attributes and depth at pixels against a linear solve, and their derivatives."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from shadows.interpolate import (
    barycentric_slopes,
    barycentrics,
    gather_faces,
    interpolate,
    pixel_centers,
    window_depth,
)

from .reference import barycentrics_reference, plane_reference, rasterize_reference
from .tools import assert_close

FACES = np.arange(18, dtype=np.int32).reshape(6, 3)

find_weights = jax.jit(barycentrics)
blend = jax.jit(interpolate)
find_depth = jax.jit(window_depth)
find_slopes = jax.jit(barycentric_slopes)


@functools.cache
def scene():
    """Six faces in perspective, one with a corner behind the eye, float64, at 12 x 16 pixels.

    Returns clip positions, face ids, and which covered pixels are well inside their face.
    """
    points = np.random.default_rng(0).uniform([-2, -2, -4], [2, 2, -1.5], (6, 3, 3))
    points[0, 0] = [1, -1, 1]
    x, y, z = points.reshape(-1, 3).T
    clip = np.stack([1.5 * x, 2 * y, -1.5 * z - 2, -z], axis=-1)
    reference = rasterize_reference(clip, FACES, (12, 16))
    inside = (reference.face_ids >= 0) & (reference.margin > 0.02)
    assert np.sum(inside) > 60
    assert np.sum(reference.face_ids < 0) > 20
    return clip, jnp.asarray(reference.face_ids, jnp.int32), inside


# Known answers


def test_pixel_centres_run_from_the_top_left(dtype):
    x, y = pixel_centers(2, 4, np.dtype(dtype))
    assert_close(x, [-0.75, -0.25, 0.25, 0.75], ulps=0)
    assert_close(y, [0.5, -0.5], ulps=0)
    assert x.dtype == y.dtype == dtype


def test_half_way_on_the_screen_is_nearer_to_the_near_corner(dtype):
    """Between corners at distance 1 and 3, the screen's middle is a quarter of the way."""
    clip = jnp.asarray([[-1, 0, 0, 1], [3, 0, 0, 3], [0, 4, 0, 4]], dtype)
    weights = find_weights(clip, FACES[:1], jnp.zeros((1, 1), jnp.int32))
    assert_close(weights[0, 0], [0.75, 0.25, 0], ulps=2)
    value = blend(
        jnp.asarray([[0.0], [1.0], [5.0]], dtype), FACES[:1], jnp.zeros((1, 1), int), weights
    )
    assert_close(value[0, 0], [0.25], ulps=2)


def test_weights_at_a_corner_are_one_and_zero(dtype):
    corner = [0.25, -0.25]  # the centre of pixel (2, 2) of 4 x 4
    clip = jnp.asarray([[*corner, 0, 1], [2, -0.25, 0, 2], [0.5, 6, 0, 2]], dtype)
    face_ids = jnp.full((4, 4), -1).at[2, 2].set(0)
    expected = np.zeros((4, 4, 3))
    expected[2, 2, 0] = 1
    assert_close(find_weights(clip, FACES[:1], face_ids), expected, ulps=8)  # measured 0.75


def test_gather_faces_takes_the_face_s_value_and_zero_where_none_is(dtype):
    values = jnp.asarray([[1, 10], [2, 20]], dtype)
    face_ids = jnp.asarray([[1, -1], [0, 1]])
    expected = [[[2, 20], [0, 0]], [[1, 10], [2, 20]]]
    assert_close(gather_faces(values, face_ids), np.array(expected, float), ulps=0)


# Laws


def test_weights_agree_with_the_linear_solve(dtype):
    clip, face_ids, inside = scene()
    weights = find_weights(clip.astype(dtype), FACES, face_ids)
    expected = barycentrics_reference(clip.astype(dtype), FACES, face_ids)
    assert weights.dtype == dtype
    assert_close(np.asarray(weights)[inside], expected[inside], ulps=16)  # 4 measured


@pytest.mark.parametrize("size", [1e-1, 1e-3, 1e-5])
def test_weights_lose_no_digits_for_small_triangles(size):
    """Triangles round a pixel centre, far smaller than a pixel, in float32."""
    centre = np.array([0.125, 0.625])  # pixel (1, 4) of 8 x 8
    corners = centre + size * np.array([[-1, -0.7], [1.3, -0.4], [0.1, 1.0]])
    w = np.array([[1.0], [2.0], [4.0]])
    clip = (np.concatenate([corners, np.zeros((3, 1)), np.ones((3, 1))], axis=1) * w).astype(
        np.float32
    )
    face_ids = np.full((8, 8), -1, np.int32)
    face_ids[1, 4] = 0
    expected = barycentrics_reference(clip, FACES[:1], face_ids)
    assert_close(find_weights(clip, FACES[:1], jnp.asarray(face_ids)), expected, ulps=4)


def test_weights_are_a_partition_of_one(dtype):
    clip, face_ids, _ = scene()
    weights = np.asarray(find_weights(clip.astype(dtype), FACES, face_ids))
    assert np.all(weights >= 0)
    assert_close(np.sum(weights, axis=-1), np.where(face_ids >= 0, 1.0, 0.0), ulps=2)


def test_weights_stay_in_range_where_a_centre_lies_outside_the_face():
    """As happens by rounding: the weights are those of a point on the edge."""
    clip = np.array([[0.1, -1, 0, 1], [1, 0, 0, 1], [0.1, 1, 0, 1]])
    weights = np.asarray(find_weights(clip, FACES[:1], jnp.zeros((1, 1), jnp.int32)))
    assert_close(weights[0, 0], [0.5, 0, 0.5], ulps=2)


def test_blended_corners_lie_on_the_pixel_s_ray():
    clip, face_ids, inside = scene()
    met = np.asarray(blend(clip, FACES, face_ids, find_weights(clip, FACES, face_ids)))
    row, column = np.nonzero(inside)
    assert_close(met[inside, 0] / met[inside, 3], (2 * column + 1) / 16 - 1)
    assert_close(met[inside, 1] / met[inside, 3], 1 - (2 * row + 1) / 12)


def test_depth_is_that_of_the_face_s_plane(dtype):
    clip, face_ids, _ = scene()
    depth = find_depth(clip.astype(dtype), FACES, face_ids)
    expected, _ = plane_reference(clip.astype(dtype), FACES, np.asarray(face_ids))
    assert depth.dtype == dtype
    assert_close(depth, np.where(face_ids < 0, 1, expected), ulps=8)  # 1.8 measured


@pytest.mark.parametrize("shift", [1, 2])
def test_rotated_corners_rotate_the_weights(shift):
    clip, face_ids, _ = scene()
    weights = np.asarray(find_weights(clip, FACES, face_ids))
    rotated = find_weights(clip, np.roll(FACES, shift, axis=1), face_ids)
    assert_close(rotated, np.roll(weights, shift, axis=-1), ulps=8)


def test_mirrored_winding_and_scale_do_not_matter():
    clip, face_ids, _ = scene()
    weights = np.asarray(find_weights(clip, FACES, face_ids))
    mirrored = find_weights(clip, FACES[:, ::-1], face_ids)
    assert_close(mirrored, weights[..., ::-1], ulps=8)
    assert_close(find_weights(clip * 2.0**-30, FACES, face_ids), weights, ulps=0)


def test_zero_area_shares_the_weight_and_no_face_has_none():
    clip = np.array([[0.3, 0.2, 0.1, 1.0]] * 3)
    face_ids = jnp.asarray([[0, -1], [-1, 0]])
    expected = np.where((face_ids >= 0)[..., None], 1 / 3, np.zeros((2, 2, 3)))
    assert_close(find_weights(clip, FACES[:1], face_ids), expected, ulps=1)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_bad_values_of_face_0_stay_out_of_empty_pixels(bad):
    clip, face_ids, _ = scene()
    ids = jnp.where(face_ids == 0, -1, face_ids)
    attributes = np.ones((18, 2))
    attributes[0] = bad
    spoiled = clip.copy()
    spoiled[0] = bad
    weights = find_weights(spoiled, FACES, ids)
    assert_close(weights, find_weights(clip, FACES, ids), ulps=0)
    value = blend(attributes, FACES, ids, weights)
    assert_close(value, np.where((ids >= 0)[..., None], np.ones((12, 16, 2)), 0.0), ulps=2)
    assert_close(find_depth(spoiled, FACES, ids), find_depth(clip, FACES, ids), ulps=0)
    faces_values = np.where(np.arange(6)[:, None] == 0, bad, 1.0)
    assert_close(gather_faces(faces_values, ids), np.where((ids >= 0)[..., None], 1.0, 0.0), ulps=0)


@pytest.mark.parametrize("axis", [0, 1])
def test_slopes_are_what_moving_the_picture_by_a_pixel_does(axis):
    """A picture moved against a pixel's step shows each centre the point one step on."""
    clip, face_ids, _ = scene()
    height, width = face_ids.shape
    step = np.zeros((1, 4))
    step[0, axis] = (-2 / width, 2 / height)[axis]
    moved = lambda pixels: find_weights(clip + pixels * step * clip[:, 3:], FACES, face_ids)
    _, expected = jax.jvp(moved, (0.0,), (1.0,))
    assert_close(find_slopes(clip, FACES, face_ids)[axis], expected, ulps=8)  # measured 0.75


def test_slopes_add_to_nothing_and_are_zero_without_a_face_or_an_area():
    clip, face_ids, _ = scene()
    for slope in find_slopes(clip, FACES, face_ids):
        assert_close(slope.sum(axis=-1), np.zeros(face_ids.shape), ulps=8)  # measured 0.5
        assert not np.any(slope[face_ids < 0])
    flat = np.tile(clip[:1], (18, 1))
    for slope in find_slopes(flat, FACES, jnp.zeros((12, 16), jnp.int32)):
        assert not np.any(slope)


# Derivatives


def test_derivatives_are_the_finite_differences():
    clip, face_ids, inside = scene()
    rng = np.random.default_rng(0)
    attributes, mix = rng.normal(size=(18, 2)), rng.normal(size=(12, 16, 2)) * inside[..., None]

    @jax.jit
    def loss(clip, attributes):
        values = interpolate(attributes, FACES, face_ids, barycentrics(clip, FACES, face_ids))
        depth = window_depth(clip, FACES, face_ids)
        return jnp.sum(mix * values**2) + jnp.sum(mix[..., 0] * depth)

    check_grads(loss, (clip, attributes), 1, ("fwd", "rev"), eps=1e-6, atol=1e-6, rtol=1e-6)


@jax.jit
def blended_gradient(clip, attributes, faces, face_ids, mix):
    """The gradient of a weighted sum of blended values, and of depths."""

    def total(clip):
        values = interpolate(attributes, faces, face_ids, barycentrics(clip, faces, face_ids))
        return jnp.sum(mix * (values[..., 0] + window_depth(clip, faces, face_ids)))

    return jax.grad(total)(clip)


def test_no_face_has_no_derivative():
    clip, face_ids, _ = scene()
    attributes = np.random.default_rng(0).normal(size=(18, 1))
    gradient = blended_gradient(clip, attributes, FACES, face_ids, 1.0 * (face_ids < 0))
    assert_close(gradient, np.zeros_like(clip), ulps=0)


@pytest.mark.parametrize("flat", ["point", "segment"])
def test_zero_area_has_no_derivative_and_spoils_no_other(flat):
    """Under jit, where a product may be fused with a sum: a b - a b need not be 0 then."""
    clip, face_ids, _ = scene()
    attributes = np.random.default_rng(0).normal(size=(18, 1))
    spoiled = clip.copy()
    spoiled[2] = clip[1] if flat == "segment" else clip[0]
    spoiled[1] = clip[1] if flat == "segment" else clip[0]
    on_flat = np.asarray(face_ids) == 0
    assert np.any(on_flat)
    weights = find_weights(spoiled, FACES, face_ids)
    assert_close(weights[on_flat], np.full((np.sum(on_flat), 3), 1 / 3), ulps=1)
    gradient = blended_gradient(spoiled, attributes, FACES, face_ids, 1.0 * on_flat)
    assert_close(gradient[:, :2], np.zeros((18, 2)), ulps=0)
    others = blended_gradient(spoiled, attributes, FACES, face_ids, 1.0 * ~on_flat)
    expected = blended_gradient(clip, attributes, FACES, face_ids, 1.0 * ~on_flat)
    assert_close(others[3:], expected[3:], ulps=0)


def test_derivative_on_an_edge_is_the_one_inside():
    """The value is x / 2 everywhere, so sliding right changes it by -1/2, edges included."""
    square = np.array([[-1, -1, 0, 1], [1, -1, 0, 1], [1, 1, 0, 1], [-1, 1, 0, 1.0]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    face_ids = jnp.asarray(rasterize_reference(square, faces, (8, 8)).face_ids)
    assert np.all(np.asarray(face_ids) == np.where(np.add.outer(range(8), range(8)) >= 7, 0, 1))
    attributes = 0.5 * square[:, :1]

    def slide(distance):
        clip = jnp.asarray(square).at[:, 0].add(distance)
        return blend(attributes, faces, face_ids, find_weights(clip, faces, face_ids))[..., 0]

    change = jax.jit(jax.jacfwd(slide))(0.0)
    assert_close(change, np.full((8, 8), -0.5), ulps=4)


# Transformations


def test_vmap_equals_a_loop():
    clip, face_ids, _ = scene()
    attributes = np.random.default_rng(0).normal(size=(18, 2))
    batch = np.stack([clip, 1.1 * clip + 0.01])

    def shade(clip):
        weights = barycentrics(clip, FACES, face_ids)
        return weights, interpolate(attributes, FACES, face_ids, weights)

    together = jax.jit(jax.vmap(shade))(batch)
    for k in range(2):
        weights = find_weights(batch[k], FACES, face_ids)
        assert_close(together[0][k], weights, ulps=16)
        assert_close(together[1][k], blend(attributes, FACES, face_ids, weights), ulps=16)
