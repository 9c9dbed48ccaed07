"""The lecture's shaders against a plain transcription, the form per fragment, normal matrices."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from tangentspace.lighting import blinn_phong, phong
from tangentspace.tangent_lighting import (
    TangentSpaceVectors,
    normal_matrix,
    shade_camera_space,
    shade_tangent_space,
    tangent_space_vectors,
    transform_directions,
    view_normal,
    view_positions,
)

from .tools import assert_close

LIGHT = np.array([0.3, 0.5, 0.8])
FLAT = np.array([0.5, 0.5, 1.0])

vertex_stage = jax.jit(tangent_space_vectors)
fragment_stage = jax.jit(shade_tangent_space)
inverse_transpose = jax.jit(normal_matrix)
bump = jax.jit(view_normal)
light_fragments = jax.jit(shade_camera_space)
to_view = jax.jit(view_positions)
turn = jax.jit(transform_directions)
jacobians = jax.jit(
    lambda matrix: (jax.jacfwd(normal_matrix)(matrix), jax.jacrev(normal_matrix)(matrix))
)


def affine(seed=0, *, linear=None, offset=(0.2, -0.3, -4.0)):
    """A matrix with the given linear part, or with a generic one, in front of the camera."""
    matrix = np.eye(4)
    matrix[:3, :3] = np.random.default_rng(seed).normal(size=(3, 3)) if linear is None else linear
    matrix[:3, 3] = offset
    return matrix


ROTATION = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
ROTATION *= np.sign(np.linalg.det(ROTATION))
RIGID = affine(linear=ROTATION)
SCALED = affine(linear=3 * ROTATION)
STRETCHED = affine(linear=ROTATION @ np.diag([2.0, 0.5, 1.0]))


def vertices(count=5, *, handedness=1):
    """Positions near the origin with orthonormal frames: p, n, t, b."""
    rng = np.random.default_rng(0)
    frames = np.linalg.qr(rng.normal(size=(count, 3, 3)))[0]
    normals, tangents = frames[..., 0], frames[..., 1]
    return (
        rng.uniform(-1, 1, (count, 3)),
        normals,
        tangents,
        handedness * np.cross(normals, tangents),
    )


def colors(count=5):
    """Texels whose normals lean up to 40 degrees and, as between texels, are too short."""
    slopes = np.random.default_rng(2).uniform(-0.6, 0.6, (count, 2))
    normals = np.concatenate([slopes, np.ones((count, 1))], axis=1)
    return 0.5 + 0.4 * normals / np.linalg.norm(normals, axis=1, keepdims=True)


# Known answers: the two shaders, transcribed with the four coordinates and types of GLSL


def normalize(v):
    return v / np.sqrt(np.dot(v, v))


def vertex_shader(position, normal, tangent, bitangent, mv_matrix, light):
    """One vertex, float64; what the listing leaves open is said in the module's docstring."""
    normal_mat = np.eye(4)
    normal_mat[:3, :3] = np.linalg.inv(mv_matrix[:3, :3]).T
    n = normalize(normal_mat @ np.append(normal, 0))
    t = normalize(mv_matrix @ np.append(tangent, 0))
    b = normalize(mv_matrix @ np.append(bitangent, 0))
    position_cs = mv_matrix @ np.append(position, 1)
    eye_dir_cs = np.array([0, 0, 0, 1]) - position_cs
    tbn = np.stack([t, b, n, [0, 0, 0, 1]])
    return tbn @ np.append(light, 0), tbn @ eye_dir_cs


def fragment_shader(light_dir_ts, eye_dir_ts, texel):
    """One fragment, float64."""
    n = normalize(np.append(texel * 2.0 - 1.0, 0.0))
    to_light = normalize(light_dir_ts)
    diffuse = np.clip(np.dot(to_light, n), 0, 1)
    to_eye = normalize(eye_dir_ts)
    mirrored = -to_light - 2.0 * np.dot(n, -to_light) * n
    highlight = np.clip(np.dot(to_eye, mirrored), 0, 1)
    return 0.1 + diffuse * 0.5 + highlight * 0.9


