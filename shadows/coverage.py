"""Which share of each texel its own surface covers, so that edges have derivatives.

A rasterizer tells which face lies over the centre of a texel: an integer, which jumps when
an edge passes. But between the centres of two neighbouring texels that see different
surfaces an edge crosses, and where it crosses follows the vertices smoothly. Of the two
texels, the one whose centre is nearer to the crossing belongs in part to its neighbour: two
layers at one texel, its own and its neighbour's, and a share.

To find the edge, the surface seen at a texel is followed towards the other, face by face over
the edges that they share, to the first edge where it ends (an open border) or turns back (a
silhouette). So it does not matter how small the faces are. Where neither surface ends, but
each lies behind the other at the other's centre, they pass through each other, and the line
where they do takes the edge's place.

An edge is seen by the pairs along rows and by those along columns; each counts by the squared
cosine between the pair and the edge's normal, which add to 1. Summed along an edge, shares
are then areas, whatever way it runs, and no sudden choice between rows and columns is made.

What lies between the centres of texels and over none of them is not seen.

References:
    S. Laine, J. Hellsten, T. Karras, Y. Seol, J. Lehtinen, T. Aila, "Modular Primitives for
    High-Performance Differentiable Rendering", SIGGRAPH Asia 2020, section 3.5 (shares from
    pairs of pixels); M. Worchel, M. Alexa, "Differentiable Shadow Mapping for Efficient
    Inverse Graphics", CVPR 2023 (the same in shadow maps, which are then blurred).
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from tangentspace._math import safe_divide

from ._fragments import get
from ._scan_convert import prefix_sum
from .interpolate import ClipPositions, Faces
from .rasterize import Raster
from .silhouettes import MeshEdges

_CHUNK = 2**13  # pairs of texels looked at together
_STEPS = 64  # faces that are followed from a texel to its neighbour
_EQUAL = 2.0**-16  # window depths so close are the same
_WALKING, _ENDED, _PASSED, _LOST = range(4)

Texels = Int[Array, " ways"]
FaceOf = Int[Array, " ways"]


class Coverage(NamedTuple):
    """Two layers at each texel: its own, and that of a neighbour.

    Attributes:
        share: Of the texel, covered by its own layer, in [0, 1].
        side: Where the neighbour lies whose layer covers the rest: 0 to the right, 1 to the
            left, 2 below, 3 above; -1 where the texel's own layer covers all.
        depths: For each raster, window depth of the neighbour's face at this texel's centre,
            in the face's plane and between the depths of its vertices.
    """

    share: Float[Array, "height width"]
    side: Int[Array, "height width"]
    depths: tuple[Float[Array, "height width"], ...]


def coverage(
    clip_positions: ClipPositions, faces: Faces, edges: MeshEdges, *rasters: Raster
) -> Coverage:
    """Find the share of each texel that its own surface covers.

    Args:
        clip_positions: Vertices in clip space.
        faces: Vertex indices.
        edges: ``mesh_edges(positions, faces)``, found once for a mesh that may move.
        rasters: What ``rasterize`` found there; of ``rasterize_two`` both, of which the first
            decides.

    Raises:
        ValueError: If ``edges`` are those of a mesh with another number of faces.

    Differentiability:
        ``share`` and ``depths`` in ``clip_positions``, forward and reverse: the derivative of
        shares, summed along an edge, is that of the area that the edge bounds. For that sum
        to be right, the texels at the ends of a long edge count for all of it that is left
        there: their derivatives are not those of their own shares. Finite everywhere; 0 where
        a texel is so crowded that no share is left of its own.
    """
    corners = jnp.asarray(faces)
    if edges.edge_ids.shape != corners.shape:
        raise ValueError(
            f"coverage: expected `edges` of {corners.shape[0]} faces, got those of "
            f"{edges.edge_ids.shape[0]}; pass mesh_edges(positions, faces)"
        )
    face_ids = rasters[0].face_ids
    if face_ids.size == 1:  # no neighbours
        depths = tuple(raster.depth for raster in rasters)
        return Coverage(jnp.ones_like(depths[0]), jnp.full_like(face_ids, -1), depths)
    screen = _screen(jnp.asarray(clip_positions), corners, *face_ids.shape)
    found = _find(lax.stop_gradient(screen), _links(screen, edges), face_ids)
    return _share(screen, found, rasters)


def blend_layers(
    coverage: Coverage, image: Float[Array, "height width *channels"]
) -> Float[Array, "height width *channels"]:
    """Return each texel's value with that of its neighbour, by the shares of their layers.

    Args:
        coverage: Of the image.
        image: Values of each texel's own layer, such as colors.

    Returns:
        Between those of the texel and the neighbour: an antialiased image.

    Differentiability:
        In the shares and the values.
    """
    per_texel = image.shape[:2] + (1,) * (image.ndim - 2)
    share, side = coverage.share.reshape(per_texel), coverage.side.reshape(per_texel)
    padded = jnp.pad(image, [(1, 1), (1, 1)] + [(0, 0)] * (image.ndim - 2))
    height, width = image.shape[:2]
    other = image
    for k, (row, column) in enumerate(((1, 2), (1, 0), (2, 1), (0, 1))):
        beside = padded[row : row + height, column : column + width]
        other = jnp.where(side == k, beside, other)
    return share * image + (1 - share) * other


class _Screen(NamedTuple):
    """Vertices in texels from the left and the top, in window depth, all times w; and faces."""

    column: Float[Array, " vertices"]
    row: Float[Array, " vertices"]
    depth: Float[Array, " vertices"]
    w: Float[Array, " vertices"]
    corners: tuple[Int[Array, " faces"], ...]

    def corners_of(self, face: FaceOf) -> list[Int[Array, " ways"]]:
        return [get(corner, jnp.maximum(face, 0)) for corner in self.corners]


class _Links(NamedTuple):
    """Which faces lie beside each other in the image.

    Attributes:
        edge_ids: The edge from each corner of a face to the next one.
        runs: +1 where the face, turned to the viewer, runs forward along that edge, or -1.
        forward: A face that runs forward along an edge; past the last face if there is none.
        backward: A face that runs backward.
    """

    edge_ids: tuple[Int[Array, " faces"], ...]
    runs: tuple[Int[Array, " faces"], ...]
    forward: Int[Array, " edges"]
    backward: Int[Array, " edges"]


class _Ways(NamedTuple):
    """Ways from a texel's centre to that of a neighbour.

    Attributes:
        texel: Index into the flattened image.
        side: Of the neighbour, as in ``Coverage``.
        width: Of the image.
    """

    texel: Texels
    side: Int[Array, " ways"]
    width: int

    @property
    def other(self) -> Texels:
        """The neighbour."""
        step = jnp.where(self.side < 2, 1, self.width)
        return jnp.where(self.side % 2 == 0, self.texel + step, self.texel - step)

    @property
    def back(self) -> "_Ways":
        """The same from the neighbour."""
        return _Ways(self.other, self.side ^ 1, self.width)


class _Points(NamedTuple):
    """Vertices seen from the start of each way, in texels times w."""

    along: Float[Array, " ways"]
    across: Float[Array, " ways"]
    w: Float[Array, " ways"]


class _Crossings(NamedTuple):
    """What was found between texels: edges, or lines where faces pass through each other.

    Attributes:
        texel: Where the way begins.
        side: Where it leads.
        start: First vertex of the edge; or the face beyond the line, over the way's start.
        end: Second vertex of the edge; or the face before the line, over the way's end.
    """

    texel: Texels
    side: Int[Array, " ways"]
    start: Int[Array, " ways"]
    end: Int[Array, " ways"]


class _Found(NamedTuple):
    """Crossings at edges and at lines; how many of each are meant."""

    edges: _Crossings
    edge_count: Int[Array, ""]
    lines: _Crossings
    line_count: Int[Array, ""]


def _screen(
    clip_positions: ClipPositions, corners: Int[Array, "faces 3"], height: int, width: int
) -> _Screen:
    x, y, z, w = clip_positions.T
    count = w.shape[0]
    missing = jnp.any((corners < 0) | (corners >= count))
    w = eqx.error_if(w, missing, f"coverage: `faces` refers to a vertex outside 0..{count - 1}")
    column, row, depth = 0.5 * width * (w + x), 0.5 * height * (w - y), 0.5 * (w + z)
    return _Screen(column, row, depth, w, tuple(corners.astype(jnp.int32).T))


def _links(screen: _Screen, edges: MeshEdges) -> _Links:
    edge_ids = jnp.asarray(edges.edge_ids)
    runs = _turned(lax.stop_gradient(screen))[:, None] * jnp.asarray(edges.directions)
    face_count, edge_count = edge_ids.shape[0], edges.vertices.shape[0]
    face = jnp.broadcast_to(jnp.arange(face_count, dtype=jnp.int32)[:, None], runs.shape)

    def first(chosen: Bool[Array, "faces 3"]) -> Int[Array, " edges"]:
        none = jnp.full(edge_count, face_count, jnp.int32)
        return none.at[jnp.where(chosen, edge_ids, edge_count)].min(face, mode="drop")

    return _Links(tuple(edge_ids.T), tuple(runs.T), first(runs > 0), first(runs < 0))


def _turned(screen: _Screen) -> Int[Array, " faces"]:
    """Return +1 for faces seen from one side, -1 for those seen from the other."""
    a, b, c = (
        [get(axis, corner) for axis in (screen.column, screen.row, screen.w)]
        for corner in screen.corners
    )
    # Relative to a ray through the first corner, so that small faces lose no digits.
    safe_w = jnp.where(a[2] == 0, 1, a[2])
    b_column, b_row, c_column, c_row = (
        point[k] - a[k] / safe_w * point[2] for point in (b, c) for k in (0, 1)
    )
    area = a[2] * (b_column * c_row - c_column * b_row)
    return jnp.where(area < 0, -1, 1).astype(jnp.int32)


def _place(screen: _Screen, ways: _Ways, vertex: Int[Array, " ways"]) -> _Points:
    """Return where vertices lie, seen from the start of each way."""
    column, row, w = (get(axis, vertex) for axis in (screen.column, screen.row, screen.w))
    column = column - ((ways.texel % ways.width).astype(w.dtype) + 0.5) * w
    row = row - ((ways.texel // ways.width).astype(w.dtype) + 0.5) * w
    along, across = jnp.where(ways.side < 2, column, row), jnp.where(ways.side < 2, row, column)
    return _Points(jnp.where(ways.side % 2 == 0, along, -along), across, w)


def _find(screen: _Screen, links: _Links, face_ids: Int[Array, "height width"]) -> _Found:
    """Look between all neighbouring texels that see different faces."""
    height, width = face_ids.shape
    texels = height * width
    right = jnp.pad(face_ids[:, 1:] != face_ids[:, :-1], ((0, 0), (0, 1)))
    below = jnp.pad(face_ids[1:] != face_ids[:-1], ((0, 1), (0, 0)))
    pairs, total = _indices(jnp.concatenate([right.reshape(-1), below.reshape(-1)]))
    chunk = min(_CHUNK, 2 * texels)
    pairs = jnp.pad(pairs, (0, -pairs.size % chunk))
    none = _Crossings(*(jnp.zeros(pairs.size, jnp.int32) for _ in range(4)))

    def step(carry: tuple) -> tuple:
        first, found = carry
        pair = lax.dynamic_slice_in_dim(pairs, first, chunk)
        there = first + jnp.arange(chunk, dtype=jnp.int32) < total
        ways = _Ways(pair % texels, 2 * (pair // texels), width)
        edges, is_edge, lines, is_line = _look(screen, links, ways, face_ids.reshape(-1))
        at_edges = _append(found.edges, found.edge_count, edges, is_edge & there)
        at_lines = _append(found.lines, found.line_count, lines, is_line & there)
        return first + chunk, _Found(*at_edges, *at_lines)

    start = (jnp.int32(0), _Found(none, jnp.int32(0), none, jnp.int32(0)))
    return lax.while_loop(lambda carry: carry[0] < total, step, start)[1]


def _indices(mask: Bool[Array, " items"]) -> tuple[Int[Array, " items"], Int[Array, ""]]:
    """Return the indices of what is true, from the first, and how many they are."""
    ends = prefix_sum(mask.astype(jnp.int32))
    places = jnp.where(mask, ends - 1, mask.size)
    items = jnp.arange(mask.size, dtype=jnp.int32)
    return jnp.zeros_like(items).at[places].set(items, mode="drop"), ends[-1]


def _append(
    kept: _Crossings, count: Int[Array, ""], new: _Crossings, good: Bool[Array, " ways"]
) -> tuple[_Crossings, Int[Array, ""]]:
    ends = count + prefix_sum(good.astype(jnp.int32))
    places = jnp.where(good, ends - 1, kept.texel.size)
    put = lambda old, values: old.at[places].set(values, mode="drop")
    return _Crossings(*map(put, kept, new)), ends[-1]


def _look(
    screen: _Screen, links: _Links, ways: _Ways, face_ids: Int[Array, " texels"]
) -> tuple[_Crossings, Bool[Array, " ways"], _Crossings, Bool[Array, " ways"]]:
    """Return edges and lines between the two ends of each way, and whether they are there."""
    face, other = get(face_ids, ways.texel), get(face_ids, ways.other)
    # From both ends at once: a program half as long.
    texel = jnp.concatenate([ways.texel, ways.other])
    both = _Ways(texel, jnp.concatenate([ways.side, ways.back.side]), ways.width)
    own, far = jnp.concatenate([face, other]), jnp.concatenate([other, face])
    status, start, end, last = _follow(screen, links, both, own)
    along, depth = _edge_crossing(screen, both, start, end)
    hidden = (far >= 0) & (depth > _plane_depth(screen, both, far, along) + _EQUAL)
    ended = (status == _ENDED) & ~hidden
    there, back = jnp.split(ended, 2)
    depth, back_depth = jnp.split(depth, 2)
    nearer_back = back & (~there | (back_depth < depth))
    crossings = _Crossings(
        *(
            jnp.where(nearer_back, *jnp.split(values, 2)[::-1])
            for values in (both.texel, both.side, start, end)
        )
    )
    (status, back_status), (last, back_last) = jnp.split(status, 2), jnp.split(last, 2)
    # Neither ends before the other's centre, and they are not one surface.
    passed = (status == _PASSED) & (back_status == _PASSED) & (last != other) & (back_last != face)
    lines = _Crossings(ways.texel, ways.side, back_last, last)
    gaps = _gaps(screen, lines, ways.width, face, other)
    cross = passed & (gaps[0] >= 0) & (gaps[1] >= 0) & (gaps[0] + gaps[1] > _EQUAL)
    return crossings, there | back, lines, cross


def _follow(
    screen: _Screen, links: _Links, ways: _Ways, face: FaceOf
) -> tuple[Int[Array, " ways"], Int[Array, " ways"], Int[Array, " ways"], FaceOf]:
    """Follow a surface along each way.

    Returns:
        What became of it; the two vertices of the last edge; the last face.
    """
    none = screen.corners[0].size

    def step(carry: tuple) -> tuple:
        count, status, face, came_by, *edge = carry
        corners = screen.corners_of(face)
        points = [_place(screen, ways, corner) for corner in corners]
        farthest = jnp.full(face.shape, -jnp.inf, screen.w.dtype)
        by, run, found = jnp.full_like(face, -1), jnp.zeros_like(face), edge
        for k, n in ((0, 1), (1, 2), (2, 0)):
            a, b = points[k], points[n]
            crosses = (a.across >= 0) != (b.across >= 0)
            w = a.w * b.across - b.w * a.across
            in_front = jnp.where(b.across >= 0, w, -w) > 0
            along = (a.along * b.across - b.along * a.across) / jnp.where(in_front, w, 1)
            along = jnp.where(in_front, along, jnp.inf)
            this = get(links.edge_ids[k], face)
            take = crosses & (this != came_by) & (along > farthest)
            farthest, by = jnp.where(take, along, farthest), jnp.where(take, this, by)
            run = jnp.where(take, get(links.runs[k], face), run)
            ends = corners[k], corners[n]
            found = [jnp.where(take, new, old) for new, old in zip(ends, found, strict=True)]
        edge_id = jnp.maximum(by, 0)
        beyond = jnp.where(run > 0, get(links.backward, edge_id), get(links.forward, edge_id))
        ended = jnp.where(beyond == none, _ENDED, _WALKING)
        now = jnp.where(by < 0, _LOST, jnp.where(farthest > 1, _PASSED, ended))
        on = status == _WALKING
        keep = lambda new, old: jnp.where(on, new, old)
        face = jnp.where(on & (now == _WALKING), beyond, face)
        return count + 1, keep(now, status), face, keep(by, came_by), *map(keep, found, edge)

    zero = jnp.zeros_like(face)
    first = (
        jnp.int32(0),
        jnp.where(face >= 0, _WALKING, _LOST),
        jnp.maximum(face, 0),
        zero - 1,
        zero,
        zero,
    )
    carry = lax.while_loop(lambda c: (c[0] < _STEPS) & jnp.any(c[1] == _WALKING), step, first)
    _, status, face, _, start, end = carry
    return status, start, end, face


def _edge_crossing(
    screen: _Screen, ways: _Ways, start: Int[Array, " ways"], end: Int[Array, " ways"]
) -> tuple[Float[Array, " ways"], Float[Array, " ways"]]:
    """Return how far along the way an edge crosses it, and the window depth there."""
    a, b = _place(screen, ways, start), _place(screen, ways, end)
    w = a.w * b.across - b.w * a.across
    depth = get(screen.depth, start) * b.across - get(screen.depth, end) * a.across
    return _along(a, b), safe_divide(depth, w)


def _along(a: _Points, b: _Points) -> Float[Array, " ways"]:
    """Return where the line through two points crosses the way."""
    w = a.w * b.across - b.w * a.across
    return safe_divide(a.along * b.across - b.along * a.across, w)


def _edge_length(
    screen: _Screen, edges: _Crossings, count: Int[Array, ""], ways: _Ways, height: int
) -> Float[Array, " ways"]:
    """Return how much of a long edge a way stands for, across it: 1 but near the edge's ends.

    There all that is left up to the end, so that derivatives add up to those of the whole
    edge. Of shorter edges each stands for its neighbours too.
    """
    width, size = ways.width, ways.texel.size
    texels = height * width
    flat, forth = ways.side < 2, ways.side % 2 == 0
    code = edges.start * 7919 + edges.end
    pair = jnp.where(flat, 0, texels) + jnp.minimum(ways.texel, ways.other)
    pair = jnp.where(jnp.arange(size) < count, pair, 2 * texels)
    crossed = jnp.zeros(2 * texels, code.dtype).at[pair].set(code, mode="drop")
    a, b = (_place(screen, ways, vertex) for vertex in (edges.start, edges.end))
    # An end behind the eye is infinitely far.
    far = 2.0 * (height + width)
    ends = [
        jnp.where(p.w > 0, p.across / jnp.where(p.w > 0, p.w, 1), jnp.sign(p.across) * far)
        for p in (a, b)
    ]
    lengths, row, column = [], ways.texel // width, ways.texel % width
    for end in ends:
        # Where the edge meets the next line towards this end, if it was found there.
        step = jnp.where(end < 0, -1, 1)
        c, d = (point._replace(across=point.across - step * point.w) for point in (a, b))
        along = _along(c, d)
        first = jnp.floor(jnp.clip(along, -width - height, width + height)).astype(jnp.int32)
        first = jnp.where(forth, first, -first - 1)
        there = row + jnp.where(flat, step, first), column + jnp.where(flat, first, step)
        inside = (there[0] >= 0) & (there[0] < height) & (there[1] >= 0) & (there[1] < width)
        at = jnp.where(inside, there[0] * width + there[1], 0) + jnp.where(flat, 0, texels)
        found = inside & (get(crossed, at) == code)
        length = jnp.abs(end)
        lengths.append(jnp.where((length < 1) | (length < 2) & ~found, length, 0.5))
    long = jnp.abs(ends[0]) + jnp.abs(ends[1]) >= 2
    return jnp.where(long, lengths[0] + lengths[1], 1.0)


def _edge_weight(
    screen: _Screen, ways: _Ways, start: Int[Array, " ways"], end: Int[Array, " ways"]
) -> Float[Array, " ways"]:
    """Return the squared cosine between the way and the edge's normal."""
    a, b = _place(screen, ways, start), _place(screen, ways, end)
    return _squared_cosine(a.across * b.w - a.w * b.across, a.w * b.along - a.along * b.w)


