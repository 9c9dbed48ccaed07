"""All tangent frames of a mesh and their derivatives, in one program for meshes of many sizes."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from tangentspace import (
    CornerGroups,
    corner_groups,
    corner_tangents,
    face_normals,
    gram_schmidt,
    group_tangents,
    perturb_normal,
    triangle_frames,
    vertex_frames,
    vertex_normals,
)
from tangentspace.mesh import Mesh

from .views import on_device, padded, quick

LARGEST = 1250, 2250  # vertices and faces of the largest mapped scene
BUMP = np.array([0.3, -0.2, 0.9])  # what a normal map holds, everywhere


class Framed(NamedTuple):
    """Frames of a padded mesh.

    Attributes:
        mesh: The mesh, padded.
        tangents: Of corners, equal to MikkTSpace's.
        made: All others by name.
        slopes: Derivatives of a sum over all numbers in positions, normals and UVs.
    """

    mesh: Mesh
    tangents: np.ndarray
    made: dict[str, Any]
    slopes: Any


@quick
def framed(positions: Any, normals: Any, uvs: Any, groups: CornerGroups, bumps: Any) -> Any:
    """Return what frames there are, and the gradient of a sum over all their numbers."""

    def total(positions: Any, normals: Any, uvs: Any) -> Any:
        frames = vertex_frames(positions, normals, uvs, groups.faces)
        corners = group_tangents(positions, normals, uvs, groups)
        made = {
            "faces": face_normals(positions, groups.faces),
            "vertices": vertex_normals(positions, groups.faces),
            "triangles": triangle_frames(positions, uvs, groups.faces),
            "frames": frames,
            "orthonormal": gram_schmidt(frames.tangent, frames.bitangent, normals),
            "corners": corners,
            "pixels": perturb_normal(bumps, corners, normals[groups.faces]),
        }
        numbers = jax.tree.leaves(eqx.filter(made, eqx.is_inexact_array))
        return sum(jnp.sum(jnp.sin(leaf)) for leaf in numbers), made

    return jax.value_and_grad(total, argnums=(0, 1, 2), has_aux=True)(positions, normals, uvs)


def padded_groups(mesh: Mesh) -> CornerGroups:
    """Return a mesh's groups with more sums, which nothing reads; the default stays the last."""
    assert mesh.uvs is not None
    groups = corner_groups(mesh.positions, mesh.normals, mesh.uvs, mesh.faces)
    count, default = groups.faces.size, len(groups.handedness) - 1
    grown = lambda values, fill: np.concatenate(
        [values, np.full(count - len(values), fill, np.int32)]
    )
    return groups._replace(
        members=grown(groups.members, 0),
        sums=grown(groups.sums, count - 1),
        handedness=grown(groups.handedness, groups.handedness[-1]),
        corner_sums=np.where(groups.corner_sums == default, count - 1, groups.corner_sums),
    )


def frames_of(mesh: Mesh, dtype: Any = np.float32) -> Framed:
    """Return all frames of a mesh that is not larger than the others."""
    mesh = padded(mesh, *LARGEST)
    groups = padded_groups(mesh)
    bumps = np.broadcast_to(BUMP, (*groups.faces.shape, 3))
    numbers = on_device((mesh.positions, mesh.normals, mesh.uvs, bumps), dtype)
    (_, made), slopes = framed(*numbers[:3], groups, numbers[3])
    return Framed(mesh, corner_tangents(mesh), made, slopes)
