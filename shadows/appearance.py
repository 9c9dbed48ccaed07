"""From materials to what shading needs at each pixel: color, normal, gloss, reflectivity.

Each is computed only if some material asks for it; a mesh without textures pays nothing.
"""

import functools
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from tangentspace._math import dot, safe_normalize
from tangentspace._planes import in_planes
from tangentspace.material import Material, MippedTexture, look_up_texture
from tangentspace.mesh import Mesh
from tangentspace.mips import texel_footprint
from tangentspace.normal_filtering import mean_length
from tangentspace.normal_map import decode_normals, scale_normals
from tangentspace.pixel_frame import perturb_normal
from tangentspace.shading import Shading
from tangentspace.texture import Texture

from .edge_points import EdgePoints
from .interpolate import barycentric_slopes, gather_faces, interpolate
from .surface import Surface
from .transforms import Camera, transform_points


class Appearance(NamedTuple):
    """How the surface looks at each pixel, before any light.

    Attributes:
        normal: Unit shading normals, with normal maps, on the camera's side.
        base_color: Linear RGB; None for white.
        coherence: Length of the mean of the normals that the pixel covers, in (0, 1], where a
            normal map with mips is minified, else 1; None without such maps.
        reflectivity: Share of the mirrored environment in the color; None for none.
    """

    normal: Float[Array, "height width 3"]
    base_color: Float[Array, "height width 3"] | None = None
    coherence: Float[Array, "height width"] | None = None
    reflectivity: Float[Array, "height width"] | None = None

    def bind(self, shading: Shading) -> Callable[..., Float[Array, "height width 3"]]:
        """Return the lighting model with color and gloss bound, for ``shade_lights``."""
        bound = {}
        if self.base_color is not None:
            bound["base_color"] = self.base_color
        if self.coherence is not None:
            bound["gloss"] = shading.gloss(self.coherence)
        return functools.partial(shading, **bound)


class _Region(NamedTuple):
    """The pixels of one material."""

    material: Material
    inside: Bool[Array, "height width"]


@in_planes
def surface_appearance(
    mesh: Mesh,
    camera: Camera,
    surface: Surface,
    materials: Sequence[Material],
    *,
    face_materials: Int[Array | np.ndarray, " faces"] | None = None,
) -> Appearance:
    """Look up colors, normals and reflectivity at each pixel.

    Args:
        mesh: With uvs where a material has a texture, and tangents where one has a normal map.
        camera: The view, for the textures' footprints.
        surface: What it sees of the mesh.
        materials: How the mesh looks; none for plain white.
        face_materials: For each face, the index of its material; not needed for one.

    Raises:
        ValueError: If the mesh lacks uvs, tangents or ``face_materials`` where they are needed.

    Differentiability:
        In texels, colors, uvs, tangents, normals and, inside each face, positions; see the
        lookups of ``tangentspace``.
    """
    _check(mesh, materials, face_materials)
    inside = [surface.covered]
    if len(materials) > 1:
        ids = gather_faces(jnp.asarray(face_materials)[:, None], surface.face_ids)[..., 0]
        inside = [surface.covered & (ids == k) for k in range(len(materials))]
    regions = [_Region(m, i) for m, i in zip(materials, inside, strict=False)]
    places = _Places(mesh, camera, surface)
    normal, coherence = _normals(mesh, surface, regions, places)
    return Appearance(normal, _colors(surface, regions, places), coherence, _reflectivity(regions))


def edge_appearance(
    appearance: Appearance, surface: Surface, sides: Surface, points: EdgePoints
) -> Appearance:
    """Return how the surfaces on both sides of edges look.

    Args:
        appearance: Of the pixels.
        surface: What the eye sees.
        sides: ``edge_surface(mesh, camera, surface, points)``.
        points: On edges.

    Returns:
        As at the centres of the pixels beside the edge, but with normals turned as the
        surface's are from there to the edge.
    """
    look = jax.tree.map(points.beside, appearance)
    change = sides.normal - points.beside(surface.normal)
    return look._replace(normal=safe_normalize(look.normal + change))


