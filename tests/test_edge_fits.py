"""Fits across shadow edges: poses, lights and vertices from shadows, and what images tell apart."""

import json

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from scipy.spatial.transform import Rotation

from experiments.__main__ import _run
from experiments.edge_fits.adam import adam
from experiments.edge_fits.determined import combination, determined, sentences
from experiments.edge_fits.fit_options import parse_start
from experiments.edge_fits.image_fit import (
    Problem,
    blurred,
    check_edges,
    fit_images,
    images_and_derivatives,
)
from experiments.edge_fits.scene_numbers import (
    SceneProblem,
    State,
    numbers_of,
    rotation,
    vertex_numbers,
)
from experiments.edge_fits.shadow_view import ShadowView, Technique
from experiments.edge_fits.smooth_fit import rows_and_links, share_pulls
from experiments.edge_gradients.quad_shadow import CAMERAS, CORNERS, LIGHTS, quad_over_floor
from experiments.mesh_parts import split_caster
from experiments.scene import Material, Scene
from experiments.scenes import load_scene
from shadows import BilinearFilter, ConstantBias, HardCompare, SingleLayout
from tangentspace.shading import BlinnPhongShading

TECHNIQUE = Technique(SingleLayout(), BilinearFilter(), HardCompare(), BlinnPhongShading(), 128)
ZERO = np.zeros(3, np.float32)


@pytest.fixture
def single_precision():
    """As the command line computes."""
    with jax.enable_x64(False):
        yield


@pytest.mark.parametrize("vector", [(0.0, 0.0, 0.0), (1e-5, 0, 2e-5), (0.3, -0.2, 0.5), (2, 1, 2)])
def test_rotations(vector):
    vector = np.array(vector, float)
    expected = Rotation.from_rotvec(vector).as_matrix()
    np.testing.assert_allclose(rotation(jnp.asarray(vector)), expected, atol=1e-12)
    turn = lambda vector: rotation(jnp.asarray(vector))
    check_grads(turn, (jnp.asarray(vector),), order=1, eps=1e-5, atol=1e-6, rtol=1e-6)


class Blob(Problem):
    """A soft disc, and a faint one beside it: two valleys."""

    @property
    def names(self):
        return ("across", "down")

    def images(self, vector):
        place = jnp.arange(40, dtype=vector.dtype)
        away = lambda x, y: (place[None, :] - x) ** 2 + (place[:, None] - y) ** 2
        disc = lambda x, y: jax.nn.sigmoid(9 - away(x, y))
        x, y = vector[0], vector[1]
        return disc(x, y)[None] + 0.5 * disc(x + 12, y)[None]


BLOB = (Blob(), np.asarray(Blob().images(jnp.array([25.0, 20.0])), np.float32))


def test_images_are_blurred_and_left_as_they_are_by_zero():
    image = np.random.default_rng(0).random((2, 12, 17))
    np.testing.assert_array_equal(blurred(jnp.asarray(image), jnp.asarray(0.0)), image)
    flat = blurred(jnp.ones((1, 9, 9)), jnp.asarray(3.0))
    np.testing.assert_allclose(flat, 1, rtol=1e-12)
    point = blurred(jnp.zeros((1, 41, 41)).at[0, 20, 20].set(1.0), jnp.asarray(2.0))[0]
    assert float(point[20, 22] / point[20, 20]) == pytest.approx(np.exp(-0.5), rel=1e-6)


@pytest.mark.usefixtures("single_precision")
def test_a_fit_finds_its_way_from_blurred_to_sharp_and_goes_on_where_it_stopped():
    problem, target = BLOB
    start, stages = [np.array([31.0, 29.0])], []
    blurs = {"blurs": (0.2, 0.1, 0.05, 0.0)}
    keep = lambda done: stages.append(list(done))
    found = fit_images(problem, target, start, keep=keep, **blurs)
    np.testing.assert_allclose(found.vector, [25, 20], atol=1e-3)
    assert found.evaluations == sum(stage.evaluations for stage in found.stages)
    again = fit_images(problem, target, start, done=stages[3], **blurs)
    assert again.vector == pytest.approx(found.vector, abs=0)
    assert [s.rms for s in again.stages] == [s.rms for s in found.stages]
    # Sharp from the start, the discs do not touch and nothing moves them.
    stuck = fit_images(problem, target, start, blurs=(0.0,))
    assert np.linalg.norm(stuck.vector - [25, 20]) > 3


