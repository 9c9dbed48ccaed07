"""From what a file holds to a clean mesh: checked, triangulated, with normals.

A file's polygons index separate lists of positions, UVs and normals (``Polygons``); a mesh
has one index per corner. Nothing is merged that the file keeps apart, so UV seams survive,
and vertices keep the file's order. What is legal but odd is counted and said in the notes.
"""

import dataclasses
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from tangentspace.mesh import Mesh
from tangentspace.texture import clamp

from ..scene import Material
from .smooth_normals import (
    face_normals_and_angles,
    perpendicular,
    smooth_normals,
    unique_rows,
    unit,
)

PLAIN = Material(base_color=(0.7, 0.7, 0.7))
_UV_ROUNDING = 1e-5  # a UV so far outside [0, 1] still counts as inside


class SceneFileError(ValueError):
    """A scene file that cannot be used; the message is one line that begins with its name."""


class Polygons(NamedTuple):
    """Faces with any number of corners, as OBJ and PLY files hold them.

    Attributes:
        positions: World space.
        sizes: Number of corners of each polygon.
        corners: For each corner the index of its position, UV and normal; a UV or normal
            index of -1 means none.
        uvs: Texture coordinates, v upwards.
        normals: Of any length.
        polygon_materials: For each polygon, the index of its material.
        materials: At least one.
        notes: What a reader should know, one line each.
    """

    positions: Float[np.ndarray, "positions 3"]
    sizes: Int[np.ndarray, " polygons"]
    corners: Int[np.ndarray, "corners 3"]
    uvs: Float[np.ndarray, "uvs 2"]
    normals: Float[np.ndarray, "normals 3"]
    polygon_materials: Int[np.ndarray, " polygons"]
    materials: tuple[Material, ...] = (PLAIN,)
    notes: tuple[str, ...] = ()


class BuiltMesh(NamedTuple):
    """A mesh with its materials.

    Attributes:
        mesh: NumPy float32 and int32 arrays.
        face_materials: For each face, the index of its material.
        materials: At least one.
        notes: What a reader should know, one line each.
    """

    mesh: Mesh
    face_materials: Int[np.ndarray, " faces"]
    materials: tuple[Material, ...]
    notes: tuple[str, ...]


@contextmanager
def reading(path: Path, kind: str) -> Iterator[None]:
    """Turn whatever a broken file provokes in a parser into one line that names the file."""
    try:
        yield
    except SceneFileError:
        raise
    except Exception as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise SceneFileError(
            f"{path}: cannot be read as {kind}, the file is damaged, cut short or of another "
            f"kind ({reason}); export it again"
        ) from error


def build_polygons(path: Path, polygons: Polygons) -> BuiltMesh:
    """Triangulate as fans and give every different (position, UV, normal) its own vertex.

    Args:
        path: The file, for error messages.
        polygons: Its contents.

    Raises:
        SceneFileError: If an index is out of range, or as ``build_mesh``.
    """
    sizes, corners = polygons.sizes, polygons.corners
    pools = (polygons.positions, polygons.uvs, polygons.normals)
    for what, index, pool, least in zip(
        ("position", "UV", "normal"), corners.T, pools, (0, -1, -1), strict=True
    ):
        wrong = int(((index < least) | (index >= len(pool))).sum())
        if wrong:
            raise SceneFileError(
                f"{path}: {wrong} face indices out of range, they name none of the "
                f"{len(pool)} {what}s in the file; export it again"
            )
    notes = polygons.notes
    notes += counted(sizes > 3, "face", "faces", "with more than three corners split as a fan")
    notes += counted(sizes < 3, "face", "faces", "with fewer than three corners left out")
    # Fan: triangle j of a polygon has its corners 0, j + 1 and j + 2.
    triangles = np.maximum(sizes - 2, 0)
    starts = np.repeat(np.cumsum(sizes) - sizes, triangles)
    step = np.arange(len(starts)) - np.repeat(np.cumsum(triangles) - triangles, triangles)
    fans = np.stack([starts, starts + step + 1, starts + step + 2], axis=1)

    # Positions that no polygon uses go along as corners, to be checked and counted.
    unused = np.delete(np.arange(len(polygons.positions)), corners[:, 0])
    lone = np.stack([unused, np.full_like(unused, -1), np.full_like(unused, -1)], axis=1)
    first, vertex = unique_rows(np.concatenate([corners, lone]))
    position, uv, normal = np.concatenate([corners, lone])[first].T
    raw = Mesh(
        positions=polygons.positions[position],
        normals=np.concatenate([polygons.normals, [[np.nan] * 3]])[normal],  # row -1: none
        faces=vertex[fans],
        uvs=np.concatenate([polygons.uvs, [[np.nan] * 2]])[uv] if len(polygons.uvs) else None,
    )
    face_materials = np.repeat(polygons.polygon_materials, triangles)
    return build_mesh(path, raw, face_materials, polygons.materials, notes)


