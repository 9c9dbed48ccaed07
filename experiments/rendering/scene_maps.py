"""Maps from image files put on a scene: what the file of a mesh did not bring along."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from tangentspace.material import Material
from tangentspace.texture import Texture

from ..files.cube_files import read_cube_map
from ..files.framing import FLOOR
from ..files.map_files import read_color_map, read_height_map, read_normal_map
from ..files.subdivide import subdivide
from ..scene import Scene


def with_maps(
    scene: Scene,
    *,
    color_map: Path | None = None,
    normal_map: Path | None = None,
    flip_green: bool = False,
    height_map: Path | None = None,
    height_scale: float = 1.0,
    subdivisions: int = 0,
    environment: Sequence[Path] = (),
    reflectivity: float | None = None,
) -> Scene:
    """Return the scene with maps on all its materials but the floor that framing put there.

    Args:
        scene: As it was loaded.
        color_map: Image file of colors.
        normal_map: Image file of tangent-space normals.
        flip_green: Whether its green points down (-Y).
        height_map: Image file of heights, by which vertices are displaced.
        height_scale: World length that a height of 1 stands for.
        subdivisions: How often each face is cut in four before vertices are displaced.
        environment: Six image files in the order +x -x +y -y +z -z, or a folder of them.
        reflectivity: Share of the mirrored environment in the color, in [0, 1].

    Raises:
        ValueError: If a file is no such map, or the mesh has no uvs for it.
    """
    changes, notes = {}, []
    if color_map is not None:
        loaded = read_color_map(color_map)
        changes["base_color_texture"] = Texture(loaded.texels)
        notes += loaded.notes
    if normal_map is not None:
        loaded = read_normal_map(normal_map, flip_green=flip_green)
        changes |= {"normal_texture": Texture(loaded.texels), "normal_scale": None}
        notes += loaded.notes
    if height_map is not None:
        loaded = read_height_map(height_map)
        changes |= {"height_texture": Texture(loaded.texels), "height_scale": height_scale}
        notes += loaded.notes
    if changes and scene.mesh.uvs is None:
        given = next(str(f) for f in (normal_map, color_map, height_map) if f is not None)
        raise ValueError(f"{scene.name}: has no uvs, which {given} needs; unwrap the mesh")
    if subdivisions:
        mesh, parents = subdivide(scene.mesh, subdivisions)
        scene = scene._replace(mesh=mesh, face_materials=scene.face_materials[parents])
    if reflectivity is not None:
        changes["reflectivity"] = np.float32(reflectivity)
    if changes:
        materials = tuple(_dressed(material, changes) for material in scene.materials)
        scene = scene._replace(materials=materials)
    if environment:
        faces = read_cube_map(environment[0] if len(environment) == 1 else environment)
        scene = scene._replace(environment=faces)
    return scene._replace(notes=(*scene.notes, *notes))


def without_normal_maps(scene: Scene) -> Scene:
    """Return the scene with the normals of its mesh alone."""
    bare = (dataclasses.replace(m, normal_texture=None, normal_scale=None) for m in scene.materials)
    return scene._replace(materials=tuple(bare))


def _dressed(material: Material, changes: dict) -> Material:
    return material if material is FLOOR else dataclasses.replace(material, **changes)
