"""Long runs: what was measured is kept, a killed run goes on, and so does a cluster's."""

import json
import os
import signal
import subprocess
import sys
import textwrap
import time
from collections import Counter
from pathlib import Path
from typing import NamedTuple

import pytest

import experiments.frontier.run as runs
from experiments.frontier.cluster import connect
from experiments.frontier.run import ACCURACY, TIMINGS, Cell, measure_here, run
from experiments.frontier.store import FORMAT, Key, Store
from experiments.frontier.view import View

ROOT = Path(__file__).parents[1]
KEY = Key("accuracy", "sphere", "pcf 3x3 @ 256", 64)


class Stub(NamedTuple):
    """A contender that takes no time to speak of, and logs where it is told to."""

    label: str
    log: str = ""
    seconds: float = 0.0
    technique: str = "stub"
    kind: str = "shadow"
    map_size: int = 8

    @property
    def name(self):
        return self.label

    def applies(self, view):
        return not (view.name == "dull" and self.label == "picky")

    def accuracy(self, view, programs):
        return self._measured(view, ACCURACY), f"picture of {view.name} {self.label}".encode()

    def timing(self, view, programs, *, runs):
        return self._measured(view, "timing")

    def _measured(self, view, what):
        time.sleep(self.seconds)
        if self.log:
            with open(self.log, "a") as file:
                file.write(f"{what} {view.name} {self.label} {os.getpid()}\n")
        return {"value": f"{view.name} {self.label}" * 200}


def cells(scenes, stubs):
    return [Cell(w, s, stub, 8, 1) for s in scenes for stub in stubs for w in (ACCURACY, *TIMINGS)]


def empty_view(name, size):
    """Return a view of nothing: they take long, and the stubs ask for the name alone."""
    return View(name, *[None] * (len(View._fields) - 1))


@pytest.fixture
def no_views(monkeypatch):
    monkeypatch.setattr(runs, "load_view", empty_view)
    runs._view.cache_clear()
    yield
    runs._view.cache_clear()


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
    with pytest.raises(ValueError, match=rf"results of format .*, expected {FORMAT}; choose"):
        Store(tmp_path)


def test_a_picture_is_kept_beside(tmp_path):
    store = Store(tmp_path)
    store.put(KEY, {"rmse": 0.25}, b"seen")
    assert Store(tmp_path).picture(KEY) == b"seen"
    assert store.picture(KEY._replace(scene="cube")) is None


# Runs


def test_nothing_is_measured_twice(tmp_path, no_views):
    log, store = tmp_path / "log", Store(tmp_path)
    stubs = [Stub(name, str(log)) for name in "xyz"]
    run(cells("ab", stubs), store)
    found = Counter(line.split()[0] for line in log.read_text().splitlines())
    assert found == {"accuracy": 6, "timing": 12}
    run(cells("abc", stubs), store)
    assert [line.split()[1] for line in log.read_text().splitlines()[18:]] == ["c"] * 9
    run([cell._replace(image_size=16) for cell in cells("a", stubs)], store)
    assert len(log.read_text().splitlines()) == 36
    assert store.picture(Key(ACCURACY, "a", "x", 8)) == b"picture of a x"


def test_timings_come_after_all_accuracies_of_their_scene(no_views):
    order = [
        (cell.scene, cell.what) for cell, _ in measure_here(cells("ab", [Stub("x"), Stub("y")]))
    ]
    assert order == [(s, w) for s in "ab" for w in (ACCURACY, *TIMINGS) for _ in range(2)]


def test_what_is_not_for_a_scene_is_left_out(tmp_path, no_views):
    store = Store(tmp_path)
    run(cells(["dull", "fair"], [Stub("picky")]), store)
    assert store.get(Key(ACCURACY, "dull", "picky", 8)) == {}
    assert store.get(Key(ACCURACY, "fair", "picky", 8)) != {}


def test_an_error_ends_the_run_and_keeps_what_was_made(tmp_path, no_views, monkeypatch):
    def broken(name, size):
        if name == "b":
            raise ValueError("scene 'b': odd")
        return empty_view(name, size)

    monkeypatch.setattr(runs, "load_view", broken)
    store = Store(tmp_path)
    with pytest.raises(ValueError, match="scene 'b': odd"):
        run(cells("ab", [Stub("x")]), store)
    assert store.get(Key(TIMINGS[1], "a", "x", 8)) is not None


