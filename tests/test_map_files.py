"""Maps out of files: raw normals, heights, linear colors; what is odd is said or refused."""

import struct
import zlib

import numpy as np
import pytest
from PIL import Image

from experiments.files.images import linear_to_srgb, write_exr
from experiments.files.map_files import (
    bump_map,
    read_color_map,
    read_height_map,
    read_normal_map,
    write_normal_map,
)
from experiments.files.texture_file import Pixels
from tangentspace.texture import clamp, repeat

from .test_images import png_16_bit
from .tools import assert_close

SRGB = (b"sRGB", b"\0")
GAMMA = (b"gAMA", struct.pack(">I", 45455))
PROFILE = (b"iCCP", b"sRGB\0\0" + zlib.compress(b"made up"))


def normals(size=(6, 8)):
    """Unit normals up to 60 degrees from z, no two alike."""
    rng = np.random.default_rng(0)
    tilt, turn = rng.uniform(0.05, np.pi / 3, size), rng.uniform(0, 2 * np.pi, size)
    x, y = np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn)
    return np.stack([x, y, np.cos(tilt)], axis=-1)


def levels(texels):
    """Values in [0, 1] as 8-bit levels."""
    return np.rint(255 * np.asarray(texels)).astype(np.uint8)


def png(path, texels, *chunks):
    """Write 8-bit levels, and chunks that Pillow would not write, behind the header."""
    Image.fromarray(np.asarray(texels, np.uint8)).save(path)
    content = path.read_bytes()
    more = b"".join(
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        for kind, data in chunks
    )
    path.write_bytes(content[:33] + more + content[33:])
    return path


def exr(path, texels, names="RGB"):
    write_exr(path, dict(zip(names, np.moveaxis(np.asarray(texels), -1, 0), strict=True)))
    return path


def vectors(texels):
    return 2 * texels.astype(np.float64) - 1


RAW = 0.5 + 0.5 * normals()


# Normal maps: known answers


def test_8_bit_texels_are_raw_row_0_on_top(tmp_path):
    stored = np.array([[[128, 128, 255], [1, 128, 128]], [[218, 90, 210], [128, 255, 128]]])
    texels, notes = read_normal_map(png(tmp_path / "a.png", stored))
    np.testing.assert_array_equal(texels, stored.astype(np.float32) / np.float32(255))
    assert texels.dtype == np.float32
    assert notes == ()


@pytest.mark.parametrize(("bits", "finest"), [(8, 255), (16, 65535)])
def test_png_keeps_what_it_is_given_to_half_a_level(tmp_path, bits, finest):
    path = tmp_path / "a.png"
    write_normal_map(path, RAW, bits=bits)
    texels, notes = read_normal_map(path)
    assert np.abs(texels - RAW).max() <= 0.5001 / finest
    assert notes == ()
    with Image.open(path) as image:
        assert not {"srgb", "gamma", "icc_profile"} & image.info.keys()
    write_normal_map(tmp_path / "b.png", texels, bits=bits)
    np.testing.assert_array_equal(read_normal_map(tmp_path / "b.png").texels, texels)
    assert (tmp_path / "b.png").read_bytes() == path.read_bytes()


def test_other_programs_read_the_png(tmp_path):
    write_normal_map(tmp_path / "a.png", RAW)
    high_bytes = np.rint(65535 * RAW).astype(np.uint16) >> 8
    with Image.open(tmp_path / "a.png") as image:
        np.testing.assert_array_equal(np.asarray(image), high_bytes)


def test_exr_keeps_every_float(tmp_path):
    write_normal_map(tmp_path / "a.exr", RAW.astype(np.float32))
    texels, notes = read_normal_map(tmp_path / "a.exr")
    np.testing.assert_array_equal(texels, RAW.astype(np.float32))
    assert notes == ()


@pytest.mark.parametrize("names", ["RGB", "XYZ"])
def test_normals_themselves_are_encoded(tmp_path, names):
    texels, notes = read_normal_map(exr(tmp_path / "a.exr", normals(), names))
    assert_close(texels, RAW, ulps=2)
    assert notes == (f"{tmp_path / 'a.exr'}: holds normals in [-1, 1], encoded to [0, 1]",)
    flat = np.broadcast_to([0.0, 0.0, 1.0], (4, 4, 3))
    texels, notes = read_normal_map(exr(tmp_path / "b.exr", flat))
    assert_close(texels, np.broadcast_to([0.5, 0.5, 1.0], (4, 4, 3)))
    assert "encoded to [0, 1]" in notes[0]


