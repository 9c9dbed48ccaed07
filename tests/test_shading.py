"""Lighting models as pytrees: equal to the functions of ``lighting``, in value and derivative."""

import dataclasses
import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from tangentspace._math import safe_normalize
from tangentspace.lighting import IncomingLight, blinn_phong, lambert, phong, shade_lights
from tangentspace.shading import (
    BlinnPhongShading,
    Coefficient,
    LambertShading,
    PhongShading,
    Shading,
    Terms,
)

from .tools import assert_close

FUNCTIONS = {LambertShading: lambert, PhongShading: phong, BlinnPhongShading: blinn_phong}
RGB = {"albedo": (0.2, 0.4, 0.8), "specular": (0.9, 0.5, 0.1), "ambient": (0.02, 0.05, 0.1)}

# Compiled without optimization: each runs once or twice, on few points.
quick = functools.partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})


def model_of(kind, dtype=np.float64, **changed):
    """A model whose coefficients are all arrays, with a color wherever it takes one."""
    values = {**RGB, "shininess": 7.3, **changed}
    names = [field.name for field in dataclasses.fields(kind)]
    return kind(**{name: np.asarray(values[name], dtype) for name in names})


def shade(model, vectors, light):
    return model(*vectors, **light)


def shade_by_function(model, vectors, light):
    """The same by ``lighting``, where the base color is a factor on two coefficients."""
    light = dict(light)
    base_color = light.pop("base_color", 1.0)
    fields = {field.name: getattr(model, field.name) for field in dataclasses.fields(model)}
    tinted = {name: fields[name] * base_color for name in ("albedo", "ambient")}
    return FUNCTIONS[type(model)](*vectors, **{**fields, **tinted, **light})


call, by_function = quick(shade), quick(shade_by_function)


def unit(vectors):
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def everywhere(count=200, dtype=np.float64):
    """Unit n, l and v in all directions: half of the lights are behind the surface."""
    return tuple(unit(np.random.default_rng(0).normal(size=(3, count, 3))).astype(dtype))


def generic(count=4):
    """Unit n, l and v within 36 degrees of +z: away from every clamp."""
    tilts = np.random.default_rng(0).uniform(-0.5, 0.5, (3, count, 2))
    return tuple(unit(np.concatenate([tilts, np.ones((3, count, 1))], axis=-1)))


def arriving(count, dtype):
    random = np.random.default_rng(1)
    light = {
        "radiance": random.uniform(0, 3, (count, 3)),
        "visibility": random.uniform(0, 1, count),
        "gloss": random.uniform(0.05, 1, count),
        "base_color": random.uniform(0, 1, (count, 3)),
    }
    return {name: value.astype(dtype) for name, value in light.items()}


X, Z = np.array([1.0, 0, 0]), np.array([0.0, 0, 1])
TILTED = np.array([0.6, 0, 0.8])
# Where a cosine is exactly 0, 1 or undefined, in (n, l, v).
SINGULAR = {
    "light at the horizon": (Z, X, Z),
    "mirrored away": (Z, TILTED, TILTED * [-1, 1, 1]),
    "all aligned": (Z, Z, Z),
    "camera opposite to light": (Z, X, -X),
    "opposite along the normal": (Z, Z, -Z),
    "light behind": (Z, -Z, Z),
    "camera behind": (Z, TILTED, -TILTED),
    "zero normal": (0 * Z, Z, TILTED),
    "no light": (Z, 0 * Z, Z),
    "nothing": (0 * Z, 0 * Z, 0 * Z),
}


def singular(dtype):
    """All of them, n, l and v in a row each."""
    return tuple(
        np.stack(vectors).astype(dtype) for vectors in zip(*SINGULAR.values(), strict=True)
    )


# Known answers


