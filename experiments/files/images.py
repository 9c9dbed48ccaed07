"""Images in and out: EXR channels as they are, PNG encoded to sRGB; row 0 is the top row.

Images in memory hold linear radiance; only PNG files are sRGB. A file appears under its
name when it is complete, or not at all.
"""

import contextlib
import os
import secrets
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
import OpenEXR
from jaxtyping import Array, Float, Num
from PIL import Image

Channels = Mapping[str, Num[Array | np.ndarray, "height width"]]
_EXR_MAGIC = b"\x76\x2f\x31\x01"


def linear_to_srgb(linear: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    """Encode linear values in [0, 1] as sRGB in [0, 1] (IEC 61966-2-1)."""
    curve = 1.055 * np.maximum(linear, 0.0031308) ** (1 / 2.4) - 0.055
    return np.where(linear <= 0.0031308, 12.92 * linear, curve)


def srgb_to_linear(srgb: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    """Decode sRGB values in [0, 1] to linear ones in [0, 1]."""
    curve = ((np.maximum(srgb, 0.04045) + 0.055) / 1.055) ** 2.4
    return np.where(srgb <= 0.04045, srgb / 12.92, curve)


@contextlib.contextmanager
def atomic_path(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield a temporary path beside ``path``, and rename it to ``path`` when all went well.

    The temporary name has the suffix of ``path``. If the body raises anything, the
    temporary file is removed and what stood under ``path`` stays as it was.

    Args:
        path: The file to write; its folder must exist.

    Raises:
        ValueError: If the folder is missing, or the file cannot be written there.
    """
    path = Path(path)
    if not path.parent.is_dir():
        raise ValueError(f"{path}: there is no folder {path.parent}; make it first")
    temporary = path.with_name(f".{path.stem}-{secrets.token_hex(4)}{path.suffix}")
    try:
        temporary.touch(exist_ok=False)
        yield temporary
        temporary.replace(path)
    except OSError as error:
        reason = error.strerror or error
        raise ValueError(f"{path}: cannot be written ({reason}); choose another place") from error
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)


def write_exr(path: str | os.PathLike[str], channels: Channels) -> None:
    """Write channels of equal size to an EXR file, 32-bit float, ZIP-compressed.

    Args:
        path: Name of the file, ending in ``.exr``.
        channels: Arrays by channel name, for example ``R``, ``G``, ``B``, ``depth.Z``,
            ``normal.X``, ``visibility.V``; row 0 on top.

    Raises:
        ValueError: If there is no channel, a channel is empty or not two-dimensional, sizes
            differ, or the file cannot be written.
    """
    path = _with_suffix(path, ".exr")
    pixels = {name: np.ascontiguousarray(a, np.float32) for name, a in channels.items()}
    shapes = {name: a.shape for name, a in pixels.items()}
    if len(set(shapes.values())) != 1:
        raise ValueError(f"{path}: expected channels of one size (height, width), got {shapes}")
    shape = next(iter(shapes.values()))
    if len(shape) != 2 or 0 in shape:
        raise ValueError(f"{path}: expected channels of size (height, width) > 0, got {shape}")
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with atomic_path(path) as temporary:
        try:
            OpenEXR.File(header, pixels).write(str(temporary))
        except RuntimeError as error:
            raise ValueError(f"{path}: cannot be written as EXR ({error})") from error


def read_exr(path: str | os.PathLike[str]) -> dict[str, Float[np.ndarray, "height width"]]:
    """Read every channel of an EXR file's first part (its data window), as float32.

    Args:
        path: Name of the file, ending in ``.exr``; half, float and integer channels are read.

    Returns:
        Arrays by channel name; row 0 on top.

    Raises:
        ValueError: If the file is missing, broken, or no flat EXR image.
    """
    path = _existing(_with_suffix(path, ".exr"))
    try:
        with path.open("rb") as stream:
            if stream.read(4) != _EXR_MAGIC:
                raise ValueError("it does not start as one")
        with OpenEXR.File(str(path), separate_channels=True) as file:
            channels = {name: np.array(c.pixels) for name, c in file.channels().items()}
    except (OSError, RuntimeError, ValueError) as error:
        raise ValueError(f"{path}: not an EXR image, or a broken one ({error})") from error
    shapes = {name: a.shape for name, a in channels.items()}
    if len(set(shapes.values())) != 1 or any(a.dtype == object for a in channels.values()):
        raise ValueError(f"{path}: expected a flat image, channels of one size, got {shapes}")
    return {name: a.astype(np.float32) for name, a in channels.items()}


def write_png(
    path: str | os.PathLike[str],
    image: Num[Array | np.ndarray, "height width 3"] | Num[Array | np.ndarray, "height width"],
) -> None:
    """Write an image as an 8-bit sRGB PNG, clipped to [0, 1]; not-a-number becomes black.

    Args:
        path: Name of the file, ending in ``.png``.
        image: Linear RGB or gray; row 0 on top.

    Raises:
        ValueError: If the image has another shape or no pixel, or cannot be written.
    """
    path = _with_suffix(path, ".png")
    linear = np.nan_to_num(np.asarray(image, np.float32), posinf=1.0)
    if linear.ndim not in (2, 3) or linear.shape[2:] not in ((), (3,)) or linear.size == 0:
        raise ValueError(
            f"{path}: expected an image (height, width, 3) or (height, width), got {linear.shape}"
        )
    encoded = np.rint(255 * linear_to_srgb(np.clip(linear, 0, 1))).astype(np.uint8)
    with atomic_path(path) as temporary:
        Image.fromarray(encoded).save(temporary)


def read_image(path: str | os.PathLike[str]) -> Float[np.ndarray, "height width 3"]:
    """Read a picture as linear RGB: the R, G, B of an EXR file, or a PNG decoded from sRGB.

    Args:
        path: Name of the file, ending in ``.exr`` or ``.png``. PNG files may be gray, RGB or
            with a palette, 8 or 16 bits deep; alpha is ignored.

    Returns:
        Linear RGB, float32, row 0 on top; from PNG in [0, 1].

    Raises:
        ValueError: If the file is missing, not an image, or has no R, G and B.
    """
    path = _with_suffix(path, ".exr", ".png")
    if path.suffix.lower() == ".png":
        return srgb_to_linear(_read_png(_existing(path)))
    channels = read_exr(path)
    if not {"R", "G", "B"} <= channels.keys():
        raise ValueError(f"{path}: expected channels R, G, B, got {', '.join(channels)}")
    return np.stack([channels[name] for name in "RGB"], axis=-1)


def _read_png(path: Path) -> Float[np.ndarray, "height width 3"]:
    """Return the encoded values of a PNG file in [0, 1], float32."""
    try:
        with Image.open(path, formats=["PNG"]) as image:
            layout = image.tile[0].args
            if image.mode == "I;16":
                gray = np.asarray(image, np.float32)[..., None] / np.float32(65535)
                return np.broadcast_to(gray, (*gray.shape[:2], 3))
            high = np.asarray(image.convert("RGB"), np.float32)
        if layout not in ("RGB;16B", "RGBA;16B"):
            return high / np.float32(255)
        # Pillow keeps the first byte of each 16-bit sample; read as little-endian, the second.
        with Image.open(path, formats=["PNG"]) as image:
            image.tile = [image.tile[0]._replace(args=layout[:-1] + "L")]
            low = np.asarray(image.convert("RGB"), np.float32)
        return (256 * high + low) / np.float32(65535)
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise ValueError(f"{path}: not a PNG image, or a broken one ({error})") from error


def _with_suffix(path: str | os.PathLike[str], *suffixes: str) -> Path:
    """Return the path, or raise if it ends otherwise."""
    path = Path(path)
    if path.suffix.lower() not in suffixes:
        raise ValueError(f"{path}: expected a name ending in {' or '.join(suffixes)}")
    return path


def _existing(path: Path) -> Path:
    """Return the path, or raise if no file is there."""
    if not path.is_file():
        raise ValueError(f"{path}: no such file; check the name")
    return path
