"""The failure catalogue as an atlas: verdicts, metrics, completeness, known figures, a run."""

import json

import jax
import numpy as np
import pyarrow.parquet as pq
import pytest

import experiments.stability.atlas as atlas
import experiments.stability.command as command
import experiments.stability.shadow_rows as shadow_rows
from experiments.frontier.store import Store
from experiments.options import techniques
from experiments.scenes.failure_scenes import FAILURES
from experiments.stability import detectors, frame_rows, map_rows, sweeps, texel_rows
from experiments.stability.cells import (
    FINE,
    KNOWN,
    UNCONFIRMED,
    UNEXPECTED,
    VERDICTS,
    Cell,
    not_finite,
)
from experiments.stability.charts import MARKS, matrix, worst
from experiments.stability.combinations import BIASES, FILTERS, NAIVE, Technique, combinations
from experiments.stability.detectors import Sight
from experiments.stability.fit_starts import USUAL, Setting, fit_starts
from experiments.stability.naive_ways import NAIVE_WAYS
from experiments.stability.shadow_rows import ROWS, measure_row
from experiments.stability.views import View, precision
from shadows import Bias, CombinedBias, Filter, default_bias

CELL = Cell(1, "plane", "nearest, no bias", "float32", "acne", 0.5, 0.02)
NAMES = {task.name for task in atlas.TASKS}


# Verdicts


@pytest.mark.parametrize(
    ("value", "said", "may", "verdict"),
    [
        (0.0, "", "", FINE),
        (0.02, "", "", FINE),
        (0.02, "", "row 2", FINE),
        (0.5, "row 1", "", KNOWN),
        (0.5, "", "row 2", KNOWN),
        (0.5, "", "", UNEXPECTED),
        (0.01, "row 1", "", UNCONFIRMED),
        (np.nan, "", "", UNEXPECTED),
        (np.nan, "row 1", "", KNOWN),
    ],
)
def test_verdicts(value, said, may, verdict):
    assert CELL._replace(value=value, said=said, may=may).verdict == verdict


@pytest.mark.parametrize("flaw", ["values_not_finite", "slopes_not_finite"])
def test_what_is_not_finite_is_never_expected(flaw):
    cell = CELL._replace(said="row 1", **{flaw: 1})
    assert cell.broken
    assert cell.verdict == UNEXPECTED
    beyond = cell._replace(documented=False)
    assert not beyond.broken
    assert beyond.verdict == KNOWN


def test_numbers_that_are_not_finite_are_counted():
    tree = {"a": np.array([1.0, np.nan, np.inf]), "b": [np.arange(3), np.float32(-np.inf)]}
    assert not_finite(tree, np.zeros(4)) == 3


# Metrics


def sight(truth, **masks):
    truth = np.asarray(truth, bool)
    everything = np.ones_like(truth)
    fields = {
        "facing": everything, "distance": np.where(truth, np.inf, 1.0),
        "sine": np.ones(truth.shape), "special": everything,
    }  # fmt: skip
    return Sight(truth, **(fields | masks))


