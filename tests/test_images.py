"""EXR and PNG files: what is written is read back, and nothing half-written stays."""

import struct
import zlib

import numpy as np
import OpenEXR
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays
from PIL import Image

from experiments.files.images import (
    atomic_path,
    linear_to_srgb,
    read_exr,
    read_image,
    srgb_to_linear,
    write_exr,
    write_png,
)

LAYERS = ["R", "G", "B", "depth.Z", "normal.X", "normal.Y", "normal.Z", "visibility.V"]


def ramp(*shape):
    return np.linspace(0, 1, int(np.prod(shape)), dtype=np.float32).reshape(shape)


def png_16_bit(path, texels):
    """Write a 16-bit PNG by hand: Pillow cannot."""
    color_type = {1: 0, 2: 4, 3: 2, 4: 6}[texels.shape[2]]
    height, width = texels.shape[:2]
    rows = b"".join(b"\0" + row.astype(">u2").tobytes() for row in texels)
    header = struct.pack(">IIBBBBB", width, height, 16, color_type, 0, 0, 0)
    chunks = [(b"IHDR", header), (b"IDAT", zlib.compress(rows)), (b"IEND", b"")]
    path.write_bytes(
        b"\x89PNG\r\n\x1a\n"
        + b"".join(
            struct.pack(">I", len(data)) + tag + data + struct.pack(">I", zlib.crc32(tag + data))
            for tag, data in chunks
        )
    )


# Known answers


def test_srgb_known_values():
    linear = np.array([0.0, 0.0031308, 0.0033, 0.214041, 0.5, 1.0])
    srgb = np.array([0.0, 0.04044994, 0.04256632, 0.5, 0.735357, 1.0])
    np.testing.assert_allclose(linear_to_srgb(linear), srgb, atol=1e-6)  # measured 1.5e-7
    np.testing.assert_allclose(srgb_to_linear(srgb), linear, atol=1e-6)  # measured 1.4e-7


def test_png_known_texels_row_0_on_top(tmp_path):
    image = np.zeros((2, 3, 3), np.float32)
    image[0, 0] = [1.0, 0.5, 0.0]
    image[1, 2] = [2.0, -1.0, np.nan]
    write_png(tmp_path / "a.png", image)
    with Image.open(tmp_path / "a.png") as file:
        texels = np.asarray(file)
    assert texels.dtype == np.uint8
    np.testing.assert_array_equal(texels[0, 0], [255, 188, 0])
    np.testing.assert_array_equal(texels[1, 2], [255, 0, 0])
    assert texels.sum() == 255 + 188 + 255


@pytest.mark.parametrize("mode", ["1", "L", "LA", "P", "RGB", "RGBA"])
def test_read_png_of_8_bits(tmp_path, mode):
    path = tmp_path / "a.png"
    colors = Image.new("RGB", (3, 2), (255, 255, 255) if mode == "1" else (188, 188, 188))
    image = colors.quantize(2) if mode == "P" else colors.convert(mode)
    if mode in ("LA", "RGBA"):
        image.putalpha(7)
    image.save(path)
    read = read_image(path)
    assert (read.shape, read.dtype) == ((2, 3, 3), np.float32)
    expected = 1.0 if mode == "1" else ((188 / 255 + 0.055) / 1.055) ** 2.4
    np.testing.assert_allclose(read, expected, rtol=1e-6)  # measured 8e-8


@pytest.mark.parametrize("channels", [1, 3, 4])
def test_read_png_of_16_bits(tmp_path, channels):
    texels = np.random.default_rng(0).integers(0, 65536, (5, 7, channels))
    png_16_bit(tmp_path / "a.png", texels)
    expected = srgb_to_linear(np.broadcast_to(texels[..., :3], (5, 7, 3)) / 65535)
    np.testing.assert_allclose(read_image(tmp_path / "a.png"), expected, atol=1e-6)  # 2e-7


def test_read_png_of_16_bits_gray_and_alpha_keeps_8(tmp_path):
    texels = np.random.default_rng(0).integers(0, 65536, (5, 7, 2))
    png_16_bit(tmp_path / "a.png", texels)
    encoded = linear_to_srgb(read_image(tmp_path / "a.png"))
    expected = np.broadcast_to(texels[..., :1] / 65535, (5, 7, 3))
    np.testing.assert_allclose(encoded, expected, atol=1 / 255)


