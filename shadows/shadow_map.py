"""The light's pass, and what the shadow test knows about each receiving point.

A ``ShadowMap`` depends on the light and the geometry, not on the eye: keep it while only
the eye or a bias moves. A ``Receiver`` holds a point's place in the map, and how the depth
of its surface changes from texel to texel: from the plane of its face, analytically.

A light that one image cannot serve has several (the faces of a cube, cascades): they lie
along a leading axis, and each point is looked up in the first that holds it.
"""

from typing import Literal, NamedTuple, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from tangentspace._math import dot, safe_divide

from .coverage import coverage, neighbor_depth
from .rasterize import Raster, rasterize, rasterize_two
from .silhouettes import MeshEdges
from .steady_frame import main_plane, steady_frame
from .surface_planes import SurfacePlanes, neighbor_planes, seen_planes
from .transforms import Scalar, texel_from_clip, transform_points

_STEEPEST = 100.0  # tangent of the angle to the light up to which slopes are followed


Coordinates = list[Array]


Casters = Literal["nearest", "back", "two", "planes"]


class NeighborLayer(NamedTuple):
    """What covers the rest of each texel: the surface that a neighbour sees.

    Attributes:
        share: Of the texel, covered by its own surface.
        depth: Window depth of the neighbour's surface, in its plane at the texel's centre.
        second: Of the neighbour's second surface, where casters of two layers were asked for.
        planes: Of the neighbour's surface, where planes were asked for.
    """

    share: Float[Array, "*maps map_height map_width"]
    depth: Float[Array, "*maps map_height map_width"]
    second: Float[Array, "*maps map_height map_width"] | None = None
    planes: SurfacePlanes | None = None


class ShadowMap(NamedTuple):
    """The nearest surface seen from a light.

    Attributes:
        depth: Window depth in [0, 1] of the nearest surface, 1 where there is none.
        clip_from_world: The matrix that it was made with; one for each image.
        second: Depth of the second surface, where casters of two layers were asked for.
        neighbor: What covers the rest of each texel; None where edges have no derivatives.
        planes: Of the nearest surface, where they were asked for: a comparison that follows
            the receiver's plane follows these too.
    """

    depth: Float[Array, "*maps map_height map_width"]
    clip_from_world: Float[Array, "*maps 4 4"]
    second: Float[Array, "*maps map_height map_width"] | None = None
    neighbor: NeighborLayer | None = None
    planes: SurfacePlanes | None = None

    @property
    def texel_from_world(self) -> Float[Array, "*maps 4 4"]:
        """The matrix to (column, row, window depth, 1) times w."""
        height, width = self.depth.shape[-2:]
        viewport = texel_from_clip(height, width, dtype=self.depth.dtype)
        return jnp.matmul(viewport, self.clip_from_world, precision="highest")


def render_shadow_map(
    positions: Float[Array | np.ndarray, "vertices 3"],
    faces: Int[Array | np.ndarray, "faces 3"],
    clip_from_world: Float[Array, "*maps 4 4"],
    *,
    map_size: int,
    casters: Casters = "nearest",
    edges: MeshEdges | None = None,
) -> ShadowMap:
    """Rasterize the scene's depth from a light.

    Args:
        positions: Vertices, world space.
        faces: Vertex indices.
        clip_from_world: Of the light, for example ``light.clip_from_world(positions)``; of
            several images, the map has as many, made one after another.
        map_size: Texels on each side.
        casters: ``nearest`` surface; only ``back`` faces, turned away from the light, so
            that lit faces cannot shade themselves (wants closed meshes, and leaks where
            surfaces meet); ``two``, the nearest surface and the one behind it; or the nearest
            surface and the ``planes`` of its faces.
        edges: ``mesh_edges(positions, faces)``, to know which share of each texel its surface
            covers, so that shadow edges have derivatives; None for not to compute that.

    Raises:
        ValueError: If ``casters`` is none of these, or ``edges`` are another mesh's.

    Differentiability:
        As ``rasterize``: the depth follows the plane of the face seen at each texel. With
        ``edges`` also as ``coverage``: edges move with vertices and light.

    References:
        L. Williams, "Casting Curved Shadows on Curved Surfaces", SIGGRAPH 1978.
    """
    if casters not in get_args(Casters):
        raise ValueError(
            f"render_shadow_map: expected `casters` nearest, back, two or planes, got {casters!r}"
        )
    positions, size = jnp.asarray(positions), (map_size, map_size)
    steady = None if edges is None else main_plane(positions, faces)

    def one(matrix: Float[Array, "4 4"]) -> ShadowMap:
        if steady is not None:
            matrix = steady_frame(matrix, steady)
        clip = transform_points(matrix, positions)
        rasters: tuple[Raster, ...]
        if casters == "two":
            rasters = rasterize_two(clip, faces, image_size=size)
        else:
            rasters = (rasterize(clip, faces, image_size=size, cull_front=casters == "back"),)
        depth, *others = (raster.depth for raster in rasters)
        second = others[0] if others else None
        planes = seen_planes(clip, faces, rasters[0]) if casters == "planes" else None
        if edges is None:
            return ShadowMap(depth, matrix, second, planes=planes)
        covers = coverage(clip, faces, edges, rasters[0].face_ids)
        depths = (neighbor_depth(clip, faces, covers, raster) for raster in rasters)
        beside = None if planes is None else neighbor_planes(planes, covers)
        neighbor = NeighborLayer(covers.share, *depths, planes=beside)
        return ShadowMap(depth, matrix, second, neighbor, planes)

    matrix = jnp.asarray(clip_from_world)
    if matrix.ndim == 2:
        return one(matrix)
    # One after another, where a choice by what was found must not become both.
    return jax.vmap(one)(matrix) if edges is None else lax.map(one, matrix)


