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

from typing import NamedTuple

import numpy as np

from shadows.area_lights import AreaLight
from shadows.moment_filter import MomentFilter
from shadows.pcss_filter import PCSSFilter

from .bench import techniques
from .models import Model
from .shadow_pixels import ShadowPixels, Values, shadow_pixels
from .sight import SEEN_WRONG, Measure, Sight, picture_of

_JITTER = np.linspace(-0.5, 0.5, 9)  # texels by which the edge in a map is off
_WITHIN = np.array([5, 13, 1, 9, 17, 3, 11, 7, 15]) / 18  # of a pixel, where the edge may be
_FLIP_OF_SHADOW = 0.4  # FLIP between light and shadow, about
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


class Theory:
    """Predicts the errors of models on a scene."""

    def __init__(self, sight: Sight, measure: Measure = "rmse") -> None:
        """Look at the scene's shadows.

        Args:
            sight: The scene.
            measure: Of errors.
        """
        self._measure: Measure = measure
        self.soft = any(isinstance(seen.light, AreaLight) for seen in sight.seen)
        self._pixels = [shadow_pixels(sight, k) for k in range(len(sight.seen))]
        self._sight = sight
        self._parts: dict[Model, Parts] = {}
        self._edges_of: dict[tuple, float] = {}  # which models share
        weights = np.concatenate([p.weight for p in self._pixels])
        squares = np.sum(weights**2) / max(np.sum(weights), 1e-30)
        self._contrast = max(squares * sight.covered.sum() / self._pixels[0].step, 1e-6)
        lit = np.concatenate([p.share > 0.5 for p in self._pixels])
        slopes = np.concatenate([p.slope for p in self._pixels])
        self.slope = _quantile(slopes[lit], weights[lit], _STEEP)

    def parts(self, model: Model) -> Parts:
        """Return what theory expects of a model's picture."""
        if model not in self._parts:
            self._parts[model] = self._expected(model)
        return self._parts[model]

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
        if model.filter.startswith("pcss") and not self.soft:
            return "no light has a size: shadows are not soft"
        return None

    def _expected(self, model: Model) -> Parts:
        if not model.filter:
            lost = sum(np.sum(self._penalty(p, 1 - p.share)) for p in self._pixels)
            return Parts(0.0, 0.0, float(lost))
        found = [self._of_light(k, model) for k in range(len(self._pixels))]
        return Parts(*np.sum(found, axis=0).tolist())

    def _of_light(self, index: int, model: Model) -> tuple[float, float, float]:
        """Return parts of the error that are due to one light."""
        pixels, (filter, _) = self._pixels[index], techniques(model, self.slope)
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
        softens = isinstance(filter, PCSSFilter) and self.soft
        key = index, model.map_size, "soft" if softens else reach
        if key not in self._edges_of:
            edges = self._soft_edges if softens else self._edges
            self._edges_of[key] = float(np.sum(edges(pixels, pixels.edge / texel, reach - 0.5)))
        return (
            self._edges_of[key],
            float(np.sum(np.where(pixels.share > 0.5, acne, 0))),
            float(np.sum(leaks * whole)),
        )

    def _edges(self, pixels: ShadowPixels, away: Values, half_width: float) -> Values:
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

    def _soft_edges(self, pixels: ShadowPixels, away: Values, half_width: float) -> Values:
        """Return the penalty of penumbrae as wide as truth's, but for texels and few taps."""
        del half_width
        square = 0.04 * pixels.share * (1 - pixels.share) + np.where(np.abs(away) < 1, 0.05, 0)
        return self._penalty(pixels, square**0.5)

    def _penalty(self, pixels: ShadowPixels, off: np.ndarray) -> np.ndarray:
        """Return what the measure adds up where visibilities are off by so much."""
        weight = pixels.weight.reshape(-1, *[1] * (off.ndim - 1))
        if self._measure == "error":
            one = pixels.step / self._sight.covered.sum()
            return one * (off * np.sqrt(weight / one) > SEEN_WRONG)
        scale = 1 if self._measure == "rmse" else _FLIP_OF_SHADOW / self._contrast
        return scale * weight * off**2


def _quantile(values: Values, weights: Values, share: float) -> float:
    """Return the value that so great a share of the weight lies at or below; 1 if there is none."""
    if not weights.sum() > 0:
        return 1.0
    order = np.argsort(values)
    below = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(below, share * below[-1])])
