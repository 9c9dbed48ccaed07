"""Vector helpers whose derivatives stay finite where the vector vanishes."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Shaped


def dot(
    a: Float[Array | np.ndarray, "... 3"], b: Float[Array | np.ndarray, "... 3"]
) -> Float[Array, "..."]:
    """Return the inner products along the last axis.

    Written out: on a CPU a reduction over three numbers takes several times as long.
    """
    a, b = jnp.asarray(a), jnp.asarray(b)
    return a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1] + a[..., 2] * b[..., 2]


def stack_last(*columns: Shaped[Array, "..."]) -> Shaped[Array, "... n"]:
    """Stack arrays of one shape along a new last axis; on a CPU twice as fast as ``jnp.stack``.

    There all that led to them would be done in the one loop that stacks.
    """
    axis, (*others, last) = jnp.arange(len(columns)), columns
    stacked = jnp.broadcast_to(last[..., None], (*last.shape, len(columns)))
    for k, column in enumerate(others):
        stacked = jnp.where(axis == k, column[..., None], stacked)
    return stacked


def safe_divide(
    numerator: Float[Array | np.ndarray, "..."], denominator: Float[Array | np.ndarray, "..."]
) -> Float[Array, "..."]:
    """Divide, answering 0 (with derivative 0) where the denominator is exactly 0."""
    zero = denominator == 0
    return jnp.where(zero, 0.0, numerator / jnp.where(zero, 1.0, denominator))


def safe_norm(
    vectors: Float[Array | np.ndarray, "... n"], *, eps: float = 1e-30
) -> Float[Array, "..."]:
    """Return lengths along the last axis; 0, with derivative 0, where below ``sqrt(eps)``."""
    squared = _squared(vectors)
    tiny = squared <= eps
    return jnp.where(tiny, 0.0, jnp.sqrt(jnp.where(tiny, 1.0, squared)))


def safe_normalize(
    vectors: Float[Array | np.ndarray, "... n"], *, eps: float = 1e-30
) -> Float[Array, "... n"]:
    """Scale to unit length; 0, with derivative 0, where the length is below ``sqrt(eps)``.

    Each row is guarded by itself: one zero row leaves its neighbours' derivatives alone.
    """
    squared = _squared(vectors)[..., None]
    tiny = squared <= eps
    return jnp.where(tiny, 0.0, vectors / jnp.sqrt(jnp.where(tiny, 1.0, squared)))


def _squared(vectors: Float[Array | np.ndarray, "... n"]) -> Float[Array, "..."]:
    vectors = jnp.asarray(vectors)
    squares = [vectors[..., k] * vectors[..., k] for k in range(vectors.shape[-1])]
    return sum(squares[1:], squares[0])
