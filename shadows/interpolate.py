"""From face ids to values at pixels: barycentric weights, attributes and depth.

The rasterizer answers which face covers a pixel; that answer is an integer and has no
derivative. Everything smooth is computed here, per pixel, from the face's three vertices,
so it has exact derivatives in positions, matrices and attributes everywhere inside a face.
The weights are those of homogeneous rasterization: with ``r_k`` the vertices in clip space
relative to the pixel's ray, ``r_k = (x_k - x w_k, y_k - y w_k)``, weight 0 is proportional
to ``cross(r_1, r_2)``, and so on. They are perspective-correct, need no division by w and
lose no digits for small triangles.

References:
    M. Olano, T. Greer, "Triangle Scan Conversion using 2D Homogeneous Coordinates",
    Graphics Hardware 1997, section 4.
"""

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int, Num

from tangentspace._math import safe_divide, stack_last

ClipPositions = Float[Array | np.ndarray, "vertices 4"]
Faces = Int[Array | np.ndarray, "faces 3"]
FaceIds = Int[Array, "height width"]


def pixel_centers(
    height: int, width: int, dtype: jnp.dtype | np.dtype
) -> tuple[Float[Array, " width"], Float[Array, " height"]]:
    """Return the NDC x of each column's centre and the NDC y of each row's (row 0 on top)."""
    x = (2 * jnp.arange(width) + 1).astype(dtype) / width - 1
    y = 1 - (2 * jnp.arange(height) + 1).astype(dtype) / height
    return x, y


def barycentrics(
    clip_positions: ClipPositions,
    faces: Faces,
    face_ids: FaceIds,
    *,
    points: tuple[Float[Array, "*x"], Float[Array, "*y"]] | None = None,
) -> Float[Array, "height width 3"]:
    """Return perspective-correct barycentric weights of each pixel centre in its face.

    Args:
        clip_positions: Vertices in clip space.
        faces: Vertex indices.
        face_ids: Face at each pixel, -1 where there is none, as ``rasterize`` returns it.
        points: NDC x and y of each pixel's point, if it is not the centre: shapes that
            broadcast to that of the face ids. Beyond a face its border counts.

    Returns:
        Weights that are not negative and sum to 1; all 0 where no face is. A face of zero
        area seen from here has the weights 1/3.

    Differentiability:
        Smooth in ``clip_positions`` inside a face; zero where no face is, and at the
        weights of a face of zero area.
    """
    areas, _, reach = _edge_functions(clip_positions, faces, face_ids, points)
    flat = areas[0] + areas[1] + areas[2] <= jnp.finfo(reach.dtype).eps * reach**2
    # Rounding may put a centre outside its face: no weight is negative, but the derivative
    # stays that of the plane.
    areas = [area + lax.stop_gradient(jnp.maximum(-area, 0)) for area in areas]
    total = jnp.where(flat, 0, areas[0] + areas[1] + areas[2])
    weights = [jnp.where(flat, 1 / 3, safe_divide(area, total)) for area in areas]
    return jnp.where(face_ids[..., None] >= 0, stack_last(*weights), 0.0)


def barycentric_slopes(
    clip_positions: ClipPositions, faces: Faces, face_ids: FaceIds
) -> tuple[Float[Array, "height width 3"], Float[Array, "height width 3"]]:
    """Return how the weights of ``barycentrics`` change from pixel to pixel.

    Blended by these, an attribute's change is its derivative in the image: texture lookups
    take their footprint from it.

    Returns:
        The change per pixel to the right, and per pixel downwards, along the plane of the
        face; 0 where no face is and for faces of zero area.

    Differentiability:
        As ``barycentrics``.
    """
    areas, slopes, reach = _edge_functions(clip_positions, faces, face_ids)
    total = areas[0] + areas[1] + areas[2]
    total = jnp.where(total <= jnp.finfo(reach.dtype).eps * reach**2, 0, total)
    height, width = face_ids.shape
    changes = []
    for slope, step in zip(slopes, (2 / width, -2 / height), strict=True):
        sum_of_slopes = slope[0] + slope[1] + slope[2]
        change = [
            step * safe_divide(slope[k] - safe_divide(areas[k], total) * sum_of_slopes, total)
            for k in range(3)
        ]
        changes.append(jnp.where(face_ids[..., None] >= 0, stack_last(*change), 0.0))
    return changes[0], changes[1]


