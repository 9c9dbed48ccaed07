"""Error against time: what is measured, that a killed run goes on, tables and charts."""

import json
import subprocess
import sys
import textwrap
from pathlib import Path

import jax
import matplotlib.image
import numpy as np
import pyarrow.parquet as pq
import pytest

import experiments.frontier.command as command
from experiments.frontier.chart import front, save_chart
from experiments.frontier.measure import Programs, accuracy, timing
from experiments.frontier.methods import MAP_SIZES, methods
from experiments.frontier.store import Key, Store
from experiments.frontier.view import load_view
from experiments.options import techniques
from shadows import Filter

ROOT = Path(__file__).parents[1]
KEY = Key("accuracy", "sphere", "pcf 3x3 @ 256", 64)
QUICK = methods(("bilinear", "vsm"), quick=True)[:3]  # two of them with the smaller map


@pytest.fixture(scope="module", autouse=True)
def single_precision():
    """As users have it."""
    with jax.enable_x64(False):
        yield


@pytest.fixture(scope="module")
def view():
    return load_view("sphere", 48)


@pytest.fixture(scope="module")
def programs():
    return Programs()


# What is compared


def test_every_filter_at_every_size_is_a_method():
    chosen = methods()
    assert {method.technique for method in chosen} == set(techniques(Filter))
    assert len({method.name for method in chosen}) == len(chosen)
    assert {method.map_size for method in chosen} == set(MAP_SIZES)
    for method in chosen:
        assert type(method.filter()) is techniques(Filter)[method.technique]
    assert {m.technique for m in methods(quick=True)} == set(techniques(Filter))


def test_numbers_in_names_are_those_of_the_filters():
    made = {method.label: method.filter() for method in methods()}
    assert made["pcf 9x9"].radius == 4
    assert made["tent 7x7"].radius == 3
    assert made["poisson 32"].taps == 32
    assert made["pcss 8"].search_taps == made["pcss 8"].taps == 8
    assert made["msm 3x3"].radius == 1


@pytest.mark.errors
def test_an_unknown_filter_is_named():
    with pytest.raises(ValueError, match=r"^--techniques: no such filter 'pfc'; .*pcf"):
        methods(("pfc",))


# Measurements


def test_more_texels_are_closer_to_truth(view, programs):
    coarse, _, fine = (accuracy(view, method, programs) for method in QUICK)
    for error in ("rmse", "error", "flip"):
        assert 0 <= fine[error] < coarse[error] < 0.3
    assert coarse["acne"] < 0.05  # the best bias was found: without, it is a half
    assert coarse["rmse_penumbra"] is None


def test_a_bias_is_chosen_for_each(view, programs):
    bilinear, vsm = (accuracy(view, method, programs)["bias"] for method in QUICK[:2])
    assert "SlopeBias" in bilinear
    assert vsm == "none"


def test_accuracy_is_the_same_again(view, programs):
    method = QUICK[0]
    assert accuracy(view, method, programs) == accuracy(view, method, Programs())


def test_costs(view, programs):
    figures = timing(view, QUICK[0], programs, runs=3)
    parts = {name: figures[name]["ms"] for name in ("draw", "prepare", "image", "gradient")}
    for low, median, high in parts.values():
        assert 0 < low <= median <= high
    stages = [parts[name] for name in ("draw", "prepare", "image")]
    assert sum(s[0] for s in stages) * 0.5 < figures["total_ms"] < sum(s[2] for s in stages) * 2
    assert figures["kept_bytes"] >= 256 * 256 * 4
    assert isinstance(figures["stable"], bool)


def test_programs_are_compiled_once(view, programs):
    before = len(programs._kept)
    timing(view, QUICK[0], programs, runs=1)
    assert len(programs._kept) == before


def test_an_area_light_is_judged_softly():
    view = load_view("soft-lamp", 32)
    assert view.soft
    found = accuracy(view, QUICK[0], Programs())
    assert 0 < found["rmse"] < found["rmse_penumbra"]
    assert ((view.share > 0) & (view.share < 1)).any()


# The store


