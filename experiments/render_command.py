"""``python -m experiments render``: one image of a scene, with its shadow map."""

from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import tyro

from shadows.bias import Bias, CombinedBias
from shadows.compare import Compare
from shadows.filters import Filter
from shadows.render import Rendering

from .checks import check_out, check_scene, check_shadow_map, check_size
from .console import say, say_notes, stage
from .figures import on_background
from .images import Channels, write_exr, write_png
from .options import describe, parse_technique, parse_techniques
from .render_scene import SHADINGS, render_scene
from .scenes import EMBEDDED, load_scene

SceneName = Annotated[
    str,
    tyro.conf.Positional,
    tyro.conf.arg(
        metavar="SCENE",
        help=f"A mesh or glTF file (.obj .ply .stl .gltf .glb), or one of: {', '.join(EMBEDDED)}.",
    ),
]
ImageSize = Annotated[tuple[int, int], tyro.conf.arg(metavar="H W", help="Pixels of the image.")]
MapSize = Annotated[int, tyro.conf.arg(metavar="N", help="Texels on each side of the shadow map.")]
BiasWords = Annotated[
    tuple[str, ...],
    tyro.conf.arg(
        metavar="NAME[=VALUE]",
        help="Biases, one after another; no word for no bias. " + "; ".join(describe(Bias)) + ".",
    ),
]
CompareWord = Annotated[
    str,
    tyro.conf.arg(metavar="NAME[=VALUE]", help="Comparison. " + "; ".join(describe(Compare)) + "."),
]
FilterWord = Annotated[
    str, tyro.conf.arg(metavar="NAME", help="Lookup. " + "; ".join(describe(Filter)) + ".")
]
CullFront = Annotated[
    bool, tyro.conf.arg(help="Draw only faces turned away from the light into the shadow map.")
]
ShadingName = Annotated[
    Literal["blinn-phong", "phong", "lambert"], tyro.conf.arg(help="Lighting model of the picture.")
]


def render(
    scene: SceneName = "default",
    /,
    *,
    out: Annotated[Path, tyro.conf.arg(metavar="IMAGE", help="File to write, .exr or .png.")],
    png_out: Annotated[
        Path | None, tyro.conf.arg(metavar="PNG", help="Also write the color as PNG.")
    ] = None,
    shadow_map_out: Annotated[
        Path | None, tyro.conf.arg(metavar="MAP", help="Also write the shadow map, .exr.")
    ] = None,
    image_size: ImageSize = (512, 512),
    shadow_map_size: MapSize = 1024,
    bias: BiasWords = ("slope=2",),
    compare: CompareWord = "hard",
    filter: FilterWord = "bilinear",
    cull_front: CullFront = False,
    shading: ShadingName = "blinn-phong",
) -> None:
    """Render a scene under its first light with a shadow map.

    An EXR holds linear color R G B, depth.Z (window depth in [0, 1]), normal.X Y Z (world
    space) and visibility.V (1 = lit); the shadow map's file holds depth.Z in [0, 1].
    """
    check_out(out, ".exr", ".png")
    for extra, suffix in ((png_out, ".png"), (shadow_map_out, ".exr")):
        if extra is not None:
            check_out(extra, suffix)
    check_size("--image-size", *image_size)
    check_size("--shadow-map-size", shadow_map_size)
    terms = CombinedBias(parse_techniques(Bias, bias, option="--bias"))
    comparison = parse_technique(Compare, compare, option="--compare", least=0.0)
    lookup = parse_technique(Filter, filter, option="--filter")
    with stage(f"loading {scene}"):
        loaded = load_scene(scene)
        check_scene(loaded)
    say_notes(loaded.notes)
    with stage("compiling and rendering"):
        image = render_scene(
            loaded,
            image_size=image_size,
            map_size=shadow_map_size,
            bias=terms,
            filter=lookup,
            compare=comparison,
            shading=SHADINGS[shading],
            cull_front=cull_front,
        )
    check_shadow_map(loaded, image.shadow_map, cull_front=cull_front)
    if not bool(image.surface.covered.any()):
        say_notes(["the camera sees no surface; the image is empty"])
    if out.suffix.lower() == ".exr":
        write_exr(out, image_channels(image))
    for path in (png_out, out if out.suffix.lower() == ".png" else None):
        if path is not None:
            write_png(
                path, on_background(np.asarray(image.color), np.asarray(image.surface.covered))
            )
    if shadow_map_out is not None:
        write_exr(shadow_map_out, shadow_map_channels(image))
    for path in (out, png_out, shadow_map_out):
        if path is not None:
            say(f"wrote {path}")


def image_channels(image: Rendering) -> Channels:
    """Return the channels of an image's EXR file."""
    color, normal = np.asarray(image.color), np.asarray(image.surface.normal)
    return {
        **{name: color[..., k] for k, name in enumerate("RGB")},
        "depth.Z": np.asarray(image.surface.depth),
        **{f"normal.{name}": normal[..., k] for k, name in enumerate("XYZ")},
        "visibility.V": np.asarray(image.visibility),
    }


def shadow_map_channels(image: Rendering) -> Channels:
    """Return the channel of a shadow map's EXR file."""
    return {"depth.Z": np.asarray(image.shadow_map.depth)}
