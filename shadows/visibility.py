"""How much of a light arrives at what the eye sees, by its shadow map; and by which bias."""

import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from tangentspace._math import dot
from tangentspace._planes import in_planes

from .bias import AnalyticBias, Bias, CombinedBias
from .compare import Compare
from .filters import Filter
from .lights import Light
from .plane_bias import AdaptiveBias
from .shadow_map import Receiver, ShadowMap, choose_map, receive
from .surface import Surface
from .transforms import Scalar

Visibility = Float[Array, "height width"]


def receive_surface(
    surface: Surface, light: Light, shadow_map: ShadowMap, *, reach: Scalar = 0.0
) -> Receiver:
    """Locate the pixels of a view in a light's shadow map.

    Args:
        surface: What the eye sees.
        light: The light.
        shadow_map: Its map; of several images, each pixel goes to the first that holds it
            and all that the filter reads.
        reach: Of the filter, texels.
    """
    to_light = light.to_light(surface.position)
    index = choose_map(surface.position, shadow_map, reach=reach)
    matrix = shadow_map.texel_from_world
    return receive(surface.position, surface.face_normal, to_light, matrix, map_index=index)


@in_planes
def surface_visibility(
    surface: Surface,
    light: Light,
    shadow_map: ShadowMap,
    *,
    bias: Bias,
    filter: Filter,
    compare: Compare,
    prepared: PyTree = None,
) -> Float[Array, "height width"]:
    """Return the light's visibility at each pixel; 0 on faces turned away from the light.

    Args:
        surface: What the eye sees.
        light: The light.
        shadow_map: Its map.
        bias: Against self-shadowing.
        filter: How the map is asked.
        compare: Hard, or soft where derivatives are wanted.
        prepared: ``filter.prepare(bias.prepare(shadow_map))``, if it was kept.
    """
    check_techniques(bias, filter)
    filter = filter.for_light(light)
    reach = filter.reach()
    receiver = receive_surface(surface, light, shadow_map, reach=reach)
    facing = dot(receiver.normal, receiver.to_light) > 0
    moved = bias(receiver, reach)
    if prepared is None:
        prepared = filter.prepare(bias.prepare(shadow_map))
    visibility = filter.visibility(filter.read(prepared, moved), moved, compare)
    return jnp.where(facing & surface.covered, visibility, 0.0)


def facing_visibility(surface: Surface, light: Light) -> Visibility:
    """Return a light's visibility at each pixel if nothing blocks it: 1 on faces turned to it."""
    facing = dot(surface.face_normal, light.to_light(surface.position)) > 0
    return (facing & surface.covered).astype(surface.position.dtype)


def default_bias(filter: Filter) -> Bias:
    """Return the least bias that clears every plane of acne under a filter.

    In closed form for lookups of up to 2x2 texels and for those that compare no texels;
    following the receiver's plane for wider ones, where one depth for all texels would take
    away much shadow; none for filters that need none.
    """
    if not filter.needs_bias:
        return CombinedBias()
    return AdaptiveBias() if filter.compares and filter.wide else AnalyticBias()


def check_techniques(bias: Bias, filter: Filter) -> None:
    """Refuse a bias that means nothing to a filter.

    Raises:
        ValueError: If the bias follows the receiver's plane and the filter compares no texels.
    """
    if bias.follows_plane and not filter.compares:
        raise ValueError(
            f"bias: {_term_names(bias)} compares texel by texel, which {type(filter).__name__} "
            "does not; choose another bias or filter"
        )


def _term_names(bias: Bias) -> str:
    terms = bias.terms if isinstance(bias, CombinedBias) else (bias,)
    return " and ".join(type(term).__name__ for term in terms if term.follows_plane)
