"""Scenes from glTF: transforms, tangents, textures, and clear errors."""

import base64
import struct

import numpy as np
import pytest
import trimesh

from experiments.files.gltf import load_gltf
from experiments.files.mesh_file import load_scene_file
from tangentspace.shapes import icosphere, torus

from .gltf_files import SHEET, SHEET_FACES, Builder, indices, quaternion, sheet_scene
from .tools import assert_close

# Known answers


def test_vertices_and_faces_keep_their_order_and_v_points_up(tmp_path):
    scene = sheet_scene(tmp_path)
    mesh = scene.mesh
    assert (scene.name, len(scene.lights)) == ("sheet", 1)
    np.testing.assert_array_equal(mesh.positions, SHEET["POSITION"])
    np.testing.assert_array_equal(mesh.normals, SHEET["NORMAL"])
    np.testing.assert_array_equal(mesh.faces, SHEET_FACES.reshape(2, 3))
    assert_close(np.asarray(mesh.uvs), mesh.positions[:, :2])
    arrays = [mesh.positions, mesh.normals, mesh.uvs, mesh.tangents]
    assert {np.asarray(array).dtype for array in arrays} == {np.dtype(np.float32)}
    assert mesh.faces.dtype == scene.face_materials.dtype == np.int32


def test_gltf_bitangent_is_the_projects_bitangent_up_the_image(tmp_path):
    """With v up, dp/dv is +y here; glTF's w = 1 gives w * cross(normal, tangent) = +y too."""
    tangents = np.asarray(sheet_scene(tmp_path).mesh.tangents)
    assert_close(tangents, SHEET["TANGENT"])
    assert_close(tangents[:, 3:] * np.cross(SHEET["NORMAL"], tangents[:, :3]), [[0, 1, 0]] * 4)


def test_nested_transforms_compose_from_the_root(tmp_path):
    build = Builder()
    leaf = build.node(mesh=build.mesh(build.primitive()), scale=[2, 3, 4])
    turned = build.node(children=[leaf], rotation=quaternion([0, 1, 0], 90))
    # Column-major: a translation by (10, 20, 30).
    build.node(children=[turned], matrix=[1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 10, 20, 30, 1])
    mesh = load_gltf(build.glb(tmp_path / "a.glb")).mesh
    expected = [[10, 20, 30], [10, 20, 28], [10, 23, 28], [10, 23, 30]]
    assert_close(np.asarray(mesh.positions)[:4], expected)
    assert_close(np.asarray(mesh.normals)[:4], [[1, 0, 0]] * 4)
    assert_close(np.asarray(mesh.tangents)[:4], [[0, 0, -1, 1]] * 4)


@pytest.mark.parametrize("rotation", [([1, 2, 3], 70.0), ([0, 0, -1], 200.0)])
def test_positions_agree_with_trimesh(tmp_path, rotation):
    ring = torus()
    build = Builder()
    shape = build.mesh(build.primitive({"POSITION": ring.positions}, indices(ring)))
    placed = {"rotation": quaternion(*rotation), "scale": [1, -2, 0.5], "translation": [3, 1, 2]}
    leaf = build.node(mesh=shape, **placed)
    root = build.node(children=[leaf], **placed)
    build.document |= {"scenes": [{"nodes": [root]}], "scene": 0}
    path = build.glb(tmp_path / "ring.glb")
    expected = trimesh.load_scene(path, process=False).to_mesh()
    mesh = load_gltf(path).mesh
    assert_close(np.asarray(mesh.positions)[:-4], expected.vertices.astype(np.float32))


def volume(mesh, faces):
    a, b, c = np.moveaxis(
        np.asarray(mesh.positions, np.float64)[np.asarray(mesh.faces)[:faces]], 1, 0
    )
    return np.sum(np.cross(a, b) * c) / 6


