"""Ways to light a normal map: per vertex or per fragment, by which frames, with which mips.

Judged against ``lit_map``, in color instead of visibility, and without shadows.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from shadows.interpolate import barycentric_slopes, gather_faces, interpolate
from shadows.lights import Light
from shadows.surface import Surface
from shadows.transforms import transform_points
from tangentspace.frames import triangle_frames
from tangentspace.material import look_up_texture
from tangentspace.mesh import Mesh
from tangentspace.shading import BlinnPhongShading
from tangentspace.tangent_lighting import shade_tangent_space, tangent_space_vectors

from .errors import mean_flip
from .lit_map import Looks, light_fragments, mapped_material, with_normal_texture, without_mips
from .pictures import picture
from .programs import Programs, Timed, time_stages
from .view import View

_NONE, _VERTEX, _FRAGMENT = "no normal map", "lit per vertex", "lit per fragment"
_MIPS, _GLOSS = "mips", "mips and gloss"


class ShadingMethod(NamedTuple):
    """How a normal map is lit.

    Attributes:
        technique: Whether it is, and where light and eye are taken to tangent space.
        frames: ``MikkTSpace``'s, or one for each ``face``.
        mips: Of the map: none, or such that widen highlights too, or not.
    """

    technique: str
    frames: str = ""
    mips: str = ""

    @property
    def kind(self) -> str:
        """What it is among others in the table."""
        return "shading"

    @property
    def map_size(self) -> None:
        """It has no shadow map."""

    @property
    def label(self) -> str:
        """Technique, frames and mips."""
        parts = [self.technique, self.frames and f"{self.frames} frames", self.mips]
        return ", ".join(filter(None, parts))

    @property
    def name(self) -> str:
        """The same."""
        return self.label

    def applies(self, view: View) -> bool:
        """Whether a material of the scene has a normal map."""
        return view.lit is not None

    def accuracy(self, view: View, programs: Programs) -> tuple[dict[str, Any], bytes]:
        """Return ``rmse`` of the color, ``flip``, and the picture, where the map covers pixels."""
        assert view.lit is not None
        truth, counts = view.lit
        color = np.array(self._image(view, self._looks(view), programs)())
        color[~counts] = truth[~counts]
        rmse = float(np.sqrt(np.mean((color[counts] - truth[counts]) ** 2)))
        judged = view._replace(share=truth.mean(axis=-1))
        shown = picture(judged, color.mean(axis=-1), color)
        return {"rmse": rmse, "flip": mean_flip(truth, color)}, shown

    def timing(self, view: View, programs: Programs, *, runs: int) -> dict[str, Any]:
        """Return a round of what looking up, lighting and the gradient in texels cost."""
        assert view.lit is not None
        looks, gradient = self._looks(view), None
        if self.technique != _NONE:
            arguments = (looks, view.surface, view.light, view.lit.color)
            gradient = programs.get(f"gradient {self.label}", self._loss_gradient, *arguments)
        image = self._image(view, looks, programs)
        stages = {"draw": None, "prepare": None, "image": image, "gradient": gradient}
        kept = sum(leaf.nbytes for leaf in jax.tree.leaves((looks.materials, looks.mesh.tangents)))
        return {"stages": time_stages(stages, runs=runs), "kept_bytes": kept}

    def _image(self, view: View, looks: Looks, programs: Programs) -> Timed:
        return programs.get(f"image {self.label}", self._color, looks, view.surface, view.light)

    def _looks(self, view: View) -> Looks:
        """Return the scene with frames and textures as the method wants them."""
        scene = view.scene
        looks = Looks(scene.mesh, scene.camera, scene.materials, scene.face_materials)
        if self.technique == _NONE:
            looks = with_normal_texture(looks, None)
        elif not self.mips:
            looks = without_mips(looks)
        if self.frames == "face":
            looks = looks._replace(mesh=_face_frames(looks.mesh))
        return jax.tree.map(jnp.asarray, looks)

    def _color(
        self, looks: Looks, surface: Surface, light: Light
    ) -> Float[Array, "height width 3"]:
        if self.technique != _VERTEX:
            return light_fragments(looks, surface, light, gloss=self.mips == _GLOSS)
        rest = light_fragments(with_normal_texture(looks, None), surface, light)
        of_faces = gather_faces(looks.face_materials[:, None], surface.face_ids)[..., 0]
        inside = surface.covered & (of_faces == mapped_material(looks))
        return jnp.where(inside[..., None], _lit_per_vertex(looks, surface, light), rest)

    def _loss_gradient(
        self, looks: Looks, surface: Surface, light: Light, truth: Array
    ) -> tuple[Array, Any]:
        def loss(texture: Any) -> Array:
            color = self._color(with_normal_texture(looks, texture), surface, light)
            return jnp.mean((color - truth) ** 2)

        texture = looks.materials[mapped_material(looks)].normal_texture
        return jax.value_and_grad(loss)(texture)


SHADING_METHODS = (
    ShadingMethod(_NONE),
    *(
        ShadingMethod(technique, frames, mips)
        for technique, of_technique in {
            _VERTEX: ("", _MIPS),
            _FRAGMENT: ("", _MIPS, _GLOSS),
        }.items()
        for frames in ("MikkTSpace", "face")
        for mips in of_technique
    ),
)


def _lit_per_vertex(looks: Looks, surface: Surface, light: Light) -> Float[Array, "height width 3"]:
    """Take light and eye to tangent space at the vertices, and light there per fragment."""
    mesh, camera, ids = looks.mesh, looks.camera, surface.face_ids
    positions, uvs, tangents = map(jnp.asarray, (mesh.positions, mesh.uvs, mesh.tangents))
    frame = tangents[:, :3], tangents[:, 3:] * jnp.cross(mesh.normals, tangents[:, :3])
    view = camera.view_from_world
    vectors = tangent_space_vectors(
        positions, mesh.normals, *frame, view_from_model=view,
        to_light_view=light.to_light(positions) @ view[:3, :3].T,
    )  # fmt: skip
    clip = transform_points(camera.clip_from_world(ids.shape[1] / ids.shape[0]), positions)
    places = (surface.weights, *barycentric_slopes(clip, mesh.faces, ids))
    at = [interpolate(uvs, mesh.faces, ids, weights) for weights in places]
    material = looks.materials[mapped_material(looks)]
    blended = [interpolate(v, mesh.faces, ids, surface.weights) for v in vectors]
    colors = (1.0, 1.0, 1.0) if material.base_color is None else material.base_color

    def shading(*directions: Array) -> Array:
        radiance = light.radiance(surface.position)
        base = jnp.stack([jnp.asarray(c) for c in colors])
        return BlinnPhongShading()(*directions, base_color=base, radiance=radiance)

    assert material.normal_texture is not None
    texels = look_up_texture(material.normal_texture, *at)
    return shade_tangent_space(type(vectors)(*blended), texels, shading=shading)


def _face_frames(mesh: Mesh) -> Mesh:
    """Return the mesh with vertices of each face's own, and its frame at them."""
    frames = jax.jit(triangle_frames)(mesh.positions, mesh.uvs, mesh.faces)
    unit = np.asarray(frames.tangent)
    unit = unit / np.maximum(np.linalg.norm(unit, axis=-1, keepdims=True), 1e-30)
    tangents = np.concatenate([unit, np.asarray(frames.handedness)[:, None]], axis=-1)
    corners = np.asarray(mesh.faces).ravel()
    return Mesh(
        positions=np.asarray(mesh.positions)[corners],
        normals=np.asarray(mesh.normals)[corners],
        faces=np.arange(len(corners), dtype=np.int32).reshape(-1, 3),
        uvs=np.asarray(mesh.uvs)[corners],
        tangents=np.repeat(tangents, 3, axis=0),
    )
