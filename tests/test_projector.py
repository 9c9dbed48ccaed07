"""The projector: where its image lands, that nothing is behind it, its shadow and derivatives."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from shadows import (
    PerspectiveCamera,
    Projector,
    look_at,
    render,
    render_shadow_map,
    transform_points,
)
from tangentspace.shapes import box, merge, plane, transform_mesh

from .tools import assert_close

UP = np.array([0.0, 1.0, 0.0])

# Compiled without optimization: each runs a few times, on small images.
quick = functools.partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})
radiance = jax.jit(lambda light, positions: light.radiance(positions))
clip_of = jax.jit(lambda light, points: light.clip_from_world(points))


def unit(*vector):
    return np.array(vector) / np.linalg.norm(np.array(vector))


def random_image(height=5, width=7, channels=3):
    return np.random.default_rng(0).uniform(0.1, 1, (height, width, channels))


def forward_projector(**changes):
    """It stands at the origin and looks along -z; its image is 2 high at distance 1."""
    fields = {"position": np.zeros(3), "direction": -np.array([0.0, 0.0, 1.0])}
    fields |= {"image": random_image(), "vertical_fov": np.pi / 2, "up": UP}
    return Projector(**(fields | changes))


def generic_projector(**changes):
    """One that is tilted every way."""
    fields = {"position": np.array([0.4, 1.1, 2.0]), "direction": unit(-0.3, -0.5, -1.0)}
    fields |= {"vertical_fov": 0.7, "up": unit(0.2, 1.0, 0.1), "color": np.array([0.9, 0.6, 0.3])}
    return forward_projector(**(fields | changes))


def on_image(light, u, v, distance):
    """World points on the ray of each (u, v), by the pinhole model and cross products."""
    forward = light.direction / np.linalg.norm(light.direction)
    right = unit(*np.cross(forward, light.up))
    above = np.cross(right, forward)
    tangent = np.tan(light.vertical_fov / 2)
    height, width = light.image.shape[:2]
    u, v, distance = (np.asarray(x)[..., None] for x in (u, v, distance))
    across, up = tangent * width / height * (2 * u - 1), tangent * (2 * v - 1)
    return light.position + distance * (forward + across * right + up * above)


def radiance_reference(light, points):
    """One point at a time, in float64."""
    height, width, _ = light.image.shape
    forward = light.direction / np.linalg.norm(light.direction)
    right = unit(*np.cross(forward, light.up))
    above = np.cross(right, forward)
    result = np.zeros((len(points), 3))
    for k, point in enumerate(points):
        offset = point - light.position
        depth = offset @ forward
        if depth <= 0:
            continue
        scale = height / (2 * np.tan(light.vertical_fov / 2)) / depth  # pixels per length
        column = width / 2 + scale * (offset @ right)
        row = height / 2 - scale * (offset @ above)
        if not (0 < column < width and 0 < row < height):
            continue
        share = min(1, 2 * column, 2 * (width - column)) * min(1, 2 * row, 2 * (height - row))
        left, top = int(np.floor(column - 0.5)), int(np.floor(row - 0.5))
        for i, j in np.ndindex(2, 2):
            weight = (1 - abs(row - 0.5 - top - i)) * (1 - abs(column - 0.5 - left - j))
            texel = light.image[np.clip(top + i, 0, height - 1), np.clip(left + j, 0, width - 1)]
            result[k] += share * weight * texel * light.color
    return result


# Known answers


def test_pixels_land_where_the_pinhole_model_says(dtype):
    """On a wall at distance 3 the image is 6 high, row 0 on top, column 0 on the left."""
    light = jax.tree.map(lambda x: jnp.asarray(x, dtype), forward_projector())
    rows, columns = np.indices((5, 7))
    pixel = 6.0 / 5
    x, y = (columns - 3) * pixel, (2 - rows) * pixel
    wall = jnp.asarray(np.stack([x, y, np.full(x.shape, -3.0)], axis=-1), dtype)
    arrived = radiance(light, wall)
    assert arrived.dtype == dtype
    assert_close(arrived, random_image())
    middle = 0.5 * (random_image()[:, 1:] + random_image()[:, :-1])
    between = wall[:, :-1] + jnp.array([0.5 * pixel, 0, 0], dtype)
    assert_close(radiance(light, between), middle)


def test_checker_on_a_slanted_floor():
    """A pixel's square is lit in the pixel's color wherever its ray goes."""
    checks = np.indices((6, 8)).sum(axis=0) % 2.0
    light = generic_projector(image=checks[..., None], color=np.ones(3))
    u, v = np.meshgrid((np.arange(8) + 0.5) / 8, (np.arange(6) + 0.5) / 6)
    rays = on_image(light, u, v, np.ones_like(u)) - light.position
    floor = light.position + rays * (-1.0 - light.position[1]) / rays[..., 1:2]
    falls = (rays[..., 1] < 0).ravel()
    assert falls.sum() > 30
    expected = np.repeat(checks[::-1, :, None], 3, axis=-1).reshape(-1, 3)
    assert_close(radiance(light, jnp.asarray(floor.reshape(-1, 3)[falls])), expected[falls])


@pytest.mark.parametrize("channels", [1, 3])
def test_against_the_oracle(channels):
    light = generic_projector(image=random_image(channels=channels))
    rng = np.random.default_rng(1)
    points = rng.uniform(-3, 3, (2000, 3))
    inside = on_image(light, *rng.uniform(-0.1, 1.1, (2, 1000)), rng.uniform(0.1, 9, 1000))
    points = np.concatenate([points, inside])
    expected = radiance_reference(light, points)
    assert 0.2 < (expected > 0).mean() < 0.8
    assert_close(radiance(light, jnp.asarray(points)), expected)


def test_brightness_does_not_fall_with_distance_and_to_light_is_the_ray_back():
    light = generic_projector()
    points = jnp.asarray(on_image(light, np.full(3, 0.3), np.full(3, 0.6), np.array([0.1, 2, 50])))
    assert_close(radiance(light, points)[1:], radiance(light, points)[:1].repeat(2, axis=0))
    expected = light.position - np.asarray(points)
    expected /= np.linalg.norm(expected, axis=-1, keepdims=True)
    assert_close(light.to_light(points), expected)


def test_fades_over_half_a_pixel_at_the_border():
    light = forward_projector(image=np.ones((4, 4, 1)))
    u = np.array([0.0, 1 / 32, 1 / 16, 1 / 8, 0.5, 1 - 1 / 16, 1.0])
    expected = np.array([0, 0.25, 0.5, 1, 1, 0.5, 0])[:, None] * np.ones(3)
    for place in ((u, np.full(7, 0.5)), (np.full(7, 0.5), u)):
        points = on_image(light, *place, np.full(7, 2.0))
        assert_close(radiance(light, jnp.asarray(points)), expected)


# Nothing outside, nothing behind


def test_nothing_outside_the_image_and_nothing_mirrored_behind():
    light = generic_projector(image=random_image() + 1)
    rng = np.random.default_rng(2)
    inside = on_image(light, *rng.uniform(0.01, 0.99, (2, 200)), rng.uniform(0.1, 9, 200))
    assert float(radiance(light, jnp.asarray(inside)).min()) > 0
    behind = 2 * light.position - inside  # with the same x / w and y / w
    assert_close(radiance(light, jnp.asarray(behind)), np.zeros((200, 3)), ulps=0)
    u, v = rng.uniform(-2, 3, (2, 400))
    out = (np.abs(u - 0.5) > 0.5) | (np.abs(v - 0.5) > 0.5)
    beside = on_image(light, u, v, rng.uniform(0.1, 9, 400))[out]
    assert len(beside) > 200
    assert_close(radiance(light, jnp.asarray(beside)), np.zeros((len(beside), 3)), ulps=0)


@pytest.mark.parametrize("depth", [0.0, -0.0, 1e-40, 1e-30, 1e-13, 1e-11, 1e-5, -1e-30, -1e-5])
def test_finite_with_finite_derivatives_beside_the_projector(depth, dtype):
    """Points at the projector, in its plane, and hardly in front of it, among good ones."""
    light = jax.tree.map(lambda x: jnp.asarray(x, dtype), forward_projector())
    sides = [[0, 0], [depth / 2, depth / 3], [0.3, 0.0], [0.0, -2.0], [1e9, 1e9]]
    points = np.array([[x, y, -depth] for x, y in sides] + [[0.2, 0.1, -1.0]])
    points = jnp.asarray(points, dtype)
    total = lambda light, points: jnp.sum(light.radiance(points) + light.to_light(points))
    value, slopes = jax.jit(jax.value_and_grad(total, argnums=(0, 1)))(light, points)
    assert bool(jnp.isfinite(value))
    assert all(bool(jnp.isfinite(leaf).all()) for leaf in jax.tree.leaves(slopes))
    assert_close(radiance(light, points)[2:5], np.zeros((3, 3)), ulps=0)
    assert float(radiance(light, points)[5].min()) > 0


# The shadow map is the image's frustum


def test_map_and_image_share_their_frame():
    """A point's place in the map, as a share of its sides, is its uv in the image."""
    light = generic_projector()
    u, v = np.random.default_rng(3).uniform(0, 1, (2, 50))
    distance = np.linspace(0.5, 4, 50)
    points = on_image(light, u, v, distance)
    clip = np.asarray(transform_points(clip_of(light, points), jnp.asarray(points)))
    bias = np.array([[0.5, 0, 0, 0.5], [0, 0.5, 0, 0.5], [0, 0, 0.5, 0.5], [0, 0, 0, 1]])
    u_map, v_map, depth, _ = (clip @ bias.T / clip[:, 3:]).T
    assert_close(u_map, u)
    assert_close(v_map, v)
    assert_close(clip[:, 3], distance)
    assert 0 < depth.min() < 0.05
    assert 0.95 < depth.max() < 1


