"""What the commands say: progress on standard error, results on standard output."""

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table
from rich.text import Text

_out = Console(highlight=False, soft_wrap=True, width=240)  # so that no table is cut
_err = Console(stderr=True, highlight=False, soft_wrap=True)


@contextmanager
def stage(name: str) -> Iterator[Callable[[str], None]]:
    """Show what goes on: a live line on a terminal, and a plain one once it went well.

    Yields:
        A function that adds how far it is.
    """
    start = time.perf_counter()
    with _err.status(escape(name)) as status:
        yield lambda text: status.update(escape(f"{name}: {text}"))
    _err.print(f"{name}: {time.perf_counter() - start:.1f} s", markup=False)


def say(text: str) -> None:
    """Print a line on standard output."""
    _out.print(text, markup=False)


def say_notes(notes: Sequence[str]) -> None:
    """Print what was odd about a scene on standard error."""
    for note in notes:
        _err.print(f"note: {note}", markup=False)


def say_error(text: str) -> None:
    """Print one line on standard error."""
    _err.print(f"error: {text}", markup=False)


def say_table(title: str, header: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Print a table on standard output, never cut; all columns but the first are numbers."""
    table = Table(title=Text(title), title_justify="left", box=box.SIMPLE_HEAD, pad_edge=False)
    for index, name in enumerate(header):
        table.add_column(name, justify="right" if index else "left", no_wrap=True)
    for row in rows:
        table.add_row(*row)
    _out.print(table)
