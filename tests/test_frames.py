"""Tangent frames: known answers, the definition, laws, derivatives, vertices without a frame."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from tangentspace import shapes
from tangentspace.frames import (
    gram_schmidt,
    to_tangent,
    to_world,
    triangle_frames,
    vertex_frames,
)
from tangentspace.mesh import Mesh
from tangentspace.mikktspace import corner_tangents
from tangentspace.seams import split_mirrored

from .frames_reference import triangle_reference, vertex_reference
from .tools import assert_close

ROTATION, _ = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))
ROTATION *= np.linalg.det(ROTATION)  # not a mirror
MIRROR = np.array([-1.0, 1, 1])
frames_of = jax.jit(vertex_frames)
triangles_of = jax.jit(triangle_frames)
orthonormal_of = jax.jit(gram_schmidt)

# One triangle in the plane z = 0, normals up, and what its frame is for some UVs.
CORNERS = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
FLAT_UVS = CORNERS[:, :2]
KNOWN = {
    "identity": (FLAT_UVS, [1, 0, 0], [0, 1, 0], 1),
    "mirrored u": (FLAT_UVS * [-1, 1], [-1, 0, 0], [0, 1, 0], -1),
    "mirrored v": (FLAT_UVS * [1, -1], [1, 0, 0], [0, -1, 0], -1),
    "turned by 90 degrees": (FLAT_UVS @ [[0, 1], [-1, 0]], [0, -1, 0], [1, 0, 0], 1),
    "stretched": (FLAT_UVS * [0.5, 4], [2, 0, 0], [0, 0.25, 0], 1),
    "sheared": (FLAT_UVS @ [[1, 0], [0.5, 1]], [1, 0, 0], [-0.5, 1, 0], 1),
}


def one_triangle(uvs, dtype=np.float64):
    normals = np.tile([0, 0, 1.0], (3, 1))
    arrays = (array.astype(dtype) for array in (CORNERS, normals, np.asarray(uvs, float)))
    return (*arrays, np.array([[0, 1, 2]]))


def bumpy_torus(dtype=np.float64):
    """A surface without symmetries, and normals and UVs that do not quite belong to it."""
    mesh = shapes.torus(major_segments=7, minor_segments=5, dtype=np.float64)
    rng = np.random.default_rng(0)
    positions = mesh.positions + rng.normal(scale=0.05, size=mesh.positions.shape)
    normals = (mesh.normals + rng.normal(scale=0.1, size=mesh.normals.shape)) * 1.7
    uvs = np.asarray(mesh.uvs)
    uvs = uvs + rng.normal(scale=0.02, size=uvs.shape)
    return positions.astype(dtype), normals.astype(dtype), uvs.astype(dtype), mesh.faces


def strip():
    """Two squares that share the edge x = 0, where the texture is mirrored: ``u = |x|``."""
    x, y = np.meshgrid([-1.0, 0, 1], [0.0, 1])
    positions = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], axis=-1)
    faces = np.array([[0, 1, 4], [0, 4, 3], [1, 2, 5], [1, 5, 4]])
    return positions, np.tile([0, 0, 1.0], (6, 1)), np.abs(positions[:, :2]), faces


@pytest.mark.parametrize("case", KNOWN)
def test_frame_of_one_triangle(case, dtype):
    uvs, tangent, bitangent, handedness = KNOWN[case]
    positions, normals, uvs, faces = one_triangle(uvs, dtype)
    frame = triangles_of(positions, uvs, faces)
    assert {array.dtype for array in frame[:3]} == {np.dtype(dtype)}
    assert_close(frame.tangent, np.array([tangent], float), ulps=1)
    assert_close(frame.bitangent, np.array([bitangent], float), ulps=1)
    assert_close(frame.handedness, np.array([handedness]), ulps=0)
    assert frame.valid.all()

    frames = frames_of(positions, normals, uvs, faces)
    assert {array.dtype for array in frames[:4]} == {np.dtype(dtype)}
    unit = np.tile(tangent / np.linalg.norm(tangent), (3, 1))
    assert_close(frames.tangent, unit, ulps=1)
    # At right angles to the other two, not along growing v: it differs under shear.
    assert_close(frames.bitangent, handedness * np.cross([0, 0, 1], unit), ulps=1)
    assert_close(frames.normal, normals, ulps=0)
    assert_close(frames.handedness, np.full(3, handedness), ulps=0)
    assert frames.valid.all()


def test_a_plane_has_the_frame_that_its_docstring_tells(dtype):
    mesh = shapes.plane(segments=4, dtype=dtype)
    frames = frames_of(mesh.positions, mesh.normals, mesh.uvs, mesh.faces)
    assert_close(frames.tangent, np.tile([1.0, 0, 0], (25, 1)), ulps=1)
    assert_close(frames.bitangent, np.tile([0.0, 0, -1], (25, 1)), ulps=1)


def test_a_shared_fold_bends_the_tangent():
    """A right-angled fold, the normal halfway: both sides count alike, in its plane."""
    positions = np.array([[0, 0, 0], [0, 1, 0], [-1, 0, 0], [0, 0, -1]], float)[[0, 1, 2, 3]]
    normals = np.tile(np.array([1, 0, 1]) / np.sqrt(2), (4, 1))
    uvs = np.array([[0, 0], [0, 1], [-1, 0], [1, 0]], float)
    frames = frames_of(positions, normals, uvs, np.array([[0, 1, 2], [0, 3, 1]]))
    assert_close(frames.tangent[:2], np.tile([np.sqrt(0.5), 0, -np.sqrt(0.5)], (2, 1)), ulps=4)


SPHERES = {
    "torus": lambda dtype: shapes.torus(dtype=dtype),
    "sphere": lambda dtype: shapes.uv_sphere(dtype=dtype),
}


@pytest.mark.parametrize("shape", SPHERES)
def test_tangents_of_a_round_body_point_east(shape, dtype):
    """Where faces surround the vertex: neither at the seams nor at the poles."""
    mesh = SPHERES[shape](dtype)
    frames = frames_of(mesh.positions, mesh.normals, mesh.uvs, mesh.faces)
    assert frames.valid.all()
    inside = off_the_seams(mesh)
    assert np.count_nonzero(inside) > 400
    east = longitude_directions(mesh)[inside].astype(dtype)
    assert_close(frames.tangent[inside], east, ulps=16)  # measured 1.8
    north = np.cross(mesh.normals[inside], east)
    assert_close(frames.bitangent[inside], north, ulps=16)


def off_the_seams(mesh):
    """Vertices inside the UV chart, with faces all round."""
    uvs = np.asarray(mesh.uvs)
    return np.all((uvs > 0) & (uvs < 1), axis=-1)


def longitude_directions(mesh):
    longitude = 2 * np.pi * mesh.uvs[:, 0].astype(float)
    return np.stack([-np.sin(longitude), 0 * longitude, -np.cos(longitude)], axis=-1)


def sheared_torus_error(size):
    """Largest angle, degrees, to the true tangent under ``v + u / 2``, off the seams."""
    mesh = shapes.torus(2.0, 0.5, major_segments=2 * size, minor_segments=size, dtype=np.float64)
    east = longitude_directions(mesh)
    ring = np.sqrt(np.sum(mesh.positions[:, ::2] ** 2, axis=-1, keepdims=True))
    true = ring * east - 0.5 * 0.5 * np.cross(mesh.normals, east)
    true /= np.linalg.norm(true, axis=-1, keepdims=True)
    frames = frames_of(
        mesh.positions, mesh.normals, np.asarray(mesh.uvs) @ [[1, 0.5], [0, 1]], mesh.faces
    )
    cosine = np.sum(frames.tangent * true, axis=-1)
    inside = off_the_seams(mesh)
    return np.degrees(np.arccos(np.clip(cosine[inside], -1, 1))).max()


def test_converges_to_the_tangent_of_the_true_surface():
    coarse, fine = sheared_torus_error(12), sheared_torus_error(48)
    assert fine < coarse / 15  # measured 0.43 and 0.027 degrees: 15.8, of second order


def test_agrees_with_the_definition():
    mesh = bumpy_torus()
    frames, expected = frames_of(*mesh), vertex_reference(*mesh)
    assert expected.valid.all()
    for name, values in expected._asdict().items():
        assert_close(getattr(frames, name), values, ulps=64)


@pytest.mark.parametrize("seed", range(3))
def test_agrees_with_the_definition_on_a_tangle(seed):
    """Random faces on few vertices: both handednesses, faces seen from behind, repeated ones."""
    rng = np.random.default_rng(seed)
    positions, normals = rng.normal(size=(2, 60, 3))
    uvs, faces = rng.normal(size=(60, 2)), rng.integers(0, 50, (40, 3))
    faces[0, 1] = faces[0, 0]
    normals[faces[1]] = 0
    uvs[faces[2]] = uvs[faces[2, 0]]
    frames, expected = frames_of(positions, normals, uvs, faces), None
    expected = vertex_reference(positions, normals, uvs, faces)
    assert 5 < np.count_nonzero(expected.valid) < 40
    for name, values in expected._asdict().items():
        assert_close(getattr(frames, name), values, ulps=1024)
    triangles = triangles_of(positions, uvs, faces)
    for face, *frame, valid in zip(faces, *triangles, strict=True):
        answer = triangle_reference(positions[face], uvs[face])
        assert bool(valid) == (answer is not None)
        for actual, value in zip(frame, answer or (np.zeros(3), np.zeros(3), 0.0), strict=True):
            assert_close(actual, value, ulps=4096)


def test_equals_mikktspace_where_its_corners_agree():
    positions, normals, uvs, faces = bumpy_torus(np.float32)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    uvs[:, 0] = np.abs(uvs[:, 0] - 0.5)  # mirrored in the middle
    mesh = split_mirrored(Mesh(positions, normals, faces, uvs))
    assert len(mesh.positions) > len(positions)
    frames = frames_of(mesh.positions, mesh.normals, mesh.uvs, mesh.faces)
    reference = corner_tangents(mesh)
    own = np.concatenate([frames.tangent, frames.handedness[:, None]], axis=-1)[mesh.faces]
    first = reference.reshape(-1, 4)[np.unique(mesh.faces, return_index=True)[1]]
    alone = np.full(len(mesh.positions), True)  # not where two fans meet in one vertex only
    alone[mesh.faces[np.any(first[mesh.faces] != reference, axis=-1)]] = False
    kept = alone[mesh.faces]
    assert np.mean(kept) > 0.9
    assert_close(own[kept], reference[kept], ulps=64)


def test_single_precision_is_near_double():
    double, single = frames_of(*bumpy_torus()), frames_of(*bumpy_torus(np.float32))
    assert_close(single.tangent, double.tangent.astype(np.float32), ulps=64)
    assert_close(single.bitangent, double.bitangent.astype(np.float32), ulps=64)


LAWS = {
    "translate": (lambda p, n, w, f: (p + 5.0, n, w, f), lambda t, b: (t, b)),
    "rotate": (
        lambda p, n, w, f: (p @ ROTATION.T, n @ ROTATION.T, w, f),
        lambda t, b: (t @ ROTATION.T, b @ ROTATION.T),
    ),
    "grow": (lambda p, n, w, f: (p * 1e12, n, w, f), lambda t, b: (t, b)),
    "shrink": (lambda p, n, w, f: (p * 1e-12, n, w, f), lambda t, b: (t, b)),
    "mirror space": (
        lambda p, n, w, f: (p * MIRROR, n * MIRROR, w, f[:, ::-1]),
        lambda t, b: (t * MIRROR, b * MIRROR),
    ),
    "move the texture": (lambda p, n, w, f: (p, n, w + 3.0, f), lambda t, b: (t, b)),
    "stretch the texture": (lambda p, n, w, f: (p, n, w * [1e3, 1e-3], f), lambda t, b: (t, b)),
    "mirror u": (lambda p, n, w, f: (p, n, w * [-1, 1], f), lambda t, b: (-t, b)),
    "mirror v": (lambda p, n, w, f: (p, n, w * [1, -1], f), lambda t, b: (t, -b)),
    "shear u": (lambda p, n, w, f: (p, n, w @ [[1, 0], [0.7, 1]], f), lambda t, b: (t, b)),
    "lengthen normals": (lambda p, n, w, f: (p, n * 1e6, w, f), lambda t, b: (t, b)),
    "reorder faces": (lambda p, n, w, f: (p, n, w, f[::-1]), lambda t, b: (t, b)),
    "roll corners": (lambda p, n, w, f: (p, n, w, np.roll(f, 1, axis=1)), lambda t, b: (t, b)),
}


@pytest.mark.parametrize("law", LAWS)
def test_law(law):
    change, expect = LAWS[law]
    mesh = bumpy_torus()
    before, after = frames_of(*mesh), frames_of(*change(*mesh))
    assert after.valid.all()
    tangent, bitangent = expect(before.tangent, before.bitangent)
    assert_close(after.tangent, tangent, ulps=512)
    assert_close(after.bitangent, bitangent, ulps=512)
    flipped = "mirror" in law
    assert_close(after.handedness, -before.handedness if flipped else before.handedness, ulps=0)


def test_an_edge_along_the_normal_makes_a_right_angle():
    """As in MikkTSpace; a face of the plane and one that stands on it then count alike."""
    positions = np.array([[0, 0, 0], [1, 0, 0], [0, 0, 1], [1, 1, 0], [-1, 1, 0]], float)
    uvs = np.array([[0, 0], [1, 0], [0, 1], [1, 1], [1, -1]], float)
    mesh = positions, np.tile([0, 0, 1.0], (5, 1)), uvs, np.array([[0, 1, 2], [0, 3, 4]])
    mesh[3][1] = mesh[3][1, ::-1]  # whose texture has u along y, v along x
    frames = frames_of(*mesh)
    assert_close(frames.tangent[0], np.array([1, 1, 0]) / np.sqrt(2), ulps=2)
    assert_close(frames.tangent[0], vertex_reference(*mesh).tangent[0], ulps=4)


def test_a_face_with_u_along_the_normal_has_no_say():
    """Not in the handedness either: here it is mirrored."""
    positions = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 1, 0]], float)
    uvs = np.array([[0, 0], [1, 0], [0, 1], [1, 0], [0, -1]], float)
    faces = np.array([[0, 1, 2], [0, 3, 4]])
    frames = frames_of(positions, np.tile([0, 0, 1.0], (5, 1)), uvs, faces)
    assert_close(frames.valid, np.array([True, True, True, False, False]))
    assert_close(frames.tangent[0], np.array([1, 0, 0]), ulps=0)
    assert_close(frames.handedness, np.ones(5), ulps=0)


def test_handedness_is_kept_where_it_changes():
    """A mirrored seam has no frame until its vertices are split; then each side has its own."""
    positions, normals, uvs, faces = strip()
    frames = frames_of(positions, normals, uvs, faces)
    assert_close(frames.valid, np.array([True, False, True] * 2))
    assert_close(frames.tangent, np.array([[-1, 0, 0], [0, 0, 0], [1, 0, 0]] * 2), ulps=0)
    assert_close(frames.bitangent, np.array([[0, 1, 0], [0, 0, 0], [0, 1, 0]] * 2), ulps=0)
    assert_close(frames.handedness, np.array([-1, 1, 1] * 2), ulps=0)

    mesh = split_mirrored(Mesh(positions, normals, faces, uvs))
    frames = frames_of(mesh.positions, mesh.normals, mesh.uvs, mesh.faces)
    assert frames.valid.all()
    right = np.sum(mesh.positions[mesh.faces][..., 0], axis=-1) > 0
    tangent = np.where(right[:, None], 1.0, -1.0)
    assert_close(frames.tangent[mesh.faces][..., 0], np.broadcast_to(tangent, (4, 3)), ulps=0)
    assert_close(frames.handedness[mesh.faces], np.broadcast_to(tangent, (4, 3)), ulps=0)


def test_bitangent_is_that_of_gram_schmidt():
    """Accumulating bitangents as well, and S0's formula, would give nothing new."""
    positions, normals, uvs, faces = bumpy_torus()
    uvs = np.concatenate([uvs, uvs * MIRROR[:2]])
    twice = (np.concatenate([array, array]) for array in (positions, normals))
    faces = np.concatenate([faces, faces + len(positions)])
    frames = frames_of(*twice, uvs, faces)
    assert set(np.asarray(frames.handedness)) == {1.0, -1.0}
    sums = np.zeros((len(uvs), 3))
    raw = triangles_of(np.concatenate([positions, positions]), uvs, faces)
    np.add.at(sums, faces, np.asarray(raw.bitangent)[:, None])
    orthonormal = orthonormal_of(frames.tangent, sums, frames.normal)
    assert_close(orthonormal.tangent, frames.tangent, ulps=4)
    assert_close(orthonormal.bitangent, frames.bitangent, ulps=64)
    assert_close(orthonormal.normal, frames.normal, ulps=4)


