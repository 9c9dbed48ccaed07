"""Layouts: how many shadow maps serve a light, and which part of the scene each one sees.

One map is the least and serves most scenes. A point light among what it lights wants the
six sides of a cube, a sun over a deep view several maps of growing size. Each map is drawn
wider than its part by the reach of the filter, so a lookup never leaves the map that it
began in: no seams, under any filter. A new layout is a new subclass of ``Layout``.
"""

import abc
import itertools

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ._checks import check_field
from .lights import DirectionalLight, Light, PointLight, Points
from .transforms import (
    Camera,
    Scalar,
    look_at,
    orthographic,
    perspective,
    transform_points,
)

_NEAREST = 2e-3  # near plane of a cube's maps, share of the farthest distance


class Layout(eqx.Module):
    """Which maps a light has."""

    @abc.abstractmethod
    def matrices(
        self,
        light: Light,
        points: Points,
        camera: Camera,
        *,
        aspect: float,
        map_size: int,
        reach: Scalar,
    ) -> Float[Array, "*maps 4 4"]:
        """Return ``clip_from_world`` of each map; of one map without the leading axis.

        Args:
            light: The light.
            points: What is lit and casts, world space.
            camera: The view that will look the maps up.
            aspect: Width over height of that view.
            map_size: Texels on each side of a map.
            reach: Of the filter, texels.

        Raises:
            ValueError: If the light is of a kind that the layout does not serve, or the
                filter reaches too far for the size of the maps.
        """


class SingleLayout(Layout):
    """One map, fitted to the scene."""

    def matrices(
        self,
        light: Light,
        points: Points,
        camera: Camera,
        *,
        aspect: float,
        map_size: int,
        reach: Scalar,
    ) -> Float[Array, "4 4"]:
        """Return the light's own matrix."""
        return light.clip_from_world(points)


class CubeLayout(Layout):
    """Six maps on the sides of a cube round a point light."""

    def matrices(
        self,
        light: Light,
        points: Points,
        camera: Camera,
        *,
        aspect: float,
        map_size: int,
        reach: Scalar,
    ) -> Float[Array, "6 4 4"]:
        """Return six perspective matrices of a little more than a right angle."""
        if not isinstance(light, PointLight):
            kind = type(light).__name__
            raise ValueError(
                f"CubeLayout: expected a PointLight, got a {kind}; one map serves that"
            )
        half_angle = jnp.arctan(_widened("CubeLayout", map_size, reach))
        offsets = jnp.asarray(points) - jnp.asarray(light.position)
        farthest = jnp.max(jnp.sum(offsets**2, axis=1)) ** 0.5
        far = jnp.where(farthest > 0, 1.01 * farthest, 1.0)
        clip_from_view = perspective(2 * half_angle, 1.0, _NEAREST * far, far)
        axes = [sign * axis for axis in np.eye(3) for sign in (1.0, -1.0)]
        ups = [np.eye(3)[2 if axis[1] else 1] for axis in axes]
        views = [
            look_at(light.position, light.position + axis, up)
            for axis, up in zip(axes, ups, strict=True)
        ]
        return jnp.stack([jnp.matmul(clip_from_view, v, precision="highest") for v in views])


