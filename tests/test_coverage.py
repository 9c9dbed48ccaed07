"""Coverage against a slow oracle, areas in closed form, and differences."""

import functools
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jax.test_util import check_grads

from shadows.coverage import blend_layers, coverage, neighbor_depth
from shadows.rasterize import Raster, rasterize, rasterize_two
from shadows.silhouettes import mesh_edges
from shadows.surface import mesh_creases
from shadows.transforms import look_at, perspective, transform_points
from tangentspace.mesh import Mesh
from tangentspace.shapes import box, icosphere, merge, plane, torus, transform_mesh

from .coverage_reference import crossings, screen_points, shares

SIZE = 24


@functools.partial(jax.jit, static_argnames="size")
def cover(clip, faces, edges, size=SIZE):
    raster = rasterize(clip, faces, image_size=(size, size))
    found = coverage(clip, faces, edges, raster.face_ids)
    return raster, found, neighbor_depth(clip, faces, found, raster)


def flat_clip(points, depth=0.0, dtype=np.float64):
    """Return points in NDC as clip positions."""
    points = np.asarray(points, dtype)
    if points.shape[1] == 2:
        points = np.concatenate([points, np.full((len(points), 1), depth, dtype)], axis=1)
    return np.concatenate([points, np.ones((len(points), 1), dtype)], axis=1)


def turned(angle):
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, s], [-s, c]])


QUAD = np.array([[-0.45, -0.35], [0.5, -0.3], [0.4, 0.45], [-0.5, 0.3]])
QUAD_FACES = np.array([[0, 1, 2], [0, 2, 3]], np.int32)


def polygon_area(points):
    x, y = points[:, 0], points[:, 1]
    return 0.5 * jnp.abs(jnp.sum(x * jnp.roll(y, -1) - y * jnp.roll(x, -1)))


def covered_area(clip, faces, edges, size):
    """Return the area, in NDC, of what is not background."""
    raster, found, _ = cover(clip, faces, edges, size)
    seen = (raster.face_ids >= 0).astype(clip.dtype)
    return 4 * jnp.mean(blend_layers(found, seen))


@given(
    angle=st.floats(0, 6.3), scale=st.floats(0.3, 1.0), shift=st.tuples(*[st.floats(-0.2, 0.2)] * 2)
)
def test_areas_of_quads(angle, scale, shift):
    points = scale * QUAD @ turned(angle) + np.array(shift)
    area = covered_area(
        flat_clip(points), QUAD_FACES, mesh_edges(flat_clip(points)[:, :3], QUAD_FACES), 64
    )
    assert abs(area - polygon_area(points)) < 2e-3  # measured 5e-4; the quad has .2 to .7


@pytest.mark.parametrize(("size", "most"), [(64, 5e-3), (256, 4e-4)])  # measured 1.9e-3, 1.3e-4
def test_areas_follow_single_vertices(size, most):
    points = QUAD @ turned(0.3)
    edges = mesh_edges(flat_clip(points)[:, :3], QUAD_FACES)
    place = lambda p: jnp.concatenate([p, jnp.zeros((4, 1)), jnp.ones((4, 1))], axis=1)
    change = jax.grad(lambda p: covered_area(place(p), QUAD_FACES, edges, size))(
        jnp.asarray(points)
    )
    exact = jax.grad(polygon_area)(jnp.asarray(points))
    assert np.abs(change - exact).max() < most * np.abs(exact).max()


def test_areas_of_balls_grow_whatever_the_size_of_their_faces():
    """20 480 faces on 900 texels: most are seen at no centre."""
    ball = icosphere(0.55, subdivisions=5, dtype=np.float64)
    edges = mesh_edges(ball.positions, ball.faces)

    clip = jnp.asarray(flat_clip(ball.positions * [1, 1, 0.5]))

    def area(scale):
        return covered_area(clip.at[:, :3].multiply(scale), ball.faces, edges, 64)

    now, change = jax.value_and_grad(area)(1.0)
    assert float(change) == pytest.approx(2 * float(now), rel=0.01)


