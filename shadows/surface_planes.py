"""The planes of the surfaces in a map, so that depths are known beside texels' centres too."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from tangentspace._math import safe_divide

from ._fragments import get
from ._ways import Screen, Ways, face_plane
from .coverage import Coverage
from .interpolate import ClipPositions, FaceIds, Faces
from .rasterize import Raster

Image = Float[Array, "*maps map_height map_width"]


class SurfacePlanes(NamedTuple):
    """What the depth of a surface is round where it was seen.

    Attributes:
        depth: Window depth there.
        across: Columns from the texel's centre to there; None for at the centre.
        down: Rows to there.
        depth_per_column: Change of the depth from one column to the next.
        depth_per_row: From one row to the next.
        farthest: Depth of the face's farthest vertex, beyond which it does not go on; 1 where
            no surface was seen.
    """

    depth: Image
    across: Image | None
    down: Image | None
    depth_per_column: Image
    depth_per_row: Image
    farthest: Image


def seen_planes(clip_positions: ClipPositions, faces: Faces, raster: Raster) -> SurfacePlanes:
    """Return the planes of what is seen at texels' centres.

    Args:
        clip_positions: Vertices in clip space.
        faces: Vertex indices.
        raster: What ``rasterize`` found.

    Differentiability:
        As the depth of ``rasterize``.
    """
    height, width = raster.face_ids.shape
    screen = Screen.of(clip_positions, faces, height, width)
    at = get(screen.column, screen.corners[0]), get(screen.row, screen.corners[0])
    w = get(screen.w, screen.corners[0])
    # Looked at from a texel close by, small faces lose no digits.
    column, row = (
        jnp.clip(safe_divide(place, w), 0, size - 1).astype(jnp.int32)
        for place, size in zip(at, (width, height), strict=True)
    )
    face = jnp.arange(column.size, dtype=jnp.int32)
    plane = face_plane(screen, Ways(row * width + column, jnp.zeros_like(face), width), face)
    return SurfacePlanes(
        raster.depth,
        None,
        None,
        _at_texels(plane.per_along, raster.face_ids, 0.0),
        _at_texels(plane.per_across, raster.face_ids, 0.0),
        _at_texels(plane.farthest, raster.face_ids, 1.0),
    )


def neighbor_planes(planes: SurfacePlanes, coverage: Coverage) -> SurfacePlanes:
    """Return the planes of what is seen at the neighbour whose layer reaches into each texel.

    Args:
        planes: ``seen_planes`` of the map.
        coverage: Says which neighbour; the texel itself where its own layer covers all.
    """
    height, width = coverage.side.shape
    side = coverage.side.reshape(-1)
    texel = jnp.arange(side.size, dtype=jnp.int32)
    other = jnp.where(side < 0, texel, Ways(texel, side, width).other)
    sides = jnp.array([[1, -1, 0, 0, 0], [0, 0, 1, -1, 0]], planes.depth.dtype)
    across, down = (get(steps, side % 5).reshape(height, width) for steps in sides)
    there = lambda image: get(image.reshape(-1), other).reshape(height, width)
    return SurfacePlanes(there(planes.depth), across, down, *map(there, planes[3:]))


def _at_texels(
    values: Float[Array, " faces"], face_ids: FaceIds, none: float
) -> Float[Array, "height width"]:
    index: Int[Array, "height width"] = jnp.maximum(face_ids, 0)
    return jnp.where(face_ids >= 0, get(values, index), none)
