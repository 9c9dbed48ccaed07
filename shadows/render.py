"""The two-pass image: a light's shadow map, the eye's view, and the light between them.

Each stage is a function of plain arrays that can be used alone; ``render`` composes them.
What depends on the eye (``Surface``) and what depends on the light (``ShadowMap``) are kept
apart, so a fit or an animation computes again only what changed.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from tangentspace._math import dot, safe_normalize
from tangentspace.lighting import blinn_phong
from tangentspace.mesh import Mesh
from tangentspace.vertex_normals import face_normals

from .bias import Bias, SlopeBias
from .compare import Compare, HardCompare
from .filters import BilinearFilter, Filter, look_up
from .interpolate import barycentrics, gather_faces, interpolate
from .lights import Light
from .rasterize import rasterize
from .shadow_map import Receiver, ShadowMap, receive, render_shadow_map
from .transforms import Camera, texel_from_clip, transform_points

Shading = Callable[..., Float[Array, "... 3"]]


class Surface(NamedTuple):
    """What the eye sees at each pixel, before any light.

    Attributes:
        face_ids: The face, -1 where there is none.
        depth: Window depth in [0, 1], 1 where there is none.
        position: World space.
        face_normal: Unit normal of the face, turned to the camera's side.
        normal: Unit shading normal, interpolated, turned with the face's.
        to_camera: Unit vector towards the eye.
    """

    face_ids: Int[Array, "height width"]
    depth: Float[Array, "height width"]
    position: Float[Array, "height width 3"]
    face_normal: Float[Array, "height width 3"]
    normal: Float[Array, "height width 3"]
    to_camera: Float[Array, "height width 3"]

    @property
    def covered(self) -> Bool[Array, "height width"]:
        """Whether there is a surface at the pixel."""
        return self.face_ids >= 0


class Rendering(NamedTuple):
    """An image and what it was made from.

    Attributes:
        color: Linear RGB; the background is 0.
        visibility: Of the light, in [0, 1]; 0 on faces turned away and on the background.
        surface: What the eye saw.
        shadow_map: What the light saw.
    """

    color: Float[Array, "height width 3"]
    visibility: Float[Array, "height width"]
    surface: Surface
    shadow_map: ShadowMap


def render_surface(mesh: Mesh, camera: Camera, *, image_size: tuple[int, int]) -> Surface:
    """Rasterize the mesh from the eye and interpolate what shading needs.

    Args:
        mesh: World space.
        camera: The view; its aspect ratio follows the image's.
        image_size: Height and width in pixels.

    Differentiability:
        Smooth in positions, normals and the camera inside each face; see ``rasterize``.
    """
    positions, faces = jnp.asarray(mesh.positions), jnp.asarray(mesh.faces)
    clip = transform_points(camera.clip_from_world(image_size[1] / image_size[0]), positions)
    raster = rasterize(clip, faces, image_size=image_size)
    weights = barycentrics(clip, faces, raster.face_ids)
    position = interpolate(positions, faces, raster.face_ids, weights)
    normal = safe_normalize(interpolate(mesh.normals, faces, raster.face_ids, weights))
    face_normal = gather_faces(face_normals(positions, faces), raster.face_ids)
    to_camera = camera.to_camera(position)
    away = (dot(face_normal, to_camera) < 0)[..., None]
    return Surface(
        raster.face_ids,
        raster.depth,
        position,
        jnp.where(away, -face_normal, face_normal),
        jnp.where(away, -normal, normal),
        to_camera,
    )


def receive_surface(surface: Surface, light: Light, shadow_map: ShadowMap) -> Receiver:
    """Locate the pixels of a view in a light's shadow map."""
    height, width = shadow_map.depth.shape
    viewport = texel_from_clip(height, width, dtype=shadow_map.depth.dtype)
    to_light = light.to_light(surface.position)
    matrix = viewport @ shadow_map.clip_from_world
    return receive(surface.position, surface.face_normal, to_light, matrix)


def surface_visibility(
    surface: Surface,
    light: Light,
    shadow_map: ShadowMap,
    *,
    bias: Bias,
    filter: Filter,
    compare: Compare,
) -> Float[Array, "height width"]:
    """Return the light's visibility at each pixel; 0 on faces turned away from the light."""
    receiver = receive_surface(surface, light, shadow_map)
    facing = dot(receiver.normal, receiver.to_light) > 0
    visibility = look_up(shadow_map, bias(receiver), filter=filter, compare=compare)
    return jnp.where(facing & surface.covered, visibility, 0.0)


def shade(
    surface: Surface,
    light: Light,
    visibility: Float[Array, "height width"],
    *,
    base_color: Float[Array | np.ndarray, "#height #width 3"] | None = None,
    shading: Shading = blinn_phong,
) -> Float[Array, "height width 3"]:
    """Light each pixel; the background is 0.

    Args:
        surface: What the eye sees.
        light: Where light comes from and how much arrives unblocked.
        visibility: Share that is not blocked; scales diffuse and specular, ambient stays.
        base_color: Factor on the color, linear RGB, per pixel; None for none.
        shading: A function of ``tangentspace.lighting``, or one with its signature.
    """
    color = shading(
        surface.normal,
        light.to_light(surface.position),
        surface.to_camera,
        radiance=light.radiance(surface.position),
        visibility=visibility,
    )
    color = color if base_color is None else color * base_color
    return jnp.where(surface.covered[..., None], color, 0.0)


def render(
    mesh: Mesh,
    camera: Camera,
    light: Light,
    *,
    image_size: tuple[int, int] = (512, 512),
    map_size: int = 1024,
    cull_front: bool = False,
    bias: Bias = SlopeBias(2.0),
    filter: Filter = BilinearFilter(),
    compare: Compare = HardCompare(),
    base_color: Float[Array | np.ndarray, "faces 3"] | None = None,
    shading: Shading = blinn_phong,
    shadow_map: ShadowMap | None = None,
) -> Rendering:
    """Render a mesh under one light with a shadow map.

    Args:
        mesh: World space.
        camera: The view.
        light: The light.
        image_size: Height and width in pixels.
        map_size: Texels on each side of the shadow map.
        cull_front: Draw only faces turned away from the light into the map.
        bias: Against self-shadowing; the default is the least that clears every plane of
            acne under 2x2 lookup.
        filter: Which texels are asked.
        compare: Hard, or soft where derivatives are wanted.
        base_color: Linear RGB of each face; None for white.
        shading: A function of ``tangentspace.lighting``, or one with its signature.
        shadow_map: A map kept from before, while only the eye or a bias moved.

    Differentiability:
        In everything but the discrete choices of which face is seen; see each stage.
    """
    if shadow_map is None:
        clip_from_world = light.clip_from_world(mesh.positions)
        shadow_map = render_shadow_map(
            mesh.positions, mesh.faces, clip_from_world, map_size=map_size, cull_front=cull_front
        )
    surface = render_surface(mesh, camera, image_size=image_size)
    visibility = surface_visibility(
        surface, light, shadow_map, bias=bias, filter=filter, compare=compare
    )
    pixel_color = None if base_color is None else gather_faces(base_color, surface.face_ids)
    color = shade(surface, light, visibility, base_color=pixel_color, shading=shading)
    return Rendering(color, visibility, surface, shadow_map)
