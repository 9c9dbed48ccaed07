"""Biases against self-shadowing: each moves the receiver in favor of light.

A shadow map stores one depth per texel; between texel centres a slanted surface is deeper
than what was stored, and shades itself (acne). A bias b removes it once b is at least the
depth that the surface gains within the reach of the lookup, and takes away true shadow
within b of each caster (peter-panning). Every number has a unit that a scene gives meaning
to, and that can be chosen: world lengths, texels, or the reach of the filter, in which the
same number serves a narrow and a wide one. None is in units of the depth buffer.

A new bias is a new subclass of ``Bias``: its fields are leaves that a fit can move, with
their unit in ``field(metadata={"unit": ...})``. Biases that follow the receiver's plane are
in ``plane_bias`` and ``two_plane_bias``, those that choose which surfaces cast in ``layer_bias``.
"""

import abc
from typing import Any, ClassVar, Literal

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from tangentspace._math import dot

from .shadow_map import Casters, Receiver, ShadowMap
from .transforms import Scalar

Unit = Literal["world", "texel", "reach"]
_LENGTHS = {"world": "world length", "texel": "texel widths", "reach": "reaches of the filter"}
_GAINS = _LENGTHS | {"texel": "texel footprints"}


def length_field(default: float) -> Any:
    """Return the field of a bias that is a length in one of the units."""
    return eqx.field(default=default, metadata={"unit": _LENGTHS})


def unit_field(default: Unit) -> Any:
    """Return the field of a bias that says what its number is measured in."""
    return eqx.field(static=True, default=default, metadata={"choices": tuple(_LENGTHS)})


class Bias(eqx.Module):
    """A way to favor light at a receiver.

    Attributes:
        casters: Which surfaces it wants in the shadow map.
        reads_anew: Whether other texels, or other depths, are read when its numbers change.
        follows_plane: Whether it needs a comparison at each texel.
    """

    casters: ClassVar[Casters] = "nearest"
    reads_anew: ClassVar[bool] = False
    follows_plane: ClassVar[bool] = False

    def prepare(self, shadow_map: ShadowMap) -> ShadowMap:
        """Return the map that receivers are compared with."""
        return shadow_map

    @abc.abstractmethod
    def __call__(self, receiver: Receiver, reach: Scalar = 0.5) -> Receiver:
        """Return the receiver, moved.

        Args:
            receiver: A point in the map.
            reach: Texels from it to the farthest texel centre that the filter reads along
                either axis; 0.5 for nearest lookup, 1 for 2x2 bilinear.
        """


def in_world(
    length: Scalar, unit: Unit, receiver: Receiver, reach: Scalar
) -> Scalar | Float[Array, "*points"]:
    """Return a length of the given unit as a world length."""
    if unit == "world":
        return length
    return length * receiver.texel_length * (reach if unit == "reach" else 1.0)


class ConstantBias(Bias):
    """Move along the light ray by the same length everywhere.

    Peter-panning law: on a floor whose normal makes the angle t with the light, a caster
    of thickness W along the light's horizontal direction loses its shadow over
    ``max(0, length * sin(t) - W)`` from the contact.

    Attributes:
        length: Length along the ray.
        unit: Of ``length``; in texels and reaches it grows with the distance from a lamp.
    """

    length: Scalar = length_field(0.0)
    unit: Unit = unit_field("world")

    def __call__(self, receiver: Receiver, reach: Scalar = 0.5) -> Receiver:
        """Return the receiver, moved toward the light."""
        return receiver.toward_light(in_world(self.length, self.unit, receiver, reach))


