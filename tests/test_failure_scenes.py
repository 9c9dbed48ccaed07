"""The scenes of the failure catalogue: sound, finite under every technique, and what they say."""

import functools
import re
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.checks import check_scene
from experiments.metrics import shadow_errors
from experiments.options import techniques
from experiments.scene import Scene
from experiments.scenes import EMBEDDED, load_scene
from experiments.scenes.bias_failures import contact_plate, contact_wall, tilted_plane, turned_plane
from experiments.scenes.failure_scenes import FAILURE_SCENES, FAILURES
from experiments.stability import frames
from experiments.stability.frames import LARGEST
from experiments.stability.views import (
    FACES,
    IMAGE,
    VERTICES,
    lightings,
    on_device,
    padded,
    precision,
    quick,
    truth,
    view,
    view_of,
    visibility,
)
from experiments.technique_words import choose_layout
from shadows import (
    AdaptiveBias,
    AnalyticBias,
    Appearance,
    Bias,
    BilinearFilter,
    ConstantBias,
    ESMFilter,
    EVSM4Filter,
    Filter,
    FrontFaceCullingBias,
    HardCompare,
    Medium,
    MSMFilter,
    NormalOffsetBias,
    PCFFilter,
    PCSSFilter,
    PoissonFilter,
    ReceiverPlaneBias,
    Rendering,
    SoftCompare,
    VSMFilter,
    add_shafts,
    default_bias,
    mesh_edges,
    surface_visibility,
    volume_visibility,
)
from tangentspace import (
    face_normals,
    split_mirrored,
)
from tangentspace._math import dot

SCENES = {name: make() for name, make in FAILURE_SCENES.items()}
SHADOWED = [name for name, failure in FAILURES.items() if failure.row <= 30]
NO_SCENES = {11, 13, 14, 15, 16, 21, 37, 42, 43}
SMALLER = {
    "pcss": PCSSFilter(0.1, search_taps=4, taps=4, widest=8),
    "poisson": PoissonFilter(taps=4),
}

# Sound


def test_every_row_has_a_scene_or_is_none():
    rows = {failure.row for failure in FAILURES.values()}
    assert rows == set(range(1, 44)) - NO_SCENES
    assert not set(FAILURES) & set(EMBEDDED) - {"room", "avenue"}
    for failure in FAILURES.values():
        said = re.match(rf"Row {failure.row}[ab]?: ", str(failure.make.__doc__))
        assert said or failure.make in EMBEDDED.values()
        assert failure.fails


@pytest.mark.parametrize("name", SCENES)
def test_a_scene_is_sound(name):
    scene, mesh = load_scene(name), load_scene(name).mesh
    assert scene.name == name
    for one, other in zip(jax.tree.leaves(scene), jax.tree.leaves(SCENES[name]), strict=True):
        np.testing.assert_array_equal(one, other)
    assert mesh.positions.dtype == mesh.normals.dtype == np.float32
    assert mesh.faces.dtype == np.int32
    assert np.isfinite(mesh.positions).all()
    assert set(np.unique(mesh.faces)) == set(range(len(mesh.positions)))
    assert len(scene.face_materials) == len(mesh.faces)
    length = np.linalg.norm(mesh.normals, axis=1)
    assert ((np.abs(length - 1) < 1e-5) | (length == 0)).all()
    grown = scene._replace(mesh=padded(mesh, VERTICES, FACES))  # of one size: compiled once
    check_scene(grown, choose_layout(grown, ()))


def test_a_misspelled_name_gets_a_hint():
    with pytest.raises(ValueError, match=r"scene 'tilted-plain': .* did you mean 'tilted-plane'"):
        load_scene("tilted-plain")


@pytest.mark.parametrize("name", SCENES)
def test_the_camera_sees_the_scene_in_light_and_shadow(name):
    with precision(np.float32):
        seen = view(name)
        lit = truth(seen)
    covered = np.asarray(seen.surface.covered)
    assert covered.mean() > 0.25  # measured 0.30 and more
    assert lit.sum() > 0.1 * lit.size
    in_view = set(np.unique(seen.surface.face_ids))
    assert len(in_view) > 2 or len(SCENES[name].mesh.faces) <= 2


