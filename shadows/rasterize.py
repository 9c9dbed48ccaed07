"""Which face covers each pixel, and how deep: the rasterizer under every pass.

The depth buffer holds complex numbers ``depth + i * face``, whose order is lexicographic:
one scatter-minimum settles both the depth and the face, and a tie goes to the lower face
in whatever order faces arrive.
"""

import functools
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.custom_batching import sequential_vmap
from jaxtyping import Array, Complex, Float, Int

from ._fragments import Drawing, Fragments, draw
from .interpolate import ClipPositions, Faces, window_depth

_EMPTY = 2.0  # NDC depth of a pixel without a face

Buffer = Complex[Array, " image"]


class Raster(NamedTuple):
    """What a rasterization found at each pixel.

    Attributes:
        face_ids: The nearest face, -1 where there is none.
        depth: Its window depth in [0, 1]; 1 where there is none.
    """

    face_ids: Int[Array, "height width"]
    depth: Float[Array, "height width"]


def rasterize(
    clip_positions: ClipPositions,
    faces: Faces,
    *,
    image_size: tuple[int, int],
    cull_back: bool = False,
    cull_front: bool = False,
    chunk: int = 2**15,
) -> Raster:
    """Find the nearest face at each pixel centre.

    Follows OpenGL: y up in NDC (row 0 of the image is at NDC y = +1), only depths in
    [-1, 1] kept (near and far plane), a centre on a shared edge belongs to exactly one
    face. Of faces that cross the near plane or pass behind the eye the visible part is
    drawn; faces of zero area cover nothing; faces with a coordinate that is not finite are
    left out.

    Args:
        clip_positions: Vertices in clip space; matrices applied, not yet divided by w.
        faces: Vertex indices; a face is front-facing where it is counter-clockwise in NDC.
        image_size: Height and width in pixels.
        cull_back: Leave out faces seen from behind.
        cull_front: Leave out faces seen from the front.
        chunk: Faces and rows handled at a time. 2**15 suits a CPU's caches; a GPU, where
            every step of a loop costs a launch, wants more (at most 2**18).

    Returns:
        The face and the depth at each pixel. Of faces at the same depth the one with the
        lowest index wins.

    Raises:
        ValueError: If a shape, the image size or the chunk is impossible (while tracing).
        EquinoxRuntimeError: If a face refers to a missing vertex (at run time, also under
            ``jit``; disable with ``EQX_ON_ERROR=off``).

    Differentiability:
        ``depth`` has the exact derivative, in ``clip_positions``, of the plane of the face
        at each pixel (forward and reverse mode); it is computed only when asked for.
        Which face is seen is piecewise constant, so silhouettes contribute nothing.
        Under ``vmap`` the images are made one after another.

    References:
        M. Olano, T. Greer, "Triangle Scan Conversion using 2D Homogeneous Coordinates",
        Graphics Hardware 1997.
    """
    drawing = Drawing(*image_size, chunk, cull_back, cull_front)
    face_ids, depth = _rasterize(drawing, 1, *_checked(clip_positions, faces, image_size, chunk))
    return Raster(face_ids[0], depth[0])


def rasterize_two(
    clip_positions: ClipPositions,
    faces: Faces,
    *,
    image_size: tuple[int, int],
    chunk: int = 2**15,
) -> tuple[Raster, Raster]:
    """Find the nearest face at each pixel centre, and the next one behind it.

    For twice the time of ``rasterize``, which tells of the arguments and derivatives. Two
    faces at the same depth are two layers.

    References:
        C. Everitt, "Interactive Order-Independent Transparency", NVIDIA 2001 (depth peeling).
    """
    drawing = Drawing(*image_size, chunk)
    face_ids, depth = _rasterize(drawing, 2, *_checked(clip_positions, faces, image_size, chunk))
    return Raster(face_ids[0], depth[0]), Raster(face_ids[1], depth[1])


def _checked(
    clip_positions: ClipPositions, faces: Faces, image_size: tuple[int, int], chunk: int
) -> tuple[Array, Array]:
    vertices, corners = jnp.asarray(clip_positions), jnp.asarray(faces)
    _check_static(vertices, corners, image_size, chunk)
    count = vertices.shape[0]
    message = f"rasterize: `faces` refers to a vertex outside 0..{count - 1}"
    return eqx.error_if(vertices, jnp.any((corners < 0) | (corners >= count)), message), corners


