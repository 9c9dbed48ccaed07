"""Rays from a low-poly mesh to a detailed one, and how far from it they have to start.

The cage is the low-poly surface pushed outwards, along normals that are smooth everywhere
(also across hard edges, where a cage along the shading normals would gape). A ray starts on
it and goes inwards, as far behind the surface as it started before it, and what counts is
the first face that it meets from the front: the outermost layer of detail, as bakers have
it. Faces met from behind belong to another part of the mesh, and are passed through.

Embree computes in float32, so the mesh is moved to its bounds' centre and scaled to unit
size first.
"""

from typing import NamedTuple

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from jaxtyping import Float, Int

from tangentspace.mesh import Mesh

from ..files.framing import bounding_sphere
from ..files.smooth_normals import smooth_normals, unit

Vectors = Float[np.ndarray, "rays 3"]
_STEP = 1e-6  # past a face met from behind, in units of the mesh
_RAYS = 2**17
_CAUGHT = 0.999  # share of the rays that meet anything which the cage must catch
_MARGIN = 1.5  # of the cage over the distance that catches them
# In radii of the low-poly mesh:
_REACH = 0.5  # how far detail is looked for
_LEAST = 1e-3  # the least cage
_APART = 1e-5  # how far behind a point a ray through it starts


class Hits(NamedTuple):
    """What rays met.

    Attributes:
        faces: The face, -1 where there is none.
        distances: From the ray's origin, world units; infinity where there is none.
        weights: Barycentric weights of the point on the face; 0 where there is none.
    """

    faces: Int[np.ndarray, " rays"]
    distances: Float[np.ndarray, " rays"]
    weights: Float[np.ndarray, "rays 3"]


class Detail:
    """A detailed mesh, prepared for rays."""

    def __init__(self, mesh: Mesh) -> None:
        """Prepare the mesh, whose positions are finite and whose faces are in range."""
        positions, faces = np.asarray(mesh.positions, np.float64), np.asarray(mesh.faces, np.int32)
        used = positions[np.unique(faces)]
        low, high = used.min(axis=0), used.max(axis=0)
        self._center = 0.5 * (low + high)
        self._unit = float(max((high - low).max(), 1e-30))
        self._scene = EmbreeScene(robust=True)
        TriangleMesh(self._scene, self._to_local(positions), faces)

    def first_front(
        self, origins: Vectors, outwards: Vectors, reach: float, *, inwards: bool = True
    ) -> Hits:
        """Return the first face on each ray that looks outwards.

        Args:
            origins: Where the rays start, world space.
            outwards: Unit vectors; faces turned away from them are passed through.
            reach: Length of the rays, world units.
            inwards: Whether the rays go against ``outwards`` or along it.
        """
        sign = np.float32(-1 if inwards else 1)
        directions = sign * outwards.astype(np.float32)
        count = len(origins)
        hits = Hits(np.full(count, -1), np.full(count, np.inf), np.zeros((count, 3), np.float32))
        passed, step = np.zeros(count), _STEP
        todo = np.arange(count)
        while len(todo):
            ahead = directions[todo]
            hit = self._scene.run(
                self._to_local(origins[todo] + self._unit * passed[todo, None] * ahead),
                ahead,
                dists=(reach / self._unit - passed[todo]).astype(np.float32),
                output=True,
            )
            met = hit["primID"] >= 0
            front = met & (sign * np.einsum("ra,ra->r", hit["Ng"], ahead) > 0)
            found = todo[front]
            second, third = hit["u"][front], hit["v"][front]
            hits.faces[found] = hit["primID"][front]
            hits.distances[found] = self._unit * (passed[found] + hit["tfar"][front])
            hits.weights[found] = np.stack([1 - second - third, second, third], axis=1)
            behind = met & ~front
            todo = todo[behind]
            passed[todo] += hit["tfar"][behind] + step
            step *= 2  # so that even a ray within the plane of many faces ends soon
        return hits

    def _to_local(self, world: Float[np.ndarray, "points 3"]) -> Float[np.ndarray, "points 3"]:
        """Return Embree's coordinates of world-space points."""
        return ((world - self._center) / self._unit).astype(np.float32)


def find_cage(low: Mesh, detail: Detail) -> float:
    """Return how far the cage must be from the low-poly surface.

    From points all over the surface the nearest detail is looked for on both sides, along
    the smooth normals, up to half the radius of the mesh. The cage catches 99.9 % of what
    was found (the rest may be holes through which other parts are seen), times 1.5.

    Args:
        low: The low-poly mesh.
        detail: The detailed mesh.

    Returns:
        The distance in world units; infinity where no ray found anything.
    """
    _, radius = bounding_sphere(low.positions[np.unique(low.faces)])
    points, outwards = _surface_points(low, _RAYS)
    apart = _APART * radius
    sides = [
        detail.first_front(points - side * apart * outwards, outwards, _REACH * radius, inwards=i)
        for side, i in ((-1, True), (1, False))
    ]
    nearest = np.minimum(*(np.abs(hits.distances - apart) for hits in sides))
    found = nearest[np.isfinite(nearest)]
    if not len(found):
        return np.inf
    return float(max(_MARGIN * np.quantile(found, _CAUGHT), _LEAST * radius))


def _surface_points(mesh: Mesh, count: int) -> tuple[Vectors, Vectors]:
    """Return random points, evenly spread over the surface, and unit normals of the cage."""
    corners = np.asarray(mesh.positions, np.float64)[mesh.faces]
    normals = smooth_normals(np.asarray(mesh.positions), np.asarray(mesh.faces))[mesh.faces]
    double_area = np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    )
    rng = np.random.default_rng(0)
    faces = rng.choice(len(corners), count, p=double_area / double_area.sum())
    weights = rng.dirichlet([1, 1, 1], count)
    points = np.einsum("pk,pkx->px", weights, corners[faces])
    outwards, missing = unit(np.einsum("pk,pkx->px", weights, normals[faces]))
    return points[~missing], outwards[~missing]
