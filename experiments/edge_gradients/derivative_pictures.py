"""Pictures of how an image changes with one number: forward mode beside central differences.

A derivative in forward mode is an image, one number a pixel: how fast its brightness, the mean
of red, green and blue, changes. Differences are of images from many points in each pixel:
traced by rays, which owe nothing to shadow maps, or rendered with the same shadow maps.
Single pixels of both differ where an edge passes, as a difference smears it over its step;
sums over a few pixels do not. So errors are those of means over 4 x 4 pixels.
"""

from pathlib import Path
from typing import Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib.figure
import numpy as np
import scipy.ndimage
from jaxtyping import Array, Float

from shadows.area_lights import AreaLight
from shadows.layouts import Layout, SingleLayout
from shadows.render import Rendering, render
from shadows.silhouettes import MeshEdges, mesh_edges
from tangentspace.shading import BlinnPhongShading, Shading

from ..files.images import atomic_path
from ..rendering.render_scene import Shadows, render_scene, shade_scene
from ..scene import Scene
from ..truth.area import surface_share
from ..truth.rays import Occluders
from .scene_parameters import Parameter, Setup

Brightness = Float[np.ndarray, "height width"]
Against = Literal["rays", "maps"]
COLORS = "PuOr_r"  # purple less, orange more; for all eyes
_BOX = 4  # pixels on each side over which errors are averaged
_LARGEST = 2048  # of an image with all points of its pixels
_UNSEEN = 1e-4  # change of brightness over a step that counts as none


class Sizes(NamedTuple):
    """Of an image: its height and width; and of its shadow maps, texels on each side."""

    image: tuple[int, int]
    map: int


class Derivatives(NamedTuple):
    """How fast an image's brightness changes.

    Attributes:
        forward: Forward mode through coverage.
        uncovered: Forward mode without.
        difference: Central difference.
    """

    forward: Brightness
    uncovered: Brightness
    difference: Brightness

    def mean_error(self, image: Brightness) -> float | None:
        """Return by how much an image's mean is off the difference's, by the size of that."""
        mean = float(self.difference.mean())
        return abs(float(image.mean()) - mean) / abs(mean) if mean else None

    def error(self, image: Brightness) -> float | None:
        """Return the sum of distances from the difference, by that of its sizes, in boxes."""
        size = self.size()
        return float(np.abs(_boxes(image - self.difference)).mean()) / size if size else None

    def size(self) -> float:
        """Return the mean size of the difference, in boxes."""
        return float(np.abs(_boxes(self.difference)).mean())

    def moves(self, parameter: Parameter) -> bool:
        """Return whether anything is to be seen of a step."""
        return max(float(np.abs(image).max()) for image in self) * parameter.step > _UNSEEN


def derivatives(
    scene: Scene,
    setup: Setup,
    parameter: Parameter,
    *,
    sizes: Sizes,
    layout: Layout = SingleLayout(),
    shading: Shading = BlinnPhongShading(),
    against: Against = "rays",
) -> Derivatives:
    """Return how fast a scene's image changes with a number, three times found.

    Args:
        scene: As ``prepare_scene`` returns it.
        setup: What of it moves, arrays of JAX.
        parameter: The number; what rays do not know of is differenced with maps.
        sizes: Of image and shadow maps.
        layout: How many maps serve each light.
        shading: The lighting model.
        against: What is differenced: images traced by rays, or rendered with shadow maps.
    """
    edges = mesh_edges(scene.mesh.positions, scene.mesh.faces)
    look = (scene.materials, scene.face_materials, scene.environment, shading, layout)
    arrays = jax.tree.map(jnp.asarray, (look, edges))
    velocity = parameter.velocity(setup)
    forward, uncovered = (
        np.asarray(_forward(setup, velocity, arrays[0], edges, sizes))
        for edges in (arrays[1], None)
    )

    maps = against == "maps" or not parameter.traced
    image = _rendered if maps else _traced
    after, before = (
        image(scene, parameter.move(setup, change), sizes, layout, shading)
        for change in (parameter.step, -parameter.step)
    )
    return Derivatives(forward, uncovered, (after - before) / (2 * parameter.step))


