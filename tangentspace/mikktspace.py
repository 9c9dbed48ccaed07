"""Tangents equal to MikkTSpace's, the standard that normal maps are baked with.

Each corner of each face gets a tangent and a handedness, ``bitangent = handedness *
cross(normal, tangent)``; UVs have v upwards (v downwards gives the opposite handedness).
Corners of equal position, normal and UV are welded; around a welded vertex the corners of
neighboring faces of one handedness are a group; the group's tangent is the sum of its faces'
``dp/du``, each taken into the plane of the normal, to unit length, weighted by the corner's
angle in that plane; the sum is normalized once.

`corner_tangents` repeats the reference's arithmetic to the last bits. `corner_groups` finds
what is a matter of integers, and `group_tangents` sums in JAX: smooth while the groups stay.
Normals are taken as they are: unit length is expected, and not seen to.

References:
    M. S. Mikkelsen, "Simulation of Wrinkled Surfaces Revisited", master's thesis, 2008, and
    its reference implementation, mikktspace.c, version 1.0.
"""

import jax.numpy as jnp
import numpy as np
from jax.lax import stop_gradient
from jaxtyping import Array, Float, Float32, Int

from ._math import dot, safe_divide, safe_norm, safe_normalize
from ._mikktspace_arithmetic import normalize
from ._mikktspace_survey import DEFAULT, survey
from ._mikktspace_survey import CornerGroups as CornerGroups
from ._mikktspace_weld import equal_rows
from .mesh import Mesh

Vectors = Float[Array | np.ndarray, "vertices 3"]
Uvs = Float[Array | np.ndarray, "vertices 2"]
Faces = Int[Array | np.ndarray, "faces 3"]


def corner_groups(positions: Vectors, normals: Vectors, uvs: Uvs, faces: Faces) -> CornerGroups:
    """Find the groups of corners that share a tangent.

    Args:
        positions: Vertex positions; this and the next two are rounded to single precision.
        normals: Vertex normals.
        uvs: Texture coordinates, v upwards.
        faces: Vertex indices.

    Returns:
        The groups as NumPy arrays, to be kept while positions, normals and UVs are fitted.

    Raises:
        ValueError: If an array has the wrong shape, or a number that is not finite in single
            precision, or ``faces`` name a missing vertex.
    """
    return survey("corner_groups", positions, normals, uvs, faces)[0]


def corner_tangents(mesh: Mesh) -> Float32[np.ndarray, "faces 3 4"]:
    """Compute the tangent and the handedness of every corner as MikkTSpace does.

    Equal also where rounding or the order of the faces decides: mirrored, degenerate and
    zero-area UVs, edges of many faces, opposite tangents that cancel. The order decides at
    few corners: of faces without area in UV space, at edges of more than two faces, and
    where the reference leaves edges unsorted (see `_mikktspace_links`).

    Args:
        mesh: A mesh with UVs; its arrays are rounded to single precision.

    Returns:
        Tangents, and the handedness +1 or -1 in the last column. Tangents have unit length,
        but (0, 0, 0) where no contribution has a direction or weight, as at the ends of a
        sliver, or all cancel exactly, and where the reference's numbers are not finite.
        Corners of no group (a face without area in UV space that no neighbor takes in;
        repeated positions at a vertex of no better face) have the default: (1, 0, 0) of
        handedness -1, whatever the normal.

    Raises:
        ValueError: If the mesh has no UVs, and as `corner_groups`.
    """
    return _tangents_of_corners("corner_tangents", mesh)


def group_tangents(
    positions: Vectors, normals: Vectors, uvs: Uvs, groups: CornerGroups
) -> Float[Array, "faces 3 4"]:
    """Compute the tangents of given groups, differentiably.

    Args:
        positions: Vertex positions.
        normals: Vertex normals; unit length is expected.
        uvs: Texture coordinates, v upwards.
        groups: What `corner_groups` found for this mesh, or for one that it was: the groups
            and their handedness stay.

    Returns:
        Tangents and handedness as `corner_tangents`; but directions, angles and sums that
        are 0 up to rounding count as 0.

    Differentiability:
        Smooth in ``positions``, ``normals`` and ``uvs`` but where an edge, a face in UV
        space or a sum degenerates or an angle is 0 or 180 degrees: such an item has
        derivative zero, as has the default, and all others keep theirs.
    """
    positions, normals, uvs = jnp.asarray(positions), jnp.asarray(normals), jnp.asarray(uvs)
    corners, normals, uvs = (array[groups.faces] for array in (positions, normals, uvs))
    to_next = _projected(_unit(jnp.roll(corners, -1, axis=1) - corners), normals)
    to_previous = _projected(_unit(jnp.roll(corners, 1, axis=1) - corners), normals)
    angles = _angles(to_next, to_previous)[..., None]
    tangents = _projected(_along_u(corners, uvs)[:, None, :], normals)
    weighted = jnp.concatenate([angles * tangents, angles], axis=-1).reshape(-1, 4)
    sums = jnp.zeros((len(groups.handedness), 4), weighted.dtype)
    sums = sums.at[groups.sums].add(weighted[groups.members])
    means = safe_divide(sums[:, :3], stop_gradient(sums[:, 3:]))
    handedness = jnp.asarray(groups.handedness, means.dtype)[:, None]
    unit = safe_normalize(handedness * means, eps=_rounding(means) ** 2)
    unit = unit.at[-1].set(jnp.array(DEFAULT[:3], means.dtype))
    return jnp.concatenate([unit, handedness], axis=-1)[groups.corner_sums]


