"""OBJ materials: colors, maps with their options, and what is missing, passed over or broken."""

import numpy as np
import pytest
from PIL import Image

from experiments.files.images import write_exr
from experiments.files.mesh_file import load_scene_file
from experiments.files.mtl import load_materials, read_mtl
from experiments.scene import Material
from tangentspace.texture import Texture, clamp, repeat

from .tools import assert_close

# A sheet whose quad and triangle have UVs, each with a material of its own.
OBJ = """mtllib all.mtl
v 0 0 0
v 1 0 0
v 1 1 0
v 0 1 0
v 2 0 0
vt 0 0
vt 1 0
vt 1 1
vt 0 1
vt 2 0
usemtl a
f 1/1 2/2 3/3 4/4
usemtl b
f 2/2 5/5 3/3
"""
NORMAL = [[[128, 128, 255], [218, 128, 218]]]
HEIGHTS = [[0, 51, 255, 102]]


@pytest.fixture
def folder(tmp_path):
    """A folder with a map of each kind; ``my colors.png`` has a space in its name."""
    for name, texels in (
        ("my colors.png", [[[255, 188, 0]]]),
        ("normal.png", NORMAL),
        ("heights.png", HEIGHTS),
    ):
        Image.fromarray(np.array(texels, np.uint8)).save(tmp_path / name)
    (tmp_path / "maps").mkdir()
    (tmp_path / "normal.png").rename(tmp_path / "maps" / "normal.png")
    return tmp_path


def texels_of(texture):
    assert isinstance(texture, Texture)
    return texture.texels


def material(folder, text):
    """Return the material that the statements make, and the notes."""
    (folder / "all.mtl").write_text("newmtl a\n" + text)
    materials, notes = load_materials([read_mtl(folder / "all.mtl")["a"]])
    return materials[0], notes


def load(folder, text):
    (folder / "all.mtl").write_text(text)
    (folder / "thing.obj").write_text(OBJ)
    return load_scene_file(folder / "thing.obj")


# Known answers


def test_no_statement_is_the_default(folder):
    assert material(folder, "") == (Material(), ())
    assert load_materials([None])[0][0].base_color == (0.7, 0.7, 0.7)


def test_colors_are_linear_numbers_and_srgb_images(folder):
    made, notes = material(folder, "Kd 0.5 .25 1\nmap_Kd my colors.png\n")
    assert made.base_color == (0.5, 0.25, 1.0)
    assert_close(texels_of(made.base_color_texture), np.float32([[[1, 0.50288653, 0]]]))
    assert made.normal_texture is made.height_texture is None
    assert notes == ()
    assert material(folder, "Kd 0.5\n")[0].base_color == (0.5, 0.5, 0.5)


@pytest.mark.parametrize("word", ["norm", "map_Bump", "map_bump", "bump", "NORM"])
def test_a_bluish_map_holds_normals(folder, word):
    made, notes = material(folder, f"{word} -bm 0.75 maps\\normal.png\n")
    expected = np.array(NORMAL, np.float32) / np.float32(255)
    np.testing.assert_array_equal(texels_of(made.normal_texture), expected)
    assert made.normal_scale == 0.75
    assert (made.normal_texture.wrap_u, made.normal_texture.wrap_v) == (repeat, repeat)
    assert notes == ()


@pytest.mark.parametrize("word", ["map_Bump", "bump"])
def test_a_gray_bump_map_holds_heights(folder, word):
    """From 0 over 0.2 to 1 in two texels: a slope of 0.5 a texel, at scale 1."""
    made, notes = material(folder, f"{word} -bm 2 heights.png\n")
    normal = 2 * texels_of(made.normal_texture)[0, 1] - 1
    assert_close(normal, np.float32([-1, 0, 2] / np.sqrt(5)), ulps=8)
    assert made.normal_scale == 2
    assert made.height_texture is None
    assert notes == ("texture heights.png: a bump map, taken as heights in widths of its texels",)


def test_heights_displace_by_base_and_gain(folder):
    plain, _ = material(folder, "disp heights.png\n")
    assert_close(texels_of(plain.height_texture), np.float32([[[0], [0.2], [1], [0.4]]]))
    assert plain.height_scale == 1
    assert plain.normal_texture is None
    moved, _ = material(folder, "disp -mm -0.1 3 heights.png\n")
    assert texels_of(moved.height_texture).dtype == np.float32
    assert_close(texels_of(moved.height_texture), np.float32([[[-0.1], [0.5], [2.9], [1.1]]]))


def test_options_may_stand_in_any_order_before_a_name_with_spaces(folder):
    text = "map_Kd -s 1 1 -clamp on -o 0.5 -texres 256 -mm 0 1 my colors.png\n"
    made, notes = material(folder, text)
    assert texels_of(made.base_color_texture).shape == (1, 1, 3)
    assert (made.base_color_texture.wrap_u, made.base_color_texture.wrap_v) == (clamp, clamp)
    assert notes == ("texture my colors.png: options -o, -s, -texres ignored",)
    assert material(folder, "map_Kd -clamp off my colors.png\n")[0].base_color_texture.wrap_u is (
        repeat
    )


def test_faces_keep_their_material_through_triangulation(folder):
    scene = load(folder, "newmtl b\nKd 0 1 0\nnewmtl a\nKd 1 0 0\nmap_Bump maps/normal.png\n")
    np.testing.assert_array_equal(scene.face_materials[:-2], [0, 0, 1])
    assert [m.base_color for m in scene.materials[:2]] == [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0)]
    assert scene.materials[0].normal_texture is not None
    assert scene.materials[1].normal_texture is None


