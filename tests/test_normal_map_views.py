"""What a fit of a normal map takes for the image, against the renderer and against laws.

The forward model of the fit is written for speed: rows of pixels, texels found beforehand,
colors light by light. The renderer computes the same another way, and is the reference.
"""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import ndimage

from experiments.normal_map_fits.normal_map_task import Task, Unknowns
from experiments.normal_map_fits.normal_map_views import View, see_map
from experiments.scene import Material, Scene
from shadows import shade, surface_appearance
from shadows.lights import DirectionalLight, PointLight, SpotLight
from shadows.transforms import OrthographicCamera, look_at
from tangentspace.material import with_mips
from tangentspace.mikktspace import with_tangents
from tangentspace.normal_map import encode_normals, normals_from_slopes
from tangentspace.shading import BlinnPhongShading, LambertShading, PhongShading
from tangentspace.shapes import merge, plane
from tangentspace.texture import Texture, clamp, mirror, repeat

from .tools import assert_close

quick = functools.partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})
IMAGE, MAP = (40, 48), (7, 9)
UP = np.array([0.0, 1.0, 0.0])
MODELS = [
    LambertShading(np.array([0.9, 0.5, 0.2], np.float32), ambient=0.07),
    PhongShading(),
    BlinnPhongShading(specular=np.array([0.2, 0.3, 0.4], np.float32), shininess=9.0),
]


def float32(*numbers):
    return np.array(numbers, np.float32)


def unit(*numbers):
    return (np.array(numbers) / np.linalg.norm(numbers)).astype(np.float32)


LIGHTS = (
    DirectionalLight(unit(0.7, 1.0, 0.3), float32(1.0, 0.7, 0.4)),
    PointLight(float32(-1.6, 1.8, 0.9), float32(0.4, 0.9, 1.3)),
    SpotLight(float32(0.4, 2.2, -1.4), unit(-0.2, -2.2, 1.2), 0.2, 0.6, float32(1.0, 0.3, 0.8)),
)


# Many kinds of surface in one view


def patch(x, z, *, uvs=((1, 0), (0, 1)), offset=(0.0, 0.0), lean=0.0, tilt=0.0, below=False):
    """Return a square in the floor; its normals lean, its texture lies as told."""
    square = plane(0.5, segments=2)
    positions = square.positions + np.tile(float32(x, 0, z), (9, 1))
    positions[:, 1] += tilt * square.positions[:, 0]
    normals = square.normals + lean * square.positions
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    coordinates = square.uvs @ np.array(uvs, np.float32) + np.array(offset, np.float32)
    square = square._replace(positions=positions, normals=normals, uvs=coordinates)
    if below:  # the back is seen: faces and normals point away from the camera
        square = square._replace(faces=square.faces[:, ::-1], normals=-normals)
    return square


@functools.cache
def quilt():
    """Patches turned, mirrored, tiled, seen from behind, and one of another material."""
    patches = [
        patch(-1, -0.5, uvs=((1.7, 0.3), (-0.4, 2.1)), offset=(-0.6, -0.8)),
        patch(0, -0.5, uvs=((-0.8, 0), (0, 0.9)), offset=(0.9, 0.1), lean=0.7),
        patch(1, -0.5, uvs=((0, 0.9), (-0.7, 0)), offset=(0.8, 0.05), tilt=0.4),
        patch(-1, 0.5, uvs=((0.9, 0), (0, 0.9)), lean=0.5, below=True),
        patch(0, 0.5),
        patch(1, 0.5, uvs=((0.4, 0.1), (0.2, 0.5)), offset=(0.2, 0.1), lean=-0.3, tilt=-0.2),
    ]
    roof = plane(0.4, segments=1)
    roof = roof._replace(positions=roof.positions + float32(2.0, 0.9, 0.1))
    mesh = with_tangents(merge(*patches, roof))
    counts = [len(p.faces) for p in patches] + [len(roof.faces)]
    face_materials = np.repeat([1, 1, 1, 1, 0, 1, 0], counts).astype(np.int32)
    view = look_at(np.array([0.0, 3.0, 0.0]), np.zeros(3), np.array([0.0, 0.0, -1.0]))
    camera = OrthographicCamera(np.asarray(view, np.float32), 1.1, 0.5, 5.0)
    rng = np.random.default_rng(0)
    colors = rng.uniform(0.2, 1, (5, 6, 3)).astype(np.float32)
    slopes = rng.normal(scale=1.2, size=(*MAP, 2)).astype(np.float32)
    with jax.enable_x64(False):
        texels = np.asarray(encode_normals(normals_from_slopes(slopes)))
    look = Material(
        (0.9, 0.7, 0.8), Texture(colors, clamp, repeat), Texture(texels, repeat, mirror)
    )
    scene = Scene("quilt", mesh, face_materials, (Material(), look), camera, LIGHTS)
    return scene, slopes


