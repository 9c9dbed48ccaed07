"""Ray-traced shadows against closed forms, a float64 loop over triangles, and laws."""

import numpy as np
import pytest
import trimesh

from experiments.truth.rays import Occluders, nearest_occluder_distance, trace_visibility
from shadows.lights import DirectionalLight, PointLight, SpotLight

DOWN = np.array([0.0, -1.0, 0.0])


def unit(*vector):
    return np.array(vector) / np.linalg.norm(np.array(vector))


def normals_of(positions, faces):
    a, b, c = np.moveaxis(positions.astype(np.float64)[faces], 1, 0)
    normals = np.cross(b - a, c - a)
    return normals / np.linalg.norm(normals, axis=1, keepdims=True)


def surface_samples(rng, positions, faces, count):
    """Return points, their faces' normals, and the faces, spread by area."""
    corners = positions.astype(np.float64)[faces]
    area = np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    )
    chosen = rng.choice(len(faces), count, p=area / area.sum())
    weights = rng.dirichlet([1, 1, 1], count)
    points = np.einsum("pk,pkx->px", weights, corners[chosen])
    return points, normals_of(positions, faces)[chosen], chosen


def rotation(seed):
    return np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0]


def quad(half, height, center=(0.0, 0.0)):
    """Return a square that faces upwards."""
    x, z = center
    offsets = np.array([[-1, 0, -1], [-1, 0, 1], [1, 0, 1], [1, 0, -1]])
    return half * offsets + np.array([x, height, z]), np.array([[0, 1, 2], [0, 2, 3]])


def join(*parts):
    starts = np.cumsum([0] + [len(positions) for positions, _ in parts])
    return (
        np.concatenate([positions for positions, _ in parts]),
        np.concatenate([faces + start for (_, faces), start in zip(parts, starts, strict=False)]),
    )


def floor_points(half=2.0, size=61):
    """Return an image of points on a floor, their normals and (first) faces."""
    x, z = np.meshgrid(np.linspace(-half, half, size), np.linspace(-half, half, size))
    points = np.stack([x, np.zeros_like(x), z], axis=-1)
    first_half = (x - z <= 0).astype(np.int32)
    return points, np.broadcast_to([0.0, 1.0, 0.0], points.shape), 1 - first_half


def traced(image, light, occluders):
    """Return visibility and occluder distance, checked against each other."""
    points, normals, faces = image
    lit = trace_visibility(points, normals, faces, light, occluders)
    distances = nearest_occluder_distance(points, normals, faces, light, occluders)
    assert not np.any(lit & np.isfinite(distances))
    return lit, distances


def blocked_in_float64(points, to_light, reach, own, positions, faces):
    """Return the distance to the first other triangle, one triangle at a time."""
    nearest = np.full(len(points), np.inf)
    for face, (a, b, c) in enumerate(positions.astype(np.float64)[faces]):
        edges = np.stack([b - a, c - a], axis=-1)
        columns = np.concatenate(
            [-to_light[..., None], np.broadcast_to(edges, (len(points), 3, 2))], axis=-1
        )
        distance, u, v = np.linalg.solve(columns, (points - a)[..., None])[..., 0].T
        hit = (distance > 0) & (distance < reach) & (u >= 0) & (v >= 0) & (u + v <= 1)
        nearest = np.where(hit & (own != face), np.minimum(nearest, distance), nearest)
    return nearest


# Known answers


def test_floating_square_under_parallel_light():
    half, height = 0.5, 0.75
    mesh = join(quad(5.0, 0.0), quad(half, height, (0.1, 0.2)))
    to_light = unit(0.3, 1.0, -0.6)
    image = floor_points()
    lit, distances = traced(image, DirectionalLight(to_light), Occluders(*mesh))
    hit = image[0] + (height / to_light[1]) * to_light - [0.1, height, 0.2]
    shadow = np.max(np.abs(hit[..., [0, 2]]), axis=-1) < half
    assert 0.05 < shadow.mean() < 0.1
    np.testing.assert_array_equal(lit, ~shadow)
    expected = np.where(shadow, height / to_light[1], np.inf)
    np.testing.assert_allclose(distances, expected, rtol=1e-5)  # measured 3e-6