def test_exr_header_and_layers(tmp_path):
    layers = {name: ramp(4, 6) + i for i, name in enumerate(LAYERS)}
    write_exr(tmp_path / "a.exr", layers)
    with OpenEXR.File(str(tmp_path / "a.exr"), separate_channels=True) as file:
        assert file.header()["compression"] == OpenEXR.ZIP_COMPRESSION
        assert {c.pixels.dtype for c in file.channels().values()} == {np.dtype(np.float32)}
    read = read_exr(tmp_path / "a.exr")
    assert sorted(read) == sorted(LAYERS)
    for name in LAYERS:
        np.testing.assert_array_equal(read[name], layers[name])
    image = read_image(tmp_path / "a.exr")
    np.testing.assert_array_equal(image, np.stack([layers[name] for name in "RGB"], axis=-1))


def test_exr_of_other_programs(tmp_path):
    """Half-float RGBA, tightly packed, and an integer channel."""
    path = tmp_path / "a.exr"
    header = {"compression": OpenEXR.PIZ_COMPRESSION, "type": OpenEXR.scanlineimage}
    pixels = ramp(3, 4, 4).astype(np.float16)
    ids = np.arange(12, dtype=np.uint32).reshape(3, 4)
    OpenEXR.File(header, {"RGBA": pixels, "id": ids}).write(str(path))
    read = read_exr(path)
    assert sorted(read) == ["A", "B", "G", "R", "id"]
    assert {a.dtype for a in read.values()} == {np.dtype(np.float32)}
    np.testing.assert_array_equal(read["id"], ids)
    np.testing.assert_array_equal(read_image(path), pixels[..., :3].astype(np.float32))


# Laws


