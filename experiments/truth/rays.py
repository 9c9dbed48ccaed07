"""Ray-traced shadows: which points of a surface see the light, by one ray from each.

Embree computes in float32, so the mesh is moved to its bounds' centre and scaled to unit
size first. A ray starts a little off its surface, on the side of the geometric normal; how
far is a bound on the rounding errors there, which grow with the coordinates (C. Waechter,
N. Binder, "A Fast and Robust Method for Avoiding Self-Intersection", Ray Tracing Gems,
2019). Shadows are hard: a light is a direction or a point.
"""

import jax.numpy as jnp
import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from jaxtyping import Array, Bool, Float, Int

from shadows.lights import Light

Vectors = Float[Array | np.ndarray, "*image 3"]
FaceIds = Int[Array | np.ndarray, "*image"]
_FLOAT32_EPS = float(np.finfo(np.float32).eps)


class Occluders:
    """The faces of a mesh, prepared for rays; no ray meets a face without area.

    Attributes:
        face_count: Number of faces given.
    """

    def __init__(
        self,
        positions: Float[Array | np.ndarray, "vertices 3"],
        faces: Int[Array | np.ndarray, "faces 3"],
    ) -> None:
        """Prepare the mesh.

        Args:
            positions: Vertex positions, world space. Their floating-point type tells how
                exact they are: what it cannot resolve casts no shadow.
            faces: Vertex indices.

        Raises:
            ValueError: If there is no face, a face names a missing vertex, or a face has a
                corner that is not finite.
        """
        world, faces = np.asarray(positions), np.asarray(faces)
        if faces.ndim != 2 or faces.shape[1] != 3 or len(faces) == 0:
            raise ValueError(f"Occluders: expected `faces` (faces > 0, 3), got {faces.shape}")
        if faces.min() < 0 or faces.max() >= len(world):
            raise ValueError(
                f"Occluders: expected `faces` from 0 to {len(world) - 1} (the vertices there "
                f"are), got {faces.min()} to {faces.max()}"
            )
        used = world[np.unique(faces)].astype(np.float64)
        if not np.isfinite(used).all():
            raise ValueError("Occluders: expected finite `positions`, got NaN or infinity")
        low, high = used.min(axis=0), used.max(axis=0)
        self._world_eps = float(np.finfo(world.dtype).eps)
        self._center = 0.5 * (low + high)
        self._unit = 2.0 ** np.ceil(np.log2(max((high - low).max(), 1e-30)))
        local = self._to_local(world)
        self._corners = local.astype(np.float64)[faces]
        self.face_count = len(faces)
        self._scene = EmbreeScene(robust=True)
        TriangleMesh(self._scene, local, faces.astype(np.int32))

    def hit_distance(
        self,
        origins: Float[np.ndarray, "rays 3"],
        directions: Float[np.ndarray, "rays 3"],
        reach: Float[np.ndarray, " rays"],
        own_faces: Int[np.ndarray, " rays"],
    ) -> Float[np.ndarray, " rays"]:
        """Return how far each ray goes to the first face that is not its own.

        Args:
            origins: Where the rays start, world space.
            directions: Unit vectors.
            reach: Lengths of the rays, world units; infinity allowed.
            own_faces: The face that each ray passes through unhindered; -1 for none.

        Returns:
            Distances in world units, infinity where nothing is hit.
        """
        distances = np.full(len(origins), np.inf)
        passed = np.zeros(len(origins))
        step = 1e-6
        todo = np.arange(len(origins))
        while len(todo):
            starts = origins[todo] + (self._unit * passed[todo, None]) * directions[todo]
            hit = self._scene.run(
                self._to_local(starts),
                directions[todo].astype(np.float32),
                dists=(reach[todo] / self._unit - passed[todo]).astype(np.float32),
                output=True,
            )
            found = hit["primID"] >= 0
            todo, passed_now = todo[found], passed[todo[found]] + hit["tfar"][found]
            own = hit["primID"][found] == own_faces[todo]
            distances[todo[~own]] = self._unit * passed_now[~own]
            todo = todo[own]
            passed[todo] = passed_now[own] + step
            step *= 2  # so that even a ray within its own plane ends soon
        return distances

    def leave_surface(
        self,
        points: Float[np.ndarray, "rays 3"],
        normals: Float[np.ndarray, "rays 3"],
        directions: Float[np.ndarray, "rays 3"],
        faces: Int[np.ndarray, " rays"],
    ) -> Float[np.ndarray, "rays 3"]:
        """Return origins for rays from points on faces, safe from hits on that surface.

        A point is first put onto its face as Embree has it, which takes away the errors of
        its interpolation, then moved off by the error bound along the normal, and along the
        ray, so that it also leaves the other face of a concave edge. (In an edge of less
        than a right angle, points nearer to it than a few bounds may end up outside.)

        Args:
            points: Surface points, world space.
            normals: Unit geometric normals, on the side that the rays leave to.
            directions: Unit vectors.
            faces: The face of each point.
        """
        corners = self._corners[faces]
        center = self._center / self._unit
        magnitude = np.abs(corners).max(axis=(1, 2))
        world_magnitude = np.abs(corners + center).max(axis=(1, 2))
        # In every trial one eps was enough; two leave a margin, and change 1 ray in 100 000.
        error = 2.0 * (_FLOAT32_EPS * magnitude + self._world_eps * world_magnitude)
        local = _onto_triangles(points / self._unit - center, corners)
        return self._unit * (local + center + error[:, None] * (normals + directions))

    def _to_local(self, world: Float[np.ndarray, "points 3"]) -> Float[np.ndarray, "points 3"]:
        """Return Embree's coordinates of world-space points."""
        return ((world.astype(np.float64) - self._center) / self._unit).astype(np.float32)


