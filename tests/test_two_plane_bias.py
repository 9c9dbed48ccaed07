"""The bias by two planes: folds stay lit without a depth to choose, contacts keep their shadow."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shadows import (
    AnalyticBias,
    BilinearFilter,
    CombinedBias,
    DirectionalLight,
    HardCompare,
    NearestFilter,
    PCFFilter,
    PerspectiveCamera,
    PoissonFilter,
    ReceiverPlaneBias,
    ShadowMap,
    SlopeBias,
    SoftCompare,
    TwoPlaneBias,
    VSMFilter,
    look_at,
    look_up,
    mesh_edges,
    orthographic,
    perspective,
    rasterize,
    receive,
    render,
    render_shadow_map,
    transform_points,
)
from shadows.surface_planes import seen_planes
from tangentspace import shapes

from .tools import assert_close

SIZE = 64
FILTERS = {
    "nearest": NearestFilter(),
    "bilinear": BilinearFilter(),
    "pcf 2": PCFFilter(2),
    "poisson": PoissonFilter(2.5),
}
ABOVE = np.diag([1.0, 1.0, -1 / 16, 1.0])  # parallel light from +z; a texel is 1/32 wide
TOWARDS = np.array([2.0, 6.0, 3.0]) / 7
ROOF = np.array([[0, 1, 2], [1, 2, 3], [2, 3, 4], [3, 4, 5]], np.int32)  # both sides of a fold

draw = jax.jit(render_shadow_map, static_argnames=("map_size", "casters"))


@jax.jit
def lit(shadow_map, positions, normals, bias, filter):
    """Visibility of points under light from +z."""
    to_light = jnp.broadcast_to(jnp.array([0.0, 0.0, 1.0]), positions.shape)
    receiver = receive(positions, normals, to_light, shadow_map.texel_from_world)
    moved = bias(receiver, filter.reach())
    return look_up(bias.prepare(shadow_map), moved, filter=filter, compare=HardCompare())


def fold(left, right, turn, shift):
    """Two half planes that rise by slopes from a line near the middle, and its place."""
    across = np.array([np.cos(turn), np.sin(turn)])
    along = np.array([-across[1], across[0]])
    middle = shift / 32 * across
    points = [
        np.append(middle + u * across + v * along, abs(u) * slope)
        for u, slope in ((-1.5, left), (0.0, 0.0), (1.5, right))
        for v in (-1.5, 1.5)
    ]
    return np.array(points), across, middle


def on_fold(left, right, across, middle, seed, reach=3.0):
    """Points of both half planes up to some texels from the fold, and their normals."""
    u, v = np.random.default_rng(seed).uniform(-1, 1, (2, 400)) * [[reach / 32], [0.5]]
    slope = np.where(u > 0, right, -left)
    place = middle + u[:, None] * across + v[:, None] * np.array([-across[1], across[0]])
    normals = np.append(-slope[:, None] * across, np.ones((400, 1)), axis=1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return np.append(place, (slope * u)[:, None], axis=1), normals


# Laws: where two planes meet nothing is darkened


@pytest.mark.parametrize("name", FILTERS)
@given(
    left=st.floats(-8, 8),
    right=st.floats(-8, 8),
    turn=st.floats(0, 2 * np.pi),
    shift=st.floats(-1, 1),
    seed=st.integers(0, 99),
)
@settings(max_examples=40)
def test_folds_of_two_planes_are_lit(name, left, right, turn, shift, seed):
    """Valleys and ridges, under every filter, with no tolerance."""
    points, *where = fold(left, right, turn, shift)
    shadow_map = draw(points, ROOF, ABOVE, map_size=SIZE, casters="planes")
    positions, normals = on_fold(left, right, *where, seed)
    visible = lit(shadow_map, positions, normals, TwoPlaneBias(0.0), FILTERS[name])
    assert float(jnp.min(visible)) >= 1 - 1e-9


def test_one_plane_alone_darkens_valleys():
    """What the test above would tell of the receiver's plane, or of one depth for all texels."""
    points, *where = fold(0.2, 3.0, 0.4, 0.3)
    bare = draw(points, ROOF, ABOVE, map_size=SIZE)
    positions, normals = on_fold(0.2, 3.0, *where, 0, reach=1.0)
    dark = [
        float(jnp.mean(lit(bare, positions, normals, bias, BilinearFilter()) < 1))
        for bias in (ReceiverPlaneBias(), AnalyticBias())
    ]
    assert dark[0] > 0.5  # measured 0.60
    assert dark[1] > 0.2  # measured 0.24


