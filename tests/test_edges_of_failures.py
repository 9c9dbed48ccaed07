"""Edges on the scenes of the failure catalogue: values in range, all derivatives finite."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.scenes import load_scene
from experiments.stability.views import (
    FACES,
    IMAGE,
    MAP,
    VERTICES,
    lightings,
    on_device,
    padded,
    precision,
    quick,
)
from shadows import (
    AnalyticBias,
    CombinedBias,
    MeshEdges,
    PCFFilter,
    SoftCompare,
    VSMFilter,
    mesh_edges,
    render,
)

from .test_failure_scenes import SHADOWED

EDGES = 3 * FACES
UNBROKEN = {"tilted-plane", "wide-kernel"}  # fill the map from side to side
TECHNIQUES = ((PCFFilter(), AnalyticBias()), (VSMFilter(), CombinedBias()))


def padded_edges(edges):
    """Return edges of a padded mesh, its further faces running along none."""
    fill = lambda array, size: np.pad(np.asarray(array), ((0, size - len(array)), (0, 0)))
    return MeshEdges(
        fill(edges.vertices, EDGES), fill(edges.edge_ids, FACES), fill(edges.directions, FACES)
    )


@quick
def image_and_slopes(mesh, camera, light, layout, edges):
    """Return images, and the gradient of their weighted sum in geometry, light and camera."""
    weights = jnp.linspace(-1.0, 1.0, IMAGE[0] * IMAGE[1]).reshape(*IMAGE, 1)

    def total(moving):
        positions, normals, camera, light = moving
        images = [
            render(
                mesh._replace(positions=positions, normals=normals),
                camera,
                light,
                image_size=IMAGE,
                map_size=MAP,
                layout=layout,
                filter=filter,
                bias=bias,
                compare=SoftCompare(0.5),
                edges=edges,
            )
            for filter, bias in TECHNIQUES
        ]
        return sum(jnp.sum(weights * image.color) for image in images), images

    moving = mesh.positions, mesh.normals, camera, light
    (_, images), slopes = eqx.filter_value_and_grad(total, has_aux=True)(moving)
    return [(i.color, i.coverage.share, i.shadow_maps[0].neighbor) for i in images], slopes


@pytest.mark.parametrize("name", SHADOWED)
def test_edges_are_finite(name):
    scene = load_scene(name)
    light, layout = next(iter(lightings(scene).values()))
    mesh = padded(scene.mesh._replace(uvs=None, tangents=None), VERTICES, FACES)
    edges = padded_edges(mesh_edges(scene.mesh.positions, scene.mesh.faces))
    with precision(np.float32):
        moving = on_device((mesh, scene.camera, light, layout), np.float32)
        images, slopes = image_and_slopes(*moving, edges)
    for color, share, neighbor in images:
        assert np.isfinite(color).all()
        assert np.min(color) >= 0
        for part in (share, neighbor.share):
            assert np.min(part) >= 0
            assert np.max(part) <= 1
        assert (np.min(neighbor.share) < 1) == (name not in UNBROKEN)
        assert np.isfinite(neighbor.depth).all()
    leaves = [leaf for leaf in jax.tree.leaves(slopes) if eqx.is_inexact_array(leaf)]
    assert all(np.isfinite(leaf).all() for leaf in leaves)
    assert sum(np.abs(leaf).sum() for leaf in leaves) > 0
