"""A normal map lit per fragment, and what it is judged against.

Truth is the map as it was made for MikkTSpace's frames, lit without mips and without shadows
at sixteen points of each pixel. Only pixels that the map covers wholly count.
"""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from shadows.appearance import surface_appearance
from shadows.interpolate import gather_faces
from shadows.lights import Light
from shadows.render import shade
from shadows.surface import Surface, render_surface
from shadows.transforms import Camera
from tangentspace.material import Material, MippedTexture
from tangentspace.mesh import Mesh
from tangentspace.texture import Texture

from ..scene import Scene

_FINER = 4  # points along each side of a pixel


class Lit(NamedTuple):
    """Truth of a scene with a normal map.

    Attributes:
        color: Mean over each pixel, linear RGB.
        counts: Whether the map covers the pixel wholly.
    """

    color: Float[np.ndarray, "height width 3"]
    counts: Bool[np.ndarray, "height width"]


class Looks(NamedTuple):
    """What a picture is made from besides the surface and the light; as in ``Scene``."""

    mesh: Mesh
    camera: Camera
    materials: tuple[Material, ...]
    face_materials: Any


def mapped_material(looks: Looks) -> int:
    """Return which material has a normal map, the first; -1 for none."""
    found = (k for k, m in enumerate(looks.materials) if m.normal_texture is not None)
    return next(found, -1)


def with_normal_texture(looks: Looks, texture: Texture | MippedTexture | None) -> Looks:
    """Return the looks with another normal map instead of the first."""
    mapped = mapped_material(looks)
    materials = [
        dataclasses.replace(m, normal_texture=texture if k == mapped else m.normal_texture)
        for k, m in enumerate(looks.materials)
    ]
    return looks._replace(materials=tuple(materials))


def light_fragments(
    ready: Looks, surface: Surface, light: Light, *, gloss: bool = False
) -> Float[Array, "height width 3"]:
    """Light per fragment."""
    mesh, camera, materials, of_faces = ready
    look = surface_appearance(mesh, camera, surface, materials, face_materials=of_faces)
    if not gloss:
        look = look._replace(coherence=None)
    return shade(surface, (light,), (jnp.ones(surface.face_ids.shape),), appearance=look)


def without_mips(looks: Looks) -> Looks:
    """Return the looks with the normal map at its full size alone."""
    texture = looks.materials[mapped_material(looks)].normal_texture
    if not isinstance(texture, MippedTexture):
        return looks
    plain = Texture(texture.mips.levels[0], texture.wrap_u, texture.wrap_v)
    return with_normal_texture(looks, plain)


def light_finely(scene: Scene, light: Light, image_size: tuple[int, int]) -> Lit | None:
    """Return truth; None where no material has a normal map.

    Args:
        scene: As ``prepare_scene`` returns it.
        light: The one light.
        image_size: Height and width in pixels.
    """
    looks = Looks(scene.mesh, scene.camera, scene.materials, scene.face_materials)
    mapped = mapped_material(looks)
    if mapped < 0:
        return None
    height, width = image_size
    blocks = (height, _FINER, width, _FINER)

    @jax.jit
    def fine(looks: Looks, light: Light) -> tuple[Array, Array]:
        size = (_FINER * height, _FINER * width)
        surface = render_surface(looks.mesh, looks.camera, image_size=size)
        of_map = gather_faces(looks.face_materials[:, None], surface.face_ids)[..., 0] == mapped
        color = light_fragments(looks, surface, light).reshape(*blocks, 3).mean(axis=(1, 3))
        return color, (of_map & surface.covered).reshape(blocks).all(axis=(1, 3))

    arrays = jax.tree.map(jnp.asarray, (without_mips(looks), light))
    return Lit(*map(np.asarray, fine(*arrays)))