@pytest.mark.parametrize("matrix", [RIGID, SCALED, STRETCHED, affine()])
def test_the_shader_pair_is_that_of_the_lecture(matrix, dtype):
    """Per vertex, blended by given weights, per fragment."""
    attributes, texels = vertices(12), colors(20)
    weights = np.random.default_rng(3).dirichlet(np.ones(3), 20)
    corners = np.random.default_rng(4).integers(0, 12, (20, 3))
    expected = np.array(
        [vertex_shader(*vertex, matrix, LIGHT) for vertex in zip(*attributes, strict=True)]
    )
    vectors = vertex_stage(
        *(a.astype(dtype) for a in attributes),
        view_from_model=matrix.astype(dtype),
        to_light_view=LIGHT.astype(dtype),
    )
    for stage, vector in enumerate(vectors):
        assert vector.dtype == dtype
        assert_close(vector, expected[:, stage, :3], ulps=32)  # 7 measured
    assert np.all(expected[..., 3] == 0), "w stays 0"

    blend = lambda rows: np.einsum("pk,pkc->pc", weights, np.asarray(rows)[corners])
    blended = TangentSpaceVectors(*(blend(v).astype(dtype) for v in vectors))
    color = fragment_stage(blended, texels.astype(dtype))
    assert color.dtype == dtype
    lights, eyes = blend(expected[:, 0]), blend(expected[:, 1])
    lit = [fragment_shader(*given) for given in zip(lights, eyes, texels, strict=True)]
    assert np.ptp(lit) > 0.5
    # 25 measured: where interpolated vectors are short.
    assert_close(color, np.repeat(np.array(lit)[:, None], 3, axis=1), ulps=128)


def test_facing_light_and_camera_gives_the_full_color(dtype):
    """0.1 + 0.5 + 0.9, and with the light 60 degrees off, 0.1 + 0.25 + 0.45."""
    towards = np.array([[0, 0, 2], [np.sqrt(0.75), 0, 0.5]], dtype)
    vectors = TangentSpaceVectors(jnp.asarray(towards), jnp.asarray([[0, 0, 5]] * 2, dtype))
    color = fragment_stage(vectors, np.tile(FLAT, (2, 1)).astype(dtype))
    assert_close(color, np.array([[1.5] * 3, [0.8] * 3]), ulps=4)


def test_vectors_are_not_normalized():
    """Only so do they interpolate linearly over a face."""
    p, n, t, b = vertices()
    near, far = (
        vertex_stage(p, n, t, b, view_from_model=RIGID, to_light_view=k * LIGHT) for k in (1, 2)
    )
    assert_close(far.to_light_tangent, 2 * near.to_light_tangent)
    distance = np.linalg.norm(to_view(RIGID, p), axis=1)
    assert_close(np.linalg.norm(near.to_camera_tangent, axis=1), distance)


def test_a_light_at_a_point_is_given_per_vertex():
    attributes = vertices()
    to_light = np.array([1.0, 2, -1]) - to_view(RIGID, attributes[0])
    together = vertex_stage(*attributes, view_from_model=RIGID, to_light_view=to_light)
    for k in range(5):
        alone = vertex_stage(
            *(a[k] for a in attributes), view_from_model=RIGID, to_light_view=to_light[k]
        )
        assert_close(together.to_light_tangent[k], alone.to_light_tangent)


# Known answers: normal matrices


def test_normal_matrix_is_the_inverse_transpose(dtype):
    for seed in range(5):
        matrix = affine(seed).astype(dtype)
        expected = np.linalg.inv(matrix[:3, :3].astype(np.float64)).T
        assert_close(inverse_transpose(matrix), expected, ulps=64)  # 5 measured


def test_normal_matrix_known_answers(dtype):
    for matrix, expected in [
        (RIGID, ROTATION),
        (affine(linear=np.diag([2.0, -0.5, 1])), np.diag([0.5, -2.0, 1])),
        (affine(linear=np.diag([1e12, 1e-12, 1e-12])), np.diag([1e-12, 1e12, 1e12])),
    ]:
        actual = inverse_transpose(matrix.astype(dtype))
        assert actual.dtype == dtype
        assert_close(actual, expected, ulps=8)