# Finite


def cases():
    """Return each way to light each scene of shadows."""
    for name in SHADOWED:
        yield from ((name, lighting) for lighting in lightings(SCENES[name]))


def ours(base) -> dict[str, Any]:
    """Return the techniques of the package; other tests define some more."""
    found = techniques(base).items()
    return {name: cls for name, cls in found if cls.__module__.startswith("shadows.")}


def combinations(lighting: str) -> dict[str, tuple[Bias, Filter]]:
    """Return each filter with its least bias, and each bias with two filters.

    Of several maps a filter reads one, so there each bias meets one filter; and an offset in
    space locates the receiver once more, which takes seconds to compile.
    """
    several = lighting in ("cascades", "cube")
    filters = {name: SMALLER.get(name) or cls() for name, cls in ours(Filter).items()}
    pairs = {name: (default_bias(filter), filter) for name, filter in filters.items()}
    for name, cls in ours(Bias).items():
        for lookup in ("bilinear",) if several else ("bilinear", "pcf"):
            if not (several and cls is NormalOffsetBias):
                pairs[f"{name} {lookup}"] = cls(), filters[lookup]
    return pairs


def flaws(what, tree):
    """Return which leaves are not finite."""
    for path, leaf in jax.tree_util.tree_leaves_with_path(tree):
        if eqx.is_inexact_array(leaf) and not np.isfinite(leaf).all():
            count = np.count_nonzero(~np.isfinite(leaf))
            yield f"{what}{jax.tree_util.keystr(path)}: {count} of {leaf.size} not finite"


def run(seen, pairs):
    """Run techniques on a view; return what is wrong, and the sum of all sound gradients."""
    wrong, total = list(flaws("seen", seen.seen)), None
    for label, (bias, filter) in pairs.items():
        # Soft for all, which have the more derivatives; hard once for each filter.
        for hard in (False, True) if filter.compares and label in ours(Filter) else (False,):
            title = f"{label}{' hard' if hard else ' soft'}"
            lit, at_seen, slopes = visibility(seen, bias, filter, hard=hard)
            lit = np.asarray(lit)
            if not ((lit >= 0) & (lit <= 1 + 4 * np.finfo(lit.dtype).eps)).all():
                wrong.append(f"{title}: visibility from {lit.min()} to {lit.max()}")
            found = list(flaws(title, {"seen": at_seen, **slopes}))
            wrong += found
            if not found:
                total = at_seen if total is None else jax.tree.map(jnp.add, total, at_seen)
    return wrong, total


@pytest.mark.parametrize(("name", "lighting"), list(cases()))
def test_every_technique_is_finite(name, lighting):
    """In value, and in derivatives by everything from the light to the vertices.

    What leads from the geometry to what the techniques start from is linear in derivatives:
    where one of them met what is not finite there, so does their sum.
    """
    with precision(np.float32):
        seen = view(name, lighting)
        wrong, total = run(seen, combinations(lighting))
        assert wrong + list(flaws("geometry", seen.pull(total))) == []


@pytest.mark.parametrize("name", ["edge-on-triangle", "near-far", "coarse-sphere"])
def test_techniques_are_finite_in_double_precision(name):
    with precision(np.float32):
        seen = view_of(SCENES[name])
    with precision(np.float64):
        seen.seen, seen.facing = on_device((seen.seen, seen.facing), np.float64)
        chosen = ("bilinear", "msm", "constant bilinear")
        assert run(seen, {label: combinations("sun")[label] for label in chosen})[0] == []


@pytest.mark.parametrize(("name", "lighting"), [("contact-wall", "sun"), ("near-far", "cube")])
def test_the_stages_make_what_rendering_makes(name, lighting):
    with precision(np.float32):
        seen = view(name, lighting)
        technique = {"bias": AnalyticBias(), "filter": BilinearFilter(), "compare": HardCompare()}
        together = quick(lambda *views: surface_visibility(*views, **technique))
        lit = together(seen.surface, seen.light, seen.seen.two)
        alone = visibility(seen, AnalyticBias(), BilinearFilter())[0]
    # Several maps are drawn here with room for the widest filter, so a few lie in another one.
    assert np.count_nonzero(np.abs(lit - alone) > 1e-4) <= (5 if lighting == "cube" else 0)


