"""What methods are judged on: a scene, seen once, and what rays say of its first light."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from shadows.area_lights import AreaLight
from shadows.layouts import Layout
from shadows.lights import Light
from shadows.render import shade
from shadows.surface import Surface, render_surface
from tangentspace._math import dot

from ..checks import check_scene
from ..rendering.prepare_scene import prepare_scene
from ..scene import Scene
from ..scenes import load_scene
from ..technique_words import choose_layout
from ..truth.area import seen_share
from ..truth.rays import Occluders


class View(NamedTuple):
    """A scene and its truth.

    Attributes:
        name: Of the scene.
        scene: Arrays of JAX; only its mesh, camera and first light count.
        light: The first light.
        layout: The least that serves the light.
        surface: What the eye sees.
        facing: Pixels of surfaces that face the light.
        share: Of the light that is seen from each pixel; 0 or 1 but for area lights.
        color: The image under that share, linear RGB.
    """

    name: str
    scene: Scene
    light: Light
    layout: Layout
    surface: Surface
    facing: Bool[np.ndarray, "height width"]
    share: Float[np.ndarray, "height width"]
    color: Float[np.ndarray, "height width 3"]

    @property
    def soft(self) -> bool:
        """Whether the light has a size, and truth penumbrae."""
        return isinstance(self.light, AreaLight)


def load_view(name: str, image_size: int) -> View:
    """Load a scene, look at it and trace its truth.

    Raises:
        ValueError: If there is no such scene, or its light cannot be mapped.
    """
    scene = prepare_scene(load_scene(name))
    layout = choose_layout(scene, ())
    check_scene(scene, layout)
    light = scene.lights[0]
    arrays = jax.tree.map(jnp.asarray, (scene.mesh, scene.camera))
    size = (image_size, image_size)
    surface = jax.jit(lambda mesh, camera: render_surface(mesh, camera, image_size=size))(*arrays)
    position, normal = np.asarray(surface.position), np.asarray(surface.face_normal)
    places = position, normal, np.asarray(surface.face_ids)
    occluders = Occluders(scene.mesh.positions, scene.mesh.faces)
    seen = seen_share(*places, light, occluders)
    towards = np.asarray(dot(surface.face_normal, light.to_light(surface.position)))
    facing = np.asarray(surface.covered) & (towards > 0)
    share = np.where(facing, seen, 0.0)
    light = jax.tree.map(jnp.asarray, light)
    color = jax.jit(lambda share: shade(surface, (light,), (share,)))(jnp.asarray(share))
    moved = scene._replace(mesh=arrays[0], camera=arrays[1])
    return View(scene.name, moved, light, layout, surface, facing, share, np.asarray(color))