def view_of(mesh, eye=(0.3, 0.5, 3.0), fov=0.6):
    matrix = perspective(fov, 1.0, 1.0, 8.0) @ look_at(
        np.array(eye), np.zeros(3), np.array([0.0, 1.0, 0.0])
    )
    return transform_points(matrix, jnp.asarray(mesh.positions))


def scattered(seed):
    """Return shapes apart from each other before a wall."""
    rng = np.random.default_rng(seed)
    parts = [transform_mesh(plane(0.8, dtype=np.float64), _placing(rng, (0, 0, -3.0), 1.0))]
    shapes = [
        box((0.3, 0.2, 0.25), dtype=np.float64),
        icosphere(0.3, subdivisions=1, dtype=np.float64),
        torus(0.3, 0.12, major_segments=9, minor_segments=6, dtype=np.float64),
        plane(0.3, dtype=np.float64),
    ]
    for _k, depth in enumerate((-0.4, 0.4)):
        shape = shapes[rng.integers(len(shapes))]
        place = (*rng.uniform(-0.4, 0.4, 2), depth)
        parts.append(transform_mesh(shape._replace(uvs=None), _placing(rng, place, 0.8)))
    return filled_up(merge(*parts))


def filled_up(mesh, vertex_count=200, face_count=300):
    """Add vertices that no face has and faces without area, for one program to serve all."""
    vertices, faces = vertex_count - len(mesh.positions), face_count - len(mesh.faces)
    return mesh._replace(
        positions=np.pad(mesh.positions, ((0, vertices), (0, 0)), mode="edge"),
        faces=np.pad(mesh.faces, ((0, faces), (0, 0))),
    )


def edges_of(mesh):
    """Return edges as many as there may be at most, for the same reason."""
    edges = mesh_edges(mesh.positions, mesh.faces)
    count = 3 * len(mesh.faces) - len(edges.vertices)
    return edges._replace(vertices=np.pad(edges.vertices, ((0, count), (0, 0))))


def _placing(rng, place, size):
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = size * turn * np.sign(np.linalg.det(turn)), place
    return matrix


@pytest.mark.parametrize("seed", range(12))
def test_shares_are_those_of_the_oracle(seed):
    mesh = scattered(seed)
    clip = view_of(mesh)
    raster, found, _ = cover(clip, mesh.faces, edges_of(mesh))
    points = screen_points(clip, SIZE, SIZE)
    expected, doubtful = crossings(points, mesh.faces, np.asarray(raster.face_ids))
    assert len(expected) > 20
    assert doubtful.mean() < 0.05
    error = np.where(doubtful, 0, np.abs(found.share - shares(expected, (SIZE, SIZE))))
    assert error.max() < 1e-12


def test_shares_do_not_depend_on_how_faces_are_wound_or_cut_at_seams():
    mesh = scattered(3)
    clip = view_of(mesh)
    found = cover(clip, mesh.faces, edges_of(mesh))[1]
    rng = np.random.default_rng(0)
    flipped = np.where(rng.random((len(mesh.faces), 1)) < 0.5, mesh.faces, mesh.faces[:, ::-1])
    as_flipped = cover(clip, flipped, mesh_edges(mesh.positions, flipped))[1]
    np.testing.assert_allclose(as_flipped.share, found.share, atol=1e-12)
    apart = mesh.positions[mesh.faces.reshape(-1)]
    own = np.arange(len(apart), dtype=np.int32).reshape(-1, 3)
    as_apart = cover(clip[mesh.faces.reshape(-1)], own, mesh_edges(apart, own))[1]
    np.testing.assert_allclose(as_apart.share, found.share, atol=1e-12)


def test_doubled_faces_change_nothing():
    mesh = scattered(4)
    clip = view_of(mesh)
    found = cover(clip, mesh.faces, edges_of(mesh))[1]
    doubled = np.concatenate([mesh.faces, mesh.faces[:, ::-1]])
    again = cover(clip, doubled, mesh_edges(mesh.positions, doubled))[1]
    # A doubled border is a fold: its two sides look the same way on.
    np.testing.assert_allclose(again.share, found.share, atol=1e-12)


