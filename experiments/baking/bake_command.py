"""``python -m experiments bake-normals``: the detail of one mesh as a normal map of another."""

from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from tangentspace.mesh import Mesh

from ..checks import check_folder, check_out, make_folder
from ..console import say, say_notes, stage
from ..files.framing import FLOOR
from ..files.map_files import write_normal_map
from ..files.mesh_file import load_scene_file
from .bake_normals import bake_normals, check_options
from .bake_pictures import render_bake, save_bake_pictures


def bake(
    high: Annotated[
        Path,
        tyro.conf.Positional,
        tyro.conf.arg(metavar="HIGH", help="The detailed mesh (.obj .ply .stl .gltf .glb)."),
    ],
    low: Annotated[
        Path,
        tyro.conf.Positional,
        tyro.conf.arg(metavar="LOW", help="The low-poly mesh, with UVs, in the same place."),
    ],
    /,
    *,
    out: Annotated[
        Path, tyro.conf.arg(metavar="MAP", help="File to write, .exr or .png (16 bits).")
    ],
    size: Annotated[int, tyro.conf.arg(metavar="N", help="Texels on each side of the map.")] = 1024,
    cage: Annotated[
        float | None,
        tyro.conf.arg(
            metavar="DISTANCE",
            help="How far out of and into the low-poly surface detail is looked for, world length.",
            help_behavior_hint="(default: found from the meshes)",
        ),
    ] = None,
    samples: Annotated[
        int, tyro.conf.arg(metavar="N", help="N x N rays for each texel, averaged.")
    ] = 3,
    margin: Annotated[
        int,
        tyro.conf.arg(metavar="N", help="Texels round the charts that repeat what is inside."),
    ] = 16,
    pictures: Annotated[
        Path | None,
        tyro.conf.arg(metavar="DIR", help="Also write comparison.png: both meshes, map, errors."),
    ] = None,
) -> None:
    """Bake a tangent-space normal map for a low-poly mesh from a detailed one.

    Rays go inwards from the low-poly surface pushed out by the cage's distance along its
    smooth normals, and stop as far behind it; the outermost face of the detailed mesh counts.
    Normals are raw, green +Y, for MikkTSpace tangents (or those of the low-poly file).
    """
    check_out(out, ".exr", ".png")
    if pictures is not None:
        check_folder(pictures)
    check_options(size=size, cage=cage, samples=samples, margin=margin, prefix="--")
    with stage(f"loading {high} and {low}"):
        high_mesh, low_mesh = _load_mesh(high), _load_mesh(low)
    with stage("baking") as report:
        baked = bake_normals(
            high_mesh,
            low_mesh,
            size=size,
            cage=cage,
            samples=samples,
            margin=margin,
            names=(str(high), str(low)),
            report=report,
        )
    say_notes([f"{low}: {note}" for note in baked.notes])
    write_normal_map(out, baked.texels)
    say(f"wrote {out}: {baked.charted.mean():.1%} of its texels in charts, cage {baked.cage:.4g}")
    if pictures is None:
        return
    make_folder(pictures)
    comparison = pictures / "comparison.png"
    with stage("rendering both meshes"):
        views = render_bake(high_mesh, low_mesh, baked)
        save_bake_pictures(
            comparison,
            views,
            baked.texels,
            faces=(len(high_mesh.faces), len(low_mesh.faces)),
            title=f"{high.name} baked onto {low.name}",
        )
    say(f"wrote {comparison}")
    errors = (views.low_error, views.mapped_error, views.map_error)
    before, after, own = (f"{np.nanmean(error):.3g}" for error in errors)
    say(f"mean angle to the detailed normals in a pixel: {before} degrees, with the map {after}")
    say(f"of these, at the same points of the surface: {own}")


def _load_mesh(path: Path) -> Mesh:
    """Load the mesh of a file, without the floor that its scene gets, and say what is odd."""
    scene = load_scene_file(path)
    mesh, notes = scene.mesh, scene.notes
    if scene.materials[-1] is FLOOR:
        notes = [note for note in notes if "floor" not in note]
        faces = np.asarray(mesh.faces)[scene.face_materials < len(scene.materials) - 1]
        count = faces.max() + 1  # the floor's vertices come last
        mesh = Mesh(
            mesh.positions[:count],
            mesh.normals[:count],
            faces,
            None if mesh.uvs is None else mesh.uvs[:count],
            None if mesh.tangents is None else mesh.tangents[:count],
        )
    say_notes([f"{path}: {note}" for note in notes])
    return mesh
