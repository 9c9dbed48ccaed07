"""Shadow volumes against counted triangles, closed forms and rays; where the eye stands is free.

The oracle counts, in float64 and one triangle at a time, which faces the segment from a
point to the light meets. Where that passes within rounding of an edge, nothing is asked.
"""

import functools
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.ndimage

from experiments.scenes import load_scene
from experiments.truth.rays import Occluders, trace_visibility
from shadows import (
    DirectionalLight,
    Light,
    MeshEdges,
    OrthographicCamera,
    PerspectiveCamera,
    PointLight,
    SpotLight,
    Surface,
    blocker_counts,
    look_at,
    mesh_edges,
    render_surface,
    shade,
    volume_visibility,
)
from shadows.silhouettes import silhouette, turned_to_light
from tangentspace import shapes
from tangentspace.mesh import Mesh

from .tools import assert_close

UP = np.array([0.0, 1.0, 0.0])
IMAGE = (48, 64)
FAR = 30.0

# Compiled without optimization: each runs a few times, on small images.
quick = functools.partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})
render_padded = quick(lambda mesh, camera: render_surface(mesh, camera, image_size=IMAGE))
count_padded = quick(
    lambda mesh, camera, surface, light, edges: blocker_counts(
        mesh, camera, surface, light, edges=edges
    )
)
# Vertices, faces and edges that a mesh is filled up to, so that few shapes compile.
SIZES = ((64, 32, 64), (4096, 6144, 9216))


def padded(mesh, edges):
    """Add unused vertices, faces of three equal corners and edges that no face has."""
    counts = len(mesh.positions), len(mesh.faces), len(edges.vertices)
    vertices, faces, ends = next(size for size in SIZES if np.all(np.array(size) >= counts))
    fill = lambda array, size: np.pad(array, ((0, size - len(array)), (0, 0)))
    mesh = Mesh(
        fill(mesh.positions, vertices), fill(mesh.normals, vertices), fill(mesh.faces, faces)
    )
    return mesh, MeshEdges(
        fill(edges.vertices, ends), fill(edges.edge_ids, faces), fill(edges.directions, faces)
    )


class Seen(NamedTuple):
    """A ``Surface``, and what tests ask of it as NumPy arrays."""

    surface: Surface
    face_ids: np.ndarray
    covered: np.ndarray
    position: np.ndarray
    face_normal: np.ndarray
    to_camera: np.ndarray


def look(mesh, camera):
    mesh, _ = padded(mesh, mesh_edges(mesh.positions, mesh.faces))
    surface = render_padded(mesh, camera)
    return Seen(surface, *(np.asarray(getattr(surface, name)) for name in Seen._fields[1:]))


def count_of(mesh, camera, seen, light, edges=None):
    if edges is None:
        edges = mesh_edges(mesh.positions, mesh.faces)
    mesh, edges = padded(mesh, edges)
    return np.asarray(count_padded(mesh, camera, seen.surface, light, edges))


def lit(seen, light, counts):
    """What ``volume_visibility`` is to answer, as a mask."""
    rays, _ = rays_to_light(seen.position, light)
    return (np.sum(seen.face_normal * rays, axis=-1) > 0) & seen.covered & (counts == 0)


def unit(*vector):
    return np.array(vector) / np.linalg.norm(vector)


def single(tree):
    """All numbers of a camera, light or mesh in float32, integers aside."""
    narrow = lambda x: np.asarray(x, None if np.asarray(x).dtype.kind == "i" else np.float32)
    return jax.tree.map(narrow, tree)


def moved(mesh, *offset):
    return mesh._replace(positions=mesh.positions + np.array(offset, mesh.positions.dtype))


def view(position, target, near=0.05, far=FAR, fov=0.9):
    view_from_world = np.asarray(look_at(np.array(position), np.array(target), UP))
    return PerspectiveCamera(view_from_world, fov, near, far)


def parallel_view(position, target, near=0.05, far=FAR):
    view_from_world = np.asarray(look_at(np.array(position), np.array(target), UP))
    return OrthographicCamera(view_from_world, 2.0, near, far)