def _squared_cosine(along: Float[Array, " ways"], across: Float[Array, " ways"]) -> Array:
    # Relative to the larger, so that squares stay within the exponent's range.
    size = lax.stop_gradient(jnp.maximum(jnp.abs(along), jnp.abs(across)))
    along, across = safe_divide(along, size), safe_divide(across, size)
    return safe_divide(along**2, along**2 + across**2)


def _plane_depth(
    screen: _Screen,
    ways: _Ways,
    face: FaceOf,
    along: Float[Array, " ways"] | float = 0.0,
    across: float = 0.0,
) -> Float[Array, " ways"]:
    """Return the window depth of a face's plane, no nearer or farther than its vertices are."""
    corners = screen.corners_of(face)
    points = [_place(screen, ways, corner) for corner in corners]
    rays = [(point.along - along * point.w, point.across - across * point.w) for point in points]
    areas = [rays[i][0] * rays[j][1] - rays[j][0] * rays[i][1] for i, j in ((1, 2), (2, 0), (0, 1))]
    depths = [get(screen.depth, corner) for corner in corners]
    top = areas[0] * depths[0] + areas[1] * depths[1] + areas[2] * depths[2]
    bottom = areas[0] * points[0].w + areas[1] * points[1].w + areas[2] * points[2].w
    each = [safe_divide(d, jnp.maximum(p.w, 0)) for d, p in zip(depths, points, strict=True)]
    nearest, farthest = (functools.reduce(f, each) for f in (jnp.minimum, jnp.maximum))
    return jnp.clip(safe_divide(top, bottom), nearest, farthest)


