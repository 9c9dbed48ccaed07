import os
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from experiments.checks import (
    check_folder,
    check_out,
    check_scene,
    check_shadow_map,
    check_size,
    check_target,
    make_folder,
)
from experiments.scenes import EMBEDDED, load_scene
from experiments.technique_words import choose_layout
from shadows.area_lights import DiscLight, RectangleLight
from shadows.lights import DirectionalLight, PointLight, SpotLight
from shadows.projector import Projector
from shadows.shadow_map import ShadowMap, render_shadow_map

SCENE = load_scene("stacked")
DOWN = np.array([0, -1, 0], np.float32)


def f32(*values):
    return np.array(values, np.float32)


def camera(**changed):
    return SCENE._replace(camera=SCENE.camera.__class__(**{**vars(SCENE.camera), **changed}))


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "file"
    path.write_text("kept")
    return path


@pytest.fixture
def read_only(monkeypatch):
    """Let nothing be writable; the tests may be run by one who may write everywhere."""
    monkeypatch.setattr(os, "access", lambda path, mode: not mode & os.W_OK)


@pytest.mark.parametrize("size", [1, 8192])
def test_sizes_in_range_pass(size):
    check_size("--image-size", size, 8192)


@pytest.mark.parametrize("size", [0, -1, 8193, 10**30])
def test_sizes_out_of_range_are_refused(size):
    with pytest.raises(ValueError, match=f"^--map: expected sizes from 1 to 8192.*got 5 {size}$"):
        check_size("--map", 5, size)


def test_a_folder_that_can_be_made_passes_and_is_not_made_yet(tmp_path):
    folder = tmp_path / "a" / "b"
    check_folder(folder)
    assert list(tmp_path.iterdir()) == []
    make_folder(folder)
    make_folder(folder)
    check_folder(folder)
    assert folder.is_dir()


def test_a_relative_folder_passes(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    check_folder(Path("a/b"))
    check_folder(Path())


@pytest.mark.parametrize("below", ["", "a/b"])
def test_a_file_is_no_folder(file, below):
    with pytest.raises(ValueError, match=f"{file / below}: {file} is a file"):
        check_folder(file / below)
    with pytest.raises(ValueError, match=rf"{file / below}: cannot be made \("):
        make_folder(file / below)
    assert file.read_text() == "kept"


def test_a_read_only_folder_is_refused(tmp_path, read_only):
    with pytest.raises(ValueError, match=f"{tmp_path / 'a'}: {tmp_path} cannot be written to"):
        check_folder(tmp_path / "a")
    with pytest.raises(ValueError, match=r"a\.png: its folder cannot be written to"):
        check_out(tmp_path / "a.png", ".png")


def test_outputs_that_can_be_written_pass(tmp_path):
    check_out(tmp_path / "a.PNG", ".exr", ".png")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("a.jpg", "ends in .exr or .png"),
        ("a", "ends in .exr or .png"),
        ("no/a.png", "no folder"),
        ("taken.png", "is a folder"),
        ("file/a.png", "no folder"),
    ],
)
def test_outputs_that_cannot_be_written_are_refused(tmp_path, file, name, says):
    (tmp_path / "taken.png").mkdir()
    with pytest.raises(ValueError, match=says) as error:
        check_out(tmp_path / name, ".exr", ".png")
    assert str(error.value).startswith(f"{tmp_path / name}: ")


def test_a_target_fits_the_view():
    image = np.zeros((4, 6, 3), np.float32)
    check_target(Path("t.exr"), image, (4, 6))
    with pytest.raises(ValueError, match=r"^t.exr: expected 6 x 4 pixels .* got 4 x 6"):
        check_target(Path("t.exr"), image, (6, 4))
    for value in (np.nan, np.inf):
        image[0, 0, 0] = value
        with pytest.raises(ValueError, match=r"^t.exr: has pixels that are NaN or infinite"):
            check_target(Path("t.exr"), image, (4, 6))


@pytest.mark.parametrize("name", EMBEDDED)
def test_embedded_scenes_pass(name):
    scene = load_scene(name)
    check_scene(scene, choose_layout(scene, ()))


@pytest.mark.parametrize(
    ("near", "far", "passes"), [(0.5, 20.0, True), (20.0, 20.0, False), (np.nan, 1.0, False)]
)
def test_the_camera_has_room_between_near_and_far(near, far, passes):
    if passes:
        check_scene(camera(near=near, far=far))
        return
    with pytest.raises(ValueError, match=r"^stacked: the camera's near .* less than its far"):
        check_scene(camera(near=near, far=far))


