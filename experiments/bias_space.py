"""The numbers of a bias as a vector, and many biases tried at once: what fit and sweep share."""

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
from shadows.compare import HardCompare, SoftCompare
from shadows.filters import Filter

from .bias_study import Trial
from .options import hint, numbers

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
    """The free numbers of a bias, each in steps of which one changes about as much.

    Attributes:
        template: The bias; what is not free keeps its value.
        step: What 1 in the vector means in the number's own unit: the median texel
            footprint for world lengths, 1 for numbers in texels.
        names: The free numbers, as ``constant.length``.
        units: The unit of each.
        free: For each number of the bias, whether it is free.
    """

    template: CombinedBias
    step: Float[Array, " numbers"]
    names: tuple[str, ...] = eqx.field(static=True)
    units: tuple[str, ...] = eqx.field(static=True)
    free: tuple[bool, ...] = eqx.field(static=True)

    @staticmethod
    def of(bias: CombinedBias, trial: Trial, names: Sequence[str] | None = None) -> "BiasSpace":
        """Choose the free numbers of a bias.

        Args:
            bias: At most one term of each kind.
            trial: Tells what a step means.
            names: The free numbers; None for all.

        Raises:
            ValueError: As ``free_numbers``.
        """
        chosen = free_numbers(bias, names)
        known = {n: unit for term in bias.terms for n, (_, unit) in numbers(term).items()}
        free = tuple(name in chosen for name in known)
        length = trial.footprint_length
        step = [
            length if known[name] == "world length" else jnp.ones_like(length) for name in chosen
        ]
        template = jax.tree.map(lambda number: jnp.asarray(number, length.dtype), bias)
        units = tuple(known[name] for name in chosen)
        return BiasSpace(template, jnp.stack(step), chosen, units, free)

    def bias(self, vector: Float[Array, " numbers"]) -> CombinedBias:
        """Return the bias at a point, in steps."""
        leaves, structure = jax.tree.flatten(self.template)
        fresh = iter(range(len(self.names)))
        values = vector * self.step
        placed = [
            values[next(fresh)] if free else leaf
            for leaf, free in zip(leaves, self.free, strict=True)
        ]
        return jax.tree.unflatten(structure, placed)

    def values(self, vector: Float[Array | np.ndarray, " numbers"]) -> dict[str, float]:
        """Return the numbers at a point, in their own units."""
        return dict(
            zip(self.names, (np.asarray(vector) * np.asarray(self.step)).tolist(), strict=True)
        )


def free_numbers(bias: CombinedBias, names: Sequence[str] | None = None) -> tuple[str, ...]:
    """Return the names of the free numbers of a bias, in its order.

    Args:
        bias: At most one term of each kind.
        names: The free numbers; None for all.

    Raises:
        ValueError: If a name is not one of the bias's numbers, if there is none to choose, or
            if two terms are of the same kind.
    """
    known = [name for term in bias.terms for name in numbers(term)]
    twice = sorted({name for name in known if known.count(name) > 1})
    if not known or twice:
        raise ValueError(
            f"bias: expected one or more terms of different kinds, got {', '.join(twice)} twice"
            if twice
            else "bias: has no numbers to fit; name a bias, as constant or slope"
        )
    for name in () if names is None else names:
        if name not in known:
            raise ValueError(f"free {name}: no such number of the bias; {hint(name, known)}")
    chosen = tuple(name for name in known if names is None or name in names)
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
    """Errors of many biases under hard comparison, a fixed number at a time.

    Attributes:
        evaluations: Biases tried so far.
    """

    def __init__(
        self, space: BiasSpace, trial: Trial, filter: Filter, clock: Clock, *, batch: int
    ) -> None:
        """Compile the trial of ``batch`` biases."""
        self._args = (space, trial, filter)
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
    space: BiasSpace, trial: Trial, filter: Filter, points: Float[Array, "points numbers"]
) -> Float[Array, "points 2"]:
    def tried(vector: Float[Array, " numbers"]) -> Float[Array, "2"]:
        visibility = trial.visibility(space.bias(vector), filter, HardCompare())
        deviation = jnp.mean(jnp.abs(trial.goal.residual(visibility)))
        return jnp.stack([trial.goal.error(visibility), deviation])

    return lax.map(tried, points)


def soft_residual(
    vector: Float[Array, " numbers"],
    space: BiasSpace,
    trial: Trial,
    filter: Filter,
    softness: Array,
) -> Float[Array, "..."]:
    """Return what a fit makes small: goal minus image under soft comparison."""
    visibility = trial.visibility(space.bias(vector), filter, SoftCompare(softness))
    return trial.goal.residual(visibility)


def untold(
    vector: Float[Array, " numbers"],
    space: BiasSpace,
    trial: Trial,
    filter: Filter,
    softness: Array,
) -> tuple[str, ...]:
    """Say which combinations of the numbers the data does not determine near a point.

    From the singular values of the soft residual's derivative: a direction whose value is
    below 1 % of the largest leaves the image as it is.
    """
    jacobian = eqx.filter_jit(jax.jacfwd(soft_residual))(vector, space, trial, filter, softness)
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
