"""Cascades: no point of a deep view is missed, and the grid of texels stays as the eye moves."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.truth.rays import Occluders, trace_visibility
from shadows import (
    AdaptiveBias,
    CascadesLayout,
    DirectionalLight,
    HardCompare,
    OrthographicCamera,
    PCFFilter,
    PerspectiveCamera,
    PointLight,
    SpotLight,
    look_at,
    render_shadow_map,
    render_surface,
    surface_visibility,
)
from tangentspace import shapes

from .test_layouts import CAMERA, STREET, SUN, UP, held, placed, texels


def camera_at(eye, turn, *, far=200.0, near=0.1, fov=0.8, pitch=-0.1, dtype=np.float64):
    ahead = np.array([np.sin(turn), pitch, -np.cos(turn)])
    view = np.asarray(look_at(eye, eye + ahead, UP), dtype)
    return PerspectiveCamera(view, fov, near, far)


def map_camera(half_height, near, far):
    view = np.asarray(look_at(np.array([0.0, 30.0, -20.0]), np.array([1.0, 0.0, -25.0]), UP))
    return OrthographicCamera(view, half_height, near, far)


@functools.partial(jax.jit, static_argnames="map_size")
def _cascades(layout, light, camera, points, reach, map_size):
    return layout.matrices(light, points, camera, aspect=1.5, map_size=map_size, reach=reach)


def cascades(
    camera, count=3, *, points=STREET, reach=3.0, map_size=512, spread=0.75, dtype=np.float64
):
    light = DirectionalLight(SUN.direction.astype(dtype))
    layout = CascadesLayout(count, spread)
    return np.asarray(_cascades(layout, light, camera, points.astype(dtype), reach, map_size))


CAMERAS = {
    "street": camera_at(np.array([0.0, 1.5, 0.0]), 0.1),
    "near far plane": camera_at(np.array([0.0, 1.5, 0.0]), 0.1, far=20.0),
    "narrow": camera_at(np.array([0.0, 1.5, 1.0]), -0.1, fov=0.15, near=0.01),
    "wide": camera_at(np.array([0.0, 1.0, -30.0]), 2.0, fov=1.8, near=1e-3),
    "from afar": camera_at(np.array([40.0, 30.0, -20.0]), -1.4, pitch=-0.7),
    "map": map_camera(10.0, 0.0, 100.0),
    "map from within": map_camera(6.0, -15.0, 100.0),
}


def seen(camera, aspect, count=4000):
    """Points of the scene's box that the camera sees."""
    rng = np.random.default_rng(0)
    low, high = STREET.min(axis=0), STREET.max(axis=0)
    near = camera.view_from_world[:3, :3].T @ -camera.view_from_world[:3, 3] + rng.normal(
        size=(count, 3)
    )
    points = np.concatenate([rng.uniform(low, high, (20 * count, 3)), near])
    points = points[np.all((points >= low) & (points <= high), axis=1)]
    clip = (
        np.asarray(camera.clip_from_world(aspect))
        @ np.pad(points, ((0, 0), (0, 1)), constant_values=1).T
    )
    return points[np.all(np.abs(clip[:3]) <= clip[3], axis=0)]


@pytest.mark.parametrize("spread", [0.0, 0.75, 1.0])
@pytest.mark.parametrize("name", CAMERAS)
def test_every_point_of_the_view_is_in_some_map_with_the_filters_reach(name, spread):
    camera = CAMERAS[name]
    points = seen(camera, 1.5)
    assert len(points) > 300
    for count, reach in ((1, 1.0), (3, 5.0)):
        matrices = cascades(camera, count, reach=reach, spread=spread, map_size=128)
        assert matrices.shape == (count, 4, 4)
        assert held(matrices, points, 128, reach).any(axis=0).all()


def edges(camera, aspect):
    """Points along the four edges of a view, from its near to its far plane."""
    depth = 2 * np.geomspace(1e-4, 1, 50) - 1
    corners = [(x, y, z, 1.0) for x in (-1, 1) for y in (-1, 1) for z in (-1, *depth)]
    world = np.array(corners) @ np.linalg.inv(camera.clip_from_world(aspect)).T
    return world[:, :3] / world[:, 3:]


@pytest.mark.parametrize("kind", ["perspective", "parallel"])
def test_the_edges_of_the_view_are_held_whichever_way_it_looks(kind):
    """They touch the spheres that maps are fitted to, some of them where the map's sides do."""
    around = 50.0 * np.stack(np.meshgrid(*3 * ([-1, 1],)), axis=-1).reshape(-1, 3)
    for turn in np.linspace(0, 2 * np.pi, 40):
        camera = camera_at(np.array([0.0, 1.5, 0.0]), turn, far=20.0, pitch=0.6 * np.sin(3 * turn))
        if kind == "parallel":
            camera = OrthographicCamera(camera.view_from_world, 2.0, -15.0, 20.0)
        for count in (1, 3):
            matrices = cascades(camera, count, points=around, reach=5.0, map_size=64)
            assert held(matrices, edges(camera, 1.5), 64, 5.0).any(axis=0).all()


def test_maps_grow_with_the_distance():
    """The nearest is much finer than one map of everything would be."""
    sizes = 1 / np.linalg.norm(cascades(CAMERAS["street"], 4)[:, 0, :3], axis=-1)
    assert np.all(np.diff(sizes) > 0)
    assert sizes[0] < 0.15 * sizes[-1]
    alike = 1 / np.linalg.norm(cascades(CAMERAS["street"], 4, spread=0.0)[:, 0, :3], axis=-1)
    assert alike[0] > 2 * sizes[0]