@pytest.mark.usefixtures("single_precision")
def test_of_several_starts_the_best_is_followed():
    problem, target = BLOB
    starts = [np.array([38.0, 8.0]), np.array([24.0, 21.0])]
    found = fit_images(problem, target, starts, blurs=(0.02, 0.0))
    np.testing.assert_allclose(found.vector, [25, 20], atol=1e-3)
    assert found.best == 1
    assert {stage.start for stage in found.stages} == {0, 1}


@pytest.mark.usefixtures("single_precision")
def test_what_stands_out_counts_less():
    """A few wrong pixels do not move a fit."""
    problem, target = BLOB
    dirty = target.copy()
    dirty[0, 16:18, 27:30] += 3.0
    found = fit_images(problem, dirty, [np.array([24.0, 21.0])])
    plain = next(s for s in reversed(found.stages) if s.blur > 0)
    assert (
        np.abs(found.vector - [25, 20]).max()
        < 0.2 * np.abs(np.array(plain.vector) - [25, 20]).max()
    )


@pytest.mark.errors
def test_a_fit_that_nothing_moves_says_so():
    problem, _ = BLOB
    far = images_and_derivatives(problem, np.array([500.0, 500.0]))[1]
    near = images_and_derivatives(problem, np.array([20.0, 20.0]))[1]
    check_edges(problem, [far, near])
    with pytest.raises(ValueError, match="do not change with across, down; no edge"):
        check_edges(problem, [far, far])


@pytest.mark.usefixtures("single_precision")
def test_adam_comes_down_too_and_keeps_its_history():
    problem, target = BLOB
    history = adam(problem, target, np.array([22.0, 21.0]), steps=60, rates=(0.01, 0.3))
    assert history.rate == 0.3
    assert len(history.rms) == len(history.vectors) == 60
    np.testing.assert_allclose(history.vectors[-1], [25, 20], atol=0.3)


def test_singular_values_tell_what_images_tell():
    """Two numbers alone, and of the third and fourth only the sum."""
    jacobian = np.zeros((6, 4))
    jacobian[0, 0], jacobian[1, 1], jacobian[2, 2], jacobian[2, 3] = 4, 2, 1, 1
    found = determined(jacobian, 0.1)
    np.testing.assert_allclose(found.singular, [4, 2, np.sqrt(2), 0], atol=1e-12)
    np.testing.assert_array_equal(found.known, [True, True, True, False])
    np.testing.assert_allclose(found.standard_errors[:2], [0.025, 0.05])
    assert np.isinf(found.standard_errors[2:]).all()
    (line,) = sentences(found, ("a", "b", "c", "d"))
    assert line.startswith("undetermined: 0.71 ")
    assert "- 0.71" in line
    assert combination(np.array([0.1, -0.9, 0.4]), ("x", "y", "z")) == "0.90 y - 0.40 z"


def test_a_fit_that_left_the_view_is_flagged():
    """Derivatives of rounding alone tell of nothing."""
    found = determined(np.full((100, 2), 1e-9), 0.1)
    assert not found.known.any()
    assert np.isinf(found.standard_errors).all()
    (line,) = sentences(found, ("turn.x", "shift.y"))
    assert line.startswith("out of view: where the fit ended, none of its numbers changes")