@quick
def misty(camera, light, medium, surface, shadow_map):
    """Return the mean of what a medium scatters, and its gradient."""

    def mean(arguments):
        camera, light, medium, surface, shadow_map = arguments
        nothing = jnp.zeros((*IMAGE, 3), surface.position.dtype)
        image = Rendering(nothing, (), surface, Appearance(surface.normal), (shadow_map,))
        compare = SoftCompare(0.5)
        return jnp.mean(add_shafts(image, camera, light, medium, steps=4, compare=compare).color)

    return eqx.filter_value_and_grad(mean)((camera, light, medium, surface, shadow_map))


@pytest.mark.parametrize("name", [name for name in SHADOWED if name != "room"])
def test_light_shafts_are_finite(name):
    with precision(np.float32):
        seen = view(name)
        medium = on_device(Medium(0.1, anisotropy=0.3), np.float32)
        nearest = seen.seen.two._replace(second=None)
        value, slopes = misty(seen.camera, seen.light, medium, seen.surface, nearest)
    assert value > 0
    assert list(flaws("shafts", slopes)) == []


@quick
def counted(mesh, camera, surface, light, edges):
    return volume_visibility(mesh, camera, surface, light, edges=edges)


@pytest.mark.parametrize("name", SHADOWED)
def test_shadow_volumes_agree_with_rays(name):
    """Also where maps fail: no crack, no eye inside, no triangle across a plane disturbs them."""
    with precision(np.float32):
        seen = view(name, list(lightings(SCENES[name]))[-1])
        edges = mesh_edges(seen.mesh.positions, seen.mesh.faces)
        more = np.zeros((3 * FACES - len(edges.vertices), 2), np.int32)
        edges = edges._replace(vertices=np.concatenate([edges.vertices, more]))
        lit = np.asarray(counted(seen.mesh, seen.camera, seen.surface, seen.light, edges))
        to_light = seen.light.to_light(seen.surface.position)
        edge_on = np.abs(dot(seen.surface.face_normal, to_light)) < 1e-3  # rounding decides there
        wrong = (lit != truth(seen)) & ~edge_on
    assert set(np.unique(lit)) <= {0.0, 1.0}
    assert wrong.sum() <= 2, wrong.sum()


# Frames

MAPPED = {
    name: scene
    for name, scene in SCENES.items()
    if any(look.normal_texture is not None for look in scene.materials)
}


@functools.cache
def frames_of(name):
    """Return a scene's padded mesh, its corners' tangents, all frames, and their derivatives."""
    with precision(np.float32):
        return frames.frames_of(SCENES[name].mesh)


@pytest.mark.parametrize("name", MAPPED)
def test_frames_are_finite(name):
    _, tangents, made, slopes = frames_of(name)
    np.testing.assert_allclose(made["corners"], tangents, atol=1e-4)
    assert list(flaws("frames", made)) == []
    assert list(flaws("gradient", slopes)) == []


# What each scene shows


def errors(of, bias, filter=BilinearFilter()):
    """Return a technique's errors among the pixels that face the light."""
    with precision(np.float32):
        seen = view_of(of) if isinstance(of, Scene) else view(of)
        lit = np.asarray(visibility(seen, bias, filter)[0])
        return shadow_errors(lit, truth(seen), np.asarray(seen.facing))


def lit_by(name, bias, filter=BilinearFilter()):
    """Return a technique's visibility, and which pixels are lit and which in shadow."""
    with precision(np.float32):
        seen = view(name)
        lit, facing = np.asarray(visibility(seen, bias, filter)[0]), np.asarray(seen.facing)
        return lit, facing & truth(seen), facing & ~truth(seen)


@pytest.mark.parametrize("tilt", [75.0, 80.0, 85.0, 88.0])
def test_a_tilted_plane_is_striped_without_a_bias(tilt):
    scene = tilted_plane(tilt)
    cosine = scene.mesh.normals[0] @ scene.lights[0].direction
    np.testing.assert_allclose(np.rad2deg(np.arccos(cosine)), tilt, rtol=1e-5)
    assert 0.4 < errors(scene, ConstantBias(0.0)).acne < 0.6  # measured 0.50
    assert errors(scene, AnalyticBias()).soft_acne == 0  # no texel fails


