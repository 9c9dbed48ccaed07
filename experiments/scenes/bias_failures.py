"""Scenes on which biases fail, by rows of the failure catalogue (``failure_scenes``).

Surfaces under grazing light, and casters about as thin as the bias that those ask for.
"""

import dataclasses
import itertools
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from shadows.lights import DirectionalLight, Light
from shadows.transforms import look_at
from tangentspace.mesh import Mesh
from tangentspace.shapes import box, icosphere, plane, transform_mesh

from ..scene import Material, Scene
from .staging import UP, placed, staged, sun


def tilted_plane(tilt: float = 80.0) -> Scene:
    """Row 1: a bare plane tilted to the light: without a bias half of it is striped.

    Args:
        tilt: Angle between the plane's normal and the light, degrees.
    """
    floor = plane(2.0)
    return staged("tilted-plane", [floor], eye=(0.0, 2.2, 3.4), light=sun(90.0 - tilt, 90.0))


def turned_plane(azimuth: float = 45.0) -> Scene:
    """Row 2: that plane turned about the light: a bias by the larger slope alone leaves acne.

    Plane and camera turn together, so that the view stays and only the map's grid turns.

    Args:
        azimuth: Of the turn, degrees.
    """
    scene = tilted_plane()
    light = scene.lights[0]
    assert isinstance(light, DirectionalLight)
    turn = np.eye(4)
    turn[:3, :3] = _rotation(np.asarray(light.direction), np.deg2rad(azimuth))
    view = np.asarray(scene.camera.view_from_world @ turn.T, np.float32)
    return scene._replace(
        name="turned-plane",
        mesh=transform_mesh(scene.mesh, turn),
        camera=dataclasses.replace(scene.camera, view_from_world=view),
    )


def contact_wall(thickness: float = 0.02) -> Scene:
    """Row 3a: a thin wall across the light: its shadow detaches by ``b sin(50) - thickness``.

    Args:
        thickness: Along the light's horizontal direction.
    """
    wall = placed(box((thickness / 2, 0.4, 0.8)), (0.5, 0.4, 0.0))
    return staged("contact-wall", [plane(2.0), wall], eye=(-1.8, 2.0, 2.4), light=sun(40.0, 90.0))


def contact_plate(height: float = 0.02) -> Scene:
    """Row 3b: a plate on a floor: its narrow shadow is gone once ``b > height / cos(50)``.

    Args:
        height: Of the plate's top over the floor.
    """
    plate = placed(box((0.3, height / 2, 0.3)), (0.0, height / 2, 0.0))
    return aimed(
        "contact-plate",
        [plane(0.5), plate],
        eye=(-0.8, 0.45, 0.45),
        target=(-0.2, 0.0, 0.0),
        light=sun(40.0, 90.0),
    )


def box_corner() -> Scene:
    """Row 4: a box on a floor: a map of back faces leaks along the edge where they meet."""
    block = placed(box((0.4, 0.3, 0.4)), (0.0, 0.3, 0.0))
    return staged("box-corner", [plane(2.0), block], eye=(-2.0, 1.7, 2.4), light=sun(45.0, 70.0))


def open_fold() -> Scene:
    """Row 4: a tent of two open sheets: a map of back faces knows nothing of the lit one."""
    front, back, ridge = 0.7, -0.7, np.array([0.0, 0.7])
    sheets = [
        _quad((0.7, 0.0, front), (0.7, 0.0, back), (*ridge, back), (*ridge, front)),
        _quad((-0.7, 0.0, back), (-0.7, 0.0, front), (*ridge, front), (*ridge, back)),
    ]
    return staged("open-fold", [plane(2.0), *sheets], eye=(-0.6, 1.1, 3.4), light=sun(35.0, 80.0))


def thin_wall(thickness: float = 0.01) -> Scene:
    """Row 5: a hut with walls thinner than a bias: light comes through along their feet.

    Args:
        thickness: Of walls and roof.
    """
    half = thickness / 2
    walls = [placed(box((half, 0.35, 0.5)), (x, 0.35, 0.0)) for x in (-0.7, 0.7)]
    walls += [placed(box((0.7, 0.35, half)), (0.0, 0.35, -0.5))]
    roof = placed(box((0.7, half, 0.5)), (0.0, 0.7, 0.0))
    parts = [plane(2.0), *walls, roof]
    return staged("thin-wall", parts, eye=(0.5, 1.3, 3.4), light=sun(40.0, 230.0))


