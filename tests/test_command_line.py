"""The command line as users run it, and the README's example."""

import contextlib
import json
import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image

import experiments.bias_fits.fit_bias_command as fit_bias_command
import experiments.rendering.render_command as render_command
from experiments.__main__ import main
from experiments.console import say_table, stage
from experiments.files.images import read_exr, read_image, write_exr, write_png
from experiments.scenes import EMBEDDED
from shadows.appearance import Appearance
from shadows.bias import CombinedBias, ConstantBias, SlopeBias
from shadows.render import Rendering
from shadows.shadow_map import ShadowMap
from shadows.surface import Surface

from .gltf_files import Builder
from .studies import IMAGE_SIZE, MAP_SIZE, study

ROOT = Path(__file__).parents[1]
SMALL = ["--image-size", "64", "48", "--shadow-map-size", "64"]
TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"
PICTURES = ["before", "after", "too_large", "sweep_best"]


# A program that a shell started in the background ignores interrupts, and so do its children.
INTERRUPTIBLE = """
import runpy, signal
signal.signal(signal.SIGINT, signal.default_int_handler)
runpy.run_module("experiments", run_name="__main__", alter_sys=True)
"""


def start(*arguments, cwd, program=("-m", "experiments")):
    """Start a program of its own, as a user does."""
    return subprocess.Popen(
        [sys.executable, *program, *arguments],
        cwd=cwd,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def finish(program):
    out, err = program.communicate(timeout=300)
    return program.returncode, out, err


def contents(folder):
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))


@pytest.fixture
def run(monkeypatch, capsys, tmp_path):
    """Run ``main`` in this process, in a folder of its own and in single precision."""
    monkeypatch.chdir(tmp_path)

    def run(*arguments):
        monkeypatch.setattr(sys, "argv", ["experiments", *map(str, arguments)])
        with jax.enable_x64(False):
            code = main()
        out, err = capsys.readouterr()
        return code, out, err

    return run


@pytest.fixture
def refused(run, tmp_path):
    """Run bad arguments, check that nothing comes of it, and return the one line."""

    def refused(*arguments):
        before = contents(tmp_path)
        code, out, err = run(*arguments)
        assert code == 2
        assert out == ""
        assert contents(tmp_path) == before
        assert "Traceback" not in err
        assert re.fullmatch(r"error: [^\n]+\n", err), err
        return err

    return refused


# Whole programs


@pytest.fixture(scope="module")
def fitted(tmp_path_factory):
    """Fit a small view and return the folder and what was said."""
    folder = tmp_path_factory.mktemp("fitted")
    sizes = ["--image-size", "96", "96", "--shadow-map-size", "128"]
    program = start("fit-bias", "thin-box", "--out", "made/here", *sizes, cwd=folder)
    code, out, err = finish(program)
    assert code == 0, err
    return folder / "made" / "here", out, err


def test_render_writes_the_channels_that_its_help_names(tmp_path):
    """On a mesh that is odd but legal, which is said."""
    odd = "v 5 5 5\nv 1 1 0\nf 1 2 3\nf 1 2 5 3\nf 2 2 3\n"
    (tmp_path / "odd.obj").write_text(TRIANGLE + odd)
    files = ["--out", "a.exr", "--png-out", "a.png", "--shadow-map-out", "map.exr"]
    code, out, err = finish(start("render", "odd.obj", *files, *SMALL, cwd=tmp_path))
    assert code == 0, err
    for note in (
        "1 vertex without a face",
        "1 face with more than three corners",
        "1 zero-area face",
        "with the same three points",
    ):
        assert note in err
    assert contents(tmp_path) == ["a.exr", "a.png", "map.exr", "odd.obj"]
    assert re.findall("wrote (.*)", out) == ["a.exr", "a.png", "map.exr"]
    channels = read_exr(tmp_path / "a.exr")
    names = {"R", "G", "B", "depth.Z", "normal.X", "normal.Y", "normal.Z", "visibility.V"}
    assert set(channels) == names
    assert {channel.shape for channel in channels.values()} == {(64, 48)}
    covered = channels["depth.Z"] < 1
    assert 0.5 < covered.mean() < 1
    assert channels["depth.Z"].min() > 0
    lengths = np.linalg.norm([channels[f"normal.{axis}"] for axis in "XYZ"], axis=0)
    np.testing.assert_allclose(lengths[covered], 1, atol=1e-5)
    assert set(np.unique(channels["visibility.V"][~covered])) == {0}
    assert set(channels["visibility.V"][covered].round(6)) >= {0.0, 1.0}
    map_channels = read_exr(tmp_path / "map.exr")
    assert set(map_channels) == {"depth.Z"}
    depth = map_channels["depth.Z"]
    assert depth.shape == (64, 64)
    assert depth.min() > 0
    assert depth.max() == 1
    with Image.open(tmp_path / "a.png") as image:
        assert (image.size, image.mode) == ((48, 64), "RGB")
    radiance = np.stack([channels[name] for name in "RGB"], axis=-1)
    shown = read_image(tmp_path / "a.png")[covered]
    np.testing.assert_allclose(shown, radiance.clip(0, 1)[covered], atol=0.01)


