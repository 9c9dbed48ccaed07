"""Displacement: known surfaces, seams that hold, frames that follow, derivatives, errors."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from tangentspace import shapes
from tangentspace.displacement import displace, displace_vertices, find_seams
from tangentspace.mesh import Mesh
from tangentspace.texture import clamp

from .tools import assert_close

ROTATION, _ = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))
ROTATION *= np.linalg.det(ROTATION)  # not a mirror


_displace = eqx.filter_jit(displace)
_displace_vertices = eqx.filter_jit(displace_vertices)


def displaced(mesh, heights, *, scale=1.0, midlevel=0.0, **wraps):
    """The result as NumPy arrays; compiled once for each shape."""
    scale, midlevel = np.asarray([scale, midlevel], heights.dtype)
    numbers = {"scale": np.asarray(scale), "midlevel": np.asarray(midlevel)}
    result = _displace(mesh, heights, **numbers, **wraps, seams=find_seams(mesh))
    return jax.tree.map(np.asarray, result)


def displaced_vertices(mesh, heights):
    result = _displace_vertices(mesh, heights, seams=find_seams(mesh))
    return jax.tree.map(np.asarray, result)


def unit(vectors):
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def with_tangents(mesh):
    """Some tangents, right angles to the normals, of both handednesses."""
    least = np.eye(3)[np.argmin(np.abs(mesh.normals), axis=1)]
    tangents = unit(np.cross(mesh.normals, least))
    sign = np.where(np.arange(len(tangents)) % 2 == 0, 1, -1)[:, None]
    return mesh._replace(tangents=np.concatenate([tangents, sign], 1).astype(mesh.normals.dtype))


def random_heights(*shape, dtype=np.float64):
    return np.random.default_rng(0).random(shape or (8, 16)).astype(dtype)


# Known answers


def test_constant_height_lifts_a_plane(dtype):
    plane = with_tangents(shapes.plane(segments=3, dtype=dtype))
    result = displaced(plane, np.full((2, 2), 0.75, dtype), scale=2.0, midlevel=0.25)
    assert {result[k].dtype for k in (0, 1, 3, 4)} == {np.dtype(dtype)}
    assert_close(result.positions, plane.positions + np.array([0, 1, 0], dtype), ulps=2)
    assert_close(result.normals, plane.normals, ulps=0)
    assert_close(result.tangents, plane.tangents, ulps=0)
    assert_close(result.faces, plane.faces)
    assert_close(result.uvs, plane.uvs, ulps=0)


def test_constant_height_makes_a_larger_sphere(dtype):
    sphere = shapes.uv_sphere(2.0, dtype=dtype)
    result = displaced(sphere, np.full((2, 2), 0.5, dtype))
    assert_close(result.positions, 1.25 * sphere.positions, ulps=4)  # measured 0.9
    assert_close(result.normals, sphere.normals, ulps=8)  # measured 1.9


@pytest.mark.parametrize("height", [0.5, -0.25])
def test_constant_height_makes_a_larger_box(height, dtype):
    box = shapes.box((1.0, 2.0, 3.0), dtype=dtype)
    larger = shapes.box((1 + height, 2 + height, 3 + height), dtype=dtype)
    result = displaced(box, np.full((2, 2), height, dtype))
    assert_close(result.positions, larger.positions, ulps=4)
    assert_close(result.normals, larger.normals, ulps=1)


def test_a_normal_counts_once_however_many_faces_repeat_it():
    """A box of single triangles: corners have one copy of a side's normal, or two."""
    box, larger = shapes.box(dtype=np.float64), shapes.box((1.5, 1.5, 1.5), dtype=np.float64)
    corners = box.faces.ravel()
    single = Mesh(box.positions[corners], box.normals[corners], np.arange(36).reshape(-1, 3))
    result = displaced_vertices(single, np.full(36, 0.5))
    assert_close(result.positions, larger.positions[corners], ulps=4)


def waves(u, v):
    """A height that repeats, and its derivatives in u and v."""
    a, b = 2 * np.pi * u + 0.3, 2 * np.pi * v - 0.2
    slope = 2 * np.pi * np.stack([np.cos(a) * np.cos(b), -np.sin(a) * np.sin(b)])
    return np.sin(a) * np.cos(b), slope


