"""Placing, lighting and viewing the parts of scenes made by code."""

from collections.abc import Sequence

import numpy as np

from shadows.lights import DirectionalLight, Light
from shadows.transforms import PerspectiveCamera, look_at
from tangentspace.mesh import Mesh
from tangentspace.shapes import merge, transform_mesh

from ..scene import Material, Scene

UP = np.array([0.0, 1.0, 0.0], np.float32)


def placed(mesh: Mesh, offset: tuple[float, float, float]) -> Mesh:
    """Move a mesh."""
    matrix = np.eye(4)
    matrix[:3, 3] = offset
    return transform_mesh(mesh, matrix)


def sun(elevation: float, azimuth: float) -> DirectionalLight:
    """Return light from an elevation over the floor and an azimuth from +z to +x, degrees."""
    up, turn = np.deg2rad([elevation, azimuth])
    direction = [np.cos(up) * np.sin(turn), np.sin(up), np.cos(up) * np.cos(turn)]
    return DirectionalLight(np.array(direction, np.float32))


def staged(
    name: str,
    parts: Sequence[Mesh],
    looks: Sequence[Material] | None = None,
    *,
    eye: tuple[float, float, float],
    light: Light,
) -> Scene:
    """Merge the parts and look at a point a little over the floor's middle.

    Args:
        name: The scene's name.
        parts: Its meshes, world space.
        looks: The material of each part; by default all are white.
        eye: Where the camera stands.
        light: The only light.
    """
    view_from_world = look_at(np.array(eye), np.array([0.0, 0.3, 0.0]), UP)
    camera = PerspectiveCamera(
        np.asarray(view_from_world, np.float32), float(np.deg2rad(40.0)), 0.5, 20.0
    )
    slots = range(len(parts)) if looks else [0] * len(parts)
    face_materials = np.repeat(slots, [len(part.faces) for part in parts]).astype(np.int32)
    materials = tuple(looks) if looks else (Material(),)
    return Scene(name, merge(*parts), face_materials, materials, camera, (light,))
