"""Measurements on disk, a file each, so that a run may be stopped anywhere and goes on later.

A file is written under another name and renamed when it is whole: what is there is right. One
that was damaged afterwards is set aside, and measured again.
"""

import hashlib
import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from ..console import say_notes
from ..files.images import atomic_path

FORMAT = 3  # of the files; another means a folder that this version cannot go on with


class Key(NamedTuple):
    """What was measured.

    Attributes:
        kind: ``accuracy``, which is the same in every run, or a round of timing.
        scene: Name or file.
        method: ``Method.name``.
        image_size: Pixels on each side of the image.
    """

    kind: str
    scene: str
    method: str
    image_size: int


class Store:
    """A folder of measurements."""

    def __init__(self, folder: Path) -> None:
        """Open a folder, or begin one.

        Raises:
            ValueError: If another version of this program made it.
        """
        self._cells = folder / "cells"
        self._cells.mkdir(parents=True, exist_ok=True)
        mark = self._cells / "format.json"
        if not mark.exists():
            _write(mark, {"format": FORMAT})
        found = (_read(mark) or {}).get("format")
        if found != FORMAT:
            raise ValueError(
                f"{folder}: results of format {found}, expected {FORMAT}; choose another folder"
            )

    def get(self, key: Key) -> dict[str, Any] | None:
        """Return what was measured, or None; a damaged file is set aside with a word."""
        path = self._path(key)
        if not path.exists():
            return None
        content = _read(path)
        if content is not None and content.get("key") == list(key) and "figures" in content:
            return content["figures"]
        aside = path.with_suffix(".damaged")
        path.replace(aside)
        say_notes([f"{path}: damaged; set aside as {aside.name} and measured again"])
        return None

    def put(self, key: Key, figures: Mapping[str, Any], picture: bytes | None = None) -> None:
        """Keep a measurement, and the picture that was made with it."""
        path = self._path(key)
        path.parent.mkdir(parents=True, exist_ok=True)
        if picture is not None:
            with atomic_path(path.with_suffix(".webp")) as temporary:
                temporary.write_bytes(picture)
        _write(path, {"key": list(key), "figures": dict(figures)})

    def picture(self, key: Key) -> bytes | None:
        """Return the picture of a measurement, or None."""
        path = self._path(key).with_suffix(".webp")
        return path.read_bytes() if path.exists() else None

    def _path(self, key: Key) -> Path:
        plain = re.sub(r"[^a-z0-9]+", "-", " ".join(map(str, key[1:])).lower()).strip("-")
        unique = hashlib.sha256(json.dumps(key).encode()).hexdigest()[:8]
        return self._cells / key.kind / f"{plain[-80:]}-{unique}.json"


def _write(path: Path, content: Mapping[str, Any]) -> None:
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(content, indent=1) + "\n", "utf-8")


def _read(path: Path) -> dict[str, Any] | None:
    try:
        content = json.loads(path.read_text("utf-8"))
    except (OSError, ValueError):
        return None
    return content if isinstance(content, dict) else None
