"""The least model: the search on tables, what theory says, known answers, the command."""

import contextlib
import dataclasses
import json
import re
import sys

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import experiments.simplest.command as command
import experiments.simplest.evidence as evidence
import experiments.simplest.models as models
from experiments.__main__ import main
from experiments.files.images import read_exr
from experiments.options import parse_technique
from experiments.rendering.render_scene import render_scene
from experiments.scenes import load_scene
from experiments.simplest.bench import Measured, stages
from experiments.simplest.choice import choose
from experiments.simplest.climb import Expected, Found, climb, covariance
from experiments.simplest.find import out_of_reach, simplest
from experiments.simplest.models import Model, all_models, bias_words, biases_for, filters
from experiments.simplest.search import Search
from experiments.simplest.sight import look_at_scene, picture_of, shown
from experiments.simplest.theory import Theory
from experiments.technique_words import least_filter, parse_bias
from shadows.filters import Filter
from shadows.layouts import CubeLayout, SingleLayout
from tangentspace.texture import Texture

SIZE = 48


@pytest.fixture(scope="module", autouse=True)
def single_precision():
    """As users have it."""
    with jax.enable_x64(False):
        yield


# The search, on tables


class Table:
    """Families of models of growing size: errors fall, costs rise, both with chance in them."""

    def __init__(self, seed, *, families=16, sizes=5, rough=0.15, surprise=0.15):
        rng = np.random.default_rng(seed)
        family, size = np.divmod(np.arange(families * sizes), sizes)
        error = 0.05 * np.exp(rng.normal(0, 0.7, families))[family] * 0.6**size
        self.error = error * np.exp(rng.normal(0, rough, len(error)))
        dear = np.exp(rng.normal(0, 0.8, families))[family]
        self.cost = 3.0**size + 2 * dear * np.exp(rng.normal(0, 0.05, len(error)))
        off = rng.normal(0, 0.3) + rng.normal(0, 0.2, families)[family]
        theory = self.error * np.exp(off + rng.normal(0, surprise, len(error)))
        kinds = [["" for _ in family], [str(k) for k in family]]
        spread = covariance(kinds, (0.35, 0.25), np.zeros(len(error), bool))
        spread += surprise**2 * np.eye(len(error))
        self.expected = Expected(theory, np.zeros(len(error)), 2, spread)
        self.guess = self.cost * np.exp(rng.normal(0, 0.05, len(error)))
        self.asked = []

    def climb(self, **wanted):
        known = np.array(self.guess)

        def measure(k):
            self.asked.append(k)
            known[k] = self.cost[k]
            return Found(float(self.error[k]), float(self.cost[k]))

        return climb(self.expected, lambda: known, measure, **wanted)

    def cheapest(self, tolerance):
        return self.cost[self.error <= tolerance].min()


def test_the_search_finds_a_cheap_one_with_few_measurements():
    ratios, shares = [], []
    for seed in range(40):
        table = Table(seed)
        tolerance = float(np.quantile(table.error, 0.1 + 0.02 * seed))
        found = table.climb(tolerance=tolerance)
        ratios.append(table.cost[found.best] / table.cheapest(tolerance))
        shares.append(len(table.asked) / len(table.error))
    assert np.mean(np.array(ratios) <= 1.2) >= 0.95
    assert np.mean(shares) < 0.2
    assert max(shares) < 0.5


@settings(max_examples=60)
@given(
    seed=st.integers(0, 10_000),
    tolerance=st.floats(1e-5, 1.0),
    rough=st.floats(0, 2),
    surprise=st.floats(0, 2),
)
def test_the_search_never_returns_one_that_misses(seed, tolerance, rough, surprise):
    table = Table(seed, families=6, rough=rough, surprise=surprise)  # rough: not monotone
    found = table.climb(tolerance=tolerance)
    assert len(table.asked) == len(set(table.asked)) == len(found.tried)
    if found.best is None:
        assert all(f.error > tolerance for f in found.tried.values())
        return
    assert table.error[found.best] <= tolerance
    assert found.tried[found.best] == (table.error[found.best], table.cost[found.best])
    enough = [f.cost for f in found.tried.values() if f.error <= tolerance]
    assert table.cost[found.best] == min(enough)


@settings(max_examples=30)
@given(seed=st.integers(0, 10_000), budget=st.floats(1, 100))
def test_no_choice_is_above_the_budget(seed, budget):
    table = Table(seed, families=6)
    found = table.climb(tolerance=0.02, budget=budget)
    if found.best is not None:
        assert table.cost[found.best] <= budget


