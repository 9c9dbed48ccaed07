"""What theory says of a model before it is tried: how wrong its picture will be, and why.

Three ways for shadows to be wrong, each a mean square over the pixels of what it does to the
picture:

- *edges*: a lookup answers with a ramp as wide as its kernel, that lies up to half a texel
  off. Truth has a step there, or under an area light its penumbra; both are compared at each
  pixel's distance from the shadow's edge, counted in texels.
- *acne*: on a slope that gains more depth within the reach of the lookup than the bias, the
  share of texels that hide the receiver.
- *leaks*: shadow is lost where the occluder is nearer than the bias.

And what leaving normal maps out does, under true shadows, as a part that shadows add to.
All is known from truth and the scale of the light's map alone; no map is drawn for it.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.ndimage
from jaxtyping import Array, Bool, Float

from shadows.area_lights import AreaLight
from shadows.layouts import Layout
from shadows.lights import Light
from shadows.moment_filter import MomentFilter
from shadows.pcss_filter import PCSSFilter
from shadows.render import receive_surface
from shadows.shadow_map import Receiver, ShadowMap
from shadows.surface import Surface
from shadows.transforms import Camera

from .bench import techniques
from .models import Model
from .sight import SEEN_WRONG, Measure, Seen, Share, Sight, picture_of

Pixels = Float[np.ndarray, " pixels"]
_SCALE = 256  # size of the map whose texels are measured; others are in proportion
_MOST_PIXELS = 30_000
_JITTER = np.linspace(-0.5, 0.5, 9)  # texels by which the edge in a map is off
_WITHIN = np.array([5, 13, 1, 9, 17, 3, 11, 7, 15]) / 18  # of a pixel, where the edge may be
_FAR = 1e6
_FLIP_OF_SHADOW = 0.4  # FLIP between light and shadow, about
_CONTINUOUS = 0.2  # sine of the angle between a surface and the step to its next pixel
_STEEP = 0.95  # share of the lit surface that a constant bias is to clear


class Parts(NamedTuple):
    """The picture's error by its causes: mean squares, or for other measures means."""

    edges: float
    acne: float
    leaks: float

    @property
    def cause(self) -> str:
        """The largest of them, in words."""
        return max(zip(self, self._fields, strict=True))[1]


class _Pixels(NamedTuple):
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

    weight: Pixels
    share: Pixels
    edge: Pixels
    pixel: Pixels
    texel: Pixels
    slope: Pixels
    gap: Pixels
    step: int


