"""Lights: where they are, what arrives, and maps that cover what is lit."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from shadows import DirectionalLight, PointLight, SpotLight, transform_points

from .tools import assert_close

DOWN = np.array([0.0, -1.0, 0.0])
COLOR = np.array([0.9, 0.6, 0.3])

radiance = jax.jit(lambda light, positions: light.radiance(positions))
clip_of = jax.jit(lambda light, points: light.clip_from_world(points))


def unit(vector):
    return np.array(vector) / np.linalg.norm(vector)


def cloud(seed=0, count=60):
    return np.random.default_rng(seed).uniform(-1, 1, (count, 3)) * [2.0, 0.7, 1.3]


def project(light, points):
    """NDC and w of points in the light's map."""
    clip = np.asarray(transform_points(clip_of(light, points), jnp.asarray(points)))
    return clip[:, :3] / clip[:, 3:], clip[:, 3]


def spot(**changes):
    fields = {"position": np.array([0.0, 4.0, 0.0]), "direction": DOWN, "color": COLOR}
    return SpotLight(**(fields | {"inner_angle": 0.3, "outer_angle": 0.6} | changes))


def below(angle, distance=3.0):
    """The point that a light at (0, 4, 0) sees at an angle from straight down."""
    offset = distance * np.array([np.sin(angle), -np.cos(angle), 0.0])
    return jnp.asarray(np.array([0.0, 4.0, 0.0]) + offset)


# Known answers: light that arrives


@pytest.mark.parametrize(
    ("angle", "share"),
    [(0.0, 1.0), (0.29, 1.0), (0.61, 0.0), (1.5, 0.0), (2.0, 0.0), (np.pi, 0.0)],
)
def test_spot_in_and_out_of_the_cone(angle, share):
    assert_close(radiance(spot(), below(angle)), share * COLOR)
    assert_close(radiance(spot(), below(angle, 30.0)), share * COLOR)  # no fall-off


@pytest.mark.parametrize("part", [0.25, 0.5, 0.9])
def test_spot_fades_between_its_angles(part):
    """As KHR_lights_punctual: the square of the share, linear in the cosine."""
    cosine = np.cos(0.6) + part * (np.cos(0.3) - np.cos(0.6))
    assert_close(radiance(spot(), below(np.arccos(cosine))), part**2 * COLOR)


def test_spot_with_equal_angles_is_a_hard_cone():
    light = spot(inner_angle=0.5, outer_angle=0.5)
    assert_close(radiance(light, below(0.49)), COLOR)
    assert_close(radiance(light, below(0.51)), np.zeros(3), ulps=0)


def test_spot_defaults():
    light = SpotLight(np.array([0.0, 4.0, 0.0]), DOWN)
    assert_close(radiance(light, below(0.0)), np.ones(3))
    assert_close(radiance(light, below(np.pi / 4 + 1e-6)), np.zeros(3), ulps=0)


def test_directional_and_point_lights_reach_everything():
    for light in (DirectionalLight(-DOWN, COLOR), PointLight(np.zeros(3), COLOR)):
        arrives = radiance(light, jnp.asarray(cloud()))
        assert_close(arrives, np.broadcast_to(COLOR, (60, 3)), ulps=0)


def test_to_light():
    position = np.array([3.0, 1.0, 2.0])
    points = jnp.asarray(cloud())
    expected = (position - cloud()) / np.linalg.norm(position - cloud(), axis=1, keepdims=True)
    for light in (SpotLight(position, DOWN), PointLight(position)):
        assert_close(light.to_light(points), expected)
    direction = unit([1.0, 2.0, 3.0])
    sun = DirectionalLight(direction).to_light(points)
    assert_close(sun, np.broadcast_to(direction, (60, 3)), ulps=0)


# Laws: what the map covers

