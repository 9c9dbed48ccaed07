"""Biases that compare each texel with the receiver's plane there, not with the receiver.

Over the reach of a filter the plane of a slanted face rises and falls by more than a
texel's own error; one depth for all texels needs a bias that grows with the filter. These
follow the plane from the receiver to each texel's centre: on a plane nothing is left but
rounding, however wide the filter. The slope is that of the face, from its normal, not
from differences of neighbouring pixels.
"""

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp

from .bias import Bias, Unit, in_world, length_field, unit_field
from .shadow_map import PlaneSlope, Receiver
from .transforms import Scalar


class ReceiverPlaneBias(Bias):
    """Compare each texel with the depth of the receiver's plane at that texel.

    Exact on planes. Where the filter reaches over an edge the plane is not the surface:
    on the lit side of a concave edge it darkens, on that of a convex one it leaks.

    Attributes:
        strength: Share of the plane's slope that is followed; 0 for none, 1 for all.

    References:
        J. Isidoro, "Shadow Mapping: GPU-based Tips and Techniques", GDC 2006.
    """

    follows_plane: ClassVar[bool] = True
    strength: Scalar = eqx.field(default=1.0, metadata={"unit": "share"})

    def __call__(self, receiver: Receiver, reach: Scalar = 0.5) -> Receiver:
        """Return the receiver with its plane followed both ways."""
        return _rounded(receiver._replace(plane=PlaneSlope(self.strength, self.strength)), reach)


class AdaptiveBias(Bias):
    """Compare each texel with the nearer of the receiver and its plane at that texel.

    The plane meets the ray through the texel's centre where the receiver's own surface may
    have been drawn: exact on planes, and never darker than without a bias. The tolerance is
    a length along the ray, the same at every distance, where the source derives one from
    the depth buffer.

    Attributes:
        tolerance: What is left to curvature: the inside of a bowl lies before its planes.
        unit: Of ``tolerance``.

    References:
        H. Dou, Y. Yan, E. Kerzner, Z. Dai, C. Wyman, "Adaptive Depth Bias for Shadow Maps",
        JCGT 3(4), 2014, section 3.
    """

    follows_plane: ClassVar[bool] = True
    tolerance: Scalar = length_field(0.3)
    unit: Unit = unit_field("texel")

    def __call__(self, receiver: Receiver, reach: Scalar = 0.5) -> Receiver:
        """Return the receiver with its plane followed where it comes nearer."""
        moved = receiver._replace(plane=PlaneSlope(1.0, 0.0))
        length = in_world(self.tolerance, self.unit, receiver, reach)
        return _rounded(moved.toward_light(length), reach)


def _rounded(receiver: Receiver, reach: Scalar) -> Receiver:
    """Favor light by what rounding leaves of a comparison with a plane.

    Beside the depth's own rounding, that of the place in the map times the slope.
    """
    place = receiver.place_resolution + reach * jnp.finfo(receiver.depth.dtype).eps
    slope = jnp.abs(receiver.depth_per_column) + jnp.abs(receiver.depth_per_row)
    return receiver.less_depth(receiver.depth_resolution + 2 * place * slope)
