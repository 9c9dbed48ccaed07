"""``python -m experiments fit-normal-map``: a normal map recovered from images."""

import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from ..checks import check_folder, check_scene, check_size, make_folder
from ..console import say, say_notes, stage
from ..files.images import read_image
from ..files.light_file import read_lights
from ..files.map_files import write_normal_map
from ..json_file import check_settings, write_json
from ..provenance import commit, device, versions
from ..rendering.prepare_scene import prepare_scene
from ..rendering.render_command import SceneName
from ..scenes import load_scene
from ..technique_words import ShadingWords, parse_shading
from .fit_normal_map import MapFit
from .normal_map_evidence import Evidence, gather_evidence, seen_texels, undetermined
from .normal_map_report import tell, write_results
from .normal_map_study import MapStudy, errors_of, load_study, make_study, texels_of
from .normal_map_task import Task, Unknowns, free_leaves

_MOST_STEPS = 600


def fit(
    scene: SceneName = "relief",
    /,
    *,
    out: Annotated[Path, tyro.conf.arg(metavar="DIR", help="Folder for the map and pictures.")],
    images: Annotated[
        tuple[Path, ...],
        tyro.conf.arg(
            metavar="IMAGE",
            help="Pictures of the scene's view, EXR or PNG, each under one light, in the "
            "order of the lights; without any, they are made from the scene's own map.",
        ),
    ] = (),
    lights: Annotated[
        Path | None,
        tyro.conf.arg(
            metavar="FILE",
            help="Directions to distant lights instead of the scene's: lines of x y z, world "
            "space, and, if not white, r g b.",
        ),
    ] = None,
    map_size: Annotated[
        tuple[int, int] | None,
        tyro.conf.arg(
            metavar="H W",
            help="Texels of the map.",
            help_behavior_hint="(default: those of the scene's own map, or 256 256)",
        ),
    ] = None,
    image_size: Annotated[
        tuple[int, int], tyro.conf.arg(metavar="H W", help="Pixels of images that are made.")
    ] = (384, 384),
    free: Annotated[
        tuple[str, ...],
        tyro.conf.arg(
            metavar="NAME",
            help="Fitted beside the map: albedo, specular, shininess, ambient of the lighting "
            "model; light.direction, light.color, light.position of every light.",
        ),
    ] = (),
    noise: Annotated[
        float, tyro.conf.arg(metavar="SIGMA", help="Noise on images that are made, of white.")
    ] = 0.0,
    shadow_margin: Annotated[
        int,
        tyro.conf.arg(
            metavar="N", help="Pixels round shadows' edges in given images that do not count."
        ),
    ] = 1,
    shading: ShadingWords = ("phong",),
    steps: Annotated[
        int, tyro.conf.arg(metavar="N", help="Solver steps between progress and pictures.")
    ] = 20,
    resume: Annotated[
        bool, tyro.conf.arg(help="Go on where a fit into the same folder was stopped.")
    ] = False,
) -> None:
    """Recover a normal map, and on request material and lights, from images under known lights.

    Where the images are made, the error against the true map is told. Texels that fewer than
    three lights reach are counted and marked: two lights leave pairs of normals that explain
    both images. Writes the map (normal_map.exr, .png), how well each texel is known
    (evidence.exr), pictures, and summary.json; state.eqx lets a stopped fit go on.
    """
    _check_options(out, images, image_size, map_size, noise, shadow_margin, steps)
    model = parse_shading(shading)
    pictures = [read_image(path) for path in images]
    distant = None if lights is None else read_lights(lights)
    with stage(f"loading {scene}"):
        loaded = load_scene(scene)
        if distant is not None:
            loaded = loaded._replace(lights=distant)
        loaded = prepare_scene(loaded, tangents=True)
        check_scene(loaded)
    say_notes(loaded.notes)
    with stage("finding pixels and shadows"):
        if pictures:
            limit = 1.0 if any(path.suffix.lower() == ".png" for path in images) else np.inf
            study = load_study(
                loaded, model, pictures,
                map_size=map_size, limit=limit, shadow_margin=shadow_margin,
            )  # fmt: skip
        else:
            study = make_study(loaded, model, image_size=image_size, noise=noise)
    task = Task(study.seen.view, study.targets)
    settings = {
        "scene": scene, "images": [str(path) for path in images],
        "lights": None if lights is None else str(lights), "map_size": list(task.view.map_size),
        "image_size": list(study.images[0].shape[:2]), "free": list(free), "noise": noise,
        "shadow_margin": shadow_margin, "shading": list(shading),
    }  # fmt: skip
    make_folder(out)
    start = time.perf_counter()
    with stage("compiling"):
        under_way = MapFit(task, study.shading, study.lights, free=free)
        if resume:
            check_settings(out / "settings.json", settings)
            under_way.restore(out / "state.eqx")
        under_way.advance(0)
    compile_seconds = time.perf_counter() - start
    write_json(out / "settings.json", settings)
    history = _run(under_way, task, study, out, steps)
    unknowns = under_way.unknowns
    with stage("judging and drawing"):
        evidence = gather_evidence(task, unknowns)
        unclear = undetermined(task, unknowns, free)
        summary = _summary(study, task, unknowns, evidence, under_way, history, free, unclear)
        write_results(out, study, task, (under_way.start, unknowns), evidence, history)
    seconds = {"fit": history[-1]["seconds"], "compile": compile_seconds}
    made_with = {"versions": versions(), "device": device(), "commit": commit()}
    write_json(
        out / "summary.json", {"settings": settings, **summary, "seconds": seconds, **made_with}
    )
    tell(study, summary, seconds)
    say(f"map and pictures: {out} (start with comparison.png; figures in summary.json)")


