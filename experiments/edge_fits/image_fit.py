"""Fit what a scene is made of to images of it: least squares, from blurred images to sharp ones.

An edge tells of its place only near where it is: two outlines that do not touch have nothing
to say to each other. Blurred, they do, so the fit begins with images blurred over many pixels
and ends with those that there are. Where the landscape has several valleys, several starts are
followed down to half the blurs, and the best of them to the end.

Where a corner passes over the centre of a texel, its share jumps. One such pixel can hold a fit
away from where all others fit, so at the end pixels count the less the more they stand out.

What is done is kept by stages, one blur of one start each, so that a fit that was stopped goes on
after the last.
"""

import abc
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

from .determined import DARK

BLURS = (1 / 20, 1 / 40, 1 / 80, 1 / 160, 1 / 320, 0.0)  # standard deviations, of the image's side
_STEPS = 12  # of each blur
_ROUNDS = 3  # in which pixels that stand out count less

Report = Callable[[str], None]
Vector = Float[Array, " numbers"]
Images = Float[Array, "images height width"]


class Problem(eqx.Module):
    """Images as a function of numbers, each in a unit that changes them about as much."""

    @property
    @abc.abstractmethod
    def names(self) -> tuple[str, ...]:
        """Of the numbers."""

    @abc.abstractmethod
    def images(self, vector: Vector) -> Images:
        """Return the images."""


class Stage(NamedTuple):
    """One least-squares solve.

    Attributes:
        start: Which start it belongs to.
        blur: Of the images, pixels.
        vector: Where it ended.
        rms: There, of the images' difference, not blurred.
        evaluations: Of the images with their derivatives.
        seconds: It took, without compilation but for the first.
        result: The solver's own word.
    """

    start: int
    blur: float
    vector: tuple[float, ...]
    rms: float
    evaluations: int
    seconds: float
    result: str


class ImageFit(NamedTuple):
    """Numbers fitted to images.

    Attributes:
        stages: Every solve, in order.
        best: Which start was best.
        images: Of the result.
    """

    stages: tuple[Stage, ...]
    best: int
    images: Float[np.ndarray, "images height width"]

    @property
    def vector(self) -> Float[np.ndarray, " numbers"]:
        """The numbers, in the problem's units."""
        return np.array(self.stages[-1].vector)

    @property
    def evaluations(self) -> int:
        """Of all starts."""
        return sum(stage.evaluations for stage in self.stages)


def fit_images(
    problem: Problem,
    targets: Float[Array | np.ndarray, "images height width"],
    starts: Sequence[Float[np.ndarray, " numbers"]],
    *,
    blurs: Sequence[float] = BLURS,
    done: Sequence[Stage] = (),
    keep: Callable[[Sequence[Stage]], None] = lambda stages: None,
    report: Report = lambda text: None,
) -> ImageFit:
    """Fit by Levenberg-Marquardt.

    Args:
        problem: What makes the images.
        targets: What they should be.
        starts: Where to begin; all are followed through the first half of the blurs.
        blurs: Of each solve, falling, as shares of the longer side of the images.
        done: Stages of the same fit that were done before.
        keep: Told all stages after each.
        report: Told how far it is.
    """
    targets = jnp.asarray(targets)
    pixels = [blur * max(targets.shape[1:]) for blur in blurs]
    half, even = (len(pixels) + 1) // 2, jnp.ones_like(targets)
    stages: list[Stage] = []
    before = iter(done)

    def follow(start: int, vector: np.ndarray, blur: float, weights: Images = even) -> np.ndarray:
        stage = next(before, None) or solve(start, vector, blur, weights)
        stages.append(stage)
        return np.array(stage.vector)

    def solve(start: int, vector: np.ndarray, blur: float, weights: Images) -> Stage:
        begin = time.perf_counter()
        solution = _solve(jnp.asarray(vector), problem, targets, jnp.asarray(blur), weights)
        rms = float(jnp.sqrt(jnp.mean((solution.aux - targets) ** 2)))
        stage = Stage(
            start,
            blur,
            tuple(map(float, solution.value)),
            rms,
            int(solution.stats["num_steps"]),
            time.perf_counter() - begin,
            "converged" if solution.result == optx.RESULTS.successful else "all steps taken",
        )
        keep([*stages, stage])
        report(f"start {start + 1} of {len(starts)}, blur {blur:.3g} pixels: rms {rms:.3g}")
        return stage

    ends = []
    for k, vector in enumerate(starts):
        for blur in pixels[:half]:
            vector = follow(k, np.asarray(vector), blur)
        ends.append(vector)
    rms = [[s.rms for s in stages if s.start == k][half - 1] for k in range(len(starts))]
    best = int(np.argmin(rms))
    vector = ends[best]
    for blur in pixels[half:]:
        vector = follow(best, vector, blur)
    for _ in range(_ROUNDS):
        images = _images(problem, jnp.asarray(vector))
        vector = follow(best, vector, 0.0, _outstanding(images - targets))
    return ImageFit(tuple(stages), best, np.asarray(_images(problem, jnp.asarray(vector))))


