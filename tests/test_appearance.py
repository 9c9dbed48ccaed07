"""From materials to pixels: colors, normals, gloss and reflectivity, each in its own region.

Four square tiles of 8 x 8 pixels, seen straight on by parallel rays: a texture of 8 x 8 texels
shows each texel at one pixel, so what is expected are the texels themselves.
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from shadows import (
    Appearance,
    OrthographicCamera,
    PerspectiveCamera,
    look_at,
    render_surface,
    surface_appearance,
)
from tangentspace import shapes
from tangentspace.lighting import blinn_phong, lambert
from tangentspace.material import Material, with_mips
from tangentspace.mesh import Mesh
from tangentspace.shading import BlinnPhongShading, LambertShading, PhongShading
from tangentspace.texture import Texture

from .tools import assert_close

SIDE, IMAGE = 8, (20, 28)  # pixels of a tile and of the image; 8 pixels are a unit of length
TILES = tuple((slice(r, r + SIDE), slice(c, c + SIDE)) for r in (2, 10) for c in (6, 14))
# In which direction u and v grow on each tile: as written, turned, mirrored, both.
AXES = np.array([[[1, 0], [0, 1]], [[0, 1], [-1, 0]], [[-1, 0], [0, 1]], [[0, 1], [1, 0]]])
HANDEDNESS = (1, 1, -1, -1)
FACE_TILES = np.repeat(np.arange(4, dtype=np.int32), 2)
RANDOM = np.random.default_rng(0)
COLORS = RANDOM.random((SIDE, SIDE, 3))
UP = np.array([0.0, 1.0, 0.0])

quick = functools.partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})
surface_of = quick(lambda mesh, camera: render_surface(mesh, camera, image_size=IMAGE))


@quick
def looks(mesh, camera, surface, materials, face_materials=None):
    return surface_appearance(mesh, camera, surface, materials, face_materials=face_materials)


def tiles(dtype=np.float64, axes=AXES):
    """Two above two in the plane z = 0; shading normals lean outwards, the more the farther."""
    corners = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])
    middles = np.array([[-0.5, 0.5], [0.5, 0.5], [-0.5, -0.5], [0.5, -0.5]])
    plane = (middles[:, None] + corners).reshape(-1, 2)
    positions = np.concatenate([plane, np.zeros((16, 1))], axis=1)
    normals = np.concatenate([0.4 * plane, np.ones((16, 1))], axis=1)
    uvs = np.concatenate([corners @ axis.T + 0.5 for axis in axes])
    along_u = np.repeat(axes[:, 0], 4, axis=0)
    sign = np.repeat(HANDEDNESS, 4)[:, None]
    tangents = np.concatenate([along_u, np.zeros((16, 1)), sign], axis=1)
    faces = np.concatenate([[[k, k + 1, k + 2], [k, k + 2, k + 3]] for k in range(0, 16, 4)])
    arrays = (positions, normals, faces.astype(np.int32), uvs, tangents)
    return Mesh(*(a if a.dtype == np.int32 else a.astype(dtype) for a in arrays))


def camera_on_axis(side=1.0, dtype=np.float64):
    view = look_at(np.array([0.0, 0.0, 3.0 * side]), np.zeros(3), UP)
    return OrthographicCamera(np.asarray(view, dtype), 1.25, 1.0, 5.0)


MESH, CAMERA = tiles(), camera_on_axis()


@pytest.fixture(scope="module")
def front():
    return surface_of(MESH, CAMERA)


def normal_texels(size=SIDE, spread=0.6):
    """A map of generic normals, up to about 40 degrees."""
    normals = np.ones((size, size, 3))
    normals[..., :2] = np.random.default_rng(1).uniform(-spread, spread, (size, size, 2))
    return 0.5 * (unit(normals) + 1)


def unit(vectors):
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def on_tile(texels, axis):
    """What a tile shows at each pixel: for each, the texel at its u and v."""
    x, y = np.meshgrid((np.arange(SIDE) + 0.5) / SIDE - 0.5, 0.5 - (np.arange(SIDE) + 0.5) / SIDE)
    u, v = np.moveaxis(np.stack([x, y], axis=-1) @ axis.T, -1, 0)
    size = len(texels)
    return texels[(size * (0.5 - v)).astype(int), (size * (0.5 + u)).astype(int)]


def frames(tile):
    """T, B and N at the pixels of a tile, from the definition."""
    rows, columns = np.mgrid[TILES[tile]]
    x, y = (columns + 0.5) / SIDE - 1.75, 1.25 - (rows + 0.5) / SIDE
    normal = np.stack([0.4 * x, 0.4 * y, np.ones_like(x)], axis=-1)
    tangent = np.append(AXES[tile][0], 0.0)
    return tangent, HANDEDNESS[tile] * np.cross(normal, tangent), normal


def assert_same(actual, expected, *, ulps=64):
    """Compare what is there; None agrees with None only."""
    assert (actual is None) == (expected is None)
    if actual is not None:
        assert_close(actual, expected, ulps=ulps)


# Colors


def colored_materials(dtype=np.float64):
    texture = Texture(COLORS.astype(dtype))
    tint = np.array([0.5, 0.25, 2.0], dtype)
    return [
        Material((0.2, 0.4, 0.6)),
        Material(base_color_texture=texture),
        Material(tint, base_color_texture=texture),
        Material(),
    ]


def color_of(material, tile):
    colors = np.ones((SIDE, SIDE, 3))
    if material.base_color is not None:
        colors = colors * np.asarray(material.base_color)
    if material.base_color_texture is not None:
        colors = colors * on_tile(COLORS, AXES[tile])
    return colors


@pytest.mark.parametrize("order", [(0, 1, 2, 3), (3, 2, 0, 1), (1, 1, 2, 2)])
def test_each_region_has_the_color_of_its_material(front, order):
    materials = colored_materials()
    seen = looks(MESH, CAMERA, front, materials, np.array(order, np.int32)[FACE_TILES])
    for tile, material in enumerate(order):
        expected = color_of(materials[material], tile)
        assert_close(seen.base_color[TILES[tile]], expected, ulps=256)  # measured 17
    assert_same(seen.coherence, None)
    assert_same(seen.reflectivity, None)
    assert_close(seen.normal, front.normal, ulps=0)


def test_colors_in_the_precision_of_users():
    mesh, camera = tiles(np.float32), camera_on_axis(dtype=np.float32)
    materials = colored_materials(np.float32)
    with jax.enable_x64(False):
        seen = looks(mesh, camera, surface_of(mesh, camera), materials, FACE_TILES)
    assert {seen.base_color.dtype, seen.normal.dtype} == {np.dtype(np.float32)}
    for tile, material in enumerate(materials):
        # The lookup's place is rounded at 8 texels: measured 31.
        assert_close(seen.base_color[TILES[tile]], color_of(material, tile), ulps=128)


def test_one_material_covers_all_faces_unasked(front):
    seen = looks(MESH, CAMERA, front, [colored_materials()[2]])
    for tile in range(4):
        expected = color_of(colored_materials()[2], tile)
        assert_close(seen.base_color[TILES[tile]], expected, ulps=256)


@pytest.mark.parametrize("materials", [[], [Material()], [Material(height_scale=2.0)]])
def test_what_no_material_has_is_none(front, materials):
    seen = looks(MESH, CAMERA, front, materials)
    assert seen[1:] == (None, None, None)
    assert_close(seen.normal, front.normal, ulps=0)


def test_colors_with_mips_are_means_where_minified(front):
    """Four texels a pixel: the mean of 4 x 4; as many as pixels: each texel."""
    texels = RANDOM.random((4 * SIDE, 4 * SIDE, 3))
    means = texels.reshape(SIDE, 4, SIDE, 4, 3).mean(axis=(1, 3))
    fine, coarse = with_mips(Texture(texels)), with_mips(Texture(COLORS))
    materials = [Material(base_color_texture=texture) for texture in (fine, coarse)]
    seen = looks(MESH, CAMERA, front, materials, FACE_TILES % 2)
    for tile in range(4):
        expected = on_tile(COLORS if tile % 2 else means, AXES[tile])
        assert_close(seen.base_color[TILES[tile]], expected, ulps=256)  # measured 18


def test_the_longer_footprint_chooses_the_mip_whichever_way_it_lies(front):
    """Four texels a pixel along u, which runs to the right on two tiles and upwards on two."""
    stripes = np.broadcast_to(RANDOM.random((1, 4 * SIDE, 3)), (SIDE, 4 * SIDE, 3))
    means = np.repeat(stripes[:1].reshape(1, SIDE, 4, 3).mean(axis=2), SIDE, axis=0)
    seen = looks(MESH, CAMERA, front, [Material(base_color_texture=with_mips(Texture(stripes)))])
    for tile in range(4):
        assert_close(seen.base_color[TILES[tile]], on_tile(means, AXES[tile]), ulps=256)


# Normals


@pytest.mark.parametrize("scale", [None, 0.5, -2.0])
def test_normals_are_those_of_the_map_in_each_frame(front, scale):
    texels = normal_texels()
    materials = [Material(normal_texture=Texture(texels), normal_scale=scale)]
    seen = looks(MESH, CAMERA, front, materials)
    for tile in range(4):
        x, y, z = np.moveaxis(2 * on_tile(texels, AXES[tile]) - 1, -1, 0)[..., None]
        if scale is not None:
            length = np.sqrt(scale**2 * (x * x + y * y) + z * z)
            x, y, z = scale * x / length, scale * y / length, z / length
        tangent, bitangent, normal = frames(tile)
        expected = unit(x * tangent + y * bitangent + z * normal)
        assert_close(seen.normal[TILES[tile]], expected, ulps=256)  # measured 19
    assert_same(seen.coherence, None)
    assert_same(seen.base_color, None)


def test_only_mapped_regions_are_bumped(front):
    """Two maps and two materials without: each its own."""
    one, other = normal_texels(), normal_texels()[::-1]
    materials = [Material(), Material(normal_texture=Texture(one)), Material((0.5, 0.5, 0.5))]
    materials.append(Material(normal_texture=Texture(other), normal_scale=0.5))
    seen = looks(MESH, CAMERA, front, materials, FACE_TILES)
    for tile, alone in ((1, [materials[1]]), (3, [materials[3]])):
        expected = looks(MESH, CAMERA, front, alone).normal
        assert_close(seen.normal[TILES[tile]], expected[TILES[tile]], ulps=4)
    for tile in (0, 2):
        assert_close(seen.normal[TILES[tile]], front.normal[TILES[tile]], ulps=0)


def test_from_behind_normals_are_turned_over_and_images_mirrored():
    """The surface shows the same bumps from its other side, where each is a dent."""
    behind = camera_on_axis(-1.0)
    surface = surface_of(MESH, behind)
    materials = [
        Material(base_color_texture=Texture(COLORS), normal_texture=Texture(normal_texels()))
    ]
    seen = looks(MESH, behind, surface, materials)
    front = looks(MESH, CAMERA, surface_of(MESH, CAMERA), materials)
    covered = np.asarray(surface.covered)
    assert covered.sum() == 4 * SIDE**2
    for name, sign in (("base_color", 1), ("normal", -1)):
        expected = sign * np.asarray(getattr(front, name))[:, ::-1]
        assert_close(getattr(seen, name)[covered], expected[covered], ulps=256)
    assert (np.asarray(seen.normal)[covered] @ [0, 0, -1] > 0.3).all()


# A round mesh in perspective, inside out on request: what is seen are back faces then.
BALL = shapes.uv_sphere(1.0, rings=6, segments=10, dtype=np.float64)
BALL = BALL._replace(
    tangents=np.concatenate(
        [unit(np.cross(UP, BALL.normals) + 1e-3), np.ones((len(BALL.normals), 1))], axis=1
    )
)


def ball_seen(dtype, *, inside_out=False):
    view = look_at(np.array([0.5, 0.8, 3.0]), np.zeros(3), UP)
    camera = PerspectiveCamera(np.asarray(view), 0.8, 1.0, 10.0)
    mesh = BALL._replace(faces=BALL.faces[:, ::-1], normals=-BALL.normals) if inside_out else BALL
    cast = lambda a: a if a.dtype == np.int32 else np.asarray(a, dtype)
    return jax.tree.map(lambda a: cast(np.asarray(a)), (mesh, camera))


@quick
def under_flat_maps(mesh, camera, texture):
    """The surface, its look under the same map with mips and without, and all colors."""
    surface = render_surface(mesh, camera, image_size=IMAGE)
    maps = [Material(normal_texture=texture), Material(normal_texture=with_mips(texture))]
    found = [surface_appearance(mesh, camera, surface, [material]) for material in maps]
    to_light = unit(np.array([1.0, 1.0, 1.0])).astype(mesh.positions.dtype)
    colors = [
        look.bind(shading)(look.normal, to_light, surface.to_camera)
        for shading in (PhongShading(shininess=5.0), BlinnPhongShading())
        for look in (Appearance(surface.normal), *found)
    ]
    return surface, found, colors


@pytest.mark.parametrize("inside_out", [False, True])
def test_a_flat_map_changes_nothing(inside_out, dtype):
    """Not the normal, to the last bit; not the gloss; and so no color; also on back faces."""
    flat = Texture(np.full((16, 16, 3), [0.5, 0.5, 1.0], dtype))
    with jax.enable_x64(dtype is np.float64):
        mesh, camera = ball_seen(dtype, inside_out=inside_out)
        surface, found, colors = under_flat_maps(mesh, camera, flat)
    assert float(surface.covered.mean()) > 0.3
    for look in found:
        assert look.normal.dtype == dtype
        assert_close(look.normal, surface.normal, ulps=0)
    assert found[0].coherence is None
    assert_close(found[1].coherence, np.ones(IMAGE), ulps=0)
    for plain, *mapped in (colors[:3], colors[3:]):
        assert float(jnp.ptp(plain)) > 0.3
        for color in mapped:
            np.testing.assert_allclose(color, plain, rtol=0, atol=1e-7)


# Gloss


def striped_texels(size, tilt=0.5):
    """Normals that lean to the left and to the right by turns: their mean is shorter."""
    sign = np.where(np.arange(size) % 2, tilt, -tilt)
    normals = np.stack([np.tile(sign, (size, 1)), np.zeros((size, size)), np.ones((size, size))])
    return 0.5 * (unit(np.moveaxis(normals, 0, -1)) + 1)


def test_minified_maps_spread_highlights(front):
    """Four texels a pixel: the mean's length counts by 15 / 17 (see ``normal_filtering``)."""
    fine, coarse = (with_mips(Texture(striped_texels(n * SIDE))) for n in (4, 1))
    materials = [Material(normal_texture=texture) for texture in (fine, coarse)] + [Material()]
    seen = looks(MESH, CAMERA, front, materials, np.array([0, 1, 2, 0], np.int32)[FACE_TILES])
    length = 1 / np.sqrt(1 + 0.5**2)
    coherent = length / (length + 15 / 17 * (1 - length))
    for tile, expected in enumerate((coherent, 1.0, 1.0, coherent)):
        assert_close(seen.coherence[TILES[tile]], np.full((SIDE, SIDE), expected), ulps=256)
    assert_close(seen.normal[TILES[0]], front.normal[TILES[0]], ulps=256)  # the stripes cancel


