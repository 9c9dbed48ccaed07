"""Meshes with exact answers, made with NumPy: what tests, scenes and notebooks start from.

Right-handed, y up, faces counter-clockwise seen from outside, normals of the true surface
(not of the triangles), v upwards, and every chart right-handed: ``cross(dp/du, dp/dv)``
points out, so the handedness is +1. Vertices are repeated along UV seams and at hard edges.
"""

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import DTypeLike

from .mesh import Mesh

# Each side of a box as (u axis, v axis); the outward normal is their cross product.
_SIDES = np.array(
    [
        [[0, 0, -1], [0, 1, 0]],  # +x
        [[0, 0, 1], [0, 1, 0]],  # -x
        [[1, 0, 0], [0, 0, -1]],  # +y
        [[1, 0, 0], [0, 0, 1]],  # -y
        [[1, 0, 0], [0, 1, 0]],  # +z
        [[-1, 0, 0], [0, 1, 0]],  # -z
    ]
)


def plane(half_width: float = 1.0, *, segments: int = 1, dtype: DTypeLike = np.float32) -> Mesh:
    """Make a square in the plane y = 0 round the origin, facing up.

    Args:
        half_width: Half of the side's length.
        segments: Squares along each side, >= 1; each becomes two triangles.
        dtype: Floating-point type of the arrays.

    Returns:
        The mesh; u grows with x, v against z.
    """
    _require("plane", "segments", segments, 1)
    uvs, faces = _grid(segments, segments)
    u, v = uvs.T
    positions = half_width * np.stack([2 * u - 1, np.zeros_like(u), 1 - 2 * v], axis=-1)
    return _mesh(positions, np.tile([0.0, 1.0, 0.0], (len(u), 1)), faces, uvs, dtype)


def box(
    half_extents: tuple[float, float, float] = (1.0, 1.0, 1.0), *, dtype: DTypeLike = np.float32
) -> Mesh:
    """Make a box round the origin, four vertices a side, the whole texture on each side.

    Args:
        half_extents: Half of the lengths along x, y and z.
        dtype: Floating-point type of the arrays.

    Returns:
        The mesh; v points up on the four walls, against z on the top and along z below.
    """
    uvs, faces = _grid(1, 1)
    normals = np.repeat(np.cross(_SIDES[:, 0], _SIDES[:, 1]), 4, axis=0)
    across = ((2 * uvs - 1) @ _SIDES).reshape(-1, 3)
    all_faces = (4 * np.arange(6)[:, None, None] + faces).reshape(-1, 3)
    positions = (across + normals) * np.asarray(half_extents)
    return _mesh(positions, normals, all_faces, np.tile(uvs, (6, 1)), dtype)


def uv_sphere(
    radius: float = 1.0, *, rings: int = 16, segments: int = 32, dtype: DTypeLike = np.float32
) -> Mesh:
    """Make a sphere round the origin, cut along meridians and parallels, poles on the y axis.

    Args:
        radius: Radius of the sphere, on which every vertex lies.
        rings: Bands from pole to pole, >= 2.
        segments: Slices round the axis, >= 3.
        dtype: Floating-point type of the arrays.

    Returns:
        The mesh. u goes once round, eastwards from its seam at +x; v is 0 at the lower
        pole and 1 at the upper. A pole has one vertex per slice, with u in its middle.
    """
    _require("uv_sphere", "rings", rings, 2)
    _require("uv_sphere", "segments", segments, 3)
    uvs, faces = _grid(segments, rings)
    u, v = uvs.T
    longitude, latitude = 2 * np.pi * (u % 1), np.pi * (v - 0.5)
    ring = np.where((v == 0) | (v == 1), 0.0, np.cos(latitude))
    normals = _round_y_axis(ring, np.sin(latitude), longitude)
    uvs[:, 0] += 0.5 / segments * np.where(v == 0, 1, np.where(v == 1, -1, 0))
    kept = np.ones((rings, segments, 2), bool)
    kept[0, :, 0] = kept[-1, :, 1] = False  # the half of a square that shrinks to a line
    used, faces = np.unique(faces[kept.ravel()], return_inverse=True)
    normals = normals[used]
    return _mesh(radius * normals, normals, faces.reshape(-1, 3), uvs[used], dtype)


