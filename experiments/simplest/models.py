"""What there is to choose from: every filter, size of map and bias, with and without normal map.

A model is named by words that ``render`` takes. Numbers of biases are those of theory: a
bias in reaches of the filter is enough, or not, on a plane whatever the filter's size.
"""

import functools
from collections.abc import Iterator, Sequence
from typing import NamedTuple

from shadows.filters import Filter
from shadows.layouts import CubeLayout, Layout

from ..frontier.methods import Method, methods
from ..options import parse_technique

MAP_SIZES = (128, 256, 512, 1024, 2048)
LOOKS = ("plain", "normal map")


class Model(NamedTuple):
    """A way to make an image of a scene.

    Attributes:
        look: ``plain``, without normal maps, or ``normal map``, with them and their mips.
        filter: Name of a filter with its size, ``pcf 5x5``; none for no shadows.
        map_size: Texels on each side of a shadow map; 0 for no shadows.
        bias: Name of a bias; ``none``, ``constant``, ``slope``, ``slope, constant`` or
            ``adaptive``.
    """

    look: str
    filter: str = ""
    map_size: int = 0
    bias: str = "none"

    @property
    def name(self) -> str:
        """As in tables; tells models of a scene apart."""
        shadows = "no shadows"
        if self.filter:
            bias = "" if self.bias == "none" else f", {self.bias} bias"
            shadows = f"{self.filter} @ {self.map_size}{bias}"
        return shadows if self.look == "plain" else f"{shadows}, normal map"


@functools.cache
def filters(techniques: tuple[str, ...] = ()) -> dict[str, Method]:
    """Return filters by their names with sizes; their words are ``render``'s.

    Args:
        techniques: Names without sizes; none for all.

    Raises:
        ValueError: If there is no filter of a name.
    """
    return {method.label: method for method in methods(techniques)}


def biases_for(filter: Filter) -> tuple[str, ...]:
    """Return the names of biases that suit a filter, from the least on.

    No bias at all only where it may do: wide filters shade every slope themselves. Following
    the plane only where one depth serves badly.
    """
    if not filter.needs_bias:
        return ("none",)
    if filter.compares and filter.wide:
        return ("constant", "slope", "adaptive")
    return ("none", "constant", "slope", "slope, constant")


def bias_words(name: str, slope: float) -> tuple[str, ...]:
    """Return what ``--bias`` takes.

    Args:
        name: Of a bias.
        slope: For the constant one: the length along the light's ray that lit surfaces gain
            over a length of the map, which is how many reaches it must be.
    """
    return {
        "none": (),
        "constant": (f"constant={slope:.3g}", "constant.unit=reach"),
        "slope": ("analytic",),
        "slope, constant": ("analytic", "constant=0.3", "constant.unit=texel"),
        "adaptive": ("adaptive",),
    }[name]


def all_models(looks: Sequence[str], layout: Layout, techniques: Sequence[str] = ()) -> list[Model]:
    """Return every model: each look without shadows, and with each filter, size and bias.

    Args:
        looks: Those that the scene has.
        layout: How many maps serve its lights; filters that reach too far for it are left out.
        techniques: Names of filters; none for all.

    Raises:
        ValueError: If there is no filter of a name.
    """
    shadows = list(_shadows(layout, tuple(techniques)))
    return [Model(look, *rest) for look in looks for rest in [(), *shadows]]


def _shadows(layout: Layout, techniques: tuple[str, ...]) -> Iterator[tuple[str, int, str]]:
    """Return filter, size and bias of every model with shadows."""
    for name, method in filters(techniques).items():
        filter = parse_technique(Filter, method.words, option="--filter")
        for map_size in MAP_SIZES:
            most = 0.5 * map_size - 1 if isinstance(layout, CubeLayout) else map_size
            if float(filter.reach()) < most:
                for bias in biases_for(filter):
                    yield name, map_size, bias
