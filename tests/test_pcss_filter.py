"""Penumbrae from one map: as wide as the law says, against the exact area light.

The scene is a half plane over a floor, in coordinates of the light: it shines down -z, from
far away or from a point over the edge at x = 0. A disc light of diameter ``light_size`` is
seen past a straight edge as a disc cut by a line, so its visibility is known exactly.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from shadows import (
    AdaptiveBias,
    BilinearFilter,
    CombinedBias,
    ConstantBias,
    HardCompare,
    PCFFilter,
    PCSSFilter,
    PointLight,
    ReceiverPlaneBias,
    SoftCompare,
    look_up,
    orthographic,
    receive,
    render_shadow_map,
)

from .test_filters import BLOCKED, look, random_map, random_places, receivers
from .tools import assert_close

SIZE = 512
LAMP = 4.0  # height of the point light
ROW = 0.013  # y of the line of points
PLACES = np.linspace(-1.0, 1.0, 4001)
QUADS = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]], np.int32)
FINE = {"taps": 64, "search_taps": 64, "widest": 64}


def share_of_disc(x):
    """Return the share of the unit disc left of a line at x."""
    x = np.clip(x, -1, 1)
    return 0.5 + (x * np.sqrt(1 - x * x) + np.arcsin(x)) / np.pi


def half_plane(height, slope):
    """A floor ``z = slope . (x, y)``, and over its half x < 0 a sheet at a height."""
    corners = np.array([[-2, -2], [2, -2], [2, 2], [-2, 2.0]])
    floor = np.column_stack([corners, corners @ slope])
    return np.concatenate([floor, np.column_stack([np.minimum(corners, [0, 2]), 4 * [height]])])


def parallel_view(positions):
    """A square map that looks down -z."""
    low, high = positions.min(axis=0), positions.max(axis=0)
    return orthographic(-2.0, 2.0, -2.0, 2.0, -high[2] - 0.5, -low[2] + 0.5)


def lamp_view(positions):
    return PointLight(np.array([0.0, 0.0, LAMP])).clip_from_world(positions)


@jax.jit
def _draw(positions, clip):
    return render_shadow_map(positions, QUADS, clip, map_size=SIZE)


@functools.partial(jax.jit, static_argnames="point")
def _locate(shadow_map, slope, point):
    """Points of the floor on a line across the edge's shadow."""
    x = jnp.asarray(PLACES, slope.dtype)
    place = jnp.stack([x, jnp.full_like(x, ROW), slope[0] * x + slope[1] * ROW], axis=-1)
    normal = jnp.stack([-slope[0], -slope[1], jnp.ones_like(slope[0])])
    normal = jnp.broadcast_to(normal / jnp.sqrt(jnp.sum(normal**2)), place.shape)
    towards = jnp.broadcast_to(jnp.array([0.0, 0.0, 1.0], x.dtype), place.shape)
    if point:
        towards = PointLight(jnp.array([0.0, 0.0, LAMP], x.dtype)).to_light(place)
    return receive(place, normal, towards, shadow_map.texel_from_world)


def edge_scene(height=1.0, slope=(0.0, 0.0), point=False, dtype=np.float64):
    """The map, and receivers across the edge's shadow."""
    positions = half_plane(height, np.asarray(slope))
    clip = (lamp_view if point else parallel_view)(positions)
    positions, slope, clip = (jnp.asarray(a, dtype) for a in (positions, slope, clip))
    shadow_map = _draw(positions, clip)
    return shadow_map, _locate(shadow_map, slope, point)


@jax.jit
def _look(shadow_map, receiver, filter, bias):
    moved = bias(receiver, filter.reach())
    return look_up(shadow_map, moved, filter=filter, compare=HardCompare())


def across_the_edge(filter, *, bias=AdaptiveBias(), **scene):
    """Visibility of points of the floor on a line across the edge's shadow."""
    return np.asarray(_look(*edge_scene(**scene), filter, bias), np.float64)


def truth(light_size, *, height=1.0, slope=(0.0, 0.0)):
    """Visibility of parallel light from a disc; ``light_size`` is its whole angle's tangent."""
    gap = height - slope[0] * PLACES - slope[1] * ROW
    return share_of_disc(2 * PLACES / (light_size * gap))