@pytest.mark.parametrize(("name", "most"), [("bilinear", 0.04), ("pcf 2", 0.14)])
def test_contacts_keep_their_shadow(name, most):
    """A sheet that stands on a floor: no more of its shadow is lit than by one plane.

    The least bias for planes alone lights 3.5 to 5 times as much of it.
    """
    floor = shapes.plane(1.5, dtype=np.float64)
    sheet = np.array([[0.0, 0, -2], [0, 0, 2], [0, 1, 2], [0, 1, -2]])
    positions = np.concatenate([floor.positions, sheet])
    faces = np.concatenate([floor.faces, len(floor.positions) + np.array([[0, 1, 2], [0, 2, 3]])])
    towards = np.array([1.0, 0.6, 0.3]) / np.sqrt(1.45)
    view = np.asarray(look_at(2 * towards, np.zeros(3), np.array([0.0, 1.0, 0.0])))
    matrix = np.asarray(orthographic(-1.0, 1.0, -1.0, 1.0, 0.0, 4.0)) @ view
    shadow_map = draw(positions, faces.astype(np.int32), matrix, map_size=SIZE, casters="planes")
    x, z = np.random.default_rng(0).uniform([[-0.3], [-0.3]], [[0.0], [0.3]], (2, 2000))
    points = jnp.array([x, np.zeros(2000), z]).T
    up, to_light = (jnp.broadcast_to(jnp.array(v), (2000, 3)) for v in ([0.0, 1, 0], towards))
    receiver = receive(points, up, to_light, shadow_map.texel_from_world)

    def lit_share(bias):
        moved, filter = bias(receiver, FILTERS[name].reach()), FILTERS[name]
        return float(jnp.mean(look_up(shadow_map, moved, filter=filter, compare=HardCompare())))

    both = lit_share(TwoPlaneBias(0.0))
    assert both == lit_share(ReceiverPlaneBias()) < most  # measured 0.031 and 0.129
    assert lit_share(TwoPlaneBias()) < 2.5 * both  # measured 0.068 and 0.167
    assert lit_share(AnalyticBias()) > 3 * both  # measured 0.15 and 0.45


@pytest.mark.parametrize("name", FILTERS)
def test_steep_faces_count_no_deeper_than_they_reach(name):
    """Close below a fold of which one side is steep, all is dark; its plane would lead below."""
    points, *where = fold(0.0, 40.0, 0.4, 0.3)
    shadow_map = draw(points, ROOF, ABOVE, map_size=SIZE, casters="planes")
    positions, _ = on_fold(0.0, 0.0, *where, 0)
    below, up = positions - [0, 0, 0.1], np.broadcast_to([0.0, 0.0, 1.0], positions.shape)
    assert float(jnp.max(lit(shadow_map, below, up, TwoPlaneBias(0.0), FILTERS[name]))) == 0


# What the map keeps


def ball_map(matrix, **options):
    mesh = shapes.icosphere(0.7, subdivisions=2, dtype=np.float64)
    return mesh, render_shadow_map(mesh.positions, mesh.faces, matrix, map_size=SIZE, **options)


VIEW = np.asarray(look_at(np.array([0.4, 0.8, 2.4]), np.zeros(3), np.array([0.0, 1.0, 0.0])))
SPOT = jnp.asarray(np.asarray(perspective(0.8, 1.0, 0.5, 8.0)) @ VIEW)


def test_planes_lead_from_texel_to_texel():
    """Within a face, a texel's plane goes on to its neighbour's depth."""
    mesh, found = ball_map(SPOT, casters="planes")
    clip = transform_points(SPOT, mesh.positions)
    ids = np.asarray(rasterize(clip, mesh.faces, image_size=(SIZE, SIZE)).face_ids)
    depth, planes = np.asarray(found.depth), found.planes
    right = (ids[:, 1:] == ids[:, :-1]) & (ids[:, 1:] >= 0)
    below = (ids[1:] == ids[:-1]) & (ids[1:] >= 0)
    assert min(right.sum(), below.sum()) > 500
    off = (depth + np.asarray(planes.depth_per_column))[:, :-1] - depth[:, 1:]
    assert np.max(np.abs(off[right])) < 1e-12  # measured 6e-15
    off = (depth + np.asarray(planes.depth_per_row))[:-1] - depth[1:]
    assert np.max(np.abs(off[below])) < 1e-12
    assert np.all(np.asarray(planes.farthest)[ids >= 0] >= depth[ids >= 0] - 1e-12)
    empty = ids < 0
    for image, value in zip(planes[3:], (0.0, 0.0, 1.0), strict=True):
        assert np.all(np.asarray(image)[empty] == value)


def test_planes_of_neighbours_are_those_of_their_texels():
    mesh = shapes.icosphere(0.7, subdivisions=2, dtype=np.float64)
    edges = mesh_edges(mesh.positions, mesh.faces)
    _, found = ball_map(SPOT, casters="planes", edges=edges)
    planes, layer = found.planes, found.neighbor.planes
    row, column = np.mgrid[:SIZE, :SIZE]
    there = row + np.asarray(layer.down, int), column + np.asarray(layer.across, int)
    moved = (there[0] != row) | (there[1] != column)
    assert moved.sum() > 50
    assert np.all(np.asarray(found.neighbor.share)[~moved] == 1)
    for mine, theirs in ((planes.depth, layer.depth), *zip(planes[3:], layer[3:], strict=True)):
        np.testing.assert_array_equal(np.asarray(mine)[there], theirs)


