"""Whole images of what is more than triangles: maps, mirrors, their cost and derivatives."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.rendering.prepare_scene import prepare_scene
from experiments.rendering.render_scene import render_scene, shade_scene
from experiments.scenes import load_scene
from shadows import (
    Appearance,
    BilinearFilter,
    DirectionalLight,
    HardCompare,
    OrthographicCamera,
    PerspectiveCamera,
    ShadowMap,
    SlopeBias,
    SoftCompare,
    SpotLight,
    look_at,
    render,
    shade,
)
from tangentspace import shapes
from tangentspace.environment import CubeMap, sample_cube_map, skybox
from tangentspace.lighting import lambert
from tangentspace.material import Material, with_mips
from tangentspace.shading import BlinnPhongShading, LambertShading, PhongShading
from tangentspace.texture import Texture

from .test_appearance import CAMERA, MESH, SIDE, TILES, UP, normal_texels, surface_of, unit
from .test_render import primitives
from .tools import assert_close

quick = functools.partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})

# A kept map in which no light meets anything.
NO_SHADOW = ShadowMap(jnp.ones((8, 8)), jnp.eye(4))

# A flat normal map's cells beside real bumps


CELLS = 192  # pixels of the image's side, which is four cells


@pytest.fixture(scope="module")
def cells():
    with jax.enable_x64(False):
        scene = prepare_scene(load_scene("normal-cells"))
        camera = OrthographicCamera(scene.camera.view_from_world, 1.0, 0.5, 4.0)
        return scene._replace(camera=camera)


def cell_pairs(image):
    """The four rows of two real cells, and the flat ones to their right."""
    side = CELLS // 4
    parts = np.asarray(image).reshape(4, side, 2, 2, side, -1)
    return parts[:, :, :, 0], parts[:, :, :, 1]


def unlike(scene):
    """Angles between the normals of real and flat cells, degrees, and differences in color."""
    shading = BlinnPhongShading()
    with jax.enable_x64(False):
        image = render_scene(
            scene,
            image_size=(CELLS, CELLS),
            map_size=64,
            bias=SlopeBias(2.0),
            filter=BilinearFilter(),
            compare=HardCompare(),
            shading=shading,
        )
        everywhere = [np.ones((CELLS, CELLS), np.float32)]
        color = shade_scene(scene, image, scene.lights, everywhere, shading)
        again = shade_scene(scene, image, scene.lights, image.visibilities, shading)
    assert bool(image.surface.covered.all())
    assert_close(again, image.color, ulps=8)
    real, flat = cell_pairs(image.appearance.normal)
    angles = np.rad2deg(2 * np.arcsin(np.linalg.norm(real - flat, axis=-1) / 2))
    real, flat = cell_pairs(color)
    assert np.ptp(real) > 0.4
    return angles.mean(axis=(1, 3)), angles.max(), np.abs(real - flat).max(axis=-1)


def test_flat_cells_look_like_the_real_ones_to_their_left(cells):
    """Turned by quarters and mirrored, each as near as triangles and texels allow."""
    mean, worst, color = unlike(cells)
    assert mean.max() < 0.25  # degrees; measured 0.163
    assert worst < 2.1  # measured 1.35
    median, most, nearly_all, largest = np.quantile(color, [0.5, 0.95, 0.999, 1])
    assert median < 1e-3  # measured 0.0005, where colors span 0.49
    assert most < 0.008  # measured 0.0048
    assert nearly_all < 0.025  # measured 0.0165
    assert largest < 0.04  # measured 0.0265


def with_map(scene, change):
    """The scene with other texels in all levels of its map."""
    plain, mapped = scene.materials
    texture = mapped.normal_texture
    mips = dataclasses.replace(texture.mips, texels=change(np.asarray(texture.mips.texels)))
    texture = dataclasses.replace(texture, mips=mips)
    return scene._replace(materials=(plain, dataclasses.replace(mapped, normal_texture=texture)))


def with_frames(scene, change):
    """The scene with other tangents and handedness."""
    tangent, handedness = np.split(np.asarray(scene.mesh.tangents), [3], axis=1)
    tangents = np.concatenate(change(tangent, handedness), axis=1)
    return scene._replace(mesh=scene.mesh._replace(tangents=tangents.astype(np.float32)))


def turned(tangent, degrees):
    cos, sin = np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
    return tangent @ np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]])


# Each with the least mean angle, in the worst cell, and the least difference at 95 % of pixels.
MISTAKES = {
    "green flipped": (
        lambda scene: with_map(scene, lambda c: np.float32([0, 1, 0]) + c * np.float32([1, -1, 1])),
        (14, 0.2),  # measured 14.3 and 0.24
    ),
    "red and green swapped": (lambda scene: with_map(scene, lambda c: c[:, [1, 0, 2]]), (14, 0.3)),
    "no map": (
        lambda scene: with_map(scene, lambda c: np.full_like(c, 0.5) + np.float32([0, 0, 0.5])),
        (11, 0.2),
    ),
    "handedness dropped": (
        lambda scene: with_frames(scene, lambda t, w: (t, np.abs(w))),
        (14, 0.2),  # of the mirrored half only
    ),
    "handedness turned": (lambda scene: with_frames(scene, lambda t, w: (t, -w)), (14, 0.2)),
    "tangents turned by 5 degrees": (
        lambda scene: with_frames(scene, lambda t, w: (turned(t, 5), w)),
        (0.9, 0.015),  # measured 0.996 and 0.016
    ),
    "tangents turned by a quarter": (
        lambda scene: with_frames(scene, lambda t, w: (turned(t, 90), w)),
        (14, 0.2),
    ),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_the_comparison_of_cells_sees_each_mistake(cells, mistake):
    change, (angle, difference) = MISTAKES[mistake]
    mean, _, color = unlike(change(cells))
    assert mean.max() > angle
    assert np.quantile(color, 0.95) > difference


# Mirrors and surroundings


def faces_of_one_color():
    """+x red, -x cyan, +y green, -y magenta, +z blue, -z yellow."""
    colors = np.array([[1, 0, 0], [0, 1, 1], [0, 1, 0], [1, 0, 1], [0, 0, 1], [1, 1, 0]])
    return CubeMap(np.broadcast_to(colors[:, None, None].astype(float), (6, 4, 4, 3)))


@pytest.fixture(scope="module")
def front():
    return surface_of(MESH, CAMERA)


light_front = quick(
    lambda surface, lights, visibilities, **options: shade(surface, lights, visibilities, **options)
)


def test_mirrors_show_the_surroundings_in_their_share(front):
    """Normals that lean by 45 degrees along u: a mirror shows what lies there."""
    tangents = np.repeat(MESH.tangents[::4, :3], SIDE**2, axis=0).reshape(4, SIDE, SIDE, 3)
    normal, share = np.zeros((*front.covered.shape, 3)), np.zeros(front.covered.shape)
    for tile, leaning in zip(TILES, unit(tangents + np.array([0, 0, 1.0])), strict=True):
        normal[tile], share[tile] = leaning, 0.75
    share[TILES[3]] = 0.0
    look = Appearance(jnp.asarray(normal), reflectivity=jnp.asarray(share))
    dark = [jnp.zeros(front.covered.shape)]
    lights = [DirectionalLight(np.array([0.0, 0.0, 1.0]))]
    around = faces_of_one_color()
    color = light_front(front, lights, dark, appearance=look, environment=around)
    for tile, seen in zip(TILES, ([1, 0, 0], [0, 1, 0], [0, 1, 1], None), strict=True):
        expected = np.full(3, 0.1) if seen is None else 0.25 * 0.1 + 0.75 * np.array(seen)
        assert_close(color[tile], np.broadcast_to(expected, (SIDE, SIDE, 3)))
    assert_close(color[~front.covered], np.zeros((int((~front.covered).sum()), 3)), ulps=0)
    lonely = light_front(front, lights, dark, appearance=look)  # black around
    assert_close(lonely[TILES[0]], np.full((SIDE, SIDE, 3), 0.025))
    assert_close(lonely[TILES[3]], np.full((SIDE, SIDE, 3), 0.1))


def test_lights_add_up_over_a_look_and_ambient_counts_once(front):
    random = np.random.default_rng(0)
    shape = front.covered.shape
    base_color = jnp.asarray(random.random((*shape, 3)))
    directions = unit(random.normal(size=(3, 3)) + np.array([0, 0, 2]))
    lights = [DirectionalLight(d, random.random(3)) for d in directions]
    visibilities = [jnp.asarray(v) for v in random.random((3, *shape))]
    look = Appearance(front.normal, base_color)
    shading = LambertShading(albedo=0.7, ambient=0.2)
    color = light_front(front, lights, visibilities, appearance=look, shading=shading)
    expected = 0.2 * base_color
    for light, visible in zip(lights, visibilities, strict=True):
        expected += lambert(
            front.normal,
            light.direction,
            albedo=0.7 * base_color,
            radiance=light.color,
            visibility=visible,
        )
    covered = np.asarray(front.covered)
    assert_close(color[covered], expected[covered])


# Cost: a model no larger than the scene needs


BALL = shapes.uv_sphere(1.0, rings=6, segments=8, dtype=np.float32)
BALL = BALL._replace(
    tangents=np.concatenate(
        [np.cross([0.1, 1, 0], BALL.normals), np.ones((len(BALL.normals), 1))], axis=1
    ).astype(np.float32)
)
BARE = BALL._replace(uvs=None, tangents=None)
VIEW = np.asarray(look_at(np.array([0.4, 0.9, 3.0]), np.zeros(3), UP))
EYE = PerspectiveCamera(VIEW, 0.8, 1.0, 10.0)
TEXTURE = Texture(np.random.default_rng(0).random((5, 7, 3)))
PLAIN = (Material(), Material(height_texture=Texture(TEXTURE.texels[..., :1])))


def program(mesh, materials, **options):
    """What is compiled for an image in single precision."""
    single = lambda a: np.asarray(a, np.int32 if np.asarray(a).dtype.kind == "i" else np.float32)
    light = DirectionalLight(np.array([0.0, 0.6, 0.8]))
    options |= {"materials": list(materials), "shadow_maps": [NO_SHADOW]}
    arguments = jax.tree.map(single, (mesh, EYE, light, options))

    def draw(mesh, camera, light, options):
        return render(mesh, camera, light, image_size=(12, 16), **options).color

    with jax.enable_x64(False):
        return quick(draw).trace(*arguments)


def gathers(traced):
    return list(primitives(traced.jaxpr.jaxpr)).count("gather")


def cost(traced):
    with jax.enable_x64(False):
        analysis = traced.lower().compile().cost_analysis()
    return analysis["flops"], analysis["bytes accessed"]


@pytest.fixture(scope="module")
def bare():
    traced = program(BARE, ())
    return traced.lower().as_text(), gathers(traced), cost(traced)


FREE = {
    "a plain material": (BARE, [Material()]),
    "uvs and tangents": (BALL, [Material()]),
    "uvs and tangents, no material": (BALL, ()),
    "a height texture, which displacement consumes": (BALL, PLAIN[1:]),
    "a scale of normals without a map": (BALL, [Material(normal_scale=0.5)]),
}


@pytest.mark.parametrize("case", FREE)
def test_what_a_scene_has_not_is_not_in_the_program(case, bare):
    """The same text goes to the compiler, so that the same comes out of it."""
    traced = program(*FREE[case])
    assert gathers(traced) == bare[1]
    assert traced.lower().as_text() == bare[0]


def test_plain_materials_of_many_faces_cost_nothing_once_compiled(bare):
    traced = program(BALL, PLAIN, face_materials=np.arange(len(BALL.faces)) % 2)
    assert cost(traced) == bare[2]


def test_textures_cost_what_they_are(bare):
    """The checks above can see it."""
    textured = program(BALL, [Material(base_color_texture=TEXTURE)])
    mapped = program(BALL, [Material(base_color_texture=TEXTURE, normal_texture=TEXTURE)])
    mipped = program(BALL, [Material(base_color_texture=with_mips(TEXTURE))])
    mirror = program(BARE, [Material(reflectivity=0.5)], environment=faces_of_one_color())
    colored = program(BARE, [Material((0.2, 0.3, 0.4))])
    assert gathers(colored) == bare[1]
    assert colored.lower().as_text() != bare[0]
    assert bare[1] < gathers(textured) < gathers(mapped)
    assert bare[1] < gathers(mirror)
    assert gathers(textured) < gathers(mipped)
    assert all(more > less for more, less in zip(cost(textured), bare[2], strict=True))


# Derivatives


def light_matrix(light, positions):
    return light.clip_from_world(positions)


def everything():
    """A round mesh off every axis, with mips and without, under soft shadows and a sky."""
    random = np.random.default_rng(0)
    mesh = jax.tree.map(lambda a: a if a.dtype == np.int32 else a.astype(float), BALL)
    noise = lambda a: a + 0.02 * random.normal(size=a.shape)
    mesh = mesh._replace(
        positions=noise(mesh.positions),
        normals=noise(mesh.normals),
        uvs=noise(mesh.uvs) * [2.3, 1.7],
        tangents=mesh.tangents + 0.1 * random.normal(size=mesh.tangents.shape) * [1, 1, 1, 0],
    )
    bumps = with_mips(Texture(normal_texels(21)))
    smooth = Texture(random.random((5, 3, 3)))
    materials = [
        Material(random.random(3), with_mips(Texture(random.random((27, 22, 3)))), bumps),
        Material(
            None, smooth, Texture(normal_texels(3)), np.array(0.7), reflectivity=np.array(0.3)
        ),
    ]
    position = np.array([1.5, 2.0, 3.5])
    light = SpotLight(
        position, unit(-position), np.array(0.1), np.array(0.9), np.array([1.0, 0.9, 0.8])
    )
    around = CubeMap(random.random((6, 4, 4, 3)))
    depths = 0.97 + 0.03 * random.random((8, 8))  # about those of the surface
    shading = PhongShading(*(np.array(x) for x in (0.5, 0.9, 5.0, 0.1)))
    return {
        "mesh": mesh._asdict(),
        "materials": materials,
        "light": light,
        "environment": around,
        "shadow_map": ShadowMap(depths, np.asarray(quick(light_matrix)(light, mesh.positions))),
        "shading": shading,
        "camera": PerspectiveCamera(np.asarray(VIEW, float), np.array(0.8), 1.0, 10.0),
    }


@quick
@functools.partial(jax.value_and_grad, has_aux=True, allow_int=True)
def weighted_image(parts):
    """The sum of an image, each channel of each pixel with a weight of its own; the image."""
    mesh = shapes.Mesh(**parts["mesh"])
    image = render(
        mesh,
        parts["camera"],
        parts["light"],
        image_size=(12, 16),
        shadow_maps=[parts["shadow_map"]],
        compare=SoftCompare(3.0),
        materials=parts["materials"],
        face_materials=np.arange(len(BALL.faces)) % 2,
        environment=parts["environment"],
        shading=parts["shading"],
    )
    return jnp.sum(image.color * np.random.default_rng(4).normal(size=(12, 16, 3))), image


def test_an_image_is_its_stages_and_the_sky_behind():
    parts = everything()
    (_, image), _ = weighted_image(parts)
    covered = np.asarray(image.surface.covered)
    assert 0.2 < covered.mean() < 0.8
    shading = {"shading": parts["shading"], "environment": parts["environment"]}
    surface = light_front(
        image.surface, [parts["light"]], image.visibilities, appearance=image.appearance, **shading
    )
    assert_close(image.color[covered], surface[covered])
    assert_close(surface[~covered], np.zeros((int((~covered).sum()), 3)), ulps=0)
    # The upper left pixel's ray, from the definition; row 0 on top, width / height = 4 / 3.
    to_corner = np.array([-4 / 3 * 15 / 16, 11 / 12, -1 / np.tan(0.4)])
    ray = VIEW[:3, :3].astype(float).T @ to_corner
    assert not covered[0, 0]
    assert_close(image.color[0, 0], sample_cube_map(parts["environment"], ray), ulps=512)
    matrix = parts["camera"].clip_from_world(16 / 12)
    sky = quick(skybox, static_argnums=(2, 3))(parts["environment"], matrix, 12, 16)
    assert float(jnp.ptp(sky)) > 0.5
    assert_close(image.color[~covered], np.asarray(sky)[~covered])


STILL = ("['faces']", ".height_scale", ".near", ".far")  # of which images have no slope


def test_an_image_has_its_derivatives_in_all_that_made_it():
    """Against central differences, where no pixel's centre lies on an edge or a texel's."""
    parts = everything()
    slopes = jax.tree.leaves(weighted_image(parts)[1])
    paths, structure = jax.tree_util.tree_flatten_with_path(parts)
    names, leaves = ([item[k] for item in paths] for k in (0, 1))
    random, checked = np.random.default_rng(6), []
    for k, (name, leaf, slope) in enumerate(zip(names, leaves, slopes, strict=True)):
        if any(still in jax.tree_util.keystr(name) for still in STILL):
            continue
        step = 1e-6 * random.normal(size=np.shape(leaf))
        above, below = (
            float(
                weighted_image(
                    structure.unflatten([*leaves[:k], leaf + sign * step, *leaves[k + 1 :]])
                )[0][0]
            )
            for sign in (1, -1)
        )
        numerical, slope = (above - below) / 2e-6, float(np.sum(slope * step)) / 1e-6
        assert abs(numerical) > 1e-3, jax.tree_util.keystr(name)
        assert slope == pytest.approx(numerical, rel=1e-6), jax.tree_util.keystr(name)
        checked.append(name)
    assert len(checked) == 4 + 7 + 5 + 1 + 2 + 4 + 2


FLAWS = {
    "zero tangents": {"tangents": 0.0},
    "zero normals": {"normals": 0.0},
    "uvs at one point": {"uvs": 0.0},
    "a third of all": {"positions": (2, 3), "normals": (3, 5), "uvs": (2, 5), "tangents": (1, 3)},
}


@pytest.mark.parametrize("flaw", FLAWS)
def test_derivatives_are_finite_whatever_is_broken(flaw):
    """Also where nothing is, whose positions are the origin: there stands the light."""
    parts = everything()
    parts["light"] = dataclasses.replace(parts["light"], position=np.zeros(3))
    for name, change in FLAWS[flaw].items():
        array = parts["mesh"][name]
        if isinstance(change, tuple):
            offset, every = change
            kept = (np.arange(len(array)) % every != offset % every)[:, None]
            parts["mesh"][name] = array * kept
        else:
            parts["mesh"][name] = array * change
    (value, _), slopes = weighted_image(parts)
    assert np.isfinite(value)
    for path, leaf in jax.tree_util.tree_leaves_with_path(slopes):
        if leaf.dtype != jax.dtypes.float0:
            assert np.isfinite(leaf).all(), jax.tree_util.keystr(path)


# Errors


@pytest.mark.errors
@pytest.mark.parametrize("count", [0, 1, 3])
def test_each_light_has_one_visibility(front, count):
    lights = [DirectionalLight(UP), DirectionalLight(UP)]
    expected = f"shade: expected one of `visibilities` for each of 2 lights, got {count}"
    with pytest.raises(ValueError, match=f"^{expected}$"):
        shade(front, lights, [jnp.ones(front.covered.shape)] * count)


@pytest.mark.errors
def test_without_light_there_is_no_image(front):
    with pytest.raises(ValueError, match="expected at least one of `lights`, got none"):
        shade(front, [], [])


@pytest.mark.errors
def test_each_light_has_one_kept_map():
    lights = [DirectionalLight(UP)]
    with pytest.raises(
        ValueError, match=r"^render: expected one of `shadow_maps` .* 1 lights, got 0"
    ):
        render(MESH, CAMERA, lights, image_size=(12, 16), shadow_maps=[])
