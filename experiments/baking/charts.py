"""A mesh drawn into its own texture: which face each texel belongs to, and what is there.

Texel centres are at half integers; row 0 is at the top, where v is 1. The texture repeats:
a face that reaches over its edge is drawn on the other side as well. Where faces share a
texel, one that is not mirrored comes before one that is, and a lower index before a higher.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from shadows.interpolate import barycentrics, interpolate
from shadows.rasterize import rasterize
from tangentspace.mesh import Mesh

from ..files.mesh_build import counted

_BAND = 2**20  # texels drawn at a time
_ROUNDING = 1e-4  # of UVs, in repetitions


class Charts(NamedTuple):
    """The faces of a mesh in its texture, once for every repetition that they reach into.

    Attributes:
        corners: UVs of the copies; each meets the unit square.
        faces: For each copy, the face of the mesh.
        mirrored: For each copy, whether it shows the texture's back.
        notes: What a reader should know, one line each.
    """

    corners: Float[np.ndarray, "copies 3 2"]
    faces: Int[np.ndarray, " copies"]
    mirrored: Bool[np.ndarray, " copies"]
    notes: tuple[str, ...]


class Band(NamedTuple):
    """Some rows of a texture as a place to draw into, below the image's end if need be.

    Attributes:
        top: The first row.
        rows: How many rows are drawn.
        size: Texels on each side of the whole texture.
    """

    top: int
    rows: int
    size: int

    @property
    def kept(self) -> slice:
        """Which of the rows drawn lie in the texture."""
        return slice(0, min(self.rows, self.size - self.top))

    @property
    def place(self) -> slice:
        """Where in the texture they are."""
        return slice(self.top, min(self.top + self.rows, self.size))


def lay_out(mesh: Mesh, *, name: str) -> Charts:
    """Find the faces that cover texels, and the repetitions of the texture they lie in.

    Args:
        mesh: With finite UVs.
        name: What error texts call the mesh.

    Raises:
        ValueError: If the mesh has no UVs, they are not finite, no face has an area in the
            texture, or a face is larger than the texture.
    """
    if mesh.uvs is None:
        raise ValueError(f"{name}: has no UVs, so it cannot hold a map; unwrap it first")
    corners = np.asarray(mesh.uvs, np.float64)[mesh.faces]
    if not np.isfinite(corners).all():
        raise ValueError(f"{name}: has UVs that are NaN or infinite; unwrap it again")
    across, up = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = across[:, 0] * up[:, 1] - across[:, 1] * up[:, 0]
    flat = area == 0
    if flat.all():
        raise ValueError(f"{name}: no face has an area in the texture; unwrap it first")
    extent = np.ptp(corners, axis=1).max(axis=1)
    if extent[~flat].max() > 1 + _ROUNDING:
        raise ValueError(
            f"{name}: a face reaches over {extent[~flat].max():.3g} repetitions of the texture, "
            "so no texel belongs to one point; unwrap it without tiling"
        )
    first = np.floor(corners.min(axis=1))
    last = np.maximum(np.ceil(corners.max(axis=1)) - 1, first)
    beyond = np.maximum(-corners, corners - 1).max(axis=(1, 2)) > _ROUNDING
    copies, faces = [], []
    for along_u in (0, 1):
        for along_v in (0, 1):
            tile = first + np.array([along_u, along_v])
            reached = np.flatnonzero(~flat & (tile <= last).all(axis=1))
            copies.append(corners[reached] - tile[reached, None])
            faces.append(reached)
    face_of = np.concatenate(faces)
    order = np.argsort(face_of, kind="stable")
    return Charts(
        np.concatenate(copies)[order],
        face_of[order],
        (area < 0)[face_of[order]],
        counted(flat, "face", "faces", "without area in the texture: no texel shows them")
        + counted(~flat & beyond, "face", "faces", "with UVs outside [0, 1]: the texture repeats"),
    )


def bands(size: int) -> list[Band]:
    """Cut a texture into bands of equal size, so that memory is bounded."""
    rows = min(size, max(1, _BAND // size))
    return [Band(top, rows, size) for top in range(0, size, rows)]


def draw(
    charts: Charts,
    corner_values: Float[np.ndarray, "faces 3 channels"],
    band: Band,
    *,
    offset: tuple[float, float] = (0.5, 0.5),
) -> tuple[Int[np.ndarray, "rows size"], Float[Array, "rows size channels"]]:
    """Find the face at one point of each texel, and blend its corners' values there.

    Args:
        charts: Where the faces lie.
        corner_values: What to blend, by face and corner.
        band: The rows to draw.
        offset: Where in the texel the point lies, right and down from its upper left corner.

    Returns:
        The face of the mesh, -1 where there is none, and the values, 0 where there is none.
    """
    clip = jnp.asarray(_clip(charts, band, offset))
    triangles = jnp.arange(len(clip), dtype=jnp.int32).reshape(-1, 3)
    copies = _cover(clip, triangles, image_size=(band.rows, band.size))
    values = jnp.asarray(corner_values[charts.faces].reshape(len(clip), -1))
    return _mesh_faces(charts, copies), _blend(clip, triangles, copies, values)


def shared_texels(charts: Charts, size: int) -> tuple[int, int]:
    """Count the texels whose centre lies in several faces.

    Returns:
        How many are shared by mirrored and other faces, as by the halves of a symmetric
        mesh, and how many by faces of one kind.
    """
    across = same = 0
    for band in bands(size):
        first, last = (_cover_centers(charts, band, order)[band.kept] for order in (1, -1))
        shared = first != last
        differ = charts.mirrored[first[shared]] != charts.mirrored[last[shared]]
        across += int(differ.sum())
        same += int((~differ).sum())
    return across, same


def _cover_centers(charts: Charts, band: Band, order: int) -> Int[np.ndarray, "rows size"]:
    """Return the copy at each texel's centre; in order -1 the one that comes last."""
    clip = _clip(charts, band, (0.5, 0.5))
    clip[:, 2] *= order
    triangles = jnp.arange(len(clip), dtype=jnp.int32).reshape(-1, 3)[::order]
    copies = np.asarray(_cover(jnp.asarray(clip), triangles, image_size=(band.rows, band.size)))
    return np.where(copies < 0, -1, copies if order > 0 else len(triangles) - 1 - copies)


def _clip(
    charts: Charts, band: Band, offset: tuple[float, float]
) -> Float[np.ndarray, "corners 4"]:
    """Return the copies' corners in clip space, as seen through the given points of texels."""
    u, v = charts.corners.reshape(-1, 2).T
    column = band.size * u - offset[0] + 0.5
    row = band.size * (1 - v) - band.top - offset[1] + 0.5
    x, y = 2 * column / band.size - 1, 1 - 2 * row / band.rows
    depth = np.repeat(0.5 * charts.mirrored, 3)
    return np.stack([x, y, depth, np.ones_like(x)], axis=-1).astype(np.float32)


@functools.partial(jax.jit, static_argnames="image_size")
def _cover(clip: Array, triangles: Array, *, image_size: tuple[int, int]) -> Array:
    return rasterize(clip, triangles, image_size=image_size).face_ids


@jax.jit
def _blend(clip: Array, triangles: Array, copies: Array, values: Array) -> Array:
    return interpolate(values, triangles, copies, barycentrics(clip, triangles, copies))


def _mesh_faces(charts: Charts, copies: Array) -> Int[np.ndarray, "rows size"]:
    """Return the face of the mesh for each copy, -1 for none."""
    index = np.asarray(copies)
    return np.where(index < 0, -1, charts.faces[np.maximum(index, 0)])
