"""A shadow map's frame that holds still while its light moves, to first order.

Where a map lies, how it is turned and how wide it is are choices that change nothing but the
places of its texels. Yet they follow the light and the scene, and with them slide all edges
and all receivers over the texels alike. In a derivative the two should cancel; each comes
with the grid's own errors, and what is left of them is noise.

Here the frame stays, and the light's move is put into space: a shear that leaves a plane as it
is and takes the light back to where it was. Lines through the light stay lines through the
light, so a point and what hides it still meet in the map. What lies in the plane does not move
there at all; so the plane is laid through what the scene has most of, which is what receives.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from tangentspace._math import safe_divide, safe_norm, safe_normalize

_LOWEST = 0.1  # sine of the least angle between the plane and the light


class Plane(NamedTuple):
    """A plane in world space.

    Attributes:
        point: On it.
        normal: Unit length.
    """

    point: Float[Array, "3"]
    normal: Float[Array, "3"]


def main_plane(
    positions: Float[Array | np.ndarray, "vertices 3"], faces: Int[Array | np.ndarray, "faces 3"]
) -> Plane:
    """Return the plane nearest to the surface: least squares over its area.

    Args:
        positions: Vertices, world space.
        faces: Vertex indices.

    Returns:
        Through the middle of the surface; without area, through the origin.

    Differentiability:
        None: it counts as fixed.
    """
    positions, faces = lax.stop_gradient(jnp.asarray(positions)), jnp.asarray(faces)
    a, b, c = (positions.at[faces[:, k]].get(mode="clip") for k in range(3))
    area = safe_norm(jnp.cross(b - a, c - a))
    weights = safe_divide(area, jnp.sum(area))
    middle = weights @ (a + b + c) / 3
    arms = [p - middle for p in (a, b, c)]
    # The second moment of a triangle: of its corners, and of their sum.
    whole = arms[0] + arms[1] + arms[2]
    moments = sum((weights[:, None] * arm).T @ arm for arm in (*arms, whole)) / 12
    _, axes = jnp.linalg.eigh(moments)
    return Plane(middle, axes[:, 0])


def steady_frame(clip_from_world: Float[Array, "4 4"], still: Plane) -> Float[Array, "4 4"]:
    """Return the same matrix, with derivatives of the light's place alone.

    Args:
        clip_from_world: Of a light's map, invertible.
        still: ``main_plane(positions, faces)``, or another that shall not move in the map. If
            the light is within 6 degrees of it, the plane across the light's way takes its
            place.

    Differentiability:
        In the place (or, of parallel light, the direction) that the matrix looks from; what
        else it depends on, the frame, counts as fixed.
    """
    moving = jnp.linalg.inv(clip_from_world)[:, 2]  # what is seen at no place but its depth
    light = lax.stop_gradient(moving)
    towards = safe_normalize(light[:3] - light[3] * still.point)
    edge_on = jnp.abs(still.normal @ towards) < _LOWEST
    normal = jnp.where(edge_on, towards, still.normal)
    plane = jnp.append(normal, -normal @ still.point)
    # A light is a point up to scale: at equal heights over the plane they may be subtracted.
    back = light / (plane @ light) - moving / (plane @ moving)
    shear = jnp.eye(4, dtype=light.dtype) + jnp.outer(back, plane)
    return jnp.matmul(lax.stop_gradient(clip_from_world), shear, precision="highest")
