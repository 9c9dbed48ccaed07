"""Layouts of several maps: which is looked up, and a cube round a lamp without seams."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from experiments.options import techniques
from experiments.truth.rays import Occluders, trace_visibility
from shadows import (
    AdaptiveBias,
    CascadesLayout,
    CubeLayout,
    DirectionalLight,
    Filter,
    HardCompare,
    PCFFilter,
    PCSSFilter,
    PerspectiveCamera,
    PointLight,
    ShadowMap,
    SingleLayout,
    SoftCompare,
    SpotLight,
    choose_map,
    default_bias,
    look_at,
    look_up,
    orthographic,
    receive,
    render,
    render_shadow_map,
)
from tangentspace import shapes
from tangentspace.vertex_normals import face_normals

from .tools import assert_close

UP = np.array([0.0, 1.0, 0.0])
SUN = DirectionalLight(np.array([2.0, 6.0, 3.0]) / 7)
STREET = np.stack(np.meshgrid([-5.0, 5.0], [0.0, 2.0], [-60.0, 2.0]), axis=-1).reshape(-1, 3)
FILTERS = {
    name: cls()  # pyright: ignore[reportAbstractUsage]
    for name, cls in techniques(Filter).items()
    if cls.__module__.startswith("shadows.")
}
FILTERS["pcss"] = PCSSFilter(0.05, widest=6)


def placed(mesh, offset):
    return mesh._replace(positions=mesh.positions + np.asarray(offset))


def unit(vectors):
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def texels(matrices, points, size):
    """Columns, rows and depths of points in each of several maps, and their w."""
    viewport = np.array([[size / 2, 0, 0, size / 2], [0, -size / 2, 0, size / 2], [0, 0, 0.5, 0.5]])
    clip = np.einsum("mjk,pk->mpj", matrices, np.pad(points, ((0, 0), (0, 1)), constant_values=1))
    with np.errstate(divide="ignore", invalid="ignore"):
        window = np.einsum("jk,mpk->mpj", viewport, clip) / clip[..., 3:]
    return window, clip[..., 3]


def held(matrices, points, size, reach):
    """Whether each map holds each point with all texels within reach."""
    window, w = texels(np.asarray(matrices, np.float64), points, size)
    sides = np.minimum(window[..., :2], size - window[..., :2]).min(axis=-1)
    depth = window[..., 2]
    return (w > 0) & (sides >= reach) & (depth >= 0) & (depth <= 1)


# Which map a point is looked up in


def nested_maps(size=32):
    """Three maps that look down -z on squares of growing size, the first off centre."""
    matrices = [
        orthographic(x - half, x + half, -half, half, -1.0, 1.0)
        for x, half in ((0.5, 0.5), (0.0, 1.5), (0.0, 3.0))
    ]
    depth = np.random.default_rng(0).uniform(0.2, 0.8, (3, size, size))
    return ShadowMap(jnp.asarray(depth), jnp.stack(matrices))


def places(count=2000):
    """Points in and around the largest map, some beyond its depths."""
    return np.random.default_rng(1).uniform([-4, -4, -1.3], [4, 4, 1.3], (count, 3))


@pytest.mark.parametrize("reach", [0.0, 0.5, 3.0])
def test_the_first_map_that_holds_all_is_chosen(reach):
    """Else the first that holds the point; else the first of all."""
    maps, points = nested_maps(), places()
    found = jax.jit(choose_map)(jnp.asarray(points), maps, reach=reach)
    whole = held(maps.clip_from_world, points, 32, reach)
    point = held(maps.clip_from_world, points, 32, 0.0)
    expected = np.where(whole.any(axis=0), whole.argmax(axis=0), point.argmax(axis=0))
    assert set(np.unique(expected)) == {0, 1, 2}
    assert reach == 0 or np.any(whole.any(axis=0) != point.any(axis=0))
    assert_close(found, expected)


def test_one_map_needs_no_index():
    points = jnp.asarray(places(3))
    one = ShadowMap(jnp.ones((4, 4)), jnp.eye(4))
    assert choose_map(points, one) is None
    several = ShadowMap(jnp.ones((1, 4, 4)), jnp.eye(4)[None])
    assert_close(choose_map(points, several), np.zeros(3, np.int32))


def test_receivers_and_lookups_are_those_of_the_chosen_map():
    maps, points = nested_maps(), jnp.asarray(places(300))
    normals = jnp.asarray(unit(np.random.default_rng(2).normal(size=(300, 3))))
    towards = jnp.broadcast_to(jnp.array([0.0, 0.0, 1.0]), points.shape)
    index = jnp.asarray(np.random.default_rng(3).integers(0, 3, 300))
    arrays = points, normals, towards
    locate, look = jax.jit(receive), jax.jit(look_at_maps)
    together = locate(*arrays, maps.texel_from_world, map_index=index)
    lit = look(maps, together)
    assert float(lit.mean()) < 0.95
    for k in range(3):
        one = ShadowMap(maps.depth[k], maps.clip_from_world[k])
        alone = locate(*arrays, one.texel_from_world)
        for field in ("column", "row", "depth", "depth_per_row", "depth_rate", "texel_length"):
            assert_close(getattr(together, field)[index == k], getattr(alone, field)[index == k])
        assert_close(lit[index == k], look(one, alone)[index == k])


def look_at_maps(shadow_map, receiver):
    return look_up(shadow_map, receiver, filter=PCFFilter(1), compare=SoftCompare(20.0))


def test_moved_receivers_stay_in_their_map():
    maps, points = nested_maps(), jnp.asarray(places(100))
    normals = jnp.broadcast_to(jnp.array([0.6, 0.0, 0.8]), points.shape)
    index = jnp.asarray(np.random.default_rng(3).integers(0, 3, 100))
    towards = jnp.broadcast_to(jnp.array([0.0, 0.0, 1.0]), points.shape)
    receiver = receive(points, normals, towards, maps.texel_from_world, map_index=index)
    moved = receiver.along_normal(0.1)
    expected = receive(
        points + 0.1 * normals, normals, towards, maps.texel_from_world, map_index=index
    )
    assert_close(moved.map_index, index)
    for field in ("column", "row", "depth"):
        assert_close(getattr(moved, field), getattr(expected, field))


def test_derivative_through_several_maps():
    """In every map's depths and in the points: forward, reverse and differences."""
    maps, points = nested_maps(8), jnp.asarray(places(60)) * 0.7
    towards = jnp.broadcast_to(jnp.array([0.0, 0.0, 1.0]), points.shape)
    index = choose_map(points, maps)
    weights = jnp.asarray(np.random.default_rng(4).normal(size=60))

    @jax.jit
    def loss(depth, points):
        shadow_map = maps._replace(depth=depth)
        receiver = receive(points, towards, towards, maps.texel_from_world, map_index=index)
        return weights @ look_at_maps(shadow_map, receiver)

    gradients = jax.jit(jax.grad(loss, argnums=(0, 1)))(maps.depth, points)
    rng = np.random.default_rng(5)
    for k, argument in enumerate((maps.depth, points)):
        step = jnp.asarray(rng.normal(size=argument.shape))
        ends = [
            loss(
                *(
                    (a + sign * 1e-6 * step if j == k else a)
                    for j, a in enumerate((maps.depth, points))
                )
            )
            for sign in (1, -1)
        ]
        numerical = float(ends[0] - ends[1]) / 2e-6
        assert abs(numerical) > 1e-3
        np.testing.assert_allclose(jnp.sum(gradients[k] * step), numerical, rtol=1e-6)
    assert all(float(jnp.abs(g).max()) > 1e-3 for g in gradients[0])


