"""Area lights: their points, and the penumbrae that closed forms ask of the traced truth."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from experiments.truth.area import area_visibility
from experiments.truth.rays import Occluders, trace_visibility
from shadows import (
    DiscLight,
    HardCompare,
    Medium,
    NearestFilter,
    PCSSFilter,
    PerspectiveCamera,
    PointLight,
    RectangleLight,
    SlopeBias,
    add_shafts,
    look_at,
    render,
    transform_points,
)
from tangentspace.shapes import box, merge, plane, transform_mesh

from .tools import assert_close

UP = np.array([0.0, 1.0, 0.0])
COLOR = np.array([0.9, 0.6, 0.3])

# Compiled without optimization: each runs a few times, on small images.
quick = functools.partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})
radiance = jax.jit(lambda light, positions: light.radiance(positions))
clip_of = jax.jit(lambda light, points: light.clip_from_world(points))


def unit(*vector):
    return np.array(vector) / np.linalg.norm(np.array(vector))


TILTED = {"position": np.array([0.4, 3.0, -0.2]), "direction": unit(0.2, -1.0, 0.3)}
LIGHTS = {
    "disc": DiscLight(**TILTED, radius=0.3, color=COLOR),
    "rectangle": RectangleLight(
        **TILTED, width=0.6, height=0.4, up=unit(1.0, 0.3, 0.2), color=COLOR
    ),
}


def in_plane(light, points):
    """Coordinates along the light's width, its height and its normal, by cross products."""
    forward = light.direction
    right = unit(*np.cross(forward, getattr(light, "up", UP)))
    axes = np.stack([right, np.cross(right, forward), forward])
    return (np.asarray(points) - light.position) @ axes.T


# Known answers: the points


@pytest.mark.parametrize("count", [1, 2, 7, 64, 1000])
@pytest.mark.parametrize("kind", LIGHTS)
def test_points_lie_on_the_light(kind, count):
    light = LIGHTS[kind]
    across, along, off = in_plane(light, light.sample_points(count)).T
    assert len(across) == count
    np.testing.assert_allclose(off, 0, atol=1e-15)
    if kind == "disc":
        assert np.hypot(across, along).max() < 0.3
    else:
        assert np.abs(across).max() < 0.3
        assert np.abs(along).max() < 0.2


@pytest.mark.parametrize("kind", LIGHTS)
def test_points_are_spread_evenly(kind):
    """Centre, variances and no covariance of a uniform disc and rectangle."""
    light = LIGHTS[kind]
    points = in_plane(light, light.sample_points(1000))[:, :2]
    variances = [0.3**2 / 4] * 2 if kind == "disc" else [0.6**2 / 12, 0.4**2 / 12]
    np.testing.assert_allclose(points.mean(axis=0), 0, atol=3e-4)
    expected = np.diag(variances)
    np.testing.assert_allclose(points.T @ points / 1000, expected, atol=5e-3 * max(variances))
    # No two come nearer to each other than most of the spacing of a regular grid.
    area = np.pi * 0.3**2 if kind == "disc" else 0.24
    distance = np.linalg.norm(points[:, None] - points, axis=-1) + np.eye(1000)
    assert distance.min() > 0.6 * np.sqrt(area / 1000)


@pytest.mark.parametrize("kind", LIGHTS)
def test_the_diameter_is_that_of_a_disc_that_spreads_as_far(kind):
    """On a disc the mean square of the distance from the centre is an eighth of it squared."""
    light = LIGHTS[kind]
    offsets = np.asarray(light.sample_points(4000)) - light.position
    spread = np.sqrt(8 * (offsets**2).sum(axis=1).mean())
    assert float(light.diameter) == pytest.approx(spread, rel=1e-4)  # measured 8e-8, 1e-5
    if kind == "disc":
        assert light.diameter == 0.6


def test_a_light_without_size_is_a_point():
    for light in (DiscLight(**TILTED, radius=0.0), RectangleLight(**TILTED, width=0.0, height=0.0)):
        assert_close(light.sample_points(5), np.tile(TILTED["position"], (5, 1)))


def test_a_light_may_point_along_its_up():
    light = RectangleLight(UP, UP, 1.0, 1.0)
    points = np.asarray(light.sample_points(100))
    np.testing.assert_allclose(points[:, 1], 1)
    assert np.ptp(points[:, 0]) > 0.9
    assert np.ptp(points[:, 2]) > 0.9


# Known answers: what arrives