def soup(seed):
    """Fourteen triangles that cross each other, two of them over one edge of a third."""
    corners = np.random.default_rng(seed).normal(size=(14, 3, 3))
    corners[1, :2] = corners[0, :2]
    corners[2, :2] = corners[0, 1::-1]
    faces = np.arange(42, dtype=np.int32).reshape(-1, 3)
    return Mesh(corners.reshape(-1, 3), np.ones((42, 3)), faces)


def box_over_floor():
    box = moved(shapes.box((0.6, 0.3, 0.5), dtype=np.float64), 0.2, 1.0, 0.1)
    return shapes.merge(box, shapes.plane(3.0, dtype=np.float64))


# The oracle


class Reference(NamedTuple):
    """Blockers of each pixel's point, and how near the count is to another one."""

    counts: np.ndarray
    margin: np.ndarray


def rays_to_light(points, light):
    """Vectors to the light, and the share of them that the light's rays go."""
    if isinstance(light, DirectionalLight):
        return np.broadcast_to(np.asarray(light.direction, np.float64), points.shape), np.inf
    return np.asarray(light.position, np.float64) - points, 1.0


def count_reference(mesh, seen, light):
    """Count the faces between each point and the light, one face at a time, in float64.

    The point's own face counts where the eye looks at its dark side.
    """
    points = seen.position.astype(np.float64)
    face_ids = seen.face_ids
    rays, reach = rays_to_light(points, light)
    to_camera = seen.to_camera.astype(np.float64)
    counts = np.zeros(face_ids.shape, int)
    margin = np.full(face_ids.shape, np.inf)
    for face_id, (a, b, c) in enumerate(np.asarray(mesh.positions, np.float64)[mesh.faces]):
        normal = np.cross(b - a, c - a)
        slope = rays @ normal
        own = face_ids == face_id
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = (a - points) @ normal / slope
            hit = points + distance[..., None] * rays
            weights = [
                np.cross(q - p, hit - p) @ normal / (normal @ normal)
                for p, q in ((a, b), (b, c), (c, a))
            ]
            inner = [*weights, distance, (reach - distance) if np.isfinite(reach) else distance]
        inner = np.nan_to_num(np.min(inner, axis=0), nan=-np.inf)
        dark_side = (to_camera @ normal > 0) != (slope > 0)
        counts += np.where(own, dark_side, inner > 0)
        margin = np.minimum(margin, np.where(own, np.inf, np.abs(inner)))
    return Reference(np.where(face_ids >= 0, counts, 0), margin)


def assert_counts(mesh, camera, light, *, margin, decided):
    """Assert that counts are the oracle's wherever that is decided, at a share of pixels."""
    seen = look(mesh, camera)
    counts = count_of(mesh, camera, seen, light)
    reference = count_reference(mesh, seen, light)
    sure = seen.covered & (reference.margin > margin)
    assert np.sum(sure) >= decided * np.sum(seen.covered) > 0
    assert_close(np.where(sure, counts, 0), np.where(sure, reference.counts, 0))
    return counts


# Known answers

CAMERAS = {
    "outside": view((3.0, 4.0, 5.0), (0.0, 0.3, 0.0)),
    "in shadow": view((0.0, 0.25, 0.1), (2.0, 0.5, 1.0)),
    "in the box": view((0.3, 1.1, 0.0), (1.0, 0.5, 1.0), near=0.01),
    "near plane in the box": view((0.2, 1.4, 2.0), (0.2, 0.9, 0.0), near=1.9),
    "near plane on the floor": view((0.2, 0.3, 2.5), (0.2, 0.0, 0.0), near=1.0),
    "far plane in the box": view((0.2, 1.4, 3.0), (0.2, 0.9, 0.0), far=2.9),
    "from below": view((0.5, -3.0, 1.0), (0.0, 1.0, 0.0)),
    "parallel": parallel_view((3.0, 4.0, 5.0), (0.0, 0.3, 0.0)),
    "parallel, near plane in the box": parallel_view((0.2, 1.4, 2.0), (0.2, 0.9, 0.0), near=2.0),
    "parallel, far plane in the box": parallel_view((0.2, 1.4, 3.0), (0.2, 0.9, 0.0), far=2.9),
}
LIGHTS = {
    "sun": DirectionalLight(unit(0.5, 0.8, -0.4)),
    "noon": DirectionalLight(UP),
    "point": PointLight(np.array([0.4, 2.0, 0.3])),
    "lamp in the box": PointLight(np.array([0.3, 1.1, 0.2])),
}