def _check_options(
    out: Path,
    images: Sequence[Path],
    image_size: tuple[int, int],
    map_size: tuple[int, int] | None,
    noise: float,
    shadow_margin: int,
    steps: int,
) -> None:
    check_folder(out)
    check_size("--image-size", *image_size)
    if map_size is not None:
        check_size("--map-size", *map_size)
    if images and noise:
        raise ValueError("--noise: is for images that are made, and --images gives some; drop one")
    if not 0 <= noise < np.inf:
        raise ValueError(f"--noise: expected a number of at least 0, got {noise}")
    if shadow_margin < 0:
        raise ValueError(f"--shadow-margin: expected at least 0 pixels, got {shadow_margin}")
    if steps < 1:
        raise ValueError(f"--steps: expected at least 1, got {steps}")


def _run(
    under_way: MapFit, task: Task, study: MapStudy, out: Path, steps: int
) -> list[dict[str, int | float]]:
    """Solve to the end; after every few steps tell the loss, draw the map, store the state."""
    history: list[dict[str, int | float]] = []
    seconds = 0.0
    seen = seen_texels(task.view)
    value = jax.jit(lambda task, unknowns: sum(jnp.sum(r**2) for r in task.residuals(unknowns)))
    with stage("fitting") as report:
        while True:
            unknowns = under_way.unknowns
            row = {
                "step": under_way.steps,
                "seconds": seconds,
                "loss": 0.5 * float(value(task, unknowns)),
            }
            if study.truth is not None:
                row["mean_error"] = float(errors_of(study, unknowns.slopes)[seen].mean())
            history.append(row)
            report(", ".join(f"{name} {number:.4g}" for name, number in row.items()))
            write_normal_map(out / "progress.png", texels_of(unknowns.slopes), bits=8)
            under_way.store(out / "state.eqx")
            if under_way.converged or under_way.steps >= _MOST_STEPS:
                return history
            start = time.perf_counter()
            under_way.advance(steps)
            seconds += time.perf_counter() - start


def _summary(
    study: MapStudy,
    task: Task,
    unknowns: Unknowns,
    evidence: Evidence,
    under_way: MapFit,
    history: Sequence[Mapping[str, int | float]],
    free: Sequence[str],
    unclear: Sequence[str],
) -> dict[str, Any]:
    known = evidence.known
    summary: dict[str, Any] = {
        "texels": int(known.size),
        "seen": int(evidence.seen.sum()),
        "known": int(known.sum()),
        "lights": {str(k): int((evidence.lights == k).sum()) for k in range(len(study.lights) + 1)},
        "rms_residual": evidence.noise,
        "standard_error_degrees": float(np.median(evidence.standard_error[known]))
        if known.any()
        else None,
        "numbers": {
            name: {
                "start": np.asarray(where(under_way.start)).tolist(),
                "fit": np.asarray(where(unknowns)).tolist(),
            }
            for name, where in free_leaves(unknowns, free)
        },
        "undetermined": list(unclear),
        "steps": under_way.steps,
        "converged": under_way.converged,
        "history": list(history),
        "notes": list(study.scene.notes),
    }
    if study.truth is not None:
        errors = errors_of(study, unknowns.slopes)
        for name, where in (("known", known), ("seen", evidence.seen)):
            picked = errors[where]
            summary[f"error_degrees_{name}"] = {
                "mean": float(picked.mean()) if picked.size else None,
                "max": float(picked.max()) if picked.size else None,
            }
    return summary
