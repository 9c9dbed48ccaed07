"""Environments infinitely far away, as cube maps: lookup by direction, mirror and skybox.

Faces stand in OpenGL's order, +x -x +y -y +z -z, and orientation: row 0 is the first row of
the image files. A direction ``(x, y, z)`` meets the face of its largest coordinate; with
``m`` that coordinate's size, column and row in ``[0, size]`` are ``(s + 1) size / 2`` and
``(t + 1) size / 2`` where

====  ====  ====
face  s m   t m
====  ====  ====
+x    -z    -y
-x    z     -y
+y    x     z
-y    x     -z
+z    x     -y
-z    -x    -y
====  ====  ====

Seen from inside, upright with +y up, the images on the sides are mirrored left to right in
a right-handed world: that is what the convention says, and what files made for it expect.

References:
    The Khronos Group, "OpenGL 4.6 Core Profile", section 8.13, "Cube Map Texture Selection",
    and 8.14, "Texture Minification", on seamless filtering.
"""

from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, Bool, Float, Int

from ._math import safe_normalize, stack_last
from .lighting import reflect
from .texture import Taps, gather_flat

Faces = Float[Array | np.ndarray, "6 size size channels"]
Directions = Float[Array | np.ndarray, "... 3"]
Border = Callable[[Float[Array, "6 n n c"]], Float[Array, "6 n+2 n+2 c"]]

# For each face: its middle, and the directions in which s and t grow.
_AXES = (
    ((1, 0, 0), (0, 0, -1), (0, -1, 0)),
    ((-1, 0, 0), (0, 0, 1), (0, -1, 0)),
    ((0, 1, 0), (1, 0, 0), (0, 0, 1)),
    ((0, -1, 0), (1, 0, 0), (0, 0, -1)),
    ((0, 0, 1), (1, 0, 0), (0, -1, 0)),
    ((0, 0, -1), (-1, 0, 0), (0, -1, 0)),
)


def opengl_border(faces: Float[Array, "6 n n c"]) -> Float[Array, "6 n+2 n+2 c"]:
    """Surround each face by texels that make bilinear lookup seamless, as OpenGL defines it.

    Across an edge continue the texels of the face there; beyond a corner, where no texel is,
    stands the mean of the three round it. That lines of texels have a kink at an edge is not
    taken into account: there the image is shifted along it by up to a quarter of a texel.

    Args:
        faces: The six images.
    """
    across = _across_edges(faces)
    return _surrounded(faces, across, (_corners(faces) + _at_corners(across)) / 3)


def smooth_border(faces: Float[Array, "6 n n c"]) -> Float[Array, "6 n+2 n+2 c"]:
    """Surround each face by texels that make bilinear lookup seamless, and exact at edges.

    Unlike ``opengl_border`` it takes the values on an edge from where the lines between
    opposite texels cross it: the error of a smooth image is of second order in the texels'
    size there too, and no larger than inside the faces. The border's values are extrapolated,
    but no lookup is: each blends texels with weights that are not negative.

    Args:
        faces: The six images.
    """
    size = faces.shape[1]
    own, across = _along_edges(faces), _across_edges(faces)
    place = ((1 - 0.5 / size) * _centres(size) + 1) * size / 2 - 0.5
    before = place.astype(int)
    after = np.minimum(before + 1, size - 1)
    weight = jnp.asarray(place - before, faces.dtype)[None, None, :, None]
    middle = (own + across) / 2
    border = 2 * ((1 - weight) * middle[:, :, before] + weight * middle[:, :, after]) - own
    corners = _corners(faces)
    four_thirds = jnp.asarray(4 / 3, faces.dtype) * (corners + _at_corners(across))
    return _surrounded(faces, border, four_thirds - corners - _at_corners(border))


class CubeMap(eqx.Module):
    """An environment: what is seen in each direction, linear radiance.

    Attributes:
        faces: Six square images in the order +x -x +y -y +z -z, row 0 first.
        border: How lookups near the edges go on to the next face: ``opengl_border``, equal to
            a driver's seamless filtering, or ``smooth_border``, more exact.
    """

    faces: Faces
    border: Border = eqx.field(static=True, default=opengl_border)


def sample_cube_map(cube_map: CubeMap, directions: Directions) -> Float[Array, "... channels"]:
    """Look up the environment in the directions given, bilinear and without seams.

    Args:
        cube_map: The environment.
        directions: World space, of any length.

    Returns:
        Radiance, of the type of the faces; black where a direction is zero.

    Raises:
        ValueError: If an array has the wrong shape.

    Differentiability:
        Linear in ``faces``. In ``directions`` continuous, and smooth between texel centres; on
        the lines through these the derivative is that of the side where s or t is larger.
        Where two faces or three meet it is that of one: of x before y before z. Zero
        where a direction is zero.
    """
    faces = _checked(cube_map.faces, "sample_cube_map")
    if not jnp.shape(directions) or jnp.shape(directions)[-1] != 3:
        expected = f"expected `directions` of shape (..., 3), got {jnp.shape(directions)}"
        raise ValueError(f"sample_cube_map: {expected}; give x, y, z along the last axis")
    face, s, t, exists = _project(jnp.asarray(directions))
    texels = cube_map.border(faces).reshape(-1, faces.shape[-1])
    colors = gather_flat(texels, _taps(face, s, t, faces.shape[1]))
    return jnp.where(exists[..., None], colors, 0.0)


