"""Light shafts: closed forms, the order of convergence, rays traced at the same points."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from experiments.truth.rays import Occluders
from experiments.truth.shafts import trace_shafts
from shadows import (
    CubeLayout,
    DirectionalLight,
    HardCompare,
    Medium,
    OrthographicCamera,
    PerspectiveCamera,
    PointLight,
    Projector,
    Rays,
    ShadowMap,
    SoftCompare,
    SpotLight,
    add_shafts,
    interleaved_noise,
    look_at,
    render,
    render_shadow_map,
    render_surface,
    scattered_light,
    view_rays,
)
from tangentspace.shapes import box, merge, plane, transform_mesh

from .tools import assert_close

UP = np.array([0.0, 1.0, 0.0])
COLOR = np.array([0.9, 0.6, 0.3])

# Compiled without optimization: each runs a few times, on small images.
quick = functools.partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})


def unit(*vector):
    return np.array(vector) / np.linalg.norm(np.array(vector))


def placed(mesh, *offset):
    matrix = np.eye(4)
    matrix[:3, 3] = offset
    return transform_mesh(mesh, matrix)


CORNERS = np.stack(np.meshgrid([-3.0, 3.0], [0.0, 3.0], [-3.0, 3.0]), axis=-1).reshape(-1, 3)
LIGHTS = {
    "sun": DirectionalLight(unit(2.0, 6.0, 3.0), COLOR),
    "spot": SpotLight(np.array([1.0, 4.0, 2.0]), unit(-1.0, -4.0, -2.0), 0.1, 0.7, COLOR),
    "point": PointLight(np.array([-1.0, 5.0, 1.0]), COLOR),
    "projector": Projector(
        np.array([0.5, 5.0, 3.0]),
        unit(-0.1, -1.0, -0.5),
        np.random.default_rng(0).uniform(0.2, 1, (6, 8, 3)),
        vertical_fov=0.8,
        color=COLOR,
    ),
}

CAMERA = PerspectiveCamera(
    np.asarray(look_at(np.array([2.0, 2.5, 6.0]), np.array([0.0, 1.0, 0.0]), UP)), 0.8, 1.0, 20.0
)


def empty_map(light, size=8):
    return ShadowMap(jnp.ones((size, size)), jnp.asarray(light.clip_from_world(CORNERS)))


def random_rays(count=200, length=3.0, seed=0):
    rng = np.random.default_rng(seed)
    directions = rng.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    origins = rng.uniform([-2, 0.5, -2], [2, 2.5, 2], (count, 3))
    return Rays(*(jnp.asarray(a) for a in (origins, directions, np.full(count, length))))


@functools.partial(quick, static_argnames=("steps", "filter"))
def scatter(rays, light, shadow_map, medium, steps, offset=0.5, compare=HardCompare(), **options):
    return scattered_light(
        rays, light, shadow_map, medium, steps=steps, offset=offset, compare=compare, **options
    )


# Known answers: nothing in the way


@pytest.mark.parametrize("steps", [1, 8])
@pytest.mark.parametrize("kind", ["sun", "point"])
def test_even_light_has_the_closed_form(kind, steps):
    """A quarter of what the way to the eye does not let through, exact with any steps."""
    light = LIGHTS[kind]
    for density in (1e-9, 0.05, 1.0, 50.0):
        scattered = scatter(random_rays(), light, empty_map(light), Medium(density, 0.8), steps)
        expected = 0.2 * COLOR * -np.expm1(-3.0 * density)
        np.testing.assert_allclose(scattered, np.tile(expected, (200, 1)), rtol=1e-14)


def test_the_error_falls_with_the_square_of_the_steps():
    """Where what arrives changes along the ray, as with a point light's angle: 1e-3 with 32."""
    light, medium = LIGHTS["point"], Medium(0.5, anisotropy=0.4)
    rays = random_rays(50)
    of = lambda steps: np.asarray(scatter(rays, light, empty_map(light), medium, steps))
    exact = of(2048)
    errors = [np.abs(of(steps) / exact - 1).max() for steps in (32, 64, 128)]
    orders = np.log2(np.divide(errors[:-1], errors[1:]))
    np.testing.assert_allclose(orders, 2, atol=0.05)
    assert errors[0] < 1e-3