def test_green_that_points_down_is_flipped(tmp_path):
    path = png(tmp_path / "a.png", levels(RAW))
    up, down = read_normal_map(path).texels, read_normal_map(path, flip_green=True).texels
    np.testing.assert_allclose(vectors(down), vectors(up) * [1, -1, 1], atol=2e-7)  # 1.2e-7
    np.testing.assert_array_equal(down[..., ::2], up[..., ::2])


def test_two_channels_get_their_z(tmp_path):
    full = normals()
    gray_alpha = np.stack([levels(RAW[..., 0]), levels(RAW[..., 1])], axis=-1)
    png_16_bit(tmp_path / "deep.png", np.rint(65535 * RAW[..., :2]).astype(int))
    paths = {
        exr(tmp_path / "a.exr", RAW[..., :2], "RG"): 3e-7,
        exr(tmp_path / "b.exr", full[..., :2], "XY"): 3e-7,
        png(tmp_path / "c.png", gray_alpha): 8e-3,
        png(tmp_path / "d.png", levels(RAW * [1, 1, 0])): 8e-3,
        tmp_path / "deep.png": 3e-5,
    }
    for path, atol in paths.items():
        texels, notes = read_normal_map(path)
        np.testing.assert_allclose(vectors(texels), full, atol=atol)
        assert f"{path}: has two channels, z rebuilt" in notes


def test_z_is_0_where_two_channels_are_too_long(tmp_path):
    xy = np.array([[[1.0, 1.0], [0.5, 1.0], [0.5, 0.5]]])
    texels, notes = read_normal_map(exr(tmp_path / "a.exr", xy, "RG"))
    assert_close(texels[..., 2], [[0.5, 0.5, 1.0]])
    assert "1 of 3 texels have x, y longer than 1: z is 0" in notes[1]


@pytest.mark.parametrize("flat", [(127, 127, 255), (128, 128, 255), (127, 128, 255)])
def test_a_flat_map_becomes_exactly_flat(tmp_path, flat):
    texels, notes = read_normal_map(png(tmp_path / "a.png", np.full((3, 4, 3), flat)))
    np.testing.assert_array_equal(texels, np.broadcast_to([0.5, 0.5, 1.0], (3, 4, 3)))
    assert "is flat; the tilt by rounding to 8 bits is taken out" in notes[0]


def test_a_16_bit_map_as_flat_as_8_bits_go_is_kept(tmp_path):
    deep = np.array([[[32768, 32768, 65535], [32868, 32668, 65535]]])
    png_16_bit(tmp_path / "a.png", deep)
    texels, notes = read_normal_map(tmp_path / "a.png")
    assert_close(texels, (deep / 65535).astype(np.float32))
    assert notes == ()


def test_one_texel_that_is_not_flat_keeps_the_map_raw(tmp_path):
    stored = np.full((3, 4, 3), (128, 128, 255), np.uint8)
    stored[1, 2] = (140, 128, 254)
    texels, notes = read_normal_map(png(tmp_path / "a.png", stored))
    np.testing.assert_array_equal(texels, stored.astype(np.float32) / np.float32(255))
    assert notes == ()


# Normal maps: odd but legal


@pytest.mark.parametrize("tag", [SRGB, GAMMA, PROFILE])
def test_an_srgb_tag_on_raw_normals_is_ignored_and_said(tmp_path, tag):
    path = png(tmp_path / "a.png", levels(RAW), tag)
    texels, notes = read_normal_map(path)
    assert_close(texels, levels(RAW).astype(np.float32) / np.float32(255))
    assert notes == (f"{path}: its sRGB tag is ignored, the texels are raw",)


def test_a_linear_gamma_is_no_srgb_tag(tmp_path):
    linear = (b"gAMA", struct.pack(">I", 100000))
    assert read_normal_map(png(tmp_path / "a.png", levels(RAW), linear)).notes == ()


def test_odd_texels_are_counted_and_kept(tmp_path):
    stored = levels(RAW)
    stored[0, :3] = 0
    stored[1, :2] = levels(0.5 + 0.4 * normals()[1, :2])
    stored[2, 0] = levels([0.5, 0.5, 0.0])
    path = png(tmp_path / "a.png", stored)
    texels, notes = read_normal_map(path)
    np.testing.assert_array_equal(texels, stored.astype(np.float32) / np.float32(255))
    assert notes == (
        f"{path}: 3 of 48 texels are zero, as if never written; used as they are",
        f"{path}: 2 of 48 texels are not of length 1, as if blurred; used as they are",
        f"{path}: 1 of 48 texels point below the surface; used as they are",
    )


