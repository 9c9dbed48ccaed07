"""Adam on the same images, as the usual way to compare with.

References:
    D. P. Kingma, J. Ba, "Adam: A Method for Stochastic Optimization", ICLR 2015, algorithm 1.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .image_fit import Images, Problem, Vector

RATES = (0.3, 1.0, 3.0)  # steps of the numbers


class History(NamedTuple):
    """How Adam came down, at the best of several rates.

    Attributes:
        rate: In steps of the numbers.
        rms: At each evaluation.
        vectors: There.
    """

    rate: float
    rms: list[float]
    vectors: list[list[float]]


def adam(
    problem: Problem,
    targets: Float[Array | np.ndarray, "images height width"],
    start: Float[np.ndarray, " numbers"],
    *,
    steps: int,
    rates: Sequence[float] = RATES,
    report: Callable[[str], None] = lambda text: None,
) -> History:
    """Descend by Adam at several rates; return the one that ended lowest.

    Args:
        problem: What makes the images.
        targets: What they should be.
        start: Where to begin.
        steps: Evaluations of images and gradient at each rate.
        rates: To try.
        report: Told how far it is.
    """
    found = []
    for rate in rates:
        vector = np.asarray(start, float)
        mean, square = np.zeros_like(vector), np.zeros_like(vector)
        rms, vectors = [], []
        for step in range(1, steps + 1):
            loss, change = _loss(problem, jnp.asarray(vector, targets.dtype), jnp.asarray(targets))
            rms.append(float(jnp.sqrt(loss)))
            vectors.append(vector.tolist())
            change = np.asarray(change, float)
            mean = 0.9 * mean + 0.1 * change
            square = 0.999 * square + 0.001 * change**2
            root = np.sqrt(square / (1 - 0.999**step)) + 1e-12
            vector = vector - rate * mean / (1 - 0.9**step) / root
            if step % 10 == 0:
                report(f"rate {rate:g}: {step} of {steps}, rms {rms[-1]:.3g}")
        found.append(History(rate, rms, vectors))
    return min(found, key=lambda history: min(history.rms[-max(1, steps // 10) :]))


@eqx.filter_jit
def _loss(problem: Problem, vector: Vector, targets: Images) -> tuple[Array, Vector]:
    return jax.value_and_grad(lambda v: jnp.mean((problem.images(v) - targets) ** 2))(vector)