def reflect_environment(
    cube_map: CubeMap, normal: Directions, to_camera: Directions
) -> Float[Array, "... channels"]:
    """Look up what a mirror shows: the environment along ``reflect(-to_camera, normal)``.

    Args:
        cube_map: The environment.
        normal: Unit normals, world space.
        to_camera: Vectors from the surface to the camera, world space, of any length.

    Differentiability:
        As ``sample_cube_map``, through the reflected direction.
    """
    return sample_cube_map(cube_map, reflect(-jnp.asarray(to_camera), normal))


def skybox(
    cube_map: CubeMap, clip_from_world: Float[Array | np.ndarray, "4 4"], height: int, width: int
) -> Float[Array, "{height} {width} channels"]:
    """Look up the environment along the view ray of each pixel of an image.

    It is infinitely far: a camera that moves without turning sees the same, and so does one
    of parallel rays at every pixel.

    Args:
        cube_map: The environment.
        clip_from_world: The camera's matrix.
        height: Rows of the image.
        width: Columns of the image.
    """
    return sample_cube_map(cube_map, view_directions(clip_from_world, height, width))


def view_directions(
    clip_from_world: Float[Array | np.ndarray, "4 4"], height: int, width: int
) -> Float[Array, "{height} {width} 3"]:
    """Return the direction of the view ray through each pixel's centre, away from the eye.

    A pixel ``(x, y)`` in NDC lies on the planes ``(m0 - x m3) p = 0`` and ``(m1 - y m3) p = 0``
    of the matrix's rows; their normals' cross product is linear in x and y.

    Args:
        clip_from_world: The camera's matrix, of a rigid view and any projection.
        height: Rows of the image, row 0 on top.
        width: Columns of the image.

    Returns:
        Directions in world space, not of unit length.

    Differentiability:
        Smooth in ``clip_from_world``.
    """
    across, up, _, forward = jnp.asarray(clip_from_world)[:, :3]
    x = (2 * jnp.arange(width, dtype=across.dtype)[None, :] + 1) / width - 1
    y = 1 - (2 * jnp.arange(height, dtype=across.dtype) + 1)[:, None] / height
    middle, along_x = jnp.cross(up, across), jnp.cross(forward, up)
    along_y = jnp.cross(across, forward)
    return stack_last(*(middle[k] + x * along_x[k] + y * along_y[k] for k in range(3)))


def cube_map_from_function(
    function: Callable[[Float[Array, "6 size size 3"]], Float[Array, "6 size size channels"]],
    size: int,
    *,
    dtype: DTypeLike = float,
) -> CubeMap:
    """Make a cube map from the radiance as a function of the direction.

    Args:
        function: Takes unit directions, world space; returns colors, the channels last.
        size: Rows and columns of each face.
        dtype: Floating-point type of the directions.

    Raises:
        ValueError: If the function's result has another shape.
    """
    faces = jnp.asarray(function(cube_directions(size, dtype=dtype)))
    if faces.shape[:-1] != (6, size, size):
        expected = f"expected `function` to return shape (6, {size}, {size}, channels)"
        raise ValueError(f"cube_map_from_function: {expected}, got {faces.shape}")
    return CubeMap(faces)


def cube_directions(size: int, *, dtype: DTypeLike = float) -> Float[Array, "6 {size} {size} 3"]:
    """Return the unit direction of each texel's centre, world space.

    Args:
        size: Rows and columns of each face.
        dtype: Floating-point type of the result.
    """
    centres = jnp.asarray(_centres(size), dtype)
    s, t = centres[None, :], centres[:, None]
    return safe_normalize(jnp.stack([_on_face(face, s, t) for face in range(6)]))


def _checked(faces: Faces, name: str) -> Float[Array, "6 n n c"]:
    """Return the faces as a JAX array; refuse what is no cube map."""
    shape = jnp.shape(faces)
    if len(shape) != 4 or shape[0] != 6 or shape[1] != shape[2] or 0 in shape:
        expected = f"expected `faces` of shape (6, size, size, channels), got {shape}"
        raise ValueError(f"{name}: {expected}; give six square images of one size")
    return jnp.asarray(faces)