def test_exr_files_hold_single_precision(fitted):
    import OpenEXR

    for name in ("before.exr", "shadow_map.exr"):
        with OpenEXR.File(str(fitted[0] / name), separate_channels=True) as file:
            assert {c.pixels.dtype for c in file.channels().values()} == {np.dtype(np.float32)}


def test_fit_bias_writes_all_its_files_and_nothing_else(fitted):
    folder, _, _ = fitted
    assert contents(folder) == sorted(
        [
            *(f"{name}.{form}" for name in (*PICTURES, "truth") for form in ("exr", "png")),
            *(f"error_{name}.png" for name in PICTURES),
            *("acne_leak_curve.png", "comparison.png", "shadow_map.exr", "summary.json"),
        ]
    )
    before, truth = (read_exr(folder / f"{name}.exr") for name in ("before", "truth"))
    assert set(np.unique(truth["visibility.V"])) == {0.0, 1.0}
    for name in ("depth.Z", "normal.X", "normal.Y", "normal.Z"):
        np.testing.assert_array_equal(before[name], truth[name])


def test_the_summary_holds_every_figure(fitted):
    folder, _, _ = fitted
    summary = json.loads((folder / "summary.json").read_text())
    for field in ("acne", "leak", "error", "acne_interior", "leak_interior", "error_interior"):
        assert set(summary[field]) == {"before", "after", "sweep_best"}
        assert all(0 <= share <= 1 for share in summary[field].values())
    assert summary["acne"]["before"] > 0.3
    assert summary["error"]["after"] < 0.02
    for name, value in summary["objective"].items():
        if name != "name":
            assert value == pytest.approx(summary["error"][name], abs=1e-6)
    units = {name: entry["unit"] for name, entry in summary["parameters"].items()}
    assert units == {"constant.length": "world length", "slope.factor": "texel footprints"}
    for entry in summary["parameters"].values():
        assert set(entry) == {"after", "sweep_best", "unit"}
    assert 0 < summary["steps"] == sum(level["steps"] for level in summary["levels"])
    assert summary["evaluations"]["fit"] < summary["evaluations"]["sweep"]
    for cost in ("seconds", "compile_seconds"):
        assert all(summary[cost][name] > 0 for name in ("fit", "sweep"))
    assert summary["versions"]["jax"] == jax.__version__
    assert summary["device"]
    assert summary["commit"] is None or re.fullmatch(r"[0-9a-f]{40}\+?", summary["commit"])
    assert summary["settings"]["scene"] == "thin-box"
    assert summary["settings"]["image_size"] == [96, 96]


def test_the_summary_agrees_with_the_pictures(fitted):
    folder, _, _ = fitted
    summary = json.loads((folder / "summary.json").read_text())
    truth = read_exr(folder / "truth.exr")
    surface, lit = truth["depth.Z"] < 1, truth["visibility.V"] == 1
    for name in ("before", "after", "sweep_best"):
        seen = read_exr(folder / f"{name}.exr")["visibility.V"]
        acne, leak = seen[surface & lit] <= 0.5, seen[surface & ~lit] >= 0.5
        assert summary["acne"][name] == pytest.approx(acne.mean(), abs=1e-9)
        assert summary["leak"][name] == pytest.approx(leak.mean(), abs=1e-9)
        assert summary["error"][name] == pytest.approx((acne.sum() + leak.sum()) / surface.sum())


def test_fit_bias_says_what_it_does_and_what_came_of_it(fitted):
    _, out, err = fitted
    stages = [line.partition(":")[0] for line in err.splitlines()]
    assert stages[0] == "loading thin-box"
    assert {"fitting", "sweeping", "drawing"} <= set(stages)
    for word in ("zero bias", "fitted bias", "best of sweep", "acne", "leak", "constant.length ="):
        assert word in out
    assert "..." not in out.replace("\u2026", "...")  # no number is cut
    assert "made/here" in out