def _gaps(
    screen: _Screen, lines: _Crossings, width: int, face: FaceOf, other: FaceOf
) -> tuple[Float[Array, " ways"], Float[Array, " ways"]]:
    """Return how far behind the seen face the other surface is, at both ends of the way."""
    ways = _Ways(lines.texel, lines.side, width)
    here = _plane_depth(screen, ways, lines.start) - _plane_depth(screen, ways, face)
    there = _plane_depth(screen, ways.back, lines.end) - _plane_depth(screen, ways.back, other)
    return here, there


def _share(screen: _Screen, found: _Found, rasters: tuple[Raster, ...]) -> Coverage:
    """Make shares of crossings."""
    height, width = rasters[0].face_ids.shape
    ids = [raster.face_ids.reshape(-1) for raster in rasters]

    def of_edges(screen: _Screen, edges: _Crossings, ways: _Ways) -> tuple[Array, Array]:
        along, _ = _edge_crossing(screen, ways, edges.start, edges.end)
        length = _edge_length(lax.stop_gradient(screen), edges, found.edge_count, ways, height)
        still = lax.stop_gradient(along)
        along = still + length * (along - still)
        return along, _edge_weight(screen, ways, edges.start, edges.end)

    def of_lines(screen: _Screen, lines: _Crossings, ways: _Ways) -> tuple[Array, Array]:
        face, other = get(ids[0], ways.texel), get(ids[0], ways.other)
        here, there = _gaps(screen, lines, width, face, other)
        gap = lambda *place: (
            _plane_depth(screen, ways, other, *place) - _plane_depth(screen, ways, face, *place)
        )
        weight = _squared_cosine(gap(1.0) - gap(), gap(0.0, 1.0) - gap())
        return safe_divide(here, here + there), weight

    lists = (
        (of_edges, found.edges, found.edge_count, 4 * (height + width)),
        (of_lines, found.lines, found.line_count, height + width),
    )
    rests = jnp.zeros(4 * height * width, screen.w.dtype)
    for measure, crossings, count, few in lists:
        run = functools.partial(_rests, screen, measure, crossings, count, (height, width))
        rests = rests + _few_or_all(run, count, few, crossings.texel.size)
    by_side = rests.reshape(4, height, width)
    share = jnp.maximum(1 - (by_side[0] + by_side[1]) - (by_side[2] + by_side[3]), 0)
    widest = jnp.argmax(lax.stop_gradient(by_side), axis=0).astype(jnp.int32)
    side = jnp.where(lax.stop_gradient(share) < 1, widest, -1)
    return Coverage(share, side, _other_depths(screen, side, rasters))


