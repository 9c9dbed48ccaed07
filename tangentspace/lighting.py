"""Local lighting: Lambert, Phong in the lecture form, and normalized Blinn-Phong.

Pure functions of unit vectors that leave the surface, all in one space: world space
per fragment, or tangent space when light and eye were taken there per vertex; the models
only see angles. Leading axes broadcast, so one function serves a pixel and an image.

``radiance`` is the linear light that arrives and ``visibility`` how much of it is not
blocked; both scale diffuse and specular, while ambient stays. There is no factor 1 / pi:
a white Lambert surface that faces light of radiance 1 shows color 1.

``gloss`` says how far bumps that are finer than a pixel spread a highlight: a factor on its
exponent, from the filtering of normal maps. With it each model also lowers the highlight's
peak, so that its energy stays; 1, the default, changes and costs nothing.

Sources: Phong, "Illumination for Computer Generated Pictures", 1975; Blinn, "Models of
Light Reflection for Computer Synthesized Pictures", 1977; Toksvig, "Mipmapping Normal Maps", 2004.
"""

import functools
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ._math import dot, safe_normalize

Directions = Float[Array | np.ndarray, "... 3"]
Scalars = Float[Array | np.ndarray, "..."] | float
Colors = Float[Array | np.ndarray, "... 3"] | Float[Array | np.ndarray, ""] | float
ShadingFunction = Callable[..., Float[Array, "... 3"]]


class IncomingLight(NamedTuple):
    """What arrives at a surface from one light.

    Attributes:
        to_light: Unit vectors from the surface to the light.
        radiance: Linear light that arrives unblocked, RGB or one number.
        visibility: Share of the light that is not blocked, in [0, 1].
    """

    to_light: Directions
    radiance: Colors = 1.0
    visibility: Scalars = 1.0


def reflect(incident: Directions, normal: Directions) -> Float[Array, "... 3"]:
    """Mirror directions at a surface, as GLSL's ``reflect``: ``i - 2 <n, i> n``.

    Args:
        incident: Directions towards the surface, of any length.
        normal: Unit normals.
    """
    along_normal = dot(normal, incident)[..., None] * jnp.asarray(normal)
    return jnp.asarray(incident) - 2 * along_normal


def lambert(
    normal: Directions,
    to_light: Directions,
    to_camera: Directions | None = None,
    *,
    albedo: Colors,
    ambient: Colors = 0.0,
    radiance: Colors = 1.0,
    visibility: Scalars = 1.0,
    gloss: Scalars = 1.0,
) -> Float[Array, "... 3"]:
    """Shade matte: ``ambient + visibility * radiance * albedo * clamp(<n, l>, 0, 1)``.

    Args:
        normal: Unit normals.
        to_light: Unit vectors from the surface to the light.
        to_camera: Not used, since a matte surface looks the same from everywhere; taken so
            that one model can stand in for another.
        albedo: Linear RGB, or one number for all channels.
        ambient: Linear RGB or one number; what remains in full shadow.
        radiance: Linear light that arrives unblocked, RGB or one number.
        visibility: Share of the light that is not blocked, in [0, 1].
        gloss: Not used, since there is no highlight; taken as ``to_camera`` is.

    Returns:
        Linear RGB.

    Differentiability:
        Smooth but for the clamp: at and below ``<n, l> = 0`` the derivative is zero, as it
        is at and above 1. Linear in all colors and in ``visibility``.
    """
    n_dot_l = clamp_cosine(dot(normal, to_light))
    reflected = _arriving(radiance, visibility * n_dot_l) * jnp.asarray(albedo)
    return _rgb(jnp.asarray(ambient) + reflected)


def phong(
    normal: Directions,
    to_light: Directions,
    to_camera: Directions,
    *,
    ambient: Colors = 0.1,
    albedo: Colors = 0.5,
    specular: Colors = 0.9,
    shininess: Scalars = 1.0,
    radiance: Colors = 1.0,
    visibility: Scalars = 1.0,
    gloss: Scalars = 1.0,
) -> Float[Array, "... 3"]:
    """Shade with Phong's model; the defaults are the lecture form, which has no exponent.

    ``ambient + visibility * radiance * (albedo * clamp(<n, l>, 0, 1) + specular *
    clamp(<v, r>, 0, 1) ** shininess)`` with ``r = reflect(-l, n)``. To the letter of that
    form the highlight is not switched off where the light is behind the surface: without
    an exponent it is wide enough to show there, unless ``visibility`` removes it.

    Args:
        normal: Unit normals ``n``.
        to_light: Unit vectors ``l`` from the surface to the light.
        to_camera: Unit vectors ``v`` from the surface to the camera.
        ambient: Linear RGB or one number; what remains in full shadow.
        albedo: Diffuse coefficient, linear RGB or one number.
        specular: Specular coefficient, linear RGB or one number.
        shininess: Exponent of the highlight, > 0.
        radiance: Linear light that arrives unblocked, RGB or one number.
        visibility: Share of the light that is not blocked, in [0, 1].
        gloss: Factor on the exponent, in (0, 1]. The peak is lowered by
            ``(1 + gloss * shininess) / (1 + shininess)``. A lobe round the mirror direction is
            as wide as one round the half vector with four times its exponent: to filter a
            map for this model, ask for the gloss at ``4 * shininess``.

    Returns:
        Linear RGB, not clamped to 1.

    Differentiability:
        Smooth but for the two clamps; where a cosine is at or below 0, or at or above 1,
        its term has derivative zero, for every ``shininess``.
    """
    n_dot_l = clamp_cosine(dot(normal, to_light))
    highlight = lobe(dot(to_camera, reflect(-to_light, normal)), shininess * gloss)
    if not (isinstance(gloss, float) and gloss == 1.0):
        highlight = highlight * ((1 + shininess * gloss) / (1 + shininess))
    reflected = jnp.asarray(albedo) * n_dot_l[..., None] + specular * highlight[..., None]
    return _rgb(jnp.asarray(ambient) + _arriving(radiance, visibility) * reflected)


