"""Welding as MikkTSpace does it: equal corners, and the corner that stands for them.

Corners are numbered ``3 * face + corner``. Which of several equal corners stands for all
is an accident of the order in which the reference sorts them in place; but the numbers
decide how it pairs edges (`_mikktspace_links`), so the order is followed here to the letter,
all boxes of one level of its recursion at a time.
"""

import numpy as np
from jaxtyping import Float32, Int

CELLS = 2048


def weld(
    positions: Float32[np.ndarray, "vertices 3"],
    normals: Float32[np.ndarray, "vertices 3"],
    uvs: Float32[np.ndarray, "vertices 2"],
    faces: Int[np.ndarray, "faces 3"],
) -> Int[np.ndarray, "faces 3"]:
    """Name each corner by the corner that stands for all with its position, normal and uv.

    Numbers are equal as floats are: 0.0 equals -0.0.
    """
    same = equal_rows(np.hstack([positions, normals, uvs]))[faces.ravel()]
    order = _sorting_order(positions[faces.ravel()])
    chosen = np.zeros(len(positions), np.int64)
    # The last of several assignments to one place counts: so the first in order stays.
    chosen[same[order[::-1]]] = order[::-1]
    return chosen[same].reshape(-1, 3)


def equal_rows(rows: Float32[np.ndarray, "rows columns"]) -> Int[np.ndarray, " rows"]:
    """Number the rows, of an even number of columns: equal rows have equal numbers."""
    pairs = (rows + np.float32(0)).view(np.uint64)  # adding 0 makes 0 of -0
    order = np.lexsort(pairs.T)
    ordered = pairs[order]
    is_new = np.any(ordered[1:] != ordered[:-1], axis=1)
    numbers = np.zeros(len(rows), np.int64)
    numbers[order[1:]] = np.cumsum(is_new)
    return numbers


def _sorting_order(points: Float32[np.ndarray, "points 3"]) -> Int[np.ndarray, " points"]:
    """Return the points' indices in the order in which the reference welds them.

    It throws the points into cells along the longest side of their bounding box, and halves
    the box of each cell's points along its longest side until all points in it are equal.
    """
    cells = _cells(points)
    order = np.argsort(cells, kind="stable")
    counts = np.bincount(cells)
    columns = np.ascontiguousarray(points.T)
    places = np.arange(len(points))  # the places in `order` where boxes are still halved
    while True:
        places, counts = places[np.repeat(counts > 1, counts)], counts[counts > 1]
        if len(places) == 0:
            return order
        values, middle, halve = _longest_sides(columns[:, order[places]], counts)
        going_on = np.repeat(halve, counts)
        places, values = places[going_on], values[going_on]
        counts, middle = counts[halve], middle[halve]
        lower = values < np.repeat(middle, counts)
        order[places], counts = _partition(order[places], lower, counts)


def _cells(points: Float32[np.ndarray, "points 3"]) -> Int[np.ndarray, " points"]:
    """Return each point's cell along the longest side of the bounding box of all."""
    low, high = points.min(axis=0, initial=np.inf), points.max(axis=0, initial=-np.inf)
    axis = _longest(high - low)
    share = (points[:, axis] - low[axis]) / (high[axis] - low[axis])
    cells = np.nan_to_num(CELLS * share, nan=0.0, posinf=0.0).astype(np.int16)
    return np.minimum(cells, CELLS - 1)


def _longest(sides: Float32[np.ndarray, "3 ..."]) -> Int[np.ndarray, "..."]:
    """Return the axis of the longest side, with the reference's choice among equal ones."""
    x, y, z = sides
    return np.where((y > x) & (y > z), 1, np.where(z > x, 2, 0))


def _longest_sides(
    columns: Float32[np.ndarray, "3 points"], counts: Int[np.ndarray, " boxes"]
) -> tuple[Float32[np.ndarray, " points"], Float32[np.ndarray, " boxes"], np.ndarray]:
    """Return the coordinates along each box's longest side, its middle, and if it is inside."""
    starts = np.cumsum(counts) - counts
    low = np.stack([np.minimum.reduceat(column, starts) for column in columns])
    high = np.stack([np.maximum.reduceat(column, starts) for column in columns])
    axis = _longest(high - low)
    boxes = np.arange(len(counts))
    low, high = low[axis, boxes], high[axis, boxes]
    middle = np.float32(0.5) * (high + low)
    values = columns[np.repeat(axis, counts), np.arange(columns.shape[1])]
    return values, middle, (low < middle) & (middle < high)


def _partition(
    items: Int[np.ndarray, " points"], lower: np.ndarray, counts: Int[np.ndarray, " boxes"]
) -> tuple[Int[np.ndarray, " points"], Int[np.ndarray, " halves"]]:
    """Bring the lower items of each box to its front; return them and the counts of halves.

    As an in-place partition does: the first item that must move to the back changes places
    with the last that must move to the front, and so on inwards.
    """
    starts = np.cumsum(counts) - counts
    lower_counts = np.add.reduceat(lower, starts, dtype=np.int64)
    in_front = np.arange(len(items)) < np.repeat(starts + lower_counts, counts)
    from_front, from_back = np.flatnonzero(in_front & ~lower), np.flatnonzero(~in_front & lower)
    moves = np.add.reduceat(in_front & ~lower, starts, dtype=np.int64)
    ends = np.cumsum(moves)
    inwards = np.repeat(2 * ends - moves - 1, moves) - np.arange(len(from_back))
    from_back = from_back[inwards]
    moved = items.copy()
    moved[from_front], moved[from_back] = items[from_back], items[from_front]
    return moved, np.column_stack([lower_counts, counts - lower_counts]).ravel()
