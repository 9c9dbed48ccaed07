"""Materials of Wavefront OBJ files: colors, normal and bump maps, displacement.

Read are ``Kd``, ``map_Kd``, ``norm``, ``map_Bump`` or ``bump``, and ``disp``, with the
options ``-bm``, ``-mm`` and ``-clamp``. A bump map that is mainly blue is taken for the
normal map that many exporters write there, any other for heights, in widths of its texels:
the format names no unit. Coefficients of the format's own shading (``Ka``, ``Ks``, ``Ns``,
``illum`` and the like) are passed over, since experiments choose theirs; what else is
passed over is noted.
"""

import functools
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

from tangentspace.texture import Texture, clamp, repeat

from ..scene import Material
from .map_files import bump_map, color_map, height_map
from .mesh_build import PLAIN
from .normal_texels import is_bluish, normal_map
from .texture_file import read_pixels

_ALIASES = {"bump": "map_bump", "map_disp": "disp", "map_norm": "norm"}
_SHADING = {"ka", "ks", "ke", "ns", "ni", "tf", "illum", "sharpness", "map_aat"}
_OPAQUE = {"d": 1.0, "tr": 0.0}
_WORDS_AFTER = {"-mm": 2, "-o": 3, "-s": 3, "-t": 3}  # after other options: one
_OPTIONS = {"-bm", "-mm", "-clamp"}


class MtlMaterial(NamedTuple):
    """A material's statements.

    Attributes:
        library: The file that holds them.
        statements: What follows each key word (lower case), the last where it stands twice.
    """

    library: Path
    statements: dict[str, str]


class _Map(NamedTuple):
    """An image, and the factor on its bumps, None for 1."""

    texture: Texture
    factor: float | None


_ReadMap = Callable[[Path, str, str], _Map | None]


def read_mtl(path: Path) -> dict[str, MtlMaterial]:
    """Return a library's materials by name; their maps are not yet read."""
    materials: dict[str, MtlMaterial] = {}
    statements: dict[str, str] = {}
    for line in path.read_text("utf-8", "replace").replace("\\\n", " ").splitlines():
        key, rest = (*line.split(maxsplit=1), "", "")[:2]
        if key == "newmtl":
            statements = {}
            materials[rest.strip()] = MtlMaterial(path, statements)
        elif key and not key.startswith("#"):
            statements[_ALIASES.get(key.lower(), key.lower())] = rest.strip()
    return materials


def load_materials(
    used: Sequence[MtlMaterial | None],
) -> tuple[tuple[Material, ...], tuple[str, ...]]:
    """Read the maps of materials and return what the scene's types hold of them.

    Args:
        used: The materials; plain gray where None.

    Returns:
        The materials, and notes on what is missing or passed over. A map that several
        materials name in the same words is read once.

    Raises:
        ValueError: If a number is none, or an image is broken or unfit for its use.
    """
    notes: list[str] = []
    passed_over: list[str] = []
    read_map = functools.cache(
        lambda library, key, statement: _read_map(library, key, statement, notes)
    )
    materials = tuple(
        PLAIN if source is None else _material(source, read_map, passed_over) for source in used
    )
    if passed_over:
        count = f"{len(passed_over)} material statement{'s' if len(passed_over) > 1 else ''}"
        notes.append(f"{count} passed over: {', '.join(sorted(set(passed_over)))}")
    return materials, tuple(notes)


def _material(source: MtlMaterial, read_map: _ReadMap, passed_over: list[str]) -> Material:
    """Return one material; add to what is passed over."""
    library, statements = source
    rest = {key: text for key, text in statements.items() if key not in _SHADING}
    for key, opaque in _OPAQUE.items():
        if key in rest and _numbers(rest[key].split()[-1:], 1, library) == [opaque]:
            del rest[key]
    base_color = None
    if "kd" in rest and rest["kd"].split()[:1] not in (["spectral"], ["xyz"]):
        words = rest.pop("kd").split()
        red, green, blue = _numbers(words * (3 if len(words) == 1 else 1), 3, library)
        base_color = None if red == green == blue == 1 else (red, green, blue)
    surface = "norm" if "norm" in rest else "map_bump"
    color, normal, height = (
        read_map(library, key, rest.pop(key)) if key in rest else None
        for key in ("map_kd", surface, "disp")
    )
    passed_over += rest
    return Material(
        base_color=base_color,
        base_color_texture=color and color.texture,
        normal_texture=normal and normal.texture,
        normal_scale=normal and normal.factor,
        height_texture=height and height.texture,
    )


def _read_map(library: Path, key: str, statement: str, notes: list[str]) -> _Map | None:
    """Read the image that a statement names, or note that it is missing; add to notes."""
    options, name = _split_options(statement)
    image = library.parent / name.replace("\\", "/")
    label = f"texture {image.name}"
    if not image.is_file():
        instead = "its material's color is used alone" if key == "map_kd" else "used without"
        notes.append(f"{label} not found: {instead}")
        return None
    if ignored := sorted(options.keys() - _OPTIONS):
        notes.append(f"{label}: options {', '.join(ignored)} ignored")
    pixels = read_pixels(image, label)
    wrap = clamp if options.get("-clamp") == ["on"] else repeat
    if key == "map_kd":
        loaded = color_map(pixels, label)
    elif key == "disp":
        base, gain = _numbers(options.get("-mm", ["0", "1"]), 2, library)
        loaded = height_map(pixels, label)
        loaded = loaded._replace(texels=base + gain * loaded.texels)
    elif key == "norm" or is_bluish(pixels.texels):
        loaded = normal_map(pixels, label)
    else:
        loaded = bump_map(pixels, label, wrap_u=wrap, wrap_v=wrap)
    notes += loaded.notes
    factor = _numbers(options["-bm"], 1, library)[0] if "-bm" in options else None
    return _Map(Texture(loaded.texels, wrap, wrap), factor)


def _split_options(statement: str) -> tuple[dict[str, list[str]], str]:
    """Return the words after each option, and the file's name, which may hold spaces."""
    options: dict[str, list[str]] = {}
    while statement.startswith("-"):
        option, *words = statement.split()
        most = _WORDS_AFTER.get(option, 1)
        count = most
        if most == 3:  # one to three numbers
            count = next((i for i, word in enumerate(words[:3]) if not _is_number(word)), 3)
        options[option] = words[:count]
        statement = statement.split(maxsplit=count + 1)[count + 1] if len(words) > count else ""
    return options, statement


def _numbers(words: Sequence[str], count: int, library: Path) -> list[float]:
    """Return so many finite numbers, or raise if the words are others."""
    numbers = [float(word) for word in words if _is_number(word)]
    if len(numbers) != count or len(words) != count:
        expected = f"expected {count} number{'s' if count > 1 else ''}"
        raise ValueError(f"material file {library.name}: {expected}, got '{' '.join(words)}'")
    return numbers


def _is_number(word: str) -> bool:
    try:
        return math.isfinite(float(word))
    except ValueError:
        return False
