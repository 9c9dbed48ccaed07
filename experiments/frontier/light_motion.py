"""How an image of visibility changes as the light moves: what a gradient is judged against.

The light moves by two angles, as seen from the middle of what the eye sees: a direction is
turned, a position moved across the way to it. What changes is judged by means over the image
under a few smooth patterns, each times the light that arrives, which takes out the
terminator. Means of truth are smooth in the angles, though each ray answers yes or no.
"""

from collections.abc import Callable
from typing import Any, cast

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from shadows.lights import DirectionalLight, Light
from shadows.surface import Surface
from tangentspace._math import dot, safe_norm, safe_normalize

_STEP = 0.03  # radians
_WAVES = ((0, 0), (1, 0), (0, 1), (1, 1), (1, -1), (2, 0), (0, 2))
_TURN = 3.0  # radians of a wave of 1, from the middle of the image to its edge

Patterns = Float[np.ndarray, "patterns height width"]


def move_light(
    light: Light, angles: Float[Array, "2"], center: Float[Array | np.ndarray, "3"]
) -> Light:
    """Return the light, moved by two angles.

    Args:
        light: With a position, or else a direction.
        angles: Radians.
        center: Of the motion, world space.
    """
    center, placed = jnp.asarray(center), cast(Any, light)  # all others have a position
    away = placed.direction if isinstance(light, DirectionalLight) else placed.position - center
    least = jnp.eye(3, dtype=center.dtype)[jnp.argmin(jnp.abs(away))]
    right = safe_normalize(jnp.cross(away, least))
    up = safe_normalize(jnp.cross(right, away))
    moved = away + safe_norm(away) * (angles[0] * right + angles[1] * up)
    if isinstance(light, DirectionalLight):
        return eqx.tree_at(lambda light: light.direction, light, safe_normalize(moved))
    return eqx.tree_at(lambda light: light.position, light, center + moved)


def patterns(surface: Surface, light: Light) -> Patterns:
    """Return the weights of the means; 0 where no light would arrive."""
    cosine = np.asarray(dot(surface.face_normal, light.to_light(surface.position)))
    bright = np.mean(np.asarray(light.radiance(surface.position)), axis=-1)
    arriving = np.where(np.asarray(surface.covered), np.maximum(cosine, 0) * bright, 0)
    row, column = (np.linspace(-1, 1, n) for n in arriving.shape)
    waves = [np.cos(_TURN * (i * column + j * row[:, None]) + i + j) for i, j in _WAVES]
    return np.stack([arriving * wave for wave in waves]) / arriving.size


def truth_slopes(
    share: Callable[[Light], Float[np.ndarray, "height width"]],
    light: Light,
    weights: Patterns,
    center: Float[np.ndarray, "3"],
) -> Float[np.ndarray, "2 patterns"]:
    """Return derivatives of the means by central differences.

    Args:
        share: Truth, for a light.
        light: Where it stands.
        weights: From ``patterns``.
        center: Of the motion.
    """
    slopes = []
    for step in np.eye(2, dtype=np.float32) * _STEP:
        after, before = (share(move_light(light, jnp.asarray(s), center)) for s in (step, -step))
        slopes.append(np.tensordot(weights, after - before, axes=2) / (2 * _STEP))
    return np.stack(slopes)


def slope_error(
    changes: Float[np.ndarray, "2 height width"],
    weights: Patterns,
    slopes: Float[np.ndarray, "2 patterns"],
) -> float | None:
    """Return how far derivatives are from truth's, by the length of truth's.

    Args:
        changes: Derivatives of a method's visibility in both angles.
        weights: From ``patterns``.
        slopes: From ``truth_slopes``.

    Returns:
        0 for exact, 1 for no derivative at all; None if truth does not change.
    """
    found = np.stack([np.tensordot(weights, change, axes=2) for change in changes])
    length = np.linalg.norm(slopes)
    return float(np.linalg.norm(found - slopes) / length) if length > 0 else None