def test_gram_schmidt_is_the_lecture_formula(dtype):
    tangent, bitangent, normal = np.random.default_rng(0).normal(size=(3, 50, 3)).astype(dtype)
    frames = orthonormal_of(tangent, bitangent, normal)
    assert {array.dtype for array in frames} == {np.dtype(dtype)}
    for t, b, n, *result in zip(tangent, bitangent, normal, *frames, strict=True):
        n = n.astype(float) / np.linalg.norm(n.astype(float))
        t = t - (n @ t) * n
        t /= np.linalg.norm(t)
        b = b - (n @ b) * n - (t @ b) * t
        for actual, expected in zip(result, (t, b / np.linalg.norm(b), n), strict=True):
            assert_close(actual, expected, ulps=256)


def test_gram_schmidt_without_an_answer_is_zero(dtype):
    """One bad row of each kind among good ones."""
    t, b, n = np.random.default_rng(0).normal(size=(3, 5, 3)).astype(dtype)
    t[0], b[1], n[2] = 3 * n[0], 2 * n[1] - 5 * t[1], 0
    t[3] = 0
    frames = [np.asarray(array) for array in orthonormal_of(t, b, n)]
    for array, zero in zip(frames, (frames[0][[0, 3]], frames[1][1], frames[2][2]), strict=True):
        assert_close(zero, np.zeros_like(zero), ulps=0)
        assert np.isfinite(array).all()
    summed = jax.jit(jax.grad(lambda *v: sum(jnp.sum(a) for a in gram_schmidt(*v)), (0, 1, 2)))
    gradients, alone = summed(t, b, n), summed(t[4:], b[4:], n[4:])
    for gradient, good in zip(gradients, alone, strict=True):
        assert np.isfinite(gradient).all()
        assert_close(gradient[4:], good, ulps=64)
    assert_close(gradients[0][::3], np.zeros((2, 3)), ulps=0)


