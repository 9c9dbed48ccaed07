"""The light's pass and the receivers: places, slopes and rates against finite differences."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from shadows import (
    DirectionalLight,
    HardCompare,
    NearestFilter,
    PointLight,
    ShadowMap,
    SpotLight,
    look_up,
    receive,
    render_shadow_map,
    texel_from_clip,
)
from tangentspace import shapes

from .tools import assert_close

SIZE = 64
VIEWPORT = texel_from_clip(SIZE, SIZE)
UP = np.array([0.0, 1.0, 0.0])
AROUND = np.stack(np.meshgrid([-2.0, 2.0], [-1.0, 1.0], [-2.0, 2.0]), axis=-1).reshape(-1, 3)
LIGHTS = {
    "parallel": DirectionalLight(np.array([2.0, 6.0, 3.0]) / 7),
    "spot": SpotLight(
        np.array([1.0, 4.0, 2.0]), np.array([-1.0, -4.0, -2.0]) / np.sqrt(21), outer_angle=0.7
    ),
    "point": PointLight(np.array([-3.0, 3.0, 1.0])),
}

CLIPS = {name: light.clip_from_world(AROUND) for name, light in LIGHTS.items()}
MATRICES = {name: VIEWPORT @ clip for name, clip in CLIPS.items()}

locate = jax.jit(receive)


def unit(vectors):
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def generic_points(count=50):
    """Points and normals, none seen edge-on, on either side of the light."""
    rng = np.random.default_rng(0)
    normals = unit(rng.uniform(-0.6, 0.6, (count, 3)) + UP)
    return rng.uniform(-0.9, 0.9, (count, 3)), normals * rng.choice([-1.0, 1.0], (count, 1))


def located(name, position, normal):
    position = jnp.asarray(position)
    to_light = LIGHTS[name].to_light(position)
    return locate(position, jnp.asarray(normal), to_light, MATRICES[name])


def window(name, position):
    """Column, row and depth by the definition."""
    ones = np.ones((*position.shape[:-1], 1))
    clip = np.concatenate([position, ones], axis=-1) @ np.asarray(MATRICES[name]).T
    return clip[..., :3] / clip[..., 3:]


def difference(name, position, direction, step=1e-5):
    """Change of (column, row, depth) per world length along a direction."""
    ends = [window(name, position + sign * step * direction) for sign in (1, -1)]
    return (ends[0] - ends[1]) / (2 * step)


# Known answers


def box_from_above(dtype, **options):
    """A box at x from 0 to 1, z from -1 to 0, y from -0.5 to 0.5, and the map's matrix.

    The map looks down: columns along x, rows along z, depth 0 at y = 2, 1 at y = -2.
    """
    box = shapes.box((0.5, 0.5, 0.5), dtype=dtype)
    positions = jnp.asarray(box.positions + np.array([0.5, 0.0, -0.5], dtype))
    matrix = jnp.array([[0.5, 0, 0, 0], [0, 0, -0.5, 0], [0, -0.5, 0, 0], [0, 0, 0, 1]], dtype)
    draw = jax.jit(
        lambda positions, matrix: render_shadow_map(
            positions, box.faces, matrix, map_size=8, **options
        )
    )
    return draw(positions, matrix), matrix


def test_shadow_map_of_a_box_seen_from_above(dtype):
    """Depths in [0, 1] with row 0 on top; the nearest wins; 1 where nothing is."""
    shadow_map, matrix = box_from_above(dtype)
    expected = np.ones((8, 8))
    expected[2:4, 4:6] = 0.375
    assert shadow_map.depth.dtype == dtype
    assert_close(shadow_map.depth, expected, ulps=4)
    assert_close(shadow_map.clip_from_world, matrix, ulps=0)


def test_culling_fronts_keeps_the_far_side():
    shadow_map, _ = box_from_above(np.float64, casters="back")
    expected = np.ones((8, 8))
    expected[2:4, 4:6] = 0.625
    assert_close(shadow_map.depth, expected, ulps=4)


def test_place_and_depth_follow_the_conventions():
    """Column 0 is left, row 0 on top, centres at half integers, window depth in [0, 1]."""
    clip = np.diag([1.0, 1.0, 1.0, 1.0])
    corners = np.array([[-1.0, 1, -1], [1, 1, 0], [1, -1, 1], [1 / SIZE - 1, 1 - 1 / SIZE, 0.5]])
    toward = np.broadcast_to([0.0, 0.0, -1.0], corners.shape)
    receiver = locate(*(jnp.asarray(a) for a in (corners, -toward, toward, VIEWPORT @ clip)))
    assert_close(receiver.column, np.array([0.0, SIZE, SIZE, 0.5]))
    assert_close(receiver.row, np.array([0.0, 0.0, SIZE, 0.5]))
    assert_close(receiver.depth, np.array([0.0, 0.5, 1.0, 0.75]))
    assert not receiver.outside.any()


def test_beyond_the_depths_of_the_map_is_outside():
    points = jnp.array([[0.0, 0.0, -1.001], [0.0, 0.0, 1.001], [9.0, 9.0, 0.0]])
    receiver = locate(points, points, points, jnp.asarray(VIEWPORT))
    assert_close(receiver.outside, np.array([True, True, False]))


@pytest.mark.parametrize("name", LIGHTS)
def test_place_is_the_projection(name):
    position, normal = generic_points()
    receiver = located(name, position, normal)
    expected = window(name, position)
    for k, value in enumerate((receiver.column, receiver.row, receiver.depth)):
        assert_close(value, expected[:, k])
    assert float(jnp.abs(receiver.depth_bias).max()) < 1e-12  # rounding at most
    assert not receiver.outside.any()


def test_texel_length_on_the_axis():
    """2 d tan(half angle) / size under a spot; the side over the size under parallel light."""
    spot = LIGHTS["spot"]
    distance = np.array([2.0, 3.0, 4.5])
    positions = spot.position + distance[:, None] * spot.direction
    receiver = located("spot", positions, np.tile(UP, (3, 1)))
    focal = np.linalg.norm(CLIPS["spot"][0, :3])
    assert_close(receiver.texel_length, 2 * distance / focal / SIZE)
    position, normal = generic_points()
    matrix = jnp.diag(jnp.array([1 / 3, 1 / 3, -0.1, 1.0]))
    toward = jnp.broadcast_to(jnp.array([0.0, 0.0, 1.0]), position.shape)
    receiver = locate(jnp.asarray(position), jnp.asarray(normal), toward, VIEWPORT @ matrix)
    assert_close(receiver.texel_length, np.full(len(position), 6 / SIZE))
    assert_close(receiver.depth_rate, np.full(len(position), 0.05))


# Laws: every rate against central differences of the projection


@pytest.mark.parametrize("name", LIGHTS)
def test_depth_gradient_along_the_plane(name):
    position, normal = generic_points()
    receiver = located(name, position, normal)
    across = unit(np.cross(normal, [0.3, 0.1, 0.9]))
    steps = [difference(name, position, d) for d in (across, np.cross(normal, across))]
    jacobian = np.stack(steps, axis=-2)  # (points, 2 directions, 3 window axes)
    expected = np.linalg.solve(jacobian[..., :2], jacobian[..., 2:])[..., 0]
    actual = np.stack([receiver.depth_per_column, receiver.depth_per_row], axis=-1)
    np.testing.assert_allclose(actual, expected, rtol=1e-7, atol=1e-9)  # measured
    assert_close(receiver.footprint, 0.5 * np.abs(actual).sum(axis=-1))


@pytest.mark.parametrize("name", LIGHTS)
def test_rates_along_the_ray(name):
    position, normal = generic_points()
    light = LIGHTS[name]
    receiver = located(name, position, normal)
    along = difference(name, position, np.asarray(receiver.to_light))
    np.testing.assert_allclose(along[:, :2], 0, atol=1e-8)  # the ray stays in its texel
    np.testing.assert_allclose(receiver.depth_rate, -along[:, 2], rtol=1e-7)
    if name == "parallel":
        assert_close(receiver.nearness, np.zeros(len(position)))
    else:
        distance = np.linalg.norm(position - light.position, axis=-1)
        assert_close(receiver.nearness, 1 / distance)


@pytest.mark.parametrize("name", LIGHTS)
def test_texel_length_lies_between_both_sides(name):
    """A length per column and per row, each along its steepest direction."""
    position, normal = generic_points()
    axes = [np.broadcast_to(axis, position.shape) for axis in np.eye(3)]
    density = np.stack([difference(name, position, axis) for axis in axes], axis=-1)
    sides = 1 / np.linalg.norm(density[:, :2], axis=-1)
    texel_length = np.asarray(located(name, position, normal).texel_length)
    assert (texel_length > (1 - 1e-7) * sides.min(axis=-1)).all()
    assert (texel_length < (1 + 1e-7) * sides.max(axis=-1)).all()


@pytest.mark.parametrize("name", LIGHTS)
def test_toward_light_is_the_moved_point_projected(name):
    position, normal = generic_points()
    receiver = located(name, position, normal)
    for length in (0.3, -0.2):
        moved = position + length * np.asarray(receiver.to_light)
        biased = receiver.toward_light(length)
        assert_close(biased.depth - biased.depth_bias, window(name, moved)[:, 2], ulps=512)
        assert_close(biased.column, receiver.column, ulps=0)


def test_beyond_the_light_is_lit():
    """Nothing is left to block there, not even a map whose every texel is at the near plane."""
    position, normal = generic_points()
    light = LIGHTS["point"]
    blocked = ShadowMap(jnp.zeros((SIZE, SIZE)), jnp.asarray(CLIPS["point"]))
    look = jax.jit(
        lambda length: look_up(
            blocked,
            located("point", position, normal).toward_light(length),
            filter=NearestFilter(),
            compare=HardCompare(),
        )
    )
    distance = np.linalg.norm(position - light.position, axis=-1)
    assert float(jnp.max(look(0.1))) == 0
    assert float(jnp.min(look(1.0001 * distance.max()))) == 1
    assert float(jnp.min(look(50.0))) == 1


@pytest.mark.parametrize("name", LIGHTS)
def test_along_normal_moves_to_the_lights_side(name):
    position, normal = generic_points()
    length = jnp.linspace(0.1, 0.4, len(position))
    receiver = located(name, position, normal).less_depth(jnp.asarray(0.01))
    side = np.sign(np.sum(normal * np.asarray(receiver.to_light), axis=-1))
    assert {-1.0, 1.0} == set(side)
    moved = jax.jit(lambda receiver, length: receiver.along_normal(length))(receiver, length)
    expected = window(name, position + (side * length)[:, None] * normal)
    for k, value in enumerate((moved.column, moved.row, moved.depth)):
        assert_close(value, expected[:, k])
    assert_close(moved.depth_bias, np.full(len(position), 0.01), ulps=2**12)


@pytest.mark.parametrize("name", LIGHTS)
def test_single_precision_keeps_the_slopes(name):
    """Users live there: slopes and rates agree with double precision."""
    position, normal = generic_points()
    wide = located(name, position, normal)
    narrow = locate(
        *(
            jnp.asarray(a, jnp.float32)
            for a in (position, normal, wide.to_light, wide.texel_from_world)
        )
    )
    scale = np.max(np.asarray(wide.footprint))
    for field in ("depth_per_column", "depth_per_row"):
        error = np.abs(getattr(narrow, field) - getattr(wide, field)).max() / scale
        assert error < 1e-4
    for field in ("depth_rate", "texel_length"):
        np.testing.assert_allclose(getattr(narrow, field), getattr(wide, field), rtol=1e-4)


# Derivatives


@pytest.mark.parametrize("name", LIGHTS)
def test_derivatives_of_a_receiver(name):
    """In position, normal and the light's place or direction; forward, reverse, differences."""
    position, normal = generic_points(4)
    light = LIGHTS[name]
    field = "direction" if name == "parallel" else "position"

    def outputs(position, normal, of_light):
        moved = eqx.tree_at(lambda light: getattr(light, field), light, of_light)
        receiver = receive(position, normal, moved.to_light(position), MATRICES[name])
        rates = receiver.depth_rate, receiver.nearness, receiver.texel_length
        slopes = receiver.depth_per_column, receiver.depth_per_row
        return jnp.stack([receiver.column / SIZE, receiver.depth, *rates, *slopes])

    arguments = jnp.asarray(position), jnp.asarray(normal), jnp.asarray(getattr(light, field))
    check_jacobian(outputs, arguments)


