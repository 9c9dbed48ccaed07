"""The ways that rows of the catalogue warn of, so that their metrics have something to see.

Each makes a picture of a view, as a technique that does not clip, does not look where it
divides, or counts from the eye would make it; and shadow volumes, which do as they should.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from shadows import CubeLayout, blocker_counts, mesh_edges, volume_visibility
from shadows.bias import AnalyticBias, NormalOffsetBias
from shadows.plane_bias import AdaptiveBias
from shadows.window_filters import BilinearFilter, PCFFilter

from .views import FACES, View, quick, visibility


@quick
def _volumes(mesh: Any, camera: Any, surface: Any, light: Any, edges: Any) -> jax.Array:
    return volume_visibility(mesh, camera, surface, light, edges=edges)


@quick
def _counts(mesh: Any, camera: Any, surface: Any, light: Any, edges: Any) -> jax.Array:
    return blocker_counts(mesh, camera, surface, light, edges=edges)


def by_volumes(seen: View) -> np.ndarray:
    """Return the visibility by shadow volumes."""
    return np.asarray(_volumes(*_with_edges(seen)), np.float64)


def blockers(seen: View) -> np.ndarray:
    """Return how many faces lie between each pixel and the light."""
    return np.asarray(_counts(*_with_edges(seen)))


def counted_from_the_eye(seen: View) -> np.ndarray:
    """Return the visibility by volumes that are counted from the eye to the surface (z-pass).

    Faces between the eye and the light are volumes that the eye stands in: each is left once
    more than it was entered.
    """
    counts = blockers(seen)
    view = np.asarray(seen.camera.view_from_world, np.float64)
    eye = -view[:3, :3].T @ view[:3, 3]
    towards = np.asarray(seen.light.to_light(jnp.asarray(eye[None])), np.float64)[0]
    inside = _faces_between(eye, towards, seen)
    return np.where(np.asarray(seen.facing), counts == inside, 0.0).astype(np.float64)


def mirrored(seen: View) -> np.ndarray:
    """Return the visibility where points behind a light are divided by their negative w."""
    points = np.asarray(seen.surface.position, np.float64)
    matrix = np.asarray(seen.seen.two.texel_from_world, np.float64)
    place = points @ matrix[:, :3].T + matrix[:, 3]
    column, row, depth = np.moveaxis(place[..., :3] / place[..., 3:], -1, 0)
    size = seen.seen.two.depth.shape[-1]
    inside = (column >= 0) & (column < size) & (row >= 0) & (row < size)
    texels = [np.clip(np.floor(at), 0, size - 1).astype(int) for at in (row, column)]
    stored = np.asarray(seen.seen.two.depth, np.float64)[tuple(texels)]
    return np.where(inside & (np.minimum(depth, 1.0) > stored), 0.0, 1.0)


def without_margin(seen: View) -> np.ndarray:
    """Return the visibility on a cube of right angles, beyond which a filter reads nothing."""
    arguments = seen.light, seen.mesh.positions, seen.camera
    size = seen.seen.two.depth.shape[-1]
    matrices = CubeLayout().matrices(*arguments, aspect=1.0, map_size=size, reach=-1.0)
    return _lit(seen.with_matrices(matrices), AdaptiveBias(), PCFFilter(2))


def unclipped(seen: View) -> np.ndarray:
    """Return the visibility in a map whose triangles were divided by w before any clipping."""
    matrix = jnp.asarray(seen.seen.two.clip_from_world)
    clip = jnp.asarray(seen.mesh.positions) @ matrix[:, :3].T + matrix[:, 3]
    flat = seen.drawn_from(clip[:, :3] / clip[:, 3:])
    return _lit(flat, AnalyticBias(), BilinearFilter())


def smooth_offset(seen: View) -> np.ndarray:
    """Return the visibility of receivers that are offset along smooth normals, by three texels."""
    moved = seen.seen.receiver._replace(normal=seen.surface.normal)
    bent = seen.with_seen(seen.seen._replace(receiver=moved))
    return _lit(bent, NormalOffsetBias(3.0), BilinearFilter())


def _lit(seen: View, bias: Any, filter: Any) -> np.ndarray:
    return np.asarray(visibility(seen, bias, filter)[0], np.float64)


def _with_edges(seen: View) -> tuple:
    edges = mesh_edges(np.asarray(seen.mesh.positions), np.asarray(seen.mesh.faces))
    more = np.zeros((3 * FACES - len(edges.vertices), 2), np.int32)
    edges = edges._replace(vertices=np.concatenate([edges.vertices, more]))
    return seen.mesh, seen.camera, seen.surface, seen.light, edges


def _faces_between(eye: np.ndarray, towards: np.ndarray, seen: View) -> int:
    """Return how many faces a ray of the sun meets before it reaches the eye."""
    positions = np.asarray(seen.mesh.positions, np.float64)
    a, b, c = np.moveaxis(positions[np.asarray(seen.mesh.faces)], 1, 0)
    across = np.cross(towards, c - a)
    area = np.sum((b - a) * across, axis=-1)
    safe = np.where(np.abs(area) < 1e-12, np.inf, area)
    u = np.sum((eye - a) * across, axis=-1) / safe
    turned = np.cross(eye - a, b - a)
    v, distance = turned @ towards / safe, np.sum((c - a) * turned, axis=-1) / safe
    hit = (u > 0) & (v > 0) & (u + v < 1) & (distance > 0) & np.isfinite(safe)
    return int(np.count_nonzero(hit))


# By row: name, why it should fail, and what makes the picture.
NAIVE_WAYS = {
    19: ("(divided by any w)", "mirrors what lies behind the light", mirrored),
    20: ("pcf 5x5, adaptive, (no margin)", "reads beyond its side of the cube", without_margin),
    25: ("bilinear, analytic, (no clipping)", "draws what lies behind the light", unclipped),
    27: ("(counted from the eye)", "the eye stands in a volume", counted_from_the_eye),
    30: ("bilinear, (offset along smooth normals)", "leaves the face's normal", smooth_offset),
}
