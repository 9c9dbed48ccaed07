"""``python -m experiments fit-normal-map``: its files, its words, stopping, and bad input."""

import contextlib
import functools
import io
import json
import re
import shutil
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image

import experiments.checks
import experiments.normal_map_fits.fit_normal_map_command as command
from experiments.__main__ import main
from experiments.files.images import read_exr, write_exr, write_png
from experiments.files.map_files import read_normal_map
from experiments.normal_map_fits.normal_map_study import angles
from experiments.normal_map_fits.normal_map_views import see_map
from experiments.rendering.prepare_scene import prepare_scene
from experiments.scenes import load_scene
from experiments.scenes.relief import shadowed_relief
from shadows import shade, surface_appearance
from tangentspace.shading import LambertShading, PhongShading
from tangentspace.texture import clamp

from .test_normal_map_views import quick

SCENE, SIDE, IMAGE = "shadowed-relief", 32, (64, 64)
LEFT_BEHIND = ["progress.png", "settings.json", "state.eqx"]  # by a fit that was stopped
FILES = sorted(
    [
        *LEFT_BEHIND,
        *("comparison.png", "progress_curve.png", "summary.json"),
        *("evidence.exr", "normal_map.exr", "normal_map.png"),
    ]
)
SMALL = ["--image-size", "64", "64"]
FREE = ["--free", "albedo", "--shading", "lambert.albedo=0.7", "--steps", "7"]


@functools.cache
def small():
    """The relief with posts on it, under six lights, with a map of 32 x 32 texels."""
    return shadowed_relief(size=SIDE)


def normals_of(texels):
    vectors = 2.0 * np.asarray(texels, np.float64) - 1
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def truth():
    return normals_of(small().materials[0].normal_texture.texels)


@functools.cache
def rendered(shading, count):
    """What the renderer makes of the scene under each of so many lights, without mips."""
    scene = prepare_scene(small(), tangents=True)
    wraps, size = (clamp, clamp), (SIDE, SIDE)
    with jax.enable_x64(False):
        seen = see_map(scene, 0, image_size=IMAGE, map_size=size, wraps=wraps, shadow_margin=0)

        @quick
        def images(mesh, surface, visibilities):
            # As if the posts were made of it too: no fit looks at them.
            look = surface_appearance(mesh, scene.camera, surface, small().materials[:1])
            return [
                shade(surface, (light,), (reached,), appearance=look, shading=shading)
                for light, reached in zip(scene.lights, visibilities, strict=False)
            ]

        arrays = (scene.mesh, seen.surface, seen.visibility[:count].astype(np.float32))
        return [np.asarray(image) for image in images(*jax.tree.map(jnp.asarray, arrays))]


def write_image(path, image):
    if Path(path).suffix == ".png":
        write_png(path, image)
    else:
        write_exr(path, {name: image[..., k] for k, name in enumerate("RGB")})
    return str(path)


def contents(folder):
    return sorted(str(path.relative_to(folder)) for path in Path(folder).rglob("*"))


def call(*arguments):
    """Run ``main`` as users do; return its exit code and what it said."""
    out, err = io.StringIO(), io.StringIO()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["experiments", "fit-normal-map", *map(str, arguments)])
        patch.setattr(
            command, "load_scene", lambda name: small() if name == SCENE else load_scene(name)
        )
        with (
            jax.enable_x64(False),
            contextlib.redirect_stdout(out),
            contextlib.redirect_stderr(err),
        ):
            code = main()
    return code, out.getvalue(), err.getvalue()