def width(visibility):
    """How far it is from 10 to 90 %."""
    return np.interp(0.9, visibility, PLACES) - np.interp(0.1, visibility, PLACES)


# Known answers: the law. Of a disc light's penumbra 69 % lie between 10 and 90 %.

MIDDLE = 0.6870  # share_of_disc(0.6870) = 0.9


@pytest.mark.parametrize(
    ("height", "light_size"), [(0.5, 0.2), (1.0, 0.1), (1.0, 0.2), (2.0, 0.1), (2.0, 0.2)]
)
@pytest.mark.parametrize("point", [True, False], ids=["point", "parallel"])
def test_width_of_the_penumbra(point, height, light_size):
    """``(d_R - d_B) w / d_B`` of a lamp, ``(d_R - d_B) w`` of parallel light; 3 to 50 texels."""
    lit = across_the_edge(PCSSFilter(light_size, **FINE), height=height, point=point)
    law = height * light_size / (LAMP - height if point else 1.0)
    assert np.all(np.diff(lit) >= -1e-12)
    assert width(lit) / MIDDLE == pytest.approx(law, rel=0.1)  # 1.04 to 1.065 of it measured


def test_width_of_the_penumbra_under_a_lamp_over_the_whole_range():
    """As the blocker rises to the lamp the penumbra widens without end."""
    heights = np.array([1.0, 2.0, 2.8])
    found = [width(across_the_edge(PCSSFilter(0.1, **FINE), height=h, point=True)) for h in heights]
    np.testing.assert_allclose(found, MIDDLE * 0.1 * heights / (LAMP - heights), rtol=0.1)


@pytest.mark.parametrize("bias", [AdaptiveBias(), ReceiverPlaneBias()], ids=["adaptive", "plane"])
@pytest.mark.parametrize("slope", [(0.5, 0.0), (-0.5, 0.0), (0.0, 1.0), (0.8, 0.5)])
def test_penumbra_on_a_slope(slope, bias):
    """The receiver's own surface blocks nothing, and its tilt changes no distance."""
    expected = truth(0.2, slope=slope)
    lit = across_the_edge(PCSSFilter(0.2, **FINE), slope=slope, bias=bias)
    assert np.abs(lit - expected).max() < 0.05  # measured 0.029
    assert width(lit) == pytest.approx(width(expected), rel=0.1)  # measured 1.05


def test_default_taps(dtype):
    lit = across_the_edge(PCSSFilter(0.1), dtype=dtype)
    expected = truth(0.1)
    assert width(lit) == pytest.approx(width(expected), rel=0.1)  # measured 0.99
    assert np.abs(lit - expected).max() < 0.1  # measured 0.064


def test_better_than_a_fixed_box_of_as_many_taps():
    """PCF 5x5 reads 36 texels; here 16 points search and 16 filter, four texels each at most."""
    slope = (0.9, 0.0)
    expected = truth(0.15, slope=slope)
    error = {
        filter: np.sqrt(np.mean((across_the_edge(filter, slope=slope) - expected) ** 2))
        for filter in (PCSSFilter(0.15), PCFFilter(2), PCFFilter(4))
    }
    pcss, *boxes = error.values()
    assert pcss < 0.3 * min(boxes), error  # measured 0.007, 0.049 and 0.031


@pytest.mark.parametrize("point", [True, False], ids=["point", "parallel"])
def test_light_and_shadow_away_from_the_edge(point):
    lit = across_the_edge(PCSSFilter(0.1), point=point)
    away = np.abs(PLACES) > 0.15
    assert_close(lit[away], (PLACES > 0)[away].astype(float), ulps=8)


def test_a_light_without_size_is_bilinear():
    shadow_map, receiver = random_map(), receivers(*random_places())
    expected = look(shadow_map, receiver, BilinearFilter(), HardCompare())
    assert_close(look(shadow_map, receiver, PCSSFilter(0.0), HardCompare()), expected, ulps=8)


