"""The choice of casters: closed bodies need no other bias, contacts and open meshes pay."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from shadows import (
    AdaptiveBias,
    BilinearFilter,
    CombinedBias,
    ConstantBias,
    DirectionalLight,
    FrontFaceCullingBias,
    HardCompare,
    MidpointBias,
    NearestFilter,
    PCFFilter,
    PerspectiveCamera,
    PointLight,
    SecondDepthBias,
    ShadowMap,
    SlopeBias,
    SoftCompare,
    look_at,
    look_up,
    receive,
    render,
    render_shadow_map,
)
from tangentspace import shapes
from tangentspace.vertex_normals import face_normals

from .tools import assert_close

SIZE = 256
LIGHTS = {
    "parallel": DirectionalLight(np.array([2.0, 6.0, 3.0]) / 7),
    "point": PointLight(np.array([1.5, 4.0, 2.0])),
}
LAYERS = {
    "second depth": SecondDepthBias(),
    "midpoint": MidpointBias(),
    "front-face culling": FrontFaceCullingBias(),
}
_VERTICES, _FACES = 700, 1300  # so that few shapes compile

draw = jax.jit(render_shadow_map, static_argnames=("map_size", "casters"))


@jax.jit
def look(shadow_map, receiver, bias, filter):
    moved = bias(receiver, filter.reach())
    prepared = bias.prepare(shadow_map)
    return look_up(prepared, moved, filter=filter, compare=HardCompare())


def layers(mesh, light, casters, dtype=np.float64):
    """The map of a mesh, of one shape for all."""
    positions = np.asarray(mesh.positions, dtype)
    matrix = jnp.asarray(light.clip_from_world(positions), dtype)
    positions = np.pad(positions, ((0, _VERTICES - len(positions)), (0, 0)))
    faces = np.pad(mesh.faces, ((0, _FACES - len(mesh.faces)), (0, 0)))
    return draw(positions, faces, matrix, map_size=SIZE, casters=casters)


def located(points, normals, light, shadow_map):
    points, normals = jnp.asarray(points), jnp.asarray(normals)
    return jax.jit(receive)(points, normals, light.to_light(points), shadow_map.texel_from_world)


def ball():
    return shapes.icosphere(0.8, subdivisions=3, dtype=np.float64)


def block():
    return shapes.box((0.5, 0.4, 0.3), dtype=np.float64)


def lit_points(mesh, light, count=4000):
    """Points on faces turned to the light: of a convex body, all of them lit."""
    rng = np.random.default_rng(0)
    normals = np.asarray(face_normals(jnp.asarray(mesh.positions), mesh.faces))
    corners = mesh.positions[mesh.faces]
    area = np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    )
    face = rng.choice(len(area), count, p=area / area.sum())
    weights = rng.dirichlet(np.ones(3), count)
    points = np.einsum("pk,pkx->px", weights, corners[face])
    facing = np.sum(normals[face] * np.asarray(light.to_light(jnp.asarray(points))), axis=1)
    return points[facing > 0], normals[face][facing > 0], facing[facing > 0]


# Known answers


@pytest.mark.parametrize("lookup", [NearestFilter(), BilinearFilter()], ids=["nearest", "bilinear"])
@pytest.mark.parametrize("light", LIGHTS)
@pytest.mark.parametrize("name", LAYERS)
@pytest.mark.parametrize("body", [ball, block])
def test_closed_bodies_need_no_other_bias(body, name, light, lookup):
    """But at silhouettes, where both layers meet; without a bias half of all is in acne."""
    mesh, light, bias = body(), LIGHTS[light], LAYERS[name]
    points, normals, facing = lit_points(mesh, light)
    shadow_map = layers(mesh, light, bias.casters)
    receiver = located(points, normals, light, shadow_map)
    lit = np.asarray(look(shadow_map, receiver, bias, lookup))
    assert body is block or np.all(lit[facing > 0.3] == 1)
    assert np.mean(lit <= 0.5) < 0.01  # 0.0044 measured, of the midpoint
    nearest = layers(mesh, light, "nearest")
    without = np.asarray(look(nearest, receiver, CombinedBias(), lookup))
    assert np.mean(without <= 0.5) > 0.3


def contact():
    """A block that stands on a floor."""
    floor, body = shapes.plane(2.0, dtype=np.float64), block()
    return shapes.merge(floor, body._replace(positions=body.positions + np.array([0, 0.4, 0])))


def shadowed_floor():
    """Points of the floor behind the block, and how far they are from its wall."""
    away = np.linspace(1e-3, 0.15, 400)
    x, z = np.meshgrid(-0.5 - away, np.linspace(-0.28, -0.1, 5))
    points = np.stack([x, 0 * x, z], axis=-1).reshape(-1, 3)
    return points, np.tile([0.0, 1.0, 0.0], (len(points), 1)), -0.5 - points[:, 0]


def test_contacts_leak_within_the_reach():
    """A bright line where a caster's back meets the receiver, under PCF 5x5; nothing beyond it.

    Halfway into a thick block there is no such line.
    """
    light, mesh, filter = LIGHTS["parallel"], contact(), PCFFilter(2)
    points, normals, away = shadowed_floor()
    lit, texels = {}, away
    for name, bias in {**LAYERS, "adaptive": AdaptiveBias()}.items():
        shadow_map = layers(mesh, light, bias.casters)
        receiver = located(points, normals, light, shadow_map)
        lit[name] = np.asarray(look(shadow_map, receiver, bias, filter))
        texels = away / float(receiver.texel_length.max())
        assert np.all(lit[name][texels > filter.reach()] == 0)
    for name in ("second depth", "front-face culling"):
        assert 0.1 < lit[name][texels < 1].mean() < 0.3  # measured 0.14
    for name in ("midpoint", "adaptive"):
        assert lit[name].max() == 0


def sheet_over_floor():
    sheet = shapes.plane(0.5, dtype=np.float64)
    return shapes.merge(
        shapes.plane(2.0, dtype=np.float64),
        sheet._replace(positions=sheet.positions + np.array([0, 0.5, 0])),
    )


def test_open_meshes_pay():
    """Of a sheet's shadow culling leaves nothing, the second depth acne; the midpoint keeps it."""
    light, mesh = DirectionalLight(np.array([0.1, 1.0, 0.2]) / np.sqrt(1.05)), sheet_over_floor()
    x, z = np.meshgrid(*2 * (np.linspace(-0.3, 0.3, 40),))
    points = np.stack([x, 0 * x, z], axis=-1).reshape(-1, 3)
    up = np.tile([0.0, 1.0, 0.0], (len(points), 1))
    share = {}
    for name, bias in LAYERS.items():
        shadow_map = layers(mesh, light, bias.casters)
        receiver = located(points, up, light, shadow_map)
        share[name] = float(jnp.mean(look(shadow_map, receiver, bias, NearestFilter())))
    assert share["front-face culling"] == 1
    assert 0.3 < share["second depth"] < 0.7
    assert share["midpoint"] == 0


