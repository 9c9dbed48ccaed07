"""Lambert, Phong and Blinn-Phong: known colors, laws, energy, derivatives at the clamps."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from tangentspace.lighting import (
    IncomingLight,
    blinn_phong,
    lambert,
    phong,
    reflect,
    shade_lights,
)

from .tools import assert_close

AMBIENT = 0.1
COLORS = {"ambient": AMBIENT, "albedo": np.array([0.2, 0.4, 0.8]), "specular": 0.9}
ROTATION, _ = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))


def matte(normal, to_light, to_camera, *, ambient, albedo, specular, **light):
    """Lambert with the arguments of the other two."""
    return lambert(normal, to_light, to_camera, ambient=ambient, albedo=albedo, **light)


MODELS = {"lambert": jax.jit(matte), "phong": jax.jit(phong), "blinn_phong": jax.jit(blinn_phong)}


def at_angle(degrees, dtype=np.float64):
    """The unit vector tilted from +z towards +x."""
    angle = np.deg2rad(degrees)
    return jnp.asarray([np.sin(angle), 0.0, np.cos(angle)], dtype)


def generic(*shape):
    """Unit n, l and v within 36 degrees of +z: away from every clamp."""
    tilts = np.random.default_rng(0).uniform(-0.5, 0.5, (3, *shape, 2))
    vectors = np.concatenate([tilts, np.ones((3, *shape, 1))], axis=-1)
    return tuple(jnp.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)))


# From the form itself: 0.1 + 0.5 <n, l> + 0.9 <v, r>, with r as far on the other side.
@pytest.mark.parametrize(
    ("light", "camera", "expected"),
    [
        (0, 0, 0.1 + 0.5 + 0.9),  # all aligned
        (60, -60, 0.1 + 0.25 + 0.9),  # camera in the mirror direction
        (60, 0, 0.1 + 0.25 + 0.45),  # camera 60 degrees off the mirror direction
        (60, 45, 0.1 + 0.25),  # 105 degrees off: no highlight
        (120, -90, 0.1 + 0.9 * np.sqrt(0.75)),  # light behind: to the letter, a highlight
    ],
)
def test_phong_defaults_are_the_lecture_form(light, camera, expected, dtype):
    color = phong(at_angle(0, dtype), at_angle(light, dtype), at_angle(camera, dtype))
    assert color.dtype == dtype
    assert_close(color, np.full(3, expected), ulps=4)  # measured 1.1


def test_phong_raises_the_highlight_to_its_exponent():
    vectors = at_angle(0), at_angle(60), at_angle(0)  # <v, r> = 1/2
    color = phong(*vectors, ambient=0.0, albedo=0.0, specular=1.0, shininess=5.0)
    assert_close(color, np.full(3, 0.5**5), ulps=4)


def test_lambert_follows_the_cosine_in_each_channel(dtype):
    albedo, radiance = np.array([0.2, 0.4, 0.8], dtype), np.array([1.0, 2.0, 3.0], dtype)
    vectors = at_angle(0, dtype), at_angle(60, dtype)
    color = lambert(*vectors, albedo=albedo, radiance=radiance, visibility=0.5)
    assert color.dtype == dtype
    assert_close(color, np.array([0.05, 0.2, 0.6]), ulps=4)


def test_no_light_from_behind_but_ambient():
    vectors = at_angle(0), at_angle(100), at_angle(-60)
    assert_close(lambert(*vectors[:2], albedo=0.5), np.zeros(3), ulps=0)
    assert_close(blinn_phong(*vectors, ambient=0.1), np.full(3, 0.1), ulps=0)


def test_blinn_phong_without_highlight_is_lambert():
    normal, to_light, to_camera = generic(7)
    color = blinn_phong(normal, to_light, to_camera, ambient=0.0, albedo=0.3, specular=0.0)
    assert_close(color, lambert(normal, to_light, albedo=0.3))


def test_reflect_mirrors():
    assert_close(reflect(-at_angle(30), at_angle(0)), at_angle(-30), ulps=4)
    normal, incident, _ = generic(7)
    assert_close(reflect(reflect(incident, normal), normal), incident)


@pytest.mark.parametrize("shininess", [1.0, 10.0, 100.0])
def test_blinn_phong_keeps_energy(shininess):
    """A white hemisphere reflects with share 1 along the normal, with less from the side."""
    nodes, weights = np.polynomial.legendre.leggauss(200)
    azimuths = np.arange(64) * (2 * np.pi / 64)
    cosine, azimuth = np.meshgrid(0.5 + 0.5 * nodes, azimuths)
    sine = np.sqrt(1 - cosine**2)
    sky = jnp.stack([sine * np.cos(azimuth), sine * np.sin(azimuth), cosine], axis=-1)
    highlight = {"ambient": 0.0, "albedo": 0.0, "specular": 1.0, "shininess": shininess}

    def share(degrees):
        color = blinn_phong(at_angle(0), sky, at_angle(degrees), **highlight)[..., 0]
        return jnp.sum(color * weights) / len(azimuths)  # of pi, since 2 pi / 2 / pi = 1

    assert_close(share(0), 1.0, ulps=1024)  # measured 317 at exponent 100: a power of 100
    assert all(0 < share(degrees) < 1 for degrees in (20, 50, 80))


# A highlight spread by bumps


@pytest.mark.parametrize("model", MODELS)
def test_gloss_1_changes_nothing(model, dtype):
    vectors = [x.astype(dtype) for x in generic(9)]
    colors = {name: dtype(0.3) for name in COLORS}
    shiny = {} if model == "lambert" else {"shininess": dtype(17.3)}
    plain = MODELS[model](*vectors, **colors, **shiny)
    glossy = MODELS[model](*vectors, **colors, **shiny, gloss=np.ones(9, dtype))
    assert glossy.dtype == dtype
    assert_close(glossy, plain, ulps=1)  # 0.5 measured: the compiler fuses another product


def test_gloss_1_compiles_to_nothing():
    vectors = generic(9)
    program = lambda **gloss: str(jax.make_jaxpr(lambda *v: phong(*v, **gloss))(*vectors))
    assert program(gloss=1.0) == program()
    assert len(program(gloss=np.ones(9))) > len(program())


def test_gloss_is_a_factor_on_the_exponent():
    vectors, gloss = generic(5), np.linspace(0.2, 1, 5)
    light = {"ambient": 0.0, "albedo": 0.0, "specular": 1.0}
    spread = blinn_phong(*vectors, **light, shininess=20.0, gloss=gloss)
    assert_close(spread, blinn_phong(*vectors, **light, shininess=20.0 * gloss), ulps=0)
    spread = phong(*vectors, **light, shininess=20.0, gloss=gloss)
    lowered = phong(*vectors, **light, shininess=20.0 * gloss) * ((1 + 20 * gloss) / 21)[:, None]
    assert_close(spread, lowered, ulps=2)
    assert_close(MODELS["lambert"](*vectors, **COLORS, gloss=gloss), matte(*vectors, **COLORS))


def test_gloss_keeps_the_energy_of_a_phong_highlight():
    """Over all directions of the camera: the mean over the hemisphere is 1 / (1 + shininess)."""
    nodes, weights = np.polynomial.legendre.leggauss(200)
    cosine = 0.5 + 0.5 * nodes
    cameras = np.stack([np.sqrt(1 - cosine**2), 0 * cosine, cosine], axis=-1)
    light = {"ambient": 0.0, "albedo": 0.0, "specular": 1.0, "shininess": 24.0}
    for gloss in (1.0, 0.5, 0.1):
        color = phong(at_angle(0), at_angle(0), cameras, **light, gloss=gloss)[:, 0]
        assert_close(jnp.sum(color * weights) / 2, 1 / 25)


@pytest.mark.parametrize(("model", "factor"), [("phong", 4), ("blinn_phong", 1)])
def test_gloss_stands_for_bumps_finer_than_a_pixel(model, factor):
    """The mean color over many bumps is nearer to that of their mean, spread as Toksvig says."""
    slopes = np.random.default_rng(0).normal(0, 0.15, (5000, 2))
    normals = np.concatenate([slopes, np.ones((5000, 1))], axis=1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    mean = normals.mean(axis=0)
    length = np.linalg.norm(mean)
    cameras = jnp.stack([at_angle(degrees) for degrees in range(-60, 61, 10)])[:, None]
    light = {"ambient": 0.0, "albedo": 0.0, "specular": 1.0, "shininess": 32.0}
    truth = jnp.mean(MODELS[model](normals, at_angle(0), cameras, **light), axis=1)
    gloss = length / (length + factor * 32 * (1 - length))
    color = lambda gloss: MODELS[model](
        mean / length, at_angle(0), cameras[:, 0], **light, gloss=gloss
    )
    error = lambda color: np.sqrt(np.mean((color - truth) ** 2))
    assert error(color(gloss)) < 0.4 * error(color(1.0))  # measured: 0.05 and 0.26


# Several lights


def test_several_lights_add_and_ambient_counts_once():
    lights = [IncomingLight(at_angle(0)), IncomingLight(at_angle(60), np.array([1.0, 2.0, 0.0]))]
    color = shade_lights(functools.partial(phong, specular=0.0), at_angle(0), at_angle(0), lights)
    assert_close(color, 0.1 + 0.5 + 0.25 * np.array([1.0, 2.0, 0.0]), ulps=4)
    shaded = [light._replace(visibility=0.0) for light in lights]
    color = shade_lights(phong, at_angle(0), at_angle(0), shaded)
    assert_close(color, np.full(3, 0.1), ulps=0)


@pytest.mark.parametrize("model", MODELS)
def test_lights_are_a_sum(model):
    normal, to_light, to_camera = generic(3)
    shading = functools.partial(MODELS[model], **COLORS)
    lights = [IncomingLight(x, 1.0 + k, 0.5) for k, x in enumerate(to_light)]
    arriving = [{"radiance": 1.0 + k, "visibility": 0.5} for k in range(3)]
    alone = [
        shading(normal, x, to_camera, **light) for x, light in zip(to_light, arriving, strict=True)
    ]
    assert_close(shade_lights(shading, normal, to_camera, lights[:1]), alone[0], ulps=0)
    together = shade_lights(shading, normal, to_camera, lights)
    assert_close(together, sum(alone) - 2 * AMBIENT)
    assert_close(shade_lights(shading, normal, to_camera, lights[::-1]), together, ulps=4)


@pytest.mark.errors
def test_no_light_is_an_error():
    with pytest.raises(ValueError, match="expected at least one of `lights`, got none"):
        shade_lights(phong, at_angle(0), at_angle(0), [])


LAWS = {
    "rotate": (lambda shade, v: shade(*(x @ ROTATION for x in v), **COLORS), lambda c: c),
    "one row alone": (lambda shade, v: shade(*(x[2] for x in v), **COLORS), lambda c: c[2]),
    "shadow": (
        lambda shade, v: shade(*v, **COLORS, visibility=np.linspace(0, 1, 5)),
        lambda c: AMBIENT + np.linspace(0, 1, 5)[:, None] * (c - AMBIENT),
    ),
    "colored light": (
        lambda shade, v: shade(*v, **COLORS, radiance=np.array([0.0, 1.0, 3.0])),
        lambda c: AMBIENT + np.array([0.0, 1.0, 3.0]) * (c - AMBIENT),
    ),
    "one light for all": (
        lambda shade, v: shade(v[0], v[1][0], v[2], **COLORS)[0],
        lambda c: c[0],
    ),
}


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("law", LAWS)
def test_law(law, model):
    change, expect = LAWS[law]
    vectors = generic(5)
    assert_close(change(MODELS[model], vectors), expect(MODELS[model](*vectors, **COLORS)))


@pytest.mark.parametrize("model", MODELS)
def test_derivatives_in_every_argument(model):
    names = ("ambient", "albedo", "specular", "radiance", "visibility", "shininess", "gloss")
    values = [jnp.full(n, 0.7) for n in (3, 3, 3, 3)] + [jnp.full(4, x) for x in (0.6, 7.0, 0.8)]
    if model == "lambert":
        names, values = names[:5], values[:5]
    shade = lambda v, values: MODELS[model](*v, **dict(zip(names, values, strict=True)))
    check_grads(shade, (generic(4), values), 1, ("fwd", "rev"))


# Where a cosine is exactly 0, 1 or undefined, in (n, l, v).
X, Z = at_angle(90).at[2].set(0.0), at_angle(0)
SINGULAR = {
    "light at the horizon": (Z, X, Z),
    "mirrored away": (Z, at_angle(60), at_angle(60 - 90)),
    "all aligned": (Z, Z, Z),
    "camera opposite to light": (Z, X, -X),
    "light behind": (Z, -Z, Z),
    "zero normal": (0 * Z, Z, Z),
}


@pytest.mark.parametrize("shininess", [0.5, 1.0, 32.0])
@pytest.mark.parametrize("model", ["phong", "blinn_phong"])
@pytest.mark.parametrize("case", SINGULAR)
def test_derivatives_are_finite_where_clamped(case, model, shininess):
    light = {"albedo": 0.0, "ambient": 0.0, "specular": 1.0}
    shade = lambda *v: MODELS[model](*v[:3], **light, shininess=v[3]).sum()
    for derivative in (jax.jacrev, jax.jacfwd):
        jacobians = derivative(shade, argnums=(0, 1, 2, 3))(*SINGULAR[case], jnp.asarray(shininess))
        assert all(np.isfinite(jacobian).all() for jacobian in jacobians)


@pytest.mark.parametrize("light", [X, Z, -Z])
def test_the_clamped_side_of_lambert_has_derivative_zero(light):
    gradients = jax.grad(lambda *v: lambert(*v, albedo=0.5).sum(), argnums=(0, 1))(Z, light)
    assert_close(gradients[0], np.zeros(3), ulps=0)
    assert_close(gradients[1], np.zeros(3), ulps=0)


@pytest.mark.parametrize("shininess", [0.5, 1.0, 32.0])
def test_a_highlight_at_its_clamp_has_derivative_zero(shininess):
    shade = lambda *v: phong(*v, albedo=0.0, shininess=shininess).sum()
    for derivative in (jax.jacrev, jax.jacfwd):
        for jacobian in derivative(shade, argnums=(0, 1, 2))(Z, X, Z):  # <v, r> = 0
            assert_close(jacobian, np.zeros(3), ulps=0)


def test_one_singular_row_leaves_the_others_alone():
    good, singular = generic(3), SINGULAR["camera opposite to light"]
    bad = [rows.at[1].set(row) for rows, row in zip(good, singular, strict=True)]
    gradient = jax.grad(lambda *v: blinn_phong(*v).sum())
    assert_close(gradient(*bad)[::2], gradient(*good)[::2])
    assert np.isfinite(gradient(*bad)).all()
