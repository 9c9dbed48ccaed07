"""Compiled programs, kept for the next method and scene, and what running them takes."""

import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

_LITTLE_S, _MUCH_S = 0.03, 0.25  # spent on a stage: more runs if below, fewer if above
_MOST = 50  # runs
_SLOW_S = 0.1  # a program so slow needs no warming
_MOST_MAPS = 40_000  # of memory; Linux allows a process 65 530, and a program takes 60 to 200
_OF_IMAGE = ("draw", "prepare", "image")  # stages that make an image


class Programs:
    """Compiled programs by what they are made of, with what compiling them took.

    The last ones are kept, as many as a process can hold. Several threads may ask: each program
    is compiled by one, and different ones side by side.
    """

    def __init__(self) -> None:
        """Begin with none."""
        self._kept: dict[tuple, tuple[Any, dict[str, Any]]] = {}
        self._compiling: dict[tuple, threading.Lock] = defaultdict(threading.Lock)
        self._keeping = threading.Lock()

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
            with self._keeping:
                found = self._kept.pop(key, None)
            new = found is None
            if found is None:
                found = _compiled(function, arguments)
            with self._keeping:
                self._kept[key] = found  # the last of them
                if new and _crowded():
                    for old in list(self._kept)[: len(self._kept) // 2]:
                        del self._kept[old]
        return Timed(*found, arguments)

    def __len__(self) -> int:
        """How many were compiled."""
        return len(self._kept)


def _crowded() -> bool:
    """Tell whether this process has nearly as many maps of memory as it may have."""
    try:
        with open("/proc/self/maps", "rb") as maps:
            return sum(1 for _ in maps) > _MOST_MAPS
    except OSError:  # not on Linux, where there is no such limit
        return False


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


def time_stages(stages: Mapping[str, Timed | None], *, runs: int) -> dict[str, Any]:
    """Return what the stages of a method cost, compiled and warm.

    Args:
        stages: Programs by name; None for a stage that a method does not have.
        runs: Of each program, see ``run_times``.

    Returns:
        Of each stage times in ms (``ms``), seconds of compilation and temporary bytes; None of
        a stage that it does not have.
    """
    return {
        name: timed and timed.cost | {"ms": [round(t, 4) for t in run_times(timed, runs)]}
        for name, timed in stages.items()
    }


def pace_shift(timed: Iterable[Sequence[Mapping[str, Any]]]) -> float:
    """Return by what factor the machine's pace shifted between rounds, as the methods saw it.

    Quartiles of a few runs in a row know nothing of a machine that is slower a minute later.

    Args:
        timed: Of each method its rounds of ``time_stages``.

    Returns:
        At least 1; for nine of ten methods the medians of any two rounds are as near as that.
    """
    medians = [[_image_median(one) for one in rounds] for rounds in timed]
    ratios = [max(of_one) / min(of_one) for of_one in medians if len(of_one) > 1]
    return float(np.percentile(ratios, 90)) if ratios else 1.0


def summarize(rounds: Sequence[Mapping[str, Any]], *, shift: float = 1.0) -> dict[str, Any]:
    """Return the median and the range of what was timed in several rounds.

    Args:
        rounds: Of ``time_stages``, some time apart.
        shift: ``pace_shift``, which widens the ranges, so that they hold what another sitting
            would measure, and not only another run of this one.

    Returns:
        The first round with lower quartile, median and upper quartile for times, the quartiles
        moved apart by ``shift``; ``total_ms``, the same of the sum of all stages of an
        image; and whether each round's median of it lies within what the other rounds
        give (``stable``).
    """
    figures = dict(rounds[0])
    for name, cost in rounds[0].items():
        if cost is not None:
            figures[name] = cost | {"ms": _range(rounds, name, shift).round(4).tolist()}

    def total(rounds: Sequence[Mapping[str, Any]]) -> np.ndarray:
        return np.sum([_range(rounds, name, shift) for name in _stages(rounds[0])], axis=0)

    others = [total([*rounds[:k], *rounds[k + 1 :]] or rounds) for k in range(len(rounds))]
    pairs = zip(rounds, others, strict=True)
    stable = all(bool(low <= _image_median(one) <= high) for one, (low, _, high) in pairs)
    return figures | {"total_ms": total(rounds).round(4).tolist(), "stable": stable}


def _range(rounds: Sequence[Mapping[str, Any]], stage: str, shift: float) -> np.ndarray:
    times = np.concatenate([one[stage]["ms"] for one in rounds])
    return np.percentile(times, [25, 50, 75]) * [1 / shift, 1, shift]


def _stages(figures: Mapping[str, Any]) -> list[str]:
    return [name for name in _OF_IMAGE if figures[name] is not None]


def _image_median(figures: Mapping[str, Any]) -> float:
    return float(sum(np.median(figures[name]["ms"]) for name in _stages(figures)))


def run_times(timed: Timed, runs: int) -> list[float]:
    """Return the times of warm runs, ms; more of a fast program, and fewer of a slow one."""
    warming = _run_time(timed)
    times = [warming] if warming > 1e3 * _SLOW_S else []
    while sum(times) < 1e3 * _MUCH_S:
        if len(times) >= (_MOST if sum(times) < 1e3 * _LITTLE_S else runs):
            break
        times.append(_run_time(timed))
    return times


def _run_time(timed: Timed) -> float:
    start = time.perf_counter()
    timed()
    return 1e3 * (time.perf_counter() - start)
