"""What the images tell of each texel: the blocks of the Gauss-Newton matrix.

With ``r`` the residuals and ``s`` a texel's two slopes, its block is the sum over all residuals
of ``(dr/ds)^T (dr/ds)``: how much the images change with that texel alone.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .normal_map_task import Task, Unknowns
from .normal_map_views import View

_TELLS = 1e-6  # squared change of a light's color with the normal, linear radiance squared


class Information(NamedTuple):
    """What the images tell.

    Attributes:
        slopes: Of each texel's slopes, linear radiance squared.
        metric: From changes of each texel's slopes to the squared angle of its normal.
        tells: Whether each light tells of the normal at each pixel.
        squares: Sum of squares of the residuals.
    """

    slopes: Float[np.ndarray, "height width 2 2"]
    metric: Float[np.ndarray, "height width 2 2"]
    tells: Bool[np.ndarray, "lights pixels"]
    squares: float


def texel_information(task: Task, unknowns: Unknowns) -> Information:
    """Return what the images tell of each texel, were its neighbours known."""
    view = task.view
    tells, products, squares = (np.asarray(a) for a in _at_pixels(task, unknowns))
    weights = np.asarray(view.weights, np.float64) ** 2
    of_normal = np.empty((*view.map_size, 3, 3))
    for (row, column), values in zip(_PAIRS, products, strict=True):
        total = to_texels(view, values, weights)
        of_normal[..., row, column] = of_normal[..., column, row] = total
    # The derivative of a unit normal with respect to its slopes.
    p, q = np.moveaxis(np.asarray(unknowns.slopes, np.float64), -1, 0)
    length = np.sqrt(1 + p * p + q * q)
    normal = np.stack([-p, -q, np.ones_like(p)], axis=-1) / length[..., None]
    across = np.eye(3) - normal[..., :, None] * normal[..., None, :]
    change = -across[..., :2] / length[..., None, None]
    transposed = np.swapaxes(change, -1, -2)
    return Information(transposed @ of_normal @ change, transposed @ change, tells, float(squares))


def to_texels(
    view: View,
    values: Float[np.ndarray, " pixels"],
    weights: Float[np.ndarray, "4 pixels"] | None = None,
) -> Float[np.ndarray, "height width"]:
    """Return the sum of the pixels' values at each texel, by their weights there."""
    weights = np.asarray(view.weights) if weights is None else weights
    texels = view.map_size[0] * view.map_size[1]
    total = np.bincount(np.asarray(view.indices).ravel(), (weights * values).ravel(), texels)
    return total.reshape(view.map_size)


_PAIRS = [(i, j) for i in range(3) for j in range(i, 3)]


@jax.jit
def _at_pixels(task: Task, unknowns: Unknowns) -> tuple[Array, Array, Array]:
    """Return whether each light tells of the looked-up normal, how much all do, the squares."""
    looked_up = task.view.look_up(unknowns.slopes)
    residuals = lambda vector: task.residuals_at(vector, unknowns)
    one, zero = jnp.ones_like(looked_up[0]), jnp.zeros_like(looked_up[0])
    axes = [tuple(one if k == axis else zero for k in range(3)) for axis in range(3)]
    values, along = jax.linearize(residuals, looked_up)
    slopes = [along(direction) for direction in axes]
    products = [[a * b for a, b in zip(slopes[i], slopes[j], strict=True)] for i, j in _PAIRS]
    squared = [sum(parts) for parts in zip(products[0], products[3], products[5], strict=True)]
    tells = jnp.stack([sum(squared[k : k + 3]) > _TELLS for k in range(0, len(squared), 3)])
    information = jnp.stack([sum(product) for product in products])
    return tells, information, jnp.sum(jnp.stack([jnp.sum(value**2) for value in values]))