def test_the_lecture_form_is_phong_of_the_defaults():
    assert_close(PhongShading()(Z, Z, Z), np.full(3, 0.1 + 0.5 + 0.9), ulps=4)
    mirrored = unit(np.array([-1, 0, 1])), unit(np.array([1, 0, 1]))
    expected = 0.1 + 0.5 * np.sqrt(0.5) + 0.9
    assert_close(PhongShading()(Z, *mirrored), np.full(3, expected), ulps=4)
    green = PhongShading(albedo=np.array([0.0, 1.0, 0.0]), specular=0.0, ambient=0.0)
    assert_close(green(Z, TILTED, Z), np.array([0, 0.8, 0]), ulps=4)


def test_base_color_tints_what_is_matte_but_not_the_highlight():
    model = PhongShading(albedo=0.5, specular=0.25, ambient=0.125)
    color = model(Z, Z, Z, base_color=np.array([1.0, 0.5, 0.0]))
    assert_close(color, np.array([0.875, 0.5625, 0.25]), ulps=2)


def test_ambient_that_is_given_replaces_the_models_own():
    model = LambertShading(albedo=0.5, ambient=0.25)
    base_color = np.array([0.5, 0.5, 0.5])
    assert_close(model(Z, Z, Z, base_color=base_color), np.full(3, 0.375), ulps=2)
    assert_close(model(Z, Z, Z, base_color=base_color, ambient=0.0), np.full(3, 0.25), ulps=2)
    blue = np.array([0.0, 0.0, 1.0])
    assert_close(model(Z, -Z, Z, ambient=blue), blue, ulps=0)


@pytest.mark.parametrize("kind", FUNCTIONS)
def test_a_call_without_options_is_the_functions(kind):
    """The defaults are those of ``lighting``; lambert's, which has none, are its own."""
    vectors = everywhere()
    chosen = {"albedo": 0.8} if kind is LambertShading else {}
    assert_close(call(kind(), vectors, {}), FUNCTIONS[kind](*vectors, **chosen), ulps=64)


@pytest.mark.parametrize("kind", FUNCTIONS)
@pytest.mark.parametrize("option", [(), "base_color", "gloss", "radiance", "visibility", "all"])
def test_equals_the_function_in_all_directions(kind, option, dtype):
    vectors, model = everywhere(dtype=dtype), model_of(kind, dtype)
    light = {k: v for k, v in arriving(200, dtype).items() if option in (k, "all")}
    color = call(model, vectors, light)
    assert color.dtype == dtype
    assert color.shape == (200, 3)
    # The half vector's length from 2 + 2 <l, v> loses digits near 0: measured 40 and 26.
    assert_close(color, by_function(model, vectors, light), ulps=128)
    dark = np.all(np.asarray(color) <= np.asarray(RGB["ambient"]) + 1e-6, axis=-1).mean()
    assert dark < 0.7  # most points show more than the ambient light


@pytest.mark.parametrize("kind", FUNCTIONS)
def test_equals_the_function_at_singular_points(kind, dtype):
    model = model_of(kind, dtype)
    assert_close(call(model, singular(dtype), {}), by_function(model, singular(dtype), {}))


@pytest.mark.parametrize("kind", FUNCTIONS)
def test_shades_under_several_lights_as_the_function_does(kind):
    normal, first, to_camera = everywhere(50)
    second = unit(np.random.default_rng(2).normal(size=(50, 3)))
    model, base_color = model_of(kind), arriving(50, np.float64)["base_color"]
    lights = [
        IncomingLight(first, np.array([1.0, 2.0, 0.5]), np.linspace(0, 1, 50)),
        IncomingLight(second),
    ]
    bound = functools.partial(model, base_color=base_color)
    color = shade_lights(bound, normal, to_camera, lights)
    one, other = (
        by_function(
            model,
            (normal, light.to_light, to_camera),
            {"base_color": base_color, "radiance": light.radiance, "visibility": light.visibility},
        )
        for light in lights
    )
    assert_close(color, one + other - base_color * np.asarray(RGB["ambient"]), ulps=64)


