"""Subdivision: counts, where vertices come to lie, the order of faces, seams, errors."""

import numpy as np
import pytest

from experiments.files.subdivide import subdivide
from tangentspace import shapes
from tangentspace.mesh import Mesh

from .tools import assert_close

TRIANGLE = Mesh(
    positions=np.array([[0.0, 0, 0], [4, 0, 0], [0, 8, 0]]),
    normals=np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]),
    faces=np.array([[0, 1, 2]]),
    uvs=np.array([[0.0, 0], [1, 0], [0, 1]]),
    tangents=np.array([[1.0, 0, 0, -1], [0, 0, 1, -1], [0, 0, 1, 1]]),
)


def corners(mesh):
    """For each face what its corners have, side by side."""
    arrays = [a for a in mesh._replace(faces=None) if a is not None]
    return np.concatenate(arrays, axis=1)[mesh.faces]


def unit(vectors):
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def test_a_triangle_cut_once():
    mesh, parents = subdivide(TRIANGLE, 1)
    a, b, c = TRIANGLE.positions
    ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
    expected = np.array([[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]])
    assert_close(mesh.positions[mesh.faces], expected, ulps=0)
    assert_close(mesh.positions[:3], TRIANGLE.positions, ulps=0)
    assert len(mesh.positions) == 6
    assert parents.tolist() == [0, 0, 0, 0]
    middle = mesh.faces[3]  # between corners 0 and 1, 1 and 2, 2 and 0
    assert_close(mesh.uvs[middle], np.array([[0.5, 0], [0.5, 0.5], [0, 0.5]]), ulps=0)
    assert_close(mesh.normals[middle], unit(np.array([[1.0, 0, 1], [1, 1, 0], [0, 1, 1]])))
    tangents = unit(np.array([[1.0, 0, 1], [0, 0, 1], [1, 0, 1]]))
    assert_close(mesh.tangents[middle, :3], tangents)
    assert_close(mesh.tangents[middle, 3], np.array([-1.0, 1, 1]), ulps=0)


@pytest.mark.parametrize("levels", [0, 1, 3])
def test_every_part_lies_in_its_parent(levels, dtype):
    coarse = shapes.torus(major_segments=5, minor_segments=4, dtype=dtype)
    mesh, parents = subdivide(coarse, levels)
    assert len(mesh.faces) == len(coarse.faces) * 4**levels
    assert {a.dtype for a in (mesh.positions, mesh.normals, mesh.uvs)} == {np.dtype(dtype)}
    assert mesh.faces.dtype == coarse.faces.dtype
    assert mesh.tangents is None
    assert_close(parents, np.arange(len(coarse.faces)).repeat(4**levels))
    kept = len(coarse.positions)
    assert all(np.array_equal(mesh[k][:kept], coarse[k]) for k in (0, 1, 3))
    # Barycentric coordinates in the parent, found from the uvs, give the positions.
    u = coarse.uvs.astype(np.float64)[coarse.faces[parents]]
    edges = np.stack([u[:, 1] - u[:, 0], u[:, 2] - u[:, 0]], axis=-1)
    weights = np.linalg.solve(
        edges[:, None], (mesh.uvs[mesh.faces] - u[:, None, 0].astype(dtype))[..., None]
    )[..., 0]
    assert weights.min() > -1e-6
    assert weights.sum(axis=-1).max() < 1 + 1e-6
    p = coarse.positions.astype(np.float64)[coarse.faces[parents]]
    expected = p[:, None, 0] + weights @ (p[:, 1:] - p[:, :1])
    assert_close(mesh.positions[mesh.faces], expected.astype(dtype), ulps=16)  # measured 3.5
    assert_close(np.linalg.norm(mesh.normals, axis=1), np.ones(len(mesh.normals)), ulps=4)


def test_area_and_winding_are_kept():
    coarse = shapes.icosphere(subdivisions=1, dtype=np.float64)
    mesh, parents = subdivide(coarse, 2)

    def areas(mesh):
        a, b, c = mesh.positions[mesh.faces].transpose(1, 0, 2)
        return np.cross(b - a, c - a) / 2

    whole = areas(coarse)
    assert_close(areas(mesh), whole[parents] / 16)
    edges = np.sort(np.stack([mesh.faces, np.roll(mesh.faces, -1, 1)], -1).reshape(-1, 2), axis=1)
    assert len(np.unique(edges, axis=0)) == len(edges) / 2  # each edge has two faces: no cracks


def test_normals_are_those_of_the_coarse_face():
    """Interpolated over the whole face, then of unit length, not cut by cut."""
    mesh, _ = subdivide(TRIANGLE, 2)
    weights = np.stack([1 - mesh.uvs.sum(axis=1), *mesh.uvs.T], axis=-1)
    assert_close(mesh.normals, unit(weights @ TRIANGLE.normals), ulps=4)


def test_seams_stay_at_one_place():
    coarse = shapes.uv_sphere(rings=4, segments=6)
    mesh, _ = subdivide(coarse, 2)
    along_seam = np.flatnonzero(coarse.uvs[:, 0] % 1 == 0)
    assert len(along_seam) == 2 * 3
    left, right = (np.flatnonzero(mesh.uvs[:, 0] == u) for u in (0, 1))
    assert len(left) == len(right) > 3
    order = [side[np.argsort(mesh.uvs[side, 1])] for side in (left, right)]
    assert_close(mesh.positions[order[0]], mesh.positions[order[1]], ulps=0)
    assert_close(mesh.normals[order[0]], mesh.normals[order[1]], ulps=0)


def test_opposite_normals_leave_none():
    mesh = TRIANGLE._replace(normals=np.array([[0, 0, 1.0], [0, 0, -1], [0, 1, 0]]))
    assert_close(subdivide(mesh, 1).mesh.normals[subdivide(mesh, 1).mesh.faces[0, 1]], np.zeros(3))


@pytest.mark.errors
def test_too_many_faces_are_refused_at_once():
    with pytest.raises(ValueError, match="30 levels make 1152921504606846976 faces out of 1,"):
        subdivide(TRIANGLE, 30)
    with pytest.raises(ValueError, match="more than `max_faces` of 15; give fewer levels"):
        subdivide(TRIANGLE, 2, max_faces=15)
    assert len(subdivide(TRIANGLE, 2, max_faces=16).mesh.faces) == 16


@pytest.mark.errors
def test_negative_levels_are_refused():
    with pytest.raises(ValueError, match="`levels` of at least 0, got -1"):
        subdivide(TRIANGLE, -1)
