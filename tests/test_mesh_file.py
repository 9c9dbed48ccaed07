"""Scenes from OBJ, PLY and STL: nothing merged, flaws said, framing, and clear errors."""

import struct
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image

from experiments.files.mesh_file import load_scene_file
from experiments.files.smooth_normals import smooth_normals
from tangentspace.shapes import icosphere, torus
from tangentspace.vertex_normals import vertex_normals

from .test_mtl import texels_of
from .tools import assert_close

FLOOR_VERTICES, FLOOR_FACES = 4, 2
TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"
CUBE_CORNERS = np.indices((2, 2, 2)).reshape(3, 8).T
CUBE_NORMALS = (2 * CUBE_CORNERS - 1) / np.sqrt(3)


class NumpyMesh(NamedTuple):
    positions: np.ndarray
    normals: np.ndarray
    faces: np.ndarray
    uvs: np.ndarray


def load(tmp_path, content, name="thing.obj"):
    path = tmp_path / name
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return load_scene_file(path)


def cube(size):
    """A cube whose sides are quads."""
    lines = [f"v {x * size} {y * size} {z * size}" for x, y, z in CUBE_CORNERS]
    sides = ("1 2 4 3", "5 7 8 6", "1 5 6 2", "3 4 8 7", "1 3 7 5", "2 6 8 4")
    return "\n".join([*lines, *(f"f {side}" for side in sides)])


def obj_of(mesh, uvs=True):
    slash = "/" if uvs else ""
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in mesh.positions.tolist()]
    lines += [f"vt {u!r} {v!r}" for u, v in mesh.uvs.tolist()] if uvs else []
    for face in mesh.faces + 1:
        lines.append("f " + " ".join(f"{i}{slash}{i if uvs else ''}" for i in face))
    return "\n".join(lines)


def ply_of(mesh, encoding):
    header = (
        f"ply\nformat {encoding} 1.0\ncomment made by a test\n"
        f"element vertex {len(mesh.positions)}\n"
        "property float x\nproperty float y\nproperty double z\n"
        f"element face {len(mesh.faces)}\n"
        "property uchar red\nproperty list uchar int vertex_indices\nend_header\n"
    ).encode()
    if encoding == "ascii":
        lines = [f"{x!r} {y!r} {z!r}" for x, y, z in mesh.positions.tolist()]
        lines += [f"255 3 {a} {b} {c}" for a, b, c in mesh.faces.tolist()]
        return header + "\n".join(lines).encode()
    order = "<" if "little" in encoding else ">"
    body = b"".join(struct.pack(order + "ffd", *row) for row in mesh.positions.tolist())
    body += b"".join(struct.pack(order + "BBiii", 255, 3, *face) for face in mesh.faces.tolist())
    return header + body


def stl_of(mesh, encoding):
    corners = mesh.positions[mesh.faces]
    if encoding == "ascii":
        facets = "".join(
            "facet normal 0 0 0\nouter loop\n"
            + "".join(f"vertex {x!r} {y!r} {z!r}\n" for x, y, z in triangle)
            + "endloop\nendfacet\n"
            for triangle in corners.tolist()
        )
        return f"solid thing\n{facets}endsolid thing\n".encode()
    record = np.zeros(
        len(corners), [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("extra", "<u2")]
    )
    record["corners"] = corners
    return b"\0" * 80 + struct.pack("<I", len(corners)) + record.tobytes()


def without_floor(scene):
    """The file's own vertices and faces, as NumPy arrays; no UVs become no rows."""
    mesh = scene.mesh
    return NumpyMesh(
        np.asarray(mesh.positions)[:-FLOOR_VERTICES],
        np.asarray(mesh.normals)[:-FLOOR_VERTICES],
        np.asarray(mesh.faces)[:-FLOOR_FACES],
        np.zeros((0, 2)) if mesh.uvs is None else np.asarray(mesh.uvs)[:-FLOOR_VERTICES],
    )


# Known answers


WRITERS = {
    "thing.obj": lambda mesh: obj_of(mesh, uvs=False).encode(),
    "ascii.ply": lambda mesh: ply_of(mesh, "ascii"),
    "little.ply": lambda mesh: ply_of(mesh, "binary_little_endian"),
    "big.ply": lambda mesh: ply_of(mesh, "binary_big_endian"),
    "ascii.stl": lambda mesh: stl_of(mesh, "ascii"),
    "BINARY.STL": lambda mesh: stl_of(mesh, "binary"),
}


