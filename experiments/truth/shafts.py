"""Ray-traced light shafts: the integral along each view ray, with a shadow ray at each sample.

The same single scattering as ``shadows.shafts``, written again in NumPy float64 and without
shadow maps: ``density exp(-density t)`` is integrated over each step, all else is sampled.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from shadows.lights import Light
from shadows.medium import Medium

from .rays import Occluders

Vectors = Float[Array | np.ndarray, "rays 3"]


def trace_shafts(
    origins: Vectors,
    directions: Vectors,
    lengths: Float[Array | np.ndarray, " rays"],
    light: Light,
    occluders: Occluders,
    medium: Medium,
    *,
    steps: int,
    offset: float = 0.5,
) -> Float[np.ndarray, "rays 3"]:
    """Return what the medium scatters of one light along each ray, linear RGB.

    Args:
        origins: Where the view rays start, world space.
        directions: Unit vectors.
        lengths: Of the rays, world units.
        light: The light; where it has a ``position``, shadow rays end there.
        occluders: What casts shadows.
        medium: What the rays lead through.
        steps: Shadow rays along each view ray.
        offset: Where each step is sampled, as a share of it.
    """
    origins, directions, lengths = (
        np.asarray(array, np.float64) for array in (origins, directions, lengths)
    )
    density, g = float(medium.density), float(medium.anisotropy)
    total = np.zeros((len(origins), 3))
    left = np.exp(-density * lengths * np.arange(steps + 1)[:, None] / steps)
    for k in range(steps):
        points = origins + ((k + offset) / steps * lengths)[:, None] * directions
        towards, reach = _to_light(points, light)
        hit = occluders.hit_distance(points, towards, reach, np.full(len(points), -1))
        cosine = np.sum(towards * directions, axis=-1)
        phase = (1 - g**2) / (4 * np.pi * (1 + g**2 - 2 * g * cosine) ** 1.5)
        share = np.pi * phase * (left[k] - left[k + 1])
        arrives = np.asarray(light.radiance(jnp.asarray(points)), np.float64)
        total += np.where(np.isinf(hit), share, 0)[:, None] * arrives
    return np.asarray(medium.albedo) * total


def _to_light(
    points: Float[np.ndarray, "rays 3"], light: Light
) -> tuple[Float[np.ndarray, "rays 3"], Float[np.ndarray, " rays"]]:
    """Return unit vectors towards the light and the distances to it."""
    position = getattr(light, "position", None)
    if position is None:
        towards = np.asarray(light.to_light(jnp.asarray(points)), np.float64)
        return towards, np.full(len(points), np.inf)
    towards = np.asarray(position, np.float64) - points
    lengths = np.linalg.norm(towards, axis=-1)
    return towards / np.maximum(lengths, 1e-30)[:, None], lengths
