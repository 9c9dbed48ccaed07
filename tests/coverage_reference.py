"""A slow oracle of coverage in NumPy float64, written from what is seen and not from the code.

On the segment between two texel centres, what is seen changes where an outline crosses that
nothing hides: an edge all of whose faces lie on one side of it. If there is one such crossing,
that is it; segments with several are left out.
"""

import itertools
from typing import NamedTuple

import numpy as np


class CrossingReference(NamedTuple):
    """The crossing between two neighbouring texels.

    Attributes:
        first: Row and column of the texel on the left, or above.
        second: Row and column of the other.
        along: How far it is from the first's centre to the crossing, in [0, 1].
        weight: Squared cosine between the segment and the outline's normal, near a corner
            that of its outlines.
    """

    first: tuple[int, int]
    second: tuple[int, int]
    along: float
    weight: float


def screen_points(clip: np.ndarray, height: int, width: int) -> np.ndarray:
    """Return column, row (centres at half integers) and window depth; w must be positive."""
    x, y, z = (np.asarray(clip, np.float64)[:, :3] / np.asarray(clip, np.float64)[:, 3:]).T
    return np.stack([0.5 * width * (1 + x), 0.5 * height * (1 - y), 0.5 * (1 + z)], axis=-1)


def outlines(points: np.ndarray, faces: np.ndarray) -> list[tuple[int, int]]:
    """Return the edges all of whose faces lie on one side of them, in the image."""
    _, same = np.unique(points, axis=0, return_inverse=True)
    same = same.reshape(-1)
    sides: dict[tuple[int, int], list[float]] = {}
    ends: dict[tuple[int, int], tuple[int, int]] = {}
    for a, b, c in faces:
        for p, q, r in ((a, b, c), (b, c, a), (c, a, b)):
            key = (min(same[p], same[q]), max(same[p], same[q]))
            if key[0] == key[1]:
                continue
            p, q = ends.setdefault(key, (p, q))
            u, v = points[q, :2] - points[p, :2], points[r, :2] - points[p, :2]
            sides.setdefault(key, []).append(np.sign(u[0] * v[1] - u[1] * v[0]))
    return [ends[key] for key, found in sides.items() if len(set(found)) == 1]


def crossings(
    points: np.ndarray, faces: np.ndarray, face_ids: np.ndarray
) -> tuple[list[CrossingReference], np.ndarray]:
    """Return the crossings that are without doubt, and where several leave doubt."""
    height, width = face_ids.shape
    edges = np.array(outlines(points, faces)).reshape(-1, 2)
    a, b = points[edges[:, 0]], points[edges[:, 1]]
    found, doubtful = [], np.zeros(face_ids.shape, bool)
    steps = [((0, 1), 0), ((1, 0), 1)]
    for row, column, ((down, right), axis) in itertools.product(range(height), range(width), steps):
        second = row + down, column + right
        if second[0] >= height or second[1] >= width or face_ids[second] == face_ids[row, column]:
            continue
        start = np.array([column + 0.5, row + 0.5])
        over = [end[:, 1 - axis] - start[1 - axis] for end in (a, b)]
        share = np.divide(
            over[0], over[0] - over[1], where=over[0] != over[1], out=np.zeros(len(a))
        )
        place = a + share[:, None] * (b - a)
        along = place[:, axis] - start[axis]
        crosses = ((over[0] >= 0) != (over[1] >= 0)) & (along >= 0) & (along <= 1)
        seen = [k for k in np.flatnonzero(crosses) if not _hidden(place[k], points[faces])]
        if not seen:  # from face to face of one surface
            continue
        if len(seen) > 1:
            doubtful[row, column] = doubtful[second] = True
            continue
        steep = _steep_at(place[seen[0], :2], points[:, :2], edges, seen[0])
        weight = steep if axis == 0 else 1 - steep
        found.append(CrossingReference((row, column), second, along[seen[0]], weight))
    return found, doubtful


def _steep_at(place: np.ndarray, points: np.ndarray, edges: np.ndarray, edge: int) -> float:
    """Return the squared cosine between rows and an outline's normal, near its corners as there.

    At a corner it is the mean over the outlines that meet there; half a texel away the edge's.
    """
    arms = points[edges[:, 1]] - points[edges[:, 0]]
    steep = arms[:, 1] ** 2 / (arms**2).sum(axis=1)
    means, near = [], []
    for end in points[edges[edge]]:
        meets = (points[edges] == end).all(axis=-1).any(axis=-1)
        means.append(steep[meets].mean())
        near.append(max(1 - 4 * ((place - end) ** 2).sum(), 0) ** 2)
    parts = np.array(
        [near[0] * (1 - near[1]), near[1] * (1 - near[0]), (1 - near[0]) * (1 - near[1])]
    )
    return float(parts @ [*means, steep[edge]] / parts.sum())


def shares(found: list[CrossingReference], shape: tuple[int, int]) -> np.ndarray:
    """Return which share of each texel its own surface covers."""
    share = np.ones(shape)
    for crossing in found:
        cut = crossing.first if crossing.along < 0.5 else crossing.second
        share[cut] -= crossing.weight * abs(crossing.along - 0.5)
    return np.maximum(share, 0)


def _hidden(place: np.ndarray, corners: np.ndarray) -> bool:
    """Whether a face lies before a point."""
    p = corners[:, :, :2] - place[:2]
    areas = np.stack(
        [p[:, j, 0] * p[:, k, 1] - p[:, j, 1] * p[:, k, 0] for j, k in ((1, 2), (2, 0), (0, 1))]
    )
    total = areas.sum(axis=0)
    weights = np.divide(areas, total, where=total != 0, out=np.full_like(areas, -1.0))
    depth = (weights * corners[:, :, 2].T).sum(axis=0)
    return bool(np.any((weights > 1e-9).all(axis=0) & (depth < place[2] - 1e-9)))
