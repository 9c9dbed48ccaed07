"""Derivatives of images by dotted names: how numbers move scenes, the command, its errors."""

import json
import re
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image

import experiments.edge_gradients.derivatives_command as command
from experiments.__main__ import main
from experiments.edge_gradients.derivative_pictures import Derivatives, color_limit
from experiments.edge_gradients.scene_parameters import (
    Setup,
    choose_parameters,
    scene_parameters,
)
from experiments.files.images import read_exr
from experiments.mesh_parts import mesh_parts
from experiments.scenes.staging import placed, staged, sun
from experiments.technique_words import parse_bias, parse_lookup
from shadows import OrthographicCamera, SpotLight, mesh_edges
from tangentspace.shapes import box, icosphere, merge, plane

from .tools import assert_close

SMALL = ["--image-size", "64", "64", "--shadow-map-size", "128"]


def ball_scene():
    """A ball over a floor, and a box below it, which nobody sees."""
    ball = placed(icosphere(0.6, subdivisions=3), (0.0, 0.8, 0.0))
    hidden = placed(box((0.2, 0.1, 0.2)), (0.3, -0.5, 0.0))
    parts = [plane(2.0), hidden, ball]
    return staged("ball", parts, eye=(1.4, 1.9, 3.2), light=sun(50.0, -60.0))


def parameters(scene, bias=("constant=0.02",), compare=("soft=0.5",)):
    lookup, comparison = parse_lookup((), compare)
    setup = Setup.of(scene, parse_bias(bias, lookup), lookup, comparison)
    parts = mesh_parts(scene.mesh, mesh_edges(scene.mesh.positions, scene.mesh.faces))
    return setup, {known.name: known for known in scene_parameters(setup, parts, 64)}