@pytest.mark.parametrize("shift", [0.0, -2.0, -50.0])
def test_map_of_points_round_or_behind_the_projector_is_finite(shift):
    light = jax.tree.map(jnp.asarray, forward_projector())
    points = np.random.default_rng(0).uniform(-1, 1, (30, 3)) - [0, 0, shift]
    matrix = lambda light, points: light.clip_from_world(points)
    assert bool(jnp.isfinite(clip_of(light, points)).all())
    slopes = jax.jit(jax.jacrev(matrix, argnums=(0, 1)))(light, jnp.asarray(points))
    assert all(bool(jnp.isfinite(leaf).all()) for leaf in jax.tree.leaves(slopes))


def placed(mesh, *offset):
    matrix = np.eye(4)
    matrix[:3, 3] = offset
    return transform_mesh(mesh, matrix)


BOX_FACES = 12
FLOOR = plane(4.0, dtype=np.float64)
MESH = merge(placed(box((0.3, 0.3, 0.3), dtype=np.float64), 0.4, 1.0, 0.2), FLOOR)
LAMP = forward_projector(
    position=np.array([0.0, 4.0, 0.0]),
    direction=-UP,
    up=np.array([0.0, 0.0, -1.0]),
    vertical_fov=2 * np.arctan(0.5),  # on the floor 4 high (along z), and 4 * 7 / 5 wide
)
EYE = PerspectiveCamera(
    np.asarray(look_at(np.array([1.0, 6.0, 5.0]), np.zeros(3), UP)), 0.9, 1.0, 20.0
)


