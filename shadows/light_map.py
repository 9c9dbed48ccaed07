"""Light maps: diffuse light and its shadows, baked once into a texture.

Texels take the place of pixels: ``texture_surface`` is what an eye would see that looks at
the unrolled mesh, so shadow maps, rays and lighting models serve as they are. An image then
asks the texture, and neither lights nor shadow maps.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from tangentspace.mesh import Mesh
from tangentspace.shading import BlinnPhongShading, Shading
from tangentspace.texture import clamp, sample_bilinear

from .appearance import Appearance
from .interpolate import interpolate
from .surface import Surface, surface_at


class LightMap(NamedTuple):
    """Light that arrives on a surface, by texture coordinates of its own.

    Attributes:
        texels: Linear RGB of radiance times visibility times cosine, summed over lights.
        uvs: For each vertex, where it lies on the map; no two faces overlap there.
    """

    texels: Float[Array | np.ndarray, "height width 3"]
    uvs: Float[Array | np.ndarray, "vertices 2"]


def texture_surface(
    mesh: Mesh, uvs: Float[Array | np.ndarray, "vertices 2"], *, size: tuple[int, int]
) -> Surface:
    """Return what lies at the centre of each texel.

    Args:
        mesh: World space.
        uvs: In [0, 1], v up; where faces overlap the one with the lowest index is taken.
        size: Height and width in texels.

    Returns:
        As an image of the mesh; normals as the faces are wound, ``to_camera`` is the normal.
        Texels without a face have the face -1.

    Differentiability:
        In positions and normals.
    """
    flat = 2 * jnp.asarray(uvs, jnp.asarray(mesh.positions).dtype) - 1
    zero, one = jnp.zeros_like(flat[:, :1]), jnp.ones_like(flat[:, :1])
    clip = jnp.concatenate([flat, zero, one], axis=1)
    return surface_at(mesh, clip, image_size=size)


def look_up_light(mesh: Mesh, surface: Surface, light_map: LightMap) -> Float[Array, "h w 3"]:
    """Return the light that arrives at each pixel, from the map.

    Args:
        mesh: The mesh that the map was baked for.
        surface: What the eye sees of it.
        light_map: The map; sampled bilinearly, its borders are not crossed.

    Differentiability:
        In the texels and coordinates, and in positions inside each face.
    """
    uvs = interpolate(light_map.uvs, mesh.faces, surface.face_ids, surface.weights)
    return sample_bilinear(light_map.texels, uvs, wrap_u=clamp, wrap_v=clamp)


def shade_with_light_map(
    surface: Surface,
    light: Float[Array, "height width 3"],
    *,
    appearance: Appearance | None = None,
    shading: Shading = BlinnPhongShading(),
) -> Float[Array, "height width 3"]:
    """Light each pixel by what a light map holds.

    Args:
        surface: What the eye sees.
        light: From ``look_up_light``.
        appearance: Its base color counts; normals are those of the bake.
        shading: Its ambient and diffuse coefficients count.

    Returns:
        Linear RGB; the background is 0.
    """
    color = shading.ambient + shading.albedo * light
    if appearance is not None and appearance.base_color is not None:
        color = appearance.base_color * color
    return jnp.where(surface.covered[..., None], color, 0.0)
