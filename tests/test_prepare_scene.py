"""What a scene needs before it is rendered: made where materials ask, and nowhere else."""

import dataclasses

import jax
import numpy as np
import pytest

from experiments.rendering.prepare_scene import prepare_scene
from experiments.scene import Material, Scene
from experiments.scenes import load_scene
from shadows import DirectionalLight, PerspectiveCamera, look_at
from tangentspace import shapes
from tangentspace.material import MippedTexture
from tangentspace.mikktspace import with_tangents
from tangentspace.texture import Texture, clamp, mirror

from .tools import assert_close

RANDOM = np.random.default_rng(0)
COLORS = RANDOM.random((4, 8, 3)).astype(np.float32)
UP = np.array([0.0, 1.0, 0.0], np.float32)
SEGMENTS = 4


@pytest.fixture(autouse=True)
def _single_precision():
    with jax.enable_x64(False):
        yield


def unit(vectors):
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def scene_of(mesh, *materials, face_materials=None):
    """A scene whose faces all have the first material unless told."""
    if face_materials is None:
        face_materials = np.zeros(len(mesh.faces), np.int32)
    camera = PerspectiveCamera(np.asarray(look_at(4 * UP, 0 * UP, UP)), 0.8, 1.0, 10.0)
    light = DirectionalLight(UP)
    return Scene("small", mesh, face_materials, materials, camera, (light,), ("a note",))


def sheets():
    """Two level sheets side by side, which meet at x = 1 with vertices of their own."""
    sheet = shapes.plane(1.0, segments=SEGMENTS)
    moved = np.eye(4)
    moved[0, 3] = 2.0
    both = shapes.merge(sheet, shapes.transform_mesh(sheet, moved))
    return both, np.repeat(np.arange(2, dtype=np.int32), len(sheet.faces))


def normal_texture(size=8, *wraps):
    normals = np.ones((size, size, 3))
    normals[..., :2] = RANDOM.uniform(-0.6, 0.6, (size, size, 2))
    return Texture((0.5 * (unit(normals) + 1)).astype(np.float32), *wraps)


def height_texture(heights, *wraps):
    return Texture(np.asarray(heights, np.float32)[..., None], *wraps)


def assert_untouched(prepared, scene):
    """The very same arrays, not only equal ones."""
    one, other = jax.tree.leaves(prepared), jax.tree.leaves(scene)
    assert len(one) == len(other)
    assert all(a is b for a, b in zip(one, other, strict=True))
    assert jax.tree.structure(prepared) == jax.tree.structure(scene)


# Nothing to do


@pytest.mark.parametrize("name", ["default", "spot", "mirror"])
def test_scenes_without_maps_are_returned_as_they_are(name):
    scene = load_scene(name)
    assert_untouched(prepare_scene(scene), scene)


def test_what_has_no_map_needs_no_uvs_and_keeps_its_tangents():
    broken = shapes.plane()._replace(tangents=np.full((4, 4), np.nan, np.float32))
    for mesh in (broken, broken._replace(uvs=None, tangents=None)):
        scene = scene_of(mesh, Material((0.1, 0.2, 0.3), reflectivity=0.5, normal_scale=2.0))
        assert_untouched(prepare_scene(scene), scene)


def test_preparing_twice_is_preparing_once():
    mesh, face_materials = sheets()
    heights = Material(height_texture=height_texture(RANDOM.random((4, 4))))
    mapped = Material(None, Texture(COLORS), normal_texture(), 0.5)
    once = prepare_scene(scene_of(mesh, heights, mapped, face_materials=face_materials))
    twice = prepare_scene(once)
    assert jax.tree.structure(twice) == jax.tree.structure(once)
    for one, other in zip(jax.tree.leaves(twice), jax.tree.leaves(once), strict=True):
        np.testing.assert_array_equal(one, other)


# Tangents


def test_tangents_are_the_standard_tools_where_a_map_needs_them():
    scene = load_scene("bumpy")
    prepared = prepare_scene(scene)
    expected = with_tangents(scene.mesh)
    for one, other in zip(prepared.mesh, expected, strict=True):
        np.testing.assert_array_equal(one, other)
    assert scene.mesh.tangents is None
    np.testing.assert_array_equal(prepared.face_materials, scene.face_materials)
    rest = ("name", "camera", "lights", "notes", "environment")
    assert all(getattr(prepared, name) is getattr(scene, name) for name in rest)


def test_tangents_on_request():
    scene = scene_of(shapes.plane(segments=2), Material())
    assert prepare_scene(scene).mesh.tangents is None
    made = prepare_scene(scene, tangents=True).mesh.tangents
    assert_close(made, np.tile(np.float32([1, 0, 0, 1]), (9, 1)), ulps=2)


