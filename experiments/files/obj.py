"""Wavefront OBJ: polygons whose corners index positions, UVs and normals apart.

Written out because trimesh (5.2) takes relative indices from the end of the file instead
of from the line they stand on, lets index 0 pass, and drops all UVs where some are missing.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from .mesh_build import Polygons, SceneFileError
from .mtl import MtlMaterial, load_materials, read_mtl

_NO_SUCH = -2  # an index that the range check refuses; -1 means that a corner has no UV


def read_obj(path: Path) -> Polygons:
    """Read the polygons and the materials they use.

    Lines, curves, smoothing groups and vertex colors are passed over; all objects and groups
    become one mesh. A missing material file or texture is noted, not an error.

    Raises:
        SceneFileError: If a material's numbers or images cannot be used.
    """
    pools: dict[str, list[list[str]]] = {"v": [], "vt": [], "vn": []}
    sizes, corners, polygon_names = [], [], []
    library: dict[str, MtlMaterial] = {}
    names, name = {"": 0}, 0
    notes: list[str] = []
    for line in path.read_text("utf-8", "replace").replace("\\\n", " ").splitlines():
        key, *words = line.split() or [""]
        if key in pools:
            pools[key].append(words)
        elif key == "f":
            counts = [len(pool) for pool in pools.values()]
            sizes.append(len(words))
            corners += [_corner(word, counts) for word in words]
            polygon_names.append(name)
        elif key == "usemtl":
            name = names.setdefault(" ".join(words), len(names))
        elif key == "mtllib":
            file = path.parent / " ".join(words)
            if file.is_file():
                library |= read_mtl(file)
            else:
                notes.append(f"material file {file.name} not found: plain gray used")
    used, polygon_materials = np.unique(np.array(polygon_names, np.int64), return_inverse=True)
    sources = [library.get(tuple(names)[index]) for index in used]
    try:
        materials, said = load_materials(sources or [None])
    except ValueError as error:
        raise SceneFileError(f"{path}: {error}") from error
    return Polygons(
        positions=_numbers(pools["v"], 3),
        sizes=np.array(sizes, np.int64),
        corners=np.array(corners, np.int64).reshape(-1, 3),
        uvs=_numbers([[*words, "0"] for words in pools["vt"]], 2),
        normals=_numbers(pools["vn"], 3),
        polygon_materials=polygon_materials,
        materials=materials,
        notes=(*notes, *said),
    )


def _corner(word: str, counts: Sequence[int]) -> tuple[int, int, int]:
    """Return the indices of ``v``, ``v/vt``, ``v//vn`` or ``v/vt/vn``, counted from 0.

    Args:
        word: One corner; negative indices count back from the newest line of their kind.
        counts: How many lines of each kind stand above.
    """
    indices = [-1, -1, -1]
    for kind, (text, count) in enumerate(zip(word.split("/"), counts, strict=False)):
        if text:
            index = int(text)
            place = index - 1 if index > 0 else count + index
            indices[kind] = place if index and place >= 0 else _NO_SUCH
    return indices[0], indices[1], indices[2]


def _numbers(lines: list[list[str]], columns: int) -> Float[np.ndarray, "lines columns"]:
    """Return the first numbers of each line."""
    for words in lines:
        if len(words) < columns:
            raise ValueError(f"expected {columns} numbers, got '{' '.join(words)}'")
    return np.array([words[:columns] for words in lines], np.float64).reshape(-1, columns)