@functools.cache
def seen(margin=0):
    scene, _ = quilt()
    with jax.enable_x64(False):
        return see_map(
            scene, 1, image_size=IMAGE, map_size=MAP, wraps=(repeat, mirror), shadow_margin=margin
        )


@functools.cache
def rendered():
    """What the renderer makes of the quilt, all of the mapped material, before any light."""
    scene, _ = quilt()
    with jax.enable_x64(False):
        surface = jax.tree.map(jnp.asarray, seen().surface)
        look = lambda mesh, surface: surface_appearance(
            mesh, scene.camera, surface, scene.materials[1:]
        )
        return surface, quick(look)(jax.tree.map(jnp.asarray, scene.mesh), surface)


def test_the_quilt_shows_what_it_is_meant_to_show():
    scene, _ = quilt()
    view, shows = seen().view, seen().inside
    turned = np.einsum("xp,xp->p", view.frame[2], view.to_camera) < 0
    assert not turned.any()  # frames are on the side that is seen, also of the patch from behind
    assert set(np.unique(scene.mesh.tangents[:, 3])) == {-1, 1}
    assert 0.5 < shows.mean() < 0.8  # the fifth patch is of another material
    for light in seen().visibility:
        assert 0.2 < light[shows].mean() < 1
    uvs = scene.mesh.uvs[np.unique(scene.mesh.faces[scene.face_materials == 1])]
    assert uvs.min() < -0.3
    assert uvs.max() > 1.3


def test_normals_are_those_of_the_renderer():
    _, appearance = rendered()
    with jax.enable_x64(False):
        found = quick(lambda v, s: jnp.stack(v.normals(v.look_up(s)), -1))(seen().view, quilt()[1])
    expected = np.asarray(appearance.normal)[seen().inside]
    assert np.std(expected, axis=0).min() > 0.1
    np.testing.assert_allclose(found, expected, atol=5e-6)  # measured 2e-6: uvs, rounded otherwise


@pytest.mark.parametrize("model", MODELS, ids=lambda model: type(model).__name__)
def test_colors_are_those_of_the_renderer(model):
    surface, appearance = rendered()
    shows = seen().inside

    @quick
    def ours(view, slopes, model):
        colors = view.colors(view.normals(view.look_up(slopes)), LIGHTS, model)
        return jnp.stack([jnp.stack(channels, -1) for channels in colors])

    @quick
    def theirs(surface, appearance, model):
        everywhere = jnp.ones(IMAGE)
        return jnp.stack(
            [
                shade(surface, (light,), (everywhere,), appearance=appearance, shading=model)
                for light in LIGHTS
            ]
        )

    with jax.enable_x64(False):
        found = np.asarray(ours(seen().view, quilt()[1], model))
        expected = np.asarray(theirs(surface, appearance, model))[:, shows]
    assert found.dtype == np.float32
    assert expected.std(axis=1).min() > 0.01  # of each light and channel
    np.testing.assert_allclose(found, expected, atol=1e-5)  # measured 3e-6


def test_a_texture_with_mips_counts_by_its_largest_image():
    """A fit looks the map up without mips, and colors likewise."""
    scene, _ = quilt()
    look = scene.materials[1]
    mipped = eqx.tree_at(lambda m: m.base_color_texture, look, with_mips(look.base_color_texture))
    scene = scene._replace(materials=(scene.materials[0], mipped))
    with jax.enable_x64(False):
        other = see_map(
            scene, 1, image_size=IMAGE, map_size=MAP, wraps=(repeat, mirror), shadow_margin=0
        )
    np.testing.assert_array_equal(other.view.base_color, seen().view.base_color)


# Shadows


def under_the_roof(light):
    """Return where the roof hides the light, by hand, at each pixel of the map."""
    points = np.asarray(seen().view.position, np.float64).T
    position = getattr(light, "position", None)
    towards = np.asarray(light.direction, float) if position is None else position - points
    towards = np.broadcast_to(towards, points.shape)
    share = (0.9 - points[:, 1]) / towards[:, 1]
    x, _, z = (points + share[:, None] * towards).T
    inside = (np.abs(x - 2.0) < 0.4) & (np.abs(z - 0.1) < 0.4)
    near = (np.abs(np.abs(x - 2.0) - 0.4) < 1e-3) | (np.abs(np.abs(z - 0.1) - 0.4) < 1e-3)
    return inside & (share > 0) & ((position is None) | (share < 1)), near


