"""MikkTSpace: the reference's own numbers, an oracle on wild meshes, laws, derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jax.test_util import check_grads

from tangentspace import Mesh, shapes
from tangentspace._mikktspace_links import following_corners
from tangentspace._mikktspace_weld import weld
from tangentspace.mikktspace import corner_groups, corner_tangents, group_tangents, with_tangents

from .mikktspace_reference import slow_corner_tangents, slow_names, slow_partners
from .tools import assert_close

UNIT = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]])
IDENTITY = [[0, 0], [1, 0], [0, 1]]
ROTATION, _ = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))
ROTATION *= np.linalg.det(ROTATION)  # not a mirror
DEFAULT = [1, 0, 0, -1]
groups_to_tangents = jax.jit(group_tangents)


def mesh_of(positions, uvs, faces=((0, 1, 2),), normal=(0, 0, 1), dtype=np.float32):
    normals = np.broadcast_to(np.array(normal, dtype), np.shape(positions)).copy()
    return Mesh(np.array(positions, dtype), normals, np.array(faces), np.array(uvs, dtype))


def corners_of(mesh):
    return corner_groups(mesh.positions, mesh.normals, mesh.uvs, mesh.faces)


def smooth_tangents(mesh):
    arrays = mesh.positions, mesh.normals, mesh.uvs
    return groups_to_tangents(*arrays, corner_groups(*arrays, mesh.faces))


def bumpy_sphere(dtype=np.float32):
    """A closed surface without symmetries: 80 faces, mirrored in u where x is negative."""
    mesh = shapes.icosphere(subdivisions=1, dtype=np.float64)
    stretch = np.random.default_rng(0).uniform(0.8, 1.2, (len(mesh.positions), 1))
    positions = (mesh.positions * stretch) @ ROTATION.T
    x, y, z = positions.T
    uvs = np.stack([np.abs(x), y + 0.3 * z], axis=1)
    normals = mesh.normals @ ROTATION.T
    return Mesh(positions.astype(dtype), normals.astype(dtype), mesh.faces, uvs.astype(dtype))


def ordinary_mesh(dtype=np.float32):
    """The bumpy sphere and a lone last face: its edges are the ones that stay unsorted.

    Without it the reference misses a pair on the sphere, and another if the order changes.
    """
    lone = mesh_of(UNIT + 5.0, IDENTITY, dtype=dtype)
    return shapes.merge(bumpy_sphere(dtype), lone)


# Answers of the C reference, compiled and run for these tests; tangent and sign per corner.
TRIANGLES = {
    "identity": (UNIT, IDENTITY, (0, 0, 1), [[1, 0, 0, 1]] * 3),
    "mirrored": (UNIT, [[0, 0], [-1, 0], [0, 1]], (0, 0, 1), [[-1, 0, 0, -1]] * 3),
    "sheared": (UNIT, [[0, 0], [1, 0], [0.5, 1]], (0, 0, 1), [[1, 0, 0, 1]] * 3),
    "equal uvs": (UNIT, [[0.3, 0.7]] * 3, (0, 0, 1), [DEFAULT] * 3),
    "equal uvs, normal along x": (UNIT, [[0.3, 0.7]] * 3, (1, 0, 0), [DEFAULT] * 3),
    "uvs on a line": (UNIT, [[0, 0], [1, 1], [2, 2]], (0, 0, 1), [DEFAULT] * 3),
    "repeated position": (UNIT[[0, 1, 1]], IDENTITY, (0, 0, 1), [DEFAULT] * 3),
    "no normal": (UNIT, IDENTITY, (0, 0, 0), [[1, 0, 0, 1]] * 3),
    "normal along the tangent": (UNIT, IDENTITY, (1, 0, 0), [[0, 0, 0, 1]] * 3),
    "normal along an edge": (
        UNIT,
        IDENTITY,
        (0, 1, 0),
        [[1, 0, 0, 1], [0, 0, 0, 1], [1, 0, 0, 1]],
    ),
    "normal not of unit length": (UNIT, IDENTITY, (1, 0, 1), [[0, 0, -1, 1]] * 3),
    "uv area of the least float": (UNIT, np.multiply(IDENTITY, 2.0**-63), (0, 0, 1), [DEFAULT] * 3),
    "uv area twice the least float": (
        UNIT,
        np.multiply(IDENTITY, [2.0**-62, 2.0**-63]),
        (0, 0, 1),
        [[1, 0, 0, 1]] * 3,
    ),
    "uv area beyond the largest float": (
        UNIT,
        np.multiply(IDENTITY, 1e20),
        (0, 0, 1),
        [DEFAULT] * 3,
    ),
    "no length along v": (
        [[0, 0, 0], [1, 0, 0], [0, 1e-21, 0]],
        [[0, 0], [1, 0], [0, 1e18]],
        (0, 0, 1),
        [DEFAULT] * 3,
    ),
    "tiny positions": (UNIT * 1e-20, IDENTITY, (0, 0, 1), [[1, 0, 0, 1]] * 3),
    "squares of lengths overflow": (UNIT * 1e25, IDENTITY, (0, 0, 1), [[0, 0, 0, 1]] * 3),
    "sliver": (
        [[2, 0, 0], [3, 0, 0], [4, 0, 0]],
        IDENTITY,
        (0, 0, 1),
        [[0, 0, 0, 1], [1, 0, 0, 1], [0, 0, 0, 1]],
    ),
}

# Meshes found by a search for those that a single wrong rule gets wrong; normals are +z.
# Positions, UVs, faces, the reference's different answers, and which of them each corner has.
MESHES = {
    "a loose face, first reached by a negative group": (
        [[1, 0, 0], [2, 2, 1], [2, 0, 1], [2, 1, 0]],
        [[0, 2], [2, 2], [1, 1], [0, 2]],
        [[2, 3, 1], [1, 0, 2], [2, 0, 3], [3, 2, 1]],
        [
            [0, 0, 0, -1],
            [0, 1, 0, -1],
            [0.447214, 0.894427, 0, 1],
            [1, 0, 0, -1],
            [0, 1, 0, 1],
            [0, 0, 0, 1],
        ],
        [[0, 1, 0], [2, 2, 2], [0, 3, 1], [4, 5, 5]],
    ),
    "a loose face, first reached by a positive group": (
        [[1, 2, 0], [0, 1, 2], [1, 1, 2], [1, 2, 2]],
        [[0, 1], [0, 0], [0, 1], [2, 1]],
        [[0, 3, 2], [1, 3, 0], [2, 3, 1]],
        [[0, 0, 0, 1], [1, 0, 0, -1], [0, 1, 0, -1]],
        [[0, 0, 1], [0, 0, 0], [2, 2, 2]],
    ),
    "a loose face between faces of one handedness": (
        [[1, 1, 2], [1, 2, 0], [2, 1, 2], [0, 0, 1]],
        [[2, 2], [1, 2], [1, 2], [2, 0]],
        [[3, 0, 2], [2, 0, 1]],
        [[-1, 0, 0, 1], [1, 0, 0, -1]],
        [[0, 0, 0], [0, 0, 1]],
    ),
    "three faces at an edge": (
        [[1, 1, 2], [0, 1, 0], [0, 2, 2], [0, 0, 1]],
        [[0, 2], [0, 2], [1, 0], [1, 1]],
        [[0, 3, 2], [3, 0, 1], [2, 0, 3]],
        [[-0.316228, -0.948683, 0, -1], [1, 0, 0, -1]],
        [[0, 0, 0], [0, 0, 1], [0, 0, 0]],
    ),
    "opposite tangents are left out": (
        [[2, 0, 0], [1, 0, 2], [0, 0, 1], [0, 2, 2], [2, 0, 2]],
        [[0, 2], [2, 1], [1, 2], [0, 0], [2, 2]],
        [[1, 4, 2], [3, 2, 4], [3, 0, 2], [1, 2, 4]],
        [[1, 0, 0, 1], [0, 0, 0, 1], [1, 0, 0, -1], [-1, 0, 0, -1], [0, 0, 0, -1]],
        [[0, 1, 1], [2, 2, 2], [3, 3, 3], [2, 4, 4]],
    ),
    "opposite bitangents are left out": (
        [[1, 1, 1], [2, 2, 2], [0, 2, 0], [1, 1, 2], [2, 0, 1]],
        [[0, 0], [1, 1], [1, 1], [0, 2], [0, 1]],
        [[1, 4, 3], [0, 4, 2], [4, 0, 3]],
        [[0, 1, 0, -1], [-0.707107, 0.707107, 0, -1], [-0.000311, 1, 0, -1]],
        [[0, 0, 0], [1, 1, 1], [2, 1, 0]],
    ),
    "zeros of either sign": (
        [[1, 0, 2], [0, 2, 1], [1, 1, 2], [0, 1, 0], [1, -0.0, 2]],
        [[1, 1], [0, 1], [2, 0], [0, 1], [1, 1]],
        [[1, 3, 4], [0, 2, 1]],
        [[0.447214, -0.894427, 0, -1], [1, 0, 0, -1]],
        [[0, 1, 0], [0, 0, 0]],
    ),
    "a pair of faces that the unsorted edges hide": (
        [[0, 1, 0], [2, 0, 2], [0, 0, 0], [2, 0, 1]],
        [[1, 0], [2, 2], [2, 2], [0, 1]],
        [[2, 0, 1], [0, 2, 3], [0, 2, 1], [3, 2, 1], [3, 1, 2], [2, 3, 1], [1, 2, 3]],
        [[-0.970142, 0.242536, 0, 1], [-0.970143, 0.242536, 0, 1], [1, 0, 0, -1]],
        [[0, 1, 2], [1, 0, 0], [1, 0, 2], [0, 0, 2], [2, 2, 0], [2, 2, 2], [2, 2, 0]],
    ),
    "the corner that stands for a vertex decides which edges are hidden": (
        [[2, 1, 2], [2, 0, 1], [1, 0, 0], [2, 0, 0]],
        [[2, 2], [2, 2], [0, 1], [1, 2]],
        [[0, 3, 1], [2, 0, 0], [3, 0, 2], [0, 1, 3], [0, 3, 0]],
        [[0, 1, 0, -1], [1, 0, 0, -1]],
        [[0, 0, 1], [0, 0, 0], [0, 0, 0], [0, 1, 0], [0, 0, 0]],
    ),
}


@pytest.mark.parametrize("name", TRIANGLES)
def test_single_triangles(name):
    positions, uvs, normal, expected = TRIANGLES[name]
    tangents = corner_tangents(mesh_of(positions, uvs, normal=normal))
    assert tangents.dtype == np.float32
    assert_close(tangents[0], np.array(expected), ulps=1)


@pytest.mark.parametrize("name", MESHES)
def test_small_meshes(name):
    positions, uvs, faces, answers, answer = MESHES[name]
    tangents = corner_tangents(mesh_of(positions, uvs, faces))
    assert_close(tangents, np.array(answers)[answer], ulps=8)  # stored to six decimals


def test_a_sliver_beside_a_good_triangle():
    positions = [*UNIT, [2, 0, 0], [3, 0, 0], [4, 0, 0]]
    tangents = corner_tangents(mesh_of(positions, IDENTITY * 2, [[0, 1, 2], [3, 4, 5]]))
    expected = [[[1, 0, 0, 1]] * 3, [[0, 0, 0, 1], [1, 0, 0, 1], [0, 0, 0, 1]]]
    assert_close(tangents, np.array(expected), ulps=0)


def test_bitangents_that_overflow_are_opposite_to_all():
    positions = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]) * 1e19
    uvs = np.multiply([[0, 0], [1, 0], [0, 1], [-1, 0.5]], [1e20, 1e-3])
    tangents = corner_tangents(mesh_of(positions, uvs, [[0, 1, 2], [0, 2, 3]]))
    root = np.sqrt(0.5)
    expected = [[[1, 0, 0, 1]] * 3, [[root, -root, 0, 1]] * 3]
    assert_close(tangents, np.array(expected), ulps=1)


def test_tangents_are_zero_where_the_reference_has_nan():
    tangents = corner_tangents(mesh_of(UNIT, IDENTITY, normal=(1, 1e-23, 0)))
    assert_close(tangents[0], np.array([[0, 0, 0, 1]] * 3), ulps=0)


def mirrored_strip():
    positions = [[x, y, 0] for x in (-1, 0, 1) for y in (0, 1)]
    faces = [[0, 2, 1], [1, 2, 3], [2, 4, 3], [3, 4, 5]]
    return mesh_of(positions, np.abs(positions)[:, :2], faces)


def test_mirrored_faces_share_no_tangent():
    tangents = corner_tangents(mirrored_strip())
    assert_close(tangents[:2], np.tile([-1, 0, 0, -1], (2, 3, 1)), ulps=0)
    assert_close(tangents[2:], np.tile([1, 0, 0, 1], (2, 3, 1)), ulps=0)


def test_a_fold_with_a_shared_normal_shares_its_tangent():
    positions = [[0, 0, 0], [0, 1, 0], [-1, 0, 0], [0, 0, -1]]
    uvs = [[0, 0], [0, 1], [-1, 0], [1, 0]]
    normal = np.array([1, 0, 1]) / np.sqrt(2)
    tangents = corner_tangents(mesh_of(positions, uvs, [[0, 1, 2], [0, 3, 1]], normal))
    assert_close(tangents[0, 0], np.array([0.70710678, 0, -0.70710678, 1]), ulps=1)
    assert_close(tangents[1, 0], tangents[0, 0], ulps=0)


def test_a_torus_has_its_analytic_tangents():
    mesh = shapes.torus(dtype=np.float32)
    tangents = corner_tangents(mesh)
    x, _, z = mesh.positions[mesh.faces].transpose(2, 0, 1)
    ring = np.stack([z, 0 * z, -x], axis=-1)
    ring /= np.linalg.norm(ring, axis=-1, keepdims=True)
    along = np.abs(np.sum(ring * tangents[..., :3], axis=-1))
    # Least at the seam, where the sum is one-sided by half of a segment: cos(pi / 32).
    assert along.min() > 0.9951, along.min()


def test_no_faces():
    assert corner_tangents(mesh_of(UNIT, IDENTITY, np.zeros((0, 3), int))).shape == (0, 3, 4)


@pytest.mark.parametrize("seed", range(4))
def test_welding_chooses_as_the_reference_does(seed):
    """Clusters of neighboring floats, so that nearly all corners are moved in the sorting."""
    random = np.random.default_rng(seed)
    positions = random.integers(0, 3, (40, 3)).astype(np.float32)
    positions[20:] = np.nextafter(positions[20:], np.float32(9))
    positions = positions[random.integers(0, 40, 200)]
    normals, uvs = np.zeros_like(positions), random.integers(0, 2, (200, 2)).astype(np.float32)
    faces = random.permutation(600).reshape(-1, 3) % 200
    arrays = (list(array[faces.ravel()]) for array in (positions, normals, uvs))
    assert_close(weld(positions, normals, uvs, faces).ravel(), np.array(slow_names(*arrays)))


@pytest.mark.parametrize("seed", range(4))
def test_edges_are_paired_as_the_reference_does(seed):
    """Many edges of many faces run from vertex 20 upwards: these stay unsorted."""
    random = np.random.default_rng(seed)
    fan = np.column_stack([np.full(60, 20), *random.integers([0, 21], [20, 27], (60, 2)).T])
    others = random.permuted(np.tile(np.arange(20), (60, 1)), axis=1)[:, :3]
    turned = random.permuted(np.vstack([fan, others]), axis=1)
    welded = random.permutation(turned)
    partners = slow_partners(welded.ravel().tolist(), range(len(welded)))
    expected = np.full(welded.size, -1)
    for edge, partner in partners.items():
        expected[edge] = 3 * (partner // 3) + (partner % 3 + 1) % 3
    assert_close(following_corners(welded), expected)


SMALL = st.integers(0, 2)
NORMALS = [[0, 0, 1], [0, 1, 0], [-1, 0, 0], [0.6, 0, 0.8], [1, 1, 0], [0, 0, 0], [0.3, -0.5, 0.4]]


@st.composite
def wild_meshes(draw):
    """Few places in space and texture, so that everything that can coincide does."""
    count = draw(st.integers(3, 7))
    rows = lambda values, width: draw(
        st.lists(st.tuples(*[values] * width), min_size=count, max_size=count)
    )
    faces = st.lists(st.tuples(*[st.integers(0, count - 1)] * 3), min_size=1, max_size=12)
    normals = np.array(NORMALS)[np.ravel(rows(st.integers(0, len(NORMALS) - 1), 1))]
    scale = 10.0 ** draw(st.sampled_from([0, 0, 0, -19, 18]))
    arrays = rows(SMALL, 3), normals, np.multiply(rows(SMALL, 2), scale)
    return *(np.array(array, np.float32) for array in arrays), np.array(draw(faces))


@given(wild_meshes())
@settings(max_examples=300)
def test_agrees_with_the_definition(wild):
    positions, normals, uvs, faces = wild
    tangents = corner_tangents(Mesh(positions, normals, faces, uvs))
    expected = slow_corner_tangents(*wild)
    defined = np.all(np.isfinite(expected), axis=-1, keepdims=True)
    assert_close(tangents, np.where(defined, expected, tangents), ulps=4)  # measured 0


@pytest.mark.parametrize("seed", range(6))
def test_agrees_with_the_definition_on_patched_spheres(seed):
    """Real shapes, where welding sorts by many boxes; patches of no area and of mirrored UVs."""
    random = np.random.default_rng(seed)
    mesh = bumpy_sphere()
    uvs = np.array(mesh.uvs)
    uvs = np.round(2 * uvs) / 2 if seed % 2 else uvs
    uvs[random.random(len(uvs)) < 0.15] = 0.5
    faces = random.permutation(mesh.faces)
    tangents = corner_tangents(Mesh(mesh.positions, mesh.normals, faces, uvs))
    expected = slow_corner_tangents(mesh.positions, mesh.normals, uvs, faces)
    assert_close(tangents, expected, ulps=4)  # measured 0


def exploded(mesh):
    """Give each corner a vertex of its own."""
    corners = mesh.faces.ravel()
    faces = np.arange(len(corners)).reshape(-1, 3)
    return Mesh(mesh.positions[corners], mesh.normals[corners], faces, mesh.uvs[corners])


def test_vertices_are_welded_whatever_the_index_list():
    mesh = bumpy_sphere()
    assert_close(corner_tangents(exploded(mesh)), corner_tangents(mesh), ulps=0)


LAWS = {
    "move": (lambda m: m._replace(positions=m.positions + 1), lambda t: t),
    "rotate": (
        lambda m: m._replace(positions=m.positions @ ROTATION.T, normals=m.normals @ ROTATION.T),
        lambda t: np.concatenate([t[..., :3] @ ROTATION.T, t[..., 3:]], axis=-1),
    ),
    "grow": (lambda m: m._replace(positions=m.positions * 1e6), lambda t: t),
    "stretch the texture": (lambda m: m._replace(uvs=m.uvs * [4, 2**-10]), lambda t: t),
    "mirror u": (lambda m: m._replace(uvs=m.uvs * [-1, 1]), lambda t: -t),
    "mirror v": (lambda m: m._replace(uvs=m.uvs * [1, -1]), lambda t: t * [1, 1, 1, -1]),
    "reorder the faces": (
        lambda m: m._replace(faces=np.roll(m.faces[::-1], -1, axis=0)),  # the lone one last
        lambda t: np.roll(t[::-1], -1, axis=0),
    ),
    "turn the faces": (
        lambda m: m._replace(faces=np.roll(m.faces, 1, axis=1)),
        lambda t: np.roll(t, 1, axis=1),
    ),
}


@pytest.mark.parametrize("law", LAWS)
def test_law(law):
    change, expect = LAWS[law]
    mesh = ordinary_mesh(np.float64)
    tangents = corner_tangents(change(mesh))
    assert_close(tangents, expect(corner_tangents(mesh)), ulps=128)


@given(wild_meshes())
def test_lengths_and_signs(wild):
    positions, normals, uvs, faces = wild
    tangents = corner_tangents(Mesh(positions, normals, faces, uvs))
    lengths = np.linalg.norm(tangents[..., :3].astype(float), axis=-1)
    assert np.all((np.abs(lengths - 1) < 1e-6) | (lengths == 0))
    assert set(np.unique(tangents[..., 3])) <= {-1.0, 1.0}


def test_tangents_are_perpendicular_to_normals():
    mesh = bumpy_sphere()
    tangents = corner_tangents(mesh)[..., :3]
    assert_close(np.sum(tangents * mesh.normals[mesh.faces], axis=-1), 0.0, ulps=4)
    assert_close(np.sum(tangents**2, axis=-1), 1.0, ulps=4)


def test_smooth_core_equals_the_reference_arithmetic():
    mesh = bumpy_sphere()
    tangents = smooth_tangents(mesh)
    assert tangents.dtype == np.float32
    assert_close(tangents, corner_tangents(mesh), ulps=32)


def test_smooth_core_equals_the_definition_in_double_precision():
    mesh = bumpy_sphere(np.float64)
    expected = slow_corner_tangents(mesh.positions, mesh.normals, mesh.uvs, mesh.faces, np.float64)
    assert_close(smooth_tangents(mesh), expected)


@pytest.mark.parametrize("name", TRIANGLES)
def test_smooth_core_on_single_triangles(name, dtype):
    positions, uvs, normal, expected = TRIANGLES[name]
    if name != "squares of lengths overflow":  # the smooth core has the tangent there
        mesh = mesh_of(positions, uvs, normal=normal, dtype=dtype)
        assert_close(smooth_tangents(mesh)[0], np.array(expected), ulps=1)


@pytest.mark.parametrize("name", [name for name in MESHES if "bitangents" not in name])
def test_smooth_core_on_small_meshes(name):
    """But the one where the reference's weight is the rounding of an angle of zero."""
    positions, uvs, faces, answers, answer = MESHES[name]
    tangents = smooth_tangents(mesh_of(positions, uvs, faces))
    assert_close(tangents, np.array(answers)[answer], ulps=64)