@pytest.mark.parametrize("kind", ["point", "spot"])
def test_squares_below_and_above_a_light(kind):
    """The shadow of the lower square is magnified; the upper one is behind the light."""
    half, height, light_height = 0.5, 0.5, 2.0
    position = np.array([0.2, light_height, 0.1])
    light = PointLight(position) if kind == "point" else SpotLight(position, DOWN)
    mesh = join(quad(5.0, 0.0), quad(half, height), quad(5.0, 2 * light_height))
    image = floor_points()
    lit, distances = traced(image, light, Occluders(*mesh))
    hit = image[0] + (height / light_height) * (position - image[0])
    shadow = np.max(np.abs(hit[..., [0, 2]]), axis=-1) < half
    assert 0.1 < shadow.mean() < 0.2
    np.testing.assert_array_equal(lit, ~shadow)
    length = np.linalg.norm(position - image[0], axis=-1) * height / light_height
    expected = np.where(shadow, length, np.inf)
    np.testing.assert_allclose(distances, expected, rtol=2e-5)  # measured 5e-6


def test_sphere_on_a_floor():
    ball = trimesh.creation.icosphere(5)
    mesh = join(quad(5.0, 0.0), (np.asarray(ball.vertices) - DOWN, np.asarray(ball.faces)))
    to_light = unit(0.3, 1.0, -0.6)
    image = floor_points(size=201)
    lit, _ = traced(image, DirectionalLight(to_light), Occluders(*mesh))
    to_center = [0, 1, 0] - image[0]
    passing = np.linalg.norm(np.cross(to_center, to_light), axis=-1)
    clear = np.abs(passing - 1) > 1e-3  # the flat faces stay within 8e-4 of the sphere
    assert clear.mean() > 0.99
    np.testing.assert_array_equal(lit[clear], (passing > 1)[clear])


def test_triangle_soup_against_float64_loop():
    rng = np.random.default_rng(0)
    centers = rng.uniform(-1, 1, (80, 1, 3))
    positions = (centers + rng.normal(scale=0.3, size=(80, 3, 3))).reshape(-1, 3)
    positions = positions.astype(np.float32)
    faces = np.arange(240).reshape(80, 3)
    points, normals, chosen = surface_samples(rng, positions, faces, 4000)
    light = PointLight(np.array([0.5, 1.5, 0.2]))
    occluders = Occluders(positions, faces)
    towards = light.position - points
    length = np.linalg.norm(towards, axis=1)
    to_light = towards / length[:, None]
    facing = np.sum(normals * to_light, axis=1) > 0
    nearest = blocked_in_float64(points, to_light, length, chosen, positions, faces)
    lit, distances = traced((points, normals, chosen), light, occluders)
    assert 0.1 < lit.mean() < 0.4
    np.testing.assert_array_equal(lit, facing & np.isinf(nearest))
    expected = np.where(facing, nearest, np.inf)
    np.testing.assert_allclose(distances, expected, atol=1e-4)  # measured 3e-5, at a grazing hit


# No acne


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
@pytest.mark.parametrize("diameters", [0.0, 1e3, 1e4])
def test_sphere_is_lit_on_exactly_its_facing_half(dtype, scale, diameters):
    ball = trimesh.creation.icosphere(4)
    away = 2 * diameters * unit(1.0, 0.3, -0.7)
    positions = (scale * (np.asarray(ball.vertices) + away)).astype(dtype)
    rng = np.random.default_rng(0)
    points, normals, faces = surface_samples(rng, positions, ball.faces, 100_000)
    to_light = unit(0.3, 1.0, 0.2)
    light, occluders = DirectionalLight(to_light), Occluders(positions, np.asarray(ball.faces))
    lit = trace_visibility(points.astype(dtype), normals, faces, light, occluders)
    np.testing.assert_array_equal(lit, normals @ to_light > 0)  # 0 of 100 000 wrong


@pytest.mark.parametrize(("error", "shift"), [(0.0, 0.0), (1e-6, 0.0), (0.0, 2e3)])
def test_fine_plane_has_no_acne_under_grazing_light(error, shift):
    """Half a degree above a rotated plane of 80 000 faces; points may have rounding errors."""
    size = 201
    x, z = np.meshgrid(np.linspace(-0.5, 0.5, size), np.linspace(-0.5, 0.5, size))
    turn = rotation(1)
    positions = np.stack([x, 0 * x, z], axis=-1).reshape(-1, 3) @ turn.T + shift
    positions = positions.astype(np.float32)
    index = np.arange(size**2).reshape(size, size)
    a, b, c, d = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    faces = np.stack([a, b, c, a, c, d], axis=-1).reshape(-1, 3)
    elevation = np.deg2rad(0.5)
    to_light = turn @ [0.6 * np.cos(elevation), np.sin(elevation), 0.8 * np.cos(elevation)]
    rng = np.random.default_rng(0)
    points, normals, chosen = surface_samples(rng, positions, faces, 100_000)
    normals *= np.sign(normals @ turn[:, 1])[:, None]
    facing = normals @ to_light > 0
    assert facing.mean() > (0.6 if shift else 0.9999)  # far away, coordinates are coarse
    points = (points + error * rng.normal(size=points.shape)).astype(np.float32)
    occluders = Occluders(positions, faces)
    lit = trace_visibility(points, normals, chosen, DirectionalLight(to_light), occluders)
    # 0 of 100 000 wrong; 1.4 % if points stay off their faces, 1.7 % if an offset for the
    # local coordinates is used far away.
    np.testing.assert_array_equal(lit, facing)