@pytest.mark.parametrize("g", [-0.7, 0.0, 0.6])
def test_scattering_conserves_energy_and_turns_by_its_mean_cosine(g):
    cosines, weights = np.polynomial.legendre.leggauss(200)
    p = np.asarray(Medium(1.0, anisotropy=g).scattered(jnp.asarray(cosines)))
    phase = p / np.pi
    assert_close(2 * np.pi * np.sum(weights * phase), 1.0, ulps=2**10)
    assert_close(2 * np.pi * np.sum(weights * phase * cosines), g, ulps=2**10)


def test_mist_is_bright_towards_the_light_when_it_scatters_straight_on():
    """The phase function of the angle between the view ray and the ray to the light."""
    light, medium = LIGHTS["sun"], Medium(0.2, anisotropy=0.5)
    directions = np.stack([light.direction, -light.direction, unit(3.0, -1.0, 0.0)])
    rays = Rays(jnp.zeros((3, 3)) + 1.0, jnp.asarray(directions), jnp.full(3, 2.0))
    scattered = scatter(rays, light, empty_map(light), medium, 2)
    ratio = np.asarray(scattered)[:, 0] / (COLOR[0] / 4 * (1 - np.exp(-0.4)))
    expected = 0.75 / np.array([0.5**3, 1.5**3, 1.25**1.5])
    np.testing.assert_allclose(ratio, expected, rtol=1e-12)


def test_only_what_lies_in_the_beam_scatters():
    """Across the axis of a hard cone: the chord that the ray has in it."""
    light = SpotLight(np.array([0.0, 4.0, 0.0]), -UP, 0.5, 0.5)
    rays = Rays(jnp.array([[-4.0, 1.0, 0.0]]), jnp.array([[1.0, 0.0, 0.0]]), jnp.array([8.0]))
    scattered = scatter(rays, light, empty_map(light), Medium(0.3), 4000)
    half = 3 * np.tan(0.5)
    expected = 0.25 * (np.exp(-0.3 * (4 - half)) - np.exp(-0.3 * (4 + half)))
    np.testing.assert_allclose(scattered, np.full((1, 3), expected), rtol=1e-3)


def test_albedo_may_be_a_color_and_absorbing_alone_is_dark():
    light, rays = LIGHTS["sun"], random_rays(5)
    white, tinted, black = (
        scatter(rays, light, empty_map(light), Medium(0.4, albedo), 4)
        for albedo in (1.0, jnp.asarray(COLOR), 0.0)
    )
    assert_close(tinted, white * COLOR)
    assert_close(black, np.zeros((5, 3)), ulps=0)


# Known answers: a plate

PLATE = placed(box((1.0, 0.05, 1.0), dtype=np.float64), 0.0, 2.0, 0.0)
SCENE = merge(PLATE, plane(3.0, dtype=np.float64))
draw_map = quick(
    lambda matrix: render_shadow_map(SCENE.positions, SCENE.faces, matrix, map_size=512)
)


@functools.cache
def map_of(kind):
    return draw_map(jnp.asarray(LIGHTS[kind].clip_from_world(SCENE.positions)))


def level_rays(height=1.0, count=64):
    """Rays of length 5 along x that start at x = -2.5, at different z."""
    z = np.linspace(-0.8, 0.8, count)
    origins = np.stack([np.full(count, -2.5), np.full(count, height), z], axis=-1)
    directions = np.broadcast_to([1.0, 0.0, 0.0], (count, 3))
    return Rays(*(jnp.asarray(a) for a in (origins, directions, np.full(count, 5.0))))