@pytest.fixture(scope="module")
def image():
    """A slide thrown down on a floor past a box, seen with no further edit."""
    draw = quick(lambda mesh, light: render(mesh, EYE, [light], image_size=(64, 96), map_size=256))
    return draw(MESH, LAMP)


def test_render_shows_a_slide_with_the_shadow_of_what_stands_in_its_way(image):
    """The box, from 0.7 to 1.3 high under a lamp 4 high, hides what lies behind it."""
    position = np.asarray(image.surface.position)
    floor = np.asarray(image.surface.face_ids) >= BOX_FACES
    corners = np.array([0.4, 1.0, 0.2]) + 0.3 * (2 * np.indices((2, 2, 2)).reshape(3, -1).T - 1)
    shadow = 4 * corners[:, ::2] / (4 - corners[:, 1:2])  # its corners are cut by 0.03 at most
    inside = lambda margin: np.all(
        (position[..., ::2] > shadow.min(axis=0) + margin)
        & (position[..., ::2] < shadow.max(axis=0) - margin),
        axis=-1,
    )
    visibility, arrived = np.asarray(image.visibilities[0]), radiance(LAMP, image.surface.position)
    slide = np.asarray(arrived).min(axis=-1) > 0
    dark, lit = floor & inside(0.06), floor & ~inside(-0.06)
    assert dark.sum() > 30
    assert (lit & slide).sum() > 500
    assert_close(visibility[dark], np.zeros(dark.sum()), ulps=0)
    assert_close(visibility[lit], np.ones(lit.sum()), ulps=8)
    ambient = 0.1
    color = np.asarray(image.color)
    assert_close(color[dark], np.full((dark.sum(), 3), ambient))
    outside = floor & ~slide & ~inside(-0.06)
    assert outside.sum() > 500
    assert_close(color[outside], np.full((outside.sum(), 3), ambient))
    # Diffuse 0.5 times the slide, times the cosine of the ray with the floor, and some gloss.
    cosine = 4 / np.sqrt(4**2 + np.sum(position[..., ::2] ** 2, axis=-1))
    expected = ambient + 0.5 * np.asarray(arrived) * cosine[..., None]
    shown = lit & slide & (expected.max(axis=-1) < 0.9)
    assert (color[shown] > expected[shown] - 1e-9).all()


