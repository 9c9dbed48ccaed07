"""How far a method's visibility is from the truth: acne, leaks, and the contact gap.

Acne is a dark pixel where the truth is lit, a leak a lit one where the truth is dark. A
pixel is right only if its visibility is on the truth's side of 0.5: exactly 0.5 decides
nothing and counts as wrong in both, and so does NaN (as 1 in the soft errors). Under an area
light truth is a share, and acne and leak are how much too dark and too light the pixels are.
Pixels without a surface do not count.
"""

from typing import NamedTuple

import numpy as np
import scipy.ndimage
from jaxtyping import Array, Bool, Float, Shaped

Image = Float[Array | np.ndarray, "height width"]
Mask = Bool[Array | np.ndarray, "height width"]
_WINDOW = 7


class ShadowErrors(NamedTuple):
    """Shares in [0, 1], 0 where there is nothing to share; and the pixels they refer to.

    Interior pixels are those away from shadow edges: the truth is the same at all surface
    pixels of the 7 x 7 window round them (less at the image's borders). On the other pixels,
    the edge, resolution rules and not bias.

    Attributes:
        acne: Wrong pixels among the truth-lit ones.
        leak: Wrong pixels among the truth-dark ones.
        error: Wrong pixels among all.
        acne_interior: As ``acne``, interior pixels only.
        leak_interior: As ``leak``, interior pixels only.
        error_interior: As ``error``, interior pixels only.
        soft_acne: Mean of ``1 - visibility`` over the truth-lit pixels, at least 0 each.
        soft_leak: Mean of ``visibility`` over the truth-dark pixels, at least 0 each.
        lit: Number of truth-lit pixels.
        dark: Number of truth-dark pixels.
        edge: Number of pixels that are not interior.
    """

    acne: float
    leak: float
    error: float
    acne_interior: float
    leak_interior: float
    error_interior: float
    soft_acne: float
    soft_leak: float
    lit: int
    dark: int
    edge: int


class SoftShadowErrors(NamedTuple):
    """Distances from the share of an area light that is seen, 0 where no pixel has any.

    Acne and leak add up to the mean distance. They are means over all pixels with a surface,
    not over lit or dark ones alone: in a penumbra a pixel is both.

    Attributes:
        acne: Mean of ``truth - visibility``, at least 0 each: light that is missing.
        leak: Mean of ``visibility - truth``, at least 0 each: light that is too much.
        rmse: Root mean square of the difference.
        rmse_penumbra: The same over the penumbra alone.
        surface: Number of pixels with a surface, over which the means are.
        penumbra: Number of those that see some of the light but not all.
    """

    acne: float
    leak: float
    rmse: float
    rmse_penumbra: float
    surface: int
    penumbra: int


def shadow_errors(visibility: Image, truth: Mask, surface: Mask) -> ShadowErrors:
    """Compare visibilities with the truth.

    Args:
        visibility: The method's, in [0, 1], 1 = lit; any value where there is no surface.
        truth: True where lit.
        surface: True where there is a surface.

    Returns:
        The errors.

    Raises:
        ValueError: If the sizes differ.
    """
    visibility, truth, surface = _checked("shadow_errors", visibility, truth, surface)
    lit, dark = surface & truth, surface & ~truth
    interior = surface & ~_near_edge(lit, dark)
    wrong = _wrong(visibility, truth)
    return ShadowErrors(
        acne=_mean(wrong, lit),
        leak=_mean(wrong, dark),
        error=_mean(wrong, surface),
        acne_interior=_mean(wrong, lit & interior),
        leak_interior=_mean(wrong, dark & interior),
        error_interior=_mean(wrong, interior),
        soft_acne=_mean(np.maximum(1.0 - visibility, 0.0), lit),
        soft_leak=_mean(np.maximum(visibility, 0.0), dark),
        lit=int(lit.sum()),
        dark=int(dark.sum()),
        edge=int((surface & ~interior).sum()),
    )


def soft_shadow_errors(visibility: Image, truth: Image, surface: Mask) -> SoftShadowErrors:
    """Compare visibilities with the true shares of an area light.

    Args:
        visibility: The method's, in [0, 1], 1 = lit; any value where there is no surface.
        truth: Share of the light that is seen, in [0, 1].
        surface: True where there is a surface.

    Returns:
        The errors.

    Raises:
        ValueError: If the sizes differ.
    """
    visibility, truth, surface = _checked("soft_shadow_errors", visibility, truth, surface)
    penumbra = surface & (truth > 0) & (truth < 1)
    squared = (visibility - truth) ** 2
    return SoftShadowErrors(
        acne=_mean(np.maximum(truth - visibility, 0.0), surface),
        leak=_mean(np.maximum(visibility - truth, 0.0), surface),
        rmse=_mean(squared, surface) ** 0.5,
        rmse_penumbra=_mean(squared, penumbra) ** 0.5,
        surface=int(surface.sum()),
        penumbra=int(penumbra.sum()),
    )