def test_no_gloss_without_mips(front):
    material = Material(normal_texture=Texture(striped_texels(32)))
    assert looks(MESH, CAMERA, front, [material]).coherence is None


def test_color_and_gloss_reach_the_lighting_model():
    """Bound as the models take them: the same as telling the functions of ``lighting``."""
    normal, to_light, to_camera = unit(np.random.default_rng(2).normal(size=(3, 5, 4, 3)))
    base_color, coherence = RANDOM.random((5, 4, 3)), RANDOM.uniform(0.3, 1, (5, 4))
    vectors = [jnp.asarray(v) for v in (normal, to_light, to_camera)]
    look = Appearance(vectors[0], jnp.asarray(base_color), jnp.asarray(coherence))
    expected = blinn_phong(
        *vectors,
        albedo=0.5 * base_color,
        ambient=0.1 * base_color,
        gloss=coherence / (coherence + 32 * (1 - coherence)),
    )
    assert_close(look.bind(BlinnPhongShading())(*vectors), expected)
    matte = lambert(*vectors, albedo=0.8 * base_color)
    assert_close(look.bind(LambertShading())(*vectors), matte)
    unbound = Appearance(vectors[0]).bind(PhongShading())
    assert_close(unbound(*vectors), PhongShading()(*vectors), ulps=0)


