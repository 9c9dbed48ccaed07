"""How fast the images of random scenes change: by derivatives of renderings, and by rays.

The truth are central differences of ray-traced images, in double precision: the mean of several,
each over its own time and from its own points in the pixels. How they scatter tells the noise.
A difference is the mean of the derivative over its time, so derivatives of renderings are means
over moments of it. They are in single precision, with coverage and without. Differences of
the renderings themselves, in double precision, tell apart what derivatives miss from what shadow
maps do. All are rendered with the bias by two planes: under one depth for all texels the borders of
acne in folds, and of leaks at contacts, move too, and no derivative sees those.
"""

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from shadows import TwoPlaneBias, render

from .random_scenes import Motion, RandomScene, random_scene
from .supersampled import supersampled

_CLEAR = 20.0  # times the noise: changes above are known to 5 %
_BLOCK = 4  # pixels on each side, over which derivative images are compared
Image = Float[Array | np.ndarray, "height width"]


class Settings(NamedTuple):
    """How scenes are measured.

    Attributes:
        image_size: Pixels on each side.
        samples: Rendered pixels on each side of one of the image's.
        map_size: Texels on each side of the shadow map.
        truth_samples: Points on each side of a pixel for each of the truth's differences.
        times: Forth and back, for each of the differences.
        moments: Between them, at which derivatives are taken; few do not tell the mean, as shadows
            move over many texels.
    """

    image_size: int = 128
    samples: int = 4
    map_size: int = 1024
    truth_samples: int = 4
    times: tuple[float, ...] = 2 * (0.008, 0.009, 0.01, 0.011)
    moments: int = 32


class Figures(NamedTuple):
    """What was measured of a scene.

    Attributes:
        seed: Of the scene.
        light_kind: Of the scene.
        moves: What moves, or how.
        caster_faces: Of each caster.
        change: Of the mean over the window, per unit of time; the truth.
        noise: Twice the truth's standard error.
        own: The same of the rendering with coverage, by differences.
        covered: The change by derivatives with coverage.
        plain: The same without.
        image_noise: Relative L1 distance between two halves of the truth's derivative images.
        image_own: The same of the derivative image with coverage from its own differences.
        image_covered: The same from the truth's.
        image_plain: The same without.
    """

    seed: int
    light_kind: str
    moves: str
    caster_faces: tuple[int, ...]
    change: float
    noise: float
    own: float
    covered: float
    plain: float
    image_noise: float
    image_own: float
    image_covered: float
    image_plain: float

    @property
    def clear(self) -> bool:
        """Whether the change stands out from the noise."""
        return abs(self.change) > _CLEAR * self.noise

    @property
    def off(self) -> dict[str, float]:
        """The relative errors of the changes, by ways."""
        pairs = {
            "with coverage": (self.covered, self.change),
            "own differences": (self.covered, self.own),
            "without": (self.plain, self.change),
        }
        return {name: abs(found - true) / abs(true) for name, (found, true) in pairs.items()}

    @property
    def image_off(self) -> dict[str, float]:
        """The errors of the derivative images, by ways."""
        return {
            "with coverage": self.image_covered,
            "own differences": self.image_own,
            "without": self.image_plain,
        }


def measure_scenes(
    seeds: Sequence[int], settings: Settings = Settings(), *, workers: int = 2
) -> Iterator[Figures]:
    """Measure scenes, some at once, in the order given."""
    with ThreadPoolExecutor(workers) as pool:
        yield from pool.map(partial(measure_scene, settings=settings), seeds)