class SlopeBias(Bias):
    """Favor light by a multiple of the depth that the surface gains within a texel.

    The footprint is ``(|dz/du| + |dz/dv|) / 2`` per texel, from the plane of the receiving
    face, so on a plane the factor 1 is the least that removes all acne under nearest
    lookup and 2 under 2x2 bilinear, at every angle of the light and turn of the map.

    As with OpenGL's polygon offset, what rounding cannot tell is added: a surface that faces
    the light has no slope, and would shade itself at random.

    Attributes:
        factor: How far the surface is followed: in texel footprints (half texels); in
            reaches, of which 1 is the least on a plane under any filter; or in world lengths
            along the surface's image in the map.
        unit: Of ``factor``.
    """

    factor: Scalar = eqx.field(default=2.0, metadata={"unit": _GAINS})
    unit: Unit = unit_field("texel")

    def __call__(self, receiver: Receiver, reach: Scalar = 0.5) -> Receiver:
        """Return the receiver with its depth lowered."""
        if self.unit == "texel":
            footprints = self.factor
        elif self.unit == "reach":
            footprints = 2 * self.factor * reach
        else:
            footprints = 2 * self.factor / receiver.texel_length
        return receiver.less_depth(footprints * receiver.footprint + receiver.depth_resolution)


class AnalyticBias(Bias):
    """Favor light by the least that clears a plane of acne under the filter, in closed form.

    ``(|dz/du| + |dz/dv|) * reach``, what theory says a fit should find where surfaces are
    flat: ``SlopeBias(1, unit="reach")`` without a number to fit.
    """

    def __call__(self, receiver: Receiver, reach: Scalar = 0.5) -> Receiver:
        """Return the receiver with its depth lowered."""
        return SlopeBias(1.0, unit="reach")(receiver, reach)


class NormalOffsetBias(Bias):
    """Move along the normal of the face by texels times the sine of the angle to the light.

    On a plane tilted along a side of the map, 0.5 texels remove all acne under nearest
    lookup and 1 under 2x2 bilinear. The shadow shifts sideways, at most by the offset.

    Attributes:
        offset: Length along the normal, at grazing light.
        unit: Of ``offset``.

    References:
        D. Holbert, "Saying Goodbye to Shadow Acne", GDC 2011 poster.
    """

    reads_anew: ClassVar[bool] = True
    offset: Scalar = length_field(1.0)
    unit: Unit = unit_field("texel")

    def __call__(self, receiver: Receiver, reach: Scalar = 0.5) -> Receiver:
        """Return the receiver, moved off its surface."""
        cos_angle = dot(receiver.normal, receiver.to_light)
        squared = 1 - cos_angle**2
        facing = squared <= 1e-12
        sin_angle = jnp.where(facing, 0.0, jnp.sqrt(jnp.where(facing, 1.0, squared)))
        return receiver.along_normal(sin_angle * in_world(self.offset, self.unit, receiver, reach))


class CombinedBias(Bias):
    """Several biases, one after another; none at all is no bias.

    Attributes:
        terms: Applied in this order.
    """

    terms: tuple[Bias, ...] = ()

    def __check_init__(self) -> None:
        """Refuse terms that want different surfaces in the map."""
        special = [type(term).__name__ for term in self.terms if term.casters != "nearest"]
        if len(special) > 1:
            raise ValueError(
                f"CombinedBias: expected at most one of `terms` to choose which surfaces cast, "
                f"got {' and '.join(special)}"
            )

    @property
    def casters(self) -> Casters:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Which surfaces the terms want in the shadow map."""
        for term in self.terms:
            if term.casters != "nearest":
                return term.casters
        return "nearest"

    @property
    def reads_anew(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Whether any of the terms reads other texels or depths when its numbers change."""
        return any(term.reads_anew for term in self.terms)

    @property
    def follows_plane(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Whether any of the terms needs a comparison at each texel."""
        return any(term.follows_plane for term in self.terms)

    def prepare(self, shadow_map: ShadowMap) -> ShadowMap:
        """Return the map that receivers are compared with."""
        for term in self.terms:
            shadow_map = term.prepare(shadow_map)
        return shadow_map

    def __call__(self, receiver: Receiver, reach: Scalar = 0.5) -> Receiver:
        """Return the receiver, moved by every term."""
        for term in self.terms:
            receiver = term(receiver, reach)
        return receiver