@pytest.mark.parametrize("azimuth", [0.0, 15.0, 45.0, 70.0])
def test_a_turned_plane_wants_both_slopes(azimuth):
    """Under nearest lookup; by half of the larger slope alone no turn but a quarter is served."""
    with precision(np.float32):
        seen = view_of(turned_plane(azimuth))
    receiver, covered = seen.seen.receiver, np.asarray(seen.surface.covered)
    stored = np.asarray(seen.seen.two.depth)
    texels = [np.floor(np.asarray(place)).astype(int) for place in (receiver.row, receiver.column)]
    excess = np.asarray(receiver.depth) - stored[tuple(np.clip(k, 0, 63) for k in texels)]
    slopes = np.abs([receiver.depth_per_column, receiver.depth_per_row])
    assert (slopes.min(axis=0)[covered] > 0.3 * slopes.max(axis=0)[covered]).all() == (azimuth > 0)
    larger, both = 0.5 * slopes.max(axis=0), 0.5 * slopes.sum(axis=0) + 1e-5
    assert (excess > both)[covered].mean() == 0
    assert ((excess > larger + 1e-5)[covered].mean() > 0.02) == (azimuth > 0)
    assert 0.4 < (excess > 0)[covered].mean() < 0.6


def test_a_large_bias_detaches_the_shadow_of_the_wall():
    assert errors("contact-wall", AnalyticBias()).leak < 0.06  # measured 0.04, edges of shadows
    assert errors("contact-wall", ConstantBias(0.3)).leak > 0.2  # measured 0.23
    # Of a wall as thick as the way that the bias makes up for, all shadow is left.
    thick = contact_wall(0.3 * np.sin(np.deg2rad(50.0)))
    assert errors(thick, ConstantBias(0.3)).leak < 0.06


def test_a_plate_loses_its_shadow_to_a_bias_of_its_height():
    limit = 0.02 / np.cos(np.deg2rad(50.0))
    assert errors("contact-plate", ConstantBias(2.0 * limit)).leak == 1
    assert errors("contact-plate", ConstantBias(0.5 * limit)).leak < 0.5
    assert errors(contact_plate(0.1), ConstantBias(2.0 * limit)).leak < 0.5


@pytest.mark.parametrize("name", ["open-fold", "t-junction"])
def test_maps_of_back_faces_do_not_know_open_sheets(name):
    assert errors(name, FrontFaceCullingBias()).leak > 0.75  # measured 0.80 and 1
    assert errors(name, AnalyticBias()).leak < 0.1  # measured 0.08 and 0.01


def test_back_faces_leak_where_a_box_stands():
    """At its feet the back of the box is the floor: those pixels are lit, and dark ones behind."""
    lit, _, dark = lit_by("box-corner", FrontFaceCullingBias())
    assert 0 < (lit > 0.5)[dark].mean() < 0.2  # measured 0.08


def test_light_comes_through_walls_thinner_than_a_bias():
    leaks = [errors("thin-wall", ConstantBias(length)).leak for length in (0.005, 0.1, 0.3)]
    assert leaks[0] < 0.03 < 0.05 < leaks[1] < leaks[2]  # measured 0.02, 0.06, 0.13


def test_a_coarse_map_leaves_rings_on_the_sphere():
    with precision(np.float32):
        texel = view("coarse-sphere").seen.receiver.texel_length
    assert np.min(texel) > 0.3  # half of the radius, in maps of these tests
    assert errors("coarse-sphere", ConstantBias(0.1)).acne > 0.3  # measured 0.36
    assert errors("coarse-sphere", AnalyticBias()).acne < 0.02  # measured 0.01


def test_wide_filters_want_more_bias():
    bilinear, wide = (
        errors("wide-kernel", ConstantBias(0.1), filter)
        for filter in (BilinearFilter(), PCFFilter())
    )
    assert bilinear.soft_acne == 0
    assert wide.soft_acne > 0.02  # measured 0.026
    assert errors("wide-kernel", AdaptiveBias(), PCFFilter()).soft_acne == 0


