"""Scenes made by code, each for a failure it shows; ``load_scene`` finds them by name.

World units are arbitrary; each scene is a few units wide. Elevations are angles of the
light over the floor. A new scene is a new function in one of the tables below; those of the
failure catalogue are in ``failure_scenes``.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from shadows.lights import SpotLight
from tangentspace.shapes import box, icosphere, plane

from ..files.mesh_file import load_scene_file
from ..options import hint
from ..scene import Scene
from .failure_scenes import FAILURE_SCENES
from .layout_scenes import avenue, room
from .light_scenes import projector, skylights, soft_lamp
from .mapped_scenes import bumpy, displaced, mirror, normal_cells
from .relief import relief, shadowed_relief
from .staging import placed, staged, sun


def grazing_plane() -> Scene:
    """A bare floor under light 8 degrees high: nothing but acne can go wrong."""
    floor = plane(2.0)
    return staged("grazing-plane", [floor], eye=(0.0, 2.2, 3.4), light=sun(8.0, 30.0))


def thin_box() -> Scene:
    """A thin wall and a thin plate on a floor: a bias larger than they are loses shadow."""
    wall = placed(box((0.8, 0.4, 0.01)), (0.0, 0.4, -0.3))
    plate = placed(box((0.35, 0.02, 0.35)), (-0.2, 0.02, 0.75))
    return staged(
        "thin-box", [plane(2.0), wall, plate], eye=(1.6, 2.2, 3.0), light=sun(40.0, 160.0)
    )


def sphere() -> Scene:
    """A ball that hovers over a floor: every slope towards the light at once."""
    ball = placed(icosphere(0.6, subdivisions=5), (0.0, 0.8, 0.0))
    return staged("sphere", [plane(2.0), ball], eye=(1.4, 1.9, 3.2), light=sun(50.0, -60.0))


def stacked() -> Scene:
    """Two plates one above the other over a floor: three depths behind one texel."""
    low = placed(box((0.6, 0.02, 0.4)), (0.0, 0.3, 0.0))
    high = placed(box((0.35, 0.02, 0.6)), (0.15, 0.8, 0.1))
    return staged("stacked", [plane(2.0), low, high], eye=(1.5, 2.0, 3.2), light=sun(55.0, 200.0))


def spot() -> Scene:
    """A wall and a ball in the cone of a spotlight: texels grow with distance."""
    ball = placed(icosphere(0.4, subdivisions=4), (0.5, 0.4, 0.3))
    wall = placed(box((0.03, 0.5, 0.5)), (-0.5, 0.5, 0.0))
    position = np.array([-1.8, 2.6, 1.6], np.float32)
    direction = -position / np.linalg.norm(position)
    light = SpotLight(position, direction.astype(np.float32), inner_angle=0.45, outer_angle=0.6)
    return staged("spot", [plane(2.5), ball, wall], eye=(1.8, 2.2, 3.0), light=light)


def bracket() -> Scene:
    """A bracket of three bars that hovers over a floor: its shadow tells how it is turned."""
    bars = [
        placed(box((0.4, 0.06, 0.08)), (0.0, 0.9, 0.0)),
        placed(box((0.07, 0.05, 0.25)), (-0.33, 0.9, 0.33)),
        placed(box((0.06, 0.2, 0.06)), (0.32, 1.12, -0.1)),
    ]
    position = np.array([0.5, 3.4, 0.9], np.float32)
    direction = -position / np.linalg.norm(position)
    light = SpotLight(position, direction.astype(np.float32), inner_angle=0.5, outer_angle=0.8)
    return staged("bracket", [plane(1.8), *bars], eye=(0.2, 2.4, 2.6), light=light)


def default() -> Scene:
    """Low light over a ball, a wall and sheets hardly thicker than the bias that acne asks for."""
    ball = placed(icosphere(0.45, subdivisions=4), (-0.75, 0.45, -0.35))
    wall = placed(box((0.01, 0.3, 0.45)), (0.55, 0.3, -0.2))
    sheets = [
        placed(box((0.22, height, 0.22)), (x, height, 0.95))
        for x, height in ((-0.9, 0.002), (-0.2, 0.004), (0.5, 0.008))
    ]
    return staged(
        "default", [plane(2.0), ball, wall, *sheets], eye=(0.5, 2.1, 3.3), light=sun(16.0, -62.0)
    )


SHADOW_SCENES: dict[str, Callable[[], Scene]] = {
    "default": default,
    "grazing-plane": grazing_plane,
    "thin-box": thin_box,
    "sphere": sphere,
    "stacked": stacked,
    "spot": spot,
    "bracket": bracket,
}
MAPPED_SCENES: dict[str, Callable[[], Scene]] = {
    "bumpy": bumpy,
    "normal-cells": normal_cells,
    "mirror": mirror,
    "displaced": displaced,
    "relief": relief,
    "shadowed-relief": shadowed_relief,
}
LIGHT_SCENES: dict[str, Callable[[], Scene]] = {
    "projector": projector,
    "skylights": skylights,
    "soft-lamp": soft_lamp,
    "room": room,
    "avenue": avenue,
}
EMBEDDED = SHADOW_SCENES | MAPPED_SCENES | LIGHT_SCENES


def load_scene(name: str) -> Scene:
    """Return an embedded scene by its name, or load a mesh or glTF file.

    Raises:
        ValueError: If the name is neither an embedded scene nor a readable file.
    """
    known = EMBEDDED | FAILURE_SCENES
    if name in known:
        return known[name]()
    if not Path(name).exists() and not Path(name).suffix:
        raise ValueError(
            f"scene '{name}': neither a file nor an embedded scene; {hint(name, known)}"
        )
    return load_scene_file(name)