def torus(
    major_radius: float = 1.0,
    minor_radius: float = 0.4,
    *,
    major_segments: int = 32,
    minor_segments: int = 16,
    dtype: DTypeLike = np.float32,
) -> Mesh:
    """Make a torus round the y axis.

    Args:
        major_radius: From the axis to the middle of the tube.
        minor_radius: Radius of the tube.
        major_segments: Slices round the axis, >= 3.
        minor_segments: Slices round the tube, >= 3.
        dtype: Floating-point type of the arrays.

    Returns:
        The mesh. u goes once round the axis, eastwards from its seam at +x; v goes once
        round the tube, upwards from its seam on the outer equator.
    """
    _require("torus", "major_segments", major_segments, 3)
    _require("torus", "minor_segments", minor_segments, 3)
    uvs, faces = _grid(major_segments, minor_segments)
    u, v = uvs.T
    longitude, tube = 2 * np.pi * (u % 1), 2 * np.pi * (v % 1)
    normals = _round_y_axis(np.cos(tube), np.sin(tube), longitude)
    spine = _round_y_axis(np.ones_like(u), np.zeros_like(u), longitude)
    return _mesh(major_radius * spine + minor_radius * normals, normals, faces, uvs, dtype)


def icosphere(radius: float = 1.0, *, subdivisions: int = 2, dtype: DTypeLike = np.float32) -> Mesh:
    """Make a sphere of nearly equal triangles: a closed surface with no repeated vertex.

    Args:
        radius: Radius of the sphere, on which every vertex lies.
        subdivisions: How often each face of the icosahedron is cut in four, >= 0.
        dtype: Floating-point type of the arrays.

    Returns:
        The mesh, with 20 * 4 ** subdivisions faces and no UVs (they would need a seam).
    """
    _require("icosphere", "subdivisions", subdivisions, 0)
    golden = (1 + np.sqrt(5)) / 2
    cyclic = [(0, a, b * golden) for a in (-1, 1) for b in (-1, 1)]
    corners = np.array([np.roll(corner, turn) for turn in range(3) for corner in cyclic])
    distances = np.linalg.norm(corners[:, None] - corners, axis=-1)
    near = np.isclose(distances, 2.0)  # the edges' length
    a, b, c = np.nonzero(near[:, :, None] & near[:, None] & near)
    outward = np.einsum("ij,ij->i", np.cross(corners[a], corners[b]), corners[c]) > 0
    faces = np.stack([a, b, c], axis=-1)[outward & (a < b) & (a < c)]
    normals = corners / np.linalg.norm(corners[0])
    for _ in range(subdivisions):
        normals, faces = _cut_in_four(normals, faces)
    return _mesh(radius * normals, normals, faces, None, dtype)


def transform_mesh(mesh: Mesh, matrix: Float[np.ndarray, "4 4"]) -> Mesh:
    """Apply an affine transform, such as a model matrix, to a mesh.

    Normals take the inverse transpose and unit length, tangents the matrix and unit length.
    A mirroring matrix also turns faces over, so that they stay counter-clockwise seen from
    outside, and flips the handedness.

    Args:
        mesh: Any mesh; its arrays are left alone.
        matrix: ``to_from``, acting on columns, last row (0, 0, 0, 1).

    Returns:
        A NumPy mesh of the same floating-point type.

    Raises:
        ValueError: If the matrix is not affine and invertible.
    """
    matrix = np.asarray(matrix, np.float64)
    if matrix.shape != (4, 4) or (matrix[3] != [0, 0, 0, 1]).any():
        raise ValueError(
            "transform_mesh: expected an affine `matrix` of shape (4, 4) with last row "
            f"(0, 0, 0, 1), got {matrix.tolist()}; a projection cannot act on a mesh"
        )
    linear, determinant = matrix[:3, :3], np.linalg.det(matrix[:3, :3])
    if determinant == 0:
        raise ValueError(
            f"transform_mesh: expected an invertible `matrix`, got {matrix.tolist()}; "
            "scale no axis by 0"
        )
    dtype = np.asarray(mesh.positions).dtype
    positions = np.asarray(mesh.positions) @ linear.T + matrix[:3, 3]
    normals = _normalize(np.asarray(mesh.normals) @ np.linalg.inv(linear))
    faces = np.asarray(mesh.faces)[:, :: 1 if determinant > 0 else -1]
    tangents = mesh.tangents
    if tangents is not None:
        directions = _normalize(np.asarray(tangents)[:, :3] @ linear.T)
        handedness = np.sign(determinant) * np.asarray(tangents)[:, 3:]
        tangents = np.concatenate([directions, handedness], axis=1).astype(dtype)
    return mesh._replace(
        positions=positions.astype(dtype),
        normals=normals.astype(dtype),
        faces=np.ascontiguousarray(faces),
        tangents=tangents,
    )