def blinn_phong(
    normal: Directions,
    to_light: Directions,
    to_camera: Directions,
    *,
    ambient: Colors = 0.1,
    albedo: Colors = 0.5,
    specular: Colors = 0.04,
    shininess: Scalars = 32.0,
    radiance: Colors = 1.0,
    visibility: Scalars = 1.0,
    gloss: Scalars = 1.0,
) -> Float[Array, "... 3"]:
    """Shade with Blinn-Phong's model as a normalized reflectance.

    ``ambient + visibility * radiance * clamp(<n, l>, 0, 1) * (albedo + specular * c(s) *
    clamp(<n, h>, 0, 1) ** s)`` with the half vector ``h = normalize(l + v)`` and
    ``c(s) = (s + 2) (s + 4) / (8 (s + 2 ** (-s / 2)))``. So normalized, a surface seen
    along its normal reflects the share ``specular`` of a white hemisphere at any
    ``shininess``, and less from the side; the highlight fades out with ``<n, l>``.

    Args:
        normal: Unit normals ``n``.
        to_light: Unit vectors ``l`` from the surface to the light.
        to_camera: Unit vectors ``v`` from the surface to the camera.
        ambient: Linear RGB or one number; what remains in full shadow.
        albedo: Share of the light that is reflected diffusely, linear RGB or one number.
        specular: Share of the light in the highlight, linear RGB or one number.
        shininess: Exponent ``s`` of the highlight, > 0.
        radiance: Linear light that arrives unblocked, RGB or one number.
        visibility: Share of the light that is not blocked, in [0, 1].
        gloss: Factor on the exponent, in (0, 1], also in ``c``.

    Returns:
        Linear RGB, not clamped to 1.

    Differentiability:
        Smooth but for the clamps, as ``phong``; where light and camera are opposite there
        is no half vector, the highlight is zero and so is its derivative.

    References:
        C. Schueler, "The Blinn-Phong Normalization Zoo", 2011.
    """
    n_dot_l = clamp_cosine(dot(normal, to_light))
    half_vector = safe_normalize(to_light + to_camera)
    exponent = shininess * gloss
    normalization = (exponent + 2) * (exponent + 4) / (8 * (exponent + 2 ** (-exponent / 2)))
    highlight = normalization * lobe(dot(normal, half_vector), exponent)
    reflectance = jnp.asarray(albedo) + specular * highlight[..., None]
    return _rgb(jnp.asarray(ambient) + _arriving(radiance, visibility * n_dot_l) * reflectance)


def shade_lights(
    shading: ShadingFunction,
    normal: Directions,
    to_camera: Directions,
    lights: Sequence[IncomingLight],
) -> Float[Array, "... 3"]:
    """Shade under several lights; ambient, which comes from none of them, counts once.

    Args:
        shading: ``lambert``, ``phong``, ``blinn_phong`` or a function with their keywords,
            its material bound: ``functools.partial(phong, albedo=color)``. Called with its
            own ``ambient`` for the first light and with ``ambient=0.0`` for the others.
        normal: Unit normals.
        to_camera: Unit vectors from the surface to the camera.
        lights: At least one.

    Returns:
        Linear RGB, not clamped to 1.

    Raises:
        ValueError: If there is no light.
    """
    if not lights:
        raise ValueError(
            "shade_lights: expected at least one of `lights`, got none; "
            "for a surface in the dark pass a light of visibility 0"
        )
    first, *others = (
        functools.partial(
            shading, normal, to_light, to_camera, radiance=radiance, visibility=visibility
        )
        for to_light, radiance, visibility in lights
    )
    return sum((shade(ambient=0.0) for shade in others), first())


def _arriving(radiance: Colors, share: Scalars) -> Float[Array, "..."]:
    """Scale the light's color by a share per pixel, which has no channels."""
    return jnp.asarray(share)[..., None] * jnp.asarray(radiance)


def clamp_cosine(cosine: Float[Array | np.ndarray, "..."]) -> Float[Array, "..."]:
    """Clamp to [0, 1], with derivative 0 at both ends (``jnp.clip`` halves it there)."""
    return jnp.where(cosine <= 0, 0.0, jnp.where(cosine >= 1, 1.0, cosine))


def lobe(cosine: Float[Array | np.ndarray, "..."], shininess: Scalars) -> Float[Array, "..."]:
    """Raise the clamped cosine to a power, whose derivative at 0 is 0 for any exponent."""
    dark = cosine <= 0
    return jnp.where(dark, 0.0, jnp.where(dark, 1.0, clamp_cosine(cosine)) ** shininess)


def _rgb(color: Float[Array, "..."]) -> Float[Array, "... 3"]:
    """Repeat a single channel thrice."""
    return jnp.broadcast_to(color, (*color.shape[:-1], 3))
