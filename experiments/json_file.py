"""Settings and figures of a run, as JSON."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from .files.images import atomic_path


def check_settings(path: Path, settings: Mapping[str, Any]) -> None:
    """Refuse to go on with a fit of other settings."""
    try:
        stored = read_json(path)
    except ValueError as error:
        raise ValueError(f"--resume: {error}; start anew") from error
    other = [name for name, value in settings.items() if stored.get(name) != value]
    if other:
        raise ValueError(
            f"--resume: the stopped fit had other settings ({', '.join(other)}); "
            f"give the same ones, or start anew"
        )


def write_json(path: Path, content: Mapping[str, Any] | Sequence[Any]) -> None:
    """Write a file, or nothing."""
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(content, indent=2) + "\n", "utf-8")


def read_json(path: Path) -> Any:
    """Read a file.

    Raises:
        ValueError: If it is none.
    """
    try:
        return json.loads(path.read_text("utf-8"))
    except (OSError, ValueError) as error:
        raise ValueError(f"{path}: cannot be read ({error})") from error
