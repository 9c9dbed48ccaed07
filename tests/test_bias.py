"""Biases: the least that removes acne, the shadow that each takes away, units, derivatives.

On a plane whose depth gains (a, b) per texel, a receiver lies up to half a texel from the
centre whose depth was stored, under 2x2 lookup up to a whole one: the least bias without
acne is ``(|a| + |b|) / 2`` and ``|a| + |b|``. Every bound here is found by bisection over
maps that were rasterized, with receivers down to 1e-4 texel from the worst place.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from shadows import (
    BilinearFilter,
    CombinedBias,
    ConstantBias,
    DirectionalLight,
    HardCompare,
    NearestFilter,
    NormalOffsetBias,
    PointLight,
    SlopeBias,
    SpotLight,
    look_at,
    look_up,
    orthographic,
    receive,
    render_shadow_map,
    texel_from_clip,
)
from tangentspace import shapes

from .tools import assert_close

SIZE = 1024
REACH = {"nearest": (NearestFilter(), 0.5), "bilinear": (BilinearFilter(), 1.0)}
SPOT = SpotLight(
    np.array([1.0, 3.0, 0.5]), np.array([-0.24, -0.96, 0.16]) / np.sqrt(1.0048), outer_angle=0.5
)
VIEWPORT = texel_from_clip(SIZE, SIZE)

draw = jax.jit(
    lambda positions, faces, matrix: render_shadow_map(positions, faces, matrix, map_size=SIZE)
)
locate = jax.jit(receive)


move = jax.jit(lambda receiver, bias: bias(receiver))


@jax.jit
def visibility(shadow_map, receiver, bias, filter):
    return look_up(shadow_map, bias(receiver), filter=filter, compare=HardCompare())


def mesh_map(mesh, matrix):
    """The map of a mesh of at most 14 faces and 28 vertices, so that one shape serves all."""
    positions, faces = np.asarray(mesh.positions), mesh.faces
    positions = np.concatenate([positions, np.zeros((28 - len(positions), 3), positions.dtype)])
    faces = np.concatenate([faces, np.zeros((14 - len(faces), 3), np.int32)])
    return draw(positions, faces, jnp.asarray(matrix, positions.dtype))


def on_plane(matrix, normal, point, texel):
    """The points of a plane that a light sees at the given places of its map."""
    matrix, normal = np.asarray(VIEWPORT @ matrix), np.asarray(normal)
    rows = matrix[:2] - np.asarray(texel)[..., None] * matrix[3]
    plane = np.broadcast_to([*normal, -normal @ point], (*rows.shape[:-2], 1, 4))
    system = np.concatenate([rows, plane], axis=-2)
    return np.linalg.solve(system[..., :3], -system[..., 3:])[..., 0]


def corner_texels(first=(4, 4)):
    """Places in 20x20 texels: the centre, and 1e-4 texel from each corner and centre line."""
    near = np.array([1e-4, 0.25, 0.5 - 1e-4, 0.5, 0.5 + 1e-4, 0.75, 1 - 1e-4])
    line = (np.arange(20)[:, None] + near).ravel()
    return np.stack(np.meshgrid(line + first[0], line + first[1]), axis=-1).reshape(-1, 2)


def random_texels(count=2**16, first=(4, 4)):
    return np.random.default_rng(0).uniform(0, 20, (count, 2)) + first


class PlaneScene:
    """A plane's shadow map, and receivers on the plane."""

    def __init__(self, matrix, normal, point, to_light, texel, dtype=np.float64, margin=4):
        low, high = np.min(texel, axis=0) - margin, np.max(texel, axis=0) + margin
        corners = [low, [high[0], low[1]], high, [low[0], high[1]]]
        quad = on_plane(matrix, normal, point, np.array(corners)).astype(dtype)
        faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
        self.map = mesh_map(shapes.Mesh(quad, quad, faces), matrix)
        positions = on_plane(matrix, normal, point, texel)
        normals = np.broadcast_to(normal, positions.shape)
        arrays = (positions, normals, to_light(jnp.asarray(positions)), VIEWPORT @ matrix)
        self.receiver = locate(*(jnp.asarray(a, dtype) for a in arrays))

    def visibility(self, bias, filter):
        return visibility(self.map, self.receiver, bias, filter)

    def least(self, kind, filter):
        """The least bias without acne, by bisection between 0 and 4."""
        low, high = 0.0, 4.0
        for _ in range(26):
            middle = 0.5 * (low + high)
            lit = bool(jnp.min(self.visibility(kind(middle), filter)) >= 1 - 1e-10)
            low, high = (low, middle) if lit else (middle, high)
        return high


