"""Wavefront OBJ: polygons whose corners index positions, UVs and normals apart.

Written out because trimesh (5.2) takes relative indices from the end of the file instead
of from the line they stand on, lets index 0 pass, and drops all UVs where some are missing.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from .mesh_build import PLAIN, Polygons
from .scene import Material
from .texture_file import read_texture

_NO_SUCH = -2  # an index that the range check refuses; -1 means that a corner has no UV


def read_obj(path: Path) -> Polygons:
    """Read the polygons, and colors and color textures of the materials they use.

    Lines, curves, smoothing groups and vertex colors are passed over; all objects and groups
    become one mesh. A missing material file or texture is noted, not an error.
    """
    pools: dict[str, list[list[str]]] = {"v": [], "vt": [], "vn": []}
    sizes, corners, polygon_materials = [], [], []
    library: dict[str, Material] = {}
    names, name = [""], 0
    notes: list[str] = []
    for line in path.read_text("utf-8", "replace").replace("\\\n", " ").splitlines():
        key, *words = line.split() or [""]
        if key in pools:
            pools[key].append(words)
        elif key == "f":
            counts = [len(pool) for pool in pools.values()]
            sizes.append(len(words))
            corners += [_corner(word, counts) for word in words]
            polygon_materials.append(name)
        elif key == "usemtl":
            names.append(" ".join(words))
            name = len(names) - 1
        elif key == "mtllib":
            library |= _read_mtl(path.parent / " ".join(words), notes)
    used, polygon_names = np.unique(np.array(polygon_materials, np.int64), return_inverse=True)
    return Polygons(
        positions=_numbers(pools["v"], 3),
        sizes=np.array(sizes, np.int64),
        corners=np.array(corners, np.int64).reshape(-1, 3),
        uvs=_numbers([[*words, "0"] for words in pools["vt"]], 2),
        normals=_numbers(pools["vn"], 3),
        polygon_materials=polygon_names,
        materials=tuple(library.get(names[index], PLAIN) for index in used) or (PLAIN,),
        notes=tuple(notes),
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


def _read_mtl(path: Path, notes: list[str]) -> dict[str, Material]:
    """Return a library's materials (``Kd`` as linear RGB, ``map_Kd`` as sRGB); add to notes."""
    if not path.is_file():
        notes.append(f"material file {path.name} not found: plain gray used")
        return {}
    materials: dict[str, Material] = {}
    name = ""
    for line in path.read_text("utf-8", "replace").splitlines():
        key, _, rest = line.strip().partition(" ")
        rest = rest.strip()
        if key == "newmtl":
            name = rest
            materials[name] = Material()
        elif key == "Kd":
            red, green, blue = (float(word) for word in rest.split()[:3])
            materials[name] = materials[name]._replace(base_color=(red, green, blue))
        elif key == "map_Kd":
            # Options such as "-s 1 1 1" stand before the file's name.
            file = rest.split()[-1] if rest.startswith("-") else rest
            image = path.parent / file.replace("\\", "/")
            if image.is_file():
                texture = read_texture(image, color=True)
                materials[name] = materials[name]._replace(base_color_texture=texture)
            else:
                notes.append(f"texture {image.name} not found: its material's color is used alone")
    return materials