def test_bad_input_to_a_whole_program(tmp_path):
    code, out, err = finish(start("fit-bias", "no.obj", "--out", "made", cwd=tmp_path))
    assert (code, out, err) == (2, "", "error: no.obj: no such file; check the path\n")
    assert contents(tmp_path) == []


def test_an_interrupt_leaves_whole_files_and_says_so(tmp_path):
    arguments = ["fit-bias", "thin-box", "--out", "made", *SMALL]
    program = start(*arguments, cwd=tmp_path, program=("-c", INTERRUPTIBLE))
    assert program.stderr.readline().startswith("loading thin-box")  # it is at work
    program.send_signal(signal.SIGINT)
    code, _, err = finish(program)
    assert code == 130
    assert err.splitlines()[-1].startswith("error: interrupted")
    assert "Traceback" not in err
    assert not [name for name in contents(tmp_path) if Path(name).name.startswith(".")]


# In this process


def test_a_fit_to_a_picture_is_judged_by_the_picture(run, monkeypatch, tmp_path):
    box = study("thin-box")  # the same view, so that it is compiled once
    known = CombinedBias((ConstantBias(0.005), SlopeBias(1.5)))
    with jax.enable_x64(False):
        write_png(tmp_path / "target.png", box.picture(box.visibility(known)))
    monkeypatch.setattr(fit_bias_command, "load_scene", lambda name: box.scene)
    sizes = ["--image-size", *map(str, IMAGE_SIZE), "--shadow-map-size", str(MAP_SIZE)]
    code, out, err = run("fit-bias", "thin-box", "--target", "target.png", "--out", "made", *sizes)
    assert code == 0, err
    objective = json.loads((tmp_path / "made" / "summary.json").read_text())["objective"]
    assert objective["name"].startswith("rms")
    assert objective["name"] in out
    assert objective["after"] <= 1.1 * objective["sweep_best"]  # measured 1.02
    assert objective["after"] < 0.05 * objective["before"]


def test_help_names_every_scene_technique_and_unit(run, capsys):
    with pytest.raises(SystemExit) as stop:
        run("render", "--help")
    assert stop.value.code == 0
    words = " ".join(capsys.readouterr().out.replace("│", " ").split())
    for word in (*EMBEDDED, "normal-offset", "texel footprints", "world length", "nearest", "soft"):
        assert word in words


@pytest.fixture
def seen(monkeypatch):
    """Let ``render`` see nothing, under a shadow map of the given depth."""

    def seen(depth):
        with jax.enable_x64(False):
            empty, none = jnp.zeros((64, 48, 3)), jnp.full((64, 48), -1)
            surface = Surface(none, jnp.ones((64, 48)), *[empty] * 5)
            shadow_map = ShadowMap(jnp.full((64, 64), depth), jnp.eye(4))
            dark = (jnp.zeros((64, 48)),)
            image = Rendering(empty, dark, surface, Appearance(empty), (shadow_map,))
        monkeypatch.setattr(render_command, "render_scene", lambda *_, **__: image)

    return seen


def test_an_empty_view_is_said(run, seen):
    seen(0.5)
    code, _, err = run("render", "--out", "a.png", *SMALL)
    assert code == 0
    assert "note: the camera sees no surface; the image is empty\n" in err


def test_an_empty_shadow_map_is_refused(run, seen):
    seen(1.0)
    code, _, err = run("render", "--out", "a.png", *SMALL)
    assert code == 2
    assert err.splitlines()[-1].startswith("error: default: nothing is in the light's view")
    assert contents(Path()) == []


def scene_file(*, camera=None, lens=None, light=None, name="scene.glb", **document):
    """Write a sheet with a camera and a light, facing it unless told otherwise."""
    build = Builder()
    build.node(mesh=build.mesh(build.primitive()))
    lens = {"yfov": 0.8, "znear": 0.1, "zfar": 100.0, **(lens or {})}
    build.add("cameras", {"type": "perspective", "perspective": lens})
    build.node(**{"camera": 0, "translation": [0.5, 0.5, 3], **(camera or {})})
    spot = {"type": "spot", "spot": {"outerConeAngle": 0.3, "innerConeAngle": 0.1}}
    build.node(**{"translation": [0.5, 0.5, 4], "extensions": build.light(**spot), **(light or {})})
    build.document.update(document)
    return build.glb(Path(name))