DIAGONAL = np.array([1.0, 2.0, 3.0])
PENTAGON = np.array([[np.cos(a), np.sin(a), 0] for a in 2 * np.pi * np.arange(6) / 5])
# Positions, UVs, faces, normal, and the corners of the first face that have no tangent.
REMAINDERS = {
    "angles of a slanting sliver": (
        np.outer([0.1, 0.2, 0.7], DIAGONAL),
        IDENTITY,
        [[0, 1, 2]],
        (0, 0, 1),
        [True, False, True],
    ),
    "tangent along a slanting normal": (
        np.array([[0, 0, 0], DIAGONAL / 3, [0.1, 0.5, 0.2]]),
        IDENTITY,
        [[0, 1, 2]],
        DIAGONAL / np.sqrt(14),
        [True] * 3,
    ),
    "sum around a pole": (
        np.vstack([PENTAGON, [0, 0, 0]]),
        np.array([*[[i, 0] for i in range(6)], [2.5, 1]]),
        [[i, i + 1, 6] for i in range(5)],
        (0, 0, 1),
        [False, False, True],
    ),
}


@pytest.mark.parametrize("name", REMAINDERS)
def test_remainders_of_rounding_count_as_zero(name, dtype):
    positions, uvs, faces, normal, vanish = REMAINDERS[name]
    mesh = mesh_of(positions, uvs, faces, normal, dtype)
    lengths = np.linalg.norm(smooth_tangents(mesh)[0, :, :3], axis=-1)
    assert_close(lengths, np.where(vanish, 0.0, 1.0), ulps=2)
    assert all(np.all(np.isfinite(gradient)) for gradient in gradients(mesh, len(faces)))