def test_the_map_holds_nothing_but_the_image(image):
    """A corner of the floor outside of the image has no texel."""
    shadow_map = image.shadow_maps[0]
    corner = jnp.array([[2.79, 0.0, 1.99], [2.81, 0.0, 0.0], [0.0, 0.0, 2.01]])
    clip = transform_points(shadow_map.clip_from_world, corner)
    assert_close(jnp.all(jnp.abs(clip[:, :3]) <= clip[:, 3:], axis=-1), [True, False, False])
    assert float(jnp.max(shadow_map.depth)) < 1  # the floor fills the image


# Derivatives

POSE = ("position", "direction", "up", "vertical_fov", "color", "image")


def check_jacobian(function, argument):
    """Forward and reverse mode, and central differences, to 1e-5."""
    forward = np.asarray(jax.jit(jax.jacfwd(function))(argument))
    assert_close(jax.jit(jax.jacrev(function))(argument), forward, ulps=2**12)
    of = jax.jit(function)
    columns = [
        (of(argument.at[k].add(1e-6)) - of(argument.at[k].add(-1e-6))) / 2e-6
        for k in np.ndindex(argument.shape)
    ]
    numerical = np.stack(columns, axis=-1).reshape(forward.shape)
    scale = np.abs(numerical).max()
    assert scale > 1e-3
    np.testing.assert_allclose(forward, numerical, atol=1e-7 * scale)  # measured 5e-10


@pytest.mark.parametrize("field", POSE)
def test_radiance_has_its_derivative_in(field):
    light = jax.tree.map(jnp.asarray, generic_projector())
    rng = np.random.default_rng(4)
    points = on_image(generic_projector(), *rng.uniform(-0.1, 1.1, (2, 40)), np.full(40, 2.5))
    points = jnp.asarray(points)

    def arrived(value):
        return eqx.tree_at(lambda light: getattr(light, field), light, value).radiance(points)

    check_jacobian(arrived, getattr(light, field))


