"""Image files as raw numbers, one to three channels, 8 or 16 bits a channel or EXR floats.

What the numbers mean (colors, normals, heights) is ``map_files``' business: nothing is
decoded here. Row 0 is on top.
"""

import struct
import zlib
from io import BytesIO
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from PIL import Image, ImageFile

from .images import atomic_path, read_exr

FLOAT_BITS = 32
_GAMMA_OF_SRGB = 0.45455
_EXR_LAYOUTS = (("R", "G", "B"), ("X", "Y", "Z"), ("R", "G"), ("X", "Y"), ("Y",))


class Pixels(NamedTuple):
    """An image as its file stores it.

    Attributes:
        texels: Gray, two channels or RGB, float32; integers are scaled to [0, 1], floats
            as they are. Alpha is dropped, but for gray with alpha: two channels.
        bits: Of a channel: 8, 16, or 32 for floating-point numbers.
        tagged_srgb: Whether the file calls its numbers sRGB colors.
    """

    texels: Float[np.ndarray, "height width channels"]
    bits: int = 8
    tagged_srgb: bool = False


def read_pixels(file: Path | BytesIO, label: str) -> Pixels:
    """Read an EXR file (by its suffix), or any image that Pillow can open.

    Args:
        file: The file, or its bytes.
        label: What error messages call it, such as its path.

    Raises:
        ValueError: If the file is missing, no image, or a broken one.
    """
    if isinstance(file, Path):
        if not file.is_file():
            raise ValueError(f"{label}: no such file; check the name")
        if file.suffix.lower() == ".exr":
            return _exr_pixels(file, label)
    try:
        with Image.open(file) as image:
            info = image.info
            tagged = (
                "srgb" in info
                or "icc_profile" in info
                or abs(info.get("gamma", 0) - _GAMMA_OF_SRGB) < 1e-4
            )
            return _scaled(image, file)._replace(tagged_srgb=tagged)
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise ValueError(
            f"{label}: is no image that can be read, or a broken one; save it as PNG or EXR"
        ) from error


def write_raw_png(
    path: Path, texels: Float[np.ndarray, "height width 3"], *, bits: int = 16
) -> None:
    """Write values in [0, 1] as an RGB PNG, without any color tag.

    Written out because Pillow (13.0) writes RGB of 8 bits only. Each row is stored as
    differences from its left neighbours (filter 1), which compress better.

    Args:
        path: The file; it appears when it is complete, or not at all.
        texels: Rounded to the nearest level, clipped to [0, 1].
        bits: Of a channel, 8 or 16.

    Raises:
        ValueError: If the file cannot be written.
    """
    height, width, _ = texels.shape
    levels = np.rint(np.clip(texels, 0, 1).astype(np.float64) * (2**bits - 1))
    raw = np.ascontiguousarray(levels, f">u{bits // 8}").view(np.uint8).reshape(height, -1)
    step = 3 * bits // 8
    rows = np.concatenate([np.ones((height, 1), np.uint8), raw], axis=1)
    rows[:, 1 + step :] -= raw[:, :-step]
    chunks = {
        b"IHDR": struct.pack(">IIBBBBB", width, height, bits, 2, 0, 0, 0),
        b"IDAT": zlib.compress(rows.tobytes()),
        b"IEND": b"",
    }
    with atomic_path(path) as temporary, temporary.open("wb") as stream:
        stream.write(b"\x89PNG\r\n\x1a\n")
        for kind, data in chunks.items():
            checksum = struct.pack(">I", zlib.crc32(kind + data))
            stream.write(struct.pack(">I", len(data)) + kind + data + checksum)


def _exr_pixels(path: Path, label: str) -> Pixels:
    """Read the channels of the first layout that the file has, or its only channel."""
    channels = read_exr(path)
    only = tuple(channels) if len(channels) == 1 else ()
    for names in (*_EXR_LAYOUTS, only):
        if names and channels.keys() >= set(names):
            return Pixels(np.stack([channels[name] for name in names], axis=-1), FLOAT_BITS)
    raise ValueError(
        f"{label}: expected channels R, G, B or a single one, got {', '.join(channels)}"
    )


def _scaled(image: ImageFile.ImageFile, file: Path | BytesIO) -> Pixels:
    """Return the channels of an opened image without its alpha."""
    layout = image.tile[0].args if image.format == "PNG" else None
    size = image.size[::-1]
    if image.mode == "F":
        return Pixels(np.asarray(image, np.float32)[..., None], FLOAT_BITS)
    if image.mode.startswith("I"):
        return Pixels(np.asarray(image, np.float32)[..., None] / np.float32(65535), 16)
    if layout == "LA;16B":  # four bytes a pixel: high and low of gray, high and low of alpha
        pairs = _bytes_as(file, "RGBA").reshape(*size, 2, 2)
        return Pixels((256 * pairs[..., 0] + pairs[..., 1]) / np.float32(65535), 16)
    mode = {"1": "L", "L": "L", "LA": "LA"}.get(image.mode, "RGB")
    high = np.asarray(image.convert(mode), np.float32).reshape(*size, -1)
    if layout not in ("RGB;16B", "RGBA;16B"):
        return Pixels(high / np.float32(255))
    # Pillow keeps the first byte of each 16-bit sample; read as little-endian, the second.
    low = _bytes_as(file, layout[:-1] + "L")[..., :3]
    return Pixels((256 * high + low) / np.float32(65535), 16)


def _bytes_as(file: Path | BytesIO, layout: str) -> Float[np.ndarray, "height width channels"]:
    """Decode a PNG file's samples as if they were laid out otherwise."""
    with Image.open(file, formats=["PNG"]) as image:
        image.tile = [image.tile[0]._replace(args=layout)]
        return np.asarray(image, np.float32)