@pytest.mark.parametrize("kind", LIGHTS)
def test_light_falls_with_the_cosine_and_is_dark_behind(kind):
    light = LIGHTS[kind]
    side = unit(*np.cross(light.direction, UP))
    angles = np.deg2rad([0, 30, 60, 89, 91, 150, 180])
    ways = np.cos(angles)[:, None] * light.direction + np.sin(angles)[:, None] * side
    shares = np.maximum(np.cos(angles), 0)[:, None]
    for distance in (0.1, 5.0):
        points = jnp.asarray(light.position + distance * ways)
        assert_close(radiance(light, points), shares * COLOR, ulps=2**8)
        assert_close(light.to_light(points), -ways, ulps=2**8)


@pytest.mark.parametrize("kind", LIGHTS)
def test_map_covers_what_lies_before_the_light(kind):
    light = LIGHTS[kind]
    rng = np.random.default_rng(0)
    points = rng.uniform([-2, -1, -2], [2, 4, 2], (500, 3))  # some behind it
    clip = np.asarray(transform_points(clip_of(light, points), jnp.asarray(points)))
    towards = points - light.position
    depth = towards @ light.direction
    before = depth > np.cos(np.deg2rad(80)) * np.linalg.norm(towards, axis=1)
    assert 100 < before.sum() < 450
    assert np.abs(clip[before, :2] / clip[before, 3:]).max() < 1
    assert (np.abs(clip[before, 2]) < clip[before, 3])[depth[before] > 0.01].all()


# Known answers: penumbrae of a straight edge

HEIGHT, LAMP = 1.0, 4.0  # of the edge and of the light over the floor
OVER_EDGE = {"position": LAMP * UP, "direction": -UP}
DISC = DiscLight(**OVER_EDGE, radius=0.25)
RECTANGLE = RectangleLight(**OVER_EDGE, width=0.5, height=0.3, up=np.array([0.0, 0.0, 1.0]))
PENUMBRA = HEIGHT * 0.5 / (LAMP - HEIGHT)  # (d_R - d_B) w_L / d_B


def half_plane():
    """A floor, and over its half x < 0 a sheet."""
    square = np.array([[-1, 0, -1], [-1, 0, 1], [1, 0, 1], [1, 0, -1.0]])
    sheet = square * [2, 1, 4] + [-2, HEIGHT, 0]
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    return Occluders(np.concatenate([4 * square, sheet]), np.concatenate([faces, faces + 4]))


def seen_past_edge(light, samples, count=401):
    """Places on the floor across the penumbra, as shares of its width, and what they see."""
    place = np.linspace(-0.7, 0.7, count)
    points = np.stack([PENUMBRA * place, np.zeros(count), 0.1 + 0 * place], axis=-1)
    normals = np.broadcast_to(UP, points.shape)
    faces = np.where(points[:, 0] - points[:, 2] <= 0, 0, 1)
    return place, area_visibility(points, normals, faces, light, half_plane(), samples=samples)


def share_of_rectangle(place):
    return np.clip(0.5 + place, 0, 1)


def share_of_disc(place):
    """Return what is left of a disc of diameter 1 beside a line."""
    x = np.clip(2 * place, -1, 1)
    return 0.5 + (x * np.sqrt(1 - x * x) + np.arcsin(x)) / np.pi


EDGES = {"disc": (DISC, share_of_disc), "rectangle": (RECTANGLE, share_of_rectangle)}


@pytest.mark.parametrize("kind", EDGES)
def test_penumbra_of_a_straight_edge(kind):
    light, exact = EDGES[kind]
    place, seen = seen_past_edge(light, 400)
    assert np.abs(seen - exact(place)).max() < 0.015  # measured 0.0094, 0.0010
    # From a visibility of 0.1 to one of 0.9.
    assert np.all(np.diff(seen) >= 0)
    width = np.subtract(*np.interp([0.9, 0.1], seen, place))
    fine = np.linspace(-0.5, 0.5, 10001)
    expected = np.subtract(*np.interp([0.9, 0.1], exact(fine), fine))
    np.testing.assert_allclose(width, expected, rtol=0.01)  # measured 0.0036, 0.0025


@pytest.mark.parametrize("kind", EDGES)
def test_truth_converges_faster_than_random_points_would(kind):
    light, exact = EDGES[kind]
    counts = [16, 64, 256, 1024]
    errors = []
    for count in counts:
        place, seen = seen_past_edge(light, count, 101)
        errors.append(np.sqrt(np.mean((seen - exact(place)) ** 2)))
    order = -np.polyfit(np.log(counts), np.log(errors), 1)[0]
    assert order > 0.7  # measured 0.79, 1.01; of random points 0.5
    assert errors[-1] < 2e-3  # measured 1.2e-3, 2.3e-4


