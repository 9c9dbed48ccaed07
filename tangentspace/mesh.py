"""The triangle mesh that every stage takes: plain arrays, one index per corner.

Positions are in whatever space the caller says (scenes here: world space, right-handed,
y up). Faces are counter-clockwise seen from outside. ``uvs`` have v upwards.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Float, Int


class Mesh(NamedTuple):
    """A triangle mesh.

    Attributes:
        positions: Vertex positions.
        normals: Unit vertex normals, for shading; zero where no normal exists.
        faces: Vertex indices, counter-clockwise seen from outside.
        uvs: Texture coordinates, v upwards; None where the mesh has none.
        tangents: Unit tangents and the handedness (+1 or -1) in the last column, with
            ``bitangent = handedness * cross(normal, tangent)``; None where none are given.
    """

    positions: Float[Array | np.ndarray, "vertices 3"]
    normals: Float[Array | np.ndarray, "vertices 3"]
    faces: Int[Array | np.ndarray, "faces 3"]
    uvs: Float[Array | np.ndarray, "vertices 2"] | None = None
    tangents: Float[Array | np.ndarray, "vertices 4"] | None = None