@pytest.mark.parametrize("degrees", [90, 135, 179, 181, 270])
@pytest.mark.parametrize("error", [0.0, 1e-5])
def test_crease_of_two_triangles_is_lit_on_both_sides(degrees, error):
    """Points on, next to and (by their errors) beyond the common edge."""
    angle = np.deg2rad(degrees)
    turn = rotation(2)
    tip = [np.cos(angle), np.sin(angle), 0]
    positions = np.array([[0.0, 0, 1], [0, 0, -1], [1, 0, 0], tip])
    positions = (positions @ turn.T).astype(np.float32)
    faces = np.array([[0, 2, 1], [0, 1, 3]])
    normals = normals_of(positions, faces)
    to_light = unit(*(normals[0] + normals[1] + 0.2 * turn[:, 2]))
    normals *= np.sign(normals @ to_light)[:, None]
    rng = np.random.default_rng(0)
    count = 4000
    chosen = rng.integers(0, 2, count)
    inwards = np.where(rng.random(count) < 0.3, 0, 10.0 ** rng.uniform(-9, -3, count))[:, None]
    along = rng.uniform(0.1, 0.9, count)[:, None]
    a, b, tips = positions[0], positions[1], positions[2 + chosen]
    points = (1 - inwards) * ((1 - along) * a + along * b) + inwards * tips
    points = (points + error * rng.normal(size=points.shape)).astype(np.float32)
    light, occluders = DirectionalLight(to_light), Occluders(positions, faces)
    assert trace_visibility(points, normals[chosen], chosen, light, occluders).all()


def test_own_face_does_not_count_but_what_lies_behind_it_does():
    """With a normal that is not its face's, a ray passes through its own face."""
    positions = np.array([[-1, 0, -1], [-1, 0, 1], [1, 0, 0]], np.float32)
    point, face = np.array([[0.1, 0.0, 0.1]]), np.array([0])
    to_light, normal = unit(0.6, -0.3, 0.0), np.array([unit(1.0, 1.0, 0.0)])
    light = DirectionalLight(to_light)
    alone = Occluders(positions, np.array([[0, 1, 2]]))
    np.testing.assert_array_equal(trace_visibility(point, normal, face, light, alone), [True])
    below = np.concatenate([positions, 5 * positions + np.array([0, -0.25, 0], np.float32)])
    both = Occluders(below, np.array([[0, 1, 2], [3, 4, 5]]))
    lit, distances = traced((point, normal, face), light, both)
    assert not lit[0]
    np.testing.assert_allclose(distances, 0.25 / -to_light[1], rtol=1e-5)  # measured 5e-7


# Laws


def scene():
    """Return a ball over a floor, and points on both."""
    ball = trimesh.creation.icosphere(2)
    ball = (0.7 * np.asarray(ball.vertices) + [0.1, 0.9, 0], np.asarray(ball.faces))
    positions, faces = join(quad(2.0, 0.0), ball)
    rng = np.random.default_rng(3)
    return positions, faces, surface_samples(rng, positions, faces, 3000)


LAWS = {
    "translate": (lambda p: p + np.array([500.0, -300.0, 40.0]), lambda v: v, 1.0),
    "rotate": (lambda p: p @ rotation(4).T, lambda v: v @ rotation(4).T, 1.0),
    "shrink": (lambda p: 1e-20 * p, lambda v: v, 1e-20),
    "enlarge": (lambda p: 1e20 * p, lambda v: v, 1e20),
}


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("kind", ["directional", "point"])
def test_law(law, kind):
    move, turn, scale = LAWS[law]
    positions, faces, (points, normals, chosen) = scene()
    source = np.array([1.0, 3.0, 0.5])

    def light_of(change, change_direction):
        if kind == "point":
            return PointLight(change(source))
        return DirectionalLight(change_direction(unit(*source)))

    stay = lambda p: p
    before = traced((points, normals, chosen), light_of(stay, stay), Occluders(positions, faces))
    after = traced(
        (move(points), turn(normals), chosen),
        light_of(move, turn),
        Occluders(move(positions), faces),
    )
    assert 0.5 < before[0].mean() < 0.9
    np.testing.assert_array_equal(after[0], before[0])
    np.testing.assert_allclose(after[1], scale * before[1], rtol=1e-5)  # measured 2e-6


