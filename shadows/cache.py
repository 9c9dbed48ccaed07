"""Shadow maps kept from image to image, and drawn again when a light or an object moved.

A map is a function of the geometry and of its matrix, and those are what is compared: a
camera that moves, a light's color or a bias leave every map as it is, and the cascades of
a moving camera are drawn again only when they move by a texel.
"""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from tangentspace.mesh import Mesh

from .layouts import Layout, SingleLayout
from .lights import Light
from .shadow_map import Casters, ShadowMap, render_shadow_map
from .transforms import Camera, Scalar


class _Kept(NamedTuple):
    drawn_from: tuple
    map: ShadowMap


class ShadowMapCache:
    """The maps of a scene's lights; for ``render(..., shadow_maps=cache.maps(...))``.

    Attributes:
        passes: Light passes made so far: one for each light whose maps were drawn.
    """

    def __init__(self) -> None:
        """Start empty."""
        self.passes = 0
        self._kept: dict[int, _Kept] = {}

    def maps(
        self,
        mesh: Mesh,
        camera: Camera,
        lights: Sequence[Light],
        *,
        map_size: int = 1024,
        layout: Layout = SingleLayout(),
        reach: Scalar = 1.0,
        casters: Casters = "nearest",
        aspect: float = 1.0,
    ) -> tuple[ShadowMap, ...]:
        """Return the map of each light, drawn now or kept.

        Args:
            mesh: World space.
            camera: The view, on which cascades depend.
            lights: The lights; each is compared with what stood at its place before.
            map_size: Texels on each side.
            layout: How many maps serve each light.
            reach: Of the filter, ``filter.reach()``.
            casters: Of the bias, ``bias.casters``.
            aspect: Width over height of the image.
        """
        found = []
        for place, light in enumerate(lights):
            matrix = _matrices(layout, light, mesh.positions, camera, reach, aspect, map_size)
            drawn_from = (mesh.positions, mesh.faces, matrix, map_size, casters)
            kept = self._kept.get(place)
            if kept is None or not _same(kept.drawn_from, drawn_from):
                self.passes += 1
                drawn = _draw(mesh.positions, mesh.faces, matrix, map_size, casters)
                kept = self._kept[place] = _Kept(drawn_from, drawn)
            found.append(kept.map)
        return tuple(found)


def _same(before: tuple, now: tuple) -> bool:
    """Compare what two maps were drawn from; arrays that are one object are not looked into."""
    return all(
        a is b or (np.shape(a) == np.shape(b) and bool(np.all(np.asarray(a) == np.asarray(b))))
        for a, b in zip(before, now, strict=True)
    )


@eqx.filter_jit
def _matrices(
    layout: Layout,
    light: Light,
    positions: Array | np.ndarray,
    camera: Camera,
    reach: Scalar,
    aspect: float,
    map_size: int,
) -> Float[Array, "*maps 4 4"]:
    return layout.matrices(light, positions, camera, aspect=aspect, map_size=map_size, reach=reach)


@eqx.filter_jit
def _draw(
    positions: Array | np.ndarray,
    faces: Array | np.ndarray,
    matrix: Float[Array, "*maps 4 4"],
    map_size: int,
    casters: Casters,
) -> ShadowMap:
    return render_shadow_map(positions, faces, matrix, map_size=map_size, casters=casters)
