"""The solve: limited-memory BFGS in steps that can be stopped, stored and continued.

``optimistix`` runs a solver to its end in one call; here its steps are taken in runs of a
few, so that progress can be told and shown, and everything that the next step needs can be
written to a file. A continued solve takes the same steps as one that was never stopped.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Float, PyTree

from .files.images import atomic_path

Objective = Callable[[PyTree, PyTree, PyTree], Float[Array, ""]]


class Progress(eqx.Module):
    """Where a solve stands; every array of it is in a stored file.

    Attributes:
        y: The unknowns, as steps from the anchor.
        anchor: What the steps start from and are scaled by.
        solver_state: What the solver remembers.
        steps: Steps taken; not each is an improvement, a step may be tried shorter.
        since_anchor: Steps taken since the anchor was set.
        value: The objective when the anchor was set.
        ended: Whether the solver met its tolerance since then.
        failed: Whether it gave up.
    """

    y: PyTree[Array]
    anchor: PyTree[Array]
    solver_state: PyTree[Array]
    steps: Array
    since_anchor: Array
    value: Array
    ended: Array
    failed: Array


class Solve:
    """A minimization in steps, from anchors that may be set anew on the way.

    Args:
        objective: Function of steps, anchor and ``data``.
        zero: No steps at all.
        anchor: What steps start from and are scaled by.
        data: What else the objective needs; an argument of the compiled program.
        solver: Of ``optimistix``.
    """

    def __init__(
        self,
        objective: Objective,
        zero: PyTree,
        anchor: PyTree,
        data: PyTree,
        solver: optx.AbstractMinimiser,
    ) -> None:
        self._solver, self._data, self._zero = solver, data, zero
        self._function = lambda y, args: (objective(y, *args), None)
        self._value = jax.ShapeDtypeStruct((), jax.tree.leaves(zero)[0].dtype)
        struct = eqx.filter_eval_shape(self._init, zero, (anchor, data))
        self._static = eqx.partition(struct, _is_array)[1]
        self._advance = eqx.filter_jit(self._run)
        self._first = eqx.filter_jit(
            lambda y, args: eqx.partition(self._init(y, args), eqx.is_array)[0]
        )
        self._value_at = eqx.filter_jit(lambda y, args: objective(y, *args))
        self.progress = self._begun(anchor, jnp.array(0))

    def advance(self, steps: int) -> Progress:
        """Take up to so many steps and return where the solve then stands."""
        self.progress = self._advance(self.progress, self._data, jnp.array(steps))
        return jax.block_until_ready(self.progress)

    @property
    def value(self) -> float:
        """The objective where the solve stands."""
        return float(self._value_at(self.progress.y, (self.progress.anchor, self._data)))

    def set_anchor(self, anchor: PyTree) -> None:
        """Go on from another anchor; what the solver remembers is in the old one's steps."""
        self.progress = self._begun(anchor, self.progress.steps)

    def store(self, path: Path) -> None:
        """Write all that a continued solve needs to a file, or nothing."""
        with atomic_path(path) as temporary:
            eqx.tree_serialise_leaves(temporary, self.progress)

    def restore(self, path: Path) -> None:
        """Go on from a file that ``store`` wrote.

        Raises:
            ValueError: If it is none, or belongs to unknowns of another size.
        """
        try:
            self.progress = eqx.tree_deserialise_leaves(path, self.progress)
        except (OSError, RuntimeError, ValueError, EOFError) as error:
            raise ValueError(f"{path}: cannot be continued from ({error})") from error

    def _begun(self, anchor: PyTree, steps: Array) -> Progress:
        state = self._first(self._zero, (anchor, self._data))
        value, no = self._value_at(self._zero, (anchor, self._data)), jnp.array(False)
        return Progress(self._zero, anchor, state, steps, jnp.array(0), value, no, no)

    def _init(self, y: PyTree, args: PyTree) -> Any:
        return self._solver.init(self._function, y, args, {}, self._value, None, frozenset())

    def _run(self, progress: Progress, data: PyTree, steps: Array) -> Progress:
        last = progress.steps + steps
        args = (progress.anchor, data)

        def unfinished(at: Progress) -> Array:
            return ~at.ended & ~at.failed & (at.steps < last)

        def step(at: Progress) -> Progress:
            state = eqx.combine(self._static, at.solver_state)
            y, state, _ = self._solver.step(self._function, at.y, args, {}, state, frozenset())
            ended, result = self._solver.terminate(self._function, y, args, {}, state, frozenset())
            failed = result != optx.RESULTS.successful
            dynamic = eqx.partition(state, eqx.is_array)[0]
            steps, since = at.steps + 1, at.since_anchor + 1
            return Progress(y, at.anchor, dynamic, steps, since, at.value, ended, failed)

        return jax.lax.while_loop(unfinished, step, progress)


def _is_array(leaf: Any) -> bool:
    return eqx.is_array(leaf) or isinstance(leaf, jax.ShapeDtypeStruct)