def under_plate(density):
    """A level ray under the plate and overhead light: dark from 1.5 to 3.5 of 5."""
    ends = np.exp(-density * np.array([0.0, 1.5, 3.5, 5.0]))
    return 0.25 * (ends[0] - ends[1] + ends[2] - ends[3])


OVERHEAD = DirectionalLight(UP)
OVERHEAD_MAP = draw_map(jnp.asarray(OVERHEAD.clip_from_world(SCENE.positions)))


def test_the_plates_shadow_is_a_gap_in_the_shaft():
    scattered = scatter(level_rays(), OVERHEAD, OVERHEAD_MAP, Medium(0.3), 500)
    expected = np.full((64, 3), under_plate(0.3))
    texel = 6.06 / 512  # either edge of the gap lies within one
    np.testing.assert_allclose(scattered, expected, atol=0.25 * 0.3 * (texel + 5.0 / 500))


def test_across_an_edge_the_error_falls_with_the_number_of_steps():
    """Averaged over where the steps fall; the noise of a fixed pattern averages out as well."""
    rays, medium = level_rays(1.0, 1024), Medium(0.3)
    jitter = jnp.asarray(np.random.default_rng(0).uniform(size=1024))
    of = lambda steps: np.asarray(scatter(rays, OVERHEAD, OVERHEAD_MAP, medium, steps, jitter))
    exact = of(4096).mean()
    assert abs(exact - under_plate(0.3)) < 0.25 * 0.3 * 6.06 / 512  # a texel; measured half of it
    spread = np.array([of(steps)[:, 0].std() for steps in (16, 32, 64)])
    orders = np.log2(spread[:-1] / spread[1:])
    np.testing.assert_allclose(orders, 1, atol=0.15)
    assert abs(of(16).mean() - exact) < 0.1 * spread[0]


@pytest.mark.parametrize("depth", [0.0, 3.0, 300.0])
def test_shadows_go_on_behind_all_that_casts(depth):
    """Far below the floor, beyond the far plane, it is as dark as just below it."""
    rays = level_rays(-0.1 - depth)
    scattered = scatter(rays, OVERHEAD, OVERHEAD_MAP, Medium(0.3), 20)
    assert_close(scattered, np.zeros((64, 3)), ulps=0)
    beside = rays._replace(origin=rays.origin.at[:, 2].add(9.0))  # past the floor's edge
    lit = scatter(beside, OVERHEAD, OVERHEAD_MAP, Medium(0.3), 20)
    np.testing.assert_allclose(lit, np.full((64, 3), 0.25 * (1 - np.exp(-1.5))))


@pytest.mark.parametrize("layout", ["single", "cube"])
def test_shadows_of_a_point_light_go_on_behind_all_that_casts(layout):
    light = PointLight(np.array([0.0, 4.0, 0.0]))
    matrix = light.clip_from_world(SCENE.positions)
    if layout == "cube":
        matrix = CubeLayout().matrices(
            light, SCENE.positions, CAMERA, aspect=1.0, map_size=64, reach=1.0
        )
    shadow_map = quick(
        lambda matrix: render_shadow_map(SCENE.positions, SCENE.faces, matrix, map_size=64)
    )(jnp.asarray(matrix))
    for depth in (0.3, 30.0):
        spread = (4 + depth) / 4  # of the floor's shadow
        dark = level_rays(-depth)._replace(length=jnp.full(64, 5.0))
        assert_close(scatter(dark, light, shadow_map, Medium(0.3), 20), np.zeros((64, 3)), ulps=0)
        beside = dark._replace(origin=dark.origin.at[:, 2].add(4.5 * spread))
        lit = scatter(beside, light, shadow_map, Medium(0.3), 20)
        np.testing.assert_allclose(lit, np.full((64, 3), 0.25 * (1 - np.exp(-1.5))))


