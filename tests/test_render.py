"""The two passes together: a box over a floor, whose shadow is known in closed form."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from shadows import (
    BilinearFilter,
    ConstantBias,
    DirectionalLight,
    HardCompare,
    NearestFilter,
    PerspectiveCamera,
    PointLight,
    SlopeBias,
    SoftCompare,
    SpotLight,
    look_at,
    receive_surface,
    render,
    render_shadow_map,
    render_surface,
    shade,
    surface_visibility,
)
from tangentspace import shapes

from .tools import assert_close

UP = np.array([0.0, 1.0, 0.0])
IMAGE, MAP = (48, 64), 256
HALF, CENTER = np.array([0.6, 0.3, 0.5]), np.array([0.2, 1.0, 0.1])
BOX_FACES, FLOOR_FACES = 12, 2


def unit(*vector):
    return np.array(vector) / np.linalg.norm(vector)


def box_over_floor(dtype=np.float64):
    box = shapes.box(tuple(HALF), dtype=dtype)
    box = box._replace(positions=box.positions + CENTER.astype(dtype))
    return shapes.merge(box, shapes.plane(3.0, dtype=dtype))


def camera_at(*position):
    view_from_world = look_at(np.array(position), np.array([0.0, 0.3, 0.0]), UP)
    return PerspectiveCamera(np.asarray(view_from_world), 0.8, 1.0, 20.0)


MESH, CAMERA = box_over_floor(), camera_at(3.0, 4.0, 5.0)
SUN = DirectionalLight(unit(0.5, 0.8, -0.4))
LIGHTS = {
    "sun": SUN,
    "spot": SpotLight(np.array([1.5, 4.0, -1.0]), unit(-1.3, -3.5, 1.2), outer_angle=0.9),
    "point": PointLight(np.array([1.0, 4.0, -1.0])),
}

# Compiled without optimization: each runs a few times, on small images.
quick = functools.partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})
draw = quick(
    lambda mesh, camera, light: render(mesh, camera, light, image_size=IMAGE, map_size=MAP)
)
surface_of = quick(lambda mesh, camera: render_surface(mesh, camera, image_size=IMAGE))
map_of = quick(
    lambda mesh, matrix: render_shadow_map(mesh.positions, mesh.faces, matrix, map_size=MAP)
)

matrix_of = quick(lambda light, mesh: light.clip_from_world(mesh.positions))


@quick
def see(surface, light, shadow_map, bias, compare):
    return surface_visibility(
        surface, light, shadow_map, bias=bias, filter=BilinearFilter(), compare=compare
    )


def stages(mesh, camera, light):
    """What is kept while only a bias moves."""
    return surface_of(mesh, camera), map_of(mesh, matrix_of(light, mesh))


def ray_hits_box(origin, towards, half):
    """Slab test, from the definition: 0 < t < 1 to the light, the box scaled round its middle."""
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = np.stack([(CENTER + s * half - origin) / towards for s in (-1, 1)])
    return ends.min(axis=0).max(axis=-1) < ends.max(axis=0).min(axis=-1)


def sure_shadow(surface, light, margin):
    """Where the floor is dark, and where lit, by more than a margin in the box's size."""
    position = np.asarray(surface.position, np.float64)
    towards = np.asarray(light.to_light(surface.position), np.float64)
    floor = np.asarray(surface.face_ids) >= BOX_FACES
    dark = floor & ray_hits_box(position, towards, HALF - margin)
    return dark, floor & ~ray_hits_box(position, towards, HALF + margin)


# Known answers


def test_nothing_blocks_light_without_shadows():
    bare = quick(
        lambda mesh, camera, light: render(
            mesh, camera, light, image_size=IMAGE, map_size=MAP, cast_shadows=False
        )
    )(MESH, CAMERA, SUN)
    surface = bare.surface
    cosine = np.asarray(surface.face_normal) @ SUN.direction
    lit = np.asarray(surface.covered) & (cosine > 0)
    assert bare.shadow_maps == ()
    np.testing.assert_array_equal(bare.visibilities[0], lit)
    shadowed = np.asarray(draw(MESH, CAMERA, SUN).visibilities[0])
    assert (shadowed <= lit).all()
    assert np.mean(lit & (shadowed == 0)) > 0.02  # the box casts one


@pytest.mark.parametrize("name", LIGHTS)
def test_shadow_falls_where_geometry_says(name):
    surface, shadow_map = stages(MESH, CAMERA, LIGHTS[name])
    lit = np.asarray(see(surface, LIGHTS[name], shadow_map, SlopeBias(), HardCompare()))
    dark_floor, lit_floor = sure_shadow(surface, LIGHTS[name], margin=0.05)  # two texels
    assert dark_floor.sum() > 50
    assert lit_floor.sum() > 500
    assert_close(lit[dark_floor], np.zeros(dark_floor.sum()), ulps=0)
    assert_close(lit[lit_floor], np.ones(lit_floor.sum()), ulps=8)
    unsure = (np.asarray(surface.face_ids) >= BOX_FACES) & ~dark_floor & ~lit_floor
    assert unsure.sum() < 0.6 * dark_floor.sum()


