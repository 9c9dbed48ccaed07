"""What ``fit-pose`` and ``fit-light`` have in common: options, targets, starts."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from jaxtyping import Float

from shadows.bias import Bias
from shadows.visibility import check_techniques, default_bias

from ..checks import check_folder, check_reach, check_scene, check_size, check_target
from ..files.images import read_image
from ..rendering.prepare_scene import prepare_scene
from ..scene import Scene
from ..scenes import load_scene
from ..technique_words import choose_layout, parse_bias, parse_lookup, parse_shading
from .image_fit import images_and_derivatives
from .scene_numbers import Number, SceneProblem
from .shadow_view import Technique

Targets = Annotated[
    tuple[Path, ...],
    tyro.conf.arg(
        metavar="IMAGE",
        help="Pictures of the view, EXR or PNG, one for each of the scene's lights; without "
        "any, they are made from the scene as it is.",
    ),
]
Start = Annotated[
    tuple[str, ...],
    tyro.conf.arg(
        metavar="NAME=AMOUNT",
        help="What is added to the scene's numbers to begin with: degrees, world units, %.",
    ),
]
Starts = Annotated[
    int, tyro.conf.arg(metavar="N", help="Places to begin at; all but the first by chance.")
]
Noise = Annotated[
    float,
    tyro.conf.arg(
        metavar="SIGMA",
        help="Noise of each pixel, of white: added to targets that are made, and what standard "
        "errors are told for (for 0.01 if it is 0).",
    ),
]
Adam = Annotated[
    int,
    tyro.conf.arg(metavar="STEPS", help="Also run Adam from the same start, at three rates."),
]
Resume = Annotated[bool, tyro.conf.arg(help="Go on where a fit into the same folder was stopped.")]


class Options(NamedTuple):
    """The options of a fit, as they were given."""

    scene: str
    out: Path
    target: tuple[Path, ...]
    starts: int
    noise: float
    adam: int
    layout: Sequence[str]
    bias: Sequence[str] | None
    filter: Sequence[str]
    compare: Sequence[str]
    shading: Sequence[str]
    image_size: tuple[int, int]
    shadow_map_size: int

    @property
    def settings(self) -> dict[str, object]:
        """As JSON holds them; not where they are written to."""
        values = {name: value for name, value in self._asdict().items() if name != "out"}
        values["target"] = [str(path) for path in self.target]
        return {k: list(v) if isinstance(v, tuple) else v for k, v in values.items()}


def load(options: Options) -> tuple[Scene, Technique, Bias, list[Float[np.ndarray, "..."]]]:
    """Return the scene, how its shadows are made, the bias, and the targets that were given.

    Raises:
        ValueError: If an option has no sense, or a picture is not of the view.
    """
    check_folder(options.out)
    check_size("--image-size", *options.image_size)
    check_size("--shadow-map-size", options.shadow_map_size)
    if not 0 <= options.noise < np.inf:
        raise ValueError(f"--noise: expected a number of at least 0, got {options.noise}")
    for name, value, least in (("--starts", options.starts, 1), ("--adam", options.adam, 0)):
        if value < least:
            raise ValueError(f"{name}: expected at least {least}, got {value}")
    lookup, comparison = parse_lookup(options.filter, options.compare)
    model = parse_shading(options.shading)
    pictures = []
    for path in options.target:
        picture = read_image(path)
        check_target(path, picture, options.image_size)
        pictures.append(picture.mean(axis=-1))
    scene = prepare_scene(load_scene(options.scene))
    layout = choose_layout(scene, options.layout)
    check_scene(scene, layout)
    check_reach(lookup, layout, options.shadow_map_size)
    lookup = lookup.for_light(scene.lights[0])
    if pictures and len(pictures) != len(scene.lights):
        raise ValueError(
            f"--target: expected one picture for each of {len(scene.lights)} lights, got "
            f"{len(pictures)}"
        )
    technique = Technique(layout, lookup, comparison, model, options.shadow_map_size)
    bias = bias_of(options, technique)
    return scene, technique, bias, pictures


def bias_of(options: Options, technique: Technique) -> Bias:
    """Return the bias that was named, or the usual one of the filter."""
    filter = technique.filter
    bias = default_bias(filter) if options.bias is None else parse_bias(options.bias, filter)
    check_techniques(bias, filter)
    return bias


def targets_of(
    problem: SceneProblem, pictures: Sequence[Float[np.ndarray, "height width"]], noise: float
) -> Float[np.ndarray, "images height width"]:
    """Return the pictures; without any, images of the scene as it is, with noise."""
    if pictures:
        return np.stack(pictures).astype(np.float32)
    images, _ = images_and_derivatives(problem, np.zeros(len(problem.numbers)))
    rng = np.random.default_rng(0)
    return (images + noise * rng.standard_normal(images.shape)).astype(np.float32)


def parse_start(words: Sequence[str], numbers: Sequence[Number]) -> Float[np.ndarray, " numbers"]:
    """Return the amounts of ``NAME=AMOUNT``, in steps.

    Raises:
        ValueError: If a name is not free or an amount is no number.
    """
    vector = np.zeros(len(numbers))
    names = [number.name for number in numbers]
    for word in words:
        name, _, text = word.partition("=")
        if name not in names:
            raise ValueError(f"--start: '{name}' is not free; expected one of {', '.join(names)}")
        try:
            amount = float(text)
        except ValueError:
            amount = np.nan
        if not np.isfinite(amount):
            raise ValueError(f"--start: expected {name}=NUMBER, got '{word}'")
        number = numbers[names.index(name)]
        vector[names.index(name)] = amount / (number.step * number.told)
    return vector


def scene_size(scene: Scene, vertices: np.ndarray) -> float:
    """Return the largest side of the box round some vertices."""
    positions = np.asarray(scene.mesh.positions)[vertices]
    return float(np.max(positions.max(axis=0) - positions.min(axis=0)))


def as_arrays(problem: SceneProblem) -> SceneProblem:
    """Return the problem with arrays in place of numbers, which would be compiled in."""
    return jax.tree.map(jnp.asarray, problem)