@pytest.mark.parametrize("light", LIGHTS)
@pytest.mark.parametrize("camera", CAMERAS)
def test_box_over_floor_is_counted_right_wherever_the_eye_stands(camera, light):
    # At noon the walls lie within the light's rays: there rounding decides.
    decided = 0.3 if light == "noon" else 0.99
    assert_counts(box_over_floor(), CAMERAS[camera], LIGHTS[light], margin=1e-9, decided=decided)


def test_spot_casts_shadow_in_all_directions():
    """Its cone is its light's matter: beyond it, nothing arrives that could be blocked."""
    light = SpotLight(np.array([1.5, 4.0, -1.0]), unit(-1.3, -3.5, 1.2), outer_angle=0.1)
    assert_counts(box_over_floor(), CAMERAS["outside"], light, margin=1e-9, decided=0.99)


@pytest.mark.parametrize("camera", ["outside", "in shadow"])
def test_shadow_of_a_box_is_a_rectangle(camera, dtype):
    """Under a lamp two above the floor, the box's top at 1.3 throws the longer shadow."""
    mesh, eye, lamp = box_over_floor(), CAMERAS[camera], PointLight(np.array([0.2, 2.0, 0.1]))
    if dtype == np.float32:
        mesh, eye, lamp = single((mesh, eye, lamp))
    seen = look(mesh, eye)
    counts = count_of(mesh, eye, seen, lamp)
    assert seen.position.dtype == dtype
    x, _, z = np.moveaxis(seen.position - np.array([0.2, 0, 0.1]), -1, 0)
    inside = np.maximum(np.abs(x) / 0.6, np.abs(z) / 0.5) * (2.0 - 1.3) / 2.0
    floor = seen.face_ids >= 12
    sure = floor & (np.abs(inside - 1) > 1e-5)
    assert np.sum(sure & (inside < 1)) > 50
    assert_close(counts[sure], np.where(inside < 1, 2, 0)[sure].astype(counts.dtype))


@quick
def see_box(surface, light):
    """The edges are found while tracing: the mesh is not traced."""
    return volume_visibility(box_over_floor(), CAMERAS["outside"], surface, light)


@pytest.mark.parametrize("light", ["sun", "noon"])
def test_visibility_is_1_where_nothing_blocks_light_that_the_face_looks_at(light):
    """Zero on the background and on averted faces, also where the light just grazes them."""
    mesh, eye, light = box_over_floor(), CAMERAS["outside"], LIGHTS[light]
    seen = look(mesh, eye)
    visibility = see_box(seen.surface, light)
    assert visibility.dtype == np.float64
    expected = lit(seen, light, count_of(mesh, eye, seen, light))
    averted = seen.face_normal @ light.direction <= 0
    for part in (expected, averted, ~seen.covered, seen.covered & ~averted & ~expected):
        assert np.sum(part) > 20
    assert_close(visibility, 1.0 * expected, ulps=0)
    color = np.asarray(shade(seen.surface, [light], [visibility]))
    assert np.min(color[expected]) > np.max(color[seen.covered & ~expected]) > 0


@pytest.mark.parametrize("position", [(3.0, 4.0, 5.0), (0.2, 1.0, 3.0), (-3.0, 0.3, 0.1)])
def test_lamp_at_the_eye_shows_no_shadow(position):
    mesh, eye = box_over_floor(), view(position, (0.0, 0.3, 0.0))
    seen = look(mesh, eye)
    lamp = PointLight(np.array(position))
    counts = count_of(mesh, eye, seen, lamp)
    assert np.sum(seen.covered) > 100
    assert_close(counts, np.zeros_like(counts))


@pytest.mark.parametrize("direction", [(0.0, 1.0, 0.0), (3.0, 4.0, 5.0), (0.0, 0.0, 1.0)])
def test_parallel_light_along_a_parallel_view_shows_no_shadow(direction):
    """Volumes then have no sides in the image, and end in the point where the eye's rays do."""
    mesh, eye = box_over_floor(), parallel_view(4 * np.array(direction), (0.0, 0.0, 0.0))
    seen = look(mesh, eye)
    light = DirectionalLight(unit(*direction))
    facing = seen.face_normal @ light.direction > 1e-6
    assert np.sum(facing) > 100
    assert not np.any(count_of(mesh, eye, seen, light)[facing])


