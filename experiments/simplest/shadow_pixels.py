"""What theory needs of each pixel that faces a light.

How far the shadow's edge is, how steep the surface is in the light's map, how far away what
casts the shadow is, and what shadow does to the picture. All of it comes from truth and the
scale of the map; no map is drawn.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.ndimage
from jaxtyping import Array, Bool, Float

from shadows.layouts import Layout
from shadows.lights import Light
from shadows.shadow_map import Receiver, ShadowMap
from shadows.surface import Surface
from shadows.transforms import Camera
from shadows.visibility import receive_surface

from .sight import Seen, Share, Sight, picture_of

Values = Float[np.ndarray, " pixels"]
_SCALE = 256  # size of the map whose texels are measured; others are in proportion
_MOST_PIXELS = 30_000
_FAR = 1e6
_CONTINUOUS = 0.2  # sine of the angle between a surface and the step to its next pixel


class ShadowPixels(NamedTuple):
    """What theory needs of the pixels that face a light.

    Attributes:
        weight: Square of what full shadow changes of the picture, as a share of the whole.
        share: Of the light that is seen.
        edge: World length across the light's rays to the next pixel that is lit otherwise;
            positive where this one is lit.
        pixel: Share of that length that one pixel is; the edge is somewhere in the last one.
        texel: Width of a texel of a map of one texel, world length.
        slope: Depth that the surface gains over a length of the map.
        gap: World length along the ray to the occluder nearest to the light; 0 for none.
        step: Of so many pixels one was taken.
    """

    weight: Values
    share: Values
    edge: Values
    pixel: Values
    texel: Values
    slope: Values
    gap: Values
    step: int


def shadow_pixels(sight: Sight, index: int) -> ShadowPixels:
    """Return what theory needs of one light, of a fair sample of the pixels that face it."""
    seen = sight.seen[index]
    receiver = jax.tree.map(
        np.asarray,
        _receive(sight.surface, seen.light, sight.layout, sight.scene.mesh.positions,
                 sight.scene.camera),
    )  # fmt: skip
    weight = _weight(sight, index)
    edge, pixel = _edge_distance(sight, seen, receiver)
    images = {
        "weight": weight, "share": seen.share, "edge": edge, "pixel": pixel,
        "texel": receiver.texel_length * _SCALE, "slope": _slope(receiver),
        "gap": _gap(sight, seen),
    }  # fmt: skip
    rows = np.flatnonzero(seen.facing.ravel() & (weight.ravel() > 0))
    step = max(1, len(rows) // _MOST_PIXELS)
    found = {name: np.asarray(a, np.float64).ravel()[rows[::step]] for name, a in images.items()}
    return ShadowPixels(**found | {"weight": found["weight"] * step}, step=step)


def _weight(sight: Sight, index: int) -> Share:
    """Return the square of what full shadow changes at each pixel, by the number of pixels."""
    shares = [seen.share for seen in sight.seen]
    pictures = []
    for share in (sight.seen[index].facing, np.zeros(sight.covered.shape)):
        shares[index] = share
        pictures.append(picture_of(sight, sight.looks[-1], shares))
    squared = np.mean((pictures[0] - pictures[1]) ** 2, axis=-1)
    return np.where(sight.covered, squared, 0) / max(1, sight.covered.sum())


def _slope(receiver: Receiver) -> Share:
    """Return the depth that surfaces gain over a length of the map, along both its sides."""
    gained = np.abs(receiver.depth_per_column) + np.abs(receiver.depth_per_row)
    rate = np.maximum(np.abs(receiver.depth_rate * receiver.texel_length), 1e-30)
    return gained / rate


def _edge_distance(sight: Sight, seen: Seen, receiver: Receiver) -> tuple[Share, Share]:
    """Return ``edge`` and ``pixel`` of each pixel, see ``ShadowPixels``."""
    position, lit = np.asarray(sight.surface.position, np.float64), seen.share > 0.5
    near = _next_to_edge(position, np.asarray(sight.surface.face_normal), lit, seen.facing)
    distance, pixel = np.full(lit.shape, _FAR), np.zeros(lit.shape)
    for side in (lit, ~lit):
        if (near & ~side).any():
            found = _distance_to(near & ~side, position, receiver)
            distance, pixel = np.where(side, found, (distance, pixel))
    return np.where(lit, distance, -distance), pixel


def _distance_to(
    there: Bool[np.ndarray, "height width"],
    position: Float[np.ndarray, "height width 3"],
    receiver: Receiver,
) -> tuple[Share, Share]:
    """Return how far each pixel is from the next of some across the rays, and 1 by pixels."""
    found: Any = scipy.ndimage.distance_transform_edt(~there, return_indices=True)
    pixels, (row, column) = found
    across = position - position[row, column]
    along = np.sum(across * receiver.to_light, axis=-1)
    straight = np.linalg.norm(across, axis=-1)
    distance = np.sqrt(np.maximum(straight**2 - along**2, 0))
    # No plane shortens it by more; less is an edge on another surface, in line with the light.
    cosine = np.maximum(np.sum(receiver.normal * receiver.to_light, axis=-1), 0)
    return np.maximum(distance, straight * cosine), 1 / np.maximum(pixels, 1)


def _next_to_edge(
    position: Float[np.ndarray, "height width 3"],
    normal: Float[np.ndarray, "height width 3"],
    lit: Bool[np.ndarray, "height width"],
    facing: Bool[np.ndarray, "height width"],
) -> Bool[np.ndarray, "height width"]:
    """Return the pixels whose neighbour on the same surface is lit otherwise."""
    near = np.zeros_like(lit)
    for one, other in ((np.s_[:-1], np.s_[1:]), (np.s_[:, :-1], np.s_[:, 1:])):
        step = position[other] - position[one]
        length = np.maximum(np.linalg.norm(step, axis=-1), 1e-30)
        flat = np.abs(np.sum(step * normal[one], axis=-1)) < _CONTINUOUS * length
        changes = flat & facing[one] & facing[other] & (lit[one] != lit[other])
        near[one] |= changes
        near[other] |= changes
    return near


def _gap(sight: Sight, seen: Seen) -> Share:
    """Return how far before each pixel the light's rays first hit something."""
    position = np.asarray(sight.surface.position, np.float64)[seen.facing]
    towards = np.asarray(seen.light.to_light(jnp.asarray(position)), np.float64)
    source = getattr(seen.light, "position", None)
    if source is None:
        extent = float(np.linalg.norm(np.ptp(np.asarray(sight.scene.mesh.positions), axis=0)))
        length = np.full(len(position), 2 * extent)
    else:
        length = np.linalg.norm(np.asarray(source) - position, axis=-1)
    origins = position + length[:, None] * towards
    hit = sight.occluders.hit_distance(
        origins, -towards, length, np.full(len(position), -1, np.int32)
    )
    gap = np.zeros(seen.facing.shape)
    gap[seen.facing] = np.where(np.isinf(hit), 0, np.maximum(length - hit, 0))
    return gap


@jax.jit
def _receive(
    surface: Surface, light: Light, layout: Layout, positions: Array, camera: Camera
) -> Receiver:
    matrices = layout.matrices(
        light, positions, camera, aspect=1.0, map_size=_SCALE, reach=jnp.float32(1.0)
    )
    depth = jnp.zeros((*matrices.shape[:-2], _SCALE, _SCALE))
    return receive_surface(surface, light, ShadowMap(depth, matrices))
