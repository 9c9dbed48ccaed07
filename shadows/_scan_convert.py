"""The geometry of scan conversion: rows of a face, spans of a row, and work lists.

A face meets a row of pixels where it meets the plane through the eye and the row's centre
line. That intersection is a segment in clip space whose two ends lie on two edges; its part
in front of the eye, projected, gives the span of pixels, and near and far plane are left to
each pixel's depth. So triangles are never split, no digits are lost to a vertex made close
to the eye, and nothing is divided by a w that could vanish.

The ends are computed from the two vertices of an edge in an order that does not depend on
the face (the vertex on or above the row first), by the same operations: two faces that
share an edge find the same number, and between them no pixel is missed or covered twice.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from tangentspace._fusion import once

_BLOCK = 64
Triple = list[Float[Array, " items"]]
Corners = Float[Array, "corners=3 faces"]


class Spans(NamedTuple):
    """Runs of pixels, one row each; ``length`` is 0 where a row holds nothing.

    Attributes:
        column: First pixel.
        length: Number of pixels.
        depth: NDC depth at the first pixel's centre.
        slope: Change of the depth from one pixel to the next.
        front: Whether the face is seen counter-clockwise. Told by which of the span's ends
            is on the left, so that it never contradicts the pixels covered: of faces that
            close a surface, as many front as back ones lie over each pixel, or the eye is
            inside.
    """

    column: Int[Array, " items"]
    length: Int[Array, " items"]
    depth: Float[Array, " items"]
    slope: Float[Array, " items"]
    front: Bool[Array, " items"]


def prefix_sum(counts: Int[Array, " items"]) -> Int[Array, " items"]:
    """Return the inclusive sums of numbers of at most 2**14 each.

    Within blocks by a product with a triangular matrix, which is exact in float32 in that
    range; three to four times as fast on a CPU as a running sum.
    """
    size = counts.shape[0]
    blocks = jnp.pad(counts, (0, -size % _BLOCK)).reshape(-1, _BLOCK).astype(jnp.float32)
    upper = jnp.triu(jnp.ones((_BLOCK, _BLOCK), jnp.float32))
    within = jnp.matmul(blocks, upper, precision="highest").astype(jnp.int32)
    before = once(jnp.cumsum(within[:, -1], dtype=jnp.int32) - within[:, -1])
    return (within + before[:, None]).reshape(-1)[:size]


def owners(starts: Int[Array, " owners"], first: Int[Array, ""], size: int) -> Int[Array, " items"]:
    """Return who owns the items ``first .. first + size`` of a list of runs.

    Args:
        starts: Where each owner's run starts, not decreasing.
        first: The first item asked for.
        size: How many items are asked for.

    Returns:
        The last owner whose run starts at or before each item.
    """
    offset = starts - first
    before = jnp.sum(offset < 0, dtype=jnp.int32)
    inside = jnp.where((offset >= 0) & (offset < size), offset, size)
    marks = jnp.zeros(size, jnp.int32).at[inside].add(1, mode="drop")
    return jnp.clip(prefix_sum(marks) + (before - 1), 0, starts.shape[0] - 1)


def row_ranges(
    clip: Float[Array, "axes=4 corners=3 faces"],
    height: int,
    *,
    cull_back: bool,
    cull_front: bool,
    cull_far: bool,
) -> tuple[Int[Array, " faces"], Int[Array, " faces"]]:
    """Return the first row and the number of rows that each face may meet.

    The range may hold a row too many, never one too few. Faces outside the view or with a
    coordinate that is not finite have none.
    """
    x, y, z, w = clip
    front = w > 0
    row = 0.5 * height * (1 - y / jnp.where(front, w, 1))
    low = jnp.min(jnp.where(front, row, jnp.inf), axis=0)
    high = jnp.max(jnp.where(front, row, -jnp.inf), axis=0)
    for a, b in ((0, 1), (1, 2), (2, 0)):
        crosses = front[a] != front[b]
        # Where w reaches 0 the image of the edge runs to infinity, up or down.
        upwards = jnp.abs(w[a]) * y[b] + jnp.abs(w[b]) * y[a] > 0
        cut = jnp.where(upwards, -jnp.inf, jnp.inf)
        low = jnp.minimum(low, jnp.where(crosses, cut, jnp.inf))
        high = jnp.maximum(high, jnp.where(crosses, cut, -jnp.inf))
    visible = jnp.any(front, axis=0) & jnp.all(jnp.isfinite(clip), axis=(0, 1))
    for outside in (x < -w, x > w, z < -w, (z > w) & cull_far):
        visible &= ~jnp.all(outside, axis=0)
    if cull_back or cull_front:
        area = signed_area(x, y, w)
        visible &= ~((area <= 0) & cull_back) & ~((area >= 0) & cull_front)
    slack = 4 * height * float(jnp.finfo(x.dtype).eps)
    first = jnp.ceil(jnp.clip(low - 0.5 - slack, 0, height)).astype(jnp.int32)
    last = jnp.ceil(jnp.clip(high - 0.5 + slack, 0, height)).astype(jnp.int32)
    return first, jnp.where(visible, jnp.maximum(last - first, 0), 0)


def signed_area(x: Corners, y: Corners, w: Corners) -> Float[Array, " faces"]:
    """Return a number of the sign of each face's area in NDC, front faces positive.

    Relative to a ray through the first corner: that leaves the determinant as it is, and
    no digits are lost for small faces.
    """
    safe_w = jnp.where(w[0] == 0, 1, w[0])
    x = x - x[0] / safe_w * w
    y = y - y[0] / safe_w * w
    first, second, third = (
        w[i] * (x[j] * y[k] - x[k] * y[j]) for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1))
    )
    return first + second + third


def spans(
    x: Triple, y: Triple, z: Triple, w: Triple, row: Int[Array, " items"], height: int, width: int
) -> Spans:
    """Return the pixels of a row whose centres lie in a face.

    Half-open to the right, and rows half-open downwards: a centre on an edge belongs to
    the face on its right, or below it.

    Args:
        x: Clip-space x of the three vertices of each item's face.
        y: The same for y.
        z: The same for z.
        w: The same for w.
        row: The row of each item.
        height: Rows of the image.
        width: Columns of the image.
    """
    y_row = 1 - (2 * row + 1).astype(x[0].dtype) / height
    height_over_row = [yk - y_row * wk for yk, wk in zip(y, w, strict=True)]
    above = [h >= 0 for h in height_over_row]
    cut = _Cut(height_over_row, above)
    (x_p, x_q), (z_p, z_q), (w_p, w_q) = cut(x), cut(z), cut(w)
    meets = ~((above[0] == above[1]) & (above[1] == above[2])) & ((w_p > 0) | (w_q > 0))

    # An end behind the eye: the image of the segment runs to infinity where w reaches 0.
    def project(x: Array, w: Array, other_x: Array, other_w: Array) -> Array:
        column = x / jnp.where(w > 0, w, 1) * (0.5 * width) + (0.5 * width - 0.5)
        return jnp.where(w > 0, column, jnp.where(other_w * x > w * other_x, jnp.inf, -jnp.inf))

    ends = project(x_p, w_p, x_q, w_q), project(x_q, w_q, x_p, w_p)
    column = jnp.ceil(jnp.clip(jnp.minimum(*ends), 0, width))
    after = jnp.ceil(jnp.clip(jnp.maximum(*ends), 0, width))
    length = jnp.where(meets & (after > column), after - column, 0)

    # Depth from coordinates relative to the first pixel: no digits lost on steep faces.
    x_first = (2 * column + 1) / width - 1
    e_p, e_q = cut([xk - x_first * wk for xk, wk in zip(x, w, strict=True)])

    def depth_at(distance: Array) -> Array:
        a, b = e_p - distance * w_p, e_q - distance * w_q
        bottom = a * w_q - b * w_p
        return (a * z_q - b * z_p) / jnp.where(bottom == 0, 1, bottom)

    depth = depth_at(jnp.zeros_like(column))
    steps = jnp.maximum(length - 1, 0)
    slope = (depth_at(steps * (2 / width)) - depth) / jnp.maximum(steps, 1)
    front = (ends[0] < ends[1]) == cut.alone_above
    return Spans(column.astype(jnp.int32), length.astype(jnp.int32), depth, slope, front)


class _Cut:
    """Where a row's plane cuts the two edges that leave the vertex alone on its side.

    A cut of the edge from ``a`` (on or above the row, by ``h_a``) to ``b`` (below it) is
    the homogeneous point ``h_a b - h_b a``: both weights are positive, nothing cancels. A
    vertex on the row is its own cut, so that all edges from it meet the row in one number.
    """

    def __init__(self, heights: Triple, above: list[Bool[Array, " items"]]):
        self._alone_0 = above[1] == above[2]
        self._alone_1 = ~self._alone_0 & (above[0] == above[2])
        self._heights = self._rotate(heights)
        self.alone_above = self._heights[0] >= 0

    def _rotate(self, values: Triple) -> Triple:
        """Put the lone vertex first."""
        return [
            jnp.where(
                self._alone_0,
                values[k],
                jnp.where(self._alone_1, values[(k + 1) % 3], values[(k + 2) % 3]),
            )
            for k in range(3)
        ]

    def __call__(self, values: Triple) -> Triple:
        """Return a coordinate of the two homogeneous points."""
        alone, *others = self._rotate(values)
        h_alone, *h_others = self._heights
        points = []
        for other, h_other in zip(others, h_others, strict=True):
            above, below = self._sorted(alone, other)
            h_above, h_below = self._sorted(h_alone, h_other)
            points.append(jnp.where(h_above == 0, above, h_above * below - h_below * above))
        return points

    def _sorted(self, alone: Array, other: Array) -> tuple[Array, Array]:
        """Return the values at the edge's upper and lower end."""
        return (
            jnp.where(self.alone_above, alone, other),
            jnp.where(self.alone_above, other, alone),
        )