def with_tangents(mesh: Mesh) -> Mesh:
    """Give a mesh MikkTSpace's tangents, splitting vertices where corners differ.

    Args:
        mesh: A mesh with UVs.

    Returns:
        The mesh with a tangent and handedness per vertex, in the precision of its positions.
        Vertices keep their places, with the tangent of the first corner that names them;
        copies for corners that differ are appended in the order of these corners. Vertices
        of no face have the default, (1, 0, 0) of handedness -1.

    Raises:
        ValueError: As `corner_tangents`.
    """
    tangents = _tangents_of_corners("with_tangents", mesh).reshape(-1, 4)
    faces, count = np.asarray(mesh.faces), len(mesh.positions)
    vertices = faces.ravel().astype(np.int64)
    variants = vertices * (len(vertices) + 1) + equal_rows(tangents)
    _, first, variant = np.unique(variants, return_index=True, return_inverse=True)
    order = np.argsort(first)
    _, keeping = np.unique(vertices[first[order]], return_index=True)
    copies = np.delete(order, keeping)
    places = vertices[first]
    places[copies] = count + np.arange(len(copies))
    sources = np.concatenate([np.arange(count), vertices[first[copies]]])
    positions, normals, uvs = (
        np.asarray(array)[sources] for array in (mesh.positions, mesh.normals, mesh.uvs)
    )
    per_vertex = np.tile(np.array(DEFAULT, positions.dtype), (len(sources), 1))
    per_vertex[places] = tangents[first]
    faces = places[variant].reshape(-1, 3).astype(faces.dtype)
    return Mesh(positions, normals, faces, uvs, per_vertex)


def _tangents_of_corners(name: str, mesh: Mesh) -> Float32[np.ndarray, "faces 3 4"]:
    """Sum the groups' tangents in the reference's arithmetic."""
    if mesh.uvs is None:
        raise ValueError(f"{name}: expected a mesh with `uvs`, got None; unwrap it first")
    groups, weighted = survey(name, mesh.positions, mesh.normals, mesh.uvs, mesh.faces)
    sums = np.zeros((3, len(groups.handedness)), np.float32)
    with np.errstate(all="ignore"):
        for total, column in zip(sums, weighted, strict=True):
            np.add.at(total, groups.sums, column[groups.members])  # one by one, as listed
        tangents = normalize(sums)
    tangents[:, ~np.all(np.isfinite(tangents), axis=0)] = 0
    table = np.column_stack([*tangents, groups.handedness.astype(np.float32)])
    table[-1] = DEFAULT
    return table[groups.corner_sums]


def _along_u(
    corners: Float[Array, "faces 3 3"], uvs: Float[Array, "faces 3 2"]
) -> Float[Array, "faces 3"]:
    """Return the unit directions of dp/du, up to the sign; 0 where there is none.

    Edges, and differences of v, are first divided by the largest of the face: squares of
    small ones would vanish, and the direction does not change.
    """
    edges, rises = corners[:, 1:] - corners[:, :1], uvs[:, 1:, 1] - uvs[:, :1, 1]
    largest = jnp.max(jnp.abs(edges), axis=(1, 2), keepdims=True)
    edges = safe_divide(edges, stop_gradient(largest))
    rises = safe_divide(rises, stop_gradient(jnp.max(jnp.abs(rises), axis=1, keepdims=True)))
    return safe_normalize(rises[:, 1:] * edges[:, 0] - rises[:, :1] * edges[:, 1])


def _unit(vectors: Float[Array, "*rows 3"]) -> Float[Array, "*rows 3"]:
    """Scale vectors of any length to unit length; 0 stays 0."""
    largest = jnp.max(jnp.abs(vectors), axis=-1, keepdims=True)
    return safe_normalize(safe_divide(vectors, stop_gradient(largest)))


def _projected(
    directions: Float[Array, "faces corners 3"], normals: Float[Array, "faces 3 3"]
) -> Float[Array, "faces 3 3"]:
    """Take unit directions into the planes of the normals, to unit length again."""
    projected = directions - dot(normals, directions)[..., None] * normals
    return safe_normalize(projected, eps=_rounding(projected) ** 2)


def _angles(a: Float[Array, "faces 3 3"], b: Float[Array, "faces 3 3"]) -> Float[Array, "faces 3"]:
    """Return the angles between unit vectors; a right angle where one is 0."""
    sine, cosine = safe_norm(jnp.cross(a, b), eps=_rounding(a) ** 2), dot(a, b)
    # The angle's derivative has no limit at (0, 0): there a harmless sine stands in.
    right = (sine == 0) & (cosine == 0)
    return jnp.arctan2(jnp.where(right, 1.0, sine), jnp.where(right, 0.0, cosine))


def _rounding(array: Float[Array, "..."]) -> float:
    """Return 8 units of rounding: shorter remainders of unit vectors are noise."""
    return 8 * float(jnp.finfo(array.dtype).eps)
