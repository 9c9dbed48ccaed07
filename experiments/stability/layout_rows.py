"""Rows about the layout of maps, soft shadows and shading: one question each."""

import copy
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.ndimage import maximum_filter, minimum_filter

from shadows import (
    CascadesLayout,
    DirectionalLight,
    PerspectiveCamera,
    render_surface,
    surface_appearance,
)
from tangentspace._math import dot

from ..rendering.prepare_scene import prepare_scene
from ..scene import Scene
from ..scenes import load_scene
from ..scenes.light_failures import panning_camera
from ..truth.rays import trace_visibility
from .cells import Cell, not_finite
from .combinations import Technique
from .detectors import penumbra_area
from .shadow_rows import IMAGE, MAP
from .views import MAPS, REACH, View, on_device, quick, receiver_stage, view_of, visibility

_SIZES: dict[str, Any] = {"image": IMAGE, "map_size": MAP}
_SUN_SAMPLES = 48


def penumbrae(dtype: Any) -> list[Cell]:
    """Row 17: the area of the penumbrae of two casters of unlike height, against rays."""
    seen = view_of(load_scene("tall-and-short"), None, dtype, **_SIZES)
    facing = np.asarray(seen.facing)
    truth = penumbra_area(sun_share(seen, 0.1), facing)
    base = Cell(17, "tall-and-short", "", np.dtype(dtype).name, "penumbra area", 0.0, 0.25)
    cells = []
    for technique in (
        Technique("pcss", "adaptive"), Technique("pcss", "none"), Technique("pcss", "constant"),
        Technique("pcf 5x5", "adaptive"), Technique("bilinear", "analytic"),
    ):  # fmt: skip
        lit, at_seen, slopes = visibility(seen, *technique.make())
        area = penumbra_area(np.asarray(lit), facing)
        one = technique.filter == "pcss"
        cells.append(
            base._replace(
                technique=technique.name,
                value=abs(area / truth - 1),
                said="one mean depth of two blockers" if one else "",
                may="" if one else "one width for all",
                values_not_finite=not_finite(lit),
                slopes_not_finite=not_finite(at_seen, slopes),
                note="relative error of the area that is half lit; the sun's full angle 0.1",
            )
        )
    return cells


def sun_share(seen: View, size: float) -> np.ndarray:
    """Return the share of a round sun that each pixel sees.

    Args:
        seen: A view under parallel light.
        size: Tangent of the full angle of the sun.
    """
    towards = np.asarray(seen.light.direction, np.float64)
    across = np.cross(towards, np.eye(3)[np.argmin(np.abs(towards))])
    across /= np.linalg.norm(across)
    up = np.cross(towards, across)
    points, occluders = seen.points(), seen.occluders()
    share = np.zeros(points[2].shape)
    for k in range(_SUN_SAMPLES):  # a spiral of equal areas
        radius, turn = 0.5 * size * np.sqrt((k + 0.5) / _SUN_SAMPLES), 2.399963 * k
        moved = towards + radius * (np.cos(turn) * across + np.sin(turn) * up)
        sun = DirectionalLight(moved / np.linalg.norm(moved))
        share += trace_visibility(*points, sun, occluders)
    return share / _SUN_SAMPLES


def duelling(dtype: Any) -> list[Cell]:
    """Row 22: pixels that a texel covers, where the view looks into the light."""
    scene = load_scene("duelling-frusta")
    base = Cell(22, scene.name, "", np.dtype(dtype).name, "pixels per texel", 0.0, 10.0)
    cells = []
    for name, lighting in (("one map", "sun"), ("cascades", "cascades")):
        seen = view_of(scene, lighting, dtype, **_SIZES)
        view = np.asarray(seen.camera.view_from_world, np.float64)
        covered = np.asarray(seen.surface.covered)
        away = -(np.asarray(seen.surface.position) @ view[2, :3] + view[2, 3])
        assert isinstance(seen.camera, PerspectiveCamera)
        pixel = 2 * away * np.tan(0.5 * float(seen.camera.vertical_fov)) / IMAGE[0]
        texels = np.asarray(seen.seen.receiver.texel_length)
        cells.append(
            base._replace(
                technique=name,
                value=float((texels / pixel)[covered].max()),
                said="coarse near the eye" if lighting == "sun" else "",
                values_not_finite=not_finite(texels),
                note="above 10 is severe (Lloyd 2007); the toolkit warps no maps",
            )
        )
    return cells