def test_penumbra_grows_with_the_light_and_with_the_distance_from_the_edge():
    """Twice the light twice as wide; the same in units of the law."""
    for radius in (0.05, 0.5):
        place, seen = seen_past_edge(DiscLight(**OVER_EDGE, radius=radius), 200)
        scaled = np.clip(place * 0.25 / radius, -0.5, 0.5)
        assert np.abs(seen - share_of_disc(scaled)).max() < 0.02


def test_a_hole_shows_its_own_area():
    """A small square window before a large light: what is seen is its share of the disc."""
    half, height = 0.05, 2.0
    frame = [((-2, -half), (-2, 2)), ((half, 2), (-2, 2))]
    frame += [((-half, half), (-2, -half)), ((-half, half), (half, 2))]
    corners, faces = [], []
    for (x0, x1), (z0, z1) in frame:
        start = len(corners)
        corners += [[x, height, z] for x, z in ((x0, z0), (x0, z1), (x1, z1), (x1, z0))]
        faces += [[start, start + 1, start + 2], [start, start + 2, start + 3]]
    floor = plane(1.0, dtype=np.float64)
    faces = np.concatenate([floor.faces, np.array(faces) + 4])
    occluders = Occluders(np.concatenate([floor.positions, corners]), faces)
    light = DiscLight(**OVER_EDGE, radius=0.4)
    seen = area_visibility(
        np.array([[0.02, 0, -0.01]]), UP[None], np.array([0]), light, occluders, samples=4000
    )
    window = (2 * half * LAMP / (LAMP - height)) ** 2
    np.testing.assert_allclose(seen, window / (np.pi * 0.4**2), rtol=0.03)


def test_one_sample_of_a_disc_is_nearly_its_centre():
    """A tiny light casts the hard shadow of a point."""
    _, seen = seen_past_edge(DiscLight(**OVER_EDGE, radius=1e-7), 5)
    assert set(np.unique(seen)) <= {0.0, 1.0}


# The image


def placed_box():
    matrix = np.eye(4)
    matrix[:3, 3] = 0.3, 0.6, 0.1
    return transform_mesh(box((0.3, 0.2, 0.3), dtype=np.float64), matrix)


def test_an_area_light_renders_as_any_other():
    """Its shadow map stands at its centre."""
    mesh = merge(placed_box(), plane(2.0, dtype=np.float64))
    view = np.asarray(look_at(np.array([1.0, 3.0, 4.0]), np.zeros(3), UP))
    camera = PerspectiveCamera(view, 0.7, 1.0, 20.0)
    light = LIGHTS["disc"]
    image = quick(
        lambda light: render(
            mesh,
            camera,
            light,
            image_size=(48, 64),
            map_size=512,
            bias=SlopeBias(1.0),
            filter=NearestFilter(),
            compare=HardCompare(),
        )
    )(light)
    seen = image.surface
    arguments = (seen.position, seen.face_normal, seen.face_ids)
    occluders = Occluders(mesh.positions, mesh.faces)
    hard = trace_visibility(*arguments, PointLight(light.position), occluders)
    soft = area_visibility(*arguments, light, occluders, samples=64)
    assert ((image.visibilities[0] > 0.5) != hard).mean() < 0.01
    assert 0.01 < ((soft > 0.1) & (soft < 0.9)).mean() < 0.1  # the penumbra
    assert (hard == (soft > 0.5))[(soft < 0.02) | (soft > 0.98)].mean() > 0.999
    assert not soft[np.asarray(seen.face_ids) < 0].any()


def test_a_filter_takes_the_size_that_was_left_open_from_the_light():
    disc, point = LIGHTS["disc"], PointLight(TILTED["position"])
    open_size = PCSSFilter(taps=7)
    assert open_size.for_light(disc) == PCSSFilter(0.6, taps=7)
    assert open_size.for_light(point) == PCSSFilter(0.1, taps=7)
    told = PCSSFilter(0.2)
    assert told.for_light(disc) is told
    assert NearestFilter().for_light(disc) == NearestFilter()


def test_shadows_are_as_soft_as_the_light_is_large():
    """Unless the filter is told otherwise; in the image, and in mist."""
    mesh = merge(placed_box(), plane(2.0, dtype=np.float64))
    view = np.asarray(look_at(np.array([1.0, 3.0, 4.0]), np.zeros(3), UP))
    camera = PerspectiveCamera(view, 0.7, 1.0, 20.0)
    settings = {"image_size": (24, 24), "map_size": 128}

    @functools.partial(quick, static_argnums=1)
    def of(light, size):
        filter = PCSSFilter(size)
        image = render(mesh, camera, light, **settings, filter=filter)
        return image.visibilities[0], add_shafts(
            image, camera, light, Medium(0.1), steps=4, filter=filter
        ).color

    open_size, told, other = (of(LIGHTS["disc"], size) for size in (None, 0.6, 0.1))
    for found, same, differs in zip(open_size, told, other, strict=True):
        np.testing.assert_array_equal(found, same)
        assert np.abs(found - differs).max() > 0.01