@pytest.mark.parametrize("scale", [[1, 1, -1], [-2, 3, 1], [-1, -1, -1], [2, 2, 2]])
@pytest.mark.parametrize("given", [True, False])
def test_mirrored_nodes_are_not_inside_out(tmp_path, scale, given):
    """Faces stay counter-clockwise and normals outward, given or computed."""
    ball = icosphere()
    build = Builder()
    attributes = {"POSITION": ball.positions} | ({"NORMAL": ball.normals} if given else {})
    build.node(mesh=build.mesh(build.primitive(attributes, indices(ball))), scale=scale)
    mesh = load_gltf(build.glb(tmp_path / "ball.glb")).mesh
    unscaled = volume(ball, None)
    assert np.isclose(volume(mesh, -2), unscaled * abs(np.prod(scale)), rtol=1e-7)  # 7e-9
    outward = np.asarray(ball.normals, np.float64) / scale
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    # Given normals transform exactly; computed ones are those of the facets (measured 0.9985).
    cosine = np.sum(np.asarray(mesh.normals)[:-4] * outward, axis=1)
    assert cosine.min() > (1 - 1e-6 if given else 0.998)


def test_mirroring_keeps_the_bitangent_on_the_surface(tmp_path):
    """A node that mirrors x moves dp/du to -x and leaves dp/dv at +y."""
    mesh = sheet_scene(tmp_path, scale=[-1, 1, 1]).mesh
    tangents, normals = np.asarray(mesh.tangents), np.asarray(mesh.normals)
    assert_close(tangents, [[-1, 0, 0, -1]] * 4)
    assert_close(normals, [[0, 0, 1]] * 4)
    assert_close(tangents[:, 3:] * np.cross(normals, tangents[:, :3]), [[0, 1, 0]] * 4)


def test_missing_normals_are_smooth_over_seams(tmp_path):
    ring = torus()
    build = Builder()
    attributes = {"POSITION": ring.positions, "TEXCOORD_0": ring.uvs}
    build.node(mesh=build.mesh(build.primitive(attributes, indices(ring))))
    scene = load_gltf(build.glb(tmp_path / "ring.glb"))
    normals = np.asarray(scene.mesh.normals)[:-4]
    assert "no normals in the file: smooth ones computed" in scene.notes
    # Facets against the true torus; measured 0.99993.
    assert np.sum(normals * ring.normals, axis=1).min() > 0.9999


@pytest.mark.parametrize("mode", [5, 6])
def test_strips_and_fans(tmp_path, mode):
    order = {5: [0, 1, 3, 2], 6: [0, 1, 2, 3]}[mode]
    build = Builder()
    build.node(mesh=build.mesh(build.primitive(faces=np.array(order, np.uint16), mode=mode)))
    mesh = load_gltf(build.glb(tmp_path / "a.glb")).mesh
    corners = np.asarray(mesh.positions)[np.asarray(mesh.faces)[:2]]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert_close(normals, [[0, 0, 1]] * 2)


def test_accessors_strided_sparse_normalized_and_without_indices(tmp_path):
    build = Builder()
    triangle = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32)
    mixed = np.zeros(3, [("position", "<f4", 3), ("uv", "<u2", 2)])
    mixed["position"], mixed["uv"] = triangle, [[0, 0], [65535, 0], [0, 13107]]
    view = build.view(mixed.tobytes(), byteStride=16)
    position = {"bufferView": view, "componentType": 5126, "count": 3, "type": "VEC3"}
    position["sparse"] = {
        "count": 1,
        "indices": {
            "bufferView": build.view(np.array([2], np.uint16).tobytes()),
            "componentType": 5123,
        },
        "values": {"bufferView": build.view(np.array([0, 7, 0], np.float32).tobytes())},
    }
    uv = {"bufferView": view, "byteOffset": 12, "componentType": 5123, "normalized": True}
    uv |= {"count": 3, "type": "VEC2"}
    normal = build.accessor(np.array([[0, 0, 127]] * 3, np.int8), normalized=True)
    attributes = {
        "POSITION": build.add("accessors", position),
        "TEXCOORD_0": build.add("accessors", uv),
        "NORMAL": normal,
    }
    build.node(mesh=build.mesh({"attributes": attributes}))
    mesh = load_gltf(build.glb(tmp_path / "a.glb")).mesh
    assert_close(np.asarray(mesh.positions)[:3], [[0, 0, 0], [1, 0, 0], [0, 7, 0]])
    assert_close(np.asarray(mesh.uvs)[:3], [[0, 1], [1, 1], [0, np.float32(0.8)]])
    assert_close(np.asarray(mesh.normals)[:3], [[0, 0, 1]] * 3)