SINGULAR = {
    "flattened to y = 0": (np.diag([2.0, 0, 3]), [0, 1.0, 0]),
    "flattened along a diagonal": (np.eye(3) - np.ones((3, 3)) / 3, np.ones(3) / np.sqrt(3)),
    "two equal columns": (np.array([[1.0, 1, 0], [2, 2, 0], [0, 0, 1]]), [2, -1, 0] / np.sqrt(5)),
    "flattened to a line": (np.outer([1.0, 2, 3], [1, 0, 1]), np.zeros(3)),
    "nothing left": (np.zeros((3, 3)), np.zeros(3)),
}


@pytest.mark.parametrize("case", SINGULAR)
def test_singular_matrices_keep_the_normal_of_what_is_left(case, dtype):
    """Of the plane, of either sign; zero where there is none. Derivatives are finite."""
    linear, expected = SINGULAR[case]
    matrix = affine(linear=linear).astype(dtype)
    normals = np.asarray(turn(inverse_transpose(matrix), vertices()[1]))
    parallel = np.abs(normals @ expected)[:, None] * np.abs(expected)
    assert_close(np.abs(normals), parallel, ulps=16)
    assert np.any(normals != 0) == np.any(expected)
    assert all(np.all(np.isfinite(jacobian)) for jacobian in jacobians(matrix))


# Laws


@pytest.mark.parametrize("handedness", [1, -1])
@pytest.mark.parametrize("matrix", [RIGID, SCALED])
def test_both_forms_light_a_vertex_alike(matrix, handedness):
    attributes, texels = vertices(9, handedness=handedness), colors(9)
    p, n, t, b = attributes
    uniforms = {"view_from_model": matrix, "to_light_view": LIGHT}
    bumped = bump(texels, t, b, n, view_from_model=matrix)
    per_fragment = light_fragments(p, bumped, **uniforms)
    assert np.ptp(per_fragment) > 0.3
    assert_close(fragment_stage(vertex_stage(*attributes, **uniforms), texels), per_fragment)


def bumpy(uv):
    """A cylinder with a relief, and its frame and slopes without the relief."""
    u, v = uv
    smooth = jnp.stack([jnp.cos(u), v, -jnp.sin(u)])
    normal = jnp.stack([jnp.cos(u), 0 * v, -jnp.sin(u)])
    return smooth + 0.05 * jnp.sin(7 * u) * jnp.cos(5 * v) * normal


@pytest.mark.parametrize("matrix", [RIGID, STRETCHED, affine(3)])
def test_per_fragment_is_the_normal_of_the_transformed_surface(matrix):
    """A relief on a cylinder, encoded in its frame, then stretched: at zeros of the height."""
    u, v = 2 * np.pi / 7, 0.3  # the height is 0 there, its slope in u is not
    tangent = jnp.array([-np.sin(u), 0, -np.cos(u)])
    normal, bitangent = jnp.array([np.cos(u), 0, -np.sin(u)]), jnp.array([0.0, 1, 0])
    slope = 0.05 * 7 * np.cos(5 * v)
    encoded = 0.5 + 0.5 * np.array([-slope, 0, 1]) / np.sqrt(1 + slope**2)
    du, dv = jax.jacfwd(lambda uv: to_view(matrix, bumpy(uv)))(jnp.array([u, v])).T
    truth = jnp.cross(du, dv) * np.sign(np.linalg.det(matrix[:3, :3]))
    actual = bump(encoded, tangent, bitangent, normal, view_from_model=matrix)
    assert_close(actual, truth / np.linalg.norm(truth))


def test_a_flat_map_changes_nothing(dtype):
    p, n, t, b = (a.astype(dtype) for a in vertices())
    matrix, light = STRETCHED.astype(dtype), LIGHT.astype(dtype)
    flat = np.tile(FLAT, (5, 1)).astype(dtype)
    bumped = bump(flat, t, b, n, view_from_model=matrix)
    smooth = turn(inverse_transpose(matrix), n)
    assert_close(bumped, smooth / np.linalg.norm(smooth, axis=1, keepdims=True), ulps=2)
    color = light_fragments(p, bumped, view_from_model=matrix, to_light_view=light)
    to_camera = -to_view(matrix, p)
    to_camera /= np.linalg.norm(to_camera, axis=1, keepdims=True)
    expected = phong(bumped, light / dtype(np.linalg.norm(light)), to_camera)
    assert color.dtype == dtype
    assert_close(color, expected, ulps=8)