def test_a_cube_of_maps_leaves_no_seam_in_the_mist():
    """Above and beside a light among what it lights nothing blocks."""
    light = PointLight(np.array([0.0, 2.5, 0.0]))
    matrix = CubeLayout().matrices(
        light, SCENE.positions, CAMERA, aspect=1.0, map_size=64, reach=1.0
    )
    shadow_map = quick(
        lambda matrix: render_shadow_map(SCENE.positions, SCENE.faces, matrix, map_size=64)
    )(jnp.asarray(matrix))
    rays = random_rays(400, length=1.0)
    rays = rays._replace(origin=rays.origin.at[:, 1].add(3.6))
    scattered = scatter(rays, light, shadow_map, Medium(0.3), 16)
    expected = np.full((400, 3), 0.25 * (1 - np.exp(-0.3)))
    np.testing.assert_allclose(scattered, expected)


# Against rays


@pytest.mark.parametrize("kind", LIGHTS)
def test_against_rays_traced_at_the_same_points_and_at_many_more(kind):
    """Equal wherever no sample lies near a shadow's edge; on average the same as the truth."""
    light, medium = LIGHTS[kind], Medium(0.3, 0.9, 0.4)
    surface = quick(lambda: render_surface(SCENE, CAMERA, image_size=(24, 32)))()
    rays = quick(lambda surface: view_rays(surface, CAMERA, background_distance=9.0))(surface)
    rays = Rays(*(a.reshape(-1, *a.shape[2:]) for a in rays))
    occluders = Occluders(SCENE.positions, SCENE.faces)
    marched = np.asarray(scatter(rays, light, map_of(kind), medium, 16))
    traced = trace_shafts(*rays, light, occluders, medium, steps=16)
    truth = trace_shafts(*rays, light, occluders, medium, steps=256)
    scale = truth.mean()
    same = np.isclose(marched, traced, rtol=1e-6, atol=1e-9).all(axis=1)
    assert same.mean() > 0.85  # measured 0.88 to 0.98
    assert np.abs(marched - traced).mean() < 0.01 * scale
    finer = np.asarray(scatter(rays, light, map_of(kind), medium, 256))
    error, finer_error = (np.abs(a - truth).mean() / scale for a in (marched, finer))
    assert finer_error < 0.01
    assert finer_error < 0.3 * error


# The image

PARALLEL = OrthographicCamera(CAMERA.view_from_world, 2.0, 1.0, 20.0)


@pytest.mark.parametrize("camera", [CAMERA, PARALLEL], ids=["perspective", "orthographic"])
def test_view_rays_end_at_the_surface(camera):
    surface = quick(lambda: render_surface(SCENE, camera, image_size=(12, 16)))()
    rays = quick(lambda surface: view_rays(surface, camera, background_distance=7.0))(surface)
    covered = np.asarray(surface.covered)
    assert 0.2 < covered.mean() < 0.9
    ends = rays.origin + rays.length[..., None] * rays.direction
    assert_close(ends[covered], surface.position[covered], ulps=2**8)
    assert_close(np.asarray(rays.length)[~covered], np.full((~covered).sum(), 7.0))
    assert_close(rays.direction[covered], -surface.to_camera[covered], ulps=2**8)
    eye = np.array([2.0, 2.5, 6.0])
    at_eye = np.asarray(rays.origin) - eye
    forward = -np.asarray(camera.view_from_world)[2, :3]
    depth = 0.0 if camera is CAMERA else 1.0  # parallel rays start on the near plane
    np.testing.assert_allclose(at_eye @ forward, depth, atol=1e-12)
    if camera is CAMERA:
        np.testing.assert_allclose(at_eye, 0, atol=1e-12)


LAMPS = (LIGHTS["sun"], LIGHTS["spot"])


@pytest.fixture(scope="module")
def clear():
    """The scene without a medium."""
    draw = quick(lambda lights: render(SCENE, CAMERA, lights, image_size=(24, 32), map_size=128))
    return draw(LAMPS)


@functools.partial(quick, static_argnames="steps")
def misty(image, lights, medium, steps=8, **options):
    return add_shafts(image, CAMERA, lights, medium, steps=steps, **options)