AWAY = {"rotation": [0, 1, 0, 0]}  # half a turn: the back of the light
SCENES = {
    "missing": (lambda: "no.obj", "no.obj: no such file"),
    "folder": (lambda: os.mkdir("a.obj") or "a.obj", "a.obj: is a directory"),
    "unknown kind": (lambda: text("a.xyz", "x"), "a.xyz: unknown kind of file"),
    "no mesh": (lambda: text("a.obj", "hello\n"), "a.obj: has no faces"),
    "empty": (lambda: text("a.stl", ""), "a.stl: "),
    "no faces": (lambda: text("a.obj", "v 0 0 0\nv 1 0 0\n"), "a.obj: has no faces"),
    "nan": (lambda: text("a.obj", TRIANGLE + "v nan 0 0\nf 1 2 4\n"), "a.obj: 1 of 4 vertices"),
    "infinite": (lambda: text("a.obj", TRIANGLE + "v 1e99 0 0\nf 1 2 4\n"), "a.obj: 1 of 4 vert"),
    "out of range": (lambda: text("a.obj", TRIANGLE + "f 1 2 9\n"), "a.obj: 1 face indices out of"),
    "not glTF": (lambda: text("a.glb", "glTF, it says"), "a.glb: "),
    "extension": (lambda: scene_file(extensionsRequired=["KHR_new"]), "KHR_new"),
    "near and far": (lambda: scene_file(lens={"znear": 9.0, "zfar": 2.0}), "scene: the camera's"),
    "light away": (lambda: scene_file(light=AWAY), "scene: nothing is in the light's view"),
    "name": (lambda: "thin-bax", "scene 'thin-bax': .* did you mean 'thin-box'"),
    "long name": (lambda: "x" * 5000, "name too long"),
}


def text(name, content):
    Path(name).write_text(content)
    return name


@pytest.mark.parametrize("flaw", SCENES)
@pytest.mark.parametrize("command", ["render", "fit-bias"])
def test_a_scene_that_cannot_be_used_is_named(refused, command, flaw):
    make, says = SCENES[flaw]
    assert re.search(says, refused(command, make(), "--out", "made.exr", *SMALL))


FIT, RENDER = ["fit-bias", "--out", "made"], ["render", "--out", "made.exr"]
OPTIONS = {
    "command": (["rendr", "--out", "a.png"], "no such command 'rendr'; did you mean 'render'?"),
    "no command": ([], "render, fit-bias"),
    "no output": (["render"], "--out"),
    "option": ([*RENDER, "--image-sise", "5", "5"], "--image-sise.*--image-size"),
    "type": ([*RENDER, "--shadow-map-size", "1.5"], "--shadow-map-size"),
    "one size": ([*RENDER, "--image-size", "5"], "--image-size"),
    "choice": ([*RENDER, "--shading", "toon"], "--shading toon: no such.*lambert"),
    "zero size": ([*RENDER, "--image-size", "0", "5"], "--image-size: .* got 0 5"),
    "huge map": ([*FIT, "--shadow-map-size", "99999999999999"], "--shadow-map-size: .* 8192"),
    "bias": ([*FIT, "--bias", "slop=1"], "--bias slop=1: .*did you mean 'slope'"),
    "number": ([*FIT, "--bias", "slope.fctor=1"], "did you mean 'factor'"),
    "nan": ([*RENDER, "--bias", "slope=nan"], "--bias slope=nan: expected a finite number"),
    "infinity": ([*RENDER, "--bias", "constant=inf"], "expected a finite number"),
    "softness": ([*RENDER, "--compare", "soft=-1"], "--compare soft=-1: .* at least 0"),
    "compare": ([*RENDER, "--compare", "hart"], "did you mean 'hard'"),
    "filter": ([*FIT, "--filter", "linear"], "did you mean 'bilinear'"),
    "no bias": ([*FIT, "--bias"], "bias: has no numbers to fit"),
    "free": ([*FIT, "--free", "slope.facto"], "free slope.facto: .* did you mean 'slope.factor'"),
    "kind": (["render", "--out", "a.jpg"], "a.jpg: expected a name that ends in .exr or .png"),
    "png kind": ([*RENDER, "--png-out", "a.exr"], "a.exr: expected a name that ends in .png"),
    "no folder": (["render", "--out", "no/a.png"], "no/a.png: no folder no"),
    "folder": (["render", "--out", "folder.png"], "folder.png: is a folder"),
    "other folder": ([*RENDER, "--shadow-map-out", "folder.exr"], "folder.exr: is a folder"),
    "file": (["fit-bias", "--out", "file"], "file: file is a file"),
    "below a file": (["fit-bias", "--out", "file/a/b"], "file/a/b: file is a file"),
}


@pytest.mark.parametrize("flaw", OPTIONS)
def test_an_option_that_makes_no_sense_is_named(refused, tmp_path, flaw):
    (tmp_path / "file").write_text("kept")
    (tmp_path / "folder.png").mkdir()
    (tmp_path / "folder.exr").mkdir()
    arguments, says = OPTIONS[flaw]
    assert re.search(says, refused(*arguments))


