"""What an experiment is run on: one world-space mesh, its materials, a camera and lights."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Int

from shadows.lights import Light
from shadows.transforms import Camera
from tangentspace.environment import CubeMap
from tangentspace.material import Material as Material
from tangentspace.mesh import Mesh


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
        environment: What surrounds the scene, infinitely far away, or None.
    """

    name: str
    mesh: Mesh
    face_materials: Int[np.ndarray, " faces"]
    materials: tuple[Material, ...]
    camera: Camera
    lights: tuple[Light, ...]
    notes: tuple[str, ...] = ()
    environment: CubeMap | None = None