@pytest.mark.parametrize("name", WRITERS)
def test_every_format_keeps_corners_in_order_and_gives_a_sphere_its_normals(tmp_path, name):
    sphere = icosphere(subdivisions=2)
    scene = load(tmp_path, WRITERS[name](sphere), name)
    mesh = without_floor(scene)
    assert scene.name == name.rpartition(".")[0]
    np.testing.assert_array_equal(
        mesh.positions[mesh.faces], sphere.positions[sphere.faces], strict=True
    )
    expected = np.asarray(vertex_normals(sphere.positions, sphere.faces))
    assert_close(mesh.normals[mesh.faces], expected[sphere.faces])
    assert [a.dtype for a in mesh[:3]] == [np.float32, np.float32, np.int32]
    assert scene.face_materials.dtype == np.int32
    assert len(scene.face_materials) == len(scene.mesh.faces)
    shared = len(sphere.positions) if "stl" not in name.lower() else 3 * len(sphere.faces)
    assert len(mesh.positions) == shared
    assert scene.notes == ("no normals in the file: smooth ones computed",)


def test_uv_seams_survive_and_make_no_crease(tmp_path):
    ring = torus()
    mesh = without_floor(load(tmp_path, obj_of(ring)))
    np.testing.assert_array_equal(mesh.positions, ring.positions)
    np.testing.assert_array_equal(mesh.uvs, ring.uvs)
    np.testing.assert_array_equal(mesh.faces, ring.faces)
    _, point = np.unique(mesh.positions, axis=0, return_inverse=True)
    assert len(np.unique(point)) < len(point)
    order = np.argsort(point)
    same = np.diff(point[order]) == 0
    np.testing.assert_array_equal(mesh.normals[order][1:][same], mesh.normals[order][:-1][same])


def test_one_position_with_two_uvs_becomes_two_vertices(tmp_path):
    text = TRIANGLE + "v 1 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nvt .5 .5\n"
    mesh = without_floor(load(tmp_path, text + "f 1/1 2/2 3/3\nf 2/4 4/1 3/3\n"))
    assert_close(mesh.positions, [[0, 0, 0], [1, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]])
    assert_close(mesh.uvs, [[0, 0], [1, 0], [0.5, 0.5], [0, 1], [0, 0]])
    np.testing.assert_array_equal(mesh.faces, [[0, 1, 3], [2, 4, 3]])


@pytest.mark.parametrize("size", [1e-6, 1.0, 1e6])
def test_corners_of_a_cube_weigh_their_sides_by_angle(tmp_path, size):
    scene = load(tmp_path, cube(size))
    assert_close(without_floor(scene).normals, CUBE_NORMALS)
    assert "6 faces with more than three corners split as a fan" in scene.notes


def test_smooth_normals_are_those_of_the_welded_mesh():
    ring = torus()
    points, weld = np.unique(ring.positions, axis=0, return_inverse=True)
    rng = np.random.default_rng(0)
    points = (points + rng.normal(0, 0.02, points.shape)).astype(np.float32)
    expected = vertex_normals(jnp.asarray(points, jnp.float64), weld[ring.faces])
    assert_close(smooth_normals(points[weld], np.asarray(ring.faces)), np.asarray(expected)[weld])


def test_both_sides_of_a_sheet_keep_their_normals(tmp_path):
    text = TRIANGLE + TRIANGLE + "f 1 2 3\nf 4 6 5\n"
    scene = load(tmp_path, text)
    assert_close(without_floor(scene).normals[:, 2], [1, 1, 1, -1, -1, -1])
    assert "1 face with the same three points as another kept" in scene.notes


def test_normals_of_the_file_are_scaled_to_unit_length_and_replaced_where_invalid(tmp_path):
    text = TRIANGLE + "vn 0 3 4\nvn 0 0 0\nvn nan 0 1\nf 1//1 2//2 3//3\n"
    scene = load(tmp_path, text)
    assert_close(without_floor(scene).normals, [[0, 0.6, 0.8], [0, 0, 1], [0, 0, 1]])
    assert scene.notes == ("2 vertices without a valid normal: smooth one used",)


def test_relative_indices_count_from_their_own_line(tmp_path):
    first, second = TRIANGLE + "f -3 -2 -1\n", "o b\nv 5 0 0\nv 6 0 0\nv 5 1 0\nf -3 -2 -1\n"
    mesh = without_floor(load(tmp_path, first + second))
    assert_close(mesh.positions[mesh.faces][:, 0], [[0, 0, 0], [5, 0, 0]])