# A cube of maps round a point light

LAMP = np.array([0.1, 0.2, -0.15])
CUBE_SIZE = 256


def cube_matrices(points, reach, size=CUBE_SIZE, lamp=LAMP):
    return CubeLayout().matrices(
        PointLight(lamp), points, CAMERA, aspect=1.0, map_size=size, reach=reach
    )


CAMERA = PerspectiveCamera(np.eye(4), 0.8, 0.1, 100.0)


def directions(count=3000):
    """Unit vectors, among them the middles, edges and corners of the cube and their neighbors."""
    grid = np.stack(np.meshgrid(*3 * ([-1.0, 0.0, 1.0],)), axis=-1).reshape(-1, 3)
    special = grid[np.any(grid != 0, axis=1)]
    rng = np.random.default_rng(0)
    near = (special[:, None] + rng.normal(size=(26, 40, 3)) * 0.01).reshape(-1, 3)
    return unit(np.concatenate([special, near, rng.normal(size=(count, 3))]))


@pytest.mark.parametrize("reach", [0.5, 3.0, 20.0])
def test_every_direction_is_in_some_side_of_the_cube_with_the_filters_reach(reach, dtype):
    points = 3 * directions() + LAMP
    matrices = cube_matrices(jnp.asarray(points, dtype), reach, lamp=LAMP.astype(dtype))
    assert matrices.dtype == dtype
    for distance in (0.02, 1.0, 3.0):
        inside = held(matrices, distance * directions() + LAMP, CUBE_SIZE, reach)
        assert inside.any(axis=0).all()


