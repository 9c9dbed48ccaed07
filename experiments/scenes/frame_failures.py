"""Scenes on which shading normals and tangent frames fail, by rows of the failure catalogue.

Meshes have no tangents; a renderer makes those that a normal map needs.
"""

import functools

import jax
import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from tangentspace.mesh import Mesh
from tangentspace.normal_map import encode_normals, normals_from_heights
from tangentspace.shapes import box, icosphere, merge, plane, uv_sphere
from tangentspace.texture import Texture

from ..files.smooth_normals import smooth_normals
from ..scene import Material, Scene
from .bias_failures import aimed
from .staging import placed, staged, sun


def low_poly_sphere() -> Scene:
    """Row 28: a ball of 80 faces with smooth normals: whole faces go dark at the terminator."""
    ball = placed(icosphere(0.7, subdivisions=1), (0.0, 0.8, 0.0))
    return staged("low-poly-sphere", [plane(2.0), ball], eye=(0.0, 1.6, 3.2), light=sun(15.0, 75.0))


def grazing_normal_map() -> Scene:
    """Row 29: steep bumps under grazing light: lit slopes end hard where the face turns away."""
    ball = uv_sphere(0.7, rings=24, segments=48)
    ball = placed(_tiled(ball, 10, 5), (0.0, 0.8, 0.0))
    floor = _tiled(plane(2.0), 12, 12)
    looks = [_bumpy(0.5), _bumpy(0.5)]
    return staged(
        "grazing-normal-map", [floor, ball], looks, eye=(0.0, 1.6, 3.2), light=sun(8.0, 80.0)
    )


def mirrored_strip() -> Scene:
    """Row 31: two squares that share an edge where the texture is mirrored: tangents cancel."""
    x, y = np.meshgrid([-1.0, 0.0, 1.0], [0.0, 1.0])
    strip = _upright_sheet(x, y, [[0, 1, 4], [0, 4, 3], [1, 2, 5], [1, 5, 4]], np.abs(x), y)
    return _on_display("mirrored-strip", strip)


def equal_uvs() -> Scene:
    """Row 32: a triangle whose corners have equal texture coordinates: it has no tangent."""
    x, y = np.meshgrid([-1.0, 0.0, 1.0], [0.0, 1.0])
    faces = [[0, 1, 4], [0, 4, 3], [1, 2, 5]]
    sheet = _upright_sheet(x, y, faces, x, y)
    collapsed = _upright_sheet([0.0, 1.0, 0.0], [0.0, 1.0, 1.0], [[0, 1, 2]], [0.5] * 3, [0.5] * 3)
    return _on_display("equal-uvs", merge(sheet, collapsed))


def collinear_sliver() -> Scene:
    """Row 33: a triangle whose corners lie on one line, beside a good one: no tangent there."""
    x, y = [-1.0, 0.25, -0.25, 0.5, 0.75, 1.0], [0.0, 0.0, 1.0, 0.5, 0.5, 0.5]
    u, v = [0.0, 1.0, 0.5, 0.0, 1.0, 0.0], [0.0, 0.0, 1.0, 0.0, 0.0, 1.0]
    sheet = _upright_sheet(x, y, [[0, 1, 2], [3, 4, 5]], u, v)
    upright = np.tile(np.array([0, 0, 1], np.float32), (len(x), 1))  # also where no area is
    return _on_display("collinear-sliver", sheet._replace(normals=upright))


def duplicate_vertex() -> Scene:
    """Row 34: triangles with a corner twice, by its index and by its place: no area, no normal."""
    x, y = [-1.0, 1.0, 1.0, -1.0, 1.0], [0.0, 0.0, 1.0, 1.0, 0.0]
    faces = [[0, 1, 2], [0, 2, 3], [1, 1, 2], [1, 2, 4]]
    return _on_display("duplicate-vertex", _upright_sheet(x, y, faces, x, y))


def pole_cap() -> Scene:
    """Row 35: the pole of a mapped ball: tangents run round it in a swirl."""
    ball = _tiled(uv_sphere(0.8, rings=8, segments=12), 12, 6)
    return aimed(
        "pole-cap",
        [ball],
        [_bumpy(0.25)],
        eye=(0.0, 2.6, 0.9),
        target=(0.0, 0.5, 0.0),
        light=sun(40.0, -60.0),
    )


def sheared_uvs(shear: float = 60.0) -> Scene:
    """Row 36: sheared texture coordinates: a bitangent at right angles turns the lighting.

    Args:
        shear: Angle by which lines of equal u lean, degrees.
    """
    x, y = np.meshgrid([-1.0, 1.0], [0.0, 1.0])
    sheet = _upright_sheet(x, y, [[0, 1, 3], [0, 3, 2]], x + np.tan(np.deg2rad(shear)) * y, y)
    return _on_display("sheared-uvs", sheet)


