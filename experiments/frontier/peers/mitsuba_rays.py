"""Mitsuba 3: shadow rays from our surface points to its samples of the light.

What its integrator ``direct`` does for emitters, but at given points: its scene holds the mesh,
its shapes and its sampler (multi-jittered) choose points of the light, ``ray_test`` tells which
are seen, and all pixels run at once as one kernel of the variant ``llvm_ad_rgb``. Its own
camera spreads samples over each pixel: beside truth, which is at pixel centres, that counts as
an RMSE of 0.05 on ``soft-lamp`` at 512 pixels, however many samples there are. Its radiance
also weights each sample by distance and angles, which a share of the light's area does not.
"""

import importlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np

from shadows.area_lights import AreaLight, DiscLight, RectangleLight
from shadows.transforms import look_at

from ..view import View
from .peer import INSTALL, Image, Peer, Work

_VARIANT = "llvm_ad_rgb"


@dataclass(frozen=True)
class Mitsuba(Peer):
    """Rays to random points of the light.

    Attributes:
        samples: Points of the light for each pixel; a square number.
    """

    samples: int
    technique: ClassVar[str] = "mitsuba"
    note: ClassVar[str] = f"shadow rays of its variant {_VARIANT}, at our surface points"

    @property
    def label(self) -> str:
        """Name with its samples."""
        return f"mitsuba {self.samples} sample{'s' if self.samples > 1 else ''}"

    @classmethod
    def absent(cls) -> str | None:
        """Return why it cannot run: it is not installed, or finds no LLVM."""
        try:
            mi, dr = _modules()
            dr.eval(mi.Float([0, 1]) + 1)
        except ModuleNotFoundError:
            return f"the module mitsuba is not installed; {INSTALL}"
        except Exception:  # Dr.Jit has told more
            return f"its variant {_VARIANT} does not run, which wants LLVM; apt install llvm"
        return None

    def applies(self, view: View) -> bool:
        """Whether it knows the light, and more samples than one have something to find."""
        if isinstance(view.light, AreaLight):
            return isinstance(view.light, DiscLight | RectangleLight)
        return self.samples == 1

    @contextmanager
    def open(self, view: View) -> Iterator[Work]:
        """Hand over the surface points and, ready to be built, the mesh."""
        mi, dr = _modules()
        mesh = _mesh(mi, np.asarray(view.scene.mesh.positions), np.asarray(view.scene.mesh.faces))
        flat = [
            np.asarray(array, np.float32).reshape(-1, 3).T
            for array in (view.surface.position, view.surface.face_normal)
        ]
        position, normal = mi.Point3f(flat[0]), mi.Normal3f(flat[1])
        covered = mi.Bool(np.asarray(view.surface.covered).ravel())
        aim = _aim(mi, view, self.samples)
        dr.eval(position, normal, covered)
        scene: Any = None

        def prepare() -> None:
            nonlocal scene
            scene = mi.load_dict({"type": "scene", "mesh": mesh})
            dr.sync_thread()

        def image() -> Image:
            count = self.samples
            pixel = dr.arange(mi.UInt32, count * dr.width(position)) // count
            point = dr.zeros(mi.SurfaceInteraction3f, dr.width(pixel))
            point.p = dr.gather(mi.Point3f, position, pixel)
            point.n = dr.gather(mi.Normal3f, normal, pixel)
            towards, ray = aim(point)
            faces = dr.gather(mi.Bool, covered, pixel) & (dr.dot(point.n, towards) > 0)
            seen = faces & ~scene.ray_test(ray, faces)
            share = dr.block_sum(dr.select(seen, mi.Float(1 / count), mi.Float(0)), count)
            return np.array(share).reshape(view.share.shape)

        yield Work(image, prepare=prepare)


def _modules() -> tuple[Any, Any]:
    """Return Mitsuba, set to the variant, and Dr.Jit."""
    mi = importlib.import_module("mitsuba")
    mi.set_variant(_VARIANT)
    return mi, importlib.import_module("drjit")


def _mesh(mi: Any, positions: np.ndarray, faces: np.ndarray) -> Any:
    mesh = mi.Mesh("mesh", len(positions), len(faces))
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = positions.astype(np.float32).ravel()
    parameters["faces"] = faces.astype(np.uint32).ravel()
    parameters.update()
    return mesh


def _aim(mi: Any, view: View, samples: int) -> Any:
    """Return a function from surface points to directions and rays to the light."""
    light = view.light
    if isinstance(light, AreaLight):
        shape = mi.load_dict(_shape(mi, light))
        sampler = mi.load_dict({"type": "multijitter", "sample_count": samples})

        def to_area(point: Any) -> tuple[Any, Any]:
            sampler.set_samples_per_wavefront(samples)
            sampler.seed(0, samples * view.share.size)
            target = shape.sample_position(0.0, sampler.next_2d()).p
            return target - point.p, point.spawn_ray_to(target)

        return to_area
    place = getattr(light, "position", None)
    if place is None:
        direction = mi.Vector3f(np.asarray(light.to_light(jnp.zeros(3))).tolist())
        return lambda point: (direction, point.spawn_ray(direction))
    target = mi.Point3f(np.asarray(place).tolist())
    return lambda point: (target - point.p, point.spawn_ray_to(target))


def _shape(mi: Any, light: AreaLight) -> dict[str, Any]:
    """Return the shape of an area light."""
    if isinstance(light, DiscLight):
        kind, sides, up = "disk", (light.radius, light.radius), np.array([0.0, 1.0, 0.0])
    elif isinstance(light, RectangleLight):
        kind, sides, up = "rectangle", (0.5 * light.width, 0.5 * light.height), light.up
    else:
        raise TypeError(f"mitsuba: expected a disc or rectangle light, got {type(light).__name__}")
    target = light.position + np.asarray(light.direction)
    world_from_view = np.linalg.inv(np.asarray(look_at(light.position, target, up), np.float64))
    scale = np.diag([float(sides[0]), float(sides[1]), 1.0, 1.0])
    return {"type": kind, "to_world": mi.ScalarTransform4f(world_from_view @ scale)}