def panning(dtype: Any) -> list[Cell]:
    """Row 23: points of the world whose visibility changes while the eye moves a little."""
    scene, moved = load_scene("avenue"), panning_camera()
    seen = view_of(scene, "cascades", dtype, **_SIZES)
    kind = np.dtype(dtype)
    arguments = {"aspect": 1.0, "map_size": MAP, "reach": REACH}
    camera = jax.tree.map(lambda x: jnp.asarray(x, dtype), moved.camera)
    after = CascadesLayout(MAPS).matrices(seen.light, seen.mesh.positions, camera, **arguments)
    way = np.asarray(moved.camera.view_from_world) - np.asarray(scene.camera.view_from_world)
    shift = np.eye(4)
    shift[:3, 3] = np.asarray(scene.camera.view_from_world)[:3, :3].T @ way[:3, 3]
    with_eye = jnp.stack(seen._matrices) @ jnp.asarray(shift, dtype)
    base = Cell(23, "panning-camera", "", kind.name, "pixels that change", 0.0, 1e-3)
    cells = []
    for technique in (Technique("bilinear", "analytic"), Technique("pcf 5x5", "adaptive")):
        before = _fixed(seen, seen, technique)
        for name, matrices, said in (
            ("cascades", after, ""),
            ("(not snapped)", with_eye, "not in whole texels"),
        ):
            lit = _fixed(seen.with_matrices(matrices), seen, technique)
            changed = np.abs(lit - before)[np.asarray(seen.facing)] > 1e-3
            cells.append(
                base._replace(
                    technique=f"{technique.filter}, {name}",
                    value=float(changed.mean()),
                    said=said,
                    values_not_finite=not_finite(lit),
                    note="the same points of the avenue, the eye 0.003 to the right",
                )
            )
    return cells


def _fixed(seen: View, chosen: View, technique: Technique) -> np.ndarray:
    """Return visibilities, each point looked up in the map that another view chose."""
    place = (*seen.placed[:4], chosen.placed[4])
    at = seen.with_seen(seen.seen._replace(receiver=receiver_stage[0](*place)))
    return np.asarray(visibility(at, *technique.make())[0])


def seams(dtype: Any) -> list[Cell]:
    """Row 24: how much visibility jumps where one cascade takes over from another."""
    seen = view_of(load_scene("avenue"), "cascades", dtype, **_SIZES)
    index = np.asarray(seen.placed[4])
    least, most = (f(index, size=9) for f in (minimum_filter, maximum_filter))
    band = (least < most) & np.asarray(seen.facing)
    shift = lambda by: jnp.clip(seen.placed[4] + by, 0, MAPS - 1)
    other = copy.copy(seen)
    other.placed = (*seen.placed[:4], shift(1))
    base = Cell(24, "avenue", "", np.dtype(dtype).name, "jump at the seam", 0.0, 0.005)
    cells = []
    for name, bias in (
        ("bilinear", "analytic"), ("pcf 5x5", "adaptive"), ("vsm", "none"), ("esm", "none"),
        ("msm", "analytic"),
    ):  # fmt: skip
        technique = Technique(name, bias)
        here, there = _fixed(seen, seen, technique), _fixed(seen, other, technique)
        cells.append(
            base._replace(
                technique=f"{technique.name}, cascades",
                value=float(np.abs(here - there)[band].mean()),
                said="maps of two sizes meet",
                values_not_finite=not_finite(here, there),
                note="mean difference between a map and the next, within 4 pixels of a seam",
            )
        )
    return cells


def hard_terminator(dtype: Any) -> list[Cell]:
    """Row 29: light of bumps that face the light just where their face turns away."""
    scene = load_scene("grazing-normal-map")
    seen = view_of(scene, None, dtype, **_SIZES)
    normal = bumped_normals(scene, dtype)
    towards = seen.light.to_light(seen.surface.position)
    face = np.asarray(dot(seen.surface.face_normal, towards))
    lit = np.clip(np.asarray(dot(jnp.asarray(normal), towards)), 0, 1)
    covered = np.asarray(seen.surface.covered)
    near = covered & (np.abs(face) < 0.2)
    base = Cell(29, scene.name, "", np.dtype(dtype).name, "jump at the terminator", 0.0, 0.02)
    cells = []
    for technique in (Technique("bilinear", "analytic"), Technique("pcf 5x5", "adaptive")):
        shadow, at_seen, slopes = visibility(seen, *technique.make())
        light = lit * np.asarray(shadow)
        jump = light[near & (face > 0)].mean() - light[near & (face <= 0)].mean()
        cells.append(
            base._replace(
                technique=technique.name,
                value=float(jump),
                said="no light behind the face's own terminator",
                values_not_finite=not_finite(light),
                slopes_not_finite=not_finite(at_seen, slopes),
                note="mean of cosine times visibility, before and behind it",
            )
        )
    smooth = lit[near & (face > 0)].mean() - lit[near & (face <= 0)].mean()
    cells.append(base._replace(technique="(no shadow)", value=float(smooth), may="slopes of bumps"))
    return cells


def bumped_normals(scene: Scene, dtype: Any) -> np.ndarray:
    """Return the normals of a view after the normal maps, with MikkTSpace tangents."""
    ready = prepare_scene(scene)
    parts = on_device((ready.mesh, ready.camera, ready.materials), dtype)

    @quick
    def bumped(mesh: Any, camera: Any, materials: Any) -> jax.Array:
        surface = render_surface(mesh, camera, image_size=IMAGE)
        faces = ready.face_materials
        look = surface_appearance(mesh, camera, surface, materials, face_materials=faces)
        return look.normal

    return np.asarray(bumped(*parts))
