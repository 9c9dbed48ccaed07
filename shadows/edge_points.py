"""Places on the edges of an image, where what is seen on both sides can be asked.

An edge that moves trades what lies on its one side for what lies on the other, right at it. The
centres of the texels beside it are off by half a texel, where colors may be others: towards the
outline of a ball they change as fast as a square root, and where something stands on a floor its
shadow begins at the edge. So derivatives ask at the edge itself.

References:
    T.-M. Li, M. Aittala, F. Durand, J. Lehtinen, "Differentiable Monte Carlo Ray Tracing through
    Edge Sampling", SIGGRAPH Asia 2018, section 4.1: the derivative of a pixel is an integral, over
    the edges in it, of the difference of what is seen on both sides.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from tangentspace._math import safe_divide

from ._fragments import get
from ._ways import Length, Screen, Ways, edge_crossing, line_crossing, line_planes, place
from .coverage import Coverage, cut_texel
from .interpolate import ClipPositions, FaceIds, Faces
from .silhouettes import MeshEdges


class EdgePoints(NamedTuple):
    """Places on edges between the centres of neighbouring texels.

    Attributes:
        texels: On both sides of the edge; indices into the flattened image.
        place: NDC x and y.
        rest: The one that the edge bounds, an index into the flattened ``Coverage.rests``; one
            beyond the last where nothing is meant.
        ends: Whether the surface seen at the first texel ends at the edge.
        vertices: Of the mesh's edge where it does.
        weight: Of the second vertex, where attributes of both are blended.
    """

    texels: Int[Array, "2 points"]
    place: tuple[Float[Array, " points"], Float[Array, " points"]]
    rest: Int[Array, " points"]
    ends: Bool[Array, " points"]
    vertices: tuple[Int[Array, " points"], Int[Array, " points"]]
    weight: Float[Array, " points"]

    def beside(self, image: Array) -> Array:
        """Return an image's values at the texels on both sides, (2, points, ...)."""
        return get(image.reshape(-1, *image.shape[2:]), self.texels)