def test_the_search_ends_though_each_model_has_a_small_chance():
    """A dear model is enough, and of 300 cheap ones each is expected to miss by half."""
    error = np.append(np.full(300, 0.015), 0.001)
    expected = Expected(error, np.zeros(301), 2, 0.25**2 * np.eye(301))
    cost = np.append(np.ones(300), 8.0)
    found = climb(expected, lambda: cost, lambda k: Found(error[k], cost[k]), tolerance=0.01)
    assert found.best == 300
    assert 20 < len(found.tried) < 90  # measured 69; all 301 if no trial had to promise more


def test_if_none_is_enough_the_best_is_among_those_tried():
    for seed in range(10):
        table = Table(seed)
        found = table.climb(tolerance=0.5 * float(table.error.min()))
        assert found.best is None
        closest = min(f.error for f in found.tried.values())
        assert closest < 1.2 * table.error.min()
        assert len(found.tried) < 0.5 * len(table.error)


def test_what_cannot_do_is_not_tried():
    table = Table(0)
    fixed = np.where(np.arange(len(table.error)) % 2, 0.0, 0.5)
    table.error = np.hypot(table.error, fixed)
    table.expected = table.expected._replace(fixed=fixed)
    found = table.climb(tolerance=0.05)
    assert found.best % 2 == 1
    assert all(k % 2 == 1 for k in table.asked)
    assert not found.chance[::2].any()


def test_one_measurement_tells_about_its_kind():
    shared = covariance([["a", "a", "b"]], (1.0,), np.array([False, False, False]))
    expected = Expected(np.full(3, 0.1), np.zeros(3), 2, shared)
    asked = []

    def measure(k):
        asked.append(k)
        return (Found(1.0, 2.0), Found(1.0, 3.0), Found(0.01, 9.0))[k]

    found = climb(expected, lambda: np.array([2.0, 3.0, 9.0]), measure, tolerance=0.1)
    assert asked == [0, 2]  # ten times worse than expected, and so is the other one of its kind
    assert found.best == 2
    assert found.chance[1] < 0.001


# Models and their words


def test_every_model_is_told_apart_and_made():
    everything = all_models(("plain", "normal map"), SingleLayout())
    assert len({m.name for m in everything}) == len(set(everything)) == len(everything)
    assert {m.filter for m in everything} == {"", *filters()}
    assert {m.map_size for m in everything} == {0, *models.MAP_SIZES}
    for method in filters().values():
        for bias in biases_for(method.filter()):
            parse_bias(bias_words(bias, 1.5), method.filter())


def test_filters_too_wide_for_a_small_cube_are_left_out():
    few = all_models(("plain",), CubeLayout(), ("pcss",))
    assert {m.map_size for m in few} >= {128, 256}
    assert len(few) <= len(all_models(("plain",), SingleLayout(), ("pcss",)))


@pytest.mark.errors
def test_an_unknown_filter_is_named():
    with pytest.raises(ValueError, match=r"^--techniques: no such filter 'pfc'; .*pcf"):
        simplest(load_scene("sphere"), 0.1, techniques=("pfc",))


# Theory


@pytest.fixture(scope="module")
def sphere():
    sight = look_at_scene(load_scene("sphere"), SIZE)
    return sight, Theory(sight)


def test_finer_maps_are_expected_to_be_closer(sphere):
    _, theory = sphere
    for name in ("nearest", "bilinear", "pcf 5x5", "vsm 3x3"):
        bias = biases_for(filters()[name].filter())[-1]
        errors = [theory.error(Model("plain", name, n, bias)) for n in models.MAP_SIZES]
        assert all(np.diff(errors) < 0), name


def test_wider_kernels_are_expected_to_blur_a_hard_shadow(sphere):
    _, theory = sphere
    names = ("bilinear", "pcf 3x3", "pcf 5x5", "pcf 9x9")
    edges = [theory.parts(Model("plain", name, 128, "slope")).edges for name in names]
    assert all(np.diff(edges) > 0)


def test_without_shadows_theory_is_exact(sphere):
    sight, theory = sphere
    expected = theory.error(Model("plain"))
    seen = picture_of(sight, "plain", [s.facing for s in sight.seen])
    assert abs(expected / sight.error(seen, "rmse") - 1) < 1e-3  # 2e-5 measured


