"""Fit a bias, or other numbers of shadow techniques: least squares, hardening.

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
from shadows.compare import Compare, HardCompare
from shadows.filters import Filter

from .bias_space import BiasSpace, Clock, Search, soft_residual, untold
from .bias_study import Techniques, Trial

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
        techniques: Bias, filter and comparison of the result.
        values: The fitted numbers.
        units: The unit of each.
        error: Of the goal; under hard comparison, unless a soft one was asked for.
        levels: Every solve.
        evaluations: Biases tried under hard comparison, and one for each solver step.
        seconds: Run time, without compilation.
        compile_seconds: Compilation.
        untold: What the data does not determine, in sentences; none if it does.
    """

    techniques: Techniques
    values: dict[str, float]
    units: dict[str, str]
    error: float
    levels: tuple[Level, ...]
    evaluations: int
    seconds: float
    compile_seconds: float
    untold: tuple[str, ...]

    @property
    def bias(self) -> CombinedBias:
        """The bias of the result."""
        return self.techniques[0]

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
    compare: Compare = HardCompare(),
    levels: Sequence[float] = LEVELS,
    report: Report = lambda text: None,
) -> BiasFit:
    """Fit the numbers of a bias, from zero, or of other techniques, by Levenberg-Marquardt.

    Args:
        trial: What is compared with what.
        bias: Which terms there are; numbers that are not free keep their values.
        filter: How the map is asked.
        free: Names of the numbers to fit, as ``constant.length`` or ``poisson.radius``; None
            for all of the bias.
        compare: How depths become visibility in the end. Hard comparison has no slope to
            follow, and is reached through soft ones; another one stays as it is.
        levels: Softness of each solve, falling, half texels.
        report: Told how far it is.

    Raises:
        ValueError: If a name is not one of the bias's numbers.
    """
    (fitted,) = fit_bias_from(
        trial, bias, filter, [None], free=free, compare=compare, levels=levels, report=report
    )
    return fitted


def fit_bias_from(
    trial: Trial,
    bias: CombinedBias,
    filter: Filter,
    starts: Sequence[Float[np.ndarray, " numbers"] | None],
    *,
    free: Sequence[str] | None = None,
    compare: Compare = HardCompare(),
    levels: Sequence[float] = LEVELS,
    report: Report = lambda text: None,
) -> list[BiasFit]:
    """Fit as ``fit_bias`` does, from each of several starts; compiled once.

    Args:
        trial: As there, as all that is not here.
        bias: As there.
        filter: As there.
        starts: In steps of the ``BiasSpace``; None for its own start.
        free: As there.
        compare: As there.
        levels: As there.
        report: As there.
    """
    space, clock = BiasSpace.of(bias, filter, trial, free, compare=compare), Clock()
    softnesses = jnp.asarray(levels if space.softens else levels[:1], space.start.dtype)
    # As many steps in all where there is one level.
    most = _STEPS_PER_LEVEL * (1 if space.softens else len(LEVELS))
    solve = clock.compiled(_solve, space.start, space, trial, softnesses[0], most)
    search = Search(space, trial, clock, batch=_WAY)
    fits = []
    for start in starts:
        before = clock.seconds, search.evaluations
        vector = space.start if start is None else jnp.asarray(start, space.start.dtype)
        start = np.asarray(vector)
        best, score = start, search(start[None]).score(0)
        solved = []
        for softness in softnesses:
            with clock.running():
                solution = jax.block_until_ready(solve(vector, space, trial, softness, most))
            vector = solution.value
            way = start + np.linspace(0, 1, _WAY + 1)[1:, None] * (np.asarray(vector) - start)
            tried = search(way)
            if tried.score(tried.best) < score:
                best, score = way[tried.best], tried.score(tried.best)
            result = _result(solution, most)
            steps, error = int(solution.stats["num_steps"]), float(tried.errors[-1])
            end = Level(float(softness), space.values(vector), error, steps, result)
            solved.append(end)
            report(f"softness {end.softness:.2g}: error {end.error:.3%}, {steps} steps")
        point = jnp.asarray(best, space.start.dtype)
        fits.append(
            BiasFit(
                techniques=space.techniques(point),
                values=space.values(point),
                units=dict(zip(space.names, space.units, strict=True)),
                error=score[0],
                levels=tuple(solved),
                evaluations=search.evaluations - before[1] + sum(level.steps for level in solved),
                seconds=clock.seconds - before[0],
                compile_seconds=clock.compile_seconds,
                untold=untold(point, space, trial, softnesses[0]),
            )
        )
    return fits


def _result(solution: optx.Solution, most: int) -> str:
    """Return the solver's result code as a word, or its text where it is a rare one."""
    if solution.result == optx.RESULTS.successful:
        return "converged"
    if solution.result == optx.RESULTS.nonlinear_max_steps_reached:
        return f"stopped after {most} steps"
    return optx.RESULTS[solution.result]


@eqx.filter_jit
def _solve(
    start: Float[Array, " numbers"],
    space: BiasSpace,
    trial: Trial,
    softness: Float[Array, ""],
    most: int,
) -> optx.Solution:
    """Minimize the soft residual; a few numbers and many pixels want the normal equations."""
    # A level only leads to the next one; the only one leads to the result.
    rtol = 3e-2 if space.softens else 1e-4
    linear_solver = lx.Normal(lx.Cholesky())
    solver = optx.LevenbergMarquardt(rtol=rtol, atol=1e-3, linear_solver=linear_solver)
    return optx.least_squares(
        lambda vector, _: soft_residual(vector, space, trial, softness),
        solver,
        start,
        options={"jac": "fwd"},
        max_steps=most,
        throw=False,
    )
