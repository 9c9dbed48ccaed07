"""A map's frame under a moving light: the same matrix, and derivatives of the light alone."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.scenes.staging import placed
from shadows import DirectionalLight, PointLight, SpotLight
from shadows.steady_frame import Plane, main_plane, steady_frame
from shadows.transforms import transform_points
from tangentspace.shapes import box, merge, plane

POSITION = np.array([0.7, 2.5, 0.4])
SCENE = merge(
    plane(1.5, dtype=np.float64)._replace(uvs=None),
    placed(box((0.3, 0.2, 0.25), dtype=np.float64), (0.1, 0.6, -0.2))._replace(uvs=None),
)
STILL = main_plane(SCENE.positions, SCENE.faces)
LIGHTS = {
    "spot": lambda at: SpotLight(at, -at / jnp.linalg.norm(at), 0.4, 0.6),
    "directional": lambda at: DirectionalLight(at / jnp.linalg.norm(at)),
    "point": lambda at: PointLight(at),
}


def frame(light, at):
    return steady_frame(light(at).clip_from_world(SCENE.positions), STILL)


def in_map(matrix, points):
    clip = transform_points(matrix, points)
    return clip[:, :2] / clip[:, 3:]


def rate(light, points_of):
    """Return how places in the map change as the light moves along (1, -0.3, 0.5)."""
    velocity = jnp.array([1.0, -0.3, 0.5])
    place = lambda t: in_map(
        frame(light, POSITION + t * velocity), points_of(POSITION + t * velocity)
    )
    return jax.jit(lambda: jax.jvp(place, (0.0,), (1.0,)))()


@pytest.mark.parametrize("name", LIGHTS)
def test_the_matrix_is_the_same(name):
    given = LIGHTS[name](POSITION).clip_from_world(SCENE.positions)
    np.testing.assert_allclose(frame(LIGHTS[name], POSITION), given, rtol=1e-12, atol=1e-12)


def test_the_main_plane_is_the_floor():
    assert abs(STILL.normal[1]) > 0.99
    assert abs(STILL.point[1]) < 0.2
    without = main_plane(jnp.zeros((3, 3)), np.array([[0, 1, 2]]))
    assert np.isfinite(np.concatenate(without)).all()


@pytest.mark.parametrize("name", LIGHTS)
def test_points_of_the_plane_stay(name):
    """And others move, unless they ride on lines through the moving light."""
    away = np.array([[0.3, 0, 0.2], [-0.5, 0, 0.4], [0.1, 0, -0.6]])
    on_plane = STILL.point + away - (away @ STILL.normal)[:, None] * STILL.normal
    place, change = rate(LIGHTS[name], lambda at: on_plane)
    np.testing.assert_allclose(change, 0, atol=1e-12)

    def riding(at):
        light = LIGHTS[name](at)
        return on_plane + 0.3 * light.to_light(on_plane)

    above, change = rate(LIGHTS[name], riding)
    np.testing.assert_allclose(above, place, atol=1e-12)
    np.testing.assert_allclose(change, 0, atol=1e-12)
    _, change = rate(LIGHTS[name], lambda at: on_plane + jnp.array([0, 0.5, 0]))
    assert np.abs(change).max() > 0.05


def test_a_light_in_the_plane_gets_another():
    """Derivatives stay finite, and values the same."""
    matrix = LIGHTS["point"](POSITION).clip_from_world(SCENE.positions)
    holding = Plane(jnp.zeros(3), jnp.asarray(np.cross(POSITION, [0, 1.0, 0])))
    holding = holding._replace(normal=holding.normal / jnp.linalg.norm(holding.normal))

    def entries(at):
        return steady_frame(LIGHTS["point"](at).clip_from_world(SCENE.positions), holding)

    np.testing.assert_allclose(entries(POSITION), matrix, rtol=1e-12, atol=1e-12)
    change = np.asarray(jax.jacfwd(entries)(jnp.asarray(POSITION)))
    assert np.isfinite(change).all()
    assert 0 < np.abs(change).max() < 1e3