def test_derivatives():
    mesh = bumpy_sphere(np.float64)
    groups = corners_of(mesh)
    function = jax.jit(lambda *arrays: group_tangents(*arrays, groups))
    arrays = mesh.positions, mesh.normals, mesh.uvs
    check_grads(function, arrays, 1, ("fwd", "rev"), atol=1e-6, rtol=1e-6, eps=1e-5)


@jax.jit
def mixed_gradients(positions, normals, uvs, groups, weights):
    """Differentiate a mix of all components of the first tangents by all three arrays."""
    mixed = lambda *arrays: jnp.sum(weights * group_tangents(*arrays, groups)[: len(weights)])
    return jax.grad(mixed, (0, 1, 2))(positions, normals, uvs)


def gradients(mesh, count):
    weights = np.random.default_rng(0).normal(size=(count, 3, 4)).astype(mesh.uvs.dtype)
    return mixed_gradients(mesh.positions, mesh.normals, mesh.uvs, corners_of(mesh), weights)


@pytest.mark.parametrize("name", TRIANGLES)
def test_derivatives_at_degenerate_triangles(name, dtype):
    positions, uvs, normal, expected = TRIANGLES[name]
    for gradient in gradients(mesh_of(positions, uvs, normal=normal, dtype=dtype), 1):
        assert np.all(np.isfinite(gradient))
        if expected[0] == DEFAULT or name == "normal along the tangent":
            assert_close(gradient, 0.0, ulps=0)


