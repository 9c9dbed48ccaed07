"""Solvers side by side on one normal map: they take turns, a few steps at a time.

All start from the flat map and have the same residuals. ``MapFit`` walks in scaled steps from
anchors, the others in the slopes themselves. Compilation is timed apart; turns make a change
of the machine's speed meet all of them. Errors are those of the texels that three or more
lights reach.
"""

import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float, PyTree

from tangentspace.normal_map import slopes_from_normals

from ..normal_map_fits.fit_normal_map import MapFit
from ..normal_map_fits.normal_map_evidence import gather_evidence
from ..normal_map_fits.normal_map_information import texel_information
from ..normal_map_fits.normal_map_study import MapStudy, errors_of
from ..normal_map_fits.normal_map_task import Task, Unknowns
from ..normal_map_fits.normal_map_views import Slopes

_PAST_ANCHOR = 21  # steps that meet all that a fit compiles

Problem = tuple[Task, Unknowns]
Function = Callable[[Slopes, Problem], PyTree[Array]]


class Standing(NamedTuple):
    """Where a solver stands.

    Attributes:
        slopes: Of the map.
        steps: Taken so far.
        result: How it ended; empty while it goes on.
    """

    slopes: Slopes
    steps: int
    result: str


class Walk:
    """A solver under way in a compiled program of its own.

    Args:
        begun: Arrays to start from.
        advance: Function of those, the problem and a number of steps, to compile.
        problem: What is fitted; an argument of the compiled program.
        look: Function from the arrays to where the solver stands.
    """

    def __init__(
        self,
        begun: PyTree[Array],
        advance: Callable[[PyTree[Array], Problem, Array], PyTree[Array]],
        problem: Problem,
        look: Callable[[PyTree[Array]], Standing],
    ) -> None:
        start = time.perf_counter()
        self._advance = jax.jit(advance).lower(begun, problem, jnp.array(1)).compile()
        self.compile_seconds = time.perf_counter() - start
        self.head_start = 0.0
        self._at, self._problem, self._look = begun, problem, look
        jax.block_until_ready(self._advance(begun, problem, jnp.array(1)))

    def advance(self, steps: int) -> None:
        """Take up to so many steps."""
        self._at = jax.block_until_ready(self._advance(self._at, self._problem, jnp.array(steps)))

    @property
    def standing(self) -> Standing:
        """Where the solver stands."""
        return self._look(self._at)


class FitWalk:
    """``MapFit`` under way; what its first anchor costs counts from the start."""

    def __init__(self, study: MapStudy) -> None:
        task = Task(study.seen.view, study.targets)
        start = time.perf_counter()
        self._fit = MapFit(task, study.shading, study.lights)
        seconds = [time.perf_counter() - start]
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "start.eqx"
            self._fit.store(path)
            for _ in range(2):  # the first time all is compiled
                self._fit.restore(path)
                start = time.perf_counter()
                self._fit.advance(_PAST_ANCHOR)
                seconds.append(time.perf_counter() - start)
            self._fit.restore(path)
        start = time.perf_counter()
        texel_information(task, self._fit.start)
        self.head_start = time.perf_counter() - start
        made, first, second = seconds
        self.compile_seconds = made + first - second

    def advance(self, steps: int) -> None:
        """Take up to so many steps."""
        self._fit.advance(steps)

    @property
    def standing(self) -> Standing:
        """Where the fit stands."""
        result = "converged" if self._fit.converged else ""
        return Standing(self._fit.unknowns.slopes, self._fit.steps, result)


class Entry:
    """A solver in the race, and how it came down so far.

    Args:
        name: Of the solver.
        walk: The solver.
        study: What it is fitted to.
        known: The texels that count.
        chunk: Steps at a time.
        most: Steps after which it is stopped.
    """

    def __init__(
        self,
        name: str,
        walk: Walk | FitWalk,
        study: MapStudy,
        known: Bool[np.ndarray, "height width"],
        *,
        chunk: int,
        most: int,
    ) -> None:
        self.name, self._walk = name, walk
        self._study, self._known, self._chunk, self._most = study, known, chunk, most
        self._seconds, self._points = walk.head_start, []
        self._record()

    def advance(self) -> bool:
        """Take some steps, and return whether more are to come."""
        start = time.perf_counter()
        self._walk.advance(self._chunk)
        self._seconds += time.perf_counter() - start
        return self._record()

    def row(self) -> dict[str, Any]:
        """Return the figures; the curve's begin with the flat map."""
        steps, seconds, mean, largest = np.array(self._points).T
        per_step = 1e3 * np.diff(seconds) / np.maximum(np.diff(steps), 1)
        return {
            "solver": self.name,
            "result": self._result or f"stopped after {steps[-1]:.0f} steps",
            "steps": int(steps[-1]),
            "seconds": float(seconds[-1]),
            "compile_s": self._walk.compile_seconds,
            "ms_per_step": np.percentile(per_step, [25, 50, 75]).round(2).tolist(),
            "mean_error_degrees": float(mean[-1]),
            "max_error_degrees": float(largest[-1]),
            "texels_known": int(self._known.sum()),
            "texels": self._known.size,
            "curve": {
                "steps": steps.astype(int).tolist(),
                "seconds": seconds.round(4).tolist(),
                "mean_error_degrees": mean.tolist(),
                "max_error_degrees": largest.tolist(),
            },
        }

    def _record(self) -> bool:
        slopes, steps, self._result = self._walk.standing
        errors = errors_of(self._study, slopes)[self._known]
        self._points.append((steps, self._seconds, errors.mean(), errors.max()))
        return not self._result and steps < self._most