DIRECTIONS = {
    "generic": unit([0.3, 0.8, -0.4]),
    "straight above": -DOWN,
    "straight below": DOWN,
    "almost above": unit([1e-6, 1.0, 0.0]),
    "level": unit([1.0, 0.0, 0.0]),
}
SHAPES = {
    "cloud": cloud(),
    "flat": cloud() * [1.0, 0.0, 1.0],
    "tilted plane": cloud() @ np.array([[1.0, 0.5, 0], [0, 0, 0], [0, 0.2, 1]]),
    "line": cloud() * [1.0, 0.0, 0.0],
}


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("name", DIRECTIONS)
def test_directional_map_covers_all_points_and_little_more(name, shape):
    light = DirectionalLight(DIRECTIONS[name])
    ndc, w = project(light, SHAPES[shape])
    assert_close(w, np.ones(60))
    assert np.abs(ndc).max() < 1
    extent = ndc.max(axis=0) - ndc.min(axis=0)
    assert extent.max() == pytest.approx(2 / 1.01, rel=1e-6)
    filled = extent > 1e-3  # sides that are not flat are filled, too
    assert filled.any()
    assert (extent[filled & (extent > 0.5)] > 1.9).all()


@pytest.mark.parametrize("name", DIRECTIONS)
def test_directional_depth_grows_away_from_the_light(name):
    matrix = np.asarray(clip_of(DirectionalLight(DIRECTIONS[name]), cloud()))
    direction = DIRECTIONS[name]
    assert matrix[2, :3] @ direction < 0
    across = matrix[2, :3] - (matrix[2, :3] @ direction) * direction
    assert_close(across, np.zeros(3))
    assert np.linalg.det(matrix[:3, :3]) < 0  # right-handed world, NDC with depth inwards


def near_and_far(matrix):
    """Of a perspective matrix with rigid view: distances along the axis."""
    axis = np.linalg.norm(matrix[3, :3])
    assert axis == pytest.approx(1, rel=1e-12)
    slope = matrix[2, :3] @ matrix[3, :3]
    offset = matrix[2, 3] - slope * matrix[3, 3]
    return offset / (-1 - slope), offset / (1 - slope)


PLACES = {
    "above": ([0.0, 4.0, 0.0], [0.0, -1.0, 0.0]),
    "aside": ([3.0, 3.0, -2.0], [-0.6, -0.7, 0.4]),
    "far": ([300.0, 300.0, -200.0], [-0.6, -0.6, 0.4]),
    "among": ([0.1, 0.2, 0.3], [-0.6, -0.7, 0.4]),
    "on a vertex": (cloud()[0], [-0.6, -0.7, 0.4]),
}


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("angle", [0.2, 0.7, 1.5])
def test_spot_map_covers_what_the_cone_lights(angle, shape, place):
    position, direction = PLACES[place]
    light = SpotLight(np.array(position), unit(direction), outer_angle=angle)
    matrix = np.asarray(clip_of(light, SHAPES[shape]))
    assert np.isfinite(matrix).all()
    near, far = near_and_far(matrix)
    assert 0 < near < far
    lit = np.asarray(radiance(light, jnp.asarray(SHAPES[shape])))[:, 0] > 0
    clip = np.concatenate([SHAPES[shape], np.ones((60, 1))], axis=1)[lit] @ matrix.T
    clip = clip[clip[:, 3] > 1.001 * near]  # a thousandth of the depth is given up
    assert np.abs(clip[:, :3] / clip[:, 3:]).max(initial=0) < 1


@pytest.mark.parametrize("place", ["above", "aside", "far"])
@pytest.mark.parametrize("shape", SHAPES)
def test_point_map_covers_all_points_seen_from_outside(shape, place):
    light = PointLight(np.array(PLACES[place][0]))
    ndc, w = project(light, SHAPES[shape])
    near, far = near_and_far(np.asarray(clip_of(light, SHAPES[shape])))
    assert 0 < near < far
    assert near <= w.min() * 0.991
    assert far >= w.max() * 1.009
    assert np.abs(ndc).max() < 1


