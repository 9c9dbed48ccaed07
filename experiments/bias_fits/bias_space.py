"""The numbers of techniques as a vector, and many tried at once: what fit and sweep share."""

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from shadows.bias import CombinedBias
from shadows.compare import Compare, HardCompare, SoftCompare
from shadows.filters import Filter
from shadows.transforms import Scalar
from shadows.window_filters import BilinearFilter

from ..options import hint, numbers, technique_name
from .bias_study import Trial

_SAME = 0.01  # singular values below this share of the largest cannot be told apart


class Clock:
    """Adds up run time and compilation apart.

    Attributes:
        seconds: Run time.
        compile_seconds: Compilation.
    """

    def __init__(self) -> None:
        """Start at zero."""
        self.seconds = 0.0
        self.compile_seconds = 0.0

    @contextmanager
    def running(self) -> Iterator[None]:
        """Count what happens inside as run time."""
        start = time.perf_counter()
        yield
        self.seconds += time.perf_counter() - start

    def compiled(self, function: Any, *args: object) -> Callable:
        """Compile an ``equinox.filter_jit`` function ahead of its calls."""
        start = time.perf_counter()
        compiled = function.lower(*args).compile()
        self.compile_seconds += time.perf_counter() - start
        return compiled


class BiasSpace(eqx.Module):
    """The free numbers of techniques, each in steps of which one changes about as much.

    Attributes:
        template: Bias, filter and comparison; what is not free keeps its value.
        start: Where a fit begins: zero for a bias, their own values for other numbers.
        step: What 1 in the vector means in the number's own unit: of a bias the median
            texel footprint for world lengths and 1 for numbers in texels; of other numbers
            a quarter of their own values.
        names: The free numbers, as ``constant.length``.
        units: The unit of each.
        free: For each number, whether it is free.
        smooth: Whether a hard comparison may stay in a fit: the numbers move no depth, but
            what a filter reads, and the truth has penumbrae that follow it.
    """

    template: tuple[CombinedBias, Filter, Compare]
    start: Float[Array, " numbers"]
    step: Float[Array, " numbers"]
    names: tuple[str, ...] = eqx.field(static=True)
    units: tuple[str, ...] = eqx.field(static=True)
    free: tuple[bool, ...] = eqx.field(static=True)
    smooth: bool = eqx.field(static=True)

    @staticmethod
    def of(
        bias: CombinedBias,
        filter: Filter,
        trial: Trial,
        names: Sequence[str] | None = None,
        *,
        compare: Compare = HardCompare(),
    ) -> "BiasSpace":
        """Choose the free numbers.

        Args:
            bias: At most one term of each kind.
            filter: How the map is asked.
            trial: Tells what a step means.
            names: The free numbers; None for all of the bias.
            compare: How depths become visibility; hard is made soft for fits.

        Raises:
            ValueError: As ``free_numbers``.
        """
        chosen = free_numbers(bias, names, filter=filter, compare=compare)
        of_bias = _numbers(bias.terms)
        known = of_bias | _numbers((filter, compare))
        length = np.asarray(trial.footprint_length)
        step = [_step(*known[name], float(length) if name in of_bias else None) for name in chosen]
        start = [
            0.0 if name in of_bias else known[name][0] / each
            for name, each in zip(chosen, step, strict=True)
        ]
        template = jax.tree.map(
            lambda number: jnp.asarray(number, length.dtype), (bias, filter, compare)
        )
        return BiasSpace(
            template,
            jnp.asarray(start, length.dtype),
            jnp.asarray(step, length.dtype),
            chosen,
            tuple(known[name][1] for name in chosen),
            tuple(name in chosen for name in known),
            bool(trial.soft) and not any(name in of_bias for name in chosen),
        )

    @property
    def softens(self) -> bool:
        """Whether a fit puts a soft comparison in place of a hard one."""
        _, filter, compare = self.template
        return filter.compares and isinstance(compare, HardCompare) and not self.smooth

    @property
    def reads_anew(self) -> bool:
        """Whether a number of the filter is free, so that what it reads changes."""
        name = technique_name(type(self.template[1]))
        return any(free.startswith(f"{name}.") for free in self.names)

    def techniques(self, vector: Float[Array, " numbers"]) -> tuple[CombinedBias, Filter, Compare]:
        """Return bias, filter and comparison at a point, in steps."""
        leaves, structure = jax.tree.flatten(self.template)
        fresh = iter(range(len(self.names)))
        # Only a bias may be negative.
        free = jnp.where(self.start > 0, jnp.abs(vector), vector) * self.step
        placed = [
            free[next(fresh)] if chosen else leaf
            for leaf, chosen in zip(leaves, self.free, strict=True)
        ]
        return jax.tree.unflatten(structure, placed)

    def visibility(
        self, vector: Float[Array, " numbers"], trial: Trial, softness: Scalar | None = None
    ) -> Float[Array, " pixels"]:
        """Return what a point shows; with a softness, under a comparison that is so soft."""
        bias, filter, compare = self.techniques(vector)
        if softness is not None and self.softens:
            compare = SoftCompare(softness)
        return trial.visibility(bias, filter, compare, anew=self.reads_anew)

    def values(self, vector: Float[Array | np.ndarray, " numbers"]) -> dict[str, float]:
        """Return the numbers at a point, in their own units."""
        vector = np.where(np.asarray(self.start) > 0, np.abs(vector), vector)
        return dict(zip(self.names, (vector * np.asarray(self.step)).tolist(), strict=True))