def interpolate(
    attributes: Float[Array | np.ndarray, "vertices channels"],
    faces: Faces,
    face_ids: FaceIds,
    weights: Float[Array, "height width 3"],
) -> Float[Array, "height width channels"]:
    """Blend per-vertex attributes by the weights of ``barycentrics``; 0 where no face is.

    Differentiability:
        Linear in ``attributes`` and in ``weights``.
    """
    attributes = jnp.asarray(attributes)
    covered = face_ids[..., None] >= 0
    first, second, third = (
        weights[..., k, None] * jnp.where(covered, attributes.at[corner].get(mode="clip"), 0)
        for k, corner in enumerate(_face_corners(faces, face_ids))
    )
    return first + second + third


def gather_faces(
    attributes: Num[Array | np.ndarray, "faces channels"], face_ids: FaceIds
) -> Num[Array, "height width channels"]:
    """Return a per-face attribute at each pixel; 0 where no face is."""
    values = jnp.asarray(attributes).at[jnp.maximum(face_ids, 0)].get(mode="clip")
    return jnp.where(face_ids[..., None] >= 0, values, jnp.zeros((), values.dtype))


def window_depth(
    clip_positions: ClipPositions, faces: Faces, face_ids: FaceIds
) -> Float[Array, "height width"]:
    """Return the window depth in [0, 1] of the face at each pixel; 1 where no face is.

    Differentiability:
        Smooth in ``clip_positions`` inside a face; zero where no face is.
    """
    weights = barycentrics(clip_positions, faces, face_ids)
    clip = interpolate(clip_positions[:, 2:], faces, face_ids, weights)
    return jnp.where(face_ids >= 0, 0.5 * safe_divide(clip[..., 0], clip[..., 1]) + 0.5, 1.0)


def _face_corners(faces: Faces, face_ids: FaceIds) -> list[Int[Array, "height width"]]:
    """Return the vertex index of each of the three corners at each pixel."""
    index = jnp.maximum(face_ids, 0)
    columns = jnp.asarray(faces).T
    return [columns[k].at[index].get(mode="clip") for k in range(3)]


def _edge_functions(
    clip_positions: ClipPositions,
    faces: Faces,
    face_ids: FaceIds,
    points: tuple[Array, Array] | None = None,
) -> tuple[list[Array], tuple[list[Array], list[Array]], Array]:
    """Return what the weights are shares of, its slopes in NDC x and y, and the rays' size.

    All are turned so that a face seen from behind has positive areas too.
    """
    if points is None:
        height, width = face_ids.shape
        x, y = pixel_centers(height, width, clip_positions.dtype)
        points = x, y[:, None]
    x, y = points
    covered = face_ids >= 0
    columns = jnp.asarray(clip_positions).T
    rays = []
    for corner in _face_corners(faces, face_ids):
        # Guarded: where no face is, whatever face 0 holds must not reach a derivative.
        vertex_x, vertex_y, w = (
            jnp.where(covered, columns[axis].at[corner].get(mode="clip"), 1) for axis in (0, 1, 3)
        )
        rays.append((vertex_x - x * w, vertex_y - y * w, w))
    pairs = [(rays[i], rays[j]) for i, j in ((1, 2), (2, 0), (0, 1))]
    areas = [a[0] * b[1] - a[1] * b[0] for a, b in pairs]
    facing = jnp.where(areas[0] + areas[1] + areas[2] < 0, -1, 1).astype(x.dtype)
    # Fused products leave a rounding error where the area is 0.
    areas = [area * facing for area in areas]
    slopes_x = [(b[2] * a[1] - a[2] * b[1]) * facing for a, b in pairs]
    slopes_y = [(a[2] * b[0] - b[2] * a[0]) * facing for a, b in pairs]
    reach = jnp.zeros_like(facing)
    for ray_x, ray_y, _ in rays:
        reach = reach + jnp.abs(ray_x) + jnp.abs(ray_y)
    return areas, (slopes_x, slopes_y), reach
