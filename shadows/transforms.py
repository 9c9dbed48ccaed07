"""Matrices between world, view, clip and window space, and the cameras that hold them.

Conventions, used everywhere: world is right-handed with y up; matrices act on columns and
compose by eye, ``clip_from_world = clip_from_view @ view_from_world``; view space looks
along -z; normalized device coordinates (NDC) are OpenGL's, [-1, 1] on each axis; window
depth is ``0.5 * z_ndc + 0.5``; images have row 0 on top, pixel centres at half integers.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, Float

from tangentspace._math import safe_normalize

Vector = Float[Array | np.ndarray, "3"]
Scalar = Float[Array | np.ndarray, ""] | float


def look_at(position: Vector, target: Vector, up: Vector) -> Float[Array, "4 4"]:
    """Return ``view_from_world`` of an eye at ``position`` that looks at ``target``.

    Where ``up`` is (nearly) parallel to the line of sight, the axis least aligned with
    that line replaces it, so that every direction has a frame.

    Args:
        position: The eye, world space.
        target: The point looked at, world space; must differ from ``position``.
        up: Direction that appears upwards in the image, world space.

    Returns:
        A rigid transform; view space looks along -z.
    """
    dtype = jnp.result_type(position, jnp.float32)
    position, target, up = (jnp.asarray(vector, dtype) for vector in (position, target, up))
    back = safe_normalize(position - target)
    steep = jnp.sum(jnp.cross(safe_normalize(up), back) ** 2) < 1e-8
    other = jnp.eye(3, dtype=back.dtype)[jnp.argmin(jnp.abs(back))]
    right = safe_normalize(jnp.cross(jnp.where(steep, other, up), back))
    rotation = jnp.stack([right, jnp.cross(back, right), back])
    top = jnp.concatenate([rotation, -(rotation @ position)[:, None]], axis=1)
    return jnp.concatenate([top, jnp.array([[0, 0, 0, 1]], top.dtype)])


def perspective(
    vertical_fov: Scalar, aspect: Scalar, near: Scalar, far: Scalar
) -> Float[Array, "4 4"]:
    """Return ``clip_from_view`` of a pinhole camera, as OpenGL's ``gluPerspective``.

    Args:
        vertical_fov: Full vertical angle of view, radians.
        aspect: Width over height.
        near: Distance of the near plane, > 0.
        far: Distance of the far plane, > ``near``.
    """
    focal = 1.0 / jnp.tan(0.5 * jnp.asarray(vertical_fov))
    near, far = jnp.asarray(near), jnp.asarray(far)
    zero, one = jnp.zeros_like(focal), jnp.ones_like(focal)
    return jnp.stack(
        [
            jnp.stack([focal / aspect, zero, zero, zero]),
            jnp.stack([zero, focal, zero, zero]),
            jnp.stack([zero, zero, (near + far) / (near - far), 2 * near * far / (near - far)]),
            jnp.stack([zero, zero, -one, zero]),
        ]
    )


def orthographic(
    left: Scalar, right: Scalar, bottom: Scalar, top: Scalar, near: Scalar, far: Scalar
) -> Float[Array, "4 4"]:
    """Return ``clip_from_view`` of a parallel projection, as OpenGL's ``glOrtho``.

    Args:
        left: View-space x that maps to NDC -1.
        right: View-space x that maps to NDC +1.
        bottom: View-space y that maps to NDC -1.
        top: View-space y that maps to NDC +1.
        near: Distance along -z that maps to window depth 0.
        far: Distance along -z that maps to window depth 1.
    """
    low = jnp.stack([jnp.asarray(left), jnp.asarray(bottom), -jnp.asarray(near)])
    high = jnp.stack([jnp.asarray(right), jnp.asarray(top), -jnp.asarray(far)])
    scale = 2.0 / (high - low)
    matrix = jnp.diag(jnp.concatenate([scale, jnp.ones(1, scale.dtype)]))
    return matrix.at[:3, 3].set(-(high + low) / (high - low))


def texel_from_clip(height: int, width: int, *, dtype: DTypeLike = float) -> Float[Array, "4 4"]:
    """Return the viewport: clip space to (column, row, window depth, 1) times w.

    The bias matrix of shadow mapping (NDC [-1, 1] to [0, 1]), with the image's size and
    row 0 on top: NDC (-1, 1, -1) goes to (0, 0, 0), NDC (1, -1, 1) to (width, height, 1).
    """
    scale = jnp.array([0.5 * width, -0.5 * height, 0.5], dtype)
    offset = jnp.array([0.5 * width, 0.5 * height, 0.5, 1.0], dtype)
    return jnp.diag(jnp.pad(scale, (0, 1))).at[:, 3].set(offset)


def transform_points(
    matrix: Float[Array, "4 4"], points: Float[Array | np.ndarray, "... 3"]
) -> Float[Array, "... 4"]:
    """Apply a matrix to points (w = 1) and keep all four coordinates."""
    # On an accelerator a product of matrices would be rounded to fewer bits.
    return jnp.matmul(points, matrix[:, :3].T, precision="highest") + matrix[:, 3]


class PerspectiveCamera(eqx.Module):
    """A pinhole camera; its image's aspect ratio is given when the matrix is asked for.

    Attributes:
        view_from_world: Rigid transform; view space looks along -z.
        vertical_fov: Full vertical angle of view, radians.
        near: Distance of the near plane, > 0.
        far: Distance of the far plane.
    """

    view_from_world: Float[Array | np.ndarray, "4 4"]
    vertical_fov: Scalar
    near: Scalar
    far: Scalar

    def clip_from_world(self, aspect: Scalar) -> Float[Array, "4 4"]:
        """Return the matrix for an image of ``aspect`` = width / height."""
        return perspective(self.vertical_fov, aspect, self.near, self.far) @ self.view_from_world

    def to_camera(self, positions: Float[Array, "... 3"]) -> Float[Array, "... 3"]:
        """Return unit vectors from world-space positions to the eye."""
        rotation, translation = self.view_from_world[:3, :3], self.view_from_world[:3, 3]
        return safe_normalize(-(rotation.T @ translation) - positions)


class OrthographicCamera(eqx.Module):
    """A camera of parallel rays.

    Attributes:
        view_from_world: Rigid transform; view space looks along -z.
        half_height: Half of the image's height, world units.
        near: Distance along the line of sight that maps to window depth 0.
        far: Distance along the line of sight that maps to window depth 1.
    """

    view_from_world: Float[Array | np.ndarray, "4 4"]
    half_height: Scalar
    near: Scalar
    far: Scalar

    def clip_from_world(self, aspect: Scalar) -> Float[Array, "4 4"]:
        """Return the matrix for an image of ``aspect`` = width / height."""
        half_height = jnp.asarray(self.half_height)
        half_width = half_height * aspect
        clip_from_view = orthographic(
            -half_width, half_width, -half_height, half_height, self.near, self.far
        )
        return clip_from_view @ self.view_from_world

    def to_camera(self, positions: Float[Array, "... 3"]) -> Float[Array, "... 3"]:
        """Return the unit vector towards the viewer, the same at every position."""
        return jnp.broadcast_to(self.view_from_world[2, :3], positions.shape)


Camera = PerspectiveCamera | OrthographicCamera