@pytest.mark.parametrize(("kind", "factor"), [(PhongShading, 4), (BlinnPhongShading, 1)])
def test_gloss_is_toksvigs_of_a_lobe_as_wide(kind, factor, dtype):
    lengths, exponent = np.linspace(0.1, 1, 7, dtype=dtype), factor * 20
    gloss = kind(shininess=20.0).gloss(lengths)
    assert gloss.dtype == dtype
    assert_close(gloss, lengths / (lengths + exponent * (1 - lengths)), ulps=8)
    assert float(gloss[-1]) == 1.0


def test_matte_surfaces_have_no_gloss():
    assert LambertShading().gloss(np.array([0.5, 1.0])) == 1.0


# Laws


@pytest.mark.parametrize("kind", FUNCTIONS)
def test_only_angles_matter(kind):
    turn = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]  # may mirror
    vectors, model = everywhere(), model_of(kind)
    turned = tuple(vector @ turn for vector in vectors)
    # Measured 66: exponents up to 7 and a half vector near 0.
    assert_close(call(model, turned, {}), call(model, vectors, {}), ulps=256)


@pytest.mark.parametrize("kind", FUNCTIONS)
def test_numbers_per_pixel_and_colors_broadcast_over_images(kind):
    """(h, w, 3) with one light direction, gloss and visibility per pixel, color per pixel."""
    model = model_of(kind)
    normal, to_light, to_camera = (np.reshape(v[:6], (2, 3, 3)) for v in everywhere())
    light = {
        name: value.reshape(2, 3, *value.shape[1:])
        for name, value in arriving(6, np.float64).items()
    }
    color = model(normal, to_light[0, 0], to_camera, **light)
    assert color.shape == (2, 3, 3)
    for at in np.ndindex(2, 3):
        alone = model(
            normal[at], to_light[0, 0], to_camera[at], **{k: v[at] for k, v in light.items()}
        )
        assert_close(color[at], alone, ulps=8)


@pytest.mark.parametrize("kind", FUNCTIONS)
def test_numbers_for_coefficients_serve_as_colors_do(kind):
    number, colors = (
        kind(**{f.name: make(0.3) for f in dataclasses.fields(kind) if f.name != "shininess"})
        for make in (lambda x: x, lambda x: np.full(3, x))
    )
    vectors = everywhere(50)
    assert_close(number(*vectors), colors(*vectors), ulps=1)


def test_coefficients_are_leaves_and_have_units():
    for kind in FUNCTIONS:
        names = [field.name for field in dataclasses.fields(kind)]
        assert len(jax.tree.leaves(kind())) == len(names)
        for field in dataclasses.fields(kind):
            assert field.metadata["unit"] in ("of white", "exponent")
            assert (field.metadata["unit"] == "exponent") == (field.name == "shininess")


def test_traces_once_for_other_coefficients():
    traces = []

    @eqx.filter_jit
    def counted(model, vectors):
        traces.append(type(model))
        return model(*vectors)

    for exponent in (3.0, 5.0):
        counted(model_of(PhongShading, shininess=exponent), generic())
    counted(model_of(BlinnPhongShading), generic())
    assert traces == [PhongShading, BlinnPhongShading]


def test_what_is_not_given_is_not_computed():
    vectors = generic()
    program = lambda model, **light: str(jax.make_jaxpr(lambda v: model(*v, **light))(vectors))
    plain = program(PhongShading())
    assert program(PhongShading(), gloss=1.0, base_color=1.0) == plain
    assert len(program(PhongShading(), gloss=np.ones(4))) > len(plain)
    assert len(program(PhongShading(), base_color=np.ones(3))) > len(plain)
    assert "pow" in plain
    assert "pow" not in program(LambertShading())


