"""OpenGL through moderngl, on Mesa where there is no GPU: a depth texture, compared 2x2.

The light's pass draws depth with ``glPolygonOffset``; the image asks a ``sampler2DShadow``,
blended linearly, at our surface points, which lie in a texture. The matrix is ours. Both end
with ``glFinish``.
"""

import importlib
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar

import numpy as np

from shadows.layouts import SingleLayout

from ..view import View
from .peer import INSTALL, Image, Peer, Work

_FACTORS, _UNITS = (1.0, 1.5, 2.0, 3.0, 4.0, 6.0), 4.0  # more units change hardly anything
_DEPTH_BYTES = 4  # a texel of 24 bits is stored in 32

_DRAW = """
#version 330
uniform mat4 clip_from_world;
in vec3 position;
void main() { gl_Position = clip_from_world * vec4(position, 1.0); }
"""
_NOTHING = """
#version 330
void main() {}
"""
_WHOLE_IMAGE = """
#version 330
void main() {
    vec2 corner = vec2(gl_VertexID & 1, gl_VertexID >> 1);
    gl_Position = vec4(4.0 * corner - 1.0, 0.0, 1.0);
}
"""
_ASK = """
#version 330
uniform mat4 clip_from_world;
uniform sampler2D places;
uniform sampler2DShadow shadow_map;
out float seen;
void main() {
    vec3 place = texelFetch(places, ivec2(gl_FragCoord.xy), 0).xyz;
    vec4 clip = clip_from_world * vec4(place, 1.0);
    vec4 texture_place = vec4(0.5 * (clip.xyz + clip.w), clip.w);
    seen = clip.w > 0.0 ? textureProj(shadow_map, texture_place) : 1.0;
}
"""


@dataclass(frozen=True)
class OpenGL(Peer):
    """A shadow map as graphics hardware has it.

    Attributes:
        size: Texels on each side of the map.
    """

    size: int
    technique: ClassVar[str] = "opengl"
    note: ClassVar[str] = "depth texture of 24 bits, compared 2x2, at our surface points"

    @property
    def label(self) -> str:
        """Name with its taps."""
        return "opengl 2x2"

    @property
    def map_size(self) -> int | None:
        """Texels on each side of the map."""
        return self.size

    @classmethod
    def absent(cls) -> str | None:
        """Return why it cannot run: it is not installed, or finds no OpenGL."""
        try:
            _context().release()
        except ModuleNotFoundError:
            return f"the module moderngl is not installed; {INSTALL}"
        except Exception as error:
            reason = " ".join(str(error).split())
            return f"no OpenGL context could be made ({reason}); apt install libegl1 libgl1"
        return None

    def applies(self, view: View) -> bool:
        """Whether one map serves the light; of an area light it takes the centre."""
        return isinstance(view.layout, SingleLayout)

    @contextmanager
    def open(self, view: View) -> Iterator[Work]:
        """Hand over mesh, matrix and surface points, and compile the shaders."""
        context = _context()
        try:
            yield _work(context, view, self.size)
        finally:
            context.release()


def _context() -> Any:
    """Return a context without a window: by EGL, or where there is none as the system has it."""
    moderngl = importlib.import_module("moderngl")
    backend = {"backend": "egl"} if sys.platform == "linux" else {}
    return moderngl.create_context(standalone=True, **backend)


def _work(context: Any, view: View, size: int) -> Work:
    scene, height_width = view.scene, view.share.shape
    width_height = height_width[::-1]
    matrix = view.layout.matrices(
        view.light, scene.mesh.positions, scene.camera, aspect=1.0, map_size=size, reach=1.0
    )
    columns = np.asarray(matrix, np.float32).T.tobytes()
    vertices = context.buffer(np.asarray(scene.mesh.positions, np.float32).tobytes())
    indices = context.buffer(np.asarray(scene.mesh.faces, np.int32).tobytes())
    drawing = context.program(vertex_shader=_DRAW, fragment_shader=_NOTHING)
    casters = context.vertex_array(drawing, [(vertices, "3f", "position")], indices)
    depth = context.depth_texture((size, size))
    light_frame = context.framebuffer(depth_attachment=depth)
    sampler = context.sampler(
        texture=depth, compare_func="<=", filter=(context.LINEAR, context.LINEAR),
        repeat_x=False, repeat_y=False, border_color=(1.0, 1.0, 1.0, 1.0),
    )  # fmt: skip

    asking = context.program(vertex_shader=_WHOLE_IMAGE, fragment_shader=_ASK)
    whole = context.vertex_array(asking, [])
    points = np.asarray(view.surface.position, np.float32)
    places = context.texture(width_height, 3, points.tobytes(), dtype="f4", alignment=4)
    frame = context.framebuffer([context.texture(width_height, 1, dtype="f4")])
    for program in (drawing, asking):
        program["clip_from_world"].write(columns)
    asking["places"], asking["shadow_map"] = 0, 1

    def draw() -> None:
        light_frame.use()
        context.enable_only(context.DEPTH_TEST)
        light_frame.clear(depth=1.0)
        casters.render()
        context.finish()

    def image() -> Image:
        frame.use()
        context.enable_only(context.NOTHING)
        places.use(0)
        sampler.use(1)
        whole.render(vertices=3)
        context.finish()
        return np.frombuffer(frame.read(components=1, dtype="f4"), np.float32).reshape(height_width)

    biases = {
        f"polygon offset {factor:g} and {_UNITS:g} units": partial(
            setattr, context, "polygon_offset", (factor, _UNITS)
        )
        for factor in _FACTORS
    }
    return Work(image, draw=draw, biases=biases, kept_bytes=_DEPTH_BYTES * size**2)
