"""Scenes made by code that one shadow map does not serve."""

import dataclasses

import numpy as np

from shadows.lights import PointLight
from shadows.transforms import look_at
from tangentspace.shapes import box, icosphere, plane

from ..scene import Scene
from .staging import UP, placed, staged, sun


def room() -> Scene:
    """A lamp among a ball, a post and a table in a closed room: light in every direction."""
    walls = [plane(1.7), placed(box((1.6, 0.05, 1.6)), (0.0, 2.05, 0.0))]
    walls += [placed(box((0.05, 1.0, 1.6)), (x, 1.0, 0.0)) for x in (-1.65, 1.65)]
    walls += [placed(box((1.6, 1.0, 0.05)), (0.0, 1.0, z)) for z in (-1.65, 1.65)]
    ball = placed(icosphere(0.28, subdivisions=4), (-0.75, 0.28, -0.5))
    post = placed(box((0.08, 0.8, 0.08)), (0.75, 0.8, -0.75))
    table = placed(box((0.35, 0.02, 0.3)), (0.35, 0.5, 0.1))
    lamp = PointLight(np.array([0.0, 1.25, -0.3], np.float32))
    scene = staged("room", [*walls, ball, post, table], eye=(-0.6, 1.35, 1.55), light=lamp)
    camera = dataclasses.replace(scene.camera, vertical_fov=float(np.deg2rad(70.0)), near=0.05)
    return scene._replace(camera=camera)


def avenue() -> Scene:
    """Posts along a road sixty units deep under the sun: near and far in one view."""
    posts = [
        placed(box((0.12, 0.6, 0.12)), (side, 0.6, -float(z)))
        for z in np.cumsum(np.linspace(1.5, 6.0, 14))
        for side in (-1.4, 1.4)
    ]
    ground = placed(plane(40.0), (0.0, 0.0, -30.0))
    scene = staged("avenue", [ground, *posts], eye=(0.4, 1.3, 2.5), light=sun(35.0, 110.0))
    view = look_at(np.array([0.4, 1.3, 2.5]), np.array([0.0, 0.5, -10.0]), UP)
    camera = dataclasses.replace(
        scene.camera, view_from_world=np.asarray(view, np.float32), near=0.3, far=80.0
    )
    return scene._replace(camera=camera)
