"""Random scenes that move: what they promise, and derivatives of their images against rays."""

from operator import attrgetter

import jax
import numpy as np
import pytest

from experiments.edge_gradients.motion_study import Settings, measure_scenes
from experiments.edge_gradients.random_scenes import (
    LEAST_FACES,
    LIGHT_KINDS,
    MOST_CASTERS,
    MOST_FACES,
    MOTIONS,
    random_scene,
)
from experiments.edge_gradients.supersampled import supersampled

SCENES = 60
SMALL = Settings(image_size=64, map_size=512, times=(0.015, 0.016, 0.017, 0.018), moments=8)
SEEDS = (0, 1, 2, 3, 4, 5, 6, 7)


@pytest.fixture(scope="module")
def scenes():
    return [random_scene(seed) for seed in range(SCENES)]


@pytest.fixture(scope="module")
def rows():
    return list(measure_scenes(SEEDS, SMALL))


def test_scenes_are_what_they_promise(scenes):
    counts = [len(scene.caster_faces) for scene in scenes]
    assert set(counts) == set(range(1, MOST_CASTERS + 1))
    assert min(min(scene.caster_faces) for scene in scenes) >= LEAST_FACES
    assert 0.8 * MOST_FACES < max(sum(scene.caster_faces) for scene in scenes) <= MOST_FACES
    assert [scene.light_kind for scene in scenes] == SCENES // 4 * list(LIGHT_KINDS)
    assert {scene.moves for scene in scenes} == set(MOTIONS)


def test_scenes_of_a_number_are_the_same(scenes):
    jax.tree.map(np.testing.assert_array_equal, random_scene(7).motion, scenes[7].motion)


def test_something_moves_and_one_program_serves_all(scenes):
    shapes = [jax.tree.map(np.shape, scene.motion) for scene in scenes]
    for number, scene in enumerate(scenes):
        assert shapes[number] == shapes[number % len(LIGHT_KINDS)]
        motion = scene.motion
        speeds = np.sqrt(np.sum(motion.velocity**2, axis=1))
        lamp = sum(np.abs(leaf).sum() for leaf in jax.tree.leaves(motion.light_velocity))
        assert (lamp > 0) == (scene.moves == "light")
        assert speeds.max() == pytest.approx(0 if scene.moves == "light" else 1, rel=0.3)
        top, bottom, left, right = scene.window
        assert 0 <= top < bottom <= 1
        assert 0 <= left < right <= 1


def test_many_grids_of_points_are_one_fine_grid(scenes):
    """Means over pixels agree to what an edge takes of a few points; measured 0.0006."""
    mesh, light = scenes[0].motion.at(0.0)
    camera, size = scenes[0].motion.camera, (32, 32)
    draw = lambda samples, grid: supersampled(
        mesh, camera, light, image_size=size, samples=samples, grid=grid
    )
    many = np.mean([draw(4, grid) for grid in range(4)], axis=0)
    fine = draw(8, 0)
    assert np.abs(draw(4, 0) - draw(4, 1)).max() > 1e-3
    assert np.abs(many - fine).mean() < 0.002


def agreement(rows, way, change):
    """Return whether changes, their signs, and derivative images are those of the truth."""
    clear = [row for row in rows if row.clear]
    return (
        np.median([row.off[way] for row in clear]) < 0.02,
        all(change(row) * row.change > 0 for row in clear),
        np.median([row.image_off[way] for row in rows]) < 0.06,
    )


def test_derivatives_are_those_of_the_truth_with_coverage_alone(rows):
    """Measured: medians of 0.25 % and 3.9 %, without coverage 86 % and 96 %."""
    assert {row.light_kind for row in rows} == set(LIGHT_KINDS)
    assert sum(row.clear for row in rows) >= 4
    covered, plain = attrgetter("covered"), attrgetter("plain")
    assert agreement(rows, "with coverage", covered) == (True, True, True)
    assert agreement(rows, "own differences", covered) == (True, True, True)
    assert agreement(rows, "without", plain) == (False, False, False)
