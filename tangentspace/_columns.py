"""Vectors as three arrays of coordinates: on a CPU far faster than rows of three numbers.

A reduction over, or a concatenation along, an axis of length three costs more there than
all the arithmetic between.
"""

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ._math import stack_last


@dataclass(frozen=True)
class Columns:
    """Many vectors; the operators act on each.

    Attributes:
        x: First coordinates.
        y: Second coordinates.
        z: Third coordinates.
    """

    x: Float[Array, " n"]
    y: Float[Array, " n"]
    z: Float[Array, " n"]

    def __sub__(self, other: "Columns") -> "Columns":
        return Columns(self.x - other.x, self.y - other.y, self.z - other.z)

    def __neg__(self) -> "Columns":
        return Columns(-self.x, -self.y, -self.z)

    def __mul__(self, scale: Float[Array, " n"]) -> "Columns":
        return Columns(self.x * scale, self.y * scale, self.z * scale)

    def dot(self, other: "Columns") -> Float[Array, " n"]:
        """Return the inner products."""
        return self.x * other.x + self.y * other.y + self.z * other.z

    def cross(self, other: "Columns") -> "Columns":
        """Return the cross products."""
        return Columns(
            self.y * other.z - self.z * other.y,
            self.z * other.x - self.x * other.z,
            self.x * other.y - self.y * other.x,
        )

    def across(self, unit: "Columns") -> "Columns":
        """Return the parts at right angles to unit vectors."""
        return self - unit * self.dot(unit)

    def unit(self, least: float) -> tuple["Columns", Bool[Array, " n"]]:
        """Return unit vectors, and which are longer than ``least``; the others become zero.

        Their derivative is zero as well.
        """
        squared = self.dot(self)
        longer = squared > least**2
        scale = jnp.where(longer, 1 / jnp.sqrt(jnp.where(longer, squared, 1.0)), 0.0)
        return self * scale, longer

    def where(self, kept: Bool[Array, " n"], stand_in: tuple[float, float, float]) -> "Columns":
        """Return the vectors that are kept, and one other in place of the rest."""
        pairs = zip((self.x, self.y, self.z), stand_in, strict=True)
        return Columns(*(jnp.where(kept, own, other) for own, other in pairs))

    def take(self, indices: Int[Array | np.ndarray, " m"]) -> "Columns":
        """Return the vectors of these indices."""
        return Columns(self.x[indices], self.y[indices], self.z[indices])

    def rows(self) -> Float[Array, "n 3"]:
        """Return one row per vector."""
        return stack_last(self.x, self.y, self.z)


def columns_of(rows: Float[Array, "n 3"]) -> Columns:
    """Return rows of three numbers as columns."""
    return Columns(rows[:, 0], rows[:, 1], rows[:, 2])
