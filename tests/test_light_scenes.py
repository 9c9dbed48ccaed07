"""The scenes of lights show what their docstrings say."""

import jax
import numpy as np
import pytest

from experiments.scenes import load_scene
from shadows.bias import CombinedBias, SlopeBias
from shadows.projector import Projector

from .studies import study


@pytest.fixture(autouse=True)
def _single_precision():
    with jax.enable_x64(False):
        yield


def test_projector_throws_a_slide_onto_a_wall_past_a_ball_and_a_post():
    light = load_scene("projector").lights[0]
    assert isinstance(light, Projector)
    shown = study("projector")
    surface = shown.unbiased.surface
    arrived = np.asarray(light.radiance(surface.position))
    position, normal = np.asarray(surface.position), np.asarray(surface.face_normal)
    covered = np.asarray(surface.covered)
    wall = covered & (normal[..., 2] > 0.99) & (np.abs(position[..., 2] + 1.16) < 1e-3)
    slide = wall & (arrived.max(axis=-1) > 0)
    assert 0.5 < slide.sum() / wall.sum() < 0.95
    # Red grows to the right, green upwards, and the arrow in the middle is white.
    x, y = position[slide][:, 0], position[slide][:, 1]
    assert np.corrcoef(x, arrived[slide][:, 0])[0, 1] > 0.5
    assert np.corrcoef(y, arrived[slide][:, 1])[0, 1] > 0.5
    assert (arrived[slide].min(axis=-1) == arrived.max()).sum() > 20
    # Post and ball take some of it away; the map sees what rays see.
    dark = slide & ~shown.truth
    assert 0.05 < dark.sum() / slide.sum() < 0.5
    errors = shown.errors(CombinedBias((SlopeBias(2.0),)))
    assert errors.error < 0.02  # measured 0.012, along edges


def test_light_falls_into_a_dark_room_through_six_openings():
    shown = study("skylights")
    surface = shown.unbiased.surface
    position = np.asarray(surface.position)
    floor = np.asarray(surface.covered) & (position[..., 1] < 1e-4)
    assert floor.sum() > 3000
    lit = floor & shown.truth
    assert 0.005 < lit.sum() / floor.sum() < 0.1
    # The patch of an opening lies where its rays lead, a height of 1.7 below.
    shift = 1.7 / np.tan(np.deg2rad(62.0))
    x, z = position[lit][:, 0] + shift, position[lit][:, 2]
    through_x = [(x > 0.2) & (x < 0.4), (x > 1.0) & (x < 1.2), (x > -0.6) & (x < -0.4)]
    through_z = [(z > -1.1) & (z < -0.8), (z > 0.0) & (z < 0.2)]
    assert (np.any(through_x, axis=0) & np.any(through_z, axis=0)).all()