@pytest.mark.parametrize("name", LIGHTS)
def test_the_box_is_lit_from_one_side_only(name):
    """It is convex: each side that faces the light is lit, each other has visibility 0."""
    light = LIGHTS[name]
    surface, shadow_map = stages(MESH, CAMERA, light)
    lit = np.asarray(see(surface, light, shadow_map, SlopeBias(), HardCompare()))
    n_dot_l = np.sum(np.asarray(surface.face_normal * light.to_light(surface.position)), axis=-1)
    box = (np.asarray(surface.face_ids) >= 0) & (np.asarray(surface.face_ids) < BOX_FACES)
    assert (box & (n_dot_l < 0)).sum() > 20
    assert_close(lit[box & (n_dot_l < 0)], np.zeros((box & (n_dot_l < 0)).sum()), ulps=0)
    # On a side's rim the shadow of the box itself may begin within a texel.
    assert lit[box & (n_dot_l > 0)].mean() > 0.97


@pytest.fixture(scope="module")
def sun_image():
    return draw(MESH, CAMERA, SUN)


def test_background(sun_image):
    empty = np.asarray(sun_image.surface.face_ids) == -1
    assert 0.1 < empty.mean() < 0.6
    assert_close(sun_image.color[empty], np.zeros((empty.sum(), 3)), ulps=0)
    assert_close(sun_image.visibilities[0][empty], np.zeros(empty.sum()), ulps=0)
    assert_close(sun_image.surface.depth[empty], np.ones(empty.sum()), ulps=0)
    assert_close(sun_image.surface.covered, ~empty)
    assert float(sun_image.surface.depth[~empty].max()) < 1


def test_surface_lies_where_the_scene_is(sun_image):
    """Floor at height 0 with normal up, box between its sides, eye vectors to the eye."""
    surface = sun_image.surface
    ids = np.asarray(surface.face_ids)
    floor, box = ids >= BOX_FACES, (ids >= 0) & (ids < BOX_FACES)
    count = floor.sum()
    assert_close(surface.position[floor][:, 1], np.zeros(count))
    assert_close(surface.face_normal[floor], np.broadcast_to(UP, (count, 3)))
    assert_close(surface.normal[floor], np.broadcast_to(UP, (count, 3)))
    relative = np.abs(np.asarray(surface.position)[box] - CENTER) / HALF
    assert_close(relative.max(axis=-1), np.ones(box.sum()))
    expected = np.array([3.0, 4.0, 5.0]) - np.asarray(surface.position)
    expected /= np.linalg.norm(expected, axis=-1, keepdims=True)
    assert_close(surface.to_camera[floor], expected[floor])


def test_ambient_stays_in_shadow(sun_image):
    """The default shading's ambient is 0.1 of white; in the light there is more."""
    dark, lit = sure_shadow(sun_image.surface, SUN, margin=0.05)
    assert_close(sun_image.color[dark], np.full((dark.sum(), 3), 0.1))
    diffuse = 0.1 + 0.5 * SUN.direction[1]  # and some highlight
    assert float(sun_image.color[lit].min()) >= diffuse
    assert float(sun_image.color[lit].min()) < diffuse + 0.01


def test_row_0_is_on_top():
    """Seen level from +z: the box, above the middle, covers upper rows; +x is on the right."""
    view = look_at(np.array([0.0, 0.0, 9.0]), np.zeros(3), UP)
    camera = PerspectiveCamera(np.asarray(view), 2 * np.arctan(1.5 / 8.4), 1.0, 20.0)
    rows, columns = np.nonzero(np.asarray(surface_of(MESH, camera).covered))
    pixel = 3.0 / IMAGE[0]  # at the box's front, 8.4 from the eye, where its outline lies
    first = lambda edge: np.ceil(edge / pixel - 0.5)  # the first centre beyond an edge
    assert rows.min() == first(1.5 - 1.3)
    assert (columns.min(), columns.max() + 1) == (first(2.0 - 0.4), first(2.0 + 0.8))
    assert rows.max() < IMAGE[0] / 2


# Laws


def test_render_is_its_stages(sun_image):
    surface, shadow_map = stages(MESH, CAMERA, SUN)
    assert_close(sun_image.surface.face_ids, surface.face_ids)
    assert_close(sun_image.surface.position, surface.position)
    assert_close(sun_image.shadow_maps[0].depth, shadow_map.depth)
    lit = see(surface, SUN, shadow_map, SlopeBias(), HardCompare())
    assert_close(sun_image.visibilities[0], lit)
    assert_close(sun_image.color, shade(surface, [SUN], [lit]))


