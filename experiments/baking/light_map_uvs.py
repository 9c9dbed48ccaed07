"""Texture coordinates for a light map: the mesh's own where they serve, or new charts.

A light map needs a place of its own for each point of the surface; coordinates for
textures often repeat or mirror. Charts are those of xatlas, the same in every run.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import xatlas
from jaxtyping import Float

from shadows.rasterize import rasterize_two
from tangentspace.mesh import Mesh

_LOOK = 512  # texels on which overlaps are looked for
_SHARED = 0.001  # share of doubly covered texels above which charts count as overlapping


class Unwrapped(NamedTuple):
    """A mesh with coordinates for a light map.

    Attributes:
        mesh: The mesh, its vertices split where charts part.
        uvs: In [0, 1], v up, for each vertex.
        reason: Why the mesh's own coordinates do not serve; empty if they do.
    """

    mesh: Mesh
    uvs: Float[np.ndarray, "vertices 2"]
    reason: str


def light_map_uvs(mesh: Mesh) -> Unwrapped:
    """Return coordinates under which no two faces overlap.

    Args:
        mesh: Any mesh.
    """
    reason = _unfit(mesh)
    if not reason:
        assert mesh.uvs is not None
        return Unwrapped(mesh, np.asarray(mesh.uvs, np.float32), "")
    source, faces, uvs = xatlas.parametrize(
        np.ascontiguousarray(mesh.positions, np.float32),
        np.ascontiguousarray(mesh.faces, np.uint32),
    )
    split: dict[str, Any] = {
        name: None if values is None else np.asarray(values)[source]
        for name, values in mesh._replace(faces=None)._asdict().items()
    }
    return Unwrapped(Mesh(**split)._replace(faces=faces.astype(np.int32)), uvs, reason)


def _unfit(mesh: Mesh) -> str:
    """Return why a mesh's coordinates do not serve a light map; empty if they do."""
    if mesh.uvs is None:
        return "no uvs"
    uvs = np.asarray(mesh.uvs)
    if not np.isfinite(uvs).all() or uvs.min() < 0 or uvs.max() > 1:
        return "uvs outside 0 to 1"
    corners = uvs[np.asarray(mesh.faces)].astype(np.float64)
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    flat = np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) <= 1e-12
    if flat.mean() > _SHARED:
        return "faces without area in uv"
    clip = np.concatenate([2 * uvs - 1, np.zeros((len(uvs), 1)), np.ones((len(uvs), 1))], axis=1)
    first, second = jax.jit(lambda c, f: rasterize_two(c, f, image_size=(_LOOK, _LOOK)))(
        jnp.asarray(clip, jnp.float32), jnp.asarray(mesh.faces)
    )
    covered, twice = (np.asarray(layer.face_ids >= 0).sum() for layer in (first, second))
    return "overlapping uvs" if twice > _SHARED * covered else ""