def test_alpha_is_dropped(tmp_path):
    with_alpha = np.concatenate([levels(RAW), np.full((6, 8, 1), 77, np.uint8)], axis=-1)
    texels = read_normal_map(png(tmp_path / "a.png", with_alpha)).texels
    assert_close(texels, levels(RAW).astype(np.float32) / np.float32(255))


# Heights and colors


def test_heights_are_raw_and_of_one_channel(tmp_path):
    stored = np.array([[0, 51, 255]], np.uint8)
    expected = np.float32([[[0], [0.2], [1]]])
    three = np.repeat(stored[..., None], 3, axis=-1)
    for index, texels in enumerate((stored, three, np.concatenate([three, three[..., :1]], -1))):
        read = read_height_map(png(tmp_path / f"{index}.png", texels))
        assert_close(read.texels, expected)
        assert read.notes == ()
    png_16_bit(tmp_path / "deep.png", np.array([[[0], [12345], [65535]]]))
    deep = read_height_map(tmp_path / "deep.png").texels
    assert_close(deep, np.float32([[[0], [12345 / 65535], [1]]]))
    for names in ("Y", "Z", "R"):
        floats = exr(tmp_path / "a.exr", np.float32([[[-2.5], [7]]]), names)
        np.testing.assert_array_equal(read_height_map(floats).texels, [[[-2.5], [7]]])


def test_level_heights_are_said(tmp_path):
    path = png(tmp_path / "a.png", np.full((2, 2), 9))
    assert read_height_map(path).notes == (f"{path}: all heights are equal",)


def test_colors_are_decoded_from_png_and_kept_from_exr(tmp_path):
    stored = np.array([[[255, 188, 0]]])
    # sRGB 188 is the level nearest to half the light: ((188/255 + 0.055) / 1.055)^2.4.
    read = read_color_map(png(tmp_path / "a.png", stored))
    assert_close(read.texels, np.float32([[[1, 0.50288653, 0]]]))
    gray = read_color_map(png(tmp_path / "b.png", [[188, 0]])).texels
    assert_close(gray, np.float32([[[0.50288653] * 3, [0] * 3]]))
    bright = np.float32([[[0.25, 3.5, 0]]])
    np.testing.assert_array_equal(read_color_map(exr(tmp_path / "c.exr", bright)).texels, bright)


def test_bumps_of_a_ramp_lean_against_it(tmp_path):
    """Heights that rise by 0.1 a texel along u: a slope of 0.1; clamped, half of it at the ends."""
    ramp = np.broadcast_to(np.arange(8, dtype=np.float32) / 10, (4, 8))
    colored = ramp[..., None] * np.float32([1.5, 1, 0.2])
    for texels in (ramp[..., None], colored):
        pixels = Pixels(texels)
        weight = 1.0 if texels.shape[-1] == 1 else 1.5 * 0.2126 + 0.7152 + 0.2 * 0.0722
        leaning = vectors(bump_map(pixels, "a", wrap_u=clamp, wrap_v=clamp).texels)
        slope = -leaning[..., 0] / leaning[..., 2]
        np.testing.assert_allclose(slope[:, 1:-1], 0.1 * weight, rtol=1e-5)  # 1e-6
        np.testing.assert_allclose(slope[:, [0, -1]], 0.05 * weight, rtol=1e-5)  # 1e-6
        np.testing.assert_allclose(leaning[..., 1], 0, atol=1e-7)
    around = vectors(bump_map(Pixels(ramp[..., None]), "a", wrap_u=repeat, wrap_v=repeat).texels)
    np.testing.assert_allclose(-around[:, 0, 0] / around[:, 0, 2], -0.3, rtol=1e-5)  # 1e-6


# Errors


def with_nan(path):
    texels = RAW.copy()
    texels[0, 0, 1], texels[1, 1], texels[2, 2, 0] = np.nan, np.nan, np.inf
    return exr(path.with_suffix(".exr"), texels)


def gray(path):
    return png(path, [[128, 200]])