def edge_changes(
    clip_positions: ClipPositions,
    faces: Faces,
    edges: MeshEdges,
    face_ids: FaceIds,
    coverage: Coverage,
    image: Float[Array, "height width channels"],
    look: Callable[[EdgePoints], Float[Array, "2 points channels"]],
    *,
    creases: Bool[Array, " edges"] | None = None,
) -> Float[Array, "4 height width channels"]:
    """Return how differences between neighbours change from the centres to the edge.

    Args:
        clip_positions: Vertices in clip space.
        faces: Vertex indices.
        edges: ``mesh_edges(positions, faces)``.
        face_ids: What ``rasterize`` found there.
        coverage: ``coverage`` of the same.
        image: Values at the centres.
        look: Returns the values on both sides of edges. It is asked for some points at a time.
        creases: As ``coverage`` was told.

    Returns:
        For each rest: the neighbour's value less the texel's own, at the edge, less the same
        at the centres; 0 where there is no rest. For ``blend_layers``.

    Differentiability:
        None: all arguments, and what ``look`` holds, are to be without derivatives.
    """
    height, width = face_ids.shape
    screen = Screen.of(clip_positions, faces, height, width)
    ids, (at_edges, at_lines) = face_ids.reshape(-1), coverage.crossings
    ends_of_edges, most = _corners(edges, faces), at_edges.way.size
    size = min(4 * (height + width), most)
    of_edges, of_lines = (-(-crossings.total // size) for crossings in coverage.crossings)

    def points(piece: Int[Array, ""]) -> tuple[EdgePoints, Ways, Length]:
        lines = piece >= of_edges
        here = at_edges.part(jnp.clip(piece * size, 0, most - size), size)
        there = at_lines.part(jnp.clip((piece - of_edges) * size, 0, most - size), size)
        count = jnp.where(lines, there.total, here.total)
        ways = here._replace(way=jnp.where(lines, there.way, here.way)).ways(width)
        texel, side = ways.texel, ways.side
        edge = jnp.where(lines, 0, here.by[0])
        vertices = get(ends_of_edges[0], edge), get(ends_of_edges[1], edge)
        a, b = (place(screen, ways, vertex) for vertex in vertices)
        line = line_crossing(*line_planes(screen, ways, there.by, ids)).along
        along = jnp.clip(jnp.where(lines, line, edge_crossing(a, b)), 0, 1)
        rest = jnp.where(jnp.arange(size) < count, cut_texel(ways, along, height)[1], 4 * ids.size)
        step = jnp.where(side % 2 == 0, along, -along)
        column = texel % width + 0.5 + jnp.where(side < 2, step, 0)
        row = texel // width + 0.5 + jnp.where(side < 2, 0, step)
        ends = ~lines & ~(False if creases is None else get(creases, edge))
        found = EdgePoints(
            jnp.stack([texel, ways.other]),
            (2 * column / width - 1, 1 - 2 * row / height),
            rest,
            ends,
            vertices,
            safe_divide(a.across, a.across - b.across),
        )
        return found, ways, along

    def step(carry: tuple) -> tuple:
        piece, changes = carry
        some, ways, along = points(piece)
        values = look(some)
        inwards = Ways(ways.texel, ways.side ^ 1, width), Ways(ways.other, ways.side, width)
        bends = [
            _bend(*side, coverage, image)
            for side in zip(values, inwards, (along, 1 - along), strict=True)
        ]
        values += jnp.stack(bends) - some.beside(image)
        change = values[1] - values[0]
        # The rest is the neighbour's: that of the second texel is the first one's.
        own = (some.rest % ids.size == some.texels[0])[:, None]
        return piece + 1, changes.at[some.rest].set(jnp.where(own, change, -change), mode="drop")

    none = jnp.zeros((4 * ids.size, image.shape[-1]), image.dtype)
    going = lambda carry: carry[0] < of_edges + of_lines
    changes = lax.while_loop(going, step, (jnp.int32(0), none))[1]
    return changes.reshape(4, *image.shape)


def _bend(
    at_edge: Float[Array, "points channels"],
    inwards: Ways,
    away: Length,
    coverage: Coverage,
    image: Float[Array, "height width channels"],
) -> Float[Array, "points channels"]:
    """Return how far values at centres beside an edge are above straight lines from there.

    The lines go to a texel's width from the edge. Sums over centres take what changes beside an
    edge, such as light towards the outline of a ball, to change evenly there; the mean of this
    is what they miss. 0 where there is an edge or the image's border behind the texel.

    Args:
        at_edge: Values there.
        inwards: From the texel whose centre it is, away from the edge.
        away: The edge, in texels.
        coverage: Of the image.
        image: Values at the centres.
    """
    texel, side, width = inwards
    size, behind = coverage.side.size, inwards.other
    there = (behind >= 0) & (behind < size) & ((side >= 2) | (behind // width == texel // width))
    behind = jnp.where(there, behind, texel)
    rests = coverage.rests.reshape(-1)
    parted = get(rests, side * size + texel) + get(rests, (side ^ 1) * size + behind) > 0
    values = image.reshape(size, -1)
    centre, next_centre, away = get(values, texel), get(values, behind), away[:, None]
    at_one = away * centre + (1 - away) * next_centre
    bend = centre - (1 - away) * at_edge - away * at_one
    return jnp.where((there & ~parted)[:, None], bend, 0)


def _corners(edges: MeshEdges, faces: Faces) -> tuple[Int[Array, " edges"], Int[Array, " edges"]]:
    """Return the vertices at both ends of each edge that one of its faces has there.

    ``edges.vertices`` may be others at the same place, with other normals.
    """
    start = jnp.asarray(faces, jnp.int32)
    end, forward = jnp.roll(start, -1, axis=1), jnp.asarray(edges.directions) > 0
    none = jnp.zeros(edges.vertices.shape[0], jnp.int32)
    at_ends = jnp.where(forward, start, end), jnp.where(forward, end, start)
    first, second = (none.at[jnp.asarray(edges.edge_ids)].max(values) for values in at_ends)
    return first, second
