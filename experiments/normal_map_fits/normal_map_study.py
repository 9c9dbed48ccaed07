"""A normal map to be recovered: the scene, the images that show it, and the truth if known.

Images are given, one for each light of the scene in their order, or made from the scene's
own map, with ray-traced shadows, so that the result can be compared with the truth.
"""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from shadows.lights import Light
from tangentspace.material import MippedTexture
from tangentspace.normal_map import (
    decode_normals,
    encode_normals,
    normals_from_slopes,
    scale_normals,
    slopes_from_normals,
)
from tangentspace.shading import Shading
from tangentspace.texture import Texture, repeat

from ..scene import Scene
from .normal_map_views import SeenMap, Slopes, View, see_map

DEFAULT_MAP_SIZE = (256, 256)
_SATURATED = 1 - 1 / 512  # linear: from here on an 8-bit value may stand for anything brighter

Image = Float[np.ndarray, "height width 3"]


class MapStudy(NamedTuple):
    """What a fit works on.

    Attributes:
        scene: With tangents.
        seen: Where the view shows the map.
        lights: One for each image.
        shading: The lighting model, with the coefficients that the fit starts from.
        images: What the map is fitted to, linear RGB.
        targets: The same at the pixels that show the map.
        truth: Unit normals of the true map; None where it is not known.
    """

    scene: Scene
    seen: SeenMap
    lights: tuple[Light, ...]
    shading: Shading
    images: tuple[Image, ...]
    targets: Float[Array, "lights 3 pixels"]
    truth: Float[np.ndarray, "texels texels 3"] | None


def mapped_material(scene: Scene) -> int:
    """Return the first material with a normal map, or the first of all."""
    mapped = [k for k, m in enumerate(scene.materials) if m.normal_texture is not None]
    return mapped[0] if mapped else 0


def make_study(
    scene: Scene,
    shading: Shading,
    *,
    image_size: tuple[int, int],
    noise: float = 0.0,
    seed: int = 0,
) -> MapStudy:
    """Make the images from the scene's own map, under each of its lights by itself.

    Args:
        scene: With tangents and a material with a normal map.
        shading: The lighting model.
        image_size: Height and width of the images.
        noise: Standard deviation of Gaussian noise on every value, linear radiance.
        seed: Of the noise.

    Raises:
        ValueError: If no material has a normal map, or no pixel shows it.
    """
    material = mapped_material(scene)
    texture = scene.materials[material].normal_texture
    if texture is None:
        raise ValueError(
            f"{scene.name}: has no normal map to make images from; give images with --images"
        )
    seen = _see(scene, image_size=image_size, map_size=None, shadow_margin=0)
    normals = decode_normals(_plain(texture).texels)
    scale = scene.materials[material].normal_scale
    normals = np.asarray(scale_normals(normals, 1.0 if scale is None else scale), np.float64)
    slopes, valid = jax.jit(slopes_from_normals)(jnp.asarray(normals, np.float32))
    if not bool(jnp.all(valid)):
        raise ValueError(f"{scene.name}: its normal map has normals that do not look up")
    colors = np.asarray(_colors(seen.view, slopes, scene.lights, shading))
    ambient = np.broadcast_to(np.asarray(shading.ambient, np.float32), (3,))
    tint = 1.0 if seen.view.base_color is None else np.asarray(seen.view.base_color)
    unlit = ambient[:, None] * tint
    reached = seen.visibility[:, seen.inside][:, None]
    targets = np.where(reached, colors, unlit).astype(np.float32)
    targets += noise * np.random.default_rng(seed).standard_normal(targets.shape, np.float32)
    images = []
    for values in targets:
        image = np.zeros((*image_size, 3), np.float32)
        image[seen.inside] = values.T
        images.append(image)
    return MapStudy(
        scene, seen, scene.lights, shading, tuple(images), jnp.asarray(targets), normals
    )