def test_receiver_planes_darken_creases():
    assert not lit_by("crease", AdaptiveBias(), PCFFilter())[2].any()
    plane, nearer = (
        errors("crease", bias, PCFFilter()).soft_acne
        for bias in (ReceiverPlaneBias(), AdaptiveBias())
    )
    assert plane > 0.02 > 0.01 > nearer  # measured 0.027 and 0.008


def test_edge_on_triangles_are():
    with precision(np.float32):
        seen = view("edge-on-triangle")
        normals = np.asarray(face_normals(seen.mesh.positions, seen.mesh.faces))[2:7]
        cosine = np.abs(normals @ np.asarray(seen.light.direction))
    assert cosine.min() < 1e-7
    assert 0.05 < cosine.max() < 0.1
    assert set(range(2, 7)) <= set(np.unique(seen.surface.face_ids))


def test_variance_leaks_between_two_occluders():
    leaks = [
        errors("two-occluders", AnalyticBias(), f).soft_leak
        for f in (VSMFilter(), EVSM4Filter(), MSMFilter())
    ]
    assert leaks[0] > 1.15 * leaks[1] > 1.15 * leaks[2]  # measured 0.34, 0.29, 0.25


def test_a_low_exponent_leaves_a_halo():
    """Without a blur, by the distance to the caster alone."""
    filters = [ESMFilter(radius=0, exponent=exponent) for exponent in (10.0, 40.0, 80.0)]
    halos = [errors("contact-halo", ConstantBias(0.0), filter).soft_leak for filter in filters]
    assert halos[0] > 1.5 * halos[1] > 1.5 * halos[2]


def test_near_and_far_posts_lie_apart_by_more_than_a_hundred():
    scene = SCENES["near-far"]
    distance = np.linalg.norm(scene.mesh.positions[4:] - scene.lights[0].position, axis=1)
    assert distance.max() > 150 * distance.min()
    assert errors("near-far", ConstantBias(0.1)).acne > 0.15  # measured 0.19
    assert errors("near-far", AnalyticBias()).acne < 0.01


def test_no_light_falls_behind_a_spot():
    with precision(np.float32):
        seen = view("behind-spot")
        position = np.asarray(seen.surface.position)
        behind = np.asarray(seen.surface.covered) & (position[..., 2] > 0.05)
        arrives = np.asarray(seen.light.radiance(seen.surface.position))
        lit = np.asarray(visibility(seen, AnalyticBias(), BilinearFilter())[0])
    assert behind.mean() > 0.2
    assert (arrives[behind] == 0).all()
    assert arrives[~behind].max() == 1
    assert (lit[behind & np.asarray(seen.facing)] == 1).all()  # no post before it is mirrored


def test_triangles_cross_the_plane_of_the_light():
    scene = SCENES["near-plane-triangle"]
    light = scene.lights[0]
    ahead = (scene.mesh.positions - light.position) @ light.direction
    crossing = np.ptp(np.sign(ahead)[scene.mesh.faces], axis=1) == 2
    assert crossing[-1]  # the board
    assert errors("near-plane-triangle", AnalyticBias()).error < 0.02  # measured 0.01


def test_t_junctions_lie_off_the_edge_by_rounding():
    positions = SCENES["t-junction"].mesh.positions[4:].astype(np.float64)
    a, b = positions[0], positions[2]
    edge = (b - a) / np.linalg.norm(b - a)
    off = np.linalg.norm(np.cross(positions[3::3][1:] - a, edge), axis=1)
    assert 0 < off.max() < 1e-6
    lit, _, dark = lit_by("t-junction", AnalyticBias())
    assert (lit[dark] > 0.5).mean() < 0.03  # measured 0.01: the edges of the shadow


def test_the_eye_stands_in_shadow():
    scene = SCENES["eye-in-shadow"]
    view_from_world = np.asarray(scene.camera.view_from_world)
    eye = -view_from_world[:3, :3].T @ view_from_world[:3, 3]
    roof = scene.mesh.positions[4:28]
    reach = (roof[:, 1].min() - eye[1]) / scene.lights[0].direction[1]
    hit = eye + reach * scene.lights[0].direction
    assert (roof.min(axis=0)[[0, 2]] < hit[[0, 2]]).all()
    assert (hit[[0, 2]] < roof.max(axis=0)[[0, 2]]).all()


