"""What images tell apart: singular values of their derivative, and standard errors.

With noise of one size in every pixel, independent of each other, a least-squares fit spreads
along each right singular vector of the Jacobian by the noise over the singular value.

References:
    G. H. Golub, C. F. Van Loan, "Matrix Computations", section 5.5 (rank-deficient least squares).
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

_SHARE = 1e-4  # of the largest singular value, below which a combination is not determined
DARK = 1e-7  # derivatives of pixels below this, in their root mean square, are none


class Determined(NamedTuple):
    """What images tell of numbers.

    Attributes:
        singular: Singular values, falling; change of the images per unit.
        directions: For each, the unit combination of numbers.
        standard_errors: Of each number, in its unit; infinite where it is part of a combination
            that is not determined.
        known: Which combinations are determined.
    """

    singular: Float[np.ndarray, " numbers"]
    directions: Float[np.ndarray, "numbers numbers"]
    standard_errors: Float[np.ndarray, " numbers"]
    known: Bool[np.ndarray, " numbers"]


def determined(jacobian: Float[np.ndarray, "pixels numbers"], noise: float) -> Determined:
    """Judge a fit at its solution.

    Args:
        jacobian: Of all pixels; numbers in units that change the images about as much.
        noise: Standard deviation in each pixel.
    """
    _, singular, directions = np.linalg.svd(jacobian, full_matrices=False)
    known = singular > max(_SHARE * singular[0], DARK * np.sqrt(len(jacobian)))
    spread = noise / np.where(known, singular, 1)
    variance = np.sum((spread[:, None] * directions)[known] ** 2, axis=0)
    blind = (np.abs(directions[~known]) > 0.05).any(axis=0)
    return Determined(singular, directions, np.where(blind, np.inf, np.sqrt(variance)), known)


def sentences(found: Determined, names: tuple[str, ...]) -> list[str]:
    """Return a line for each combination that the images do not tell of, and for the weakest."""
    if not found.known.any():
        return [
            "out of view: where the fit ended, none of its numbers changes the images; what casts "
            "has left the light's view, or its shadow the picture"
        ]
    lines = [
        f"undetermined: {combination(row, names)} may change without a trace in the images"
        for row in found.directions[~found.known]
    ]
    ratio = found.singular[0] / max(found.singular[found.known].min(initial=np.inf), 1e-300)
    if len(names) > 1 and ratio > 30:
        weakest = found.directions[found.known][-1]
        lines.append(
            f"weakest: {combination(weakest, names)} shows {ratio:.0f} times less than the most"
        )
    return lines


def combination(row: Float[np.ndarray, " numbers"], names: tuple[str, ...]) -> str:
    """Return a combination of numbers in words, the largest parts first."""
    parts = [k for k in np.argsort(-np.abs(row)) if abs(row[k]) > 0.2][:4]
    sign = np.sign(row[parts[0]])
    return " ".join(
        f"{'+' if sign * row[k] > 0 else '-'} {abs(row[k]):.2f} {names[k]}" for k in parts
    ).removeprefix("+ ")
