"""What a baked map is worth: the low-poly mesh without and with it, beside the detailed one."""

from pathlib import Path
from typing import NamedTuple

import matplotlib.cm
import matplotlib.colors
import matplotlib.figure
import numpy as np
from jaxtyping import Bool, Float

from shadows.appearance import Appearance
from shadows.bias import SlopeBias
from shadows.compare import HardCompare
from shadows.interpolate import interpolate
from shadows.render import Rendering
from shadows.surface import Surface
from shadows.window_filters import BilinearFilter
from tangentspace.material import Material
from tangentspace.mesh import Mesh
from tangentspace.mikktspace import with_tangents
from tangentspace.shading import BlinnPhongShading
from tangentspace.texture import Texture

from ..figures import on_background
from ..files.framing import framing_camera, key_light
from ..files.images import atomic_path, linear_to_srgb
from ..files.smooth_normals import smooth_normals
from ..rendering.render_scene import render_scene, shade_scene
from ..scene import Scene
from .bake_cage import Detail
from .bake_normals import NormalBake, detail_normals

Image = Float[np.ndarray, "height width 3"]
Degrees = Float[np.ndarray, "height width"]
_SHADING = BlinnPhongShading()
_COLORS = "cividis"  # even in lightness, also for the color-blind


class BakePictures(NamedTuple):
    """Both meshes and the map from one place, and errors of the shading normals in degrees.

    Attributes:
        low: The low-poly mesh as it is, sRGB.
        mapped: The low-poly mesh with the map, sRGB.
        high: The detailed mesh, sRGB.
        low_error: Angle between the normals of ``low`` and ``high`` in the same pixel; NaN
            where not both are seen.
        mapped_error: The same for ``mapped``. It holds also what no map can mend: the low-poly
            surface lies elsewhere, so that a pixel sees another part of the detail.
        map_error: Angle between the normal of ``mapped`` and that of the detail that belongs
            to the same point of the surface; NaN where there is none.
    """

    low: Image
    mapped: Image
    high: Image
    low_error: Degrees
    mapped_error: Degrees
    map_error: Degrees


def render_bake(
    high: Mesh, low: Mesh, bake: NormalBake, *, image_size: tuple[int, int] = (512, 512)
) -> BakePictures:
    """Render both meshes and the map, each by itself, without a floor."""
    low = low if low.tangents is not None else with_tangents(low)
    points = np.concatenate([np.asarray(mesh.positions) for mesh in (high, low)])
    camera, lights = framing_camera(points), (key_light(),)

    def view(mesh: Mesh, material: Material) -> tuple[Scene, Rendering]:
        materials = np.zeros(len(mesh.faces), np.int32)
        scene = Scene("bake", mesh, materials, (material,), camera, lights)
        return scene, render_scene(
            scene,
            image_size=image_size,
            map_size=1024,
            bias=SlopeBias(2.0),
            filter=BilinearFilter(),
            compare=HardCompare(),
            shading=_SHADING,
        )

    scene, mapped = view(low, Material(normal_texture=Texture(bake.texels)))
    _, truth = view(high, Material())
    plain = mapped._replace(appearance=Appearance(mapped.surface.normal))
    color = shade_scene(scene, plain, lights, mapped.visibilities, _SHADING)
    plain = plain._replace(color=color)
    return BakePictures(
        low=_picture(plain),
        mapped=_picture(mapped),
        high=_picture(truth),
        low_error=_angles(plain, _normals(truth), _covered(truth)),
        mapped_error=_angles(mapped, _normals(truth), _covered(truth)),
        map_error=_angles(mapped, *_matching_normals(high, low, bake.cage, mapped.surface)),
    )


def save_bake_pictures(
    path: Path,
    pictures: BakePictures,
    texels: Float[np.ndarray, "size size 3"],
    *,
    faces: tuple[int, int],
    title: str,
) -> None:
    """Save the views in a row, and under them the map and the errors in degrees.

    Args:
        path: PNG file.
        pictures: What ``render_bake`` returned.
        texels: The map.
        faces: How many faces the detailed and the low-poly mesh have.
        title: What was baked.
    """
    figure = matplotlib.figure.Figure(figsize=(16.5, 9), layout="constrained")
    axes = figure.subplots(2, 4)
    shown = {
        f"low: {faces[1]} faces": pictures.low,
        "low + map": pictures.mapped,
        f"high: {faces[0]} faces": pictures.high,
        f"map: {len(texels)} x {len(texels)}, green +Y": texels,
    }
    for place, (name, image) in zip(axes[0], shown.items(), strict=True):
        place.imshow(image, interpolation="nearest")
        place.set_title(name, fontsize=11)
    errors = {
        "low, in the same pixel": pictures.low_error,
        "low + map, in the same pixel": pictures.mapped_error,
        "low + map, at the same point": pictures.map_error,
    }
    most = np.nanquantile(pictures.low_error, 0.99)
    scale = matplotlib.cm.ScalarMappable(matplotlib.colors.Normalize(0, most), _COLORS)
    for place, (name, error) in zip(axes[1], errors.items(), strict=False):
        place.imshow(error, cmap=scale.cmap, norm=scale.norm, interpolation="nearest")
        place.set_title(f"{name}: mean {np.nanmean(error):.2f}°", fontsize=11)
    for place in axes.flat:
        place.set_axis_off()
    bar = figure.colorbar(scale, cax=axes[1, 3].inset_axes((0.05, 0.05, 0.06, 0.9)), extend="max")
    bar.set_label("angle to the normals of high (degrees)")
    figure.suptitle(title, fontsize=13)
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=110)


def _matching_normals(
    high: Mesh, low: Mesh, cage: float, surface: Surface
) -> tuple[Image, Bool[np.ndarray, "height width"]]:
    """Return the detail's normals that belong to what is seen of the low-poly mesh."""
    outward = smooth_normals(np.asarray(low.positions), np.asarray(low.faces))
    outward = interpolate(outward, low.faces, surface.face_ids, surface.weights)
    places = np.concatenate([surface.position, outward], axis=-1)
    return detail_normals(high, Detail(high), np.asarray(surface.covered), places, cage)


def _angles(image: Rendering, truth: Image, known: Bool[np.ndarray, "height width"]) -> Degrees:
    """Return the angles between the shading normals and true ones; NaN where not both are."""
    half_chord = 0.5 * np.linalg.norm(_normals(image) - truth, axis=-1)
    angles = np.rad2deg(2 * np.arcsin(np.minimum(half_chord, 1)))
    return np.where(_covered(image) & known, angles, np.nan)


def _picture(image: Rendering) -> Image:
    """Return an image as shown, sRGB."""
    return linear_to_srgb(np.clip(on_background(np.asarray(image.color), _covered(image)), 0, 1))


def _normals(image: Rendering) -> Image:
    return np.asarray(image.appearance.normal)


def _covered(image: Rendering) -> Bool[np.ndarray, "height width"]:
    return np.asarray(image.surface.covered)
