"""Every pixel of every face, handed to a function: the loops under all drawing.

Faces are expanded to rows and rows to pixels in chunks of fixed size inside ``while``
loops: nothing to guess, nothing that overflows, memory bounded by the chunk whatever the
mesh, and the time follows the faces and pixels that there are. The first few pixels of a
row are written at once (most rows of a fine mesh end there), the rest in wider pieces.

What becomes of the pixels is up to the function that they are handed to: keep the nearest,
count them.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from ._scan_convert import Spans, owners, prefix_sum, row_ranges, spans

_FIRST = 4  # pixels of a row that are written at once
_PIECE = 16  # pixels of each further piece


class Fragments(NamedTuple):
    """Some pixels of some faces.

    Attributes:
        pixel: Index into the flattened image.
        depth: NDC depth of the face at the pixel's centre.
        inside: Whether the face covers the centre; if not, all else means nothing.
        face: Index of the face, the same for all pixels of an item.
        front: Whether the face is seen counter-clockwise.
    """

    pixel: Int[Array, "items pixels"]
    depth: Float[Array, "items pixels"]
    inside: Bool[Array, "items pixels"]
    face: Int[Array, " items"]
    front: Bool[Array, " items"]


Buffer = Array
Write = Callable[[Buffer, Fragments], Buffer]


class Drawing(NamedTuple):
    """How to draw.

    Attributes:
        height: Of the image, pixels.
        width: Of the image, pixels.
        chunk: Faces and rows handled at a time.
        cull_back: Leave out faces seen from behind.
        cull_front: Leave out faces seen from the front.
        cull_far: Leave out faces that lie wholly beyond the far plane.
    """

    height: int
    width: int
    chunk: int
    cull_back: bool = False
    cull_front: bool = False
    cull_far: bool = True


def draw(
    drawing: Drawing,
    clip_positions: Float[Array, "vertices 4"],
    faces: Int[Array, "faces 3"],
    buffer: Buffer,
    write: Write,
    *,
    face_count: Int[Array, ""] | int | None = None,
) -> Buffer:
    """Hand all pixels of all faces to a function.

    Args:
        drawing: Size and options.
        clip_positions: Vertices in clip space.
        faces: Vertex indices, all valid.
        buffer: What the function changes.
        write: Takes the buffer and some fragments, in no order, and returns the buffer.
            Depths are not clipped to the near and far plane.
        face_count: How many of the faces to draw, from the first; all by default.

    Returns:
        The buffer after all fragments.
    """
    # A common power of two changes nothing but keeps products within the exponent's range.
    w = jnp.abs(clip_positions[:, 3])
    largest = jnp.max(jnp.where(jnp.isfinite(w), w, 0))
    _, exponent = jnp.frexp(largest)
    vertices = jnp.ldexp(clip_positions, -exponent).T
    # No more rows at a time than an int32 can count.
    chunk = min(drawing.chunk, -(-faces.shape[0] // 64) * 64, 2**30 // drawing.height)
    steps = -(-faces.shape[0] // chunk)
    # Added faces have three equal corners and so cover nothing.
    corners = jnp.pad(faces.astype(jnp.int32), ((0, steps * chunk - faces.shape[0]), (0, 0))).T
    if face_count is not None:
        steps = -(-face_count // chunk)

    def step(carry: tuple) -> tuple:
        index, buffer = carry
        first_face = index * chunk
        corner = lax.dynamic_slice_in_dim(corners, first_face, chunk, axis=1)
        if face_count is not None:
            face = first_face + jnp.arange(chunk, dtype=jnp.int32)
            corner = jnp.where(face < face_count, corner, 0)
        clip = jnp.stack([axis.at[corner].get(mode="promise_in_bounds") for axis in vertices])
        return index + 1, _draw_faces(drawing, buffer, write, clip, first_face)

    return lax.while_loop(lambda carry: carry[0] < steps, step, (jnp.int32(0), buffer))[1]


def _draw_faces(
    drawing: Drawing,
    buffer: Buffer,
    write: Write,
    clip: Float[Array, "axes=4 corners=3 faces"],
    first_face: Int[Array, ""],
) -> Buffer:
    """Draw one chunk of faces, as many rows at a time as the chunk holds."""
    first_row, row_count = row_ranges(
        clip,
        drawing.height,
        cull_back=drawing.cull_back,
        cull_front=drawing.cull_front,
        cull_far=drawing.cull_far,
    )
    ends = prefix_sum(row_count)
    starts = ends - row_count
    total = ends[-1]

    def step(carry: tuple) -> tuple:
        first, buffer = carry
        owner = owners(starts, first, drawing.chunk)
        item = first + jnp.arange(drawing.chunk, dtype=jnp.int32)
        row = get(first_row - starts, owner) + item
        x, y, z, w = ([get(corner, owner) for corner in axis] for axis in clip)
        run = spans(x, y, z, w, row, drawing.height, drawing.width)
        run = run._replace(length=jnp.where(item < total, run.length, 0))
        start = row * drawing.width + run.column
        return first + drawing.chunk, _draw_spans(buffer, write, run, start, first_face + owner)

    return lax.while_loop(lambda carry: carry[0] < total, step, (jnp.int32(0), buffer))[1]


def _draw_spans(
    buffer: Buffer,
    write: Write,
    run: Spans,
    start: Int[Array, " items"],
    face: Int[Array, " items"],
) -> Buffer:
    """Draw the first pixels of every span, then what is left of the long ones in pieces."""
    first = jnp.arange(_FIRST, dtype=jnp.int32)[None]
    buffer = write(buffer, _fragments(run, start, face, first))
    piece_count = (jnp.maximum(run.length - _FIRST, 0) + (_PIECE - 1)) // _PIECE
    ends = prefix_sum(piece_count)
    starts = ends - piece_count
    total = ends[-1]
    batch = max(face.shape[0] // 8, 64)

    def step(carry: tuple) -> tuple:
        first, buffer = carry
        owner = owners(starts, first, batch)
        item = first + jnp.arange(batch, dtype=jnp.int32)
        offset = (_FIRST + (item - get(starts, owner)) * _PIECE)[:, None] + jnp.arange(
            _PIECE, dtype=jnp.int32
        )
        piece = Spans(*(get(values, owner) for values in run))
        piece = piece._replace(length=jnp.where(item < total, piece.length, 0))
        fragments = _fragments(piece, get(start, owner), get(face, owner), offset)
        return first + batch, write(buffer, fragments)

    return lax.while_loop(lambda carry: carry[0] < total, step, (jnp.int32(0), buffer))[1]


def _fragments(
    run: Spans,
    start: Int[Array, " items"],
    face: Int[Array, " items"],
    offset: Int[Array, "#items pixels"],
) -> Fragments:
    """Return the pixels at the given offsets into each span."""
    depth = run.depth[:, None] + offset.astype(run.depth.dtype) * run.slope[:, None]
    inside = offset < run.length[:, None]
    return Fragments(start[:, None] + offset, depth, inside, face, run.front)


def get(values: Array, index: Int[Array, "..."]) -> Array:
    """Return the values at indices that are known to be valid."""
    return values.at[index].get(mode="promise_in_bounds")