def test_what_is_kept_is_found(tmp_path):
    store = Store(tmp_path)
    assert store.get(KEY) is None
    store.put(KEY, {"rmse": 0.25, "bias": "none"})
    assert Store(tmp_path).get(KEY) == {"rmse": 0.25, "bias": "none"}


def test_names_that_look_alike_are_told_apart(tmp_path):
    store = Store(tmp_path)
    for k, scene in enumerate(("a.obj", "a-obj", "A.obj", "dir/a.obj")):
        store.put(KEY._replace(scene=scene), {"k": k})
    found = [store.get(KEY._replace(scene=s)) for s in ("a.obj", "a-obj", "A.obj", "dir/a.obj")]
    assert found == [{"k": k} for k in range(4)]


@pytest.mark.parametrize("damage", [b"", b"{", b"[1, 2]", b'{"key": [], "figures": {}}', b"\xff"])
def test_a_damaged_file_is_set_aside(tmp_path, damage, capsys):
    store = Store(tmp_path)
    store.put(KEY, {"rmse": 1.0})
    (path,) = (tmp_path / "cells" / "accuracy").iterdir()
    path.write_bytes(damage)
    assert store.get(KEY) is None
    assert path.with_suffix(".damaged").read_bytes() == damage
    assert "damaged" in capsys.readouterr().err
    store.put(KEY, {"rmse": 2.0})
    assert store.get(KEY) == {"rmse": 2.0}


@pytest.mark.errors
@pytest.mark.parametrize("mark", ['{"format": 0}', "", "[]"])
def test_another_format_is_refused(tmp_path, mark):
    Store(tmp_path)
    (tmp_path / "cells" / "format.json").write_text(mark)
    with pytest.raises(ValueError, match=r"results of format .*, expected 1; choose another"):
        Store(tmp_path)


def fake(monkeypatch):
    """Replace what takes long; count what is measured."""
    measured = []

    def accuracy(view, method, programs):
        measured.append(("accuracy", view, method.name))
        return {"rmse": len(view) / 100, "bias": "none"}

    def timing(view, method, programs, runs):
        measured.append(("timing", view, method.name))
        return {"total_ms": float(method.map_size), "stable": True}

    monkeypatch.setattr(command, "load_view", lambda name, size: name)
    monkeypatch.setattr(command, "accuracy", accuracy)
    monkeypatch.setattr(command, "timing", timing)
    return measured


def test_nothing_is_measured_twice(tmp_path, monkeypatch):
    measured, store = fake(monkeypatch), Store(tmp_path)
    command.run(("a", "b"), QUICK, store, image_size=8, runs=1)
    assert len(measured) == len(set(measured)) == 12
    command.run(("a", "b", "c"), QUICK, store, image_size=8, runs=1)
    assert [what[1] for what in measured[12:]] == ["c"] * 6
    command.run(("a",), QUICK, store, image_size=16, runs=1)
    assert len(measured) == 24


FILTERS = [
    "nearest",
    "bilinear",
    "pcf",
    "tent",
    "poisson",
    "pcss",
    "vsm",
    "esm",
    "evsm2",
    "evsm4",
    "msm",
]
KILLED = """
    import os, random, signal, sys, time
    from pathlib import Path
    import experiments.frontier.command as command
    from experiments.frontier.methods import methods
    from experiments.frontier.store import Store

    def slow(view, method, programs, runs=None):
        time.sleep(0.002)
        return {"value": f"{view} {method.name}" * 500}

    command.load_view = lambda name, size: name
    command.accuracy = command.timing = slow
    chosen = methods(sys.argv[2:], quick=True)
    arguments = (tuple("abcd"), chosen, Store(Path(sys.argv[1])))
    chance, cells, kills = random.Random(0), Path(sys.argv[1]) / "cells", 0
    made = lambda: sum(1 for _ in cells.glob("*/*.json"))
    while True:
        goal = made() + chance.randrange(4)  # 60 of 176 at most, whatever the machine's speed
        child = os.fork()
        if child == 0:
            command.run(*arguments, image_size=8, runs=1)
            os._exit(0)
        if kills < 20:
            while made() < goal:
                time.sleep(0.0002)
            time.sleep(chance.uniform(0.0, 0.002))
            os.kill(child, signal.SIGKILL)
        _, status = os.waitpid(child, 0)
        kills += os.WIFSIGNALED(status)
        if os.WIFEXITED(status):
            break
    print(kills)
"""


