"""The two-pass image: shadow maps of the lights, the eye's view, and the light between them.

Each stage is a function of plain arrays that can be used alone; ``render`` composes them.
What depends on the eye (``Surface``, ``Appearance``) and what depends on a light
(``ShadowMap``) are kept apart, so a fit or an animation computes again only what changed.
"""

from collections.abc import Sequence
from typing import NamedTuple, TypeVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int, PyTree

from tangentspace._planes import in_planes
from tangentspace.environment import CubeMap, reflect_environment, skybox
from tangentspace.lighting import IncomingLight, shade_lights
from tangentspace.material import Material
from tangentspace.mesh import Mesh
from tangentspace.shading import BlinnPhongShading, Shading

from .appearance import Appearance, edge_appearance, surface_appearance
from .bias import Bias
from .compare import Compare, HardCompare
from .coverage import Coverage, blend_layers
from .edge_points import EdgePoints, edge_changes
from .filters import Filter
from .interpolate import ClipPositions
from .layouts import Layout, SingleLayout
from .lights import Light
from .rasterize import Raster, rasterize
from .shadow_map import ShadowMap, render_shadow_map
from .silhouettes import MeshEdges
from .surface import Surface, edge_surface, mesh_creases, surface_coverage, surface_of
from .transforms import Camera, transform_points
from .visibility import (
    Visibility,
    check_techniques,
    default_bias,
    facing_visibility,
    surface_visibility,
)
from .volumes import volume_visibility
from .window_filters import BilinearFilter

Tree = TypeVar("Tree")


class Rendering(NamedTuple):
    """An image and what it was made from.

    Attributes:
        color: Linear RGB; the background is the environment, or 0.
        visibilities: Of each light, in [0, 1]; 0 on faces turned away and on the background.
        surface: What the eye saw.
        appearance: How it looks before any light.
        shadow_maps: What each light saw; none where shadows were cast by volumes.
        coverage: Of the pixels, where edges were asked for; the color is blended by it.
    """

    color: Float[Array, "height width 3"]
    visibilities: tuple[Visibility, ...]
    surface: Surface
    appearance: Appearance
    shadow_maps: tuple[ShadowMap, ...]
    coverage: Coverage | None = None


@in_planes
def shade(
    surface: Surface,
    lights: Sequence[Light],
    visibilities: Sequence[Visibility],
    *,
    appearance: Appearance | None = None,
    environment: CubeMap | None = None,
    shading: Shading = BlinnPhongShading(),
) -> Float[Array, "height width 3"]:
    """Light each pixel.

    Args:
        surface: What the eye sees.
        lights: Where light comes from and how much arrives unblocked; at least one.
        visibilities: For each light, the share that is not blocked; scales diffuse and
            specular, ambient stays and counts once.
        appearance: Color, normals with normal maps, and so on; None for plain white.
        environment: What reflective materials mirror; None for black.
        shading: The lighting model.

    Returns:
        Linear RGB; the background is 0.

    Raises:
        ValueError: If there is no light, or not one visibility for each.
    """
    if len(lights) != len(visibilities):
        expected = f"expected one of `visibilities` for each of {len(lights)} lights"
        raise ValueError(f"shade: {expected}, got {len(visibilities)}")
    look = Appearance(surface.normal) if appearance is None else appearance
    incoming = [
        IncomingLight(light.to_light(surface.position), light.radiance(surface.position), visible)
        for light, visible in zip(lights, visibilities, strict=True)
    ]
    color = shade_lights(look.bind(shading), look.normal, surface.to_camera, incoming)
    if look.reflectivity is not None:
        share = look.reflectivity[..., None]
        mirrored = 0.0
        if environment is not None:
            mirrored = reflect_environment(environment, look.normal, surface.to_camera)
        color = (1 - share) * color + share * mirrored
    return jnp.where(surface.covered[..., None], color, 0.0)