def test_narrow_scene_gets_a_narrow_map():
    """The texels go where the points are, not to the rest of the cone."""
    points = 0.1 * cloud()
    ndc, _ = project(SpotLight(np.array([0.0, 4.0, 0.0]), DOWN, outer_angle=1.0), points)
    assert np.abs(ndc[:, :2]).max() == pytest.approx(1 / 1.01, rel=1e-6)


@pytest.mark.parametrize("height", [4.0, 0.0])
def test_map_of_a_floor_that_a_spot_does_not_see_is_finite(height):
    """A spot over the floor, or let into it, that shines up: an animation may pass there."""
    light = jax.tree.map(jnp.asarray, SpotLight(np.array([0.0, height, 0.0]), -DOWN))
    points = jnp.asarray(SHAPES["flat"])
    assert bool(jnp.isfinite(clip_of(light, points)).all())
    matrix = lambda light, points: light.clip_from_world(points)
    derivatives = jax.jit(jax.jacrev(matrix, argnums=(0, 1)))(light, points)
    assert all(bool(jnp.isfinite(leaf).all()) for leaf in jax.tree.leaves(derivatives))


# Derivatives


@pytest.mark.parametrize("angle", [0.1, 0.45, 0.7])
def test_radiance_has_its_derivative(angle):
    """Zero in the full light and in the dark; in between the closed form."""
    inner, outer = 0.3, 0.6
    of = lambda angle: spot().radiance(jnp.stack([jnp.sin(angle), 4 - jnp.cos(angle), 0 * angle]))[
        0
    ]
    width = np.cos(inner) - np.cos(outer)
    part = (np.cos(angle) - np.cos(outer)) / width
    expected = -2 * part * np.sin(angle) / width * COLOR[0] if inner < angle < outer else 0.0
    assert float(jax.jit(jax.grad(of))(angle)) == pytest.approx(expected, abs=1e-12)


def test_derivatives_at_the_light_itself_are_finite():
    for light in (spot(), PointLight(np.array([0.0, 4.0, 0.0]))):
        at_light = jnp.array([[0.0, 4.0, 0.0], [0.1, 1.0, 0.2]])
        of = lambda p, light=light: jnp.sum(light.to_light(p) + light.radiance(p))
        assert bool(jnp.isfinite(jax.jit(jax.grad(of))(at_light)).all())
        assert_close(light.to_light(at_light)[0], np.zeros(3), ulps=0)


# Transformations


def test_lights_are_pytrees_whose_numbers_can_be_mapped_over():
    positions = jnp.stack([below(0.0) + jnp.array([x, 3.0, 0.0]) for x in (0.0, 0.5, 1.0)])
    of = lambda position: SpotLight(position, DOWN, 0.1, 0.4).radiance(below(0.0)[None])[0]
    assert_close(jax.vmap(of)(positions), jnp.stack([of(p) for p in positions]))


SOME = [spot(), DirectionalLight(unit([1.0, 2, 3])), PointLight(2 * COLOR)]


@pytest.mark.parametrize("light", SOME, ids=lambda light: type(light).__name__)
def test_moving_the_world_moves_what_is_lit(light):
    """Radiance and the direction to the light turn with the scene."""
    turn = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
    shift = np.array([1.0, 2.0, 3.0])
    fields = {"color": light.color}
    if hasattr(light, "position"):
        fields["position"] = turn @ light.position + shift
    if hasattr(light, "direction"):
        fields["direction"] = turn @ light.direction
    if isinstance(light, SpotLight):
        fields |= {"inner_angle": light.inner_angle, "outer_angle": light.outer_angle}
    moved, points = type(light)(**fields), cloud()
    there = jnp.asarray(points @ turn.T + shift)
    assert_close(radiance(moved, there), radiance(light, jnp.asarray(points)), ulps=256)
    assert_close(moved.to_light(there), light.to_light(jnp.asarray(points)) @ turn.T)