class CascadesLayout(Layout):
    """Several maps for parallel light over a deep view, small near the eye and large afar.

    Stable under camera motion: a map keeps its size and turn, and moves by whole texels, so
    edges of shadows do not crawl.

    Attributes:
        count: Maps.
        spread: How the view's depth is cut: 0 in equal parts, 1 in equal ratios.

    References:
        F. Zhang, H. Sun, L. Xu, L. Lun, "Parallel-Split Shadow Maps for Large-scale Virtual
        Environments", VRCIA 2006 (the split); M. Valient, "Stable Rendering of Cascaded
        Shadow Maps", ShaderX6, 2008.
    """

    count: int = eqx.field(static=True, default=3, metadata={"whole": "maps"})
    spread: Scalar = eqx.field(default=0.75, metadata={"unit": "share"})

    def __check_init__(self) -> None:
        """Refuse a count that is not from 1 to 8."""
        check_field(self, "count", "from 1 to 8", lambda count: 1 <= count <= 8, whole=True)

    def matrices(
        self,
        light: Light,
        points: Points,
        camera: Camera,
        *,
        aspect: float,
        map_size: int,
        reach: Scalar,
    ) -> Float[Array, "maps 4 4"]:
        """Return an orthographic matrix for each part of the view's depth."""
        if not isinstance(light, DirectionalLight):
            kind = type(light).__name__
            raise ValueError(
                f"CascadesLayout: expected a DirectionalLight, got a {kind}; one map serves that"
            )
        wider = _widened("CascadesLayout", map_size, reach)
        points = jnp.asarray(points)
        # About the world's origin, so that the grid of texels stays while the eye moves.
        view_from_world = look_at(
            jnp.asarray(light.direction), np.zeros(3), np.array([0.0, 1.0, 0.0])
        )
        heights = transform_points(view_from_world, points)[:, 2]
        padding = 0.005 * (jnp.max(heights) - jnp.min(heights)) + 1e-4
        near, far = -jnp.max(heights) - padding, -jnp.min(heights) + padding
        ends = self._ends(camera, points)
        matrices = []
        for first, last in itertools.pairwise(ends):
            centre, radius = _slice_sphere(camera, aspect, first, last)
            half = _coarse(radius * wider, 6)
            texel = 2 * half / map_size
            place = transform_points(view_from_world, centre)[:2]
            x, y = jnp.floor(place / texel) * texel
            box = orthographic(x - half, x + half, y - half, y + half, near, far)
            matrices.append(jnp.matmul(box, view_from_world, precision="highest"))
        return jnp.stack(matrices)

    def _ends(self, camera: Camera, points: Float[Array, "points 3"]) -> list[Array]:
        """Return where the view's depth is cut, up to the farthest point of the scene.

        That is taken coarsely and all around, or each turn of the eye would change the sizes.
        """
        near, far = jnp.asarray(camera.near), jnp.asarray(camera.far)
        view = transform_points(jnp.asarray(camera.view_from_world), points)[:, :3]
        farthest = _coarse(jnp.max(jnp.sum(view**2, axis=1)) ** 0.5, 3)
        far = jnp.clip(farthest, 1.001 * near, far)
        first = jnp.maximum(near, 1e-3 * far)
        shares = np.arange(1, self.count + 1) / self.count
        ratio, equal = (
            [first * (far / first) ** s for s in shares],
            [first + (far - first) * s for s in shares],
        )
        cuts = [self.spread * r + (1 - self.spread) * e for r, e in zip(ratio, equal, strict=True)]
        return [near, *cuts]


def _coarse(length: Array, bits: int) -> Array:
    """Return the next larger of few lengths, which changes only where the length changes much."""
    _, exponent = jnp.frexp(length)
    unit = jnp.ldexp(jnp.ones_like(length), exponent - bits)
    return jnp.ceil(length / unit + 1e-3) * unit


def _widened(name: str, map_size: int, reach: Scalar) -> Scalar:
    """Return by what factor a map is wider than its part, for the filter to stay inside."""
    if isinstance(reach, int | float) and not 2 * (reach + 1) < map_size:
        raise ValueError(
            f"{name}: expected a filter that reaches less than half a map of {map_size} texels, "
            f"got {reach:g}; choose larger maps or a narrower filter"
        )
    return map_size / (map_size - 2 * (reach + 1))


def _slice_sphere(
    camera: Camera, aspect: float, first: Array, last: Array
) -> tuple[Float[Array, "3"], Float[Array, ""]]:
    """Return centre and radius of a sphere round the part of a view between two depths."""
    world_from_clip = jnp.linalg.inv(camera.clip_from_world(aspect))
    signs = [(x, y) for x in (-1.0, 1.0) for y in (-1.0, 1.0)]
    near, far = jnp.asarray(camera.near), jnp.asarray(camera.far)
    corners = []
    for x, y in signs:
        ends = []
        for z in (-1.0, 1.0):
            corner = world_from_clip @ jnp.array([x, y, z, 1.0], world_from_clip.dtype)
            ends.append(corner[:3] / corner[3])
        for depth in (first, last):
            corners.append(ends[0] + (depth - near) / (far - near) * (ends[1] - ends[0]))
    corners = jnp.stack(corners)
    centre = jnp.mean(corners, axis=0)
    return centre, jnp.max(jnp.sum((corners - centre) ** 2, axis=1)) ** 0.5
