"""Fit all vertices of a caster to images of its shadow: shadow art.

A silhouette tells of the vertices on it and of no others: steps along the bare gradient tear
those few out of the surface. Here the unknowns are moved, not the vertices: ``(I + smoothness L)``
times the vertices' shifts, with the mesh's Laplacian ``L``, so that a pull at one vertex is
shared by those round it, the farther the greater the smoothness.

References:
    B. Nicolet, A. Jacobson, W. Jakob, "Large Steps in Inverse Rendering of Geometry", SIGGRAPH
    Asia 2021, equations 4 and 9.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float, Int

from shadows import Bias, Light

from ..solve import Solve
from .image_fit import Images, blurred
from .shadow_view import ShadowView

BLURS = (1 / 40, 1 / 80, 1 / 160, 0.0)  # standard deviations, of the image's longer side
_LEAST_GAIN = 0.1  # of what is minimized, in a round
_ITERATIONS = 60  # of conjugate gradients, at most
_TOLERANCE = 1e-4  # of the right-hand side


class Surface(eqx.Module):
    """A caster whose vertices are free.

    Attributes:
        view: What is seen, and what casts.
        positions: Of all that casts, as it starts, world space.
        places: For each vertex the row of the shifts that moves it; vertices at one place have
            one row, those that stay the last, which counts for nothing.
        links: Pairs of rows that an edge joins.
        lights: One for each image.
        bias: Against self-shadowing.
        smoothness: How far a pull is shared.
        step: World length of a shift of 1.
    """

    view: ShadowView
    positions: Float[Array | np.ndarray, "vertices 3"]
    places: Int[Array | np.ndarray, " vertices"]
    links: Int[Array | np.ndarray, "links 2"]
    lights: tuple[Light, ...]
    bias: Bias
    smoothness: Array | float
    step: Array | float

    def moved(self, unknowns: Float[Array, "rows 3"]) -> Float[Array, "vertices 3"]:
        """Return the vertices."""
        shifts = self.step * share_pulls(unknowns, self.links, self.smoothness)
        shifts = jnp.concatenate([shifts, jnp.zeros((1, 3), shifts.dtype)])
        return jnp.asarray(self.positions) + shifts[self.places]

    def images(self, unknowns: Float[Array, "rows 3"]) -> Images:
        """Return an image under each light."""
        positions = self.moved(unknowns)
        return jnp.stack([self.view.image(positions, light, self.bias) for light in self.lights])


def share_pulls(
    pulls: Float[Array, "rows 3"],
    links: Int[Array | np.ndarray, "links 2"],
    smoothness: Array | float,
) -> Float[Array, "rows 3"]:
    """Return shifts ``x`` with ``(I + smoothness L) x`` the pulls, by conjugate gradients.

    Args:
        pulls: At each row.
        links: Pairs of rows, of which the Laplacian ``L`` takes the differences.
        smoothness: How far a pull is shared.
    """
    a, b = jnp.asarray(links).T

    def spread(shifts: Float[Array, "rows 3"]) -> Float[Array, "rows 3"]:
        change = shifts[a] - shifts[b]
        return shifts + smoothness * jnp.zeros_like(shifts).at[a].add(change).at[b].add(-change)

    solved, _ = jax.scipy.sparse.linalg.cg(spread, pulls, tol=_TOLERANCE, maxiter=_ITERATIONS)
    return solved


class Anchor(NamedTuple):
    """What steps start from.

    Attributes:
        unknowns: The surface's.
        blur: Of the images, pixels.
    """

    unknowns: Float[Array, "rows 3"]
    blur: Float[Array, ""]


class SmoothFit:
    """A fit under way, from blurred images to sharp ones.

    Args:
        surface: Whose vertices are free.
        targets: What the images should be.
        steps: Of the solver, at most.
    """

    def __init__(self, surface: Surface, targets: Images, steps: int) -> None:
        side = max(targets.shape[1:])
        self._blurs = [jnp.asarray(blur * side, targets.dtype) for blur in BLURS]
        self._steps, self._idle = steps, 0
        rows = int(np.max(surface.places))
        zero = jnp.zeros((rows, 3), targets.dtype)
        solver = optx.LBFGS(rtol=1e-6, atol=1e-6)
        anchor = Anchor(zero, self._blurs[0])
        self._data = surface, jnp.asarray(targets)
        self._solve = Solve(_objective, zero, anchor, self._data, solver)

    @property
    def unknowns(self) -> Float[Array, "rows 3"]:
        """Where the fit stands."""
        progress = self._solve.progress
        return progress.anchor.unknowns + progress.y

    @property
    def pull(self) -> Float[Array, "rows 3"]:
        """The derivative of what is minimized."""
        progress, data = self._solve.progress, self._data
        return _descent(progress.y, progress.anchor, data)[1]

    @property
    def steps(self) -> int:
        """Taken so far."""
        return int(self._solve.progress.steps)

    @property
    def blur(self) -> float:
        """Of the images that are compared, pixels."""
        return float(self._solve.progress.anchor.blur)

    @property
    def ended(self) -> bool:
        """Whether all steps are taken, or the sharp images gain nothing from a new start."""
        return self.steps >= self._steps or self._idle == 2

    def advance(self, steps: int) -> None:
        """Take up to so many steps.

        A round that gains little ends a blur: where shares jump, a line search finds no way on
        in the directions that the solver remembers, and a new start forgets them.
        """
        before = self._solve.value
        self._solve.advance(min(steps, self._steps - self.steps))
        if self._solve.value < (1 - _LEAST_GAIN) * before:
            self._idle = 0
            return
        sharp = self._level == len(self._blurs) - 1
        self._idle += sharp
        blur = self._blurs[self._level + (not sharp)]
        self._solve.set_anchor(Anchor(self.unknowns, blur))

    def store(self, path: Path) -> None:
        """Write the state of the fit to a file, or nothing."""
        self._solve.store(path)

    def restore(self, path: Path) -> None:
        """Go on from a stored state."""
        self._solve.restore(path)

    @property
    def _level(self) -> int:
        return int(np.argmin([abs(float(blur) - self.blur) for blur in self._blurs]))


def uniform_adam(
    surface: Surface,
    targets: Images,
    *,
    steps: int,
    rate: float,
    report: Callable[[str], None] = lambda text: None,
) -> list[float]:
    """Descend by Adam with one second moment for all numbers, as the reference does.

    Returns:
        The root mean square of the images' difference at each evaluation.

    Args:
        surface: Whose vertices are free.
        targets: What the images should be.
        steps: Evaluations.
        rate: Of the largest unknown, in steps.
        report: Told how far it is.
    """
    unknowns = np.zeros((int(np.max(surface.places)), 3), np.float32)
    mean, square, rms = np.zeros_like(unknowns), 0.0, []
    anchor = Anchor(jnp.zeros_like(unknowns), jnp.zeros((), targets.dtype))
    for step in range(1, steps + 1):
        loss, change = _descent(jnp.asarray(unknowns), anchor, (surface, jnp.asarray(targets)))
        rms.append(float(np.sqrt(2 * loss / targets.size)))
        mean = 0.9 * mean + 0.1 * np.asarray(change)
        square = 0.999 * square + 0.001 * float(np.max(np.asarray(change) ** 2))
        root = np.sqrt(square / (1 - 0.999**step)) + 1e-12
        unknowns = unknowns - np.float32(rate / (1 - 0.9**step) / root) * mean
        if step % 10 == 0:
            report(f"{step} of {steps}, rms {rms[-1]:.3g}")
    return rms


def rows_and_links(
    vertices: Int[np.ndarray, "edges 2"],
    first: Int[np.ndarray, " vertices"],
    free: Sequence[int] | Int[np.ndarray, " free"],
) -> tuple[Int[np.ndarray, " vertices"], Int[np.ndarray, "links 2"]]:
    """Return the row of each vertex, and which rows an edge joins.

    Args:
        vertices: The two ends of each edge, of vertices that stand for all at their place.
        first: For each vertex, the one that stands for its place.
        free: Vertices that may move.
    """
    standing = np.unique(first[np.asarray(free)])
    row = np.full(len(first), len(standing), np.int32)
    row[standing] = np.arange(len(standing))
    links = row[vertices]
    links = links[(links < len(standing)).all(axis=1) & (links[:, 0] != links[:, 1])]
    return row[first], links


def _objective(
    steps: Float[Array, "rows 3"], anchor: Anchor, data: tuple[Surface, Images]
) -> Float[Array, ""]:
    """Return half the sum of squares of the blurred images' difference."""
    surface, targets = data
    images = surface.images(anchor.unknowns + steps)
    return 0.5 * jnp.sum(blurred(images - targets, anchor.blur) ** 2)


@eqx.filter_jit
def _descent(
    unknowns: Float[Array, "rows 3"], anchor: Anchor, data: tuple[Surface, Images]
) -> tuple[Float[Array, ""], Float[Array, "rows 3"]]:
    return jax.value_and_grad(_objective)(unknowns, anchor, data)
