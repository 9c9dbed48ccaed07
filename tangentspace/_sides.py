"""The sides of every triangle, in space and in UVs, with none left that divides by zero."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ._columns import Columns, columns_of

Scalars = Float[Array, " faces"]


class Sides(NamedTuple):
    """Two edges of every face; where not valid, of a face with a good frame instead.

    Attributes:
        first: From corner 0 to corner 1.
        second: From corner 0 to corner 2.
        cross: Their cross product.
        uv_first: The first, in UVs.
        uv_second: The second, in UVs.
        uv_area: The cross product in UVs; negative where the texture is mirrored.
        valid: Whether the face has a frame.
    """

    first: Columns
    second: Columns
    cross: Columns
    uv_first: tuple[Scalars, Scalars]
    uv_second: tuple[Scalars, Scalars]
    uv_area: Scalars
    valid: Bool[Array, " faces"]

    def along_u(self) -> Columns:
        """Return ``dp/du`` times ``uv_area``: Cramer's rule before its division."""
        return self.first * self.uv_second[1] - self.second * self.uv_first[1]

    def along_v(self) -> Columns:
        """Return ``dp/dv`` times ``uv_area``."""
        return self.second * self.uv_first[0] - self.first * self.uv_second[0]

    def corners(self) -> tuple[tuple[Columns, Columns], ...]:
        """Return the edges from each corner to the next and to the previous one."""
        third = self.second - self.first
        return (self.first, self.second), (third, -self.first), (-self.second, -third)


def sides_of(
    positions: Float[Array, "vertices 3"],
    uvs: Float[Array, "vertices 2"],
    faces: Int[Array | np.ndarray, "faces 3"],
) -> Sides:
    """Return the sides of every face, and which faces have a frame."""
    columns, (u, v) = columns_of(positions), (uvs[:, 0], uvs[:, 1])
    at = [faces[:, corner] for corner in range(3)]
    first, second = (columns.take(at[k]) - columns.take(at[0]) for k in (1, 2))
    (du1, dv1), (du2, dv2) = ((u[at[k]] - u[at[0]], v[at[k]] - v[at[0]]) for k in (1, 2))

    # Twice the area is the longest edge times the height; the squares are about twice the
    # longest one's. The largest coordinate stands for the length, whose square may underflow.
    third, normal = second - first, first.cross(second)
    squares = first.dot(first) + second.dot(second) + third.dot(third)
    uv_squares = du1**2 + dv1**2 + du2**2 + dv2**2 + (du2 - du1) ** 2 + (dv2 - dv1) ** 2
    area = jnp.maximum(jnp.maximum(jnp.abs(normal.x), jnp.abs(normal.y)), jnp.abs(normal.z))
    thin = 0.5 * rounding(positions)
    valid = (area > thin * squares) & (jnp.abs(du1 * dv2 - du2 * dv1) > thin * uv_squares)

    first, second = first.where(valid, (1.0, 0.0, 0.0)), second.where(valid, (0.0, 1.0, 0.0))
    du1, dv2 = jnp.where(valid, du1, 1.0), jnp.where(valid, dv2, 1.0)
    dv1, du2 = jnp.where(valid, dv1, 0.0), jnp.where(valid, du2, 0.0)
    uv_area = du1 * dv2 - du2 * dv1
    return Sides(first, second, first.cross(second), (du1, dv1), (du2, dv2), uv_area, valid)


def angle_seen_along(
    normal: Columns, to_next: Columns, to_previous: Columns, cross: Columns
) -> Scalars:
    """Return the angle between two edges as projected onto the plane of a unit normal.

    The projection keeps of the edges' cross product the part along the normal, and takes
    from their inner product what the parts along the normal gave. An edge along the normal
    is seen as a point; its angle counts as a right one, as in MikkTSpace.
    """
    sine = jnp.abs(normal.dot(cross))
    cosine = to_next.dot(to_previous) - normal.dot(to_next) * normal.dot(to_previous)
    squares = to_next.dot(to_next) + to_previous.dot(to_previous)
    point = sine + jnp.abs(cosine) <= 0.5 * rounding(squares) * squares
    return jnp.arctan2(jnp.where(point, 1.0, sine), jnp.where(point, 0.0, cosine))


def rounding(values: Float[Array, "..."]) -> float:
    """Return the size, relative to its terms, at or below which a difference is rounding."""
    return 8 * float(jnp.finfo(values.dtype).eps)
