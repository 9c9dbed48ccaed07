"""What must hold before anything is computed; each failure is one line for the user."""

import os
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from shadows.area_lights import AreaLight, DiscLight, RectangleLight
from shadows.filters import Filter
from shadows.layouts import CubeLayout, Layout, SingleLayout
from shadows.lights import DirectionalLight, Light, PointLight, SpotLight
from shadows.projector import Projector
from shadows.shadow_map import Casters, ShadowMap
from shadows.transforms import Scalar, transform_points

from .scene import Scene

_LARGEST_IMAGE = 8192


def check_size(option: str, *sizes: int) -> None:
    """Refuse image and map sizes that are not from 1 to 8192."""
    if not all(1 <= size <= _LARGEST_IMAGE for size in sizes):
        got = " ".join(map(str, sizes))
        raise ValueError(f"{option}: expected sizes from 1 to {_LARGEST_IMAGE} pixels, got {got}")


def check_reach(filter: Filter, layout: Layout, map_size: int) -> None:
    """Refuse a filter that reaches farther than the maps, of a layout of several half a map."""
    reach = float(filter.reach())
    most = map_size if isinstance(layout, SingleLayout) else 0.5 * map_size - 1
    if not reach < most:
        raise ValueError(
            f"--filter: reaches {reach:g} texels, expected less than {most:g} for shadow maps of "
            f"{map_size}; choose a narrower filter or a larger --shadow-map-size"
        )


def check_folder(folder: Path) -> None:
    """Refuse a folder that cannot be made or written to; nothing is made yet."""
    there = next(place for place in (folder, *folder.parents) if place.exists())
    if not there.is_dir():
        raise ValueError(f"{folder}: {there} is a file, no folder; choose another folder")
    if not os.access(there, os.W_OK | os.X_OK):
        raise ValueError(f"{folder}: {there} cannot be written to; choose another folder")


def make_folder(folder: Path) -> None:
    """Make a folder and those that it lies in."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        reason = error.strerror or error
        raise ValueError(f"{folder}: cannot be made ({reason}); choose another folder") from error


def check_out(path: Path, *suffixes: str) -> None:
    """Refuse an output file of another kind, or in a folder that is missing or read-only."""
    if path.suffix.lower() not in suffixes:
        raise ValueError(f"{path}: expected a name that ends in {' or '.join(suffixes)}")
    if path.is_dir():
        raise ValueError(f"{path}: is a folder; choose another name")
    if not path.parent.is_dir():
        raise ValueError(f"{path}: no folder {path.parent}; make it or choose another place")
    if not os.access(path.parent, os.W_OK | os.X_OK):
        raise ValueError(f"{path}: its folder cannot be written to; choose another place")


def check_target(
    path: Path, image: Float[np.ndarray, "height width 3"], size: tuple[int, int]
) -> None:
    """Refuse a target image of another size than the view, or with values that are not finite."""
    if image.shape[:2] != size:
        raise ValueError(
            f"{path}: expected {size[0]} x {size[1]} pixels (height x width) as the view, got "
            f"{image.shape[0]} x {image.shape[1]}; scale it or give --image-size"
        )
    if not np.isfinite(image).all():
        raise ValueError(f"{path}: has pixels that are NaN or infinite; repair the image")


def check_scene(scene: Scene, layout: Layout = SingleLayout()) -> None:
    """Refuse cameras and lights that see nothing or have no sense."""
    camera, light = scene.camera, scene.lights[0]
    near, far = float(camera.near), float(camera.far)
    if not near < far:
        raise ValueError(
            f"{scene.name}: the camera's near ({near:g}) must be less than its far ({far:g})"
        )
    _check_light(scene.name, light)
    positions = np.asarray(scene.mesh.positions)
    if isinstance(layout, CubeLayout):
        return
    if stands_inside(scene, light):
        raise ValueError(
            f"{scene.name}: the point light stands inside the scene, where one shadow map "
            "cannot see all around; take the cube layout, move it out or use a spot light"
        )
    matrix = light.clip_from_world(jnp.asarray(positions))
    clip = np.asarray(transform_points(matrix, jnp.asarray(positions)))
    if not np.isfinite(clip).all() or np.all(clip[:, 3] <= 0):
        raise ValueError(f"{scene.name}: nothing is in the light's view; move or turn the light")


def stands_inside(scene: Scene, light: Light) -> bool:
    """Tell whether a point light stands among what it lights, so that it wants a cube of maps."""
    positions = np.asarray(scene.mesh.positions)
    low, high = positions.min(axis=0), positions.max(axis=0)
    return isinstance(light, PointLight) and bool(
        np.all((low < light.position) & (light.position < high))
    )


def check_shadow_map(scene: Scene, shadow_map: ShadowMap, *, casters: Casters) -> None:
    """Refuse an empty map, but for one that shows only faces turned away from the light."""
    if casters != "back" and not bool((shadow_map.depth < 1).any()):
        raise ValueError(f"{scene.name}: nothing is in the light's view; move or turn the light")


def _check_light(name: str, light: Light) -> None:
    """Refuse a light whose own numbers have no sense."""
    if isinstance(light, DirectionalLight | SpotLight | Projector | AreaLight):
        length = float(np.linalg.norm(np.asarray(light.direction)))
        if not np.isfinite(length) or length < 1e-6:
            raise ValueError(
                f"{name}: the light's direction is zero or not finite (light at its target?)"
            )
    if isinstance(light, Projector | RectangleLight) and not np.isfinite(light.up).all():
        raise ValueError(f"{name}: the light's `up` is NaN or infinite")
    if isinstance(light, SpotLight):
        _check_between(name, "the spot's outer angle", light.outer_angle, np.pi / 2, "pi/2")
    if isinstance(light, Projector):
        _check_between(name, "the projector's vertical field", light.vertical_fov, np.pi, "pi")
        if not np.isfinite(light.image).all():
            raise ValueError(f"{name}: the projector's image has pixels that are NaN or infinite")
    if isinstance(light, DiscLight):
        _check_between(name, "the disc light's radius", light.radius)
    if isinstance(light, RectangleLight):
        _check_between(name, "the rectangle light's width", light.width)
        _check_between(name, "the rectangle light's height", light.height)


def _check_between(
    name: str, what: str, value: Scalar, most: float = np.inf, in_words: str = "infinity"
) -> None:
    """Refuse a number that is not above 0 and below the most."""
    if not 0 < float(value) < most:
        raise ValueError(f"{name}: expected {what} between 0 and {in_words}, got {float(value):g}")