# Faces added to a good mesh that contribute nothing: three new vertices, or old ones.
FLAWS = {
    "repeated vertex": ([0, 1, 1], np.zeros((3, 3)), np.zeros((3, 2))),
    "repeated position": ([-3, -2, -1], UNIT[[0, 1, 1]] + 9.0, np.array(IDENTITY, float)),
    "no area in the texture": ([-3, -2, -1], UNIT + 9.0, np.ones((3, 2))),
    "nothing at all": ([-3, -2, -1], np.full((3, 3), 9.0), np.ones((3, 2))),
}


@pytest.mark.parametrize("flaw", FLAWS)
def test_degenerate_faces_leave_the_others_alone(flaw):
    face, positions, uvs = FLAWS[flaw]
    mesh = ordinary_mesh(np.float64)
    count, vertices = len(mesh.faces), len(mesh.positions)
    flawed = Mesh(
        np.vstack([mesh.positions, positions]),
        np.vstack([mesh.normals, np.tile([0.0, 0.0, 1.0], (3, 1))]),
        np.vstack([mesh.faces, np.mod(face, vertices + 3)]),
        np.vstack([mesh.uvs, uvs]),
    )
    assert_close(smooth_tangents(flawed)[:count], smooth_tangents(mesh), ulps=1)
    assert_close(corner_tangents(flawed)[:count], corner_tangents(mesh), ulps=0)
    for changed, plain in zip(gradients(flawed, count), gradients(mesh, count), strict=True):
        assert_close(changed[:vertices], plain, ulps=16)
        assert_close(changed[vertices:], 0.0, ulps=0)