def test_radiance_has_its_derivative_in_the_position_lit():
    light = generic_projector()
    u, v = np.random.default_rng(5).uniform(0, 1, (2, 6))
    points = jnp.asarray(on_image(light, u, v, np.linspace(1, 4, 6)))
    check_jacobian(lambda points: light.radiance(points), points)


def test_the_pose_can_be_found_from_what_is_seen():
    """Gauss-Newton steps from a wrong pose lead to the one that threw the image."""
    smooth = np.add.outer(np.sin(np.arange(9) / 3), np.cos(np.arange(12) / 4))
    truth = generic_projector(image=np.abs(smooth)[..., None])
    rng = np.random.default_rng(6)
    points = jnp.asarray(on_image(truth, *rng.uniform(0.2, 0.8, (2, 300)), rng.uniform(2, 4, 300)))
    target = radiance(truth, points)

    def residual(pose):
        light = Projector(pose[:3], pose[3:], truth.image, truth.vertical_fov, truth.up)
        return (light.color * light.radiance(points) * truth.color - target).ravel()

    step = jax.jit(lambda p: jnp.linalg.lstsq(jax.jacfwd(residual)(p), -residual(p))[0])
    right = np.concatenate([truth.position, truth.direction])
    pose = jnp.asarray(right + 0.03 * rng.normal(size=6))
    for _ in range(8):
        pose = pose + step(pose)
    found = np.concatenate([pose[:3], unit(*np.asarray(pose[3:]))])
    np.testing.assert_allclose(found, right, atol=1e-6)


def test_shadowed_slide_has_finite_derivatives_in_all_its_numbers():
    """Through its own map, drawn anew for each pose."""
    total = lambda light: jnp.sum(render(MESH, EYE, light, image_size=(24, 32), map_size=32).color)
    slopes = quick(jax.grad(total))(jax.tree.map(jnp.asarray, LAMP))
    assert all(bool(jnp.isfinite(leaf).all()) for leaf in jax.tree.leaves(slopes))
    assert float(jnp.abs(slopes.image).max()) > 0
    assert float(jnp.abs(slopes.position).max()) > 0


# Errors and transformations


@pytest.mark.errors
@pytest.mark.parametrize("shape", [(4, 4), (4, 4, 2), (0, 4, 3), (4, 4, 4)])
def test_an_image_has_rows_columns_and_one_or_three_channels(shape):
    with pytest.raises(ValueError, match=r"^Projector: expected `image` of shape .* got \("):
        forward_projector(image=np.ones(shape))


@pytest.mark.errors
@pytest.mark.parametrize("angle", [0.0, -1.0, np.pi, np.nan])
def test_the_angle_lies_between_0_and_pi(angle):
    with pytest.raises(ValueError, match=r"^Projector: expected `vertical_fov` between 0 and pi"):
        forward_projector(vertical_fov=angle)


def test_moving_the_world_moves_the_slide():
    light = generic_projector()
    turn = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
    turn *= np.linalg.det(turn)  # a mirrored world would mirror the slide
    shift = np.array([1.0, 2.0, 3.0])
    moved = generic_projector(
        position=turn @ light.position + shift,
        direction=turn @ light.direction,
        up=turn @ light.up,
    )
    points = on_image(light, *np.random.default_rng(7).uniform(0, 1, (2, 100)), np.full(100, 2.0))
    there = jnp.asarray(points @ turn.T + shift)
    assert_close(radiance(moved, there), radiance(light, jnp.asarray(points)), ulps=2**10)


def test_its_map_is_drawn_like_any_other():
    drawn = quick(
        lambda matrix: render_shadow_map(FLOOR.positions, FLOOR.faces, matrix, map_size=16)
    )(clip_of(LAMP, FLOOR.positions))
    clip = np.asarray(transform_points(drawn.clip_from_world, jnp.zeros((1, 3))))[0]
    assert_close(drawn.depth, np.full((16, 16), 0.5 * clip[2] / clip[3] + 0.5))