def test_tangent_space_and_back(dtype):
    frames = frames_of(*bumpy_torus(dtype))
    axes = frames.tangent, frames.bitangent, frames.normal
    for k, axis in enumerate(axes):
        unit = np.tile(np.eye(3, dtype=dtype)[k], (len(axis), 1))
        assert_close(to_world(unit, *axes), axis, ulps=0)
        assert_close(to_tangent(axis, *axes), unit, ulps=8)
    vectors = np.random.default_rng(0).normal(size=axes[0].shape).astype(dtype)
    there = to_world(vectors, *axes)
    assert there.dtype == dtype
    assert_close(to_tangent(there, *axes), vectors, ulps=16)
    assert_close(to_world(to_tangent(vectors, *axes), *axes), vectors, ulps=16)
    one = to_world(vectors[0], *axes)
    assert_close(one, to_world(np.tile(vectors[0], (len(vectors), 1)), *axes), ulps=0)
    grid = to_tangent(vectors[:, None], *(axis[None, :4] for axis in axes))
    assert grid.shape == (len(vectors), 4, 3)
    assert_close(grid[2, 3], to_tangent(vectors[2], *(axis[3] for axis in axes)), ulps=4)


def test_derivatives_of_vertex_frames():
    *arrays, faces = bumpy_torus()
    check_grads(
        jax.jit(lambda p, n, w: vertex_frames(p, n, w, faces)[:3]), arrays, 1, ("fwd", "rev")
    )