# Derivatives


def test_the_diameter_has_its_derivative_also_without_a_size():
    of = lambda sides: RectangleLight(**TILTED, width=sides[0], height=sides[1]).diameter
    slopes = jax.grad(of)(jnp.array([0.6, 0.4]))
    scale = np.sqrt(2 / 3) / np.hypot(0.6, 0.4)
    assert_close(slopes, scale * np.array([0.6, 0.4]))
    assert_close(jax.grad(of)(jnp.zeros(2)), np.zeros(2), ulps=0)


@pytest.mark.parametrize("kind", LIGHTS)
def test_points_follow_pose_and_size(kind):
    """Forward, reverse, and central differences."""
    light = jax.tree.map(lambda x: jnp.asarray(x, np.float64), LIGHTS[kind])
    flat, unravel = ravel_pytree(light)
    of = lambda flat: unravel(flat).sample_points(5).ravel()
    forward = np.asarray(jax.jit(jax.jacfwd(of))(flat))
    assert_close(jax.jit(jax.jacrev(of))(flat), forward)
    numerical = np.stack(
        [(of(flat + s) - of(flat - s)) / 2e-6 for s in 1e-6 * jnp.eye(len(flat))], axis=-1
    )
    np.testing.assert_allclose(forward, numerical, atol=1e-8)
    # They move with the centre, and away from it as the light grows.
    assert_close(forward[:, :3], np.tile(np.eye(3), (5, 1)))
    offsets = np.asarray(light.sample_points(5) - light.position).ravel()
    sizes = forward[:, 6:7] if kind == "disc" else forward[:, 6:8]
    lengths = [0.3] if kind == "disc" else [0.6, 0.4]
    assert_close(sizes @ lengths, offsets)


def test_radiance_has_its_derivative_and_is_finite_at_the_light():
    light = LIGHTS["disc"]
    points = jnp.asarray(np.array([[0.1, 0.5, 0.3], light.position, [0.0, 5.0, 0.0]]))
    total = lambda points: jnp.sum(light.radiance(points) * jnp.arange(1.0, 4.0))
    slopes = jax.jit(jax.grad(total))(points)
    assert bool(jnp.isfinite(slopes).all())
    numerical = [
        (total(points.at[0, k].add(1e-6)) - total(points.at[0, k].add(-1e-6))) / 2e-6
        for k in range(3)
    ]
    np.testing.assert_allclose(slopes[0], numerical, rtol=1e-7)
    assert_close(slopes[1:], np.zeros((2, 3)), ulps=0)


# Errors and transformations


@pytest.mark.errors
def test_sizes_and_counts_are_checked():
    with pytest.raises(ValueError, match=r"^DiscLight: expected `radius` of at least 0, got -1"):
        DiscLight(**TILTED, radius=-1.0)
    with pytest.raises(ValueError, match=r"^RectangleLight: expected `height` .* got nan"):
        RectangleLight(**TILTED, width=1.0, height=np.nan)
    with pytest.raises(ValueError, match=r"^DiscLight.sample_points: expected `count` .* got 0"):
        LIGHTS["disc"].sample_points(0)


@pytest.mark.parametrize("kind", LIGHTS)
def test_moving_the_world_moves_the_light(kind):
    light = LIGHTS[kind]
    turn = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
    turn *= np.linalg.det(turn)
    pose = {"position": turn @ light.position + 1, "direction": turn @ light.direction}
    if kind == "rectangle":
        moved = RectangleLight(**pose, width=0.6, height=0.4, up=turn @ light.up, color=COLOR)
        expected = np.asarray(light.sample_points(9)) @ turn.T + 1
        assert_close(moved.sample_points(9), expected)
    else:  # a disc has no up; its points may turn about its normal
        moved = DiscLight(**pose, radius=0.3, color=COLOR)
        of = lambda light: np.linalg.norm(light.sample_points(9) - light.position, axis=1)
        assert_close(of(moved), of(light))
    points = np.random.default_rng(2).normal(size=(20, 3))
    there = jnp.asarray(points @ turn.T + 1)
    assert_close(radiance(moved, there), radiance(light, jnp.asarray(points)), ulps=256)