def halves(size=16):
    """Lit left half, dark right half."""
    return np.tile(np.arange(size) < size // 2, (size, 1))


def test_acne_and_leaks_are_shares_of_lit_and_dark():
    seen, lit = sight(halves()), halves().astype(float)
    for measure in (detectors.acne, detectors.leak, detectors.inner_acne, detectors.inner_leak):
        assert measure(lit, seen) == 0
    lit[:4] = 1 - lit[:4]
    assert detectors.acne(lit, seen) == detectors.leak(lit, seen) == 0.25
    assert detectors.inner_acne(lit, seen) == detectors.inner_leak(lit, seen) == 0.25
    assert detectors.wrong(lit, seen) == detectors.soft_wrong(lit, seen) == 0.25
    assert detectors.soft_acne(np.full((16, 16), 0.75), seen) == 0.25
    assert detectors.acne(np.full((16, 16), np.nan), seen) == 1


def test_inner_pixels_lie_three_from_an_edge():
    seen, lit = sight(halves()), halves().astype(float)
    lit[:, 5:11] = 1 - lit[:, 5:11]  # all that is near the edge
    assert detectors.inner_acne(lit, seen) == detectors.inner_leak(lit, seen) == 0
    assert detectors.acne(lit, seen) == 3 / 8
    lit[:, 4] = 0
    assert detectors.inner_acne(lit, seen) == 1 / 5


def test_special_pixels_alone_count():
    rows = np.zeros((16, 16), bool)
    rows[:4] = True
    seen, lit = sight(halves(), special=rows), halves().astype(float)
    lit[4:] = 1 - lit[4:]
    assert detectors.acne(lit, seen) == detectors.leak(lit, seen) == 0
    assert detectors.darkness(1 - rows.astype(float), seen) == 1


def test_halos_are_looked_for_close_to_casters():
    distance = np.where(halves(), np.inf, np.linspace(0, 2, 16))
    lit = (distance < detectors.CONTACT * 8).astype(float)
    seen = sight(halves(), distance=distance)
    assert detectors.halo(lit, seen) == 0  # none is so close
    near = sight(halves(), distance=np.where(halves(), np.inf, 0.1))
    half = np.full((16, 16), 0.25)
    assert detectors.halo(half, near) == 0.25
    assert detectors.contact_leak(half, near) == 0
    assert detectors.contact_leak(3 * half, near) == 1


def test_bleeding_is_the_most_that_is_seen_two_pixels_inside():
    seen, lit = sight(halves()), np.zeros((16, 16))
    lit[:, 8:10] = 1
    assert detectors.bleeding(lit, seen) == 0
    lit[:, 12] = 0.3
    assert detectors.bleeding(lit, seen) == 0.3


def test_a_gap_is_a_length():
    distance = np.tile(np.linspace(0, 1.5, 16), (16, 1))
    dark = sight(np.zeros((16, 16)), distance=distance, sine=np.full((16, 16), 0.5))
    assert detectors.gap(np.zeros((16, 16)), dark) == 0
    lit = (distance < 0.55).astype(float)
    np.testing.assert_allclose(detectors.gap(lit, dark), 0.55 * 0.5, atol=0.03)


def test_penumbrae_are_from_a_tenth_to_nine():
    ramp = np.linspace(0, 1, 101)[None]
    assert detectors.penumbra_area(ramp, np.ones_like(ramp, bool)) == 79
    assert detectors.penumbra_area(ramp, ramp > 0.5) == 39


# Completeness


def test_every_row_is_measured_or_has_a_reason():
    measured = {row for task in atlas.TASKS for row in task.rows}
    assert measured | set(atlas.ABSENT) == set(range(1, 44))
    assert not measured & set(atlas.ABSENT)
    assert all(atlas.ABSENT.values())


def test_every_scene_of_the_catalogue_is_measured():
    assert set(FAILURES) <= NAMES
    by_name = {(task.name, row) for task in atlas.TASKS for row in task.rows}
    assert {(name, failure.row) for name, failure in FAILURES.items()} <= by_name


def test_every_filter_and_bias_is_there_and_naive_ones_are_offered_to_nobody():
    ours = lambda base: {c for c in techniques(base).values() if c.__module__.startswith("shadows")}
    assert ours(Filter) <= set(map(type, FILTERS.values()))
    assert ours(Bias) | {CombinedBias} == set(map(type, BIASES.values()))
    assert not set(map(type, NAIVE.values())) & set(techniques(Bias).values())


@pytest.mark.parametrize("options", [{}, {"quick": True}, {"several": True}])
def test_combinations_are_told_apart_and_hold_every_default(options):
    chosen = combinations(**options)
    assert len({technique.name for technique in chosen}) == len(chosen)
    for technique in chosen:
        bias, filter = technique.make()
        assert filter.compares or not bias.follows_plane
    for filter in {technique.filter for technique in chosen} - {"pcf 9x9"}:
        default = type(default_bias(FILTERS[filter]))
        assert any(t.filter == filter and type(t.make()[0]) is default for t in chosen)


def test_the_catalogue_blames_only_whom_it_names():
    by_row = {row.row: row for row in ROWS}
    bare, default = Technique("bilinear", "none"), Technique("bilinear", "analytic")
    assert by_row[1].said(bare)
    assert not by_row[1].said(default)
    assert not by_row[1].said(Technique("vsm", "none"))  # needs no bias
    assert by_row[6].may(bare)
    assert not by_row[6].may(default)
    assert by_row[10].said(Technique("vsm", "none"))
    assert not by_row[10].said(Technique("msm", "none"))
    assert by_row[12].said(Technique("bilinear", "analytic", 10.0))
    assert set(NAIVE_WAYS) <= set(by_row)


# Known figures


def table(cells):
    return {cell.technique: cell for cell in cells}


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_three_layers_leak_as_computed(dtype):
    with precision(dtype):
        cells = table(texel_rows.three_layers(dtype))
    for name, atol in (("vsm", 1e-5), ("msm", 1e-5), ("esm 20", 1e-5), ("evsm4", 1e-4)):
        np.testing.assert_allclose(cells[name].value, cells[name].predicted, atol=atol)
    assert cells["vsm"].verdict == cells["msm"].verdict == KNOWN
    assert cells["evsm4"].verdict == FINE


def test_single_depths_have_no_roots_in_single_precision():
    with precision(np.float32):
        cells = table(texel_rows.single_depths(np.float32))
    assert 0.001 < cells["(0 to 1, bias 3e-06, Cholesky)"].value < 0.02  # catalogue 0.009
    assert cells["(-1 to 1, bias 3e-07, Cholesky)"].value < 0.004  # catalogue 0.0014
    assert not any(cell.broken for cell in cells.values())
    assert max(cells[f"msm {bias:g}"].value for bias in (0, 3e-7, 3e-6, 3e-5)) < 0.01


def test_half_precision_loses_half_of_the_variances():
    with precision(np.float32):
        share = table(texel_rows.half_precision(np.float32))["(vsm, float16)"].value
    assert 0.48 < share < 0.53  # catalogue 0.51


def test_green_upside_down_turns_bumps_into_dents():
    with precision(np.float32):
        cells = table(frame_rows.green(np.float32))
    assert cells["(-Y map, read as +Y)"].value > 1.9
    assert cells["+Y map"].value == cells["-Y map, flipped"].value < 0.1


def test_the_figure_of_uvs_shrinks_to_none():
    scene = frame_rows.shrunk_uvs(1e-3)
    a, b, c = scene.mesh.uvs[-3:].astype(np.float64)
    np.testing.assert_allclose(0.5 * np.linalg.det([b - a, c - a]), 1e-3, rtol=1e-4)
    assert sweeps.UV_AREAS[-1] == 0
    assert sweeps.SOFTNESSES[0] == 1e-6
    assert sweeps.RATIOS[-1] == 1e5
    assert sweeps.ELEVATIONS[0] == 0.5


@pytest.fixture
def small(monkeypatch):
    """Small views and few techniques; derivatives in the geometry are those of other tests."""
    monkeypatch.setattr(View, "pull", lambda self, slopes: slopes)
    few = [Technique("nearest", "analytic"), Technique("nearest", "none")]
    monkeypatch.setattr(shadow_rows, "IMAGE", (48, 48))
    monkeypatch.setattr(shadow_rows, "MAP", 64)
    monkeypatch.setattr(shadow_rows, "combinations", lambda **options: few)


def test_a_row_of_shadows_is_judged_as_known(small):
    with precision(np.float32):
        cells = table(measure_row(ROWS[0], np.float32, quick=True))
    assert 0.45 < cells["nearest, no bias"].value < 0.55  # catalogue 0.5
    assert cells["nearest, analytic"].value == cells["nearest, analytic"].predicted == 0
    assert cells["nearest, no bias"].verdict == KNOWN
    assert {"shadow volumes", "derivatives in the geometry"} < set(cells)
    assert not any(cell.broken for cell in cells.values())


def test_the_metric_sees_volumes_that_are_counted_from_the_eye(small):
    row = next(row for row in ROWS if row.row == 27)
    with precision(np.float32):
        cells = table(measure_row(row, np.float32, quick=True))
    assert cells[NAIVE_WAYS[27][0]].verdict == KNOWN
    assert cells["shadow volumes"].verdict == cells["nearest, analytic"].verdict == FINE


def test_a_hard_step_has_no_slope_and_a_sharp_one_none_that_helps():
    with precision(np.float32):
        hard, fits = map_rows.hard_gradient(np.float32), table(map_rows.fits(np.float32))
    assert table(hard)["hard"].value == 1
    assert table(hard)["soft 0.5"].value == 0
    assert fits["soft 1e-06"].verdict == fits["soft 100"].verdict == KNOWN
    assert fits["soft 0.1"].verdict == FINE


# The command


class Counted:
    """A measurement that counts how often it is made."""

    def __init__(self, name, cell):
        self.name, self.cell, self.calls = name, cell, 0

    def __call__(self, dtype, quick):
        self.calls += 1
        return [self.cell._replace(scene=self.name, dtype=np.dtype(dtype).name)]


def task(name, cell=CELL):
    return atlas.Task(name, (1,), Counted(name, cell))


def test_a_run_goes_on_where_it_was_stopped(tmp_path):
    first, second = Counted("a", CELL), Counted("b", CELL)
    jobs = [(atlas.Task(one.name, (1,), one), np.float32) for one in (first, second)]
    command.run(jobs[:1], Store(tmp_path), quick=False)
    cells = command.run(jobs, Store(tmp_path), quick=False)
    assert first.calls == second.calls == 1
    again = command.run(jobs, Store(tmp_path), quick=False)
    assert [cell.record().keys() for cell in again] == [cell.record().keys() for cell in cells]
    assert [cell.verdict for cell in again] == [UNEXPECTED, UNEXPECTED]
    np.testing.assert_equal(again, cells)  # NaN among them
    command.run(jobs, Store(tmp_path), quick=True)  # other techniques: measured anew
    assert first.calls == 2


def test_a_whole_run_writes_tables_charts_and_a_page(tmp_path, capsys):
    with jax.enable_x64(False):
        command.stability(("three-layers", "knob"), out=tmp_path / "out")
    out = tmp_path / "out"
    rows = pq.read_table(out / "stability.parquet").to_pylist()
    assert {"scene", "technique", "dtype", "metric", "value", "verdict"} <= set(rows[0])
    assert {row["dtype"] for row in rows} == {"float32", "float64"}
    assert {row["row"] for row in rows} == {11, 37}
    assert {row["verdict"] for row in rows} <= set(VERDICTS)
    made = json.loads((out / "stability.json").read_text("utf-8"))
    assert made["absent"].keys() == {"16", "21"}
    assert made["not_finite"] == 0
    assert sum(made["verdicts"].values()) == len(rows)
    assert made["versions"]["jax"]
    page = (out / "stability.html").read_text("utf-8")
    assert "http" not in page
    assert "<script" not in page
    assert "three layers" in page
    assert "catalogue: 0.0963" in page
    for name in ("stability.png", "stability.pdf"):
        assert (out / name).stat().st_size > 5000
    assert not (out / "stability_ranges.parquet").exists()
    said = capsys.readouterr().out
    assert "fails as known" in said
    assert "0 of 18 cells" in said


def test_ranges_have_a_table_and_curves_of_their_own(tmp_path, monkeypatch):
    cells = [CELL._replace(parameter="tilt", setting=x, value=x / 100) for x in (0.0, 1.0, 80.0)]
    command.write(cells, tmp_path)
    rows = pq.read_table(tmp_path / "stability_ranges.parquet").to_pylist()
    assert [row["setting"] for row in rows] == [0, 1, 80]
    assert [row["verdict"] for row in rows] == [FINE, FINE, UNEXPECTED]
    assert (tmp_path / "stability_ranges.png").stat().st_size > 5000
    assert not (tmp_path / "stability.png").exists()
    assert ">tilt<" in (tmp_path / "stability.html").read_text("utf-8")


def test_only_what_is_not_finite_fails_the_command(tmp_path, monkeypatch, capsys):
    bad = task("bad", CELL._replace(slopes_not_finite=2))
    monkeypatch.setattr(command, "TASKS", (task("odd"), bad))
    command.stability(("odd",), out=tmp_path / "odd")
    with pytest.raises(SystemExit) as stop:
        command.stability((), out=tmp_path / "bad", quick=True)
    assert stop.value.code == 1
    assert "not finite, value or derivative: 1 of 2 cells" in capsys.readouterr().out


def test_quick_runs_are_in_single_precision_and_leave_out_what_is_slow():
    full, quick = (list(command.chosen((), quick=q)) for q in (False, True))
    assert {dtype for _, dtype in quick} == {np.float32}
    assert {one.name for one, _ in full} == NAMES
    assert {one.name for one, _ in quick} == NAMES - {"room", "no-gutter"}
    assert [one.name for one, _ in command.chosen(("room",), quick=True)] == ["room"]


def test_a_misspelled_scene_gets_a_hint():
    with pytest.raises(ValueError, match=r"no scene 'tilted-plain'; did you mean 'tilted-plane'"):
        list(command.chosen(("tilted-plain",), quick=True))


def test_the_worst_verdict_is_shown_and_marked_for_print():
    cells = [CELL._replace(value=0.0), CELL._replace(said="row 1"), CELL]
    assert worst(cells) == CELL
    assert worst(cells[:2]).verdict == KNOWN
    assert len(set(MARKS.values())) == len(VERDICTS) == len(MARKS)


def test_naive_ways_of_single_rows_share_a_column():
    many = {f"technique {k}": [CELL] for k in range(20)}
    groups = {
        (1, "a"): many | {"(one way)": [CELL], "(both)": [CELL]},
        (2, "b"): many | {"(another way)": [CELL], "(both)": [CELL]},
        (3, "c"): {"alone": [CELL]},
    }
    lines, few, columns = matrix(groups)
    assert columns[-2:] == ["(the row's naive way)", "(both)"]
    assert len(columns) == 22
    assert all(set(cells) == set(columns) for cells in lines.values())
    assert few == {(3, "c"): {"alone": [CELL]}}


# Fits from many starts


def test_fits_reach_the_best_from_their_usual_starts():
    with jax.enable_x64(False):
        usual, far = fit_starts(
            "sphere", starts=4, others=4, image_size=64, settings=(USUAL, Setting(scale=1e4))
        )
    assert usual["reached"] == 1.0
    assert usual["best_error"] <= usual["median_error"] <= usual["worst_error"]
    assert far["reached"] < 1.0  # everything is lit there, and nothing tells the way back
    assert (usual["starts"], usual["scale"], far["scale"]) == (4, 8.0, 1e4)
