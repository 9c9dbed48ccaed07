"""Techniques as users name them: one new class is all it takes, and nonsense is refused."""

import contextlib
import re
import sys
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.__main__ import main
from experiments.files.images import read_exr
from experiments.options import describe
from shadows import Filter, Tap, TapFilter
from shadows.filters import fetch
from shadows.transforms import Scalar

SMALL = ["--image-size", "64", "48", "--shadow-map-size", "64"]


class CrossFilter(TapFilter):
    """Five texels: the receiver's, and one on each side.

    Attributes:
        arm: How far the others are.
        middle: How often the first counts.
    """

    arm: Scalar = eqx.field(default=2.0, metadata={"unit": "texels"})
    middle: int = eqx.field(static=True, default=1, metadata={"whole": "times"})

    def reach(self):
        """Return the arm and half a texel."""
        return self.arm + 0.5

    def read(self, prepared, receiver):
        """Read five texels."""
        column, row = jnp.floor(receiver.column), jnp.floor(receiver.row)
        taps = []
        for across, down in ((0, 0), (1, 0), (-1, 0), (0, 1), (0, -1)):
            right, below = column + jnp.round(across * self.arm), row + jnp.round(down * self.arm)
            stored = fetch(prepared.depth, right, below, receiver)
            weight = jnp.full_like(stored, 1.0 if across or down else self.middle)
            offset = right + 0.5 - receiver.column, below + 0.5 - receiver.row
            taps.append(Tap(stored, weight, *offset))
        return tuple(taps)


@pytest.fixture
def run(monkeypatch, capsys, tmp_path):
    """Run ``main`` in a folder of its own and in single precision."""

    def run(*arguments):
        monkeypatch.setattr(sys, "argv", ["experiments", *map(str, arguments)])
        with jax.enable_x64(False), contextlib.chdir(tmp_path):
            code = main()
            made = {path.name: read_exr(path) for path in Path().glob("*.exr")}
        return code, capsys.readouterr().err, made

    return run


# Nothing said


@pytest.mark.parametrize(
    ("scene", "words"),
    [
        ("default", ["bilinear"]),
        ("soft-lamp", ["pcss", "--filter.taps", 8, "--filter.search_taps", 8]),
    ],
)
def test_the_least_filter_is_taken_for_a_scene(run, scene, words):
    """And its bias, or the one that is asked for."""
    for bias in ([], ["--bias", "constant=0.02"]):
        asked = ["render", scene, *SMALL, *bias]
        code, err, made = run(*asked, "--out", "least.exr")
        assert code == 0, err
        code, err, made = run(*asked, "--out", "named.exr", "--filter", *words)
        assert code == 0, err
        least, named = (made[f"{name}.exr"]["visibility.V"] for name in ("least", "named"))
        np.testing.assert_array_equal(least, named)
        assert 0.1 < least.mean() < 0.9


# One class is all it takes


def test_a_new_filter_is_found_and_rendered_with(run):
    """By the command line's own path, its options and their units included."""
    render = ["render", "thin-box", "--out", "a.exr", "--bias", "slope=3", *SMALL]
    code, err, made = run(*render, "--filter", "cross", "--filter.arm", "2", "--filter.middle", "4")
    assert code == 0, err
    levels = np.unique(made["a.exr"]["visibility.V"].round(5))
    assert set(levels) <= {0.0, 0.125, 0.25, 0.375, 0.5, 0.625, 0.75, 0.875, 1.0}
    assert len(levels) > 5
    code, err, alone = run(*render, "--filter", "cross.arm=0")
    assert code == 0, err
    code, err, nearest = run(*render, "--filter", "nearest")
    assert code == 0, err
    np.testing.assert_array_equal(*(m["a.exr"]["visibility.V"] for m in (alone, nearest)))
    (line,) = [line for line in describe(Filter) if line.startswith("cross ")]
    expected = "cross (arm, default 2.0 texels, middle, default 1 times): Five texels: the receiver"
    assert line.startswith(expected)


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["cross.amr=2"], "cross.amr=2: 'cross' has no such option; did you mean 'arm'?"),
        (["cross.middle=1.5"], "expected a whole number, got 1.5"),
        (["cros"], "no such technique 'cros'; did you mean 'cross'?"),
    ],
)
def test_mistakes_in_its_options_are_named_too(run, words, says):
    code, err, _ = run("render", "--out", "a.exr", "--filter", *words)
    assert (code, err) == (2, f"error: --filter {words[0]}: {says.split(': ', 1)[-1]}\n")


# Several maps


@pytest.mark.parametrize(
    ("scene", "options", "count"),
    [
        ("room", [], 6),
        ("avenue", ["--layout", "cascades", "--layout.count", "2", "--filter", "tent=2"], 2),
    ],
)
def test_layouts_by_name(run, scene, options, count):
    """A point light inside the scene has a cube unasked; its maps lie one below another."""
    files = ["--out", "a.exr", "--shadow-map-out", "map.exr"]
    code, err, made = run("render", scene, *files, *options, *SMALL)
    assert code == 0, err
    depths = made["map.exr"]["depth.Z"].reshape(count, 64, 64)
    assert all(np.mean(depth < 1) > 0.02 for depth in depths)
    visibility = made["a.exr"]["visibility.V"][made["a.exr"]["depth.Z"] < 1]
    assert 0.1 < visibility.mean() < 0.95


