"""Techniques by name: ``constant=0.02 slope slope.factor=1.5`` becomes objects.

Every class that derives from a base of ``shadows`` (``Bias``, ``Filter``, ``Compare``) is
found by its name, ``NormalOffsetBias`` as ``normal-offset``, so a new class needs no entry
anywhere. A word is NAME, NAME=VALUE (the class's first number) or NAME.OPTION=VALUE.
"""

import dataclasses
import difflib
import inspect
import math
import re
from collections.abc import Iterable, Iterator, Sequence
from typing import TypeVar

import equinox as eqx
import numpy as np

Technique = TypeVar("Technique", bound=eqx.Module)
_LARGEST = float(np.finfo(np.float32).max)


def techniques(base: type[Technique]) -> dict[str, type[Technique]]:
    """Return the concrete classes under ``base`` whose fields are all numbers with a unit."""
    found = {}
    for cls in _descendants(base):
        fields = dataclasses.fields(cls)
        if not inspect.isabstract(cls) and all("unit" in field.metadata for field in fields):
            found[technique_name(cls)] = cls
    return found


def technique_name(cls: type) -> str:
    """Return ``normal-offset`` for ``NormalOffsetBias``."""
    words = re.findall(r"[A-Z][a-z0-9]*", cls.__name__)
    return "-".join(words[:-1]).lower()


def numbers(technique: eqx.Module) -> dict[str, tuple[float, str]]:
    """Return each number of a technique with its unit, by its name, ``slope.factor``."""
    name = technique_name(type(technique))
    return {
        f"{name}.{field.name}": (float(getattr(technique, field.name)), field.metadata["unit"])
        for field in dataclasses.fields(technique)
    }


def describe(base: type[eqx.Module]) -> list[str]:
    """Return one line a technique: its name, its numbers with units, what it does."""
    lines = []
    for name, cls in techniques(base).items():
        fields = dataclasses.fields(cls)
        options = ", ".join(f"{f.name}, default {f.default} {f.metadata['unit']}" for f in fields)
        summary = (cls.__doc__ or "").splitlines()[0].rstrip(".")
        lines.append(f"{name}{f' ({options})' if options else ''}: {summary}")
    return lines


def parse_techniques(
    base: type[Technique], words: Sequence[str], *, option: str, least: float = -math.inf
) -> tuple[Technique, ...]:
    """Make techniques from words, in the order in which they are first named.

    Args:
        base: Where to look for classes.
        words: NAME, NAME=VALUE or NAME.FIELD=VALUE.
        option: Name of the command-line option, for error texts.
        least: The least value that a number may have.

    Raises:
        ValueError: If a name, an option of it or a value is not understood.
    """
    known = techniques(base)
    chosen: dict[str, dict[str, float]] = {}
    for word in words:
        head, has_value, text = word.partition("=")
        name, has_field, field = head.partition(".")
        if name not in known:
            raise ValueError(f"{option} {word}: no such technique '{name}'; {hint(name, known)}")
        fields = [f.name for f in dataclasses.fields(known[name])]
        values = chosen.setdefault(name, {})
        if not has_value and not has_field:
            continue
        field = field if has_field else next(iter(fields), "")
        if field not in fields:
            raise ValueError(f"{option} {word}: '{name}' has no such number; {hint(field, fields)}")
        values[field] = _number(option, word, text, least)
    return tuple(known[name](**values) for name, values in chosen.items())


def parse_technique(
    base: type[Technique], word: str, *, option: str, least: float = -math.inf
) -> Technique:
    """Make the one technique that a word names; see ``parse_techniques``."""
    return parse_techniques(base, [word], option=option, least=least)[0]


def hint(name: str, known: Iterable[str]) -> str:
    """Return the end of an error text: the name that is probably meant, or all names."""
    known = list(known)
    close = difflib.get_close_matches(name, known, n=1)
    return f"did you mean '{close[0]}'?" if close else f"choose from: {', '.join(known) or 'none'}"


def _number(option: str, word: str, text: str, least: float) -> float:
    try:
        value = float(text)
    except ValueError:
        raise ValueError(f"{option} {word}: expected a number after '=', got '{text}'") from None
    if not abs(value) <= _LARGEST:
        raise ValueError(f"{option} {word}: expected a finite number, got {text}")
    if value < least:
        raise ValueError(f"{option} {word}: expected a number of at least {least:g}, got {text}")
    return value


def _descendants(cls: type[Technique]) -> Iterator[type[Technique]]:
    for child in cls.__subclasses__():
        yield child
        yield from _descendants(child)
