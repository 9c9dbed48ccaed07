"""Render a ``Scene``: the one place where experiments compile ``shadows.render``."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from shadows.bias import Bias
from shadows.compare import Compare
from shadows.filters import Filter
from shadows.interpolate import gather_faces
from shadows.lights import Light
from shadows.render import Rendering, Shading, Surface, render, shade
from tangentspace.lighting import blinn_phong, lambert, phong

from .scene import Scene, face_colors

SHADINGS: dict[str, Shading] = {
    "blinn-phong": blinn_phong,
    "phong": phong,
    "lambert": functools.partial(lambert, albedo=0.8),
}


def render_scene(
    scene: Scene,
    *,
    image_size: tuple[int, int],
    map_size: int,
    bias: Bias,
    filter: Filter,
    compare: Compare,
    shading: Shading,
    cull_front: bool = False,
) -> Rendering:
    """Render a scene under its first light; compiled once per set of sizes and techniques."""
    arrays = (scene.mesh, scene.camera, scene.lights[0], face_colors(scene), bias, compare)
    static = (image_size, map_size, filter, shading, cull_front)
    return jax.block_until_ready(_render(jax.tree.map(jnp.asarray, arrays), static))


def shade_scene(
    scene: Scene,
    surface: Surface,
    light: Light,
    visibility: Float[Array | np.ndarray, "height width"],
    shading: Shading,
) -> Float[Array, "height width 3"]:
    """Light what is seen once more, with another visibility."""
    colors = face_colors(scene)
    base_color = None if colors is None else gather_faces(colors, surface.face_ids)
    return shade(surface, light, jnp.asarray(visibility), base_color=base_color, shading=shading)


@eqx.filter_jit
def _render(arrays: tuple, static: tuple) -> Rendering:
    mesh, camera, light, base_color, bias, compare = arrays
    image_size, map_size, filter, shading, cull_front = static
    return render(
        mesh,
        camera,
        light,
        image_size=image_size,
        map_size=map_size,
        cull_front=cull_front,
        bias=bias,
        filter=filter,
        compare=compare,
        base_color=base_color,
        shading=shading,
    )
