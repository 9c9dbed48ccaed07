"""Texture lookup: nearest, bilinear and trilinear, with repeated, clamped or mirrored borders.

Texels are (height, width, channels) with row 0 on top; uvs have v upwards and (0, 0) at the
image's lower left corner, so the centre of row r and column c lies at
``((c + 1/2) / width, 1 - (r + 1/2) / height)``. Everything is as OpenGL defines it, for
raw values: a lookup blends texels and neither decodes nor normalizes them.

A coordinate of any size has a defined, finite answer; one that is not a number counts as a
huge one. A texel that is not finite shows wherever a lookup touches it, and nowhere else.

References:
    The Khronos Group, "OpenGL 4.6 Core Profile", section 8.14, "Texture Minification".
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, Float, Int

Sizes = int | Int[Array, "..."]
Wrap = Callable[[Int[Array, "..."], Sizes], Int[Array, "..."]]
Texels = Float[Array | np.ndarray, "height width channels"]
Uvs = Float[Array | np.ndarray, "... 2"]

_FARTHEST = 2.0**30  # places beyond count as this; an integer holds it


def repeat(index: Int[Array, "..."], size: Sizes) -> Int[Array, "..."]:
    """Wrap texel indices so that the image repeats."""
    return index % size


def clamp(index: Int[Array, "..."], size: Sizes) -> Int[Array, "..."]:
    """Wrap texel indices so that the texels at the image's edge extend beyond it."""
    return jnp.clip(index, 0, size - 1)


def mirror(index: Int[Array, "..."], size: Sizes) -> Int[Array, "..."]:
    """Wrap texel indices so that every other repetition of the image is mirrored."""
    period = index % (2 * size)
    return jnp.minimum(period, 2 * size - 1 - period)


class Texture(eqx.Module):
    """An image to look up, and how it continues beyond its borders.

    Attributes:
        texels: Raw values, row 0 on top.
        wrap_u: ``repeat``, ``clamp`` or ``mirror`` to the left and to the right.
        wrap_v: The same above and below.
    """

    texels: Texels
    wrap_u: Wrap = eqx.field(static=True, default=repeat)
    wrap_v: Wrap = eqx.field(static=True, default=repeat)


class Taps(NamedTuple):
    """The texels that each lookup blends; kept, they serve while only texels change.

    Attributes:
        indices: Index into the image's texels, row by row.
        weights: Weight of each; they are not negative and sum to 1. A lookup takes the first
            as what the others leave of 1.
    """

    indices: Int[Array, "... taps"]
    weights: Float[Array, "... taps"]


def sample_nearest(
    texels: Texels, uvs: Uvs, *, wrap_u: Wrap = repeat, wrap_v: Wrap = repeat
) -> Float[Array, "... channels"]:
    """Return the texel whose square holds each point.

    Args:
        texels: The image.
        uvs: Where to look, v upwards; a point between two texels belongs to the right and to
            the upper one.
        wrap_u: How the image continues to the left and to the right.
        wrap_v: How it continues above and below.

    Raises:
        ValueError: If an array has the wrong shape or no floating-point type.

    Differentiability:
        Linear in ``texels``; zero in ``uvs``.
    """
    size = image_size(texels, "sample_nearest")
    u, v = split_uvs(uvs, "sample_nearest")
    column = wrap_u(bounded(jnp.floor(u * size[1])).astype(jnp.int32), size[1])
    height = wrap_v(bounded(jnp.floor(v * size[0])).astype(jnp.int32), size[0])
    index = (size[0] - 1 - height) * size[1] + column
    return _flat(texels).at[index].get(mode="promise_in_bounds")


def sample_bilinear(
    texels: Texels, uvs: Uvs, *, wrap_u: Wrap = repeat, wrap_v: Wrap = repeat
) -> Float[Array, "... channels"]:
    """Blend the 2x2 texels whose centres surround each point.

    Args:
        texels: The image.
        uvs: Where to look, v upwards.
        wrap_u: How the image continues to the left and to the right.
        wrap_v: How it continues above and below.

    Returns:
        Values of the type of ``texels``.

    Raises:
        ValueError: If an array has the wrong shape or no floating-point type.

    Differentiability:
        Linear in ``texels``. Continuous in ``uvs`` and smooth between texel centres; on the
        lines through them the derivative is that of the right and of the upper side.
    """
    size = image_size(texels, "sample_bilinear")
    u, v = split_uvs(uvs, "sample_bilinear")
    return gather_flat(_flat(texels), cell_taps((u, v), size, wrap_u=wrap_u, wrap_v=wrap_v))


