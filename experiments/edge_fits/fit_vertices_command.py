"""``python -m experiments fit-vertices``: a caster's vertices from its shadow, shadow art."""

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np
import trimesh
import tyro
from jaxtyping import Float

from shadows import Bias, mesh_edges

from ..checks import make_folder
from ..console import say, say_notes, stage
from ..files.images import atomic_path
from ..json_file import check_settings, read_json, write_json
from ..mesh_parts import split_caster
from ..panels import Curve
from ..provenance import commit, device, versions
from ..rendering.prepare_scene import prepare_scene
from ..rendering.render_command import ImageSize, MapSize, SceneName
from ..scene import Scene
from ..scenes import load_scene
from ..technique_words import BiasWords, CompareWords, FilterWords, LayoutWords, ShadingWords
from .fit_options import (
    Adam,
    Noise,
    Options,
    Resume,
    Start,
    Targets,
    as_arrays,
    bias_of,
    load,
    parse_start,
    scene_size,
    targets_of,
)
from .run_fit import Fit, draw_images, draw_progress, run_fit
from .scene_numbers import SceneProblem, State, vertex_numbers
from .shadow_view import ShadowView, Technique
from .smooth_fit import SmoothFit, Surface, rows_and_links, uniform_adam

_STEP = 0.01  # of the caster's size
_ADAM_RATE = 5.0  # steps

Images = Float[np.ndarray, "images height width"]


def fit(
    scene: SceneName = "sphere",
    /,
    *,
    out: Annotated[Path, tyro.conf.arg(metavar="DIR", help="Folder for mesh, pictures, figures.")],
    target: Targets = (),
    shape: Annotated[
        str,
        tyro.conf.arg(
            metavar="SCENE",
            help="Without --target: fit to the shadow of this scene's or mesh's caster, brought "
            "to the size and place of the one that is fitted.",
        ),
    ] = "bracket",
    vertices: Annotated[
        tuple[int, ...],
        tyro.conf.arg(
            metavar="N",
            help="Move these vertices alone (with all at their places), by least squares; the "
            "target is then made from the scene as it is.",
            help_behavior_hint="(default: all of the caster)",
        ),
    ] = (),
    start: Annotated[
        Start, tyro.conf.arg(help_behavior_hint="(with --vertices; default: x=0.2 of the size)")
    ] = (),
    smoothness: Annotated[
        float,
        tyro.conf.arg(
            metavar="LAMBDA", help="How far a pull at one vertex is shared; 0 for not at all."
        ),
    ] = 20.0,
    steps: Annotated[int, tyro.conf.arg(metavar="N", help="Solver steps at most.")] = 200,
    noise: Noise = 0.0,
    adam: Adam = 0,
    layout: LayoutWords = (),
    bias: BiasWords = None,
    filter: FilterWords = ("bilinear",),
    compare: CompareWords = (),
    shading: ShadingWords = ("blinn-phong",),
    image_size: ImageSize = (256, 256),
    shadow_map_size: MapSize = 256,
    resume: Resume = False,
) -> None:
    """Move the vertices of a caster until its shadow is that of the target.

    The camera sees the ground alone: the part of the mesh with the largest box; all else is
    the caster. Writes the caster (caster.ply), comparison.png, progress_curve.png, summary.json;
    a stopped fit goes on with --resume.
    """
    options = Options(
        scene, out, target, 1, noise, adam, layout, bias, filter, compare, shading,
        image_size, shadow_map_size,
    )  # fmt: skip
    if not 0 <= smoothness < np.inf or steps < 1:
        raise ValueError("--smoothness: expected at least 0, and --steps at least 1")
    with stage(f"loading {scene}"):
        loaded, technique, chosen_bias, pictures = load(options)
        casts, caster = split_caster(loaded.mesh)
        view = ShadowView.of(loaded, technique, image_size=image_size, seen=~casts)
    say_notes(loaded.notes)
    settings = options.settings | {
        "shape": shape, "vertices": list(vertices), "start": list(start),
        "smoothness": smoothness, "steps": steps,
    }  # fmt: skip
    if vertices:
        problem = _single_vertices(loaded, view, caster, vertices, chosen_bias)
        words = start or ([] if pictures else [_usual_start(problem)])
        first = parse_start(words, problem.numbers)
        targets = targets_of(problem, pictures, noise)
        truth = None if pictures else np.zeros(len(first))
        title = f"{loaded.name}: vertices from shadows"
        make_folder(out)
        run_fit(
            Fit(title, problem, targets, [first], truth, noise, adam), out, settings, resume=resume
        )
        return
    if start:
        raise ValueError("--start: is for --vertices; name some, or leave it out")
    with stage("reading the target" if pictures else f"making the target from {shape}"):
        surface = _surface(loaded, view, caster, chosen_bias, smoothness)
        targets = (
            np.stack(pictures) if pictures else _shape_images(loaded, technique, options, shape)
        )
        targets = targets.astype(np.float32)
    make_folder(out)
    _fit_all(loaded, surface, casts, targets, out, settings, resume=resume)