def test_an_empty_medium_changes_nothing(clear):
    image = misty(clear, LAMPS, Medium(0.0))
    for value, wanted in zip(jax.tree.leaves(image), jax.tree.leaves(clear), strict=True):
        assert_close(value, wanted, ulps=0)


def test_the_medium_dims_what_is_behind_it_and_adds_each_lights_shafts(clear):
    medium = Medium(0.2)
    image = misty(clear, LAMPS, medium)
    rays = view_rays(clear.surface, CAMERA, background_distance=CAMERA.far)
    expected = np.exp(-0.2 * rays.length)[..., None] * clear.color
    for light, shadow_map in zip(LAMPS, clear.shadow_maps, strict=True):
        expected = expected + scatter(rays, light, shadow_map, medium, 8)
    assert_close(image.color, expected)
    nearer = misty(clear, LAMPS, medium, background_distance=8.0)
    covered = np.asarray(clear.surface.covered)
    assert_close(nearer.color[covered], image.color[covered])
    assert np.abs(nearer.color - image.color)[~covered].min() > 5e-4


def test_noise_trades_bands_for_grain():
    """The mean over 3x3 pixels is nearer to the truth than the bands are."""
    surface = quick(lambda: render_surface(SCENE, CAMERA, image_size=(60, 60)))()
    rays = quick(lambda surface: view_rays(surface, CAMERA, background_distance=9.0))(surface)
    light, medium = LIGHTS["sun"], Medium(0.3)
    of = lambda steps, offset: np.asarray(
        scatter(rays, light, map_of("sun"), medium, steps, offset)
    )[..., 0]
    truth = of(512, 0.5)
    block = lambda error: error.reshape(20, 3, 20, 3).mean(axis=(1, 3))
    bands, grain = (block(of(8, o) - truth) for o in (0.5, interleaved_noise(60, 60)))
    assert np.sqrt(np.mean(grain**2)) < 0.5 * np.sqrt(np.mean(bands**2))  # measured 0.3


def test_noise_is_even_over_any_3x3_pixels():
    noise = np.asarray(interleaved_noise(64, 48))
    assert noise.shape == (64, 48)
    assert 0 <= noise.min() < 0.01
    assert 0.99 < noise.max() < 1
    windows = np.lib.stride_tricks.sliding_window_view(noise, (3, 3)).reshape(-1, 9)
    np.testing.assert_allclose(windows.mean(axis=1), 0.5, atol=0.09)
    assert np.diff(np.sort(windows, axis=1), axis=1).max() < 0.25


# Derivatives


def through_plate(depth, medium, light, compare):
    """A few rays through the plate's shadow; the map follows the light, its depths stay."""
    matrix = light.clip_from_world(SCENE.positions)
    rays = level_rays(0.9, 3)
    shadow_map = ShadowMap(depth, matrix)
    return scattered_light(rays, light, shadow_map, medium, steps=12, compare=compare)


@pytest.mark.parametrize("kind", ["sun", "spot", "projector"])
def test_derivatives_in_the_medium_and_in_the_light(kind):
    numbers = (Medium(0.3, 0.9, 0.4), LIGHTS[kind], SoftCompare(30.0))
    numbers = jax.tree.map(lambda x: jnp.asarray(x, np.float64), numbers)
    flat, unravel = ravel_pytree(numbers)
    depth = map_of(kind).depth
    of = lambda flat: through_plate(depth, *unravel(flat))[:, :2].ravel()
    forward = np.asarray(quick(jax.jacfwd(of))(flat))
    reverse = quick(jax.jacrev(of))(flat)
    np.testing.assert_allclose(reverse, forward, atol=1e-12 * np.abs(forward).max())
    plain = quick(of)
    steps = 1e-6 * jnp.eye(len(flat))
    numerical = np.stack([(plain(flat + s) - plain(flat - s)) / 2e-6 for s in steps], axis=-1)
    scale = np.abs(numerical).max(axis=0)
    assert (scale > 1e-6).sum() >= min(69, len(flat) - 1)  # pixels of a slide far from the rays
    error = np.abs(forward - numerical).max(axis=0)
    assert (error < 1e-5 * scale + 1e-10).all()  # measured 6e-7 * scale