def bilinear_taps(
    size: tuple[int, int],
    uvs: Uvs,
    *,
    wrap_u: Wrap = repeat,
    wrap_v: Wrap = repeat,
    dtype: DTypeLike | None = None,
) -> Taps:
    """Prepare bilinear lookups, for ``gather_taps``.

    Args:
        size: Height and width of the image, in texels.
        uvs: Where to look, v upwards.
        wrap_u: How the image continues to the left and to the right.
        wrap_v: How it continues above and below.
        dtype: Of the weights; by default that of ``uvs``.

    Returns:
        Four texels and their weights for each point.

    Raises:
        ValueError: If a side of the image has no texel, or ``uvs`` has the wrong shape or no
            floating-point type.

    Differentiability:
        The weights as ``sample_bilinear``; the indices are integers.
    """
    if len(size) != 2 or min(size) < 1:
        raise ValueError(f"bilinear_taps: expected `size` as (height, width) >= 1, got {size}")
    u, v = split_uvs(uvs, "bilinear_taps")
    taps = cell_taps((u, v), size, wrap_u=wrap_u, wrap_v=wrap_v)
    return taps if dtype is None else taps._replace(weights=taps.weights.astype(dtype))


def gather_taps(texels: Texels, taps: Taps) -> Float[Array, "... channels"]:
    """Blend the texels that were prepared for an image of this size.

    Args:
        texels: The image.
        taps: From ``bilinear_taps``.

    Returns:
        Values of the type of ``texels``.

    Raises:
        ValueError: If ``texels`` has the wrong shape or no floating-point type.

    Differentiability:
        Linear in ``texels`` and in the weights, as long as these sum to 1.
    """
    image_size(texels, "gather_taps")
    return gather_flat(_flat(texels), taps)


def gather_flat(
    texels: Float[Array | np.ndarray, "texels channels"], taps: Taps
) -> Float[Array, "... channels"]:
    """Blend rows of texels, relative to the first one: where all are equal, exactly that.

    One gather, so that its transpose is one scatter: on a CPU the derivative takes half the
    time of four. The sum is written out: a reduction over a short axis is slow.
    """
    texels = jnp.asarray(texels)
    rows = texels.at[taps.indices].get(mode="promise_in_bounds")
    weights = taps.weights[..., None].astype(texels.dtype)
    first = rows[..., 0, :]
    others = range(1, rows.shape[-2])
    return sum((weights[..., k, :] * (rows[..., k, :] - first) for k in others), first)


def cell_taps(
    coordinates: tuple[Float[Array, "..."], Float[Array, "..."]],
    size: tuple[Sizes, Sizes],
    *,
    wrap_u: Wrap,
    wrap_v: Wrap,
    first: int | Int[Array, "..."] = 0,
) -> Taps:
    """Return the four texels round each point of an image, with their bilinear weights.

    Args:
        coordinates: u and v.
        size: Height and width of the image; may differ from point to point.
        wrap_u: How the image continues to the left and to the right.
        wrap_v: How it continues above and below.
        first: Index of the image's first texel.
    """
    height, width = size
    left, right_weight = _cell(coordinates[0], width)
    lower, upper_weight = _cell(coordinates[1], height)
    columns = [wrap_u(left + step, width) for step in (0, 1)]
    rows = [first + (height - 1 - wrap_v(lower + step, height)) * width for step in (0, 1)]
    across, up = (1 - right_weight, right_weight), (1 - upper_weight, upper_weight)
    return Taps(
        jnp.stack([row + column for row in rows for column in columns], axis=-1),
        jnp.stack([vertical * horizontal for vertical in up for horizontal in across], axis=-1),
    )


def image_size(texels: Texels, name: str) -> tuple[int, int]:
    """Return height and width of an image; refuse what is none."""
    shape = jnp.shape(texels)
    if len(shape) != 3 or 0 in shape:
        expected = f"expected `texels` of shape (height, width, channels), each > 0, got {shape}"
        raise ValueError(f"{name}: {expected}")
    _check_floating(texels, "texels", name)
    return shape[0], shape[1]


def split_uvs(uvs: Uvs, name: str) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    """Return u and v as arrays of their own."""
    if not jnp.shape(uvs) or jnp.shape(uvs)[-1] != 2:
        raise ValueError(f"{name}: expected `uvs` of shape (..., 2), got {jnp.shape(uvs)}")
    _check_floating(uvs, "uvs", name)
    uvs = jnp.asarray(uvs)
    return uvs[..., 0], uvs[..., 1]


def _check_floating(array: Array | np.ndarray, argument: str, name: str) -> None:
    dtype = jnp.result_type(array)
    if not jnp.issubdtype(dtype, jnp.floating):
        raise ValueError(f"{name}: expected `{argument}` of floating-point type, got {dtype}")


def _cell(
    coordinate: Float[Array, "..."], size: Sizes
) -> tuple[Int[Array, "..."], Float[Array, "..."]]:
    """Return the texel whose centre lies at or before a point, and how far on the point lies."""
    place = bounded(coordinate * jnp.asarray(size, coordinate.dtype) - 0.5)
    before = jnp.floor(place)
    return before.astype(jnp.int32), place - before


def bounded(place: Float[Array, "..."]) -> Float[Array, "..."]:
    """Limit what no integer holds, NaN included; the derivative there is zero."""
    place = jnp.where(place < _FARTHEST, place, _FARTHEST)
    return jnp.where(place > -_FARTHEST, place, -_FARTHEST)


def _flat(texels: Texels) -> Float[Array, "texels channels"]:
    texels = jnp.asarray(texels)
    return texels.reshape(-1, texels.shape[-1])