@pytest.fixture
def run(monkeypatch, capsys, tmp_path):
    """Run ``main`` in this process, on the scene of the ball and in single precision."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(command, "load_scene", lambda name: ball_scene())

    def run(*arguments):
        monkeypatch.setattr(sys, "argv", ["experiments", "derivatives", *map(str, arguments)])
        with jax.enable_x64(False):
            code = main()
        return code, *capsys.readouterr()

    return run


# How numbers move a scene


def test_parts_are_named_by_size_and_the_mesh_is_all_but_the_floor():
    scene = ball_scene()
    setup, known = parameters(scene)
    velocity = {
        name: np.asarray(known[f"{name}.shift.x"].velocity(setup).mesh.positions)
        for name in ("mesh", "part1", "part2", "part3")
    }
    floor, hidden = len(plane(2.0).positions), len(box((1.0, 1.0, 1.0)).positions)
    moved = {
        "part1": slice(0, floor),
        "part2": slice(floor + hidden, None),
        "part3": slice(floor, floor + hidden),
        "mesh": slice(floor, None),
    }
    for name, mine in moved.items():
        expected = np.zeros_like(velocity[name])
        expected[mine, 0] = 1
        assert_close(velocity[name], expected)


def test_a_mesh_of_many_parts_names_the_largest():
    """Of equal ones the first; vertices that no face uses stay."""
    sizes = [2.0, *[0.1] * 30, 0.5]
    mesh = merge(*[placed(plane(size), (0.0, float(k), 0.0)) for k, size in enumerate(sizes)])
    mesh = mesh._replace(
        positions=np.concatenate([mesh.positions, [[9, 9, 9]]], dtype=np.float32),
        normals=np.concatenate([mesh.normals, [[0, 1, 0]]], dtype=np.float32),
        uvs=None,
    )
    parts = mesh_parts(mesh, mesh_edges(mesh.positions, mesh.faces))
    assert len(parts) == 9
    heights = [float(mesh.positions[part.vertices, 1].mean()) for part in parts]
    assert heights == [0, 31, *range(1, 8)]
    assert_close(parts[1].size, np.array([1, 0, 1.0]), ulps=2**30)
    setup, known = parameters(ball_scene()._replace(mesh=mesh))
    assert "part9.scale" in known
    assert "part10.scale" not in known
    rate = np.asarray(known["mesh.shift.y"].velocity(setup).mesh.positions)[:, 1]
    expected = (mesh.positions[:, 1] > 0).astype(rate.dtype)
    expected[-1] = 0
    assert_close(rate, expected)


@pytest.mark.parametrize("axis", "xyz")
def test_a_turn_is_about_an_axis_through_the_middle(axis):
    """Normals turn along; a quarter turn takes one axis to the next."""
    setup, known = parameters(ball_scene())
    turn = known[f"part2.turn.{axis}"]
    ball = slice(-len(icosphere(0.6, subdivisions=3).positions), None)
    middle, k = np.float32([0, 0.8, 0]), "xyz".index(axis)
    velocity = turn.velocity(setup)
    for field, about in (("positions", middle), ("normals", 0 * middle)):
        arm = np.asarray(getattr(setup.mesh, field))[ball] - about
        rate = np.asarray(getattr(velocity.mesh, field))[ball]
        assert_close(rate, np.deg2rad(np.cross(np.eye(3)[k], arm)).astype(rate.dtype))
        quarter = np.asarray(getattr(turn.move(setup, 90.0).mesh, field))[ball] - about
        assert_close(quarter[:, (k + 2) % 3], arm[:, (k + 1) % 3].astype(quarter.dtype))


def test_directions_keep_their_length_and_the_eye_moves():
    setup, known = parameters(ball_scene())
    towards = np.asarray(setup.lights[0].direction)
    moved = known["light.direction.x"].move(setup, 0.3).lights[0].direction
    expected = towards + 0.3 * np.float32([1, 0, 0])
    assert_close(moved, expected / np.linalg.norm(expected))
    point = jnp.array([0.1, 0.2, 0.3], jnp.float32)
    to_eye = lambda setup, far: far * np.asarray(setup.camera.to_camera(far * point))
    moved = known["camera.position.y"].move(setup, 0.5)
    eye = np.array([1.4, 1.9, 3.2])
    for seen, expected in ((setup, eye), (moved, eye + 0.5 * np.eye(3)[1])):
        away = expected - np.asarray(point)
        assert_close(to_eye(seen, 1), (away / np.linalg.norm(away)).astype(np.float32))


def test_every_number_has_a_name_and_moves_what_it_names():
    """Of a spot, a second light, a camera of parallel rays, bias and comparison."""
    scene = ball_scene()
    spot = SpotLight(np.array([0.0, 3.0, 0.0]), np.array([0.6, -0.8, 0.0]))
    camera = OrthographicCamera(scene.camera.view_from_world, 1.0, 0.1, 9.0)
    setup, known = parameters(scene._replace(lights=(*scene.lights, spot), camera=camera))
    wanted = {
        "mesh.scale", "light.color.b", "light2.position.z", "light2.outer_angle",
        "camera.half_height", "constant.length", "soft.softness",
    }  # fmt: skip
    assert wanted <= set(known)
    assert not {"light.position.x", "camera.near", "camera.vertical_fov"} & set(known)
    for parameter in known.values():
        rates = jax.tree.leaves(parameter.velocity(setup))
        assert any(np.any(np.asarray(rate)) for rate in rates), parameter.name
        assert all(np.isfinite(rate).all() for rate in rates)
        assert 0 < parameter.step < (5 if "turn" in parameter.name else 1)
        assert parameter.traced == (parameter.name not in ("constant.length", "soft.softness"))


# Errors of pictures


def test_errors_are_shares_of_the_difference_in_boxes():
    difference = np.zeros((9, 8))
    difference[:4, :4], difference[:4, 4:] = 1.0, -0.5
    forward = np.where(difference > 0, 1.5, difference)
    forward[8] = 7.0  # not in a whole box
    found = Derivatives(forward, 0 * difference, difference)
    assert found.size() == pytest.approx(0.375)
    assert found.error(forward) == pytest.approx(0.125 / 0.375)
    assert found.error(found.uncovered) == pytest.approx(1)
    assert found.mean_error(found.uncovered) == pytest.approx(1)
    nothing = Derivatives(*[0 * difference] * 3)
    assert nothing.error(forward) is nothing.mean_error(forward) is None
    assert color_limit(nothing.difference) == 1


# The command


def test_pictures_show_how_the_image_changes(run, tmp_path):
    """Through coverage as rays do; without it not. What nobody sees is said to move nothing."""
    names = ["mesh.shift.x", "light.color.r", "part3.shift.z"]
    code, out, err = run("ball", "--of", *names, "--out", "made/here", *SMALL)
    assert code == 0, err
    assert "part1: 2 faces, 4 x 0 x 4; taken for the floor" in err
    assert "part3.shift.z: moves no pixel of this view" in out
    folder = tmp_path / "made" / "here"
    files = {f"{name}.{kind}" for name in names[:2] for kind in ("png", "exr")}
    assert {path.name for path in folder.iterdir()} == files | {"derivatives.json"}
    content = json.loads((folder / "derivatives.json").read_text("utf-8"))
    shift, color, hidden = content["derivatives"]
    # Measured: 17 % of single boxes at this size, of which rays' own steps are a part.
    assert shift["forward"]["error_in_boxes"] < 0.25
    assert shift["without_coverage"]["error_in_boxes"] > 0.5
    assert abs(shift["forward"]["mean"] - shift["difference"]) < 0.05 * shift["mean_size"]
    assert color["forward"]["mean_error"] < 0.01
    assert not hidden["moves"]
    channels = read_exr(folder / "mesh.shift.x.exr")
    assert set(channels) == {"forward.Y", "uncovered.Y", "difference.Y"}
    assert channels["forward.Y"].mean() == pytest.approx(shift["forward"]["mean"], rel=1e-3)
    with Image.open(folder / "mesh.shift.x.png") as picture:
        assert picture.width > 1000
    line = next(line for line in out.splitlines() if line.lstrip().startswith("mesh.shift.x"))
    assert f"{shift['forward']['error_in_boxes']:.2%}" in line


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--of", "light.directon.x", "--out", "d"], "nearest: light.direction.x, "),
        (["--of", "mesh.shift.x", "wall", "--out", "d"], "--of wall: no such parameter; nearest:"),
        (["--of", "constant.length", "--out", "d"], "--of constant.length: no such parameter"),
        (["--of", "--out", "d"], "--of: name at least one number"),
        (["--out", "d"], "--of"),
        (["--of", "mesh.shift.x", "--out", "file/d"], "file is a file, no folder"),
        (["--of", "mesh.shift.x", "--out", "d", "--image-size", "0", "4"], "--image-size"),
    ],
)
def test_errors_are_one_line_and_leave_nothing(run, tmp_path, arguments, said):
    (tmp_path / "file").touch()
    code, out, err = run("ball", *arguments)
    assert (code, out) == (2, "")
    assert re.fullmatch(r"error: [^\n]+\n", err), err
    assert said in err
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_names_are_chosen_once():
    _, known = parameters(ball_scene())
    chosen = choose_parameters(["mesh.scale", "mesh.scale"], list(known.values()))
    assert [parameter.name for parameter in chosen] == ["mesh.scale"]
