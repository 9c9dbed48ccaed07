"""Slow oracles in NumPy float64, written from the definitions and not from the code.

A triangle with corners ``(x_k, y_k, z_k, w_k)`` in clip space covers a centre ``p`` (in NDC)
where the ray through the eye and the centre meets it. With ``r_k = (x_k, y_k) - p w_k``, the
corners relative to that ray, the weight of corner 0 in the point met is proportional to
``cross(r_1, r_2)``, and so on: linear in ``p``, zero on the edge's line. The near and the far
plane give two more such functions, since ``z +- w`` of the point is linear too. Given the sign
of ``sum_k weight_k w_k`` all five are positive inside, whatever the winding, and only for
points in front of the eye.
"""

from typing import NamedTuple

import numpy as np


class RasterReference(NamedTuple):
    """What covers each pixel, and how near the decision was.

    Attributes:
        face_ids: The nearest face, -1 where there is none.
        depth: Window depth; 1 where there is none.
        margin: Distance, in pixels, that the centre would have to move for any one face to
            gain or lose it. Where it is tiny, rounding may decide.
    """

    face_ids: np.ndarray
    depth: np.ndarray
    margin: np.ndarray


class FaceReference(NamedTuple):
    """One face, at every pixel.

    Attributes:
        weights: Of the three corners in the point met, (3, height, width); sum 1.
        depth: Window depth of the face's plane.
        steepness: Largest change of the window depth over a distance of one in NDC.
        inside: Whether the face covers the centre.
        margin: How far it does (positive) or does not, in pixels.
        front: Whether the face is counter-clockwise in NDC.
    """

    weights: np.ndarray
    depth: np.ndarray
    steepness: float
    inside: np.ndarray
    margin: np.ndarray
    front: bool


