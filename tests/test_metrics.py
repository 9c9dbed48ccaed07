"""Shadow errors and the contact gap: small images by hand, and laws."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from experiments.metrics import ShadowErrors, contact_gap, shadow_errors, soft_shadow_errors
from experiments.truth.rays import Occluders, nearest_occluder_distance, trace_visibility
from shadows.lights import DirectionalLight

from .tools import assert_close

EVERYWHERE = np.ones((9, 10), bool)


def image_of(*rows):
    return np.array([[float(c) for c in row.split()] for row in rows])


def errors_by_loop(visibility, truth, surface):
    """Count pixel by pixel."""
    height, width = truth.shape
    counts = dict.fromkeys(["lit", "dark", "acne", "leak", "edge"], 0)
    inner = dict.fromkeys(["lit", "dark", "acne", "leak"], 0)
    soft = dict.fromkeys(["lit", "dark"], 0.0)
    for y in range(height):
        for x in range(width):
            if not surface[y, x]:
                continue
            window = slice(max(y - 3, 0), y + 4), slice(max(x - 3, 0), x + 4)
            interior = len(set(truth[window][surface[window]])) == 1
            kind, name = ("lit", "acne") if truth[y, x] else ("dark", "leak")
            distance = abs(float(truth[y, x]) - visibility[y, x])
            soft[kind] += distance
            counts["edge"] += not interior
            for tally in [counts, inner] if interior else [counts]:
                tally[kind] += 1
                tally[name] += distance >= 0.5
    share = lambda part, whole: part / whole if whole else 0.0
    acne = [share(t["acne"], t["lit"]) for t in (counts, inner)]
    leak = [share(t["leak"], t["dark"]) for t in (counts, inner)]
    error = [share(t["acne"] + t["leak"], t["lit"] + t["dark"]) for t in (counts, inner)]
    return ShadowErrors(
        acne=acne[0],
        leak=leak[0],
        error=error[0],
        acne_interior=acne[1],
        leak_interior=leak[1],
        error_interior=error[1],
        soft_acne=share(soft["lit"], counts["lit"]),
        soft_leak=share(soft["dark"], counts["dark"]),
        lit=counts["lit"],
        dark=counts["dark"],
        edge=counts["edge"],
    )


@st.composite
def cases(draw, values=st.floats(0, 1)):
    """Draw a visibility, a truth and a surface of one size, with large areas of one truth."""
    shape = draw(st.tuples(st.integers(1, 12), st.integers(1, 12)))
    truth = np.zeros(shape, bool)
    truth[:, : draw(st.integers(0, shape[1]))] = True
    truth ^= draw(arrays(bool, shape, fill=st.just(False)))
    visibility = draw(arrays(np.float64, shape, elements=values))
    return visibility, truth, draw(arrays(bool, shape, fill=st.just(True)))


# Known answers


def test_errors_of_a_small_image():
    """All within one window, so that every pixel is near the edge."""
    visibility = image_of("1 .4 .9 .2", "1 .6 .1 .7")
    truth = image_of("1 1 0 0", "1 1 0 0") > 0
    surface = image_of("1 1 1 1", "0 1 1 1") > 0
    errors = shadow_errors(visibility, truth, surface)
    assert_close(
        np.array(errors),
        np.array(
            [1 / 3, 2 / 4, 3 / 7, 0, 0, 0, (0.6 + 0.4) / 3, (0.9 + 0.2 + 0.1 + 0.7) / 4, 3, 4, 7]
        ),
    )


def test_interior_begins_four_pixels_from_the_edge():
    truth = np.zeros(EVERYWHERE.shape, bool)
    truth[:, :5] = True
    visibility = np.where(truth, 0.0, 1.0)
    visibility[:, 1] = 1.0
    visibility[:, 9] = 0.0
    visibility[:, 2:8] = 0.25
    errors = shadow_errors(visibility, truth, EVERYWHERE)
    assert errors.edge == 9 * 6
    assert (errors.acne, errors.leak, errors.error) == (4 / 5, 1 / 5, 5 / 10)
    inner = (errors.acne_interior, errors.leak_interior, errors.error_interior)
    assert inner == (1 / 2, 1 / 2, 2 / 4)


def test_pixels_without_surface_make_no_edge():
    truth = np.zeros(EVERYWHERE.shape, bool)
    truth[:, :5] = True
    errors = shadow_errors(np.ones(truth.shape), truth, truth)
    assert errors == ShadowErrors(0, 0, 0, 0, 0, 0, 0, 0, 45, 0, 0)


@pytest.mark.parametrize("undecided", [0.5, np.nan])
def test_undecided_pixels_are_wrong(undecided):
    truth = np.zeros(EVERYWHERE.shape, bool)
    truth[0, 0] = True
    errors = shadow_errors(np.full(truth.shape, undecided), truth, EVERYWHERE)
    soft = 1.0 if np.isnan(undecided) else 0.5
    assert errors[:3] == (1, 1, 1)
    assert (errors.soft_acne, errors.soft_leak) == (soft, soft)


def test_visibility_beyond_the_truth_is_no_error():
    truth = image_of("1 1 0 0") > 0
    errors = shadow_errors(image_of("1.5 0.5 -0.5 0.5"), truth, np.ones((1, 4), bool))
    assert (errors.soft_acne, errors.soft_leak) == (0.25, 0.25)


def test_nothing_to_share_gives_zero():
    nothing = np.zeros(EVERYWHERE.shape, bool)
    assert shadow_errors(np.full(nothing.shape, np.nan), nothing, nothing) == (0,) * 11
    assert contact_gap(np.ones(nothing.shape), nothing, nothing, np.ones(nothing.shape), 1.0) == 0


def test_gap_of_a_line_of_pixels():
    """Leaks at 1, 2, 4 and 5, one shadowed pixel at 3: the best threshold is behind 5."""
    dark, everywhere = np.zeros((1, 7), bool), np.ones((1, 7), bool)
    distance = image_of("6 2 1 4 3 inf 5")
    visibility = image_of("0 1 1 1 0 1 1")
    assert contact_gap(visibility, dark, everywhere, distance, 0.5) == 0.5 * (5 + 6) / 2
    assert contact_gap(np.zeros((1, 7)), dark, everywhere, distance, 0.5) == 0.0
    assert contact_gap(np.ones((1, 7)), dark, everywhere, distance, 0.5) == 0.5 * 6
    far_leak = image_of("1 0 0 0 0 0 0")
    assert contact_gap(far_leak, dark, everywhere, distance, 0.5) == 0.0


def test_gap_is_not_looked_for_within_three_pixels_of_lit_ones():
    truth = np.zeros((1, 12), bool)
    truth[0, 0] = True
    everywhere, distance = np.ones((1, 12), bool), np.arange(12.0)[None]
    for leaked, gap in ((3, 0.0), (5, 5.5)):
        visibility = (distance <= leaked).astype(float)
        assert contact_gap(visibility, truth, everywhere, distance, 1.0) == gap


def test_equal_distances_are_not_separated():
    dark, everywhere = np.zeros((1, 5), bool), np.ones((1, 5), bool)
    distance = image_of("1 1 1 2 3")
    assert contact_gap(image_of("1 1 0 0 0"), dark, everywhere, distance, 1.0) == 1.5
    assert contact_gap(image_of("1 0 0 0 0"), dark, everywhere, distance, 1.0) == 0.0


@pytest.mark.parametrize("thickness", [0.0, 0.02, 0.3])
@pytest.mark.parametrize("bias", [0.0, 0.01, 0.05, 0.1, 0.3])
@pytest.mark.parametrize("degrees", [20.0, 52.0, 80.0])
def test_gap_behind_a_wall(thickness, bias, degrees):
    """First-surface map: the ray leaves a wall ``(x + thickness) / sin`` from the pixel."""
    sine = np.sin(np.deg2rad(degrees))
    pixel = 0.45 / 449
    x = np.broadcast_to(np.linspace(-0.05, 0.4, 450), (20, 450))
    truth = (x < 0) | (x > 0.35)
    on_floor = np.where(truth, np.inf, x / sine)
    visibility = np.where(truth | (bias > (x + thickness) / sine), 1.0, 0.0)
    noise = np.random.default_rng(0).random(x.shape) < 0.02
    visibility = np.where(noise, 1 - visibility, visibility)
    gap = contact_gap(visibility, truth, np.ones(x.shape, bool), on_floor, np.full(x.shape, sine))
    expected = max(0.0, bias * sine - thickness)
    assert abs(gap - expected) <= (0.6 * pixel if expected else 0.0)  # measured 0.49


def test_gap_from_traced_distances():
    """A thin wall over a floor; a bias along the ray hides what is nearer than it."""
    positions = np.array([[-9.0, 0, -9], [-9, 0, 9], [9, 0, 9], [9, 0, -9]])
    wall = np.array([[0.0, 0, -5], [0, 0, 5], [0, 0.5, 5], [0, 0.5, -5]])
    faces = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]])
    occluders = Occluders(np.concatenate([positions, wall]), faces)
    to_light = np.array([-0.8, 0.6, 0.0])
    x, z = np.meshgrid(np.linspace(-0.2, 0.8, 400), np.linspace(0, 0.1, 9))
    points = np.stack([x, np.zeros_like(x), z], axis=-1)
    normals = np.broadcast_to([0.0, 1.0, 0.0], points.shape)
    image = (points, normals, (x > z).astype(np.int32), DirectionalLight(to_light), occluders)
    truth, distance = trace_visibility(*image), nearest_occluder_distance(*image)
    visibility = np.where(truth | (distance < 0.25), 1.0, 0.0)
    gap = contact_gap(visibility, truth, np.ones(x.shape, bool), distance, 0.8)
    assert abs(gap - 0.25 * 0.8) <= 0.5 / 399  # half a pixel, measured 0.3


def test_soft_errors_of_a_small_image():
    visibility = image_of("1 .5 .2 0", ".3 .9 0 .1")
    truth = image_of("1 .75 0 0", ".1 1 .5 .4")
    surface = image_of("1 1 1 1", "1 1 0 1") > 0
    errors = soft_shadow_errors(visibility, truth, surface)
    assert (errors.surface, errors.penumbra) == (7, 3)
    squares = np.array([0.25, 0.2, 0.2, 0.1, 0.3]) ** 2
    assert_close(
        np.array(errors[:4]),
        np.array(
            [
                (0.25 + 0.1 + 0.3) / 7,
                (0.2 + 0.2) / 7,
                np.sqrt(squares.sum() / 7),
                np.sqrt(squares[[0, 2, 4]].sum() / 3),
            ]
        ),
    )


def test_nothing_seen_has_no_soft_errors_and_nan_is_as_wrong_as_can_be():
    truth = np.full((3, 4), 0.5)
    assert soft_shadow_errors(truth, truth, truth > 1) == (0,) * 6
    errors = soft_shadow_errors(np.full((3, 4), np.nan), truth, truth > 0)
    assert errors == (1, 1, 1, 1, 12, 12)


# Laws


@given(cases(), st.integers(0, 2**32 - 1))
def test_soft_errors_of_shares(case, seed):
    """What acne and leak add up to; the complement; the bounds of the root mean square."""
    visibility, _, surface = case
    truth = np.random.default_rng(seed).random(surface.shape).round(1)
    e = soft_shadow_errors(visibility, truth, surface)
    distance = np.abs(visibility - truth)[surface]
    mean = distance.mean() if surface.any() else 0.0
    assert_close(np.array(e.acne + e.leak), mean)
    assert mean <= e.rmse * (1 + 1e-12)
    assert e.rmse <= distance.max(initial=0) * (1 + 1e-12)
    assert e.penumbra == ((truth > 0) & (truth < 1) & surface).sum()
    c = soft_shadow_errors(1 - visibility, 1 - truth, surface)
    assert_close(np.array(c[:4]), np.array([e.leak, e.acne, e.rmse, e.rmse_penumbra]))


@given(cases())
def test_soft_errors_of_a_hard_truth_are_those_of_its_lit_and_dark_pixels(case):
    visibility, truth, surface = case
    soft = soft_shadow_errors(visibility, truth.astype(np.float64), surface)
    hard = shadow_errors(visibility, truth, surface)
    assert (soft.surface, soft.penumbra, soft.rmse_penumbra) == (hard.lit + hard.dark, 0, 0)
    assert_close(np.array(soft.acne * soft.surface), hard.soft_acne * hard.lit, ulps=256)
    assert_close(np.array(soft.leak * soft.surface), hard.soft_leak * hard.dark, ulps=256)


@given(cases())
def test_errors_against_a_loop(case):
    assert_close(np.array(shadow_errors(*case)), np.array(errors_by_loop(*case)))


@given(cases())
def test_mirrored_and_transposed_images_have_the_same_errors(case):
    errors = np.array(shadow_errors(*case))
    for change in (np.transpose, np.flipud, np.fliplr):
        assert_close(np.array(shadow_errors(*(change(a) for a in case))), errors)


@given(cases())
def test_complement_swaps_acne_and_leak(case):
    visibility, truth, surface = case
    e = shadow_errors(visibility, truth, surface)
    c = shadow_errors(1.0 - visibility, ~truth, surface)
    hard = (c.leak, c.acne, c.error, c.leak_interior, c.acne_interior, c.error_interior)
    assert_close(np.array(e[:6]), np.array(hard))
    assert_close(np.array(e[6:]), np.array([c.soft_leak, c.soft_acne, c.dark, c.lit, c.edge]))


@given(cases(st.sampled_from([0.0, 1.0])))
def test_hard_visibility_has_equal_hard_and_soft_errors_zero_iff_it_is_the_truth(case):
    visibility, truth, surface = case
    e = shadow_errors(visibility, truth, surface)
    assert (e.soft_acne, e.soft_leak) == (e.acne, e.leak)
    equal = np.array_equal((visibility > 0)[surface], truth[surface])
    assert (e.acne == 0 and e.leak == 0) == equal == (e.error == 0)
    assert shadow_errors(truth.astype(np.float32), truth, surface)[:8] == (0,) * 8


@given(cases(), st.integers(0, 2**32 - 1))
def test_gap_scales_with_lengths_and_does_not_see_the_order_of_pixels(case, seed):
    visibility, _, surface = case
    dark = np.zeros(surface.shape, bool)
    distance = np.random.default_rng(seed).random(surface.shape)
    gap = contact_gap(visibility, dark, surface, distance, 0.5)
    assert contact_gap(visibility, dark, surface, 4 * distance, 0.5) == 4 * gap
    assert contact_gap(visibility.T, dark.T, surface.T, distance.T, 0.5) == gap


# Errors


@pytest.mark.errors
def test_sizes_must_agree():
    image, other = np.zeros((3, 4)), np.zeros((4, 3), bool)
    same = np.zeros((3, 4), bool)
    with pytest.raises(ValueError, match=r"shadow_errors: .*'truth': \(4, 3\)"):
        shadow_errors(image, other, same)
    with pytest.raises(ValueError, match=r"^soft_shadow_errors: .*'truth': \(4, 3\)"):
        soft_shadow_errors(image, image.T, same)
    with pytest.raises(ValueError, match=r"contact_gap: .*'surface': \(4, 3\)"):
        contact_gap(image, same, other, image, 1.0)
    with pytest.raises(ValueError, match=r"`occluder_distance` \(3, 4\), got \(2, 4\)"):
        contact_gap(image, same, same, image[:2], 1.0)
    with pytest.raises(ValueError, match=r"`sin_angle` \(3, 4\), got \(4,\)"):
        contact_gap(image, same, same, image, image[0])