# Mirrors


def test_reflectivity_by_region(front):
    materials = [Material(reflectivity=0.75), Material((0.1, 0.2, 0.3)), Material()]
    materials.append(Material((0.1, 0.2, 0.3), reflectivity=np.asarray(0.25)))
    seen = looks(MESH, CAMERA, front, materials, FACE_TILES)
    expected = np.zeros(IMAGE)
    for tile, share in enumerate((0.75, 0.0, 0.0, 0.25)):
        expected[TILES[tile]] = share
    assert_close(seen.reflectivity, expected, ulps=0)


# Flaws; derivatives are those of whole images, in ``test_mapped_render``


FLAWS = {
    "zero tangents": lambda m: m._replace(tangents=0 * m.tangents),
    "zero normals": lambda m: m._replace(normals=0 * m.normals),
    "tangents along normals": lambda m: m._replace(
        tangents=np.concatenate([m.normals, m.tangents[:, 3:]], axis=1)
    ),
    "no handedness": lambda m: m._replace(tangents=m.tangents * [1, 1, 1, 0]),
    "equal uvs": lambda m: m._replace(uvs=0 * m.uvs + 0.3),
    "huge uvs": lambda m: m._replace(uvs=1e30 * m.uvs),
    "one vertex broken": lambda m: m._replace(
        tangents=m.tangents * (np.arange(len(m.tangents)) % 3 != 0)[:, None],
        normals=m.normals * (np.arange(len(m.normals)) % 2 != 0)[:, None],
    ),
}


