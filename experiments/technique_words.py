"""The command-line options that name techniques, and the techniques that they name."""

from collections.abc import Sequence
from typing import Annotated

import tyro

from shadows.area_lights import AreaLight
from shadows.bias import Bias, CombinedBias
from shadows.compare import Compare
from shadows.filters import Filter
from shadows.layouts import CubeLayout, Layout, SingleLayout
from shadows.visibility import check_techniques, default_bias
from tangentspace.shading import Shading

from .checks import stands_inside
from .options import describe, parse_technique, parse_techniques
from .scene import Scene

BiasWords = Annotated[
    tuple[str, ...] | None,
    tyro.conf.arg(
        metavar="NAME[=VALUE]",
        help="Biases, one after another; no word for no bias. " + "; ".join(describe(Bias)) + ".",
        help_behavior_hint="(default: analytic; adaptive for filters wider than 2x2 texels; "
        "none for filters that need none)",
    ),
]
CompareWords = Annotated[
    tuple[str, ...],
    tyro.conf.arg(
        metavar="NAME[=VALUE]",
        help="Comparison, for filters that compare. " + "; ".join(describe(Compare)) + ".",
        help_behavior_hint="(default: hard)",
    ),
]
LayoutWords = Annotated[
    tuple[str, ...],
    tyro.conf.arg(
        metavar="NAME[=VALUE]",
        help="Shadow maps of a light. " + "; ".join(describe(Layout)) + ".",
        help_behavior_hint="(default: cube for a point light inside the scene, else single)",
    ),
]
FilterWords = Annotated[
    tuple[str, ...],
    tyro.conf.arg(
        metavar="NAME[.OPTION=VALUE]",
        help="Lookup; its options also as --filter.OPTION VALUE. "
        + "; ".join(describe(Filter))
        + ".",
        help_behavior_hint="(default: bilinear)",
    ),
]
ShadingWords = Annotated[
    tuple[str, ...],
    tyro.conf.arg(
        metavar="NAME[.NUMBER=VALUE]",
        help="Lighting model of the picture. " + "; ".join(describe(Shading)) + ".",
    ),
]


def parse_bias(words: Sequence[str] | None, filter: Filter) -> CombinedBias:
    """Make the bias that ``--bias`` names, or the default one of a filter.

    Raises:
        ValueError: If a word is not understood, or means nothing to the filter.
    """
    if words is None:
        return CombinedBias((default_bias(filter),))
    terms = CombinedBias(parse_techniques(Bias, words, option="--bias"))
    check_techniques(terms, filter)
    return terms


def choose_layout(scene: Scene, words: Sequence[str]) -> Layout:
    """Make the layout that ``--layout`` names, or the least that serves a scene's lights.

    Raises:
        ValueError: If the words are not understood.
    """
    if words:
        return parse_technique(Layout, words, option="--layout", least=0.0)
    inside = any(stands_inside(scene, light) for light in scene.lights)
    return CubeLayout() if inside else SingleLayout()


def least_filter(scene: Scene) -> tuple[str, ...]:
    """Return what ``--filter`` takes for the least filter that serves most scenes of a kind.

    For hard lights 2x2 texels, and for area lights few taps that look for the blocker:
    ``python -m experiments.simplest.evidence`` compares all there are.
    """
    soft = any(isinstance(light, AreaLight) for light in scene.lights)
    return ("pcss", ".taps=8", ".search_taps=8") if soft else ("bilinear",)


def parse_lookup(filter: Sequence[str], compare: Sequence[str]) -> tuple[Filter, Compare]:
    """Make the filter and the comparison that ``--filter`` and ``--compare`` name.

    Raises:
        ValueError: If they are not understood, or mean nothing to each other.
    """
    lookup = parse_technique(Filter, filter or ["bilinear"], option="--filter")
    if compare and not lookup.compares:
        raise ValueError(f"--compare: --filter {filter[0]} compares no depths; drop one of them")
    return lookup, parse_technique(Compare, compare or ["hard"], option="--compare", least=0.0)


def parse_shading(words: Sequence[str]) -> Shading:
    """Make the lighting model that the words of ``--shading`` name.

    Raises:
        ValueError: If they name none, or several, or are not understood.
    """
    return parse_technique(Shading, words, option="--shading")
