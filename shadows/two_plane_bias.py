"""A bias by two planes, the receiver's and the caster's: folds and contacts need no more."""

from typing import ClassVar

import equinox as eqx

from .bias import Bias
from .plane_bias import ReceiverPlaneBias
from .shadow_map import Casters, Receiver, ShadowMap
from .transforms import Scalar


class TwoPlaneBias(Bias):
    """Compare each texel with the receiver's plane there, and its own plane with the receiver.

    Lit is what either finds lit, each at a place where one of the planes was truly seen. Of two
    faces that meet, over a ridge the one that is lit lies behind the receiver's plane; in a
    valley its plane lies behind the receiver. So where two planes meet nothing is darkened,
    without a depth to choose, and where a caster stands on its receiver no more light leaks
    than under ``ReceiverPlaneBias``, as a face counts no deeper than its farthest vertex.
    Curved surfaces and corners of more planes are left to the tolerance.

    The map keeps three numbers more for each texel (nine where edges have derivatives).

    Attributes:
        tolerance: What is added, in texel footprints (half texels) of the receiver's plane.

    References:
        C. Schueler, "Eliminating Surface Acne with Gradient Shadow Mapping", ShaderX4, 2006
        (the caster's plane); J. Isidoro, "Shadow Mapping: GPU-based Tips and Techniques", GDC
        2006 (the receiver's).
    """

    casters: ClassVar[Casters] = "planes"
    follows_plane: ClassVar[bool] = True
    tolerance: Scalar = eqx.field(default=0.5, metadata={"unit": "texel footprints"})

    def prepare(self, shadow_map: ShadowMap) -> ShadowMap:
        """Return the map.

        Raises:
            ValueError: If it keeps no planes.
        """
        if shadow_map.planes is None:
            raise ValueError(
                "TwoPlaneBias: expected a map with planes "
                "(render_shadow_map(..., casters='planes')), got one without"
            )
        return shadow_map

    def __call__(self, receiver: Receiver, reach: Scalar = 0.5) -> Receiver:
        """Return the receiver with its plane followed both ways."""
        moved = receiver.less_depth(self.tolerance * receiver.footprint)
        return ReceiverPlaneBias()(moved, reach)
