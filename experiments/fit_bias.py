"""Fit a bias: least squares under a soft comparison that hardens.

Hard comparison counts right and wrong pixels and has no slope to follow; a soft one does.
Each level starts from where the last ended, with a harder comparison, so that the first
sees how far every pixel is from its comparison and the last nearly what the hard one will.
Of all points on the way from zero bias to each level's result, the one with the least
error under hard comparison is kept, and of equal ones the one that deviates least on average.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

from shadows.bias import CombinedBias
from shadows.filters import Filter

from .bias_space import BiasSpace, Clock, Search, soft_residual, untold
from .bias_study import Trial

LEVELS = (1.0, 0.3, 0.1)  # softness in half texels
_STEPS_PER_LEVEL = 8
_WAY = 32  # points tried between zero bias and a level's result

Report = Callable[[str], None]


class Level(NamedTuple):
    """One least-squares solve.

    Attributes:
        softness: Of the comparison, half texels.
        values: The numbers where it ended.
        error: There, under hard comparison.
        steps: Solver steps.
        result: The solver's own word.
    """

    softness: float
    values: dict[str, float]
    error: float
    steps: int
    result: str


class BiasFit(NamedTuple):
    """A fitted bias and how it came about.

    Attributes:
        bias: The result.
        values: Its fitted numbers.
        units: The unit of each.
        error: Under hard comparison.
        levels: Every solve.
        evaluations: Biases tried under hard comparison, and one for each solver step.
        seconds: Run time, without compilation.
        compile_seconds: Compilation.
        untold: What the data does not determine, in sentences; none if it does.
    """

    bias: CombinedBias
    values: dict[str, float]
    units: dict[str, str]
    error: float
    levels: tuple[Level, ...]
    evaluations: int
    seconds: float
    compile_seconds: float
    untold: tuple[str, ...]

    @property
    def steps(self) -> int:
        """Solver steps of all levels."""
        return sum(level.steps for level in self.levels)


def fit_bias(
    trial: Trial,
    bias: CombinedBias,
    filter: Filter,
    *,
    free: Sequence[str] | None = None,
    levels: Sequence[float] = LEVELS,
    report: Report = lambda text: None,
) -> BiasFit:
    """Fit the numbers of a bias, from zero, by Levenberg-Marquardt.

    Args:
        trial: What is compared with what.
        bias: Which terms there are; numbers that are not free keep their values.
        filter: Which texels are asked.
        free: Names of the numbers to fit, as ``constant.length``; None for all.
        levels: Softness of each solve, falling, half texels.
        report: Told how far it is.

    Raises:
        ValueError: If a name is not one of the bias's numbers.
    """
    space, clock = BiasSpace.of(bias, trial, free), Clock()
    zero = jnp.zeros_like(space.step)
    softnesses = jnp.asarray(levels, zero.dtype)
    solve = clock.compiled(_solve, zero, space, trial, filter, softnesses[0])
    search = Search(space, trial, filter, clock, batch=_WAY)
    best, score = np.zeros(zero.shape), search(np.zeros((1, *zero.shape))).score(0)
    vector, solved = zero, []
    for softness in softnesses:
        with clock.running():
            solution = jax.block_until_ready(solve(vector, space, trial, filter, softness))
        vector = solution.value
        way = np.linspace(0, 1, _WAY + 1)[1:, None] * np.asarray(vector)
        tried = search(way)
        if tried.score(tried.best) < score:
            best, score = way[tried.best], tried.score(tried.best)
        result = _result(solution)
        steps = int(solution.stats["num_steps"])
        end = Level(float(softness), space.values(vector), float(tried.errors[-1]), steps, result)
        solved.append(end)
        report(f"softness {end.softness:.2g}: error {end.error:.3%}, {steps} steps")
    point = jnp.asarray(best, zero.dtype)
    return BiasFit(
        bias=space.bias(point),
        values=space.values(point),
        units=dict(zip(space.names, space.units, strict=True)),
        error=score[0],
        levels=tuple(solved),
        evaluations=search.evaluations + sum(level.steps for level in solved),
        seconds=clock.seconds,
        compile_seconds=clock.compile_seconds,
        untold=untold(point, space, trial, filter, softnesses[0]),
    )


def _result(solution: optx.Solution) -> str:
    """Return the solver's result code as a word, or its text where it is a rare one."""
    if solution.result == optx.RESULTS.successful:
        return "converged"
    if solution.result == optx.RESULTS.nonlinear_max_steps_reached:
        return f"stopped after {_STEPS_PER_LEVEL} steps"
    return optx.RESULTS[solution.result]


@eqx.filter_jit
def _solve(
    start: Float[Array, " numbers"],
    space: BiasSpace,
    trial: Trial,
    filter: Filter,
    softness: Float[Array, ""],
) -> optx.Solution:
    """Minimize the soft residual; a few numbers and many pixels want the normal equations."""
    solver = optx.LevenbergMarquardt(rtol=3e-2, atol=1e-3, linear_solver=lx.Normal(lx.Cholesky()))
    return optx.least_squares(
        lambda vector, _: soft_residual(vector, space, trial, filter, softness),
        solver,
        start,
        options={"jac": "fwd"},
        max_steps=_STEPS_PER_LEVEL,
        throw=False,
    )