@pytest.mark.skipif(sys.platform == "win32", reason="kills a forked process")
def test_a_run_killed_twenty_times_has_the_same_table(tmp_path, monkeypatch):
    program = [sys.executable, "-c", textwrap.dedent(KILLED), str(tmp_path), *FILTERS]
    done = subprocess.run(program, cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) == 20
    assert not list(tmp_path.rglob("*.damaged"))
    store = Store(tmp_path)
    for scene in "abcd":
        for method in methods(FILTERS, quick=True):
            for kind in ("accuracy", "timing"):
                expected = {"value": f"{scene} {method.name}" * 500}
                assert store.get(Key(kind, scene, method.name, 8)) == expected


# The front, tables and charts


def test_the_front():
    rows = [
        {"total_ms": ms, "rmse": rmse}
        for ms, rmse in [(1, 9), (2, 9), (3, 5), (3, 6), (4, 5), (5, 2), (9, 3)]
    ]
    assert [(row["total_ms"], row["rmse"]) for row in front(rows, "rmse")] == [
        (1, 9),
        (3, 5),
        (5, 2),
    ]


def test_no_row_of_the_front_is_beaten():
    rng = np.random.default_rng(0)
    rows = [{"total_ms": a, "rmse": b} for a, b in rng.uniform(size=(200, 2))]
    best = front(rows, "rmse")
    assert 2 < len(best) < 20
    beats = lambda a, b: a["total_ms"] <= b["total_ms"] and a["rmse"] <= b["rmse"] and a != b
    for row in rows:
        assert any(beats(other, row) for other in rows) == (row not in best)


def test_the_command_writes_table_and_charts(tmp_path, capsys):
    out = tmp_path / "made"
    arguments = {"techniques": ("bilinear", "vsm"), "quick": True, "image_size": 32, "runs": 1}
    command.frontier(("sphere",), out=out, **arguments)
    rows = pq.read_table(out / "frontier.parquet").to_pylist()
    content = json.loads((out / "frontier.json").read_text())
    assert content["rows"] == rows
    assert {"versions", "device", "commit"} <= content.keys()
    assert [(r["setting"], r["map_size"]) for r in rows] == [
        ("bilinear", 256), ("vsm 3x3", 256), ("bilinear", 1024), ("vsm 3x3", 1024),
    ]  # fmt: skip
    assert all(
        np.isfinite([row["rmse"], row["total_ms"], row["gradient_ms_median"]]).all() for row in rows
    )
    assert matplotlib.image.imread(out / "frontier.png").std() > 0.05
    assert (out / "frontier.pdf").read_bytes().startswith(b"%PDF")
    assert "none is both faster and closer to truth" in capsys.readouterr().out
    # Once more: nothing is left to measure, and the table is the same.
    command.frontier(("sphere",), out=out, **arguments)
    assert pq.read_table(out / "frontier.parquet").to_pylist() == rows


@pytest.mark.errors
def test_mistakes_are_named(tmp_path):
    with pytest.raises(ValueError, match=r"scene 'sphree': neither a file nor .*sphere"):
        command.frontier(("sphree",), out=tmp_path / "a", techniques=("esm",), quick=True)
    with pytest.raises(ValueError, match="--image-size and --runs of at least 1"):
        command.frontier(("sphere",), out=tmp_path / "b", runs=0)


def test_a_chart_of_one_scene_and_of_many(tmp_path):
    rng = np.random.default_rng(0)
    rows = [
        {"scene": f"scene {k}", "technique": name, "map_size": 256, "total_ms": ms, "rmse": error}
        for k in range(4)
        for name in techniques(Filter)
        for ms, error in rng.uniform(0.1, 1, (2, 2))
    ]
    save_chart(rows, tmp_path / "many.png")
    save_chart([row for row in rows if row["scene"] == "scene 0"], tmp_path / "one.png")
    many, one = (matplotlib.image.imread(tmp_path / f"{name}.png") for name in ("many", "one"))
    assert many.shape[0] > 1.5 * one.shape[0]
