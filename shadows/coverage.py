"""Which share of each texel its own surface covers, so that edges have derivatives.

A rasterizer tells which face lies over the centre of a texel: an integer, which jumps when
an edge passes. But between the centres of two neighbouring texels that see different
surfaces an edge crosses, and where it crosses follows the vertices smoothly. Of the two
texels, the one whose centre is nearer to the crossing belongs in part to its neighbour: two
layers at one texel, its own and its neighbour's, and a share.

To find the edge, the surface seen at a texel is followed towards the other, face by face over
the edges that they share, to the first edge where it ends (an open border) or turns back (a
silhouette). So it does not matter how small the faces are. Where it leads on to what is seen at
the other, but over a crease at which its shading normal jumps, the crease is the edge, in a view
that shows colors. Where neither surface ends, but each lies behind the other at the other's
centre, they pass through each other, and the line where they do takes the edge's place.

An edge is seen by the pairs along rows and by those along columns; each counts by the squared
cosine between the pair and the edge's normal, which add to 1. Summed along an edge, shares
are then areas, whatever way it runs, and no sudden choice between rows and columns is made.
Towards a corner of the outline, the cosine goes over into the mean of the edges that meet
there, so that shares do not jump when a corner passes a row or a column.

What lies between the centres of texels and over none of them is not seen.

References:
    S. Laine, J. Hellsten, T. Karras, Y. Seol, J. Lehtinen, T. Aila, "Modular Primitives for
    High-Performance Differentiable Rendering", SIGGRAPH Asia 2020, section 3.5 (shares from
    pairs of pixels); M. Worchel, M. Alexa, "Differentiable Shadow Mapping for Efficient
    Inverse Graphics", CVPR 2023 (the same in shadow maps, which are then blurred).
"""

import functools
from collections.abc import Callable, Sequence
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jax import lax
from jax.typing import DTypeLike
from jaxtyping import Array, Bool, Float, Int

from tangentspace._math import safe_divide, stack_last

from ._crossings import Crossings, Links, find_crossings, link_faces, marked
from ._fragments import get
from ._ways import (
    Index,
    Length,
    Points,
    Screen,
    Ways,
    edge_crossing,
    face_plane,
    line_crossing,
    line_planes,
    place,
)
from .interpolate import ClipPositions, FaceIds, Faces
from .rasterize import Raster
from .silhouettes import MeshEdges

_CORNER = 0.5  # texels from a corner where its own steepness counts

Size = TypeVar("Size")
Result = TypeVar("Result")


class Coverage(NamedTuple):
    """The layers at each texel: its own, and those of the neighbours that reach into it.

    Attributes:
        rests: How much of the texel belongs to the layers of the neighbours to the right, to
            the left, below and above; together more than 1 where it is crowded.
        crossings: Edges between texels, and lines where surfaces pass through each other.
    """

    rests: Float[Array, "4 height width"]
    crossings: tuple[Crossings, Crossings]

    @property
    def share(self) -> Float[Array, "height width"]:
        """How much of the texel its own layer covers, in [0, 1]."""
        right, left, below, above = self.rests
        return jnp.maximum(1 - (right + left) - (below + above), 0)

    @property
    def side(self) -> Int[Array, "height width"]:
        """Which neighbour's layer covers most of the rest; -1 where there is no rest."""
        rests = lax.stop_gradient(self.rests)
        widest = jnp.argmax(rests, axis=0).astype(jnp.int32)
        return jnp.where(jnp.any(rests > 0, axis=0), widest, -1)