@pytest.mark.parametrize("light", LIGHTS)
def test_share_goes_from_the_first_layer_to_the_second(light, dtype):
    mesh, light = contact(), LIGHTS[light]
    two = layers(mesh, light, "two", dtype)
    assert_close(two.depth, layers(mesh, light, "nearest", dtype).depth, ulps=0)
    assert two.second.dtype == dtype
    assert bool(jnp.all(two.second >= two.depth))
    assert_close(MidpointBias(0.0).prepare(two).depth, two.depth, ulps=0)
    assert_close(MidpointBias(1.0).prepare(two).depth, two.second, ulps=1)
    assert_close(SecondDepthBias().prepare(two).depth, two.second, ulps=1)
    assert_close(
        MidpointBias(0.25).prepare(two).depth, 0.75 * two.depth + 0.25 * two.second, ulps=2
    )
    # With nothing behind, the far end of the map is the second surface.
    alone = (np.asarray(two.depth) < 1) & (np.asarray(two.second) == 1)
    assert alone.any()
    found = np.asarray(MidpointBias().prepare(two).depth)[alone]
    assert_close(found, 0.5 + 0.5 * np.asarray(two.depth)[alone], ulps=2)


def test_nothing_is_moved():
    light = LIGHTS["point"]
    points, normals, _ = lit_points(ball(), light, 100)
    receiver = located(points, normals, light, layers(ball(), light, "nearest"))
    for bias in LAYERS.values():
        moved = bias(receiver, 3.0)
        assert all(a is b for a, b in zip(moved, receiver, strict=True))


# Combined with others


def test_casters_of_combined_biases():
    for bias in LAYERS.values():
        both = CombinedBias((SlopeBias(), bias, ConstantBias()))
        assert both.casters == bias.casters != "nearest"
        assert both.reads_anew == bias.reads_anew
    assert CombinedBias((SlopeBias(), AdaptiveBias())).casters == "nearest"
    assert CombinedBias().casters == "nearest"


