"""Local lighting: Lambert, Phong in the lecture form, and normalized Blinn-Phong.

Pure functions of unit vectors that leave the surface, all in one space: world space
per fragment, or tangent space when light and eye were taken there per vertex; the models
only see angles. Leading axes broadcast, so one function serves a pixel and an image.

``radiance`` is the linear light that arrives and ``visibility`` how much of it is not
blocked; both scale diffuse and specular, while ambient stays. There is no factor 1 / pi:
a white Lambert surface that faces light of radiance 1 shows color 1.

Sources: Phong, "Illumination for Computer Generated Pictures", 1975; Blinn, "Models of
Light Reflection for Computer Synthesized Pictures", 1977.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ._math import dot, safe_normalize

Directions = Float[Array | np.ndarray, "... 3"]
Scalars = Float[Array | np.ndarray, "..."] | float
Colors = Float[Array | np.ndarray, "... 3"] | Float[Array | np.ndarray, ""] | float


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
    radiance: Colors = 1.0,
    visibility: Scalars = 1.0,
) -> Float[Array, "... 3"]:
    """Shade a matte surface: ``visibility * radiance * albedo * clamp(<n, l>, 0, 1)``.

    Args:
        normal: Unit normals.
        to_light: Unit vectors from the surface to the light.
        to_camera: Not used, since a matte surface looks the same from everywhere; taken so
            that one model can stand in for another.
        albedo: Linear RGB, or one number for all channels.
        radiance: Linear light that arrives unblocked, RGB or one number.
        visibility: Share of the light that is not blocked, in [0, 1].

    Returns:
        Linear RGB.

    Differentiability:
        Smooth but for the clamp: at and below ``<n, l> = 0`` the derivative is zero, as it
        is at and above 1. Linear in ``albedo``, ``radiance`` and ``visibility``.
    """
    n_dot_l = _clamp(dot(normal, to_light))
    return _rgb(_arriving(radiance, visibility * n_dot_l) * jnp.asarray(albedo))


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

    Returns:
        Linear RGB, not clamped to 1.

    Differentiability:
        Smooth but for the two clamps; where a cosine is at or below 0, or at or above 1,
        its term has derivative zero, for every ``shininess``.
    """
    n_dot_l = _clamp(dot(normal, to_light))
    highlight = _lobe(dot(to_camera, reflect(-to_light, normal)), shininess)
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

    Returns:
        Linear RGB, not clamped to 1.

    Differentiability:
        Smooth but for the clamps, as ``phong``; where light and camera are opposite there
        is no half vector, the highlight is zero and so is its derivative.

    References:
        C. Schueler, "The Blinn-Phong Normalization Zoo", 2011.
    """
    n_dot_l = _clamp(dot(normal, to_light))
    half_vector = safe_normalize(to_light + to_camera)
    normalization = (shininess + 2) * (shininess + 4) / (8 * (shininess + 2 ** (-shininess / 2)))
    lobe = normalization * _lobe(dot(normal, half_vector), shininess)
    reflectance = jnp.asarray(albedo) + specular * lobe[..., None]
    return _rgb(jnp.asarray(ambient) + _arriving(radiance, visibility * n_dot_l) * reflectance)


def _arriving(radiance: Colors, share: Scalars) -> Float[Array, "..."]:
    """Scale the light's color by a share per pixel, which has no channels."""
    return jnp.asarray(share)[..., None] * jnp.asarray(radiance)


def _clamp(cosine: Float[Array, "..."]) -> Float[Array, "..."]:
    """Clamp to [0, 1], with derivative 0 at both ends (``jnp.clip`` halves it there)."""
    return jnp.where(cosine <= 0, 0.0, jnp.where(cosine >= 1, 1.0, cosine))


def _lobe(cosine: Float[Array, "..."], shininess: Scalars) -> Float[Array, "..."]:
    """Raise the clamped cosine to a power, whose derivative at 0 is 0 for any exponent."""
    dark = cosine <= 0
    return jnp.where(dark, 0.0, jnp.where(dark, 1.0, _clamp(cosine)) ** shininess)


def _rgb(color: Float[Array, "..."]) -> Float[Array, "... 3"]:
    """Repeat a single channel thrice."""
    return jnp.broadcast_to(color, (*color.shape[:-1], 3))