AT_TARGET = np.zeros(3, np.float32)
HIGH = f32(0, 5, 0)
SLIDE = np.ones((2, 3, 3), np.float32)


@pytest.mark.parametrize(
    ("light", "says"),
    [
        (DirectionalLight(AT_TARGET), "direction is zero"),
        (DirectionalLight(f32(np.nan, 1, 0)), "direction"),
        (SpotLight(HIGH, AT_TARGET), "direction is zero"),
        (SpotLight(HIGH, DOWN, outer_angle=2.0), "outer angle"),
        (SpotLight(HIGH, DOWN, outer_angle=0.0), "outer angle"),
        (SpotLight(HIGH, -DOWN), "nothing is in the light's view"),
        (SpotLight(f32(np.nan, 5, 0), DOWN), "nothing is in the light's view"),
        (PointLight(f32(0, 0.5, 0)), "inside the scene"),
        (Projector(HIGH, AT_TARGET, SLIDE), "direction is zero"),
        (Projector(HIGH, f32(0, np.inf, 0), SLIDE), "direction"),
        (Projector(HIGH, DOWN, SLIDE, up=f32(0, np.nan, 1)), "`up` is NaN"),
        (Projector(HIGH, DOWN, SLIDE * np.float32(np.nan)), "image has pixels that are NaN"),
        (Projector(HIGH, DOWN, SLIDE, jnp.asarray(4.0)), "vertical field between 0 and pi, got 4"),
        (Projector(HIGH, -DOWN, SLIDE), "nothing is in the light's view"),
        (DiscLight(HIGH, AT_TARGET, 0.1), "direction is zero"),
        (DiscLight(HIGH, f32(np.nan, 0, 0), 0.1), "direction"),
        (DiscLight(HIGH, DOWN, 0.0), "radius between 0 and infinity, got 0"),
        (DiscLight(HIGH, DOWN, jnp.asarray(-1.0)), "radius between 0 and infinity, got -1"),
        (DiscLight(HIGH, DOWN, np.inf), "radius between 0 and infinity, got inf"),
        (DiscLight(f32(0, np.nan, 0), DOWN, 0.1), "nothing is in the light's view"),
        (DiscLight(HIGH, -DOWN, 0.1), "nothing is in the light's view"),
        (RectangleLight(HIGH, AT_TARGET, 0.1, 0.1), "direction is zero"),
        (RectangleLight(HIGH, DOWN, 0.0, 0.1), "width between 0 and infinity, got 0"),
        (RectangleLight(HIGH, DOWN, 0.1, jnp.asarray(np.nan)), "height .* got nan"),
        (RectangleLight(HIGH, DOWN, 0.1, 0.1, up=f32(np.nan, 0, 1)), "`up` is NaN"),
    ],
)
def test_lights_without_sense_are_refused(light, says):
    with pytest.raises(ValueError, match=says) as error:
        check_scene(SCENE._replace(lights=(light,)))
    assert str(error.value).startswith("stacked: ")
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    "light",
    [
        SpotLight(HIGH, DOWN),
        PointLight(HIGH),
        Projector(HIGH, DOWN, SLIDE),
        DiscLight(HIGH, DOWN, 0.1),
        RectangleLight(HIGH, DOWN, 0.1, 0.2),
    ],
)
def test_lights_over_the_scene_pass(light):
    check_scene(SCENE._replace(lights=(light,)))


def test_a_light_that_looks_past_everything_is_refused():
    aside = SpotLight(f32(0, 5, 0), f32(1, 0, 0), outer_angle=0.2)
    scene = SCENE._replace(lights=(aside,))
    matrix = aside.clip_from_world(jnp.asarray(scene.mesh.positions))
    missed = render_shadow_map(scene.mesh.positions, scene.mesh.faces, matrix, map_size=8)
    with pytest.raises(ValueError, match=r"^stacked: nothing is in the light's view"):
        check_shadow_map(scene, missed, casters="nearest")


def test_a_map_without_back_faces_may_be_empty():
    empty = ShadowMap(jnp.ones((4, 4)), jnp.eye(4))
    check_shadow_map(SCENE, empty, casters="back")
    check_shadow_map(SCENE, ShadowMap(empty.depth.at[1, 1].set(0.5), jnp.eye(4)), casters="nearest")
