"""Places on edges, what is seen at them, and what images and their derivatives gain by it."""

import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from shadows import (
    DirectionalLight,
    PerspectiveCamera,
    blend_layers,
    coverage,
    look_at,
    mesh_edges,
    rasterize,
    render,
    render_surface,
    surface_coverage,
)
from shadows.edge_points import edge_changes
from shadows.surface import edge_surface, mesh_creases
from shadows.transforms import transform_points
from tangentspace.mesh import Mesh
from tangentspace.shapes import box, icosphere, merge, plane

from .test_coverage import flat_clip

VIEW = look_at(np.array([0.4, 0.8, 2.2]), np.array([0.0, 0.2, 0.0]), np.array([0.0, 1.0, 0.0]))
CAMERA = PerspectiveCamera(VIEW, 0.8, 0.1, 20.0)
SIZE = (96, 96)


def ball_and_box() -> Mesh:
    """A smooth ball that a box passes through, over a floor."""
    floor = plane(2.0, dtype=np.float64)._replace(uvs=None)
    ball = icosphere(subdivisions=3, dtype=np.float64)
    ball = ball._replace(positions=0.4 * ball.positions + np.array([0.0, 0.5, 0.0]))
    brick = box((0.5, 0.2, 0.3), dtype=np.float64)
    brick = brick._replace(positions=brick.positions + np.array([0.3, 0.4, 0.2]))
    return merge(floor, ball._replace(uvs=None), brick._replace(uvs=None))


@pytest.fixture(scope="module")
def points():
    """All points of a view, found a few at a time."""
    mesh = ball_and_box()
    edges = mesh_edges(mesh.positions, mesh.faces)
    surface = render_surface(mesh, CAMERA, image_size=SIZE)
    covers = surface_coverage(mesh, CAMERA, surface, edges)
    clip = transform_points(CAMERA.clip_from_world(1.0), mesh.positions)
    found = []

    def look(points):
        # Written through the callback, as it is traced once.
        jax.debug.callback(lambda points: found.append(jax.tree.map(np.asarray, points)), points)
        return jnp.zeros((2, points.rest.size, 1))

    creases = mesh_creases(mesh, edges)
    image = jnp.zeros((*SIZE, 1))
    edge_changes(
        clip, mesh.faces, edges, surface.face_ids, covers, image, look, creases=creases
    ).block_until_ready()
    jax.effects_barrier()
    every = jax.tree.map(lambda *parts: np.concatenate(parts, axis=-1), *found)
    there = every.rest < 4 * SIZE[0] * SIZE[1]
    return mesh, surface, covers, jax.tree.map(lambda x: x[..., there], every)


def test_every_rest_has_a_point_between_its_texels(points):
    _, _, covers, found = points
    rests = np.flatnonzero(np.asarray(covers.rests))
    assert set(rests) <= set(found.rest.tolist())
    row, column = np.divmod(found.texels, SIZE[1])
    assert np.all(np.abs(np.diff(row, axis=0)) + np.abs(np.diff(column, axis=0)) == 1)
    x, y = 0.5 * SIZE[1] * (1 + found.place[0]), 0.5 * SIZE[0] * (1 - found.place[1])
    for axis, at in ((column + 0.5, x), (row + 0.5, y)):
        assert np.all(at >= axis.min(axis=0) - 1e-9)
        assert np.all(at <= axis.max(axis=0) + 1e-9)
    cut = found.rest % (SIZE[0] * SIZE[1])
    assert np.all((cut == found.texels[0]) | (cut == found.texels[1]))


def test_outlines_are_where_their_edges_are(points):
    mesh, surface, _, found = points
    ends = found.ends
    assert 0.2 < ends.mean() < 0.9  # the others are creases, and lines through the ball
    positions = [np.asarray(mesh.positions)[vertex[ends]] for vertex in found.vertices]
    weight = found.weight[ends, None]
    clip = transform_points(
        CAMERA.clip_from_world(1.0), (1 - weight) * positions[0] + weight * positions[1]
    )
    for axis in (0, 1):
        np.testing.assert_allclose(clip[:, axis] / clip[:, 3], found.place[axis][ends], atol=1e-9)
    sides = edge_surface(mesh, CAMERA, surface, jax.tree.map(jnp.asarray, found))
    np.testing.assert_allclose(np.linalg.norm(sides.normal, axis=-1)[sides.covered], 1)
    # The ball's normals are radial, at its outline too.
    ball = ends & (np.linalg.norm(sides.position[0] - np.array([0, 0.5, 0]), axis=1) < 0.401)
    away = (sides.position[0] - np.array([0, 0.5, 0]))[ball]
    along = np.sum(away * sides.normal[0][ball], axis=1) / np.linalg.norm(away, axis=1)
    assert ball.sum() > 50
    assert np.abs(along).min() > 0.998  # chords of the ball


