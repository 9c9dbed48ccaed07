"""``python -m experiments derivatives``: how an image changes with the numbers of its scene."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import tyro

from shadows.silhouettes import mesh_edges

from ..checks import check_folder, check_reach, check_scene, check_size, make_folder
from ..console import say, say_notes, say_table, stage
from ..files.images import write_exr
from ..json_file import write_json
from ..mesh_parts import Part, mesh_parts
from ..provenance import commit, device, versions
from ..rendering.prepare_scene import prepare_scene
from ..rendering.render_command import ImageSize, MapSize, SceneName
from ..scene import Scene
from ..scenes import load_scene
from ..technique_words import (
    BiasWords,
    CompareWords,
    FilterWords,
    LayoutWords,
    ShadingWords,
    choose_layout,
    least_filter,
    parse_bias,
    parse_lookup,
    parse_shading,
)
from .derivative_pictures import Against, Derivatives, Sizes, derivatives, save_derivatives
from .scene_parameters import (
    Parameter,
    Setup,
    choose_parameters,
    scene_parameters,
)

_SHOWN_PARTS = 4
_CANCELS = 0.05  # mean over mean size below which an error relative to the mean says nothing
_HEADER = (
    "change of the mean image with", "forward", "difference", "mean size", "error",
    "error in 4x4 boxes", "without coverage: error", "in 4x4 boxes",
)  # fmt: skip


def derive(
    scene: SceneName = "default",
    /,
    *,
    of: Annotated[
        tuple[str, ...],
        tyro.conf.arg(
            metavar="PARAMETER",
            help="Numbers of the scene: mesh.shift.x (all but the floor), mesh.turn.y (degrees), "
            "mesh.scale, part2.shift.x (one part alone); light.position.x, light.direction.y, "
            "light.color.r and so on, light2 the second light; camera.position.x, "
            "camera.vertical_fov; constant.length and other numbers of bias, filter, comparison.",
        ),
    ],
    out: Annotated[Path, tyro.conf.arg(metavar="DIR", help="Folder for pictures and numbers.")],
    against: Annotated[
        Against,
        tyro.conf.arg(
            help="Differences of images traced by rays, or rendered with the same shadow maps; "
            "always the latter in what rays do not know, as a bias."
        ),
    ] = "rays",
    image_size: ImageSize = (256, 256),
    shadow_map_size: MapSize = 512,
    layout: LayoutWords = (),
    bias: BiasWords = None,
    compare: CompareWords = (),
    filter: FilterWords = (),
    shading: ShadingWords = ("blinn-phong",),
) -> None:
    """Show how each pixel changes with a number of the scene: forward mode beside differences.

    For each number a picture of four panels: the derivative in forward mode through coverage, that
    by central differences of images with many points in each pixel, the first minus the second,
    and the derivative without coverage, which sees no edge move. The table tells how the mean
    image changes, and the mean size of what changes; errors are shares of the difference: of the
    mean ("-" where more and less cancel out), and of all means over 4 x 4 pixels. A shadow map
    finer than the pixels makes pictures noisy: its edges fall between the pixels' centres. Writes
    PARAMETER.png, PARAMETER.exr (forward.Y, difference.Y, uncovered.Y) and derivatives.json.
    """
    if not of:
        raise ValueError("--of: name at least one number of the scene, as mesh.shift.x")
    check_folder(out)
    check_size("--image-size", *image_size)
    check_size("--shadow-map-size", shadow_map_size)
    lookup, comparison = parse_lookup(filter, compare)
    terms = parse_bias(bias, lookup)
    model = parse_shading(shading)
    with stage(f"loading {scene}"):
        loaded = prepare_scene(load_scene(scene))
        maps = choose_layout(loaded, layout)
        if not filter:
            lookup, _ = parse_lookup(least_filter(loaded), ())
            terms = parse_bias(bias, lookup)
        check_scene(loaded, maps)
        check_reach(lookup, maps, shadow_map_size)
        setup = Setup.of(loaded, terms, lookup, comparison)
        parts = mesh_parts(loaded.mesh, mesh_edges(loaded.mesh.positions, loaded.mesh.faces))
        chosen = choose_parameters(of, scene_parameters(setup, parts, image_size[0]))
    say_notes([*loaded.notes, *_part_notes(parts)])
    found: dict[str, Derivatives] = {}
    for parameter in chosen:
        with stage(f"compiling and differentiating in {parameter.name}"):
            found[parameter.name] = derivatives(
                loaded,
                setup,
                parameter,
                sizes=Sizes(image_size, shadow_map_size),
                layout=maps,
                shading=model,
                against=against,
            )
    make_folder(out)
    _write(chosen, found, loaded, out, against=against, settings={
        "scene": scene, "image_size": image_size, "shadow_map_size": shadow_map_size,
        "against": against, "techniques": [repr(t) for t in (terms, lookup, comparison, maps)],
    })  # fmt: skip
    seen = [p for p in chosen if found[p.name].moves(p)]
    if seen:
        say_table(f"{loaded.name}:", _HEADER, [_row(p, found[p.name]) for p in seen])
    for parameter in chosen:
        if parameter not in seen:
            say(f"{parameter.name}: moves no pixel of this view")
    say(f"pictures and numbers: {out}")


def _part_notes(parts: Sequence[Part]) -> list[str]:
    if len(parts) == 1:
        return []
    sizes = [f"{part.faces} faces, {' x '.join(f'{s:.3g}' for s in part.size)}" for part in parts]
    notes = [f"part{k + 1}: {size}" for k, size in enumerate(sizes[:_SHOWN_PARTS])]
    notes[0] += "; taken for the floor, 'mesh' is the others"
    if len(parts) > _SHOWN_PARTS:
        notes.append("and smaller parts")
    return notes


def _write(
    chosen: Sequence[Parameter],
    found: dict[str, Derivatives],
    scene: Scene,
    out: Path,
    *,
    against: Against,
    settings: dict[str, Any],
) -> None:
    """Write a picture for each number that moves anything, and all figures."""
    rows = []
    for parameter in chosen:
        derivative = found[parameter.name]
        moves = derivative.moves(parameter)
        if moves:
            save_derivatives(
                out / f"{parameter.name}.png", derivative, parameter,
                title=scene.name, against=against,
            )  # fmt: skip
            channels = {f"{kind}.Y": image for kind, image in derivative._asdict().items()}
            write_exr(out / f"{parameter.name}.exr", channels)
        rows.append({
            "parameter": parameter.name, "unit": parameter.unit, "step": parameter.step,
            "against": against if parameter.traced else "maps", "moves": moves,
            "difference": float(derivative.difference.mean()), "mean_size": derivative.size(),
            "forward": _figures(derivative, derivative.forward),
            "without_coverage": _figures(derivative, derivative.uncovered),
        })  # fmt: skip
    made_with = {"versions": versions(), "device": device(), "commit": commit()}
    content = {"settings": settings, "derivatives": rows, **made_with}
    write_json(out / "derivatives.json", content)


def _figures(derivative: Derivatives, image: Any) -> dict[str, float | None]:
    return {
        "mean": float(image.mean()),
        "mean_error": derivative.mean_error(image),
        "error_in_boxes": derivative.error(image),
    }


def _row(parameter: Parameter, derivative: Derivatives) -> list[str]:
    size, errors = derivative.size(), []
    cancels = abs(derivative.difference.mean()) < _CANCELS * size
    for image in (derivative.forward, derivative.uncovered):
        for error in (None if cancels else derivative.mean_error(image), derivative.error(image)):
            errors.append("-" if error is None else f"{error:.2%}")
    means = [f"{image.mean():.6f}" for image in (derivative.forward, derivative.difference)]
    means.append(f"{size:.6f}")
    return [f"{parameter.name}, {parameter.unit}", *means, *errors]
