"""What the filters that blur beforehand answer, from the definition: slow, NumPy, float64.

No moments are blurred here: the weight of every texel in a lookup is written out, and the
bound is computed from the distribution of depths that the weights make.
"""

import numpy as np

from shadows import EVSM2Filter, EVSM4Filter, MSMFilter, VSMFilter

TARGET = np.array([0, 0.375, 0, 0.375])  # moments of the depth in [-1, 1]


def lit_reference(filter, depths, weights, z):
    """Share lit at depth ``z``; depths in [0, 1], weights that sum to 1."""
    depths, weights = np.asarray(depths, float), np.asarray(weights, float)
    if isinstance(filter, VSMFilter):
        bound = cantelli(depths, weights, z, float(filter.min_variance))
        return np.clip((bound - filter.bleeding) / (1 - filter.bleeding), 0, 1)
    if isinstance(filter, EVSM2Filter):
        bound = warped_bound(depths, weights, z, float(filter.exponent), filter)
        if isinstance(filter, EVSM4Filter):
            second = warped_bound(depths, weights, z, -float(filter.negative_exponent), filter)
            bound = min(bound, second)
        return bound
    if isinstance(filter, MSMFilter):
        moments = np.array([weights @ (2 * depths - 1) ** j for j in range(1, 5)])
        moments += float(filter.moment_bias) * (TARGET - moments)
        return 1 - hamburger(moments, 2 * z - 1)
    return min(1.0, weights @ np.exp(float(filter.exponent) * (depths - z)))


def cantelli(values, weights, z, least):
    mean = weights @ values
    variance = max(weights @ (values - mean) ** 2, least)
    return 1.0 if z <= mean else variance / (variance + (z - mean) ** 2)


def warped_bound(depths, weights, z, exponent, filter):
    warp = lambda depth: np.sign(exponent) * np.exp(exponent * (2 * depth - 1))
    slope = 2 * abs(exponent) * abs(warp(z))
    return cantelli(warp(depths), weights, warp(z), float(filter.min_variance) * slope**2)


def hamburger(moments, z):
    """Least shadow of four moments, by the algorithm as it was published."""
    b1, b2, b3, b4 = moments
    matrix = np.array([[1, b1, b2], [b1, b2, b3], [b2, b3, b4]])
    low, high = np.sort(np.roots(np.linalg.solve(matrix, [1, z, z**2])[::-1]).real)
    if z <= low:
        return 0.0
    if z <= high:
        return (z * high - b1 * (z + high) + b2) / ((high - low) * (z - low))
    return 1 - (low * high - b1 * (low + high) + b2) / ((z - low) * (z - high))


def kernel_reference(radius, blur):
    """Weights of a row of texels: one box, or four of nearly the same width in turn."""
    if blur == "box":
        return np.full(2 * radius + 1, 1 / (2 * radius + 1))
    weights = np.ones(1)
    for k in range(4):
        width = 1 + 2 * radius // 4 + (k < 2 * radius % 4)
        weights = np.convolve(weights, np.full(width, 1 / width))
    return weights


def axis_weights(place, size, filter, level):
    """Weight of each texel of an axis in a lookup at a level."""
    kernel, radius = kernel_reference(filter.radius, filter.blur), filter.radius
    count = size // 2**level
    position = np.clip(place / 2**level - 0.5, 0, count - 1)
    weights = np.zeros(size)
    for coarse in range(count):
        near = max(0.0, 1 - abs(position - coarse))
        for fine in range(coarse * 2**level, (coarse + 1) * 2**level):
            for k in range(-radius, radius + 1):
                weights[np.clip(fine + k, 0, size - 1)] += near * kernel[radius + k] / 2**level
    return weights


def lookup_reference(filter, image, column, row, z):
    """Visibility at a place of a map of depths in [0, 1], for a receiver at such a depth."""
    height, width = image.shape
    finer = min(int(filter.level), max(filter.mips - 1, 0))
    weights = 0
    for level, share in ((finer, 1 + finer - filter.level), (finer + 1, filter.level - finer)):
        if share:
            down = axis_weights(row, height, filter, level)
            weights = weights + share * np.outer(down, axis_weights(column, width, filter, level))
    lit = lit_reference(filter, image.ravel(), np.ravel(weights), z)
    inside = 1.0
    for place, size in ((column, width), (row, height)):
        texels = np.arange(size) + 0.5
        inside *= np.maximum(0, 1 - np.abs(place - texels)).sum()
    return 1 - inside * (1 - lit)


def linear_reference(depth, clip_from_world):
    """Share of the way between the ends of a map: w of the point unprojected, for each depth."""
    inverse = np.linalg.inv(clip_from_world)
    w = lambda ndc: 1 / (inverse @ [0.1, -0.2, ndc, 1])[3]
    near, far = w(-1.0), w(1.0)
    if abs(far - near) < 1e-12:
        return depth
    return np.vectorize(lambda t: (w(2 * t - 1) - near) / (far - near))(depth)