def test_a_pixel_wider_than_a_strip_takes_from_both_sides():
    """A strip of 0.8 pixels: of a pixel's color a tenth is what lies on each side."""
    size, half = 8, 0.8 / 8
    corners = np.array([[-half, -2], [half, -2], [half, 2], [-half, 2]]) + np.array([1 / 8, 0])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    clip = flat_clip(corners)
    ids = rasterize(clip, faces, image_size=(size, size)).face_ids
    found = coverage(clip, faces, mesh_edges(clip[:, :3], faces), ids)
    image = jnp.where(ids >= 0, 5.0, jnp.where(jnp.arange(size) < 4, 1.0, 2.0))
    blended = np.asarray(blend_layers(found, image))[2:-2]
    expected = np.array([1.0, 1.0, 1.0, 1.0, 0.8 * 5 + 0.1 * 1 + 0.1 * 2, 2.0, 2.0, 2.0])
    np.testing.assert_allclose(blended, np.broadcast_to(expected, blended.shape), atol=1e-6)


def test_a_crease_is_no_edge_where_the_surface_ends_behind_it():
    """Between two centres a surface folds and then ends: its area follows the end, not the fold."""
    size, fold, end = 16, 0.33, 0.36  # centres at 0.3125 and 0.4375
    x, y = np.array([-0.51, fold, end, end, fold, -0.51]), 0.52 * np.array([-1, -1, -1, 1, 1, 1])
    clip = jnp.asarray(flat_clip(np.stack([x, y], axis=1)))
    faces = np.array([[0, 1, 4], [0, 4, 5], [1, 2, 3], [1, 3, 4]])
    edges = mesh_edges(clip[:, :3], faces)
    ids = rasterize(clip, faces, image_size=(size, size)).face_ids
    creases = jnp.asarray(np.all(np.isin(edges.vertices, (1, 4)), axis=1))
    assert creases.sum() == 1

    def area(x, creases):
        found = coverage(clip.at[2:4, 0].set(x), faces, edges, ids, creases=creases)
        return jnp.sum(blend_layers(found, (ids >= 0).astype(clip.dtype)))

    slope = jax.jit(jax.grad(area))
    height, per_unit = 0.52 * size, size / 2
    for marked in (creases, jnp.zeros_like(creases)):
        np.testing.assert_allclose(slope(end, marked), height * per_unit, rtol=1e-6)


def test_changes_are_of_derivatives_alone():
    size = 8
    clip = flat_clip(np.array([[-0.55, -0.5], [0.52, -0.5], [0.5, 0.53], [-0.5, 0.57]]))
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    edges = mesh_edges(clip[:, :3], faces)
    ids = rasterize(clip, faces, image_size=(size, size)).face_ids
    changes = jnp.asarray(np.random.default_rng(3).normal(size=(4, size, size)))
    image = (ids >= 0).astype(clip.dtype)
    shares = lambda clip: coverage(clip, faces, edges, ids)
    plain = lambda clip: blend_layers(shares(clip), image)
    changed = lambda clip: blend_layers(shares(clip), image, changes=changes)
    way = jnp.asarray(np.random.default_rng(4).normal(size=clip.shape))
    (before, slope), (after, other) = (jax.jvp(f, (clip,), (way,)) for f in (plain, changed))
    np.testing.assert_array_equal(before, after)
    rates = jax.jvp(lambda clip: shares(clip).rests, (clip,), (way,))[1]
    np.testing.assert_allclose(other - slope, jnp.sum(rates * changes, axis=0), atol=1e-9)
    weights = jnp.asarray(np.random.default_rng(5).normal(size=image.shape))
    back = jax.grad(lambda clip: jnp.sum(weights * changed(clip)))(clip)
    np.testing.assert_allclose(jnp.sum(back * way), jnp.sum(weights * other), rtol=1e-9)


def steady(first, *_):
    """Return no change where an image was looked up at edges, or what bends beside them."""
    return None if isinstance(first, tuple) else jnp.zeros_like(first)


@pytest.mark.parametrize(
    ("light", "module", "part", "limit", "without"),
    [
        # Measured: off by 0.8 %, by 6.0 % with colors of the pixels' centres.
        ((0.5, 0.6, 0.62), "shadows.render", "_edge_changes", 0.015, 0.05),
        # Light from behind brightens the outline as fast as a square root: 3.9 %, 14.5 %
        # where it is taken to change evenly.
        ((0.0, 0.6, -0.8), "shadows.edge_points", "_bend", 0.05, 0.12),
    ],
)
def test_a_smooth_outline_has_the_colors_of_the_edge(
    monkeypatch, light, module, part, limit, without
):
    """A ball grows: the change of the mean, by derivatives and by differences."""
    light = DirectionalLight(np.array(light), np.ones(3))
    mesh = ball_and_box()
    ball = np.linalg.norm(mesh.positions - np.array([0, 0.5, 0]), axis=1) < 0.401
    rate = np.where(ball[:, None], mesh.positions - np.array([0, 0.5, 0]), 0.0)
    edges = mesh_edges(mesh.positions, mesh.faces)

    def mean(time):
        grown = mesh._replace(positions=mesh.positions + time * rate)
        image = render(grown, CAMERA, light, image_size=(192, 192), edges=edges, cast_shadows=False)
        return jnp.mean(image.color)

    def slope():
        times = 0.03 * np.arange(-7, 8, 2) / 8
        change = jax.jit(lambda time: jax.jvp(mean, (time,), (1.0,))[1])
        return float(np.mean([change(time) for time in times]))

    difference = float((jax.jit(mean)(0.03) - jax.jit(mean)(-0.03)) / 0.06)
    assert slope() == pytest.approx(difference, rel=limit)
    monkeypatch.setattr(sys.modules[module], part, steady)
    assert slope() != pytest.approx(difference, rel=without)
