"""Slow oracles for texture lookup in NumPy float64, written from OpenGL 4.6, section 8.14.

Coordinates are handled one point at a time. OpenGL's row 0 is at the bottom, at v = 0.
"""

import math

import numpy as np


def wrap_reference(mode: str, index: int, size: int) -> int:
    """Table 8.20 of the specification."""
    if mode == "repeat":
        return index - size * math.floor(index / size)
    if mode == "clamp":
        return min(max(index, 0), size - 1)
    position = index - 2 * size * math.floor(index / (2 * size)) - size
    return size - 1 - (position if position >= 0 else -(1 + position))


def texel_reference(texels: np.ndarray, i: int, j: int, modes: tuple[str, str]) -> np.ndarray:
    """Return texel (i, j), j counted upwards from the lowest row."""
    height, width = texels.shape[:2]
    column, up = wrap_reference(modes[0], i, width), wrap_reference(modes[1], j, height)
    return texels[height - 1 - up, column].astype(np.float64)


def nearest_reference(texels: np.ndarray, uvs: np.ndarray, modes: tuple[str, str]) -> np.ndarray:
    """Return the texel that holds each point; ``uvs`` is (points, 2)."""
    height, width = texels.shape[:2]
    places = [(math.floor(float(u) * width), math.floor(float(v) * height)) for u, v in uvs]
    return np.array([texel_reference(texels, i, j, modes) for i, j in places])


def bilinear_reference(texels: np.ndarray, uvs: np.ndarray, modes: tuple[str, str]) -> np.ndarray:
    """Equation 8.21 of the specification."""
    height, width = texels.shape[:2]
    result = []
    for u, v in np.asarray(uvs, np.float64):
        x, y = u * width - 0.5, v * height - 0.5
        i, j = math.floor(x), math.floor(y)
        a, b = x - i, y - j
        result.append(
            (1 - a) * (1 - b) * texel_reference(texels, i, j, modes)
            + a * (1 - b) * texel_reference(texels, i + 1, j, modes)
            + (1 - a) * b * texel_reference(texels, i, j + 1, modes)
            + a * b * texel_reference(texels, i + 1, j + 1, modes)
        )
    return np.array(result)


def mips_reference(texels: np.ndarray) -> list[np.ndarray]:
    """Return all levels: means over areas, by the overlap of every texel with every other."""
    levels = [np.asarray(texels, np.float64)]
    while levels[-1].shape[:2] != (1, 1):
        height, width = levels[-1].shape[:2]
        down, across = overlaps(height, max(height // 2, 1)), overlaps(width, max(width // 2, 1))
        levels.append(np.einsum("ah,bw,hwc->abc", down, across, levels[-1]))
    return levels


def overlaps(count: int, fewer: int) -> np.ndarray:
    """Return what share of each of few equal intervals lies in each of many: (few, many)."""
    shares = np.zeros((fewer, count))
    for new in range(fewer):
        for old in range(count):
            low = max(new / fewer, old / count)
            high = min((new + 1) / fewer, (old + 1) / count)
            shares[new, old] = max(high - low, 0) * fewer
    return shares


def trilinear_reference(
    texels: np.ndarray,
    uvs: np.ndarray,
    uv_dx: np.ndarray,
    uv_dy: np.ndarray,
    modes: tuple[str, str],
) -> np.ndarray:
    """Equations 8.7, 8.8 and 8.22 of the specification."""
    levels = mips_reference(texels)
    size = np.array(texels.shape[1::-1])
    result = []
    for uv, dx, dy in zip(uvs, uv_dx, uv_dy, strict=True):
        rho = max(math.hypot(*(dx * size)), math.hypot(*(dy * size)))
        level = min(max(math.log2(rho) if rho > 0 else 0.0, 0.0), len(levels) - 1)
        finer, share = math.floor(level), level - math.floor(level)
        coarser = min(finer + 1, len(levels) - 1)
        values = [bilinear_reference(levels[k], uv[None], modes)[0] for k in (finer, coarser)]
        result.append((1 - share) * values[0] + share * values[1])
    return np.array(result)