def test_order_of_faces_and_of_points_does_not_matter():
    rng = np.random.default_rng(0)
    positions, faces, (points, normals, chosen) = scene()
    light = DirectionalLight(unit(1.0, 3.0, 0.5))
    lit = trace_visibility(points, normals, chosen, light, Occluders(positions, faces))
    face_order = rng.permutation(len(faces))
    order = rng.permutation(len(points))
    renamed = np.argsort(face_order)[chosen]
    occluders = Occluders(positions, faces[face_order])
    shuffled = trace_visibility(points[order], normals[order], renamed[order], light, occluders)
    np.testing.assert_array_equal(shuffled, lit[order])


def test_faces_without_area_and_far_unused_vertices_change_nothing():
    positions, faces, (points, normals, chosen) = scene()
    light = DirectionalLight(unit(1.0, 3.0, 0.5))
    lit, distances = traced((points, normals, chosen), light, Occluders(positions, faces))
    rng = np.random.default_rng(5)
    a, b = rng.uniform([-2, 0, -2], [2, 1.6, 2], (2, 500, 3))
    lines = np.stack([a, b, a + rng.random((500, 1)) * (b - a)], axis=1).reshape(-1, 3)
    count = len(positions)
    repeated = np.array([[0, 0, 2], [5, 5, 5], [7, 9, 7]])
    flat = np.concatenate([repeated, count + np.arange(1500).reshape(500, 3)])
    unused = np.array([[1e9, 0, 0], [np.nan] * 3])
    more = np.concatenate([positions, lines, unused])
    occluders = Occluders(more, np.concatenate([flat, faces]))
    flawed_lit, flawed_distances = traced((points, normals, chosen + len(flat)), light, occluders)
    np.testing.assert_array_equal(flawed_lit, lit)
    np.testing.assert_array_equal(flawed_distances, distances)


def test_pixels_without_surface_are_dark_and_their_positions_unread():
    points, normals, faces = floor_points(size=9)
    points[0, 0] = np.nan
    faces[0, 0], faces[3, 4] = -1, -1
    occluders = Occluders(*quad(5.0, 0.0))
    lit, distances = traced((points, normals, faces), DirectionalLight(-DOWN), occluders)
    assert lit.shape == (9, 9)
    np.testing.assert_array_equal(lit, faces >= 0)
    assert np.isinf(distances).all()


def test_surface_that_faces_away_is_dark_and_has_no_occluder():
    occluders = Occluders(*join(quad(5.0, 0.0), quad(0.5, 0.75)))
    image = floor_points(size=9)
    for light in (DirectionalLight(DOWN), DirectionalLight(np.array([1.0, 0.0, 0.0]))):
        lit, distances = traced(image, light, occluders)
        assert not lit.any()
        assert np.isinf(distances).all()
    only_flat = Occluders(np.zeros((3, 3)), np.array([[0, 1, 2]]))
    no_faces = np.zeros((9, 9), int)
    assert trace_visibility(*image[:2], no_faces, DirectionalLight(-DOWN), only_flat).all()


# Errors


@pytest.mark.errors
@pytest.mark.parametrize(
    ("positions", "faces", "message"),
    [
        (np.zeros((3, 3)), np.zeros((0, 3), int), "faces > 0"),
        (np.zeros((3, 3)), np.array([[0, 1, 3]]), "from 0 to 2"),
        (np.zeros((3, 3)), np.array([[0, -1, 2]]), "-1 to 2"),
        (np.full((3, 3), np.nan), np.array([[0, 1, 2]]), "finite"),
    ],
)
def test_bad_mesh(positions, faces, message):
    with pytest.raises(ValueError, match=message):
        Occluders(positions, faces)


@pytest.mark.errors
def test_bad_image():
    points, normals, faces = floor_points(size=9)
    occluders = Occluders(*quad(5.0, 0.0))
    light = DirectionalLight(-DOWN)
    with pytest.raises(ValueError, match=r"`geometric_normals` \(9, 9, 3\)"):
        trace_visibility(points, normals[:5], faces, light, occluders)
    with pytest.raises(ValueError, match=r"`positions` \(9, 8, 3\)"):
        nearest_occluder_distance(points, normals, faces[:, :8], light, occluders)
    with pytest.raises(ValueError, match=r"below 2.*got 7"):
        trace_visibility(points, normals, faces + 6, light, occluders)
