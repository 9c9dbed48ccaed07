"""Images of a still view while what casts shadows in it, or the light, is changed."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from shadows import (
    Appearance,
    Bias,
    Camera,
    Compare,
    Filter,
    Layout,
    Light,
    MeshEdges,
    Surface,
    mesh_edges,
    render_shadow_map,
    render_surface,
    shade,
    surface_appearance,
    surface_visibility,
)
from tangentspace.shading import Shading

from ..scene import Scene

Positions = Float[Array | np.ndarray, "vertices 3"]


class Technique(eqx.Module):
    """How shadows are made.

    Attributes:
        layout: How many maps a light has.
        filter: How the maps are asked.
        compare: Hard or soft.
        shading: The lighting model.
        map_size: Texels on each side of a map.
    """

    layout: Layout
    filter: Filter
    compare: Compare
    shading: Shading
    map_size: int = eqx.field(static=True)


class ShadowView(eqx.Module):
    """What the eye sees, which stays, and the mesh that casts the shadows in it.

    Attributes:
        camera: The view.
        faces: Of all that casts.
        edges: Of the same mesh.
        surface: What the eye sees.
        appearance: How it looks.
        technique: How shadows are made.
    """

    camera: Camera
    faces: Int[Array | np.ndarray, "faces 3"]
    edges: MeshEdges
    surface: Surface
    appearance: Appearance
    technique: Technique

    @staticmethod
    def of(
        scene: Scene,
        technique: Technique,
        *,
        image_size: tuple[int, int],
        seen: Bool[np.ndarray, " faces"] | None = None,
    ) -> "ShadowView":
        """Look at a scene.

        Args:
            scene: As ``prepare_scene`` returns it.
            technique: How shadows are made.
            image_size: Height and width in pixels.
            seen: Which faces the eye sees; the others only cast. All if None.
        """
        mesh, of_faces = scene.mesh, np.asarray(scene.face_materials)
        if seen is not None:
            mesh, of_faces = mesh._replace(faces=mesh.faces[seen]), of_faces[seen]
        arrays = jax.tree.map(jnp.asarray, (mesh, scene.camera, scene.materials, of_faces))
        surface, appearance = _look(arrays, image_size)
        faces = np.asarray(scene.mesh.faces)
        edges = mesh_edges(scene.mesh.positions, faces)
        return ShadowView(arrays[1], faces, edges, surface, appearance, technique)

    def image(self, positions: Positions, light: Light, bias: Bias) -> Float[Array, "height width"]:
        """Return the mean of the color's channels, for positions of all that casts and a light."""
        technique = self.technique
        height, width = self.surface.face_ids.shape
        matrices = technique.layout.matrices(
            light, positions, self.camera, aspect=width / height,
            map_size=technique.map_size, reach=technique.filter.reach(),
        )  # fmt: skip
        shadow_map = render_shadow_map(
            positions,
            self.faces,
            matrices,
            map_size=technique.map_size,
            casters=bias.casters,
            edges=self.edges,
        )
        visibility = surface_visibility(
            self.surface, light, shadow_map,
            bias=bias, filter=technique.filter, compare=technique.compare,
        )  # fmt: skip
        color = shade(
            self.surface, [light], [visibility],
            appearance=self.appearance, shading=technique.shading,
        )  # fmt: skip
        return jnp.mean(color, axis=-1)


@eqx.filter_jit
def _look(arrays: tuple, image_size: tuple[int, int]) -> tuple[Surface, Appearance]:
    mesh, camera, materials, face_materials = arrays
    surface = render_surface(mesh, camera, image_size=image_size)
    return surface, surface_appearance(
        mesh, camera, surface, materials, face_materials=face_materials
    )
