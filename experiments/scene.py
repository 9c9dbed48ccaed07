"""What an experiment is run on: one world-space mesh, its materials, a camera and lights."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from shadows.lights import Light
from shadows.transforms import Camera
from tangentspace.mesh import Mesh


class Material(NamedTuple):
    """How a part of the mesh looks.

    Attributes:
        base_color: Linear RGB, multiplied with the texture where there is one.
        base_color_texture: Linear RGB in [0, 1], row 0 on top, or None.
        normal_texture: Raw texels in [0, 1] (never sRGB-decoded), row 0 on top, or None.
        normal_scale: Factor on the x and y of the texture's normals.
    """

    base_color: tuple[float, float, float] = (1.0, 1.0, 1.0)
    base_color_texture: Float[np.ndarray, "height width 3"] | None = None
    normal_texture: Float[np.ndarray, "height width 3"] | None = None
    normal_scale: float = 1.0


class Scene(NamedTuple):
    """A scene, ready to render.

    Attributes:
        name: Short name, used in file names and tables.
        mesh: All objects in one mesh, world space, NumPy float32 and int32 arrays.
        face_materials: For each face, the index of its material.
        materials: At least one.
        camera: The view.
        lights: At least one; shadows are computed for the first.
        notes: What a reader should know about how the scene was made, one line each
            (for example "3 zero-area faces kept; they cover no pixel").
    """

    name: str
    mesh: Mesh
    face_materials: Int[np.ndarray, " faces"]
    materials: tuple[Material, ...]
    camera: Camera
    lights: tuple[Light, ...]
    notes: tuple[str, ...] = ()


def face_colors(scene: Scene) -> Float[np.ndarray, "faces 3"] | None:
    """Return each face's base color, without textures; None where all are white."""
    colors = np.array([material.base_color for material in scene.materials], np.float32)
    return None if np.all(colors == 1) else colors[scene.face_materials]