def test_stored_depth_is_the_pixels_own_within_a_footprint(sun_image):
    """In the light, a texel holds the depth of the floor at its centre."""
    receiver = quick(receive_surface)(sun_image.surface, SUN, sun_image.shadow_maps[0])
    (tap,) = NearestFilter().read(sun_image.shadow_maps[0], receiver)
    _, lit = sure_shadow(sun_image.surface, SUN, margin=0.05)
    lit &= np.asarray(tap.stored) < 1  # off the floor's rim
    gain = np.abs(receiver.depth - tap.stored)[lit] / np.asarray(receiver.footprint)[lit]
    assert 0.9 < gain.max() < 1 + 1e-9
    assert_close(receiver.position, sun_image.surface.position, ulps=0)


def test_kept_shadow_map_gives_the_same_image(sun_image):
    kept = quick(
        lambda mesh, camera, light, shadow_map: render(
            mesh, camera, light, image_size=IMAGE, shadow_maps=[shadow_map]
        )
    )
    again = kept(MESH, CAMERA, SUN, sun_image.shadow_maps[0])
    for value, wanted in zip(jax.tree.leaves(again), jax.tree.leaves(sun_image), strict=True):
        assert_close(value, wanted)


def test_two_lights_add_up_and_ambient_counts_once(sun_image):
    spot_image = draw(MESH, CAMERA, LIGHTS["spot"])
    both = draw(MESH, CAMERA, (SUN, LIGHTS["spot"]))
    ambient = np.where(np.asarray(both.surface.covered)[..., None], 0.1, 0.0)
    assert_close(both.color, sun_image.color + spot_image.color - ambient)
    for k, alone in enumerate((sun_image, spot_image)):
        assert_close(both.visibilities[k], alone.visibilities[0])
        assert_close(both.shadow_maps[k].depth, alone.shadow_maps[0].depth)


def test_traces_once_for_other_values():
    """Meshes, cameras, lights and biases are arguments, not constants."""
    traces = []

    def counted(mesh, camera, light, bias):
        traces.append(len(mesh.faces))
        return render(mesh, camera, light, image_size=IMAGE, map_size=MAP, bias=bias)

    jitted = jax.jit(counted)
    jitted.lower(MESH, CAMERA, SUN, SlopeBias(2.0))
    higher = MESH._replace(positions=MESH.positions + 1.0)
    jitted.lower(higher, camera_at(1.0, 4.0, 5.0), DirectionalLight(UP), SlopeBias(1.0))
    assert traces == [14]
    jitted.lower(MESH, CAMERA, LIGHTS["spot"], SlopeBias(2.0))  # another light: another program
    assert traces == [14, 14]


def test_world_turned_about_the_vertical_axis():
    """Scene, eye and light together: the image stays, but for ties of rounding."""
    cos, sin = np.cos(1.1), np.sin(1.1)
    turn = np.array([[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]])
    spot = LIGHTS["spot"]
    turned_spot = SpotLight(
        turn @ spot.position, turn @ spot.direction, outer_angle=spot.outer_angle
    )
    turned_mesh = MESH._replace(positions=MESH.positions @ turn.T, normals=MESH.normals @ turn.T)
    view = look_at(turn @ np.array([3.0, 4.0, 5.0]), np.array([0.0, 0.3, 0.0]), UP)
    turned_camera = PerspectiveCamera(np.asarray(view), 0.8, 1.0, 20.0)
    images = []
    for mesh, camera, light in ((MESH, CAMERA, spot), (turned_mesh, turned_camera, turned_spot)):
        surface, shadow_map = stages(mesh, camera, light)
        lit = see(surface, light, shadow_map, SlopeBias(), HardCompare())
        images.append(np.asarray(shade(surface, [light], [lit])))
    assert (np.abs(images[0] - images[1]) > 1e-6).mean() < 2e-3  # measured


OVERHEAD = {
    "sun": DirectionalLight(UP),
    "spot": SpotLight(np.array([0.0, 4.0, 0.0]), -UP, outer_angle=0.9),
    "far spot": SpotLight(np.array([0.0, 40.0, 0.0]), -UP, outer_angle=0.1),
    "point": PointLight(np.array([0.2, 5.0, 0.1])),
    "low sun": DirectionalLight(unit(0.9, 0.3, -0.2)),
}