def wave_errors(segments, size=512):
    """Errors of heights, normals and tangents of a plane on which waves stand."""
    plane = shapes.plane(segments=segments, dtype=np.float64)
    plane = plane._replace(tangents=np.tile([1.0, 0, 0, 1], (len(plane.positions), 1)))
    centres = (np.arange(size) + 0.5) / size
    texels, _ = waves(centres[None, :], 1 - centres[:, None])
    result = displaced(plane, texels, scale=0.1)
    height, (slope_u, slope_v) = waves(*plane.uvs.T)
    # The plane is 2 wide: x = 2 u - 1, z = 1 - 2 v.
    normals = unit(np.stack([-0.05 * slope_u, np.ones_like(height), 0.05 * slope_v], -1))
    tangents = unit(np.stack([np.ones_like(height), 0.05 * slope_u, 0 * height], -1))
    inner = (np.abs(plane.positions[:, [0, 2]]) < 0.99).all(axis=1)
    wrong = [
        result.positions[:, 1] - 0.1 * height,
        result.normals - normals,
        result.tangents[:, :3] - tangents,
    ]
    return np.array([np.abs(error[inner]).max() for error in wrong])


def test_waves_on_a_plane_have_their_analytic_frames():
    """To the second order of the mesh's size, inside; heights to that of the texels."""
    coarse, fine = wave_errors(32), wave_errors(128)
    assert fine[0] < 1e-5  # measured 3.8e-6, by bilinear lookup
    assert (fine[1:] < 1e-3).all()  # measured 2.0e-4
    assert (coarse[1:] / fine[1:] > 4**2 * 0.8).all()  # measured 15.2


# Seams


def groups(index):
    return [np.flatnonzero(index == first) for first in np.unique(index)]


def test_seams_of_a_box_and_of_a_sphere():
    box = find_seams(shapes.box())
    assert [len(g) for g in groups(box.point)] == [3] * 8
    assert_close(box.smooth, np.arange(24))
    mesh = shapes.uv_sphere(rings=4, segments=6)
    sphere = find_seams(mesh)
    assert_close(sphere.smooth, sphere.point)
    assert sorted(len(g) for g in groups(sphere.point)) == [1] * 15 + [2] * 3 + [6] * 2
    for group in groups(sphere.point):
        assert_close(mesh.positions[group], np.tile(mesh.positions[group[0]], (len(group), 1)))


def test_normals_that_files_round_apart_are_equal():
    positions = np.array([[1, 0.0, 0]] * 2 + [[1, -0.0, 0]] * 3)
    normals = np.array([[0, 0, 1], [0, 1e-4, 1], [0, 1e-2, 1], [0, 1.01e-2, 1], [0, 0, 0]])
    seams = find_seams(Mesh(positions, normals, np.array([[0, 1, 2]])))
    assert_close(seams.point, np.zeros(5, int))
    assert_close(seams.smooth, np.array([0, 0, 2, 2, 4]))


SEAMY = {"uv sphere": shapes.uv_sphere, "torus": shapes.torus, "box": shapes.box}


@pytest.mark.parametrize("shape", SEAMY)
def test_seams_hold(shape, dtype):
    """Heights that differ on both sides move both alike, to the last bit."""
    mesh = SEAMY[shape](dtype=dtype)
    seams = find_seams(mesh)
    result = displaced_vertices(mesh, 0.2 * random_heights(len(mesh.positions), dtype=dtype))
    assert result.positions.dtype == result.normals.dtype == dtype
    assert_close(result.positions, result.positions[seams.point], ulps=0)
    assert_close(result.normals, result.normals[seams.smooth], ulps=0)
    assert_close(np.linalg.norm(result.normals, axis=1), np.ones(len(mesh.normals)), ulps=4)
    assert np.ptp(np.linalg.norm(result.positions - mesh.positions, axis=1)) > 0.04


