"""Biases against self-shadowing: each moves the receiver in favor of light.

A shadow map stores one depth per texel; between texel centres a slanted surface is deeper
than what was stored, and shades itself (acne). A bias b removes it once b is at least the
depth that the surface gains within the reach of the lookup, and takes away true shadow
within b of each caster (peter-panning). Every number has a unit that a scene gives meaning
to, world lengths or texels; none is in units of the depth buffer.

A new bias is a new subclass of ``Bias``: its fields are leaves that a fit can move, with
their unit in ``field(metadata={"unit": ...})``.
"""

import abc
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp

from tangentspace._math import dot

from .shadow_map import Receiver
from .transforms import Scalar


class Bias(eqx.Module):
    """A way to favor light at a receiver.

    Attributes:
        moves_texel: Whether the receiver may come to lie in another texel.
    """

    moves_texel: ClassVar[bool] = False

    @abc.abstractmethod
    def __call__(self, receiver: Receiver) -> Receiver:
        """Return the receiver, moved."""


class ConstantBias(Bias):
    """Move along the light ray by the same length everywhere.

    Peter-panning law: on a floor whose normal makes the angle t with the light, a caster
    of thickness W along the light's horizontal direction loses its shadow over
    ``max(0, length * sin(t) - W)`` from the contact.

    Attributes:
        length: World length along the ray.
    """

    length: Scalar = eqx.field(default=0.0, metadata={"unit": "world length"})

    def __call__(self, receiver: Receiver) -> Receiver:
        """Return the receiver, moved toward the light."""
        return receiver.toward_light(self.length)


class SlopeBias(Bias):
    """Favor light by a multiple of the depth that the surface gains within a texel.

    The footprint is ``(|dz/du| + |dz/dv|) / 2`` per texel, from the plane of the receiving
    face, so on a plane the factor 1 is the least that removes all acne under nearest
    lookup and 2 under 2x2 bilinear, at every angle of the light and turn of the map.

    As with OpenGL's polygon offset, what rounding cannot tell is added: a surface that faces
    the light has no slope, and would shade itself at random.

    Attributes:
        factor: Texel footprints.
    """

    factor: Scalar = eqx.field(default=2.0, metadata={"unit": "texel footprints"})

    def __call__(self, receiver: Receiver) -> Receiver:
        """Return the receiver with its depth lowered."""
        return receiver.less_depth(self.factor * receiver.footprint + receiver.depth_resolution)


class NormalOffsetBias(Bias):
    """Move along the normal of the face by texels times the sine of the angle to the light.

    On a plane tilted along a side of the map, 0.5 removes all acne under nearest lookup
    and 1 under 2x2 bilinear. The shadow shifts sideways, at most by the offset.

    Attributes:
        texels: Texel widths, at grazing light.

    References:
        D. Holbert, "Saying Goodbye to Shadow Acne", GDC 2011 poster.
    """

    moves_texel: ClassVar[bool] = True
    texels: Scalar = eqx.field(default=1.0, metadata={"unit": "texel widths"})

    def __call__(self, receiver: Receiver) -> Receiver:
        """Return the receiver, moved off its surface."""
        cos_angle = dot(receiver.normal, receiver.to_light)
        squared = 1 - cos_angle**2
        facing = squared <= 1e-12
        sin_angle = jnp.where(facing, 0.0, jnp.sqrt(jnp.where(facing, 1.0, squared)))
        return receiver.along_normal(self.texels * sin_angle * receiver.texel_length)


class CombinedBias(Bias):
    """Several biases, one after another; none at all is no bias.

    Attributes:
        terms: Applied in this order.
    """

    terms: tuple[Bias, ...] = ()

    @property
    def moves_texel(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Whether any of the terms moves the texel."""
        return any(term.moves_texel for term in self.terms)

    def __call__(self, receiver: Receiver) -> Receiver:
        """Return the receiver, moved by every term."""
        for term in self.terms:
            receiver = term(receiver)
        return receiver
