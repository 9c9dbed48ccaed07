"""Textures out of image files: colors become linear, normal maps stay as they are."""

from io import BytesIO
from pathlib import Path

import numpy as np
from jaxtyping import Float
from PIL import Image

from .images import srgb_to_linear


def read_texture(file: Path | BytesIO, *, color: bool) -> Float[np.ndarray, "height width 3"]:
    """Return an image's RGB texels, row 0 on top, alpha dropped.

    Args:
        file: An image file that Pillow can open; 8 bits per channel are kept.
        color: Decode from sRGB to linear; False keeps raw values (normal maps).

    Returns:
        Values in [0, 1], float32.

    Raises:
        ValueError: If the file is no image, or a broken one.
    """
    try:
        with Image.open(file) as image:
            texels = np.asarray(image.convert("RGB"))
    except (OSError, SyntaxError, Image.DecompressionBombError) as error:
        raise ValueError("a texture is no image that can be read") from error
    levels = np.arange(256) / 255
    return (srgb_to_linear(levels) if color else levels).astype(np.float32)[texels]
