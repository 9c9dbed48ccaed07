"""Sweep a bias: every point of a grid from zero, so that a fit is judged against the best.

The grid grows until its best point is not on its far border, and its steps are halved until
that changes the best error by less than 1 %: over the whole grid while that is affordable,
after that over a window of eight steps round the best point that moves with it.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from shadows.bias import CombinedBias
from shadows.compare import Compare, HardCompare
from shadows.filters import Filter

from .bias_space import BiasSpace, Clock, Search, Tried
from .bias_study import Techniques, Trial

_BATCH = 256
_FIRST_REACH = 8.0  # steps of the space: footprints or texels
_LAST_REACH = 2.0**12
_FIRST_COUNT = {1: 129, 2: 33, 3: 17}  # grid points along each number, by how many are free
_LAST_COUNT = {1: 1025, 2: 65, 3: 17}  # of a grid over the whole range
_WINDOW = 4  # steps to each side
_HALVINGS = 12
_CHANGE = 0.01


class BiasSweep(NamedTuple):
    """The best bias of a grid.

    Attributes:
        techniques: The best bias, filter and comparison.
        values: Their free numbers.
        error: Of the goal.
        points: Numbers of every bias on the last whole grid, in their own units.
        errors: The error of each.
        evaluations: Biases tried on all grids.
        seconds: Run time, without compilation.
        compile_seconds: Compilation.
        converged: Whether the last halving changed the best error by less than 1 %.
    """

    techniques: Techniques
    values: dict[str, float]
    error: float
    points: Float[np.ndarray, "points numbers"]
    errors: Float[np.ndarray, " points"]
    evaluations: int
    seconds: float
    compile_seconds: float
    converged: bool

    @property
    def bias(self) -> CombinedBias:
        """The best bias."""
        return self.techniques[0]


def sweep_bias(
    trial: Trial,
    bias: CombinedBias,
    filter: Filter,
    *,
    free: Sequence[str] | None = None,
    compare: Compare = HardCompare(),
    report: Callable[[str], None] = lambda text: None,
) -> BiasSweep:
    """Try a grid of biases, or of other numbers.

    Args:
        trial: What is compared with what.
        bias: Which terms there are; numbers that are not free keep their values.
        filter: How the map is asked.
        free: Names of the numbers to sweep, at most three; None for all of the bias.
        compare: How depths become visibility.
        report: Told how far it is.

    Raises:
        ValueError: If a name is not one of the bias's numbers, or there are more than three.
    """
    space, clock = BiasSpace.of(bias, filter, trial, free, compare=compare), Clock()
    dimensions = len(space.names)
    if dimensions not in _LAST_COUNT:
        raise ValueError(f"sweep: expected at most 3 free numbers, got {dimensions}; fix some")
    search = Search(space, trial, clock, batch=_BATCH)
    reach, count = np.full(dimensions, _FIRST_REACH), _FIRST_COUNT[dimensions]

    def tried(low: np.ndarray, high: np.ndarray, count: int) -> tuple[np.ndarray, Tried]:
        points = _grid(low, high, count)
        found = search(points)
        report(f"{search.evaluations} biases: best error {found.errors.min():.3%}")
        return points, found

    best, score, converged = np.zeros(dimensions), (np.inf, np.inf), False
    while True:
        whole = points, found = tried(np.zeros(dimensions), reach, count)
        gain, nearest = score[0] - found.errors.min(), points[found.best]
        if found.score(found.best) < score:
            best, score = nearest, found.score(found.best)
        at_border = (nearest == reach) & (reach < _LAST_REACH)
        if at_border.any():
            reach = np.where(at_border, 2 * reach, reach)
            continue
        converged = bool(gain <= _CHANGE * score[0])
        if converged or 2 * count - 1 > _LAST_COUNT[dimensions]:
            break
        count = 2 * count - 1
    step = reach / (count - 1)
    for _ in range(0 if converged else _HALVINGS):
        step = step / 2
        low, high = np.maximum(best - 2 * _WINDOW * step, 0), best + 2 * _WINDOW * step
        points, found = tried(low, high, 4 * _WINDOW + 1)
        gain, nearest = score[0] - found.errors.min(), points[found.best]
        if found.score(found.best) < score:
            best, score = nearest, found.score(found.best)
        at_border = (nearest == high) | ((nearest == low) & (low > 0))
        converged = bool(gain <= _CHANGE * score[0] and not at_border.any())
        if converged:
            break
    return BiasSweep(
        techniques=space.techniques(jnp.asarray(best, space.step.dtype)),
        values=space.values(best),
        error=score[0],
        points=whole[0] * np.asarray(space.step),
        errors=whole[1].errors,
        evaluations=search.evaluations,
        seconds=clock.seconds,
        compile_seconds=clock.compile_seconds,
        converged=converged,
    )


def _grid(
    low: Float[np.ndarray, " numbers"], high: Float[np.ndarray, " numbers"], count: int
) -> Float[np.ndarray, "points numbers"]:
    """Return the points of a grid, the smallest first."""
    ends = zip(low, high, strict=True)
    axes = np.meshgrid(*(np.linspace(start, end, count) for start, end in ends), indexing="ij")
    points = np.stack(axes, axis=-1).reshape(-1, len(low))
    return points[np.argsort(np.sum(points / high, axis=1), kind="stable")]
