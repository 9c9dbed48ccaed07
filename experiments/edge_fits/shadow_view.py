"""Images of a still view while what casts shadows in it, or the light, is changed."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

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
from tangentspace.mesh import Mesh
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


def split_caster(mesh: Mesh) -> Bool[np.ndarray, " faces"]:
    """Tell which faces cast: all but those of the part with the largest surface, the ground.

    Raises:
        ValueError: If there is one part alone.
    """
    edges = mesh_edges(mesh.positions, mesh.faces)
    parts = _parts(np.asarray(edges.edge_ids), len(edges.vertices))
    a, b, c = (np.asarray(mesh.positions, np.float64)[mesh.faces[:, k]] for k in range(3))
    areas = np.bincount(parts, np.linalg.norm(np.cross(b - a, c - a), axis=1))
    if (areas > 0).sum() < 2:
        raise ValueError("mesh: expected a caster over a ground, got one connected part")
    return parts != areas.argmax()


def _parts(edge_ids: Int[np.ndarray, "faces 3"], edge_count: int) -> Int[np.ndarray, " faces"]:
    """Return for each face a number that faces connected by edges share."""
    face_count = len(edge_ids)
    faces = np.repeat(np.arange(face_count), 3)
    size = face_count + edge_count
    links = coo_array(
        (np.ones(faces.size, np.int8), (faces, face_count + edge_ids.ravel())), (size, size)
    )
    return connected_components(links, directed=False)[1][:face_count]


@eqx.filter_jit
def _look(arrays: tuple, image_size: tuple[int, int]) -> tuple[Surface, Appearance]:
    mesh, camera, materials, face_materials = arrays
    surface = render_surface(mesh, camera, image_size=image_size)
    return surface, surface_appearance(
        mesh, camera, surface, materials, face_materials=face_materials
    )


def vertices_of(mesh: Mesh, faces: Bool[np.ndarray, " faces"]) -> Int[np.ndarray, " chosen"]:
    """Return the vertices of chosen faces.

    Raises:
        ValueError: If the other faces have some of them too.
    """
    mine, others = np.unique(mesh.faces[faces]), np.unique(mesh.faces[~faces])
    if np.isin(mine, others).any():
        raise ValueError("mesh: the caster shares vertices with the ground; split them")
    return mine
