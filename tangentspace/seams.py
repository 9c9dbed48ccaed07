"""Vertices that no single tangent frame can serve, parted on the host with NumPy.

A texture is mirrored where its triangle runs clockwise in UVs; v points up. Where mirrored
and other faces meet in one vertex, each kind needs a frame of its own.
"""

import numpy as np
from jaxtyping import Float, Int

from .frames import _checked_attribute
from .mesh import Mesh
from .vertex_normals import _checked


def split_mirrored(mesh: Mesh) -> Mesh:
    """Split the vertices that faces of both handedness share.

    Most of a vertex's faces keep it (where equally many, those that are not mirrored); the
    others get a copy, with all that the vertex has. Faces without a frame (see
    ``triangle_frames``) have no handedness, and stay.

    Args:
        mesh: A mesh with UVs; its arrays are left alone.

    Returns:
        A NumPy mesh of the same types: the vertices in their order, then the copies in the
        order of what they were copied from; faces in their order. No vertex is shared any
        more, so that a second call changes nothing.

    Raises:
        ValueError: If the mesh has no UVs, an array has the wrong shape, or ``faces`` name a
            missing vertex.
    """
    if mesh.uvs is None:
        raise ValueError(
            "split_mirrored: expected a mesh with `uvs`, got None; without a texture nothing is "
            "mirrored, so use the mesh as it is"
        )
    _checked(mesh.positions, mesh.faces, "split_mirrored")
    _checked_attribute("uvs", mesh.uvs, (len(mesh.positions), 2), "split_mirrored")
    positions, normals, faces, uvs = (np.asarray(array) for array in mesh[:4])
    count = len(positions)
    handedness = _handedness(positions, uvs, faces)
    plain, mirrored = (
        np.bincount(faces[handedness == sign].ravel(), minlength=count) for sign in (1, -1)
    )
    shared = np.flatnonzero((plain > 0) & (mirrored > 0))
    copies = np.arange(count)
    copies[shared] = count + np.arange(len(shared))
    leaving = np.where(plain >= mirrored, -1, 1)  # the handedness that takes the copy
    leaves = handedness[:, None] == leaving[faces]
    source = np.concatenate([np.arange(count), shared])
    return Mesh(
        positions=positions[source],
        normals=normals[source],
        faces=np.where(leaves, copies[faces], faces).astype(faces.dtype),
        uvs=uvs[source],
        tangents=None if mesh.tangents is None else np.asarray(mesh.tangents)[source],
    )


def _handedness(
    positions: Float[np.ndarray, "vertices 3"],
    uvs: Float[np.ndarray, "vertices 2"],
    faces: Int[np.ndarray, "faces 3"],
) -> Int[np.ndarray, " faces"]:
    """Return +1, -1 where mirrored, 0 where a face has no frame: as ``triangle_frames`` says."""
    thin = 4 * np.finfo(positions.dtype).eps
    first, second = (positions[faces[:, k]] - positions[faces[:, 0]] for k in (1, 2))
    uv_first, uv_second = (uvs[faces[:, k]] - uvs[faces[:, 0]] for k in (1, 2))
    height = np.abs(np.cross(first, second)).max(axis=-1, initial=0.0)
    area = uv_first[:, 0] * uv_second[:, 1] - uv_second[:, 0] * uv_first[:, 1]
    valid = height > thin * _squares(first, second)
    valid &= np.abs(area) > thin * _squares(uv_first, uv_second)
    return np.where(valid, np.sign(area), 0).astype(np.int64)


def _squares(
    first: Float[np.ndarray, "faces n"], second: Float[np.ndarray, "faces n"]
) -> Float[np.ndarray, " faces"]:
    """Return the sum of the squared lengths of a triangle's edges."""
    return np.sum(first**2 + second**2 + (second - first) ** 2, axis=-1)