@pytest.fixture
def run(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    return call


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
        *stages, last = err.splitlines()
        assert last.startswith("error: "), err
        assert not [line for line in stages if "error" in line.lower()]
        return last

    return refused


# A whole fit, of images that are made


@pytest.fixture(scope="module")
def fitted(tmp_path_factory):
    """Fit noisy images and return the folder and what was said."""
    folder = tmp_path_factory.mktemp("fitted") / "made" / "here"
    code, out, err = call(SCENE, "--out", folder, *SMALL, "--noise", "0.01", "--steps", "7")
    assert code == 0, err
    return folder, out, err


def summary_of(folder):
    def refuse(word):
        raise AssertionError(f"{word} is no JSON")

    return json.loads((folder / "summary.json").read_text(), parse_constant=refuse)


def test_a_fit_writes_all_its_files_and_nothing_else(fitted):
    folder, _, _ = fitted
    assert contents(folder) == FILES
    exact = read_normal_map(folder / "normal_map.exr").texels
    rounded = read_normal_map(folder / "normal_map.png").texels
    assert exact.shape == (SIDE, SIDE, 3)
    np.testing.assert_allclose(rounded, exact, atol=0.51 / 65535)
    for name, size in (("progress.png", (SIDE, SIDE)), ("comparison.png", None)):
        with Image.open(folder / name) as image:
            assert size in (None, image.size)
            assert len(image.convert("RGB").getcolors(1 << 24)) > 100
    with Image.open(folder / "progress_curve.png") as image:
        image.verify()


def test_the_summary_says_how_good_the_written_map_is(fitted):
    folder, _, _ = fitted
    summary = summary_of(folder)
    errors = angles(normals_of(read_normal_map(folder / "normal_map.exr").texels), truth())
    evidence = read_exr(folder / "evidence.exr")
    assert set(evidence) == {"seen.Y", "lights.Y", "standard_error.Y"}
    seen, lights = evidence["seen.Y"] == 1, evidence["lights.Y"]
    assert set(np.unique(lights)) <= set(range(7))
    assert 10 < (lights < 6).sum() < 300  # the posts' shadows
    for name, where in (("seen", seen), ("known", lights >= 3)):
        assert summary[name] == where.sum() > 0.9 * SIDE**2
        figures = summary[f"error_degrees_{name}"]
        assert figures["mean"] == pytest.approx(errors[where].mean(), abs=1e-3)
        assert figures["max"] == pytest.approx(errors[where].max(), abs=1e-2)
    assert summary["texels"] == SIDE**2
    assert summary["lights"] == {str(k): int((lights == k).sum()) for k in range(7)}
    assert summary["error_degrees_known"]["mean"] <= 1.5  # measured 0.17
    median = float(np.median(evidence["standard_error.Y"][lights >= 3]))
    assert summary["standard_error_degrees"] == pytest.approx(median, rel=1e-5)
    assert summary["rms_residual"] == pytest.approx(0.01, rel=0.05)
    assert summary["converged"] is True
    assert summary["undetermined"] == []


def test_what_is_printed_is_what_the_summary_holds(fitted):
    folder, out, err = fitted
    summary = summary_of(folder)
    for name, words in (("known", "under 3 lights or more"), ("seen", "seen at all")):
        mean, largest = (summary[f"error_degrees_{name}"][k] for k in ("mean", "max"))
        assert f"texels {words}: mean error {mean:.4f}, max {largest:.3f} degrees\n" in out
    error = summary["standard_error_degrees"]
    assert f"standard error of a known texel: {error:.4f} degrees\n" in out
    rows = dict(re.findall(r"^ ([0-9]+) +([0-9]+) +[0-9.]+%", out, re.MULTILINE))
    assert rows == {k: str(n) for k, n in summary["lights"].items() if n}
    assert f"{summary['steps']} solver steps" in out
    assert f"{summary['seconds']['fit']:.1f} s" in out
    unclear = summary["seen"] - summary["known"]
    assert (f"undetermined: {unclear} texels" in out) == (unclear > 0)
    assert "not converged" not in out
    assert str(folder) in out
    stages = [line.partition(":")[0] for line in err.splitlines()]
    assert stages[0] == f"loading {SCENE}"
    assert {"finding pixels and shadows", "fitting", "judging and drawing"} <= set(stages)


def test_the_history_tells_every_few_steps(fitted):
    folder, _, _ = fitted
    summary = summary_of(folder)
    history = summary["history"]
    steps = [row["step"] for row in history]
    assert steps[:-1] == list(range(0, 7 * (len(history) - 1), 7))
    assert steps[-1] == summary["steps"]
    assert history[-1]["loss"] < 0.01 * history[0]["loss"]
    assert history[-1]["mean_error"] < 0.1 * history[0]["mean_error"]
    seconds = [row["seconds"] for row in history]
    assert seconds == sorted(seconds)
    assert summary["seconds"]["fit"] == seconds[-1]
    assert history[-1]["mean_error"] == pytest.approx(summary["error_degrees_seen"]["mean"])


def test_the_settings_are_kept(fitted):
    folder, _, _ = fitted
    settings = json.loads((folder / "settings.json").read_text())
    assert settings == summary_of(folder)["settings"]
    assert settings["scene"] == SCENE
    assert settings["image_size"] == [64, 64]
    assert settings["map_size"] == [SIDE, SIDE]
    assert settings["noise"] == 0.01
    assert settings["free"] == []
    assert summary_of(folder)["versions"]["jax"] == jax.__version__


# Two images of a matte surface, which are not enough; fits that are stopped


@pytest.fixture(scope="module")
def pair(tmp_path_factory):
    """Return options for a fit to two images, with the albedo free beside the map."""
    folder = tmp_path_factory.mktemp("pair")
    images = rendered(LambertShading(0.5), 2)
    return ["--images", *(write_image(folder / f"{k}.exr", a) for k, a in enumerate(images)), *FREE]


@pytest.fixture(scope="module")
def fitted_pair(pair, tmp_path_factory):
    """Fit two images and return the folder and what was said."""
    folder = tmp_path_factory.mktemp("fitted_pair") / "made"
    code, out, err = call(SCENE, "--out", folder, *pair)
    assert code == 0, err
    return folder, out


@pytest.fixture(scope="module")
def stopped(pair, tmp_path_factory):
    """Interrupt the same fit in its third run of steps; return the folder and what was said."""
    folder = tmp_path_factory.mktemp("stopped") / "made"
    calls = []
    advance = command.MapFit.advance

    def interrupted(fit, steps):
        calls.append(steps)
        if calls.count(7) == 3:
            raise KeyboardInterrupt
        advance(fit, steps)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(command.MapFit, "advance", interrupted)
        said = call(SCENE, "--out", folder, *pair)
    return folder, said


@pytest.fixture
def half_done(stopped, tmp_path):
    """Return a copy of the stopped fit's folder."""
    shutil.copytree(stopped[0], tmp_path / "made")
    return tmp_path / "made"


def test_two_lights_are_said_not_to_be_enough(fitted_pair):
    folder, out = fitted_pair
    summary = summary_of(folder)
    assert summary["known"] == 0
    assert summary["seen"] > 0.99 * SIDE**2
    assert summary["standard_error_degrees"] is None
    assert summary["lights"]["2"] > 0.9 * SIDE**2
    evidence = read_exr(folder / "evidence.exr")
    assert evidence["lights.Y"].max() == 2
    sentence = f"undetermined: {summary['seen']} texels are told of by fewer than 3 lights"
    assert sentence in out
    assert "pairs of normals" in out
    assert "texels under 3 lights" not in out


def test_a_number_that_two_lights_do_not_tell_is_said(fitted_pair):
    folder, out = fitted_pair
    (sentence,) = summary_of(folder)["undetermined"]
    assert sentence == "albedo and the map: another mix gives the same images"
    assert f"undetermined: {sentence}\n" in out


def test_a_free_number_is_told(fitted_pair):
    folder, out = fitted_pair
    numbers = summary_of(folder)["numbers"]
    assert [*numbers] == ["albedo"]
    assert numbers["albedo"]["start"] == pytest.approx(0.7)
    assert numbers["albedo"]["fit"] != numbers["albedo"]["start"]
    assert f"albedo: 0.7 -> {numbers['albedo']['fit']:.4g}\n" in out


def test_an_interrupt_leaves_whole_files(stopped):
    folder, (code, out, err) = stopped
    assert code == 130
    assert out == ""
    assert err.splitlines()[-1].startswith("error: interrupted")
    assert "Traceback" not in err
    assert contents(folder) == LEFT_BEHIND
    json.loads((folder / "settings.json").read_text())
    with Image.open(folder / "progress.png") as image:
        assert image.size == (SIDE, SIDE)


def test_a_resumed_fit_ends_where_one_ends_that_was_never_stopped(
    run, pair, fitted_pair, half_done
):
    code, _, err = run(SCENE, "--out", "made", *pair, "--resume")
    assert code == 0, err
    assert contents(half_done) == FILES
    for name in ("normal_map.exr", "normal_map.png", "evidence.exr"):
        assert (half_done / name).read_bytes() == (fitted_pair[0] / name).read_bytes()
    resumed, whole = summary_of(half_done), summary_of(fitted_pair[0])
    assert 14 in [row["step"] for row in resumed["history"]]
    for field in ("steps", "numbers", "lights", "rms_residual", "undetermined"):
        assert resumed[field] == whole[field]


def test_other_settings_are_not_resumed(refused, pair, half_done):
    before = {path: path.read_bytes() for path in half_done.iterdir()}
    images = pair[1:3]
    for change, name in (
        (["--shadow-margin", "2"], "shadow_margin"),
        (["--shading", "lambert.albedo=0.6"], "shading"),
        (["--images", *images[::-1]], "images"),
        (["--free"], "free"),
    ):
        said = refused(SCENE, "--out", "made", *pair, "--resume", *change)
        assert "--resume: the stopped fit had other settings" in said
        assert name in said
    assert {path: path.read_bytes() for path in half_done.iterdir()} == before


@pytest.mark.parametrize(
    ("name", "content"),
    [("state.eqx", b""), ("state.eqx", None), ("settings.json", b"{"), ("settings.json", None)],
)
def test_a_folder_that_cannot_be_resumed_is_named(refused, pair, half_done, name, content):
    if content is None:
        (half_done / name).unlink()
    else:
        (half_done / name).write_bytes(content)
    assert f"made/{name}" in refused(SCENE, "--out", "made", *pair, "--resume")
    if content is not None:
        assert (half_done / name).read_bytes() == content


# Images that are given


def test_exr_images_of_the_renderer_give_the_map(run, tmp_path):
    """Of the project's own renderer, which knows nothing of the fit."""
    images = rendered(PhongShading(), 6)
    names = [write_image(f"{k}.exr", image) for k, image in enumerate(images)]
    before = {name: Path(name).read_bytes() for name in names}
    code, out, err = run(SCENE, "--out", "made", "--images", *names)
    assert code == 0, err
    assert contents(tmp_path / "made") == FILES
    assert {name: Path(name).read_bytes() for name in names} == before
    summary = summary_of(tmp_path / "made")
    errors = angles(normals_of(read_normal_map("made/normal_map.exr").texels), truth())
    known = read_exr("made/evidence.exr")["lights.Y"] >= 3
    assert known.mean() > 0.95
    assert errors[known].mean() <= 0.01  # measured 0.0001
    assert errors[known].max() <= 2  # measured 0.004
    assert summary["settings"]["images"] == names
    assert summary["settings"]["image_size"] == [64, 64]
    assert "error_degrees_known" not in summary
    assert "mean error" not in out
    assert "mean_error" not in summary["history"][0]


def test_png_images_and_lights_in_a_file_give_the_map(run, tmp_path):
    images = rendered(PhongShading(ambient=0.1 / 0.6), 6)
    names = [write_image(f"{k}.png", 0.6 * image) for k, image in enumerate(images)]
    with open("lights.txt", "w") as file:
        for light in small().lights:
            file.write(" ".join(str(float(2 * x)) for x in light.direction) + " 0.6 0.6 0.6\n")
    given = ["--images", *names, "--lights", "lights.txt", "--shadow-margin", "0"]
    code, _, err = run(SCENE, "--out", "made", *given)
    assert code == 0, err
    errors = angles(normals_of(read_normal_map("made/normal_map.exr").texels), truth())
    known = read_exr("made/evidence.exr")["lights.Y"] >= 3
    assert known.mean() > 0.95
    assert errors[known].mean() <= 0.3  # measured 0.1: 8 bits
    summary = summary_of(tmp_path / "made")
    assert summary["rms_residual"] < 1 / 255  # measured 0.0019
    assert summary["settings"]["lights"] == "lights.txt"


# Bad input


def exr(name, size=IMAGE, value=0.2, hole=None):
    image = np.full((*size, 3), value, np.float32)
    if hole is not None:
        image[30:34, 30:34] = hole
    return write_image(name, image)


def text(name, content):
    Path(name).write_text(content)
    return name


SQUARE = "v -1 0 -1\nv 1 0 -1\nv 1 0 1\nv -1 0 1\nf 4 3 2 1\n"
GIVEN = {
    "more images than lights": (
        lambda: [SCENE, "--images", *(exr(f"{k}.exr") for k in range(7))],
        r"--images: got 7 images, but shadowed-relief has 6 lights",
    ),
    "more images than lights in a file": (
        lambda: [SCENE, "--images", exr("a.exr"), exr("b.exr"), "--lights", text("l", "0 1 0")],
        r"--images: got 2 images, but shadowed-relief has 1 light",
    ),
    "sizes": (
        lambda: [SCENE, "--images", exr("a.exr"), exr("b.exr", (64, 48))],
        r"--images: expected images of one size, got 64 x 48, 64 x 64",
    ),
    "NaN": (
        lambda: [SCENE, "--images", exr("a.exr"), exr("b.exr", hole=np.nan)],
        r"--images: have pixels that are NaN or infinite",
    ),
    "infinite": (
        lambda: [SCENE, "--images", exr("a.exr", hole=np.inf)],
        r"--images: have pixels that are NaN or infinite",
    ),
    "missing image": (lambda: [SCENE, "--images", "no.exr"], r"no\.exr: no such file"),
    "kind": (lambda: [SCENE, "--images", text("a.jpg", "x")], r"a\.jpg: expected a name ending"),
    "no EXR": (lambda: [SCENE, "--images", text("a.exr", "x")], r"a\.exr: not an EXR image"),
    "no PNG": (lambda: [SCENE, "--images", text("a.png", "x")], r"a\.png: not a PNG image"),
    "noise": (
        lambda: [SCENE, "--images", exr("a.exr"), "--noise", "0.01"],
        r"--noise: is for images that are made",
    ),
    "no uvs": (
        lambda: [text("square.obj", SQUARE), "--images", exr("a.exr")],
        r"square.*: has no uvs",
    ),
    "no uvs, no map": (lambda: [text("square.obj", SQUARE)], r"square.*: has no uvs"),
    "no map": (lambda: ["sphere"], r"sphere: has no normal map to make images from; .*--images"),
    "missing lights": (lambda: [SCENE, "--lights", "no.txt"], r"no\.txt: cannot be read"),
    "bad lights": (
        lambda: [SCENE, "--lights", text("l.txt", "0 1 0\n1 2\n")],
        r"l\.txt: line 2: expected x y z",
    ),
    "no lights": (lambda: [SCENE, "--lights", text("l.txt", "# none\n")], r"l\.txt: holds no"),
    "scene": (lambda: ["releif"], r"scene 'releif': .*did you mean 'relief'"),
    "missing scene": (lambda: ["no.obj"], r"no\.obj: no such file"),
}


@pytest.mark.parametrize("flaw", GIVEN)
@pytest.mark.errors
def test_what_cannot_be_used_is_named(refused, flaw):
    make, says = GIVEN[flaw]
    arguments = make()
    assert re.search(says, refused(*arguments, "--out", "made", *SMALL))


OPTIONS = {
    "no out": ([SCENE], "--out"),
    "unknown option": ([SCENE, "--out", "made", "--nois", "1"], "--nois.*--noise"),
    "negative noise": ([SCENE, "--out", "made", "--noise", "-0.1"], "--noise: .* got -0.1"),
    "nan noise": ([SCENE, "--out", "made", "--noise", "nan"], "--noise: .* got nan"),
    "endless noise": ([SCENE, "--out", "made", "--noise", "inf"], "--noise: .* got inf"),
    "no steps": (
        [SCENE, "--out", "made", "--steps", "0"],
        "--steps: expected at least 1, got 0",
    ),
    "half a step": ([SCENE, "--out", "made", "--steps", "1.5"], "--steps"),
    "margin": ([SCENE, "--out", "made", "--shadow-margin", "-1"], "--shadow-margin: .* got -1"),
    "empty image": ([SCENE, "--out", "made", "--image-size", "0", "9"], "--image-size: .*0 9"),
    "huge map": ([SCENE, "--out", "made", "--map-size", "9", "9999"], "--map-size: .* 8192"),
    "one size": ([SCENE, "--out", "made", "--map-size", "9"], "--map-size"),
    "model": ([SCENE, "--out", "made", "--shading", "fong"], "did you mean 'phong'"),
    "models": ([SCENE, "--out", "made", "--shading", "phong", "lambert"], "--shading: .* got 2"),
    "model number": ([SCENE, "--out", "made", "--shading", "phong.albedo=x"], "albedo=x"),
    "file": ([SCENE, "--out", "file"], "file: file is a file, no folder"),
    "below a file": ([SCENE, "--out", "file/a"], "file/a: file is a file, no folder"),
    "free": ([SCENE, "--out", "there", *SMALL, "--free", "albdo"], "did you mean 'albedo'"),
    "free of other lights": (
        [SCENE, "--out", "there", *SMALL, "--free", "light.position"],
        "--free light.position: no such number",
    ),
    "nothing to resume": (
        [SCENE, "--out", "there", *SMALL, "--resume"],
        "there/settings.json",
    ),
}


@pytest.mark.parametrize("flaw", OPTIONS)
def test_an_option_that_makes_no_sense_is_named(refused, tmp_path, flaw):
    (tmp_path / "file").write_text("kept")
    (tmp_path / "there").mkdir()
    arguments, says = OPTIONS[flaw]
    assert re.search(says, refused(*arguments))
    assert (tmp_path / "file").read_text() == "kept"


def test_a_folder_that_cannot_be_written_to_is_named(refused, monkeypatch, tmp_path):
    (tmp_path / "locked").mkdir()
    monkeypatch.setattr(experiments.checks.os, "access", lambda *_: False)
    assert "locked/made: locked cannot be written to" in refused(SCENE, "--out", "locked/made")
