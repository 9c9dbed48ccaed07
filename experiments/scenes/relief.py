"""The scenes on which a normal map is recovered: a curved patch under six lights.

The patch fills the view, so that each texel of its map is seen by two pixels or more. The
map is made by code: hills, scratches and a stamped grid, tilted by up to 59 degrees.
"""

import numpy as np
from jaxtyping import Float

from shadows.lights import DirectionalLight
from shadows.transforms import PerspectiveCamera, look_at
from tangentspace.mesh import Mesh
from tangentspace.shapes import box, merge, plane, transform_mesh
from tangentspace.texture import Texture, clamp

from ..files.smooth_normals import smooth_normals
from ..scene import Material, Scene

_STEEPEST = np.deg2rad(59.0)


def relief(*, size: int = 256) -> Scene:
    """A gently curved patch with a normal map, seen from above, with nothing that casts shadows.

    Args:
        size: Texels on each side of the map.
    """
    return _scene("relief", [_patch()], size)


def shadowed_relief(*, size: int = 256) -> Scene:
    """The same patch with three posts on it, whose shadows cross it under every light."""
    posts = []
    for x, z, height in ((-0.5, -0.35, 0.25), (0.45, -0.1, 0.35), (-0.1, 0.5, 0.2)):
        matrix = np.eye(4)
        matrix[:3, 3] = (x, height, z)
        posts.append(transform_mesh(box((0.04, height, 0.04)), matrix))
    return _scene("shadowed-relief", [_patch(), *posts], size)


def relief_texels(size: int) -> Float[np.ndarray, "size size 3"]:
    """Return the map of the patch: raw texels in [0, 1]."""
    rng = np.random.default_rng(7)
    frequency = np.fft.fftfreq(size)
    squared = frequency[:, None] ** 2 + frequency**2
    noise = np.fft.fft2(rng.standard_normal((size, size)))
    hills = np.fft.ifft2(noise * np.exp(-squared * size * 8)).real
    hills *= 0.04 * size / np.abs(hills).max()
    scratches = np.fft.ifft2(noise * np.exp(-squared * 60)).real
    scratches *= 1.2 / np.abs(scratches).max()
    period = size / 8
    across = np.abs((np.arange(size) + 0.5) % period - period / 2)
    grid = np.clip(0.4 * period - np.maximum(across[:, None], across), 0, 0.08 * period)
    heights = hills + scratches + grid
    # Slopes per texel; the image's row 0 is on top, at the largest v.
    p = 0.5 * (np.roll(heights, -1, 1) - np.roll(heights, 1, 1))
    q = 0.5 * (np.roll(heights, 1, 0) - np.roll(heights, -1, 0))
    slope = np.hypot(p, q)
    shrink = np.minimum(1, np.tan(_STEEPEST) / np.maximum(slope, 1e-6))
    normals = np.stack([-p * shrink, -q * shrink, np.ones_like(p)], axis=-1)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    return (0.5 * normals + 0.5).astype(np.float32)


def _patch() -> Mesh:
    flat = plane(1.0, segments=48)
    x, _, z = flat.positions.T
    heights = 0.15 * np.cos(1.2 * x) * np.cos(1.2 * z)
    positions = np.stack([x, heights.astype(np.float32), z], axis=-1)
    normals = smooth_normals(positions, np.asarray(flat.faces)).astype(np.float32)
    return flat._replace(positions=positions, normals=normals)


def _scene(name: str, parts: list[Mesh], size: int) -> Scene:
    mesh = merge(*parts)
    face_materials = (np.arange(len(mesh.faces)) >= len(parts[0].faces)).astype(np.int32)
    view = look_at(np.array([0.0, 3.0, 0.5]), np.zeros(3), np.array([0.0, 1.0, 0.0]))
    camera = PerspectiveCamera(np.asarray(view, np.float32), float(np.deg2rad(40.0)), 0.5, 20.0)
    turns = np.deg2rad(60.0 * np.arange(6) + 15.0)
    up = np.deg2rad(50.0)
    lights = tuple(
        DirectionalLight(
            np.array([np.cos(up) * np.sin(t), np.sin(up), np.cos(up) * np.cos(t)], np.float32)
        )
        for t in turns
    )
    texture = Texture(relief_texels(size), clamp, clamp)
    materials = (Material(normal_texture=texture), Material())
    return Scene(name, mesh, face_materials, materials[: len(parts)], camera, lights)