def test_derivatives_of_triangle_frames():
    positions, _, uvs, faces = bumpy_torus()
    frames = jax.jit(lambda p, w: triangle_frames(p, w, faces)[:2])
    check_grads(frames, (positions, uvs), 1, ("fwd", "rev"))


@pytest.mark.parametrize(
    "function",
    [
        gram_schmidt,
        lambda t, b, n: to_world(t * b, t, b, n),
        lambda t, b, n: to_tangent(t * b, t, b, n),
    ],
)
def test_derivatives_of_vector_functions(function):
    vectors = tuple(np.random.default_rng(0).normal(size=(3, 20, 3)))
    check_grads(jax.jit(function), vectors, 1, ("fwd", "rev"))


def test_frames_of_several_meshes_at_once():
    *arrays, faces = bumpy_torus()
    other = [array[::-1] for array in arrays]
    both = jax.jit(jax.vmap(vertex_frames, (0, 0, 0, None)))(
        *map(np.stack, zip(arrays, other, strict=True)), faces
    )
    for actual, expected in zip(both, frames_of(*other, faces), strict=True):
        assert_close(actual[1], expected, ulps=64)


def break_vertex(mesh, flaw, vertex=8):
    """Take the frame of one vertex away, among good ones."""
    positions, normals, uvs, faces = (array.copy() for array in mesh)
    round_it = np.any(faces == vertex, axis=1)
    near = np.unique(faces[round_it])
    if flaw == "zero normal":
        normals[vertex] = 0
    elif flaw == "normal not finite":
        normals[vertex] = np.nan
    elif flaw == "collapsed uvs":
        uvs[near] = uvs[vertex]
    elif flaw == "uvs on a line":
        uvs[near] = near[:, None] * np.array([0.25, 0.5], uvs.dtype)
    elif flaw == "collapsed positions":
        positions[near] = positions[vertex]
    elif flaw == "positions on a line":
        positions[near] = near[:, None] * np.array([0.25, 0.5, 1.0], positions.dtype)
    elif flaw == "position not finite":
        positions[vertex] = np.inf
    elif flaw == "unreferenced":
        faces[round_it] = faces[~round_it][0]
    elif flaw == "both handednesses":
        faces[np.argmax(round_it)] = faces[np.argmax(round_it), ::-1]
    return positions, normals, uvs, faces