@pytest.mark.parametrize("name", ["low-poly-sphere", "bent-normals"])
def test_smooth_normals_are_lit_where_faces_are_not(name):
    with precision(np.float32):
        seen = view(name)
        to_light = seen.light.to_light(seen.surface.position)
        smooth = np.asarray(dot(seen.surface.normal, to_light) > 0.02)
    assert (
        smooth & ~np.asarray(seen.facing) & np.asarray(seen.surface.covered)
    ).sum() > 10  # measured 15


def on_sheet(name):
    """Return which faces of a padded mesh carry the bumps."""
    bumpy = SCENES[name].face_materials == len(SCENES[name].materials) - 1
    return np.pad(bumpy, (0, LARGEST[1] - len(bumpy)))


def test_tangents_cancel_on_the_mirrored_strip():
    mesh, _, made, _ = frames_of("mirrored-strip")
    sheet = on_sheet("mirrored-strip")
    used = np.unique(mesh.faces[sheet])
    assert (~np.asarray(made["frames"].valid)[used]).sum() == 2
    parted = split_mirrored(MAPPED["mirrored-strip"].mesh)
    assert len(parted.positions) == len(MAPPED["mirrored-strip"].mesh.positions) + 2


@pytest.mark.parametrize(
    ("name", "count"), [("equal-uvs", 1), ("collinear-sliver", 1), ("duplicate-vertex", 2)]
)
def test_degenerate_triangles_have_no_frame(name, count):
    _, tangents, made, _ = frames_of(name)
    sheet = on_sheet(name)
    assert (~np.asarray(made["triangles"].valid)[sheet]).sum() == count
    if name == "collinear-sliver":
        lengths = np.linalg.norm(tangents[sheet][1, :, :3], axis=1)
        np.testing.assert_allclose(lengths, [0, 1, 0], atol=1e-6)


def test_tangents_turn_round_the_pole():
    mesh, tangents, _, _ = frames_of("pole-cap")
    at_pole = np.isclose(mesh.positions[mesh.faces][..., 1], mesh.positions[:, 1].max())
    at_pole[~on_sheet("pole-cap")] = False
    angles = np.sort(np.arctan2(*tangents[at_pole][:, [0, 2]].T))
    assert np.ptp(angles) > np.deg2rad(300)
    assert np.diff(angles).max() < np.deg2rad(31)


def test_sheared_uvs_lean_by_60_degrees():
    triangles, sheet = frames_of("sheared-uvs")[2]["triangles"], on_sheet("sheared-uvs")
    along, up = (np.asarray(axis, np.float64)[sheet] for axis in triangles[:2])
    lengths = np.linalg.norm(along, axis=1) * np.linalg.norm(up, axis=1)
    sine = -np.sum(along * up, axis=1) / lengths
    np.testing.assert_allclose(np.rad2deg(np.arcsin(sine)), 60, rtol=1e-4)


def test_split_quads_differ_in_the_cut_alone():
    mesh, tangents, _, _ = frames_of("split-quads")
    sheet = on_sheet("split-quads")
    left, right = (np.unique(faces) for faces in np.split(mesh.faces[sheet], 2))
    apart = mesh.positions[right] - mesh.positions[left]
    np.testing.assert_allclose(apart, np.broadcast_to(apart[0], apart.shape), atol=1e-6)
    np.testing.assert_array_equal(mesh.uvs[left], mesh.uvs[right])
    of_vertex = np.zeros((len(mesh.positions), 3))
    of_vertex[mesh.faces] = tangents[..., :3]
    cosine = np.sum(of_vertex[left] * of_vertex[right], axis=1)
    assert np.rad2deg(np.arccos(np.clip(cosine, -1, 1))).max() > 1


def test_charts_touch_without_a_gutter():
    mesh = SCENES["no-gutter"].mesh
    corners = mesh.uvs[mesh.faces].astype(np.float64)
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = 0.5 * np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
    np.testing.assert_allclose(area.sum(), 1, rtol=1e-6)  # the atlas is full
    assert mesh.uvs.min() == 0
    assert mesh.uvs.max() == 1
