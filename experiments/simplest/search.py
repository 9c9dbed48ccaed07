"""A search over the models of a scene for the cheapest that is enough, and for its neighbours."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from .bench import Measured
from .climb import WORTH, Climb, Expected, Found, climb, covariance
from .costs import Costs
from .models import Model
from .sight import Measure, Sight
from .theory import Theory

# Standard deviations of the logarithm of true by expected error: of all models of a scene
# together; of a filter; a bias; a filter under a bias; a size; a filter at a size; of one alone.
_SPREADS = (0.25, 0.2, 0.15, 0.15, 0.1, 0.1, 0.06)

_BETTER = 0.7  # times the error of the choice that one step further is to have


class Tried(NamedTuple):
    """A model that was measured."""

    model: Model
    error: float
    cost: float
    expected: float


class End(NamedTuple):
    """How a search ended.

    Attributes:
        best: The cheapest model that is enough.
        failed: Of those tried that cost less, the one that comes closest; None for none.
        further: The cheapest of those tried that are better and cost more; None for none.
    """

    best: int
    failed: int | None
    further: int | None


class Search:
    """A search over the models of a scene; measurements come from whoever runs it."""

    def __init__(
        self, sight: Sight, theory: Theory, models: Sequence[Model], measure: Measure
    ) -> None:
        """Ask theory about every model.

        Args:
            sight: The scene.
            theory: Of the scene.
            models: To choose from.
            measure: Of errors.
        """
        self.useless = {m: why for m in models if (why := theory.useless(m)) is not None}
        self.models = [m for m in models if m not in self.useless]
        self.tried: dict[int, Found] = {}
        self._costs = Costs(sight)
        self._parts = [theory.parts(m) for m in self.models]
        looks = {look: theory.without(look) for look in sight.looks}
        fixed = np.array([looks[m.look] for m in self.models])
        free = np.array([theory.error(m) for m in self.models])
        kinds = [
            ["" for _ in self.models],
            [m.filter for m in self.models],
            [m.bias for m in self.models],
            [f"{m.filter} {m.bias}" for m in self.models],
            [str(m.map_size) for m in self.models],
            [f"{m.filter} {m.map_size}" for m in self.models],
            [f"{m.filter} {m.bias} {m.map_size}" for m in self.models],
        ]
        spreads = _SPREADS if measure == "rmse" else (1.0, *_SPREADS[1:])
        certain = np.array([measure != "flip" and not m.filter for m in self.models])
        self._expected = Expected(
            free, fixed, 2 if measure == "rmse" else 1, covariance(kinds, spreads, certain)
        )

    def run(
        self,
        measure: Callable[[int], Measured],
        *,
        tolerance: float,
        budget: float = np.inf,
        confirm: Callable[[int], float] | None = None,
    ) -> End | None:
        """Return the least model with its neighbours; None where none is enough.

        Args:
            measure: Measures a model.
            tolerance: Largest error.
            budget: Largest cost.
            confirm: Returns the error of a model that is to be chosen, measured otherwise; a
                model that then misses is not chosen.
        """
        confirmed: set[int] = set()
        while True:
            result = climb(
                self._expected, self._costs_now, lambda k: self._learned(measure(k)),
                tolerance=tolerance, budget=budget, tried=self.tried,
            )  # fmt: skip
            self.tried = result.tried
            best = result.best
            if best is None:
                return None
            if confirm is not None and best not in confirmed:
                confirmed.add(best)
                error = confirm(best)
                if error > tolerance:
                    self.tried[best] = self.tried[best]._replace(error=error)
                    continue
            failed = self._simpler(best, result, measure, tolerance)
            further = self._better(best, measure)
            cheaper = [f for f in self.tried.values() if f.error <= tolerance]
            if min(f.cost for f in cheaper) >= self.tried[best].cost:
                return End(best, failed, further)

    def _simpler(
        self, best: int, result: Climb, measure: Callable[[int], Measured], tolerance: float
    ) -> int | None:
        """Return the closest of the cheaper ones; if none was tried, the likeliest is."""
        mine = self.tried[best]
        for likeliest_first in (True, False):
            costs = self._costs_now()
            left = costs < mine.cost
            left[list(self.tried)] = False
            if self._closest(mine, tolerance) is None and left.any():
                rank = result.chance if likeliest_first else -costs
                k = int(np.argmax(np.where(left, rank, -np.inf)))
                self.tried[k] = self._learned(measure(k))
        return self._closest(mine, tolerance)

    def _closest(self, mine: Found, tolerance: float) -> int | None:
        """Return which of the cheaper ones misses by least."""
        simpler = [k for k, f in self.tried.items() if f.cost < mine.cost and f.error > tolerance]
        return min(simpler, key=lambda k: self.tried[k].error, default=None)

    def _better(self, best: int, measure: Callable[[int], Measured]) -> int | None:
        """Return the cheapest of the dearer ones that are better; if none was tried, one is."""
        mine, costs = self.tried[best], self._costs_now()
        expected = self._expected.error
        untried = np.array([k not in self.tried for k in range(len(costs))])
        wanted = untried & (costs > mine.cost) & (expected < _BETTER * expected[best])
        for again in (True, False):
            better = [
                k for k, f in self.tried.items() if f.error < mine.error and f.cost > mine.cost
            ]
            if better or not again or not wanted.any():
                return min(better, key=lambda k: self.tried[k].cost, default=None)
            k = int(np.argmin(np.where(wanted, costs, np.inf)))
            self.tried[k] = self._learned(measure(k))
        return None

    def _costs_now(self) -> np.ndarray:
        return self._costs.expect(self.models)

    def _learned(self, found: Measured) -> Found:
        self._costs.learn(found.ms)
        return Found(found.error, found.cost)

    def told(self, k: int | None) -> Tried | None:
        """Return what was found of a model."""
        if k is None:
            return None
        power = self._expected.power
        expected = (self._expected.error[k] ** power + self._expected.fixed[k] ** power) ** (
            1 / power
        )
        return Tried(self.models[k], *self.tried[k], float(expected))

    def reasons(self, best: int, tolerance: float) -> dict[Model, str]:
        """Return why models were not tried."""
        limit = self.tried[best].cost
        costs, found = self._costs_now(), dict(self.useless)
        for k, model in enumerate(self.models):
            if k in self.tried:
                continue
            if self._expected.fixed[k] > tolerance:
                found[model] = "its look alone misses: the normal map is needed"
            elif costs[k] >= limit / WORTH:
                found[model] = "hardly cheaper than the choice, or dearer"
            else:
                found[model] = f"expected to miss by its {self._parts[k].cause}"
        return found