def coverage(
    clip_positions: ClipPositions,
    faces: Faces,
    edges: MeshEdges,
    face_ids: FaceIds,
    *,
    creases: Bool[Array, " edges"] | None = None,
) -> Coverage:
    """Find the share of each texel that its own surface covers.

    Args:
        clip_positions: Vertices in clip space.
        faces: Vertex indices.
        edges: ``mesh_edges(positions, faces)``, found once for a mesh that may move.
        face_ids: What ``rasterize`` found there.
        creases: Edges at which the surface changes its look, though it goes on
            (``mesh_creases``): both sides are layers too. None for no edge.

    Raises:
        ValueError: If ``edges`` are those of a mesh with another number of faces.

    Differentiability:
        ``share`` in ``clip_positions``, forward and reverse: the derivative of
        shares, summed along an edge, is that of the area that the edge bounds. For that sum
        to be right, the texels at the ends of a long edge count for all of it that is left
        there: their derivatives are not those of their own shares. Finite everywhere; 0 where
        a texel is so crowded that no share is left of its own.
    """
    if edges.edge_ids.shape != faces.shape:
        raise ValueError(
            f"coverage: expected `edges` of {faces.shape[0]} faces, got those of "
            f"{edges.edge_ids.shape[0]}; pass mesh_edges(positions, faces)"
        )
    screen = Screen.of(clip_positions, faces, *face_ids.shape)
    links = link_faces(lax.stop_gradient(screen), edges, creases)
    at_edges, at_lines = find_crossings(lax.stop_gradient(screen), links, face_ids)
    steepness = _steepness(lax.stop_gradient(screen), links)
    ids, (height, width) = face_ids.reshape(-1), face_ids.shape

    def of_edges(crossings: Crossings, ways: Ways) -> tuple[Length, Length, Length]:
        vertices = [get(end, crossings.by[0]) for end in links.vertices]
        a, b = (place(screen, ways, vertex) for vertex in vertices)
        along = edge_crossing(a, b)
        steep = _squared_cosine(a.across * b.w - a.w * b.across, a.w * b.along - a.along * b.w)
        length = _edge_length(*lax.stop_gradient((a, b)), crossings, ways, height)
        at_ends = [get(steepness, vertex) for vertex in vertices]
        at_ends = [jnp.where(ways.side < 2, value, 1 - value) for value in at_ends]
        near = [_nearness(point, along) for point in (a, b)]
        return _with_rate(along, length), steep, _between(steep, at_ends, near)

    def of_lines(crossings: Crossings, ways: Ways) -> tuple[Length, Length, Length]:
        line = line_crossing(*line_planes(screen, ways, crossings.by, ids))
        weight = _squared_cosine(line.per_along, line.per_across)
        return line.along, weight, weight

    few = 4 * (height + width), height + width
    rests = _rests((of_edges, of_lines), (at_edges, at_lines), (height, width), few, screen.w.dtype)
    return Coverage(rests, (at_edges, at_lines))


def neighbor_depth(
    clip_positions: ClipPositions, faces: Faces, coverage: Coverage, raster: Raster
) -> Float[Array, "height width"]:
    """Return the window depth, at each texel's centre, of the face that its neighbour sees.

    Args:
        clip_positions: Vertices in clip space.
        faces: Vertex indices.
        coverage: Says which neighbour.
        raster: What ``rasterize`` found, or either layer of ``rasterize_two``.

    Returns:
        In the face's plane and between the depths of its vertices; the texel's own depth
        where its own layer covers all.

    Differentiability:
        As the depth of ``rasterize``.
    """
    height, width = coverage.side.shape
    side, ids = coverage.side.reshape(-1), raster.face_ids.reshape(-1)
    screen = Screen.of(clip_positions, faces, height, width)
    cut, count = marked(side >= 0)

    def run(size: int) -> Float[Array, " texels"]:
        texel = cut[:size]
        ways = Ways(texel, jnp.maximum(get(side, texel), 0), width)
        face = ids.at[ways.other].get(mode="clip")
        depth = jnp.where(face < 0, 1.0, jnp.clip(face_plane(screen, ways, face).at(0.0), 0, 1))
        texel = jnp.where(jnp.arange(size) < count, texel, side.size)
        return raster.depth.reshape(-1).at[texel].set(depth, mode="drop")

    few = min(4 * (height + width), side.size)
    return _few_or_all(run, count <= few, few, side.size).reshape(height, width)


