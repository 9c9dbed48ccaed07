"""The rasterizer against a slow oracle and the laws of OpenGL: which face, how deep.

The oracle computes in float64 from the same coordinates. Where it and the rasterizer see the
same face, depths may differ by rounding times the condition of the depth; where they do not,
the centre must lie within rounding of an edge, or the two depths within rounding of each other.
"""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from jax.test_util import check_grads
from scipy.spatial import ConvexHull, Delaunay

from shadows.rasterize import rasterize
from shadows.transforms import perspective

from .reference import RasterReference, pixel_grid, plane_reference, rasterize_reference
from .tools import assert_close

HEIGHT, WIDTH = 48, 64
FACE_COUNT = 64
SEPARATE = np.arange(3 * FACE_COUNT, dtype=np.int32).reshape(-1, 3)  # no shared vertices
# Depth: times eps, times the condition. Measured over 40 seeds: 1.24 in float32; 56 in float64,
# where the oracle itself rounds (slivers), 2.1 without them.
ULPS = {np.dtype(np.float32): 2.5, np.dtype(np.float64): 112}
MARGIN = 1e-5  # pixels, in float32; measured: not one of 840 000 covered pixels differs

STATIC = ("image_size", "cull_back", "cull_front", "chunk")
jitted = jax.jit(rasterize, static_argnames=STATIC)
draw = functools.partial(jitted, image_size=(HEIGHT, WIDTH))


def filled_up(clip_positions, faces, vertex_count=24, face_count=8):
    """Add unused vertices, and faces of three equal corners: so that few shapes compile."""
    clip_positions = np.pad(clip_positions, ((0, vertex_count - len(clip_positions)), (0, 0)))
    return clip_positions, np.pad(np.int32(faces), ((0, face_count - len(faces)), (0, 0)))


def draw_small(clip_positions, faces):
    """Draw up to 24 vertices and 8 faces."""
    return jitted(*filled_up(clip_positions, faces), image_size=(8, 8), chunk=2**10)


def clip_space(xyz, w=1.0, dtype=np.float32):
    """NDC positions (any shape, 3) as clip positions (vertices, 4) with the given w."""
    xyz1 = np.concatenate([xyz, np.ones((*np.shape(xyz)[:-1], 1))], axis=-1)
    return (xyz1 * np.asarray(w)[..., None]).reshape(-1, 4).astype(dtype)


def project(points, near, far, dtype=np.float32):
    """View-space points (any shape, 3) as clip positions of a perspective view."""
    matrix = np.asarray(perspective(1.0, WIDTH / HEIGHT, near, far))
    xyz1 = np.concatenate([points, np.ones((*points.shape[:-1], 1))], axis=-1)
    return (xyz1 @ matrix.T).reshape(-1, 4).astype(dtype)


def mixed_sizes(rng):
    """Triangles from a hundredth of a pixel to several screens."""
    middle = rng.uniform(-1.2, 1.2, (FACE_COUNT, 1, 3))
    size = 10 ** rng.uniform(-3.5, 0.7, (FACE_COUNT, 1, 1))
    return middle + size * rng.normal(size=(FACE_COUNT, 3, 3))


def slivers(rng):
    """Long triangles, from half a pixel wide to nothing."""
    start, end = rng.uniform(-1.2, 1.2, (2, FACE_COUNT, 1, 3))
    width = 10 ** rng.uniform(-8, -1.5, (FACE_COUNT, 1, 1))
    along = rng.uniform(size=(FACE_COUNT, 3, 1))
    return start + (end - start) * along + width * rng.normal(size=(FACE_COUNT, 3, 3))


def edge_on(rng):
    """Triangles whose plane passes through the eye, some but for the last digits."""
    a, b = rng.normal(size=(2, FACE_COUNT, 1, 3))
    points = np.concatenate([a, b, a * rng.normal(size=(FACE_COUNT, 1, 1)) - b], axis=1)
    return points + rng.choice([0, 1e-7, 1e-5], (FACE_COUNT, 1, 1)) * rng.normal(size=points.shape)


def around_the_eye(rng):
    """Triangles with corners in front of and behind the eye."""
    size = 10 ** rng.uniform(-1, 2, (FACE_COUNT, 1, 1))
    return rng.normal(size=(FACE_COUNT, 3, 3)) * size


