"""Filters of scattered points in a disc round the receiver, the same for every receiver.

Each point is a 2x2 bilinear lookup, so that visibility is continuous in the receiver's
place and in the radius, which a fit can move.
"""

import functools

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ._checks import check_field
from .compare import Compare
from .filters import Filter, Tap, compare_taps
from .shadow_map import Receiver, ShadowMap
from .transforms import Scalar
from .window_filters import BilinearFilter

Taps = tuple[Tap, ...]


@functools.cache
def poisson_disc(count: int) -> Float[np.ndarray, "points 2"]:
    """Return points in the unit disc, each as far from the others as chance offers.

    Args:
        count: How many, at least 1.

    References:
        D. Mitchell, "Spectrally Optimal Sampling for Distribution Ray Tracing", SIGGRAPH 1991
        (the best of many candidates).
    """
    rng = np.random.default_rng(0)
    points = np.zeros((0, 2))
    for k in range(count):
        candidates = rng.uniform(-1, 1, (64 * (k + 1), 2))
        candidates = candidates[(candidates**2).sum(axis=1) <= 1]
        away = ((candidates[:, None] - points) ** 2).sum(axis=2).min(axis=1, initial=4.0)
        points = np.concatenate([points, candidates[[np.argmax(away)]]])
    # Neither shifts the shadow nor, as a kernel, is narrower than the disc it stands for.
    points = points - points.mean(axis=0)
    return points * np.sqrt(0.5 / (points**2).sum(axis=1).mean()) if count > 1 else points


def read_disc(
    shadow_map: ShadowMap,
    receiver: Receiver,
    points: Float[np.ndarray, "taps 2"],
    radius: Scalar | Float[Array, "*points"],
) -> Taps:
    """Read 2x2 texels round each point of a pattern.

    Args:
        shadow_map: The map.
        receiver: Where the disc's centre lies.
        points: The pattern, in the unit disc.
        radius: Of the disc, texels; one for all receivers or one for each.

    Returns:
        Four taps (of a map with shares eight), each with an axis for the points in front.
    """
    shape = (-1,) + (1,) * receiver.column.ndim
    across, down = (
        jnp.asarray(points[:, axis], receiver.column.dtype).reshape(shape) * radius
        for axis in (0, 1)
    )
    moved = receiver._replace(column=receiver.column + across, row=receiver.row + down)
    taps = BilinearFilter().read(shadow_map, moved)
    # From the receiver, not from the point: that is what its plane is followed along.
    return tuple(tap._replace(across=tap.across + across, down=tap.down + down) for tap in taps)


class PoissonFilter(Filter):
    """The mean of 2x2 bilinear lookups at points scattered in a disc.

    The pattern is fixed: bands where it is coarse, no noise.

    Attributes:
        radius: Of the disc.
        taps: Points.

    Differentiability:
        In the radius and the receiver's place, where bilinear lookup is.
    """

    radius: Scalar = eqx.field(default=2.0, metadata={"unit": "texels"})
    taps: int = eqx.field(static=True, default=16, metadata={"whole": "points"})

    def __check_init__(self) -> None:
        """Refuse a negative radius, and numbers of taps out of range."""
        check_field(self, "radius", "of at least 0", lambda radius: radius >= 0)
        check_field(self, "taps", "from 1 to 128", lambda taps: 1 <= taps <= 128, whole=True)

    def reach(self) -> Scalar:
        """Return the radius and one texel."""
        return self.radius + 1.0

    def read(self, prepared: ShadowMap, receiver: Receiver) -> Taps:
        """Read all points."""
        return read_disc(prepared, receiver, poisson_disc(self.taps), self.radius)

    def visibility(
        self, reading: Taps, receiver: Receiver, compare: Compare
    ) -> Float[Array, "*points"]:
        """Return the mean over the points."""
        return jnp.mean(compare_taps(reading, receiver, compare), axis=0)
