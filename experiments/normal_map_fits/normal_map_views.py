"""One view under several lights, prepared for trying normal maps: nothing is found twice.

While only the map changes, each pixel keeps its face, its frame, the four texels that it
blends and the light that reaches it. A trial is then a gather, a rotation and the lighting.

An image shows one light, with the ambient light of the lighting model. A pixel that a caster
hides from a light shows nothing of the normal there, so under that light it does not count;
nor does one that touches the edge of a shadow, where a hidden and a lit part may be mixed.
"""

import functools
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy import ndimage

from shadows.interpolate import interpolate
from shadows.lights import Light
from shadows.surface import Surface, render_surface
from shadows.transforms import Camera
from tangentspace.material import MippedTexture
from tangentspace.mesh import Mesh
from tangentspace.normal_map import normals_from_slopes
from tangentspace.shading import Shading
from tangentspace.texture import Texture, Wrap, bilinear_taps, sample_bilinear

from ..scene import Scene
from ..truth.rays import Occluders, trace_visibility

Slopes = Float[Array, "height width 2"]
Vector = tuple[Float[Array, " pixels"], ...]
_XYZ = range(3)


class View(eqx.Module):
    """The pixels that show a normal map, and what the lights do there.

    Coordinates come first, pixels last: arithmetic on whole rows of pixels takes a quarter
    of the time that it takes on rows of three.

    Attributes:
        indices: The four texels that each pixel blends.
        weights: Their weights.
        frame: Tangent, bitangent and normal in world space, not normalized, turned to the
            side that is seen.
        to_camera: Unit vectors.
        position: World space.
        lit: 1 where a light reaches the pixel for certain, else 0.
        base_color: Linear RGB; None for white.
        map_size: Height and width of the map, texels.
    """

    indices: Int[Array, "4 pixels"]
    weights: Float[Array, "4 pixels"]
    frame: Float[Array, "3 3 pixels"]
    to_camera: Float[Array, "3 pixels"]
    position: Float[Array, "3 pixels"]
    lit: Float[Array, "lights pixels"]
    base_color: Float[Array, "3 pixels"] | None
    map_size: tuple[int, int] = eqx.field(static=True)

    def look_up(self, slopes: Slopes) -> Vector:
        """Return the map's blended normals, tangent space, not normalized."""
        texels = normals_from_slopes(slopes).reshape(-1, 3).T
        return tuple(self._blend(coordinate) for coordinate in texels)

    def normals(self, looked_up: Vector) -> Vector:
        """Return the unit shading normals, world space, as ``perturb_normal`` does."""
        bent = [_sum(a * x for a, x in zip(self.frame[:, k], looked_up, strict=True)) for k in _XYZ]
        squared = _sum(x * x for x in bent)
        zero = squared == 0
        length = jnp.sqrt(jnp.where(zero, 1.0, squared))
        return tuple(jnp.where(zero, 0.0, x / length) for x in bent)

    def colors(
        self, normals: Vector, lights: Sequence[Light], shading: Shading
    ) -> list[list[Float[Array, " pixels"]]]:
        """Return what each light by itself, unblocked, makes of each channel."""
        n_dot_v = _sum(n * v for n, v in zip(normals, self.to_camera, strict=True))
        tint = [1.0] * 3 if self.base_color is None else self.base_color
        albedo, specular, ambient = (
            jnp.broadcast_to(jnp.asarray(c), (3,))
            for c in (shading.albedo, shading.specular, shading.ambient)
        )
        result = []
        for light in lights:
            to_light = light.to_light(self.position.T).T
            radiance = light.radiance(self.position.T).T
            terms = shading.terms(
                _sum(n * x for n, x in zip(normals, to_light, strict=True)),
                n_dot_v,
                _sum(v * x for v, x in zip(self.to_camera, to_light, strict=True)),
            )
            result.append(
                [
                    ambient[k] * tint[k]
                    + radiance[k]
                    * (albedo[k] * tint[k] * terms.diffuse + specular[k] * terms.highlight)
                    for k in _XYZ
                ]
            )
        return result

    def _blend(self, texels: Float[Array, " texels"]) -> Float[Array, " pixels"]:
        """Return the weighted sum of the texels at each pixel."""
        return _sum(
            weight * texels.at[index].get(mode="promise_in_bounds")
            for weight, index in zip(self.weights, self.indices, strict=True)
        )


class SeenMap(eqx.Module):
    """Where a view shows a material's normal map.

    Attributes:
        surface: What the eye sees.
        inside: The pixels that show the material.
        view: Those pixels, prepared.
        visibility: Of each light at every pixel, ray-traced.
    """

    surface: Surface
    inside: Bool[np.ndarray, "height width"]
    view: View
    visibility: Bool[np.ndarray, "lights height width"]