@pytest.mark.parametrize("reach", [0.5, 20.0])
def test_sides_of_the_cube_share_no_more_than_they_must(reach):
    """A right angle and the reach on both sides, and a texel; each looks along an axis."""
    matrices = np.asarray(cube_matrices(3 * directions(), reach, lamp=np.zeros(3)))
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    assert_close(np.sort(unit(matrices[:, 3, :3]) @ axes.T, axis=-1)[:, -1], np.ones(6))
    for axis in axes:
        window, w = texels(matrices, axis[None], CUBE_SIZE)
        k = np.argmax(w[:, 0])
        assert_close(window[k, 0, :2], np.full(2, CUBE_SIZE / 2))
        for other in axes[np.abs(axes @ axis) < 0.5]:
            edge = texels(matrices[k : k + 1], (axis + other)[None], CUBE_SIZE)[0][0, 0, :2]
            margin = np.minimum(edge, CUBE_SIZE - edge).min()
            assert reach <= margin <= reach + 1 + 1e-9


BLOCKS = np.array([[0.9, 0.0, 0.9], [-0.8, 0.8, 0.0], [0.7, -0.7, -0.7], [0.0, 0.0, -1.2]])
HALF = (0.25, 0.2, 0.22)


@functools.cache
def round_room():
    """A round room with blocks before the cube's edges, a corner and a middle; points on it."""
    room = shapes.icosphere(3.0, subdivisions=3, dtype=np.float64)
    blocks = [placed(shapes.box(HALF, dtype=np.float64), LAMP + middle) for middle in BLOCKS]
    rng = np.random.default_rng(0)
    face = rng.integers(0, len(room.faces), 20_000)
    weights = rng.dirichlet(np.ones(3), len(face))
    points = np.einsum("pk,pkx->px", weights, room.positions[room.faces[face]])
    normals = np.asarray(face_normals(jnp.asarray(room.positions), room.faces))[face]
    return shapes.merge(room, *blocks), points, normals


def blocked(direction):
    """Whether a ray from the lamp meets a block: enters all three slabs before it leaves one."""
    hit = np.zeros(direction.shape[:-1], bool)
    for middle in BLOCKS:
        ends = np.sort([(middle + sign * np.array(HALF)) / direction for sign in (-1, 1)], axis=0)
        hit |= (ends[0].max(axis=-1) <= ends[1].min(axis=-1)) & (ends[1].min(axis=-1) > 0)
    return hit


def around(direction, angle):
    """Directions on a grid up to so far away."""
    first = unit(np.cross(direction, [0.3, 0.5, 0.81]))
    second = np.cross(direction, first)
    steps = angle * np.linspace(-1, 1, 7)
    return np.stack([direction + a * first + b * second for a in steps for b in steps])


@pytest.mark.parametrize("name", FILTERS)
def test_no_seams_in_a_closed_room(name):
    """At the cube's edges nothing differs more from the truth than inside its sides.

    Where the truth is uniform over what the filter reads, and more; so, for filters that
    compare, nothing differs at all.
    """
    filter = FILTERS[name]
    reach = float(filter.reach())
    _, points, normals = round_room()
    direction = unit(points - LAMP)
    texel = 2 / CUBE_SIZE
    shadowed = blocked(around(direction, 1.6 * (reach + 1.5) * texel))
    uniform = shadowed.all(axis=0) | ~shadowed.any(axis=0)
    ordered = np.sort(np.abs(direction), axis=-1)
    edge = ordered[:, 1] / ordered[:, 2] > 1 - 2 * (reach + 2) * texel
    # A little for the room's curvature: wide filters see its walls bend towards the lamp.
    bias = AdaptiveBias(0.25, unit="reach") if filter.compares else default_bias(filter)
    with jax.enable_x64(False):
        shadow_map = room_maps(reach)
        receiver = _locate(shadow_map, *(jnp.float32(a) for a in (points, normals)), reach)
        lit = _look(shadow_map, receiver, bias, filter)
    error = np.abs(np.asarray(lit) - ~shadowed.any(axis=0))
    at_edge, inside = uniform & edge, uniform & ~edge
    assert not receiver.outside.any()
    assert (at_edge & shadowed.all(axis=0)).sum() > 50
    if filter.compares:
        assert error[at_edge | inside].max() < 1e-6  # 0 measured
    assert error[at_edge].max() <= error[inside].max() + 1e-5  # 5e-7 more measured, of msm