def check_jacobian(function, arguments, rtol=1e-6):
    """Compare whole Jacobians: forward and reverse mode, and central differences."""
    every = tuple(range(len(arguments)))
    forward = jax.jit(jax.jacfwd(function, every))(*arguments)
    reverse = jax.jit(jax.jacrev(function, every))(*arguments)
    plain = jax.jit(function)
    for k, argument in enumerate(arguments):
        assert_close(reverse[k], forward[k], ulps=2**16)
        columns = []
        for index in np.ndindex(argument.shape):
            step = 1e-6
            ends = [
                plain(*arguments[:k], argument.at[index].add(sign * step), *arguments[k + 1 :])
                for sign in (1, -1)
            ]
            columns.append((ends[0] - ends[1]) / (2 * step))
        numerical = np.stack(columns, axis=-1).reshape(forward[k].shape)
        scale = np.abs(numerical).max()
        assert scale > 0
        np.testing.assert_allclose(forward[k], numerical, rtol=rtol, atol=rtol * scale)


def test_slope_has_its_derivative_where_the_plane_faces_the_light():
    """There the slope is 0, but tilting the plane or the light changes it at once."""
    point, towards = jnp.zeros(3), jnp.array([0.0, 0.0, 1.0])
    matrix = VIEWPORT @ jnp.diag(jnp.array([1.0, 1.0, -0.1, 1.0]))
    slope = lambda normal: receive(point, normal, towards, matrix).depth_per_column
    expected = (slope(towards.at[0].set(1e-6)) - slope(towards.at[0].set(-1e-6))) / 2e-6
    assert abs(expected) > 1e-3
    assert float(jax.grad(slope)(towards)[0]) == pytest.approx(float(expected), rel=1e-6)