@pytest.mark.parametrize("flaw", FLAWS)
def test_where_no_frame_exists_the_surface_keeps_its_normal(flaw):
    mesh, camera = ball_seen(np.float64)
    broken = FLAWS[flaw](mesh)
    surface = surface_of(broken, camera)
    material = Material(
        base_color_texture=with_mips(Texture(COLORS)),
        normal_texture=with_mips(Texture(normal_texels())),
    )
    seen = looks(broken, camera, surface, [material])
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(seen))
    assert bool((seen.coherence > 0).all())
    if flaw in ("zero tangents", "zero normals", "tangents along normals", "no handedness"):
        assert_close(seen.normal, surface.normal, ulps=8)
    else:
        assert float(jnp.abs(seen.normal - surface.normal).max()) > 0.02


def test_a_map_that_says_nothing_leaves_the_normal():
    """Texels of (1/2, 1/2, 1/2) are no direction: value and derivatives are the surface's."""
    gray = Texture(np.full((4, 4, 3), 0.5))
    mesh, camera = ball_seen(np.float64)
    surface = surface_of(mesh, camera)
    material = Material(normal_texture=gray, normal_scale=np.array(0.5))
    assert_close(looks(mesh, camera, surface, [material]).normal, surface.normal, ulps=8)
    total = lambda m: jnp.sum(surface_appearance(mesh, camera, surface, [m]).normal * COLORS[0, 0])
    for slope in jax.tree.leaves(quick(jax.grad(total))(material)):
        assert_close(slope, np.zeros_like(slope), ulps=0)