@pytest.mark.parametrize("kind", ["sun", "spot", "projector"])
def test_finite_with_finite_derivatives_wherever_rays_lead(kind):
    """Through the light, along its plane, behind it, of length 0, and beyond the far plane."""
    light = LIGHTS[kind]
    at = np.array(getattr(light, "position", np.array([0.0, 4.0, 0.0])))
    towards = np.asarray(light.to_light(jnp.zeros((1, 3))))[0]
    across = unit(*np.cross(towards, [0.3, 0.1, 0.9]))
    starts = [at - towards, at - 0.5 * across, at + towards, at, [0, 1, 0], [0, 1, 0], [0, 1, 0]]
    ways = [towards, across, towards, towards, -UP, -UP, -towards]
    rays = Rays(np.array(starts), np.array(ways), np.array([2.0, 1.0, 5.0, 0.0, 0.0, 50.0, 1e4]))

    def total(rays, light, medium, shadow_map, compare):
        return jnp.sum(scattered_light(rays, light, shadow_map, medium, steps=4, compare=compare))

    both = quick(jax.value_and_grad(total, argnums=(0, 1, 2, 3, 4)))
    for softness in (0.0, 1.0):
        arguments = (rays, light, Medium(0.3, 0.9, 0.4), map_of(kind), SoftCompare(softness))
        value, slopes = both(*jax.tree.map(lambda x: jnp.asarray(x, np.float32), arguments))
        assert value.dtype == np.float32
        assert bool(jnp.isfinite(value))
        assert all(bool(jnp.isfinite(leaf).all()) for leaf in jax.tree.leaves(slopes))


@pytest.mark.parametrize("change", [lambda f: f, jax.grad], ids=["value", "gradient"])
def test_memory_does_not_grow_with_the_steps(change):
    rays, shadow_map = random_rays(5000), map_of("sun")

    def memory(steps):
        total = lambda light: jnp.sum(
            scattered_light(
                rays, light, shadow_map, Medium(0.3), steps=steps, compare=SoftCompare()
            )
        )
        compiled = quick(change(total)).lower(LIGHTS["sun"]).compile()
        return compiled.memory_analysis().temp_size_in_bytes

    assert memory(64) < 1.01 * memory(4)


# Errors


@pytest.mark.errors
@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"density": -0.1}, "expected `density` of at least 0, got -0.1"),
        ({"density": float("nan")}, "expected `density` of at least 0, got nan"),
        ({"density": 1.0, "anisotropy": 1.0}, "`anisotropy` between -1 and 1, got 1.0"),
        ({"density": 1.0, "anisotropy": -1.0}, "`anisotropy` between -1 and 1, got -1.0"),
    ],
)
def test_a_medium_without_sense_is_refused(options, message):
    with pytest.raises(ValueError, match=f"^Medium: .*{message}$"):
        Medium(**options)


@pytest.mark.errors
def test_steps_and_lights_are_checked(clear):
    with pytest.raises(ValueError, match=r"^scattered_light: expected `steps` .* got 0$"):
        add_shafts(clear, CAMERA, LAMPS, Medium(0.1), steps=0)
    with pytest.raises(ValueError, match=r"^add_shafts: .* for each of 2 shadow maps, got 1$"):
        add_shafts(clear, CAMERA, LAMPS[0], Medium(0.1))


def test_media_are_pytrees_whose_numbers_can_be_mapped_over():
    light = LIGHTS["sun"]
    rays = random_rays(4)
    of = lambda density: scattered_light(rays, light, empty_map(light), Medium(density), steps=4)
    densities = jnp.array([0.1, 0.2])
    both = quick(jax.vmap(of))(densities)
    assert_close(both, jnp.stack([of(d) for d in densities]))
    assert eqx.tree_equal(jax.tree.map(lambda x: x, Medium(0.1)), Medium(0.1))