def crossing_planes(offset):
    """Two planes, tilted against each other, that meet where x + y / 2 = offset."""
    corners = jnp.array([[-0.8, -0.8], [0.8, -0.8], [0.8, 0.8], [-0.8, 0.8]])
    tilt = 0.3 * (corners[:, 0] + 0.5 * corners[:, 1])
    ends = [
        jnp.append(corners, d[:, None], axis=1) for d in (tilt - 0.3 * offset, 0.3 * offset - tilt)
    ]
    points = jnp.concatenate(ends)
    return jnp.append(points, jnp.ones((8, 1)), axis=1)


CROSSED = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]], np.int32)


@pytest.mark.parametrize("offset", [-0.21, 0.0, 0.13])
def test_lines_where_planes_pass_through_each_other(offset):
    edges = mesh_edges(np.asarray(crossing_planes(0.0))[:, :3], CROSSED)

    def area(offset):
        clip = crossing_planes(offset)
        raster, found, _ = cover(clip, CROSSED, edges, 128)
        first = ((raster.face_ids == 0) | (raster.face_ids == 1)).astype(clip.dtype)
        return 4 * jnp.mean(blend_layers(found, first))

    value, change = jax.value_and_grad(area)(offset)
    # A trapezoid: its middle line is from -0.8 to the offset.
    assert float(value) == pytest.approx(1.6 * (0.8 + offset), abs=2e-3)
    assert float(change) == pytest.approx(1.6, rel=0.01)


def ball_through_plane(height):
    """A ball of faces about a texel wide, and a plane of that height which it passes through."""
    ball = icosphere(0.8, subdivisions=3, dtype=np.float64)
    corners = 0.9 * jnp.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    quad = jnp.append(corners, height + jnp.zeros((4, 1)), axis=1)
    points = jnp.concatenate([jnp.asarray(ball.positions), quad]) * jnp.array([1, 1, 0.3])
    faces = np.concatenate([ball.faces, len(ball.positions) + QUAD_FACES]).astype(np.int32)
    return jnp.append(points, jnp.ones((len(points), 1)), axis=1), faces


def test_lines_where_a_surface_bends_on_its_way_through():
    """The area of a ball before a plane changes as it should, with an edge on most ways."""
    first, faces = ball_through_plane(0.0)
    edges = mesh_edges(np.asarray(first)[:, :3], faces)

    @jax.jit
    @jax.value_and_grad
    def area(height):
        clip, _ = ball_through_plane(height)
        raster, found, _ = cover(clip, faces, edges, 32)
        before = (raster.face_ids >= 0) & (raster.face_ids < len(faces) - 2)
        return 4 * jnp.mean(blend_layers(found, before.astype(clip.dtype)))

    low, high = -0.6, -0.4
    steps = low + (np.arange(16) + 0.5) / 16 * (high - low)
    change = np.mean([area(height)[1] for height in steps])
    expected = float(area(high)[0] - area(low)[0]) / (high - low)
    assert expected == pytest.approx(np.pi, rel=0.02)
    assert change == pytest.approx(
        expected, rel=0.015
    )  # measured 0.8 % off; 4.6 by both ends' slopes


def soup(seed, count=40, spread=1.0):
    rng = np.random.default_rng(seed)
    clip = rng.normal(size=(3 * count, 4)) * [spread, spread, 0.5, 0.3] + [0, 0, 0, 1]
    faces = rng.integers(0, 3 * count, (count, 3)).astype(np.int32)
    return clip, faces


@given(seed=st.integers(0, 2**16), spread=st.sampled_from([0.02, 0.3, 1.0]))
@settings(max_examples=60)
def test_any_triangles_have_bounded_shares_and_finite_derivatives(seed, spread):
    """Through each other, through the eye's plane, smaller than texels, without area."""
    clip, faces = soup(seed, spread=spread)
    edges = mesh_edges(clip[:, :3], faces)
    edges = edges._replace(vertices=np.resize(edges.vertices, (120, 2)))
    raster, found, depth = cover(clip, faces, edges)
    assert found.share.min() >= 0
    assert found.share.max() <= 1
    assert found.side.min() >= -1
    assert found.side.max() <= 3
    assert depth.min() >= 0
    assert depth.max() <= 1
    assert np.all(found.share[found.side < 0] == 1)
    assert np.all(depth[found.side < 0] == raster.depth[found.side < 0])
    assert np.isfinite(soup_change(clip, faces, edges)).all()