def merge(*meshes: Mesh) -> Mesh:
    """Put several meshes into one, in the order given; vertices are not welded.

    Args:
        *meshes: At least one.

    Returns:
        One NumPy mesh. UVs are kept if any mesh has them (zero where one has none),
        tangents only if all have them.

    Raises:
        ValueError: If no mesh is given.
    """
    if not meshes:
        raise ValueError("merge: expected at least one mesh, got none; pass the meshes to join")
    starts = np.cumsum([0, *(len(mesh.positions) for mesh in meshes)])
    faces = [mesh.faces + start for mesh, start in zip(meshes, starts[:-1], strict=True)]
    positions = np.concatenate([mesh.positions for mesh in meshes])
    tangents = [mesh.tangents for mesh in meshes if mesh.tangents is not None]
    uvs = None
    if any(mesh.uvs is not None for mesh in meshes):
        filled = [np.zeros((len(m.positions), 2)) if m.uvs is None else m.uvs for m in meshes]
        uvs = np.concatenate(filled).astype(positions.dtype)
    return Mesh(
        positions=positions,
        normals=np.concatenate([mesh.normals for mesh in meshes]),
        faces=np.concatenate(faces).astype(np.int32),
        uvs=uvs,
        tangents=np.concatenate(tangents) if len(tangents) == len(meshes) else None,
    )


def _grid(
    columns: int, rows: int
) -> tuple[Float[np.ndarray, "vertices 2"], Int[np.ndarray, "faces 3"]]:
    """Return the UVs and faces of a grid over the unit square; v changes slowest."""
    v, u = np.meshgrid(np.linspace(0, 1, rows + 1), np.linspace(0, 1, columns + 1), indexing="ij")
    low = (np.arange(rows)[:, None] * (columns + 1) + np.arange(columns)).ravel()
    high = low + columns + 1
    squares = np.stack([low, low + 1, high + 1, low, high + 1, high], axis=-1)
    return np.stack([u.ravel(), v.ravel()], axis=-1), squares.reshape(-1, 3)


def _round_y_axis(
    distance: Float[np.ndarray, " n"],
    height: Float[np.ndarray, " n"],
    longitude: Float[np.ndarray, " n"],
) -> Float[np.ndarray, "n 3"]:
    """Return points in cylindrical coordinates round the y axis, longitude 0 at +x."""
    return np.stack([distance * np.cos(longitude), height, -distance * np.sin(longitude)], axis=-1)


def _cut_in_four(
    normals: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "faces 3"]
) -> tuple[Float[np.ndarray, "more_vertices 3"], Int[np.ndarray, "more_faces 3"]]:
    """Add the middle of every edge, pushed out to the unit sphere, and cut the faces there."""
    edges = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1), axis=-1)
    unique, middle = np.unique(edges.reshape(-1, 2), axis=0, return_inverse=True)
    middle = len(normals) + middle.reshape(-1, 3)
    corner_faces = np.stack([faces, middle, np.roll(middle, 1, axis=1)], axis=-1)
    all_normals = np.concatenate([normals, _normalize(normals[unique].sum(axis=1))])
    return all_normals, np.concatenate([middle, corner_faces.reshape(-1, 3)])


def _normalize(vectors: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Scale rows to unit length; zero rows stay zero."""
    lengths = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return vectors / np.where(lengths == 0, 1.0, lengths)


def _mesh(
    positions: Float[np.ndarray, "vertices 3"],
    normals: Float[np.ndarray, "vertices 3"] | Int[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
    uvs: Float[np.ndarray, "vertices 2"] | None,
    dtype: DTypeLike,
) -> Mesh:
    """Return the mesh in the type asked for; all was computed in double precision."""
    return Mesh(
        positions=positions.astype(dtype),
        normals=normals.astype(dtype),
        faces=faces.astype(np.int32),
        uvs=None if uvs is None else uvs.astype(dtype),
    )


def _require(function: str, argument: str, value: int, least: int) -> None:
    """Refuse a count that is too small to make the shape."""
    if value < least:
        raise ValueError(
            f"{function}: expected `{argument}` of at least {least}, got {value}; make it larger"
        )
