"""What covers a surface: its color, its textures and maps, and how it mirrors.

What a material leaves at ``None`` costs nothing: that is decided while tracing, and nothing
is compiled for it.
"""

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from .mips import Mips, build_mips, sample_trilinear
from .texture import Texture, Uvs, Wrap, repeat, sample_bilinear

Number = Float[Array | np.ndarray, ""] | float


class MippedTexture(eqx.Module):
    """A texture with its smaller versions, for surfaces whose pixels cover many texels.

    Attributes:
        mips: The image and its smaller versions.
        wrap_u: ``repeat``, ``clamp`` or ``mirror`` to the left and to the right.
        wrap_v: The same above and below.
    """

    mips: Mips
    wrap_u: Wrap = eqx.field(static=True, default=repeat)
    wrap_v: Wrap = eqx.field(static=True, default=repeat)


class Material(eqx.Module):
    """How a part of a mesh looks; None for what it does not have.

    Attributes:
        base_color: Linear RGB, multiplied with the texture where there is one; None is white.
        base_color_texture: Linear RGB.
        normal_texture: Raw RGB in [0, 1] (never sRGB-decoded), green +Y.
        normal_scale: Factor on the x and y of the texture's normals; None is 1.
        height_texture: One channel; the surface is displaced along its normals.
        height_scale: World length that a height of 1 stands for.
        reflectivity: Share of the mirrored environment in the color, in [0, 1].
    """

    base_color: tuple[Number, Number, Number] | Float[Array | np.ndarray, "3"] | None = None
    base_color_texture: Texture | MippedTexture | None = None
    normal_texture: Texture | MippedTexture | None = None
    normal_scale: Number | None = None
    height_texture: Texture | None = None
    height_scale: Number = 1.0
    reflectivity: Number | None = None


def with_mips(texture: Texture) -> MippedTexture:
    """Return the texture with its smaller versions; differentiable in the texels."""
    return MippedTexture(build_mips(texture.texels), texture.wrap_u, texture.wrap_v)


def look_up_texture(
    texture: Texture | MippedTexture, uvs: Uvs, uv_dx: Uvs, uv_dy: Uvs
) -> Float[Array, "... channels"]:
    """Look a texture up: trilinear where it has mips, else bilinear.

    Args:
        texture: The texture.
        uvs: Where to look, v upwards.
        uv_dx: Change of the uvs from a pixel to its right neighbour; not used without mips.
        uv_dy: Change of the uvs from a pixel to its lower neighbour; not used without mips.

    Differentiability:
        As ``sample_bilinear`` and ``sample_trilinear``.
    """
    wraps = {"wrap_u": texture.wrap_u, "wrap_v": texture.wrap_v}
    if isinstance(texture, MippedTexture):
        return sample_trilinear(texture.mips, uvs, uv_dx, uv_dy, **wraps)
    return sample_bilinear(texture.texels, uvs, **wraps)
