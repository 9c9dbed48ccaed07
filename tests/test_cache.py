"""Kept shadow maps: what draws them again, and what does not."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from shadows import (
    CascadesLayout,
    CubeLayout,
    DirectionalLight,
    OrthographicCamera,
    PointLight,
    ShadowMapCache,
    SpotLight,
    look_at,
    render_shadow_map,
)
from tangentspace.shapes import merge, plane, transform_mesh, uv_sphere

RAISED = np.array([[1, 0, 0, 0], [0, 1, 0, 0.7], [0, 0, 1, 0], [0, 0, 0, 1.0]])
MESH = merge(plane(4.0), transform_mesh(uv_sphere(0.5), RAISED))
UP = np.array([0.0, 1.0, 0.0], np.float32)
SUN = DirectionalLight(np.float32([0.6, 0.8, 0.0]))
LAMP = SpotLight(np.float32([0.0, 3.0, 0.0]), np.float32([0.0, -1.0, 0.0]))


def camera(turn=0.0):
    eye = np.float32([4 * np.sin(turn), 2, 4 * np.cos(turn)])
    return OrthographicCamera(np.asarray(look_at(eye, np.zeros(3, np.float32), UP)), 2.0, 0.1, 20.0)


def maps(cache, mesh=MESH, eye=None, lights=(SUN, LAMP), **options):
    eye = camera() if eye is None else eye
    return cache.maps(mesh, eye, lights, **{"map_size": 32} | options)


def test_a_kept_map_is_the_one_that_would_be_drawn():
    cache = ShadowMapCache()
    first = maps(cache)
    kept = maps(cache, eye=camera(0.3))
    assert cache.passes == 2
    for light, before, after in zip((SUN, LAMP), first, kept, strict=True):
        assert before is after
        fresh = render_shadow_map(
            MESH.positions, MESH.faces, light.clip_from_world(MESH.positions), map_size=32
        )
        # Compiled and not, the matrix is rounded differently.
        assert np.mean(np.abs(np.asarray(after.depth - fresh.depth)) > 1e-4) < 0.02
        assert (np.asarray(after.depth) < 1).mean() > 0.2


KEEP = {
    "the eye moves": lambda: {"eye": camera(1.0)},
    "a light changes color": lambda: {
        "lights": (dataclasses.replace(SUN, color=np.float32([2.0, 1.0, 0.5])), LAMP)
    },
    "equal arrays": lambda: {"mesh": MESH._replace(positions=np.array(MESH.positions))},
    "other normals": lambda: {"mesh": MESH._replace(normals=-np.asarray(MESH.normals))},
    "the filter grows": lambda: {"reach": 5.0},
}
REDRAW = {
    "a light moves": (lambda: {"lights": (DirectionalLight(np.float32([0.8, 0.6, 0.0])), LAMP)}, 1),
    "an object moves": (
        lambda: {"mesh": MESH._replace(positions=MESH.positions + np.float32([0, 1e-3, 0]))},
        2,
    ),
    "a vertex moves": (lambda: {"mesh": MESH._replace(positions=nudged())}, 2),
    "faces change": (lambda: {"mesh": MESH._replace(faces=MESH.faces[:-1])}, 2),
    "finer maps": (lambda: {"map_size": 64}, 2),
    "other casters": (lambda: {"casters": "back"}, 2),
}


def nudged():
    positions = np.array(MESH.positions)
    positions[-1] += 1e-6
    return positions


@pytest.mark.parametrize("change", KEEP)
def test_what_does_not_concern_a_map_keeps_it(change):
    cache = ShadowMapCache()
    maps(cache)
    maps(cache, **KEEP[change]())
    assert cache.passes == 2


@pytest.mark.parametrize("change", REDRAW)
def test_what_a_map_shows_draws_it_again(change):
    options, passes = REDRAW[change]
    cache = ShadowMapCache()
    maps(cache)
    maps(cache, **options())
    assert cache.passes == 2 + passes
    maps(cache, **options())
    assert cache.passes == 2 + passes


def test_cascades_are_drawn_again_when_they_move_by_a_texel():
    cache = ShadowMapCache()
    options = {"lights": (SUN,), "layout": CascadesLayout(2)}

    def moved(length):
        eye = camera()
        view = np.array(eye.view_from_world)
        view[0, 3] -= length
        return dataclasses.replace(eye, view_from_world=view)

    for step in range(20):
        maps(cache, eye=moved(1e-4 * step), **options)
    few = cache.passes
    assert few <= 2
    maps(cache, eye=moved(1.0), **options)
    assert cache.passes == few + 1


def test_a_cube_of_maps_is_kept_as_one():
    cache = ShadowMapCache()
    lamp = PointLight(np.float32([0.0, 1.5, 0.0]))
    for eye in (camera(), camera(2.0)):
        (cube,) = maps(cache, eye=eye, lights=(lamp,), layout=CubeLayout())
    assert cube.depth.shape == (6, 32, 32)
    assert cache.passes == 1
    assert jnp.isfinite(cube.depth).all()