class _Places:
    """Where pixels lie on textures: found when the first texture is looked up, and once."""

    def __init__(self, mesh: Mesh, camera: Camera, surface: Surface) -> None:
        self._mesh, self._camera, self._surface = mesh, camera, surface

    def look_up(self, texture: Texture | MippedTexture) -> Float[Array, "height width channels"]:
        """Return a texture's values at the pixels."""
        return look_up_texture(texture, *self._uvs)

    def coherence(
        self, texture: MippedTexture, normals: Float[Array, "height width 3"]
    ) -> Float[Array, "height width"]:
        """Return the length of the mean of a pixel's normals; 1 where the map is magnified."""
        _, uv_dx, uv_dy = self._uvs
        squared = texel_footprint(uv_dx, uv_dy, texture.mips.size) ** 2
        small = squared <= 1
        beyond_texel = jnp.where(small, 0.0, jnp.sqrt(jnp.where(small, 1.0, squared - 1)))
        return mean_length(normals, footprint=beyond_texel)

    @functools.cached_property
    def _uvs(self) -> tuple[Float[Array, "height width 2"], ...]:
        """The uvs, and how they change to the next pixel on the right and below."""
        mesh, ids = self._mesh, self._surface.face_ids
        height, width = ids.shape
        clip = transform_points(self._camera.clip_from_world(width / height), mesh.positions)
        slopes = barycentric_slopes(clip, mesh.faces, ids)
        uvs = jnp.asarray(mesh.uvs)
        return tuple(
            interpolate(uvs, mesh.faces, ids, weights)
            for weights in (self._surface.weights, *slopes)
        )


def _colors(
    surface: Surface, regions: Sequence[_Region], places: _Places
) -> Float[Array, "height width 3"] | None:
    """Return base colors times textures; None where no material has either."""
    if not any(m.base_color is not None or m.base_color_texture for m, _ in regions):
        return None
    color = jnp.ones_like(surface.normal)
    for material, inside in regions:
        own = None
        if material.base_color is not None:
            own = jnp.stack([jnp.asarray(c, color.dtype) for c in material.base_color])
        if material.base_color_texture is not None:
            texels = places.look_up(material.base_color_texture)
            own = texels if own is None else texels * own
        if own is not None:
            color = jnp.where(inside[..., None], own, color)
    return color


def _normals(
    mesh: Mesh, surface: Surface, regions: Sequence[_Region], places: _Places
) -> tuple[Float[Array, "height width 3"], Float[Array, "height width"] | None]:
    """Return the shading normals, and their coherence where a map with mips was asked."""
    mapped = [(m, m.normal_texture, i) for m, i in regions if m.normal_texture is not None]
    if not mapped:
        return surface.normal, None
    ids, weights = surface.face_ids, surface.weights
    flat = jnp.asarray([0.0, 0.0, 1.0], surface.normal.dtype)
    raw = jnp.broadcast_to(flat, surface.normal.shape)
    anywhere = jnp.zeros_like(surface.covered)
    coherence = None
    for material, texture, inside in mapped:
        normals = decode_normals(places.look_up(texture))
        if isinstance(texture, MippedTexture):
            before = jnp.ones_like(normals[..., 0]) if coherence is None else coherence
            coherence = jnp.where(inside, places.coherence(texture, normals), before)
        if material.normal_scale is not None:
            normals = scale_normals(normals, material.normal_scale)
        raw = jnp.where(inside[..., None], normals, raw)
        anywhere = anywhere | inside
    smooth = interpolate(mesh.normals, mesh.faces, ids, weights)
    tangents = jnp.asarray(mesh.tangents)
    bumped = perturb_normal(raw, interpolate(tangents, mesh.faces, ids, weights), smooth)
    turned = (dot(smooth, surface.normal) < 0)[..., None]
    normal = jnp.where(turned, -bumped, bumped)
    return jnp.where(anywhere[..., None], normal, surface.normal), coherence


def _reflectivity(regions: Sequence[_Region]) -> Float[Array, "height width"] | None:
    """Return the share of the mirrored environment; None where no material mirrors."""
    if not any(material.reflectivity is not None for material, _ in regions):
        return None
    shares = [
        jnp.where(inside, jnp.asarray(material.reflectivity), 0.0)
        for material, inside in regions
        if material.reflectivity is not None
    ]
    return functools.reduce(jnp.add, shares)


def _check(mesh: Mesh, materials: Sequence[Material], face_materials: object) -> None:
    """Refuse a mesh that lacks what its materials need."""
    if len(materials) > 1 and face_materials is None:
        expected = f"expected `face_materials` with {len(materials)} materials"
        raise ValueError(f"surface_appearance: {expected}, got None; give one index per face")
    for material in materials:
        mapped = material.normal_texture is not None
        if mesh.uvs is None and (mapped or material.base_color_texture is not None):
            raise ValueError(
                "surface_appearance: expected a mesh with uvs where a material has a texture, "
                "got None; unwrap the mesh first"
            )
        if mesh.tangents is None and mapped:
            raise ValueError(
                "surface_appearance: expected a mesh with tangents where a material has a normal "
                "map, got None; make them with tangentspace.with_tangents(mesh)"
            )