def split_quads() -> Scene:
    """Row 38: one bent sheet twice, its squares cut along either diagonal: the maps differ."""
    sheets = []
    for middle, cut in ((-0.55, ((0, 1, 4), (0, 4, 3))), (0.55, ((0, 1, 3), (1, 4, 3)))):
        x, y = np.meshgrid([-0.5, 0.0, 0.5], [0.0, 0.5, 1.0])
        faces = np.add.outer([0, 1, 3, 4], cut).reshape(-1, 3)
        z = 1.2 * x * (y - 0.5) * np.array([[1.0], [0.0], [1.0]])
        sheets.append(_upright_sheet(x + middle, y, faces, x, y, z=z))
    return _on_display("split-quads", merge(*sheets))


def wide_triangles() -> Scene:
    """Row 39: a ball of wide triangles: frames made unit per pixel are not those of a baker."""
    ball = placed(_tiled(uv_sphere(0.8, rings=4, segments=6), 8, 4), (0.0, 0.8, 0.0))
    looks = [Material(), _bumpy(0.2)]
    return staged(
        "wide-triangles", [plane(2.0), ball], looks, eye=(0.6, 1.8, 3.2), light=sun(45.0, -50.0)
    )


def glossy_bumps() -> Scene:
    """Row 40: fine bumps to the horizon, against the light: plain mips keep the gloss too sharp."""
    floor = placed(_tiled(plane(20.0), 160, 160), (0.0, 0.0, -17.0))
    return aimed(
        "glossy-bumps",
        [floor],
        [_bumpy(0.15)],
        eye=(0.0, 1.2, 3.0),
        target=(0.0, 0.0, -4.0),
        near=0.3,
        far=60.0,
        light=sun(25.0, 180.0),
    )


def no_gutter() -> Scene:
    """Row 41: charts that touch in the light map's atlas: lit ones bleed into dark ones."""
    floor = plane(1.5)
    block = placed(box((0.5, 0.5, 0.5)), (0.0, 0.5, 0.0))
    uvs = np.concatenate([np.asarray(part.uvs) for part in (floor, block)])
    column, row = np.divmod(np.arange(6), 3)  # sides of the box, in the right half of the atlas
    corner = np.stack([0.5 + column / 4, row / 3], axis=-1)
    uvs[:4] *= [0.5, 1.0]
    uvs[4:] = uvs[4:] * [0.25, 1 / 3] + np.repeat(corner, 4, axis=0)
    mesh = merge(floor, block)._replace(uvs=uvs.astype(np.float32))
    return staged("no-gutter", [mesh], eye=(-1.6, 1.9, 2.6), light=sun(40.0, 60.0))


def _on_display(name: str, sheet: Mesh) -> Scene:
    """Stand a bumpy sheet on a floor, lit from the upper left."""
    parts, looks = [plane(2.0), placed(sheet, (0.0, 0.25, 0.0))], [Material(), _bumpy(0.3)]
    return staged(name, parts, looks, eye=(0.3, 1.2, 3.2), light=sun(40.0, -45.0))


def _upright_sheet(
    x: ArrayLike, y: ArrayLike, faces: ArrayLike, u: ArrayLike, v: ArrayLike, *, z: ArrayLike = 0.0
) -> Mesh:
    """Return a sheet in the plane z = 0, or before it, facing +z; its texture twice per unit."""
    columns = (np.ravel(column) for column in np.broadcast_arrays(x, y, z))
    positions = np.stack(list(columns), axis=-1).astype(np.float32)
    faces = np.asarray(faces, np.int32)
    uvs = 2 * np.stack([np.ravel(u), np.ravel(v)], axis=-1)
    return Mesh(positions, smooth_normals(positions, faces), faces, uvs.astype(np.float32))


def _tiled(mesh: Mesh, across: int, up: int) -> Mesh:
    return mesh._replace(uvs=(np.asarray(mesh.uvs) * [across, up]).astype(np.float32))


@functools.cache
def _knob_texels(height: float) -> Float[np.ndarray, "size size 3"]:
    """Return the normal map of one round knob, which tiles."""
    centres = (np.arange(32) + 0.5) / 32 - 0.5
    squared = centres**2 + centres[:, None] ** 2
    knob = height * np.maximum(1 - squared / 0.4**2, 0) ** 2
    normals = jax.jit(normals_from_heights)(knob.astype(np.float32))
    return np.asarray(encode_normals(normals), np.float32)


def _bumpy(height: float) -> Material:
    """Return white with a knob per tile, of a height in widths of the tile."""
    return Material(normal_texture=Texture(_knob_texels(height)))