def test_a_map_that_materials_share_is_read_once(folder):
    one, two = load(
        folder, "newmtl a\nmap_Kd my colors.png\nnewmtl b\nmap_Kd my colors.png\n"
    ).materials[:2]
    assert one.base_color_texture is two.base_color_texture


def test_a_material_used_again_is_the_same(folder):
    (folder / "all.mtl").write_text("newmtl a\nKd 1 0 0\nnewmtl b\nKd 0 1 0\n")
    (folder / "thing.obj").write_text(OBJ + "usemtl a\nf 1/1 3/3 4/4\n")
    scene = load_scene_file(folder / "thing.obj")
    np.testing.assert_array_equal(scene.face_materials[:-2], [0, 0, 1, 0])
    assert len(scene.materials) == 3  # the floor's behind them


def test_unused_materials_are_not_read(folder):
    scene = load(folder, "newmtl a\nnewmtl b\nnewmtl c\nmap_Kd none.png\nKd x\nrefl r.png\n")
    assert not any("none.png" in note or "passed over" in note for note in scene.notes)


# What is said


def test_missing_images_are_noted(folder):
    made, notes = material(folder, "map_Kd x/a.png\nnorm b.png\ndisp -mm 0 1 c d.exr\n")
    assert made == Material()
    assert notes == (
        "texture a.png not found: its material's color is used alone",
        "texture b.png not found: used without",
        "texture c d.exr not found: used without",
    )


def test_the_formats_shading_is_passed_over_in_silence_and_the_rest_counted(folder):
    silent = "# a comment\n\nKa 1 1 1\nKs 0 0 0\nNs 10\nNi 1.45\nillum 2\nd 1.0\nTr 0\nKe 0 0 0\n"
    assert material(folder, silent)[1] == ()
    loud = silent.replace("d 1.0", "d 0.5") + "map_Ks s.png\nmap_d d.png\nKd spectral a.rfl\n"
    made, notes = material(folder, loud)
    assert made == Material()
    assert notes == ("4 material statements passed over: d, kd, map_d, map_ks",)
    made, notes = material(folder, "norm maps/normal.png\nbump heights.png\n")
    assert texels_of(made.normal_texture).shape == (1, 2, 3)
    assert notes == ("1 material statement passed over: map_bump",)


def test_odd_texels_are_counted_in_the_scenes_notes(folder):
    Image.fromarray(np.array([[[0, 0, 0], [128, 128, 255]]], np.uint8)).save(folder / "n.png")
    scene = load(folder, "newmtl a\nnorm n.png\n")
    expected = "texture n.png: 1 of 2 texels are zero, as if never written; used as they are"
    assert expected in scene.notes


def test_uvs_outside_a_clamped_texture_are_counted(folder):
    what = "with UVs outside [0, 1] under a clamped texture: its border is seen there"
    clamped = load(folder, "newmtl b\nmap_Kd -clamp on my colors.png\n")
    assert f"1 vertex {what}" in clamped.notes
    for text in ("newmtl b\nmap_Kd my colors.png\n", "newmtl a\nmap_Kd -clamp on my colors.png\n"):
        assert not any(what in note for note in load(folder, text).notes)


def test_without_uvs_textures_are_left_out_and_counted(folder):
    (folder / "all.mtl").write_text(
        "newmtl a\nKd 1 0 0\nmap_Kd my colors.png\nnorm maps/normal.png\nnewmtl b\nKd 0 1 0\n"
    )
    lines = [line for line in OBJ.splitlines() if not line.startswith("vt")]
    text = "\n".join(" ".join(w.split("/")[0] for w in line.split()) for line in lines)
    (folder / "thing.obj").write_text(text)
    scene = load_scene_file(folder / "thing.obj")
    assert scene.materials[0] == Material((1.0, 0.0, 0.0))
    assert scene.mesh.uvs is None
    assert "1 material with textures but no UVs: used without" in scene.notes


# Errors


def zeros(path):
    Image.new("RGB", (4, 4)).save(path)


def with_nan(path):
    texels = np.full((2, 2), 0.5, np.float32)
    texels[0, 1] = np.nan
    write_exr(path, dict.fromkeys("RGB", texels))


BAD = {
    "color": ("Kd 1 x 0\n", None, r"material file all.mtl: expected 3 numbers, got '1 x 0'"),
    "two numbers": ("Kd 1 0\n", None, "expected 3 numbers, got '1 0'"),
    "nan": ("Kd nan 0 0\n", None, "expected 3 numbers, got 'nan 0 0'"),
    "scale": ("norm -bm x maps/normal.png\n", None, "expected 1 number, got 'x'"),
    "gain": ("disp -mm 1 x heights.png\n", None, "expected 2 numbers, got '1 x'"),
    "no image": ("map_Kd b.png\n", lambda p: p.write_text("hello"), "texture b.png: is no image"),
    "zero": ("norm b.png\n", zeros, "texture b.png: all texels are zero"),
    "gray": ("norm heights.png\n", None, "texture heights.png: is gray"),
    "color heights": ("disp my colors.png\n", None, "texture my colors.png: expected one channel"),
    "nan texels": ("map_Kd b.exr\n", with_nan, "texture b.exr: 1 of 4 texels are NaN"),
}


@pytest.mark.errors
@pytest.mark.parametrize("case", BAD)
def test_bad_material_is_one_line_that_names_scene_and_file(folder, case):
    text, make, match = BAD[case]
    if make:
        make(folder / text.split()[-1])
    with pytest.raises(ValueError, match=match) as caught:
        load(folder, "newmtl a\n" + text)
    assert str(caught.value).startswith(f"{folder / 'thing.obj'}: ")
    assert "\n" not in str(caught.value)
