"""Embree, Mitsuba and OpenGL on our surface points: known shadows, truth, costs, absence."""

import functools
import pickle
import subprocess
import sys
from functools import partial
from pathlib import Path

import jax
import numpy as np
import pytest

import experiments.frontier.peers as peers
import experiments.frontier.peers.mitsuba_rays as mitsuba_rays
import experiments.frontier.peers.opengl as opengl
from experiments.frontier.peers import PEERS, absent
from experiments.frontier.peers.embree import Embree
from experiments.frontier.peers.mitsuba_rays import Mitsuba
from experiments.frontier.peers.opengl import OpenGL
from experiments.frontier.programs import Programs, summarize
from experiments.frontier.shadow_method import Method
from experiments.frontier.view import View, load_view
from experiments.scenes import load_scene
from experiments.scenes.staging import placed, staged
from experiments.technique_words import choose_layout
from experiments.truth.area import seen_share
from experiments.truth.rays import Occluders
from shadows.area_lights import RectangleLight
from shadows.lights import DirectionalLight, SpotLight
from shadows.surface import render_surface
from tangentspace.shapes import box, plane

ROOT = Path(__file__).parents[1]
SIZE = 64
BILINEAR = Method("bilinear", "bilinear", ("bilinear",), 1024, True)
FINEST = {"embree": Embree(1), "mitsuba": Mitsuba(1), "opengl": OpenGL(2048)}
look = jax.jit(partial(render_surface, image_size=(SIZE, SIZE)))
PARTS = ("draw", "prepare", "image", "gradient")


@pytest.fixture(scope="module", autouse=True)
def single_precision():
    """As users have it."""
    with jax.enable_x64(False):
        yield


@pytest.fixture(scope="module")
def programs():
    return Programs()


@functools.cache
def found_absent():
    return absent()


def needed(peer):
    """Skip where a peer cannot run."""
    if peer.technique in found_absent():
        pytest.skip(f"{peer.technique}: {found_absent()[peer.technique]}")
    return peer


def view_of_scene(scene):
    """A view with what peers are asked about, and no more: the rest takes seconds."""
    light, surface = scene.lights[0], look(scene.mesh, scene.camera)
    places = [np.asarray(a) for a in (surface.position, surface.face_normal, surface.face_ids)]
    to_light = np.asarray(light.to_light(surface.position))
    facing = np.asarray(surface.covered) & (np.sum(places[1] * to_light, axis=-1) > 0)
    seen = seen_share(*places, light, Occluders(scene.mesh.positions, scene.mesh.faces))
    fields = dict.fromkeys(View._fields) | {
        "scene": scene, "light": light, "layout": choose_layout(scene, ()), "surface": surface,
        "facing": facing, "share": np.where(facing, seen, 0.0),
    }  # fmt: skip
    return View(**fields)


@functools.cache
def view_of(name):
    return view_of_scene(load_scene(name))


@pytest.fixture(scope="module")
def whole_view():
    """A view as the command loads it."""
    return load_view("stacked", SIZE)


def plate_under(light):
    """A view of a floor and a plate over it, a unit high, from -0.5 to 0.5."""
    plate = placed(box((0.5, 0.01, 0.5)), (0.0, 1.0, 0.0))
    scene = staged("plate", [plane(3.0), plate], eye=(0.5, 4.0, 4.0), light=light)
    return view_of_scene(scene)


@functools.cache
def lit_plate(kind):
    """A view of the plate under a sun or a spot, and from which x to which its shadow lies."""
    if kind == "sun":  # half way up: the shadow moves by the height
        return plate_under(DirectionalLight(np.float32([-1, 1, 0]) / np.float32(2**0.5))), 0.5, 1.5
    # Three units up, two above the plate: distances from x = -2 grow by a half.
    down = np.float32([2, -3, 0]) / np.float32(13**0.5)
    return plate_under(SpotLight(np.float32([-2, 3, 0]), down, outer_angle=1.0)), 0.25, 1.75


def interior_error(view, seen):
    """The share of wrong pixels away from the edges of the shadow."""
    lit = view.share > 0.5
    covered = np.asarray(view.surface.covered)
    windows = np.lib.stride_tricks.sliding_window_view(np.pad(lit, 3, "edge"), (7, 7))
    inner = covered & (windows.all((2, 3)) | ~windows.any((2, 3)))
    assert inner.mean() > 0.3
    return np.mean(np.abs(seen - view.share)[inner] > 0.5)


# What is compared


