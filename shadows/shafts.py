"""Light shafts: what a thin homogeneous medium scatters to the eye, by marching shadow maps.

Along the view ray of each pixel, up to the surface at distance d or to the background,

    L = integral from 0 to d of  density albedo p(angle) radiance(x_t) V(x_t) exp(-density t) dt

in steps: what the medium does is integrated in closed form over each, and the light that
arrives taken from its middle. Even light along a ray is exact with one step; elsewhere the
error falls with the square of the number of steps, and where a shadow's edge crosses the ray
with the number itself. Light is scattered once and reaches the medium undimmed: only the way
to the eye is dimmed.

A point in the medium has no surface that could shade itself, and so no slope and no bias.
"""

import functools
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from tangentspace._math import dot, safe_normalize
from tangentspace.environment import view_directions

from .compare import Compare, HardCompare
from .filters import Filter
from .lights import Light
from .medium import Medium
from .render import Rendering
from .shadow_map import Receiver, ShadowMap, choose_map, receive
from .surface import Surface
from .transforms import Camera, PerspectiveCamera, Scalar
from .window_filters import BilinearFilter


class Rays(NamedTuple):
    """What the eye looks along.

    Attributes:
        origin: World space.
        direction: Unit vectors away from the eye.
        length: Distance to what ends the ray.
    """

    origin: Float[Array, "*pixels 3"]
    direction: Float[Array, "*pixels 3"]
    length: Float[Array, "*pixels"]


def add_shafts(
    rendering: Rendering,
    camera: Camera,
    lights: Light | Sequence[Light],
    medium: Medium,
    *,
    steps: int = 32,
    offset: Scalar | Float[Array, "height width"] = 0.5,
    background_distance: Scalar | None = None,
    filter: Filter = BilinearFilter(),
    compare: Compare = HardCompare(),
) -> Rendering:
    """Fill the space before the eye with a medium.

    Args:
        rendering: From ``render``; its maps are marched.
        camera: The view that it was rendered with.
        lights: The lights that it was rendered with.
        medium: What fills the space.
        steps: Samples along each ray, at least 1.
        offset: Where each step is sampled, as a share of it in [0, 1]. Where bands show,
            ``interleaved_noise(height, width)`` turns them into a fine pattern.
        background_distance: Where the medium ends where there is no surface; None for the
            camera's far plane.
        filter: How the maps are asked.
        compare: Hard, or soft where derivatives are wanted; for filters that compare.

    Returns:
        The rendering with its color dimmed by the medium, and the scattered light added.

    Raises:
        ValueError: If ``steps`` is less than 1, or there is not one map for each light.

    Differentiability:
        In the medium, the lights, the camera, the surface and the maps' depths; shadow edges
        in the medium move smoothly with a soft ``compare`` and a filter that blends.
    """
    lights = (lights,) if isinstance(lights, Light) else tuple(lights)
    if len(rendering.shadow_maps) != len(lights):
        expected = f"expected one of `lights` for each of {len(rendering.shadow_maps)} shadow maps"
        raise ValueError(f"add_shafts: {expected}, got {len(lights)}")
    far = camera.far if background_distance is None else background_distance
    rays = view_rays(rendering.surface, camera, background_distance=far)
    color = medium.transmitted(rays.length)[..., None] * rendering.color
    for light, shadow_map in zip(lights, rendering.shadow_maps, strict=True):
        color = color + scattered_light(
            rays,
            light,
            shadow_map,
            medium,
            steps=steps,
            offset=offset,
            filter=filter,
            compare=compare,
        )
    return rendering._replace(color=color)


def view_rays(surface: Surface, camera: Camera, *, background_distance: Scalar) -> Rays:
    """Return the ray through each pixel's centre, from the eye to what it sees.

    Under parallel rays the eye is taken to be the near plane.

    Args:
        surface: What is seen.
        camera: The view.
        background_distance: Length of the rays that meet no surface.
    """
    height, width = surface.face_ids.shape
    clip_from_world = camera.clip_from_world(width / height)
    direction = safe_normalize(view_directions(clip_from_world, height, width))
    if isinstance(camera, PerspectiveCamera):
        view = jnp.asarray(camera.view_from_world)
        eye = -jnp.matmul(view[:3, :3].T, view[:3, 3], precision="highest")
        origin = jnp.broadcast_to(eye, direction.shape)
    else:
        inverse = jnp.linalg.inv(clip_from_world)
        x = (2 * jnp.arange(width, dtype=direction.dtype) + 1) / width - 1
        y = 1 - (2 * jnp.arange(height, dtype=direction.dtype) + 1) / height
        origin = inverse[:3, 3] - inverse[:3, 2] + y[:, None, None] * inverse[:3, 1]
        origin = origin + x[:, None] * inverse[:3, 0]
    distance = dot(surface.position - origin, direction)
    return Rays(origin, direction, jnp.where(surface.covered, distance, background_distance))