def race(entries: Sequence[Entry], report: Callable[[str], None]) -> list[dict[str, Any]]:
    """Let the solvers take turns until all have ended, and return their figures.

    Args:
        entries: The solvers.
        report: Is told which are still going.
    """
    going = list(entries)
    while going:
        report(", ".join(entry.name for entry in going))
        going = [entry for entry in going if entry.advance()]
    return [entry.row() for entry in entries]


def flat_problem(study: MapStudy) -> Problem:
    """Return what is compared, and the flat map under the right lights and material."""
    numbers = (study.shading, tuple(study.lights))
    shading, lights = jax.tree.map(lambda leaf: jnp.asarray(leaf, float), numbers)
    flat = jnp.zeros((*study.seen.view.map_size, 2))
    return Task(study.seen.view, study.targets), Unknowns(flat, shading, lights)


def known_texels(study: MapStudy) -> Bool[np.ndarray, "height width"]:
    """Return the texels that enough lights reach, under the true map."""
    assert study.truth is not None
    task, flat = flat_problem(study)
    slopes = jax.jit(slopes_from_normals)(jnp.asarray(study.truth, jnp.float32)).slopes
    return gather_evidence(task, eqx.tree_at(lambda u: u.slopes, flat, slopes)).known


def residuals(slopes: Slopes, problem: Problem) -> list[Float[Array, " pixels"]]:
    """Return color minus target for each light and channel."""
    task, flat = problem
    return task.residuals(eqx.tree_at(lambda u: u.slopes, flat, slopes))


def half_squares(slopes: Slopes, problem: Problem) -> Float[Array, ""]:
    """Return half the sum of squares of the residuals."""
    first, *others = [jnp.sum(part**2) for part in residuals(slopes, problem)]
    return 0.5 * sum(others, first)


def optimistix_walk(
    solver: optx.AbstractMinimiser | optx.AbstractLeastSquaresSolver,
    function: Function,
    problem: Problem,
) -> Walk:
    """Take a solver's steps one by one, as ``optimistix`` does in one call to the end.

    Args:
        solver: For a number, or for residuals.
        function: Returns what is made small.
        problem: What ``function`` needs beside the slopes.
    """
    pair = lambda slopes, at: (function(slopes, at), None)
    start = problem[1].slopes
    struct = jax.eval_shape(function, start, problem)
    state = solver.init(pair, start, problem, {}, struct, None, frozenset())
    arrays, static = eqx.partition(state, eqx.is_array)

    def advance(begun: PyTree, problem: Problem, steps: Array) -> PyTree:
        last = begun[2] + steps

        def unfinished(at: PyTree) -> Array:
            _, _, count, done, result = at
            return ~done & (result == optx.RESULTS.successful) & (count < last)

        def step(at: PyTree) -> PyTree:
            slopes, arrays, count, _, _ = at
            state = eqx.combine(static, arrays)
            slopes, state, _ = solver.step(pair, slopes, problem, {}, state, frozenset())
            done, result = solver.terminate(pair, slopes, problem, {}, state, frozenset())
            return slopes, eqx.partition(state, eqx.is_array)[0], count + 1, done, result

        return jax.lax.while_loop(unfinished, step, begun)

    def look(at: PyTree) -> Standing:
        slopes, _, count, done, result = at
        word = "converged" if done else ""
        if result != optx.RESULTS.successful:
            word = f"failed: {optx.RESULTS[result].strip()}"
        return Standing(slopes, int(count), word)

    begun = (start, arrays, jnp.array(0), jnp.array(False), optx.RESULTS.successful)
    return Walk(begun, advance, problem, look)


def adam_walk(rate: float, function: Function, problem: Problem) -> Walk:
    """Adam with its usual constants (D. Kingma, J. Ba, ICLR 2015, algorithm 1).

    Args:
        rate: Of learning.
        function: Returns what is made small.
        problem: What ``function`` needs beside the slopes.
    """

    def advance(begun: PyTree, problem: Problem, steps: Array) -> PyTree:
        def step(_: Array, at: PyTree) -> PyTree:
            slopes, first, second, count = at
            gradient = jax.grad(function)(slopes, problem)
            count = count + 1
            first = 0.9 * first + 0.1 * gradient
            second = 0.999 * second + 0.001 * gradient**2
            ratio = (first / (1 - 0.9**count)) / (jnp.sqrt(second / (1 - 0.999**count)) + 1e-8)
            return slopes - rate * ratio, first, second, count

        return jax.lax.fori_loop(0, steps, step, begun)

    zero = jnp.zeros_like(problem[1].slopes)
    begun = (problem[1].slopes, zero, zero, jnp.array(0))
    return Walk(begun, advance, problem, lambda at: Standing(at[0], int(at[3]), ""))