def test_peers_have_names_of_their_own():
    assert len({peer.name for peer in PEERS}) == len(PEERS) == 10
    assert [p.samples for p in PEERS if isinstance(p, Mitsuba)] == [1, 4, 16, 64]
    assert [p.map_size for p in PEERS if isinstance(p, OpenGL)] == [256, 1024, 2048]
    assert {(p.kind, p.technique) for p in PEERS} == {("peer", name) for name in FINEST}
    assert Embree(4).label == Embree(4).name == "embree 4 rays"
    assert Mitsuba(1).name == "mitsuba 1 sample"
    assert OpenGL(256).name == "opengl 2x2 @ 256"
    assert pickle.loads(pickle.dumps(PEERS)) == PEERS


def test_they_apply_where_they_have_an_answer():
    sun, _, _ = lit_plate("sun")
    room, lamp = view_of("room"), view_of("soft-lamp")
    applied = [{peer.name for peer in PEERS if peer.applies(view)} for view in (room, sun, lamp)]
    once = {"embree 1 ray", "mitsuba 1 sample"}
    assert applied[0] == once  # a cube of maps
    assert applied[1] == once | {peer.name for peer in PEERS if peer.technique == "opengl"}
    assert applied[2] == {peer.name for peer in PEERS}


# Their answers


@pytest.mark.parametrize("technique", FINEST)
@pytest.mark.parametrize("kind", ["sun", "spot"])
def test_the_shadow_of_a_plate(technique, kind):
    view, low, high = lit_plate(kind)
    seen, _ = needed(FINEST[technique]).visibility(view)
    x, y, z = np.moveaxis(np.asarray(view.surface.position), -1, 0)
    half = 0.5 * (high - low)
    beyond = np.maximum(np.abs(x - 0.5 * (low + high)), np.abs(z)) - half
    floor = np.asarray(view.surface.covered) & (np.abs(y) < 1e-4)
    # A margin for the plate's thickness and for texels.
    inside, outside = floor & (beyond < -0.05), floor & (beyond > 0.05)
    assert inside.sum() > 40
    assert np.all(seen[inside] == 0)
    assert np.all(seen[outside] == 1)


@pytest.mark.parametrize(
    ("scene", "technique"),
    [("room", "embree"), ("room", "mitsuba"), *(("soft-lamp", technique) for technique in FINEST)],
)
def test_they_agree_with_truth_off_edges(technique, scene):
    view, peer = view_of(scene), needed(FINEST[technique])
    seen, _ = peer.visibility(view)
    assert seen.shape == view.share.shape
    assert np.all((seen >= 0) & (seen <= 1) & (view.facing | (seen == 0)))
    assert interior_error(view, seen) < 0.005  # 0


def test_embree_is_truth_under_lights_without_a_size(whole_view, programs):
    figures, _ = Embree(1).accuracy(whole_view, programs)
    assert figures["rmse"] == figures["error"] == 0
    assert figures["flip"] < 1e-4  # 6e-6: shaded by another program


@pytest.mark.parametrize("kind", [Embree, Mitsuba])
def test_more_samples_are_closer_to_truth(kind):
    view = view_of("soft-lamp")
    penumbra = (view.share > 0) & (view.share < 1)
    errors = []
    for samples in (1, 4, 16):
        seen, bias = needed(kind(samples)).visibility(view)
        errors.append(np.sqrt(np.mean((seen - view.share)[penumbra] ** 2)))
        assert bias == "none"
        assert np.array_equal(seen * samples, np.round(seen * samples))
    assert errors[0] > 1.8 * errors[1] > 3 * errors[2] > 0


def test_samples_of_mitsuba_are_spread_over_the_light():
    up = np.float32([1, 2, 0])
    down = np.float32([0.3, -1, 0.1])
    light = RectangleLight(np.float32([-0.5, 2.5, 0.2]), down, width=0.2, height=1.2, up=up)
    view = plate_under(light)
    seen, _ = needed(Mitsuba(256)).visibility(view)
    penumbra = view.facing & (view.share > 0) & (view.share < 1)
    assert penumbra.sum() > 100
    difference = (seen - view.share)[penumbra]
    assert abs(difference.mean()) < 3e-3  # 7e-4; 0.02 with width and height exchanged
    assert np.abs(difference).max() < 0.08  # 0.04; 0.4


@pytest.mark.parametrize("peer", [Embree(16), Mitsuba(64)], ids=["embree", "mitsuba"])
def test_what_is_below_the_horizon_is_not_seen(peer):
    along = np.float32([1, 0, 0])  # of its height of 1, 0.6 are above the floor
    light = RectangleLight(np.float32([-4, 0.1, 0]), along, width=0.2, height=1.0)
    view = plate_under(light)
    floor = np.asarray(view.surface.covered) & (np.asarray(view.surface.position)[..., 1] < 1e-4)
    assert floor.sum() > 1000
    seen, _ = needed(peer).visibility(view)
    assert np.abs(seen[floor] - 0.6).max() < 0.05  # 0.038 for 16 rays, 0.009 for 64 samples


