"""Normal maps: encodings, the flat map, height fields, blending, slopes, and derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from jax.test_util import check_grads

from tangentspace.normal_map import (
    blend_normals,
    decode_normals,
    encode_normals,
    flip_green,
    normals_from_heights,
    normals_from_slopes,
    quantize,
    rebuild_z,
    scale_normals,
    slopes_from_normals,
    snap_flat,
)
from tangentspace.texture import clamp, mirror, repeat

from .tools import assert_close

FLAT, FLAT_TEXEL = np.array([0.0, 0.0, 1.0]), np.array([0.5, 0.5, 1.0])


def unit(vectors):
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def normals(count=200, dtype=np.float64):
    """Unit normals that look up, some of them grazing."""
    vectors = np.random.default_rng(0).normal(size=(count, 3))
    vectors[:, 2] = np.abs(vectors[:, 2]) + 0.05
    return unit(vectors).astype(dtype)


def tilt(vectors):
    """Angle to (0, 0, 1) in degrees."""
    x, y, z = np.moveaxis(np.asarray(vectors, np.float64), -1, 0)
    return np.rad2deg(np.arctan2(np.hypot(x, y), z))


def rotated(axis_angles, vectors):
    """Rodrigues' formula, for one rotation per vector."""
    angles = np.linalg.norm(axis_angles, axis=-1, keepdims=True)
    axes = axis_angles / np.where(angles == 0, 1, angles)
    along = np.sum(axes * vectors, axis=-1, keepdims=True) * axes
    turned = np.cos(angles) * (vectors - along) + np.sin(angles) * np.cross(axes, vectors)
    return along + turned


# Encoding


def test_a_flat_map_is_exactly_flat(dtype):
    decoded = decode_normals(FLAT_TEXEL.astype(dtype))
    assert decoded.dtype == dtype
    assert_close(decoded, FLAT, ulps=0)
    assert_close(encode_normals(FLAT.astype(dtype)), FLAT_TEXEL, ulps=0)


def test_encoding_maps_the_axes_to_colors():
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    expected = [[1, 0.5, 0.5], [0.5, 1, 0.5], [0.5, 0.5, 1]]
    expected += [[0, 0.5, 0.5], [0.5, 0, 0.5], [0.5, 0.5, 0]]
    assert_close(encode_normals(axes), expected, ulps=0)
    assert_close(decode_normals(np.array(expected)), axes, ulps=0)


def test_decoding_keeps_lengths():
    """So that filtering before and after decoding is the same."""
    texels = np.random.default_rng(0).uniform(0, 1, (2, 50, 3))
    assert_close(decode_normals(texels.mean(axis=0)), np.mean(decode_normals(texels), axis=0))
    assert float(jnp.abs((decode_normals(texels) ** 2).sum(-1) - 1).max()) > 0.5


@pytest.mark.parametrize(("bits", "degrees"), [(8, 0.318), (16, 0.00124)])
def test_rounding_tilts_a_flat_map(bits, degrees, dtype):
    levels = 2**bits - 1
    stored = quantize(FLAT_TEXEL.astype(dtype), bits=bits)
    assert stored.dtype == dtype
    assert_close(stored * levels, [(levels + 1) / 2, (levels + 1) / 2, levels], ulps=8)
    decoded = decode_normals(stored)
    assert_close(decoded, [1 / levels, 1 / levels, 1], ulps=4)
    assert abs(tilt(decoded) - degrees) < 0.005 * degrees
    assert_close(decode_normals(snap_flat(stored, bits=bits)), FLAT, ulps=0)


@pytest.mark.parametrize("bits", [8, 16])
def test_every_level_is_kept(bits, dtype):
    levels = (np.arange(2**bits) / (2**bits - 1)).astype(dtype)
    assert_close(quantize(levels, bits=bits), levels, ulps=1)
    snapped = np.asarray(snap_flat(levels, bits=bits))
    middle = 2 ** (bits - 1)
    assert (snapped[middle - 1 : middle + 1] == 0.5).all()
    others = np.delete(np.arange(2**bits), [middle - 1, middle])
    assert (snapped[others] == levels[others]).all()


@pytest.mark.parametrize("bits", [1, 8, 16])
def test_rounding_moves_by_half_a_level_at_most(bits):
    values = np.random.default_rng(0).uniform(-0.2, 1.2, 1000)
    rounded = np.asarray(quantize(values, bits=bits))
    levels = 2**bits - 1
    assert np.abs(rounded - np.clip(values, 0, 1)).max() <= 0.5001 / levels
    assert_close(rounded * levels, np.round(rounded * levels))
    assert np.abs(snap_flat(rounded, bits=bits) - rounded).max() <= 0.5001 / levels


