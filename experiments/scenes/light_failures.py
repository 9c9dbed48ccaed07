"""Scenes on which filters, maps and volumes fail, by rows of the catalogue (``failure_scenes``).

Blockers at several depths, and lights and views that one map or a naive projection serves
badly.
"""

import dataclasses
import itertools

import numpy as np
from jaxtyping import Float

from shadows.lights import SpotLight
from tangentspace.shapes import box, icosphere, plane

from ..scene import Scene
from .bias_failures import aimed, triangles
from .layout_scenes import avenue
from .staging import placed, staged, sun


def two_occluders() -> Scene:
    """Row 10: a plate over a grate over a floor: variance leaks light into the plate's umbra."""
    slats = [placed(box((0.06, 0.01, 0.6)), (x, 0.2, 0.0)) for x in np.linspace(-0.6, 0.6, 6)]
    plate = placed(box((0.7, 0.01, 0.5)), (0.15, 0.6, 0.0))
    parts = [plane(2.0), *slats, plate]
    return staged("two-occluders", parts, eye=(-1.8, 1.2, 2.6), light=sun(45.0, 80.0))


def contact_halo() -> Scene:
    """Row 12: a post, and a board that rests on one edge: a halo where they touch the floor."""
    post = placed(box((0.1, 0.35, 0.1)), (0.6, 0.35, -0.4))
    board = triangles(
        np.array(
            [
                [[-0.9, 0.001, 0.7], [0.5, 0.001, 0.7], [0.5, 0.15, -0.1]],
                [[-0.9, 0.001, 0.7], [0.5, 0.15, -0.1], [-0.9, 0.15, -0.1]],
            ]
        )
    )
    parts = [plane(2.0), post, board]
    return staged("contact-halo", parts, eye=(-1.6, 1.5, 2.6), light=sun(35.0, 70.0))


def tall_and_short() -> Scene:
    """Row 17: a low block in the shadow's edge of a tall one: two penumbrae of unlike widths."""
    tall = placed(box((0.12, 0.6, 0.3)), (0.9, 0.6, -0.3))
    short = placed(box((0.12, 0.1, 0.3)), (0.05, 0.1, 0.1))
    parts = [plane(2.0), tall, short]
    return staged("tall-and-short", parts, eye=(-1.6, 2.2, 2.6), light=sun(45.0, 90.0))


def near_far() -> Scene:
    """Row 18: posts before a lamp, near and far: one bias in depth units is too small and large."""
    ground = placed(plane(60.0), (0.0, 0.0, -59.0))
    posts = [
        placed(box((0.02 * d, 0.06 * d, 0.02 * d)), (0.12 * d, 0.06 * d, -d))
        for d in (0.4, 1.5, 6.0, 25.0, 90.0)
    ]
    position = np.array([-0.05, 0.3, 0.0], np.float32)
    light = SpotLight(position, _direction(0.0, -0.03, -1.0), inner_angle=0.5, outer_angle=0.7)
    return aimed(
        "near-far",
        [ground, *posts],
        eye=(-0.5, 0.7, 0.9),
        target=(0.15, 0.1, -2.0),
        far=150.0,
        light=light,
    )


def behind_spot() -> Scene:
    """Row 19: posts before and behind a spot light: a naive projection mirrors them backwards."""
    posts = [placed(box((0.08, 0.4, 0.08)), (x, 0.4, z)) for z in (-1.0, 1.0) for x in (-0.45, 0.2)]
    walls = [placed(box((2.0, 0.6, 0.03)), (0.0, 0.6, z)) for z in (-2.0, 2.0)]
    position = np.array([0.0, 0.9, 0.0], np.float32)
    light = SpotLight(position, _direction(0.0, -0.35, -1.0), inner_angle=0.6, outer_angle=0.75)
    return aimed(
        "behind-spot",
        [plane(2.1), *posts, *walls],
        eye=(4.6, 4.4, 0.9),
        target=(0.0, 0.0, -0.2),
        light=light,
    )


def duelling_frusta() -> Scene:
    """Row 22: a view into the low sun along a deep row of posts: no map of one warp fits both."""
    posts = [
        placed(box((0.08, 0.5, 0.08)), (side, 0.5, -float(z)))
        for z in np.cumsum(np.linspace(0.5, 4.0, 10))
        for side in (-0.7, 0.8)
    ]
    ground = placed(plane(20.0), (0.0, 0.0, -16.0))
    return aimed(
        "duelling-frusta",
        [ground, *posts],
        eye=(0.1, 1.2, 2.5),
        target=(0.0, 0.3, -5.0),
        near=0.3,
        far=60.0,
        light=sun(22.0, 178.0),
    )


def panning_camera(pan: float = 0.003) -> Scene:
    """Row 23: the avenue from an eye moved a little aside: unsteady cascades let edges crawl.

    Args:
        pan: Way of the eye to the right, world units; about a tenth of a texel.
    """
    scene = avenue()
    shift = np.eye(4, dtype=np.float32)
    shift[0, 3] = -pan
    camera = dataclasses.replace(scene.camera, view_from_world=shift @ scene.camera.view_from_world)
    return scene._replace(name="panning-camera", camera=camera)


def near_plane_triangle() -> Scene:
    """Row 25: a board that reaches from behind a spot light to before it: it needs clipping."""
    board = triangles(np.array([[[-3.0, 1.25, -0.3], [-3.0, 1.25, 0.5], [1.4, 1.0, 0.1]]]))
    wall = placed(box((0.03, 0.9, 1.5)), (1.9, 0.9, 0.0))
    position = np.array([-1.3, 0.85, 0.0], np.float32)
    light = SpotLight(position, _direction(1.0, -0.1, 0.0), inner_angle=0.6, outer_angle=0.75)
    return aimed(
        "near-plane-triangle",
        [plane(2.0), wall, board],
        eye=(-1.6, 2.6, 3.6),
        target=(0.5, 0.5, 0.0),
        light=light,
    )


def t_junction() -> Scene:
    """Row 26: a roof whose parts share an edge but not its vertices: light through the cracks."""
    a, b = np.array([-0.9, 0.8, -0.35]), np.array([0.9, 0.93, 0.41])
    front, back = np.array([0.2, 0.85, 1.1]), np.array([-0.1, 0.87, -1.0])
    along = a + np.linspace(0, 1, 8)[:, None] * (b - a)  # rounding moves these off the line
    whole = [[a, front, b]]
    pieces = [[p, q, back] for p, q in itertools.pairwise(along)]
    roof = triangles(np.array(whole + pieces))
    return staged("t-junction", [plane(2.0), roof], eye=(1.2, 2.2, 3.2), light=sun(60.0, 200.0))


def eye_in_shadow() -> Scene:
    """Row 27: the eye stands in the shadow of a roof: counting volumes from it is off by one."""
    roof = placed(box((2.2, 0.03, 1.2)), (0.0, 2.2, 3.2))
    post = placed(box((0.12, 0.5, 0.12)), (-0.6, 0.5, 0.0))
    ball = placed(icosphere(0.35, subdivisions=3), (0.5, 0.35, -0.3))
    parts = [plane(4.0), roof, post, ball]
    return staged("eye-in-shadow", parts, eye=(0.5, 1.4, 3.6), light=sun(65.0, 20.0))


def _direction(x: float, y: float, z: float) -> Float[np.ndarray, "3"]:
    vector = np.array([x, y, z])
    return (vector / np.linalg.norm(vector)).astype(np.float32)
