"""Vertices as seen along the way from one texel's centre to the next, and what follows.

A way leads along a row or a column of an image. Seen from its start, a vertex lies so far along
it and so far across, both in texels times w: so a small edge near by loses no digits, and nothing
is divided before it must be.
"""

import functools
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from tangentspace._math import safe_divide

from ._fragments import get
from .interpolate import ClipPositions, Faces

Length = Float[Array, " ways"]
Index = Int[Array, " ways"]


class Screen(NamedTuple):
    """A mesh in an image.

    Attributes:
        column: Of vertices, in texels from the left, times w.
        row: In texels from the top, times w.
        depth: Window depth, times w.
        w: Of clip space.
        corners: For each face its three vertices.
    """

    column: Float[Array, " vertices"]
    row: Float[Array, " vertices"]
    depth: Float[Array, " vertices"]
    w: Float[Array, " vertices"]
    corners: tuple[Int[Array, " faces"], ...]

    @staticmethod
    def of(clip_positions: ClipPositions, faces: Faces, height: int, width: int) -> "Screen":
        """Place a mesh in an image of so many texels."""
        x, y, z, w = jnp.asarray(clip_positions).T
        column, row, depth = 0.5 * width * (w + x), 0.5 * height * (w - y), 0.5 * (w + z)
        return Screen(column, row, depth, w, tuple(jnp.asarray(faces, jnp.int32).T))

    def at_corners(self) -> "Screen":
        """Return the same with vertices of its own for each corner, three from each face on."""
        corners = jnp.stack(self.corners, axis=1).reshape(-1)
        column, row, depth, w = (get(axis, corners) for axis in self[:4])
        each = tuple(jnp.arange(corners.size, dtype=jnp.int32).reshape(-1, 3).T)
        return Screen(column, row, depth, w, each)

    def corners_of(self, face: Index) -> list[Index]:
        """Return the vertices of faces; those of face 0 where there is none."""
        return [get(corner, jnp.maximum(face, 0)) for corner in self.corners]


class Ways(NamedTuple):
    """Ways from a texel's centre to that of a neighbour.

    Attributes:
        texel: Index into the flattened image.
        side: Of the neighbour: 0 to the right, 1 to the left, 2 below, 3 above.
        width: Of the image.
    """

    texel: Index
    side: Index
    width: int

    @property
    def other(self) -> Index:
        """The neighbour."""
        step = jnp.where(self.side < 2, 1, self.width)
        return jnp.where(self.side % 2 == 0, self.texel + step, self.texel - step)

    @property
    def back(self) -> "Ways":
        """The same from the neighbour."""
        return Ways(self.other, self.side ^ 1, self.width)


class Points(NamedTuple):
    """Vertices seen from the start of each way, in texels times w."""

    along: Length
    across: Length
    w: Length