def test_a_seam_makes_no_difference():
    """Cut open or closed, the surface and its normals become the same."""
    cut = shapes.torus(dtype=np.float64)
    first, closed_index = np.unique(find_seams(cut).point, return_inverse=True)
    closed = Mesh(cut.positions[first], cut.normals[first], closed_index[cut.faces])
    heights = 0.1 * random_heights(len(first))
    expected = displaced_vertices(closed, heights)
    result = displaced_vertices(cut, heights[closed_index])
    assert_close(result.positions, expected.positions[closed_index], ulps=2)
    assert_close(result.normals, expected.normals[closed_index], ulps=8)  # measured 0.5


def test_a_seam_moves_by_the_mean_of_its_heights():
    sphere = shapes.uv_sphere(rings=4, segments=6, dtype=np.float64)
    heights = random_heights(len(sphere.positions))
    way = displaced_vertices(sphere, heights).positions - sphere.positions
    for group in groups(find_seams(sphere).point):
        expected = heights[group].mean() * sphere.normals[group]
        assert_close(way[group], expected, ulps=4)


def wedge(angle):
    """Two sheets that meet along the z axis, with normals this far apart."""
    half = np.deg2rad(angle) / 2
    normals = np.array([[-np.sin(half), np.cos(half), 0], [np.sin(half), np.cos(half), 0]])
    ends = np.array([[0, 0, -1], [0, 0, 1.0]])
    away = np.array([[-np.cos(half), -np.sin(half), 0], [np.cos(half), -np.sin(half), 0]])
    positions = np.concatenate([ends, away[:1], ends, away[1:]])
    faces = np.array([[1, 0, 2], [3, 4, 5]])
    return Mesh(positions, np.repeat(normals, 3, axis=0), faces, np.zeros((6, 2)))


@pytest.mark.parametrize("angle", [1.0, 60.0, 120.0, 150.0])
def test_each_side_of_an_edge_moves_by_its_height(angle):
    mesh = wedge(angle)
    result = displaced(mesh, np.ones((1, 1)), scale=0.1)
    way = result.positions - mesh.positions
    assert_close(np.sum(way * mesh.normals, axis=1), np.full(6, 0.1), ulps=4)
    assert_close(result.positions[:2], result.positions[3:5], ulps=0)
    assert_close(result.normals, mesh.normals, ulps=4)


def test_the_way_at_acute_edges_is_limited():
    """A corner goes at most 4 times the height, and stays where normals cancel."""
    ways = []
    for angle in (140.0, 151.0, 160.0, 175.0, 179.9, 180.0):
        mesh = wedge(angle)
        ways.append(displaced(mesh, np.ones((1, 1))).positions[0, 1])
    assert max(ways) <= 4
    assert ways[0] == pytest.approx(1 / np.cos(np.deg2rad(70)))
    assert np.all(np.diff(ways[2:]) < 0)
    assert ways[-1] == pytest.approx(0, abs=1e-14)


def test_a_vertex_without_normal_stays_unless_copies_of_it_move():
    mesh = shapes.plane(segments=2, dtype=np.float64)
    normals = mesh.normals.copy()
    normals[4] = 0
    result = displaced(with_tangents(mesh)._replace(normals=normals), np.ones((1, 1)))
    assert_close(result.positions[4], mesh.positions[4], ulps=0)
    assert_close(result.positions[3], mesh.positions[3] + np.array([0, 1, 0]), ulps=0)
    uneven = displaced_vertices(with_tangents(mesh)._replace(normals=normals), np.arange(9.0))
    assert_close(uneven.normals[4], np.zeros(3), ulps=0)
    assert_close(uneven.tangents[4, :3], np.zeros(3), ulps=0)
    copied = shapes.merge(mesh, mesh._replace(normals=np.zeros_like(normals)))
    both = displaced_vertices(copied, np.repeat([1.0, 7.0], 9)).positions
    assert_close(both[:9], both[9:], ulps=0)
    assert_close(both[:9], mesh.positions + np.array([0, 1, 0]), ulps=0)


def test_what_collapses_keeps_its_normals():
    corners = np.eye(3)
    result = displaced_vertices(Mesh(corners, corners, np.array([[0, 1, 2]])), np.full(3, -1.0))
    assert_close(result.positions, np.zeros((3, 3)), ulps=0)
    assert_close(result.normals, corners, ulps=0)


# Laws