def _rests(
    screen: _Screen,
    measure: Callable,
    crossings: _Crossings,
    count: Int[Array, ""],
    shape: tuple[int, int],
    size: int,
) -> Float[Array, " shares"]:
    """Return how much of each texel belongs to its neighbour on each side.

    Only the first ``size`` crossings are looked at.
    """
    height, width = shape
    texels = height * width
    few = _Crossings(*(values[:size] for values in crossings))
    ways = _Ways(few.texel, few.side, width)
    along, weight = measure(screen, few, ways)
    along = jnp.clip(along, 0, 1)
    # The texel whose centre is nearer to the crossing is the one that is cut.
    own = lax.stop_gradient(along) < 0.5
    rest = weight * jnp.where(own, 0.5 - along, along - 0.5)
    texel, side = jnp.where(own, ways.texel, ways.other), jnp.where(own, ways.side, ways.side ^ 1)
    place = jnp.where(jnp.arange(size) < count, side * texels + texel, 4 * texels)
    return jnp.zeros(4 * texels, rest.dtype).at[place].set(rest, mode="drop")


def _other_depths(
    screen: _Screen, side: Int[Array, "height width"], rasters: tuple[Raster, ...]
) -> tuple[Float[Array, "height width"], ...]:
    """Return, at each texel, the depth of the neighbour's face; its own where there is none."""
    height, width = side.shape
    cut, count = _indices(side.reshape(-1) >= 0)

    def run(size: int) -> tuple[Float[Array, " texels"], ...]:
        texel = cut[:size]
        ways = _Ways(texel, jnp.maximum(get(side.reshape(-1), texel), 0), width)
        place = jnp.where(jnp.arange(size) < count, texel, side.size)
        depths = []
        for raster in rasters:
            face = get(raster.face_ids.reshape(-1), ways.other)
            depth = jnp.where(face < 0, 1.0, jnp.clip(_plane_depth(screen, ways, face), 0, 1))
            depths.append(raster.depth.reshape(-1).at[place].set(depth, mode="drop"))
        return tuple(depths)

    depths = _few_or_all(run, count, 4 * (height + width), side.size)
    return tuple(depth.reshape(height, width) for depth in depths)


def _few_or_all(run: Callable, count: Int[Array, ""], few: int, most: int) -> Any:
    """Return ``run(size)`` of a size that holds the count, small where that is enough."""
    if few >= most:
        return run(most)
    # Computed again backwards: what is kept of a choice is as large as its largest way.
    ways = (jax.checkpoint(functools.partial(run, size)) for size in (few, most))
    return lax.cond(count <= few, *ways)