def test_a_quantized_map_is_good_to_the_size_of_its_levels():
    exact = normals(2000)
    for bits, degrees in ((8, 0.4), (16, 0.0016)):  # measured 0.37 and 0.0014
        stored = unit(np.asarray(decode_normals(quantize(encode_normals(exact), bits=bits))))
        angles = np.rad2deg(np.arccos(np.clip((stored * exact).sum(-1), -1, 1)))
        assert 0.2 * degrees < angles.max() < degrees


def test_flipping_green_mirrors_the_bumps_upside_down():
    heights = np.random.default_rng(0).normal(size=(6, 8))
    assert_close(flip_green(np.array([0.1, 0.2, 0.9])), [0.1, -0.2, 0.9], ulps=0)
    upside_down = np.asarray(normals_from_heights(heights[::-1], scale=0.1))[::-1]
    assert_close(flip_green(normals_from_heights(heights, scale=0.1)), upside_down)
    assert_close(flip_green(flip_green(normals())), normals(), ulps=0)


def test_two_channels_are_enough(dtype):
    exact = normals(dtype=dtype)
    rebuilt = rebuild_z(exact[:, :2])
    assert rebuilt.dtype == dtype
    assert_close(rebuilt, exact, ulps=32)  # measured 10: z is small where x and y are large
    assert_close(rebuild_z(decode_normals(FLAT_TEXEL[:2].astype(dtype))), FLAT, ulps=0)


def test_beyond_the_unit_circle_z_is_zero():
    xy = np.array([[1.0, 0.0], [0.6, 0.8], [0.9, -0.9], [-3.0, 0.0]])
    assert_close(rebuild_z(xy), np.column_stack([xy, np.zeros(4)]), ulps=0)
    for derivative in (jax.jacrev, jax.jacfwd):
        jacobian = jax.vmap(derivative(rebuild_z))(jnp.asarray(xy))
        assert_close(jacobian[:, 2], np.zeros((4, 2)), ulps=0)
        assert_close(jacobian[:, :2], np.broadcast_to(np.eye(2), (4, 2, 2)), ulps=0)


# From heights


def waves(height, width, dtype=np.float64):
    """A height field over the unit square, and its slopes, at the texels' centres."""
    u = ((np.arange(width) + 0.5) / width)[None, :]
    v = (1 - (np.arange(height) + 0.5) / height)[:, None]
    a, b = 2 * np.pi * u, 4 * np.pi * v
    slopes = [2 * np.pi * np.cos(a) * np.cos(b), -4 * np.pi * np.sin(a) * np.sin(b)]
    heights = np.sin(a) * np.cos(b)
    return heights.astype(dtype), np.stack(np.broadcast_arrays(*slopes), axis=-1)


def test_normals_of_waves(dtype):
    """The unit of heights is the side of the image; the error falls with the square."""
    errors = []
    for size in ((32, 48), (64, 96)):
        heights, slopes = waves(*size, dtype)
        mapped = normals_from_heights(heights, scale=0.05)
        assert mapped.dtype == dtype
        exact = unit(np.concatenate([-0.05 * slopes, np.ones((*size, 1))], axis=-1))
        errors.append(np.abs(mapped - exact).max())
    assert errors[1] < 0.0025  # measured 0.0021
    assert 3.8 < errors[0] / errors[1] < 4.2


def test_normals_of_a_ramp_lean_downhill():
    """Higher to the right and to the top: the normals lean to the left and to the bottom."""
    u, v = np.meshgrid((np.arange(8) + 0.5) / 8, 1 - (np.arange(4) + 0.5) / 4)
    mapped = normals_from_heights(0.3 * u + 0.2 * v, scale=2.0)
    expected = unit(np.array([-0.6, -0.4, 1.0]))
    assert_close(mapped[1:-1, 1:-1], np.broadcast_to(expected, (2, 6, 3)))


@pytest.mark.parametrize(
    ("wrap", "first", "last"),
    [(repeat, -1.5, -1.5), (clamp, 0.5, 0.5), (mirror, 0.5, 0.5)],
)
def test_borders_follow_the_wrap(wrap, first, last):
    """Of the heights 0, 1, 2, 3, 4 from left to right, and from top to bottom."""
    ramp = np.arange(5.0)
    for heights, axis, sign in ((ramp[None, :], 0, 1), (ramp[:, None], 1, -1)):
        mapped = normals_from_heights(heights, scale=0.2, wrap_u=wrap, wrap_v=wrap)
        slopes = np.asarray(slopes_from_normals(mapped).slopes)
        along = sign * slopes[..., axis].ravel()
        assert_close(along, [first, 1, 1, 1, last])
        assert_close(slopes[..., 1 - axis], np.zeros_like(slopes[..., 0]), ulps=0)


