"""The solve in runs of steps: what it finds, and that stopping it changes no bit."""

import functools
import io

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest

import experiments.solve as solver
from experiments.solve import Solve

SOLVER = optx.LBFGS(rtol=1e-5, atol=1e-5)
MATRIX = np.array([[3.0, 1.0, 0.2], [1.0, 2.0, -0.4], [0.2, -0.4, 1.5]], np.float32)
GOAL = np.array([0.7, -1.2, 0.4], np.float32)


@pytest.fixture(autouse=True)
def _single_precision():
    with jax.enable_x64(False):
        yield


class Ways(eqx.Module):
    """Unknowns of two shapes, one of them at times not free."""

    place: jax.Array
    bend: jax.Array | None


def ways(place, bend):
    as_array = lambda a: None if a is None else jnp.asarray(np.float32(a))
    return Ways(as_array(place), as_array(bend))


def distance(steps, anchor, data):
    """A valley that bends; least, and zero, where place is GOAL and bend is 1."""
    goal, matrix = data
    off = anchor.place + steps.place - goal
    bend = 1.0 if steps.bend is None else anchor.bend + steps.bend
    return 0.5 * off @ matrix @ off + 20 * jnp.sum((bend - 1 - off[0] ** 2) ** 2)


def valley(*, free=True, size=3, objective=distance):
    zeros = jnp.zeros(size), (jnp.zeros(()) if free else None)
    anchor = ways(size * [0.1], 0.5 if free else None)
    data = jnp.asarray(GOAL[:size]), jnp.asarray(MATRIX[:size, :size])
    return Solve(objective, Ways(*zeros), anchor, data, SOLVER)


def bits(solve):
    """Return everything that a solve holds."""
    leaves = jax.tree.leaves(solve.progress)
    assert len(leaves) > 10
    return [np.asarray(leaf).tobytes() for leaf in leaves]


@functools.cache
def unstopped(steps):
    with jax.enable_x64(False):
        solve = valley()
        solve.advance(steps)
        return solve


# Known answers


def test_a_solve_finds_the_lowest_place_and_says_so():
    solve = valley()
    start = solve.value
    progress = solve.advance(200)
    assert progress is solve.progress
    assert bool(progress.ended)
    assert not bool(progress.failed)
    np.testing.assert_allclose(progress.anchor.place + progress.y.place, GOAL, atol=1e-3)
    assert float(progress.anchor.bend + progress.y.bend) == pytest.approx(1, abs=1e-3)
    assert solve.value < 1e-6 < start
    assert float(progress.value) == pytest.approx(start)  # when the anchor was set
    assert 3 < int(progress.steps) == int(progress.since_anchor) < 100


def test_what_is_not_free_takes_no_part():
    solve = valley(free=False)
    solve.advance(200)
    place = solve.progress.anchor.place + solve.progress.y.place
    assert bool(solve.progress.ended)
    np.testing.assert_allclose(place, GOAL, atol=2e-2)


def test_steps_are_counted_and_an_ended_solve_takes_no_more():
    solve = valley()
    for expected in (0, 1, 4, 6):
        solve.advance(expected - int(solve.progress.steps))
        assert int(solve.progress.steps) == expected
    solve.advance(500)
    ended = bits(solve)
    assert int(solve.progress.steps) < 500
    solve.advance(10)
    assert bits(solve) == ended


def test_a_new_anchor_starts_there_and_forgets():
    solve = valley()
    solve.advance(5)
    y, anchor = solve.progress.y, solve.progress.anchor
    value = solve.value
    solve.set_anchor(Ways(anchor.place + y.place, anchor.bend + y.bend))
    progress = solve.progress
    assert not np.any(progress.y.place)
    assert (int(progress.steps), int(progress.since_anchor)) == (5, 0)
    assert not bool(progress.ended)
    assert solve.value == pytest.approx(value)
    assert float(progress.value) == pytest.approx(value)
    solve.advance(200)
    np.testing.assert_allclose(
        solve.progress.anchor.place + solve.progress.y.place, GOAL, atol=1e-3
    )
    assert int(solve.progress.steps) == 5 + int(solve.progress.since_anchor)


# Stopping


@pytest.mark.parametrize("runs", [(8,), (1,) * 8, (3, 0, 5)])
def test_runs_of_any_length_take_the_same_steps(runs):
    solve = valley()
    for steps in runs:
        solve.advance(steps)
    assert bits(solve) == bits(unstopped(8))