def place(screen: Screen, ways: Ways, vertex: Index) -> Points:
    """Return where vertices lie."""
    column, row, w = (get(axis, vertex) for axis in (screen.column, screen.row, screen.w))
    column = column - ((ways.texel % ways.width).astype(w.dtype) + 0.5) * w
    row = row - ((ways.texel // ways.width).astype(w.dtype) + 0.5) * w
    along, across = jnp.where(ways.side < 2, column, row), jnp.where(ways.side < 2, row, column)
    return Points(jnp.where(ways.side % 2 == 0, along, -along), across, w)


def edge_crossing(a: Points, b: Points) -> Length:
    """Return how far along the way the line through two points crosses it."""
    w = a.w * b.across - b.w * a.across
    return safe_divide(a.along * b.across - b.along * a.across, w)


class FacePlane(NamedTuple):
    """The window depth of a face's plane, seen from the start of each way.

    Attributes:
        depth: At the start.
        per_along: Change from a texel to the next along the way.
        per_across: The same across it.
        nearest: Depth of the nearest vertex.
        farthest: Of the farthest.
    """

    depth: Length
    per_along: Length
    per_across: Length
    nearest: Length
    farthest: Length

    def at(self, along: Length | float) -> Length:
        """Return the depth along the way, no nearer or farther than the vertices are."""
        return jnp.clip(self.depth + along * self.per_along, self.nearest, self.farthest)


def face_plane(screen: Screen, ways: Ways, face: Index) -> FacePlane:
    """Return the planes of faces; 0 all over for faces without area."""
    corners = screen.corners_of(face)
    points = [place(screen, ways, corner) for corner in corners]
    depths = [get(screen.depth, corner) for corner in corners]
    depth, per_along, per_across, w = [jnp.zeros_like(depths[0])] * 4
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        a, b = points[j], points[k]
        area = a.along * b.across - b.along * a.across
        # The plane is the same sum of what the vertices give as 1 is of their w.
        depth += area * depths[i]
        per_along += (a.across * b.w - b.across * a.w) * depths[i]
        per_across += (a.w * b.along - b.w * a.along) * depths[i]
        w += area * points[i].w
    each = [safe_divide(d, jnp.maximum(p.w, 0)) for d, p in zip(depths, points, strict=True)]
    nearest, farthest = (functools.reduce(f, each) for f in (jnp.minimum, jnp.maximum))
    depth, per_along, per_across = (safe_divide(x, w) for x in (depth, per_along, per_across))
    return FacePlane(depth, per_along, per_across, nearest, farthest)


def line_planes(
    screen: Screen, ways: Ways, hidden: tuple[Index, ...], face_ids: Int[Array, " texels"]
) -> tuple[tuple[FacePlane, FacePlane], ...]:
    """Return, at both ends of each way, the planes of the face seen and of the one behind it.

    Args:
        screen: The mesh in the image.
        ways: Between texels that see surfaces which pass through each other.
        hidden: The faces behind, at the start and at the end.
        face_ids: The face seen at each texel.
    """
    return tuple(
        (face_plane(screen, way, get(face_ids, way.texel)), face_plane(screen, way, behind))
        for way, behind in zip((ways, ways.back), hidden, strict=True)
    )


class Line(NamedTuple):
    """Where surfaces pass through each other, and how the gap between them changes there.

    Attributes:
        along: How far along the way that is.
        per_along: Change of the gap from a texel to the next along the way.
        per_across: The same across it.
    """

    along: Length
    per_along: Length
    per_across: Length


def line_crossing(here: tuple[FacePlane, FacePlane], there: tuple[FacePlane, FacePlane]) -> Line:
    """Return where, along the way, the surfaces of ``line_planes`` pass through each other.

    One of them may bend on the way, from the face at its start to the face at its end: of the
    planes at both ends, those are meant that hold where they meet.
    """
    gap, gap_there = (behind.at(0.0) - seen.at(0.0) for seen, behind in (here, there))
    inwards, inwards_there = (behind.per_along - seen.per_along for seen, behind in (here, there))
    across, across_there = (behind.per_across - seen.per_across for seen, behind in (here, there))
    along = safe_divide(gap, -inwards)
    along_there = 1 - safe_divide(gap_there, -inwards_there)
    ahead = (inwards < 0) & (along <= 1)
    ahead_there = (inwards_there < 0) & (along_there >= 0)
    whole = gap + gap_there
    # The gap is the larger of both planes' where that at the end starts below, else the smaller.
    larger = whole + inwards_there > 0
    later = jnp.where(larger, along_there > along, along_there < along)
    neither, last = ~ahead & ~ahead_there, ahead_there & (~ahead | later)
    either = lambda first, second, between: jnp.where(
        neither, between, jnp.where(last, second, first)
    )
    return Line(
        either(along, along_there, safe_divide(gap, whole)),
        either(inwards, inwards_there, -whole),
        either(across, -across_there, there[0].per_across - here[0].per_across),
    )