def scattered_light(
    rays: Rays,
    light: Light,
    shadow_map: ShadowMap,
    medium: Medium,
    *,
    steps: int = 32,
    offset: Scalar | Float[Array, "*pixels"] = 0.5,
    filter: Filter = BilinearFilter(),
    compare: Compare = HardCompare(),
) -> Float[Array, "*pixels 3"]:
    """Return what the medium scatters of one light to the eye, linear RGB.

    Memory does not grow with the steps, neither of the value nor of its gradient: in the
    reverse pass each step is computed again.

    Args:
        rays: Where to march.
        light: The light.
        shadow_map: Its map, of one image or several.
        medium: What the rays lead through.
        steps: Samples along each ray, at least 1.
        offset: Where each step is sampled, as a share of it in [0, 1].
        filter: How the map is asked.
        compare: Hard or soft; for filters that compare.

    Raises:
        ValueError: If ``steps`` is less than 1.

    Differentiability:
        As ``add_shafts``.
    """
    if steps < 1:
        raise ValueError(f"scattered_light: expected `steps` of at least 1, got {steps}")
    filter = filter.for_light(light)
    prepared, reach = filter.prepare(shadow_map), filter.reach()
    step = rays.length / steps

    @functools.partial(jax.checkpoint, prevent_cse=False)
    def at_step(k: Float[Array, ""]) -> Float[Array, "*pixels 3"]:
        position = rays.origin + ((k + offset) * step)[..., None] * rays.direction
        to_light = light.to_light(position)
        receiver = _receive_in_space(position, to_light, shadow_map, reach)
        visible = filter.visibility(filter.read(prepared, receiver), receiver, compare)
        share = visible * medium.scattered(dot(to_light, rays.direction))
        share = share * medium.transmitted(k * step)
        return share[..., None] * light.radiance(position)

    add = lambda total, k: (total + at_step(k), None)
    nothing = jnp.zeros_like(rays.direction)
    total, _ = lax.scan(add, nothing, jnp.arange(steps, dtype=step.dtype))
    lost_in_step = -jnp.expm1(-medium.density * step)
    return lost_in_step[..., None] * (medium.albedo * total)


def _receive_in_space(
    position: Float[Array, "*pixels 3"],
    to_light: Float[Array, "*pixels 3"],
    shadow_map: ShadowMap,
    reach: Scalar,
) -> Receiver:
    """Locate points of the medium in a light's map.

    What casts lies before the far plane, so a point beyond it sees of the light what the
    point sees at which its ray to the light meets that plane.
    """
    length = jnp.zeros_like(position[..., 0])
    for matrix in shadow_map.texel_from_world.reshape(-1, 4, 4):
        plane = matrix[2] - matrix[3]  # depth - 1, times w
        beyond = dot(position, plane[:3]) + plane[3]
        approach = -dot(to_light, plane[:3])
        in_front = dot(position, matrix[3, :3]) + matrix[3, 3] > 0
        needed = in_front & (beyond > 0) & (approach > 0)
        back = jnp.where(needed, beyond, 0) / jnp.where(needed, approach, 1)
        length = jnp.maximum(length, back)
    moved = length > 0
    position = position + length[..., None] * to_light
    index = choose_map(position, shadow_map, reach=reach)
    matrices = shadow_map.texel_from_world
    receiver = receive(position, to_light, to_light, matrices, map_index=index)
    depth = jnp.where(moved, jnp.minimum(receiver.depth, 1), receiver.depth)
    no_slope, known = jnp.zeros_like(depth), receiver.outside & ~moved
    return receiver._replace(
        depth=depth, depth_per_column=no_slope, depth_per_row=no_slope, outside=known
    )


def interleaved_noise(height: int, width: int) -> Float[Array, "{height} {width}"]:
    """Return a fixed pattern in [0, 1) that is spread evenly over any 3x3 pixels.

    Args:
        height: Rows.
        width: Columns.

    References:
        J. Jimenez, "Next Generation Post Processing in Call of Duty: Advanced Warfare",
        SIGGRAPH 2014 course, "interleaved gradient noise".
    """
    fraction = lambda x: x - jnp.floor(x)
    row, column = jnp.arange(height)[:, None], jnp.arange(width)
    return fraction(52.9829189 * fraction(0.06711056 * column + 0.00583715 * row))