@given(arrays(np.uint8, array_shapes(min_dims=2, max_dims=2, max_side=9)))
@settings(max_examples=30, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_png_keeps_every_8_bit_value(tmp_path, texels):
    gray = srgb_to_linear(texels / 255)
    write_png(tmp_path / "a.png", gray)
    read = read_image(tmp_path / "a.png")
    np.testing.assert_array_equal(np.rint(255 * linear_to_srgb(read)), np.stack([texels] * 3, -1))


@given(
    arrays(
        np.float32,
        array_shapes(min_dims=2, max_dims=2, max_side=9),
        elements=st.floats(width=32, allow_nan=True, allow_infinity=True),
    )
)
@settings(max_examples=30, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_exr_keeps_every_float(tmp_path, depth):
    write_exr(tmp_path / "a.exr", {"depth.Z": depth})
    np.testing.assert_array_equal(read_exr(tmp_path / "a.exr")["depth.Z"], depth)


def test_srgb_round_trip():
    linear = np.concatenate([np.linspace(0, 1, 1001), np.linspace(0.00313, 0.00314, 1001)])
    np.testing.assert_allclose(srgb_to_linear(linear_to_srgb(linear)), linear, atol=1e-8)  # 3e-9
    assert linear_to_srgb(linear.astype(np.float32)).dtype == np.float32


def test_exr_takes_strided_and_double_arrays(tmp_path):
    depth = np.asfortranarray(ramp(8, 6).astype(np.float64))[::2]
    write_exr(tmp_path / "a.exr", {"depth.Z": depth})
    np.testing.assert_array_equal(read_exr(tmp_path / "a.exr")["depth.Z"], depth.astype(np.float32))


# Whole files or none


@pytest.mark.parametrize("exception", [KeyboardInterrupt, RuntimeError, OSError])
def test_interrupted_write_leaves_the_old_file_alone(tmp_path, exception):
    path = tmp_path / "a.json"
    path.write_text("old")

    def write_half():
        with atomic_path(path) as temporary:
            temporary.write_text("half")
            raise exception

    with pytest.raises(ValueError if exception is OSError else exception):
        write_half()
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_finished_write_replaces_the_old_file(tmp_path):
    path = tmp_path / "a.json"
    path.write_text("old")
    with atomic_path(path) as temporary:
        assert (temporary.parent, temporary.suffix) == (path.parent, path.suffix)
        temporary.write_text("new")
        assert path.read_text() == "old"
    assert path.read_text() == "new"
    assert list(tmp_path.iterdir()) == [path]


def test_failed_encoder_leaves_nothing(tmp_path, monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(Image.Image, "save", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_png(tmp_path / "a.png", ramp(2, 2))
    assert not list(tmp_path.iterdir())


# Errors

BAD_WRITES = {
    "sizes differ": (write_exr, "a.exr", {"R": ramp(2, 3), "G": ramp(3, 2)}, "one size"),
    "no channel": (write_exr, "a.exr", {}, "one size"),
    "empty channel": (write_exr, "a.exr", {"R": ramp(0, 3)}, r"\(0, 3\)"),
    "channel of 3 axes": (write_exr, "a.exr", {"R": ramp(2, 2, 3)}, r"\(2, 2, 3\)"),
    "empty image": (write_png, "a.png", ramp(0, 3, 3), r"\(0, 3, 3\)"),
    "RGBA image": (write_png, "a.png", ramp(2, 2, 4), r"\(2, 2, 4\)"),
    "line": (write_png, "a.png", ramp(2), r"\(2,\)"),
    "png as exr": (write_exr, "a.png", {"R": ramp(2, 2)}, "ending in .exr"),
    "exr as png": (write_png, "a.exr", ramp(2, 2), "ending in .png"),
    "no folder": (write_png, "no/a.png", ramp(2, 2), "no folder"),
    "folder in the way": (write_png, "folder.png", ramp(2, 2), "cannot be written"),
    "name too long": (write_exr, "a" * 300 + ".exr", {"R": ramp(2, 2)}, "cannot be written"),
}


@pytest.mark.errors
@pytest.mark.parametrize("case", BAD_WRITES)
def test_bad_write_is_one_clear_line(tmp_path, case):
    write, name, content, message = BAD_WRITES[case]
    (tmp_path / "folder.png").mkdir()
    with pytest.raises(ValueError, match=message) as caught:
        write(tmp_path / name, content)
    assert name in str(caught.value)
    assert "\n" not in str(caught.value)
    assert [p.name for p in tmp_path.iterdir()] == ["folder.png"]


BAD_READS = {
    "missing.png": None,
    "missing.exr": None,
    "text.png": b"no image",
    "text.exr": b"no image",
    "empty.png": b"",
    "empty.exr": b"",
    "text.jpg": b"no image",
}


@pytest.mark.parametrize("name", BAD_READS)
def test_bad_read_is_one_clear_line(tmp_path, name):
    if BAD_READS[name] is not None:
        (tmp_path / name).write_bytes(BAD_READS[name])
    with pytest.raises(ValueError, match=name) as caught:
        read_image(tmp_path / name)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("suffix", ["png", "exr"])
def test_every_truncation_is_an_error(tmp_path, suffix):
    whole, cut = tmp_path / f"a.{suffix}", tmp_path / f"cut.{suffix}"
    noise = np.random.default_rng(0).random((16, 16, 3), np.float32)
    if suffix == "png":
        write_png(whole, noise)
    else:
        write_exr(whole, {name: noise[..., i] for i, name in enumerate("RGB")})
    data = whole.read_bytes()
    for length in np.linspace(0, len(data) - 40, 12).astype(int):
        cut.write_bytes(data[:length])
        with pytest.raises(ValueError, match=r"cut\."):
            read_image(cut)


def test_jpeg_named_png_is_an_error(tmp_path):
    Image.new("RGB", (4, 4)).save(tmp_path / "a.png", format="jpeg")
    with pytest.raises(ValueError, match="not a PNG image"):
        read_image(tmp_path / "a.png")


def test_exr_without_color_names_its_channels(tmp_path):
    write_exr(tmp_path / "a.exr", {"depth.Z": ramp(2, 2), "R": ramp(2, 2)})
    with pytest.raises(ValueError, match=r"R, G, B, got R, depth\.Z"):
        read_image(tmp_path / "a.exr")
