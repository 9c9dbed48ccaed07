"""Materials of glTF scenes: colors, textures and how they lie on the surface."""

import numpy as np

from experiments.files.gltf import load_gltf
from experiments.scene import Material
from tangentspace.mikktspace import with_tangents
from tangentspace.normal_map import decode_normals
from tangentspace.pixel_frame import perturb_normal
from tangentspace.texture import Texture, clamp, mirror, repeat, sample_bilinear

from .gltf_files import SHEET, Builder
from .test_mtl import texels_of
from .tools import assert_close


def test_textures_colors_and_materials_by_face(tmp_path):
    build = Builder()
    gray, bumps = [[[188] * 3, [0] * 3]], [[[128, 188, 255]]]
    build.add("materials", {})
    build.add(
        "materials",
        {
            "pbrMetallicRoughness": {
                "baseColorFactor": [0.5, 0.25, 1, 1],
                "baseColorTexture": {"index": build.texture(gray)},
            },
            "normalTexture": {"index": build.texture(bumps), "scale": 0.75},
        },
    )
    build.node(
        mesh=build.mesh(build.primitive(material=1), build.primitive(), build.primitive(material=1))
    )
    scene = load_gltf(build.glb(tmp_path / "a.glb"))
    np.testing.assert_array_equal(scene.face_materials, [0, 0, 1, 1, 0, 0, 2, 2])
    textured, plain, _ = scene.materials
    assert (textured.base_color, textured.normal_scale) == ((0.5, 0.25, 1), 0.75)
    # Color is decoded, ((188/255 + 0.055) / 1.055)^2.4; the normal map stays raw.
    color = texels_of(textured.base_color_texture)
    assert_close(color, [[[np.float32(0.50288653)] * 3, [0] * 3]])
    normals = texels_of(textured.normal_texture)
    assert_close(normals, np.array(bumps, np.float32) / np.float32(255))
    assert plain == Material()


def test_samplers_say_how_textures_go_on(tmp_path):
    build = Builder()
    build.document["samplers"] = [{"wrapS": 33071, "wrapT": 33648}, {"wrapT": 10497}]
    wraps = []
    for sampler in (0, 1, None):
        index = build.texture([[[9, 9, 9]]])
        if sampler is not None:
            build.document["textures"][index]["sampler"] = sampler
        build.add("materials", {"pbrMetallicRoughness": {"baseColorTexture": {"index": index}}})
        build.node(mesh=build.mesh(build.primitive(material=sampler or index)))
    for material in load_gltf(build.glb(tmp_path / "a.glb")).materials[:3]:
        texture = material.base_color_texture
        assert isinstance(texture, Texture)
        wraps.append((texture.wrap_u, texture.wrap_v))
    assert wraps == [(clamp, mirror), (repeat, repeat), (repeat, repeat)]


def test_a_texture_that_materials_share_is_read_once(tmp_path):
    build = Builder()
    index = build.texture([[[128, 128, 255], [218, 128, 218]]])
    for scale in (1, 0.5):
        build.add("materials", {"normalTexture": {"index": index, "scale": scale}})
    build.node(mesh=build.mesh(build.primitive(material=0), build.primitive(material=1)))
    one, two, _ = load_gltf(build.glb(tmp_path / "a.glb")).materials
    assert one.normal_texture is two.normal_texture
    assert (one.normal_scale, two.normal_scale) == (None, 0.5)


def test_a_normal_maps_texels_are_checked(tmp_path):
    build = Builder()
    index = build.texture([[[128, 128, 255]] * 3 + [[0, 0, 0]]])
    build.add("materials", {"normalTexture": {"index": index}})
    build.node(mesh=build.mesh(build.primitive(material=0)))
    notes = load_gltf(build.glb(tmp_path / "a.glb")).notes
    assert "texture 0: 1 of 4 texels are zero, as if never written; used as they are" in notes


