"""Materials as pytrees, and the lookup that their textures share."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from tangentspace.material import Material, MippedTexture, look_up_texture, with_mips
from tangentspace.texture import Texture, clamp, mirror, repeat

from .tools import assert_close

TEXELS = np.random.default_rng(0).random((4, 4, 3))
CENTERS = (np.arange(4) + 0.5) / 4

look_up = eqx.filter_jit(look_up_texture)
mips_of = eqx.filter_jit(with_mips)


def uvs_of_texels():
    """The texels' centres, v upwards, row 0 on top."""
    return np.stack(np.meshgrid(CENTERS, CENTERS[::-1]), axis=-1)


def footprint(texels, axis):
    """Steps of so many texels, the same everywhere."""
    return np.broadcast_to(np.eye(2)[axis] * texels / 4, (4, 4, 2))


def test_a_texture_without_mips_does_not_ask_for_a_footprint(dtype):
    texture = Texture(TEXELS.astype(dtype))
    uvs = uvs_of_texels().astype(dtype)
    nan = np.full_like(uvs, np.nan)
    found = look_up(texture, uvs, nan, nan)
    assert found.dtype == dtype
    assert_close(found, TEXELS.astype(dtype), ulps=2)


def test_mips_are_asked_by_the_longer_footprint(dtype):
    """One texel: the image; two, in either direction: the mean of 2x2; from four on: of all."""
    texture = mips_of(Texture(TEXELS.astype(dtype)))
    uvs = uvs_of_texels().astype(dtype)
    halves = TEXELS.reshape(2, 2, 2, 2, 3).mean(axis=(1, 3))
    middles = np.stack(np.meshgrid([0.25, 0.75], [0.75, 0.25]), axis=-1).astype(dtype)
    steps = {
        size: [footprint(size if axis == k else 0.3, k).astype(dtype) for k in (0, 1)]
        for axis, size in ((0, 1.0), (0, 2.0), (1, 2.0), (0, 4.0), (1, 9.0))
    }
    for size, (right, down) in steps.items():
        if size == 2.0:
            right, down = (step[:2, :2] for step in (right, down))
            assert_close(look_up(texture, middles, right, down), halves, ulps=4)
        elif size == 1.0:
            assert_close(look_up(texture, uvs, right, down), TEXELS.astype(dtype), ulps=4)
        else:
            mean = np.broadcast_to(TEXELS.mean(axis=(0, 1)), TEXELS.shape)
            assert_close(look_up(texture, uvs, right, down), mean, ulps=4)


@pytest.mark.parametrize("mipped", [False, True])
@pytest.mark.parametrize("wrap", [repeat, clamp, mirror])
def test_each_border_keeps_its_rule(wrap, mipped):
    """Two and a half texels beyond the right border, and above the upper one."""
    beyond = {repeat: 2, clamp: 3, mirror: 1}[wrap]
    other = clamp if wrap is repeat else repeat
    still = np.zeros(2)
    u_texture, v_texture = (
        with_mips(texture) if mipped else texture
        for texture in (Texture(TEXELS, wrap, other), Texture(TEXELS, other, wrap))
    )
    assert isinstance(u_texture, MippedTexture if mipped else Texture)
    assert (u_texture.wrap_u, u_texture.wrap_v) == (wrap, other)
    right = look_up(u_texture, np.array([1 + 2.5 / 4, CENTERS[3]]), still, still)
    assert_close(right, TEXELS[0, beyond])
    above = look_up(v_texture, np.array([CENTERS[0], 1 + 2.5 / 4]), still, still)
    assert_close(above, TEXELS[3 - beyond, 0])


def test_mips_are_differentiable_in_the_texels():
    uvs, right, down = uvs_of_texels() + 0.03, footprint(1.7, 0), footprint(0.4, 1)
    of = jax.jit(lambda texels: look_up_texture(with_mips(Texture(texels)), uvs, right, down))
    check_grads(of, (TEXELS,), 1, ("fwd", "rev"))
    gradient = jax.grad(lambda texels: of(texels).sum())(TEXELS)
    assert_close(gradient.sum(axis=(0, 1)), np.full(3, 16.0))  # each lookup's weights sum to 1


def test_a_material_has_nothing_unless_told():
    plain = Material()
    assert jax.tree.leaves(plain) == [1.0]  # the scale of heights that it has not
    options = {f.name: getattr(plain, f.name) for f in dataclasses.fields(Material)}
    assert options.pop("height_scale") == 1.0
    assert set(options.values()) == {None}


def test_materials_are_pytrees_whose_numbers_are_leaves():
    texture = Texture(TEXELS, clamp, mirror)
    material = Material((0.1, 0.2, 0.3), texture, mips_of(texture), 0.5, None, 2.0, 0.25)
    assert len(jax.tree.leaves(material)) == 3 + 1 + 1 + 1 + 1 + 1
    doubled = jax.tree.map(lambda x: 2 * x, material)
    assert doubled.base_color == (0.2, 0.4, 0.6)
    assert (doubled.base_color_texture.wrap_u, doubled.normal_texture.wrap_v) == (clamp, mirror)
    assert_close(doubled.normal_texture.mips.levels[0], 2 * TEXELS, ulps=2)
    assert jax.tree.structure(material) == jax.tree.structure(doubled)
    other = dataclasses.replace(material, base_color_texture=Texture(TEXELS, repeat, mirror))
    assert jax.tree.structure(material) != jax.tree.structure(other)  # compiled anew


def test_materials_serve_as_arguments_of_compiled_functions():
    traces = []

    @jax.jit
    def brightness(material):
        traces.append(material)
        return jnp.asarray(material.base_color).sum() * material.reflectivity

    color = np.array([1.0, 2.0, 3.0])
    assert_close(brightness(Material(color, reflectivity=0.5)), 3.0, ulps=2)
    assert_close(brightness(Material(2 * color, reflectivity=0.25)), 3.0, ulps=2)
    assert len(traces) == 1