def bent_normals(mesh):
    """The mesh with normals of an artist's own, the same for copies."""
    bent = mesh.normals + 0.3 * np.sin(5 * mesh.positions[:, ::-1])
    return with_tangents(mesh._replace(normals=unit(bent)))


def test_the_midlevel_changes_nothing():
    """Neither normals of a file's own nor tangents."""
    mesh = bent_normals(shapes.torus(dtype=np.float64))
    result = displaced(mesh, np.full((2, 2), 0.5), scale=3.0, midlevel=0.5)
    assert_close(result.positions, mesh.positions, ulps=0)
    assert_close(result.normals, mesh.normals, ulps=4)
    assert_close(result.tangents, mesh.tangents, ulps=4)


def test_frames_stay_orthogonal():
    mesh = with_tangents(shapes.torus(dtype=np.float64))
    result = displaced(mesh, random_heights(), scale=0.1)
    tangent, handedness = result.tangents[:, :3], result.tangents[:, 3]
    assert_close(np.sum(tangent * result.normals, axis=1), np.zeros(len(tangent)), ulps=4)
    assert_close(np.linalg.norm(tangent, axis=1), np.ones(len(tangent)), ulps=4)
    assert_close(handedness, mesh.tangents[:, 3], ulps=0)
    before = np.cross(mesh.normals, mesh.tangents[:, :3])
    assert (np.sum(np.cross(result.normals, tangent) * before, axis=1) > 0).all()


LAWS = {
    "translate": (lambda p, n: (p + 5.0, n), lambda p, n: (p + 5.0, n)),
    "rotate": (
        lambda p, n: (p @ ROTATION.T, n @ ROTATION.T),
        lambda p, n: (p @ ROTATION.T, n @ ROTATION.T),
    ),
    "lengthen normals": (lambda p, n: (p, 7.0 * n), lambda p, n: (p, n)),
}


@pytest.mark.parametrize("law", LAWS)
def test_law(law):
    change, expect = LAWS[law]
    mesh, heights = bent_normals(shapes.torus(dtype=np.float64)), random_heights()
    positions, normals = change(mesh.positions, mesh.normals)
    changed = displaced(mesh._replace(positions=positions, normals=normals), heights, scale=0.1)
    expected = expect(*displaced(mesh, heights, scale=0.1)[:2])
    assert_close(changed.positions, expected[0])
    assert_close(changed.normals, expected[1])


def test_faces_turned_over_keep_the_normals_side():
    mesh, heights = shapes.torus(dtype=np.float64), random_heights()
    turned = displaced(mesh._replace(faces=mesh.faces[:, ::-1]), heights, scale=0.1)
    assert_close(turned.normals, displaced(mesh, heights, scale=0.1).normals, ulps=16)


def test_heights_of_a_texture_or_of_each_vertex():
    mesh = shapes.torus(dtype=np.float64)
    one_by_one = displaced_vertices(mesh, np.full(len(mesh.positions), 0.1))
    assert_close(one_by_one.positions, displaced(mesh, np.full((8, 16), 0.1)).positions, ulps=4)
    assert one_by_one.tangents is None
    without_uvs = displaced_vertices(mesh._replace(uvs=None), np.full(len(mesh.positions), 0.1))
    assert_close(without_uvs.normals, one_by_one.normals, ulps=0)


def test_wrap_modes_reach_the_texture():
    """Vertices at the border see both ends of a row or column, or only their own."""
    plane = shapes.plane(dtype=np.float64)
    row = np.array([[0.0, 0.0, 0.0, 1.0]])
    assert_close(displaced(plane, row).positions[:, 1], np.full(4, 0.5), ulps=0)
    clamped = displaced(plane, row, wrap_u=clamp).positions[:, 1]
    assert_close(clamped, plane.uvs[:, 0], ulps=0)
    clamped = displaced(plane, row[0, ::-1, None], wrap_v=clamp).positions[:, 1]
    assert_close(clamped, plane.uvs[:, 1], ulps=0)


