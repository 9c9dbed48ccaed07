"""Scenes made by code that show a kind of light."""

import numpy as np
from jaxtyping import Float

from shadows.area_lights import DiscLight
from shadows.lights import DirectionalLight
from shadows.projector import Projector
from tangentspace.shapes import box, icosphere, plane

from ..scene import Scene
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


def skylights() -> Scene:
    """Light that falls through six openings in the roof of a dark room."""
    along = [(-1.2, 0.6), (-0.1, 0.3), (0.7, 0.3), (1.45, 0.25)]  # middle and half width, in x
    across = [(-1.3, 0.2), (-0.4, 0.4), (1.6, 1.4)]  # in z
    boards = [placed(box((half, 0.02, 2.25)), (x, 1.72, 0.75)) for x, half in along]
    boards += [placed(box((1.7, 0.02, half)), (0.0, 1.68, z)) for z, half in across]
    sides = [placed(box((0.03, 0.85, 2.25)), (x, 0.85, 0.75)) for x in (-1.7, 1.7)]
    wall = placed(box((1.7, 0.85, 0.03)), (0.0, 0.85, -1.5))
    ball = placed(icosphere(0.3, subdivisions=4), (-0.2, 0.3, 0.1))
    light = DirectionalLight(sun(62.0, 90.0).direction, np.array([4.0, 3.6, 3.0], np.float32))
    parts = [plane(3.0), *boards, *sides, wall, ball]
    return staged("skylights", parts, eye=(0.3, 1.0, 2.9), light=light)


def soft_lamp() -> Scene:
    """A round lamp over a gate, a ball and plates: penumbrae grow from contact with the gap."""
    gate = [placed(box((0.05, 0.5, 0.05)), (x, 0.5, -0.2)) for x in (-1.3, -0.15)]
    gate.append(placed(box((0.625, 0.05, 0.05)), (-0.725, 1.05, -0.2)))
    ball = placed(icosphere(0.22, subdivisions=4), (-0.35, 0.22, 0.85))
    plates = [
        placed(box((0.2, 0.02, 0.2)), (x, height, z))
        for x, height, z in ((0.45, 0.05, 1.05), (0.75, 0.3, 0.35), (0.5, 0.7, -0.6))
    ]
    position, target = np.array([-0.9, 3.0, 1.6]), np.array([0.1, 0.0, 0.0])
    direction = (target - position) / np.linalg.norm(target - position)
    light = DiscLight(position.astype(np.float32), direction.astype(np.float32), radius=0.25)
    parts = [plane(2.0), *gate, ball, *plates]
    return staged("soft-lamp", parts, eye=(0.7, 2.3, 3.6), light=light)


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
