"""Face and vertex normals: solids with known answers, laws, an oracle, degenerate faces."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from tangentspace import shapes
from tangentspace.vertex_normals import face_normals, vertex_normals

from .tools import assert_close

ROTATION, _ = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))
ROTATION *= np.linalg.det(ROTATION)  # not a mirror
normals_of = jax.jit(vertex_normals)


def bumpy_sphere(dtype=np.float64):
    """A closed surface without symmetries, and its faces."""
    mesh = shapes.icosphere(subdivisions=1, dtype=np.float64)
    stretch = np.random.default_rng(0).uniform(0.8, 1.2, (len(mesh.positions), 1))
    return (mesh.positions * stretch).astype(dtype), mesh.faces


def slow_vertex_normals(positions, faces):
    """Thuermer and Wuethrich's definition, a corner at a time."""
    sums = np.zeros_like(positions)
    for face in faces:
        for corner in range(3):
            here, after, before = positions[np.roll(face, -corner)]
            a, b = after - here, before - here
            cosine = a @ b / (np.linalg.norm(a) * np.linalg.norm(b))
            normal = np.cross(a, b)
            sums[face[corner]] += np.arccos(cosine) * normal / np.linalg.norm(normal)
    return sums / np.linalg.norm(sums, axis=-1, keepdims=True)


def cube(diagonals):
    """A cube of 8 shared vertices; each bit of ``diagonals`` cuts a side the other way."""
    positions = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
    sides = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    turned = [np.roll(side, diagonals >> i & 1) for i, side in enumerate(sides)]
    return positions, np.array([[s[[0, 1, 2]], s[[0, 2, 3]]] for s in turned]).reshape(-1, 3)


def test_face_normals_of_a_box_are_its_axes(dtype):
    mesh = shapes.box((1.0, 2.0, 3.0), dtype=dtype)
    normals = face_normals(mesh.positions, mesh.faces)
    assert normals.dtype == dtype
    assert_close(normals, mesh.normals[mesh.faces[:, 0]], ulps=1)


def test_vertex_normals_of_an_icosahedron_point_from_its_center(dtype):
    mesh = shapes.icosphere(subdivisions=0, dtype=dtype)
    normals = normals_of(mesh.positions, mesh.faces)
    assert normals.dtype == dtype
    assert_close(normals, mesh.normals, ulps=4)  # measured 1.0


@pytest.mark.parametrize("diagonals", [0b000000, 0b111111, 0b010110])
def test_cube_corners_do_not_depend_on_the_diagonals(diagonals):
    positions, faces = cube(diagonals)
    assert_close(normals_of(positions, faces), positions / np.sqrt(3), ulps=4)


def test_agrees_with_the_definition():
    mesh = bumpy_sphere()
    assert_close(normals_of(*mesh), slow_vertex_normals(*mesh))


def test_single_precision_is_near_double():
    double, single = normals_of(*bumpy_sphere()), normals_of(*bumpy_sphere(np.float32))
    assert_close(single, double.astype(np.float32), ulps=16)  # measured 2.3


LAWS = {
    "translate": (lambda p, f: (p + 5.0, f), lambda n: n),
    "rotate": (lambda p, f: (p @ ROTATION.T, f), lambda n: n @ ROTATION.T),
    "grow": (lambda p, f: (p * 1e12, f), lambda n: n),
    "shrink": (lambda p, f: (p * 1e-12, f), lambda n: n),
    "turn faces over": (lambda p, f: (p, f[:, ::-1]), lambda n: -n),
    "reorder faces": (lambda p, f: (p, np.roll(f, 1, axis=1)[::-1]), lambda n: n),
    "add an unused vertex": (
        lambda p, f: (np.vstack([p, [[1.0, 2.0, 3.0]]]), f),
        lambda n: np.vstack([n, np.zeros(3)]),
    ),
}


@pytest.mark.parametrize("law", LAWS)
def test_law(law):
    change, expect = LAWS[law]
    mesh = bumpy_sphere()
    assert_close(normals_of(*change(*mesh)), expect(normals_of(*mesh)))


@pytest.mark.parametrize("normals", [vertex_normals, face_normals])
def test_derivatives(normals):
    positions, faces = bumpy_sphere()
    check_grads(jax.jit(lambda p: normals(p, faces)), (positions,), 1, ("fwd", "rev"))


# Faces added to a good mesh that have no normal: they must change nothing.
FLAWS = {
    "repeated corner": ([[0, 1, 1]], np.zeros((0, 3))),
    "three corners at one place": ([[42, 43, 44]], np.ones((3, 3))),
    "two corners at one place": ([[42, 43, 44]], np.array([[2.0, 0, 0], [3, 1, 0], [3, 1, 0]])),
    "corners on a line": (
        [[42, 43, 44]],
        np.array([[0.1, 0.2, 0.3], [0.2, 0.4, 0.6], [0.7, 1.4, 2.1]]),
    ),
}


@pytest.mark.parametrize("flaw", FLAWS)
def test_degenerate_faces_contribute_nothing(flaw):
    extra_faces, extra_positions = FLAWS[flaw]
    positions, faces = bumpy_sphere()
    assert len(positions) == 42
    flawed = np.vstack([positions, extra_positions]), np.vstack([faces, extra_faces])
    normals = normals_of(*flawed)
    assert_close(normals[:42], normals_of(positions, faces), ulps=1)
    assert_close(normals[42:], np.zeros_like(extra_positions), ulps=0)
    assert_close(face_normals(*flawed)[-1], np.zeros(3), ulps=0)

    weights = np.random.default_rng(0).normal(size=(len(flawed[0]), 3))
    gradient = jax.jit(jax.grad(lambda p, w, f: jnp.sum(w * vertex_normals(p, f))))
    flawed_gradient = gradient(flawed[0], weights, flawed[1])
    assert_close(flawed_gradient[:42], gradient(positions, weights[:42], faces), ulps=1)
    assert_close(flawed_gradient[42:], np.zeros_like(extra_positions), ulps=0)


def test_a_sliver_keeps_its_normal(dtype):
    positions = np.array([[0, 0, 0], [1, 0, 0], [0.5, 1e-5, 0]], dtype)
    assert_close(face_normals(positions, np.array([[0, 1, 2]])), np.array([[0, 0, 1]]), ulps=1)


@pytest.mark.errors
@pytest.mark.parametrize("normals", [vertex_normals, face_normals])
@pytest.mark.parametrize(
    ("positions", "faces", "message"),
    [
        (np.zeros((3, 2)), [[0, 1, 2]], r"`positions` of shape \(vertices, 3\), got \(3, 2\)"),
        (np.zeros((4, 3)), [[0, 1, 2, 3]], r"`faces` of shape \(faces, 3\), got \(1, 4\)"),
        (np.zeros((3, 3)), [[0, 1, 3]], "`faces` to index 3 vertices, got 3"),
        (np.zeros((3, 3)), [[0, -1, 2]], "`faces` to index 3 vertices, got -1"),
    ],
)
def test_wrong_arguments_are_named(normals, positions, faces, message):
    with pytest.raises(ValueError, match=f"{normals.__name__}: expected {message}"):
        normals(positions, np.array(faces))
