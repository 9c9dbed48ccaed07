"""Normals of a triangle mesh, in NumPy: for files that come without, and to find their flaws."""

import numpy as np
from jaxtyping import Bool, Float, Int, Num


def smooth_normals(
    positions: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "faces 3"]
) -> Float[np.ndarray, "vertices 3"]:
    """Return unit normals, each the sum of the face normals round a point by their angles.

    Vertices at exactly the same position count as one, so that neither UV seams nor a
    file without shared vertices makes creases. Where that sum cancels (a sheet with two
    sides), the vertex's own faces decide; where these cancel as well, the result is zero.
    """
    direction, angles = face_normals_and_angles(positions, faces)
    _, point = unique_rows(positions)
    count = len(positions)
    total = _sum_by(point[faces], angles, direction, count)[point]
    own = _sum_by(faces, angles, direction, count)
    weight = np.bincount(point[faces].ravel(), angles.ravel(), count)[point]
    cancels = np.linalg.norm(total, axis=1) <= 1e-6 * weight
    total = np.where(cancels[:, None], own, total)
    total[np.linalg.norm(total, axis=1) <= 1e-6 * weight] = 0
    return unit(total)[0].astype(np.float32)


def unique_rows(
    rows: Num[np.ndarray, "rows columns"],
) -> tuple[Int[np.ndarray, " unique"], Int[np.ndarray, " rows"]]:
    """Return the first index of each different row, rows sorted, and each row's place there."""
    order = np.lexsort(rows.T[::-1])
    new = np.ones(len(rows), bool)
    new[1:] = (rows[order[1:]] != rows[order[:-1]]).any(axis=1)
    place = np.empty(len(rows), np.int64)
    place[order] = np.cumsum(new) - 1
    return order[new], place


def perpendicular(normals: Float[np.ndarray, "vertices 3"]) -> Float[np.ndarray, "vertices 3"]:
    """Return unit vectors at right angles to unit (or zero) normals, otherwise arbitrary."""
    axis = np.eye(3)[np.argmin(np.abs(normals), axis=1)]
    return unit(axis - normals * np.sum(axis * normals, axis=1, keepdims=True))[0]


def face_normals_and_angles(
    positions: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "faces 3"]
) -> tuple[Float[np.ndarray, "faces 3"], Float[np.ndarray, "faces 3"]]:
    """Return unit face normals and the angle at each corner; both 0 for zero-area faces.

    Zero means that double the area is 1e-12 of the longest edge's square, or less: what
    rounding leaves of corners on one line.
    """
    corners = positions.astype(np.float64)[faces]
    ahead = np.roll(corners, -1, axis=1) - corners
    back = np.roll(corners, 1, axis=1) - corners
    cross = np.cross(ahead[:, 0], back[:, 0])
    double_area = np.linalg.norm(cross, axis=1)
    longest = np.max(np.sum(ahead**2, axis=2), axis=1)
    flat = double_area <= 1e-12 * longest
    direction = np.where(flat[:, None], 0, cross / np.where(flat, 1, double_area)[:, None])
    angles = np.arctan2(double_area[:, None], np.sum(ahead * back, axis=2))
    return direction, np.where(flat[:, None], 0, angles)


def unit(
    vectors: Float[np.ndarray, "rows 3"],
) -> tuple[Float[np.ndarray, "rows 3"], Bool[np.ndarray, " rows"]]:
    """Return unit vectors, and where there is none (zero or not finite): zero there."""
    with np.errstate(over="ignore"):
        length = np.linalg.norm(vectors.astype(np.float64), axis=1)
    missing = ~(np.isfinite(length) & (length > 0))
    unit = vectors / np.where(missing, 1, length)[:, None]
    return np.where(missing[:, None], 0, unit), missing


def _sum_by(
    index: Int[np.ndarray, "faces 3"],
    weights: Float[np.ndarray, "faces 3"],
    vectors: Float[np.ndarray, "faces 3"],
    count: int,
) -> Float[np.ndarray, "sums 3"]:
    """Add each face's vector, times the corner's weight, to the sum its corners name."""
    weighted = weights[:, :, None] * vectors[:, None, :]
    columns = [np.bincount(index.ravel(), weighted[:, :, axis].ravel(), count) for axis in range(3)]
    return np.stack(columns, axis=1)
