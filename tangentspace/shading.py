"""Lighting models as small pytrees: coefficients are leaves, and only angles matter.

Each model is ``ambient + visibility * radiance * (albedo * diffuse + specular * highlight)``,
where the two terms are functions of three cosines. A renderer, a fit and the command line
find a model by its name; a new one is a new subclass, its fields with their unit in
``field(metadata={"unit": ...})``. The formulas are those of ``lighting``.
"""

import abc
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ._math import dot
from .lighting import Colors, Directions, Scalars, clamp_cosine, lobe
from .normal_filtering import toksvig_gloss

Cosines = Float[Array | np.ndarray, "..."]
Coefficient = Float[Array | np.ndarray, ""] | Float[Array | np.ndarray, "3"] | float

_OF_WHITE, _EXPONENT = {"unit": "of white"}, {"unit": "exponent"}


class Terms(NamedTuple):
    """What a surface does with light from one direction, before any color.

    Attributes:
        diffuse: What the albedo is multiplied with.
        highlight: What the specular coefficient is multiplied with.
    """

    diffuse: Float[Array, "..."]
    highlight: Float[Array, "..."] | float


class Shading(eqx.Module):
    """How a surface answers light.

    Attributes:
        albedo: Share of the light that is reflected diffusely.
        specular: Coefficient of the highlight.
        ambient: Color in full shadow.
    """

    albedo: eqx.AbstractVar[Coefficient]
    specular: eqx.AbstractVar[Coefficient]
    ambient: eqx.AbstractVar[Coefficient]

    @abc.abstractmethod
    def terms(
        self, n_dot_l: Cosines, n_dot_v: Cosines, l_dot_v: Cosines, *, gloss: Scalars = 1.0
    ) -> Terms:
        """Return what is reflected, from the cosines between normal, light and camera.

        Args:
            n_dot_l: Between the normal and the direction to the light.
            n_dot_v: Between the normal and the direction to the camera.
            l_dot_v: Between the directions to light and camera.
            gloss: Factor on the highlight's exponent, in (0, 1], where the normal is an
                average of several.
        """

    def gloss(self, coherence: Scalars) -> Scalars:
        """Return the factor on the highlight's exponent for a mean of normals.

        Args:
            coherence: Length of the mean of unit normals, in (0, 1].
        """
        return 1.0

    def __call__(
        self,
        normal: Directions,
        to_light: Directions,
        to_camera: Directions,
        *,
        base_color: Colors = 1.0,
        ambient: Colors | None = None,
        radiance: Colors = 1.0,
        visibility: Scalars = 1.0,
        gloss: Scalars = 1.0,
    ) -> Float[Array, "... 3"]:
        """Return the color under one light, linear RGB.

        Args:
            normal: Unit normals.
            to_light: Unit vectors from the surface to the light.
            to_camera: Unit vectors from the surface to the camera.
            base_color: The surface's own color, linear RGB or one number: a factor on what
                is reflected diffusely and on the ambient light. Highlights keep the color of
                the light.
            ambient: What remains in full shadow, instead of the model's own; 0 for every
                light after the first (``lighting.shade_lights``).
            radiance: Linear light that arrives unblocked, RGB or one number.
            visibility: Share of the light that is not blocked, in [0, 1].
            gloss: As in ``terms``.
        """
        cosines = dot(normal, to_light), dot(normal, to_camera), dot(to_light, to_camera)
        diffuse, highlight = self.terms(*cosines, gloss=gloss)
        reflected = _times(diffuse, _scaled(self.albedo, base_color))
        if not isinstance(highlight, float):
            reflected = reflected + _times(highlight, self.specular)
        unlit = _scaled(self.ambient, base_color) if ambient is None else ambient
        color = jnp.asarray(unlit) + _times(visibility, radiance) * reflected
        return jnp.broadcast_to(color, (*color.shape[:-1], 3))


