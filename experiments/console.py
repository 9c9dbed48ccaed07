"""What the commands say: progress on standard error, results on standard output."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

from rich import box
from rich.console import Console
from rich.table import Table

_out = Console(highlight=False, soft_wrap=True)
_err = Console(stderr=True, highlight=False, soft_wrap=True)


@contextmanager
def stage(name: str) -> Iterator[Callable[[str], None]]:
    """Show what goes on while it does: a live line on a terminal, a plain one elsewhere.

    Yields:
        A function that adds how far it is.
    """
    if not _err.is_terminal:
        _err.print(f"{name} ...", markup=False)
        yield lambda text: None
        return
    with _err.status(name) as status:
        yield lambda text: status.update(f"{name}: {text}")


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
    """Print a table on standard output; all columns but the first are numbers."""
    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, pad_edge=False)
    for index, name in enumerate(header):
        table.add_column(name, justify="right" if index else "left", no_wrap=True)
    for row in rows:
        table.add_row(*row)
    _out.print(table)
