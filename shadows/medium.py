"""A thin homogeneous medium, such as mist or dust, which dims light and scatters it.

Lights here are scaled so that a white surface that faces one has its radiance, which is then
1/pi of the power that arrives. To the same scale a medium scatters pi times what its phase
function says: 1/4 of the radiance into every direction where it prefers none.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ._checks import check_field
from .transforms import Scalar, Vector


class Medium(eqx.Module):
    """What fills the space between surfaces, the same everywhere.

    Attributes:
        density: Share of the light that is lost per world length (extinction coefficient).
        albedo: Share of what is lost that is scattered, the rest is absorbed; a number or RGB.
        anisotropy: Mean cosine of the angle that light is turned by, between -1 (back) and 1
            (straight on); 0 scatters evenly.

    References:
        L. Henyey, J. Greenstein, "Diffuse Radiation in the Galaxy", 1941.
    """

    density: Scalar
    albedo: Scalar | Vector = 1.0
    anisotropy: Scalar = 0.0

    def __check_init__(self) -> None:
        """Refuse a negative density, and an anisotropy that no scattering has."""
        check_field(self, "density", "of at least 0", lambda x: 0 <= x < np.inf)
        check_field(self, "anisotropy", "between -1 and 1", lambda x: -1 < x < 1)

    def scattered(self, cos_angle: Float[Array, "*points"]) -> Float[Array, "*points"]:
        """Return pi times the phase function of Henyey and Greenstein.

        Args:
            cos_angle: Of the angle between the light's way before and after.
        """
        g = jnp.asarray(self.anisotropy)
        return 0.25 * (1 - g**2) / (1 + g**2 - 2 * g * cos_angle) ** 1.5

    def transmitted(self, distance: Float[Array, "*points"]) -> Float[Array, "*points"]:
        """Return the share of light that is left after a distance."""
        return jnp.exp(-self.density * distance)
