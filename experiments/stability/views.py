"""Views of the failure catalogue's scenes, and every shadow technique on them and its derivatives.

Meshes are padded to one size, and the way from geometry to visibility is cut into stages whose
derivatives are chained by hand: each compiles once, not once for every combination.
"""

import copy
import functools
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from shadows import (
    Bias,
    Camera,
    CascadesLayout,
    Compare,
    CubeLayout,
    DirectionalLight,
    Filter,
    HardCompare,
    Layout,
    Light,
    PointLight,
    Receiver,
    ShadowMap,
    SingleLayout,
    SoftCompare,
    SpotLight,
    choose_map,
    look_up,
    receive,
    render_shadow_map,
    render_surface,
    texel_from_clip,
)
from tangentspace._math import dot
from tangentspace.mesh import Mesh

from ..scene import Scene
from ..scenes import load_scene
from ..truth.rays import Occluders, trace_visibility

IMAGE, MAP = (48, 48), 64  # of the smallest views, which tests look at
REACH = 9.0  # of the widest filter, which the maps of cubes and cascades leave room for
VERTICES, FACES = 2750, 5250  # what the largest scene needs
MAPS = 6  # of a cube, and of the cascades here

# Compiled without optimization: each runs a few times, on small images.
quick = functools.partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})


def stage(function: Callable) -> tuple[Callable, Callable]:
    """Return a function compiled, and the pullback of its derivative at given arguments."""

    def back(arguments, slopes):
        return eqx.filter_vjp(function, *arguments)[1](slopes)

    return quick(function), quick(back)


class GeometryStages(NamedTuple):
    """What leads from the geometry to images and maps of one size; each with its pullback."""

    surface: tuple[Callable, Callable]
    matrices: tuple[Callable, Callable]
    maps: tuple[Callable, Callable]


@functools.cache
def geometry_stages(image: tuple[int, int], map_size: int) -> GeometryStages:
    """Return the stages for an image of so many pixels and maps of so many texels."""

    @stage
    def surface(mesh, camera):
        return render_surface(mesh, camera, image_size=image)

    @stage
    def matrices(layout, light, positions, camera):
        return layout.matrices(light, positions, camera, aspect=1.0, map_size=map_size, reach=REACH)

    @stage
    def maps(positions, faces, matrix):
        return tuple(
            render_shadow_map(positions, faces, matrix, map_size=map_size, casters=casters)
            for casters in ("two", "back", "planes")
        )

    return GeometryStages(surface, matrices, maps)


@stage
def to_light_stage(light: Light, position: Array) -> Array:
    """Return directions to the light."""
    return light.to_light(position)


@quick
def chosen_map(position: Array, shadow_map: ShadowMap) -> Array | None:
    """Return which of several maps each point is looked up in."""
    return choose_map(position, shadow_map, reach=REACH)


@stage
def receiver_stage(
    position: Array, normal: Array, to_light: Array, matrices: Array, index: Array | None
) -> Receiver:
    """Return the points as seen in the map."""
    return receive(position, normal, to_light, matrices, map_index=index)


class Seen(NamedTuple):
    """What every technique starts from; the maps hold two layers, back faces only, and planes."""

    receiver: Receiver
    two: ShadowMap
    back: ShadowMap
    planes: ShadowMap


@stage
def bias_stage(bias: Bias, seen: Seen, reach: Array) -> tuple[Receiver, ShadowMap]:
    """Return the receiver and the map after a bias."""
    nearest = seen.two._replace(second=None)
    maps = {"two": seen.two, "back": seen.back, "planes": seen.planes, "nearest": nearest}
    chosen = bias.prepare(maps[bias.casters])
    strong = lambda x: jnp.asarray(x, reach.dtype) if isinstance(x, float) else x
    return jax.tree.map(strong, bias(seen.receiver, reach)), chosen._replace(second=None)


@quick
def filter_stage(
    filter: Filter, compare: Compare, receiver: Receiver, shadow_map: ShadowMap, facing: Array
) -> tuple[Array, Any]:
    """Return the visibility, and the gradient of its mean in all but the last."""

    def mean(arguments):
        filter, compare, receiver, shadow_map = arguments
        lit = look_up(shadow_map, receiver, filter=filter, compare=compare)
        lit = jnp.where(facing, lit, 0.0)
        return jnp.mean(lit), lit

    arguments = filter, compare, receiver, shadow_map
    (_, lit), slopes = eqx.filter_value_and_grad(mean, has_aux=True)(arguments)
    return lit, slopes