FLAWS = [
    "zero normal",
    "normal not finite",
    "collapsed uvs",
    "uvs on a line",
    "collapsed positions",
    "positions on a line",
    "position not finite",
    "unreferenced",
    "both handednesses",
]


@jax.jit
def vertex_gradient(positions, normals, uvs, faces, weights):
    def loss(*arrays):
        frames = vertex_frames(*arrays, faces)
        return jnp.sum(weights * (frames.tangent + 2 * frames.bitangent))

    return jax.grad(loss, (0, 1, 2))(positions, normals, uvs)


@pytest.mark.parametrize("flaw", FLAWS)
def test_vertex_without_a_frame_is_flagged_with_zero_derivative(flaw, dtype):
    mesh = break_vertex(bumpy_torus(dtype), flaw)
    frames = frames_of(*mesh)
    assert not frames.valid[8]
    assert np.count_nonzero(frames.valid) > 30
    assert_close(frames.tangent[8], np.zeros(3), ulps=0)
    assert_close(frames.bitangent[8], np.zeros(3), ulps=0)
    assert_close(frames.handedness[8], 1.0, ulps=0)
    assert all(np.isfinite(array).all() for array in frames)
    weights = np.zeros((len(mesh[0]), 3), dtype)
    weights[8] = 1
    for gradient in vertex_gradient(*mesh, weights):
        assert_close(gradient, np.zeros_like(gradient), ulps=0)


