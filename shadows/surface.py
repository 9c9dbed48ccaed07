"""What the eye sees at each pixel, before any light: face, place and directions."""

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from tangentspace._math import dot, safe_normalize
from tangentspace._planes import in_planes
from tangentspace.mesh import Mesh
from tangentspace.vertex_normals import face_normals

from .coverage import Coverage, coverage
from .edge_points import EdgePoints
from .interpolate import ClipPositions, FaceIds, barycentrics, gather_faces, interpolate
from .rasterize import Raster, rasterize
from .silhouettes import MeshEdges
from .transforms import Camera, transform_points

_SAME_NORMAL = 1e-3  # difference of normals that makes no crease


class Surface(NamedTuple):
    """What the eye sees at each pixel, before any light.

    Attributes:
        face_ids: The face, -1 where there is none.
        depth: Window depth in [0, 1], 1 where there is none.
        position: World space.
        face_normal: Unit normal of the face, turned to the camera's side.
        normal: Unit shading normal, interpolated, turned with the face's.
        to_camera: Unit vector towards the eye.
        weights: Barycentric weights of the face's corners, to interpolate more with.
    """

    face_ids: Int[Array, "height width"]
    depth: Float[Array, "height width"]
    position: Float[Array, "height width 3"]
    face_normal: Float[Array, "height width 3"]
    normal: Float[Array, "height width 3"]
    to_camera: Float[Array, "height width 3"]
    weights: Float[Array, "height width 3"]

    @property
    def covered(self) -> Bool[Array, "height width"]:
        """Whether there is a surface at the pixel."""
        return self.face_ids >= 0


def render_surface(mesh: Mesh, camera: Camera, *, image_size: tuple[int, int]) -> Surface:
    """Rasterize the mesh from the eye and interpolate what shading needs.

    Args:
        mesh: World space.
        camera: The view; its aspect ratio follows the image's.
        image_size: Height and width in pixels.

    Differentiability:
        Smooth in positions, normals and the camera inside each face; see ``rasterize``.
    """
    matrix = camera.clip_from_world(image_size[1] / image_size[0])
    clip = transform_points(matrix, mesh.positions)
    return surface_of(mesh, camera, clip, rasterize(clip, mesh.faces, image_size=image_size))


@in_planes
def surface_of(mesh: Mesh, camera: Camera, clip: ClipPositions, raster: Raster) -> Surface:
    """Return the surface that the eye sees, of faces that are known.

    Args:
        mesh: World space.
        camera: The view.
        clip: The vertices in the view's clip space.
        raster: What ``rasterize`` found there.
    """
    return _turned(camera, _interpolated(mesh, clip, raster.face_ids, raster.depth))


def surface_at(mesh: Mesh, clip: ClipPositions, *, image_size: tuple[int, int]) -> Surface:
    """Return the surface at each pixel of any image of the mesh.

    Args:
        mesh: World space.
        clip: Where its vertices lie in the image, clip space.
        image_size: Height and width in pixels.

    Returns:
        With normals as the faces are wound, and ``to_camera`` along the shading normal.
    """
    raster = rasterize(clip, jnp.asarray(mesh.faces), image_size=image_size)
    return _interpolated(mesh, clip, raster.face_ids, raster.depth)


def _interpolated(
    mesh: Mesh,
    clip: ClipPositions,
    face_ids: FaceIds,
    depth: Float[Array, "height width"],
    points: tuple[Array, Array] | None = None,
) -> Surface:
    """Return the surface of known faces, at pixels' centres or at other points."""
    positions, faces = jnp.asarray(mesh.positions), jnp.asarray(mesh.faces)
    weights = barycentrics(clip, faces, face_ids, points=points)
    position = interpolate(positions, faces, face_ids, weights)
    normal = safe_normalize(interpolate(mesh.normals, faces, face_ids, weights))
    face_normal = gather_faces(face_normals(positions, faces), face_ids)
    return Surface(face_ids, depth, position, face_normal, normal, normal, weights)


def _turned(camera: Camera, seen: Surface) -> Surface:
    """Turn normals to the camera's side."""
    to_camera = camera.to_camera(seen.position)
    away = (dot(seen.face_normal, to_camera) < 0)[..., None]
    return seen._replace(
        face_normal=jnp.where(away, -seen.face_normal, seen.face_normal),
        normal=jnp.where(away, -seen.normal, seen.normal),
        to_camera=to_camera,
    )


def surface_coverage(mesh: Mesh, camera: Camera, surface: Surface, edges: MeshEdges) -> Coverage:
    """Return which share of each pixel its own surface covers, for ``blend_layers``.

    Args:
        mesh: World space.
        camera: The view.
        surface: What it sees of the mesh.
        edges: ``mesh_edges(mesh.positions, mesh.faces)``.

    Raises:
        ValueError: If the edges are those of a mesh with another number of faces.

    Differentiability:
        As ``coverage``, in positions and camera.
    """
    height, width = surface.face_ids.shape
    clip = transform_points(camera.clip_from_world(width / height), mesh.positions)
    return coverage(clip, mesh.faces, edges, surface.face_ids, creases=mesh_creases(mesh, edges))


def edge_surface(mesh: Mesh, camera: Camera, surface: Surface, points: EdgePoints) -> Surface:
    """Return what is seen on both sides of edges, right at them, as an image of two rows.

    Args:
        mesh: World space.
        camera: The view.
        surface: What it sees of the mesh.
        points: On edges of the image.
    """
    height, width = surface.face_ids.shape
    clip = transform_points(camera.clip_from_world(width / height), mesh.positions)
    ids = points.beside(surface.face_ids)
    seen = _interpolated(mesh, clip, ids, points.beside(surface.depth), points.place)
    # Where a surface ends, the face that is seen near by may not reach to its end.
    weight = points.weight[:, None]
    on_edge = []
    for values in (mesh.positions, mesh.normals):
        start, end = (jnp.asarray(values).at[v].get(mode="clip") for v in points.vertices)
        on_edge.append((1 - weight) * start + weight * end)
    own = (points.ends & jnp.array([[True], [False]]))[..., None]
    position = jnp.where(own, on_edge[0], seen.position)
    normal = jnp.where(own, safe_normalize(on_edge[1]), seen.normal)
    return _turned(camera, seen._replace(position=position, normal=normal))


def mesh_creases(mesh: Mesh, edges: MeshEdges) -> Bool[Array, " edges"]:
    """Tell at which edges faces meet with different shading normals.

    Args:
        mesh: With a normal at each vertex.
        edges: ``mesh_edges(mesh.positions, mesh.faces)``.
    """
    normals, faces = lax.stop_gradient(jnp.asarray(mesh.normals)), jnp.asarray(mesh.faces)
    start = normals.at[faces].get(mode="clip")
    end = jnp.roll(start, -1, axis=1)
    forward = (jnp.asarray(edges.directions) > 0)[..., None]
    at_ends = jnp.concatenate(
        [jnp.where(forward, start, end), jnp.where(forward, end, start)], axis=-1
    )
    none = jnp.full((edges.vertices.shape[0], 6), jnp.inf, at_ends.dtype)
    ids = jnp.asarray(edges.edge_ids)
    least, most = none.at[ids].min(at_ends), (-none).at[ids].max(at_ends)
    return jnp.any(most - least > _SAME_NORMAL, axis=-1)