def test_a_gltf_reads_its_buffer_from_beside_or_within(tmp_path):
    build = Builder()
    build.node(mesh=build.mesh(build.primitive()))
    (tmp_path / "my data.bin").write_bytes(build.data)
    beside = load_scene_file(build.gltf(tmp_path / "beside.gltf", "my%20data.bin")).mesh
    inline = "data:application/octet-stream;base64," + base64.b64encode(build.data).decode()
    within = load_scene_file(build.gltf(tmp_path / "within.GLTF", inline)).mesh
    for one, other in zip(beside, within, strict=True):
        np.testing.assert_array_equal(one, other)


# Errors


def valid(path):
    build = Builder()
    build.node(mesh=build.mesh(build.primitive()))
    return build.glb(path).read_bytes()


def with_document(**changes):
    """The valid file with parts of its document replaced."""

    def make(path):
        build = Builder()
        build.node(mesh=build.mesh(build.primitive()))
        build.document |= changes
        return build.glb(path)

    return make


def with_attributes(**attributes):
    def make(path):
        build = Builder()
        build.node(mesh=build.mesh(build.primitive(SHEET | attributes)))
        return build.glb(path)

    return make


def with_faces(faces):
    def make(path):
        build = Builder()
        build.node(mesh=build.mesh(build.primitive(faces=np.array(faces, np.uint16))))
        return build.glb(path)

    return make


def with_texture(image):
    def make(path):
        build = Builder()
        build.add("images", image)
        build.add("textures", {"source": 0})
        build.add("materials", {"normalTexture": {"index": 0}})
        build.node(mesh=build.mesh(build.primitive(material=0)))
        return build.glb(path)

    return make


BROKEN = SHEET["POSITION"] + np.array(
    [[np.nan, 0, 0], [0, np.inf, 0], [0] * 3, [0] * 3], np.float32
)
CASES = {
    "garbage": (lambda p: p.write_bytes(b"\x01\x02" * 40), "does not begin with 'glTF'"),
    "empty": (lambda p: p.write_bytes(b""), "does not begin"),
    "cut": (lambda p: p.write_bytes(valid(p)[:-50]), "cut short"),
    "not JSON": (
        lambda p: p.write_bytes(struct.pack("<4sIII4s", b"glTF", 2, 24, 4, b"JSON") + b"{a:}"),
        "cannot be read as glTF",
    ),
    "draco": (
        with_document(extensionsRequired=["KHR_lights_punctual", "KHR_draco_mesh_compression"]),
        "requires the glTF extension KHR_draco_mesh_compression",
    ),
    "version": (with_document(asset={"version": "1.0"}), "version 1.0, expected 2.0"),
    "buffer": (with_document(buffers=[{"byteLength": 10**6}]), "of 1000000 bytes.*cut short"),
    "missing bin": (
        with_document(buffers=[{"byteLength": 9, "uri": "gone.bin"}]),
        "its buffer gone.bin is missing",
    ),
    "missing texture": (
        with_texture({"uri": "no%20skin.png"}),
        "its texture no%20skin.png is",
    ),
    "bad texture": (with_texture({"uri": "data:image/png;base64,AAAA"}), "texture 0: is no image"),
    "nothing": (with_document(nodes=[{}]), "has no faces"),
    "cycle": (with_document(nodes=[{"children": [1]}, {"children": [1], "mesh": 0}]), "no tree"),
    "range": (with_faces([0, 1, 4]), "1 face indices out of range, .* 4 vertices"),
    "no triangle": (with_faces([0, 1]), "has no faces"),
    "nan": (with_attributes(POSITION=BROKEN), "2 of 4 vertices are NaN"),
    "one point": (with_attributes(POSITION=0 * SHEET["POSITION"]), "lie at one point"),
    "missing accessor": (with_document(accessors=[]), "cannot be read as glTF"),
}


@pytest.mark.errors
@pytest.mark.parametrize("case", CASES)
def test_bad_file_is_one_line_that_names_it(tmp_path, case):
    make, match = CASES[case]
    path = tmp_path / "bad.glb"
    make(path)
    with pytest.raises(ValueError, match=match) as caught:
        load_scene_file(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)