def save_derivatives(
    path: Path, found: Derivatives, parameter: Parameter, *, title: str, against: Against
) -> None:
    """Save the pictures side by side: pixel by pixel, and means of those round each pixel.

    Args:
        path: PNG file.
        found: What to show.
        parameter: Of which number.
        title: Before the number's name.
        against: What was differenced.
    """
    rays = against == "rays" and parameter.traced
    panels = {
        "forward mode through coverage": found.forward,
        f"central difference, {'rays' if rays else 'same shadow maps'}": found.difference,
        "first minus second": found.forward - found.difference,
        "forward mode without coverage": found.uncovered,
    }
    label = f"brightness per {parameter.unit}"
    figure = matplotlib.figure.Figure(figsize=(16, 8.6), layout="constrained")
    for row, width in zip(figure.subplots(2, 4), (1, _BOX), strict=True):
        shown = [scipy.ndimage.uniform_filter(panel, width) for panel in panels.values()]
        most = color_limit(shown[1] if np.any(shown[1]) else shown[0])
        options = {"cmap": COLORS, "vmin": -most, "vmax": most, "interpolation": "nearest"}
        drawn = [place.imshow(panel, **options) for place, panel in zip(row, shown, strict=True)]
        for place, name in zip(row, panels, strict=True):
            place.set_title(name if width == 1 else f"means over {_BOX} x {_BOX} pixels")
            place.set_axis_off()
        figure.colorbar(drawn[0], ax=row, label=label, extend="both", shrink=0.9, pad=0.01)
    figure.suptitle(f"{title}: change with {parameter.name}, {label}", fontsize=13)
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=110)


def color_limit(image: Brightness) -> float:
    """Return the end of a color scale that a few bright pixels do not stretch."""
    sizes = np.abs(image)
    seen = sizes[sizes > 0.01 * sizes.max()]
    return float(np.quantile(seen, 0.98)) if seen.size else 1.0


@eqx.filter_jit
def _forward(
    setup: Setup, velocity: Setup, look: tuple, edges: MeshEdges | None, sizes: Sizes
) -> Float[Array, "height width"]:
    materials, face_materials, environment, shading, layout = look

    def brightness(setup: Setup) -> Float[Array, "height width"]:
        image = render(
            *setup[:3],
            image_size=sizes.image,
            map_size=sizes.map,
            layout=layout,
            bias=setup.bias,
            filter=setup.filter,
            compare=setup.compare,
            materials=materials,
            face_materials=face_materials,
            environment=environment,
            shading=shading,
            edges=edges,
        )
        return jnp.mean(image.color, axis=-1)

    return eqx.filter_jvp(brightness, (setup,), (velocity,))[1]


def _traced(
    scene: Scene, setup: Setup, sizes: Sizes, layout: Layout, shading: Shading
) -> Brightness:
    """Return the image that rays see, from many points in each pixel."""
    soft = any(isinstance(light, AreaLight) for light in setup.lights)
    samples = _samples(sizes.image, 2 if soft else 8)  # soft edges need fewer
    image = _drawn(scene, setup, sizes, layout, shading, samples, shadows="none")
    occluders = Occluders(setup.mesh.positions, setup.mesh.faces)
    shares = [surface_share(image.surface, light, occluders)[1] for light in setup.lights]
    shares = [share.astype(image.color.dtype) for share in shares]
    lit = shade_scene(scene, image, setup.lights, shares, shading)
    color = jnp.where(image.surface.covered[..., None], lit, image.color)
    return _pooled(color, samples)


def _rendered(
    scene: Scene, setup: Setup, sizes: Sizes, layout: Layout, shading: Shading
) -> Brightness:
    """Return the image of the same shadow maps, from many points in each pixel."""
    samples = _samples(sizes.image, 8)
    image = _drawn(scene, setup, sizes, layout, shading, samples, antialias=True)
    return _pooled(image.color, samples)


def _drawn(
    scene: Scene,
    setup: Setup,
    sizes: Sizes,
    layout: Layout,
    shading: Shading,
    samples: int,
    *,
    shadows: Shadows = "maps",
    antialias: bool = False,
) -> Rendering:
    height, width = sizes.image
    return render_scene(
        scene._replace(mesh=setup.mesh, camera=setup.camera, lights=setup.lights),
        image_size=(samples * height, samples * width),
        map_size=sizes.map,
        bias=setup.bias,
        filter=setup.filter,
        compare=setup.compare,
        shading=shading,
        layout=layout,
        shadows=shadows,
        antialias=antialias,
    )


def _samples(image_size: tuple[int, int], most: int) -> int:
    """Return how many points there are on each side of a pixel."""
    return int(np.clip(_LARGEST // max(image_size), 1, most))


def _pooled(color: Float[Array, "rows columns 3"], samples: int) -> Brightness:
    """Return the mean brightness of each pixel's points."""
    rows, columns, _ = color.shape
    points = np.asarray(color, np.float64).reshape(
        rows // samples, samples, columns // samples, samples, 3
    )
    return points.mean(axis=(1, 3, 4))


def _boxes(image: Brightness) -> Float[np.ndarray, "rows columns"]:
    """Return means over boxes of pixels, whole ones if there are any."""
    height, width = (min(_BOX, size) for size in image.shape)
    rows, columns = image.shape[0] // height, image.shape[1] // width
    whole = image[: rows * height, : columns * width]
    return whole.reshape(rows, height, columns, width).mean(axis=(1, 3))