def test_a_normal_map_lies_on_the_sheet_as_in_the_image(tmp_path):
    """Green is up in the image, and that is where the bitangent points, given or not."""
    build = Builder()
    rows = [[[128, 218, 218]], [[128, 128, 255]]]  # the upper half leans up
    build.add("materials", {"normalTexture": {"index": build.texture(rows)}})
    build.node(mesh=build.mesh(build.primitive(material=0)))
    build.node(extensions=build.light(type="directional"))
    scene = load_gltf(build.glb(tmp_path / "a.glb"))
    texels = texels_of(scene.materials[0].normal_texture)
    for mesh in (scene.mesh, with_tangents(scene.mesh._replace(tangents=None))):
        assert mesh.tangents is not None
        leaning = decode_normals(sample_bilinear(texels, np.asarray(mesh.uvs), wrap_v=clamp))
        normals = np.asarray(perturb_normal(leaning, mesh.tangents, mesh.normals))
        up = np.asarray(mesh.positions)[:, 1] == 1
        # 8 bits: (128, 218, 218) is (0.004, 0.71, 0.71), (128, 128, 255) is 0.3 degrees off.
        np.testing.assert_allclose(normals[up], [[0, 0.5**0.5, 0.5**0.5]] * 2, atol=6e-3)
        np.testing.assert_allclose(normals[~up], [[0, 0, 1]] * 2, atol=6e-3)


def test_the_normal_textures_uv_set_is_used(tmp_path):
    build = Builder()
    other = np.full((4, 2), 0.25, np.float32)
    normal = {"index": build.texture([[[128, 128, 255]]], "PNG"), "texCoord": 1}
    color = {"baseColorTexture": {"index": build.texture([[[9, 9, 9]]], "JPEG")}}
    build.add("materials", {"normalTexture": normal, "pbrMetallicRoughness": color})
    build.node(mesh=build.mesh(build.primitive(SHEET | {"TEXCOORD_1": other}, material=0)))
    scene = load_gltf(build.glb(tmp_path / "a.glb"))
    assert_close(np.asarray(scene.mesh.uvs)[:4], [[0.25, 0.75]] * 4)
    assert scene.materials[0].base_color_texture is None
    assert "color textures on another UV set than their normal texture ignored" in scene.notes


def test_tangents_are_dropped_where_a_normal_map_lacks_them_and_else_filled(tmp_path):
    bare = {name: array for name, array in SHEET.items() if name != "TANGENT"}
    for mapped, expected in ((True, None), (False, [[1, 0, 0, 1]] * 4)):
        build = Builder()
        material = (
            {"normalTexture": {"index": build.texture([[[128, 128, 255]]])}} if mapped else {}
        )
        build.add("materials", material)
        build.node(mesh=build.mesh(build.primitive(), build.primitive(bare, material=0)))
        scene = load_gltf(build.glb(tmp_path / "a.glb"))
        if expected is None:
            assert scene.mesh.tangents is None
            assert "tangents ignored: some parts with a normal texture have none" in scene.notes
        else:
            tangents = np.asarray(scene.mesh.tangents)
            assert_close(tangents[:4], expected)
            assert_close(
                np.sum(tangents[:, :3] * scene.mesh.normals, axis=1), np.zeros(len(tangents))
            )
            assert "4 vertices without a valid tangent: any one used" in scene.notes


def test_what_changes_the_look_but_is_not_read_is_noted(tmp_path):
    build = Builder()
    build.document["extensionsUsed"] = ["KHR_texture_transform", "KHR_materials_clearcoat"]
    build.document["animations"] = [{}]
    build.add("materials", {"alphaMode": "BLEND"})
    build.add("textures", {"extensions": {"KHR_texture_basisu": {"source": 0}}})
    build.add("materials", {"normalTexture": {"index": 0}})
    colored = {"POSITION": SHEET["POSITION"], "COLOR_0": np.ones((4, 4), np.float32)}
    build.node(
        mesh=build.mesh(
            build.primitive(colored, material=0),
            build.primitive(colored, material=1),
            build.primitive(mode=0),
        )
    )
    build.node(mesh=0, scale=[1, 0, 1])
    assert load_gltf(build.glb(tmp_path / "a.glb")).notes[:7] == (
        "glTF extensions ignored: KHR_materials_clearcoat, KHR_texture_transform",
        "animations ignored: the nodes stay where the file puts them",
        "transparency ignored: all faces are opaque",
        "vertex colors ignored",
        "textures in formats of extensions ignored",
        "points and lines left out",
        "parts scaled to nothing left out",
    )