def build_mesh(
    path: Path,
    raw: Mesh,
    face_materials: Int[np.ndarray, " faces"],
    materials: tuple[Material, ...],
    notes: tuple[str, ...] = (),
) -> BuiltMesh:
    """Check a mesh, drop vertices without faces, and fill in what is missing.

    Args:
        path: The file, for error messages.
        raw: World space, faces in range; normals of any length. Normals, UVs and tangents are
            not finite (or, but for UVs, zero) where missing.
        face_materials: For each face, the index of its material.
        materials: At least one.
        notes: What is already to be said.

    Raises:
        SceneFileError: If there is no face, a position is not finite in single precision,
            or all positions coincide.
    """
    with np.errstate(over="ignore"):
        positions = np.asarray(raw.positions).astype(np.float32)
    if not len(raw.faces):
        raise SceneFileError(f"{path}: has no faces (a point cloud?); a mesh of faces is needed")
    broken = int((~np.isfinite(positions).all(axis=1)).sum())
    if broken:
        raise SceneFileError(
            f"{path}: {broken} of {len(positions)} vertices are NaN, infinite or too large for "
            "single precision; repair the mesh"
        )
    used = np.zeros(len(positions), bool)
    used[raw.faces] = True
    faces = (np.cumsum(used) - 1)[raw.faces].astype(np.int32)
    positions = positions[used]
    if (positions == positions[0]).all():
        raise SceneFileError(f"{path}: all vertices of its faces lie at one point; nothing to see")

    notes += counted(~used, "vertex", "vertices", "without a face left out")
    notes += _flaws(positions, faces)
    smooth = smooth_normals(positions, faces)
    normals, missing = unit(np.asarray(raw.normals)[used])
    normals[missing] = smooth[missing]
    if missing.all():
        notes += ("no normals in the file: smooth ones computed",)
    else:
        notes += counted(missing, "vertex", "vertices", "without a valid normal: smooth one used")
    none = np.linalg.norm(normals, axis=1) == 0
    notes += counted(none, "vertex", "vertices", "where no normal exists: zero used")
    uvs = tangents = None
    if raw.uvs is not None:
        uvs = np.asarray(raw.uvs)[used]
        finite = np.isfinite(uvs)
        missing = ~np.all(finite, axis=1)
        notes += counted(missing, "vertex", "vertices", "without a valid UV: zero used")
        uvs = np.where(finite, uvs, 0).astype(np.float32)
    if raw.tangents is not None:
        given = np.asarray(raw.tangents)[used]
        tangents, missing = unit(given[:, :3])
        tangents[missing] = perpendicular(normals[missing])
        notes += counted(missing, "vertex", "vertices", "without a valid tangent: any one used")
        handedness = np.where(given[:, 3:] < 0, -1.0, 1.0)
        tangents = np.concatenate([tangents, handedness], axis=1).astype(np.float32)
    mesh = Mesh(positions, normals.astype(np.float32), faces, uvs, tangents)
    materials, said = _usable_textures(mesh, face_materials, materials)
    return BuiltMesh(mesh, face_materials.astype(np.int32), materials, notes + said)


def counted(where: Bool[np.ndarray, " items"], one: str, many: str, what: str) -> tuple[str, ...]:
    """Return a note on how many items there are, or none if there are none."""
    count = int(where.sum())
    return (f"{count} {one if count == 1 else many} {what}",) if count else ()


def _usable_textures(
    mesh: Mesh, face_materials: Int[np.ndarray, " faces"], materials: tuple[Material, ...]
) -> tuple[tuple[Material, ...], tuple[str, ...]]:
    """Return materials, without textures where there are no UVs; count UVs that are clamped."""
    textures = [
        (index, kind, texture)
        for index, material in enumerate(materials)
        for kind in ("base_color_texture", "normal_texture", "height_texture")
        if (texture := getattr(material, kind)) is not None
    ]
    if mesh.uvs is None:
        plain = list(materials)
        for index, kind, _ in textures:
            plain[index] = dataclasses.replace(plain[index], **{kind: None})
        without = np.isin(np.arange(len(plain)), [index for index, *_ in textures])
        return tuple(plain), counted(
            without, "material", "materials", "with textures but no UVs: used without"
        )
    uvs = np.asarray(mesh.uvs)
    beyond = (uvs < -_UV_ROUNDING) | (uvs > 1 + _UV_ROUNDING)
    clamped = np.zeros(len(uvs), bool)
    for index, _, texture in textures:
        corners = np.asarray(mesh.faces)[face_materials == index].ravel()
        for axis, wrap in enumerate((texture.wrap_u, texture.wrap_v)):
            if wrap is clamp:
                clamped[corners] |= beyond[corners, axis]
    what = "with UVs outside [0, 1] under a clamped texture: its border is seen there"
    return materials, counted(clamped, "vertex", "vertices", what)


def _flaws(
    positions: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "faces 3"]
) -> tuple[str, ...]:
    """Say which faces are legal but odd."""
    direction, _ = face_normals_and_angles(positions, faces)
    _, point = unique_rows(positions)
    first, _ = unique_rows(np.sort(point[faces], axis=1))
    again = np.ones(len(faces), bool)
    again[first] = False
    covering = "kept; they cover no pixel"
    return counted(
        (direction == 0).all(axis=1), "zero-area face", "zero-area faces", covering
    ) + counted(again, "face", "faces", "with the same three points as another kept")
