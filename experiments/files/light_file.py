"""Distant lights in a text file, as photometric-stereo data sets list them."""

from pathlib import Path

import numpy as np

from shadows.lights import DirectionalLight


def read_lights(path: Path) -> tuple[DirectionalLight, ...]:
    """Read one light a line: ``x y z`` towards it, world space, and ``r g b`` if not white.

    Args:
        path: Text; empty lines and what follows ``#`` do not count.

    Raises:
        ValueError: If the file cannot be read, or a line is no light.
    """
    try:
        lines = path.read_text("utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: cannot be read ({error}); give a text file") from error
    lights = []
    for number, line in enumerate(lines, 1):
        words = line.partition("#")[0].replace(",", " ").split()
        if not words:
            continue
        try:
            values = np.array([float(word) for word in words], np.float32)
        except ValueError:
            values = np.full(1, np.nan)
        if len(values) not in (3, 6) or not np.isfinite(values).all():
            raise ValueError(
                f"{path}: line {number}: expected x y z or x y z r g b, got '{line.strip()}'"
            )
        length = np.linalg.norm(values[:3])
        if length == 0 or (values[3:] < 0).any():
            raise ValueError(
                f"{path}: line {number}: expected a direction that is not zero and a color that "
                f"is not negative, got '{line.strip()}'"
            )
        color = values[3:] if len(values) == 6 else np.ones(3, np.float32)
        lights.append(DirectionalLight(values[:3] / length, color))
    if not lights:
        raise ValueError(f"{path}: holds no light; write one a line as x y z")
    return tuple(lights)