def tilted_plane(gradient, texel, *, width=0.25, stretch=1.0, turn=0.0, dtype=np.float64):
    """A plane under parallel light whose depth gains ``gradient`` texel widths per texel.

    The map is turned about the light's axis by ``turn``, and its columns are made wider by
    ``stretch``; the plane stays where it was.
    """
    target, to_light = np.array([0.3, -0.2, 0.7]), np.array([2.0, 3.0, 6.0]) / 7
    view = np.asarray(look_at(target + to_light, target, np.array([0.0, 1.0, 0.0])))
    column, up, to_light = view[:3, :3]
    normal = to_light + gradient[0] * column - gradient[1] * up
    cos, sin = np.cos(turn), np.sin(turn)
    turned = np.array([[cos, -sin, 0, 0], [sin, cos, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]) @ view
    near_side, far_side = -14 * width, (SIZE - 14) * width  # the target is at texel (14, 14)
    sides = stretch * near_side, stretch * far_side, -far_side, -near_side
    matrix = orthographic(*sides, -30.0, 30.0) @ turned
    return PlaneScene(
        np.asarray(matrix),
        normal / np.linalg.norm(normal),
        target,
        lambda positions: np.broadcast_to(to_light, positions.shape),
        texel,
        dtype,
    )


def turned_sum(gradient, turn):
    """|a| + |b| of a gradient seen in a map turned by an angle."""
    a, b = gradient
    cos, sin = np.cos(turn), np.sin(turn)
    return abs(a * cos + b * sin) + abs(b * cos - a * sin)


def tilted(degrees):
    """Unit vector at an angle from +y towards +x."""
    return np.array([np.sin(np.deg2rad(degrees)), np.cos(np.deg2rad(degrees)), 0.0])


def turn_about_y(degrees):
    cos, sin = np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
    return np.array([[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]])


# The bound: (0.3, 0) and so on are known to 3 digits from an independent computation.

GRADIENTS = [(0.3, 0.0), (0.3, 0.2), (1.0, 1.0)]
TURNS = [0.0, 0.3, np.pi / 4, 2.0]


@pytest.mark.parametrize("lookup", REACH)
@pytest.mark.parametrize("gradient", GRADIENTS)
def test_least_constant_bias(gradient, lookup):
    filter, reach = REACH[lookup]
    scene = tilted_plane(gradient, corner_texels())
    bound = 0.25 * reach * (gradient[0] + gradient[1])
    assert scene.least(ConstantBias, filter) == pytest.approx(bound, rel=3e-4)  # 2e-4 off


@pytest.mark.parametrize("lookup", REACH)
@pytest.mark.parametrize("turn", TURNS)
@pytest.mark.parametrize("gradient", GRADIENTS[1:])
def test_least_slope_bias_at_every_turn_of_the_map(gradient, turn, lookup):
    filter, reach = REACH[lookup]
    scene = tilted_plane(gradient, corner_texels(), turn=turn)
    assert scene.least(SlopeBias, filter) == pytest.approx(2 * reach, rel=3e-4)
    bound = 0.25 * reach * turned_sum(gradient, turn)
    assert scene.least(ConstantBias, filter) == pytest.approx(bound, rel=3e-4)


@pytest.mark.parametrize("kind", [ConstantBias, SlopeBias])
def test_bound_in_single_precision(kind):
    scene = tilted_plane((0.3, 0.2), corner_texels(), dtype=np.float32)
    unit = 0.25 * 0.5 * 0.5 if kind is ConstantBias else 1.0
    assert scene.least(kind, NearestFilter()) == pytest.approx(unit, rel=1e-3)


@pytest.mark.parametrize("lookup", REACH)
@pytest.mark.parametrize("tilt", [0.0, 35.0, 70.0])
def test_least_slope_bias_under_a_spot_light(tilt, lookup):
    filter, reach = REACH[lookup]
    texel = corner_texels((SIZE // 2, SIZE // 3))
    around = np.array([[-3.0, -2.0, -3.0], [3.0, 2.0, 3.0]])
    matrix = np.asarray(SPOT.clip_from_world(around))
    scene = PlaneScene(matrix, turn_about_y(50) @ tilted(tilt), np.zeros(3), SPOT.to_light, texel)
    assert scene.least(SlopeBias, filter) == pytest.approx(2 * reach, rel=3e-4)


@pytest.mark.parametrize("lookup", REACH)
@pytest.mark.parametrize("degrees", [15.0, 45.0, 75.0])
@pytest.mark.parametrize("turn", [0.0, -np.pi / 2, 0.4])
def test_least_normal_offset(turn, degrees, lookup):
    """Half a texel where the plane is tilted along a side of the map, more in between."""
    filter, reach = REACH[lookup]
    scene = tilted_plane((np.tan(np.deg2rad(degrees)), 0.0), random_texels(), turn=turn)
    bound = reach * turned_sum((1.0, 0.0), turn)
    rel = 1e-2 if turn == 0.4 else 3e-4  # few receivers lie near a corner; measured 5e-3, 8e-5
    assert scene.least(NormalOffsetBias, filter) == pytest.approx(bound, rel=rel)


@pytest.mark.parametrize("lookup", REACH)
@pytest.mark.parametrize("stretch", [0.25, 4.0])
def test_normal_offset_is_enough_where_texels_are_not_square(stretch, lookup):
    """As in most maps of a directional light, which are fitted to each side of the scene."""
    filter, reach = REACH[lookup]
    scene = tilted_plane((1.0, 0.0), random_texels(), stretch=stretch)
    assert scene.least(NormalOffsetBias, filter) < 1.001 * reach


@pytest.mark.parametrize("gradient", GRADIENTS)
def test_half_of_an_unbiased_plane_is_in_acne(gradient):
    lit = tilted_plane(gradient, random_texels())
    nearest = lit.visibility(CombinedBias(), NearestFilter())
    assert float(jnp.mean(nearest)) == pytest.approx(0.5, abs=0.005)
    bilinear = lit.visibility(CombinedBias(), BilinearFilter())
    assert float(jnp.mean(bilinear >= 0.5)) == pytest.approx(0.5, abs=0.005)


# What a bias takes away: a floor at y = 0, and a box over or on it.

HEIGHT = 12.0


def floor_and_box(low, high, floor=(16.0, 2.0)):
    """A floor around the origin, and the box between two corners."""
    low, high = np.array(low), np.array(high)
    plane, box = shapes.plane(dtype=np.float64), shapes.box(dtype=np.float64)
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    return shapes.merge(
        plane._replace(positions=plane.positions * [floor[0], 1.0, floor[1]]),
        box._replace(positions=box.positions * half + middle),
    )


def on_floor(points, light, matrix):
    points = jnp.asarray(points)
    up = jnp.broadcast_to(jnp.array([0.0, 1.0, 0.0]), points.shape)
    return locate(points, up, light.to_light(points), VIEWPORT @ matrix)


def wall_gap(angle, thickness, length, azimuth=0.0):
    """The lit length behind a wall, and how long a texel is on the floor."""
    turn = turn_about_y(azimuth)
    mesh = floor_and_box([0, 0, -1.0], [thickness, HEIGHT, 1.0])
    mesh = mesh._replace(positions=mesh.positions @ turn.T)
    light = DirectionalLight(turn @ tilted(angle))
    matrix = light.clip_from_world(mesh.positions)
    distance = np.linspace(0, 15, 2**14)[1:]
    receiver = on_floor(-distance[:, None] * (turn @ tilted(90.0)), light, matrix)
    lit = visibility(mesh_map(mesh, matrix), receiver, ConstantBias(length), NearestFilter()) > 0.5
    rows = receiver.row[:2]
    return distance[np.argmin(lit)], (distance[1] - distance[0]) / abs(rows[1] - rows[0])


# In a published table of an engine the shadow behind a thin caster began, at 52 degrees, after
# 1.6, 3.2, 5.3 and 10.4 for these biases; b sin(52 degrees) is 1.59, 3.25, 5.29 and 10.47.
@pytest.mark.parametrize(
    ("angle", "thickness", "length", "azimuth"),
    [
        (52.0, 0.0, 2.02, 0.0),
        (52.0, 0.0, 4.12, 0.0),
        (52.0, 0.0, 6.71, 0.0),
        (52.0, 0.0, 13.29, 0.0),
        (52.0, 1.0, 4.12, 0.0),
        (52.0, 1.0, 4.12, 65.0),
        (30.0, 0.5, 3.0, 190.0),
        (65.0, 1.5, 4.0, 0.0),
        (52.0, 1.0, 1.2, 0.0),  # b sin t < W: nothing is lost
        (30.0, 0.5, 0.9, 65.0),
    ],
)
def test_peter_panning_law(angle, thickness, length, azimuth):
    gap, texel = wall_gap(angle, thickness, length, azimuth)
    law = max(0.0, length * np.sin(np.deg2rad(angle)) - thickness)
    assert abs(gap - law) < 2 * texel  # measured 0.35


@pytest.mark.parametrize("angle", [0.0, 40.0, 70.0])
def test_plate_loses_its_whole_shadow_beyond_its_height(angle):
    height, half_width = 1.5, 1.0
    mesh = floor_and_box([-1, height, -1], [1, height, 1], floor=(6.0, 2.0))
    light = DirectionalLight(tilted(angle))
    matrix = light.clip_from_world(mesh.positions)
    shift = -height * np.tan(np.deg2rad(angle))
    x, z = np.meshgrid(*2 * (np.linspace(-0.95, 0.95, 50) * half_width,))
    points = np.stack([x + shift, np.zeros_like(x), z], axis=-1).reshape(-1, 3)
    receiver = on_floor(points, light, matrix)
    plate = mesh_map(mesh, matrix)
    law = height / np.cos(np.deg2rad(angle))
    below, above = (
        visibility(plate, receiver, ConstantBias(share * law), NearestFilter())
        for share in (0.99, 1.01)
    )
    assert float(jnp.max(below)) == 0
    assert float(jnp.min(above)) == 1


def test_world_length_is_exact_under_a_point_light():
    """A plate at a fifth of the light's height takes a fifth of the ray."""
    light = PointLight(np.array([0.3, 5.0, 0.2]))
    mesh = floor_and_box([-1, 1, -1], [1, 1, 1], floor=(3.0, 3.0))
    matrix = light.clip_from_world(mesh.positions)
    angle = np.linspace(0, 2 * np.pi, 100)
    circle = np.stack([np.cos(angle), 0 * angle, np.sin(angle)], axis=-1) * 0.6 + [0.3, 0, 0.2]
    receiver, plate = on_floor(circle, light, matrix), mesh_map(mesh, matrix)
    law = np.hypot(0.6, 5.0) / 5
    below, above = (
        visibility(plate, receiver, ConstantBias(share * law), NearestFilter())
        for share in (0.999, 1.001)
    )
    assert float(jnp.max(below)) == 0
    assert float(jnp.min(above)) == 1


# Laws


def wall_scene(change=np.eye(4)):
    """A coarse look at a wall on a floor, moved by a similarity: map, receivers, visibility."""
    mesh = floor_and_box([0, 0, -1.0], [1.0, 2.0, 1.0], floor=(4.0, 2.0))
    light = DirectionalLight(turn_about_y(25) @ tilted(50))
    x, z = np.meshgrid(np.linspace(-3.9, -0.01, 90), np.linspace(-1.9, 1.9, 90))
    points = np.stack([x, 0 * x, z], axis=-1).reshape(-1, 3)
    turn = change[:3, :3] / np.cbrt(np.linalg.det(change[:3, :3]))
    moved = lambda points: points @ change[:3, :3].T + change[:3, 3]
    matrix = np.asarray(light.clip_from_world(mesh.positions)) @ np.linalg.inv(change)
    normals = np.broadcast_to(turn[:, 1], points.shape)
    to_light = np.broadcast_to(turn @ light.direction, points.shape)
    arrays = (moved(points), normals, to_light, VIEWPORT @ matrix)
    receiver = locate(*(jnp.asarray(a) for a in arrays))
    return mesh_map(mesh._replace(positions=moved(mesh.positions)), matrix), receiver


def similarity(scale):
    turn = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
    change = np.eye(4)
    change[:3, :3] = scale * turn * np.sign(np.linalg.det(turn))
    change[:3, 3] = [5.0, -2.0, 1.0]
    return change


BIASES = {
    "constant": lambda scale: ConstantBias(0.31 * scale),
    "slope": lambda scale: SlopeBias(0.9),
    "normal offset": lambda scale: NormalOffsetBias(0.43),
    "combined": lambda scale: CombinedBias(
        (ConstantBias(0.11 * scale), SlopeBias(0.3), NormalOffsetBias(0.2))
    ),
}


@pytest.mark.parametrize("scale", [1.0, 7.0])
@pytest.mark.parametrize("name", BIASES)
def test_bias_means_the_same_in_a_moved_and_scaled_world(name, scale):
    filter = NearestFilter()
    before = visibility(*wall_scene(), BIASES[name](1.0), filter)
    after = visibility(*wall_scene(similarity(scale)), BIASES[name](scale), filter)
    assert 0.2 < float(jnp.mean(before)) < 0.9
    assert float(jnp.mean(jnp.abs(before - after))) < 1e-3  # rounding at ties; measured 2.5e-4


@pytest.mark.parametrize("lookup", REACH)
@pytest.mark.parametrize("kind", [ConstantBias, SlopeBias])
def test_more_bias_never_darkens(kind, lookup):
    shadow_map, receiver = wall_scene()
    each = jax.jit(
        jax.vmap(lambda value: visibility(shadow_map, receiver, kind(value), REACH[lookup][0]))
    )
    steps = jnp.diff(each(jnp.linspace(-0.5, 3.0, 20)), axis=0)
    assert float(jnp.min(steps)) >= -1e-15
    assert float(jnp.max(steps)) > 0.5


@pytest.mark.parametrize("kind", [ConstantBias, SlopeBias, NormalOffsetBias])
def test_vmap_over_biases_is_a_loop(kind):
    shadow_map, receiver = wall_scene()
    values = jnp.array([0.0, 0.2, 1.0, 2.5])
    of = lambda value: visibility(shadow_map, receiver, kind(value), BilinearFilter())
    assert_close(jax.vmap(of)(values), jnp.stack([of(value) for value in values]))


@pytest.mark.parametrize("kind", [ConstantBias, SlopeBias, NormalOffsetBias])
def test_zero_is_no_bias(kind):
    shadow_map, receiver = wall_scene()
    without = visibility(shadow_map, receiver, CombinedBias(), BilinearFilter())
    assert_close(visibility(shadow_map, receiver, kind(0.0), BilinearFilter()), without, ulps=4)


def test_combined_adds_up():
    _, receiver = wall_scene()
    terms = ConstantBias(0.2), SlopeBias(1.5)
    parts = sum(move(receiver, term).depth_bias for term in terms)
    assert_close(move(receiver, CombinedBias(terms)).depth_bias, parts)
    assert_close(move(receiver, CombinedBias(terms[::-1])).depth_bias, parts)


def test_only_normal_offset_moves_to_other_texels():
    _, receiver = wall_scene()
    for bias in (ConstantBias(0.3), SlopeBias(2.0), NormalOffsetBias(1.0)):
        moved = move(receiver, bias)
        same = bool(jnp.all((moved.column == receiver.column) & (moved.row == receiver.row)))
        assert same is not bias.reads_anew
    assert CombinedBias((SlopeBias(), NormalOffsetBias())).reads_anew
    assert not CombinedBias((SlopeBias(), ConstantBias())).reads_anew


def test_normal_offset_vanishes_where_the_light_is_overhead():
    """And its derivative is finite there, and zero."""
    up = jnp.array([0.0, 1.0, 0.0])
    matrix = VIEWPORT @ DirectionalLight(up).clip_from_world(np.eye(3))

    @jax.jit
    def depth(texels, normal):
        receiver = receive(jnp.ones((1, 3)), normal[None], up[None], matrix)
        return NormalOffsetBias(texels)(receiver).depth[0]

    assert_close(depth(5.0, up), depth(0.0, up), ulps=0)
    for derivative in jax.jit(jax.grad(depth, argnums=(0, 1)))(5.0, up):
        assert_close(derivative, np.zeros(derivative.shape), ulps=0)
