"""Fit a normal map, and on request material and lights, to images under known lights.

The unknowns are two slopes per texel, so that every guess is a map of normals that look up.
The objective is the sum of squares of the colors' differences over pixels and lights, not
the mean, or a step of length one would move nothing.

The solver walks in scaled steps from an anchor. A texel's two steps are scaled by the inverse
root of what the images tell of its slopes there (a 2x2 block of the Gauss-Newton matrix), so
that texels in half shadow or at the rim of the view come down as fast as the others; what
the images tell changes with the map, so the anchor is set anew on the way.

Nothing is invented: a texel that no pixel touches keeps its start and is flagged.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

from shadows.lights import Light
from tangentspace.shading import Shading

from ..solve import Solve
from .normal_map_information import texel_information
from .normal_map_task import Anchor, Task, Unknowns, free_leaves
from .normal_map_views import Slopes

SOLVER = optx.LBFGS(rtol=1e-5, atol=1e-5)
_ROUNDS = (20, 40)  # steps from an anchor; the last number counts for all that follow
_LEAST_GAIN = 0.05  # of the objective in a round; a fit that gains less has arrived
_CAUTION = 0.03  # share of the usual information below which a texel's steps do not grow;
_LATER_CAUTION = 1e-4  # a texel that hardly shows would else run off while all others move
_LEAST_RMS = 1e-6  # linear radiance: less than images of 32-bit floats hold


class MapFit:
    """A fit under way.

    Args:
        task: What guesses are compared with.
        shading: The lighting model, with the coefficients to start from.
        lights: One for each image.
        free: What is fitted beside the map, as ``albedo`` or ``light.direction``, which is
            every light's own.
        slopes: Where the map starts; flat if not given.

    Raises:
        ValueError: If a name is not one of the model's or of its lights'.
    """

    def __init__(
        self,
        task: Task,
        shading: Shading,
        lights: Sequence[Light],
        *,
        free: Sequence[str] = (),
        slopes: Slopes | None = None,
    ) -> None:
        if slopes is None:
            slopes = jnp.zeros((*task.view.map_size, 2))
        numbers = jax.tree.map(lambda leaf: jnp.asarray(leaf, float), (shading, tuple(lights)))
        self.start = Unknowns(slopes, *numbers)
        self._task = task
        scale = jax.tree.map(lambda _: None, self.start)
        for _, where in free_leaves(self.start, free):
            step = _balanced(task, self.start, where)
            scale = eqx.tree_at(where, scale, step, is_leaf=_is_none)
        scale = eqx.tree_at(
            lambda u: u.slopes, scale, _scaled_slopes(task, self.start, _CAUTION), is_leaf=_is_none
        )
        zero = jax.tree.map(jnp.zeros_like, scale)
        zero = eqx.tree_at(lambda u: u.slopes, zero, jnp.zeros_like(slopes))
        self._solve = Solve(objective, zero, Anchor(self.start, scale), task, SOLVER)

    @property
    def unknowns(self) -> Unknowns:
        """Where the fit stands."""
        progress = self._solve.progress
        return jax.jit(Anchor.unknowns)(progress.anchor, progress.y)

    @property
    def steps(self) -> int:
        """Steps of the solver so far."""
        return int(self._solve.progress.steps)

    @property
    def converged(self) -> bool:
        """Whether, since the last anchor, the solver met its tolerance or gained next to nothing.

        The first anchor does not count: its scale is that of the start.
        """
        progress = self._solve.progress
        value = self._solve.value
        if 2 * value <= self._task.targets.size * _LEAST_RMS**2:
            return True
        if int(progress.since_anchor) == self.steps:
            return False
        over = int(progress.since_anchor) == _ROUNDS[1] or bool(progress.ended | progress.failed)
        return over and value > (1 - _LEAST_GAIN) * float(progress.value)

    def advance(self, steps: int) -> None:
        """Take up to so many steps, from new anchors where it is time."""
        last = self.steps + steps
        while self.steps < last and not self.converged:
            progress = self._solve.progress
            first = int(progress.since_anchor) == self.steps
            left = _ROUNDS[0 if first else 1] - int(progress.since_anchor)
            if bool(progress.ended | progress.failed) or left == 0:
                self._solve.set_anchor(self._next_anchor())
                left = _ROUNDS[1]
            self._solve.advance(min(left, last - self.steps))

    def store(self, path: Path) -> None:
        """Write the state of the fit to a file, or nothing."""
        self._solve.store(path)

    def restore(self, path: Path) -> None:
        """Go on from a stored state."""
        self._solve.restore(path)

    def _next_anchor(self) -> Anchor:
        here = self.unknowns
        scale = self._solve.progress.anchor.scale
        # A tenth for every round.
        caution = max(_CAUTION * 0.1 ** (1 + self.steps // _ROUNDS[1]), _LATER_CAUTION)
        slopes = _scaled_slopes(self._task, here, caution)
        return Anchor(here, eqx.tree_at(lambda u: u.slopes, scale, slopes))


def objective(steps: Unknowns, anchor: Anchor, task: Task) -> Float[Array, ""]:
    """Return half the sum of squares of the residuals."""
    parts = [jnp.sum(part**2) for part in task.residuals(anchor.unknowns(steps))]
    return 0.5 * sum(parts[1:], parts[0])


def _scaled_slopes(
    task: Task, unknowns: Unknowns, caution: float
) -> Float[Array, "height width 2 2"]:
    """Return for each texel the matrix from steps to slopes that makes all steps alike.

    With ``L`` the Cholesky factor of a texel's information, a step of ``inverse(L).T`` changes
    the images by 1 in every direction; all are then scaled so that a usual texel's is 1.
    """
    information = texel_information(task, unknowns).slopes
    trace = np.trace(information, axis1=-2, axis2=-1)
    told = trace > 0
    usual = np.median(trace[told]) / 2 if told.any() else 1.0
    damped = information / usual + caution * np.eye(2)
    factor = np.linalg.cholesky(np.where(told[..., None, None], damped, np.eye(2)))
    return jnp.asarray(np.swapaxes(np.linalg.inv(factor), -1, -2), unknowns.slopes.dtype)


def _balanced(
    task: Task, unknowns: Unknowns, where: Callable[[Unknowns], Array]
) -> Float[Array, "..."]:
    """Return the step of a leaf that changes the images as much as a texel's step of one."""
    leaf = where(unknowns)

    @jax.jit
    def change(task: Task, direction: Unknowns) -> Float[Array, ""]:
        """Return the sum of squares of the residuals' change."""
        _, slopes = jax.jvp(task.residuals, (unknowns,), (direction,))
        parts = [jnp.sum(slope**2) for slope in slopes]
        return sum(parts[1:], parts[0])

    zero = jax.tree.map(jnp.zeros_like, unknowns)
    # For random signs the expected sum is that of all texels, each by itself.
    signs = jax.random.rademacher(jax.random.key(0), zero.slopes.shape, zero.slopes.dtype)
    texel = change(task, eqx.tree_at(lambda u: u.slopes, zero, signs)) / zero.slopes.size
    basis = jnp.eye(leaf.size, dtype=leaf.dtype).reshape(-1, *leaf.shape)
    whole = max(float(change(task, eqx.tree_at(where, zero, unit))) for unit in basis)
    scale = jnp.sqrt(texel / whole) if whole > 0 else jnp.ones(())
    return jnp.broadcast_to(scale, leaf.shape).astype(leaf.dtype)


def _is_none(leaf: Any) -> bool:
    return leaf is None
