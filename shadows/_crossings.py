"""What crosses between the centres of neighbouring texels: the search under ``coverage``.

All of it is discrete: which edge, which faces. Nothing here has a derivative.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Int, PyTree

from tangentspace._math import safe_divide

from ._fragments import get
from ._scan_convert import prefix_sum, signed_area
from ._ways import Index, Length, Screen, Ways, edge_crossing, face_plane, place
from .silhouettes import MeshEdges

_PIECE = 2**11  # ways looked at together
_PAIRS = 2**15  # of texels that are listed together
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
        face: Where it is.
        came_by: The edge over which it came there; -1 at the start.
        crease: The first that it came over on this leg; -1 if none.
        steps: Made on this leg.
        end: Found on leg 0.
        last: Found on leg 0.
    """

    pair: Index
    leg: Index
    face: Index
    came_by: Index
    crease: Index
    steps: Index
    end: Index
    last: Index


class Links(NamedTuple):
    """Which faces lie beside each other in the image.

    Attributes:
        edge_ids: The edge from each corner of a face to the next one.
        runs: +1 where the face, turned to the viewer, runs forward along that edge, or -1.
        forward: A face that runs forward along an edge; past the last face if there is none.
        backward: A face that runs backward.
        vertices: The two ends of each edge.
        creases: Where one look of the surface ends and another begins.
    """

    edge_ids: tuple[Int[Array, " faces"], ...]
    runs: tuple[Int[Array, " faces"], ...]
    forward: Int[Array, " edges"]
    backward: Int[Array, " edges"]
    vertices: tuple[Int[Array, " edges"], ...]
    creases: Bool[Array, " edges"]

    @property
    def outline(self) -> Bool[Array, " edges"]:
        """Where the surface ends or turns back, or its look changes."""
        none = self.edge_ids[0].size
        return ((self.forward == none) != (self.backward == none)) | self.creases


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

    def step(carry: tuple) -> tuple:
        first, *found = carry
        pairs = _chosen(apart, ends - first, some)
        there = first + jnp.arange(some, dtype=jnp.int32) < ends[-1]
        plain = _is_plain(screen, links, _ways(pairs, width, ids.size), ids)
        others, count = marked(there & ~plain)
        walks, count = _follow(screen, links, get(pairs, others), count, ids, width)

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
    edge_ids = jnp.asarray(edges.edge_ids)
    corners = jnp.stack(screen.corners)
    area = signed_area(*(get(axis, corners) for axis in (screen.column, screen.row, screen.w)))
    turned = jnp.where(area < 0, -1, 1).astype(jnp.int32)
    runs = turned[:, None] * jnp.asarray(edges.directions)
    face_count, edge_count = edge_ids.shape[0], edges.vertices.shape[0]
    face = jnp.broadcast_to(jnp.arange(face_count, dtype=jnp.int32)[:, None], runs.shape)

    def first(chosen: Bool[Array, "faces 3"]) -> Int[Array, " edges"]:
        none = jnp.full(edge_count, face_count, jnp.int32)
        return none.at[jnp.where(chosen, edge_ids, edge_count)].min(face, mode="drop")

    ends = tuple(jnp.asarray(edges.vertices).T)
    if creases is None:
        creases = jnp.zeros(edge_count, bool)
    parts = first(runs > 0), first(runs < 0), ends, creases
    return Links(tuple(edge_ids.T), tuple(runs.T), *parts)