def test_single_precision_is_near_double():
    double = with_tangents(shapes.torus(dtype=np.float64))
    arrays = {k: a.astype(np.float32) for k, a in double._asdict().items() if k != "faces"}
    single = double._replace(**arrays)
    expected = displaced(double, random_heights(), scale=0.1)
    result = displaced(single, random_heights(dtype=np.float32), scale=0.1)
    assert result.normals.dtype == np.float32
    assert_close(result.positions, expected.positions.astype(np.float32), ulps=4)
    assert_close(result.normals, expected.normals.astype(np.float32), ulps=16)  # measured 2
    assert_close(result.tangents, expected.tangents.astype(np.float32), ulps=16)


# Derivatives


@pytest.mark.parametrize("shape", ["torus", "box"])
def test_derivatives(shape):
    mesh = bent_normals(SEAMY[shape](dtype=np.float64))
    seams, uvs = find_seams(mesh), mesh.uvs + 0.013

    @jax.jit
    def parts(heights, scale, midlevel, positions, normals, uvs):
        changed = mesh._replace(positions=positions, normals=normals, uvs=uvs)
        result = displace(changed, heights, scale=scale, midlevel=midlevel, seams=seams)
        return result.positions, result.normals, result.tangents

    args = (random_heights(5, 7), 0.11, 0.2, mesh.positions, mesh.normals, uvs)
    check_grads(parts, args, 1, ("fwd", "rev"), eps=1e-6, rtol=1e-6, atol=1e-6)


def test_a_mesh_of_known_values_needs_no_seams_in_a_fit():
    mesh, heights = shapes.torus(dtype=np.float64), random_heights()

    def loss(heights, seams=None):
        return jnp.sum(displace(mesh, heights, scale=0.1, seams=seams).normals[:, 0] ** 3)

    given = jax.jit(jax.grad(lambda h: loss(h, find_seams(mesh))))(heights)
    assert_close(jax.jit(jax.grad(loss))(heights), given, ulps=0)


def test_degenerate_places_have_finite_derivatives():
    """A face without area, a vertex without normal or tangent, normals that cancel."""
    mesh = shapes.merge(with_tangents(shapes.plane(segments=2, dtype=np.float64)), *[
        with_tangents(wedge(angle)) for angle in (180.0, 40.0)
    ])  # fmt: skip
    normals, tangents = mesh.normals.copy(), mesh.tangents.copy()
    normals[0] = 0
    tangents[4, :3] = 0
    mesh = mesh._replace(normals=normals, tangents=tangents)
    mesh = mesh._replace(faces=np.concatenate([mesh.faces, [[0, 1, 2], [5, 5, 6]]]))

    def total(heights, positions, normals):
        changed = mesh._replace(positions=positions, normals=normals)
        result = displace(changed, heights, scale=0.1, seams=find_seams(mesh))
        moved = jax.tree.leaves(result._replace(faces=None, uvs=None))
        return sum(jnp.sum(array**2) for array in moved)

    args = (random_heights(4, 4), mesh.positions, mesh.normals)
    gradients = jax.jit(jax.grad(total, (0, 1, 2)))(*args)
    assert all(np.isfinite(gradient).all() for gradient in gradients)
    assert_close(gradients[2][0], np.zeros(3), ulps=0)


# Errors

BAD = {
    "no uvs": (lambda m: displace(m._replace(uvs=None), HEIGHTS, scale=1.0), "mesh with `uvs`"),
    "channels": (
        lambda m: displace(m, HEIGHTS[..., None], scale=1.0),
        r"displace: expected `heights` of shape \(height, width\), got \(2, 2, 1\)",
    ),
    "per vertex": (
        lambda m: displace_vertices(m, np.ones(3)),
        r"displace_vertices: expected `heights` of shape \(4,\), got \(3,\)",
    ),
    "traced": (
        lambda m: jax.grad(
            lambda p: jnp.sum(displace(m._replace(positions=p), HEIGHTS, scale=1.0).normals)
        )(m.positions),
        "find_seams: expected positions and normals of known values",
    ),
}
HEIGHTS = np.ones((2, 2))


@pytest.mark.errors
@pytest.mark.parametrize("case", BAD)
def test_wrong_arguments_are_named(case):
    call, message = BAD[case]
    with pytest.raises(ValueError, match=message) as caught:
        call(shapes.plane(dtype=np.float64))
    assert "\n" not in str(caught.value)