def test_without_a_bias_half_of_what_is_lit_is_expected_dark(sphere):
    sight, theory = sphere
    bare = theory.parts(Model("plain", "nearest", 256))
    biased = theory.parts(Model("plain", "nearest", 256, "slope"))
    dark = picture_of(sight, "plain", [np.zeros_like(s.share) for s in sight.seen])
    assert biased.acne == 0
    assert bare.acne == pytest.approx(0.5 * sight.error(dark, "rmse") ** 2, rel=0.02)


def test_theory_is_near_to_what_is_measured(found):
    assert len(found.tried) >= 2
    for tried in found.tried:
        assert 0.4 < tried.error / tried.expected < 2.5, tried


def lamp(radius):
    scene = load_scene("soft-lamp")
    light = dataclasses.replace(scene.lights[0], radius=radius)
    return look_at_scene(scene._replace(lights=(light,)), SIZE)


@pytest.mark.parametrize(("radius", "soft"), [(0.005, False), (0.6, True)])
def test_only_a_large_light_is_expected_to_need_soft_shadows(radius, soft):
    theory = Theory(lamp(radius))
    fine = Model("plain", "bilinear", 2048, "slope")
    penumbrae = Model("plain", "pcss 16", 1024, "adaptive")
    assert theory.useless(penumbrae) is None
    hard, softened = theory.error(fine), theory.error(penumbrae)
    assert (hard > 0.03) == soft  # 0.009 and 0.08 measured
    assert softened < 0.03


# Known answers


@pytest.fixture(scope="module")
def found():
    """What 2x2 lookup must be on a ball, with some of the search to look at."""
    with jax.enable_x64(False):
        return simplest(
            load_scene("sphere"), 0.03, image_size=SIZE, runs=1, techniques=("bilinear", "pcss")
        )


@pytest.fixture(scope="module")
def plain():
    """What is chosen where anything will do."""
    with jax.enable_x64(False):
        return simplest(load_scene("bumpy"), 1.0, image_size=SIZE, runs=1, techniques=("nearest",))


def test_a_choice_meets_its_tolerance_and_a_simpler_one_does_not(found):
    assert found.model.filter == "bilinear"
    assert found.error <= 0.03
    assert found.failed.error > 0.03
    assert found.failed.cost < found.cost
    assert found.further is None or found.further.error < found.error
    for tried in found.tried:
        assert tried.cost >= found.cost or tried.error > 0.03


def test_nothing_is_soft_under_a_light_without_a_size(found):
    why = [why for model, why in found.skipped.items() if model.filter.startswith("pcss")]
    assert why
    assert all("no light has a size" in text for text in why)


def test_a_huge_tolerance_takes_the_least_model(plain):
    assert plain.model == Model("plain")


def test_light_without_shadows_needs_no_map():
    sight = look_at_scene(load_scene("grazing-plane"), SIZE)
    theory = Theory(sight)
    assert theory.error(Model("plain")) == 0
    found = searched(sight, theory, 0.0)
    assert found == Model("plain")


def on_theory(sight, theory):
    """Return a search, and a measurement which finds all as theory says, 1 ms each stage."""
    models = all_models(sight.looks, sight.layout, ("nearest", "bilinear"))
    search = Search(sight, theory, models, "rmse")

    def measure(k):
        model = search.models[k]
        error = np.hypot(theory.error(model), theory.without(model.look))
        return Measured(float(error), dict.fromkeys(stages(model), 1.0))

    return search, measure


def searched(sight, theory, tolerance):
    """Return what a search chooses if all is as theory says."""
    search, measure = on_theory(sight, theory)
    end = search.run(measure, tolerance=tolerance)
    assert end is not None
    return search.models[end.best]


def bumpy(tilt):
    """The scene with its normal map's tilt scaled."""
    scene = load_scene("bumpy")
    looks = []
    for look in scene.materials:
        if look.normal_texture is not None:
            flat = np.array([0.5, 0.5, 1.0], np.float32)
            texels = flat + tilt * (look.normal_texture.texels - flat)
            look = dataclasses.replace(look, normal_texture=Texture(texels.astype(np.float32)))
        looks.append(look)
    return scene._replace(materials=tuple(looks))


@pytest.mark.parametrize(("tilt", "look"), [(0.0, "plain"), (1.0, "normal map")])
def test_only_a_normal_map_that_shows_is_needed(tilt, look):
    sight = look_at_scene(bumpy(tilt), SIZE)
    assert sight.looks == ("plain", "normal map")
    assert searched(sight, Theory(sight), 0.03).look == look


