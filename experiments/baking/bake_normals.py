"""A normal map for a low-poly mesh, baked from a detailed one by rays.

For several points of each texel a ray goes from a cage round the low-poly surface inwards
(``bake_cage``). The detailed mesh's smooth normal where it lands is expressed in the frame
that the renderer will have there, as ``unperturb_normal`` does: the exact inverse of the
reconstruction in ``perturb_normal``, with MikkTSpace tangents. Texels hold the mean over
their points that found something, of unit length.

Shading normals and tangents are those of the low-poly mesh, hard edges included, so the
map belongs to these very vertices, normals and UVs.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from tangentspace.mesh import Mesh
from tangentspace.mikktspace import with_tangents
from tangentspace.normal_map import encode_normals
from tangentspace.pixel_frame import unperturb_normal

from ..files.smooth_normals import smooth_normals, unit
from .bake_cage import Detail, find_cage
from .charts import Charts, bands, draw, lay_out, shared_texels
from .dilate import dilate

_FLAT = np.array([0.0, 0.0, 1.0], np.float32)
_MOST_MISSED = 0.5


class NormalBake(NamedTuple):
    """A baked map and how it came about.

    Attributes:
        texels: Raw RGB in [0, 1], green +Y, row 0 on top; flat where nothing is known.
        charted: Texels that the low-poly mesh's faces reach.
        found: Those of them with a point that detail was found for.
        cage: How far the cage is from the low-poly surface, world length.
        missed: Share of the rays from the surface that found nothing.
        notes: What a reader should know, one line each.
    """

    texels: Float[np.ndarray, "size size 3"]
    charted: Bool[np.ndarray, "size size"]
    found: Bool[np.ndarray, "size size"]
    cage: float
    missed: float
    notes: tuple[str, ...]


def bake_normals(
    high: Mesh,
    low: Mesh,
    *,
    size: int = 1024,
    cage: float | None = None,
    samples: int = 3,
    margin: int = 16,
    names: tuple[str, str] = ("`high`", "`low`"),
    report: Callable[[str], None] = lambda text: None,
) -> NormalBake:
    """Bake a tangent-space normal map.

    Args:
        high: The detailed mesh, in the same place; its normals count, UVs are not needed.
        low: The low-poly mesh, with UVs. Without tangents it gets those of MikkTSpace.
        size: Texels on each side of the map.
        cage: How far from the low-poly surface rays start, and end behind it, world
            length; None for ``find_cage``.
        samples: Rays per texel along each side: 3 are nine rays, evenly spread.
        margin: How many texels beyond the charts hold a copy of the nearest texel inside.
        names: What error texts call the two meshes.
        report: Takes a line on how far the work is.

    Returns:
        The map; where no ray of a texel found anything, it holds what its neighbours hold
        as far as the margin reaches.

    Raises:
        ValueError: If a number is out of range, a mesh is not finite, ``low`` has no UVs or
            none with an area, or more than half of the rays miss ``high``.
    """
    check_options(size=size, cage=cage, samples=samples, margin=margin, prefix="bake_normals: ")
    for mesh, name in zip((high, low), names, strict=True):
        _check_mesh(mesh, name)
    charts = lay_out(low, name=names[1])
    if low.tangents is None:
        low = with_tangents(low)
    detail = Detail(high)
    if cage is None:
        report("looking for the cage's distance")
        cage = find_cage(low, detail)
        if not np.isfinite(cage):
            raise ValueError(
                f"{names[0]}: no ray from {names[1]} meets it; bring both meshes to one place "
                "and size, or give the cage's distance"
            )
    sums = np.zeros((size, size, 3), np.float32)
    rays, hits = np.zeros((2, size, size), np.int32)
    corner_values = _corner_values(low)
    steps = [(band, offset) for band in bands(size) for offset in _offsets(samples)]
    for step, (band, offset) in enumerate(steps):
        report(f"{step} of {len(steps)}")
        faces, values = draw(charts, corner_values, band, offset=offset)
        places = np.asarray(values[..., :6])
        normals, found = detail_normals(high, detail, faces >= 0, places, cage)
        local = np.asarray(_to_tangent_space(jnp.asarray(normals), values))
        sums[band.place] += np.where(found[..., None], local, 0)[band.kept]
        rays[band.place] += (faces >= 0)[band.kept]
        hits[band.place] += found[band.kept]
    charted, found = rays > 0, hits > 0
    if not charted.any():
        raise ValueError(
            f"{names[1]}: its faces reach no point of a map of {size} x {size} texels; choose a "
            "larger size or unwrap it again"
        )
    missed = int(rays.sum() - hits.sum()) / int(rays.sum())
    if missed > _MOST_MISSED:
        raise ValueError(
            f"{names[0]}: {missed:.0%} of the rays from {names[1]} do not meet it within "
            f"{cage:.3g} of the surface; bring both meshes to one place and size, or give a "
            "larger cage"
        )
    normals, filled = dilate(_unit(sums), found, margin=margin)
    texels = encode_normals(np.where(filled[..., None], normals, _FLAT))
    notes = charts.notes + _shared(charts, size)
    if missed:
        notes += (
            f"{rays.sum() - hits.sum()} of {rays.sum()} rays found no detail within {cage:.3g} of "
            f"the surface; {(charted & ~found).sum()} texels that have none hold what is next to "
            "them",
        )
    return NormalBake(np.asarray(texels), charted, found, cage, missed, notes)


def detail_normals(
    high: Mesh,
    detail: Detail,
    surface: Bool[np.ndarray, "rows columns"],
    places: Float[np.ndarray, "rows columns 6"],
    cage: float,
) -> tuple[Float[np.ndarray, "rows columns 3"], Bool[np.ndarray, "rows columns"]]:
    """Return the detailed mesh's normals that belong to points of the low-poly surface.

    Args:
        high: The detailed mesh.
        detail: The same, prepared for rays.
        surface: Where there is a point.
        places: Its position and the cage's normal there, of any length, world space.
        cage: How far from the surface the cage is, world length.

    Returns:
        Unit normals, world space, and where a ray found one; 0 elsewhere.
    """
    position, outward = places[surface].astype(np.float64).reshape(-1, 2, 3).swapaxes(0, 1)
    outward, nowhere = unit(outward)
    hits = detail.first_front(position + cage * outward, outward, 2 * cage)
    corners = np.asarray(high.faces)[hits.faces]
    normal, none = unit(np.einsum("rk,rkx->rx", hits.weights, np.asarray(high.normals)[corners]))
    found_here = (hits.faces >= 0) & ~none & ~nowhere
    normals, found = np.zeros((*surface.shape, 3), np.float32), np.zeros(surface.shape, bool)
    normals[surface] = np.where(found_here[:, None], normal, 0)
    found[surface] = found_here
    return normals, found


def check_options(*, size: int, cage: float | None, samples: int, margin: int, prefix: str) -> None:
    """Refuse numbers that ``bake_normals`` cannot use.

    Args:
        size: Texels on each side of the map.
        cage: World length, or None.
        samples: Rays per texel along each side.
        margin: Texels.
        prefix: What error texts put before an option's name.

    Raises:
        ValueError: If one is out of range.
    """
    ranges = {"size": (size, 1, 8192), "samples": (samples, 1, 16), "margin": (margin, 0, 8192)}
    for name, (value, least, most) in ranges.items():
        if not least <= value <= most:
            raise ValueError(f"{prefix}{name}: expected {least} to {most}, got {value}")
    if cage is not None and not 0 < cage < np.inf:
        raise ValueError(f"{prefix}cage: expected a finite world length above 0, got {cage:g}")


def _offsets(samples: int) -> list[tuple[float, float]]:
    """Return points of a texel, the centres of its equal parts."""
    places = (np.arange(samples) + 0.5) / samples
    return [(float(right), float(down)) for down in places for right in places]


def _corner_values(low: Mesh) -> Float[np.ndarray, "faces 3 13"]:
    """Return position, cage normal, shading normal and tangent of each face's corners."""
    positions, faces = np.asarray(low.positions), np.asarray(low.faces)
    columns = (positions, smooth_normals(positions, faces), low.normals, low.tangents)
    return np.concatenate([np.asarray(c, np.float32) for c in columns], axis=1)[faces]


