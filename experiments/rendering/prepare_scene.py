"""Make a scene ready to render: displaced, with tangents and mips, where materials ask."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from tangentspace.displacement import displace_vertices
from tangentspace.material import Material, MippedTexture, with_mips
from tangentspace.mikktspace import with_tangents
from tangentspace.normal_filtering import build_normal_mips
from tangentspace.texture import Texture, sample_bilinear

from ..scene import Scene


def prepare_scene(scene: Scene, *, tangents: bool = False) -> Scene:
    """Return the scene with all that rendering it needs.

    Height textures move the vertices, and normals follow.

    Tangents are made, equal to the standard tool's, where a material has a normal map and the
    file brought none; textures get their smaller versions. A scene without maps is returned
    as it is.

    Args:
        scene: As it was loaded.
        tangents: Make them whether or not a material has a normal map.
    """
    if any(material.height_texture is not None for material in scene.materials):
        scene = _displaced(scene)
    if tangents or any(material.normal_texture is not None for material in scene.materials):
        scene = _with_tangents(scene)
    return scene._replace(materials=tuple(_with_mips(material) for material in scene.materials))


def _with_tangents(scene: Scene) -> Scene:
    mesh = scene.mesh
    if mesh.uvs is None:
        raise ValueError(f"{scene.name}: has no uvs, which a normal map needs; unwrap the mesh")
    if mesh.tangents is None:
        return scene._replace(mesh=with_tangents(mesh))
    # Parts without a normal map may have none, which must not reach a derivative.
    return scene._replace(mesh=mesh._replace(tangents=np.nan_to_num(mesh.tangents)))


def _with_mips(material: Material) -> Material:
    """Return the material with the smaller versions of its textures."""
    color, normal = material.base_color_texture, material.normal_texture
    if isinstance(color, Texture):
        material = dataclasses.replace(
            material, base_color_texture=eqx.filter_jit(with_mips)(color)
        )
    if isinstance(normal, Texture):
        strength = 1.0 if material.normal_scale is None else material.normal_scale
        mips = eqx.filter_jit(build_normal_mips)(normal.texels, strength=jnp.asarray(strength))
        mipped = MippedTexture(mips, normal.wrap_u, normal.wrap_v)
        material = dataclasses.replace(material, normal_texture=mipped, normal_scale=None)
    return material


def _displaced(scene: Scene) -> Scene:
    """Return the scene with its vertices moved by the materials' height textures."""
    mesh = scene.mesh
    if mesh.uvs is None:
        raise ValueError(f"{scene.name}: has no uvs, which a height map needs; unwrap the mesh")
    heights = np.zeros(len(mesh.positions), np.float32)
    for k, material in enumerate(scene.materials):
        texture = material.height_texture
        if texture is not None:
            vertices = np.unique(mesh.faces[scene.face_materials == k])
            wraps = {"wrap_u": texture.wrap_u, "wrap_v": texture.wrap_v}
            found = sample_bilinear(texture.texels, jnp.asarray(mesh.uvs[vertices]), **wraps)
            heights[vertices] = material.height_scale * np.asarray(found[..., 0])
    moved = displace_vertices(mesh, heights)
    materials = tuple(dataclasses.replace(m, height_texture=None) for m in scene.materials)
    return scene._replace(mesh=jax.tree.map(np.asarray, moved), materials=materials)