def _project(
    directions: Float[Array, "... 3"],
) -> tuple[Int[Array, "..."], Float[Array, "..."], Float[Array, "..."], Bool[Array, "..."]]:
    """Return face, s and t in [-1, 1], and whether the direction is not zero."""
    x, y, z = (directions[..., k] for k in range(3))
    x_size, y_size, z_size = jnp.abs(x), jnp.abs(y), jnp.abs(z)
    on_x = (x_size >= y_size) & (x_size >= z_size)
    on_y = ~on_x & (y_size >= z_size)
    major = jnp.where(on_x, x, jnp.where(on_y, y, z))
    negative = major < 0
    size = jnp.where(negative, -major, major)
    signed_x, signed_z = jnp.where(negative, -x, x), jnp.where(negative, -z, z)
    s = jnp.where(on_x, -signed_z, jnp.where(on_y, x, signed_x))
    t = jnp.where(on_y, signed_z, -y)
    face = jnp.where(on_x, 0, jnp.where(on_y, 2, 4)) + negative.astype(jnp.int32)
    exists = size != 0
    safe_size = jnp.where(exists, size, 1.0)
    return face, s / safe_size, t / safe_size, exists


def _taps(
    face: Int[Array, "..."], s: Float[Array, "..."], t: Float[Array, "..."], size: int
) -> Taps:
    """Return the four texels round a point, among the faces with their borders."""
    wide = size + 2
    left, right_weight = _cell(s, size)
    top, bottom_weight = _cell(t, size)
    first = (face * wide + top) * wide + left
    left_weight, top_weight = 1 - right_weight, 1 - bottom_weight
    weights = [
        vertical * horizontal
        for vertical in (top_weight, bottom_weight)
        for horizontal in (left_weight, right_weight)
    ]
    indices = [first, first + 1, first + wide, first + wide + 1]
    return Taps(jnp.stack(indices, axis=-1), jnp.stack(weights, axis=-1))


def _cell(
    coordinate: Float[Array, "..."], size: int
) -> tuple[Int[Array, "..."], Float[Array, "..."]]:
    """Return the texel, counted with the border, before a point, and how far on that lies."""
    place = (coordinate + 1) * (0.5 * size) + 0.5
    before = jnp.clip(jnp.floor(place).astype(jnp.int32), 0, size)  # in bounds even for NaN
    return before, place - before.astype(place.dtype)


def _centres(size: int) -> Float[np.ndarray, " size"]:
    """Return s or t of the texels' centres."""
    return (2 * np.arange(size) + 1) / size - 1


def _on_face(face: int, s: Float[Array, "..."], t: Float[Array, "..."]) -> Float[Array, "... 3"]:
    """Return the points of a face's plane, at distance 1 from the cube's centre."""
    return stack_last(*(m + s * a + t * b for m, a, b in zip(*_AXES[face], strict=True)))


def _along_edges(faces: Float[Array, "6 n n c"]) -> Float[Array, "6 4 n c"]:
    """Return the texels along each face's edges: left, right, top, bottom."""
    return jnp.stack([faces[:, :, 0], faces[:, :, -1], faces[:, 0], faces[:, -1]], axis=1)


def _across_edges(faces: Float[Array, "6 n n c"]) -> Float[Array, "6 4 n c"]:
    """Return the texels that lie beside those along the edges, on the other faces."""
    size = faces.shape[1]
    beyond = jnp.full(size, 1 + 1 / size)
    along = jnp.asarray(_centres(size)) * beyond  # seen from the centre, right beside the texel
    sides = (-beyond, along), (beyond, along), (along, -beyond), (along, beyond)
    points = [jnp.stack([_on_face(face, s, t) for s, t in sides]) for face in range(6)]
    face, s, t, _ = _project(jnp.stack(points))
    column, row = (((place + 1) * (size / 2)).astype(int) for place in (s, t))
    return faces[face, row, column]


def _corners(faces: Float[Array, "6 n n c"]) -> Float[Array, "6 2 2 c"]:
    """Return each face's corner texels, top and bottom, left and right."""
    ends = np.array([0, -1])
    return faces[:, ends][:, :, ends]


def _at_corners(strips: Float[Array, "6 4 n c"]) -> Float[Array, "6 2 2 c"]:
    """Return the sums of the two texels that end at each corner, of those along the edges."""
    ends = np.array([0, -1])
    return strips[:, :2, ends].swapaxes(1, 2) + strips[:, 2:, ends]


def _surrounded(
    faces: Float[Array, "6 n n c"],
    border: Float[Array, "6 4 n c"],
    corners: Float[Array, "6 2 2 c"],
) -> Float[Array, "6 n+2 n+2 c"]:
    """Put texels on all sides of each face."""
    left, right, top, bottom = (border[:, side, None] for side in range(4))
    middle = jnp.concatenate([left.swapaxes(1, 2), faces, right.swapaxes(1, 2)], axis=2)
    first, last = (
        jnp.concatenate([corners[:, k, None, :1], line, corners[:, k, None, 1:]], axis=2)
        for k, line in enumerate((top, bottom))
    )
    return jnp.concatenate([first, middle, last], axis=1)
