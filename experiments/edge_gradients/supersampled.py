"""The image that rays see, from many points in each pixel: truth for gradients by differences.

Grids of points may be laid over each other, each a little aside of the others (by the sequence of
M. Roberts, "The Unreasonable Effectiveness of Quasirandom Sequences", 2018): an edge along rows or
columns does not meet all of a row of points at once.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from shadows import Light, PerspectiveCamera, Surface, render_surface, shade
from shadows.transforms import Scalar
from tangentspace.mesh import Mesh

from ..truth.area import surface_share
from ..truth.rays import Occluders

_ASIDE = np.array([0.7548776662466927, 0.5698402909980532])


class _Aside(PerspectiveCamera):
    """A camera whose image is moved.

    Attributes:
        move: To the right and up; the image is 2 wide and high.
    """

    move: Float[Array | np.ndarray, "2"]

    def clip_from_world(self, aspect: Scalar) -> Float[Array, "4 4"]:
        """Return the camera's matrix, moved."""
        return jnp.eye(4).at[:2, 3].set(self.move) @ super().clip_from_world(aspect)


def supersampled(
    mesh: Mesh,
    camera: PerspectiveCamera,
    light: Light,
    *,
    image_size: tuple[int, int],
    samples: int,
    grid: int = 0,
) -> Float[np.ndarray, "height width 3"]:
    """Return the image, each pixel the mean over a grid of points.

    Args:
        mesh: World space; plain white.
        camera: The view.
        light: The light; its shadows by rays.
        image_size: Height and width in pixels.
        samples: Points on each side of a pixel.
        grid: Which of many grids; no two have a point in common.
    """
    height, width = image_size
    size = (samples * height, samples * width)
    move = 2 * (grid * _ASIDE % 1 - 0.5) / np.array(size[::-1])
    aside = _Aside(camera.view_from_world, camera.vertical_fov, camera.near, camera.far, move)
    surface = _see(mesh, aside, image_size=size)
    _, share = surface_share(surface, light, Occluders(mesh.positions, mesh.faces))
    color = _shade(surface, light, jnp.asarray(share, surface.position.dtype))
    return np.asarray(color).reshape(height, samples, width, samples, 3).mean(axis=(1, 3))


_see = jax.jit(render_surface, static_argnames="image_size")


@jax.jit
def _shade(
    surface: Surface, light: Light, share: Float[Array, "height width"]
) -> Float[Array, "height width 3"]:
    return shade(surface, [light], [share])