@functools.cache
def room_maps(reach):
    """The cube of maps of the round room, as wide as a filter needs."""
    mesh, _, _ = round_room()
    positions = jnp.asarray(mesh.positions, jnp.float32)
    matrices = cube_matrices(positions, reach, lamp=LAMP.astype(np.float32))
    return _draw(positions, mesh.faces, matrices)


@jax.jit
def _draw(positions, faces, matrices):
    return render_shadow_map(positions, faces, matrices, map_size=CUBE_SIZE)


@jax.jit
def _locate(shadow_map, points, normals, reach):
    towards = PointLight(jnp.asarray(LAMP, points.dtype)).to_light(points)
    index = choose_map(points, shadow_map, reach=reach)
    return receive(points, normals, towards, shadow_map.texel_from_world, map_index=index)


@jax.jit
def _look(shadow_map, receiver, bias, filter):
    moved = bias(receiver, filter.reach())
    return look_up(shadow_map, moved, filter=filter, compare=HardCompare())


@pytest.mark.parametrize("light", ["directional", "spot"])
def test_a_cube_is_for_point_lights(light):
    lights = {"directional": DirectionalLight(UP), "spot": SpotLight(3 * UP, -UP)}
    kind = type(lights[light]).__name__
    with pytest.raises(ValueError, match=f"^CubeLayout: expected a PointLight, got a {kind}; "):
        CubeLayout().matrices(lights[light], np.eye(3), CAMERA, aspect=1.0, map_size=64, reach=1.0)


# Both


@pytest.mark.parametrize(
    ("layout", "light"), [(CubeLayout(), PointLight(LAMP)), (CascadesLayout(), SUN)]
)
def test_filters_as_wide_as_a_map_are_refused(layout, light):
    reach = PCFFilter(8).reach()
    name = type(layout).__name__
    with pytest.raises(ValueError, match=rf"^{name}: expected a filter .* of 20 texels, got 9; "):
        layout.matrices(light, STREET, CAMERA, aspect=1.0, map_size=20, reach=reach)
    assert layout.matrices(light, STREET, CAMERA, aspect=1.0, map_size=21, reach=reach).shape[
        1:
    ] == (4, 4)


def test_a_single_map_is_the_lights_own():
    found = SingleLayout().matrices(SUN, STREET, CAMERA, aspect=1.0, map_size=64, reach=1.0)
    assert_close(found, SUN.clip_from_world(STREET), ulps=0)


def test_render_draws_every_map_of_a_layout():
    """In the room of a picture; what the lamp does not see directly is dark, and nothing else."""
    mesh = shapes.merge(shapes.box((2.0, 1.0, 2.0)), placed(shapes.box((0.3, 0.3, 0.3)), UP * -0.7))
    lamp = np.float32([0.3, 0.5, 0.2])
    view = np.asarray(
        look_at(np.float32([-1.5, 0.5, -1.5]), np.float32([0, -0.6, 0]), UP), np.float32
    )
    camera = PerspectiveCamera(view, 1.0, 0.05, 10.0)
    with jax.enable_x64(False):
        mesh = mesh._replace(positions=np.float32(mesh.positions))
        image = rendered(mesh, camera, PointLight(lamp))
        truth = trace_visibility(
            image.surface.position,
            image.surface.face_normal,
            image.surface.face_ids,
            PointLight(lamp),
            Occluders(mesh.positions, mesh.faces),
        )
    assert image.shadow_maps[0].depth.shape == (6, 128, 128)
    assert 0.05 < np.mean(~truth) < 0.9
    assert np.mean(np.abs(np.asarray(image.visibilities[0]) - truth) > 0.5) < 0.02  # 0.003


@jax.jit
def rendered(mesh, camera, light):
    return render(mesh, camera, light, image_size=(64, 64), map_size=128, layout=CubeLayout())


# Derivatives


def test_derivative_of_the_cubes_matrices():
    """In the lamp's place; the far plane follows the farthest point."""

    def matrices(lamp):
        return cube_matrices(STREET, 2.0, lamp=lamp)

    check_grads(jax.jit(matrices), (jnp.asarray(LAMP),), 1, ("fwd", "rev"), eps=1e-6, rtol=1e-6)