def contact_gap(
    visibility: Image,
    truth: Mask,
    surface: Mask,
    occluder_distance: Image,
    sin_angle: Image | float,
) -> float:
    """Return the length by which shadows are detached from what casts them (peter-panning).

    On a plane, ``occluder_distance * sin_angle`` is how far a pixel is from the point below
    its occluder. The gap is the threshold on that distance which best separates leaked from
    shadowed pixels (fewest misplaced; the smallest of equally good ones), among truth-dark
    interior pixels (see ``ShadowErrors``) that have an occluder. So a gap is not seen where
    all of it lies within three pixels of lit ones.

    For a caster of thickness ``w`` along the light's horizontal direction and a bias ``b``
    along the ray, it is ``max(0, b * sin_angle - w)``.

    Args:
        visibility: The method's, in [0, 1], 1 = lit.
        truth: True where lit.
        surface: True where there is a surface.
        occluder_distance: Along the ray to the occluder nearest to the surface, world units;
            infinity where there is none.
        sin_angle: Sine of the angle between the geometric normal and the direction to light.

    Returns:
        The gap in world units; 0 if nothing leaks next to the casters. Where the whole shadow
        is gone, the largest distance in it.

    Raises:
        ValueError: If the sizes differ.
    """
    visibility, truth, surface = _checked("contact_gap", visibility, truth, surface)
    distance = np.asarray(occluder_distance, np.float64)
    sine = np.asarray(sin_angle, np.float64)
    for name, image in (("occluder_distance", distance), ("sin_angle", sine)):
        if image.shape not in (truth.shape, ()):
            raise ValueError(f"contact_gap: expected `{name}` {truth.shape}, got {image.shape}")
    lit, dark = surface & truth, surface & ~truth
    chosen = dark & ~_near_edge(lit, dark) & np.isfinite(distance)
    foot = (distance * sine)[chosen]
    order = np.argsort(foot)
    foot, leaked = foot[order], _wrong(visibility, truth)[chosen][order]
    # misplaced[k]: pixels on the wrong side if the k nearest are taken for the leaked ones.
    misplaced = np.concatenate([[0], np.cumsum(np.where(leaked, -1, 1))])
    # Equal distances cannot be separated.
    possible = np.concatenate([[True], np.diff(foot) > 0, [True]])[: len(foot) + 1]
    count = int(np.argmin(np.where(possible, misplaced, len(foot) + 1)))
    if count == 0:
        return 0.0
    return float(0.5 * (foot[count - 1] + foot[min(count, len(foot) - 1)]))


def _wrong(
    visibility: Float[np.ndarray, "height width"], truth: Bool[np.ndarray, "height width"]
) -> Bool[np.ndarray, "height width"]:
    """Return where the visibility is not on the truth's side of 0.5."""
    return ~np.where(truth, visibility > 0.5, visibility < 0.5)


def _near_edge(
    lit: Bool[np.ndarray, "height width"], dark: Bool[np.ndarray, "height width"]
) -> Bool[np.ndarray, "height width"]:
    """Return where the window holds both lit and dark pixels."""
    has_lit, has_dark = (
        scipy.ndimage.maximum_filter(kind, size=_WINDOW, mode="constant", cval=0)
        for kind in (lit, dark)
    )
    return np.logical_and(has_lit, has_dark)


def _mean(
    values: Shaped[np.ndarray, "height width"], mask: Bool[np.ndarray, "height width"]
) -> float:
    """Return the mean over the mask, 0 where that is empty; NaN among the values counts 1."""
    return float(np.where(np.isnan(values), 1.0, values)[mask].mean()) if mask.any() else 0.0


def _checked(
    caller: str, visibility: Image, truth: Image | Mask, surface: Mask
) -> tuple[
    Float[np.ndarray, "height width"],
    Shaped[np.ndarray, "height width"],
    Bool[np.ndarray, "height width"],
]:
    """Return the images as NumPy arrays, or raise if their sizes differ."""
    images = {"visibility": visibility, "truth": truth, "surface": surface}
    shapes = {name: image.shape for name, image in images.items()}
    if len(set(shapes.values())) != 1 or len(visibility.shape) != 2:
        raise ValueError(f"{caller}: expected images of one size (height, width), got {shapes}")
    return np.asarray(visibility, np.float64), np.asarray(truth), np.asarray(surface)