def pixel_grid(height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Return NDC x and y of the pixel centres, each (height, width), row 0 on top."""
    x = (2 * np.arange(width) + 1) / width - 1
    y = 1 - (2 * np.arange(height) + 1) / height
    x, y = np.meshgrid(x, y)
    return x, y


def face_reference(corners: np.ndarray, height: int, width: int) -> FaceReference | None:
    """Look at a face, given by (3, 4) clip coordinates; None if it has no area.

    A centre on an edge belongs to the face on its right or, if the edge is horizontal, below:
    as if all centres were moved right by an infinitesimal, and down by its square.
    """
    x, y, z, w = corners.astype(np.float64).T
    a, b = [1, 2, 0], [2, 0, 1]
    slope_x, slope_y = y[a] * w[b] - y[b] * w[a], w[a] * x[b] - w[b] * x[a]  # of the weights
    det = x[0] * slope_x[0] + y[0] * slope_y[0] + w[0] * (x[1] * y[2] - x[2] * y[1])
    if det == 0:
        return None
    grid_x, grid_y = pixel_grid(height, width)
    ray_x, ray_y = (v[:, None, None] - g * w[:, None, None] for v, g in ((x, grid_x), (y, grid_y)))
    edges = np.sign(det) * (ray_x[a] * ray_y[b] - ray_x[b] * ray_y[a])
    slopes = np.sign(det) * np.stack([slope_x, slope_y], axis=1)
    met_z, met_w = (np.einsum("khw,k->hw", edges, v) for v in (z, w))
    right, down = slopes[:, 0, None, None], -slopes[:, 1, None, None]
    beside = np.where(edges != 0, edges, np.where(right != 0, right, down))
    inside = np.all(beside > 0, axis=0) & (np.abs(met_z) <= met_w)

    planes = np.concatenate([edges, [met_w + met_z, met_w - met_z]])
    slopes = np.concatenate([slopes, [(w + z) @ slopes, (w - z) @ slopes]])
    steepness = np.hypot(*(z @ slopes[:3])) / np.abs(2 * det)
    per_pixel = np.hypot(*(slopes * 2 / (width, height)).T)[:, None, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        margin = np.min(np.where(planes == 0, 0, planes / per_pixel), axis=0)
        weights = edges / np.sum(edges, axis=0)
        depth = 0.5 * met_z / met_w + 0.5
    return FaceReference(weights, depth, steepness, inside, margin, bool(det > 0))


def rasterize_reference(
    clip_positions: np.ndarray,
    faces: np.ndarray,
    image_size: tuple[int, int],
    cull_back: bool = False,
    cull_front: bool = False,
) -> RasterReference:
    """Test every face at every pixel; the nearest wins, of equally near ones the lowest id."""
    clip_positions = np.asarray(clip_positions, np.float64)
    face_ids = np.full(image_size, -1)
    nearest = np.full(image_size, np.inf)
    margin = np.full(image_size, np.inf)
    for face_id, face in enumerate(np.asarray(faces)):
        corners = clip_positions[face]
        seen = face_reference(corners, *image_size) if np.all(np.isfinite(corners)) else None
        if seen is None or (cull_back and not seen.front) or (cull_front and seen.front):
            continue
        margin = np.minimum(margin, np.abs(seen.margin))
        wins = seen.inside & (seen.depth < nearest)
        face_ids[wins] = face_id
        nearest[wins] = seen.depth[wins]
    return RasterReference(face_ids, np.where(face_ids >= 0, nearest, 1.0), margin)


def plane_reference(
    clip_positions: np.ndarray, faces: np.ndarray, face_ids: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return, at each pixel, the window depth of a given face's plane, and its condition.

    The condition is how much the rounding of coordinates, as a share of each, changes the
    depth: one plus the steepness, times the cancellation in ``w = sum_k weight_k w_k``, which
    is one unless a corner lies behind the eye. Both are 0 where no face is given.
    """
    depth, condition = np.zeros(face_ids.shape), np.zeros(face_ids.shape)
    for face_id in np.unique(face_ids[face_ids >= 0]):
        here = face_ids == face_id
        corners = np.asarray(clip_positions)[np.asarray(faces)[face_id]]
        seen = face_reference(corners, *face_ids.shape)
        assert seen is not None, f"face {face_id} has no area"
        weighted = seen.weights[:, here] * corners[:, 3:]
        cancellation = np.sum(np.abs(weighted), axis=0) / np.abs(np.sum(weighted, axis=0))
        depth[here] = seen.depth[here]
        condition[here] = (1 + seen.steepness) * cancellation
    return depth, condition


def barycentrics_reference(
    clip_positions: np.ndarray, faces: np.ndarray, face_ids: np.ndarray
) -> np.ndarray:
    """Return the weights with which the corners add up to the point seen; 0 where none is.

    Solved from the definition: ``sum_k b_k V_k`` lies on the pixel's ray, ``sum_k b_k = 1``.
    """
    x, y = pixel_grid(*face_ids.shape)
    weights = np.zeros((*face_ids.shape, 3))
    for row, column in zip(*np.nonzero(face_ids >= 0), strict=True):
        corners = np.asarray(clip_positions, np.float64)[np.asarray(faces)[face_ids[row, column]]]
        on_ray = np.array([x[row, column], y[row, column], 1.0])
        solution = np.linalg.solve(corners[:, [0, 1, 3]].T, on_ray)
        weights[row, column] = solution / np.sum(solution)
    return weights


def look_up_reference(
    shadow_map: np.ndarray,
    u: np.ndarray,
    v: np.ndarray,
    depth: np.ndarray,
    *,
    bias: float = 0.0,
    bilinear: bool = False,
) -> np.ndarray:
    """Return the visibility, 1 = lit, by a hard comparison with a shadow map.

    Args:
        shadow_map: (height, width) window depths; row 0 on top.
        u: Where to look, in texels from the left; the centre of column ``j`` is ``j + 0.5``.
        v: In texels from the top; the centre of row ``i`` is at ``i + 0.5``.
        depth: Window depth of the receivers.
        bias: Subtracted from ``depth``; lit where what is left is <= the map's.
        bilinear: Compare the four nearest texels and blend the answers, not only the nearest.
            A texel outside the map is lit.
    """
    height, width = shadow_map.shape

    def lit(i: int, j: int, receiver: float) -> float:
        if not (0 <= i < height and 0 <= j < width):
            return 1.0
        return float(receiver - bias <= shadow_map[i, j])

    u, v, depth = np.broadcast_arrays(u, v, depth)
    visibility = np.zeros(u.shape)
    for at in np.ndindex(u.shape):
        if not bilinear:
            visibility[at] = lit(int(np.floor(v[at])), int(np.floor(u[at])), depth[at])
            continue
        i, j = int(np.floor(v[at] - 0.5)), int(np.floor(u[at] - 0.5))
        down, right = v[at] - 0.5 - i, u[at] - 0.5 - j
        for di, row_weight in ((0, 1 - down), (1, down)):
            for dj, column_weight in ((0, 1 - right), (1, right)):
                visibility[at] += row_weight * column_weight * lit(i + di, j + dj, depth[at])
    return visibility
