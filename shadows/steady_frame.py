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

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from tangentspace._math import safe_divide, safe_norm, safe_normalize

_LOWEST = 0.1  # sine of the least angle between the plane and the light


def steady_frame(
    clip_from_world: Float[Array, "4 4"],
    positions: Float[Array, "vertices 3"],
    faces: Int[Array, "faces 3"],
) -> Float[Array, "4 4"]:
    """Return the same matrix, with derivatives of the light's place alone.

    Args:
        clip_from_world: Of a light's map, invertible.
        positions: Vertices, world space.
        faces: Vertex indices.

    Differentiability:
        In the place (or, of parallel light, the direction) that the matrix looks from; what
        else it depends on, the frame, counts as fixed.
    """
    light = jnp.linalg.inv(clip_from_world)[:, 2]  # what is seen at no place but its depth
    still = lax.stop_gradient(light)
    middle, normal = _plane(lax.stop_gradient(positions), faces, still)
    plane = jnp.append(normal, -normal @ middle)
    # A light is a point up to scale: at equal heights over the plane they may be subtracted.
    back = still / (plane @ still) - light / (plane @ light)
    shear = jnp.eye(4, dtype=light.dtype) + jnp.outer(back, plane)
    return jnp.matmul(lax.stop_gradient(clip_from_world), shear, precision="highest")


def _plane(
    positions: Float[Array, "vertices 3"], faces: Int[Array, "faces 3"], light: Float[Array, "4"]
) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
    """Return a point and the unit normal of the plane nearest to most of the surface."""
    a, b, c = (positions.at[faces[:, k]].get(mode="clip") for k in range(3))
    area = safe_norm(jnp.cross(b - a, c - a))
    weights = safe_divide(area, jnp.sum(area))
    middle = weights @ (a + b + c) / 3
    arms = [p - middle for p in (a, b, c)]
    # The second moment of a triangle: of its corners, and of their sum.
    whole = arms[0] + arms[1] + arms[2]
    moments = sum((weights[:, None] * arm).T @ arm for arm in (*arms, whole)) / 12
    _, axes = jnp.linalg.eigh(moments)
    towards = safe_normalize(light[:3] - light[3] * middle)
    normal = axes[:, 0]
    return middle, jnp.where(jnp.abs(normal @ towards) < _LOWEST, towards, normal)