def _fit_all(
    loaded: Scene,
    surface: Surface,
    casts: np.ndarray,
    targets: Images,
    out: Path,
    settings: dict[str, Any],
    *,
    resume: bool,
) -> None:
    steps, adam = settings["steps"], settings["adam"]
    with stage("compiling, and looking at the start"):
        under_way = SmoothFit(surface, jnp.asarray(targets), steps)
        images = jax.jit(Surface.images)
        first = np.asarray(images(surface, under_way.unknowns))
        if float(jnp.max(jnp.abs(under_way.pull))) == 0:
            raise ValueError(
                "fit: the images do not change with the caster's vertices; no edge of its "
                "shadow is in view"
            )
    rms = lambda image: float(np.sqrt(np.mean((image - targets) ** 2)))
    history: list[dict[str, float]] = [{"evaluations": 1, "rms": rms(first), "seconds": 0.0}]
    if resume:
        check_settings(out / "settings.json", settings)
        history = read_json(out / "history.json")
        under_way.restore(out / "state.eqx")
    write_json(out / "settings.json", settings)
    with stage("fitting") as report:
        while not under_way.ended:
            begin = time.perf_counter()
            under_way.advance(10)
            row = {
                "evaluations": 1 + under_way.steps,
                "rms": rms(np.asarray(images(surface, under_way.unknowns))),
                "seconds": history[-1]["seconds"] + time.perf_counter() - begin,
            }
            history.append(row)
            under_way.store(out / "state.eqx")
            write_json(out / "history.json", history)
            report(f"{under_way.steps} steps, blur {under_way.blur:.3g}, rms {row['rms']:.4g}")
    last = np.asarray(images(surface, under_way.unknowns))
    title = f"{loaded.name}: all vertices from shadows"
    curves = {
        "L-BFGS, blurred to sharp": Curve(
            [row["evaluations"] for row in history], [row["rms"] for row in history]
        )
    }
    summary: dict[str, Any] = {
        "unknowns": int(3 * np.max(np.asarray(surface.places))),
        "rms": history[-1]["rms"], "loss": history[-1]["rms"] ** 2, "history": history,
    }  # fmt: skip
    if adam:
        with stage("Adam beside it") as report:
            summary["adam"] = uniform_adam(
                surface, jnp.asarray(targets), steps=adam, rate=_ADAM_RATE, report=report
            )
        name = "Adam with one second moment, sharp"
        curves[name] = Curve(list(range(1, 1 + adam)), summary["adam"])
    _write_caster(out / "caster.ply", loaded, surface, under_way.unknowns, casts)
    made_with = {"versions": versions(), "device": device(), "commit": commit()}
    write_json(out / "summary.json", {"settings": settings, **summary, **made_with})
    draw_images(out, title, first, targets, last)
    draw_progress(out, title, curves)
    contrast = float(np.std(targets))
    say(
        f"{title}: rms {summary['rms']:.3g} (mean square {summary['loss']:.3g}), "
        f"{summary['rms'] / contrast:.1%} of the target's contrast, {history[-1]['evaluations']} "
        f"evaluations, {history[-1]['seconds']:.1f} s with compilation"
    )
    if adam:
        say(f"Adam: rms {min(summary['adam']):.3g} in {adam} evaluations")
    say(f"caster, pictures and figures: {out} (start with comparison.png)")


