"""Which corner follows which around a vertex: faces paired along edges as MikkTSpace does it.

Two faces are neighbors if they run along one edge in opposite directions. Where more than
two meet, the first with a partner takes the first partner, in the order of the faces.

The reference sorts the edges by their lower, then their higher welded vertex, then the face; but
each loop over ranges leaves out the last range. So the edges with the highest lower vertex
stay in the order in which its quicksort left them, equal ones are not all found side by
side, and a pair is missed now and then. Maps were baked with it: it is repeated here.
"""

import numpy as np
from jaxtyping import Int

SEED = 39871946


def following_corners(welded: Int[np.ndarray, "faces 3"]) -> Int[np.ndarray, " corners"]:
    """Return for each corner the next one around its vertex, at the neighbor across the edge.

    Args:
        welded: Names of the vertices, three different ones per face, as `weld` gives them.

    Returns:
        Corner numbers ``3 * face + corner``, -1 where there is no neighbor. No two corners
        are followed by the same one.
    """
    first, second = welded.ravel(), np.roll(welded, -1, axis=1).ravel()
    low, high = np.minimum(first, second), np.maximum(first, second)
    keys = low * (high.max(initial=0) + 1) + high
    sequence = np.arange(len(keys))
    last = np.flatnonzero(low == low.max(initial=0))
    if len(last) > 2:  # else either order pairs the same
        last = last[_quicksorted_ties(low)]
        runs = np.cumsum(np.diff(high[last], prepend=high[last[0]]) != 0)
        keys[last] = keys.max() + 1 + runs
        unsorted = last[runs == runs[-1]]
        sequence[np.sort(unsorted)] = unsorted
    one, other = _pairs(keys, first < second, sequence)
    following = np.full(len(keys), -1)
    following[one], following[other] = next_in_face(other), next_in_face(one)
    return following


def next_in_face(corners: Int[np.ndarray, "..."]) -> Int[np.ndarray, "..."]:
    """Return the numbers of the corners that come next in the same face."""
    return np.where(corners % 3 == 2, corners - 2, corners + 1)


def _pairs(
    keys: Int[np.ndarray, " edges"], forward: np.ndarray, sequence: Int[np.ndarray, " edges"]
) -> tuple[Int[np.ndarray, " pairs"], Int[np.ndarray, " pairs"]]:
    """Pair the k-th edge forward with the k-th edge backward among those of equal keys.

    This is what taking the first free partner in turn amounts to: when an edge's turn comes
    all before it in its direction are paired, or were refused, and then it is refused too.
    """
    directed = 2 * keys + forward
    order = sequence[np.argsort(directed[sequence], kind="stable")]
    is_first = np.diff(directed[order] >> 1, prepend=-1) != 0
    starts = np.flatnonzero(is_first)
    backward = np.add.reduceat(~forward[order], starts, dtype=np.int64)
    counts = np.diff(starts, append=len(order))
    pairs = np.minimum(backward, counts - backward)
    one = np.arange(pairs.sum()) + np.repeat(starts - np.cumsum(pairs) + pairs, pairs)
    return order[one], order[one + np.repeat(backward, pairs)]


def _quicksorted_ties(values: Int[np.ndarray, " edges"]) -> Int[np.ndarray, " ties"]:
    """Return how the reference's quicksort of ``values`` arranges those equal to the maximum.

    Only ranges with two of them matter: nearly always one range per depth. A range is
    partitioned around a pivot drawn by the seed; the pointers that walk inwards stop at
    values not below and not above it, and exchange what they stopped at until they cross.

    Returns:
        For each tie in its final order, how many ties came before it at first.
    """
    ties = values == values.max()
    values, rank = values.copy(), np.cumsum(ties) - 1
    top, ranges = values.max(), [(0, len(values), SEED)]
    while ranges:
        start, stop, seed = ranges.pop()
        value, name = values[start:stop], rank[start:stop]  # views
        if np.count_nonzero(value == top) < 2 or len(value) == 2:
            continue
        turn = seed & 31
        seed = (seed + (seed << turn | seed >> (32 - turn)) + 3) & 0xFFFFFFFF
        pivot = value[seed % len(value)]
        up, down = np.flatnonzero(value >= pivot), np.flatnonzero(value <= pivot)[::-1]
        shorter = min(len(up), len(down))
        swaps = np.count_nonzero(up[:shorter] <= down[:shorter])
        left, right = up[:swaps], down[:swaps]
        value[left], value[right] = value[right], value[left]
        name[left], name[right] = name[right], name[left]
        low, high = left[-1] + 1, right[-1] - 1
        if low <= high:  # the pointers walk on to the next stop, at most to the last exchange
            low = min(up[swaps], right[-1]) if swaps < len(up) else right[-1]
            high = max(down[swaps], left[-1]) if swaps < len(down) else left[-1]
        ranges += [(start, start + high + 1, seed), (start + low, stop, seed)]
    return rank[values == top]