KILLED = """
    import os, random, signal, sys, time
    from pathlib import Path
    import experiments.frontier.run as runs
    from experiments.frontier.store import Store
    from tests.test_frontier_runs import Stub, cells, empty_view

    runs.load_view = empty_view
    wanted = cells("abcd", [Stub(f"method {k}", seconds=0.002) for k in range(22)])
    store, chance = Store(Path(sys.argv[1])), random.Random(0)
    folder, kills = Path(sys.argv[1]) / "cells", 0
    made = lambda: sum(1 for _ in folder.glob("*/*.json"))
    while True:
        goal = made() + chance.randrange(4)  # 60 of 264 at most, whatever the machine's speed
        child = os.fork()
        if child == 0:
            runs.run(wanted, store)
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
def test_a_run_killed_twenty_times_has_the_same_table(tmp_path):
    program = [sys.executable, "-c", textwrap.dedent(KILLED), str(tmp_path)]
    done = subprocess.run(program, cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) == 20
    assert not list(tmp_path.rglob("*.damaged"))
    store = Store(tmp_path)
    for cell in cells("abcd", [Stub(f"method {k}") for k in range(22)]):
        assert store.get(cell.key) == {"value": f"{cell.scene} {cell.contender.name}" * 200}


# A cluster

PRELOAD = """
import experiments.frontier.run as runs
from tests.test_frontier_runs import empty_view
runs.load_view = empty_view
"""
CLIENT = """
    import sys
    from functools import partial
    from pathlib import Path
    from experiments.frontier.cluster import connect, measure_on
    from experiments.frontier.run import run
    from experiments.frontier.store import Store
    from tests.test_frontier_runs import Stub, cells

    folder = Path(sys.argv[1])
    stubs = [Stub(f"method {k}", str(folder / "log"), seconds=0.05) for k in range(20)]
    with connect(sys.argv[2]) as client:
        client.wait_for_workers(2, timeout=60)
        run(cells("ab", stubs), Store(folder / "out"), measured=partial(measure_on, client))
"""


@pytest.mark.skipif(sys.platform == "win32", reason="kills a process")
def test_a_worker_that_dies_loses_nothing(tmp_path):
    """A scheduler and two workers, one of which is killed while it measures."""
    (tmp_path / "preload.py").write_text(PRELOAD)
    place, out = tmp_path / "scheduler.json", tmp_path / "out"
    here = {"cwd": ROOT, "stderr": subprocess.DEVNULL, "stdout": subprocess.DEVNULL}
    dask = [sys.executable, "-m", "dask"]
    at = ["--scheduler-file", str(place)]
    one = [
        "--no-nanny",
        "--nthreads",
        "1",
        "--no-dashboard",
        "--preload",
        str(tmp_path / "preload.py"),
    ]
    started = [subprocess.Popen([*dask, "scheduler", *at, "--port", "0", "--no-dashboard"], **here)]
    try:
        _wait(place.exists)
        started += [subprocess.Popen([*dask, "worker", *at, *one], **here) for _ in range(2)]
        address = json.loads(place.read_text())["address"]
        client = [sys.executable, "-c", textwrap.dedent(CLIENT), str(tmp_path), address]
        asking = subprocess.Popen(client, cwd=ROOT, stderr=subprocess.PIPE, text=True)
        started.append(asking)
        _wait(lambda: asking.poll() or len(list(out.glob("cells/*/*.json"))) > 10)
        started[1].send_signal(signal.SIGKILL)
        _, said = asking.communicate(timeout=100)
        assert asking.returncode == 0, said
    finally:
        for process in started:
            process.kill()
            process.wait()
    store = Store(out)
    wanted = cells("ab", [Stub(f"method {k}") for k in range(20)])
    for cell in wanted:
        assert store.get(cell.key) == {"value": f"{cell.scene} {cell.contender.name}" * 200}
    lines = [line.rsplit(" ", 1) for line in (tmp_path / "log").read_text().splitlines()]
    assert len({process for _, process in lines}) == 2  # both worked
    # What it had finished and not yet told is all that was measured again.
    assert len(wanted) <= len(lines) <= len(wanted) + 2


def _wait(ready):
    end = time.monotonic() + 60
    while not ready():
        assert time.monotonic() < end
        time.sleep(0.02)


@pytest.mark.errors
@pytest.mark.parametrize("address", ["tcp://127.0.0.1:9", "no address", "tcp://"])
def test_a_scheduler_that_does_not_answer_is_named(address, monkeypatch):
    monkeypatch.setattr("experiments.frontier.cluster._PATIENCE_S", 1)
    with pytest.raises(ValueError, match=f"--scheduler: no scheduler answers at '{address}'"):
        connect(address)


@pytest.mark.errors
def test_missing_dask_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(ValueError, match=r"--scheduler: needs Dask; .*tangentspace\[cluster\]"):
        connect("tcp://127.0.0.1:9")