def test_odd_faces_are_kept_or_left_out_and_counted(tmp_path):
    faces = "f 1 2 3\nf 2 3 1\nf 1 2 2\nf 1 2 4\nf 1 2\n"
    scene = load(tmp_path, TRIANGLE + "v 2 0 0\nv 9 9 9\n" + faces)
    assert scene.notes == (
        "1 face with fewer than three corners left out",
        "1 vertex without a face left out",
        "2 zero-area faces kept; they cover no pixel",
        "1 face with the same three points as another kept",
        "no normals in the file: smooth ones computed",
        "1 vertex where no normal exists: zero used",
    )
    mesh = without_floor(scene)
    assert (len(mesh.positions), len(mesh.faces)) == (4, 4)
    assert_close(mesh.normals, [[0, 0, 1], [0, 0, 1], [0, 0, 1], [0, 0, 0]])


def test_corners_without_uv_get_zero_and_are_counted(tmp_path):
    scene = load(tmp_path, TRIANGLE + "vt .5 .25\nvt nan 1\nf 1/1 2 3/2\n")
    assert_close(without_floor(scene).uvs, [[0.5, 0.25], [0, 0], [0, 1]])
    assert "2 vertices without a valid UV: zero used" in scene.notes


def test_obj_materials_color_their_faces(tmp_path):
    Image.new("RGB", (2, 1), (255, 188, 0)).save(tmp_path / "skin one.png")
    (tmp_path / "all.mtl").write_text(
        "newmtl unused\nKd 1 1 1\nnewmtl red\nKd 1 0 0\nnewmtl skin\nmap_Kd skin one.png\n"
    )
    faces = "usemtl skin\nf 1/1 2/1 3/1\nusemtl red\nf 1 3 2\nf 2 1 3\n"
    scene = load(tmp_path, "mtllib all.mtl\nvt 0 0\n" + TRIANGLE + faces)
    np.testing.assert_array_equal(scene.face_materials, [0, 1, 1, 2, 2])
    assert scene.materials[1].base_color == (1, 0, 0)
    # sRGB 188 is the level nearest to half the light: ((188/255 + 0.055) / 1.055)^2.4.
    assert_close(texels_of(scene.materials[0].base_color_texture)[0, 0], [1, 0.50288653, 0])


def test_missing_obj_material_or_texture_is_noted(tmp_path):
    (tmp_path / "b.mtl").write_text("newmtl x\nmap_Kd -s 1 1 1 none.png\n")
    scene = load(tmp_path, "mtllib a.mtl\nmtllib b.mtl\n" + TRIANGLE + "usemtl x\nf 1 2 3\n")
    assert scene.notes[:2] == (
        "material file a.mtl not found: plain gray used",
        "texture none.png not found: its material's color is used alone",
    )


PLY_HEAD = (
    "ply\nformat {}\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
)
PLY_SQUARE = "0 0 0{0}\n1 0 0{1}\n1 1 0{2}\n0 1 0{3}\n"


def test_binary_ply_may_mix_triangles_and_quads(tmp_path):
    head = PLY_HEAD.format("binary_little_endian 1.0") + (
        "element face 2\nproperty list uchar uint vertex_index\nend_header\n"
    )
    square = struct.pack("<12f", 0, 0, 0, 1, 0, 0, 1, 1, 0, 0, 1, 0)
    faces = struct.pack("<B3I", 3, 0, 1, 2) + struct.pack("<B4I", 4, 0, 1, 2, 3)
    mesh = without_floor(load(tmp_path, head.encode() + square + faces, "mixed.ply"))
    np.testing.assert_array_equal(mesh.faces, [[0, 1, 2], [0, 1, 2], [0, 2, 3]])


def test_ply_keeps_normals_and_uvs_of_vertices(tmp_path):
    rows = PLY_SQUARE.format(" 1 0 0 0 1", " 0 1 0 1 1", " 0 0 1 1 0", " 0 0 2 0 0")
    extra = "".join(f"property float {name}\n" for name in ("nx", "ny", "nz", "s", "t"))
    head = PLY_HEAD.format("ascii 1.0") + extra
    tail = "element face 2\nproperty list uchar int vertex_indices\nend_header\n"
    mesh = without_floor(load(tmp_path, head + tail + rows + "3 0 1 2\n3 0 2 3\n", "a.ply"))
    assert_close(mesh.normals, [[1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0, 1]])
    assert_close(mesh.uvs, [[0, 1], [1, 1], [1, 0], [0, 0]])


