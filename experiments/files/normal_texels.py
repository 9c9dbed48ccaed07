"""From an image's numbers to a normal map's raw texels, checked.

A texel ``c`` stands for the vector ``2 c - 1``, whose green points up the image (+Y), and
nothing is decoded from sRGB, whatever the file says of itself. Whether somebody did encode
it is seen in the texels: normals have length 1. What makes a map unusable is one
``ValueError`` line that begins with its name; what is legal but odd is counted in notes.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from .images import srgb_to_linear
from .texture_file import FLOAT_BITS, Pixels

_OFF_UNIT = 0.05  # mean distance from length 1 up to which vectors pass for normals
_ROUNDING = 0.01  # of numbers from 0 to 1


class LoadedMap(NamedTuple):
    """The texels of a map.

    Attributes:
        texels: float32, row 0 on top.
        notes: What a reader should know, one line each.
    """

    texels: Float[np.ndarray, "height width channels"]
    notes: tuple[str, ...] = ()


def normal_map(pixels: Pixels, label: str, *, flip_green: bool = False) -> LoadedMap:
    """Check what is to be a tangent-space normal map; see ``map_files.read_normal_map``.

    Args:
        pixels: As the file stores them.
        label: What messages call the map, such as its path.
        flip_green: The file's green points down the image (-Y).

    Returns:
        Raw RGB in [0, 1], green up.

    Raises:
        ValueError: If it cannot be one.
    """
    check_finite(pixels, label)
    texels, notes = _encoded(pixels, label)
    texels, more = _three_channels(texels, label)
    if flip_green:
        texels = np.stack([texels[..., 0], 1 - texels[..., 1], texels[..., 2]], axis=-1)
    notes += more + _check_normals(texels, pixels.tagged_srgb, label)
    flat = np.array([0.5, 0.5, 1], np.float32)
    if pixels.bits < FLOAT_BITS and np.abs(texels - flat).max() < 0.75 / (2**pixels.bits - 1):
        texels = np.broadcast_to(flat, texels.shape).copy()
        notes += (f"{label}: is flat; the tilt by rounding to {pixels.bits} bits is taken out",)
    return LoadedMap(texels, notes)


def check_finite(pixels: Pixels, label: str) -> None:
    """Refuse texels that are NaN or infinite."""
    broken = ~np.isfinite(pixels.texels).all(axis=-1)
    if broken.any():
        raise ValueError(
            f"{label}: {broken.sum()} of {broken.size} texels are NaN or infinite; repair the image"
        )


def is_gray(texels: Float[np.ndarray, "height width channels"]) -> bool:
    """Say whether an image has no color; gray with an alpha that varies may be x and y."""
    if texels.shape[-1] == 2:
        return bool((texels[..., 1] == 1).all())
    return bool((texels == texels[..., :1]).all())


def is_bluish(texels: Float[np.ndarray, "height width channels"]) -> bool:
    """Say whether an image looks like a normal map: in the mean bluer than red or green."""
    means = texels.mean(axis=(0, 1))
    return len(means) == 3 and bool(means[2] > 0.1 + max(means[:2]))


def _encoded(
    pixels: Pixels, label: str
) -> tuple[Float[np.ndarray, "height width channels"], tuple[str, ...]]:
    """Return raw texels in [0, 1], also where a file holds the normals themselves."""
    texels = pixels.texels
    if not texels.any():
        raise ValueError(f"{label}: all texels are zero, no normal map; bake or save it again")
    if pixels.bits < FLOAT_BITS:
        return texels, ()
    decoded, notes = bool((texels < -_ROUNDING).any()), ()
    if not decoded and texels.shape[-1] == 3:  # flat normals have no negative number either
        decoded = _off_unit(texels) < _ROUNDING and _off_unit(2 * texels - 1) > 2 * _OFF_UNIT
    if decoded:
        texels = 0.5 + 0.5 * texels
        notes = (f"{label}: holds normals in [-1, 1], encoded to [0, 1]",)
    outside = ((texels < -_ROUNDING) | (texels > 1 + _ROUNDING)).any(axis=-1)
    if outside.any():
        low, high = pixels.texels.min(), pixels.texels.max()
        raise ValueError(
            f"{label}: {outside.sum()} texels out of range, expected a normal map in [0, 1] or "
            f"unit normals, got values from {low:g} to {high:g}; save it as one of them"
        )
    return texels, notes


def _three_channels(
    texels: Float[np.ndarray, "height width channels"], label: str
) -> tuple[Float[np.ndarray, "height width 3"], tuple[str, ...]]:
    """Return RGB; where there is no z, rebuild it."""
    if is_gray(texels):
        raise ValueError(
            f"{label}: is gray, expected a normal map of three channels, or two (x and y); "
            "make one of a height map first"
        )
    xy = texels[..., :2]
    without_blue = texels.shape[-1] == 3 and not texels[..., 2].any() and np.ptp(xy) > 0
    if texels.shape[-1] == 3 and not without_blue:
        return texels, ()
    squared = np.sum((2 * xy - 1) ** 2, axis=-1, keepdims=True)
    z = np.sqrt(np.maximum(1 - squared, 0))
    notes = (f"{label}: has two channels, z rebuilt",)
    longer = squared > 1 + 2 * _ROUNDING
    if longer.any():
        notes += (f"{label}: {longer.sum()} of {z.size} texels have x, y longer than 1: z is 0",)
    return np.concatenate([xy, 0.5 + 0.5 * z], axis=-1), notes


def _check_normals(
    texels: Float[np.ndarray, "height width 3"], tagged_srgb: bool, label: str
) -> tuple[str, ...]:
    """Refuse texels that cannot be normals above the surface; return notes on odd ones."""
    black = ~texels.any(axis=-1)
    normals = 2 * texels[~black] - 1
    below = normals[:, 2] < -_ROUNDING
    if below.all():
        raise ValueError(
            f"{label}: all texels point below the surface; save a tangent-space normal map "
            "(blue 0.5 to 1)"
        )
    off = _off_unit(normals)
    if off > _OFF_UNIT and _off_unit(_as_colors(texels[~black])) < min(_OFF_UNIT, off / 2):
        raise ValueError(
            f"{label}: was saved as sRGB colors (its vectors have length 1 only after decoding "
            "from sRGB); save it raw (non-color, linear)"
        )
    notes = (f"{label}: its sRGB tag is ignored, the texels are raw",) if tagged_srgb else ()
    odd = np.abs(_lengths(normals) - 1) > 2 * _OFF_UNIT
    for where, what in (
        (black, "are zero, as if never written"),
        (odd, "are not of length 1, as if blurred"),
        (below, "point below the surface"),
    ):
        if where.any():
            notes += (f"{label}: {where.sum()} of {black.size} texels {what}; used as they are",)
    return notes


def _as_colors(texels: Float[np.ndarray, "texels 3"]) -> Float[np.ndarray, "texels 3"]:
    """Return the vectors that texels stand for if they were saved as sRGB colors."""
    return 2 * srgb_to_linear(np.clip(texels, 0, 1)) - 1


def _off_unit(vectors: Float[np.ndarray, "... 3"]) -> float:
    """Return how far lengths are from 1 in the mean."""
    return float(np.abs(_lengths(vectors) - 1).mean())


def _lengths(vectors: Float[np.ndarray, "... 3"]) -> Float[np.ndarray, "..."]:
    return np.sqrt(np.einsum("...i,...i", vectors, vectors))
