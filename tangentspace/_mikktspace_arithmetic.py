"""MikkTSpace's arithmetic in single precision, each operation in its order.

Where a sum nearly cancels, rounding decides the answer: only the same operations give the
same tangents there. Vectors are stored by component, ``(3, ...)``, and corners of faces in
the last axis, ``(3, faces, 3)``. Overflow and invalid operations are the caller's to silence.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float32, Int

Vectors = Float32[np.ndarray, "3 ..."]
OfFaces = Float32[np.ndarray, "3 faces"]
OfCorners = Float32[np.ndarray, "3 faces 3"]
ONE = np.float32(1)


class FaceDerivatives(NamedTuple):
    """How the surface runs along u and v, face by face.

    Attributes:
        tangents: Directions of dp/du, of unit length; 0 where there is none.
        bitangents: Directions of dp/dv.
        handedness: +1, or -1 where the UVs are mirrored; 0 for loose faces, which have no
            usable derivative.
    """

    tangents: OfFaces
    bitangents: OfFaces
    handedness: Int[np.ndarray, " faces"]


def dot(a: Vectors, b: Vectors) -> Float32[np.ndarray, "..."]:
    """Return the inner products."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def face_derivatives(
    positions: OfCorners, uvs: Float32[np.ndarray, "2 faces 3"]
) -> FaceDerivatives:
    """Differentiate the positions by the UVs."""
    edge, other_edge = (positions[..., i] - positions[..., 0] for i in (1, 2))
    (u, v), (other_u, other_v) = (uvs[..., i] - uvs[..., 0] for i in (1, 2))
    area = u * other_v - v * other_u
    sign = np.where(area > 0, ONE, -ONE)
    along_u = other_v * edge - v * other_edge
    along_v = -other_u * edge + u * other_edge
    length_u, length_v = np.sqrt(dot(along_u, along_u)), np.sqrt(dot(along_v, along_v))
    has_area = _not_zero(area)
    firm = has_area & _not_zero(length_u / np.abs(area)) & _not_zero(length_v / np.abs(area))
    return FaceDerivatives(
        np.where(has_area & _not_zero(length_u), sign / length_u * along_u, 0),
        np.where(has_area & _not_zero(length_v), sign / length_v * along_v, 0),
        np.where(firm, sign, 0).astype(np.int64),
    )


def project(directions: Vectors, normals: Vectors) -> Vectors:
    """Take directions into the planes of the normals, to unit length; 0 where nothing is left."""
    projected = directions - dot(normals, directions) * normals
    return normalize(projected)


def angles(positions: OfCorners, normals: OfCorners) -> Float32[np.ndarray, "faces 3"]:
    """Return the angles at the corners, of the edges taken into the planes of the normals."""
    to_previous = project(np.roll(positions, 1, axis=-1) - positions, normals)
    to_next = project(np.roll(positions, -1, axis=-1) - positions, normals)
    cosine = np.clip(dot(to_previous, to_next), -ONE, ONE)
    return np.arccos(cosine.astype(np.float64)).astype(np.float32)


def normalize(vectors: Vectors) -> Vectors:
    """Scale to unit length, but leave vectors whose components all count as zero."""
    nonzero = np.any(_not_zero(vectors), axis=0)
    return np.where(nonzero, ONE / np.sqrt(dot(vectors, vectors)) * vectors, vectors)


def _not_zero(numbers: Float32[np.ndarray, "..."]) -> Bool[np.ndarray, "..."]:
    return np.abs(numbers) > np.finfo(np.float32).tiny
