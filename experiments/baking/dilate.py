"""Values spread from the texels that have one into the gutters between charts.

A bilinear lookup near a chart's edge, and every coarser mip, reads texels that no face
covers; they must hold what lies next to them. The texture repeats: what leaves it on one
side comes in on the other.
"""

import numpy as np
import scipy.ndimage
from jaxtyping import Bool, Float


def dilate(
    texels: Float[np.ndarray, "height width channels"],
    known: Bool[np.ndarray, "height width"],
    *,
    margin: int,
) -> tuple[Float[np.ndarray, "height width channels"], Bool[np.ndarray, "height width"]]:
    """Copy the nearest known texel into each unknown one that is near enough.

    Args:
        texels: Any values; those of unknown texels are not read.
        known: Which texels hold a value.
        margin: How far values spread, texels from centre to centre, >= 0.

    Returns:
        The texels, unknown ones farther than the margin from any known one left as they
        are, and which are filled now. Of equally near ones any may be copied.

    Raises:
        ValueError: If the sizes differ or the margin is negative.
    """
    if texels.shape[:2] != known.shape:
        raise ValueError(
            f"dilate: expected `known` of the texels' size {texels.shape[:2]}, got {known.shape}"
        )
    if margin < 0:
        raise ValueError(f"dilate: expected `margin` of at least 0 texels, got {margin}")
    if margin == 0 or not known.any():
        return texels, known
    height, width = known.shape
    # Around the texture lies the texture again, as far as values can come from.
    around = [(min(margin, side),) * 2 for side in (height, width)]
    unknown = ~np.pad(known, around, mode="wrap")
    distance = np.empty(unknown.shape)
    nearest = np.empty((2, *unknown.shape), np.int32)
    scipy.ndimage.distance_transform_edt(
        unknown, distances=distance, indices=nearest, return_indices=True
    )
    inside = tuple(
        slice(before, before + side)
        for (before, _), side in zip(around, (height, width), strict=True)
    )
    rows, columns = nearest[0][inside] - around[0][0], nearest[1][inside] - around[1][0]
    filled = distance[inside] <= margin
    copies = texels[rows % height, columns % width]
    return np.where(filled[..., None], copies, texels), filled