NORMALS = {
    "missing": (lambda p: p, "no such file"),
    "folder": (lambda p: p.mkdir() or p, "no such file"),
    "no image": (lambda p: p.write_text("hello") and p, "is no image that can be read"),
    "cut": (
        lambda p: p.write_bytes(png(p, levels(RAW)).read_bytes()[:-40]) and p,
        "is no image that can be read",
    ),
    "no EXR": (
        lambda p: p.with_suffix(".exr").write_text("hello") and p.with_suffix(".exr"),
        "not an EXR image",
    ),
    "gray": (gray, "is gray, expected a normal map of three channels"),
    "gray as RGB": (lambda p: png(p, [[[9] * 3, [200] * 3]]), "is gray"),
    "gray, opaque": (lambda p: png(p, [[[9, 255], [200, 255]]]), "is gray"),
    "one channel": (lambda p: exr(p.with_suffix(".exr"), RAW[..., :1], "Y"), "is gray"),
    "channels": (
        lambda p: exr(p.with_suffix(".exr"), RAW, ["a.X", "a.Y", "a.Z"]),
        "expected channels R, G, B or a single one, got a.X, a.Y, a.Z",
    ),
    "nan": (with_nan, "3 of 48 texels are NaN or infinite"),
    "zero": (lambda p: png(p, np.zeros((3, 3, 3))), "all texels are zero"),
    "zero EXR": (lambda p: exr(p.with_suffix(".exr"), 0 * RAW), "all texels are zero"),
    "below": (lambda p: png(p, levels(RAW * [1, 1, -1] + [0, 0, 1])), "point below the surface"),
    "flat below": (lambda p: png(p, np.full((2, 2, 3), (128, 128, 0))), "below the surface"),
    "sRGB": (lambda p: png(p, levels(linear_to_srgb(RAW))), "was saved as sRGB colors"),
    "sRGB, tagged": (lambda p: png(p, levels(linear_to_srgb(RAW)), SRGB), "saved as sRGB"),
    "sRGB, flat": (lambda p: png(p, np.full((2, 2, 3), (188, 188, 255))), "saved as sRGB"),
    "sRGB, partly written": (
        lambda p: png(p, np.concatenate([levels(linear_to_srgb(RAW)), np.zeros((6, 8, 3))])),
        "saved as sRGB",
    ),
    "range": (
        lambda p: exr(p.with_suffix(".exr"), 7 * RAW),
        "texels out of range, .* from 0.* to [67]",
    ),
}


def check_line(read, make, path, match):
    path = make(path)
    with pytest.raises(ValueError, match=match) as caught:
        read(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)


@pytest.mark.errors
@pytest.mark.parametrize("case", NORMALS)
def test_bad_normal_map_is_one_line_that_names_it(tmp_path, case):
    make, match = NORMALS[case]
    check_line(read_normal_map, make, tmp_path / "bad.png", match)


@pytest.mark.errors
def test_bad_heights_and_colors_are_one_line(tmp_path):
    path = tmp_path / "bad.png"
    colored = lambda p: png(p, [[[1, 2, 3]]])
    check_line(read_height_map, colored, path, "expected one channel of heights, got colors")
    check_line(read_height_map, with_nan, path, "3 of 48 texels are NaN or infinite")
    check_line(read_color_map, with_nan, path, "3 of 48 texels are NaN or infinite")
    two = lambda p: exr(p.with_suffix(".exr"), RAW[..., :2], "RG")
    check_line(read_color_map, two, path, "got two channels")
    negative = lambda p: exr(p.with_suffix(".exr"), normals())
    check_line(read_color_map, negative, path, "of 48 texels are negative")


WRITES = {
    "suffix": ("a.tga", RAW, {}, "expected a name ending in .exr or .png"),
    "shape": ("a.png", RAW[..., :2], {}, r"expected texels of shape .*got \(6, 8, 2\)"),
    "empty": ("a.png", RAW[:0], {}, "expected texels of shape"),
    "not encoded": ("a.png", normals(), {}, "of 48 are not; encode"),
    "nan": ("a.exr", RAW * np.nan, {}, "48 of 48 are not"),
    "bits": ("a.png", RAW, {"bits": 12}, "expected `bits` of 8 or 16, got 12"),
    "folder": ("none/a.png", RAW, {}, "there is no folder"),
}


@pytest.mark.errors
@pytest.mark.parametrize("case", WRITES)
def test_bad_write_is_one_line_and_leaves_nothing(tmp_path, case):
    name, texels, options, match = WRITES[case]
    with pytest.raises(ValueError, match=match) as caught:
        write_normal_map(tmp_path / name, texels, **options)
    assert str(caught.value).startswith(f"{tmp_path / name}: ")
    assert not list(tmp_path.iterdir())