@pytest.mark.parametrize("flaw", FLAWS)
def test_neighbours_of_a_bad_vertex_keep_their_derivatives(flaw):
    """What the loss of all good vertices asks for is what differences say."""
    mesh = break_vertex(bumpy_torus(), flaw)
    good = np.asarray(frames_of(*mesh).valid)
    weights = np.random.default_rng(0).normal(size=(len(good), 3)) * good[:, None]
    gradients = vertex_gradient(*mesh, weights)
    whole = np.unique(mesh[3][np.asarray(triangles_of(mesh[0], mesh[2], mesh[3]).valid)])
    rng = np.random.default_rng(1)
    for which, gradient in enumerate(gradients):
        assert np.isfinite(gradient).all()
        # Only where no face is on the verge of getting a frame can differences be taken.
        free = np.setdiff1d(whole, np.unique(mesh[3][np.any(mesh[3] == 8, axis=1)]))
        step = np.zeros_like(mesh[which])
        step[free] = rng.normal(size=step[free].shape)

        def loss(t, which=which, step=step):
            moved = [array + t * step if k == which else array for k, array in enumerate(mesh)]
            frames = frames_of(*moved)
            return float(jnp.sum(weights * (frames.tangent + 2 * frames.bitangent)))

        difference = (loss(1e-5) - loss(-1e-5)) / 2e-5
        assert_close(np.float32(np.sum(gradient * step)), np.float32(difference), ulps=64)


