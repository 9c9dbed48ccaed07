"""A scene's diffuse light and shadows, traced once into a light map."""

from pathlib import Path
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from shadows.light_map import LightMap, texture_surface
from shadows.render import shade
from shadows.surface import Surface
from tangentspace.mesh import Mesh
from tangentspace.shading import PhongShading

from ..files.images import read_exr, write_exr
from ..scene import Scene
from ..truth.rays import Occluders, trace_visibility
from .dilate import dilate
from .light_map_uvs import light_map_uvs


class LightBake(NamedTuple):
    """A baked light map.

    Attributes:
        scene: The scene, its vertices split where charts part.
        light_map: The light, and where each vertex lies on it.
        charted: Texels that a face reaches.
        notes: What a reader should know, one line each.
    """

    scene: Scene
    light_map: LightMap
    charted: Bool[np.ndarray, "size size"]
    notes: tuple[str, ...]


def unwrap_scene(scene: Scene) -> tuple[Scene, Float[np.ndarray, "vertices 2"], tuple[str, ...]]:
    """Return the scene with coordinates for a light map, the same in every run.

    Returns:
        The scene, the coordinates, and why the scene's own did not serve, if so.
    """
    unwrapped = light_map_uvs(scene.mesh)
    notes = (f"charts by xatlas ({unwrapped.reason})",) if unwrapped.reason else ()
    return scene._replace(mesh=unwrapped.mesh), unwrapped.uvs, notes


def bake_light_map(
    scene: Scene, *, size: int = 512, samples: int = 2, margin: int = 4
) -> LightBake:
    """Trace light to the texels of a light map, from every light of a scene.

    Args:
        scene: What is lit.
        size: Texels on each side.
        samples: Points per texel along each side.
        margin: How many texels beyond the charts hold a copy of the nearest one inside.

    Raises:
        ValueError: If a number is out of range, or no face reaches a texel.
    """
    for name, value, least, most in (
        ("size", size, 1, 8192), ("samples", samples, 1, 8), ("margin", margin, 0, 64),
    ):  # fmt: skip
        if not least <= value <= most:
            raise ValueError(
                f"bake_light_map: expected `{name}` from {least} to {most}, got {value}"
            )
    if size * samples > 8192:
        raise ValueError(
            f"bake_light_map: expected size x samples of at most 8192, got {size * samples}"
        )
    scene, uvs, notes = unwrap_scene(scene)
    light, known = _trace(scene, uvs, size * samples)
    blocks = (size, samples, size, samples)
    count = known.reshape(blocks).sum(axis=(1, 3))
    charted = count > 0
    if not charted.any():
        raise ValueError(
            f"{scene.name}: its faces reach no point of a map of {size} x {size} texels; choose "
            "a larger size"
        )
    total = np.where(known[..., None], light, 0).reshape(*blocks, 3).sum(axis=(1, 3))
    mean = (total / np.maximum(count, 1)[..., None]).astype(np.float32)
    texels, filled = dilate(mean, charted, margin=margin)
    texels = np.where(filled[..., None], texels, 0).astype(np.float32)
    return LightBake(scene, LightMap(texels, uvs), charted, notes)


def write_light_map(path: Path, bake: LightBake) -> None:
    """Write a light map as EXR: R G B, and the face at each texel to know its charts by."""
    channels = {name: bake.light_map.texels[..., k] for k, name in enumerate("RGB")}
    size = bake.light_map.texels.shape[:2]
    faces = _surface(bake.scene.mesh, bake.light_map.uvs, size).face_ids
    write_exr(path, channels | {"face.Y": np.asarray(faces)})


def read_light_map(path: Path, scene: Scene) -> tuple[Scene, LightMap]:
    """Read a light map that was baked for a scene.

    Returns:
        The scene, its vertices split where charts part, and the map.

    Raises:
        ValueError: If the file is no light map, or was baked for another scene.
    """
    channels = read_exr(path)
    missing = [name for name in ("R", "G", "B", "face.Y") if name not in channels]
    if missing:
        raise ValueError(f"{path}: expected a light map of bake-light, got no {missing[0]}")
    scene, uvs, _ = unwrap_scene(scene)
    faces = channels["face.Y"]
    if not np.array_equal(_surface(scene.mesh, uvs, faces.shape).face_ids, faces):
        raise ValueError(f"{path}: was baked for another scene than {scene.name}; bake it again")
    texels = np.stack([channels[name] for name in "RGB"], axis=-1)
    if not np.isfinite(texels).all():
        raise ValueError(f"{path}: has texels that are NaN or infinite; bake it again")
    return scene, LightMap(texels, uvs)


def _surface(
    mesh: Mesh, uvs: Float[Array | np.ndarray, "vertices 2"], size: tuple[int, ...]
) -> Surface:
    on_device = jax.tree.map(jnp.asarray, mesh)
    return _texture_surface(on_device, jnp.asarray(uvs), (size[0], size[1]))


@eqx.filter_jit
def _texture_surface(mesh: Mesh, uvs: Array, size: tuple[int, int]) -> Surface:
    return texture_surface(mesh, uvs, size=size)


def _trace(
    scene: Scene, uvs: Float[np.ndarray, "vertices 2"], size: int
) -> tuple[Float[np.ndarray, "size size 3"], Bool[np.ndarray, "size size"]]:
    """Return the light at the points of a grid over the map, and where there is a face."""
    mesh = scene.mesh
    surface = _surface(mesh, uvs, (size, size))
    position, normal = np.asarray(surface.position), np.asarray(surface.face_normal)
    face_ids = np.asarray(surface.face_ids)
    occluders = Occluders(mesh.positions, mesh.faces)
    visibilities = []
    for light in scene.lights:
        to_light = np.asarray(light.to_light(surface.position))
        facing = np.sum(normal * to_light, axis=-1) > 0
        lit = trace_visibility(position, normal, face_ids, light, occluders)
        visibilities.append(jnp.asarray(lit & facing, jnp.float32))
    matte = PhongShading(albedo=1.0, specular=0.0, ambient=0.0)
    light = shade(surface, scene.lights, visibilities, shading=matte)
    return np.asarray(light), face_ids >= 0
