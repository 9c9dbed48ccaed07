"""``python -m experiments bake-light``: a scene's light and shadows in a light map."""

from pathlib import Path
from typing import Annotated

import tyro

from ..checks import check_out, check_scene
from ..console import say, say_notes, stage
from ..rendering.prepare_scene import prepare_scene
from ..rendering.render_command import SceneName
from ..scenes import load_scene
from ..technique_words import choose_layout
from .bake_light import bake_light_map, write_light_map


def bake(
    scene: SceneName = "default",
    /,
    *,
    out: Annotated[Path, tyro.conf.arg(metavar="MAP", help="File to write, .exr.")],
    size: Annotated[int, tyro.conf.arg(metavar="N", help="Texels on each side of the map.")] = 512,
    samples: Annotated[
        int, tyro.conf.arg(metavar="N", help="N x N points for each texel, averaged.")
    ] = 2,
    margin: Annotated[
        int,
        tyro.conf.arg(metavar="N", help="Texels round the charts that repeat what is inside."),
    ] = 4,
) -> None:
    """Trace a scene's diffuse light and shadows into a light map, for render --light-map.

    The map holds linear radiance times cosine, R G B, and the face at each texel. Charts are
    the scene's uvs where they serve, else new ones, the same in every run.
    """
    check_out(out, ".exr")
    with stage(f"loading {scene}"):
        loaded = prepare_scene(load_scene(scene))
        check_scene(loaded, choose_layout(loaded, ()))
    say_notes(loaded.notes)
    with stage("baking"):
        baked = bake_light_map(loaded, size=size, samples=samples, margin=margin)
    say_notes(baked.notes)
    write_light_map(out, baked)
    say(f"wrote {out}: {baked.charted.mean():.1%} of its texels in charts")