@pytest.mark.errors
@pytest.mark.parametrize("wrong", [{"tolerance": -1.0}, {"tolerance": 0.1, "budget_ms": 0.0}])
def test_nonsense_is_refused(wrong):
    with pytest.raises(ValueError, match=r"^simplest: expected a "):
        simplest(load_scene("sphere"), **wrong)


def test_all_measures_agree_on_what_is_perfect(sphere):
    sight, _ = sphere
    gray = np.full_like(sight.truth, 0.5)
    for measure in ("rmse", "flip", "error"):
        assert sight.error(sight.truth, measure) == 0
        assert sight.error(gray, measure) > 0.01


# The command


def run(monkeypatch, capsys, *arguments):
    monkeypatch.setattr(sys, "argv", ["experiments", *map(str, arguments)])
    code = main()
    return code, capsys.readouterr()


QUICK = ("--image-size", SIZE, "--runs", 1)


@pytest.mark.parametrize("scene", ["sphere", "bumpy"])
def test_the_words_show_the_reported_picture(scene, found, plain, monkeypatch, capsys, tmp_path):
    result, out, image = {"sphere": found, "bumpy": plain}[scene], tmp_path / "out", "image.exr"
    monkeypatch.setattr(command, "find", lambda *args, **options: result)
    asked = ("--tolerance", result.tolerance, "--out", out, *QUICK)
    code, said = run(monkeypatch, capsys, "simplest", scene, *asked)
    assert code == 0
    content = json.loads((out / "simplest.json").read_text())
    assert f"least model: {content['choice']['name']}" in said.out
    assert (out / "comparison.png").stat().st_size > 10_000
    assert {"versions", "device", "commit"} <= set(content)
    assert len(content["tried"]) + len(content["skipped"]) == content["models"]

    with contextlib.chdir(tmp_path):
        assert run(monkeypatch, capsys, "render", *content["render"], "--out", image)[0] == 0
        color = np.stack([read_exr(image)[channel] for channel in "RGB"], axis=-1)
    same = result.sight.error(shown(color), "rmse")
    assert same == pytest.approx(content["choice"]["error"], abs=1e-7)


def test_without_shadows_or_normal_map_in_words(monkeypatch, capsys, tmp_path):
    sight = look_at_scene(load_scene("bumpy"), SIZE)
    least = choose(Model("plain"), sight, 1.0)
    words = least.arguments(sight.looks)
    assert words == ["--shadows", "none", "--normal-map", "none"]
    asked = ("bumpy", "--image-size", SIZE, SIZE, *words, "--out", tmp_path / "image.exr")
    assert run(monkeypatch, capsys, "render", *asked)[0] == 0
    channels = read_exr(tmp_path / "image.exr")
    color = np.stack([channels[channel] for channel in "RGB"], axis=-1)
    image = least.render(load_scene("bumpy"), SIZE)
    np.testing.assert_array_equal(color, image.color)
    np.testing.assert_array_equal(channels["visibility.V"], sight.seen[0].facing)
    expected = picture_of(sight, "plain", [sight.seen[0].facing])
    # Two programs, stage by stage and as a whole; measured: 6e-8.
    np.testing.assert_allclose(shown(color), expected, rtol=0, atol=1.2e-7)


def test_the_choice_is_what_render_takes(found):
    image = found.choice.render(load_scene("sphere"), SIZE)
    assert found.sight.error(shown(np.asarray(image.color)), "rmse") == found.error
    again = render_scene(
        found.choice.scene(load_scene("sphere")), image_size=(SIZE, SIZE),
        **found.choice.techniques,
    )  # fmt: skip
    assert (np.asarray(again.color) == np.asarray(image.color)).all()