def coarse_sphere() -> Scene:
    """Row 6: a ball that a wide floor leaves few texels for: rings of acne at its terminator."""
    ball = placed(icosphere(0.6, subdivisions=4), (0.0, 0.7, 0.0))
    return staged("coarse-sphere", [plane(20.0), ball], eye=(1.4, 1.9, 3.2), light=sun(50.0, -60.0))


def wide_kernel() -> Scene:
    """Row 7: the tilted plane, for wide filters: with one depth acne grows with their reach."""
    return tilted_plane(80.0)._replace(name="wide-kernel")


def crease() -> Scene:
    """Row 8: stairs, all lit: across an edge the receiver's plane is not the surface."""
    profile = [(1.7, 0.0), (0.7, 0.0), (0.7, 0.5), (-0.3, 0.5), (-0.3, 1.0), (-1.3, 1.0)]
    steps = [
        _quad((-1.2, low, near), (1.2, low, near), (1.2, high, far), (-1.2, high, far))
        for (near, low), (far, high) in itertools.pairwise(profile)
    ]
    return staged("crease", steps, eye=(1.2, 2.2, 3.2), light=sun(25.0, 25.0))


def edge_on_triangle() -> Scene:
    """Row 9: sheets turned out of the light's rays by hardly anything: slopes without bound."""
    turns = [0.0, 1e-7, 1e-4, 1e-2, 0.1]
    sheets = []
    for turn, z in zip(turns, np.linspace(-1.2, 0.8, len(turns)), strict=True):
        corners = np.array([[-0.5, 0.0, 0.0], [0.5, 0.0, 0.0], [0.2, 0.7, 0.0]])
        corners = corners @ _rotation(UP, turn).T + [0.3 * z, 0.0, z]
        sheets.append(triangles(corners[None]))
    parts = [plane(2.0), *sheets]
    return staged("edge-on-triangle", parts, eye=(-1.0, 2.2, 3.2), light=sun(45.0, 90.0))


def bent_normals() -> Scene:
    """Row 30: rods over a ball of few faces: offset along its smooth normals, shadow is lost."""
    ball = placed(icosphere(0.7, subdivisions=1), (0.0, 0.8, 0.0))
    rods = [placed(box((0.05, 0.05, 0.9)), (x, 1.7, 0.0)) for x in (-0.3, 0.0, 0.3, 0.6)]
    parts = [plane(2.0), ball, *rods]
    return staged("bent-normals", parts, eye=(1.2, 2.0, 3.2), light=sun(60.0, 70.0))


def aimed(
    name: str,
    parts: Sequence[Mesh],
    looks: Sequence[Material] | None = None,
    *,
    eye: tuple[float, float, float],
    target: tuple[float, float, float],
    light: Light,
    near: float = 0.1,
    far: float = 20.0,
) -> Scene:
    """Merge the parts as ``staged`` does, and look at another point than the floor's middle.

    Args:
        name: The scene's name.
        parts: Its meshes, world space.
        looks: The material of each part; by default all are white.
        eye: Where the camera stands.
        target: What it looks at.
        light: The only light.
        near: Distance of the camera's near plane.
        far: Distance of its far plane.
    """
    scene = staged(name, parts, looks, eye=eye, light=light)
    view = np.asarray(look_at(np.array(eye), np.array(target), UP), np.float32)
    camera = dataclasses.replace(scene.camera, view_from_world=view, near=near, far=far)
    return scene._replace(camera=camera)


def triangles(corners: Float[np.ndarray, "faces 3 3"]) -> Mesh:
    """Return flat triangles that share no vertex.

    Args:
        corners: Of each face, counter-clockwise seen from outside.
    """
    corners = np.asarray(corners, np.float64)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    faces = np.arange(3 * len(corners), dtype=np.int32).reshape(-1, 3)
    return Mesh(
        positions=corners.reshape(-1, 3).astype(np.float32),
        normals=np.repeat(normals, 3, axis=0).astype(np.float32),
        faces=faces,
    )


def _quad(*corners: tuple[float, ...]) -> Mesh:
    a, b, c, d = (np.array(corner) for corner in corners)
    return triangles(np.array([[a, b, c], [a, c, d]]))


def _rotation(axis: Float[np.ndarray, "3"], angle: float) -> Float[np.ndarray, "3 3"]:
    """Return the turn about a unit axis, counter-clockwise seen against it."""
    x, y, z = np.asarray(axis, np.float64)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * (cross @ cross)