def _numbers(techniques: Sequence[eqx.Module]) -> dict[str, tuple[float, str]]:
    return {name: number for term in techniques for name, number in numbers(term).items()}


def _step(value: float, unit: str, footprint: float | None) -> float:
    if footprint is None:
        return 0.25 * abs(value) or 0.1
    return footprint if unit == "world length" else 1.0


def free_numbers(
    bias: CombinedBias,
    names: Sequence[str] | None = None,
    *,
    filter: Filter = BilinearFilter(),
    compare: Compare = HardCompare(),
) -> tuple[str, ...]:
    """Return the names of the free numbers, in the order of the techniques.

    Args:
        bias: At most one term of each kind.
        names: The free numbers; None for all of the bias.
        filter: How the map is asked.
        compare: How depths become visibility.

    Raises:
        ValueError: If a name is not one of the numbers, if there is none to choose, or if
            two terms are of the same kind.
    """
    of_bias = [name for term in bias.terms for name in numbers(term)]
    known = [*of_bias, *_numbers((filter, compare))]
    twice = sorted({name for name in known if known.count(name) > 1})
    if twice:
        raise ValueError(
            f"bias: expected one or more terms of different kinds, got {', '.join(twice)} twice"
        )
    if not (of_bias if names is None else known):
        raise ValueError("bias: has no numbers to fit; name a bias, as constant or slope")
    for name in () if names is None else names:
        if name not in known:
            raise ValueError(f"free {name}: no such number; {hint(name, known)}")
    chosen = tuple(name for name in known if name in (of_bias if names is None else names))
    if not chosen:
        raise ValueError(f"free: names no number; choose from: {', '.join(known)}")
    return chosen


class Tried(NamedTuple):
    """What came of many biases.

    Attributes:
        errors: Under hard comparison.
        deviations: Mean size of the goal's residual, which decides between equal errors:
            under 2x2 lookup a pixel can count as right and still be a shade too dark.
    """

    errors: Float[np.ndarray, " points"]
    deviations: Float[np.ndarray, " points"]

    @property
    def best(self) -> int:
        """Index of the least error, and of equal ones the least deviation."""
        return int(np.lexsort((self.deviations, self.errors))[0])

    def score(self, index: int) -> tuple[float, float]:
        """Return what is compared, the smaller the better."""
        return float(self.errors[index]), float(self.deviations[index])


class Search:
    """Errors of many points, a fixed number at a time.

    Attributes:
        evaluations: Points tried so far.
    """

    def __init__(self, space: BiasSpace, trial: Trial, clock: Clock, *, batch: int) -> None:
        """Compile the trial of ``batch`` points."""
        self._args = (space, trial)
        self._batch, self._clock = batch, clock
        points = jnp.zeros((batch, len(space.names)), space.step.dtype)
        self._errors = clock.compiled(_errors, *self._args, points)
        self.evaluations = 0

    def __call__(self, points: Float[np.ndarray, "points numbers"]) -> Tried:
        """Return the error and deviation of each point."""
        found = []
        with self._clock.running():
            for start in range(0, len(points), self._batch):
                part = points[start : start + self._batch]
                padded = np.resize(part, (self._batch, part.shape[1]))
                points_here = jnp.asarray(padded, self._args[0].step.dtype)
                found.append(np.asarray(self._errors(*self._args, points_here))[: len(part)])
        self.evaluations += len(points)
        errors, deviations = np.concatenate(found).T
        return Tried(errors, deviations)


@eqx.filter_jit
def _errors(
    space: BiasSpace, trial: Trial, points: Float[Array, "points numbers"]
) -> Float[Array, "points 2"]:
    def tried(vector: Float[Array, " numbers"]) -> Float[Array, "2"]:
        visibility = space.visibility(vector, trial)
        deviation = jnp.mean(jnp.abs(trial.goal.residual(visibility)))
        return jnp.stack([trial.goal.error(visibility), deviation])

    return lax.map(tried, points)


def soft_residual(
    vector: Float[Array, " numbers"], space: BiasSpace, trial: Trial, softness: Array
) -> Float[Array, "..."]:
    """Return what a fit makes small: goal minus image under soft comparison."""
    return trial.goal.residual(space.visibility(vector, trial, softness))


def untold(
    vector: Float[Array, " numbers"], space: BiasSpace, trial: Trial, softness: Array
) -> tuple[str, ...]:
    """Say which combinations of the numbers the data does not determine near a point.

    From the singular values of the soft residual's derivative: a direction whose value is
    below 1 % of the largest leaves the image as it is.
    """
    jacobian = eqx.filter_jit(jax.jacfwd(soft_residual))(vector, space, trial, softness)
    _, singular, directions = np.linalg.svd(
        np.asarray(jacobian, np.float64).reshape(-1, len(space.names)), full_matrices=False
    )
    if singular[0] <= 1e-6:
        return (f"the data does not depend on {' or '.join(space.names)} near the result",)
    sentences = []
    for value, direction in zip(singular, directions, strict=True):
        if value < _SAME * singular[0]:
            direction = direction * np.sign(direction[np.argmax(np.abs(direction))])
            change = " and ".join(
                f"{name} by {share * step:+.3g}"
                for name, share, step in zip(
                    space.names, direction, np.asarray(space.step), strict=True
                )
                if abs(share) > 0.05
            )
            sentences.append(
                f"the data cannot tell these apart: changing {change} changes the residual "
                f"{value / singular[0]:.1e} times as much as the steepest change does"
            )
    return tuple(sentences)
