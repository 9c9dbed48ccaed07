"""Ray-traced soft shadows: the share of a light that each surface point sees."""

import numpy as np
from jaxtyping import Bool, Float

from shadows.area_lights import AreaLight
from shadows.lights import Light, PointLight
from shadows.surface import Surface
from tangentspace._math import dot

from .rays import FaceIds, Occluders, Vectors, trace_visibility

LIGHT_SAMPLES = 64  # points of an area light that rays go to; 1 % in a penumbra


def seen_share(
    positions: Vectors,
    geometric_normals: Vectors,
    face_ids: FaceIds,
    light: Light,
    occluders: Occluders,
) -> Float[np.ndarray, "*image"]:
    """Return the share of any light that each surface point sees; 0 or 1 but for area lights.

    Takes and raises what ``area_visibility`` does, with ``LIGHT_SAMPLES`` points.
    """
    points = (positions, geometric_normals, face_ids)
    if isinstance(light, AreaLight):
        return area_visibility(*points, light, occluders, samples=LIGHT_SAMPLES)
    return trace_visibility(*points, light, occluders).astype(np.float64)


def surface_share(
    surface: Surface, light: Light, occluders: Occluders
) -> tuple[Bool[np.ndarray, "height width"], Float[np.ndarray, "height width"]]:
    """Return which pixels of a view face a light, and the share of it that they see; else 0."""
    position, normal, ids = surface.position, surface.face_normal, surface.face_ids
    towards = np.asarray(dot(normal, light.to_light(position)))
    facing = np.asarray(surface.covered) & (towards > 0)
    share = seen_share(np.asarray(position), np.asarray(normal), np.asarray(ids), light, occluders)
    return facing, np.where(facing, share, 0.0)


def area_visibility(
    positions: Vectors,
    geometric_normals: Vectors,
    face_ids: FaceIds,
    light: AreaLight,
    occluders: Occluders,
    *,
    samples: int,
) -> Float[np.ndarray, "*image"]:
    """Return the share of the light's area that each surface point sees, by a ray to each sample.

    Args:
        positions: World space; read only where there is a surface.
        geometric_normals: Unit normals of the faces (not the shading normals), on the side
            that is looked at; what lies behind a surface it does not see.
        face_ids: The face that each point lies on, an index into the occluders' faces; -1
            where there is no surface.
        light: The light. Both of its sides count; that one is dark is told by its radiance.
        occluders: The same mesh, prepared.
        samples: Points of the light, ``light.sample_points(samples)``.

    Returns:
        Shares in [0, 1], whole multiples of 1 / samples; 0 where there is no surface.

    Raises:
        ValueError: If ``samples`` is less than 1, the shapes do not fit each other, or a
            face does not exist.
    """
    points = np.asarray(light.sample_points(samples))
    seen = np.zeros(np.shape(face_ids))
    for point in points:
        lamp = PointLight(point)
        seen += trace_visibility(positions, geometric_normals, face_ids, lamp, occluders)
    return seen / samples
