"""Polygon File Format (PLY): ASCII and binary, with faces of any number of corners.

Written out because trimesh (5.2) refuses binary files that mix triangles and quads, and
takes an ASCII file that is cut short for a whole one.
"""

import struct
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from .mesh_build import Polygons
from .smooth_normals import unique_rows

_CODES = {
    **{"char": "b", "uchar": "B", "short": "h", "ushort": "H", "int": "i", "uint": "I"},
    **{"int8": "b", "uint8": "B", "int16": "h", "uint16": "H", "int32": "i", "uint32": "I"},
    **{"float": "f", "double": "d", "float32": "f", "float64": "d"},
}
_UV_NAMES = (("u", "v"), ("s", "t"), ("texture_u", "texture_v"))


class _Property(NamedTuple):
    """One column: its name, the code of its numbers, and for a list that of its length."""

    name: str
    code: str
    length_code: str | None


class _Column(NamedTuple):
    """A column's numbers, row after row, and how many each row has."""

    values: Float[np.ndarray, " values"]
    sizes: Int[np.ndarray, " rows"]


# Reads so many numbers of one code at an offset; returns them with the offset behind them.
_Take = Callable[[int, int, str], tuple[tuple[int | float, ...], int]]


def read_ply(path: Path) -> Polygons:
    """Read the polygons, with normals and UVs of vertices, or UVs of corners (``texcoord``)."""
    header, end, body = path.read_bytes().partition(b"end_header")
    lines = [line.split() for line in header.decode("ascii", "replace").splitlines()]
    if not lines or lines[0] != ["ply"]:
        raise ValueError("its first line is not `ply`")
    if not end:
        raise ValueError("it ends too early")
    body = body[2:] if body.startswith(b"\r\n") else body[1:]
    elements = _read_elements(_reader_of(lines[1][1], body), lines)
    vertex, face = elements.get("vertex", {}), elements.get("face", {})
    empty = _Column(np.zeros(0), np.zeros(0, np.int64))
    indices = face.get("vertex_indices", face.get("vertex_index", empty))

    positions = _together(vertex, ("x", "y", "z"))
    normals = _together(vertex, ("nx", "ny", "nz"))
    uvs = next((found for names in _UV_NAMES if len(found := _together(vertex, names))), None)
    position = indices.values.astype(np.int64)
    corner_uvs = face.get("texcoord", empty)
    if len(indices.sizes) and np.array_equal(corner_uvs.sizes, 2 * indices.sizes):
        pool = corner_uvs.values.reshape(-1, 2)
        first, uv = unique_rows(pool)
        uvs = pool[first]
    else:
        uv = np.full_like(position, -1) if uvs is None else position
    normal = position if len(normals) else np.full_like(position, -1)
    return Polygons(
        positions=positions,
        sizes=indices.sizes,
        corners=np.stack([position, uv, normal], axis=1),
        uvs=np.zeros((0, 2)) if uvs is None else uvs,
        normals=normals,
        polygon_materials=np.zeros(len(indices.sizes), np.int64),
    )


def _reader_of(encoding: str, body: bytes) -> _Take:
    """Return the function that reads numbers from the body in the header's encoding."""
    if encoding == "ascii":
        words = body.split()

        def take(offset: int, count: int, code: str) -> tuple[tuple[int | float, ...], int]:
            numbers = tuple(float(word) for word in words[offset : offset + count])
            if len(numbers) < count:
                raise ValueError("it ends too early")
            return numbers, offset + count

        return take
    order = {"binary_little_endian": "<", "binary_big_endian": ">"}[encoding]

    def unpack(offset: int, count: int, code: str) -> tuple[tuple[int | float, ...], int]:
        form = f"{order}{count}{code}"
        end = offset + struct.calcsize(form)
        if end > len(body):
            raise ValueError("it ends too early")
        return struct.unpack_from(form, body, offset), end

    return unpack


def _read_elements(take: _Take, header: list[list[str]]) -> dict[str, dict[str, _Column]]:
    """Return the columns of every element the header declares."""
    declared: list[tuple[str, int, list[_Property]]] = []
    for words in header:
        match words:
            case ["element", name, count]:
                declared.append((name, int(count), []))
            case ["property", "list", length, kind, name]:
                declared[-1][2].append(_Property(name, _CODES[kind], _CODES[length]))
            case ["property", kind, name]:
                declared[-1][2].append(_Property(name, _CODES[kind], None))
    elements, offset = {}, 0
    for name, count, properties in declared:
        elements[name], offset = _read_rows(take, offset, count, properties)
    return elements


def _read_rows(
    take: _Take, offset: int, count: int, properties: list[_Property]
) -> tuple[dict[str, _Column], int]:
    """Return the columns of one element, and the offset behind it."""
    values: list[list[int | float]] = [[] for _ in properties]
    sizes: list[list[int]] = [[] for _ in properties]
    for _ in range(count):
        for column, (_, code, length_code) in enumerate(properties):
            length = 1
            if length_code:
                (number,), offset = take(offset, 1, length_code)
                length = int(number)
            numbers, offset = take(offset, length, code)
            values[column] += numbers
            sizes[column].append(length)
    columns = {
        kind.name: _Column(np.array(numbers, np.float64), np.array(lengths, np.int64))
        for kind, numbers, lengths in zip(properties, values, sizes, strict=True)
    }
    return columns, offset


def _together(
    columns: dict[str, _Column], names: tuple[str, ...]
) -> Float[np.ndarray, "rows columns"]:
    """Return scalar columns side by side; no rows where one of them is missing."""
    if not all(name in columns for name in names):
        return np.zeros((0, len(names)))
    return np.stack([columns[name].values for name in names], axis=1)
