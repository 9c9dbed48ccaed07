"""Scenes made by code whose surfaces are more than their triangles: maps and mirrors.

Meshes have no tangents; a renderer makes those that a normal map needs.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from shadows.lights import DirectionalLight
from shadows.transforms import OrthographicCamera, look_at
from tangentspace.environment import cube_map_from_function
from tangentspace.mesh import Mesh
from tangentspace.normal_map import encode_normals, normals_from_heights
from tangentspace.shapes import icosphere, merge, plane, torus, transform_mesh
from tangentspace.texture import Texture, clamp

from ..scene import Material, Scene
from .staging import UP, placed, staged, sun

_CELL = 0.5  # width of a cell of `normal_cells`
_TURNS = 4
# Bumps of the cells, in widths of the cell: middle (u, v), radius, height by radius.
_BUMPS = (((0.4, 0.42), 0.38, 0.42), ((0.72, 0.73), 0.25, 0.3))


def bumpy() -> Scene:
    """A ring of knobs on a checkered floor: a tiled normal map and a color texture."""
    ring = torus(0.75, 0.3, major_segments=96, minor_segments=48)
    ring = placed(
        ring._replace(uvs=np.asarray(ring.uvs) * np.array([12, 5], np.float32)), (0.0, 0.3, 0.0)
    )
    u, v = _texel_centres(64)
    knobs = np.maximum(1 - ((u - 0.5) ** 2 + (v - 0.5) ** 2) / 0.4**2, 0) ** 2
    normals = jax.jit(normals_from_heights)(knobs.astype(np.float32), scale=0.25)
    checks = np.where((np.floor(8 * u) + np.floor(8 * v)) % 2, 0.8, 0.3)
    looks = [
        Material(
            base_color_texture=Texture(np.repeat(checks[..., None], 3, -1).astype(np.float32))
        ),
        Material((0.9, 0.6, 0.35), normal_texture=_normal_texture(normals)),
    ]
    return staged("bumpy", [plane(2.0), ring], looks, eye=(1.2, 2.4, 2.9), light=sun(45.0, -60.0))


def normal_cells() -> Scene:
    """Cells of real bumps, each beside a flat one whose normal map holds the same bumps.

    The four rows turn the cells by a quarter each; the right half is mirrored. All flat cells
    share one map. Seen straight on by parallel rays, and lit from so high that no bump throws
    a shadow, a flat cell shows at each point what the real cell to its left shows.
    """
    real, flat = [], []
    square, relief = plane(_CELL / 2), _relief(plane(_CELL / 2, segments=32))
    for row in range(_TURNS):
        for half, mirrored in enumerate((1.0, -1.0)):
            x, y = _CELL * (2 * half - 1.5), _CELL * (_TURNS - row - 0.5)
            real.append(transform_mesh(relief, _upright(x, y, row, mirrored)))
            flat.append(transform_mesh(square, _upright(x + _CELL, y, row, mirrored)))
    _, slope_u, slope_v = _bumps(*_texel_centres(256))
    normals = np.stack([-slope_u, -slope_v, np.ones_like(slope_u)], axis=-1)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    mapped = Material(normal_texture=_normal_texture(normals, clamp))
    height = _CELL * _TURNS
    view = look_at(np.array([0, height / 2, 2.0]), np.array([0, height / 2, 0.0]), UP)
    camera = OrthographicCamera(np.asarray(view, np.float32), 0.525 * height, 0.5, 4.0)
    light = np.array([-0.45, 0.5, 1.0], np.float32)
    counts = [len(real) * len(relief.faces), len(flat) * len(square.faces)]
    return Scene(
        name="normal-cells",
        mesh=merge(*real, *flat),
        face_materials=np.repeat([0, 1], counts).astype(np.int32),
        materials=(Material(), mapped),
        camera=camera,
        lights=(DirectionalLight(light / np.linalg.norm(light)),),
    )


def mirror() -> Scene:
    """A ball that mirrors sky and ground, over a floor: an environment cube map."""
    light = sun(50.0, -60.0)
    ball = placed(icosphere(0.6, subdivisions=5), (0.0, 0.6, 0.0))
    looks = [Material((0.6, 0.6, 0.6)), Material((0.3, 0.3, 0.35), reflectivity=0.8)]
    scene = staged("mirror", [plane(2.0), ball], looks, eye=(1.4, 1.4, 3.2), light=light)
    sky = functools.partial(_outdoors, light=light)
    environment = jax.jit(lambda: cube_map_from_function(sky, 64, dtype=np.float32))()
    return scene._replace(environment=environment)


def displaced() -> Scene:
    """Hills raised from a flat sheet by a height texture, under low light."""
    u, v = _texel_centres(128)
    hills = [(0.3, 0.35, 0.12, 1.0), (0.65, 0.6, 0.12, 0.7), (0.35, 0.75, 0.08, 0.5)]
    heights = sum(
        height * np.exp(-((u - middle_u) ** 2 + (v - middle_v) ** 2) / (2 * width**2))
        for middle_u, middle_v, width, height in hills
    )
    texture = Texture(np.asarray(heights, np.float32)[..., None], clamp, clamp)
    look = Material((0.55, 0.65, 0.45), height_texture=texture, height_scale=0.7)
    sheet = plane(1.5, segments=96)
    return staged("displaced", [sheet], [look], eye=(1.6, 2.2, 2.9), light=sun(25.0, -75.0))


def _texel_centres(
    size: int,
) -> tuple[Float[np.ndarray, "size size"], Float[np.ndarray, "size size"]]:
    """Return u and v of a square texture's texels, row 0 on top."""
    centres = (np.arange(size) + 0.5) / size
    u, v = np.meshgrid(centres, centres[::-1])
    return u, v