def test_groups_may_be_arguments_of_a_compiled_function_or_not():
    mesh = bumpy_sphere()
    groups = corners_of(mesh)
    assert all(isinstance(array, np.ndarray) for array in groups)
    kept = jax.jit(lambda *arrays: group_tangents(*arrays, groups))
    assert_close(kept(mesh.positions, mesh.normals, mesh.uvs), smooth_tangents(mesh), ulps=8)


def test_with_tangents_splits_only_where_corners_differ():
    mesh = with_tangents(mirrored_strip())
    assert len(mesh.positions) == 8
    assert_close(mesh.faces, np.array([[0, 2, 1], [1, 2, 3], [6, 4, 7], [7, 4, 5]]))
    assert_close(mesh.positions[6:], mesh.positions[2:4], ulps=0)
    assert_close(mesh.tangents[[2, 3]], np.tile([-1, 0, 0, -1], (2, 1)), ulps=0)
    assert_close(mesh.tangents[[6, 7]], np.tile([1, 0, 0, 1], (2, 1)), ulps=0)


def test_with_tangents_keeps_vertices_and_gives_each_corner_its_own(dtype):
    mesh = bumpy_sphere(dtype)
    split = with_tangents(mesh)
    count = len(mesh.positions)
    assert len(split.positions) > count
    assert {array.dtype for array in split if array is not split.faces} == {np.dtype(dtype)}
    assert split.faces.dtype == mesh.faces.dtype
    assert_close(split.tangents[split.faces], corner_tangents(mesh).astype(dtype), ulps=0)
    for before, after in ((mesh.positions, split.positions), (mesh.uvs, split.uvs)):
        assert_close(after[:count], before, ulps=0)
        assert_close(after[split.faces], before[mesh.faces], ulps=0)
    pairs = np.unique(np.hstack([split.positions, split.tangents]), axis=0)
    assert len(pairs) == len(split.positions)


