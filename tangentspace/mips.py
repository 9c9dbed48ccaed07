"""Mips: an image at ever half the size, for lookups whose pixels cover many texels.

Sizes are OpenGL's: each level has half the texels of the one before on each side, rounded
down, until one texel is left. A texel is the exact mean over the area that it covers of the
level before, also where sizes are odd, so every level has the mean of the image.

All levels lie in one array, so that each pixel of a lookup can choose its own.

References:
    The Khronos Group, "OpenGL 4.6 Core Profile", section 8.14.1, "Scale Factor and Level of
    Detail". S. Guthe and P. Heckbert, "Non-Power-of-Two Mipmap Creation", NVIDIA, 2005.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .texture import (
    Texels,
    Uvs,
    Wrap,
    bounded,
    cell_taps,
    gather_flat,
    image_size,
    repeat,
    split_uvs,
)


class Mips(eqx.Module):
    """An image and its smaller versions.

    Attributes:
        texels: Those of all levels, one level after the other, each row by row.
        size: Height and width of the image.
    """

    texels: Float[Array | np.ndarray, "texels channels"]
    size: tuple[int, int] = eqx.field(static=True)

    @property
    def levels(self) -> tuple[Float[Array, "height width channels"], ...]:
        """The images, from the full size down to one texel."""
        sizes = _level_sizes(self.size)
        ends = np.cumsum([height * width for height, width in sizes])
        parts = jnp.split(self.texels, [int(end) for end in ends[:-1]])
        return tuple(part.reshape(*s, -1) for part, s in zip(parts, sizes, strict=True))


def build_mips(texels: Texels) -> Mips:
    """Average an image down to one texel, level by level.

    Args:
        texels: The image, of any size. Values are averaged as they are: sRGB colors should be
            made linear before, normals decoded or not, as decoding is linear.

    Raises:
        ValueError: If ``texels`` has the wrong shape or no floating-point type.

    Differentiability:
        Linear in ``texels``.
    """
    size = image_size(texels, "build_mips")
    levels = [jnp.asarray(texels)]
    while levels[-1].shape[:2] != (1, 1):
        halved = _halved(levels[-1])
        levels.append(jnp.swapaxes(_halved(jnp.swapaxes(halved, 0, 1)), 0, 1))
    flat = [level.reshape(-1, level.shape[-1]) for level in levels]
    return Mips(jnp.concatenate(flat), size)


def texel_footprint(uv_dx: Uvs, uv_dy: Uvs, size: tuple[int, int]) -> Float[Array, "..."]:
    """Return the length of a pixel's longer footprint, in texels of the full size.

    Args:
        uv_dx: Change of the uvs from a pixel to its right neighbour.
        uv_dy: Change of the uvs from a pixel to its lower neighbour.
        size: Height and width of the image.

    Raises:
        ValueError: If an array has the wrong shape or no floating-point type.

    Differentiability:
        Smooth but where both footprints are equally long; zero at a footprint of zero.
    """
    if jnp.shape(uv_dx) != jnp.shape(uv_dy):
        shapes = f"{jnp.shape(uv_dx)} and {jnp.shape(uv_dy)}"
        raise ValueError(f"texel_footprint: expected `uv_dx`, `uv_dy` of one shape, got {shapes}")
    squares = []
    for step in (uv_dx, uv_dy):
        across, up = split_uvs(step, "texel_footprint")
        squares.append(bounded(across * size[1]) ** 2 + bounded(up * size[0]) ** 2)
    squared = jnp.maximum(*squares)
    tiny = squared <= jnp.finfo(squared.dtype).tiny
    return jnp.where(tiny, 0.0, jnp.sqrt(jnp.where(tiny, 1.0, squared)))


def mip_level(uv_dx: Uvs, uv_dy: Uvs, size: tuple[int, int]) -> Float[Array, "..."]:
    """Return the level whose texels are as large as a pixel's longer footprint is long.

    Args:
        uv_dx: Change of the uvs from a pixel to its right neighbour.
        uv_dy: Change of the uvs from a pixel to its lower neighbour.
        size: Height and width of the image.

    Returns:
        ``log2`` of the footprint in texels: from 0, where pixels are smaller than texels, up
        to the last level of the image.

    Raises:
        ValueError: If an array has the wrong shape or no floating-point type.

    Differentiability:
        As ``texel_footprint`` between those ends; at and beyond them the derivative is zero.
    """
    length = texel_footprint(uv_dx, uv_dy, size)
    longest = 2.0 ** (len(_level_sizes(size)) - 1)
    length = jnp.where(length > 1, jnp.where(length < longest, length, longest), 1.0)
    return jnp.log2(length)


def sample_trilinear(
    mips: Mips,
    uvs: Uvs,
    uv_dx: Uvs,
    uv_dy: Uvs,
    *,
    wrap_u: Wrap = repeat,
    wrap_v: Wrap = repeat,
) -> Float[Array, "... channels"]:
    """Blend bilinear lookups in the two levels next to the footprint's size.

    Args:
        mips: The image and its smaller versions.
        uvs: Where to look, v upwards.
        uv_dx: Change of the uvs from a pixel to its right neighbour, like ``uvs``.
        uv_dy: Change of the uvs from a pixel to its lower neighbour, like ``uvs``.
        wrap_u: How the image continues to the left and to the right.
        wrap_v: How it continues above and below.

    Returns:
        Values of the type of the texels. Where a pixel covers no more than a texel they are
        the bilinear ones.

    Raises:
        ValueError: If an array has the wrong shape or no floating-point type.

    Differentiability:
        Linear in the texels. In ``uvs`` as ``sample_bilinear``, in ``uv_dx`` and ``uv_dy`` as
        ``mip_level``; continuous everywhere.

    References:
        L. Williams, "Pyramidal Parametrics", SIGGRAPH 1983.
    """
    coordinates = split_uvs(uvs, "sample_trilinear")
    if jnp.shape(uv_dx) != jnp.shape(uvs):
        shapes = f"{jnp.shape(uvs)}, got {jnp.shape(uv_dx)}"
        raise ValueError(f"sample_trilinear: expected `uv_dx` of the shape of `uvs`, {shapes}")
    level = mip_level(uv_dx, uv_dy, mips.size)
    sizes = _level_sizes(mips.size)
    counts = [height * width for height, width in sizes]
    firsts = jnp.asarray(np.cumsum([0, *counts[:-1]]), jnp.int32)
    finer = jnp.floor(level).astype(jnp.int32)
    share = level - finer.astype(level.dtype)
    values = []
    for index in (finer, jnp.minimum(finer + 1, len(sizes) - 1)):
        height, width = (jnp.maximum(jnp.int32(side) >> index, 1) for side in mips.size)
        first = firsts.at[index].get(mode="promise_in_bounds")
        taps = cell_taps(coordinates, (height, width), wrap_u=wrap_u, wrap_v=wrap_v, first=first)
        values.append(gather_flat(mips.texels, taps))
    return values[0] + share[..., None].astype(values[0].dtype) * (values[1] - values[0])


def _level_sizes(size: tuple[int, int]) -> list[tuple[int, int]]:
    """Return height and width of every level."""
    height, width = size
    return [
        (max(height >> level, 1), max(width >> level, 1))
        for level in range(max(height, width).bit_length())
    ]


def _halved(texels: Float[Array, "long across channels"]) -> Float[Array, "short across channels"]:
    """Average over the first axis to half its length, rounded down; one texel stays."""
    length = len(texels)
    if length == 1:
        return texels
    half = length // 2
    middle = texels[1 : 2 * half : 2]
    before, after = texels[0 : 2 * half : 2], texels[2 : 2 * half + 1 : 2]
    if length % 2 == 0:
        return 0.5 * (before + middle)
    # A texel spans 2 + 1 / half of the old ones: a whole one, and parts of its neighbours.
    index = jnp.arange(half, dtype=texels.dtype)[:, None, None]
    return middle + ((half - index) * (before - middle) + (index + 1) * (after - middle)) / length
