"""The second layer: against the slow oracle, and what it says of closed and coincident faces."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from shadows.rasterize import rasterize, rasterize_two

from .reference import RasterReference, face_reference
from .test_rasterize import (
    FACE_COUNT,
    HEIGHT,
    SEPARATE,
    SOUPS,
    WIDTH,
    assert_agrees,
    clip_space,
    draw,
    filled_up,
    generic_scene,
    quad,
    sphere,
)
from .tools import assert_close

jitted = jax.jit(rasterize_two, static_argnames=("image_size", "chunk"))
draw_two = functools.partial(jitted, image_size=(HEIGHT, WIDTH))


def second_reference(clip_positions, faces, image_size):
    """Test every face at every pixel; the second in the order of depth, then index, stays."""
    clip_positions = np.asarray(clip_positions, np.float64)
    nearest, second = np.full((2, *image_size), np.inf)
    nearest_id, second_id = np.full((2, *image_size), -1)
    margin = np.full(image_size, np.inf)
    for face_id, face in enumerate(faces):
        seen = face_reference(clip_positions[face], *image_size)
        if seen is None:
            continue
        margin = np.minimum(margin, np.abs(seen.margin))
        first = seen.inside & (seen.depth < nearest)
        next_ = seen.inside & ~first & (seen.depth < second)
        second[first], second_id[first] = nearest[first], nearest_id[first]
        nearest[first], nearest_id[first] = seen.depth[first], face_id
        second[next_], second_id[next_] = seen.depth[next_], face_id
    return RasterReference(second_id, np.where(second_id >= 0, second, 1.0), margin)


def equal(raster, expected):
    assert_close(raster.face_ids, expected.face_ids)
    assert_close(raster.depth, expected.depth, ulps=0)


# Known answers


def stack(*depths, dtype=np.float32):
    """Squares over the whole image, at NDC depths."""
    quads = [quad(-1, 1, -1, 1, depth, dtype) for depth in depths]
    faces = np.concatenate([faces + 4 * k for k, (_, faces) in enumerate(quads)])
    return filled_up(np.concatenate([clip for clip, _ in quads]), faces)


draw_small = functools.partial(jitted, image_size=(8, 8), chunk=2**10)


@pytest.mark.parametrize(
    ("depths", "first", "second"),
    [
        ((0.5,), 0.75, 1.0),
        ((0.5, -0.5), 0.25, 0.75),
        ((0.5, -0.5, 0.0), 0.25, 0.5),
        ((-0.5, 0.0, 0.5, 0.9), 0.25, 0.5),
        ((0.0, 0.5, 0.0), 0.5, 0.5),
        ((-1.5, 0.0, 0.5), 0.5, 0.75),  # before the near plane
        ((0.0, 1.5), 0.5, 1.0),  # beyond the far plane
    ],
)
def test_squares_one_behind_another(depths, first, second, dtype):
    one, two = draw_small(*stack(*depths, dtype=dtype))
    assert two.depth.dtype == dtype
    assert_close(one.depth, np.full((8, 8), first), ulps=0)
    assert_close(two.depth, np.full((8, 8), second), ulps=0)
    assert bool(jnp.all((two.face_ids >= 0) == (second < 1)))


def test_faces_at_one_depth_are_two_layers_in_the_order_of_their_indices():
    one, two = draw_small(*stack(0.25, 0.25, 0.25, 0.25))
    assert_close(two.face_ids, np.asarray(one.face_ids) + 2)
    assert set(np.unique(one.face_ids)) == {0, 1}


def test_coincident_faces_of_a_soup():
    """Every face twice, in one order and then again: the copy is the second layer."""
    clip = SOUPS["perspective"](np.random.default_rng(1), np.float32)[: 3 * FACE_COUNT // 2]
    one, two = draw_two(np.tile(clip, (2, 1)), SEPARATE)
    covered = np.asarray(one.face_ids) >= 0
    assert covered.sum() > 500
    assert_close(two.face_ids[covered], np.asarray(one.face_ids)[covered] + FACE_COUNT // 2)
    assert_close(two.depth, one.depth, ulps=0)


def test_of_a_closed_sphere_it_is_the_back():
    clip, faces = sphere()
    one, two = draw_two(clip, faces)
    equal(one, draw(clip, faces, cull_back=True))
    equal(two, draw(clip, faces, cull_front=True))
    assert bool(jnp.all(two.depth >= one.depth))


# Laws


@pytest.mark.parametrize("soup", SOUPS)
def test_random_triangles_agree_with_the_oracle(soup, dtype):
    clip = SOUPS[soup](np.random.default_rng(0), dtype)
    one, two = draw_two(clip, SEPARATE)
    equal(one, draw(clip, SEPARATE))
    reference = second_reference(clip, SEPARATE, (HEIGHT, WIDTH))
    assert_agrees(two, reference, clip, SEPARATE)
    covered = np.asarray(two.face_ids) >= 0
    assert np.all(np.asarray(two.face_ids != one.face_ids)[covered])
    assert np.all(np.asarray(two.depth >= one.depth))


def test_permuted_faces_permute_the_indices():
    clip = SOUPS["perspective"](np.random.default_rng(3), np.float32)
    order = np.random.default_rng(0).permutation(FACE_COUNT)
    before, after = draw_two(clip, SEPARATE)[1], draw_two(clip, SEPARATE[order])[1]
    covered = np.asarray(before.face_ids) >= 0
    assert_close(after.depth, before.depth, ulps=0)
    assert_close(order[np.asarray(after.face_ids)][covered], np.asarray(before.face_ids)[covered])


def test_results_do_not_depend_on_the_chunk():
    clip = SOUPS["perspective"](np.random.default_rng(3), np.float32)
    for small, large in zip(
        draw_two(clip, SEPARATE, chunk=2**10), draw_two(clip, SEPARATE), strict=True
    ):
        equal(small, large)


# Derivatives


def depths_16(clip, faces):
    return [r.depth for r in rasterize_two(clip, faces, image_size=(16, 16), chunk=2**10)]


@jax.jit
def weighted_depths(clip, faces, weights):
    return sum(jnp.sum(w * depth) for w, depth in zip(weights, depths_16(clip, faces), strict=True))


def test_derivative_of_both_layers_is_the_finite_difference():
    clip, _, stable = generic_scene()
    arrays = filled_up(clip, SEPARATE[:6])
    behind = second_reference(clip, SEPARATE[:6], (16, 16))
    assert np.sum(stable & (behind.face_ids >= 0)) > 20
    weights = np.random.default_rng(0).normal(size=(2, 16, 16)) * stable
    loss = lambda positions: weighted_depths(positions, arrays[1], weights)
    check_grads(loss, (arrays[0],), 1, ("fwd", "rev"), eps=1e-6, atol=1e-7, rtol=1e-7)
    only_second = weights * np.array([0, 1])[:, None, None]
    gradient = jax.grad(weighted_depths)(*arrays, only_second)
    moved = np.unique(np.asarray(behind.face_ids)[stable & (behind.face_ids >= 0)])
    corners = np.isin(np.arange(24) // 3, moved)
    assert np.abs(gradient[corners]).max() > 0.1
    assert_close(gradient[~corners], np.zeros((24 - corners.sum(), 4)), ulps=0)


def test_pixels_without_a_second_face_have_no_derivative():
    clip, faces = stack(0.5, dtype=np.float64)
    weights = np.stack([np.zeros((16, 16)), np.ones((16, 16))])
    assert_close(jax.grad(weighted_depths)(clip, faces, weights), np.zeros_like(clip), ulps=0)


# Errors and transformations


@pytest.mark.errors
@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"clip_positions": np.zeros((3, 3))}, "expected `clip_positions` of shape"),
        ({"faces": np.zeros((1, 2), int)}, "expected `faces` of shape"),
        ({"image_size": (0, 8)}, "expected `image_size`"),
        ({"chunk": 7}, "expected `chunk`"),
    ],
)
def test_wrong_argument_is_named(change, says):
    arrays = dict(zip(("clip_positions", "faces"), quad(-1, 1, -1, 1), strict=True))
    with pytest.raises(ValueError, match=rf"^rasterize: {says}"):
        rasterize_two(**{**arrays, "image_size": (8, 8), **change})


def test_missing_vertex_is_an_error():
    clip, faces = quad(-1, 1, -1, 1)
    with pytest.raises(eqx.EquinoxRuntimeError, match="refers to a vertex outside"):
        jax.block_until_ready(rasterize_two(clip, faces + 1, image_size=(8, 8), chunk=2**10))


def test_vmap_equals_a_loop():
    batch = np.stack([stack(*depths)[0] for depths in ((0.5, 0.0), (-0.5, 0.25))])
    faces = stack(0.5, 0.0)[1]
    together = jax.vmap(draw_small, in_axes=(0, None))(batch, faces)
    for k, clip in enumerate(batch):
        for both, alone in zip(together, draw_small(clip, faces), strict=True):
            equal(jax.tree.map(lambda x, k=k: x[k], both), alone)


def test_jit_equals_no_jit():
    clip, faces = stack(0.5, -0.25, 0.0)
    plain = rasterize_two(clip, faces, image_size=(8, 8), chunk=2**10)
    for one, other in zip(plain, draw_small(clip, faces), strict=True):
        equal(one, other)


def test_a_lower_layer_count_is_rasterize():
    """The same faces through both functions, on pixels with one face and with none."""
    clip = clip_space(np.array([[-1, -1, 0], [0.5, -1, 0.3], [0, 1, 0.1]]))
    arrays = filled_up(clip, SEPARATE[:1])
    one, two = draw_small(*arrays)
    equal(one, rasterize(*arrays, image_size=(8, 8), chunk=2**10))
    assert int(jnp.max(two.face_ids)) == -1
    assert_close(two.depth, np.ones((8, 8)), ulps=0)