@pytest.mark.parametrize("name", OVERHEAD)
def test_defaults_leave_no_acne_in_single_precision(name):
    """Users live there; where the light is overhead there is no slope, only rounding."""
    light = OVERHEAD[name]
    single = lambda tree: jax.tree.map(
        lambda x: np.asarray(x, np.int32 if np.asarray(x).dtype.kind == "i" else np.float32), tree
    )
    with jax.enable_x64(False):
        surface, shadow_map = stages(single(MESH), single(CAMERA), single(light))
        lit = see(surface, single(light), shadow_map, SlopeBias(), HardCompare())
        assert lit.dtype == shadow_map.depth.dtype == np.float32
        _, lit_floor = sure_shadow(surface, light, margin=0.05)
        reached = np.asarray(light.radiance(surface.position))[..., 0] > 0
        visible = np.asarray(lit)[lit_floor & reached]
    assert len(visible) > 500
    assert visible.min() > 0.99, f"{(visible < 0.5).mean():.1%} of the lit floor is dark"


# Derivatives


def colors(surface, light, shadow_map, length, softness):
    lit = surface_visibility(
        surface,
        light,
        shadow_map,
        bias=ConstantBias(length),
        filter=BilinearFilter(),
        compare=SoftCompare(softness),
    )
    return shade(surface, [light], [lit])


def test_image_has_its_derivative_in_bias_and_softness():
    """The whole image against central differences, in forward mode; its sum, in reverse."""
    surface, shadow_map = stages(MESH, CAMERA, LIGHTS["spot"])
    image = lambda *at: colors(surface, LIGHTS["spot"], shadow_map, *at)
    at = (jnp.asarray(0.004), jnp.asarray(1.5))
    of = quick(image)
    slope_of = quick(lambda at, step: jax.jvp(image, at, step)[1])
    gradients = quick(jax.grad(lambda *at: jnp.sum(image(*at)), (0, 1)))(*at)
    for k, step in enumerate(((1.0, 0.0), (0.0, 1.0))):
        step = tuple(jnp.asarray(s) for s in step)
        slope = slope_of(at, step)
        above, below = (
            of(*(a + sign * 1e-6 * s for a, s in zip(at, step, strict=True))) for sign in (1, -1)
        )
        numerical = np.asarray(above - below) / 2e-6
        scale = np.abs(numerical).max()
        assert scale > 0.01
        assert (np.abs(numerical) > 1e-3 * scale).mean() > 0.02
        np.testing.assert_allclose(slope, numerical, rtol=1e-6, atol=1e-6 * scale)
        assert float(gradients[k]) == pytest.approx(float(slope.sum()), rel=1e-10)


def primitives(jaxpr):
    """Names of all primitives, those of nested programs included."""
    program = lambda x: hasattr(x, "jaxpr") or hasattr(x, "eqns")
    for equation in jaxpr.eqns:
        yield equation.primitive.name
        for inner in filter(program, jax.tree.leaves(equation.params, is_leaf=program)):
            yield from primitives(getattr(inner, "jaxpr", inner))


def test_nothing_is_rasterized_while_surface_and_map_are_kept():
    surface, shadow_map = stages(MESH, CAMERA, SUN)
    of = lambda length, softness: jnp.sum(colors(surface, SUN, shadow_map, length, softness))
    for function in (of, jax.grad(of, argnums=(0, 1))):
        names = set(primitives(jax.make_jaxpr(function)(0.01, 1.0).jaxpr))
        assert "gather" in names
        assert not names & {"while", "scan", "scatter-min", "scatter_min"}
    drawing = jax.make_jaxpr(lambda mesh, camera: render_surface(mesh, camera, image_size=IMAGE))
    assert "while" in set(primitives(drawing(MESH, CAMERA).jaxpr))  # the check can see it


@pytest.mark.parametrize("softness", [0.0, 1.0])
def test_derivatives_are_finite_whatever_is_in_the_image(softness):
    """Empty pixels, dark faces, a lamp at the origin, where empty pixels' positions are."""
    light = PointLight(jnp.array([0.0, 0.0, 0.0]))
    mesh = MESH._replace(positions=MESH.positions - np.array([0.0, 2.0, 0.0]))
    surface, shadow_map = stages(mesh, camera_at(3.0, 4.0, 5.0), light)
    assert not bool(surface.covered.all())

    def total(surface_floats, position, depth, length, softness):
        changed = surface._replace(**surface_floats)
        changed_map = shadow_map._replace(depth=depth)
        return jnp.sum(colors(changed, PointLight(position), changed_map, length, softness))

    floats = {"position": surface.position, "face_normal": surface.face_normal}
    arguments = (floats, light.position, shadow_map.depth, 0.01, softness)
    derivatives = quick(jax.grad(total, argnums=(0, 1, 2, 3, 4)))(*arguments)
    bad = [
        jax.tree_util.keystr(path)
        for path, leaf in jax.tree_util.tree_leaves_with_path(derivatives)
        if not bool(jnp.isfinite(leaf).all())
    ]
    assert not bad
