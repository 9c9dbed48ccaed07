"""The one comparison that tests use."""

import numpy as np
from numpy.typing import ArrayLike


def assert_close(actual: ArrayLike, expected: ArrayLike, *, ulps: float = 64) -> None:
    """Assert that two arrays agree to ``ulps * eps * max(1, |expected|)``, element by element.

    ``eps`` belongs to the floating-point type of ``actual``; integers and booleans must be
    equal. Shapes must agree (``expected`` may be one number); NaN never passes.
    """
    actual, expected = np.asarray(actual), np.asarray(expected)
    if expected.ndim:
        assert actual.shape == expected.shape, f"shape {actual.shape}, expected {expected.shape}"
    if not np.issubdtype(actual.dtype, np.floating):
        np.testing.assert_array_equal(actual, expected)
        return
    wide, target = actual.astype(np.float64), expected.astype(np.float64)
    unit = np.finfo(actual.dtype).eps * np.maximum(1.0, np.abs(target))
    with np.errstate(invalid="ignore"):
        measured = np.where(wide == target, 0.0, np.abs(wide - target) / unit)
    measured = np.where(np.isnan(measured), np.inf, measured)
    if measured.size and measured.max() > ulps:
        worst = np.unravel_index(np.argmax(measured), measured.shape)
        target = np.broadcast_to(target, wide.shape)
        raise AssertionError(
            f"measured {measured[worst]:.4g} ulps, allowed {ulps:g} ({actual.dtype}); "
            f"{np.count_nonzero(measured > ulps)} of {measured.size} elements differ, worst at "
            f"{tuple(map(int, worst))}: {wide[worst]!r}, expected {target[worst]!r}"
        )