def load_study(
    scene: Scene,
    shading: Shading,
    images: Sequence[Image],
    *,
    map_size: tuple[int, int] | None = None,
    limit: float = np.inf,
    shadow_margin: int = 1,
) -> MapStudy:
    """Take given images of the scene, the first under its first light and so on.

    Args:
        scene: With tangents; lights beyond the number of images are not used.
        shading: The lighting model.
        images: Linear RGB, of one size.
        map_size: Height and width of the map; by default that of the scene's own map.
        limit: Where the images' format saturates; brighter pixels do not count.
        shadow_margin: Pixels round the edges of shadows that do not count.

    Raises:
        ValueError: If there are more images than lights, sizes differ, a pixel is not finite,
            or no pixel shows the material.
    """
    if len(images) > len(scene.lights):
        raise ValueError(
            f"--images: got {len(images)} images, but {scene.name} has {len(scene.lights)} "
            f"lights; each image needs the one light that it was taken under"
        )
    sizes = {image.shape[:2] for image in images}
    if len(sizes) > 1:
        said = ", ".join(f"{h} x {w}" for h, w in sorted(sizes))
        raise ValueError(f"--images: expected images of one size, got {said}; scale them")
    scene = scene._replace(lights=scene.lights[: len(images)])
    seen = _see(scene, image_size=sizes.pop(), map_size=map_size, shadow_margin=shadow_margin)
    targets = np.stack([image[seen.inside].T for image in images]).astype(np.float32)
    if not np.isfinite(targets).all():
        raise ValueError("--images: have pixels that are NaN or infinite; repair the images")
    dim = (targets < limit * _SATURATED).all(axis=1)
    view = seen.view
    lit = jnp.where(dim, view.lit, 0.0)
    seen = eqx.tree_at(lambda s: s.view.lit, seen, lit)
    return MapStudy(scene, seen, scene.lights, shading, tuple(images), jnp.asarray(targets), None)


def angles(
    normals: Float[np.ndarray, "... 3"], truth: Float[np.ndarray, "... 3"]
) -> Float[np.ndarray, "..."]:
    """Return the angles between unit vectors, degrees; exact for small ones too."""
    half = np.linalg.norm(normals - truth, axis=-1) / 2
    return np.rad2deg(2 * np.arcsin(np.clip(half, 0, 1)))


def errors_of(study: MapStudy, slopes: Slopes) -> Float[np.ndarray, "height width"]:
    """Return each texel's angle to the true normal, which must be known, degrees."""
    assert study.truth is not None
    return angles(np.asarray(normals_from_slopes(slopes), np.float64), study.truth)


def texels_of(slopes: Slopes) -> Float[np.ndarray, "height width 3"]:
    """Return the raw texels of a map."""
    return np.asarray(encode_normals(normals_from_slopes(slopes)))


def _see(
    scene: Scene,
    *,
    image_size: tuple[int, int],
    map_size: tuple[int, int] | None,
    shadow_margin: int,
) -> SeenMap:
    """Find where the view shows the material that is mapped."""
    material = mapped_material(scene)
    texture = scene.materials[material].normal_texture
    plain = None if texture is None else _plain(texture)
    if map_size is None and plain is not None:
        map_size = (plain.texels.shape[0], plain.texels.shape[1])
    wraps = (repeat, repeat) if plain is None else (plain.wrap_u, plain.wrap_v)
    return see_map(
        scene,
        material,
        image_size=image_size,
        map_size=DEFAULT_MAP_SIZE if map_size is None else map_size,
        wraps=wraps,
        shadow_margin=shadow_margin,
    )


def _plain(texture: Texture | MippedTexture) -> Texture:
    """Return the texture without its smaller versions."""
    if isinstance(texture, MippedTexture):
        return Texture(texture.mips.levels[0], texture.wrap_u, texture.wrap_v)
    return texture


@jax.jit
def _colors(
    view: View, slopes: Slopes, lights: tuple[Light, ...], shading: Shading
) -> Float[Array, "lights 3 pixels"]:
    colors = view.colors(view.normals(view.look_up(slopes)), lights, shading)
    return jnp.stack([jnp.stack(channels) for channels in colors])