def _check_static(clip_positions: Array, faces: Array, image_size: tuple, chunk: int) -> None:
    def fail(name: str, expected: str, got: object) -> None:
        raise ValueError(f"rasterize: expected `{name}` {expected}, got {got}")

    if clip_positions.ndim != 2 or clip_positions.shape[1] != 4 or not clip_positions.shape[0]:
        fail("clip_positions", "of shape (vertices, 4)", clip_positions.shape)
    if clip_positions.dtype not in (jnp.float32, jnp.float64):
        fail("clip_positions", "of dtype float32 or float64", clip_positions.dtype)
    if faces.ndim != 2 or faces.shape[1] != 3 or not faces.shape[0]:
        fail("faces", "of shape (faces, 3)", faces.shape)
    if not jnp.issubdtype(faces.dtype, jnp.integer):
        fail("faces", "of an integer dtype", faces.dtype)
    if faces.shape[0] > 2**24:
        fail("faces", "to hold at most 2**24 faces", faces.shape[0])
    if len(image_size) != 2 or not all(
        isinstance(size, int | np.integer) and 1 <= size <= 2**14 for size in image_size
    ):
        fail("image_size", "to be a height and a width from 1 to 16384", image_size)
    if not 2**10 <= chunk <= 2**18:
        fail("chunk", "from 2**10 to 2**18", chunk)


@functools.partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def _rasterize(
    drawing: Drawing, layers: int, clip_positions: Array, faces: Array
) -> tuple[Int[Array, "layers height width"], Float[Array, "layers height width"]]:
    return sequential_vmap(functools.partial(_scan, drawing, layers))(clip_positions, faces)


@_rasterize.defjvp
def _rasterize_jvp(drawing: Drawing, layers: int, primals: tuple, tangents: tuple) -> tuple:
    clip_positions, faces = primals
    face_ids, depth = _rasterize(drawing, layers, clip_positions, faces)

    def depths(positions: Array) -> Array:
        return jnp.stack([window_depth(positions, faces, layer) for layer in face_ids])

    _, depth_dot = jax.jvp(depths, (clip_positions,), tangents[:1])
    return (face_ids, depth), (np.zeros(face_ids.shape, jax.dtypes.float0), depth_dot)


def _scan(
    drawing: Drawing, layers: int, clip_positions: Array, faces: Array
) -> tuple[Int[Array, "layers height width"], Float[Array, "layers height width"]]:
    """Find the layers one after another."""
    pixels = drawing.height * drawing.width
    empty = jnp.full(pixels, _EMPTY, jnp.result_type(clip_positions.dtype, jnp.complex64))
    buffers: list[Buffer] = []
    for _ in range(layers):
        write = functools.partial(_lower, buffers[-1] if buffers else None)
        buffers.append(draw(drawing, clip_positions, faces, empty, write))
    buffer = jnp.stack(buffers).reshape(-1, drawing.height, drawing.width)
    covered = buffer.real <= 1
    face_ids = jnp.where(covered, buffer.imag.astype(jnp.int32), -1)
    return face_ids, jnp.where(covered, 0.5 * buffer.real + 0.5, 1.0)


def _lower(before: Buffer | None, buffer: Buffer, fragments: Fragments) -> Buffer:
    """Keep the nearest fragments between the near and the far plane.

    ``before`` is the layer in front, of which only what lies behind is drawn.
    """
    depth = fragments.depth
    inside = fragments.inside & (depth >= -1) & (depth <= 1)
    pixel = jnp.where(inside, fragments.pixel, buffer.shape[0])
    face = jnp.broadcast_to(fragments.face[:, None].astype(depth.dtype), depth.shape)
    if before is not None:
        seen = before.at[pixel].get(mode="clip")
        behind = (depth > seen.real) | ((depth == seen.real) & (face > seen.imag))
        pixel = jnp.where(behind, pixel, buffer.shape[0])
    return buffer.at[pixel].min(lax.complex(depth, face), mode="drop")
