"""Biases by the choice of the surfaces that cast: back faces, or a depth between two layers.

A lit surface cannot shade itself where the map holds a depth behind it. The price is paid
where the layers meet: at contacts and silhouettes, and by open meshes.
"""

from typing import ClassVar

import equinox as eqx

from .bias import Bias
from .shadow_map import Casters, Receiver, ShadowMap
from .transforms import Scalar


class FrontFaceCullingBias(Bias):
    """Draw only faces turned away from the light into the map.

    Wants closed meshes; leaks where a caster's back meets the receiver.
    """

    casters: ClassVar[Casters] = "back"

    def __call__(self, receiver: Receiver, reach: Scalar = 0.5) -> Receiver:
        """Return the receiver as it is."""
        return receiver


class MidpointBias(Bias):
    """Compare with a depth between the nearest surface and the one behind it.

    Where nothing lies behind, the far end of the map counts as the second surface.

    Attributes:
        share: How far to go from the first surface to the second.

    References:
        A. Woo, "The Shadow Depth Map Revisited", Graphics Gems III, 1992.
    """

    casters: ClassVar[Casters] = "two"
    reads_anew: ClassVar[bool] = True
    share: Scalar = eqx.field(default=0.5, metadata={"unit": "share"})

    def prepare(self, shadow_map: ShadowMap) -> ShadowMap:
        """Return a map of the depths between."""
        return _between(shadow_map, self.share)

    def __call__(self, receiver: Receiver, reach: Scalar = 0.5) -> Receiver:
        """Return the receiver as it is."""
        return receiver


class SecondDepthBias(Bias):
    """Compare with the surface behind the nearest one.

    References:
        Y. Wang, S. Molnar, "Second-Depth Shadow Mapping", UNC TR94-019, 1994.
    """

    casters: ClassVar[Casters] = "two"

    def prepare(self, shadow_map: ShadowMap) -> ShadowMap:
        """Return a map of the second depths."""
        return _between(shadow_map, 1.0)

    def __call__(self, receiver: Receiver, reach: Scalar = 0.5) -> Receiver:
        """Return the receiver as it is."""
        return receiver


def _between(shadow_map: ShadowMap, share: Scalar) -> ShadowMap:
    if shadow_map.second is None:
        raise ValueError(
            "bias: expected a map of two layers (render_shadow_map(..., casters='two')), got one"
        )
    between = lambda nearest, second: nearest + share * (second - nearest)
    depth = between(shadow_map.depth, shadow_map.second)
    neighbor = shadow_map.neighbor
    if neighbor is not None:
        neighbor = neighbor._replace(depth=between(neighbor.depth, neighbor.second))
    return shadow_map._replace(depth=depth, neighbor=neighbor)
