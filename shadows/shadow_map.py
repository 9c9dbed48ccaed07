"""The light's pass, and what the shadow test knows about each receiving point.

A ``ShadowMap`` depends on the light and the geometry, not on the eye: keep it while only
the eye or a bias moves. A ``Receiver`` holds a point's place in the map, and how the depth
of its surface changes from texel to texel: from the plane of its face, analytically.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from tangentspace._math import dot, safe_divide

from .rasterize import rasterize
from .transforms import Scalar, transform_points

_STEEPEST = 100.0  # tangent of the angle to the light up to which slopes are followed


Coordinates = list[Array]


class ShadowMap(NamedTuple):
    """The nearest surface seen from a light.

    Attributes:
        depth: Window depth in [0, 1] of the nearest surface, 1 where there is none.
        clip_from_world: The matrix that it was made with.
    """

    depth: Float[Array, "map_height map_width"]
    clip_from_world: Float[Array, "4 4"]


def render_shadow_map(
    positions: Float[Array | np.ndarray, "vertices 3"],
    faces: Int[Array | np.ndarray, "faces 3"],
    clip_from_world: Float[Array, "4 4"],
    *,
    map_size: int,
    cull_front: bool = False,
) -> ShadowMap:
    """Rasterize the scene's depth from a light.

    Args:
        positions: Vertices, world space.
        faces: Vertex indices.
        clip_from_world: Of the light, for example ``light.clip_from_world(positions)``.
        map_size: Texels on each side.
        cull_front: Keep only faces turned away from the light, so that lit faces cannot
            shade themselves; wants closed meshes, and leaks where surfaces meet.

    Differentiability:
        As ``rasterize``: the depth follows the plane of the face seen at each texel.

    References:
        L. Williams, "Casting Curved Shadows on Curved Surfaces", SIGGRAPH 1978.
    """
    clip = transform_points(jnp.asarray(clip_from_world), jnp.asarray(positions))
    raster = rasterize(clip, faces, image_size=(map_size, map_size), cull_front=cull_front)
    return ShadowMap(raster.depth, jnp.asarray(clip_from_world))


class Receiver(NamedTuple):
    """Points that receive shadow, as seen in a light's map.

    Attributes:
        column: Place in the map in texels from its left, centres at half integers.
        row: Place in the map in texels from its top.
        depth: Window depth of the point.
        depth_bias: Window depth by which the comparison favors light; added up by biases.
        depth_per_column: Change of the window depth of the point's plane from one column to
            the next; followed up to a slope of 100 (89.4 degrees).
        depth_per_row: The same from one row to the next.
        depth_rate: Window depth that a world length along the ray to the light is worth.
        depth_resolution: Differences of window depth below this are rounding.
        nearness: 1 over the distance to the light; 0 for parallel light.
        texel_length: Width of a texel at the point, world units; its longer side.
        outside: True where the point lies behind the light or beyond the map's depths.
        position: World space.
        normal: Unit normal of the face, world space, on the side of the light or not.
        to_light: Unit vector towards the light, world space.
        texel_from_world: The map's matrix, to (column, row, window depth, 1) times w.
    """

    column: Float[Array, "*points"]
    row: Float[Array, "*points"]
    depth: Float[Array, "*points"]
    depth_bias: Float[Array, "*points"]
    depth_per_column: Float[Array, "*points"]
    depth_per_row: Float[Array, "*points"]
    depth_rate: Float[Array, "*points"]
    depth_resolution: Float[Array, "*points"]
    nearness: Float[Array, "*points"]
    texel_length: Float[Array, "*points"]
    outside: Bool[Array, "*points"]
    position: Float[Array, "*points 3"]
    normal: Float[Array, "*points 3"]
    to_light: Float[Array, "*points 3"]
    texel_from_world: Float[Array, "4 4"]

    @property
    def footprint(self) -> Float[Array, "*points"]:
        """Depth that the plane gains between a texel's centre and its farthest corner.

        The least bias without acne under nearest lookup; 2x2 bilinear needs twice as much.
        """
        return 0.5 * (jnp.abs(self.depth_per_column) + jnp.abs(self.depth_per_row))

    def toward_light(self, length: Scalar | Float[Array, "..."]) -> "Receiver":
        """Favor light by a world length along the ray, exactly also in perspective."""
        share = length * self.nearness
        passed = share >= 1  # beyond the light itself: nothing is left to block
        drop = length * self.depth_rate / jnp.where(passed, 1, 1 - share)
        return self.less_depth(jnp.where(passed, 2.0, drop))

    def less_depth(self, depth: Scalar | Float[Array, "..."]) -> "Receiver":
        """Favor light by a window depth."""
        return self._replace(depth_bias=self.depth_bias + depth)

    def along_normal(self, length: Scalar | Float[Array, "..."]) -> "Receiver":
        """Move by a world length along the normal, to the light's side of the surface."""
        length = jnp.asarray(length)
        side = jnp.where(dot(self.normal, self.to_light) < 0, -length, length)
        moved = receive(
            self.position + side[..., None] * self.normal,
            self.normal,
            self.to_light,
            self.texel_from_world,
        )
        return moved.less_depth(self.depth_bias)


