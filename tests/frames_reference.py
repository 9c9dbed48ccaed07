"""Tangent frames by the definitions, one face and one corner at a time, in NumPy float64."""

from typing import NamedTuple

import numpy as np


class FrameReference(NamedTuple):
    """What ``vertex_frames`` promises, by another way."""

    tangent: np.ndarray
    bitangent: np.ndarray
    handedness: np.ndarray
    valid: np.ndarray


def triangle_reference(corners, uvs):
    """Solve ``edge = du T + dv B`` of one triangle: T, B, handedness; None without a frame."""
    edges, uv_edges = corners[1:] - corners[0], uvs[1:] - uvs[0]
    if height(corners) < 1e-12 or height(uvs) < 1e-12:
        return None
    tangent, bitangent = np.linalg.solve(uv_edges, edges)
    return tangent, bitangent, np.sign(np.linalg.det(uv_edges))


def vertex_reference(positions, normals, uvs, faces):
    """Mikkelsen's sum over the corners at each vertex, mirrored faces apart."""
    count = len(positions)
    tangent, bitangent = np.zeros((count, 3)), np.zeros((count, 3))
    handedness, valid = np.ones(count), np.zeros(count, bool)
    for vertex in range(count):
        length = np.linalg.norm(normals[vertex])
        if length == 0:
            continue
        normal = normals[vertex] / length
        sums, weights = {1: np.zeros(3), -1: np.zeros(3)}, {1: 0.0, -1: 0.0}
        for face in faces:
            frame = triangle_reference(positions[face], uvs[face])
            if frame is None:
                continue
            for corner in np.flatnonzero(face == vertex):
                here, after, before = positions[np.roll(face, -corner)]
                angle = angle_between(flat(after - here, normal), flat(before - here, normal))
                across = flat(frame[0] / np.linalg.norm(frame[0]), normal)
                if np.linalg.norm(across) > 1e-12:
                    sums[frame[2]] += angle * across / np.linalg.norm(across)
                    weights[frame[2]] += angle
        side = 1 if weights[1] > 0 else -1
        if weights[-side] > 0 or np.linalg.norm(sums[side]) <= 1e-3 * weights[side]:
            continue
        valid[vertex], handedness[vertex] = True, side
        tangent[vertex] = sums[side] / np.linalg.norm(sums[side])
        bitangent[vertex] = side * np.cross(normal, tangent[vertex])
    return FrameReference(tangent, bitangent, handedness, valid)


def split_reference(uvs, faces):
    """Return which corners take a copy of their vertex: those of the side with fewer faces."""
    sign = [_uv_sign(uvs[face]) for face in faces]
    corners = np.zeros((len(faces), 3), bool)
    for vertex in range(len(uvs)):
        users = [(i, s) for i, s in enumerate(sign) for v in faces[i] if v == vertex]
        plain, mirrored = (sum(s == side for _, s in users) for side in (1, -1))
        leaving = -1 if plain >= mirrored else 1
        for i, s in users:
            if plain and mirrored and s == leaving:
                corners[i, faces[i] == vertex] = True
    return corners


def flat(vector, normal):
    """Project a vector onto the plane of a unit normal."""
    return vector - normal * (normal @ vector)


def angle_between(a, b):
    """Return the angle in [0, pi]; a right one if a vector has no direction left."""
    lengths = np.linalg.norm(a) * np.linalg.norm(b)
    return np.arccos(np.clip(a @ b / lengths, -1, 1)) if lengths > 1e-12 else np.pi / 2


def height(corners):
    """Return a triangle's height over its longest edge, as a share of that edge."""
    edges = np.roll(corners, -1, axis=0) - corners
    lengths = np.linalg.norm(edges, axis=1)
    i = np.argmax(lengths)
    if lengths[i] == 0:
        return 0.0
    along = edges[i] / lengths[i]
    return np.linalg.norm(flat(edges[i - 1], along)) / lengths[i]


def _uv_sign(uvs):
    a, b = uvs[1] - uvs[0], uvs[2] - uvs[0]
    return np.sign(a[0] * b[1] - a[1] * b[0])
