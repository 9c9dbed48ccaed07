"""Drawing a mesh into its own texture: where texels lie, wrapping, mirrored and shared ones."""

import numpy as np
import pytest

import experiments.baking.charts
from experiments.baking.charts import bands, draw, lay_out, shared_texels
from tangentspace.mesh import Mesh
from tangentspace.shapes import merge, plane

from .tools import assert_close

SIZE = 16


def flat_mesh(uvs, faces=((0, 1, 2),)):
    """Return a mesh that lies in its texture: x and y are u and v."""
    uvs = np.asarray(uvs, np.float32)
    positions = np.pad(uvs, ((0, 0), (0, 1)))
    normals = np.tile(np.float32([0, 0, 1]), (len(uvs), 1))
    return Mesh(positions, normals, np.asarray(faces, np.int32), uvs)


def with_uvs(mesh, *, factor=1.0, shift=(0.0, 0.0)):
    """Scale and move a mesh in its texture."""
    uvs = np.float32(factor) * np.asarray(mesh.uvs) + np.float32(shift)
    return mesh._replace(uvs=uvs.astype(np.float32))


def drawn(mesh, *, values=None, offset=(0.5, 0.5), size=SIZE):
    """Return faces and values of the whole texture; the values are UVs by default."""
    charts = lay_out(mesh, name="low")
    values = mesh.uvs if values is None else values
    parts = [
        (faces[band.kept], np.asarray(blended)[band.kept])
        for band in bands(size)
        for faces, blended in [draw(charts, values[mesh.faces], band, offset=offset)]
    ]
    return (np.concatenate(column) for column in zip(*parts, strict=True))


def texel_uvs(size=SIZE, offset=(0.5, 0.5)):
    """Return the UV of a point of each texel: row 0 on top, v up."""
    rows, columns = np.mgrid[:size, :size]
    return np.stack([(columns + offset[0]) / size, 1 - (rows + offset[1]) / size], axis=-1)


# Known answers


@pytest.mark.parametrize("offset", [(0.5, 0.5), (0.125, 0.875)])
def test_texel_centres_lie_at_half_integers_and_v_points_up(offset):
    faces, uvs = drawn(plane(), offset=offset)
    assert set(np.unique(faces)) == {0, 1}
    assert uvs.dtype == np.float32
    assert_close(uvs, texel_uvs(offset=offset), ulps=8)  # measured 1.5


def test_a_triangle_covers_the_texels_whose_centres_it_holds():
    corners = np.array([[0.1, 0.15], [0.93, 0.22], [0.4, 0.97]])
    faces, _ = drawn(flat_mesh(corners))
    across = np.roll(corners, -1, axis=0) - corners
    to_texel = texel_uvs()[:, :, None] - corners
    inside = (across[:, 0] * to_texel[..., 1] - across[:, 1] * to_texel[..., 0] > 0).all(axis=-1)
    np.testing.assert_array_equal(faces, np.where(inside, 0, -1))


def test_bands_are_parts_of_one_picture(monkeypatch):
    mesh = with_uvs(plane(segments=3), factor=(0.91, 0.83), shift=(0.03, 0.03))
    whole = list(drawn(mesh))  # no texel's centre lies on an edge, where rounding decides
    monkeypatch.setattr(experiments.baking.charts, "_BAND", 5 * SIZE)
    assert [band.top for band in bands(SIZE)] == [0, 5, 10, 15]
    for got, expected in zip(drawn(mesh), whole, strict=True):
        assert_close(got, expected, ulps=8)  # measured 1


# Wrapping


@pytest.mark.parametrize("tile", [(3, -2), (-1, 0)])
def test_whole_repetitions_make_no_difference(tile):
    mesh = flat_mesh([[0.1, 0.1], [0.9, 0.2], [0.3, 0.8]])
    shifted = with_uvs(mesh, shift=tile)
    (faces, values), (there, _) = drawn(shifted, values=mesh.uvs), drawn(mesh)
    np.testing.assert_array_equal(faces, there)
    assert_close(values[faces == 0], texel_uvs()[there == 0], ulps=64)  # measured 6
    assert lay_out(shifted, name="low").notes == (
        "1 face with UVs outside [0, 1]: the texture repeats",
    )


