"""Techniques by name: ``constant=0.02 slope slope.factor=1.5`` becomes objects.

Every class that derives from a base of ``shadows`` (``Bias``, ``Filter``, ``Compare``) is
found by its name, ``NormalOffsetBias`` as ``normal-offset`` and ``PCFFilter`` as ``pcf``, so
a new class needs no entry anywhere. A word is NAME, NAME=VALUE (the class's first option),
NAME.OPTION=VALUE, or .OPTION=VALUE for the technique named before; on the command line
``--filter.radius 2`` is the word ``.radius=2`` of ``--filter``.
"""

import dataclasses
import difflib
import importlib
import inspect
import math
import pkgutil
import re
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, TypeVar

import equinox as eqx
import numpy as np

import shadows

Technique = TypeVar("Technique", bound=eqx.Module)
_LARGEST = float(np.finfo(np.float32).max)
_KINDS = ("unit", "whole", "choices")  # a number that can be fitted, a whole one, a word


def techniques(base: type[Technique]) -> dict[str, type[Technique]]:
    """Return the concrete classes under ``base`` whose fields can all be given in words."""
    for module in pkgutil.iter_modules(shadows.__path__, "shadows."):
        importlib.import_module(module.name)
    found = {}
    for cls in _descendants(base):
        fields = dataclasses.fields(cls)
        spoken = all(any(kind in field.metadata for kind in _KINDS) for field in fields)
        if not inspect.isabstract(cls) and spoken:
            found[technique_name(cls)] = cls
    return found


def technique_name(cls: type) -> str:
    """Return ``normal-offset`` for ``NormalOffsetBias``, ``pcf`` for ``PCFFilter``."""
    words = re.findall(r"[A-Z]+[0-9]*(?![a-z])|[A-Z][a-z0-9]*", cls.__name__)
    return "-".join(words[:-1]).lower()


def numbers(technique: eqx.Module) -> dict[str, tuple[float, str]]:
    """Return each number of a technique with its unit, by its name, ``slope.factor``."""
    name = technique_name(type(technique))
    return {
        f"{name}.{field.name}": (float(getattr(technique, field.name)), _unit(field, technique))
        for field in dataclasses.fields(technique)
        if "unit" in field.metadata
    }


def _unit(field: dataclasses.Field, technique: Any) -> str:
    unit = field.metadata["unit"]
    return unit if isinstance(unit, str) else unit[technique.unit]


def describe(base: type[eqx.Module]) -> list[str]:
    """Return one line a technique: its name, its options with units, what it does."""
    lines = []
    for name, cls in techniques(base).items():
        options = ", ".join(_option(field, cls) for field in dataclasses.fields(cls))
        summary = (cls.__doc__ or "").splitlines()[0].rstrip(".")
        lines.append(f"{name}{f' ({options})' if options else ''}: {summary}")
    return lines


def _option(field: dataclasses.Field, cls: Any) -> str:
    if "choices" in field.metadata:
        return f"{field.name}, {field.default} of {'/'.join(map(str, field.metadata['choices']))}"
    unit = field.metadata.get("whole") or _unit(field, cls)
    default = field.metadata.get("default", field.default)
    return f"{field.name}, default {default} {unit}"


def parse_techniques(
    base: type[Technique], words: Sequence[str], *, option: str, least: float = -math.inf
) -> tuple[Technique, ...]:
    """Make techniques from words, in the order in which they are first named.

    Args:
        base: Where to look for classes.
        words: NAME, NAME=VALUE, NAME.FIELD=VALUE or .FIELD=VALUE.
        option: Name of the command-line option, for error texts.
        least: The least value that a number may have.

    Raises:
        ValueError: If a name, an option of it or a value is not understood, or refused by
            the technique.
    """
    known = techniques(base)
    chosen: dict[str, dict[str, Any]] = {}
    last = ""
    for word in words:
        head, has_value, text = word.partition("=")
        name, has_field, field_name = head.partition(".")
        if word.startswith("."):
            name = last
            if not name:
                raise ValueError(f"{option}{head}: of which technique? Name one with {option}")
        if name not in known:
            raise ValueError(f"{option} {word}: no such technique '{name}'; {hint(name, known)}")
        last = name
        fields = {field.name: field for field in dataclasses.fields(known[name])}
        values = chosen.setdefault(name, {})
        if not has_value and not has_field:
            continue
        field_name = field_name if has_field else next(iter(fields), "")
        if field_name not in fields:
            raise ValueError(
                f"{option} {word}: '{name}' has no such option; {hint(field_name, fields)}"
            )
        values[field_name] = _value(fields[field_name], option, word, text, least)
    made = []
    for name, values in chosen.items():
        try:
            made.append(known[name](**values))
        except ValueError as error:
            raise ValueError(f"{option} {name}: {error}") from error
    return tuple(made)


def parse_technique(
    base: type[Technique], words: Sequence[str], *, option: str, least: float = -math.inf
) -> Technique:
    """Make the one technique that words name; see ``parse_techniques``.

    Raises:
        ValueError: If they name none, or several, or are not understood.
    """
    made = parse_techniques(base, words, option=option, least=least)
    if len(made) != 1:
        raise ValueError(f"{option}: expected one technique, got {len(made)}; name one")
    return made[0]


def join_options(arguments: Sequence[str], options: Iterable[str]) -> list[str]:
    """Turn ``--filter.radius 2`` into the word ``.radius=2`` at the end of ``--filter``'s.

    Args:
        arguments: Of the command line.
        options: The options that take words, as ``--filter``.
    """
    rest, added = [], {option: [] for option in options}
    queue = list(arguments)
    while queue:
        argument = queue.pop(0)
        head, has_value, text = argument.partition("=")
        option, has_field, _ = head.partition(".")
        if not has_field or option not in added:
            rest.append(argument)
            continue
        if not has_value:
            text = queue.pop(0) if queue and not queue[0].startswith("--") else ""
        added[option].append(f"{head.removeprefix(option)}={text}")
    for option, words in added.items():
        if not words:
            continue
        if option not in rest:
            rest.append(option)
        end = rest.index(option) + 1
        while end < len(rest) and not rest[end].startswith("--"):
            end += 1
        rest[end:end] = words
    return rest


def hint(name: str, known: Iterable[str]) -> str:
    """Return the end of an error text: the name that is probably meant, or all names."""
    known = list(known)
    close = difflib.get_close_matches(name, known, n=1)
    return f"did you mean '{close[0]}'?" if close else f"choose from: {', '.join(known) or 'none'}"


def _value(field: dataclasses.Field, option: str, word: str, text: str, least: float) -> Any:
    """Return what a word gives to a field: one of its choices, a whole number or a number."""
    if "choices" in field.metadata:
        choices = field.metadata["choices"]
        if text not in choices:
            raise ValueError(f"{option} {word}: expected {' or '.join(choices)}, got '{text}'")
        return text
    number = _number(option, word, text, least)
    if "whole" in field.metadata:
        if number != round(number):
            raise ValueError(f"{option} {word}: expected a whole number, got {text}")
        return round(number)
    return number


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