@pytest.mark.parametrize(
    ("wanted", "said"),
    [
        (
            {"tolerance": 1e-5},
            r"no model reaches 1e-05; the best reachable is (\S+) by bilinear @ ",
        ),
        (
            {"tolerance": 1e-5, "budget": 1.5},
            r"no model reaches 1e-05 within 1\.5 ms; the best reachable is (\S+) by no shadows",
        ),
        (
            {"tolerance": 1.0, "budget": 0.1},
            r"no model costs at most 0\.1 ms; the cheapest tried costs ",
        ),
    ],
)
def test_out_of_reach_is_said_with_exit_code_3(wanted, said, sphere, monkeypatch, capsys, tmp_path):
    search, measure = on_theory(*sphere)
    assert search.run(measure, **wanted) is None

    def find(*args, **options):
        raise out_of_reach(search, wanted["tolerance"], wanted.get("budget", np.inf))

    monkeypatch.setattr(command, "find", find)
    asked = ("--tolerance", wanted["tolerance"], "--out", tmp_path / "out")
    code, output = run(monkeypatch, capsys, "simplest", "sphere", *asked)
    assert code == 3
    lines = [line for line in output.err.splitlines() if line.startswith("error")]
    assert len(lines) == 1
    match = re.match("error: " + said, lines[0])
    assert match
    if match.groups():
        within = [f for f in search.tried.values() if f.cost <= wanted.get("budget", np.inf)]
        assert float(match[1]) == pytest.approx(min(f.error for f in within), rel=1e-3)
    assert not (tmp_path / "out").exists()


@pytest.mark.errors
@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("spere", "--tolerance", 1), "scene 'spere': neither a file nor an embedded scene"),
        (("sphere", "--tolerance", -1), "--tolerance: expected a finite error of at least 0"),
        (("sphere", "--tolerance", "nan"), "--tolerance: expected a finite error"),
        (("sphere", "--tolerance", 1, "--budget-ms", 0), "--budget-ms: expected a time above 0"),
        (("sphere", "--tolerance", 1, "--runs", 0), "--runs: expected at least 1"),
        (("sphere", "--tolerance", 1, "--image-size", 0), "--image-size: expected sizes"),
        (("sphere", "--tolerance", 1, "--techniques", "pfc"), "no such filter 'pfc'"),
        (("sphere",), "--tolerance"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(arguments, said, monkeypatch, capsys, tmp_path):
    code, output = run(monkeypatch, capsys, "simplest", *arguments, "--out", tmp_path / "out")
    assert code == 2
    lines = [line for line in output.err.splitlines() if line.startswith("error")]
    assert len(lines) == 1
    assert said in lines[0]
    assert not (tmp_path / "out").exists()


# Evidence


def test_render_does_what_the_evidence_is_of():
    for kind, scene in {"hard": "default", "area": "soft-lamp"}.items():
        model, loaded = evidence.RENDERED[kind], load_scene(scene)
        words = least_filter(loaded)
        assert words == filters()[model.filter].words
        filter = parse_technique(Filter, words, option="--filter")
        assert parse_bias(None, filter) == parse_bias(bias_words(model.bias, 1.0), filter)


def test_one_model_for_all():
    """By hand: of those that are enough on most scenes, the cheapest."""
    a, b, c, d = (Model("plain", name, 256, "slope") for name in "abcd")
    table = {a: (0.1, 0.3, 0.1, 1), b: (0.1, 0.1, 0.4, 3), c: (0.1, 0.2, 0.2, 2), d: (0.3, 0, 0, 1)}
    scenes = [
        {m: Measured(row[k], {("draw",): float(row[3])}) for m, row in table.items()}
        for k in range(3)
    ]
    del scenes[2][d]  # not of all scenes
    found = evidence.one_for_all(scenes, 0.2)
    assert found == {
        "tolerance": 0.2, "model": c.name, "enough": 3, "scenes": 3, "median_ms": 2.0,
        "median_error": 0.2, "worst_error": 0.2,
    }  # fmt: skip
    assert evidence.one_for_all(scenes, 0.15)["model"] == a.name  # two, and cheaper than b


def test_evidence_goes_on_where_it_was(tmp_path, monkeypatch, capsys):
    few = [Model("plain"), evidence.RENDERED["hard"]]
    monkeypatch.setattr(evidence, "all_models", lambda *of_scene: few)
    asked = {"out": tmp_path, "scenes": ("default",), "only": True, "image_size": 16, "runs": 1}
    evidence.evidence(**asked)
    first = json.loads((tmp_path / "evidence.json").read_text())
    assert len(first["rows"]) == len(evidence.TOLERANCES)
    assert [row["of"] for row in first["one_for_all"]] == ["all", "render"] * len(first["rows"])
    assert {row["models"] for row in first["rows"]} == {2}
    assert "one model for all scenes" in capsys.readouterr().out
    monkeypatch.setattr(evidence.Bench, "measure", None)  # nothing is measured again
    evidence.evidence(**asked)
    assert json.loads((tmp_path / "evidence.json").read_text()) == first
