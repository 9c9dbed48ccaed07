"""What crosses between the centres of neighbouring texels: the search under ``coverage``.

All of it is discrete: which edge, which faces. Nothing here has a derivative.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Int, PyTree

from tangentspace._fusion import once
from tangentspace._math import safe_divide

from ._fragments import get
from ._scan_convert import prefix_sum, signed_area
from ._ways import Index, Length, Screen, Ways, edge_crossing, face_plane, place
from .silhouettes import MeshEdges

_PIECE = 2**11  # ways looked at together
_PAIRS = 2**15  # of texels that are listed together
_LAST = 2**8  # ways that are walked on to the end when no others are left
_STEPS = 64  # faces that are followed from a texel to its neighbour
_ROUNDING = 2.0**-10  # of a texel: no edge is so near to a centre
_EQUAL = 2.0**-16  # window depths so close are the same
_APART = 2.0**-19  # what surfaces that cross part by between two texels; rounding is a fourth of it


class Crossings(NamedTuple):
    """What was found between texels: edges, or lines where faces pass through each other.

    Attributes:
        way: Where each way begins and where it leads: 4 texel + side, as in ``Ways``.
        by: The edge; or two faces, hidden at the way's start and at its end, that are seen
            (as parts of one surface) at the other.
        total: How many are meant, from the first.
    """

    way: Index
    by: tuple[Index, ...]
    total: Int[Array, ""]

    def ways(self, width: int) -> Ways:
        """Return the ways, in an image so wide."""
        return Ways(self.way // 4, self.way % 4, width)

    def part(self, first: Int[Array, ""] | int, size: int) -> "Crossings":
        """Return some of them, the total counted from the first of these."""
        cut = lambda values: lax.dynamic_slice_in_dim(values, first, size)
        way, by = jax.tree.map(cut, self[:2])
        return Crossings(way, by, self.total - first)


class _Walks(NamedTuple):
    """What became of the surfaces that are seen at both ends of each way.

    Attributes:
        pair: Texel of the way's start, and that it leads down if more than there are texels.
        end: The edge where each surface ends before the other's centre; where it leads on to
            what is seen there, the first crease on the way; -1 if there is neither.
        last: The face of it that lies over the other's centre, -1 if none does.
    """

    pair: Index
    end: tuple[Index, Index]
    last: tuple[Index, Index]


class _Walker(NamedTuple):
    """Who is on a way.

    Attributes:
        pair: As in ``_Walks``.
        leg: 0 on the way, 1 on the way back, -1 idle.
        corner: Of the face where it is, from which the edge leads over which it came; -1 at the
            start.
        crease: The first that it came over on this leg; -1 if none.
        steps: Made on this leg.
        end: Found on leg 0.
        last: Found on leg 0.
    """

    pair: Index
    leg: Index
    corner: Index
    crease: Index
    steps: Index
    end: Index
    last: Index


class Links(NamedTuple):
    """Which faces lie beside each other in the image; corner 3 face + i is the face's i-th.

    Attributes:
        edge_ids: The edge from each corner to the next one of its face.
        across: The corner from which the face beyond that edge runs back along it; -1 if none.
        vertices: The two ends of each edge.
        creases: Where one look of the surface ends and another begins.
        outline: Where the surface ends or turns back, or its look changes.
    """

    edge_ids: Int[Array, " corners"]
    across: Int[Array, " corners"]
    vertices: tuple[Int[Array, " edges"], ...]
    creases: Bool[Array, " edges"]
    outline: Bool[Array, " edges"]


def find_crossings(
    screen: Screen, links: Links, face_ids: Int[Array, "height width"]
) -> tuple[Crossings, Crossings]:
    """Look between all neighbouring texels that see different faces.

    Args:
        screen: The mesh in the image.
        links: ``link_faces`` of the same.
        face_ids: The face seen at each texel, -1 where there is none.

    Returns:
        Edges, and lines where faces pass through each other.
    """
    width = face_ids.shape[1]
    right = jnp.pad(face_ids[:, 1:] != face_ids[:, :-1], ((0, 0), (0, 1)))
    below = jnp.pad(face_ids[1:] != face_ids[:-1], ((0, 1), (0, 0)))
    apart = jnp.concatenate([right.reshape(-1), below.reshape(-1)])
    ids, ends = face_ids.reshape(-1), prefix_sum(apart.astype(jnp.int32))
    some = min(_PAIRS, -(-apart.size // _PIECE) * _PIECE)
    at_corners = screen.at_corners()

    def step(carry: tuple) -> tuple:
        first, *found = carry
        pairs = _chosen(apart, ends - first, some)
        there = first + jnp.arange(some, dtype=jnp.int32) < ends[-1]
        plain = _is_plain(screen, links, _ways(pairs, width, ids.size), ids)
        others, count = marked(there & ~plain)
        walks, count = _follow(at_corners, links, get(pairs, others), count, ids, width)

        def meet(carry: tuple) -> tuple:
            start, *kept = carry
            part = jax.tree.map(lambda x: lax.dynamic_slice_in_dim(x, start, _PIECE), walks)
            there = start + jnp.arange(_PIECE, dtype=jnp.int32) < count
            new = _meet(screen, links, part, ids, width)
            return start + _PIECE, *(_append(*both, there) for both in zip(kept, new, strict=True))

        found = lax.while_loop(lambda carry: carry[0] < count, meet, (jnp.int32(0), *found))[1:]
        return first + some, *found

    none = jnp.zeros(apart.size, jnp.int32)
    found = (Crossings(none, (none,) * size, jnp.int32(0)) for size in (1, 2))
    carry = (jnp.int32(0), *found)
    _, at_edges, at_lines = lax.while_loop(lambda carry: carry[0] < ends[-1], step, carry)
    return at_edges, at_lines


def marked(mask: Bool[Array, " items"]) -> tuple[Int[Array, " items"], Int[Array, ""]]:
    """Return the indices of what is true, from the first, and how many they are."""
    ends = prefix_sum(mask.astype(jnp.int32))
    return _chosen(mask, ends, mask.size), ends[-1]


def _chosen(
    mask: Bool[Array, " items"], ends: Int[Array, " items"], size: int
) -> Int[Array, " chosen"]:
    """Return the indices of what is true, those to which ``ends`` counts from 1 to a size."""
    places = jnp.where(mask & (ends > 0), ends - 1, size)
    items = jnp.arange(mask.size, dtype=jnp.int32)
    return jnp.zeros(size, jnp.int32).at[places].set(items, mode="drop")


def _append(kept: Crossings, new: Crossings, there: Bool[Array, " ways"]) -> Crossings:
    """Append those that were found, ``new.total`` being whether each was."""
    (way, by), total = _put(kept[:2], new[:2], new.total & there, kept.total)
    return Crossings(way, by, total)


def _put(
    kept: PyTree, values: PyTree, chosen: Bool[Array, " items"], count: Int[Array, ""]
) -> tuple[PyTree, Int[Array, ""]]:
    """Write the chosen values after the first ``count`` of what is kept."""
    ends = count + prefix_sum(chosen.astype(jnp.int32))
    put = lambda old, new: old.at[jnp.where(chosen, ends - 1, old.size)].set(new, mode="drop")
    return jax.tree.map(put, kept, values), ends[-1]


def link_faces(screen: Screen, edges: MeshEdges, creases: Bool[Array, " edges"] | None) -> Links:
    """Find which faces lie beside each other in the image."""
    edge_ids = jnp.asarray(edges.edge_ids).reshape(-1)
    corners = jnp.stack(screen.corners)
    area = signed_area(*(get(axis, corners) for axis in (screen.column, screen.row, screen.w)))
    turned = jnp.where(area < 0, -1, 1)
    runs = (turned[:, None] * jnp.asarray(edges.directions)).reshape(-1)
    corner, count = jnp.arange(edge_ids.size, dtype=jnp.int32), edges.vertices.shape[0]

    def first(chosen: Bool[Array, " corners"]) -> Int[Array, " edges"]:
        none = jnp.full(count, edge_ids.size, jnp.int32)
        found = none.at[jnp.where(chosen, edge_ids, count)].min(corner, mode="drop")
        return jnp.where(found < edge_ids.size, found, -1)

    ahead, back = first(runs > 0), first(runs < 0)
    across = jnp.where(runs > 0, get(back, edge_ids), get(ahead, edge_ids))
    outline = (ahead < 0) != (back < 0)
    if creases is None:
        creases = jnp.zeros(count, bool)
    ends = tuple(jnp.asarray(edges.vertices).T)
    return Links(edge_ids, across, ends, creases, outline | creases)


def _follow(
    at_corners: Screen,
    links: Links,
    pairs: Index,
    total: Int[Array, ""],
    ids: Int[Array, " texels"],
    width: int,
) -> tuple[_Walks, Int[Array, ""]]:
    """Follow the surfaces seen at both ends of each way towards the other end.

    A few walkers go one step at a time, and who is done takes up the next way: most arrive
    after a step or two, some need many. The last go on in a smaller group.

    Args:
        at_corners: The mesh in the image, with vertices of their own for each face's corners.
        links: ``link_faces`` of the mesh.
        pairs: Ways, as in ``_Walks``.
        total: How many are meant, from the first.
        ids: The face seen at each texel.
        width: Of the image.

    Returns:
        Walks, but of those ways where one surface leads from end to end, and how many.
    """

    def step(carry: tuple) -> tuple:
        taken, walker, walks, count = carry
        free = walker.leg < 0
        turn = taken + prefix_sum(free.astype(jnp.int32)) - 1
        starts = free & (turn < total)
        pair = jnp.where(starts, pairs.at[turn].get(mode="clip"), walker.pair)
        leg = jnp.where(starts, 0, walker.leg)
        ways = _ways(pair, width, ids.size)
        back = ways.back
        texel = jnp.where(leg == 1, back.texel, ways.texel)
        ways = Ways(texel, jnp.where(leg == 1, back.side, ways.side), width)
        face = jnp.where(walker.corner < 0, get(ids, ways.texel), walker.corner // 3)
        far = get(ids, ways.other)

        along, by = _leave(at_corners, ways, jnp.maximum(face, 0), walker.corner)
        edge, beyond = get(links.edge_ids, by), get(links.across, by)
        lost = (face < 0) | (along == -jnp.inf) | (walker.steps >= _STEPS)
        passed, ended = ~lost & (along > 1), ~lost & (along <= 1) & (beyond < 0)
        done = (leg >= 0) & (lost | passed | ended)
        crossed = get(links.creases, edge) & (walker.crease < 0)
        arrived = passed & (face == far)
        end = jnp.where(ended, edge, jnp.where(arrived, walker.crease, -1))
        last = jnp.where(passed | ended, face, -1)

        both = _Walks(pair, (walker.end, end), (walker.last, last))
        walks, count = _put(walks, both, done & (leg == 1), count)
        returns = done & (leg == 0) & ~(arrived & (end < 0))
        walker = _Walker(
            pair,
            jnp.where(returns, 1, jnp.where(done, -1, leg)),
            jnp.where(done, -1, beyond),
            jnp.where(done, -1, jnp.where(crossed, edge, walker.crease)),
            jnp.where(done, 0, walker.steps + 1),
            jnp.where(returns, end, walker.end),
            jnp.where(returns, last, walker.last),
        )
        return jnp.minimum(taken + jnp.sum(free, dtype=jnp.int32), total), walker, walks, count

    def go(carry: tuple, rest: int) -> tuple:
        """Go on until so many are left."""
        more = lambda carry: (carry[0] < total) | (jnp.sum(carry[1].leg >= 0) > rest)
        return lax.while_loop(more, step, carry)

    def idle(size: int) -> _Walker:
        none = jnp.full(size, -1, jnp.int32)
        return _Walker(none, none, none, none, jnp.zeros_like(none), none, none)

    empty = jnp.zeros_like(pairs)
    walks = _Walks(empty, (empty, empty), (empty, empty))
    taken, walker, *found = go((jnp.int32(0), idle(_PIECE), walks, jnp.int32(0)), _LAST)
    walker, _ = _put(idle(_LAST), walker, walker.leg >= 0, jnp.int32(0))
    _, _, *found = go((taken, walker, *found), 0)
    return tuple(found)


def _is_plain(
    screen: Screen, links: Links, ways: Ways, ids: Int[Array, " texels"]
) -> Bool[Array, " ways"]:
    """Tell where a way leads over an edge inside the surface, from one of its faces to the other.

    Nothing else can be crossed there, and most ways are such.
    """
    faces = get(ids, ways.texel), get(ids, ways.other)
    here, there = (
        [get(links.edge_ids, 3 * jnp.maximum(face, 0) + k) for k in range(3)] for face in faces
    )
    edge = jnp.full_like(ways.texel, -1)
    for this in here:
        shared = (this == there[0]) | (this == there[1]) | (this == there[2])
        edge = jnp.where(shared, this, edge)
    meet, edge = edge >= 0, jnp.maximum(edge, 0)
    inside = meet & ~get(links.creases, edge)
    a, b = (place(screen, ways, get(end, edge)) for end in links.vertices)
    in_front = (a.w > 0) & (b.w > 0) & ((a.across >= 0) != (b.across >= 0))
    along, seen = edge_crossing(a, b), jnp.minimum(*faces) >= 0
    return seen & inside & in_front & (along > _ROUNDING) & (along < 1 - _ROUNDING)


def _ways(pair: Index, width: int, texels: int) -> Ways:
    return Ways(pair % texels, 2 * (pair // texels), width)


def _leave(at_corners: Screen, ways: Ways, face: Index, came_by: Index) -> tuple[Length, Index]:
    """Return where a face is left: how far along the way, and from which corner the edge leads.

    The first is -inf where the way does not cross the face.
    """
    corners = [3 * face + k for k in range(3)]
    points = [place(at_corners, ways, corner) for corner in corners]
    farthest, by = jnp.full(face.shape, -jnp.inf, at_corners.w.dtype), corners[0]
    for k in range(3):
        a, b = points[k], points[(k + 1) % 3]
        crosses = (a.across >= 0) != (b.across >= 0)
        w = a.w * b.across - b.w * a.across
        in_front = jnp.where(b.across >= 0, w, -w) > 0
        along = jnp.where(in_front, edge_crossing(a, b), jnp.inf)
        along = once(jnp.where(crosses & (corners[k] != came_by), along, -jnp.inf))
        by = jnp.where(along > farthest, corners[k], by)
        farthest = jnp.maximum(along, farthest)
    return farthest, by


def _meet(
    screen: Screen, links: Links, walks: _Walks, ids: Int[Array, " texels"], width: int
) -> tuple[Crossings, Crossings]:
    """Return edges and lines on each way; for their total, whether they are there."""
    ways = _ways(walks.pair, width, ids.size)
    back = ways.back
    face, other = get(ids, ways.texel), get(ids, ways.other)
    # From both ends at once: a program half as long.
    texel, side = (jnp.concatenate(ends) for ends in zip(ways[:2], back[:2], strict=True))
    both = Ways(texel, side, width)
    edge = jnp.concatenate(walks.end)
    seen_there = jnp.concatenate([other, face])
    along, depth = _edge_depth(screen, links, both, jnp.maximum(edge, 0))
    surface = face_plane(screen, both, seen_there).at(along)
    seen = (edge >= 0) & ~((seen_there >= 0) & (depth > surface + _EQUAL))
    there, back_there = jnp.split(seen, 2)
    nearer = back_there & (~there | (jnp.less(*jnp.split(depth, 2)[::-1])))
    found = [jnp.where(nearer, *jnp.split(x, 2)[::-1]) for x in (texel, side, edge)]
    at_edges = Crossings(4 * found[0] + found[1], (found[2],), there | back_there)
    # Neither is seen to end before the other's centre, and they are not one surface.
    last, back_last = walks.last
    apart = (last >= 0) & (back_last >= 0) & (last != other) & (back_last != face)
    here = face_plane(screen, ways, back_last).at(0.0) - face_plane(screen, ways, face).at(0.0)
    beyond = face_plane(screen, back, last).at(0.0) - face_plane(screen, back, other).at(0.0)
    cross = apart & (here >= 0) & (beyond >= 0) & (here + beyond > _APART)
    way = 4 * ways.texel + ways.side
    return at_edges, Crossings(way, (back_last, last), cross & ~at_edges.total)


def _edge_depth(screen: Screen, links: Links, ways: Ways, edge: Index) -> tuple[Length, Length]:
    """Return how far along the way an edge crosses it, and its window depth there."""
    vertices = [get(end, edge) for end in links.vertices]
    a, b = (place(screen, ways, vertex) for vertex in vertices)
    z_a, z_b = (get(screen.depth, vertex) for vertex in vertices)
    w = a.w * b.across - b.w * a.across
    return edge_crossing(a, b), safe_divide(z_a * b.across - z_b * a.across, w)
