"""Scenes made by code that show a kind of light."""

import numpy as np
from jaxtyping import Float

from shadows.projector import Projector
from tangentspace.shapes import box, icosphere, plane

from .scene import Scene
from .staging import placed, staged, sun


def projector() -> Scene:
    """A slide thrown across a floor onto a wall, with a ball and a post in its way."""
    wall = placed(box((1.5, 0.75, 0.04)), (0.0, 0.75, -1.2))
    ball = placed(icosphere(0.3, subdivisions=4), (-0.45, 0.3, 0.3))
    post = placed(box((0.12, 0.45, 0.12)), (0.65, 0.45, -0.2))
    position, target = np.array([0.6, 1.2, 3.0]), np.array([0.0, 0.6, -1.2])
    direction = (target - position) / np.linalg.norm(target - position)
    light = Projector(
        position.astype(np.float32),
        direction.astype(np.float32),
        _slide(96, 128),
        vertical_fov=float(np.deg2rad(25.0)),
        color=np.full(3, 1.5, np.float32),
    )
    return staged("projector", [plane(2.0), wall, ball, post], eye=(-1.5, 2.0, 4.2), light=light)


def slats() -> Scene:
    """Light that falls through the gaps of a roof of boards into a shed with an open side."""
    boards = [
        placed(box((1.5, 0.03, 0.14)), (0.0, 1.6, z)) for z in (-1.05, -0.6, -0.15, 0.3, 0.75)
    ]
    back = placed(box((1.5, 0.8, 0.03)), (0.0, 0.8, -1.25))
    ball = placed(icosphere(0.3, subdivisions=4), (0.3, 0.3, -0.1))
    parts = [plane(2.0), *boards, back, ball]
    return staged("slats", parts, eye=(2.6, 1.1, 3.2), light=sun(60.0, 35.0))


def _slide(height: int, width: int) -> Float[np.ndarray, "{height} {width} 3"]:
    """Return a checkered picture, red to the right and green upwards, with a white arrow up."""
    u = np.broadcast_to((np.arange(width) + 0.5) / width, (height, width))
    v = np.broadcast_to((height - 0.5 - np.arange(height))[:, None] / height, (height, width))
    checks = (np.floor(8 * u) + np.floor(6 * v)) % 2
    color = (
        np.stack([u, v, np.clip(1 - u - v, 0, 1)], axis=-1) * np.where(checks, 1, 0.5)[..., None]
    )
    across = np.abs(u - 0.5) * width / height
    shaft = (across < 0.04) & (v > 0.25) & (v < 0.6)
    head = (v >= 0.55) & (across < 0.75 * (0.75 - v))
    color[shaft | head] = 1.0
    return color.astype(np.float32)
