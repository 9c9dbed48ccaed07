"""The discrete part of MikkTSpace, and what each corner contributes, from the checked arrays."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Float, Float32, Int

from . import _mikktspace_arithmetic as arithmetic
from ._mikktspace_groups import group_corners, sums_without_opposites
from ._mikktspace_links import following_corners
from ._mikktspace_weld import weld

Vectors = Float[Array | np.ndarray, "vertices 3"]
Uvs = Float[Array | np.ndarray, "vertices 2"]
Faces = Int[Array | np.ndarray, "faces 3"]
DEFAULT = (1.0, 0.0, 0.0, -1.0)


class CornerGroups(NamedTuple):
    """Which corners are summed for whose tangent: all of `group_tangents` that is discrete.

    Corners are numbered ``3 * face + corner``. The last sum has no members and stands for
    the default, the tangent (1, 0, 0) of handedness -1.

    Attributes:
        faces: Vertex indices.
        members: Corners that contribute to a sum.
        sums: The sum that each of these goes into.
        corner_sums: The sum that each corner takes for its tangent.
        handedness: +1 or -1 per sum.
    """

    faces: Faces
    members: Int[Array | np.ndarray, " members"]
    sums: Int[Array | np.ndarray, " members"]
    corner_sums: Faces
    handedness: Int[Array | np.ndarray, " sums"]


def survey(
    name: str, positions: Vectors, normals: Vectors, uvs: Uvs, faces: Faces
) -> tuple[CornerGroups, Float32[np.ndarray, "3 corners"]]:
    """Return the groups, and every corner's weighted tangent in the reference's arithmetic.

    Faces that repeat a position are left out, and so are their weights: 0.
    """
    positions, normals, uvs, faces = _checked(name, positions, normals, uvs, faces)
    repeats = [positions[faces[:, i]] == positions[faces[:, i - 1]] for i in range(3)]
    good = np.flatnonzero(~np.any(np.all(repeats, axis=2), axis=0))
    corners, normal, uv = (
        np.moveaxis(array[faces[good]], -1, 0) for array in (positions, normals, uvs)
    )
    with np.errstate(all="ignore"):
        welded = weld(positions, normals, uvs, faces)
        along_u, along_v, handedness = arithmetic.face_derivatives(corners, uv)
        tangents = arithmetic.project(along_u[..., None], normal)
        bitangents = arithmetic.project(along_v[..., None], normal)
        weighted = np.zeros((3, *faces.shape), np.float32)
        weighted[:, good] = arithmetic.angles(corners, normal) * tangents
        groups, settled = group_corners(following_corners(welded[good]), handedness)
        sums = sums_without_opposites(
            groups,
            np.repeat(handedness != 0, 3),
            *(vectors.reshape(3, 3 * len(good)) for vectors in (tangents, bitangents)),
        )
    members = (3 * good[:, None] + np.arange(3)).ravel()[sums.corners]
    lists = (members, sums.sums, *_assigned(sums.read.reshape(-1, 3), settled, welded, good))
    return CornerGroups(faces, *(array.astype(np.int32) for array in lists)), weighted.reshape(
        3, -1
    )


def _assigned(
    read: Int[np.ndarray, "good 3"],
    handedness: Int[np.ndarray, " good"],
    welded: Int[np.ndarray, "faces 3"],
    good: Int[np.ndarray, " good"],
) -> tuple[Int[np.ndarray, "faces 3"], Int[np.ndarray, " sums"]]:
    """Return the sum that each corner takes, and the handedness of the sums, default last.

    Corners of faces that repeat a position take that of the first good corner welded to them.
    """
    default = read.max(initial=-1) + 1
    read = np.where(read < 0, default, read)
    sum_handedness = np.zeros(default + 1, np.int64)
    sum_handedness[read] = handedness[:, None]
    sum_handedness[-1] = DEFAULT[3]
    of_vertex = np.full(welded.size, default)
    of_vertex[welded[good].ravel()[::-1]] = read.ravel()[::-1]  # the last assignment counts
    corner_sums = of_vertex[welded]
    corner_sums[good] = read
    return corner_sums, sum_handedness


def _checked(
    name: str, positions: Vectors, normals: Vectors, uvs: Uvs, faces: Faces
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the arrays as NumPy's, in single precision; refuse what cannot be used."""
    arrays = {"positions": positions, "normals": normals, "uvs": uvs}
    count, known = len(positions), []
    for argument, array in arrays.items():
        shape = (count, 2 if argument == "uvs" else 3)
        if np.shape(array) != shape:
            expected = f"expected `{argument}` of shape {shape}, got {np.shape(array)}"
            raise ValueError(f"{name}: {expected}; give one row per vertex")
        with np.errstate(over="ignore"):
            known.append(np.asarray(array, np.float32))
        if not np.all(finite := np.isfinite(known[-1])):
            place = np.flatnonzero(~np.all(finite, axis=1))[0]
            got = f"got {np.asarray(array)[place].tolist()} at vertex {place}"
            raise ValueError(f"{name}: expected finite `{argument}`, {got}; repair that vertex")
    faces = np.asarray(faces)
    if faces.ndim != 2 or faces.shape[1] != 3:
        expected = f"expected `faces` of shape (faces, 3), got {faces.shape}"
        raise ValueError(f"{name}: {expected}; split larger polygons into triangles")
    if np.any(outside := (faces < 0) | (faces >= count)):
        expected = f"expected `faces` to index {count} vertices, got {faces[outside][0]}"
        raise ValueError(f"{name}: {expected}; repair those faces")
    return *known, faces
