"""Render a ``Scene``: the one place where experiments compile ``shadows.render``."""

from collections.abc import Sequence
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from shadows.appearance import Appearance, surface_appearance
from shadows.bias import Bias
from shadows.compare import Compare
from shadows.filters import Filter
from shadows.layouts import Layout, SingleLayout
from shadows.light_map import LightMap, look_up_light, shade_with_light_map
from shadows.lights import Light
from shadows.render import Rendering, render, shade
from shadows.shafts import Medium, add_shafts
from shadows.silhouettes import mesh_edges
from shadows.surface import Surface, render_surface
from tangentspace.environment import CubeMap
from tangentspace.shading import Shading

from ..scene import Scene

Shadows = Literal["maps", "volumes", "none"]


def render_scene(
    scene: Scene,
    *,
    image_size: tuple[int, int],
    map_size: int,
    bias: Bias,
    filter: Filter,
    compare: Compare,
    shading: Shading,
    layout: Layout = SingleLayout(),
    shadows: Shadows = "maps",
    medium: Medium | None = None,
    antialias: bool = False,
) -> Rendering:
    """Render a scene under all its lights; compiled once per set of sizes and techniques.

    Args:
        scene: As ``prepare_scene`` returns it.
        image_size: Height and width in pixels.
        map_size: Texels on each side of the shadow maps.
        bias: Against self-shadowing; says which surfaces cast.
        filter: How the maps are asked.
        compare: Hard or soft; for filters that compare.
        shading: The lighting model.
        layout: How many maps serve each light.
        shadows: Cast by maps, by volumes, or not at all.
        medium: Fills the space before the eye, and shows the light's shafts.
        antialias: Whether edges of shadows and of what is seen are smoothed.
    """
    volumes = shadows == "volumes"
    edges = None
    if volumes or antialias:
        edges = mesh_edges(scene.mesh.positions, scene.mesh.faces)
    look = (scene.materials, scene.face_materials, scene.environment)
    arrays = (scene.mesh, scene.camera, scene.lights, look, bias, filter, compare, shading, layout)
    arrays += (edges, medium)
    static = (image_size, map_size, shadows != "none", volumes, antialias)
    return jax.block_until_ready(_render(jax.tree.map(jnp.asarray, arrays), static))


def render_light_map(
    scene: Scene, light_map: LightMap, *, image_size: tuple[int, int], shading: Shading
) -> Rendering:
    """Render a scene lit by its light map: no light is asked, no shadow map drawn.

    Args:
        scene: Whose vertices the map's coordinates belong to.
        light_map: From ``bake_light_map``.
        image_size: Height and width in pixels.
        shading: Its ambient and diffuse coefficients count.
    """
    look = (scene.materials, scene.face_materials)
    arrays = (scene.mesh, scene.camera, light_map, look, shading)
    return jax.block_until_ready(_render_light_map(jax.tree.map(jnp.asarray, arrays), image_size))


@eqx.filter_jit
def _render_light_map(arrays: tuple, image_size: tuple[int, int]) -> Rendering:
    mesh, camera, light_map, (materials, face_materials), shading = arrays
    surface = render_surface(mesh, camera, image_size=image_size)
    look = surface_appearance(mesh, camera, surface, materials, face_materials=face_materials)
    light = look_up_light(mesh, surface, light_map)
    color = shade_with_light_map(surface, light, appearance=look, shading=shading)
    return Rendering(color, (), surface, look, ())


def shade_scene(
    scene: Scene,
    image: Rendering,
    lights: Sequence[Light],
    visibilities: Sequence[Float[Array | np.ndarray, "height width"]],
    shading: Shading,
) -> Float[Array, "height width 3"]:
    """Light what is seen once more, with other visibilities; the background is 0."""
    visible = tuple(jnp.asarray(visibility) for visibility in visibilities)
    arrays = (image.surface, tuple(lights), visible, image.appearance, scene.environment, shading)
    return _shade(*jax.tree.map(jnp.asarray, arrays))


@eqx.filter_jit
def _render(arrays: tuple, static: tuple) -> Rendering:
    mesh, camera, lights, look, bias, filter, compare, shading, layout, edges, medium = arrays
    materials, face_materials, environment = look
    image_size, map_size, cast_shadows, volumes, antialias = static
    image = render(
        mesh,
        camera,
        lights,
        image_size=image_size,
        map_size=map_size,
        layout=layout,
        bias=bias,
        filter=filter,
        compare=compare,
        materials=materials,
        face_materials=face_materials,
        environment=environment,
        shading=shading,
        volume_edges=edges if volumes else None,
        cast_shadows=cast_shadows,
        edges=edges if antialias else None,
    )
    if medium is None:
        return image
    return add_shafts(image, camera, lights, medium, filter=filter, compare=compare)


@eqx.filter_jit
def _shade(
    surface: Surface,
    lights: tuple[Light, ...],
    visibilities: tuple[Float[Array, "height width"], ...],
    appearance: Appearance,
    environment: CubeMap | None,
    shading: Shading,
) -> Float[Array, "height width 3"]:
    return shade(
        surface,
        lights,
        visibilities,
        appearance=appearance,
        environment=environment,
        shading=shading,
    )