MOTIONS = {
    "walk": lambda k: camera_at(np.array([0.011, 0.003, -0.02]) * k + [0, 1.5, 0], 0.1),
    "turn": lambda k: camera_at(np.array([0.0, 1.5, 0.0]), 0.1 + 0.003 * k),
    "nod": lambda k: camera_at(np.array([0.0, 1.5, 0.0]), 0.1, pitch=-0.1 + 0.002 * k),
    "near far plane": lambda k: camera_at(np.array([0.0, 1.5, -0.05 * k]), 0.004 * k, far=20.0),
}


@pytest.mark.parametrize("motion", MOTIONS)
def test_the_grid_of_texels_stays(motion, dtype):
    """Sizes are constant, and any world point stays at its place in its texel."""
    size = 512
    point = np.array([[0.3, 0.7, -0.2]])
    sides, phases = [], []
    for k in range(100):
        camera = MOTIONS[motion](k)
        view = np.asarray(camera.view_from_world, dtype)
        camera = PerspectiveCamera(view, camera.vertical_fov, camera.near, camera.far)
        with jax.enable_x64(dtype == np.float64):
            matrices = cascades(camera, dtype=dtype).astype(np.float64)
        assert np.all(matrices[:, 3] == [0, 0, 0, 1])
        sides.append(matrices[:, :3, :3])
        phases.append(texels(matrices, point, size)[0][:, 0, :2])
    eps = np.finfo(dtype).eps
    assert np.ptp(np.array(sides), axis=0).max() < 8 * eps
    moved = np.array(phases) - phases[0]
    assert np.abs(moved).max() > 3  # texels: the maps do follow the eye
    assert np.abs(moved - np.round(moved)).max() < 64 * size * eps


def test_cascades_of_a_deep_scene_against_rays():
    """Nearer to the truth than one map of as many texels on each side, near the eye most of all."""
    posts = [
        placed(shapes.box((0.06, 0.6, 0.06)), np.float32([x, 0.6, z]))
        for z in np.linspace(-1, -55, 13)
        for x in (-1.5, 0.7, 1.8)
    ]
    ground = shapes.plane(60.0)
    mesh = shapes.merge(ground, *posts)
    light = DirectionalLight(np.float32([0.5, 0.6, 0.3]) / np.float32(np.sqrt(0.7)))
    camera = camera_at(np.array([0.0, 1.6, 2.0]), 0.05, far=70.0, dtype=np.float32)
    filter, size = PCFFilter(1), 256
    draw = jax.jit(functools.partial(render_shadow_map, map_size=size))
    error = []
    with jax.enable_x64(False):
        surface = jax.jit(lambda: render_surface(mesh, camera, image_size=(96, 144)))()
        seen = surface.position, surface.face_normal, surface.face_ids
        truth = trace_visibility(*seen, light, Occluders(mesh.positions, mesh.faces))
        for layout in (CascadesLayout(1, 0.0), CascadesLayout(4)):
            matrices = layout.matrices(
                light, mesh.positions, camera, aspect=1.5, map_size=size, reach=filter.reach()
            )
            shadow_map = jax.tree.map(jnp.asarray, draw(mesh.positions, mesh.faces, matrices))
            lit = surface_visibility(
                surface,
                light,
                shadow_map,
                bias=AdaptiveBias(),
                filter=filter,
                compare=HardCompare(),
            )
            error.append(np.abs(np.asarray(lit) - truth))
    near = np.asarray(surface.covered) & (np.asarray(surface.position)[..., 2] > -10)
    one, four = (np.mean(e[near]) for e in error)
    assert 0.02 < np.mean(~truth[near]) < 0.5
    assert four < 0.3 * one, (one, four)  # 0.013 and 0.077 measured
    assert four < 0.02


@pytest.mark.errors
@pytest.mark.parametrize("count", [0, -1, 9, 1.5, True])
def test_a_number_of_cascades_out_of_range_is_refused(count):
    with pytest.raises(ValueError, match=rf"^CascadesLayout: expected .*`count`.*, got {count}$"):
        CascadesLayout(count)


@pytest.mark.parametrize("light", [PointLight(UP), SpotLight(UP, -UP)])
def test_cascades_are_for_parallel_light(light):
    kind = type(light).__name__
    with pytest.raises(
        ValueError, match=f"CascadesLayout: expected a DirectionalLight, .* {kind};"
    ):
        CascadesLayout().matrices(light, np.eye(3), CAMERA, aspect=1.0, map_size=64, reach=1.0)


# Derivatives


def test_derivative_of_the_cascades_matrices():
    """In the light's direction: that of a map which turns and keeps its size."""
    camera, step = CAMERAS["street"], np.array([0.3, 0.1, -0.2])

    @jax.jit
    def matrices(direction):
        light = DirectionalLight(direction)
        return CascadesLayout().matrices(light, STREET, camera, aspect=1.5, map_size=512, reach=2.0)

    forward = jax.jvp(matrices, (SUN.direction,), (step,))[1]
    ends = [matrices(SUN.direction + sign * 1e-9 * step) for sign in (1, -1)]
    numerical = (ends[0] - ends[1]) / 2e-9
    assert float(jnp.abs(numerical).max()) > 1e-3
    np.testing.assert_allclose(forward, numerical, atol=1e-6)