def test_faces_seen_edge_on_and_behind_the_light_have_finite_planes():
    positions = np.array([[0.0, 0, 0.5], [0, 1, 0.5], [0, 1, 0.2], [0.3, 0.2, 9.0], [0.3, 0.9, 0.1],
                          [0.9, 0.2, 0.1]])  # fmt: skip
    faces = np.array([[0, 1, 2], [3, 4, 5], [0, 0, 0]], np.int32)

    def planes(positions):
        clip = transform_points(SPOT, positions)
        raster = rasterize(clip, faces, image_size=(SIZE, SIZE))
        found = seen_planes(clip, faces, raster)
        return [image for image in found if image is not None]

    for image in planes(positions):
        assert np.all(np.isfinite(image))
    pull = jax.jacrev(lambda p: jnp.stack([jnp.sum(image) for image in planes(p)]))(positions)
    assert np.all(np.isfinite(pull))


def test_derivatives_forward_and_reverse():
    """Of the mean light under a soft comparison, in the map's vertices, tolerance and softness.

    Against differences in double precision; the map is one of a ball, seen by its own faces.
    """
    mesh = shapes.icosphere(0.7, subdivisions=2, dtype=np.float64)
    centers = jnp.asarray(mesh.positions[mesh.faces].mean(axis=1) * 0.99)
    normals = centers / jnp.linalg.norm(centers, axis=1, keepdims=True)
    light = jnp.array([0.4, 0.8, 2.4])

    def mean(at):
        moved = mesh.positions * (1 + at[2] * jnp.array([0.3, 1.0, -0.2]))
        found = render_shadow_map(moved, mesh.faces, SPOT, map_size=SIZE, casters="planes")
        receiver = receive(centers, normals, light - centers, found.texel_from_world)
        receiver = TwoPlaneBias(at[0])(receiver, 2.5)
        filter, compare = BilinearFilter(), SoftCompare(at[1])
        visible = look_up(found, receiver, filter=filter, compare=compare)
        return jnp.sum(visible * (normals @ light > 0.5)) / 100

    at, step = jnp.array([0.5, 0.7, 0.0]), 1e-6
    value = jax.jit(mean)
    expected = [(value(at + d) - value(at - d)) / (2 * step) for d in step * np.eye(3)]
    assert min(abs(e) for e in expected) > 1e-3
    push, pull = jax.jit(jax.jacfwd(mean))(at), jax.jit(jax.jacrev(mean))(at)
    np.testing.assert_allclose(push, expected, rtol=1e-5)
    assert_close(pull, push, ulps=2**12)


# Pictures


def picture(filter=BilinearFilter()):
    """A ball that passes into a floor."""
    ball = shapes.icosphere(0.5, subdivisions=1, dtype=np.float64)
    up = np.eye(4)
    up[1, 3] = 0.35
    mesh = shapes.merge(
        shapes.plane(1.6, dtype=np.float64)._replace(uvs=None), shapes.transform_mesh(ball, up)
    )
    view = look_at(np.array([0.5, 1.6, 2.2]), np.zeros(3), np.array([0.0, 1.0, 0.0]))
    return render(
        mesh,
        PerspectiveCamera(view, 0.8, 0.1, 10.0),
        DirectionalLight(TOWARDS, np.ones(3)),
        image_size=(48, 48),
        map_size=SIZE,
        bias=TwoPlaneBias(0.0),
        filter=filter,
        edges=mesh_edges(mesh.positions, mesh.faces),
    )


def test_what_faces_the_light_has_no_acne():
    image = jax.jit(picture)()
    normal = np.asarray(image.surface.face_normal)
    on_ball = np.asarray(image.surface.face_ids) >= 2
    chosen = on_ball & (np.sum(normal * TOWARDS, axis=-1) > 0.3)
    assert chosen.sum() > 150
    assert np.min(np.asarray(image.visibilities[0])[chosen]) == 1


# Bad input


@pytest.mark.errors
def test_maps_without_planes_are_refused():
    one = ShadowMap(jnp.ones((4, 4)), jnp.eye(4))
    for bias in (TwoPlaneBias(), CombinedBias((SlopeBias(), TwoPlaneBias()))):
        with pytest.raises(ValueError, match="TwoPlaneBias: expected a map with planes"):
            bias.prepare(one)


@pytest.mark.errors
def test_filters_that_compare_no_texels_are_refused():
    with pytest.raises(ValueError, match="TwoPlaneBias compares texel by texel"):
        picture(VSMFilter())