def test_faces_that_are_flipped_or_there_twice_cast_the_same_shadow():
    """In values and derivatives, and so to every fit; to rounding."""
    scene = load_scene("bracket")
    casts, caster = split_caster(scene.mesh)
    faces, materials = np.asarray(scene.mesh.faces), np.asarray(scene.face_materials)
    some = np.flatnonzero(casts)[::3]
    flipped = faces.copy()
    flipped[some] = flipped[some, ::-1]
    twice = np.concatenate([faces, faces[some], faces[some, ::-1]])

    def look(faces):
        of_faces = np.resize(materials, len(faces))
        changed = scene._replace(mesh=scene.mesh._replace(faces=faces), face_materials=of_faces)
        seen = np.arange(len(faces)) < len(casts)
        seen[: len(casts)] = ~casts
        view = ShadowView.of(changed, TECHNIQUE, image_size=(64, 64), seen=seen)
        state = State(ZERO, ZERO, scene.lights[0], ConstantBias(0.01))
        numbers = numbers_of(state, ["turn.y", "shift.x"], size=1.0)
        positions = np.asarray(scene.mesh.positions)
        problem = SceneProblem(view, positions, caster, (state,), numbers)
        return images_and_derivatives(jax.tree.map(jnp.asarray, problem), np.zeros(2))

    (image, slope), *others = (look(f) for f in (faces, flipped, twice))
    assert np.abs(slope).max() > 0.01
    for other_image, other_slope in others:
        np.testing.assert_allclose(other_image, image, atol=1e-5)
        np.testing.assert_allclose(other_slope, slope, atol=1e-5)


def test_standard_errors_are_those_of_many_noisy_fits():
    rng = np.random.default_rng(1)
    jacobian = rng.normal(size=(50, 3)) * [1, 5, 0.3]
    noise = 0.2 * rng.normal(size=(4000, 50))
    spread = np.std(noise @ np.linalg.pinv(jacobian).T, axis=0)
    np.testing.assert_allclose(determined(jacobian, 0.2).standard_errors, spread, rtol=0.05)


def test_the_caster_is_all_but_the_ground():
    for name in ("bracket", "thin-box", "sphere"):
        scene = load_scene(name)
        casts, caster = split_caster(scene.mesh)
        heights = scene.mesh.positions[scene.mesh.faces[~casts], 1]
        np.testing.assert_allclose(heights, 0, atol=1e-6)
        assert len(caster) == len(scene.mesh.positions) - 4


@pytest.mark.errors
def test_numbers_that_are_not_there_are_refused():
    state = State(ZERO, ZERO, load_scene("spot").lights[0], ConstantBias(0.1))
    assert len(numbers_of(state, ["light"], size=1.0)) == 8
    numbers = numbers_of(state, ["turn.y", "light.position"], size=1.0)
    assert [n.name for n in numbers][:2] == ["turn.y", "light.position.x"]
    with pytest.raises(ValueError, match=r"no number 'light.positon'.*light.position"):
        numbers_of(state, ["light.positon"], size=1.0)
    np.testing.assert_allclose(parse_start(["turn.y=70"], numbers)[0] * 0.02, np.deg2rad(70))
    with pytest.raises(ValueError, match=r"--start: 'turn.x' is not free"):
        parse_start(["turn.x=3"], numbers)
    with pytest.raises(ValueError, match=r"expected turn.y=NUMBER"):
        parse_start(["turn.y=much"], numbers)


def test_added_numbers_do_what_their_names_say():
    light = load_scene("spot").lights[0]
    state = State(ZERO, ZERO, light, ConstantBias(0.1), np.zeros((1, 3), np.float32))
    numbers = {n.name: n for n in numbers_of(state, ["turn", "light"], size=1.0)}
    added = lambda name, amount: numbers[name].add(state, jnp.float32(amount))
    assert added("turn.y", 2).turn[1] == pytest.approx(0.04)
    moved = added("light.position.z", 3).light.position - light.position
    np.testing.assert_allclose(moved, [0, 0, 0.03], atol=1e-6)
    turned = added("light.direction.u", 5).light.direction
    assert np.linalg.norm(turned) == pytest.approx(1, abs=1e-6)
    assert float(turned @ light.direction) == pytest.approx(np.cos(0.1), abs=1e-5)
    assert added("light.outer_angle", -1).light.outer_angle == pytest.approx(0.58)
    np.testing.assert_allclose(added("light.intensity", 1).light.color, np.exp(0.05), rtol=1e-6)
    (x, *_) = vertex_numbers([7], size=2.0)
    assert (x.name, float(x.add(state, jnp.float32(1)).vertex[0, 0])) == (
        "vertex.7.x", pytest.approx(0.02),
    )  # fmt: skip