@jax.jit
def soup_change(clip, faces, edges):
    def total(clip):
        _, found, depth = cover(clip, faces, edges)
        return jnp.sum(found.share) + jnp.sum(depth)

    return jax.grad(total)(clip)


def test_derivatives_forward_and_reverse(monkeypatch):
    """Of the shares as they are; that edges have exact ends, tests of areas see."""
    whole = lambda a, *_: jnp.ones_like(a.w)
    monkeypatch.setattr(sys.modules["shadows.coverage"], "_edge_length", whole)
    monkeypatch.setattr(sys.modules["shadows.coverage"], "_between", lambda of_edge, *_: of_edge)
    mesh = scattered(5)
    edges, clip = edges_of(mesh), view_of(mesh)
    weights = np.random.default_rng(0).normal(size=(2, SIZE, SIZE))
    ids = cover(clip, mesh.faces, edges)[0].face_ids

    @jax.jit
    def total(clip):
        found = coverage(clip, mesh.faces, edges, ids)
        depth = neighbor_depth(clip, mesh.faces, found, Raster(ids, jnp.zeros(ids.shape)))
        return jnp.sum(weights[0] * found.share) + jnp.sum(weights[1] * depth)

    check_grads(total, (clip,), order=1, modes=("fwd", "rev"), eps=1e-7, atol=1e-4, rtol=1e-4)


