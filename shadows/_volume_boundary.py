"""The surfaces that bound shadow volumes: caps, and sides from silhouettes to infinity.

Every face of a mesh, turned to the light, casts a prism of shadow away from it. Where prisms
meet, their sides cancel; what bounds all of them together is assembled here as one list of
triangles for the rasterizer, in clip space, where points at infinity are points like others.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ._fragments import get
from .silhouettes import MeshEdges, silhouette
from .transforms import transform_points


class Boundary(NamedTuple):
    """The surfaces that bound all prisms, counter-clockwise seen from outside.

    Attributes:
        clip_positions: Vertices.
        faces: Caps, then sides.
        weights: How many of each face there are; negative where they are wound the other way.
        cap_count: How many of the faces are caps.
        face_count: How many of the faces there are; the rest is padding.
    """

    clip_positions: Float[Array, "vertices 4"]
    faces: Int[Array, "faces 3"]
    weights: Int[Array, " faces"]
    cap_count: int
    face_count: Int[Array, ""] | int


def volume_boundary(
    positions: Float[Array, "vertices 3"],
    away: Float[Array, "ends 3"],
    faces: Int[Array, "faces 3"],
    edges: MeshEdges,
    turned: Int[Array, " faces"],
    matrix: Float[Array, "4 4"],
) -> Boundary:
    """Assemble the caps, and the sides of the edges that are silhouettes.

    Args:
        positions: Vertices.
        away: The same at infinity, as directions from the light; one if it is parallel.
        faces: Vertex indices.
        edges: Of the mesh.
        turned: What ``turned_to_light`` returns.
        matrix: From world to clip space.
    """
    count, parallel = positions.shape[0], away.shape[0] == 1
    at_infinity = jnp.matmul(away, matrix[:, :3].T, precision="highest")
    clip_positions = jnp.concatenate([transform_points(matrix, positions), at_infinity])

    runs = silhouette(edges, turned)
    ends = jnp.asarray(edges.vertices)
    order = jnp.nonzero(runs, size=runs.shape[0], fill_value=0)[0]
    side_count = jnp.count_nonzero(runs)
    end, start = get(ends, order).T  # the prism's side runs against its face
    if parallel:
        caps, cap_weights = faces, turned
        sides = jnp.stack([start, end, jnp.full_like(end, count)], axis=-1)
    else:
        caps = jnp.concatenate([faces, faces + count])
        cap_weights = jnp.concatenate([turned, -turned])
        first = jnp.stack([start, end, end + count], axis=-1)
        second = jnp.stack([start, end + count, start + count], axis=-1)
        sides = jnp.stack([first, second], axis=1).reshape(-1, 3)
    per_edge = sides.shape[0] // order.shape[0]
    side_weights = jnp.repeat(get(runs, order), per_edge)
    return Boundary(
        clip_positions,
        jnp.concatenate([caps, sides]),
        jnp.concatenate([cap_weights, side_weights]),
        caps.shape[0],
        caps.shape[0] + per_edge * side_count,
    )
