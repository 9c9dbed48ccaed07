"""A slide projector: a light whose color is an image, thrown by a camera that works backwards.

One matrix serves both: ``clip_from_world``, times the bias matrix that takes NDC [-1, 1] to
[0, 1], leads to the image's uvs (v upwards), and, rasterized, to the projector's own shadow
map, whose frame is the image's. So a texel of the map and the texel of the image at the same
share of the way across lie on the same ray.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from tangentspace._math import dot, safe_normalize
from tangentspace.texture import clamp, sample_bilinear

from ._checks import check_field
from .lights import Light, Points
from .transforms import Scalar, Vector, look_at, perspective

_LEAST_DEPTH = 1e-12  # in front of the projector; the square of its inverse is a float32


class Projector(Light):
    """A light at a point that throws an image; its brightness does not fall with distance.

    The image is as wide as its pixels say, each as wide as it is high. Between pixel centres
    it is blended; over the outer half of the pixels at its border it fades to nothing, so that
    what arrives is continuous. Nothing arrives outside the image, at the projector or behind it.

    Attributes:
        position: World space.
        direction: Unit vector from the projector through the image's middle.
        image: Linear RGB, or gray in one channel, that arrives; row 0 on top.
        vertical_fov: Full vertical angle of the image, radians, below pi.
        up: Direction that appears upwards in the image, world space.
        color: Linear RGB, multiplied with the image.

    Differentiability:
        Linear in the image and the color; in the pose and the positions continuous, and smooth
        between the lines through pixel centres. Zero outside the image.

    References:
        C. Everitt, "Projective Texture Mapping", NVIDIA, 2001.
    """

    position: Vector
    direction: Vector
    image: Float[Array | np.ndarray, "height width channels"]
    vertical_fov: Scalar = np.pi / 6
    up: Vector = eqx.field(default_factory=lambda: np.array([0, 1, 0], np.float32))
    color: Vector = eqx.field(default_factory=lambda: np.ones(3, np.float32))

    def __check_init__(self) -> None:
        """Refuse an image that is none, and an angle that no image has."""
        shape = jnp.shape(self.image)
        if len(shape) != 3 or 0 in shape or shape[2] not in (1, 3):
            raise ValueError(
                f"Projector: expected `image` of shape (height, width, 3 or 1), got {shape}"
            )
        check_field(self, "vertical_fov", "between 0 and pi", lambda angle: 0 < angle < np.pi)

    def to_light(self, positions: Float[Array, "... 3"]) -> Float[Array, "... 3"]:
        """Return unit vectors towards the projector's position."""
        return safe_normalize(self.position - positions)

    def radiance(self, positions: Float[Array, "... 3"]) -> Float[Array, "... 3"]:
        """Return the image at each position, times the color; 0 where no image falls."""
        # The depths of the frustum do not matter to x, y and w.
        across, up, _, forward = self._clip_from_world(1.0, 2.0)
        x, y, w = (dot(positions, row[:3]) + row[3] for row in (across, up, forward))
        inside = (w > _LEAST_DEPTH) & (jnp.abs(x) < w) & (jnp.abs(y) < w)
        x, y, w = jnp.where(inside, x, 0), jnp.where(inside, y, 0), jnp.where(inside, w, 1)
        u, v = 0.5 * (x / w) + 0.5, 0.5 * (y / w) + 0.5
        image = jnp.asarray(self.image)
        height, width = image.shape[:2]
        fade = _fade(u * width, width) * _fade(v * height, height)
        texels = sample_bilinear(image, jnp.stack([u, v], axis=-1), wrap_u=clamp, wrap_v=clamp)
        return jnp.where(inside, fade, 0.0)[..., None] * texels * self.color

    def clip_from_world(self, points: Points) -> Float[Array, "4 4"]:
        """Return the matrix of the image's frustum; its depths are those of the points."""
        distance = dot(points - jnp.asarray(self.position), safe_normalize(self.direction))
        farthest = jnp.max(distance)
        far = jnp.where(farthest > 0, 1.01 * farthest, 1.0)
        return self._clip_from_world(jnp.maximum(0.99 * jnp.min(distance), 1e-3 * far), far)

    def _clip_from_world(self, near: Scalar, far: Scalar) -> Float[Array, "4 4"]:
        """Return the matrix of a frustum that the image fills."""
        view_from_world = look_at(self.position, self.position + self.direction, self.up)
        height, width = jnp.shape(self.image)[:2]
        return perspective(self.vertical_fov, width / height, near, far) @ view_from_world


def _fade(place: Float[Array, "..."], size: int) -> Float[Array, "..."]:
    """Return the share that is left near the border: 0 there, 1 from half a pixel inside."""
    return jnp.clip(2 * jnp.minimum(place, size - place), 0, 1)
