"""Maps in image files: normals, heights and colors, checked before anything is computed.

What makes a map unusable is one ``ValueError`` line that begins with the file's name; what
is legal but odd is counted in its notes. Normal maps are raw and their green points up the
image (+Y); heights are raw; colors become linear. Row 0 is on top.
"""

from pathlib import Path

import jax
import numpy as np
from jaxtyping import Float

from tangentspace.normal_map import encode_normals, normals_from_heights
from tangentspace.texture import Wrap

from .images import srgb_to_linear, write_exr
from .normal_texels import LoadedMap, check_finite, is_gray, normal_map
from .texture_file import FLOAT_BITS, Pixels, read_pixels, write_raw_png

_normals_from_heights = jax.jit(normals_from_heights, static_argnames=("wrap_u", "wrap_v"))
_LUMINANCE = np.array([[0.2126], [0.7152], [0.0722]], np.float32)


def read_normal_map(path: Path | str, *, flip_green: bool = False) -> LoadedMap:
    """Read a tangent-space normal map from PNG (8 or 16 bits), EXR or another image file.

    Two-channel maps (gray with alpha, EXR of R and G, or RGB whose blue is 0 everywhere) get
    ``z = sqrt(1 - x^2 - y^2)``. EXR files may also hold the normals themselves. A map that
    is flat but for rounding to 8 or 16 bits becomes exactly flat; no other is changed.

    Args:
        path: The file.
        flip_green: The file's green points down the image (-Y, as DirectX has it).

    Returns:
        Raw RGB in [0, 1], green up (+Y).

    Raises:
        ValueError: If the file is missing, no image or gray, if texels are not finite or out
            of range, or if they are no raw normals: all zero, all below the surface, or
            saved as sRGB colors.
    """
    return normal_map(read_pixels(Path(path), str(path)), str(path), flip_green=flip_green)


def read_height_map(path: Path | str) -> LoadedMap:
    """Read a height map: one raw channel, or RGB whose channels are equal.

    Args:
        path: The file; integer heights are scaled to [0, 1], those of EXR kept.

    Returns:
        Heights, one channel.

    Raises:
        ValueError: If the file is missing, no image or in color, or texels are not finite.
    """
    return height_map(read_pixels(Path(path), str(path)), str(path))


def read_color_map(path: Path | str) -> LoadedMap:
    """Read colors: as they are from EXR, decoded from sRGB from all other files.

    Args:
        path: The file; gray counts for all three channels, alpha is dropped.

    Returns:
        Linear RGB.

    Raises:
        ValueError: If the file is missing, no image or of two float channels, or texels are
            not finite or negative.
    """
    return color_map(read_pixels(Path(path), str(path)), str(path))


def height_map(pixels: Pixels, label: str) -> LoadedMap:
    """Check what is to be a height map; see ``read_height_map``.

    Args:
        pixels: As the file stores them.
        label: What messages call the map, such as its path.
    """
    check_finite(pixels, label)
    texels = pixels.texels
    if texels.shape[-1] == 3 and not is_gray(texels):
        raise ValueError(f"{label}: expected one channel of heights, got colors; save it as gray")
    notes = (f"{label}: all heights are equal",) if np.ptp(texels[..., 0]) == 0 else ()
    return LoadedMap(texels[..., :1], notes)


def bump_map(pixels: Pixels, label: str, *, wrap_u: Wrap, wrap_v: Wrap) -> LoadedMap:
    """Turn a map of heights, in widths of its texels, into a normal map.

    Args:
        pixels: As the file stores them; colors count by their brightness.
        label: What messages call the map, such as its path.
        wrap_u: How the image continues to the left and to the right.
        wrap_v: How it continues above and below.

    Returns:
        Raw RGB in [0, 1], green up (+Y).
    """
    check_finite(pixels, label)
    texels = pixels.texels
    heights = texels @ _LUMINANCE if texels.shape[-1] == 3 else texels
    normals = _normals_from_heights(
        heights[..., 0], scale=1 / heights.shape[1], wrap_u=wrap_u, wrap_v=wrap_v
    )
    notes = (f"{label}: a bump map, taken as heights in widths of its texels",)
    return LoadedMap(np.asarray(encode_normals(normals), np.float32), notes)


def color_map(pixels: Pixels, label: str) -> LoadedMap:
    """Check what is to be colors; see ``read_color_map``.

    Args:
        pixels: As the file stores them.
        label: What messages call the map, such as its path.
    """
    check_finite(pixels, label)
    texels, is_float = pixels.texels, pixels.bits == FLOAT_BITS
    if is_float and texels.shape[-1] == 2:
        raise ValueError(f"{label}: expected colors R, G, B, got two channels; save all three")
    if texels.shape[-1] < 3:
        texels = np.repeat(texels[..., :1], 3, axis=-1)
    negative = (texels < 0).any(axis=-1)
    if negative.any():
        raise ValueError(
            f"{label}: {negative.sum()} of {negative.size} texels are negative, expected "
            "colors; clip them at 0"
        )
    return LoadedMap(texels if is_float else srgb_to_linear(texels).astype(np.float32))


def write_normal_map(
    path: Path | str, texels: Float[np.ndarray, "height width 3"], *, bits: int = 16
) -> None:
    """Write a normal map's raw texels: EXR (32-bit float) or untagged RGB PNG, by suffix.

    Args:
        path: The file, ending in ``.exr`` or ``.png``; it appears when complete.
        texels: Raw values in [0, 1], green +Y, row 0 on top.
        bits: Of a channel in PNG, 8 or 16. No such file has an exactly flat texel: with 8
            bits the nearest is tilted by 0.32 degrees, with 16 by 0.0012.

    Raises:
        ValueError: If the suffix is another, texels are no such values, or the file cannot
            be written.
    """
    path, texels = Path(path), np.asarray(texels)
    if texels.ndim != 3 or texels.shape[-1] != 3 or texels.size == 0:
        raise ValueError(f"{path}: expected texels of shape (height, width, 3), got {texels.shape}")
    wrong = ~((texels >= 0) & (texels <= 1)).all(axis=-1)
    if wrong.any():
        raise ValueError(
            f"{path}: expected raw texels in [0, 1], {wrong.sum()} of {wrong.size} are not; "
            "encode the normals first"
        )
    if bits not in (8, 16):
        raise ValueError(f"{path}: expected `bits` of 8 or 16, got {bits}")
    if path.suffix.lower() == ".exr":
        write_exr(path, dict(zip("RGB", np.moveaxis(texels, -1, 0), strict=True)))
    elif path.suffix.lower() == ".png":
        write_raw_png(path, texels, bits=bits)
    else:
        raise ValueError(f"{path}: expected a name ending in .exr or .png")
