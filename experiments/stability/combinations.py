"""The shadow techniques of the atlas: every filter, every bias, and those that should fail.

In parentheses stands what is not of the toolkit: the naive way that a row of the catalogue
warns of, to show that its metric sees it.
"""

from typing import NamedTuple

import jax.numpy as jnp

from shadows.bias import (
    AnalyticBias,
    Bias,
    CombinedBias,
    ConstantBias,
    NormalOffsetBias,
    SlopeBias,
)
from shadows.disc_filters import PoissonFilter
from shadows.exponential_filters import ESMFilter, EVSM2Filter, EVSM4Filter
from shadows.filters import Filter, NearestFilter
from shadows.four_moment_filter import MSMFilter
from shadows.layer_bias import FrontFaceCullingBias, MidpointBias, SecondDepthBias
from shadows.pcss_filter import PCSSFilter
from shadows.plane_bias import AdaptiveBias, ReceiverPlaneBias
from shadows.shadow_map import Receiver
from shadows.transforms import Scalar
from shadows.two_plane_bias import TwoPlaneBias
from shadows.variance_filter import VSMFilter
from shadows.visibility import default_bias
from shadows.window_filters import BilinearFilter, PCFFilter, TentFilter

CONSTANT = 0.1  # world length of the constant bias

FILTERS: dict[str, Filter] = {
    "nearest": NearestFilter(),
    "bilinear": BilinearFilter(),
    "pcf 5x5": PCFFilter(2),
    "pcf 9x9": PCFFilter(4),
    "tent": TentFilter(),
    "poisson": PoissonFilter(taps=8),
    "pcss": PCSSFilter(0.1, search_taps=8, taps=8, widest=8),
    "vsm": VSMFilter(),
    "esm": ESMFilter(),
    "evsm2": EVSM2Filter(),
    "evsm4": EVSM4Filter(),
    "msm": MSMFilter(),
}


_QUICK = ("nearest", "bilinear", "pcf 5x5", "vsm", "esm", "msm")


class LargerSlopeBias(Bias):
    """Favor light by the larger of the two slopes times the reach, as some hardware did.

    Attributes:
        share: Of that; no number of the toolkit's, so no command offers this bias.
    """

    share: Scalar = 1.0

    def __call__(self, receiver: Receiver, reach: Scalar = 0.5) -> Receiver:
        """Return the receiver with its depth lowered."""
        slopes = jnp.abs(receiver.depth_per_column), jnp.abs(receiver.depth_per_row)
        return receiver.less_depth(
            self.share * reach * jnp.maximum(*slopes) + receiver.depth_resolution
        )


class DepthUnitsBias(Bias):
    """Favor light by the same window depth everywhere.

    Attributes:
        depth: How much.
    """

    depth: Scalar = 0.0025

    def __call__(self, receiver: Receiver, reach: Scalar = 0.5) -> Receiver:
        """Return the receiver with its depth lowered."""
        return receiver.less_depth(jnp.asarray(self.depth, receiver.depth.dtype))


BIASES: dict[str, Bias] = {
    "none": CombinedBias(),
    "constant": ConstantBias(CONSTANT),
    "slope": SlopeBias(),
    "analytic": AnalyticBias(),
    "normal-offset": NormalOffsetBias(),
    "receiver-plane": ReceiverPlaneBias(),
    "adaptive": AdaptiveBias(),
    "two-plane": TwoPlaneBias(),
    "front-face-culling": FrontFaceCullingBias(),
    "midpoint": MidpointBias(),
    "second-depth": SecondDepthBias(),
}
NAIVE: dict[str, Bias] = {
    "(larger slope)": LargerSlopeBias(),
    "(depth units)": DepthUnitsBias(),
}


class Technique(NamedTuple):
    """A filter with a bias and a comparison.

    Attributes:
        filter: Its name.
        bias: Its name.
        softness: Of the comparison; 0 is the hard one.
        lighting: Name of the maps' layout, as of ``views.lightings``; None for the scene's own.
        exponent: Of an ESM, if not the default.
    """

    filter: str
    bias: str
    softness: float = 0.0
    lighting: str | None = None
    exponent: float | None = None

    @property
    def name(self) -> str:
        """As in tables."""
        parts = [self.filter if self.exponent is None else f"{self.filter} {self.exponent:g}"]
        parts += [self.bias] if self.bias != "none" else ["no bias"]
        parts += [f"soft {self.softness:g}"] if self.softness else []
        parts += [self.lighting] if self.lighting else []
        return ", ".join(parts)

    @property
    def unbiased(self) -> bool:
        """Whether depths are compared without a bias."""
        return self.bias == "none" and FILTERS[self.filter].compares

    @property
    def wide(self) -> bool:
        """Whether depths of more than 2x2 texels are compared."""
        return FILTERS[self.filter].wide and FILTERS[self.filter].compares

    def make(self) -> tuple[Bias, Filter]:
        """Return the bias and the filter."""
        made = FILTERS[self.filter] if self.exponent is None else ESMFilter(exponent=self.exponent)
        return (BIASES | NAIVE)[self.bias], made


def default_name(filter: str) -> str:
    """Return the name of a filter's default bias."""
    kind = type(default_bias(FILTERS[filter]))
    return next(name for name, bias in BIASES.items() if type(bias) is kind)


def combinations(*, quick: bool = False, several: bool = False) -> list[Technique]:
    """Return every filter with its default bias and with none, and every bias with two filters.

    Args:
        quick: Few filters, and each bias with one of them.
        several: For several maps: each filter with its default bias, each bias with one filter,
            and none of what takes seconds to compile there.
    """
    filters = _QUICK if quick else tuple(FILTERS)
    chosen = [Technique(filter, default_name(filter)) for filter in filters]
    if several:
        chosen = [one for one in chosen if one.filter != "pcf 9x9"]
        biases = [bias for bias in BIASES if bias != "normal-offset"]
        return list(dict.fromkeys(chosen + [Technique("bilinear", bias) for bias in biases]))
    chosen += [Technique(filter, "none") for filter in filters]
    for bias in BIASES:
        chosen += [Technique(filter, bias) for filter in ("bilinear", "pcf 5x5")[: 2 - quick]]
    if not quick:
        chosen += [Technique("pcf 9x9", "constant"), Technique("pcf 9x9", "slope")]
    chosen += [Technique("nearest", "(larger slope)"), Technique("bilinear", "(depth units)")]
    chosen += [Technique("bilinear", "analytic", softness) for softness in (0.5, 10.0)]
    chosen += [Technique("esm", "none", exponent=10.0)]
    return list(dict.fromkeys(chosen))