def test_opengl_is_as_far_from_truth_as_our_own_2x2(whole_view, programs):
    peer = needed(OpenGL(1024))
    theirs, ours = (method.accuracy(whole_view, programs)[0] for method in (peer, BILINEAR))
    assert theirs["bias"].startswith("polygon offset")
    assert 0.8 < theirs["rmse"] / ours["rmse"] < 1.25  # 1.0
    coarse, _ = OpenGL(256).accuracy(whole_view, programs)
    assert coarse["rmse"] > 1.5 * theirs["rmse"] > 0


def test_opengl_chooses_the_best_offset(monkeypatch):
    view, peer = view_of("soft-lamp"), needed(OpenGL(256))
    _, best = peer.visibility(view)
    monkeypatch.setattr(opengl, "_FACTORS", (0.0, 20.0, *opengl._FACTORS))
    assert peer.visibility(view)[1] == best
    monkeypatch.setattr(opengl, "_FACTORS", (0.0,))
    seen, _ = peer.visibility(view)
    assert np.mean(seen[view.share == 1]) < 0.9  # acne


@pytest.mark.parametrize("technique", FINEST)
def test_answers_are_the_same_again(technique):
    view, peer = view_of("soft-lamp"), needed(FINEST[technique])
    assert np.array_equal(peer.visibility(view)[0], peer.visibility(view)[0])


# Figures and costs


@pytest.mark.parametrize("technique", FINEST)
def test_figures_are_those_of_our_methods(technique, whole_view, programs):
    view, peer = whole_view, needed(FINEST[technique])
    ours, our_picture = BILINEAR.accuracy(view, programs)
    theirs, picture = peer.accuracy(view, programs)
    assert theirs.keys() == ours.keys()
    assert theirs["gradient_error"] is None
    assert type(picture) is type(our_picture)
    assert len(picture) > 100
    our_round = BILINEAR.timing(view, programs, runs=1)
    one_round = peer.timing(view, programs, runs=1)
    assert one_round.keys() == our_round.keys()
    our_cost, cost = (summarize([one["stages"]]) for one in (our_round, one_round))
    there = {"draw", "image"} if technique == "opengl" else {"prepare", "image"}
    assert {part for part in PARTS if cost[part] is not None} == there
    for part in there:
        assert cost[part].keys() == our_cost[part].keys()
        low, median, high = cost[part]["ms"]
        assert 0 < low <= median <= high
    assert cost["total_ms"][1] >= sum(cost[part]["ms"][0] for part in there)
    assert one_round["kept_bytes"] == (4 * 2048**2 if technique == "opengl" else None)


# Absence


@pytest.mark.parametrize(("technique", "module"), [("mitsuba", "mitsuba"), ("opengl", "moderngl")])
def test_what_is_not_installed_is_named(technique, module, monkeypatch):
    monkeypatch.setitem(sys.modules, module, None)
    reason = absent()[technique]
    assert reason == f"the module {module} is not installed; pip install 'tangentspace[peers]'"
    assert "embree" not in absent()


def fail(error):
    def raises(*args, **kwargs):
        raise error

    return raises


def test_no_context_is_named(monkeypatch):
    monkeypatch.setattr(opengl, "_context", fail(Exception("(detect) libEGL\nnot loaded")))
    reason = "no OpenGL context could be made ((detect) libEGL not loaded); apt install"
    assert absent()["opengl"].startswith(reason)


def test_no_llvm_is_named(monkeypatch):
    needed(Mitsuba(1))
    _, dr = mitsuba_rays._modules()
    monkeypatch.setattr(dr, "eval", fail(RuntimeError("LLVM was not found")))
    assert "llvm_ad_rgb does not run, which wants LLVM; apt install" in absent()["mitsuba"]


def test_importing_loads_none_of_them():
    program = """
        import sys
        import experiments.frontier.peers
        assert not {"mitsuba", "drjit", "moderngl"} & set(sys.modules)
    """
    lines = "\n".join(line.strip() for line in program.splitlines())
    subprocess.run([sys.executable, "-c", lines], cwd=ROOT, check=True, timeout=120)


def test_notes_are_one_sentence():
    for peer in PEERS:
        assert "\n" not in peer.note
        assert 10 < len(peer.note) < 90
    assert peers.__doc__
