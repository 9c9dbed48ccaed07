"""Measuring what is not on disk yet: here, or on the workers of a cluster."""

import functools
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from typing import Any, NamedTuple, Protocol, runtime_checkable

from .programs import Programs
from .store import Key, Store
from .view import View, load_view

ACCURACY = "accuracy"
TIMINGS = ("timing", "timing again")  # rounds, so that what is not steady is seen
_PROGRAMS = Programs()
_TIMING, _LOADING = threading.Lock(), threading.Lock()
_THREADS = 2  # for accuracies, most of whose time goes into compiling


@runtime_checkable
class Contender(Protocol):
    """What is measured on a scene: an immutable value, the same in every process."""

    @property
    def kind(self) -> str:
        """``shadow``, ``shading`` or ``peer``."""
        ...

    @property
    def technique(self) -> str:
        """Its family, as in legends."""
        ...

    @property
    def label(self) -> str:
        """Its family and numbers."""
        ...

    @property
    def name(self) -> str:
        """Tells it from all others of a scene."""
        ...

    @property
    def map_size(self) -> int | None:
        """Texels on each side of its shadow map, if it has one."""
        ...

    def applies(self, view: View) -> bool:
        """Whether it is for a view."""
        ...

    def accuracy(self, view: View, programs: Programs) -> tuple[dict[str, Any], bytes]:
        """Return figures that are the same in every run, and the picture as WebP."""
        ...

    def timing(self, view: View, programs: Programs, *, runs: int) -> dict[str, Any]:
        """Return a round of what it costs: ``stages`` of ``time_stages``, and ``kept_bytes``."""
        ...


class Cell(NamedTuple):
    """One measurement.

    Attributes:
        what: ``ACCURACY`` or one of ``TIMINGS``.
        scene: Name or file.
        contender: What is measured.
        image_size: Pixels on each side of the image.
        runs: Of each program, for timings.
    """

    what: str
    scene: str
    contender: Contender
    image_size: int
    runs: int

    @property
    def key(self) -> Key:
        """What it is stored under."""
        return Key(self.what, self.scene, self.contender.name, self.image_size)


Measured = tuple[dict[str, Any], bytes | None]


def measure(cell: Cell) -> Measured:
    """Measure a cell in this process: its figures, and its picture where there is one.

    Accuracies may be measured side by side; timings wait for each other. Figures of a contender
    that is not for the scene are empty.
    """
    with _LOADING:
        view = _view(cell.scene, cell.image_size)
    if not cell.contender.applies(view):
        return {}, None
    if cell.what == ACCURACY:
        return cell.contender.accuracy(view, _PROGRAMS)
    with _TIMING:
        return cell.contender.timing(view, _PROGRAMS, runs=cell.runs), None


@functools.lru_cache(maxsize=2)
def _view(scene: str, image_size: int) -> View:
    return load_view(scene, image_size)


def measure_here(cells: Iterable[Cell]) -> Iterator[tuple[Cell, Measured]]:
    """Measure scene by scene: all accuracies, two at a time, then each round of timings alone."""
    cells = list(cells)
    for scene in dict.fromkeys(cell.scene for cell in cells):
        of_scene = [cell for cell in cells if cell.scene == scene]
        accuracies = [cell for cell in of_scene if cell.what == ACCURACY]
        with ThreadPoolExecutor(_THREADS) as pool:
            futures = {pool.submit(measure, cell): cell for cell in accuracies}
            try:
                for future in as_completed(futures):
                    yield futures[future], future.result()
            finally:
                pool.shutdown(cancel_futures=True)
        for what in TIMINGS:
            for cell in of_scene:
                if cell.what == what:
                    yield cell, measure(cell)


def run(
    cells: Sequence[Cell],
    store: Store,
    *,
    measured: Callable[[Iterable[Cell]], Iterator[tuple[Cell, Measured]]] = measure_here,
    tell: Callable[[str], None] = lambda text: None,
) -> None:
    """Measure what the store does not hold, and store each as it is made.

    Args:
        cells: What is wanted.
        store: Where it goes.
        measured: Yields cells as they are done, in any order.
        tell: Is told how far it is.
    """
    todo = [cell for cell in cells if store.get(cell.key) is None]
    start = time.perf_counter()
    tell(f"0 of {len(todo)}")
    for done, (cell, (figures, picture)) in enumerate(measured(todo), 1):
        store.put(cell.key, figures, picture)
        left = (time.perf_counter() - start) / done * (len(todo) - done)
        tell(f"{done} of {len(todo)}, {left:.0f} s left: {cell.scene}, {cell.contender.name}")
