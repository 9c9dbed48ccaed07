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

from ..checks import check_scene
from ..rendering.prepare_scene import prepare_scene
from ..scene import Scene
from ..scenes import load_scene
from ..technique_words import choose_layout
from ..truth.area import surface_share
from ..truth.rays import Occluders
from .light_motion import Patterns, patterns, truth_slopes
from .lit_map import Lit, light_finely

_SPARSE = 4  # every so many pixels each way are asked how an area light's share changes


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
        center: Of what is seen, about which the light moves for ``slopes``.
        patterns: Weights of means over the image, from ``light_motion``.
        slopes: How these means of the share change as the light moves.
        lit: Truth of the normal map's color; None where there is no normal map.
    """

    name: str
    scene: Scene
    light: Light
    layout: Layout
    surface: Surface
    facing: Bool[np.ndarray, "height width"]
    share: Float[np.ndarray, "height width"]
    color: Float[np.ndarray, "height width 3"]
    center: Float[np.ndarray, "3"]
    patterns: Patterns
    slopes: Float[np.ndarray, "2 patterns"]
    lit: Lit | None

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
    occluders = Occluders(scene.mesh.positions, scene.mesh.faces)
    facing, share = surface_share(surface, light, occluders)
    light = jax.tree.map(jnp.asarray, light)
    color = jax.jit(lambda share: shade(surface, (light,), (share,)))(jnp.asarray(share))
    center = np.asarray(surface.position)[np.asarray(surface.covered)].mean(axis=0)
    weights = patterns(surface, light)
    sparse = _SPARSE if isinstance(light, AreaLight) else 1

    def seen(light: Light) -> Float[np.ndarray, "height width"]:
        found = np.zeros_like(share)
        some = np.s_[::sparse, ::sparse]
        part = jax.tree.map(lambda a: a[some], surface)
        found[some] = surface_share(part, light, occluders)[1]
        return found * sparse**2

    slopes = truth_slopes(seen, light, weights, center)
    moved = scene._replace(mesh=arrays[0], camera=arrays[1])
    return View(
        scene.name, moved, light, layout, surface, facing, share, np.asarray(color),
        center, weights, slopes, light_finely(scene, light, size),
    )  # fmt: skip
