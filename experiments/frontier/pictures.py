"""The picture of a method on the page: its image, and beside it where it is wrong."""

import io

import numpy as np
from jaxtyping import Float
from PIL import Image

from ..figures import on_background, soft_error_picture
from ..files.images import linear_to_srgb
from .view import View

_SIDE = 256  # pixels at most, of each of the two
_GAP = 8  # white pixels between them
_QUALITY = 90  # of WebP; lines a pixel wide lose their hue below


def picture(
    view: View,
    visibility: Float[np.ndarray, "height width"],
    color: Float[np.ndarray, "height width 3"],
) -> bytes:
    """Return a method's image and its error side by side, as a WebP file.

    The error is the image in pale gray, the more orange the darker than truth it is, the more
    blue the lighter (``figures.soft_error_picture``). All is averaged in linear light to at
    most 256 pixels a side before it is colored, so that a quarter of wrong pixels is seen.

    Args:
        view: Where, with its truth.
        visibility: Of the method.
        color: The image under it, linear RGB.
    """
    covered = np.asarray(view.surface.covered)
    share = _smaller(view.share)
    wrong = _smaller(np.where(covered, visibility - view.share, 0.0))
    image = _smaller(on_background(color, covered))
    mostly = _smaller(covered.astype(np.float32)) > 0.5
    error = soft_error_picture(image, share + wrong, share, mostly)
    left, right = _encoded(image), _encoded(error)
    gap = np.full((left.shape[0], _GAP, 3), 255, np.uint8)
    file = io.BytesIO()
    Image.fromarray(np.hstack([left, gap, right])).save(file, "WEBP", quality=_QUALITY, method=6)
    return file.getvalue()


def _smaller(image: Float[np.ndarray, "height width ..."]) -> Float[np.ndarray, "h w ..."]:
    """Average over the area of each pixel that is left."""
    scale = min(1.0, _SIDE / max(image.shape[:2]))
    height, width = (max(1, round(scale * side)) for side in image.shape[:2])
    flat = image.reshape(*image.shape[:2], -1).astype(np.float32)
    channels = [Image.fromarray(flat[..., k]) for k in range(flat.shape[-1])]
    smaller = [channel.resize((width, height), Image.Resampling.BOX) for channel in channels]
    return np.dstack([np.asarray(channel) for channel in smaller]).reshape(
        height, width, *image.shape[2:]
    )


def _encoded(linear: Float[np.ndarray, "height width 3"]) -> np.ndarray:
    return np.rint(255 * linear_to_srgb(np.clip(linear, 0, 1))).astype(np.uint8)