@pytest.mark.parametrize("lamp", [(0.8, 3.0, 0.1), (0.8, 3.0, 0.6), (0.2, 3.0, 0.1)])
def test_lamp_straight_above_an_edge_under_a_parallel_view(lamp):
    """The eye's rays end in the very direction in which the lamp sees an edge or a corner."""
    eye = parallel_view((0.0, 5.0, 0.0), (0.0, 0.0, 0.0))
    mesh, light = box_over_floor(), PointLight(np.array(lamp))
    assert_counts(mesh, eye, light, margin=1e-9, decided=0.9)


# Any triangles


@pytest.mark.parametrize("light", ["sun", "point"])
@pytest.mark.parametrize("camera", ["outside", "in the middle", "parallel"])
@pytest.mark.parametrize("seed", range(3))
def test_any_triangles_are_counted_as_rays_would(seed, camera, light):
    """Open, crossing, three at an edge, wound at random: no two need each other."""
    cameras = CAMERAS | {"in the middle": view((0.1, 0.2, 0.3), (1.0, 0.0, 0.0), fov=1.6)}
    mesh = soup(seed)
    counts = assert_counts(mesh, cameras[camera], LIGHTS[light], margin=1e-9, decided=0.95)
    assert counts.max() >= 2


def test_single_precision_errs_only_at_edges():
    mesh, eye, light = single((soup(1), CAMERAS["outside"], LIGHTS["point"]))
    assert_counts(mesh, eye, light, margin=1e-5, decided=0.95)


@pytest.mark.parametrize("light", ["sun", "point"])
def test_closed_meshes_are_entered_as_often_as_left(light):
    """Two linked rings: seen from outside, the number is even, and not 0 on averted faces."""
    ring = shapes.torus(1.0, 0.3, major_segments=24, minor_segments=12, dtype=np.float64)
    upright = ring._replace(positions=ring.positions[:, [0, 2, 1]] * [1, -1, 1])
    mesh = shapes.merge(ring, moved(upright, 1.0, 0.0, 0.0))
    eye = view((2.5, 2.0, 3.0), (0.5, 0.0, 0.0))
    mesh, eye, source = single((mesh, eye, LIGHTS[light]))
    seen = look(mesh, eye)
    counts = count_of(mesh, eye, seen, source)
    rays, _ = rays_to_light(seen.position, source)
    facing = np.sum(seen.face_normal * rays, axis=-1)
    assert not np.any(counts % 2)
    assert np.all(counts[seen.covered & (facing < -1e-5)] >= 2)
    for number in (0, 2):
        assert np.sum((counts == number) & (facing > 0)) > 20


def test_convex_body_does_not_shade_its_lit_side():
    """Where faces are nearly in the light's rays too, up to one part in a thousand."""
    mesh = shapes.icosphere(1.0, subdivisions=3)
    for seed in range(4):
        direction, eye = np.random.default_rng(seed).normal(size=(2, 3))
        camera, light = single(
            (view(3 * unit(*eye), np.zeros(3)), DirectionalLight(unit(*direction)))
        )
        seen = look(mesh, camera)
        facing = seen.face_normal @ light.direction > 1e-3
        assert not np.any(count_of(mesh, camera, seen, light)[facing])


# Laws


def permuted(mesh, rng):
    order = rng.permutation(len(mesh.positions))
    inverse = np.argsort(order).astype(np.int32)
    return mesh._replace(
        positions=mesh.positions[order], normals=mesh.normals[order], faces=inverse[mesh.faces]
    )


SAME_SCENE = {
    "vertices in another order": permuted,
    "faces in another order": lambda mesh, rng: mesh._replace(faces=rng.permutation(mesh.faces)),
    "corners rotated": lambda mesh, rng: mesh._replace(faces=np.roll(mesh.faces, 1, axis=1)),
    "faces inside out": lambda mesh, rng: mesh._replace(faces=mesh.faces[:, ::-1]),
    "some faces inside out": lambda mesh, rng: mesh._replace(
        faces=np.where(rng.random((len(mesh.faces), 1)) < 0.5, mesh.faces, mesh.faces[:, ::-1])
    ),
    "negative zeros": lambda mesh, rng: mesh._replace(
        positions=np.where(rng.random(mesh.positions.shape) < 0.5, -0.0, 0.0) + mesh.positions
    ),
}