def measure_scene(seed: int, settings: Settings = Settings()) -> Figures:
    """Measure one scene."""
    with jax.enable_x64(True):
        scene = random_scene(seed)
        parts = true_changes(scene.motion, settings)
        covered, plain = (rendered_change(scene.motion, settings, covered=c) for c in (True, False))
        own = rendered_difference(scene.motion, settings)
    truth = np.mean(parts, axis=0)
    of_window = partial(window_mean, scene)
    return Figures(
        seed,
        scene.light_kind,
        scene.moves,
        scene.caster_faces,
        of_window(truth),
        float(2 * np.std([of_window(part) for part in parts], ddof=1) / np.sqrt(len(parts))),
        of_window(own),
        of_window(covered),
        of_window(plain),
        _distance(np.mean(parts[::2], axis=0), np.mean(parts[1::2], axis=0)),
        _distance(covered, own),
        *(_distance(image, truth) for image in (covered, plain)),
    )


def true_changes(motion: Motion, settings: Settings) -> list[Image]:
    """Return changes of the ray-traced image, by central differences."""
    size = (settings.image_size, settings.image_size)

    def image(time: float, grid: int) -> Image:
        mesh, light = motion.at(time)
        return supersampled(
            mesh, motion.camera, light, image_size=size, samples=settings.truth_samples, grid=grid
        )[..., 0]

    return [
        (image(time, grid) - image(-time, grid)) / (2 * time)
        for grid, time in enumerate(settings.times)
    ]


def rendered_change(motion: Motion, settings: Settings, *, covered: bool) -> Image:
    """Return the derivative of the rendered image by time, with coverage or without."""
    single = lambda leaf: jnp.asarray(leaf, None if np.asarray(leaf).dtype.kind == "i" else "f4")
    motion, size = jax.tree.map(single, motion), settings.samples * settings.image_size
    moments = np.arange(1 - settings.moments, settings.moments, 2) / settings.moments
    changes = [
        _change(motion, np.float32(moment), size, settings.map_size, covered)
        for moment in np.mean(settings.times) * moments
    ]
    return _pooled(np.asarray(np.mean(changes, axis=0, dtype=np.float64)), settings.samples)


def rendered_difference(motion: Motion, settings: Settings) -> Image:
    """Return the central difference of the image rendered with coverage."""
    size, time = settings.samples * settings.image_size, float(np.mean(settings.times))
    after, before = (
        np.asarray(_rendered(motion, moment, size, settings.map_size, True))
        for moment in (time, -time)
    )
    return _pooled(np.asarray(0.5 * (after - before) / time), settings.samples)


@partial(jax.jit, static_argnames=("size", "map_size", "covered"))
def _rendered(
    motion: Motion, time: float | Float[Array, ""], size: int, map_size: int, covered: bool
) -> Image:
    mesh, light = motion.at(time)
    return render(
        mesh,
        motion.camera,
        light,
        image_size=(size, size),
        map_size=map_size,
        bias=TwoPlaneBias(),
        edges=motion.edges if covered else None,
    ).color[..., 0]


@partial(jax.jit, static_argnames=("size", "map_size", "covered"))
def _change(
    motion: Motion, moment: Float[Array | np.ndarray, ""], size: int, map_size: int, covered: bool
) -> Image:
    image = lambda time: _rendered(motion, time, size, map_size, covered)
    return jax.jvp(image, (moment,), (jnp.ones_like(moment),))[1]


def window_mean(scene: RandomScene, image: Image) -> float:
    """Return the mean over the scene's window."""
    height, width = image.shape
    first, last, left, right = scene.window
    rows = slice(int(first * height), int(last * height))
    columns = slice(int(left * width), int(right * width))
    return float(np.mean(image[rows, columns]))


def _distance(image: Image, truth: Image) -> float:
    """Return the relative L1 distance of two images after a box filter; 0 if both are 0."""
    image, truth = _pooled(image, _BLOCK), _pooled(truth, _BLOCK)
    size = np.sum(np.abs(truth))
    return float(np.sum(np.abs(image - truth)) / size) if size else 0.0


def _pooled(image: Image, block: int) -> Float[Array | np.ndarray, "rows columns"]:
    """Return the means of square blocks of pixels."""
    height, width = image.shape
    return image.reshape(height // block, block, width // block, block).mean(axis=(1, 3))