DEGENERATE = {
    "zero normal": (np.zeros(3), np.zeros(3)),
    "edge-on": (np.array([0.5, 0.0, 0.2]), None),
    "at the light": (None, UP),
    "at the light, zero normal": (None, np.zeros(3)),
    "behind the light": ("behind", UP),
    "in the light's plane": ("beside", UP),
    "facing": (np.zeros(3), "facing"),
}


def every_field(position, normal, light, matrix):
    """All fields with one row per point, before and after every way to move."""
    receiver = receive(position, normal, light.to_light(position), matrix)
    moved = receiver.along_normal(receiver.texel_length).toward_light(0.1)
    same = lambda x: x.dtype == position.dtype and x.shape[:1] == position.shape[:1]
    return [x for x in jax.tree.leaves((receiver, moved)) if same(x)]


@jax.jit
def fields_and_derivatives(position, normal, light, matrix):
    fields, pullback = jax.vjp(lambda *a: every_field(*a, light, matrix), position, normal)
    return fields, pullback([jnp.ones_like(x) for x in fields])


@pytest.mark.parametrize("case", DEGENERATE)
@pytest.mark.parametrize("name", ["parallel", "spot"])
def test_finite_with_finite_derivatives(name, case):
    """One bad row among good ones: everything finite, the good rows as without it."""
    good = generic_points(7)
    rows = [jnp.asarray(x) for x in good]
    bad = [x.at[0].set(row) for x, row in zip(rows, degenerate(LIGHTS[name], case), strict=True)]
    light = jax.tree.map(jnp.asarray, LIGHTS[name])
    with_it = jax.tree.leaves(fields_and_derivatives(*bad, light, MATRICES[name]))
    without = jax.tree.leaves(fields_and_derivatives(*rows, light, MATRICES[name]))
    for value, expected in zip(with_it, without, strict=True):
        assert bool(jnp.isfinite(value).all())
        assert_close(value[1:], expected[1:])