def _normal_texture(normals: Float[Array | np.ndarray, "height width 3"], *wraps) -> Texture:
    return Texture(np.asarray(encode_normals(normals), np.float32), *wraps, *wraps)


def _bumps(u: Float[np.ndarray, "..."], v: Float[np.ndarray, "..."]) -> Float[np.ndarray, "3 ..."]:
    """Return the cells' height and its derivatives along u and v, in widths of the cell.

    A bump of radius r and height h is ``h (1 - d^2 / r^2)^3`` up to the distance r: smooth
    where it meets the plane, and nowhere steeper than 1.72 h / r.
    """
    height, slope_u, slope_v = np.zeros((3, *np.shape(u)))
    for (middle_u, middle_v), radius, steepness in _BUMPS:
        across, up = u - middle_u, v - middle_v
        inside = np.maximum(1 - (across**2 + up**2) / radius**2, 0)
        height += steepness * radius * inside**3
        slope_u -= 6 * steepness / radius * inside**2 * across
        slope_v -= 6 * steepness / radius * inside**2 * up
    return np.stack([height, slope_u, slope_v])


def _relief(sheet: Mesh) -> Mesh:
    """Raise the cells' bumps from a level sheet, with their exact normals."""
    height, slope_u, slope_v = _bumps(*np.asarray(sheet.uvs, np.float64).T)
    positions, normals = np.array(sheet.positions), np.stack([-slope_u, 1 + 0 * height, slope_v])
    positions[:, 1] += _CELL * height
    normals /= np.linalg.norm(normals, axis=0)
    return sheet._replace(positions=positions, normals=normals.T.astype(np.float32))


def _upright(x: float, y: float, turns: int, mirrored: float) -> Float[np.ndarray, "4 4"]:
    """Return the matrix that stands a level sheet up, facing +z, mirrored and then turned."""
    cosine, sine = np.round([np.cos(np.pi / 2 * turns), np.sin(np.pi / 2 * turns)])
    turn = np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]])
    stand = np.array([[mirrored, 0, 0], [0, 0, -1], [0, 1, 0]])
    matrix = np.eye(4)
    matrix[:3, :3] = turn @ stand
    matrix[:3, 3] = x, y, 0
    return matrix


def _outdoors(directions: Float[Array, "... 3"], light: DirectionalLight) -> Float[Array, "... 3"]:
    """Return the radiance of a sky with the light's glow in it, over dark ground."""
    up = directions[..., 1:2]
    along = jnp.sum(directions * light.direction, axis=-1, keepdims=True)
    horizon, zenith, ground = (
        jnp.asarray(color, directions.dtype)
        for color in ([0.75, 0.8, 0.85], [0.15, 0.35, 0.8], [0.25, 0.2, 0.15])
    )
    sky = horizon + (zenith - horizon) * jnp.sqrt(jnp.maximum(up, 0))
    glow = 3 * jnp.exp(200 * (along - 1))
    return jnp.where(up > 0, sky + glow, ground)
