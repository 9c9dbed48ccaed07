"""Light maps: charts, the bake against rays and known light, and images lit by a map."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.baking.bake_light import (
    bake_light_map,
    read_light_map,
    unwrap_scene,
    write_light_map,
)
from experiments.baking.light_map_uvs import light_map_uvs
from experiments.rendering.render_scene import render_light_map, render_scene
from experiments.scene import Material, Scene
from experiments.truth.rays import Occluders, trace_visibility
from shadows import (
    Appearance,
    BilinearFilter,
    DirectionalLight,
    HardCompare,
    LightMap,
    PerspectiveCamera,
    SlopeBias,
    look_at,
    look_up_light,
    render_surface,
    shade_with_light_map,
    texture_surface,
)
from tangentspace.shading import LambertShading
from tangentspace.shapes import box, merge, plane, transform_mesh

from .tools import assert_close

UP = np.array([0.0, 1.0, 0.0])
TOWARD = np.array([0.6, 0.8, 0.0], np.float32)
MATTE = LambertShading(0.5, 0.1)


def raised(mesh, height):
    matrix = np.eye(4)
    matrix[1, 3] = height
    return transform_mesh(mesh, matrix)


def scene_of(mesh, *, lights=(DirectionalLight(TOWARD),)):
    view = np.asarray(look_at(np.array([1.0, 4.0, 3.0]), np.zeros(3), UP), np.float32)
    camera = PerspectiveCamera(view, 0.8, 0.5, 20.0)
    materials = np.zeros(len(mesh.faces), np.int32)
    return Scene("toy", mesh, materials, (Material(),), camera, tuple(lights))


FLOOR = plane(1.0)
ROOM = merge(plane(2.0), raised(box((0.4, 0.2, 0.4)), 0.6))


@pytest.fixture(autouse=True)
def _single_precision():
    with jax.enable_x64(False):
        yield


@pytest.fixture(scope="module")
def baked():
    with jax.enable_x64(False):
        return bake_light_map(scene_of(ROOM), size=256)


# Charts


def test_own_coordinates_serve_where_nothing_overlaps():
    unwrapped = light_map_uvs(FLOOR)
    assert unwrapped.reason == ""
    assert unwrapped.mesh is FLOOR
    np.testing.assert_array_equal(unwrapped.uvs, FLOOR.uvs)


@pytest.mark.parametrize(
    ("mesh", "reason"),
    [
        (FLOOR._replace(uvs=None), "no uvs"),
        (FLOOR._replace(uvs=FLOOR.uvs + np.float32(0.5)), "uvs outside 0 to 1"),
        (FLOOR._replace(uvs=FLOOR.uvs * np.float32(0)), "faces without area in uv"),
        (merge(FLOOR, raised(FLOOR, 1.0)), "overlapping uvs"),
    ],
)
def test_charts_are_made_where_own_coordinates_do_not_serve(mesh, reason):
    unwrapped = light_map_uvs(mesh)
    assert unwrapped.reason == reason
    assert light_map_uvs(unwrapped.mesh._replace(uvs=unwrapped.uvs)).reason == ""
    # The same triangles in the same order.
    before, after = (m.positions[m.faces] for m in (mesh, unwrapped.mesh))
    np.testing.assert_array_equal(after, before)


def test_charts_are_the_same_in_every_run():
    first, second = (light_map_uvs(ROOM) for _ in range(2))
    np.testing.assert_array_equal(first.uvs, second.uvs)


# Texels


def test_texels_lie_on_the_surface_with_v_up():
    size = (8, 16)
    surface = texture_surface(FLOOR, FLOOR.uvs, size=size)
    assert (np.asarray(surface.face_ids) >= 0).all()
    u = (np.arange(16) + 0.5) / 16
    v = 1 - (np.arange(8) + 0.5) / 8
    # The plane is affine in its coordinates.
    affine = np.linalg.lstsq(np.c_[FLOOR.uvs, np.ones(len(FLOOR.uvs))], FLOOR.positions, rcond=None)
    uv = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    expected = (np.c_[uv, np.ones(len(uv))] @ affine[0]).reshape(*size, 3)
    np.testing.assert_allclose(surface.position, expected, atol=1e-6)
    np.testing.assert_allclose(surface.normal, np.broadcast_to(UP, (*size, 3)), atol=1e-6)


def test_an_open_floor_holds_the_cosine():
    lights = (
        DirectionalLight(TOWARD),
        DirectionalLight(np.float32([0, 1, 0]), np.float32([0, 2, 0])),
    )
    bake = bake_light_map(scene_of(FLOOR, lights=lights), size=16)
    assert bake.charted.all()
    expected = np.broadcast_to(np.float32([0.8, 2.8, 0.8]), (16, 16, 3))
    assert_close(bake.light_map.texels, expected, ulps=8)


def test_light_from_below_leaves_a_floor_dark():
    bake = bake_light_map(scene_of(FLOOR, lights=(DirectionalLight(-TOWARD),)), size=16)
    assert (bake.light_map.texels == 0).all()


def test_a_shadow_has_its_size(baked):
    """The box's shadow on the floor: its silhouette along the light, in world area."""
    surface = texture_surface(baked.scene.mesh, baked.light_map.uvs, size=(1024, 1024))
    position = np.asarray(surface.position)
    floor = (np.abs(position[..., 1]) < 1e-5) & (np.asarray(surface.face_ids) >= 0)
    light = np.asarray(
        look_up_light(baked.scene.mesh, surface, LightMap(*map(jnp.asarray, baked.light_map)))
    )
    dark = floor & (light[..., 0] < 0.4)
    share = dark.sum() / floor.sum()
    # Lengths 0.8 and 0.8 + 0.4 * 0.75 of a floor of 4 x 4.
    assert share == pytest.approx(0.8 * (0.8 + 0.4 * 0.75) / 16, rel=0.03)