@pytest.mark.parametrize("wrap", [repeat, clamp, mirror])
@pytest.mark.parametrize("size", [(1, 1), (2, 2), (1, 5), (3, 1)])
def test_level_ground_is_exactly_flat(size, wrap, dtype):
    heights = np.full(size, 0.7, dtype)
    mapped = normals_from_heights(heights, scale=3.0, wrap_u=wrap, wrap_v=wrap)
    assert_close(mapped, np.broadcast_to(FLAT, (*size, 3)), ulps=0)


# Blending, strength


def test_a_flat_base_gives_the_detail_and_a_flat_detail_the_base(dtype):
    """Within 1e-7, and the first to the last bit."""
    some = normals(2000, dtype=dtype)
    flat = np.broadcast_to(FLAT.astype(dtype), some.shape)
    assert_close(blend_normals(flat, some), some, ulps=0)
    assert float(jnp.abs(blend_normals(some, flat) - some).max()) <= 1e-7  # measured 6e-8


def test_blending_turns_the_detail_with_the_base(dtype):
    """By the shortest rotation from (0, 0, 1) to the base."""
    base, detail = normals(500), normals(1000)[500:]
    axes = np.cross(FLAT, base)
    rotation = axes / np.linalg.norm(axes, axis=-1, keepdims=True) * np.deg2rad(tilt(base))[:, None]
    blended = blend_normals(base.astype(dtype), detail.astype(dtype))
    assert blended.dtype == dtype
    assert_close(blended, rotated(rotation, detail), ulps=16)  # measured 5
    assert_close((blended**2).sum(axis=-1), np.ones(500), ulps=16)


def test_strength():
    some = normals()
    assert_close(scale_normals(some, 1.0), some, ulps=4)
    assert_close(scale_normals(some, 0.0), np.broadcast_to(FLAT, some.shape), ulps=4)
    assert_close(scale_normals(some, -1.0), some * [-1, -1, 1], ulps=4)
    half = slopes_from_normals(scale_normals(some, 0.5)).slopes
    assert_close(half, 0.5 * slopes_from_normals(some).slopes)
    assert_close(scale_normals(3 * some, 0.7), scale_normals(some, 0.7), ulps=8)
    each = scale_normals(some, np.linspace(0, 1, 200))
    assert_close(each[100], scale_normals(some[100], 100 / 199), ulps=8)


def test_a_flat_map_stays_flat_at_any_strength(dtype):
    for strength in (0.0, 0.3, 1.0, 50.0):
        assert_close(scale_normals(FLAT.astype(dtype), strength), FLAT, ulps=0)


# Slopes


def test_slopes_are_those_of_the_height_field(dtype):
    slopes, valid = slopes_from_normals(unit(np.array([-0.3, 0.5, 1.0])).astype(dtype))
    assert slopes.dtype == dtype
    assert bool(valid)
    assert_close(slopes, [0.3, -0.5], ulps=4)
    assert_close(normals_from_slopes(np.zeros(2, dtype)), FLAT, ulps=0)


@given(p=st.floats(-1e4, 1e4), q=st.floats(-1e4, 1e4))
def test_slopes_there_and_back(p, q):
    slopes = np.array([p, q])
    mapped = normals_from_slopes(slopes)
    assert_close((mapped**2).sum(), 1.0, ulps=4)
    back, valid = slopes_from_normals(mapped)
    assert bool(valid)
    assert_close(back, slopes, ulps=4)


def test_normals_that_do_not_look_up_are_flagged():
    odd = np.array([[1.0, 0, 0], [0.6, 0, -0.8], [0, 0, -1], [0, 0, 0], [1, 0, 1e-20], FLAT])
    slopes, valid = slopes_from_normals(odd)
    assert valid.tolist() == [False] * 5 + [True]
    assert_close(slopes, np.zeros((6, 2)), ulps=0)
    for derivative in (jax.jacrev, jax.jacfwd):
        jacobian = derivative(lambda n: slopes_from_normals(n).slopes.sum(axis=0))(jnp.asarray(odd))
        assert_close(jacobian[:, :5], np.zeros((2, 5, 3)), ulps=0)
        assert_close(jacobian[:, 5], [[-1.0, 0, 0], [0, -1, 0]], ulps=0)


# Derivatives

