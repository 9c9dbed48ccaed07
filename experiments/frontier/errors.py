"""How wrong an image of visibility is, and the picture made with it."""

from typing import Any

import flip_evaluator
import numpy as np
from jaxtyping import Float

from ..files.images import linear_to_srgb
from ..metrics import shadow_errors, soft_shadow_errors
from .view import View

FIGURES = (
    "rmse", "rmse_penumbra", "acne", "leak", "error", "error_interior", "flip",
    "gradient_error", "bias",
)  # fmt: skip


def errors(
    view: View,
    visibility: Float[np.ndarray, "height width"],
    color: Float[np.ndarray, "height width 3"],
) -> dict[str, Any]:
    """Return the figures of a method's answer on a view.

    Args:
        view: Scene and truth.
        visibility: What the method says of the light, 0 where it is not faced.
        color: Its picture, linear RGB.

    Returns:
        ``rmse`` of the visibility where a surface is, and under an area light in the
        penumbra; ``acne`` and ``leak``, shares of pixels, or under an area light means;
        ``error`` and ``error_interior``, wrong pixels, and those away from edges; and
        ``flip``, the mean FLIP of the picture.
    """
    covered = np.asarray(view.surface.covered)
    soft = soft_shadow_errors(visibility, view.share, covered)
    hard = shadow_errors(visibility, view.share > 0.5, covered)
    return {
        "rmse": soft.rmse,
        "rmse_penumbra": soft.rmse_penumbra if view.soft else None,
        "acne": soft.acne if view.soft else hard.acne,
        "leak": soft.leak if view.soft else hard.leak,
        "error": hard.error,
        "error_interior": hard.error_interior,
        "flip": mean_flip(view.color, color),
    }


def mean_flip(
    truth: Float[np.ndarray, "height width 3"], color: Float[np.ndarray, "height width 3"]
) -> float:
    """Return the mean FLIP of two pictures, linear RGB in and shown as sRGB."""
    shown = [linear_to_srgb(np.clip(image, 0, 1)) for image in (truth, color)]
    _, flip, _ = flip_evaluator.evaluate(shown[0], shown[1], "LDR", applyMagma=False)
    return float(flip)