def see_map(
    scene: Scene,
    material: int,
    *,
    image_size: tuple[int, int],
    map_size: tuple[int, int],
    wraps: tuple[Wrap, Wrap],
    shadow_margin: int,
) -> SeenMap:
    """Prepare the pixels that show a material.

    Args:
        scene: With tangents, as ``prepare_scene`` returns it.
        material: Index of the material whose map is sought.
        image_size: Height and width of the images.
        map_size: Height and width of the map.
        wraps: How the map continues to the sides, and above and below.
        shadow_margin: Pixels round a shadow's edge that do not count either.

    Raises:
        ValueError: If the mesh has no uvs, or no pixel shows the material.
    """
    if scene.mesh.uvs is None:
        raise ValueError(f"{scene.name}: has no uvs, which a normal map needs; unwrap the mesh")
    mesh = jax.tree.map(jnp.asarray, scene.mesh)
    seen = jax.tree.map(np.asarray, _see(mesh, scene.camera, image_size))
    surface, face_ids = seen.surface, seen.surface.face_ids
    inside = (face_ids >= 0) & (scene.face_materials[face_ids] == material)
    if not inside.any():
        raise ValueError(f"{scene.name}: no pixel shows material {material}; move the camera")
    occluders = Occluders(scene.mesh.positions, scene.mesh.faces)
    visibility = np.stack(
        [
            trace_visibility(surface.position, surface.face_normal, face_ids, light, occluders)
            for light in scene.lights
        ]
    )
    lit = [_without_edges(v, face_ids >= 0, shadow_margin)[inside] for v in visibility]
    uvs, tangent, normal = seen.uvs[inside], seen.tangent[inside], seen.normal[inside]
    side = np.where(np.sum(normal * surface.normal[inside], axis=-1) < 0, -1, 1)
    bitangent = tangent[:, 3:] * np.cross(normal, tangent[:, :3])
    frame = np.stack([tangent[:, :3], bitangent, normal]) * side[:, None]
    taps = bilinear_taps(map_size, jnp.asarray(uvs), wrap_u=wraps[0], wrap_v=wraps[1])
    color = _base_color(scene, material, uvs)
    rows = lambda array: jnp.asarray(np.ascontiguousarray(array.T))
    view = View(
        indices=rows(np.asarray(taps.indices)),
        weights=rows(np.asarray(taps.weights)),
        frame=jnp.asarray(np.ascontiguousarray(np.moveaxis(frame, -1, 1))),
        to_camera=rows(surface.to_camera[inside]),
        position=rows(surface.position[inside]),
        lit=jnp.asarray(np.stack(lit), normal.dtype),
        base_color=None if color is None else rows(color),
        map_size=map_size,
    )
    return SeenMap(surface, inside, view, visibility)


class _Seen(NamedTuple):
    surface: Surface
    uvs: Float[Array, "height width 2"]
    tangent: Float[Array, "height width 4"]
    normal: Float[Array, "height width 3"]


@functools.partial(jax.jit, static_argnames="image_size")
def _see(mesh: Mesh, camera: Camera, image_size: tuple[int, int]) -> _Seen:
    surface = render_surface(mesh, camera, image_size=image_size)
    at = lambda vertices: interpolate(vertices, mesh.faces, surface.face_ids, surface.weights)
    return _Seen(surface, at(mesh.uvs), at(mesh.tangents), at(mesh.normals))


def _base_color(
    scene: Scene, material: int, uvs: Float[np.ndarray, "pixels 2"]
) -> Float[np.ndarray, "pixels 3"] | None:
    """Return the material's color at the pixels; None where it is white."""
    look = scene.materials[material]
    color = None
    if look.base_color is not None:
        color = np.broadcast_to(np.asarray(look.base_color, uvs.dtype), (len(uvs), 3))
    texture = look.base_color_texture
    if isinstance(texture, MippedTexture):
        texture = Texture(texture.mips.levels[0], texture.wrap_u, texture.wrap_v)
    if texture is not None:
        wraps = {"wrap_u": texture.wrap_u, "wrap_v": texture.wrap_v}
        texels = np.asarray(sample_bilinear(texture.texels, jnp.asarray(uvs), **wraps))
        color = texels if color is None else texels * color
    return color


def _without_edges(
    lit: Bool[np.ndarray, "height width"], covered: Bool[np.ndarray, "height width"], margin: int
) -> Bool[np.ndarray, "height width"]:
    """Return lit pixels farther than the margin from a covered one that is dark."""
    if margin == 0:
        return lit
    return ndimage.binary_erosion(lit | ~covered, np.ones((3, 3)), margin, border_value=1) & lit


def _sum(parts: Iterable[Array]) -> Array:
    first, *others = parts
    return sum(others, first)