def _single_vertices(
    loaded: Scene,
    view: ShadowView,
    caster: np.ndarray,
    vertices: Sequence[int],
    bias: Bias,
) -> SceneProblem:
    """Return the problem of a few vertices, each with all at its place."""
    positions = np.asarray(loaded.mesh.positions)
    wrong = [v for v in vertices if v not in caster]
    if wrong:
        raise ValueError(
            f"--vertices: expected vertices of the caster, from {caster.min()} to {caster.max()}, "
            f"got {wrong[0]}"
        )
    moved, rows = [], []
    for row, vertex in enumerate(vertices):
        same = np.flatnonzero((positions == positions[vertex]).all(axis=1))
        moved += same.tolist()
        rows += [row] * len(same)
    zero, offsets = np.zeros(3, np.float32), np.zeros((len(vertices), 3), np.float32)
    states = tuple(State(zero, zero, light, bias, offsets) for light in loaded.lights)
    numbers = vertex_numbers(vertices, size=scene_size(loaded, caster))
    return as_arrays(
        SceneProblem(view, positions, caster[:0], states, numbers, np.array(moved), np.array(rows))
    )


def _usual_start(problem: SceneProblem) -> str:
    number = problem.numbers[0]
    return f"{number.name}={20 * number.step * number.told}"


def _surface(
    loaded: Scene, view: ShadowView, caster: np.ndarray, bias: Bias, smoothness: float
) -> Surface:
    positions = np.asarray(loaded.mesh.positions)
    _, index, inverse = np.unique(positions, axis=0, return_index=True, return_inverse=True)
    first = index[inverse.reshape(-1)]
    edges = mesh_edges(positions, loaded.mesh.faces)
    places, links = rows_and_links(np.asarray(edges.vertices), first, caster)
    step = _STEP * scene_size(loaded, caster)
    surface = Surface(
        view, positions, places, links.astype(np.int32), loaded.lights, bias, smoothness, step
    )
    return jax.tree.map(jnp.asarray, surface)


def _shape_images(loaded: Scene, technique: Technique, options: Options, shape: str) -> Images:
    """Return images of the shadow of another caster, brought into the box of this one."""
    other = prepare_scene(load_scene(shape))
    theirs, vertices = split_caster(other.mesh)
    casts, own = split_caster(loaded.mesh)
    box = np.asarray(loaded.mesh.positions)[own]
    points = np.asarray(other.mesh.positions)[vertices]
    middle = lambda p: 0.5 * (p.min(axis=0) + p.max(axis=0))
    scale = np.max(box.max(axis=0) - box.min(axis=0)) / np.max(
        points.max(axis=0) - points.min(axis=0)
    )
    points = middle(box) + scale * (points - middle(points))
    place = np.zeros(len(other.mesh.positions), np.int64)
    place[vertices] = np.arange(len(vertices))
    ground = np.asarray(loaded.mesh.faces)[~casts]
    count = len(loaded.mesh.positions)
    faces = np.concatenate([ground, count + place[other.mesh.faces[theirs]]]).astype(np.int32)
    positions = np.concatenate([loaded.mesh.positions, points]).astype(np.float32)
    normals = np.concatenate([loaded.mesh.normals, np.tile([0, 1, 0], (len(points), 1))])
    mesh = loaded.mesh._replace(
        positions=positions, normals=normals.astype(np.float32), faces=faces, uvs=None,
        tangents=None,
    )  # fmt: skip
    materials = np.zeros(len(faces), np.int32)
    materials[: len(ground)] = loaded.face_materials[~casts]
    scene = loaded._replace(mesh=mesh, face_materials=materials)
    seen = np.arange(len(faces)) < len(ground)
    view = ShadowView.of(scene, technique, image_size=options.image_size, seen=seen)
    image = jax.jit(ShadowView.image)
    bias = bias_of(options, technique)
    return np.stack([np.asarray(image(view, positions, light, bias)) for light in loaded.lights])


def _write_caster(
    path: Path, loaded: Scene, surface: Surface, unknowns: Any, casts: np.ndarray
) -> None:
    positions = np.asarray(surface.moved(unknowns))
    faces = np.asarray(loaded.mesh.faces)[casts]
    used, local = np.unique(faces, return_inverse=True)
    mesh = trimesh.Trimesh(positions[used], local.reshape(faces.shape), process=False)
    with atomic_path(path) as temporary:
        mesh.export(temporary, file_type="ply")