def test_split_vertices_keep_faces_and_materials():
    """Mirrored uvs on one side: the shared vertices are split, the faces stay in order."""
    plane = shapes.plane(segments=2)
    uvs = np.abs(np.asarray(plane.uvs) - [0.5, 0]).astype(np.float32)
    face_materials = (np.arange(8) % 2).astype(np.int32)
    scene = scene_of(
        plane._replace(uvs=uvs),
        Material(),
        Material(normal_texture=normal_texture()),
        face_materials=face_materials,
    )
    prepared = prepare_scene(scene)
    mesh = prepared.mesh
    assert len(mesh.positions) == 9 + 3
    np.testing.assert_array_equal(mesh.positions[mesh.faces], plane.positions[plane.faces])
    np.testing.assert_array_equal(prepared.face_materials, face_materials)
    left = mesh.positions[mesh.faces].mean(axis=1)[:, 0] < 0
    expected = np.where(left[:, None], np.float32([-1, 0, 0, -1]), np.float32([1, 0, 0, 1]))
    assert_close(mesh.tangents[mesh.faces[:, 0]], expected, ulps=4)


def test_tangents_of_the_file_stay_and_missing_ones_become_zero():
    given = RANDOM.normal(size=(25, 4)).astype(np.float32)
    given[7:10] = np.nan
    mesh = shapes.plane(segments=SEGMENTS)._replace(tangents=given)
    prepared = prepare_scene(scene_of(mesh, Material(normal_texture=normal_texture())))
    known = np.delete(np.arange(25), [7, 8, 9])
    np.testing.assert_array_equal(prepared.mesh.tangents[known], given[known])
    np.testing.assert_array_equal(prepared.mesh.tangents[7:10], 0)
    np.testing.assert_array_equal(prepared.mesh.faces, mesh.faces)
    assert prepared.mesh.tangents.dtype == np.float32
    assert np.isnan(given[7:10]).all()  # the scene that was given is left alone


# Mips