def test_with_tangents_gives_unused_vertices_the_default():
    mesh = mesh_of([*UNIT, [9, 9, 9]], [*IDENTITY, [0, 0]])
    split = with_tangents(mesh)
    assert_close(split.tangents, np.array([*[[1, 0, 0, 1]] * 3, DEFAULT]), ulps=0)


@pytest.mark.parametrize("function", [corner_tangents, with_tangents])
def test_a_mesh_without_uvs_is_refused(function):
    mesh = mesh_of(UNIT, IDENTITY)._replace(uvs=None)
    with pytest.raises(ValueError, match=f"{function.__name__}: expected a mesh with `uvs`, got"):
        function(mesh)


@pytest.mark.errors
@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"positions": np.zeros((3, 2))}, r"`positions` of shape \(3, 3\), got \(3, 2\)"),
        ({"normals": np.zeros((2, 3))}, r"`normals` of shape \(3, 3\), got \(2, 3\)"),
        ({"uvs": np.zeros((3, 3))}, r"`uvs` of shape \(3, 2\), got \(3, 3\)"),
        ({"uvs": np.array([[0, 0], [np.nan, 1], [0, 1]])}, r"finite `uvs`, got \[nan, 1.0\] at"),
        ({"positions": UNIT * 1e300}, r"finite `positions`, got \[1e\+300, .*\] at vertex 1"),
        ({"faces": np.array([[0, 1, 2, 0]])}, r"`faces` of shape \(faces, 3\), got \(1, 4\)"),
        ({"faces": np.array([[0, 1, 3]])}, "`faces` to index 3 vertices, got 3"),
        ({"faces": np.array([[0, -1, 2]])}, "`faces` to index 3 vertices, got -1"),
    ],
)
def test_wrong_arguments_are_named(change, message):
    mesh = mesh_of(UNIT, IDENTITY)._replace(**change)
    with pytest.raises(ValueError, match=f"corner_groups: expected {message}"):
        corners_of(mesh)