def blend_layers(
    coverage: Coverage,
    image: Float[Array, "height width *channels"],
    *,
    changes: Float[Array, "4 height width *channels"] | None = None,
) -> Float[Array, "height width *channels"]:
    """Return each texel's value with those of its neighbours, by the shares of their layers.

    Args:
        coverage: Of the image.
        image: Values of each texel's own layer, such as colors.
        changes: For derivatives: by how much more the neighbour's value exceeds the texel's
            own at the edge between them than at the centres (``edge_changes``). None for 0.

    Returns:
        Between those of the texel and its neighbours: an antialiased image.

    Differentiability:
        In the shares and the values.
    """
    height, width = image.shape[:2]
    right, left, below, above = coverage.rests
    whole = jnp.maximum((right + left) + (below + above), 1)
    rests = tuple(rest / whole for rest in (right, left, below, above))

    def blend(own: Array, change: Array | None) -> Array:
        padded = jnp.pad(own, 1)
        blended = (1 - (rests[0] + rests[1]) - (rests[2] + rests[3])) * own
        for rest, (row, column) in zip(rests, ((1, 2), (1, 0), (2, 1), (0, 1)), strict=True):
            blended += rest * padded[row : row + height, column : column + width]
        return blended if change is None else _with_changes(blended, rests, change)

    # One channel at a time: on a CPU several times as fast, backwards above all.
    if image.ndim == 2:
        return blend(image, changes)
    parts = image.reshape(height, width, -1)
    change = None if changes is None else changes.reshape(4, *parts.shape)
    channels = [
        blend(parts[..., k], None if change is None else change[..., k])
        for k in range(parts.shape[-1])
    ]
    return stack_last(*channels).reshape(image.shape)


@jax.custom_jvp
def _with_changes(blended: Array, rests: tuple[Array, ...], changes: Array) -> Array:
    """Return a blended image whose derivative in the rests is more by the changes."""
    return blended