# Faces added to a good mesh that have no frame, on its vertex 0 and new ones.
BAD_FACES = {
    "repeated corner": ([[0, 1, 1]], np.zeros((0, 3)), np.zeros((0, 2))),
    "corners on a line": ([[0, 48, 49]], np.array([[2.0, 0, 0], [4, 0, 0]]), np.eye(2)),
    "uvs on a line": ([[0, 48, 49]], np.eye(3)[:2], np.array([[1.0, 1], [2, 2]])),
    "uvs at one place": ([[0, 48, 49]], np.eye(3)[:2], np.zeros((2, 2))),
    "not finite": ([[0, 48, 49]], np.array([[np.nan, 0, 0], [0, 1, np.inf]]), np.eye(2)),
    "uvs not finite": ([[0, 48, 49]], np.eye(3)[:2], np.array([[np.inf, 0], [0, np.nan]])),
}


@pytest.mark.parametrize("flaw", BAD_FACES)
def test_faces_without_a_frame_contribute_nothing(flaw):
    extra_faces, extra_positions, extra_uvs = BAD_FACES[flaw]
    positions, normals, uvs, faces = bumpy_torus()
    positions, uvs = positions - positions[0], uvs - uvs[0]
    count, more = len(positions), len(extra_positions)
    assert count == 48
    flawed = (
        np.vstack([positions, extra_positions]),
        np.vstack([normals, np.ones((more, 3))]),
        np.vstack([uvs, extra_uvs]),
        np.vstack([faces, extra_faces]),
    )
    triangles = triangles_of(flawed[0], flawed[2], flawed[3])
    assert_close(triangles.valid, np.arange(len(faces) + 1) < len(faces))
    for array in triangles:
        assert_close(array[-1], np.zeros_like(array[-1]), ulps=0)

    before, after = frames_of(positions, normals, uvs, faces), frames_of(*flawed)
    for array, expected in zip(after, before, strict=True):
        assert_close(array[:count], expected, ulps=4)
    assert not after.valid[count:].any()
    weights = np.random.default_rng(0).normal(size=(count + more, 3))
    good = vertex_gradient(positions, normals, uvs, faces, weights[:count])
    for gradient, expected in zip(vertex_gradient(*flawed, weights), good, strict=True):
        assert_close(gradient[:count], expected, ulps=64)
        assert_close(gradient[count:], np.zeros_like(gradient[count:]), ulps=0)