def test_texels_round_charts_repeat_what_is_inside(baked):
    texels, charted = baked.light_map.texels, baked.charted
    bare = bake_light_map(scene_of(ROOM), size=256, margin=0)
    np.testing.assert_array_equal(bare.light_map.texels[charted], texels[charted])
    assert (bare.light_map.texels[~charted] == 0).all()
    assert (texels[~charted] > 0).any()


# Images


def test_an_image_by_a_map_is_that_of_traced_light(baked):
    image = render_light_map(baked.scene, baked.light_map, image_size=(128, 128), shading=MATTE)
    surface, scene = image.surface, baked.scene
    lit = trace_visibility(
        np.asarray(surface.position),
        np.asarray(surface.face_normal),
        np.asarray(surface.face_ids),
        scene.lights[0],
        Occluders(scene.mesh.positions, scene.mesh.faces),
    )
    cosine = np.maximum(np.asarray(surface.normal) @ TOWARD, 0)
    expected = (0.1 + 0.5 * lit * cosine) * np.asarray(surface.covered)
    error = np.abs(np.asarray(image.color) - expected[..., None]).max(axis=-1)
    assert np.median(error) <= 1e-6
    assert (error > 0.01).mean() <= 0.02  # measured 0.013: texels on edges of shadows
    assert image.shadow_maps == ()


def test_a_map_and_shadow_maps_show_the_same(baked):
    by_map = render_light_map(baked.scene, baked.light_map, image_size=(128, 128), shading=MATTE)
    by_shadow = render_scene(
        baked.scene,
        image_size=(128, 128),
        map_size=1024,
        bias=SlopeBias(2.0),
        filter=BilinearFilter(),
        compare=HardCompare(),
        shading=MATTE,
    )
    difference = np.abs(np.asarray(by_map.color - by_shadow.color)).max(axis=-1)
    assert (difference > 0.02).mean() <= 0.02  # measured 0.013


def test_derivatives_in_the_texels():
    mesh = jax.tree.map(jnp.asarray, FLOOR)
    camera = scene_of(FLOOR).camera
    surface = jax.jit(lambda m: render_surface(m, camera, image_size=(24, 24)))(mesh)
    texels = jnp.asarray(np.random.default_rng(0).random((4, 4, 3)), jnp.float32)
    look = lambda texels: jnp.sum(look_up_light(mesh, surface, LightMap(texels, mesh.uvs)) ** 2)
    gradient = jax.grad(look)(texels)
    step = jnp.zeros_like(texels).at[1, 2, 0].set(0.1)
    change = look(texels + step) - look(texels - step)
    assert float(gradient[1, 2, 0]) == pytest.approx(float(change) / 0.2, rel=1e-3)
    assert jnp.isfinite(gradient).all()


def test_a_maps_light_is_shaded_by_color_albedo_and_ambient():
    mesh = jax.tree.map(jnp.asarray, FLOOR)
    surface = texture_surface(mesh, mesh.uvs, size=(2, 3))
    light = jnp.asarray(np.random.default_rng(0).random((2, 3, 3)), jnp.float32)
    plain = shade_with_light_map(surface, light, shading=MATTE)
    assert_close(plain, 0.1 + 0.5 * light, ulps=4)
    red = jnp.broadcast_to(jnp.array([1.0, 0.0, 0.5], jnp.float32), light.shape)
    look = Appearance(surface.normal, base_color=red)
    assert_close(
        shade_with_light_map(surface, light, appearance=look, shading=MATTE), red * plain, ulps=4
    )
    bare = surface._replace(face_ids=jnp.full_like(surface.face_ids, -1))
    assert (shade_with_light_map(bare, light) == 0).all()


# Files


def test_a_map_is_read_as_it_was_written(baked, tmp_path):
    path = tmp_path / "light.exr"
    write_light_map(path, baked)
    scene, light_map = read_light_map(path, scene_of(ROOM))
    np.testing.assert_array_equal(light_map.texels, baked.light_map.texels)
    np.testing.assert_array_equal(light_map.uvs, baked.light_map.uvs)
    np.testing.assert_array_equal(scene.mesh.positions, baked.scene.mesh.positions)


def test_a_map_of_another_scene_is_refused(baked, tmp_path):
    path = tmp_path / "light.exr"
    write_light_map(path, baked)
    other = scene_of(merge(plane(2.0), raised(box((0.4, 0.3, 0.4)), 0.6)))
    with pytest.raises(ValueError, match=r"light\.exr: was baked for another scene than toy"):
        read_light_map(path, other)


@pytest.mark.errors
@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"size": 0}, "`size` from 1 to 8192, got 0"),
        ({"samples": 9}, "`samples` from 1 to 8, got 9"),
        ({"margin": -1}, "`margin` from 0 to 64, got -1"),
        ({"size": 4096, "samples": 4}, "size x samples of at most 8192, got 16384"),
    ],
)
def test_numbers_out_of_range_are_refused(options, says):
    with pytest.raises(ValueError, match=f"bake_light_map: expected {says}"):
        bake_light_map(scene_of(FLOOR), **options)


def test_unwrapping_a_scene_says_why():
    assert unwrap_scene(scene_of(FLOOR))[2] == ()
    assert unwrap_scene(scene_of(ROOM))[2] == ("charts by xatlas (overlapping uvs)",)