# Errors


@pytest.mark.errors
@pytest.mark.parametrize(
    ("materials", "changed", "message"),
    [
        (
            [Material(base_color_texture=Texture(COLORS))],
            {"uvs": None},
            "expected a mesh with uvs where a material has a texture, got None; unwrap",
        ),
        (
            [Material(normal_texture=Texture(normal_texels()))],
            {"uvs": None},
            "expected a mesh with uvs where a material has a texture, got None; unwrap",
        ),
        (
            [Material(), Material(normal_texture=with_mips(Texture(normal_texels())))],
            {"tangents": None},
            "expected a mesh with tangents where a material has a normal map, got None; make them",
        ),
    ],
)
def test_a_mesh_that_lacks_what_materials_need(front, materials, changed, message):
    with pytest.raises(ValueError, match=f"^surface_appearance: {message}") as error:
        surface_appearance(
            MESH._replace(**changed), CAMERA, front, materials, face_materials=FACE_TILES % 2
        )
    assert "\n" not in str(error.value)


@pytest.mark.errors
def test_several_materials_need_to_know_their_faces(front):
    expected = "^surface_appearance: expected `face_materials` with 2 materials, got None; give one"
    with pytest.raises(ValueError, match=expected):
        surface_appearance(MESH, CAMERA, front, [Material(), Material()])


def test_what_is_not_needed_is_not_missed(front):
    """Neither uvs without textures, nor tangents without maps, nor uvs for heights and mirrors."""
    bare = MESH._replace(uvs=None, tangents=None)
    plain = Material((0.1, 0.2, 0.3), normal_scale=0.5, height_texture=Texture(COLORS[..., :1]),
                     reflectivity=0.5)  # fmt: skip
    seen = looks(bare, CAMERA, front, [plain])
    assert_close(seen.base_color[TILES[0]], np.broadcast_to([0.1, 0.2, 0.3], (SIDE, SIDE, 3)))
    textured = dataclasses.replace(plain, base_color_texture=Texture(COLORS))
    looks(MESH._replace(tangents=None), CAMERA, front, [textured])