@jax.jit
def _to_tangent_space(
    normals: Float[Array, "rows size 3"], values: Float[Array, "rows size 13"]
) -> Float[Array, "rows size 3"]:
    return unperturb_normal(normals, values[..., 9:], values[..., 6:9])


def _unit(vectors: Float[np.ndarray, "size size 3"]) -> Float[np.ndarray, "size size 3"]:
    """Return vectors of length 1; flat normals where they cancel."""
    length = np.sqrt(np.einsum("...x,...x", vectors, vectors))[..., None]
    return np.where(length > 0, vectors / np.where(length > 0, length, 1), _FLAT)


def _shared(charts: Charts, size: int) -> tuple[str, ...]:
    """Say how many texels belong to several faces."""
    across, same = shared_texels(charts, size)
    notes = ()
    if across:
        notes += (f"{across} texels shared by mirrored faces: the others' detail is baked",)
    if same:
        notes += (
            f"{same} texels shared by several faces: the first one's detail is baked; unwrap the "
            "low mesh without overlaps to keep all",
        )
    return notes


def _check_mesh(mesh: Mesh, name: str) -> None:
    """Refuse a mesh without faces, with missing vertices, or with numbers that are not finite."""
    faces, count = np.asarray(mesh.faces), len(mesh.positions)
    if not len(faces):
        raise ValueError(f"{name}: has no faces; a mesh of faces is needed")
    if faces.min() < 0 or faces.max() >= count:
        raise ValueError(
            f"{name}: expected faces from 0 to {count - 1} (the vertices there are), got "
            f"{faces.min()} to {faces.max()}; repair the mesh"
        )
    for what in ("positions", "normals", "tangents"):
        values = getattr(mesh, what)
        if values is not None and not np.isfinite(np.asarray(values)).all():
            raise ValueError(f"{name}: has {what} that are NaN or infinite; repair the mesh")