def render(
    mesh: Mesh,
    camera: Camera,
    lights: Light | Sequence[Light],
    *,
    image_size: tuple[int, int] = (512, 512),
    map_size: int = 1024,
    layout: Layout = SingleLayout(),
    bias: Bias | None = None,
    filter: Filter = BilinearFilter(),
    compare: Compare = HardCompare(),
    materials: Sequence[Material] = (),
    face_materials: Int[Array | np.ndarray, " faces"] | None = None,
    environment: CubeMap | None = None,
    shading: Shading = BlinnPhongShading(),
    shadow_maps: Sequence[ShadowMap] | None = None,
    volume_edges: MeshEdges | None = None,
    cast_shadows: bool = True,
    edges: MeshEdges | None = None,
) -> Rendering:
    """Render a mesh under its lights, with a shadow map for each.

    Args:
        mesh: World space; with uvs where a material has textures, and with tangents where
            one has a normal map (``tangentspace.with_tangents``).
        camera: The view.
        lights: One light or several.
        image_size: Height and width in pixels.
        map_size: Texels on each side of a shadow map.
        layout: How many maps serve each light.
        bias: Against self-shadowing, which also says which surfaces cast; None for the least
            that clears every plane of acne under the filter (``default_bias``).
        filter: How the maps are asked.
        compare: Hard, or soft where derivatives are wanted; for filters that compare.
        materials: How the mesh looks; none is plain white. Height textures are not applied
            here: ``tangentspace.displace`` moves the vertices before.
        face_materials: For each face, the index of its material; not needed for one.
        environment: What reflective materials mirror and the background shows; None for
            black.
        shading: The lighting model.
        shadow_maps: Maps kept from before, while only the eye or a bias moved.
        volume_edges: ``mesh_edges(mesh.positions, mesh.faces)``, to cast shadows by volumes
            instead of maps, of which none is drawn then; None for maps.
        cast_shadows: Whether anything blocks light; if not, no map is drawn either.
        edges: ``mesh_edges(mesh.positions, mesh.faces)``, so that edges, of shadows and of
            what the eye sees, are antialiased and have derivatives; None for neither.

    Raises:
        ValueError: If there is no light, not one kept map for each light, or the mesh lacks
            what its materials need.

    Differentiability:
        In everything but the discrete choices of which face is seen; with ``edges`` also
        there, where shadow edges and silhouettes move. See each stage.
    """
    lights = (lights,) if isinstance(lights, Light) else tuple(lights)
    bias = default_bias(filter) if bias is None else bias
    check_techniques(bias, filter)
    if volume_edges is not None or not cast_shadows:
        shadow_maps = ()
    elif shadow_maps is None:
        reach, aspect = filter.reach(), image_size[1] / image_size[0]
        shadow_maps = [
            render_shadow_map(
                mesh.positions,
                mesh.faces,
                layout.matrices(
                    light, mesh.positions, camera, aspect=aspect, map_size=map_size, reach=reach
                ),
                map_size=map_size,
                casters=bias.casters,
                edges=edges,
            )
            for light in lights
        ]
    elif len(shadow_maps) != len(lights):
        expected = f"expected one of `shadow_maps` for each of {len(lights)} lights"
        raise ValueError(f"render: {expected}, got {len(shadow_maps)}")
    prepared = [
        filter.for_light(light).prepare(bias.prepare(shadow_map))
        for light, shadow_map in zip(lights, shadow_maps, strict=False)
    ]
    height, width = image_size
    clip = transform_points(camera.clip_from_world(width / height), mesh.positions)
    raster = rasterize(clip, mesh.faces, image_size=image_size)
    scene = _Scene(
        mesh,
        camera,
        lights,
        tuple(shadow_maps),
        prepared,
        bias,
        filter,
        compare,
        volume_edges,
        cast_shadows,
        materials,
        face_materials,
        environment,
        shading,
    )
    image = _pixels(scene, clip, raster)
    if edges is None:
        return image
    covers = surface_coverage(mesh, camera, image.surface, edges)
    changes = _edge_changes(*_still((scene, clip, image, covers, edges)))
    color = blend_layers(covers, image.color, changes=changes)
    return image._replace(color=color, coverage=covers)