class Theory:
    """Predicts the errors of models on a scene."""

    def __init__(self, sight: Sight, measure: Measure = "rmse") -> None:
        """Look at the scene's shadows.

        Args:
            sight: The scene.
            measure: Of errors.
        """
        self._measure: Measure = measure
        self._soft = any(isinstance(seen.light, AreaLight) for seen in sight.seen)
        self._pixels = [_pixels(sight, k) for k in range(len(sight.seen))]
        self._sight = sight
        weights = np.concatenate([p.weight for p in self._pixels])
        squares = np.sum(weights**2) / max(np.sum(weights), 1e-30)
        self._contrast = max(squares * sight.covered.sum() / self._pixels[0].step, 1e-6)
        lit = np.concatenate([p.share > 0.5 for p in self._pixels])
        slopes = np.concatenate([p.slope for p in self._pixels])
        self.slope = _quantile(slopes[lit], weights[lit], _STEEP)

    def parts(self, model: Model) -> Parts:
        """Return what theory expects of a model's picture."""
        if not model.filter:
            lost = sum(np.sum(self._penalty(p, 1 - p.share)) for p in self._pixels)
            return Parts(0.0, 0.0, float(lost))
        found = [self._of_light(p, model) for p in self._pixels]
        return Parts(*np.sum(found, axis=0).tolist())

    def without(self, look: str) -> float:
        """Return how wrong a look is under true shadows."""
        true = [seen.share for seen in self._sight.seen]
        return self._sight.error(picture_of(self._sight, look, true), self._measure)

    def error(self, model: Model) -> float:
        """Return what theory expects of the measure, but for the look."""
        total = sum(self.parts(model))
        return total**0.5 if self._measure == "rmse" else total

    def useless(self, model: Model) -> str | None:
        """Return why a model cannot be the least one whatever its error, if it cannot."""
        if model.filter.startswith("pcss") and not self._soft:
            return "no light has a size: shadows are not soft"
        return None

    def _of_light(self, pixels: _Pixels, model: Model) -> tuple[float, float, float]:
        filter, _ = techniques(model, self.slope)
        reach, texel = float(filter.reach()), pixels.texel / model.map_size
        need, given = pixels.slope * reach, np.zeros_like(texel)
        if model.bias == "constant":
            given = np.full_like(texel, self.slope * reach)
        elif model.bias.startswith("slope"):
            given = need + (0.3 if "constant" in model.bias else 0.0)
        elif model.bias == "adaptive":
            need, given = np.zeros_like(texel), np.full_like(texel, 0.3)
        whole = self._penalty(pixels, np.ones_like(texel))
        acne = np.zeros_like(texel)
        if filter.needs_bias and not isinstance(filter, MomentFilter):
            left = np.where(need > given, 1 - given / np.where(need > 0, need, 1), 0) / 2
            acne = left * whole if reach < 1 else self._penalty(pixels, left)
        leaks = (pixels.share < 0.5) & (pixels.gap < given * texel)
        softens = isinstance(filter, PCSSFilter) and self._soft
        edges = self._soft_edges if softens else self._edges
        return (
            float(np.sum(edges(pixels, pixels.edge / texel, reach - 0.5))),
            float(np.sum(np.where(pixels.share > 0.5, acne, 0))),
            float(np.sum(leaks * whole)),
        )

    def _edges(self, pixels: _Pixels, away: Pixels, half_width: float) -> Pixels:
        """Return the penalty of a ramp where truth has a step or a penumbra.

        Args:
            pixels: What is seen of a light.
            away: Texels from the shadow's edge.
            half_width: Of the ramp, texels.
        """
        places = away[:, None] * (1 - _WITHIN * pixels.pixel[:, None]) + _JITTER
        if half_width <= 0:
            seen = (places > 0).astype(float)
        else:
            seen = np.clip(places / (2 * half_width) + 0.5, 0, 1)
        found = np.mean(self._penalty(pixels, np.abs(seen - pixels.share[:, None])), axis=1)
        # A ramp within one pixel slips through the samples; its integral does not.
        ramp = half_width / 12 + 0.125 / (1 + 4 * half_width)
        if self._measure == "error":
            ramp = 0.8 * half_width + 0.125
        slipped = np.where(pixels.pixel == 1, ramp / np.maximum(np.abs(away), max(1, ramp)), 0)
        return np.maximum(found, slipped * self._penalty(pixels, np.ones_like(away)))

    def _soft_edges(self, pixels: _Pixels, away: Pixels, half_width: float) -> Pixels:
        """Return the penalty of penumbrae as wide as truth's, but for texels and few taps."""
        del half_width
        square = 0.04 * pixels.share * (1 - pixels.share) + np.where(np.abs(away) < 1, 0.05, 0)
        return self._penalty(pixels, square**0.5)

    def _penalty(self, pixels: _Pixels, off: np.ndarray) -> np.ndarray:
        """Return what the measure adds up where visibilities are off by so much."""
        weight = pixels.weight.reshape(-1, *[1] * (off.ndim - 1))
        if self._measure == "error":
            one = pixels.step / self._sight.covered.sum()
            return one * (off * np.sqrt(weight / one) > SEEN_WRONG)
        scale = 1 if self._measure == "rmse" else _FLIP_OF_SHADOW / self._contrast
        return scale * weight * off**2


def _pixels(sight: Sight, index: int) -> _Pixels:
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
    return _Pixels(**found | {"weight": found["weight"] * step}, step=step)


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
    """Return ``edge`` and ``pixel`` of each pixel, see ``_Pixels``."""
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


def _quantile(values: Pixels, weights: Pixels, share: float) -> float:
    """Return the value that so great a share of the weight lies at or below; 1 if there is none."""
    if not weights.sum() > 0:
        return 1.0
    order = np.argsort(values)
    below = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(below, share * below[-1])])