class LambertShading(Shading):
    """Matte, black in full shadow.

    Attributes:
        albedo: Share of the light that is reflected diffusely.
        ambient: Color in full shadow.
    """

    albedo: Coefficient = eqx.field(default=0.8, metadata=_OF_WHITE)
    ambient: Coefficient = eqx.field(default=0.0, metadata=_OF_WHITE)

    @property
    def specular(self) -> float:  # pyright: ignore[reportIncompatibleVariableOverride]
        """None is reflected as by a mirror."""
        return 0.0

    def terms(
        self, n_dot_l: Cosines, n_dot_v: Cosines, l_dot_v: Cosines, *, gloss: Scalars = 1.0
    ) -> Terms:
        """Return the clamped cosine of the light, and no highlight."""
        return Terms(clamp_cosine(n_dot_l), 0.0)


class PhongShading(Shading):
    """Phong's model in the lecture form, whose highlight has no exponent by default.

    Attributes:
        albedo: Diffuse coefficient.
        specular: Coefficient of the highlight.
        shininess: Exponent of the highlight.
        ambient: Color in full shadow.
    """

    albedo: Coefficient = eqx.field(default=0.5, metadata=_OF_WHITE)
    specular: Coefficient = eqx.field(default=0.9, metadata=_OF_WHITE)
    shininess: Coefficient = eqx.field(default=1.0, metadata=_EXPONENT)
    ambient: Coefficient = eqx.field(default=0.1, metadata=_OF_WHITE)

    def terms(
        self, n_dot_l: Cosines, n_dot_v: Cosines, l_dot_v: Cosines, *, gloss: Scalars = 1.0
    ) -> Terms:
        """Return those of ``lighting.phong``."""
        exponent = self.shininess * gloss
        r_dot_v = 2 * n_dot_l * n_dot_v - l_dot_v  # of the light's mirror direction
        highlight = lobe(r_dot_v, exponent)
        if not (isinstance(gloss, float) and gloss == 1.0):
            highlight = highlight * ((1 + exponent) / (1 + self.shininess))
        return Terms(clamp_cosine(n_dot_l), highlight)

    def gloss(self, coherence: Scalars) -> Scalars:
        """Return that of a lobe round the half vector of the same width."""
        return toksvig_gloss(coherence, 4 * self.shininess)


class BlinnPhongShading(Shading):
    """Blinn-Phong as a normalized reflectance.

    Attributes:
        albedo: Share of the light that is reflected diffusely.
        specular: Share of the light in the highlight.
        shininess: Exponent of the highlight.
        ambient: Color in full shadow.
    """

    albedo: Coefficient = eqx.field(default=0.5, metadata=_OF_WHITE)
    specular: Coefficient = eqx.field(default=0.04, metadata=_OF_WHITE)
    shininess: Coefficient = eqx.field(default=32.0, metadata=_EXPONENT)
    ambient: Coefficient = eqx.field(default=0.1, metadata=_OF_WHITE)

    def terms(
        self, n_dot_l: Cosines, n_dot_v: Cosines, l_dot_v: Cosines, *, gloss: Scalars = 1.0
    ) -> Terms:
        """Return those of ``lighting.blinn_phong``."""
        exponent = self.shininess * gloss
        normalization = (exponent + 2) * (exponent + 4) / (8 * (exponent + 2 ** (-exponent / 2)))
        squared = 2 + 2 * l_dot_v  # of the half vector before it is normalized
        opposite = squared <= 1e-12
        length = jnp.sqrt(jnp.where(opposite, 1.0, squared))
        n_dot_h = jnp.where(opposite, 0.0, (n_dot_l + n_dot_v) / length)
        diffuse = clamp_cosine(n_dot_l)
        return Terms(diffuse, diffuse * normalization * lobe(n_dot_h, exponent))

    def gloss(self, coherence: Scalars) -> Scalars:
        """Return Toksvig's factor."""
        return toksvig_gloss(coherence, self.shininess)


def _scaled(coefficient: Coefficient, base_color: Colors) -> Colors:
    """Return the coefficient in the surface's color; alone where that is white."""
    if isinstance(base_color, float) and base_color == 1.0:
        return coefficient
    return coefficient * jnp.asarray(base_color)


def _times(scalar: Scalars, color: Colors) -> Float[Array, "..."]:
    """Multiply a number per pixel, which has no channels, with a color."""
    return jnp.asarray(scalar)[..., None] * jnp.asarray(color)