@pytest.mark.parametrize("change", SAME_SCENE)
@pytest.mark.parametrize("light", ["sun", "point"])
def test_how_a_mesh_is_written_down_changes_nothing(change, light):
    mesh, eye, source = box_over_floor(), CAMERAS["outside"], LIGHTS[light]
    other = SAME_SCENE[change](mesh, np.random.default_rng(0))
    counts = [count_of(m, eye, look(m, eye), source) for m in (mesh, other)]
    assert np.max(counts[0]) >= 2
    assert_close(counts[1], counts[0])


@pytest.mark.parametrize("light", ["sun", "point"])
def test_welding_saves_sides_and_changes_nothing(light):
    """Unwelded, every side is drawn, once for each of its two faces, and cancels."""
    mesh, eye = box_over_floor(), CAMERAS["outside"]
    split = mesh._replace(
        positions=mesh.positions[mesh.faces].reshape(-1, 3),
        normals=mesh.normals[mesh.faces].reshape(-1, 3),
        faces=np.arange(mesh.faces.size, dtype=np.int32).reshape(-1, 3),
    )
    seen = look(split, eye)
    apart = np.arange(mesh.faces.size, dtype=np.float64).reshape(-1, 1) * np.ones(3)
    edges = mesh_edges(split.positions, split.faces), mesh_edges(apart, split.faces)
    assert [len(e.vertices) for e in edges] == [18 + 5, 36 + 6]
    one, other = (count_of(split, eye, seen, LIGHTS[light], e) for e in edges)
    assert_close(one, other)


def test_edges_serve_the_mesh_in_motion():
    """Found once; the box turns, and its seams stay together."""
    mesh, eye, light = box_over_floor(), CAMERAS["outside"], LIGHTS["sun"]
    turn = np.array([[0.6, 0.0, 0.8], [0.0, 1.0, 0.0], [-0.8, 0.0, 0.6]])
    turned = mesh._replace(positions=mesh.positions @ turn.T)
    seen = look(turned, eye)
    kept, anew = (
        count_of(turned, eye, seen, light, mesh_edges(m.positions, m.faces)) for m in (mesh, turned)
    )
    assert_close(kept, anew)


def test_faces_with_a_corner_that_is_not_finite_cast_nothing():
    mesh, eye, light = box_over_floor(), CAMERAS["outside"], LIGHTS["point"]
    broken = mesh._replace(
        positions=np.concatenate([mesh.positions, [[np.nan, 0, 0], [np.inf, 3, 0]]]),
        normals=np.concatenate([mesh.normals, np.ones((2, 3))]),
        faces=np.concatenate([mesh.faces, [[0, 1, 28], [3, 2, 29]]]).astype(np.int32),
    )
    whole, other = (count_of(m, eye, look(m, eye), light) for m in (mesh, broken))
    assert_close(other, whole)


# Silhouettes


def test_silhouette_of_a_cube_seen_from_a_corner_is_a_hexagon():
    cube = shapes.box()
    edges = mesh_edges(cube.positions, cube.faces)
    assert edges.vertices.shape == (18, 2)
    turned = turned_to_light(cube.positions, cube.faces, jnp.array([3.0, 4.0, 5.0, 0.0]))
    assert sorted(np.asarray(turned)) == 6 * [-1] + 6 * [1]
    runs = np.asarray(silhouette(edges, turned))
    assert sorted(np.abs(runs)) == 12 * [0] + 6 * [2]
    ends = np.asarray(edges.vertices)[runs != 0]
    for corner in np.asarray(cube.positions)[ends.ravel()]:
        assert abs(np.dot(corner, [3.0, 4.0, 5.0])) < 12  # neither the nearest nor the farthest
    # Each run continues the one before: at every corner as many arrive as leave.
    flow = np.zeros(len(cube.positions), int)
    np.add.at(flow, ends[:, 0], -runs[runs != 0])
    np.add.at(flow, ends[:, 1], runs[runs != 0])
    assert not np.any(flow)


