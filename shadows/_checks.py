"""Checks of the numbers that a technique or a light is made with."""

from collections.abc import Callable

import numpy as np


def check_field(
    instance: object,
    field: str,
    expected: str,
    holds: Callable[[float], bool],
    *,
    whole: bool = False,
) -> None:
    """Refuse an illegal number; numbers inside a traced program pass.

    Args:
        instance: What has the field.
        field: Its name.
        expected: What was expected of it, in words that follow its name.
        holds: Whether a number is legal.
        whole: Whether only whole numbers are, which are never traced.

    Raises:
        ValueError: If the number is illegal.
    """
    value = getattr(instance, field)
    if whole:
        legal = isinstance(value, int) and not isinstance(value, bool) and holds(value)
    else:
        legal = not isinstance(value, int | float | np.ndarray | np.number) or holds(float(value))
    if not legal:
        raise ValueError(f"{type(instance).__name__}: expected `{field}` {expected}, got {value}")