def turned_away(light):
    """Return where the face that is seen looks away from the light."""
    shows = seen().inside
    points, normals = (
        np.asarray(a, np.float64)[shows]
        for a in (seen().surface.position, seen().surface.face_normal)
    )
    position = getattr(light, "position", None)
    towards = np.asarray(light.direction, float) if position is None else position - points
    return np.sum(normals * towards, axis=-1) <= 0


def test_pixels_that_a_caster_hides_do_not_count():
    dark_somewhere = []
    for light, lit in zip(LIGHTS, seen().view.lit, strict=True):
        hidden, near = under_the_roof(light)
        dark_somewhere.append(hidden.mean())
        # Patches lie side by side and tilt; where one hides another, the roof does not.
        free = ~hidden & ~turned_away(light) & ~near
        assert set(np.unique(lit)) <= {0, 1}
        assert not np.asarray(lit, bool)[hidden & ~near].any()
        assert np.asarray(lit, bool)[free].mean() > 0.9
    assert max(dark_somewhere) > 0.03


@pytest.mark.parametrize("margin", [1, 2])
def test_a_margin_takes_the_edges_of_shadows_away_and_nothing_else(margin):
    covered = seen().surface.face_ids >= 0
    square = np.ones((2 * margin + 1, 2 * margin + 1))
    for seen_light, lit in zip(seen().visibility, seen(margin).view.lit, strict=True):
        near_dark = np.asarray(ndimage.binary_dilation(covered & ~seen_light, square), bool)
        expected = (seen_light & ~near_dark)[seen().inside]
        assert 0 < expected.sum() < seen_light[seen().inside].sum()
        np.testing.assert_array_equal(np.asarray(lit, bool), expected)


def test_every_light_of_the_scene_has_its_row():
    assert seen().view.lit.shape == (3, seen().inside.sum())
    assert seen().visibility.shape == (3, *IMAGE)


# Derivatives


def studio(lights, *, pixels=60, map_size=(5, 6), seed=0, dtype=np.float32, colored=False):
    """Return pixels that look at a bent sheet from above: a view made by hand, no scene.

    Each pixel blends four texels next to each other; frames lean, are not orthogonal and not
    of unit length.
    """
    rng = np.random.default_rng(seed)
    height, width = map_size
    row, column = rng.integers(0, height - 1, pixels), rng.integers(0, width - 1, pixels)
    down, right = rng.uniform(size=(2, pixels))
    indices = np.stack([(row + r) * width + column + c for r in (0, 1) for c in (0, 1)])
    weights = np.stack([a * b for a in (1 - down, down) for b in (1 - right, right)])
    frame = np.eye(3)[[0, 2, 1]][..., None] * np.array([1, -1, 1])[:, None, None]
    frame = frame + 0.2 * rng.normal(size=(3, 3, pixels))
    position = np.stack([(column + right) / width, 0 * down, (row + down) / height]) - 0.5
    to_camera = np.array([0.1, 2.0, 0.3])[:, None] - position
    to_camera /= np.linalg.norm(to_camera, axis=0)
    as_array = lambda a: jnp.asarray(a, dtype)
    return View(
        indices=jnp.asarray(indices, jnp.int32),
        weights=as_array(weights),
        frame=as_array(frame),
        to_camera=as_array(to_camera),
        position=as_array(position),
        lit=jnp.ones((len(lights), pixels), dtype),
        base_color=as_array(rng.uniform(0.3, 1, (3, pixels))) if colored else None,
        map_size=map_size,
    )


@functools.cache
def derivatives():
    """Residuals of a colored view along one direction, and their transpose, in double."""
    model = BlinnPhongShading(
        *(np.array(c) for c in ([0.5, 0.6, 0.4], [0.2, 0.1, 0.3], 9.0, [0.1, 0.05, 0.07]))
    )
    with jax.enable_x64(True):
        rng = np.random.default_rng(1)
        double = lambda tree: jax.tree.map(lambda a: jnp.asarray(a, jnp.float64), tree)
        view = studio(LIGHTS, dtype=np.float64, colored=True)
        targets = jnp.asarray(rng.uniform(size=(3, 3, 60)))
        point = double(Unknowns(jnp.asarray(rng.normal(scale=0.4, size=(5, 6, 2))), model, LIGHTS))
        step = jax.tree.map(lambda a: jnp.asarray(rng.normal(size=np.shape(a))), point)

        @quick
        def both(point, step):
            residuals = lambda u: jnp.concatenate(Task(view, targets).residuals(u))
            value, along = jax.jvp(residuals, (point,), (step,))
            _, back = jax.vjp(residuals, point)
            return value, along, back(along)[0]

        _, along, back = both(point, step)
        h = 1e-6
        moved = [jax.tree.map(lambda p, s, h=h: p + h * s, point, step) for h in (h, -h)]
        up, down = (both(at, step)[0] for at in moved)
        return along, (up - down) / (2 * h), back, step


