"""The shadow of a quad on a floor, in closed form: what gradients across its edge must be.

The floor is the plane y = 0 and fills the view, the caster hovers above the eye, so that
only its shadow is seen: a polygon, whose corners are the caster's, projected from the light
onto the floor and from there into the image. All in the precision of the arguments.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from shadows import (
    Bias,
    Camera,
    Compare,
    ConstantBias,
    DirectionalLight,
    Filter,
    HardCompare,
    Light,
    MeshEdges,
    OrthographicCamera,
    PerspectiveCamera,
    PointLight,
    SpotLight,
    Surface,
    look_at,
    mesh_edges,
    render_shadow_map,
    render_surface,
    shade,
    surface_visibility,
    transform_points,
)
from shadows.window_filters import BilinearFilter
from tangentspace.mesh import Mesh
from tangentspace.shapes import plane

_UP = np.array([0.0, 1.0, 0.0])
_FLOOR = 1.2  # half of its width
_POINTS = 24  # on each side of a quadrature grid
Corners = Float[Array | np.ndarray, "4 3"]

CORNERS = np.array(
    [[-0.36, 1.0, -0.27], [0.31, 1.1, -0.33], [0.37, 1.05, 0.29], [-0.29, 0.95, 0.34]]
)

_SUN = np.array([0.2, 0.95, -0.24])
LIGHTS: dict[str, Light] = {
    "point": PointLight(np.array([0.3, 3.1, 0.2])),
    "spot": SpotLight(np.array([-0.4, 2.9, 0.3]), np.array([0.12, -0.99, -0.07]), 0.5, 0.9),
    "directional": DirectionalLight(_SUN / np.linalg.norm(_SUN)),
}

_ABOVE = look_at(_UP * 0.8, _UP * 0, np.array([0.0, 0.0, -1.0]))
_ASIDE = look_at(np.array([0.1, 0.85, 0.6]), np.zeros(3), _UP)
CAMERAS: dict[str, Camera] = {
    "lit area": OrthographicCamera(_ABOVE, 0.95, 0.1, 2.0),
    "mean image": PerspectiveCamera(_ASIDE, np.deg2rad(90.0), 0.05, 5.0),
}


def exact_mean(corners: Corners, light: Light, camera: Camera) -> Float[Array, ""]:
    """Return the mean over the image of what the shadow takes away, a negative number.

    Args:
        corners: Of the caster, in order round it.
        light: Directional, spot or point.
        camera: The view.
    """
    image = _floor_to_image(_shadow_corners(corners, light), camera)
    nodes, weights = np.polynomial.legendre.leggauss(_POINTS)
    s, t = 0.5 * (nodes + 1)[:, None], 0.5 * (nodes + 1)[None, :]
    total = 0.0
    for j, k in ((1, 2), (2, 3)):
        # A triangle as a square with one side drawn together.
        first, u, v = image[0], image[j] - image[0], image[k] - image[j]
        places = first + s[..., None] * (u + t[..., None] * v)
        area = (u[0] * v[1] - u[1] * v[0]) * s
        lost = _unshadowed(places, light, camera)
        total = total + jnp.sum(0.25 * weights[:, None] * weights * area * lost)
    return -jnp.abs(total) / 4  # the image has the area 4 in NDC


def rendered_mean(
    corners: Corners,
    light: Light,
    camera: Camera,
    *,
    map_size: int,
    image_size: int,
    covered: bool = True,
    filter: Filter = BilinearFilter(),
    compare: Compare = HardCompare(),
    bias: Bias = ConstantBias(0.02),
) -> Float[Array, ""]:
    """Return the same from a shadow map: the mean of the image less that without shadows."""
    mesh, edges = quad_over_floor(corners)
    size = (image_size, image_size)
    shadow_map = render_shadow_map(
        mesh.positions,
        mesh.faces,
        light.clip_from_world(mesh.positions),
        map_size=map_size,
        edges=edges if covered else None,
    )
    surface = render_surface(mesh, camera, image_size=size)
    visibility = surface_visibility(
        surface, light, shadow_map, bias=bias, filter=filter, compare=compare
    )
    lit, dark = (
        shade(surface, [light], [v])[..., 0] for v in (jnp.ones_like(visibility), visibility)
    )
    return jnp.mean(dark - lit)


def quad_over_floor(corners: Corners) -> tuple[Mesh, MeshEdges]:
    """Return the mesh, in the precision of the corners, and its edges."""
    floor = plane(_FLOOR, dtype=np.float64)
    faces = np.concatenate([floor.faces, len(floor.positions) + np.array([[0, 1, 2], [0, 2, 3]])])
    known = np.concatenate([floor.positions, CORNERS])
    edges = mesh_edges(known, faces)
    corners = jnp.asarray(corners)
    positions = jnp.concatenate([jnp.asarray(floor.positions, corners.dtype), corners])
    normals = jnp.broadcast_to(jnp.asarray(_UP, corners.dtype), positions.shape)
    return Mesh(positions, normals, faces), edges


def _shadow_corners(corners: Corners, light: Light) -> Float[Array, "4 3"]:
    corners = jnp.asarray(corners)
    away = -light.to_light(corners)
    return corners - (corners[:, 1] / away[:, 1])[:, None] * away


def _floor_to_image(points: Float[Array, "4 3"], camera: Camera) -> Float[Array, "4 2"]:
    clip = transform_points(camera.clip_from_world(1.0), points)
    return clip[:, :2] / clip[:, 3:]


def _unshadowed(
    places: Float[Array, "rows columns 2"], light: Light, camera: Camera
) -> Float[Array, "rows columns"]:
    """Return what the light adds at places in the image, on the floor."""
    inverse = jnp.linalg.inv(camera.clip_from_world(1.0))
    ends = []
    for depth in (-1.0, 1.0):
        clip = jnp.concatenate([places, jnp.full_like(places[..., :1], depth)], axis=-1)
        world = transform_points(inverse, clip)
        ends.append(world[..., :3] / world[..., 3:])
    near, far = ends
    way = near[..., 1] / (near[..., 1] - far[..., 1])
    position = near + way[..., None] * (far - near)
    up = jnp.broadcast_to(jnp.asarray(_UP, position.dtype), position.shape)
    ids = jnp.zeros(position.shape[:2], jnp.int32)
    surface = Surface(ids, way, position, up, up, camera.to_camera(position), position)
    one = jnp.ones(ids.shape, position.dtype)
    lit, dark = (shade(surface, [light], [v])[..., 0] for v in (one, 0 * one))
    return lit - dark