def degenerate(light, case):
    position, normal = DEGENERATE[case]
    spot = isinstance(light, SpotLight)
    at_light = light.position if spot else np.array([0.4, 0.5, 0.1])
    if position is None:
        position = at_light
    elif isinstance(position, str):
        offset = np.cross(UP, LIGHTS["spot"].direction) if position == "beside" else UP
        position = at_light + offset
    to_light = np.asarray(light.to_light(jnp.asarray(position)))
    if normal is None:
        normal = unit(np.cross(to_light, UP))
    elif isinstance(normal, str):
        normal = to_light
    return jnp.asarray(position), jnp.asarray(normal)


def test_zero_normal_has_no_slope():
    receiver = located("spot", np.zeros((1, 3)), np.zeros((1, 3)))
    assert_close(receiver.footprint, np.zeros(1), ulps=0)


def test_slopes_are_followed_up_to_a_limit():
    """Edge-on the slope stays that of 100 texels of length per texel, in its own direction."""
    towards = jnp.array([[0.0, 0.0, 1.0]])
    matrix = VIEWPORT @ jnp.diag(jnp.array([1.0, 1.0, -0.1, 1.0]))
    texel_depth = 2 / SIZE * 0.05
    for degrees, tangent in ((80.0, np.tan(np.deg2rad(80.0))), (89.9, 100.0), (90.0, 100.0)):
        angle = np.deg2rad(degrees)
        normal = jnp.array([[0.6 * np.sin(angle), 0.8 * np.sin(angle), np.cos(angle)]])
        receiver = locate(jnp.zeros((1, 3)), normal, towards, matrix)
        slopes = jnp.stack([receiver.depth_per_column, receiver.depth_per_row], axis=-1)
        expected = tangent * texel_depth * np.array([[0.6, -0.8]])
        if degrees == 90.0:  # deeper and less deep are the same there
            slopes, expected = jnp.abs(slopes), np.abs(expected)
        np.testing.assert_allclose(slopes, expected, rtol=1e-6)