@pytest.mark.parametrize("noise", [0.0, 1e-5])
def test_contributions_that_cancel_leave_no_frame(noise):
    """Two corners, turned by half a turn in UVs: what is left is the noise."""
    positions = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]], float)
    uvs = np.array([[0, 0], [1, 0], [0, 1], [1, noise], [0, 1]], float)
    mesh = positions, np.tile([0, 0, 1.0], (5, 1)), uvs, np.array([[0, 1, 2], [0, 3, 4]])
    frames = frames_of(*mesh)
    assert_close(frames.valid, np.arange(5) > 0)
    weights = (np.arange(5) == 0)[:, None] * np.ones(3)
    for gradient in vertex_gradient(*mesh, weights):
        assert_close(gradient, np.zeros_like(gradient), ulps=0)


def test_an_edge_on_face_has_finite_derivatives():
    """Seen from its own plane, and with an edge along the normal."""
    mesh = one_triangle(FLAT_UVS)
    for normal in ([1.0, 0, 0], [0, 1.0, 0], [1, 1, 0], [1, 2, 0]):
        edge_on = mesh[0], np.tile(normal, (3, 1)).astype(float), *mesh[2:]
        assert all(np.isfinite(g).all() for g in vertex_gradient(*edge_on, np.ones((3, 3))))


def test_a_needle_keeps_its_frame(dtype):
    corners = np.array([[0, 0, 0], [1, 0, 0], [0.5, 1e-5, 0]], dtype)
    uvs = np.array([[0, 0], [1, 0], [0.5, 1]], dtype)
    frames = frames_of(
        corners, np.tile(np.eye(3, dtype=dtype)[2], (3, 1)), uvs, np.array([[0, 1, 2]])
    )
    assert frames.valid.all()
    assert_close(frames.tangent, np.tile([1.0, 0, 0], (3, 1)), ulps=1)


@pytest.mark.errors
@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"positions": np.zeros((3, 2))}, r"`positions` of shape \(vertices, 3\), got \(3, 2\)"),
        ({"uvs": np.zeros((3, 3))}, r"`uvs` of shape \(3, 2\), got \(3, 3\); give one row per"),
        ({"uvs": np.zeros((4, 2))}, r"`uvs` of shape \(3, 2\), got \(4, 2\)"),
        ({"faces": np.zeros((1, 4), int)}, r"`faces` of shape \(faces, 3\), got \(1, 4\)"),
        ({"faces": np.array([[0, 1, 3]])}, "`faces` to index 3 vertices, got 3"),
        ({"normals": np.zeros((2, 3))}, r"`normals` of shape \(3, 3\), got \(2, 3\)"),
    ],
)
def test_wrong_arguments_are_named(change, message):
    names = ("positions", "normals", "uvs", "faces")
    arguments = dict(zip(names, one_triangle(FLAT_UVS), strict=True)) | change
    with pytest.raises(ValueError, match=f"vertex_frames: expected {message}"):
        vertex_frames(**arguments)
    del arguments["normals"]
    if "normals" not in change:
        with pytest.raises(ValueError, match=f"triangle_frames: expected {message}"):
            triangle_frames(**arguments)