def trace_visibility(
    positions: Vectors,
    geometric_normals: Vectors,
    face_ids: FaceIds,
    light: Light,
    occluders: Occluders,
) -> Bool[np.ndarray, "*image"]:
    """Return which surface points the light reaches.

    Args:
        positions: World space; read only where there is a surface.
        geometric_normals: Unit normals of the faces (not the shading normals), on the side
            that is looked at; a point whose normal faces away from the light is not lit.
        face_ids: The face that each point lies on, an index into the occluders' faces; -1
            where there is no surface.
        light: The light; where it has a ``position``, rays end there.
        occluders: The same mesh, prepared.

    Returns:
        True where lit; False where there is no surface.

    Raises:
        ValueError: If the shapes do not fit each other, or a face does not exist.
    """
    facing, distances = _trace(positions, geometric_normals, face_ids, light, occluders)
    return facing & np.isinf(distances)


def nearest_occluder_distance(
    positions: Vectors,
    geometric_normals: Vectors,
    face_ids: FaceIds,
    light: Light,
    occluders: Occluders,
) -> Float[np.ndarray, "*image"]:
    """Return how far it is from each surface point to what hides the light from it.

    Takes and raises what ``trace_visibility`` does.

    Returns:
        Distances along the ray to the first occluder, the one nearest to the surface, world
        units; infinity where none is, also where the surface faces away from the light or
        there is none.
    """
    return _trace(positions, geometric_normals, face_ids, light, occluders)[1]


def _trace(
    positions: Vectors,
    geometric_normals: Vectors,
    face_ids: FaceIds,
    light: Light,
    occluders: Occluders,
) -> tuple[Bool[np.ndarray, "*image"], Float[np.ndarray, "*image"]]:
    """Return where the surface faces the light, and the distances to the occluders."""
    face_ids = np.asarray(face_ids)
    for name, vectors in (("positions", positions), ("geometric_normals", geometric_normals)):
        if vectors.shape != (*face_ids.shape, 3):
            raise ValueError(
                f"truth: expected `{name}` {(*face_ids.shape, 3)} as `face_ids`, "
                f"got {vectors.shape}"
            )
    if face_ids.max(initial=-1) >= occluders.face_count:
        raise ValueError(
            f"truth: expected `face_ids` below {occluders.face_count}, the number of the "
            f"occluders' faces, got {face_ids.max()}; were they made from another mesh?"
        )
    surface = face_ids >= 0
    points = np.asarray(positions, np.float64)[surface]
    normals = np.asarray(geometric_normals, np.float64)[surface]
    to_light, reach = _to_light(points, light)
    facing = np.sum(normals * to_light, axis=-1) > 0
    points, normals, to_light = points[facing], normals[facing], to_light[facing]
    faces = face_ids[surface][facing]
    origins = occluders.leave_surface(points, normals, to_light, faces)
    image_facing = np.zeros(face_ids.shape, bool)
    image_facing[surface] = facing
    distances = np.full(face_ids.shape, np.inf)
    distances[image_facing] = occluders.hit_distance(origins, to_light, reach[facing], faces)
    return image_facing, distances


def _to_light(
    points: Float[np.ndarray, "points 3"], light: Light
) -> tuple[Float[np.ndarray, "points 3"], Float[np.ndarray, " points"]]:
    """Return unit vectors towards the light and the distances to it, in float64."""
    position = getattr(light, "position", None)
    if position is None:
        towards = np.asarray(light.to_light(jnp.asarray(points)), np.float64)
    else:
        towards = np.asarray(position, np.float64) - points
    lengths = np.linalg.norm(towards, axis=-1)
    reach = np.full(len(points), np.inf) if position is None else lengths
    return towards / np.maximum(lengths, 1e-30)[:, None], reach


def _onto_triangles(
    points: Float[np.ndarray, "points 3"], corners: Float[np.ndarray, "points 3 3"]
) -> Float[np.ndarray, "points 3"]:
    """Return the points moved into their triangles; unmoved where a triangle has no area."""
    a, b, c = np.moveaxis(corners, 1, 0)
    normal = np.cross(b - a, c - a)
    squared = np.sum(normal * normal, axis=-1)
    flat = squared == 0
    scale = np.where(flat, 1.0, squared)
    second = np.sum(np.cross(points - a, c - a) * normal, axis=-1) / scale
    third = np.sum(np.cross(b - a, points - a) * normal, axis=-1) / scale
    weights = np.maximum([1 - second - third, second, third], 0.0)
    weights /= weights.sum(axis=0)
    inside = np.einsum("kp,pkx->px", weights, corners)
    return np.where(flat[:, None], points, inside)