@pytest.mark.parametrize("height", [1.0, -1.0])
def test_border_counts_once_and_inner_edges_cancel(height):
    sheet = shapes.plane(1.0, segments=2)
    edges = mesh_edges(sheet.positions, sheet.faces)
    light = jnp.array([0.1, height, 0.2, 1.0])
    runs = silhouette(edges, turned_to_light(sheet.positions, sheet.faces, light))
    assert sorted(np.abs(np.asarray(runs))) == 8 * [0] + 8 * [1]


def test_edge_of_three_faces_counts_what_is_left():
    """Two of the three run it one way as the light sees them, and one the other way."""
    positions = np.array([[0, 0, -1], [0, 0, 1], [1, 0.1, 0], [1, 0.5, 0], [-1, 0, 0.0]])
    faces = np.array([[0, 1, 2], [1, 0, 3], [0, 1, 4]])
    edges = mesh_edges(positions, faces)
    runs = silhouette(edges, turned_to_light(positions, faces, jnp.array([0.0, 1.0, 0.0, 0.0])))
    shared = np.all(np.sort(edges.vertices, axis=1) == [0, 1], axis=1)
    assert sorted(np.abs(np.asarray(runs))) == 7 * [1]
    assert np.sum(shared) == 1


def test_faces_with_equal_corners_have_no_run_there():
    positions = np.array([[0, 0, 0], [1, 0, 0], [0, 0, 1], [0, 0, 0.0]])
    edges = mesh_edges(positions, np.array([[0, 1, 2], [0, 1, 3]]))
    assert edges.directions[1].tolist() == [1, -1, 0]
    assert edges.edge_ids[1, 0] == edges.edge_ids[1, 1]


# Rays


def assert_agrees_with_rays(mesh, camera, light):
    """At most one pixel in a thousand differs, and only beside the edge of a shadow."""
    mesh, camera, light = single((mesh, camera, light))
    seen = look(mesh, camera)
    found = lit(seen, light, count_of(mesh, camera, seen, light))
    truth = trace_visibility(
        seen.position,
        seen.face_normal,
        seen.face_ids,
        light,
        Occluders(mesh.positions, mesh.faces),
    )
    covered = seen.covered
    kinds = covered & truth, covered & ~truth
    assert min(map(np.sum, kinds)) > 20
    edge = np.logical_and(*(scipy.ndimage.binary_dilation(m, np.ones((3, 3))) for m in kinds))
    wrong = covered & (found != truth)
    assert np.sum(wrong) <= 1e-3 * np.sum(covered)
    assert not np.any(wrong & ~edge)


def ring_over_floor():
    """Closed but for the floor; ring, ball and box, in single precision."""
    ring = moved(shapes.torus(0.7, 0.25, major_segments=24, minor_segments=12), 0.0, 1.0, 0.0)
    ball = moved(shapes.icosphere(0.3, subdivisions=2), 0.0, 1.0, 0.0)
    return shapes.merge(ring, ball, shapes.box((0.2, 0.4, 0.2)), shapes.plane(3.0))


EYES = {
    "outside": ((2.0, 2.5, 3.0), (0.0, 0.5, 0.0), 0.1),
    "in shadow": ((-0.5, 0.15, 0.55), (0.5, 0.5, -0.5), 0.01),
    "in the ring": ((0.7, 1.0, 0.0), (-0.7, 0.9, 0.1), 0.3),
    "near plane in the ring": ((0.1, 1.2, 2.2), (0.0, 0.9, 0.0), 1.6),
}


@pytest.mark.parametrize("light", ["sun", "point"])
@pytest.mark.parametrize("eye", EYES)
def test_agrees_with_rays_wherever_the_eye_stands(eye, light):
    """Measured here: no pixel differs. At 512 x 512, on larger meshes: up to 0.003 %."""
    position, target, near = EYES[eye]
    source = LIGHTS["sun"] if light == "sun" else PointLight(np.array([0.6, 2.2, 0.7]))
    assert_agrees_with_rays(ring_over_floor(), view(position, target, near), source)


@pytest.mark.parametrize("name", ["default", "spot"])
def test_agrees_with_rays_on_scenes(name):
    scene = load_scene(name)
    light = scene.lights[0]
    if isinstance(light, SpotLight):
        light = PointLight(light.position)
    assert_agrees_with_rays(scene.mesh, scene.camera, light)


# Derivatives