class _Scene(NamedTuple):
    """What ``render`` was told, and the maps it drew."""

    mesh: Mesh
    camera: Camera
    lights: tuple[Light, ...]
    shadow_maps: tuple[ShadowMap, ...]
    prepared: list[PyTree]
    bias: Bias
    filter: Filter
    compare: Compare
    volume_edges: MeshEdges | None
    cast_shadows: bool
    materials: Sequence[Material]
    face_materials: Int[Array | np.ndarray, " faces"] | None
    environment: CubeMap | None
    shading: Shading

    def visibilities(self, surface: Surface) -> tuple[Visibility, ...]:
        """Return how much of each light arrives at the pixels."""
        if not self.cast_shadows:
            return tuple(facing_visibility(surface, light) for light in self.lights)
        if self.volume_edges is not None:
            return tuple(
                volume_visibility(self.mesh, self.camera, surface, light, edges=self.volume_edges)
                for light in self.lights
            )
        how = {"bias": self.bias, "filter": self.filter, "compare": self.compare}
        return tuple(
            surface_visibility(surface, light, drawn, **how, prepared=kept)
            for light, drawn, kept in zip(self.lights, self.shadow_maps, self.prepared, strict=True)
        )

    def shade(
        self, surface: Surface, visibilities: Sequence[Visibility], appearance: Appearance
    ) -> Float[Array, "height width 3"]:
        """Light the pixels."""
        look = {"appearance": appearance, "environment": self.environment, "shading": self.shading}
        return shade(surface, self.lights, visibilities, **look)


@in_planes
def _pixels(scene: _Scene, clip: ClipPositions, raster: Raster) -> Rendering:
    """Return the image, without coverage."""
    mesh, camera = scene.mesh, scene.camera
    surface = surface_of(mesh, camera, clip, raster)
    visibilities = scene.visibilities(surface)
    appearance = surface_appearance(
        mesh, camera, surface, scene.materials, face_materials=scene.face_materials
    )
    color = scene.shade(surface, visibilities, appearance)
    if scene.environment is not None:
        height, width = raster.face_ids.shape
        matrix = camera.clip_from_world(width / height)
        sky = skybox(scene.environment, matrix, height, width)
        color = jnp.where(surface.covered[..., None], color, sky)
    return Rendering(color, visibilities, surface, appearance, scene.shadow_maps)


def _edge_changes(
    scene: _Scene, clip: ClipPositions, image: Rendering, coverage: Coverage, edges: MeshEdges
) -> Float[Array, "4 height width 3"]:
    """Return what ``blend_layers`` asks of an image: its colors are looked up again at edges."""
    mesh, surface = scene.mesh, image.surface

    def look(points: EdgePoints) -> Float[Array, "2 points 3"]:
        sides = edge_surface(mesh, scene.camera, surface, points)
        visibilities = [points.beside(visible) for visible in image.visibilities]
        if scene.shadow_maps:
            # Where two lit surfaces meet, a map tells of both at once; beside the edge it does
            # not. But at one that is turned away the shadow on the other begins.
            begins = [
                points.ends | (facing_visibility(sides, light)[::-1] == 0) for light in scene.lights
            ]
            pairs = zip(begins, scene.visibilities(sides), visibilities, strict=True)
            visibilities = [jnp.where(*either) for either in pairs]
        appearance = edge_appearance(image.appearance, surface, sides, points)
        color = scene.shade(sides, visibilities, appearance)
        return jnp.where(sides.covered[..., None], color, points.beside(image.color))

    return edge_changes(
        clip,
        mesh.faces,
        edges,
        surface.face_ids,
        coverage,
        image.color,
        look,
        creases=mesh_creases(mesh, edges),
    )


def _still(tree: Tree) -> Tree:
    """Return the same without derivatives."""
    moving, rest = eqx.partition(tree, eqx.is_inexact_array)
    return eqx.combine(lax.stop_gradient(moving), rest)