def test_textures_get_their_smaller_versions():
    texture = Texture(COLORS, clamp, mirror)
    material = Material((0.5, 0.5, 0.5), texture, reflectivity=0.25)
    (prepared,) = prepare_scene(scene_of(shapes.plane(), material)).materials
    mipped = prepared.base_color_texture
    assert isinstance(mipped, MippedTexture)
    assert (mipped.wrap_u, mipped.wrap_v) == (clamp, mirror)
    expected = COLORS
    for level in mipped.mips.levels:
        assert_close(level, expected, ulps=4)
        rows, columns = (max(n // 2, 1) for n in expected.shape[:2])
        expected = expected.reshape(rows, -1, columns, expected.shape[1] // columns, 3)
        expected = expected.mean(axis=(1, 3))
    assert dataclasses.replace(prepared, base_color_texture=texture) == material


@pytest.mark.parametrize("scale", [None, 0.5, -2.0])
def test_normals_are_made_unit_in_their_strength_before_they_are_averaged(scale):
    texture = normal_texture(8, mirror, clamp)
    texels = texture.texels * np.float32(0.9)  # not of unit length
    material = Material(normal_texture=dataclasses.replace(texture, texels=texels))
    material = dataclasses.replace(material, normal_scale=scale)
    (prepared,) = prepare_scene(scene_of(shapes.plane(), material)).materials
    assert prepared.normal_scale is None
    mipped = prepared.normal_texture
    assert isinstance(mipped, MippedTexture)
    assert (mipped.wrap_u, mipped.wrap_v) == (mirror, clamp)
    strength = np.array([scale or 1.0, scale or 1.0, 1.0])
    normals = unit((2 * texels.astype(np.float64) - 1) * strength)
    levels = [2 * np.asarray(level) - 1 for level in mipped.mips.levels]
    assert_close(levels[0], normals, ulps=8)
    assert_close(levels[3][0, 0], normals.mean(axis=(0, 1)), ulps=8)
    assert np.linalg.norm(levels[3]) < 0.99


def test_only_textures_that_are_there_get_mips():
    materials = Material((1.0, 0.0, 0.0)), Material(base_color_texture=Texture(COLORS))
    prepared = prepare_scene(scene_of(shapes.plane(), *materials)).materials
    assert prepared[0] is materials[0]
    assert prepared[1].normal_texture is None
    assert prepare_scene(scene_of(shapes.plane(), *prepared)).materials[1] is prepared[1]


# Heights


def test_height_textures_move_what_they_cover_and_are_consumed():
    """A level of 0.5 times 3; a ramp along u, flat beyond the first and the last texel."""
    mesh, face_materials = sheets()
    one = Material(height_texture=height_texture(np.full((2, 2), 0.5)), height_scale=3.0)
    ramp = Material(height_texture=height_texture([[0, 1]], clamp, clamp))
    scene = scene_of(mesh, one, ramp, face_materials=face_materials)
    prepared = prepare_scene(scene)
    assert all(material.height_texture is None for material in prepared.materials)
    assert scene.materials[0].height_texture is not None
    moved = prepared.mesh
    assert all(isinstance(array, np.ndarray) for array in moved if array is not None)
    assert moved.positions.dtype == moved.normals.dtype == np.float32
    first = np.arange(len(mesh.positions)) < 25
    border = mesh.positions[:, 0] == 1
    expected = np.where(first, 1.5, np.clip(2 * np.asarray(mesh.uvs)[:, 0] - 0.5, 0, 1))
    # Where the sheets meet each goes half of the way: measured 0.75.
    expected[border] = 0.75
    assert_close(moved.positions[:, 1], expected.astype(np.float32), ulps=4)
    assert_close(moved.positions[:, ::2], mesh.positions[:, ::2], ulps=2)
    np.testing.assert_array_equal(moved.faces, mesh.faces)
    np.testing.assert_array_equal(moved.uvs, mesh.uvs)
    assert moved.tangents is None
    level = first & (mesh.positions[:, 0] < 0.4)
    assert_close(moved.normals[level], mesh.normals[level], ulps=4)
    inside = ~first & (np.abs(mesh.positions[:, 0] - 2) < 0.1)  # the ramp's middle, of slope 1
    slanted = np.broadcast_to(np.float32([-np.sqrt(0.5), np.sqrt(0.5), 0]), (inside.sum(), 3))
    assert_close(moved.normals[inside], slanted, ulps=16)


def test_what_has_no_heights_stays_where_it_is():
    mesh, face_materials = sheets()
    raised = Material(height_texture=height_texture(np.ones((2, 2))))
    scene = scene_of(mesh, Material(), raised, face_materials=face_materials)
    moved = prepare_scene(scene).mesh
    still = mesh.positions[:, 0] < 1
    assert_close(moved.positions[still], mesh.positions[still], ulps=0)
    assert_close(moved.positions[mesh.positions[:, 0] > 1][:, 1], np.ones(20, np.float32), ulps=2)


def gaps(mesh, moved):
    """The largest distance between vertices that were at one place."""
    _, place = np.unique(mesh.positions, axis=0, return_inverse=True)
    low, high = (np.full((place.max() + 1, 3), edge) for edge in (np.inf, -np.inf))
    np.minimum.at(low, place, moved.positions)
    np.maximum.at(high, place, moved.positions)
    assert len(low) < len(place)  # some are
    return (high - low).max()


def test_seams_do_not_crack():
    """A sphere's seam and poles; a border with what has no heights."""
    heights = Material(height_texture=height_texture(RANDOM.random((8, 8))), height_scale=0.3)
    sheet, face_materials = sheets()
    scenes = [
        scene_of(shapes.uv_sphere(rings=6, segments=8), heights),
        scene_of(sheet, heights, Material(), face_materials=face_materials),
    ]
    for scene in scenes:
        moved = prepare_scene(scene).mesh
        assert gaps(scene.mesh, moved) == 0
        assert np.abs(moved.positions - scene.mesh.positions).max() > 0.1


def test_tangents_lie_on_the_displaced_surface():
    """Made after displacement; the file's follow it."""
    heights = height_texture(RANDOM.random((4, 4)))
    look = Material(normal_texture=normal_texture(), height_texture=heights, height_scale=0.5)
    mesh, _ = sheets()
    given = mesh._replace(tangents=np.tile(np.float32([1, 0, 0, -1]), (50, 1)))
    made, followed = (prepare_scene(scene_of(m, look)).mesh for m in (mesh, given))
    flat = prepare_scene(scene_of(mesh, dataclasses.replace(look, normal_texture=None))).mesh
    np.testing.assert_array_equal(made.tangents, with_tangents(flat).tangents)
    assert (followed.tangents[:, 3] == -1).all()
    for moved in (made, followed):
        across = np.sum(moved.tangents[:, :3] * moved.normals, axis=1)
        assert np.abs(across).max() < 1e-6
        assert (moved.tangents[:, 0] > 0.5).all()
        assert np.abs(moved.tangents[:, 1]).max() > 0.2


def test_heights_of_a_material_on_no_face_move_nothing():
    mesh, _ = sheets()
    unused = Material(height_texture=height_texture(np.ones((2, 2))))
    prepared = prepare_scene(scene_of(mesh, Material(), unused))
    assert_close(prepared.mesh.positions, mesh.positions, ulps=0)
    assert prepared.materials[1].height_texture is None


# Errors


@pytest.mark.errors
@pytest.mark.parametrize(
    ("material", "options", "kind"),
    [
        (Material(normal_texture=normal_texture()), {}, "normal"),
        (Material(height_texture=height_texture(np.ones((2, 2)))), {}, "height"),
        (Material(), {"tangents": True}, "normal"),
    ],
)
def test_maps_need_uvs(material, options, kind):
    scene = scene_of(shapes.plane()._replace(uvs=None), material)
    expected = f"small: has no uvs, which a {kind} map needs; unwrap the mesh"
    with pytest.raises(ValueError, match=f"^{expected}$"):
        prepare_scene(scene, **options)