@pytest.mark.parametrize("stopped", [0, 1, 5])
def test_a_continued_solve_is_that_of_one_that_was_never_stopped(tmp_path, stopped):
    first = valley()
    first.advance(stopped)
    first.store(tmp_path / "state.eqx")
    assert [path.name for path in tmp_path.iterdir()] == ["state.eqx"]
    second = valley()
    second.advance(2)  # what it did before does not count
    second.restore(tmp_path / "state.eqx")
    assert bits(second) == bits(first)
    second.advance(8 - stopped)
    assert bits(second) == bits(unstopped(8))


def test_a_solve_continued_after_a_new_anchor_has_that_anchor(tmp_path):
    other = ways([0.3, 0.2, 0.1], 0.9)
    first = valley()
    first.advance(3)
    first.set_anchor(other)
    first.advance(2)
    first.store(tmp_path / "state.eqx")
    second = valley()
    second.restore(tmp_path / "state.eqx")
    np.testing.assert_array_equal(second.progress.anchor.place, other.place)
    for solve in (first, second):
        solve.advance(4)
    assert bits(second) == bits(first)


def test_nothing_is_traced_again_on_the_way(tmp_path):
    traces = []

    def counted(*args):
        traces.append(args)
        return distance(*args)

    solve = valley(objective=counted)
    solve.advance(1)
    assert solve.value > 0
    once = len(traces)
    assert once > 0
    for steps in (1, 3, 0, 7):
        solve.advance(steps)
        solve.set_anchor(ways([0.1 * steps, 0.2, 0.3], 0.7))
        solve.store(tmp_path / "state.eqx")
        assert solve.value > 0
    assert len(traces) == once


# Files


def npz():
    buffer = io.BytesIO()
    np.savez(buffer, y=np.zeros(3, np.float32))
    return buffer.getvalue()


def npy(array):
    buffer = io.BytesIO()
    np.save(buffer, array)
    return buffer.getvalue()


DAMAGE = {
    "empty": lambda whole: b"",
    "cut in a header": lambda whole: whole[:40],
    "cut in an array": lambda whole: whole[: len(whole) // 2],
    "cut at the end": lambda whole: whole[:-1],
    "another kind of file": lambda whole: b"\x89PNG\r\n\x1a\n" + whole[8:],
    "text": lambda whole: b"hello\n",
    "broken header": lambda whole: whole.replace(b"'descr'", b"'d(scr'", 1),
    "archive": lambda whole: b"PK\x03\x04" + whole[4:],
    "one array": lambda whole: npy(np.zeros(3, np.float32)),
    "other size": lambda whole: npy(np.zeros(4, np.float32)),
    "other type": lambda whole: npy(np.zeros(3)) + whole,
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_a_damaged_file_is_refused_and_nothing_changes(tmp_path, damage):
    path = tmp_path / "state.eqx"
    solve = unstopped(8)
    solve.store(path)
    path.write_bytes(DAMAGE[damage](path.read_bytes()))
    before = bits(solve)
    with pytest.raises(ValueError, match=r"state\.eqx: cannot be continued from") as refusal:
        solve.restore(path)
    assert "\n" not in str(refusal.value)
    assert bits(solve) == before


@pytest.mark.parametrize("other", [{"size": 2}, {"free": False}])
def test_the_file_of_other_unknowns_is_refused(tmp_path, other):
    valley(**other).store(tmp_path / "state.eqx")
    solve = valley()
    before = bits(solve)
    with pytest.raises(ValueError, match=r"state\.eqx: cannot be continued from"):
        solve.restore(tmp_path / "state.eqx")
    assert bits(solve) == before


def test_a_missing_file_or_folder_is_named(tmp_path):
    solve = unstopped(8)
    with pytest.raises(ValueError, match=r"none\.eqx: cannot be continued from"):
        solve.restore(tmp_path / "none.eqx")
    with pytest.raises(ValueError, match=r"state\.eqx: there is no folder"):
        solve.store(tmp_path / "none" / "state.eqx")


@pytest.mark.parametrize("trouble", [KeyboardInterrupt, OSError])
def test_a_file_is_whole_or_as_it_was(tmp_path, monkeypatch, trouble):
    path = tmp_path / "state.eqx"
    solve = unstopped(8)
    solve.store(path)
    whole = path.read_bytes()

    def halfway(target, tree):
        target.write_bytes(whole[: len(whole) // 2])
        raise trouble("stopped")

    monkeypatch.setattr(solver.eqx, "tree_serialise_leaves", halfway)
    with pytest.raises((trouble, ValueError)):
        solve.store(path)
    assert path.read_bytes() == whole
    assert [path.name for path in tmp_path.iterdir()] == ["state.eqx"]
