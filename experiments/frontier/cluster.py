"""Measuring on a Dask cluster: accuracies in parallel, then timings, one in a worker at a time.

A worker that dies takes no finished measurement with it, as each goes to this process's store;
what it was at is measured by another.
"""

from collections.abc import Iterable, Iterator
from typing import Any

from .run import ACCURACY, TIMINGS, Cell, Measured, measure

_PATIENCE_S = 10


def connect(address: str) -> Any:
    """Return a client of a scheduler.

    Raises:
        ValueError: If Dask is missing, or no scheduler answers.
    """
    try:
        import distributed
    except ImportError as error:
        raise ValueError(
            "--scheduler: needs Dask; install it with pip install 'tangentspace[cluster]'"
        ) from error
    try:
        return distributed.Client(address, timeout=_PATIENCE_S, set_as_default=False)
    except (OSError, TimeoutError, ValueError) as error:
        raise ValueError(
            f"--scheduler: no scheduler answers at {address!r} within {_PATIENCE_S} s; is "
            "`dask scheduler` running there?"
        ) from error


def measure_on(client: Any, cells: Iterable[Cell]) -> Iterator[tuple[Cell, Measured]]:
    """Yield cells as workers finish them.

    Raises:
        ValueError: If there is no worker.
    """
    import distributed

    if not client.scheduler_info()["workers"]:
        raise ValueError("--scheduler: has no workers; start some with `dask worker ADDRESS`")
    cells = list(cells)
    for what in (ACCURACY, *TIMINGS):
        futures = {
            client.submit(measure, cell, pure=False): cell for cell in cells if cell.what == what
        }
        for future in distributed.as_completed(futures, loop=client.loop):
            yield futures.pop(future), future.result()
            future.release()
