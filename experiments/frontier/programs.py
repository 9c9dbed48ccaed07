"""Compiled programs, kept for the next method and scene, and what running them takes."""

import threading
import time
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

_LITTLE_S, _MUCH_S = 0.03, 0.4  # spent on half of a stage's runs: more if below, fewer if above
_MOST, _LEAST = 50, 2


class Programs:
    """Compiled programs by what they are made of, with what compiling them took.

    Several threads may ask: each program is compiled by one, and different ones side by side.
    """

    def __init__(self) -> None:
        """Begin with none."""
        self._kept: dict[tuple, tuple[Any, dict[str, Any]]] = {}
        self._compiling: dict[tuple, threading.Lock] = defaultdict(threading.Lock)

    def get(self, name: str, function: Callable, *arguments: Any) -> "Timed":
        """Return a program bound to its arguments; compiled if it is new.

        Args:
            name: What tells it from others that take the same arrays.
            function: What to compile.
            arguments: Arrays, of which shapes and types count, and numbers.
        """
        arguments = jax.tree.map(jnp.asarray, arguments)
        leaves, tree = jax.tree.flatten(arguments)
        key = (name, tree, tuple((leaf.shape, leaf.dtype) for leaf in leaves))
        with self._compiling[key]:
            if key not in self._kept:
                self._kept[key] = _compiled(function, arguments)
        return Timed(*self._kept[key], arguments)

    def __len__(self) -> int:
        """How many were compiled."""
        return len(self._kept)


def _compiled(function: Callable, arguments: tuple) -> tuple[Any, dict[str, Any]]:
    start = time.perf_counter()
    program = jax.jit(function).lower(*arguments).compile()
    memory = program.memory_analysis()
    return program, {
        "compile_s": time.perf_counter() - start,
        "temporary_bytes": getattr(memory, "temp_size_in_bytes", 0),
    }


class Timed:
    """A compiled program with its arguments."""

    def __init__(self, program: Any, cost: dict[str, Any], arguments: tuple) -> None:
        """Bind them."""
        self._program, self.cost, self._arguments = program, cost, arguments

    def __call__(self) -> Any:
        """Run it to its end."""
        return jax.block_until_ready(self._program(*self._arguments))


def time_stages(
    stages: Mapping[str, Timed | None], *, total: Sequence[str], runs: int
) -> dict[str, Any]:
    """Return what the stages of a method cost, warm.

    Args:
        stages: Programs by name; None for a stage that a method does not have.
        total: Stages that count together.
        runs: Of each program, twice: half of them after the other half of all. Fast programs run
            more often, and slow ones less.

    Returns:
        Of each stage quartiles in ms (``ms``), seconds of compilation and temporary bytes;
        ``total_ms``, quartiles of the sum of some; and whether each half's median of it
        lies within them (``stable``).
    """
    there = {name: timed for name, timed in stages.items() if timed is not None}
    halves = [{name: run_times(timed, runs) for name, timed in there.items()} for _ in range(2)]
    figures: dict[str, Any] = dict.fromkeys(stages)
    for name, timed in there.items():
        quartiles = np.percentile([*halves[0][name], *halves[1][name]], [25, 50, 75])
        figures[name] = timed.cost | {"ms": [round(float(t), 4) for t in quartiles]}
    medians = [sum(np.median(half[name]) for name in total if name in there) for half in halves]
    sums = np.sum([figures[name]["ms"] for name in total if name in there], axis=0)
    return figures | {
        "total_ms": sums.tolist(),
        "stable": bool(all(sums[0] <= of_half <= sums[2] for of_half in medians)),
    }


def run_times(timed: Timed, runs: int) -> list[float]:
    """Return the times of warm runs, ms; more of a fast program, and fewer of a slow one."""
    timed()
    times: list[float] = []
    while len(times) < (_MOST if sum(times) < 1e3 * _LITTLE_S else runs):
        start = time.perf_counter()
        timed()
        times.append(1e3 * (time.perf_counter() - start))
        if sum(times) > 1e3 * _MUCH_S and len(times) >= _LEAST:
            break
    return times