def test_a_message_is_short_also_on_a_terminal_with_color(refused, monkeypatch):
    monkeypatch.setenv("FORCE_COLOR", "1")
    said = refused("render", "--out", "a.png", "--bogus", "3")
    assert said == "error: Unrecognized options: --bogus, 3; see python -m experiments --help\n"


def target(name, **channels):
    write_exr(name, {k: np.full((64, 48), v, np.float32) for k, v in channels.items()})
    return name


TARGETS = {
    "missing": (lambda: "no.exr", "no.exr: no such file"),
    "kind": (lambda: text("a.jpg", "x"), "a.jpg: expected a name ending in .exr or .png"),
    "no EXR": (lambda: text("a.exr", "x"), "a.exr: not an EXR image"),
    "no PNG": (lambda: text("a.png", "x"), "a.png: not a PNG image"),
    "channels": (lambda: target("a.exr", R=1, G=1), "a.exr: expected channels R, G, B"),
    "hole": (lambda: target("a.exr", R=1, G=1, B=np.nan), "a.exr: has pixels that are NaN"),
    "size": (
        lambda: write_png("a.png", np.zeros((48, 64, 3), np.float32)) or "a.png",
        "a.png: expected 64 x 48 pixels .* got 48 x 64",
    ),
}


@pytest.mark.parametrize("flaw", TARGETS)
def test_a_target_that_cannot_be_used_is_named(refused, flaw):
    make, says = TARGETS[flaw]
    assert re.search(says, refused("fit-bias", "--out", "made", "--target", make(), *SMALL))


@pytest.mark.parametrize(
    ("raised", "code", "says"),
    [
        (KeyboardInterrupt(), 130, "interrupted; files written so far are whole"),
        (MemoryError(), 2, "out of memory"),
        (jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: 9 GiB"), 2, "out of memory"),
        (PermissionError(13, "Permission denied", "a.bin"), 2, "a.bin"),
        (ValueError("a: first\nsecond"), 2, "a: first second"),
    ],
)
def test_what_goes_wrong_on_the_way_is_one_line(run, monkeypatch, tmp_path, raised, code, says):
    def fail(*args, **kwargs):
        raise raised

    monkeypatch.setattr(fit_bias_command, "prepare_study", fail)
    found, out, err = run("fit-bias", "--out", "made", *SMALL)
    assert (found, out) == (code, "")
    assert says in err.splitlines()[-1]
    assert "Traceback" not in err
    assert contents(tmp_path) == []


def test_a_fault_of_ours_keeps_its_traceback(run, monkeypatch):
    def fail(*args, **kwargs):
        raise jax.errors.JaxRuntimeError("INTERNAL: broken")

    monkeypatch.setattr(render_command, "render_scene", fail)
    with pytest.raises(jax.errors.JaxRuntimeError, match="INTERNAL"):
        run("render", "--out", "a.png")


def test_a_table_is_never_cut(capsys):
    say_table("[all]", ["name", "number"], [["n" * 70, "1" * 60]])
    out = capsys.readouterr().out
    for words in ("[all]", "n" * 70, "1" * 60):
        assert words in out


def test_a_stage_is_said_once_it_went_well(capsys):
    with stage("good [red]") as report:
        report("half of it [red]")
    with pytest.raises(ValueError, match="bad"), stage("bad"):
        raise ValueError("bad")
    out, err = capsys.readouterr()
    assert out == ""
    assert re.fullmatch(r"good \[red\]: \d+\.\d s\n", err)


# The README


def test_the_example_of_the_readme_runs(capsys):
    (example,) = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    example = re.sub(r"image_size=\(\d+, \d+\)", "image_size=(48, 48)", example)
    example, changes = re.subn(r"map_size=\d+", "map_size=64", example)
    assert changes == 1
    with jax.enable_x64(False), contextlib.chdir(ROOT):
        exec(example, {})
    assert float(capsys.readouterr().out) > 0  # more bias, more light


def test_the_commands_of_the_readme_are_understood():
    text = (ROOT / "README.md").read_text() + (ROOT / "Makefile").read_text()
    commands = re.findall(r"python -m experiments ((?:render|fit-bias) [^`\n]*)", text)
    assert len(commands) >= 4
    from experiments.__main__ import _parse
    from experiments.bias_fits.fit_bias_command import fit
    from experiments.rendering.render_command import render

    for command in commands:
        _parse(command.split(), {"render": render, "fit-bias": fit})
