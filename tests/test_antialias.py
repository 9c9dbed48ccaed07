"""Images with coverage: against supersampled ones, under every layout, and their derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.rendering.prepare_scene import prepare_scene
from experiments.scenes import load_scene
from experiments.scenes.staging import placed
from shadows import (
    CubeLayout,
    MidpointBias,
    NeighborLayer,
    PointLight,
    ShadowMap,
    mesh_edges,
    read_texel,
    receive,
    render,
    render_shadow_map,
    render_surface,
    surface_coverage,
)
from tangentspace.shapes import box, merge, plane

SIZE = (64, 64)


@pytest.fixture(scope="module")
def scene():
    return prepare_scene(load_scene("thin-box"))


def color(scene, size, edges=None, **options):
    draw = jax.jit(
        lambda mesh, edges: (
            render(mesh, scene.camera, scene.lights, image_size=size, edges=edges, **options).color
        )
    )
    return np.asarray(draw(scene.mesh, edges))


def test_edges_come_nearer_to_many_samples(scene):
    """Of the error of one sample a pixel, at silhouettes and shadow edges, most is gone."""
    edges = mesh_edges(scene.mesh.positions, scene.mesh.faces)
    many = color(scene, (512, 512)).reshape(64, 8, 64, 8, 3).mean(axis=(1, 3))
    once = color(scene, SIZE, map_size=128)
    smooth = color(scene, SIZE, edges, map_size=128)
    rmse = lambda image: float(np.sqrt(np.mean((image - many) ** 2)))
    assert rmse(smooth) < 0.6 * rmse(once)
    assert smooth.min() >= once.min()
    assert smooth.max() <= once.max()


def test_maps_of_a_cube_have_derivatives_at_edges(scene):
    """Each map by itself, of two layers: a box and its shadow move, as differences tell."""
    light = PointLight(np.array([0.3, 1.9, 0.2], np.float32))
    mesh = merge(plane(2.0), placed(box((0.4, 0.3, 0.35)), (0.0, 0.7, 0.0)))
    edges = mesh_edges(mesh.positions, mesh.faces)
    moving = (mesh.positions[:, 1:2] > 1e-3).astype(np.float32) * np.float32([1, 0, 0])

    def mean(shift, edges, image_size=128, map_size=256):
        image = render(
            mesh._replace(positions=mesh.positions + shift * moving), scene.camera, light,
            image_size=(image_size, image_size), map_size=map_size, layout=CubeLayout(),
            bias=MidpointBias(), edges=edges,
        )  # fmt: skip
        return jnp.mean(image.color)

    zero, one = jnp.float32(0), jnp.float32(1)
    change = jax.jit(lambda edges: jax.jvp(lambda x: mean(x, edges), (zero,), (one,))[1])
    fine = jax.jit(lambda shift: mean(shift, None, 384, 512))
    difference = float(fine(0.04) - fine(-0.04)) / 0.08
    # With 64 pixels on a side, of which the box's creases are few, it is 28 % off.
    assert float(change(edges)) == pytest.approx(difference, rel=0.1)
    assert abs(float(change(None)) - difference) > 0.3 * abs(difference)


def test_a_map_without_edges_has_no_shares(scene):
    light = scene.lights[0]
    draw = lambda edges: render_shadow_map(
        scene.mesh.positions, scene.mesh.faces, light.clip_from_world(scene.mesh.positions),
        map_size=64, edges=edges,
    )  # fmt: skip
    plain, shared = draw(None), draw(mesh_edges(scene.mesh.positions, scene.mesh.faces))
    assert plain.neighbor is None
    assert shared.neighbor.share.shape == shared.depth.shape
    np.testing.assert_array_equal(plain.depth, shared.depth)
    np.testing.assert_allclose(plain.clip_from_world, shared.clip_from_world, rtol=1e-6, atol=1e-6)


def test_the_image_is_blended_by_its_coverage(scene):
    edges = mesh_edges(scene.mesh.positions, scene.mesh.faces)
    surface = render_surface(scene.mesh, scene.camera, image_size=SIZE)
    found = surface_coverage(scene.mesh, scene.camera, surface, edges)
    image = render(
        scene.mesh, scene.camera, scene.lights, image_size=SIZE, map_size=32, edges=edges
    )
    np.testing.assert_array_equal(image.coverage.share, found.share)
    # Of the boxes, edges between two sides that are seen count too, as their look changes there.
    smooth = scene.mesh._replace(normals=np.zeros_like(scene.mesh.normals))
    outlines = surface_coverage(smooth, scene.camera, surface, edges)
    assert np.sum(np.asarray(found.share) < 1) > 1.05 * np.sum(np.asarray(outlines.share) < 1)
    assert 0.01 < np.mean(np.asarray(found.share) < 1) < 0.5
    assert (
        render(scene.mesh, scene.camera, scene.lights, image_size=SIZE, map_size=32).coverage
        is None
    )


def test_a_texel_is_read_as_two_layers_with_parts_of_its_weight():
    depth, share, other = (jnp.full((4, 4), value) for value in (0.25, 0.75, 0.5))
    receiver = receive(
        jnp.array([[0.1, 0.2, 0.0]]), jnp.array([[0.0, 0, 1]]), jnp.array([[0.0, 0, 1]]),
        ShadowMap(depth, jnp.eye(4)).texel_from_world,
    )  # fmt: skip
    place = jnp.array([1.0]), jnp.array([2.0]), jnp.array([0.5])
    (whole,) = read_texel(ShadowMap(depth, jnp.eye(4)), receiver, *place)
    assert (whole.stored, whole.weight) == (0.25, 0.5)
    near, far = read_texel(
        ShadowMap(depth, jnp.eye(4), neighbor=NeighborLayer(share, other)), receiver, *place
    )
    assert (near.stored, near.weight) == (0.25, 0.375)
    assert (far.stored, far.weight) == (0.5, 0.125)
    assert near.across == far.across == whole.across
