"""What sees a failure: each a number for a technique's picture of a scene, larger if worse.

Shares and means are 0 where a mask is empty. Pixels within three of a shadow's edge, where
resolution rules and not a technique, are left out where ``inner`` is asked for.
"""

from typing import NamedTuple

import numpy as np
import scipy.ndimage
from jaxtyping import Bool, Float

from ..metrics import contact_gap

Image = Float[np.ndarray, "height width"]
Mask = Bool[np.ndarray, "height width"]
CONTACT = 0.15  # world length up to which a caster is close


class Sight(NamedTuple):
    """What a picture is judged by.

    Attributes:
        truth: True where rays reach the light.
        facing: Pixels of surfaces that face the light.
        distance: To the occluder nearest to the surface; infinite where there is none.
        sine: Of the angle between the face's normal and the light.
        special: Pixels that the row is about; all that face the light if it names none.
    """

    truth: Mask
    facing: Mask
    distance: Image
    sine: Image
    special: Mask

    @property
    def lit(self) -> Mask:
        """Pixels that are lit in truth."""
        return self.facing & self.truth & self.special

    @property
    def dark(self) -> Mask:
        """Pixels that lie in the shadow of something."""
        return self.facing & ~self.truth & self.special

    @property
    def inner(self) -> Mask:
        """Pixels away from the edges of shadows, and from what does not face the light."""
        lit, dark = self.facing & self.truth, self.facing & ~self.truth
        near_lit, near_dark = (scipy.ndimage.maximum_filter(kind, size=7) for kind in (lit, dark))
        return self.facing & ~np.logical_and(near_lit, near_dark)

    @property
    def contact(self) -> Mask:
        """Pixels in shadow, close to what casts it."""
        return self.dark & (self.distance < CONTACT)


def acne(lit: Image, sight: Sight) -> float:
    """Return the share of lit pixels that are dark."""
    return _share(~(lit > 0.5), sight.lit)


def soft_acne(lit: Image, sight: Sight) -> float:
    """Return the mean darkness of lit pixels."""
    return _mean(1 - lit, sight.lit)


def inner_acne(lit: Image, sight: Sight) -> float:
    """Return the share of lit pixels away from shadows that are dark."""
    return _share(~(lit > 0.5), sight.lit & sight.inner)


def leak(lit: Image, sight: Sight) -> float:
    """Return the share of shadowed pixels that are lit."""
    return _share(~(lit < 0.5), sight.dark)


def inner_leak(lit: Image, sight: Sight) -> float:
    """Return the share of pixels inside of shadows that are lit."""
    return _share(~(lit < 0.5), sight.dark & sight.inner)


def contact_leak(lit: Image, sight: Sight) -> float:
    """Return the share of pixels close to what shadows them that are lit."""
    return _share(~(lit < 0.5), sight.contact)


def bleeding(lit: Image, sight: Sight) -> float:
    """Return the largest visibility of shadowed pixels, but for one in a hundred.

    Those two pixels and less from lit ones are left out.
    """
    near = scipy.ndimage.maximum_filter(sight.facing & sight.truth, size=5)
    inside = lit[sight.dark & np.logical_not(near)]
    return float(np.quantile(inside, 0.99)) if len(inside) else 0.0


def halo(lit: Image, sight: Sight) -> float:
    """Return the mean visibility of pixels close to what shadows them."""
    return _mean(lit, sight.contact)


def darkness(lit: Image, sight: Sight) -> float:
    """Return the mean darkness of the pixels that the row is about."""
    return _mean(1 - lit, sight.special)


def gap(lit: Image, sight: Sight) -> float:
    """Return the length by which shadows are detached, world units."""
    return contact_gap(lit, sight.truth, sight.facing, sight.distance, sight.sine)


def wrong(lit: Image, sight: Sight) -> float:
    """Return the share of pixels away from edges that are on the wrong side of one half."""
    right = np.where(sight.truth, lit > 0.5, lit < 0.5)
    return _share(~right, sight.facing & sight.inner & sight.special)


def soft_wrong(lit: Image, sight: Sight) -> float:
    """Return the mean distance from the truth away from edges."""
    return _mean(np.abs(lit - sight.truth), sight.facing & sight.inner & sight.special)


def penumbra_area(visibility: Image, surface: Mask) -> int:
    """Return the number of pixels of a penumbra, visible from 0.1 to 0.9."""
    return int(np.count_nonzero(surface & (visibility > 0.1) & (visibility < 0.9)))


def _share(bad: Mask, mask: Mask) -> float:
    return float(bad[mask].mean()) if mask.any() else 0.0


def _mean(values: Image, mask: Mask) -> float:
    """Return a mean, in which NaN counts 1."""
    return float(np.where(np.isnan(values), 1.0, values)[mask].mean()) if mask.any() else 0.0