def test_all_derivatives_are_zero():
    mesh, eye = box_over_floor(), CAMERAS["outside"]
    edges = mesh_edges(mesh.positions, mesh.faces)

    def total(positions, place):
        mesh_there = mesh._replace(positions=positions)
        surface = render_surface(mesh_there, eye, image_size=IMAGE)
        visibility = volume_visibility(mesh_there, eye, surface, PointLight(place), edges=edges)
        return jnp.sum(visibility)

    @quick
    def derivatives(*at):
        return jax.grad(total, argnums=(0, 1))(*at), jax.jvp(total, at, at)[1]

    derivatives = derivatives(mesh.positions, LIGHTS["point"].position)
    for derivative in jax.tree.leaves(derivatives):
        assert_close(derivative, np.zeros_like(derivative), ulps=0)


# Errors


class Lamp(Light):
    """A light of a kind that volumes do not know."""

    def to_light(self, positions):
        return positions

    def radiance(self, positions):
        return positions

    def clip_from_world(self, points):
        return jnp.eye(4)


@pytest.mark.errors
class TestErrors:
    """What a user may get wrong; float32 arrays, no shape checks but the code's own."""

    mesh, eye, light = box_over_floor(), CAMERAS["outside"], LIGHTS["sun"]

    @pytest.mark.parametrize("function", [volume_visibility, blocker_counts])
    def test_light_of_another_kind(self, function):
        seen = look(self.mesh, self.eye)
        with pytest.raises(ValueError, match=r"`light` to be .*PointLight, got a Lamp; "):
            function(self.mesh, self.eye, seen.surface, Lamp())

    def test_edges_of_another_mesh(self):
        seen = look(self.mesh, self.eye)
        edges = mesh_edges(self.mesh.positions, self.mesh.faces[:5])
        with pytest.raises(ValueError, match=r"`edges` of the mesh's 14 faces, got those of 5; "):
            blocker_counts(self.mesh, self.eye, seen.surface, self.light, edges=edges)

    def test_edges_that_name_missing_vertices(self):
        seen = look(self.mesh, self.eye)
        edges = mesh_edges(self.mesh.positions, self.mesh.faces)
        edges = edges._replace(vertices=edges.vertices + 1)
        with pytest.raises(eqx.EquinoxRuntimeError, match=r"refer to a vertex outside 0\.\.27"):
            blocker_counts(self.mesh, self.eye, seen.surface, self.light, edges=edges)

    def test_traced_mesh_without_edges(self):
        @jax.jit
        def traced(mesh):
            surface = render_surface(mesh, self.eye, image_size=IMAGE)
            return volume_visibility(mesh, self.eye, surface, self.light)

        with pytest.raises(ValueError, match=r"got traced ones; call it outside `jit` and pass"):
            traced(self.mesh)

    @pytest.mark.parametrize(
        ("positions", "faces", "message"),
        [
            (np.ones((3, 2)), np.ones((1, 3), int), r"`positions` of shape .*got \(3, 2\)"),
            (np.ones((3, 3)), np.ones((1, 4), int), r"`faces` \(faces > 0, 3\), got \(1, 4\)"),
            (np.ones((3, 3)), np.ones((0, 3), int), r"`faces` \(faces > 0, 3\), got \(0, 3\)"),
            (np.ones((3, 3)), np.array([[0, 1, 3]]), r"`faces` from 0 to 2 .*got 0 to 3"),
            (np.ones((3, 3)), np.array([[0, 1, -1]]), r"`faces` from 0 to 2 .*got -1 to 1"),
        ],
    )
    def test_arrays_that_are_no_mesh(self, positions, faces, message):
        with pytest.raises(ValueError, match=rf"mesh_edges: expected {message}"):
            mesh_edges(positions, faces)


# Transformations


def test_vmap_over_lights_equals_a_loop():
    mesh, eye = box_over_floor(), CAMERAS["outside"]
    seen, edges = look(mesh, eye), mesh_edges(mesh.positions, mesh.faces)
    places = np.array([[0.4, 2.0, 0.3], [1.5, 4.0, -1.0], [-2.0, 2.0, 0.0]])
    one = lambda place: blocker_counts(mesh, eye, seen.surface, PointLight(place), edges=edges)
    together = quick(jax.vmap(one))(places)
    for place, counts in zip(places, together, strict=True):
        assert_close(counts, count_of(mesh, eye, seen, PointLight(place)))