def test_pulls_are_shared_over_a_surface():
    """What is solved by conjugate gradients is what a dense solve gives."""
    vertices = np.array([[0, 1], [1, 2], [2, 3], [0, 2], [3, 5]])
    places, links = rows_and_links(vertices, np.array([0, 1, 2, 3, 2, 5]), [0, 1, 2, 3, 4])
    np.testing.assert_array_equal(places, [0, 1, 2, 3, 2, 4])
    assert len(links) == 4
    laplacian = np.zeros((4, 4))
    for a, b in links:
        laplacian[[a, b], [a, b]] += 1
        laplacian[[a, b], [b, a]] -= 1
    pulls = np.random.default_rng(0).normal(size=(4, 3))
    expected = np.linalg.solve(np.eye(4) + 20 * laplacian, pulls)
    np.testing.assert_allclose(share_pulls(jnp.asarray(pulls), links, 20.0), expected, atol=1e-3)


def quad_problem(covered):
    """Return the corner of a quad over a floor that fills the view, as fits see it."""
    mesh, _ = quad_over_floor(CORNERS.astype(np.float32))
    mesh = jax.tree.map(np.asarray, mesh)
    light = jax.tree.map(lambda leaf: np.asarray(leaf, np.float32), LIGHTS["spot"])
    camera = jax.tree.map(lambda leaf: np.asarray(leaf, np.float32), CAMERAS["lit area"])
    faces = np.zeros(len(mesh.faces), np.int32)
    scene = Scene("quad", mesh, faces, (Material(),), camera, (light,))
    casts, _ = split_caster(mesh)
    view = ShadowView.of(scene, TECHNIQUE, image_size=(128, 128), seen=~casts)
    if not covered:
        view = eqx.tree_at(lambda view: view.edges, view, None)
    state = State(ZERO, ZERO, light, ConstantBias(0.02), np.zeros((1, 3), np.float32))
    numbers = vertex_numbers([6], size=0.7)[::2]
    problem = SceneProblem(
        view, mesh.positions, np.zeros(0, np.int32), (state,), numbers,
        np.array([6]), np.array([0]),
    )  # fmt: skip
    return jax.tree.map(jnp.asarray, problem)


@pytest.mark.usefixtures("single_precision")
def test_a_corner_is_found_from_its_shadow_with_coverage_and_not_without():
    start = [np.array([45.0, 40.0])]
    problem = quad_problem(covered=True)
    target, _ = images_and_derivatives(problem, np.zeros(2))
    found = fit_images(problem, target, start)
    assert found.stages[-1].rms ** 2 < 1e-6  # measured 2e-13
    assert np.abs(found.vector).max() < 1e-2  # of 1 % of the caster's size
    bare = quad_problem(covered=False)
    stuck = fit_images(bare, target, start, blurs=(0.05, 0.0))
    assert stuck.stages[-1].rms ** 2 > 1e-2


def command(capsys, *words):
    code = _run([str(word) for word in words])
    return code, capsys.readouterr()