def images_and_derivatives(
    problem: Problem, vector: Float[np.ndarray, " numbers"]
) -> tuple[Float[np.ndarray, "images height width"], Float[np.ndarray, "pixels numbers"]]:
    """Return the images and how each pixel changes with each number."""
    images, jacobian = _derivatives(problem, jnp.asarray(vector))
    return np.asarray(images), np.asarray(jacobian, np.float64).reshape(-1, len(vector))


def check_edges(problem: Problem, jacobians: Sequence[Float[np.ndarray, "pixels numbers"]]) -> None:
    """Refuse a fit that nothing moves, at no start."""
    if all(np.sqrt(np.mean(jacobian**2)) <= DARK for jacobian in jacobians):
        raise ValueError(
            f"fit: the images do not change with {', '.join(problem.names)}; no edge that they "
            "move is in view"
        )


def blurred(images: Images, blur: Float[Array, ""]) -> Images:
    """Return images blurred by a Gaussian, cut off at their borders; by 0 as they are."""
    height, width = images.shape[-2:]
    rows, columns = (_gaussian(size, blur, images.dtype) for size in (height, width))
    return jnp.einsum("ij,njk,lk->nil", rows, images, columns)


def _gaussian(size: int, blur: Float[Array, ""], dtype: Any) -> Float[Array, "size size"]:
    """Return the matrix that blurs a row; each row of it sums to 1."""
    place = jnp.arange(size, dtype=dtype)
    away = (place[:, None] - place) / jnp.where(blur > 0, blur, 1)
    weights = jnp.exp(-0.5 * away**2)
    weights = weights / jnp.sum(weights, axis=1, keepdims=True)
    return jnp.where(blur > 0, weights, jnp.eye(size, dtype=dtype))


def _outstanding(difference: Images) -> Images:
    """Return roots of weights: Cauchy's, by the median of what differs at all.

    References:
        P. W. Holland, R. E. Welsch, "Robust Regression Using Iteratively Reweighted
        Least-Squares", Communications in Statistics A6, 1977.
    """
    size = np.abs(np.asarray(difference, float))
    there = size[size > 1e-4 * size.max()]
    typical = 1.48 * float(np.median(there)) if there.size else 1.0
    return jnp.asarray(1 / np.sqrt(1 + (size / (2.385 * typical)) ** 2), difference.dtype)


@eqx.filter_jit
def _solve(
    vector: Vector, problem: Problem, targets: Images, blur: Array, weights: Images
) -> optx.Solution:
    def residual(vector: Vector, _: None) -> tuple[Images, Images]:
        images = problem.images(vector)
        return blurred(weights * (images - targets), blur), images

    return optx.least_squares(
        residual,
        optx.LevenbergMarquardt(rtol=1e-4, atol=1e-4, linear_solver=lx.Normal(lx.Cholesky())),
        vector,
        has_aux=True,
        options={"jac": "fwd"},
        max_steps=_STEPS,
        throw=False,
    )


@eqx.filter_jit
def _images(problem: Problem, vector: Vector) -> Images:
    return problem.images(vector)


@eqx.filter_jit
def _derivatives(problem: Problem, vector: Vector) -> tuple[Images, Float[Array, "..."]]:
    def twice(vector: Vector) -> tuple[Images, Images]:
        images = problem.images(vector)
        return images, images

    jacobian, images = jax.jacfwd(twice, has_aux=True)(vector)
    return images, jacobian
