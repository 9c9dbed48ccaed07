"""Cube maps out of six image files, in OpenGL's order and orientation."""

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from tangentspace.environment import CubeMap

from .map_files import read_color_map

_NAMES = (
    ("px", "nx", "py", "ny", "pz", "nz"),
    ("posx", "negx", "posy", "negy", "posz", "negz"),
    ("right", "left", "top", "bottom", "front", "back"),
)
_SUFFIXES = (".exr", ".png", ".jpg", ".jpeg")

PathLike = str | os.PathLike[str]


def read_cube_map(source: PathLike | Sequence[PathLike]) -> CubeMap:
    """Read an environment, linear RGB: EXR as it is, other images decoded from sRGB.

    Args:
        source: Six files in the order +x -x +y -y +z -z, or the folder that holds them as
            ``px nx py ny pz nz``, ``posx negx posy negy posz negz`` or ``right left top bottom
            front back``, each ``.exr``, ``.png``, ``.jpg`` or ``.jpeg``.

    Returns:
        The cube map, NumPy float32 faces.

    Raises:
        ValueError: If a file is missing, broken, or not square, if sizes differ, or if a
            folder holds a face twice.
    """
    if isinstance(source, str | os.PathLike):
        paths = _faces_in(Path(source))
    else:
        paths = [Path(path) for path in source]
    if len(paths) != 6:
        raise ValueError(
            f"read_cube_map: expected 6 files in the order +x -x +y -y +z -z, got {len(paths)}"
        )
    faces = [read_color_map(path).texels for path in paths]
    for path, face in zip(paths, faces, strict=True):
        height, width = face.shape[:2]
        if height != width:
            raise ValueError(f"{path}: expected a square face, got {width} x {height}; crop it")
        if height != len(faces[0]):
            size = len(faces[0])
            raise ValueError(
                f"{path}: expected a face of {size} x {size} as {paths[0].name}, got"
                f" {width} x {height}; scale it"
            )
    return CubeMap(np.stack(faces))


def _faces_in(folder: Path) -> list[Path]:
    """Return the six files that a folder holds under one of the usual sets of names."""
    if not folder.is_dir():
        raise ValueError(f"{folder}: expected a folder of six faces; there is none, check the name")
    found = [[_files_called(folder, name) for name in names] for names in _NAMES]
    best = max(found, key=lambda files: sum(map(bool, files)))
    names = _NAMES[found.index(best)]
    missing = [name for name, files in zip(names, best, strict=True) if not files]
    if missing:
        suffixes = ", ".join(_SUFFIXES)
        raise ValueError(
            f"{folder}: no image of {', '.join(missing)}; expected {' '.join(names)}, each"
            f" ending in one of {suffixes}"
        )
    for files in best:
        if len(files) > 1:
            both = " and ".join(file.name for file in files)
            raise ValueError(f"{folder}: holds one face twice, {both}; remove one")
    return [files[0] for files in best]


def _files_called(folder: Path, name: str) -> list[Path]:
    """Return the images in a folder whose name is this, in any case."""
    return sorted(
        path
        for path in folder.iterdir()
        if path.stem.lower() == name and path.suffix.lower() in _SUFFIXES
    )