def test_the_neighbor_depth_is_that_of_the_plane_behind():
    """A floor, tilted, behind a quad: at the quad's edges the floor's depth at that very texel."""
    front = flat_clip(0.5 * QUAD, depth=-0.5)
    back = flat_clip([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    back[:, 2] = 0.3 * back[:, 0] + 0.2 * back[:, 1] + 0.1
    clip = np.concatenate([front, back])
    faces = np.concatenate([QUAD_FACES, QUAD_FACES + 4])
    raster, found, depth = cover(clip, faces, mesh_edges(clip[:, :3], faces))
    x = (2 * np.arange(SIZE) + 1) / SIZE - 1
    floor = 0.5 + 0.5 * (0.3 * x[None] - 0.2 * x[:, None] + 0.1)
    cut = np.asarray(found.side) >= 0
    near = np.asarray(raster.face_ids) < 2
    assert (cut & near).sum() > 10
    assert (cut & ~near).sum() > 5
    np.testing.assert_allclose(depth[cut & near], floor[cut & near], atol=1e-12)
    np.testing.assert_allclose(depth[cut & ~near], 0.25, atol=1e-12)


def test_two_layers_have_two_neighbor_depths():
    mesh = scattered(6)
    clip, edges = view_of(mesh), edges_of(mesh)
    _, found, nearest = cover(clip, mesh.faces, edges)
    _, second = rasterize_two(clip, mesh.faces, image_size=(SIZE, SIZE))
    behind = jax.jit(neighbor_depth)(clip, mesh.faces, found, second)
    cut = np.asarray(found.side) >= 0
    np.testing.assert_array_equal(behind[~cut], second.depth[~cut])
    assert np.mean(behind[cut] >= nearest[cut] - 1e-3) > 0.95
    assert np.mean(behind[cut] > nearest[cut] + 1e-3) > 0.5


def test_more_crossings_than_there_usually_are_change_nothing(monkeypatch):
    """The same shares, depths and derivatives when a choice holds one and all others follow."""
    mesh = scattered(8)
    clip, edges = view_of(mesh), edges_of(mesh)
    weights = np.random.default_rng(0).normal(size=(2, SIZE, SIZE))

    def total(clip):
        raster = rasterize(clip, mesh.faces, image_size=(SIZE, SIZE))
        found = coverage(clip, mesh.faces, edges, raster.face_ids)
        depth = neighbor_depth(clip, mesh.faces, found, raster)
        return jnp.sum(weights[0] * found.share) + jnp.sum(weights[1] * depth)

    usual = jax.jit(jax.value_and_grad(total))(clip)
    module = sys.modules["shadows.coverage"]
    monkeypatch.setattr(module, "_few_or_all", lambda run, are_few, few, most: run(most))
    # And when fewer pairs of texels are listed together than there are.
    monkeypatch.setattr(sys.modules["shadows._crossings"], "_PAIRS", 64)
    monkeypatch.setattr(sys.modules["shadows._crossings"], "_PIECE", 32)
    crowded = jax.jit(jax.value_and_grad(lambda clip: total(clip)))(clip)
    np.testing.assert_allclose(crowded[0], usual[0], rtol=1e-12)
    np.testing.assert_allclose(crowded[1], usual[1], rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize(("kind", "size"), [(0, 0.15), (1, 1.5)], ids=["edges", "lines"])
def test_none_of_many_crossings_is_left_out(monkeypatch, kind, size):
    """Triangles all over, more crossings of a kind than the smaller program holds."""
    rng = np.random.default_rng(0)
    centers = rng.uniform(-0.8, 0.8, (120, 1, 3))
    positions = (centers + rng.normal(size=(120, 3, 3)) * size).reshape(-1, 3)
    clip = np.concatenate([positions, np.ones((360, 1))], axis=-1)
    faces = np.arange(360, dtype=np.int32).reshape(-1, 3)
    edges = mesh_edges(positions, faces)
    ids = rasterize(clip, faces, image_size=(SIZE, SIZE)).face_ids
    found = jax.jit(coverage)(clip, faces, edges, ids)
    assert found.crossings[kind].total > (8, 2)[kind] * SIZE
    module = sys.modules["shadows.coverage"]
    monkeypatch.setattr(module, "_few_or_all", lambda run, are_few, few, most: run(most))
    whole = jax.jit(lambda clip: coverage(clip, faces, edges, ids))(clip)
    np.testing.assert_allclose(found.rests, whole.rests, atol=1e-15)


@pytest.mark.parametrize("seed", range(4))
def test_edges_inside_a_surface_are_passed_as_by_walking(monkeypatch, seed):
    """The same shares where each way is followed from face to face, as where plain ones are not."""
    mesh = scattered(seed)
    clip, edges = view_of(mesh), edges_of(mesh)
    ids = rasterize(clip, mesh.faces, image_size=(64, 64)).face_ids
    module = sys.modules["shadows._crossings"]
    is_plain, skipped = module._is_plain, []

    def shares_of():
        return coverage(clip, mesh.faces, edges, ids).rests

    def counted(*arguments):
        plain = is_plain(*arguments)
        jax.debug.callback(lambda count: skipped.append(int(count)), jnp.sum(plain))
        return plain

    monkeypatch.setattr(module, "_is_plain", counted)
    usual = jax.jit(lambda: shares_of())()
    monkeypatch.setattr(
        module, "_is_plain", lambda *arguments: jnp.zeros_like(is_plain(*arguments))
    )
    np.testing.assert_array_equal(usual, jax.jit(lambda: shares_of())())
    jax.effects_barrier()
    assert sum(skipped) > 100


def test_one_texel_has_no_neighbours():
    clip = flat_clip(QUAD)
    found = cover(clip, QUAD_FACES, mesh_edges(clip[:, :3], QUAD_FACES), 1)[1]
    assert found.share == 1
    assert found.side == -1


@pytest.mark.errors
def test_edges_of_another_mesh_are_refused():
    clip = flat_clip(QUAD)
    raster = rasterize(clip, QUAD_FACES, image_size=(4, 4))
    edges = mesh_edges(clip[:3, :3], QUAD_FACES[:1])
    with pytest.raises(ValueError, match="coverage: expected `edges` of 2 faces, got those of 1"):
        coverage(clip, QUAD_FACES, edges, raster.face_ids)


def test_blended_colors_stay_between_those_that_are_blended():
    mesh = scattered(7)
    found = cover(view_of(mesh), mesh.faces, edges_of(mesh))[1]
    image = np.random.default_rng(1).uniform(0.2, 0.7, (SIZE, SIZE, 3))
    blended = blend_layers(found, jnp.asarray(image))
    padded = np.pad(image, ((1, 1), (1, 1), (0, 0)), mode="edge")
    around = np.stack(
        [padded[1:-1, 2:], padded[1:-1, :-2], padded[2:, 1:-1], padded[:-2, 1:-1], image]
    )
    assert np.all(blended <= around.max(axis=0) + 1e-12)
    assert np.all(blended >= around.min(axis=0) - 1e-12)
    side, share = np.asarray(found.side), np.asarray(found.share)
    row, column = np.argwhere(side == 2)[0]
    expected = (
        share[row, column] * image[row, column] + (1 - share[row, column]) * image[row + 1, column]
    )
    np.testing.assert_allclose(blended[row, column], expected)


def test_shares_jump_less_for_what_corners_have_of_their_own(monkeypatch):
    """A quad moves over rows and columns; without the corners' means every corner jumps."""
    edges = mesh_edges(flat_clip(QUAD)[:, :3], QUAD_FACES)
    steps = np.linspace(0, 2 / SIZE, 101)[:, None] * np.array([1.0, 0.3])
    clips = [flat_clip(QUAD @ turned(turn) + step) for turn in (0.2, 0.7, 1.1) for step in steps]

    def jumps():
        @jax.jit
        def image(clip):
            raster = rasterize(clip, QUAD_FACES, image_size=(SIZE, SIZE))
            found = coverage(clip, QUAD_FACES, edges, raster.face_ids)
            return blend_layers(found, (raster.face_ids >= 0).astype(clip.dtype))

        change = np.diff(np.array([image(clip) for clip in clips]).reshape(3, 101, -1), axis=1)
        largest = np.abs(change).max(axis=2)
        return np.sum(largest[largest > 0.04] ** 2)

    with_means = jumps()
    monkeypatch.setattr(sys.modules["shadows.coverage"], "_between", lambda of_edge, *_: of_edge)
    assert with_means < 0.7 * jumps()  # measured 0.65 and 1.21


def test_creases_are_edges_where_colors_are_shown():
    """A roof of two sides: what one side covers follows the ridge, if it is said to be one."""
    faces = np.array([[0, 1, 2], [0, 2, 3], [1, 4, 5], [1, 5, 2]], np.int32)
    square = np.array([[-0.8, -0.7, 0], [0.1, -0.7, 0], [0.1, 0.7, 0], [-0.8, 0.7, 0],
                       [0.8, -0.7, 0], [0.8, 0.7, 0]])  # fmt: skip
    apart = square[faces.reshape(-1)]
    normals = np.repeat([[-0.6, 0, 0.8], [0.6, 0, 0.8]], 6, axis=0)
    roof = Mesh(apart, normals, np.arange(12, dtype=np.int32).reshape(4, 3))
    edges = mesh_edges(roof.positions, roof.faces)
    creases = mesh_creases(roof, edges)
    ridge = np.isclose(apart[edges.vertices, 0], 0.1).all(axis=1)
    np.testing.assert_array_equal(creases, ridge)
    assert not np.any(mesh_creases(roof._replace(normals=0 * normals + [0, 0, 1.0]), edges))
    on_ridge = np.isclose(apart[:, 0], 0.1)

    def left(shift, creases):
        clip = jnp.asarray(flat_clip(apart)).at[:, 0].add(shift * on_ridge)
        raster = rasterize(clip, roof.faces, image_size=(64, 64))
        found = coverage(clip, roof.faces, edges, raster.face_ids, creases=creases)
        seen = (raster.face_ids == 0) | (raster.face_ids == 1)
        return 4 * jnp.mean(blend_layers(found, seen.astype(clip.dtype)))

    value, change = jax.jit(jax.value_and_grad(left))(0.01, creases)
    assert float(value) == pytest.approx(0.91 * 1.4, abs=5e-3)
    assert float(change) == pytest.approx(1.4, rel=0.01)
