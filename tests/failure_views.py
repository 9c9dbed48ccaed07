"""Views of the failure catalogue's scenes, and every technique on them, forwards and backwards.

Meshes are padded to one size, and the way from geometry to visibility is cut into stages whose
derivatives are chained by hand: each compiles once, not once for every combination.
"""

import contextlib
import functools
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from experiments.scene import Scene
from experiments.scenes import load_scene
from experiments.truth.rays import Occluders, trace_visibility
from shadows import (
    CascadesLayout,
    Compare,
    CubeLayout,
    DirectionalLight,
    HardCompare,
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

IMAGE, MAP = (48, 48), 64
REACH = 9.0  # of the widest filter, which the maps of cubes and cascades leave room for
VERTICES, FACES = 2750, 5250  # what the largest scene needs
MAPS = 6  # of a cube, and of the cascades here

# Compiled without optimization: each runs a few times, on small images.
quick = functools.partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})


def stage(function):
    """Return a function compiled, and the pullback of its derivative at given arguments."""

    def back(arguments, slopes):
        return eqx.filter_vjp(function, *arguments)[1](slopes)

    return quick(function), quick(back)


@stage
def surface_stage(mesh, camera):
    return render_surface(mesh, camera, image_size=IMAGE)


@stage
def matrices_stage(layout, light, positions, camera):
    return layout.matrices(light, positions, camera, aspect=1.0, map_size=MAP, reach=REACH)


@stage
def maps_stage(positions, faces, matrix):
    return tuple(
        render_shadow_map(positions, faces, matrix, map_size=MAP, casters=casters)
        for casters in ("two", "back")
    )


@stage
def to_light_stage(light, position):
    return light.to_light(position)


@quick
def chosen_map(position, shadow_map):
    return choose_map(position, shadow_map, reach=REACH)


@stage
def receiver_stage(position, normal, to_light, matrices, index):
    return receive(position, normal, to_light, matrices, map_index=index)


class Seen(NamedTuple):
    """What every technique starts from; the maps hold two layers, and back faces only."""

    receiver: Receiver
    two: ShadowMap
    back: ShadowMap


@stage
def bias_stage(bias, seen, reach):
    maps = {"two": seen.two, "back": seen.back, "nearest": seen.two._replace(second=None)}
    chosen = bias.prepare(maps[bias.casters])
    strong = lambda x: jnp.asarray(x, reach.dtype) if isinstance(x, float) else x
    return jax.tree.map(strong, bias(seen.receiver, reach)), chosen._replace(second=None)


@quick
def filter_stage(filter, compare, receiver, shadow_map, facing):
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

    def __call__(self, stored, receiver):
        """Return the visibility."""
        soft = SoftCompare(self.softness)(stored, receiver)
        return jnp.where(self.hard, HardCompare()(stored, receiver), soft)


class View:
    """A scene under one light and one layout, and the derivatives of what is seen of it."""

    def __init__(self, layout, mesh, camera, light):
        self.layout, self.mesh, self.camera, self.light = layout, mesh, camera, light
        matrices = matrices_stage[0](layout, light, mesh.positions, camera)
        # One after another, so that one program serves one map and several.
        self._matrices = [matrices] if matrices.ndim == 2 else list(matrices)
        drawn = [maps_stage[0](mesh.positions, mesh.faces, matrix) for matrix in self._matrices]
        maps = drawn[0] if len(drawn) == 1 else jax.tree.map(lambda *m: jnp.stack(m), *drawn)
        self.surface = surface_stage[0](mesh, camera)
        position, normal = self.surface.position, self.surface.face_normal
        to_light = to_light_stage[0](light, position)
        index = chosen_map(position, maps[0])
        self._receiver = position, normal, to_light, maps[0].texel_from_world, index
        self.seen = Seen(receiver_stage[0](*self._receiver), *maps)
        self.facing = (dot(normal, to_light) > 0) & self.surface.covered

    def pull(self, slopes):
        """Return gradients in what the scene is made of, from those in what is seen of it."""
        position, normal, to_light, matrices, _ = receiver_stage[1](self._receiver, slopes.receiver)
        by_light, further = to_light_stage[1]((self.light, self.surface.position), to_light)
        surface = jax.tree.map(jnp.zeros_like, eqx.filter(self.surface, eqx.is_inexact_array))
        surface = surface._replace(position=position + further, face_normal=normal)
        maps = [(slopes.two, slopes.back)]
        if len(self._matrices) > 1:
            maps = [jax.tree.map(lambda x, k=k: x[k], maps[0]) for k in range(MAPS)]
        by_maps = [
            maps_stage[1]((self.mesh.positions, self.mesh.faces, matrix), of)
            for matrix, of in zip(self._matrices, maps, strict=True)
        ]
        matrices = jnp.matmul(texel_from_clip(MAP, MAP, dtype=matrices.dtype).T, matrices)
        drawn = jnp.stack([matrix for _, _, matrix in by_maps]).reshape(matrices.shape)
        arguments = self.layout, self.light, self.mesh.positions, self.camera
        return {
            "light": by_light,
            "maps": [positions for positions, _, _ in by_maps],
            "surface": surface_stage[1]((self.mesh, self.camera), surface),
            "matrices": matrices_stage[1](arguments, matrices + drawn),
        }


def lightings(scene: Scene) -> dict[str, tuple]:
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
    """Return a scene's view, in single precision."""
    return view_of(load_scene(name), lighting)


def view_of(scene: Scene, lighting: str | None = None) -> View:
    """Return the view of any scene that is not larger than the others."""
    ways = lightings(scene)
    light, layout = ways[lighting or next(iter(ways))]
    mesh = padded(scene.mesh._replace(uvs=None, tangents=None), VERTICES, FACES)
    return View(*on_device((layout, mesh, scene.camera, light), np.float32))


def visibility(seen: View, bias, filter, *, hard=True):
    """Return a technique's visibility, and the gradients of its mean.

    Returns:
        The visibility; what is seen of the scene as a gradient; all other gradients.
    """
    dtype = seen.seen.receiver.depth.dtype
    bias, filter = on_device((bias, filter), dtype)
    reach = jnp.asarray(filter.reach(), dtype)
    moved = bias_stage[0](bias, seen.seen, reach)
    compare = Either(jnp.asarray(hard), jnp.asarray(0.5, dtype))
    lit, slopes = filter_stage(filter, compare, *moved, seen.facing)
    at_bias, at_seen, _ = bias_stage[1]((bias, seen.seen, reach), slopes[2:])
    return lit, at_seen, {"looked up": slopes, "bias": at_bias}


def truth(seen: View):
    """Return which pixels the light reaches, by rays."""
    points = (seen.surface.position, seen.surface.face_normal, seen.surface.face_ids)
    occluders = Occluders(np.asarray(seen.mesh.positions), np.asarray(seen.mesh.faces))
    return trace_visibility(*map(np.asarray, points), seen.light, occluders)


def padded(mesh, vertices, faces):
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


def on_device(tree, dtype):
    """Return all numbers as arrays, floats of a type."""
    array = lambda x: jnp.asarray(x, dtype if np.asarray(x).dtype.kind == "f" else None)
    return jax.tree.map(array, tree)


def precision(dtype):
    """Return a context in which arrays of a type are made."""
    return contextlib.nullcontext() if dtype == np.float64 else jax.enable_x64(False)