def test_a_new_model_is_a_subclass_with_two_terms():
    class Toon(Shading):
        albedo: Coefficient = 0.5
        specular: Coefficient = 0.25
        ambient: Coefficient = 0.125

        def terms(self, n_dot_l, n_dot_v, l_dot_v, *, gloss=1.0):
            return Terms(jnp.where(n_dot_l > 0.5, 1.0, 0.0), jnp.where(n_dot_v > 0.9, gloss, 0.0))

    assert_close(Toon()(Z, Z, Z), np.full(3, 0.875), ulps=0)
    assert_close(Toon()(Z, X, Z, gloss=0.5), np.full(3, 0.25), ulps=0)
    assert_close(Toon()(Z, Z, X, base_color=np.array([1.0, 0, 2])), [0.625, 0, 1.25], ulps=0)


@pytest.mark.errors
def test_a_model_without_terms_is_none():
    with pytest.raises(TypeError, match="abstract"):
        Shading()  # pyright: ignore[reportAbstractUsage]


# Derivatives


@pytest.mark.parametrize("kind", FUNCTIONS)
def test_derivatives_in_every_argument(kind):
    model, light = model_of(kind), arriving(4, np.float64)
    check_grads(jax.jit(shade), (model, generic(), light), 1, ("fwd", "rev"))
    given = jax.jit(lambda ambient: model(*generic(), ambient=ambient))
    check_grads(given, (np.full(3, 0.3),), 1, ("fwd", "rev"))
    gradient = quick(jax.grad(lambda model: shade(model, generic(), light).sum()))(model)
    assert len(jax.tree.leaves(gradient)) == len(dataclasses.fields(kind))
    assert all(np.all(leaf != 0) for leaf in jax.tree.leaves(gradient))  # each has a say


@pytest.mark.parametrize("kind", [PhongShading, BlinnPhongShading])
def test_derivatives_of_gloss_in_length_and_exponent(kind):
    gloss = jax.jit(lambda length, shininess: kind(shininess=shininess).gloss(length))
    check_grads(gloss, (np.array([0.3, 0.8]), np.array(20.0)), 1, ("fwd", "rev"))


@pytest.mark.parametrize("kind", FUNCTIONS)
def test_derivatives_are_the_functions_own(kind):
    """Along the sphere: the two differ where vectors are not of unit length."""
    vectors, light = everywhere(50), arriving(50, np.float64)
    weights = np.random.default_rng(3).normal(size=(50, 3))

    def slopes(shade):
        total = lambda model, vectors, light: jnp.sum(
            weights * shade(model, tuple(map(safe_normalize, vectors)), light)
        )
        return jax.tree.leaves(quick(jax.grad(total, (0, 1, 2)))(model_of(kind), vectors, light))

    for one, other in zip(slopes(shade), slopes(shade_by_function), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("kind", FUNCTIONS)
def test_derivatives_are_finite_at_singular_points(kind, dtype):
    gloss = np.full(len(SINGULAR), 0.5, dtype)

    def shade(model, gloss, *vectors):
        return jax.vmap(lambda gloss, *v: model(*v, gloss=gloss))(gloss, *vectors)

    for derivative in (jax.jacrev, jax.jacfwd):
        jacobian = quick(derivative(shade, argnums=tuple(range(5))))
        for shininess in (0.5, 1.0, 32.0):
            model = model_of(kind, dtype, shininess=shininess)
            for leaf in jax.tree.leaves(jacobian(model, gloss, *singular(dtype))):
                assert np.isfinite(leaf).all()


@pytest.mark.parametrize(
    ("kind", "case"),
    [
        (PhongShading, "light at the horizon"),  # <v, r> = 0
        (BlinnPhongShading, "camera opposite to light"),
        (BlinnPhongShading, "opposite along the normal"),
    ],
)
def test_a_highlight_at_its_clamp_has_derivative_zero(kind, case):
    slopes = quick(jax.grad(lambda vectors, model: model(*vectors).sum()))
    for shininess in (0.5, 1.0, 32.0):
        model = kind(albedo=0.0, ambient=0.0, shininess=shininess)
        for slope in slopes(SINGULAR[case], model):
            assert_close(slope, np.zeros(3), ulps=0)
