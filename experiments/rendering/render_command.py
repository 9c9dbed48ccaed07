"""``python -m experiments render``: one image of a scene, with its shadow map."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated

import jax.numpy as jnp
import numpy as np
import tyro
from jaxtyping import Array

from shadows.coverage import blend_layers
from shadows.render import Rendering
from shadows.shadow_map import ShadowMap
from shadows.shafts import Medium

from ..baking.bake_light import read_light_map
from ..checks import check_out, check_reach, check_scene, check_shadow_map, check_size
from ..console import say, say_notes, stage
from ..figures import on_background
from ..files.images import Channels, write_exr, write_png
from ..scenes import EMBEDDED, load_scene
from ..scenes.failure_scenes import FAILURE_SCENES
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
from .prepare_scene import prepare_scene
from .render_scene import Shadows, render_light_map, render_scene
from .scene_maps import with_maps, without_normal_maps

SceneName = Annotated[
    str,
    tyro.conf.Positional,
    tyro.conf.arg(
        metavar="SCENE",
        help=f"A mesh or glTF file (.obj .ply .stl .gltf .glb), or one of: {', '.join(EMBEDDED)}; "
        f"scenes that break techniques: {', '.join(FAILURE_SCENES)}.",
    ),
]
ImageSize = Annotated[tuple[int, int], tyro.conf.arg(metavar="H W", help="Pixels of the image.")]
MapSize = Annotated[int, tyro.conf.arg(metavar="N", help="Texels on each side of the shadow map.")]
MapFile = Annotated[
    Path | None,
    tyro.conf.arg(
        metavar="IMAGE",
        help="Map on the surface, .png or .exr, by its uvs.",
        help_behavior_hint="(default: the scene's own)",
    ),
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
    layout: LayoutWords = (),
    bias: BiasWords = None,
    compare: CompareWords = (),
    filter: Annotated[
        FilterWords,
        tyro.conf.arg(
            help_behavior_hint="(default: bilinear; pcss with 8 taps under an area light)",
        ),
    ] = (),
    shading: ShadingWords = ("blinn-phong",),
    shadows: Annotated[
        Shadows,
        tyro.conf.arg(help="Shadow maps; shadow volumes: exact and hard, without a map; or none."),
    ] = "maps",
    antialias: Annotated[
        bool, tyro.conf.arg(help="Smooth the edges of shadows and of what is seen.")
    ] = False,
    mist: Annotated[
        float,
        tyro.conf.arg(
            metavar="DENSITY",
            help="Share of light that mist scatters per world length, which shows light shafts.",
        ),
    ] = 0.0,
    light_map: Annotated[
        Path | None,
        tyro.conf.arg(
            metavar="MAP",
            help="Light of bake-light instead of lights and shadow maps.",
            help_behavior_hint="",
        ),
    ] = None,
    normal_map: Annotated[
        MapFile,
        tyro.conf.arg(
            help="Map on the surface, .png or .exr, by its uvs; 'none' leaves out the scene's own."
        ),
    ] = None,
    flip_green: Annotated[
        bool, tyro.conf.arg(help="The normal map's green points down (-Y, as DirectX has it).")
    ] = False,
    color_map: MapFile = None,
    height_map: MapFile = None,
    height_scale: Annotated[
        float, tyro.conf.arg(metavar="LENGTH", help="World length that a height of 1 stands for.")
    ] = 1.0,
    subdivisions: Annotated[
        int,
        tyro.conf.arg(metavar="N", help="Cut each face in four so often before displacing it."),
    ] = 0,
    environment: Annotated[
        tuple[Path, ...],
        tyro.conf.arg(
            metavar="IMAGE",
            help="Six images in the order +x -x +y -y +z -z, or a folder of them: the background, "
            "and what reflective surfaces mirror.",
        ),
    ] = (),
    reflectivity: Annotated[
        float | None,
        tyro.conf.arg(
            metavar="SHARE",
            help="Share of the mirrored environment in the surface's color, from 0 to 1.",
            help_behavior_hint="(default: the scene's own)",
        ),
    ] = None,
) -> None:
    """Render a scene under its lights, each with a shadow map.

    Maps given here take the place of the scene's own, on all that it brought.

    An EXR holds linear color R G B, depth.Z (window depth in [0, 1]), normal.X Y Z (world
    space, with normal maps) and visibility.V (1 = lit; visibility2.V of a second light); the
    shadow map's file holds depth.Z in [0, 1] (depth2.Z).
    """
    check_out(out, ".exr", ".png")
    for extra, suffix in ((png_out, ".png"), (shadow_map_out, ".exr")):
        if extra is not None:
            check_out(extra, suffix)
    check_size("--image-size", *image_size)
    check_size("--shadow-map-size", shadow_map_size)
    lookup, comparison = parse_lookup(filter, compare)
    terms = parse_bias(bias, lookup)
    model = parse_shading(shading)
    if reflectivity is not None and not 0 <= reflectivity <= 1:
        raise ValueError(f"--reflectivity: expected a share from 0 to 1, got {reflectivity}")
    if not np.isfinite(height_scale):
        raise ValueError(f"--height-scale: expected a finite length, got {height_scale}")
    if subdivisions < 0:
        raise ValueError(f"--subdivisions: expected at least 0, got {subdivisions}")
    if not 0 <= mist < np.inf:
        raise ValueError(f"--mist: expected a density of at least 0, got {mist}")
    asked = {
        "bias": bias is not None, "compare": compare, "filter": filter,
        "layout": layout, "shadow-map-out": shadow_map_out, "mist": mist,
    }  # fmt: skip
    if shadows != "maps":
        _refuse(asked, f"--shadows {shadows}")
    if light_map is not None:
        more = {
            "environment": environment, "shadows": shadows != "maps", "antialias": antialias
        }  # fmt: skip
        _refuse(asked | more, "--light-map")
    smooth = normal_map == Path("none")
    if flip_green and (smooth or normal_map is None):
        raise ValueError("--flip-green: is for --normal-map, which is not given; drop it")
    with stage(f"loading {scene}"):
        loaded = with_maps(
            without_normal_maps(load_scene(scene)) if smooth else load_scene(scene),
            color_map=color_map,
            normal_map=None if smooth else normal_map,
            flip_green=flip_green,
            height_map=height_map,
            height_scale=height_scale,
            subdivisions=subdivisions,
            environment=environment,
            reflectivity=reflectivity,
        )
        loaded = prepare_scene(loaded)
        maps = choose_layout(loaded, layout)
        if not filter:
            lookup, _ = parse_lookup(least_filter(loaded), ())
            terms = parse_bias(bias, lookup)
        check_scene(loaded, maps)
        check_reach(lookup, maps, shadow_map_size)
    say_notes(loaded.notes)
    with stage("compiling and rendering"):
        if light_map is not None:
            loaded, light = read_light_map(light_map, loaded)
            image = render_light_map(loaded, light, image_size=image_size, shading=model)
        else:
            image = render_scene(
                loaded,
                image_size=image_size,
                map_size=shadow_map_size,
                bias=terms,
                filter=lookup,
                compare=comparison,
                shading=model,
                layout=maps,
                shadows=shadows,
                medium=Medium(mist) if mist else None,
                antialias=antialias,
            )
    for shadow_map in image.shadow_maps:
        check_shadow_map(loaded, shadow_map, casters=terms.casters)
    covered = np.asarray(image.surface.covered)
    alpha = covered.astype(np.float32)
    if image.coverage is not None:
        alpha = np.asarray(blend_layers(image.coverage, jnp.asarray(alpha)))
    if not covered.any():
        say_notes(["the camera sees no surface; the image is empty"])
    if out.suffix.lower() == ".exr":
        write_exr(out, image_channels(image))
    for path in (png_out, out if out.suffix.lower() == ".png" else None):
        if path is not None:
            color = np.asarray(image.color)
            write_png(path, color if loaded.environment else on_background(color, alpha))
    if shadow_map_out is not None:
        write_exr(shadow_map_out, shadow_map_channels(image.shadow_maps))
    for path in (out, png_out, shadow_map_out):
        if path is not None:
            say(f"wrote {path}")


def _refuse(asked: Mapping[str, object], instead: str) -> None:
    """Refuse what was asked about shadow maps where there are none."""
    for option, given in asked.items():
        if given:
            raise ValueError(f"--{option}: means nothing with {instead}; drop one of them")


def image_channels(image: Rendering) -> Channels:
    """Return the channels of an image's EXR file."""
    color, normal = np.asarray(image.color), np.asarray(image.appearance.normal)
    return {
        **{name: color[..., k] for k, name in enumerate("RGB")},
        "depth.Z": np.asarray(image.surface.depth),
        **{f"normal.{name}": normal[..., k] for k, name in enumerate("XYZ")},
        **_numbered("visibility", "V", image.visibilities),
    }


def shadow_map_channels(shadow_maps: Sequence[ShadowMap]) -> Channels:
    """Return the channels of a file with the maps of all lights, several of one underneath."""
    return _numbered(
        "depth", "Z", [np.reshape(m.depth, (-1, m.depth.shape[-1])) for m in shadow_maps]
    )


def _numbered(layer: str, channel: str, images: Sequence[Array | np.ndarray]) -> Channels:
    """Return ``depth.Z`` for the first light, ``depth2.Z`` for the second, and so on."""
    return {
        f"{layer}{'' if k == 0 else k + 1}.{channel}": np.asarray(image)
        for k, image in enumerate(images)
    }
