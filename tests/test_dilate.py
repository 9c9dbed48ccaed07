"""Spreading values into gutters, against a search over all texels."""

import numpy as np
import pytest

from experiments.baking.dilate import dilate


def numbered(height, width):
    """Return texels that tell their place."""
    return np.stack(np.mgrid[:height, :width], axis=-1).astype(np.float32)


def around(a, b, size):
    """Return the distance of two places along an axis that closes on itself."""
    return np.minimum((a - b) % size, (b - a) % size)


def distances_squared(known):
    """Return squared distances from every texel to every known one; the texture repeats."""
    height, width = known.shape
    rows, columns = np.mgrid[:height, :width]
    there = np.argwhere(known)
    down = around(rows[..., None], there[:, 0], height)
    right = around(columns[..., None], there[:, 1], width)
    return down**2 + right**2


@pytest.mark.parametrize("margin", [1, 2, 5, 40])
@pytest.mark.parametrize(("height", "width", "share"), [(24, 17, 0.03), (9, 30, 0.2), (1, 12, 0.1)])
def test_every_texel_gets_a_nearest_one_up_to_the_margin(margin, height, width, share):
    known = np.random.default_rng(0).uniform(size=(height, width)) < share
    texels = np.where(known[..., None], numbered(height, width), -1).astype(np.float32)
    spread, filled = dilate(texels, known, margin=margin)
    squared = distances_squared(known)
    np.testing.assert_array_equal(filled, squared.min(axis=-1) <= margin**2)
    np.testing.assert_array_equal(spread[~filled], texels[~filled])
    rows, columns = np.mgrid[:height, :width]
    source = spread[filled].astype(int)
    assert known[tuple(source.T)].all()
    down = around(rows[filled], source[:, 0], height)
    right = around(columns[filled], source[:, 1], width)
    np.testing.assert_array_equal(down**2 + right**2, squared.min(axis=-1)[filled])


def test_one_texel_becomes_a_disc_that_goes_on_behind_the_edges():
    known = np.zeros((8, 10), bool)
    known[0, 9] = True
    texels = np.zeros((8, 10, 3), np.float32)
    texels[0, 9] = [0.25, 0.5, 1.0]
    spread, filled = dilate(texels, known, margin=2)
    assert filled.sum() == 13  # of radius 2: 1 + 3 + 5 + 3 + 1
    assert filled[7, 9]
    assert filled[0, 1]
    assert not filled[2, 0]
    np.testing.assert_array_equal(spread[filled], [[0.25, 0.5, 1.0]] * 13)
    assert not spread[~filled].any()


@pytest.mark.parametrize("known", [np.ones((4, 5), bool), np.zeros((4, 5), bool)])
def test_nothing_to_fill_or_nothing_to_fill_with(known):
    spread, filled = dilate(numbered(4, 5), known, margin=3)
    np.testing.assert_array_equal(spread, numbered(4, 5))
    np.testing.assert_array_equal(filled, known)


def test_no_margin_changes_nothing():
    known = np.arange(20).reshape(4, 5) % 3 == 0
    spread, filled = dilate(numbered(4, 5), known, margin=0)
    np.testing.assert_array_equal(spread, numbered(4, 5))
    np.testing.assert_array_equal(filled, known)


def test_values_of_unknown_texels_are_not_read():
    known = np.zeros((3, 3), bool)
    known[1, 1] = True
    texels = np.full((3, 3, 3), np.nan, np.float32)
    texels[1, 1] = 1
    spread, _ = dilate(texels, known, margin=2)
    np.testing.assert_array_equal(spread, np.ones((3, 3, 3)))


@pytest.mark.errors
@pytest.mark.parametrize(
    ("known", "margin", "said"),
    [(np.ones((2, 3), bool), 1, r"\(2, 2\), got \(2, 3\)"), (np.ones((2, 2), bool), -1, "got -1")],
)
def test_wrong_arguments(known, margin, said):
    with pytest.raises(ValueError, match=rf"^dilate: .*{said}"):
        dilate(np.zeros((2, 2, 3), np.float32), known, margin=margin)