@pytest.mark.usefixtures("single_precision")
def test_a_pose_from_its_shadow_by_the_command_and_on_where_it_stopped(tmp_path, capsys):
    options = ("--image-size", 128, 128, "--shadow-map-size", 128, "--out", tmp_path)
    code, said = command(capsys, "fit-pose", "--adam", 5, *options)
    assert code == 0
    summary = json.loads((tmp_path / "summary.json").read_text())
    for name, row in summary["numbers"].items():
        # Measured: 4e-5 degrees, 1e-7.
        assert abs(row["fit"]) < (0.01 if "turn" in name else 1e-4), name
        assert row["standard_error"] > 0
    # Of nine stages of at most 12; measured 64, or 31 by another way down.
    assert summary["evaluations"] < 80
    assert len(summary["adam"]["rms"]) == 5
    assert "standard errors: if each pixel has noise of 0.01" in said.out
    for name in ("comparison.png", "progress_curve.png"):
        assert (tmp_path / name).stat().st_size > 10_000
    stages = json.loads((tmp_path / "stages.json").read_text())
    (tmp_path / "stages.json").write_text(json.dumps(stages[:2]))
    code, _ = command(capsys, "fit-pose", "--adam", 5, "--resume", *options)
    assert code == 0
    again = json.loads((tmp_path / "summary.json").read_text())
    assert again["numbers"] == summary["numbers"]
    code, said = command(capsys, "fit-pose", "--adam", 6, "--resume", *options)
    assert (code, "other settings (adam)" in said.err) == (2, True)


@pytest.mark.usefixtures("single_precision")
def test_a_light_from_its_shadows_by_the_command(tmp_path, capsys):
    code, _ = command(
        capsys, "fit-light", "--image-size", 128, 128, "--shadow-map-size", 128,
        "--out", tmp_path, "--free", "light.position", "light.intensity",
    )  # fmt: skip
    assert code == 0
    numbers = json.loads((tmp_path / "summary.json").read_text())["numbers"]
    assert abs(numbers["light.position.x"]["start"]) > 0.3
    for name, row in numbers.items():
        assert abs(row["fit"]) < 1e-3, name  # measured 3e-6 world units, 3e-5 %


@pytest.mark.usefixtures("single_precision")
def test_a_ball_takes_the_shadow_of_a_bracket_by_the_command(tmp_path, capsys):
    code, said = command(
        capsys, "fit-vertices", "--image-size", 64, 64, "--shadow-map-size", 64,
        "--out", tmp_path, "--steps", 40,
    )  # fmt: skip
    assert code == 0
    history = json.loads((tmp_path / "summary.json").read_text())["history"]
    assert history[-1]["rms"] < 0.15 * history[0]["rms"]  # measured 0.06
    assert "% of the target's contrast" in said.out
    assert (tmp_path / "caster.ply").exists()


@pytest.mark.usefixtures("single_precision")
@pytest.mark.errors
@pytest.mark.parametrize(
    ("words", "line"),
    [
        (("fit-pose", "grazing-plane"), "expected a caster over a ground, got one connected part"),
        (("fit-pose", "--free", "turm"), "no number 'turm'"),
        (("fit-pose", "--start", "turn.w=3"), "'turn.w' is not free"),
        (("fit-pose", "--starts", 0), "--starts: expected at least 1"),
        (("fit-light", "--noise", -1), "--noise: expected a number of at least 0"),
        (("fit-vertices", "--vertices", 0), "expected vertices of the caster"),
        (("fit-pose", "--target", "small.png"), "expected 32 x 32 pixels"),
        (("fit-pose", "--start", "shift.x=60"), "no edge that they move is in view"),
    ],
)
def test_bad_input_is_one_line_and_no_folder(tmp_path, capsys, monkeypatch, words, line):
    from PIL import Image

    monkeypatch.chdir(tmp_path)
    Image.new("RGB", (8, 9)).save("small.png")
    small = ("--image-size", 32, 32, "--shadow-map-size", 32)
    code, said = command(capsys, *words, "--out", tmp_path / "out", *small)
    assert code == 2
    assert line in said.err
    assert said.err.count("error:") == 1
    assert not (tmp_path / "out" / "summary.json").exists()