GENERIC = {
    "decode": (decode_normals, (normals(5),)),
    "encode": (encode_normals, (normals(5),)),
    "snap": (snap_flat, (np.random.default_rng(1).uniform(0.6, 0.9, (5, 3)),)),
    "flip": (flip_green, (normals(5),)),
    "rebuild": (rebuild_z, (np.random.default_rng(1).uniform(-0.6, 0.6, (5, 2)),)),
    "heights": (
        lambda heights, scale: normals_from_heights(heights, scale=scale, wrap_v=clamp),
        (np.random.default_rng(1).normal(size=(4, 5)), np.array(0.1)),
    ),
    "blend": (blend_normals, (normals(5), normals(10)[5:])),
    "scale": (scale_normals, (normals(5), np.linspace(0.2, 1.4, 5))),
    "to slopes": (lambda n: slopes_from_normals(n).slopes, (unit(normals(5) + FLAT),)),
    "from slopes": (normals_from_slopes, (np.random.default_rng(1).normal(size=(5, 2)),)),
}


@pytest.mark.parametrize("case", GENERIC)
def test_derivatives(case):
    function, arguments = GENERIC[case]
    check_grads(jax.jit(function), arguments, 1, ("fwd", "rev"))


def test_rounding_has_no_derivative():
    slope = jax.grad(lambda c: quantize(c, bits=8).sum())(jnp.linspace(-0.1, 1.1, 20))
    assert_close(slope, np.zeros(20), ulps=0)


@pytest.mark.parametrize("derivative", [jax.jacrev, jax.jacfwd])
def test_a_base_that_looks_straight_down(derivative):
    """There is no shortest rotation: a promised value, and nothing that is not finite."""
    base, detail = -jnp.asarray(FLAT), jnp.asarray(unit(np.array([0.3, 0.4, 1.0])))
    assert_close(blend_normals(base, detail), detail * np.array([1, 1, -1]), ulps=0)
    in_base, in_detail = derivative(blend_normals, argnums=(0, 1))(base, detail)
    assert_close(in_base, np.zeros((3, 3)), ulps=0)
    assert_close(in_detail, np.diag([1.0, 1.0, -1.0]), ulps=0)


@pytest.mark.parametrize("derivative", [jax.jacrev, jax.jacfwd])
def test_nothing_left_to_normalize(derivative):
    sideways = jnp.asarray([[1.0, 0.0, 0.0], [0.6, 0.0, 0.8]])
    assert_close(scale_normals(sideways, 0.0), [[0, 0, 0], FLAT], ulps=0)
    jacobian = derivative(lambda n, s: scale_normals(n, s).sum(axis=0), argnums=(0, 1))
    in_normals, in_strength = jacobian(sideways, jnp.asarray(0.0))
    assert_close(in_normals[:, 0], np.zeros((3, 3)), ulps=0)
    assert_close(in_strength, [0.75, 0.0, 0.0], ulps=4)  # of the second alone


# Errors

NOT_THREE = {
    "flip_green": lambda bad: flip_green(bad),
    "blend_normals": lambda bad: blend_normals(bad, FLAT),
    "scale_normals": lambda bad: scale_normals(bad, 1.0),
    "slopes_from_normals": lambda bad: slopes_from_normals(bad),
}


@pytest.mark.errors
@pytest.mark.parametrize("name", NOT_THREE)
def test_vectors_have_three_components(name):
    for bad in (np.zeros((4, 2)), np.zeros(())):
        with pytest.raises(
            ValueError, match=rf"^{name}: expected `.*` of shape \(\.\.\., 3\), got"
        ):
            NOT_THREE[name](bad)
    with pytest.raises(ValueError, match=r"^blend_normals: expected `detail` of .*got \(2,\)"):
        blend_normals(FLAT, np.zeros(2))


@pytest.mark.errors
def test_other_wrong_arguments_are_refused():
    for bits in (0, 17):
        for function in (quantize, snap_flat):
            name = function.__name__
            with pytest.raises(ValueError, match=f"^{name}: expected `bits` from 1 to 16, got"):
                function(FLAT_TEXEL, bits=bits)
    with pytest.raises(ValueError, match=r"^rebuild_z: expected `xy` of shape \(\.\.\., 2\), got"):
        rebuild_z(FLAT)
    with pytest.raises(ValueError, match=r"^normals_from_slopes: expected `slopes`.*got \(3,\)"):
        normals_from_slopes(FLAT)
    for shape in ((4, 4, 1), (0, 4)):
        with pytest.raises(ValueError, match=r"^normals_from_heights: expected `heights`.*got"):
            normals_from_heights(np.zeros(shape))