def duplicates(rng):
    """Every triangle four times, with its corners rotated and mirrored."""
    faces = mixed_sizes(rng)[: FACE_COUNT // 4]
    return np.concatenate([faces, faces, faces[:, [1, 2, 0]], faces[:, ::-1]])


def zero_area(rng):
    """Points, segments and proper triangles, mixed."""
    faces = mixed_sizes(rng)
    faces[::4, 1] = faces[::4, 0]
    faces[::8, 2] = faces[::8, 0]
    faces[1::4, 2] = 0.5 * (faces[1::4, 0] + faces[1::4, 1])
    return faces


def huge(rng):
    """Triangles of up to a million screens."""
    faces = mixed_sizes(rng)
    faces[..., :2] *= 10 ** rng.uniform(0, 6, (FACE_COUNT, 1, 1))
    faces[..., 2] = rng.uniform(-1, 1, (FACE_COUNT, 3))
    return faces


SOUPS = {
    "orthographic": lambda rng, dtype: clip_space(mixed_sizes(rng), dtype=dtype),
    "any w": lambda rng, dtype: clip_space(
        mixed_sizes(rng), w=10 ** rng.uniform(-3, 3, (FACE_COUNT, 3)), dtype=dtype
    ),
    "perspective": lambda rng, dtype: project(mixed_sizes(rng) - [0, 0, 2], 0.1, 100.0, dtype),
    "around the eye": lambda rng, dtype: project(around_the_eye(rng), 0.01, 1000.0, dtype),
    "wide near plane": lambda rng, dtype: project(around_the_eye(rng), 1.0, 50.0, dtype),
    "slivers": lambda rng, dtype: clip_space(slivers(rng), dtype=dtype),
    "edge-on": lambda rng, dtype: project(edge_on(rng), 0.1, 100.0, dtype),
    "duplicates": lambda rng, dtype: clip_space(duplicates(rng), dtype=dtype),
    "zero area": lambda rng, dtype: clip_space(zero_area(rng), dtype=dtype),
    "huge": lambda rng, dtype: clip_space(huge(rng), dtype=dtype),
}


def assert_agrees(raster, reference: RasterReference, clip_positions, faces):
    """Assert that a raster is the oracle's, but for what rounding explains."""
    eps, ulps = np.finfo(clip_positions.dtype).eps, ULPS[clip_positions.dtype]
    found, expected = np.asarray(raster.face_ids), reference.face_ids
    depth_found, condition_found = plane_reference(clip_positions, faces, found)
    depth_expected, condition = plane_reference(clip_positions, faces, expected)
    covered = expected >= 0
    same = found == expected
    error = np.abs(np.asarray(raster.depth, np.float64) - reference.depth)
    share = np.where(same & covered, error / (eps * np.maximum(condition, 1)), 0)
    assert share.max() <= ulps, f"depth: measured {share.max():.3g} eps, allowed {ulps}"
    assert np.all(np.asarray(raster.depth)[found < 0] == 1)

    coverage_differs = (found >= 0) != covered
    assert np.sum(coverage_differs) <= 1e-4 * np.sum(covered), "coverage"
    both = (found >= 0) & covered
    gap = np.abs(depth_found - depth_expected)
    equally_near = both & (gap <= 2 * ulps * eps * (condition + condition_found))
    rounding = reference.margin <= MARGIN * eps / np.finfo(np.float32).eps
    unexplained = ~(same | equally_near | rounding)
    assert not unexplained.any(), (
        f"{unexplained.sum()} pixels see another face than the oracle, first (row, column) "
        f"{tuple(np.argwhere(unexplained)[0])}"
    )


# Known answers


def quad(left, right, bottom, top, depth=0.0, dtype=np.float32):
    """Two triangles, counter-clockwise, at an NDC depth."""
    xyz = [(left, bottom, depth), (right, bottom, depth), (right, top, depth), (left, top, depth)]
    return clip_space(np.array(xyz), dtype=dtype), np.array([[0, 1, 2], [0, 2, 3]], np.int32)


def covered_by(clip_positions, faces=SEPARATE[:1]):
    return np.asarray(draw_small(clip_positions, faces).face_ids) >= 0


def test_row_0_is_at_the_top_and_column_0_on_the_left(dtype):
    raster = draw_small(*quad(-1, 0, 0.5, 1, depth=0.5, dtype=dtype))
    expected = np.zeros((8, 8), bool)
    expected[:2, :4] = True
    assert_close(raster.face_ids >= 0, expected)
    assert_close(raster.depth, np.where(expected, 0.75, 1.0), ulps=0)
    assert raster.depth.dtype == dtype
    assert np.all(np.asarray(raster.face_ids)[~expected] == -1)


@pytest.mark.parametrize(("ndc", "window"), [(-1.0, 0.0), (0.0, 0.5), (1.0, 1.0)])
def test_window_depth_is_half_of_ndc_depth_plus_a_half(ndc, window, dtype):
    assert_close(draw_small(*quad(-1, 1, -1, 1, ndc, dtype)).depth, np.full((8, 8), window), ulps=0)


@pytest.mark.parametrize(("offset", "count"), [(-0.01, 0), (0.01, 1)])
def test_pixel_centres_are_at_half_integers(offset, count):
    """A square that ends just before, or just behind, the centre of row 3, column 5."""
    right, bottom = 2 * (5.5 + offset) / 8 - 1, 1 - 2 * (3.5 + offset) / 8
    covered = covered_by(*quad(right - 0.2, right, bottom, bottom + 0.2))
    assert np.sum(covered) == count
    assert covered[3, 5] == bool(count)


def test_a_centre_on_an_edge_belongs_to_the_face_on_its_right_or_below():
    """The square runs from the centre of pixel (2, 1) to that of (6, 5)."""
    expected = np.zeros((8, 8), bool)
    expected[2:6, 1:5] = True
    assert_close(covered_by(*quad(-0.625, 0.375, -0.625, 0.375)), expected)


def test_diagonal_through_centres_is_the_right_face_s():
    face_ids = draw_small(*quad(-1, 1, -1, 1)).face_ids
    on_or_right_of_diagonal = np.add.outer(np.arange(8), np.arange(8)) >= 7
    assert_close(face_ids, np.where(on_or_right_of_diagonal, 0, 1).astype(np.int32))


def test_only_what_lies_between_near_and_far_plane_is_kept():
    """NDC depth runs from -2 on the left edge to 2 on the right one."""
    clip = clip_space(np.array([[-1, -3, -2], [1, -3, 2], [1, 5, 2], [-1, 5, -2.0]]))
    raster = draw_small(clip, np.array([[0, 1, 2], [0, 2, 3]], np.int32))
    centres = 2 * (2 * np.arange(8) + 1) / 8 - 2
    kept = np.abs(centres) <= 1
    assert_close(raster.depth, np.tile(np.where(kept, 0.5 * centres + 0.5, 1), (8, 1)), ulps=1)
    assert_close(raster.face_ids >= 0, np.tile(kept, (8, 1)))


@pytest.mark.parametrize("ndc_depth", [-1, 1])
def test_faces_in_the_near_or_the_far_plane_are_kept_whole(ndc_depth):
    """A sky is drawn at z = w: rounding must not push single pixels out."""
    clip = SOUPS["any w"](np.random.default_rng(0), np.float32)
    in_plane = clip.copy()
    in_plane[:, 2] = ndc_depth * clip[:, 3]
    raster = draw(in_plane, SEPARATE)
    flat = rasterize_reference(clip * [1, 1, 0, 1], SEPARATE, (HEIGHT, WIDTH))
    covered = flat.face_ids >= 0
    assert_close(raster.face_ids >= 0, covered)
    assert_close(raster.depth, np.where(covered, 0.5 * ndc_depth + 0.5, 1.0), ulps=0)


def test_floor_from_behind_the_eye_to_the_horizon():
    """A plane at height -1: a row at NDC y sees it at the distance f / -y, f the focal length."""
    near, far = 0.1, 10.0
    corners = np.array([[-1e3, -1, 1e2], [1e3, -1, 1e2], [0, -1, -1e3]])
    clip = project(corners, near, far)
    raster = draw(clip, SEPARATE[:1])
    focal = 1 / np.tan(0.5)
    _, y = pixel_grid(HEIGHT, WIDTH)
    seen = y <= -focal / 10.0
    assert np.sum(seen) > 1000
    distance = np.where(seen, -focal / y, 1.0)
    expected = np.where(seen, far * (distance - near) / ((far - near) * distance), 1.0)
    assert_close(raster.face_ids >= 0, seen)
    # 11 measured: the corners reach far behind the eye, where w cancels.
    assert_close(raster.depth, expected, ulps=64)


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_the_nearer_face_wins_whatever_the_order(order):
    near, far = (quad(-1, 1, -1, 1, depth)[0][:3] for depth in (-0.5, 0.5))
    clip = np.concatenate([(near, far)[k] for k in order])
    covered = covered_by(near)
    expected = np.where(covered, order.index(0), -1).astype(np.int32)
    assert_close(draw_small(clip, SEPARATE[:2]).face_ids, expected)


def test_of_equally_near_faces_the_lowest_index_wins():
    clip = np.tile(SOUPS["perspective"](np.random.default_rng(1), np.float32)[:48], (4, 1))
    reference = draw(clip, SEPARATE)
    assert np.max(reference.face_ids) < 16
    assert_close(draw(clip, SEPARATE[16:]).face_ids, reference.face_ids)


def test_indices_and_the_order_of_ties_hold_across_chunks():
    """One half of the square 2999 times, the other half in the third chunk only."""
    clip, faces = quad(-1, 1, -1, 1)
    many = np.tile(faces[:1], (3000, 1))
    many[2500] = faces[1]
    face_ids = jitted(clip, many, image_size=(8, 8), chunk=2**10).face_ids
    assert_close(face_ids, np.where(draw_small(clip, faces).face_ids == 0, 0, 2500))


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("axis", range(4))
def test_faces_with_a_coordinate_that_is_not_finite_are_left_out(value, axis):
    clip = SOUPS["perspective"](np.random.default_rng(2), np.float32)
    clip[:12:4, axis] = value
    raster = draw(clip, SEPARATE)
    assert_agrees(raster, rasterize_reference(clip, SEPARATE, (HEIGHT, WIDTH)), clip, SEPARATE)


def test_rows_beyond_2_to_the_24_in_one_chunk_are_not_lost():
    """1152 faces, each 16 383 rows high: more rows than float32 can count."""
    count, nearest, height = 1152, 1101, 2**14
    face = np.array([[-3, 1 - 2 / height, 0.5], [3, 1 - 2 / height, 0.5], [0, -2e4, 0.5]])
    corners = np.tile(face, (count, 1, 1))
    corners[nearest, :, 2] = -0.5
    faces = np.arange(3 * count, dtype=np.int32).reshape(-1, 3)
    face_ids = jitted(clip_space(corners), faces, image_size=(height, 1)).face_ids
    expected = np.where(np.arange(height) == 0, -1, nearest).astype(np.int32)
    assert_close(face_ids[:, 0], expected)


# Laws: the oracle


@pytest.mark.parametrize("soup", SOUPS)
@pytest.mark.parametrize("seed", range(3))
def test_random_triangles_agree_with_the_oracle(soup, seed, dtype):
    clip = SOUPS[soup](np.random.default_rng(seed), dtype)
    reference = rasterize_reference(clip, SEPARATE, (HEIGHT, WIDTH))
    assert_agrees(draw(clip, SEPARATE), reference, clip, SEPARATE)


EIGHTHS = st.integers(-16, 16)


@given(arrays(np.int32, (24, 3), elements=EIGHTHS), st.sampled_from([1, 2, 3, 5, 8]))
@settings(max_examples=60)
def test_vertices_on_a_lattice_agree_with_the_oracle(lattice, w):
    """Coordinates in eighths: edges and vertices on centres, duplicates and flat faces abound."""
    clip = clip_space(lattice / 8, w=float(w))
    raster = draw_small(clip, SEPARATE[:8])
    assert_agrees(raster, rasterize_reference(clip, SEPARATE[:8], (8, 8)), clip, SEPARATE[:8])


@given(arrays(np.int32, (24, 3), elements=EIGHTHS))
@settings(max_examples=60)
def test_lattice_around_the_eye_agrees_with_the_oracle(lattice):
    """Near plane at 1, far plane at 3, so that ``z = 2 w - 3`` is exact."""
    x, y, distance = lattice.T / 4
    clip = np.stack([x, y, 2 * distance - 3, distance], axis=-1).astype(np.float32)
    raster = draw_small(clip, SEPARATE[:8])
    assert_agrees(raster, rasterize_reference(clip, SEPARATE[:8], (8, 8)), clip, SEPARATE[:8])


# Laws: every centre once


@functools.partial(jax.jit, static_argnames="cull_back")
def _count_faces(clip_positions, faces, cull_back):

    def step(total, face):
        options = {"image_size": (64, 64), "chunk": 2**10, "cull_back": cull_back}
        raster = rasterize(clip_positions, face[None], **options)
        return total + (raster.face_ids >= 0), None

    return jax.lax.scan(step, jnp.zeros((64, 64), jnp.int32), faces)[0]


def count_faces(clip_positions, faces, *, cull_back=False):
    """How many faces cover each pixel of 64 x 64, each face drawn alone."""
    return _count_faces(*filled_up(clip_positions, faces, 240, 480), cull_back)


def triangulation(points):
    """A planar triangulation that reaches beyond the screen."""
    frame = np.array([[-1.5, -1.5], [1.5, -1.5], [1.5, 1.5], [-1.5, 1.5]])
    points = np.concatenate([frame, points])
    return points, Delaunay(points).simplices.astype(np.int32)


@pytest.mark.parametrize("w", ["one", "very different"])
@pytest.mark.parametrize("seed", range(2))
def test_triangulation_covers_every_centre_once(seed, w):
    rng = np.random.default_rng(seed)
    xy, faces = triangulation(rng.uniform(-1, 1, (220, 2)))
    factors = 1.0 if w == "one" else 10 ** rng.uniform(-3, 3, len(xy))
    clip = clip_space(np.pad(xy, ((0, 0), (0, 1))), w=factors)
    assert_close(count_faces(clip, faces), np.ones((64, 64), np.int32))


@pytest.mark.parametrize("share", [1.0, 0.5])
@pytest.mark.parametrize("seed", range(3))
def test_triangulation_with_vertices_on_centres_covers_every_centre_once(seed, share):
    """All vertices on centres, or every other one: then edges meet the rows at any angle."""
    rng = np.random.default_rng(seed)
    centres = (2 * rng.integers(0, 64, (220, 2)) + 1) / 64 - 1
    anywhere = rng.uniform(-1, 1, (220, 2))
    points = np.where(rng.uniform(size=(220, 1)) < share, centres, anywhere)
    xy, faces = triangulation(np.unique(points, axis=0))
    clip = clip_space(np.pad(xy, ((0, 0), (0, 1))), w=2.0 ** rng.integers(-3, 4, len(xy)))
    assert_close(count_faces(clip, faces), np.ones((64, 64), np.int32))


def test_sheet_across_the_near_plane_leaves_no_gap():
    """A bumpy ceiling from behind the eye to beyond the far plane."""
    rng = np.random.default_rng(0)
    xy, faces = triangulation(rng.uniform(-1, 1, (220, 2)))
    points = np.stack([20 * xy[:, 0], 1 + 0 * xy[:, 0], 20 * xy[:, 1]], axis=-1)
    clip = project(points, 0.5, 25.0)
    _, y = pixel_grid(64, 64)
    distance = 1 / np.tan(0.5) / np.where(y > 0, y, 1e-9)
    assert_close(count_faces(clip, faces), np.where(distance <= 25.0, 1, 0).astype(np.int32))


def sphere():
    """A closed sphere of 476 faces, radius 1, in view of a perspective camera at distance 3."""
    points = np.random.default_rng(0).normal(size=(240, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    faces = ConvexHull(points).simplices
    outward = np.linalg.det(points[faces]) > 0
    faces = np.where(outward[:, None], faces, faces[:, ::-1])
    return project(points - [0, 0, 3], 1.0, 5.0), faces


def test_closed_sphere_has_one_front_and_one_back_at_every_centre():
    clip, faces = sphere()
    front, both = count_faces(clip, faces, cull_back=True), count_faces(clip, faces)
    assert np.max(front) == 1
    assert np.sum(front) > 500
    assert_close(both, 2 * np.asarray(front))


# Laws: what changes nothing, or something known


@pytest.mark.parametrize("shift", [(1, 0), (0, -2), (-3, 5)])
def test_whole_pixels_translate_the_image(shift):
    """Coordinates of few bits, so that the arithmetic is exact; z free."""
    rng = np.random.default_rng(0)
    middle = rng.uniform(-0.6, 0.6, (FACE_COUNT, 1, 2))
    xy = np.round((middle + 0.1 * rng.normal(size=(FACE_COUNT, 3, 2))) * 256) / 256
    xy = np.clip(xy, -0.75, 0.75)
    z = rng.integers(-8, 8, (FACE_COUNT, 3, 1)) / 8
    move = np.array([shift[0], -shift[1], 0]) * 2 / 64
    square = functools.partial(jitted, image_size=(64, 64))
    before = square(clip_space(np.concatenate([xy, z], -1)), SEPARATE)
    after = square(clip_space(np.concatenate([xy, z], -1) + move), SEPARATE)
    assert np.sum(before.face_ids >= 0) > 500
    for image, moved in zip(before, after, strict=True):
        assert_close(moved, np.roll(image, shift[::-1], axis=(0, 1)), ulps=0)


@pytest.mark.parametrize("soup", ["orthographic", "perspective", "around the eye"])
class TestSymmetries:
    """Ways to write the same scene."""

    @pytest.fixture
    def clip(self, soup):
        return SOUPS[soup](np.random.default_rng(3), np.float32)

    def test_permuted_faces_permute_the_indices(self, clip):
        order = np.random.default_rng(0).permutation(FACE_COUNT)
        before, after = draw(clip, SEPARATE), draw(clip, SEPARATE[order])
        covered = before.face_ids >= 0
        assert_close(after.depth, before.depth, ulps=0)
        assert_close(covered, after.face_ids >= 0)
        assert_close(order[after.face_ids][covered], np.asarray(before.face_ids)[covered])

    def test_rotated_corners_change_nothing(self, clip):
        before, after = draw(clip, SEPARATE), draw(clip, np.roll(SEPARATE, 1, axis=1))
        assert_close(after.face_ids, before.face_ids)
        assert_close(after.depth, before.depth, ulps=0)

    def test_mirrored_winding_changes_nothing(self, clip):
        before, after = draw(clip, SEPARATE), draw(clip, SEPARATE[:, ::-1])
        assert_close(after.face_ids, before.face_ids)
        # 1.5 measured here, 16 for other seeds: a b - c d is rounded once or twice.
        assert_close(after.depth, before.depth, ulps=32)

    @pytest.mark.parametrize("factor", [2.0**40, 2.0**-40, 3.0])
    def test_scaled_clip_coordinates_change_nothing(self, clip, factor):
        scaled = (clip.astype(np.float64) * factor).astype(np.float32)
        before, after = draw(clip, SEPARATE), draw(scaled, SEPARATE)
        assert_close(after.face_ids, before.face_ids)
        if factor != 3.0:
            assert_close(after.depth, before.depth, ulps=0)
            return
        reference = rasterize_reference(scaled, SEPARATE, (HEIGHT, WIDTH))
        assert_agrees(after, reference, scaled, SEPARATE)

    def test_results_do_not_depend_on_the_chunk(self, clip):
        """Up to 3072 rows here, so three chunks of them or one."""
        small, large = draw(clip, SEPARATE, chunk=2**10), draw(clip, SEPARATE)
        assert_close(small.face_ids, large.face_ids)
        assert_close(small.depth, large.depth, ulps=0)


# Laws: the winding


def visible(clip_positions, **culling):
    """Whether a single face covers any pixel."""
    arrays = filled_up(clip_positions, SEPARATE[:1], 3 * FACE_COUNT, FACE_COUNT)
    return bool(np.any(np.asarray(draw(*arrays, **culling).face_ids) >= 0))


COUNTER_CLOCKWISE = np.array([[-1, -1, 0], [1, -1, 0], [0, 1, 0.0]])


@pytest.mark.parametrize("corners", [(0, 1, 2), (1, 2, 0), (2, 1, 0), (0, 2, 1)])
def test_counter_clockwise_faces_are_front_faces(corners):
    front = corners in ((0, 1, 2), (1, 2, 0))
    clip = clip_space(COUNTER_CLOCKWISE[list(corners)], w=3.0)
    assert visible(clip)
    assert visible(clip, cull_back=True) == front
    assert visible(clip, cull_front=True) != front


@pytest.mark.parametrize("soup", ["perspective", "around the eye", "wide near plane"])
@pytest.mark.parametrize("culling", ["cull_back", "cull_front"])
def test_culling_agrees_with_the_oracle(soup, culling):
    clip = SOUPS[soup](np.random.default_rng(4), np.float32)
    raster = draw(clip, SEPARATE, **{culling: True})
    reference = rasterize_reference(clip, SEPARATE, (HEIGHT, WIDTH), **{culling: True})
    assert_agrees(raster, reference, clip, SEPARATE)


def test_floor_seen_from_above_is_a_front_face_also_across_the_near_plane():
    """Counter-clockwise from above; from below the same floor is a back face."""
    corners = np.array([[-9, 0, 9], [9, 0, 9], [0, 0, -20.0]])
    for height, front in ((-1, True), (1, False)):
        clip = project(corners + height * np.array([0, 1, 0]), 0.1, 50.0)
        assert visible(clip, cull_back=True) == front
        assert visible(clip, cull_front=True) != front


def test_small_faces_are_not_culled_by_rounding():
    """Faces of a third of a pixel of a 4096 image, seen in perspective, all counter-clockwise."""
    rng = np.random.default_rng(0)
    count = 4096
    middle = np.stack([*np.meshgrid(*2 * [(2 * np.arange(64) + 1) / 64 - 1])], -1).reshape(-1, 1, 2)
    size = 2 / 4096
    corners = size * np.array([[-0.2, -0.2], [0.2, -0.2], [0.0, 0.3]])
    xyz = np.pad(middle + corners, ((0, 0), (0, 0), (0, 1)))
    w = rng.uniform(1, 10, (count, 1)) * (1 + 1e-3 * rng.normal(size=(count, 3)))
    faces = np.arange(3 * count, dtype=np.int32).reshape(-1, 3)
    raster = jitted(clip_space(xyz, w=w), faces, image_size=(64, 64), cull_back=True)
    covered = np.mean(raster.face_ids >= 0)
    assert covered == 1, f"{1 - covered:.2%} of the faces are missing"


# Derivatives


def depth_16(clip_positions, faces):
    return rasterize(clip_positions, faces, image_size=(16, 16), chunk=2**10).depth


weighted_depth = jax.jit(lambda clip, faces, weights: jnp.sum(weights * depth_16(clip, faces)))
weighted_gradient = jax.jit(jax.grad(weighted_depth))


def depth_gradient(clip, faces, weights=1.0):
    """The gradient of the weighted sum of the depths of 16 x 16 pixels."""
    weights = np.broadcast_to(np.asarray(weights, clip.dtype), (16, 16))
    return np.asarray(weighted_gradient(*filled_up(clip, faces), weights))[: len(clip)]


def generic_scene():
    """Six faces, float64: clip positions, face ids, and which pixels are off all edges."""
    points = np.random.default_rng(7).uniform([-2, -2, -5], [2, 2, -2], (6, 3, 3))
    points[0, 0] = [1, -1, 1]  # behind the eye
    clip = project(points, 0.5, 6.0, np.float64)
    reference = rasterize_reference(clip, SEPARATE[:6], (16, 16))
    return clip, reference.face_ids, reference.margin > 1e-3


def test_depth_derivative_is_the_finite_difference():
    clip, face_ids, stable = generic_scene()
    assert np.sum(stable & (face_ids >= 0)) > 60
    assert len(np.unique(face_ids)) > 4
    clip, faces = filled_up(clip, SEPARATE[:6])
    weights = np.random.default_rng(0).normal(size=(16, 16)) * stable
    loss = lambda clip: weighted_depth(clip, faces, weights)
    check_grads(loss, (clip,), 1, ("fwd", "rev"), eps=1e-6, atol=1e-7, rtol=1e-7)


def test_pixels_without_a_face_have_no_derivative():
    clip, face_ids, _ = generic_scene()
    assert np.any(face_ids < 0)
    assert_close(depth_gradient(clip, SEPARATE[:6], face_ids < 0), np.zeros_like(clip), ulps=0)


def test_hidden_and_unused_vertices_have_no_derivative():
    near, faces = quad(-1, 1, -1, 1, -0.5, np.float64)
    far, _ = quad(-1, 1, -1, 1, 0.5, np.float64)
    clip = np.concatenate([near, far, np.zeros((1, 4))])
    gradient = depth_gradient(clip, np.concatenate([faces, faces + 4]))
    assert_close(gradient[4:], np.zeros((5, 4)), ulps=0)
    assert np.all(np.abs(gradient[:4, 2]) > 1)


@pytest.mark.parametrize("seed", range(3))
def test_derivative_at_centres_on_an_edge_is_that_of_the_face_s_plane(seed):
    """The depth is x / 4 + 1/2 and slides to the right, where rounding puts centres on an edge.

    The shared edge has slope 1/3 and passes through six centres; the corners' w are random, so
    that its centres lie on either side of it in the last digit.
    """
    w = np.random.default_rng(seed).uniform(1, 10, 4)
    corners = np.array([[-3, -1, -1.5], [1, -1, 0.5], [3, 1, 1.5], [-3, 3, -1.5]]) * [1, 1, 0.5]
    clip, faces = clip_space(corners, w, np.float64), np.array([[0, 1, 2], [0, 2, 3]])
    for row, column in ((5, 15), (6, 12), (7, 9), (8, 6), (9, 3), (10, 0)):
        at_pixel = np.zeros((16, 16))
        at_pixel[row, column] = 1
        change = np.sum(depth_gradient(clip, faces, at_pixel)[:, 0] * w)
        assert_close(change, -0.125, ulps=4)  # 0.13 measured


NOTHING = {
    "point": [(0, -0.5, 0, 1)] * 3,
    "segment": [(-0.5, -0.5, 0, 1), (0.5, 0.5, 0, 1), (0, 0, 0.5, 1)],
    "nan": [(0, 0, np.nan, 1), (-0.5, -0.5, 0, 1), (0.5, -0.5, 0.1, 1)],
    "infinite": [(np.inf, 0, 0, 1), (-0.5, -0.5, 0, 1), (0.5, -0.5, 0.1, 1)],
    "tiny": [(0.0625 + x, 0.0625 + y, 0, 1) for x, y in ((1e-8, 0), (2e-8, 0), (1e-8, 1e-8))],
    "tiny, near the eye": np.array([(1, 1, 1, 1), (1 + 1e-6, 1, 1, 1), (1, 1 + 1e-6, 1, 1)]) * 1e-9,
    "huge": [(-1e30, 1e30, 0, 1), (0, 2e30, 0, 1), (0, 3e30, 0, 1)],
    "at the eye": [(0, 0, -1, 0), (1, 0, -1, 0), (0, 1, -1, 0)],
}
GOOD = [(-0.5, -0.5, 0, 1), (0.5, -0.5, 0.1, 1), (0, 0.5, 0.2, 1)]


@pytest.mark.parametrize("flaw", NOTHING)
def test_invisible_first_face_leaves_the_other_derivatives_alone(flaw):
    """Whatever pixels without a face look at, its derivative is not to poison the others'."""
    clip = np.array([*NOTHING[flaw], *GOOD], np.float32)
    assert not np.any(np.asarray(draw_small(clip, SEPARATE[:2]).face_ids) == 0)
    expected = depth_gradient(clip, SEPARATE[[1, 1]])
    assert np.sum(np.abs(expected)) > 1
    assert_close(depth_gradient(clip, SEPARATE[:2]), expected, ulps=0)


def test_invisible_first_face_leaves_shared_corners_alone():
    """Face 0 has a corner at infinity, and the other two in common with a good face."""
    clip = np.array([(np.inf, 0, 0, 1), *GOOD], np.float32)
    expected = depth_gradient(clip, [[1, 2, 3]])
    assert_close(depth_gradient(clip, [[0, 1, 2], [1, 2, 3]]), expected, ulps=0)


def test_derivative_under_vmap_equals_a_loop():
    clip, faces = filled_up(generic_scene()[0], SEPARATE[:6])
    batch, weights = np.stack([clip, clip + 0.01]), np.ones((16, 16))
    alone = np.stack([weighted_gradient(clip, faces, weights) for clip in batch])
    together = jax.vmap(weighted_gradient, in_axes=(0, None, None))(batch, faces, weights)
    assert_close(together, alone, ulps=64)


# Errors


CLIP, FACES = quad(-1, 1, -1, 1)


@pytest.mark.errors
@pytest.mark.parametrize(
    ("change", "expected", "got"),
    [
        ({"clip_positions": CLIP[:, :3]}, "clip_positions.*shape", r"\(4, 3\)"),
        ({"clip_positions": CLIP[0]}, "clip_positions.*shape", r"\(4,\)"),
        ({"clip_positions": CLIP[:0]}, "clip_positions.*shape", r"\(0, 4\)"),
        ({"clip_positions": CLIP.astype(int)}, "clip_positions.*float", "int64"),
        ({"clip_positions": CLIP.astype(np.float16)}, "clip_positions.*float", "float16"),
        ({"faces": FACES[:, :2]}, "faces.*shape", r"\(2, 2\)"),
        ({"faces": FACES[:0]}, "faces.*shape", r"\(0, 3\)"),
        ({"faces": FACES.astype(float)}, "faces.*integer", "float64"),
        ({"image_size": (0, 8)}, "image_size", r"\(0, 8\)"),
        ({"image_size": (8, 16385)}, "image_size", r"\(8, 16385\)"),
        ({"image_size": (8, 8, 3)}, "image_size", r"\(8, 8, 3\)"),
        ({"image_size": (8.0, 8.0)}, "image_size", r"\(8\.0, 8\.0\)"),
        ({"chunk": 100}, "chunk", "100"),
        ({"chunk": 2**19}, "chunk", str(2**19)),
    ],
)
def test_wrong_argument_is_named(change, expected, got):
    arguments = {"clip_positions": CLIP, "faces": FACES, "image_size": (8, 8)} | change
    with pytest.raises(ValueError, match=rf"rasterize: expected `{expected}.*got {got}"):
        rasterize(**arguments)


def depth_sum(clip_positions, faces):
    return jnp.sum(rasterize(clip_positions, faces, image_size=(8, 8), chunk=2**10).depth)


@pytest.mark.parametrize(
    ("function", "shift"),
    [(depth_sum, -1), (eqx.filter_jit(depth_sum), 1), (jax.grad(depth_sum), 1)],
    ids=["plain", "jit", "grad"],
)
def test_missing_vertex_is_an_error(function, shift):
    message = r"rasterize: `faces` refers to a vertex outside 0\.\.3"
    with pytest.raises(eqx.EquinoxRuntimeError, match=message):
        jax.block_until_ready(function(CLIP, FACES + shift))


# Transformations


def test_jit_equals_no_jit():
    clip = SOUPS["perspective"](np.random.default_rng(5), np.float32)
    plain = rasterize(clip, SEPARATE, image_size=(HEIGHT, WIDTH))
    compiled = draw(clip, SEPARATE)
    assert_close(compiled.face_ids, plain.face_ids)
    assert_close(compiled.depth, plain.depth, ulps=1)


def test_vmap_equals_a_loop():
    rng = np.random.default_rng(6)
    batch = np.stack([SOUPS["perspective"](rng, np.float32)[:24] for _ in range(3)])
    faces = np.stack([SEPARATE[:8], SEPARATE[:8, ::-1], np.roll(SEPARATE[:8], 1, axis=0)])
    one = functools.partial(jitted, image_size=(8, 8), chunk=2**10)
    both = jax.vmap(one)(batch, faces)
    for k in range(3):
        alone = one(batch[k], faces[k])
        assert_close(both.face_ids[k], alone.face_ids)
        assert_close(both.depth[k], alone.depth, ulps=1)


def test_same_shapes_are_traced_once():
    traces = []

    @jax.jit
    def traced(clip, faces):
        traces.append(clip.shape)
        return rasterize(clip, faces, image_size=(8, 8), chunk=2**10)

    for seed in range(3):
        clip = SOUPS["orthographic"](np.random.default_rng(seed), np.float32)[:24]
        traced(clip, SEPARATE[:8])
    assert len(traces) == 1