# What makes no sense

NONSENSE = {
    "filter": (["--filter", "pcff"], "--filter pcff: no such technique 'pcff'; did you mean 'pcf'"),
    "option": (
        ["--filter", "pcf", "--filter.raduis", "2"],
        "--filter .raduis=2: 'pcf' has no such option; did you mean 'radius'",
    ),
    "radius": (["--filter", "pcf=-1"], "--filter pcf: .* `radius` .* from 0 to 16, got -1"),
    "wide radius": (["--filter", "pcf=17"], "--filter pcf: .* `radius` .* from 0 to 16, got 17"),
    "half a radius": (["--filter", "pcf=1.5"], "--filter pcf=1.5: expected a whole number"),
    "tent": (["--filter", "tent=4"], "--filter tent: .* `radius` 1, 2 or 3, got 4"),
    "disc": (["--filter", "poisson=-0.5"], "--filter poisson: .* `radius` of at least 0, got -0.5"),
    "points": (["--filter", "poisson.taps=0"], "--filter poisson: .* `taps` from 1 to 128, got 0"),
    "light size": (["--filter", "pcss=-1"], "--filter pcss: .* `light_size` of at least 0, got"),
    "two filters": (["--filter", "pcf", "tent"], "--filter: expected one technique, got 2"),
    "whose option": (["--filter.radius", "2"], "--filter.radius: of which technique"),
    "no comparison": (
        ["--filter", "vsm", "--compare", "soft"],
        "--compare: --filter vsm compares no depths; drop one of them",
    ),
    "no texels compared": (
        ["--filter", "vsm", "--bias", "adaptive"],
        "bias: AdaptiveBias compares texel by texel, which VSMFilter does not",
    ),
    "nor with others": (
        ["--filter", "msm", "--bias", "slope", "receiver-plane"],
        "bias: ReceiverPlaneBias compares texel by texel, which MSMFilter does not",
    ),
    "casters": (
        ["--bias", "front-face-culling", "slope", "midpoint"],
        "`terms` .* got FrontFaceCullingBias and MidpointBias",
    ),
    "unit": (["--bias", "slope.unit=foot"], "--bias slope.unit=foot: expected world or texel or"),
    "no cascades": (
        ["--layout", "cascades", "--layout.count", "0"],
        "--layout cascades: .* `count` from 1 to 8, got 0",
    ),
    "many cascades": (["--layout", "cascades=9"], "--layout cascades: .* from 1 to 8, got 9"),
    "layout": (["--layout", "cubes"], "--layout cubes: no such technique .* did you mean 'cube'"),
}
LATER = {
    "cube of the sun": ("thin-box", ["--layout", "cube"], "CubeLayout: expected a PointLight, got"),
    "cube of a spot": ("spot", ["--layout", "cube"], "CubeLayout: .* got a SpotLight"),
    "cascades of a lamp": ("spot", ["--layout", "cascades"], "CascadesLayout: expected a Direct"),
    "one map inside": ("room", ["--layout", "single"], "stands inside .* take the cube layout"),
    "wider than the map": (
        "thin-box",
        ["--filter", "poisson=64", "--shadow-map-size", "64"],
        "--filter: reaches 65 texels, expected less than 64 for shadow maps of 64; ",
    ),
    "wider than half a cascade": (
        "thin-box",
        ["--filter", "pcf=16", "--layout", "cascades", "--shadow-map-size", "36"],
        "--filter: reaches 17 texels, expected less than 17 for shadow maps of 36; ",
    ),
}


@pytest.mark.errors
@pytest.mark.parametrize("command", ["render", "fit-bias"])
@pytest.mark.parametrize("flaw", NONSENSE)
def test_nonsense_is_refused_in_one_line(run, tmp_path, command, flaw):
    options, says = NONSENSE[flaw]
    code, err, _ = run(command, "--out", "made.exr", *options)
    assert code == 2
    assert re.fullmatch(r"error: [^\n]+\n", err), err
    assert re.search(says, err), err
    assert not list(tmp_path.iterdir())


@pytest.mark.errors
@pytest.mark.parametrize("flaw", LATER)
def test_what_a_scene_does_not_bear_is_refused(run, tmp_path, flaw):
    """Once the scene is known; whatever was said before, the last line says why."""
    scene, options, says = LATER[flaw]
    code, err, _ = run("render", scene, "--out", "made.exr", "--image-size", "32", "32", *options)
    assert code == 2
    assert "Traceback" not in err
    last = err.splitlines()[-1]
    assert last.startswith("error: "), err
    assert re.search(says, last), err
    assert not list(tmp_path.iterdir())
