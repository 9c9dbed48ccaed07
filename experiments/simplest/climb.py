"""The search: from what is expected of models to the cheapest one that is measured to be enough.

Errors are expected to be what theory says times a factor near 1, log-normal. Its logarithm is
a sum of parts that models share: one for all, one for each filter, bias, size and so on. So each
measurement tells about its relatives: a filter that does badly on the coarse map is dropped
on the finer ones, and a bias that fails under one filter is not tried under the next
(conditional means of a normal distribution, known as Gaussian process regression).

Next comes the model whose chance to be enough, times what it would save, is largest. The search
ends when every cheaper model was measured or has hardly a chance left.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
import scipy.special
from jaxtyping import Bool, Float

Values = Float[np.ndarray, " models"]
_LEAST_GAIN = 0.005  # chance to be enough times the logarithm of the saving, to be tried
_MANY = 15  # tried: from there on the gain must be greater, by the square of their number
_LAST_CHANCE = 0.002  # to be enough, to be tried while none that is enough is known
_BETTER_CHANCE = 0.2  # to be the best where none is enough; below it the search for it ends
_MOST_FOR_BEST = 20
WORTH = 1.1  # times cheaper that a model must be to be tried in place of one that is enough
_TINY = 1e-7
_MOST_SURPRISE = 1.5  # of a logarithm: an error of 0 tells no more about relatives than this
_CERTAIN, _ROUNDING = 0.03, 0.01  # standard deviations of logarithms, beside all others


class Found(NamedTuple):
    """A measurement."""

    error: float
    cost: float


class Expected(NamedTuple):
    """What is known of models before they are measured.

    Attributes:
        error: What theory says, of the part of the error that is not fixed.
        fixed: Part of the error that is known exactly.
        power: Errors add up by this power: 2 for root mean squares, 1 for means.
        covariance: Of the logarithms of true by expected error.
    """

    error: Values
    fixed: Values
    power: int
    covariance: Float[np.ndarray, "models models"]


class Climb(NamedTuple):
    """How a search ended.

    Attributes:
        best: The cheapest model found that is enough; None if none is.
        tried: All that were measured, in their order.
        chance: Of each model to be enough, after all measurements.
    """

    best: int | None
    tried: dict[int, Found]
    chance: Values


def covariance(
    kinds: Sequence[Sequence[str]], spreads: Sequence[float], certain: Bool[np.ndarray, " models"]
) -> Float[np.ndarray, "models models"]:
    """Return the covariance of models that share parts of their errors.

    Args:
        kinds: For each part, the kind that each model is of; equal kinds share it.
        spreads: Standard deviation of each part.
        certain: Models of which theory is exact.
    """
    total = np.zeros((len(certain), len(certain)))
    for kind, spread in zip(kinds, spreads, strict=True):
        names = np.asarray(kind)
        total += spread**2 * (names[:, None] == names)
    total[certain] = total[:, certain] = 0
    return total + np.diag(np.where(certain, _CERTAIN, _ROUNDING) ** 2)


def climb(
    expected: Expected,
    costs: Callable[[], Values],
    measure: Callable[[int], Found],
    *,
    tolerance: float,
    budget: float = np.inf,
    tried: Mapping[int, Found] | None = None,
) -> Climb:
    """Return the cheapest model that meets the tolerance.

    Args:
        expected: Of each model.
        costs: Returns what each model is expected to cost, after what was measured.
        measure: Measures a model.
        tolerance: Largest error.
        budget: Largest cost.
        tried: What was measured before.
    """
    done = dict(tried or {})
    while True:
        mean, spread = _after(expected, done)
        chance = _chance_below(expected, mean, spread, tolerance)
        cost = costs()
        best = _cheapest(done, tolerance, budget)
        limit = min(budget, np.inf if best is None else done[best].cost / WORTH)
        untried = np.ones(len(cost), bool)
        untried[list(done)] = False
        left = untried & (cost <= limit)
        dearest = 2 * cost.max() if best is None else done[best].cost
        gain = np.where(left, chance * np.log(np.maximum(dearest / cost, 1)), 0)
        least_gain = _LEAST_GAIN * (1 + (len(done) / _MANY) ** 2)
        worth_trying = chance > _LAST_CHANCE if best is None else gain > least_gain
        if (left & worth_trying).any():
            chosen = int(np.argmax(np.where(worth_trying, gain, -1)))
        else:
            if best is not None or not left.any() or len(done) >= _MOST_FOR_BEST:
                return Climb(best, done, chance)
            within = [found.error for found in done.values() if found.cost <= budget]
            better = _chance_below(expected, mean, spread, min(within, default=np.inf))
            if within and better[left].max() < _BETTER_CHANCE:
                return Climb(None, done, chance)
            chosen = int(np.argmax(np.where(left, better, -1)))
        done[chosen] = measure(chosen)


def _cheapest(done: Mapping[int, Found], tolerance: float, budget: float) -> int | None:
    enough = [k for k, f in done.items() if f.error <= tolerance and f.cost <= budget]
    return min(enough, key=lambda k: done[k].cost, default=None)


def _after(expected: Expected, done: Mapping[int, Found]) -> tuple[Values, Values]:
    """Return mean and standard deviation of the logarithm of each model's free error."""
    prior = np.log(np.maximum(expected.error, _TINY))
    total = expected.covariance
    if not done:
        return prior, np.sqrt(np.diag(total))
    seen = list(done)
    errors = np.array([done[k].error for k in seen])
    fixed, power = expected.fixed[seen], expected.power
    free = np.maximum(errors**power - fixed**power, _TINY**power) ** (1 / power)
    to_seen = total[:, seen]
    surprise = np.clip(np.log(free) - prior[seen], -_MOST_SURPRISE, _MOST_SURPRISE)
    solved = np.linalg.solve(to_seen[seen], surprise[:, None])
    mean = prior + (to_seen @ solved)[:, 0]
    explained = np.sum(to_seen * np.linalg.solve(to_seen[seen], to_seen.T).T, axis=-1)
    return mean, np.sqrt(np.maximum(np.diag(total) - explained, 1e-8))


def _chance_below(expected: Expected, mean: Values, spread: Values, error: float) -> Values:
    """Return the chance of each model that its error is not above one."""
    power = expected.power
    if not np.isfinite(error):
        return np.ones_like(mean)
    free = error**power - expected.fixed**power
    least = np.log(np.maximum(np.maximum(free, 0) ** (1 / power), _TINY))
    return np.where(free < 0, 0.0, scipy.special.ndtr((least - mean) / spread))