def receive(
    position: Float[Array, "*points 3"],
    normal: Float[Array, "*points 3"],
    to_light: Float[Array, "*points 3"],
    texel_from_world: Float[Array, "4 4"],
) -> Receiver:
    """Locate points in a light's map.

    Args:
        position: World space.
        normal: Unit normals of the faces (not the shading normals), world space. A zero
            normal gets a zero gradient.
        to_light: Unit vectors towards the light, world space.
        texel_from_world: ``texel_from_clip(*map.depth.shape) @ map.clip_from_world``.

    Differentiability:
        Smooth in everything where the point lies in front of the light and its plane is
        not seen edge-on from there; finite everywhere.
    """
    # Written out by coordinate: several times faster on a CPU than products of small arrays.
    matrix = jnp.asarray(texel_from_world)
    point = [position[..., k] for k in range(3)]
    ray = [to_light[..., k] for k in range(3)]
    column, row, depth, w = (_affine(matrix[k, :3], point, matrix[k, 3]) for k in range(4))
    behind = w <= 0
    w = jnp.where(behind, 1, w)
    column, row, depth = column / w, row / w, depth / w

    nearness = -_affine(matrix[3, :3], ray, 0) / w
    depth_rate = -_affine(matrix[2, :3], ray, 0) / w - depth * nearness
    density = [
        _norm([matrix[axis, k] - texel * matrix[3, k] for k in range(3)])
        for axis, texel in enumerate((column, row))
    ]
    texel_length = w / jnp.minimum(density[0], density[1])
    # Bound of the rounding of ``matrix @ position``, in the window depth.
    sizes = [jnp.abs(coordinate) for coordinate in point]
    terms = [_affine(jnp.abs(matrix[k, :3]), sizes, jnp.abs(matrix[k, 3])) / w for k in (2, 3)]
    resolution = 2 * jnp.finfo(depth.dtype).eps * (terms[0] + depth * terms[1])
    gradient = _depth_gradient(point, [normal[..., k] for k in range(3)], matrix)
    steepest = _STEEPEST * jnp.abs(depth_rate) * texel_length
    slope = _norm(gradient)
    limit = jnp.where(slope > steepest, safe_divide(steepest, slope), 1)
    return Receiver(
        column,
        row,
        depth,
        jnp.zeros_like(depth),
        gradient[0] * limit,
        gradient[1] * limit,
        depth_rate,
        resolution,
        nearness,
        texel_length,
        behind | (depth > 1) | (depth < 0),
        position,
        normal,
        to_light,
        matrix,
    )


def _depth_gradient(point: Coordinates, normal: Coordinates, matrix: Array) -> Coordinates:
    """Return the slope of each point's plane in window space, where it is a plane again.

    A plane is a row vector, and goes to window space by the inverse of the points' matrix.
    """
    inverse = jnp.linalg.inv(matrix)
    offset = -sum(n * p for n, p in zip(normal, point, strict=True))
    across_u, across_v, along = (
        _affine(inverse[:3, k], normal, inverse[3, k] * offset) for k in range(3)
    )
    least = 1e-6 * _norm([across_u, across_v])
    edge_on = jnp.abs(along) <= least
    along = jnp.where(edge_on, jnp.where(least > 0, least, 1), along)
    return [-across_u / along, -across_v / along]


def _affine(coefficients: Array, values: Coordinates, constant: Array | int) -> Array:
    x, y, z = (coefficients[k] * values[k] for k in range(3))
    return x + y + z + constant


def _norm(values: Coordinates) -> Array:
    """Return the length, with derivative 0 at 0."""
    squared = sum(v * v for v in values)
    zero = squared == 0
    return jnp.where(zero, 0.0, jnp.sqrt(jnp.where(zero, 1.0, squared)))
