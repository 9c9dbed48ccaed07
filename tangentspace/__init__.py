"""Local shading in JAX: tangent frames, normal maps, textures and lighting."""

from . import shapes as shapes
from .lighting import blinn_phong as blinn_phong
from .lighting import lambert as lambert
from .lighting import phong as phong
from .lighting import reflect as reflect
from .mesh import Mesh as Mesh
from .vertex_normals import face_normals as face_normals
from .vertex_normals import vertex_normals as vertex_normals