class Either(Compare):
    """A hard comparison or a soft one, as a number says: both in one program."""

    hard: jax.Array
    softness: jax.Array

    def __call__(self, stored: Array, receiver: Receiver) -> Array:
        """Return the visibility."""
        soft = SoftCompare(self.softness)(stored, receiver)
        return jnp.where(self.hard, HardCompare()(stored, receiver), soft)


class View:
    """A scene under one light and one layout, and the derivatives of what is seen of it."""

    def __init__(
        self,
        layout: Layout,
        mesh: Mesh,
        camera: Camera,
        light: Any,
        *,
        image: tuple[int, int] = IMAGE,
        map_size: int = MAP,
    ) -> None:
        """Draw the maps and look at the scene; all arguments are arrays on the device."""
        self.layout, self.mesh, self.camera, self.light = layout, mesh, camera, light
        self._stages, self._map_size = geometry_stages(image, map_size), map_size
        self.surface = self._stages.surface[0](mesh, camera)
        towards = to_light_stage[0](light, self.surface.position)
        self.facing = (dot(self.surface.face_normal, towards) > 0) & self.surface.covered
        self._draw(self._stages.matrices[0](layout, light, mesh.positions, camera))

    def points(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return where the pixels lie, the normals of their faces, and the faces, for rays."""
        surface = self.surface
        position, normal = np.asarray(surface.position), np.asarray(surface.face_normal)
        return position, normal, np.asarray(surface.face_ids)

    def occluders(self) -> Occluders:
        """Return what rays may hit."""
        return Occluders(np.asarray(self.mesh.positions), np.asarray(self.mesh.faces))

    def with_matrices(self, matrices: Array) -> "View":
        """Return the same view with other maps."""
        other = copy.copy(self)
        other._draw(jnp.asarray(matrices, self.surface.position.dtype))
        return other

    def with_seen(self, seen: Seen) -> "View":
        """Return the same view, of which techniques see something else."""
        other = copy.copy(self)
        other.seen = seen
        return other

    def drawn_from(self, clip: Array) -> "View":
        """Return the same view with maps of vertices given in clip space, w = 1 for all."""
        straight = jnp.eye(4, dtype=clip.dtype)
        two, back, planes = self._stages.maps[0](clip, self.mesh.faces, straight)
        seen = self.seen
        return self.with_seen(
            seen._replace(
                two=seen.two._replace(depth=two.depth, second=two.second),
                back=seen.back._replace(depth=back.depth),
                planes=seen.planes._replace(depth=planes.depth, planes=planes.planes),
            )
        )

    def _draw(self, matrices: Array) -> None:
        # One after another, so that one program serves one map and several.
        self._matrices = [matrices] if matrices.ndim == 2 else list(matrices)
        draw = self._stages.maps[0]
        drawn = [draw(self.mesh.positions, self.mesh.faces, matrix) for matrix in self._matrices]
        maps = drawn[0] if len(drawn) == 1 else jax.tree.map(lambda *m: jnp.stack(m), *drawn)
        position, normal = self.surface.position, self.surface.face_normal
        to_light = to_light_stage[0](self.light, position)
        index = chosen_map(position, maps[0])
        self.placed = position, normal, to_light, maps[0].texel_from_world, index
        self.seen = Seen(receiver_stage[0](*self.placed), *maps)

    def pull(self, slopes: Any) -> dict[str, Any]:
        """Return gradients in what the scene is made of, from those in what is seen of it."""
        position, normal, to_light, matrices, _ = receiver_stage[1](self.placed, slopes.receiver)
        by_light, further = to_light_stage[1]((self.light, self.surface.position), to_light)
        surface = jax.tree.map(jnp.zeros_like, eqx.filter(self.surface, eqx.is_inexact_array))
        surface = surface._replace(position=position + further, face_normal=normal)
        maps = [(slopes.two, slopes.back, slopes.planes)]
        if len(self._matrices) > 1:
            maps = [jax.tree.map(lambda x, k=k: x[k], maps[0]) for k in range(MAPS)]
        by_maps = [
            self._stages.maps[1]((self.mesh.positions, self.mesh.faces, matrix), of)
            for matrix, of in zip(self._matrices, maps, strict=True)
        ]
        matrices = jnp.matmul(
            texel_from_clip(self._map_size, self._map_size, dtype=matrices.dtype).T, matrices
        )
        drawn = jnp.stack([matrix for _, _, matrix in by_maps]).reshape(matrices.shape)
        arguments = self.layout, self.light, self.mesh.positions, self.camera
        return {
            "light": by_light,
            "maps": [positions for positions, _, _ in by_maps],
            "surface": self._stages.surface[1]((self.mesh, self.camera), surface),
            "matrices": self._stages.matrices[1](arguments, matrices + drawn),
        }


def lightings(scene: Scene) -> dict[str, tuple[Light, Layout]]:
    """Return the light and the layout of each way to light a scene; the first is its own."""
    light = scene.lights[0]
    if isinstance(light, DirectionalLight):
        return {"sun": (light, SingleLayout()), "cascades": (light, CascadesLayout(MAPS))}
    if isinstance(light, SpotLight):
        lamp = PointLight(light.position, light.color)
        return {"spot": (light, SingleLayout()), "cube": (lamp, CubeLayout())}
    return {"cube": (light, CubeLayout())}


@functools.cache
def view(name: str, lighting: str | None = None) -> View:
    """Return a scene's smallest view, in single precision."""
    return view_of(load_scene(name), lighting)


def view_of(
    scene: Scene, lighting: str | None = None, dtype: Any = np.float32, **sizes: Any
) -> View:
    """Return the view of any scene that is not larger than the others.

    Args:
        scene: The scene.
        lighting: One of ``lightings``; its own if None.
        dtype: Of all numbers.
        sizes: ``image`` and ``map_size`` of ``View``.
    """
    ways = lightings(scene)
    light, layout = ways[lighting or next(iter(ways))]
    mesh = padded(scene.mesh._replace(uvs=None, tangents=None), VERTICES, FACES)
    return View(*on_device((layout, mesh, scene.camera, light), dtype), **sizes)


def visibility(
    seen: View, bias: Bias, filter: Filter, *, hard: bool = True, softness: float = 0.5
) -> tuple[Array, Any, dict[str, Any]]:
    """Return a technique's visibility, and the gradients of its mean.

    Returns:
        The visibility; what is seen of the scene as a gradient; all other gradients.
    """
    dtype = seen.seen.receiver.depth.dtype
    bias, filter = on_device((bias, filter), dtype)
    reach = jnp.asarray(filter.reach(), dtype)
    moved = bias_stage[0](bias, seen.seen, reach)
    compare = Either(jnp.asarray(hard), jnp.asarray(softness, dtype))
    lit, slopes = filter_stage(filter, compare, *moved, seen.facing)
    at_bias, at_seen, _ = bias_stage[1]((bias, seen.seen, reach), slopes[2:])
    return lit, at_seen, {"looked up": slopes, "bias": at_bias}


def truth(seen: View) -> np.ndarray:
    """Return which pixels the light reaches, by rays."""
    return trace_visibility(*seen.points(), seen.light, seen.occluders())


def padded(mesh: Mesh, vertices: int, faces: int) -> Mesh:
    """Return a mesh with zero-area faces, and with vertices that none of the others use."""
    more, none = vertices - len(mesh.positions), faces - len(mesh.faces)
    grown = {
        name: np.concatenate([values, np.zeros((more, *values.shape[1:]), values.dtype)])
        for name in ("normals", "uvs", "tangents")
        if (values := getattr(mesh, name)) is not None
    }
    return mesh._replace(
        positions=np.concatenate([mesh.positions, np.repeat(mesh.positions[:1], more, axis=0)]),
        faces=np.concatenate([mesh.faces, np.zeros((none, 3), np.int32)]),
        **grown,
    )


def on_device(tree: Any, dtype: Any) -> Any:
    """Return all numbers as arrays, floats of a type."""
    array = lambda x: jnp.asarray(x, dtype if np.asarray(x).dtype.kind == "f" else None)
    return jax.tree.map(array, tree)


def precision(dtype: Any) -> AbstractContextManager:
    """Return a context in which arrays of a type are made."""
    return jax.enable_x64(dtype == np.float64)
