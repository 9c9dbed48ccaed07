"""Shapes: each vertex on its surface, closed, outward, with right-handed charts."""

import numpy as np
import pytest

from tangentspace import shapes

from .tools import assert_close

MAKERS = {
    "plane": lambda dtype: shapes.plane(2.0, segments=3, dtype=dtype),
    "box": lambda dtype: shapes.box((1.0, 2.0, 3.0), dtype=dtype),
    "uv_sphere": lambda dtype: shapes.uv_sphere(2.0, rings=6, segments=8, dtype=dtype),
    "torus": lambda dtype: shapes.torus(2.0, 0.5, major_segments=8, minor_segments=6, dtype=dtype),
    "icosphere": lambda dtype: shapes.icosphere(2.0, subdivisions=2, dtype=dtype),
}
WITH_UVS = [name for name in MAKERS if name != "icosphere"]


def torus_normal(positions):
    """From the nearest point of the circle in the middle of the tube."""
    radius = np.hypot(positions[:, 0], positions[:, 2])[:, None]
    return positions - 2.0 * positions * [1, 0, 1] / radius


def box_normal(positions, normals):
    """The outward axis that the vertex claims, if it does lie on that side."""
    on_side = np.isclose(positions / [1.0, 2.0, 3.0], normals)
    return np.where(on_side & (normals != 0), normals, 0.0)


# The outward direction at each vertex, from the surface's equation.
OUTWARD = {
    "plane": lambda p, n: np.where(p[:, 1:2] == 0, [0.0, 1.0, 0.0], 0.0),
    "box": box_normal,
    "uv_sphere": lambda p, n: p / 2.0,
    "torus": lambda p, n: torus_normal(p) / 0.5,
    "icosphere": lambda p, n: p / 2.0,
}


@pytest.mark.parametrize("shape", MAKERS)
def test_vertices_and_normals_are_those_of_the_surface(shape, dtype):
    mesh = MAKERS[shape](dtype)
    assert mesh.positions.dtype == mesh.normals.dtype == dtype
    assert mesh.faces.dtype == np.int32
    assert mesh.tangents is None
    outward = OUTWARD[shape](mesh.positions.astype(np.float64), mesh.normals)
    assert_close(mesh.normals, outward, ulps=8)  # measured 2.0, on the torus
    assert_close(np.linalg.norm(mesh.normals, axis=-1), 1.0, ulps=2)
    assert set(mesh.faces.ravel()) == set(range(len(mesh.positions)))


@pytest.mark.parametrize("shape", MAKERS)
def test_faces_are_counter_clockwise_seen_from_outside(shape):
    mesh = MAKERS[shape](np.float64)
    corners = mesh.positions[mesh.faces]
    area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    cosine = np.einsum("fx,fcx->fc", area, mesh.normals[mesh.faces])
    assert (cosine > 0.5 * np.linalg.norm(area, axis=-1, keepdims=True)).all()


@pytest.mark.parametrize(
    ("shape", "euler"), [("box", 2), ("uv_sphere", 2), ("torus", 0), ("icosphere", 2)]
)
def test_the_surface_is_closed_where_vertices_coincide_to_the_bit(shape, euler):
    mesh = MAKERS[shape](np.float32)
    points, weld = np.unique(mesh.positions, axis=0, return_inverse=True)
    faces = weld.ravel()[mesh.faces]
    edges = np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1).reshape(-1, 2)
    assert len(np.unique(edges, axis=0)) == len(edges)  # each direction of an edge once
    assert set(map(tuple, edges)) == set(map(tuple, edges[:, ::-1]))  # and both directions
    assert len(points) - len(edges) // 2 + len(faces) == euler


@pytest.mark.parametrize(
    ("shape", "covered"), [("plane", 1), ("box", 6), ("uv_sphere", 5 / 6), ("torus", 1)]
)
def test_charts_are_right_handed_and_cover_the_texture(shape, covered):
    mesh = MAKERS[shape](np.float64)
    corners = mesh.uvs[mesh.faces]
    doubled = np.linalg.det(corners[:, 1:] - corners[:, :1])
    assert (doubled > 0).all()
    assert_close(doubled.sum() / 2, covered)  # a sphere's pole rows lose half of 1 / rings
    assert mesh.uvs.min() == 0
    assert mesh.uvs.max() == 1


def test_icosphere_has_no_repeated_vertex_and_no_uvs():
    for subdivisions in range(3):
        mesh = shapes.icosphere(subdivisions=subdivisions)
        assert len(mesh.faces) == 20 * 4**subdivisions
        assert len(mesh.positions) == 10 * 4**subdivisions + 2
        assert mesh.uvs is None


def test_texture_directions():
    plane = shapes.plane()
    assert_close(plane.uvs, (plane.positions[:, [0, 2]] * np.array([1, -1]) + 1) / 2, ulps=1)
    box = shapes.box()
    walls = box.normals[:, 1] == 0
    assert_close(box.uvs[walls, 1], (box.positions[walls, 1] + 1) / 2, ulps=1)
    sphere = shapes.uv_sphere(dtype=np.float64)
    assert_close(sphere.positions[:, 1], np.sin(np.pi * (sphere.uvs[:, 1] - 0.5)), ulps=4)
    north = sphere.positions[np.isclose(sphere.uvs, [0.25, 0.5]).all(axis=1)]
    assert_close(north, np.array([[0.0, 0.0, -1.0]]), ulps=4)  # a quarter turn east of +x


