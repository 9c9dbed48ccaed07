"""Splitting vertices where mirrored textures meet: known answers, the definition, laws, errors."""

import numpy as np
import pytest

from tangentspace import shapes
from tangentspace.frames import triangle_frames, vertex_frames
from tangentspace.mesh import Mesh
from tangentspace.seams import split_mirrored

from .frames_reference import split_reference
from .tools import assert_close


def fan():
    """Four right triangles round vertex 0, the last two with a mirrored texture."""
    positions = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]], float)
    uvs = np.stack([positions[:, 0], np.abs(positions[:, 1])], axis=-1)
    faces = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 1]], np.int32)
    return Mesh(positions, np.tile([0, 0, 1.0], (5, 1)), faces, uvs)


def tangle(seed, dtype=np.float32):
    """Random faces on few vertices, a third of them without a frame, and every attribute."""
    rng = np.random.default_rng(seed)
    faces = rng.integers(0, 40, (60, 3)).astype(np.int32)
    uvs = rng.integers(-3, 4, (45, 2))  # often on a line: their areas are exact
    positions, normals = rng.normal(size=(2, 45, 3))
    tangents = rng.normal(size=(45, 4))
    arrays = (array.astype(dtype) for array in (positions, normals, uvs, tangents))
    positions, normals, uvs, tangents = arrays
    return Mesh(positions, normals, faces, uvs, tangents)


def sign_of(mesh):
    return np.asarray(triangle_frames(mesh.positions, mesh.uvs, mesh.faces).handedness)


def test_a_mirrored_fan_is_cut_in_two():
    """Vertices 0, 1 and 3 are shared; as many faces on each side, so the plain ones keep them."""
    mesh = split_mirrored(fan())
    source = [0, 1, 2, 3, 4, 0, 1, 3]
    assert_close(mesh.faces, np.array([[0, 1, 2], [0, 2, 3], [5, 7, 4], [5, 4, 6]]))
    assert mesh.faces.dtype == np.int32
    for array, before in zip(mesh[:4:3], fan()[:4:3], strict=True):
        assert_close(array, before[source], ulps=0)
    assert mesh.tangents is None
    frames = vertex_frames(mesh.positions, mesh.normals, mesh.uvs, mesh.faces)
    assert frames.valid.all()
    assert_close(frames.handedness, np.array([1, 1, 1, 1, -1, -1, -1, -1]), ulps=0)


def test_most_faces_keep_the_vertex():
    """Vertex 1 has one on each side, vertex 3 two mirrored ones."""
    mesh = fan()
    mirrored = mesh._replace(faces=np.concatenate([mesh.faces, mesh.faces[2:3]]))
    split = split_mirrored(mirrored)
    assert_close(split.faces, np.array([[5, 1, 2], [5, 2, 7], [0, 3, 4], [0, 4, 6], [0, 3, 4]]))


def test_faces_without_a_frame_stay():
    mesh = fan()
    flat = mesh._replace(faces=np.concatenate([mesh.faces, [[0, 1, 3], [0, 4, 4], [1, 3, 0]]]))
    split = split_mirrored(flat)
    assert_close(split.faces[:4], split_mirrored(mesh).faces)
    assert_close(split.faces[4:], flat.faces[4:])


@pytest.mark.parametrize("seed", range(4))
def test_agrees_with_the_definition(seed, dtype):
    mesh = tangle(seed, dtype)
    split = split_mirrored(mesh)
    moves = split_reference(mesh.uvs, mesh.faces)
    assert 10 < np.count_nonzero(moves) < 100
    copied = np.unique(mesh.faces[moves])
    rank = {vertex: 45 + k for k, vertex in enumerate(copied)}
    expected = [
        [rank[v] if moved else v for v, moved in zip(face, row, strict=True)]
        for face, row in zip(mesh.faces, moves, strict=True)
    ]
    assert_close(split.faces, np.array(expected))
    source = np.concatenate([np.arange(45), copied])
    for name in ("positions", "normals", "uvs", "tangents"):
        array = getattr(split, name)
        assert array.dtype == dtype
        assert_close(array, getattr(mesh, name)[source], ulps=0)


@pytest.mark.parametrize("seed", range(4))
def test_no_vertex_serves_both_handednesses(seed, dtype):
    split = split_mirrored(tangle(seed, dtype))
    sign = sign_of(split)
    assert set(sign) == {-1.0, 0.0, 1.0}
    sides = [set(split.faces[sign == side].ravel()) for side in (1, -1)]
    assert not sides[0] & sides[1]


@pytest.mark.parametrize("seed", range(4))
def test_a_second_time_changes_nothing(seed):
    once = split_mirrored(tangle(seed))
    for array, before in zip(split_mirrored(once), once, strict=True):
        assert_close(array, before, ulps=0)


def test_the_surface_and_its_texture_stay():
    mesh = tangle(0)
    split = split_mirrored(mesh)
    assert len(split.positions) > len(mesh.positions)
    for name in ("positions", "normals", "uvs", "tangents"):
        before, after = getattr(mesh, name), getattr(split, name)
        assert_close(after[split.faces], before[mesh.faces], ulps=0)


def test_nothing_to_split():
    mesh = shapes.torus(major_segments=5, minor_segments=4)
    for array, before in zip(split_mirrored(mesh)[:4], mesh[:4], strict=True):
        assert_close(array, before, ulps=0)


def test_arrays_given_are_left_alone():
    mesh = tangle(0)
    before = [array.copy() for array in mesh]
    split_mirrored(mesh)
    for array, copy in zip(mesh, before, strict=True):
        assert_close(array, copy, ulps=0)


@pytest.mark.errors
def test_wrong_meshes_are_refused():
    with pytest.raises(ValueError, match="split_mirrored: expected a mesh with `uvs`, got None"):
        split_mirrored(fan()._replace(uvs=None))
    with pytest.raises(ValueError, match="split_mirrored: expected `faces` to index 5 vertices"):
        split_mirrored(fan()._replace(faces=np.array([[0, 1, 5]])))
    with pytest.raises(ValueError, match=r"split_mirrored: expected `uvs` of shape \(5, 2\)"):
        split_mirrored(fan()._replace(uvs=np.zeros((4, 2))))