def test_the_residuals_derivative_is_that_of_finite_differences():
    along, central, _, _ = derivatives()
    assert along.dtype == np.float64
    assert np.abs(along).max() > 0.1
    np.testing.assert_allclose(along, central, rtol=1e-6, atol=1e-8)  # measured 3e-8


def test_the_reverse_derivative_is_the_transpose_of_the_forward_one():
    along, _, back, step = derivatives()
    inner = sum(jnp.vdot(b, s) for b, s in zip(*map(jax.tree.leaves, (back, step)), strict=True))
    assert_close(inner, np.vdot(along, along))
    for leaf in jax.tree.leaves(back):
        assert np.isfinite(leaf).all()
        assert np.any(leaf != 0)


def test_a_pixel_without_a_normal_shows_ambient_light_and_its_derivative_is_finite():
    view = studio(LIGHTS[:1])
    view = eqx.tree_at(lambda v: v.frame, view, view.frame.at[:, :, 7].set(0))
    slopes = jnp.zeros((5, 6, 2), jnp.float32)

    def image(slopes):
        colors = view.colors(view.normals(view.look_up(slopes)), LIGHTS[:1], LambertShading())
        return jnp.stack(colors[0])

    with jax.enable_x64(False):
        colors = quick(image)(slopes)
        gradient = quick(jax.grad(lambda s: jnp.sum(image(s) ** 2)))(slopes)
    assert_close(colors[:, 7], np.zeros(3, np.float32))
    assert (colors[0] > 0).sum() == 59
    assert np.isfinite(gradient).all()


def test_residuals_are_zero_where_a_light_does_not_count():
    rng = np.random.default_rng(0)
    lit = rng.integers(0, 2, (3, 60)).astype(np.float32)
    view = eqx.tree_at(lambda v: v.lit, studio(LIGHTS), jnp.asarray(lit))
    with jax.enable_x64(False):
        task = Task(view, jnp.full((3, 3, 60), 0.123, jnp.float32))
        unknowns = Unknowns(jnp.zeros((5, 6, 2), jnp.float32), PhongShading(), LIGHTS)
        found = quick(lambda task, u: jnp.stack(task.residuals(u)))(task, unknowns)
        full = eqx.tree_at(lambda t: t.view.lit, task, jnp.ones_like(lit))
        unhidden = quick(lambda task, u: jnp.stack(task.residuals(u)))(full, unknowns)
    assert found.shape == (9, 60)
    np.testing.assert_array_equal(found, np.repeat(lit, 3, axis=0) * unhidden)
    assert np.abs(unhidden).min() > 0


# Errors


@pytest.mark.errors
def test_a_mesh_without_uvs_is_refused():
    scene, _ = quilt()
    bare = scene._replace(mesh=scene.mesh._replace(uvs=None))
    with pytest.raises(ValueError, match=r"^quilt: has no uvs, .*unwrap the mesh$"):
        see_map(bare, 1, image_size=IMAGE, map_size=MAP, wraps=(repeat, mirror), shadow_margin=0)


def test_a_material_that_no_pixel_shows_is_refused():
    scene, _ = quilt()
    with jax.enable_x64(False), pytest.raises(ValueError, match="quilt: no pixel shows material 2"):
        see_map(scene, 2, image_size=IMAGE, map_size=MAP, wraps=(repeat, mirror), shadow_margin=0)


def test_a_camera_that_sees_nothing_is_refused():
    scene, _ = quilt()
    view = look_at(np.array([0.0, 3.0, 0.0]), np.array([0.0, 6.0, 0.1]), np.array([0.0, 0.0, 1.0]))
    away = scene._replace(camera=OrthographicCamera(np.asarray(view, np.float32), 1.1, 0.5, 5.0))
    with jax.enable_x64(False), pytest.raises(ValueError, match="quilt: no pixel shows material 1"):
        see_map(away, 1, image_size=IMAGE, map_size=MAP, wraps=(repeat, mirror), shadow_margin=0)
