"""A scene as it is judged: seen once, with the truth about each of its lights and pictures of it.

Truth is the picture under the share of each light that rays find, with normal maps and their
mips where the scene has them. Every model is judged by its picture, as a screen shows it.
"""

import functools
from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

import flip_evaluator
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from shadows.appearance import surface_appearance
from shadows.layouts import Layout
from shadows.lights import Light
from shadows.render import shade
from shadows.surface import Surface, render_surface
from shadows.transforms import Camera
from tangentspace.environment import CubeMap
from tangentspace.material import Material
from tangentspace.mesh import Mesh
from tangentspace.shading import BlinnPhongShading

from ..checks import check_scene
from ..files.images import linear_to_srgb
from ..rendering.prepare_scene import prepare_scene
from ..rendering.scene_maps import without_normal_maps
from ..scene import Scene
from ..technique_words import choose_layout
from ..truth.area import surface_share
from ..truth.rays import Occluders
from .models import LOOKS

Measure = Literal["rmse", "flip", "error"]
Picture = Float[np.ndarray, "height width 3"]
Share = Float[np.ndarray, "height width"]
SHADING = BlinnPhongShading()
SEEN_WRONG = 0.1  # of the screen's range, in any of red, green and blue


class Seen(NamedTuple):
    """A light as the pixels see it.

    Attributes:
        light: The light.
        facing: Pixels of surfaces that face it.
        share: Of the light that is seen from each pixel; 0 or 1 but for area lights.
    """

    light: Light
    facing: Bool[np.ndarray, "height width"]
    share: Share


class Sight(NamedTuple):
    """A scene, seen.

    Attributes:
        scene: As it is rendered.
        layout: The least that serves its lights.
        surface: What the eye sees.
        covered: Where it sees a surface.
        seen: Its lights.
        occluders: Its mesh, for rays.
        truth: The true picture as shown, sRGB in [0, 1], 0 where no surface is.
    """

    scene: Scene
    layout: Layout
    surface: Surface
    covered: Bool[np.ndarray, "height width"]
    seen: tuple[Seen, ...]
    occluders: Occluders
    truth: Picture

    @property
    def looks(self) -> tuple[str, ...]:
        """The looks that make a difference to it, the least first."""
        mapped = any(m.normal_texture is not None for m in self.scene.materials)
        return LOOKS if mapped else LOOKS[:1]

    def error(self, picture: Picture, measure: Measure) -> float:
        """Return how far a picture, as shown, is from truth where surfaces are.

        Args:
            picture: sRGB in [0, 1].
            measure: Root mean square (``rmse``), mean FLIP, or the share of pixels that are
                wrong by more than a tenth of the screen's range (``error``).
        """
        if measure == "flip":
            seen = np.where(self.covered[..., None], picture, 0).astype(np.float32)
            shown, _, _ = flip_evaluator.evaluate(self.truth, seen, "LDR", applyMagma=False)
            return _mean(np.asarray(shown)[self.covered])
        wrong = (picture - self.truth)[self.covered]
        if measure == "rmse":
            return _mean(wrong**2) ** 0.5
        return _mean(np.abs(wrong).max(axis=-1, initial=0) > SEEN_WRONG)


def look_at_scene(scene: Scene, image_size: int) -> Sight:
    """See a scene, and trace the truth about its lights.

    Raises:
        ValueError: If its lights cannot be mapped.
    """
    scene = prepare_scene(scene)
    layout = choose_layout(scene, ())
    check_scene(scene, layout)
    mesh, camera = jax.tree.map(jnp.asarray, (scene.mesh, scene.camera))
    surface = _see(mesh, camera, image_size=image_size)
    occluders = Occluders(scene.mesh.positions, scene.mesh.faces)
    covered = np.asarray(surface.covered)
    seen = tuple(_trace(light, surface, occluders) for light in scene.lights)
    arrays = scene._replace(
        mesh=mesh, camera=camera,
        **jax.tree.map(jnp.asarray, {
            "materials": scene.materials, "lights": scene.lights,
            "face_materials": scene.face_materials, "environment": scene.environment,
        }),
    )  # fmt: skip
    sight = Sight(arrays, layout, surface, covered, seen, occluders, np.zeros((*covered.shape, 3)))
    return sight._replace(truth=picture_of(sight, sight.looks[-1], [s.share for s in seen]))


def picture_of(sight: Sight, look: str, visibilities: Sequence[np.ndarray]) -> Picture:
    """Return the picture, as shown, under given visibilities of the lights."""
    shares = tuple(jnp.asarray(v, jnp.float32) for v in visibilities)
    return shown(np.asarray(_shaded(*shading_arguments(sight, look), shares)))


def shown(color: Float[np.ndarray, "height width 3"]) -> Picture:
    """Return linear colors as a screen shows them."""
    return linear_to_srgb(np.clip(np.asarray(color, np.float32), 0, 1))


def with_look(scene: Scene, look: str) -> Scene:
    """Return the scene with a look."""
    return scene if look == LOOKS[-1] else without_normal_maps(scene)


def shading_arguments(sight: Sight, look: str) -> tuple[Any, ...]:
    """Return what ``shade_picture`` takes before the visibilities."""
    scene = with_look(sight.scene, look)
    return (
        scene.mesh, scene.camera, sight.surface, scene.materials, scene.face_materials,
        scene.environment, scene.lights,
    )  # fmt: skip


def shade_picture(
    mesh: Mesh,
    camera: Camera,
    surface: Surface,
    materials: tuple[Material, ...],
    face_materials: Array,
    environment: CubeMap | None,
    lights: tuple[Light, ...],
    visibilities: tuple[Array, ...],
) -> Float[Array, "height width 3"]:
    """Return the image, linear RGB, 0 where no surface is."""
    appearance = surface_appearance(mesh, camera, surface, materials, face_materials=face_materials)
    return shade(
        surface, lights, visibilities, appearance=appearance, environment=environment,
        shading=SHADING,
    )  # fmt: skip


_shaded = jax.jit(shade_picture)


@functools.partial(jax.jit, static_argnames="image_size")
def _see(mesh: Mesh, camera: Camera, *, image_size: int) -> Surface:
    return render_surface(mesh, camera, image_size=(image_size, image_size))


def _trace(light: Light, surface: Surface, occluders: Occluders) -> Seen:
    return Seen(jax.tree.map(jnp.asarray, light), *surface_share(surface, light, occluders))


def _mean(values: np.ndarray) -> float:
    return float(values.mean()) if values.size else 0.0