@pytest.mark.parametrize("compare", [HardCompare(), SoftCompare(0.5)])
def test_without_blockers_all_is_lit(compare):
    cleared = BLOCKED._replace(depth=jnp.ones_like(BLOCKED.depth))
    receiver = receivers(*random_places())
    for filter in (PCSSFilter(0.3), PCSSFilter(0.3, blocker_softness=0.0)):
        assert_close(look(cleared, receiver, filter, compare), np.ones(400), ulps=0)


def test_outside_the_depths_of_the_map_is_lit():
    at = receivers(np.full(3, 5.0), np.full(3, 5.0), np.array([-0.01, 0.5, 1.01]))
    lit = look(BLOCKED, at, PCSSFilter(0.1), HardCompare())
    assert_close(lit[jnp.array([0, 2])], np.ones(2), ulps=0)
    assert float(lit[1]) < 0.5


# Laws


def test_widest_is_the_limit():
    """Also for the search: what it cannot reach casts no penumbra, but never jumps."""
    limit = PCSSFilter(0.4, taps=64, search_taps=64, widest=8)
    texel = 4.0 / SIZE
    expected = MIDDLE * 2 * 8 * texel
    assert width(across_the_edge(limit)) == pytest.approx(expected, rel=0.1)  # measured 1.04


def test_wider_lights_and_higher_blockers_cast_wider_penumbrae():
    sizes = [width(across_the_edge(PCSSFilter(size, **FINE))) for size in (0.05, 0.1, 0.2, 0.4)]
    heights = [
        width(across_the_edge(PCSSFilter(0.1, **FINE), height=height)) for height in (0.5, 1.0, 2.0)
    ]
    for widths in (sizes, heights):
        np.testing.assert_allclose(
            np.divide(widths[1:], widths[:-1]), 2.0, rtol=0.03
        )  # measured 2.00, 2.01


def test_a_soft_blocker_weight_is_near_the_hard_one():
    """Blockers far from the receiver count whole at any softness of a texel or so."""
    hard = across_the_edge(PCSSFilter(0.2, blocker_softness=0.0, **FINE))
    soft = across_the_edge(PCSSFilter(0.2, blocker_softness=1.0, **FINE))
    assert np.abs(hard - soft).max() < 1e-9  # measured 0


def test_a_constant_bias_takes_its_length_from_the_gap():
    """What is counted is the distance of the point that is compared."""
    moved = across_the_edge(
        PCSSFilter(0.2, **FINE), bias=CombinedBias((AdaptiveBias(), ConstantBias(0.25)))
    )
    low = across_the_edge(PCSSFilter(0.2, **FINE), height=0.75)
    assert width(moved) == pytest.approx(width(low), rel=0.01)  # measured 1.000


def test_what_is_read_depends_on_the_receivers_depth():
    assert PCSSFilter().reads_anew
    assert PCSSFilter(widest=5).reach() == 6


# Derivatives; those in every leaf are in test_filter_derivatives.


def test_a_fit_finds_the_light_s_size():
    """From the exact penumbra, by Gauss-Newton steps with the derivative; it is smooth enough."""
    scene = edge_scene()
    lit = lambda size: _look(*scene, PCSSFilter(size, **FINE), AdaptiveBias())
    step = jax.jit(lambda size: jax.jvp(lit, (size,), (jnp.ones_like(size),)))
    size = slope = jnp.asarray(0.08)
    for _ in range(10):
        value, slope = step(size)
        size = size + slope @ (truth(0.2) - value) / (slope @ slope)
    assert float(size) == pytest.approx(0.2, rel=0.1)  # 0.194 measured
    assert bool(jnp.isfinite(slope).all())


# Errors


@pytest.mark.errors
@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"light_size": -0.1}, "expected `light_size` of at least 0, got -0.1"),
        ({"light_size": float("nan")}, "expected `light_size` of at least 0, got nan"),
        ({"blocker_softness": -1}, "expected `blocker_softness` of at least 0, got -1"),
        ({"search_taps": 0}, "expected `search_taps` from 1 to 128, got 0"),
        ({"taps": 129}, "expected `taps` from 1 to 128, got 129"),
        ({"widest": 0}, "expected `widest` of at least 1, got 0"),
    ],
)
def test_illegal_options_are_named(options, says):
    with pytest.raises(ValueError, match=f"^PCSSFilter: {says}$"):
        PCSSFilter(**options)