def test_moving_camera_light_and_mesh_together_changes_nothing():
    attributes, texels = vertices(), colors()
    given = {"view_from_model": RIGID, "to_light_view": LIGHT}
    before = fragment_stage(vertex_stage(*attributes, **given), texels)
    p, *frame = attributes
    turned = [(p - 0.5) @ ROTATION.T, *(x @ ROTATION.T for x in frame)]
    back = affine(linear=ROTATION.T, offset=(0.5, 0.5, 0.5))
    given["view_from_model"] = RIGID @ back
    assert_close(fragment_stage(vertex_stage(*turned, **given), texels), before)


def test_any_shading_can_stand_in():
    vectors = vertex_stage(*vertices(), view_from_model=RIGID, to_light_view=LIGHT)
    shading = functools.partial(blinn_phong, shininess=5.0)
    unit = [v / np.linalg.norm(v, axis=1, keepdims=True) for v in vectors]
    expected = shading((2 * colors() - 1) / 0.8, *unit)
    assert_close(shade_tangent_space(vectors, colors(), shading=shading), expected)


# Derivatives


def to_the_letter(p, n, t, b, texels, matrix, light):
    vectors = tangent_space_vectors(p, n, t, b, view_from_model=matrix, to_light_view=light)
    return shade_tangent_space(vectors, texels)


def per_fragment(p, n, t, b, texels, matrix, light):
    bumped = view_normal(texels, t, b, n, view_from_model=matrix)
    return shade_camera_space(p, bumped, view_from_model=matrix, to_light_view=light)


FORMS = [to_the_letter, per_fragment]


def facing():
    """Vertices that face camera and light, clear of every clamp."""
    rng = np.random.default_rng(5)
    n = np.array([0, 0, 1.0]) + rng.uniform(-0.2, 0.2, (3, 3))
    t = np.array([1.0, 0, 0]) + rng.uniform(-0.2, 0.2, (3, 3))
    b = np.array([0, 1.0, 0]) + rng.uniform(-0.2, 0.2, (3, 3))
    matrix = affine(linear=np.eye(3) + rng.uniform(-0.2, 0.2, (3, 3)))
    light = np.array([0.3, -0.2, 1.0])
    return rng.uniform(-0.3, 0.3, (3, 3)), n, t, b, 0.5 + 0.5 * n, matrix, light


@pytest.mark.parametrize("form", FORMS)
def test_derivatives_are_the_finite_differences(form):
    check_grads(jax.jit(form), facing(), 1, ("fwd", "rev"), eps=1e-5, atol=1e-6, rtol=1e-6)


def test_derivatives_of_the_normal_matrix():
    check_grads(inverse_transpose, (affine(0),), 1, ("fwd", "rev"), atol=1e-6, rtol=1e-6)


@functools.partial(jax.jit, static_argnums=0)
def all_derivatives(form, given):
    """The color, its gradients and its forward derivative, all inputs changed at once."""
    color, back = jax.vjp(form, *given)
    _, forward = jax.jvp(form, given, [jnp.ones_like(x) for x in given])
    return color, back(jnp.ones_like(color)), forward


FLAWS = {"normal": 1, "tangent": 2, "bitangent": 3, "texel": 4, "matrix": 5, "light": 6}


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("flaw", FLAWS)
def test_what_vanishes_has_finite_values_and_derivatives(form, flaw):
    """A zero vector, the color (1/2, 1/2, 1/2) that stores one, a matrix of rank 0."""
    given = list(facing())
    given[FLAWS[flaw]] = np.full_like(given[FLAWS[flaw]], 0.5 if flaw == "texel" else 0.0)
    for result in jax.tree.leaves(all_derivatives(form, given)):
        assert np.all(np.isfinite(result))


@pytest.mark.parametrize("form", FORMS)
def test_one_bad_vertex_leaves_the_others_alone(form):
    given = list(facing())
    _, good, _ = all_derivatives(form, given)
    given[1][0] = 0
    _, spoiled, _ = all_derivatives(form, given)
    for k in range(5):  # what is given per vertex
        assert_close(spoiled[k][1:], good[k][1:])