class PlaneSlope(NamedTuple):
    """How far a comparison follows the plane of the receiver, from it to a texel's centre.

    Attributes:
        nearer: Share of the plane's change of depth that counts where the plane comes
            nearer to the light.
        farther: The same where it recedes.
    """

    nearer: Scalar
    farther: Scalar


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
        place_resolution: Differences of ``column`` and ``row`` below this are rounding, texels.
        nearness: 1 over the distance to the light; 0 for parallel light.
        texel_length: Width of a texel at the point, world units; its longer side.
        outside: True where the point lies behind the light or beyond the map's depths.
        position: World space.
        normal: Unit normal of the face, world space, on the side of the light or not.
        to_light: Unit vector towards the light, world space.
        texel_from_world: The map's matrix, to (column, row, window depth, 1) times w.
        map_index: Which of several maps each point is in; None if there is one.
        plane: How far comparisons follow the point's plane; None for not at all.
    """

    column: Float[Array, "*points"]
    row: Float[Array, "*points"]
    depth: Float[Array, "*points"]
    depth_bias: Float[Array, "*points"]
    depth_per_column: Float[Array, "*points"]
    depth_per_row: Float[Array, "*points"]
    depth_rate: Float[Array, "*points"]
    depth_resolution: Float[Array, "*points"]
    place_resolution: Float[Array, "*points"]
    nearness: Float[Array, "*points"]
    texel_length: Float[Array, "*points"]
    outside: Bool[Array, "*points"]
    position: Float[Array, "*points 3"]
    normal: Float[Array, "*points 3"]
    to_light: Float[Array, "*points 3"]
    texel_from_world: Float[Array, "*maps 4 4"]
    map_index: Int[Array, "*points"] | None = None
    plane: PlaneSlope | None = None

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
            map_index=self.map_index,
        )
        return moved._replace(depth_bias=self.depth_bias, plane=self.plane)

    def at_texel(
        self, across: Float[Array, "*points"], down: Float[Array, "*points"]
    ) -> "Receiver":
        """Return what a texel so many columns and rows away is compared with."""
        if self.plane is None:
            return self
        change = across * self.depth_per_column + down * self.depth_per_row
        followed = jnp.where(change < 0, self.plane.nearer, self.plane.farther) * change
        return self._replace(depth=self.depth + followed)


def choose_map(
    position: Float[Array, "*points 3"], shadow_map: ShadowMap, *, reach: Scalar = 0.0
) -> Int[Array, "*points"] | None:
    """Return the first of several maps that holds each point with all that a filter reads.

    Args:
        position: World space.
        shadow_map: Of one image or several.
        reach: Texels from a point to the farthest texel centre that is read.

    Returns:
        Indices; where no map holds all, the first that holds the point, and 0 where none
        does. None for a map of one image.
    """
    if shadow_map.depth.ndim == 2:
        return None
    count, height, width = shadow_map.depth.shape
    point = [lax.stop_gradient(position[..., k]) for k in range(3)]
    margin = lax.stop_gradient(jnp.asarray(reach))
    best = jnp.full(position.shape[:-1], -1.0, position.dtype)
    index = jnp.zeros(position.shape[:-1], jnp.int32)
    matrices = lax.stop_gradient(shadow_map.texel_from_world)
    for k in reversed(range(count)):
        matrix = matrices[k]
        column, row, depth, w = (_affine(matrix[j, :3], point, matrix[j, 3]) for j in range(4))
        # All times w: nothing is divided, and nothing behind the eye passes.
        sides = jnp.minimum(
            jnp.minimum(column, width * w - column), jnp.minimum(row, height * w - row)
        )
        within = (w > 0) & (depth >= 0) & (depth <= w)
        level = jnp.where(within, 0.0 + (sides >= 0) + (sides >= margin * w), -1.0)
        index = jnp.where(level >= best, k, index)
        best = jnp.maximum(level, best)
    return jnp.where(best > 0, index, 0)


def receive(
    position: Float[Array, "*points 3"],
    normal: Float[Array, "*points 3"],
    to_light: Float[Array, "*points 3"],
    texel_from_world: Float[Array, "*maps 4 4"],
    *,
    map_index: Int[Array, "*points"] | None = None,
) -> Receiver:
    """Locate points in a light's map.

    Args:
        position: World space.
        normal: Unit normals of the faces (not the shading normals), world space. A zero
            normal gets a zero gradient.
        to_light: Unit vectors towards the light, world space.
        texel_from_world: ``shadow_map.texel_from_world``.
        map_index: ``choose_map(position, shadow_map)``, if there are several maps.

    Differentiability:
        Smooth in everything where the point lies in front of the light and its plane is
        not seen edge-on from there; finite everywhere.
    """
    # Written out by coordinate: several times faster on a CPU than products of small arrays.
    matrices = jnp.asarray(texel_from_world)
    matrix = _entries(matrices, map_index)
    point = [position[..., k] for k in range(3)]
    ray = [to_light[..., k] for k in range(3)]
    column, row, depth, w = (_affine(matrix[k][:3], point, matrix[k][3]) for k in range(4))
    behind = w <= 0
    w = jnp.where(behind, 1, w)
    column, row, depth = column / w, row / w, depth / w

    nearness = -_affine(matrix[3][:3], ray, 0) / w
    depth_rate = -_affine(matrix[2][:3], ray, 0) / w - depth * nearness
    density = [
        _norm([matrix[axis][k] - texel * matrix[3][k] for k in range(3)])
        for axis, texel in enumerate((column, row))
    ]
    texel_length = w / jnp.minimum(density[0], density[1])
    # Bounds of the rounding of ``matrix @ position``, in window space.
    sizes = [jnp.abs(coordinate) for coordinate in point]
    terms = [_affine([jnp.abs(m) for m in r[:3]], sizes, jnp.abs(r[3])) / w for r in matrix]
    rounding = [
        2 * jnp.finfo(depth.dtype).eps * (term + jnp.abs(value) * terms[3])
        for term, value in zip(terms, (column, row, depth), strict=False)
    ]
    inverse = _entries(jnp.linalg.inv(matrices), map_index)
    gradient = _depth_gradient(point, [normal[..., k] for k in range(3)], inverse)
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
        rounding[2],
        jnp.maximum(rounding[0], rounding[1]),
        nearness,
        texel_length,
        behind | (depth > 1) | (depth < 0),
        position,
        normal,
        to_light,
        matrices,
        map_index,
    )


def _entries(
    matrices: Float[Array, "*maps 4 4"], map_index: Int[Array, "*points"] | None
) -> list[Coordinates]:
    """Return a matrix's rows, each entry a number or one for each point."""
    if map_index is None:
        return [[matrices[j, k] for k in range(4)] for j in range(4)]

    def pick(numbers: Float[Array, " maps"]) -> Float[Array, "*points"]:
        # Choosing by comparison costs a CPU less than gathering, and its derivative too.
        picked = numbers[0]
        for k in range(1, numbers.shape[0]):
            picked = jnp.where(map_index == k, numbers[k], picked)
        return picked

    return [[pick(matrices[:, j, k]) for k in range(4)] for j in range(4)]


def _depth_gradient(
    point: Coordinates, normal: Coordinates, inverse: list[Coordinates]
) -> Coordinates:
    """Return the slope of each point's plane in window space, where it is a plane again.

    A plane is a row vector, and goes to window space by the inverse of the points' matrix.
    """
    offset = -sum(n * p for n, p in zip(normal, point, strict=True))
    across_u, across_v, along = (
        _affine([inverse[j][k] for j in range(3)], normal, inverse[3][k] * offset) for k in range(3)
    )
    least = 1e-6 * _norm([across_u, across_v])
    edge_on = jnp.abs(along) <= least
    along = jnp.where(edge_on, jnp.where(least > 0, least, 1), along)
    return [-across_u / along, -across_v / along]


def _affine(coefficients: Array | Coordinates, values: Coordinates, constant: Array | int) -> Array:
    x, y, z = (coefficients[k] * values[k] for k in range(3))
    return x + y + z + constant


def _norm(values: Coordinates) -> Array:
    """Return the length, with derivative 0 at 0."""
    squared = sum(v * v for v in values)
    zero = squared == 0
    return jnp.where(zero, 0.0, jnp.sqrt(jnp.where(zero, 1.0, squared)))