@pytest.mark.parametrize("shift", [(0.25, 0), (0.5, 0.25), (-0.25, -0.5)])
def test_what_leaves_the_texture_comes_in_on_the_other_side(shift):
    mesh = plane(segments=4)
    shifted = with_uvs(mesh, shift=shift)
    (faces, _), (there, _) = drawn(shifted), drawn(mesh)
    right, up = (round(SIZE * part) for part in shift)
    np.testing.assert_array_equal(faces, np.roll(there, (-up, right), axis=(0, 1)))
    assert shared_texels(lay_out(shifted, name="low"), SIZE) == (0, 0)


def test_uvs_that_miss_the_edge_by_rounding_are_not_outside():
    assert lay_out(with_uvs(plane(), factor=1.00001), name="low").notes == ()


# Shared texels


def halves():
    """Return a square whose right half lies mirrored on its left half."""
    uvs = [[0.5, 0], [0, 0], [0, 1], [0.5, 1], [0, 0], [0, 1]]
    return flat_mesh(uvs, [[1, 0, 3], [1, 3, 2], [0, 4, 5], [0, 5, 3]])


def test_mirrored_faces_come_last_and_are_counted():
    for mesh in (halves(), halves()._replace(faces=halves().faces[::-1])):
        charts = lay_out(mesh, name="low")
        assert sorted(charts.mirrored) == [False, False, True, True]
        faces, _ = drawn(mesh)
        np.testing.assert_array_equal(faces >= 0, texel_uvs()[..., 0] < 0.5)
        straight = np.isin(mesh.faces, [4, 5]).sum(axis=1) == 0
        assert straight[faces[faces >= 0]].all()
        assert shared_texels(charts, SIZE) == (SIZE * SIZE // 2, 0)


def test_of_equal_faces_the_first_is_drawn_and_texels_are_counted_once():
    triangle = flat_mesh([[0.1, 0.1], [0.9, 0.2], [0.3, 0.8]])
    mesh = merge(triangle, triangle, triangle)
    faces, _ = drawn(mesh)
    assert set(np.unique(faces)) == {-1, 0}
    assert shared_texels(lay_out(mesh, name="low"), SIZE) == (0, (faces == 0).sum())


def test_neighbors_share_nothing():
    assert shared_texels(lay_out(plane(segments=5), name="low"), 64) == (0, 0)


def test_faces_without_area_are_noted_and_not_drawn():
    mesh = flat_mesh([[0, 0], [1, 0], [0, 1], [0.5, 0.5]], [[0, 1, 2], [1, 2, 3], [0, 0, 1]])
    charts = lay_out(mesh, name="low")
    assert charts.notes == ("2 faces without area in the texture: no texel shows them",)
    np.testing.assert_array_equal(charts.faces, [0])


# Errors


@pytest.mark.errors
@pytest.mark.parametrize(
    ("uvs", "said"),
    [
        (None, "has no UVs"),
        ([[0, 0], [1, 0], [0, np.nan]], "NaN or infinite"),
        ([[0, 0], [1, 1], [0.5, 0.5]], "no face has an area"),
        ([[0, 0], [2.5, 0], [0, 1]], "a face reaches over 2.5 repetitions"),
    ],
)
def test_unusable_uvs(uvs, said):
    mesh = flat_mesh([[0, 0], [1, 0], [0, 1]])
    mesh = mesh._replace(uvs=None if uvs is None else np.array(uvs, np.float32))
    with pytest.raises(ValueError, match=f"^low.obj: .*{said}.*; unwrap"):
        lay_out(mesh, name="low.obj")
