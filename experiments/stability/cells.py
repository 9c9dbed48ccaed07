"""A cell of the atlas: what one technique measures on one row of the catalogue, and the verdict."""

import math
from collections.abc import Iterable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np

FINE = "fine"
KNOWN = "fails as known"
UNEXPECTED = "fails unexpectedly"
UNCONFIRMED = "does not fail though said to"
VERDICTS = (FINE, KNOWN, UNCONFIRMED, UNEXPECTED)  # the worst last


class Cell(NamedTuple):
    """One measurement.

    Attributes:
        row: Of the catalogue.
        scene: Name of the scene, or of what stands for it where the row has no geometry.
        technique: What is judged; in parentheses what it is not of the toolkit.
        dtype: float32 or float64.
        metric: What ``value`` is.
        value: The larger, the worse.
        limit: Largest value that does not count as a failure.
        said: Why it should fail, by this row of the catalogue; empty if the row does not say so.
        may: Why it may fail, by another row; empty if none tells.
        predicted: The value that the catalogue gives; NaN if it gives none.
        values_not_finite: Numbers among the results that are NaN or infinite.
        slopes_not_finite: The same among the derivatives.
        documented: Whether numbers are within the limits that the toolkit documents. What is
            not finite outside of them is a failure as any other.
        parameter: What is varied; empty in the table of rows.
        setting: Its value.
        note: What a reader should know.
    """

    row: int
    scene: str
    technique: str
    dtype: str
    metric: str
    value: float
    limit: float
    said: str = ""
    may: str = ""
    predicted: float = math.nan
    values_not_finite: int = 0
    slopes_not_finite: int = 0
    documented: bool = True
    parameter: str = ""
    setting: float = math.nan
    note: str = ""

    @property
    def broken(self) -> bool:
        """Whether something is not finite where everything should be."""
        return self.documented and self.values_not_finite + self.slopes_not_finite > 0

    @property
    def verdict(self) -> str:
        """One of ``VERDICTS``."""
        if self.broken:
            return UNEXPECTED
        if not self.value <= self.limit:
            return KNOWN if self.said or self.may else UNEXPECTED
        return UNCONFIRMED if self.said else FINE

    def record(self) -> dict[str, Any]:
        """Return the fields and the verdict, for a table."""
        return self._asdict() | {"verdict": self.verdict}


def not_finite(*trees: Any) -> int:
    """Return how many floats of the arrays in trees are NaN or infinite."""
    return sum(int(np.count_nonzero(~np.isfinite(leaf))) for leaf in _floats(trees))


def _floats(tree: Any) -> Iterable[np.ndarray]:
    for leaf in jax.tree.leaves(tree):
        if eqx.is_inexact_array_like(leaf):
            yield np.asarray(leaf)