def test_ply_uvs_of_corners_split_vertices(tmp_path):
    head = PLY_HEAD.format("ascii 1.0") + (
        "element face 2\nproperty list uchar int vertex_indices\n"
        "property list uchar float texcoord\nend_header\n"
    )
    faces = "3 0 1 2 6 0 0 1 0 1 1\n3 0 2 3 6 0 0 .5 .5 0 1\n"
    scene = load(tmp_path, head + PLY_SQUARE.format("", "", "", "") + faces, "wedge.ply")
    mesh = without_floor(scene)
    assert len(mesh.positions) == 5
    assert_close(mesh.uvs[mesh.faces], [[[0, 0], [1, 0], [1, 1]], [[0, 0], [0.5, 0.5], [0, 1]]])


def test_stl_solids_become_one_mesh_whatever_their_names(tmp_path):
    solid = stl_of(icosphere(subdivisions=0), "ascii").replace(b"thing", b"Stra\xdfe")
    assert len(without_floor(load(tmp_path, solid + solid, "two.stl")).faces) == 40


# Errors


def broken_ply(encoding):
    return ply_of(icosphere(), encoding)[:-40]


BAD = {
    "no faces": ("a.obj", TRIANGLE, "has no faces"),
    "empty": ("a.obj", "", "has no faces"),
    "no faces, ply": (
        "a.ply",
        PLY_HEAD.format("ascii 1.0") + "end_header\n" + PLY_SQUARE.format("", "", "", ""),
        "has no faces",
    ),
    "nan": ("a.obj", "v nan 0 0\nv 1 inf 0\nv 0 1 0\nf 1 2 3\n", "2 of 3 vertices are NaN, inf"),
    "too large": ("a.obj", "v 1e39 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "1 of 3 vertices"),
    "nan, no face": ("a.obj", TRIANGLE + "v nan 0 0\nf 1 2 3\n", "1 of 4 vertices"),
    "range": ("a.obj", TRIANGLE + "f 1 2 4\n", "1 face indices out of range, .* 3 positions"),
    "index 0": ("a.obj", TRIANGLE + "f 0 1 2\n", "1 face indices out of range"),
    "relative": ("a.obj", TRIANGLE + "f -4 -2 -1\n", "1 face indices out of range"),
    "uv range": ("a.obj", TRIANGLE + "vt 0 0\nf 1/1 2/2 3/-2\n", "2 face .* 1 UVs"),
    "one point": ("a.obj", "v 1 2 3\nv 1 2 3\nf 1 2 1\n", "lie at one point"),
    "not a number": ("a.obj", "v 0 0 x\n" + TRIANGLE + "f 1 2 3\n", "as OBJ.*could not convert"),
    "two numbers": ("a.obj", "v 0 0\n" + TRIANGLE + "f 1 2 3\n", "expected 3 numbers, got '0 0'"),
    "garbage ply": ("a.ply", b"\x80\x81" * 50, "as PLY.*first line is not `ply`"),
    "ply, short header": ("a.ply", "ply\nformat ascii 1.0\nelement vertex", "as PLY.*too early"),
    "ply, cut": ("a.ply", broken_ply("binary_little_endian"), "as PLY.*too early"),
    "ply, cut ascii": ("a.ply", broken_ply("ascii"), "as PLY.*ends too early"),
    "stl, cut": ("a.stl", stl_of(icosphere(), "binary")[:-7], r"cut short \(16077 bytes, .*16084"),
    "stl, cut ascii": ("a.stl", stl_of(icosphere(), "ascii")[:-70], "cut short .no `endsolid`"),
    "garbage stl": ("a.stl", bytes(range(256)), "no STL file, or is cut short"),
    "empty stl": ("a.stl", b"", "no STL file, or is cut short"),
    "point stl": ("a.stl", "solid a\nendsolid a\n", "has no faces"),
    "suffix": (
        "a.xyz",
        "",
        r"unknown kind of file '.xyz'; supported: .obj, .ply, .stl, .gltf, .glb",
    ),
    "no suffix": ("thing", "", "unknown kind of file ''"),
}


@pytest.mark.errors
@pytest.mark.parametrize("case", BAD)
def test_bad_file_is_one_line_that_names_it(tmp_path, case):
    name, content, match = BAD[case]
    with pytest.raises(ValueError, match=match) as caught:
        load(tmp_path, content, name)
    assert str(caught.value).startswith(f"{tmp_path / name}: ")
    assert "\n" not in str(caught.value)


@pytest.mark.errors
def test_missing_file_and_directory(tmp_path):
    with pytest.raises(ValueError, match=r"none\.obj: no such file"):
        load_scene_file(tmp_path / "none.obj")
    (tmp_path / "folder.obj").mkdir()
    with pytest.raises(ValueError, match=r"folder\.obj: is a directory"):
        load_scene_file(str(tmp_path / "folder.obj"))
