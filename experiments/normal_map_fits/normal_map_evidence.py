"""What the images say about each texel and each fitted number, and what they cannot say.

A texel has two unknowns, so one light leaves a whole curve of normals that explain its
color, two lights leave pairs of them, and from three on the normal is known. How well
follows from the noise that the residual shows and from how much the images change with it.
"""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .normal_map_information import texel_information, to_texels
from .normal_map_task import Task, Unknowns, free_leaves
from .normal_map_views import View

ENOUGH_LIGHTS = 3
_ENOUGH = 0.5  # of a pixel: less of it at a texel does not count
_SAMPLE = 20_000  # pixels that tell fitted numbers apart well enough
_SINGULAR = 1e-6


class Evidence(NamedTuple):
    """How well each texel is known.

    Attributes:
        seen: Whether at least half a pixel shows it.
        lights: Number of lights that reach it and show something of its normal.
        noise: Root mean square of the residual per free number, linear radiance.
        standard_error: Of each texel's normal, degrees, under that noise and if its
            neighbours were known; infinite where the images do not tell.
    """

    seen: Bool[np.ndarray, "height width"]
    lights: Int[np.ndarray, "height width"]
    noise: float
    standard_error: Float[np.ndarray, "height width"]

    @property
    def known(self) -> Bool[np.ndarray, "height width"]:
        """Whether enough lights reach the texel."""
        return self.lights >= ENOUGH_LIGHTS


def gather_evidence(task: Task, unknowns: Unknowns) -> Evidence:
    """Return how well each texel is known at the end of a fit."""
    view = task.view
    information = texel_information(task, unknowns)
    seen = seen_texels(view)
    reached = [to_texels(view, tells.astype(float)) >= _ENOUGH for tells in information.tells]
    residuals = 3 * float(np.asarray(view.lit).sum())
    free = max(residuals - 2 * seen.sum(), 0.05 * residuals, 1.0)
    noise = float(np.sqrt(information.squares / free))
    matrix = information.slopes
    determinant = np.linalg.det(matrix)
    told = seen & (determinant > _SINGULAR * np.trace(matrix, axis1=-2, axis2=-1) ** 2)
    inverse = np.linalg.inv(np.where(told[..., None, None], matrix, np.eye(2)))
    variance = np.trace(inverse @ information.metric, axis1=-2, axis2=-1)
    error = np.where(told, np.rad2deg(noise * np.sqrt(variance)), np.inf)
    return Evidence(seen, np.sum(reached, axis=0), noise, error)


def seen_texels(view: View) -> Bool[np.ndarray, "height width"]:
    """Return which texels at least half a pixel shows."""
    return to_texels(view, np.ones(view.lit.shape[1])) >= _ENOUGH


def undetermined(task: Task, unknowns: Unknowns, names: Sequence[str]) -> list[str]:
    """Return what the images cannot tell of the fitted numbers, in sentences; none if nothing.

    Each pixel's normal is taken as unknown by itself: what is told apart even so, is so.

    Args:
        task: The fit.
        unknowns: Where it ended.
        names: What was free beside the map.
    """
    if not names:
        return []
    step = max(len(task.view.position[0]) // _SAMPLE, 1)
    thin = jax.tree.map(lambda a: a[..., ::step], (task.view, task.targets))
    task = eqx.tree_at(lambda t: (t.view, t.targets), task, thin)
    labels, directions = _directions(unknowns, names)
    by_number = np.stack([np.asarray(_change(task, unknowns, d)) for d in directions])
    by_normal = np.stack([np.asarray(a) for a in _change_by_normal(task, unknowns)])
    # Both (numbers, residuals, pixels); a pixel's two normal directions are projected out.
    inner = np.einsum("arp,brp->pab", by_normal, by_normal)
    inner += 1e-12 * np.trace(inner, axis1=1, axis2=2).max() * np.eye(2)
    mixed = np.einsum("arp,nrp->pan", by_normal, by_number)
    explained = np.einsum("pan,pam->nm", mixed, np.linalg.solve(inner, mixed))
    information = np.einsum("nrp,mrp->nm", by_number, by_number)
    diagonal = np.sqrt(np.maximum(np.diag(information), 1e-30))
    left = (information - explained) / np.outer(diagonal, diagonal)
    values, vectors = np.linalg.eigh(0.5 * (left + left.T))
    sentences = [f"{n}: changes nothing" for n, d in zip(labels, diagonal, strict=True) if d < 1e-9]
    for value, vector in zip(values, vectors.T, strict=True):
        share = sorted({labels[k] for k in np.flatnonzero(np.abs(vector) > 0.2)})
        if value < _SINGULAR and not any(s.startswith(tuple(share)) for s in sentences):
            sentences.append(f"{', '.join(share)} and the map: another mix gives the same images")
    return sentences


def _directions(unknowns: Unknowns, names: Sequence[str]) -> tuple[list[str], list[Unknowns]]:
    """Return a label and a direction for each number that is free to move."""
    zero = jax.tree.map(jnp.zeros_like, unknowns)
    labels, directions = [], []
    for label, where in free_leaves(unknowns, names):
        leaf = np.asarray(where(unknowns))
        basis = np.eye(leaf.size)
        if label.endswith("direction"):
            basis = np.linalg.svd(leaf[None])[2][1:]  # across it: its length does not count
        for unit in basis:
            step = jnp.asarray(unit.reshape(leaf.shape), leaf.dtype)
            labels.append(label)
            directions.append(eqx.tree_at(where, zero, step))
    return labels, directions


@jax.jit
def _change(
    task: Task, unknowns: Unknowns, direction: Unknowns
) -> Float[Array, "residuals pixels"]:
    return jnp.stack(jax.jvp(task.residuals, (unknowns,), (direction,))[1])


@jax.jit
def _change_by_normal(task: Task, unknowns: Unknowns) -> Float[Array, "2 residuals pixels"]:
    """Return how the residuals change with each pixel's normal, in two directions across it."""
    looked_up = task.view.look_up(unknowns.slopes)
    x, y, z = looked_up
    first = (z, jnp.zeros_like(x), -x)
    second = (-x * y, x * x + z * z, -y * z)
    residuals = lambda vector: task.residuals_at(vector, unknowns)
    return jnp.stack(
        [jnp.stack(jax.jvp(residuals, (looked_up,), (d,))[1]) for d in (first, second)]
    )