@_with_changes.defjvp
def _(primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    blended, _, changes = primals
    right, left, below, above = (
        rest * more for rest, more in zip(tangents[1], changes, strict=True)
    )
    return blended, tangents[0] + (right + left) + (below + above)


def cut_texel(ways: Ways, along: Length, height: int) -> tuple[Bool[Array, " ways"], Index]:
    """Return whether crossings cut the texels where the ways begin, and which rests they bound.

    The texel whose centre is nearer is the one that is cut.
    """
    own = along < 0.5
    side, texel = jnp.where(own, ways.side, ways.side ^ 1), jnp.where(own, ways.texel, ways.other)
    return own, side * height * ways.width + texel


def _rests(
    measures: Sequence[Callable[[Crossings, Ways], tuple[Length, Length, Length]]],
    crossings: Sequence[Crossings],
    shape: tuple[int, int],
    few: Sequence[int],
    dtype: DTypeLike,
) -> Float[Array, "4 height width"]:
    """Return how much of each texel belongs to its neighbour on each side.

    Args:
        measures: For each kind of crossing, what returns how far along its way each is, its
            weight in derivatives, and its weight in values.
        crossings: Between texels.
        shape: Of the image.
        few: As many of each kind as there usually are.
        dtype: Of the result.
    """
    height, width = shape
    texels = height * width

    def run(sizes: Sequence[int]) -> Float[Array, " rests"]:
        rests = jnp.zeros(4 * texels, dtype)
        for measure, found, size in zip(measures, crossings, sizes, strict=True):
            some = found.part(0, size)
            ways = some.ways(width)
            along, weight, shown = measure(some, ways)
            along = jnp.clip(along, 0, 1)
            own, cut = cut_texel(ways, lax.stop_gradient(along), height)
            part = jnp.where(own, 0.5 - along, along - 0.5)
            rest = weight * part + lax.stop_gradient((shown - weight) * part)
            cut = jnp.where(jnp.arange(size) < some.total, cut, 4 * texels)
            rests = rests.at[cut].add(rest, mode="drop")
        return rests

    most = [found.way.size for found in crossings]
    are_few = [found.total <= size for found, size in zip(crossings, few, strict=True)]
    few = [min(sizes) for sizes in zip(few, most, strict=True)]
    rests = _few_or_all(run, functools.reduce(jnp.logical_and, are_few), few, most)
    return rests.reshape(4, height, width)


def _few_or_all(
    run: Callable[[Size], Result], are_few: Bool[Array, ""], few: Size, most: Size
) -> Result:
    """Return ``run(size)`` of a size that holds all, small where that is enough."""
    if few == most:
        return run(most)
    # Computed again backwards: what is kept of a choice is as large as its largest way.
    ways = (jax.checkpoint(functools.partial(run, size)) for size in (few, most))
    return lax.cond(are_few, *ways)


@jax.custom_jvp
def _with_rate(value: Length, rate: Length) -> Length:
    """Return a value whose derivatives count ``rate`` times; the rate is not asked without."""
    return value


@_with_rate.defjvp
def _(primals: tuple[Length, Length], tangents: tuple[Length, Length]) -> tuple[Length, Length]:
    value, rate = primals
    return value, rate * tangents[0]


def _edge_length(a: Points, b: Points, crossings: Crossings, ways: Ways, height: int) -> Length:
    """Return how much of a long edge a way stands for, across it: 1 but near the edge's ends.

    There all that is left up to the end, so that derivatives add up to those of the whole
    edge. Of shorter edges each stands for its neighbours too.
    """
    width, texels, edge = ways.width, height * ways.width, crossings.by[0]
    flat, forth = ways.side < 2, ways.side % 2 == 0
    pair = jnp.where(flat, 0, texels) + jnp.minimum(ways.texel, ways.other)
    pair = jnp.where(jnp.arange(pair.size) < crossings.total, pair, 2 * texels)
    crossed = jnp.full(2 * texels, -1, edge.dtype).at[pair].set(edge, mode="drop")
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
        along = edge_crossing(c, d)
        first = jnp.floor(jnp.clip(along, -width - height, width + height)).astype(jnp.int32)
        first = jnp.where(forth, first, -first - 1)
        there = row + jnp.where(flat, step, first), column + jnp.where(flat, first, step)
        inside = (there[0] >= 0) & (there[0] < height) & (there[1] >= 0) & (there[1] < width)
        at = jnp.where(inside, there[0] * width + there[1], 0) + jnp.where(flat, 0, texels)
        found = inside & (get(crossed, at) == edge)
        length = jnp.abs(end)
        lengths.append(jnp.where((length < 1) | (length < 2) & ~found, length, 0.5))
    long = jnp.abs(ends[0]) + jnp.abs(ends[1]) >= 2
    return jnp.where(long, lengths[0] + lengths[1], 1.0)


def _steepness(screen: Screen, links: Links) -> Float[Array, " vertices"]:
    """Return the mean, over the outline's edges at each vertex, of how upright they are.

    That is the squared cosine between rows and their normals.
    """
    a, b = (
        [get(axis, end) for axis in (screen.column, screen.row, screen.w)] for end in links.vertices
    )
    steep = _squared_cosine(a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2])
    counts = links.outline.astype(steep.dtype)

    def at_vertices(values: Float[Array, " edges"]) -> Float[Array, " vertices"]:
        total = jnp.zeros_like(screen.w)
        for end in links.vertices:
            total = total.at[end].add(values)
        return total

    return safe_divide(at_vertices(counts * steep), at_vertices(counts))


def _nearness(point: Points, along: Length) -> Length:
    """Return how near a crossing is to a vertex: 1 there, 0 from half a texel."""
    w = jnp.where(point.w > 0, point.w, 1)
    squared = (point.along / w - along) ** 2 + (point.across / w) ** 2
    return jnp.where(point.w > 0, jnp.maximum(1 - squared / _CORNER**2, 0) ** 2, 0.0)


def _between(of_edge: Length, at_ends: list[Length], near: list[Length]) -> Length:
    """Return a mean of an edge's value and those of its ends, which they have for themselves."""
    away = [1 - x for x in near]
    parts = [near[0] * away[1], near[1] * away[0], away[0] * away[1]]
    whole = parts[0] + parts[1] + parts[2]
    mean = parts[0] * at_ends[0] + parts[1] * at_ends[1] + parts[2] * of_edge
    return jnp.where(whole > 0, safe_divide(mean, whole), of_edge)


def _squared_cosine(along: Length, across: Length) -> Length:
    # Relative to the larger, so that squares stay within the exponent's range.
    size = lax.stop_gradient(jnp.maximum(jnp.abs(along), jnp.abs(across)))
    along, across = safe_divide(along, size), safe_divide(across, size)
    return safe_divide(along**2, along**2 + across**2)