def test_pole_vertices_sit_in_the_middle_of_their_slice():
    sphere = shapes.uv_sphere(rings=4, segments=8, dtype=np.float64)
    u, v = np.moveaxis(sphere.uvs[sphere.faces], -1, 0)
    at_pole = (v == 0) | (v == 1)
    faces = at_pole.any(axis=1)
    assert faces.sum() == 16
    middle = np.mean(u[faces], axis=1, where=~at_pole[faces])
    assert_close(u[at_pole], middle, ulps=1)


def with_tangents(mesh):
    """The mesh with tangents along +x, exact on a plane."""
    return mesh._replace(tangents=np.tile(np.float32([1, 0, 0, 1]), (len(mesh.positions), 1)))


def test_transform_takes_normals_by_the_inverse_transpose():
    tilted = shapes.transform_mesh(with_tangents(shapes.plane()), rotate_x(45.0))
    squashed = shapes.transform_mesh(tilted, np.diag([2.0, 2.0, 1.0, 1.0]))
    assert_close(squashed.normals, np.tile([0, 1, 2] / np.sqrt(5), (4, 1)), ulps=2)
    assert_close(squashed.tangents, np.tile([1.0, 0, 0, 1], (4, 1)), ulps=2)
    assert squashed.positions.dtype == squashed.normals.dtype == np.float32


def rotate_x(degrees):
    cosine, sine = np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
    matrix = np.eye(4)
    matrix[1:3, 1:3] = [[cosine, -sine], [sine, cosine]]
    return matrix


def test_transform_by_a_mirror_keeps_faces_outward_and_flips_the_chart():
    mirrored = shapes.transform_mesh(with_tangents(shapes.plane()), np.diag([-1.0, 1, 1, 1]))
    corners = mirrored.positions[mirrored.faces]
    area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert_close(area, np.tile(np.float32([0, 4, 0]), (2, 1)), ulps=1)
    assert_close(mirrored.tangents, np.tile(np.float32([-1, 0, 0, -1]), (4, 1)), ulps=0)


def test_transforms_compose_by_eye():
    rng = np.random.default_rng(0)
    first, second = (np.vstack([rng.normal(size=(3, 4)), [0, 0, 0, 1]]) for _ in range(2))
    mesh = MAKERS["torus"](np.float64)
    once = shapes.transform_mesh(mesh, second @ first)
    twice = shapes.transform_mesh(shapes.transform_mesh(mesh, first), second)
    for one, two in zip(once[:4], twice[:4], strict=True):
        assert_close(one, two)


def test_merge_keeps_each_mesh(dtype):
    meshes = [MAKERS[shape](dtype) for shape in ("plane", "icosphere", "box")]
    merged = shapes.merge(*meshes)
    assert merged.positions.dtype == merged.uvs.dtype == dtype
    starts = np.cumsum([0, 16, 162, 24])
    for mesh, start, end in zip(meshes, starts[:-1], starts[1:], strict=True):
        assert_close(merged.positions[start:end], mesh.positions, ulps=0)
        assert_close(merged.normals[start:end], mesh.normals, ulps=0)
        uvs = np.zeros((end - start, 2)) if mesh.uvs is None else mesh.uvs
        assert_close(merged.uvs[start:end], uvs, ulps=0)
    corners = np.concatenate([mesh.positions[mesh.faces] for mesh in meshes])
    assert_close(merged.positions[merged.faces], corners, ulps=0)
    assert merged.tangents is None


def test_merge_keeps_tangents_only_if_all_have_them():
    plane = with_tangents(shapes.plane())
    assert_close(shapes.merge(plane, plane).tangents, np.tile(plane.tangents, (2, 1)), ulps=0)
    assert shapes.merge(plane, shapes.plane()).tangents is None
    assert shapes.merge(shapes.icosphere(), shapes.icosphere()).uvs is None


@pytest.mark.errors
@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: shapes.plane(segments=0), "plane: expected `segments` of at least 1, got 0"),
        (lambda: shapes.uv_sphere(rings=1), "uv_sphere: expected `rings` of at least 2, got 1"),
        (lambda: shapes.uv_sphere(segments=2), "uv_sphere: expected `segments` of at least 3"),
        (lambda: shapes.torus(major_segments=2), "torus: expected `major_segments` of at least 3"),
        (lambda: shapes.torus(minor_segments=2), "torus: expected `minor_segments` of at least 3"),
        (lambda: shapes.icosphere(subdivisions=-1), "icosphere: expected `subdivisions` of at"),
        (lambda: shapes.merge(), "merge: expected at least one mesh, got none"),
        (
            lambda: shapes.transform_mesh(shapes.plane(), np.eye(3)),
            r"transform_mesh: expected an affine `matrix` of shape \(4, 4\)",
        ),
        (
            lambda: shapes.transform_mesh(shapes.plane(), np.eye(4)[::-1]),
            r"transform_mesh: expected .* with last row \(0, 0, 0, 1\), got",
        ),
        (
            lambda: shapes.transform_mesh(shapes.plane(), np.diag([1.0, 0, 1, 1])),
            "transform_mesh: expected an invertible `matrix`",
        ),
    ],
)
def test_wrong_arguments_are_named(make, message):
    with pytest.raises(ValueError, match=message):
        make()
