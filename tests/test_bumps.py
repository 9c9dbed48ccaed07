"""Procedural bumps: the pattern, the lecture's shader pair, and derivatives up to the rims."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from tangentspace.bumps import BumpVectors, bump_normals, bump_vectors, shade_bumps

from .tools import assert_close

LIGHT = np.array([0.4, 0.6, 0.7])
MATRIX = np.array([[0.8, 0.1, 0.2, 0.3], [-0.2, 1.1, 0, -0.1], [0.1, 0.3, 0.9, -4], [0, 0, 0, 1]])
FLAT = np.array([0.0, 0.0, 1.0])

pattern = jax.jit(bump_normals)
vertex_stage = jax.jit(bump_vectors)
fragment_stage = jax.jit(shade_bumps)


def vertices(count=9):
    """Positions, normals and tangents, of any length and not quite orthogonal."""
    rng = np.random.default_rng(0)
    normals = np.array([0, 0, 1.0]) + rng.uniform(-0.6, 0.6, (count, 3))
    tangents = np.array([1.0, 0, 0]) + rng.uniform(-0.6, 0.6, (count, 3))
    return rng.uniform(-1, 1, (count, 3)), normals, tangents


# Known answers: the pattern


@pytest.mark.parametrize(
    ("place", "direction"),
    [
        ((0.5, 0.5), (0, 0, 1)),  # the top of a bump
        ((0.75, 0.5), (0.25, 0, 1)),
        ((0.5, 0.25), (0, -0.25, 1)),
        ((0.0, 0.0), (0, 0, 1)),  # between four bumps
        ((0.9, 0.5), (0, 0, 1)),  # 0.4 ** 2 is outside 0.15
        ((-0.25, 7.5), (0.25, 0, 1)),  # cells repeat, to both sides
    ],
)
def test_normals_of_the_pattern(place, direction, dtype):
    normal = pattern(np.array(place, dtype) / dtype(16))
    assert normal.dtype == dtype
    assert_close(normal, direction / np.linalg.norm(direction), ulps=2)


def test_the_rim_belongs_to_the_outside(dtype):
    on_rim = pattern(np.array([0.75, 0.5], dtype), density=dtype(1), size=dtype(0.0625))
    assert_close(on_rim, FLAT, ulps=0)
    inside = pattern(np.array([0.75, 0.5], dtype), density=dtype(1), size=dtype(0.0626))
    assert inside[0] > 0.2


# Known answers: the two shaders, transcribed


def normalize(v):
    return v / np.sqrt(np.dot(v, v))


def vertex_shader(position, normal, tangent, model_view, light_position):
    """One vertex, float64."""
    normal_mat = np.linalg.inv(model_view[:3, :3]).T
    eye_dir = (model_view @ np.append(position, 1.0))[:3]
    nn = normalize(normal_mat @ normal)
    tn = normalize(normal_mat @ tangent)
    bn = np.cross(nn, tn)
    local = lambda v: normalize(np.array([np.dot(v, tn), np.dot(v, bn), np.dot(v, nn)]))
    return local(light_position), local(eye_dir)


def fragment_shader(light_dir, eye_dir, tex_coord):
    """One fragment, float64."""
    c = 16.0 * tex_coord
    p = (c - np.floor(c)) - np.array([0.5, 0.5])
    d = p[0] * p[0] + p[1] * p[1]
    f = 1.0 / np.sqrt(d + 1.0)
    if d >= 0.15:
        p, f = np.zeros(2), 1.0
    norm_delta = np.array([p[0], p[1], 1.0]) * f
    lit_color = np.array([0.7, 0.6, 0.18]) * max(np.dot(norm_delta, light_dir), 0.0)
    reflect_dir = light_dir - 2.0 * np.dot(norm_delta, light_dir) * norm_delta
    spec = 0.5 * max(np.dot(eye_dir, reflect_dir), 0.0)
    return np.minimum(lit_color + spec, 1.0)


def test_the_shader_pair_is_that_of_the_lecture(dtype):
    """Per vertex, blended by given weights and not normalized again, per fragment."""
    attributes, rng = vertices(), np.random.default_rng(1)
    expected = np.array(
        [vertex_shader(*vertex, MATRIX, LIGHT) for vertex in zip(*attributes, strict=True)]
    )
    vectors = vertex_stage(
        *(a.astype(dtype) for a in attributes),
        view_from_model=MATRIX.astype(dtype),
        light_view=LIGHT.astype(dtype),
    )
    for stage, vector in enumerate(vectors):
        assert vector.dtype == dtype
        assert_close(vector, expected[:, stage], ulps=16)  # 2.9 measured

    weights, corners = rng.dirichlet(np.ones(3), 200), rng.integers(0, 9, (200, 3))
    blend = lambda rows: np.einsum("pk,pkc->pc", weights, np.asarray(rows)[corners])
    blended = [blend(expected[:, stage]) for stage in (0, 1)]
    uvs = rng.uniform(-1, 1, (200, 2))
    lit = np.array([fragment_shader(*given) for given in zip(*blended, uvs, strict=True)])
    color = fragment_stage(BumpVectors(*(v.astype(dtype) for v in blended)), uvs.astype(dtype))
    assert color.dtype == dtype
    assert np.any(lit == 1) and np.any(lit[:, 2] < 0.5), "some reach the clamp, some do not"  # noqa: PT018
    assert_close(color, lit, ulps=64)  # 14 measured: 16 cells blow up the rounding of uvs


def test_vectors_have_unit_length_at_vertices_and_the_eye_looks_at_the_surface():
    vectors = vertex_stage(*vertices(), view_from_model=MATRIX, light_view=3 * LIGHT)
    for vector in vectors:
        assert_close(np.linalg.norm(vector, axis=1), np.ones(9))
    ahead = np.array([[0.0, 0, -5]]), np.array([[0.0, 0, 1]]), np.array([[1.0, 0, 0]])
    from_eye = bump_vectors(*ahead, view_from_model=np.eye(4), light_view=LIGHT).from_eye
    assert_close(from_eye, -FLAT[None], ulps=0)


def test_shading_known_answers(dtype):
    """On top of a bump: all aligned reaches the clamp, a light from behind gives nothing."""
    top = np.full((3, 2), 0.5 / 16, dtype)
    lights = np.array([FLAT, -FLAT, [np.sqrt(0.75), 0, 0.5]], dtype)
    vectors = BumpVectors(jnp.asarray(lights), jnp.asarray([-FLAT] * 3, dtype))
    color = fragment_stage(vectors, top)
    # Diffuse <n, l>, and <e, r> = -<v, l - 2 <n, l> n> = <n, l>, here 1, -1 and 1/2.
    expected = [[1, 1, 0.68], [0, 0, 0], [0.6, 0.55, 0.34]]
    assert_close(color, np.array(expected), ulps=4)
    dull = fragment_stage(vectors, top, albedo=dtype(0.5), specular=dtype(0))
    assert_close(dull, np.repeat([[0.5], [0], [0.25]], 3, axis=1), ulps=4)


# Laws


def test_normals_have_unit_length_and_repeat():
    uvs = np.random.default_rng(0).uniform(0, 1, (50, 2))
    normals = pattern(uvs, density=4.0, size=0.3)
    assert_close(np.linalg.norm(normals, axis=1), np.ones(50), ulps=4)
    assert_close(pattern(uvs + np.array([0.25, -0.75]), density=4.0, size=0.3), normals)
    assert_close(pattern(2 * uvs, density=2.0, size=0.3), normals)
    mirrored = pattern(-uvs, density=4.0, size=0.3)
    assert_close(mirrored, normals * np.array([-1, -1, 1]))


# Derivatives


def test_derivatives_are_the_finite_differences_inside_bumps():
    rng = np.random.default_rng(0)
    uvs = (0.5 + rng.uniform(-0.2, 0.2, (4, 2)) + rng.integers(0, 9, (4, 2))) / 16
    position, normal, tangent = vertices(4)

    def shade(uvs, density, p, n, t, matrix, light, albedo, specular):
        vectors = bump_vectors(p, 2 * n, t, view_from_model=matrix, light_view=light)
        return shade_bumps(vectors, uvs, density=density, albedo=albedo, specular=specular)

    arguments = (uvs, 16.0, 0.3 * position, normal, tangent, MATRIX, LIGHT, np.full(3, 0.3), 0.2)
    check_grads(jax.jit(shade), arguments, 1, ("fwd", "rev"), eps=1e-6, atol=1e-6, rtol=1e-6)


def test_derivatives_between_bumps_and_in_the_size_are_zero():
    flat = np.array([[0.02, 0.9], [0.0, 0.0], [0.97, 0.5]])
    jacobian = jax.jacfwd(lambda uvs: pattern(uvs, density=1.0))(flat)
    assert_close(jacobian, np.zeros((3, 3, 3, 2)), ulps=0)
    inside = np.array([[0.5, 0.6]])
    jacobian = jax.jacrev(lambda size: pattern(inside, density=1.0, size=size))(0.15)
    assert_close(jacobian, np.zeros((1, 3)), ulps=0)


@pytest.mark.parametrize(
    ("place", "size", "beside"),
    [
        ([0.75, 0.5], 0.0625, [0.7501, 0.5]),  # the rim: as outside
        ([1.0, 0.4], 0.6, [1.0001, 0.4]),  # the border of a full cell: as at larger u
        ([0.3, 0.0], 0.6, [0.3, 0.0001]),
    ],
)
def test_jumps_have_value_and_derivative_of_the_documented_side(place, size, beside):
    normals = lambda uvs: bump_normals(uvs, density=1.0, size=size)
    place, beside = np.array(place), np.array(beside)
    assert np.max(np.abs(normals(place) - normals(beside))) < 1e-3
    assert np.max(np.abs(normals(place) - normals(2 * place - beside))) > 0.1, "it jumps here"
    for derivative in (jax.jacfwd, jax.jacrev):
        difference = derivative(normals)(place) - derivative(normals)(beside)
        assert np.max(np.abs(difference)) < 1e-3


def test_what_vanishes_and_what_is_clamped_is_finite_with_derivative_zero():

    @jax.jit
    def run(p, n, t, matrix):
        stage = lambda *v: bump_vectors(*v, view_from_model=matrix, light_view=LIGHT)
        out, back = jax.vjp(stage, p, n, t)
        return out, back(jax.tree.map(jnp.ones_like, out))

    for k in range(3):
        given = list(vertices(3))
        given[k] = np.zeros((3, 3))
        results = run(*given, np.eye(4) if k == 0 else MATRIX)
        assert all(np.all(np.isfinite(x)) for x in jax.tree.leaves(results))
    clamped = BumpVectors(jnp.asarray(FLAT), jnp.asarray(-FLAT))  # red is 1.2, cut to 1
    at_horizon = BumpVectors(jnp.array([1.0, 0, 0]), jnp.array([0.0, 1, 0]))  # cosines are 0
    top = np.array([0.5, 0.5]) / 16
    for vectors, channel in ((clamped, 0), (at_horizon, 2)):
        gradient = jax.grad(lambda v, k=channel: shade_bumps(v, top)[k])(vectors)
        assert_close(gradient.to_light, np.zeros(3), ulps=0)
        assert_close(gradient.from_eye, np.zeros(3), ulps=0)
    just_full = jax.grad(lambda v: shade_bumps(v, top, albedo=1.0, specular=0.0)[0])(clamped)
    assert_close(just_full.to_light, np.zeros(3), ulps=0)