def _follow(
    screen: Screen,
    links: Links,
    pairs: Index,
    total: Int[Array, ""],
    ids: Int[Array, " texels"],
    width: int,
) -> tuple[_Walks, Int[Array, ""]]:
    """Follow the surfaces seen at both ends of each way towards the other end.

    A few walkers go one step at a time, and who is done takes up the next way: most arrive
    after a step or two, some need many.

    Returns:
        Walks, but of those ways where one surface leads from end to end, and how many.
    """
    none, idle = screen.corners[0].size, jnp.full(_PIECE, -1, jnp.int32)

    def step(carry: tuple) -> tuple:
        taken, walker, walks, count = carry
        free = walker.leg < 0
        turn = taken + prefix_sum(free.astype(jnp.int32)) - 1
        starts = free & (turn < total)
        pair = jnp.where(starts, pairs.at[turn].get(mode="clip"), walker.pair)
        leg = jnp.where(starts, 0, walker.leg)
        ways = _ways(pair, width, ids.size)
        texel, side = jnp.where(leg == 1, jnp.stack(ways.back[:2]), jnp.stack(ways[:2]))
        ways = Ways(texel, side, width)
        face = jnp.where(walker.came_by < 0, get(ids, ways.texel), walker.face)
        far = get(ids, ways.other)

        along, edge, run = _leave(screen, links, ways, jnp.maximum(face, 0), walker.came_by)
        next_face = jnp.where(run > 0, get(links.backward, edge), get(links.forward, edge))
        lost = (face < 0) | (run == 0) | (walker.steps >= _STEPS)
        passed, ended = ~lost & (along > 1), ~lost & (along <= 1) & (next_face == none)
        done = (leg >= 0) & (lost | passed | ended)
        crossed = get(links.creases, edge) & (walker.crease < 0)
        arrived = passed & (face == far)
        end = jnp.where(ended, edge, jnp.where(arrived, walker.crease, -1))
        last = jnp.where(passed | ended, face, -1)

        both = _Walks(pair, (walker.end, end), (walker.last, last))
        walks, count = _put(walks, both, done & (leg == 1), count)
        back = done & (leg == 0) & ~(arrived & (end < 0))
        walker = _Walker(
            pair,
            jnp.where(back, 1, jnp.where(done, -1, leg)),
            next_face,
            jnp.where(done, -1, edge),
            jnp.where(done, -1, jnp.where(crossed, edge, walker.crease)),
            jnp.where(done, 0, walker.steps + 1),
            jnp.where(back, end, walker.end),
            jnp.where(back, last, walker.last),
        )
        return jnp.minimum(taken + jnp.sum(free, dtype=jnp.int32), total), walker, walks, count

    going = lambda carry: (carry[0] < total) | jnp.any(carry[1].leg >= 0)
    empty = jnp.zeros_like(pairs)
    walks = _Walks(empty, (empty, empty), (empty, empty))
    walker = _Walker(idle, idle, idle, idle, idle, jnp.zeros_like(idle), idle, idle)
    _, _, walks, count = lax.while_loop(going, step, (jnp.int32(0), walker, walks, jnp.int32(0)))
    return walks, count


def _is_plain(
    screen: Screen, links: Links, ways: Ways, ids: Int[Array, " texels"]
) -> Bool[Array, " ways"]:
    """Tell where a way leads over an edge inside the surface, from one of its faces to the other.

    Nothing else can be crossed there, and most ways are such.
    """
    faces = get(ids, ways.texel), get(ids, ways.other)
    here, there = (jnp.maximum(face, 0) for face in faces)
    edges, edge = [get(column, there) for column in links.edge_ids], jnp.full_like(here, -1)
    for column in links.edge_ids:
        this = get(column, here)
        shared = (this == edges[0]) | (this == edges[1]) | (this == edges[2])
        edge = jnp.where(shared, this, edge)
    meet, edge = edge >= 0, jnp.maximum(edge, 0)
    inside = meet & ~get(links.creases, edge)
    a, b = (place(screen, ways, get(end, edge)) for end in links.vertices)
    in_front = (a.w > 0) & (b.w > 0) & ((a.across >= 0) != (b.across >= 0))
    along, seen = edge_crossing(a, b), jnp.minimum(*faces) >= 0
    return seen & inside & in_front & (along > _ROUNDING) & (along < 1 - _ROUNDING)


def _ways(pair: Index, width: int, texels: int) -> Ways:
    return Ways(pair % texels, 2 * (pair // texels), width)


def _leave(
    screen: Screen, links: Links, ways: Ways, face: Index, came_by: Index
) -> tuple[Length, Index, Index]:
    """Return where a face is left: how far along the way, by which edge, and how it runs there.

    The last is 0 where the way does not cross the face.
    """
    points = [place(screen, ways, corner) for corner in screen.corners_of(face)]
    farthest = jnp.full(face.shape, -jnp.inf, screen.w.dtype)
    by, run = jnp.zeros_like(face), jnp.zeros_like(face)
    for k in range(3):
        a, b = points[k], points[(k + 1) % 3]
        crosses = (a.across >= 0) != (b.across >= 0)
        w = a.w * b.across - b.w * a.across
        in_front = jnp.where(b.across >= 0, w, -w) > 0
        along = jnp.where(in_front, edge_crossing(a, b), jnp.inf)
        this = get(links.edge_ids[k], face)
        take = crosses & (this != came_by) & (along > farthest)
        farthest, by = jnp.where(take, along, farthest), jnp.where(take, this, by)
        run = jnp.where(take, get(links.runs[k], face), run)
    return farthest, by, run


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