def test_combined_biases_prepare_the_map():
    two = ShadowMap(jnp.full((4, 4), 0.2), jnp.eye(4), jnp.full((4, 4), 0.6))
    both = CombinedBias((ConstantBias(0.1), MidpointBias(0.25)))
    assert_close(both.prepare(two).depth, np.full((4, 4), 0.3))
    assert_close(CombinedBias((ConstantBias(0.1),)).prepare(two).depth, two.depth, ulps=0)


@pytest.mark.parametrize("name", LAYERS)
def test_render_draws_the_casters_that_a_bias_wants(name):
    """The picture of a ball over a floor has no acne on the ball, though nothing else is done."""
    body = shapes.icosphere(0.5, subdivisions=3)
    mesh = shapes.merge(
        shapes.plane(2.0), body._replace(positions=body.positions + np.float32([0, 1.0, 0]))
    )
    view = look_at(np.array([1.5, 2.0, 3.0]), np.array([0.0, 0.5, 0.0]), np.array([0.0, 1.0, 0.0]))
    camera = PerspectiveCamera(np.asarray(view, np.float32), 0.7, 0.5, 20.0)
    light = DirectionalLight(np.float32([2, 6, 3]) / 7)
    bias = LAYERS[name]
    with jax.enable_x64(False):
        image = rendered(mesh, camera, light, CombinedBias((bias, SlopeBias())), BilinearFilter())
    (shadow_map,), (lit,) = image.shadow_maps, image.visibilities
    assert (shadow_map.second is not None) == (bias.casters == "two")
    facing = np.sum(np.asarray(image.surface.face_normal) * light.direction, axis=-1)
    on_ball = np.asarray(image.surface.face_ids) >= 2
    assert (on_ball & (facing > 0.3)).sum() > 200
    assert np.all(np.asarray(lit)[on_ball & (facing > 0.3)] > 0.999)
    assert 0.02 < np.mean(np.asarray(lit)[np.asarray(image.surface.covered) & ~on_ball] < 0.5) < 0.3


@eqx.filter_jit
def rendered(mesh, camera, light, bias, filter):
    return render(mesh, camera, light, image_size=(64, 64), map_size=SIZE, bias=bias, filter=filter)


# Derivatives


@pytest.mark.parametrize("filter", [BilinearFilter(), PCFFilter(1)], ids=["bilinear", "pcf"])
def test_derivative_in_the_share(filter):
    """Soft, forward and reverse, against finite differences."""
    mesh, light = contact(), LIGHTS["parallel"]
    two = layers(mesh, light, "two")
    rng = np.random.default_rng(1)
    points = rng.uniform([-0.9, 0, -0.9], [0.9, 0.05, 0.9], (40, 3))
    receiver = located(points, np.tile([0.0, 1.0, 0.0], (40, 1)), light, two)
    weights = jnp.asarray(rng.normal(size=40))

    @jax.jit
    def loss(share):
        map_ = MidpointBias(share).prepare(two)
        return weights @ look_up(map_, receiver, filter=filter, compare=SoftCompare(20.0))

    share, step = jnp.asarray(0.3), 1e-6
    numerical = (loss(share + step) - loss(share - step)) / (2 * step)
    assert abs(float(numerical)) > 1e-2
    np.testing.assert_allclose(jax.jit(jax.grad(loss))(share), numerical, rtol=1e-6)
    np.testing.assert_allclose(jax.jit(jax.jacfwd(loss))(share), numerical, rtol=1e-6)


# Errors


@pytest.mark.parametrize("bias", [SecondDepthBias(), MidpointBias()])
def test_a_map_of_one_layer_is_refused(bias):
    one = ShadowMap(jnp.ones((4, 4)), jnp.eye(4))
    message = r"^bias: expected a map of two layers \(render_shadow_map\(.*'two'\)\), got one$"
    with pytest.raises(ValueError, match=message):
        bias.prepare(one)
    with pytest.raises(ValueError, match=message):
        CombinedBias((SlopeBias(), bias)).prepare(one)


@pytest.mark.errors
def test_only_one_bias_may_choose_the_casters():
    message = r"^CombinedBias: .* `terms` .* got FrontFaceCullingBias and MidpointBias$"
    with pytest.raises(ValueError, match=message):
        CombinedBias((FrontFaceCullingBias(), SlopeBias(), MidpointBias()))


@pytest.mark.errors
def test_other_casters_are_refused():
    arrays = np.zeros((3, 3)), np.zeros((1, 3), int), jnp.eye(4)
    with pytest.raises(
        ValueError, match="expected `casters` nearest, back, two or planes, got 'front'"
    ):
        render_shadow_map(*arrays, map_size=8, casters="front")
