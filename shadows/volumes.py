"""Shadow volumes: exact hard shadows at every pixel, without a map, a bias or a ray.

Every face casts a prism of shadow: the face, turned to the light, is its front cap; it
widens away from the light to infinity. A point is lit if it lies in no prism, and the number
of prisms that it lies in is the number of faces between it and the light. To count them,
follow the eye's ray from the point on to infinity: each surface of a prism by which the ray
leaves counts +1, each by which it enters -1. All prisms are counted at once, since what the
sum needs no word on which surface is whose: two prisms that share an edge have a side there
in common, and it cancels unless the edge is a silhouette (``silhouettes``). What is left to
draw are the front caps, which are the faces, the sides from silhouettes to infinity, and the
back caps, which are the faces at infinity.

The eye may stand in shadow: the ray is counted from the point away from the eye (Carmack's
reverse), so what lies before the point, and what the near plane cuts away, does not matter.
Nothing is clipped at the far plane, and vertices at infinity have w = 0.

Open meshes are served like closed ones: every face has a prism of its own, so the number
means the same for any set of triangles, with borders, edges of three faces, and faces wound
the wrong way. (A closed mesh could do with the prisms of the faces that look to the light,
half of the caps; the time that takes is the price of meshes as they come.)

A lit point lies on a cap, its own face, and must count as before it whatever rounding says.
No bias decides that, and no comparison of depths: of all faces over a pixel the visible one
is the nearest, so all front caps there lie at the point or behind it, but for those that the
near plane cut away, which are nearer by far; and back caps lie behind everything. Only sides
are compared by depth. They meet surfaces along the edges of shadows, and only there does
rounding decide. What every pixel sums is closed to the last digit, since triangles that share
an edge cover complementary pixels and are told front from back by the same numbers.
"""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.custom_batching import sequential_vmap
from jaxtyping import Array, Bool, Float, Int

from tangentspace._math import dot
from tangentspace.mesh import Mesh

from ._fragments import Drawing, Fragments, draw, get
from ._volume_boundary import Boundary, volume_boundary
from .lights import DirectionalLight, Light, PointLight, SpotLight
from .silhouettes import MeshEdges, mesh_edges, turned_to_light
from .surface import Surface
from .transforms import Camera, OrthographicCamera

_CHUNK = 2**15
# Against a light exactly along an orthographic view, where sides have no image: any direction.
_NUDGE = np.array([2.0, 3.0, 2.5])


def volume_visibility(
    mesh: Mesh,
    camera: Camera,
    surface: Surface,
    light: Light,
    *,
    edges: MeshEdges | None = None,
) -> Float[Array, "height width"]:
    """Return the light's visibility at each pixel, exactly hard, by shadow volumes.

    Takes and raises what ``blocker_counts`` does.

    Returns:
        1 where lit, 0 where a face is between, on faces turned away from the light and on
        the background: what ``surface_visibility`` returns, for ``shade``.

    Differentiability:
        None: the visibility is piecewise constant, and its derivative is 0 everywhere.
    """
    facing = dot(surface.face_normal, light.to_light(surface.position)) > 0
    counts = blocker_counts(mesh, camera, surface, light, edges=edges)
    lit = facing & surface.covered & (counts == 0)
    return lit.astype(surface.position.dtype)


def blocker_counts(
    mesh: Mesh,
    camera: Camera,
    surface: Surface,
    light: Light,
    *,
    edges: MeshEdges | None = None,
) -> Int[Array, "height width"]:
    """Count the faces between each pixel's point and the light.

    The point is taken on the eye's side of its face: seen from the dark side, its own face
    counts too. Faces exactly in the light's rays have no shadow: on one of them, and for a
    light that touches a face, rounding decides.

    Args:
        mesh: World space; any triangles, closed or not.
        camera: The view.
        surface: What the eye sees: ``render_surface(mesh, camera, ...)``, of this very mesh
            and camera.
        light: Directional, spot (in all directions, the cone is no matter of shadow) or point.
        edges: ``mesh_edges(mesh.positions, mesh.faces)``, to find them once for many calls
            and under ``jit``.

    Returns:
        Numbers of faces; 0 on the background.

    Raises:
        ValueError: If the light is of another kind, the edges are not the mesh's, or they are
            not given where the mesh is traced.
        EquinoxRuntimeError: If an edge or a face names a missing vertex (at run time).

    Differentiability:
        None: the numbers are integers. Under ``vmap`` images are made one after another.

    References:
        F. Crow, "Shadow Algorithms for Computer Graphics", SIGGRAPH 1977; C. Everitt,
        M. Kilgard, "Practical and Robust Stenciled Shadow Volumes", 2002; B. Kim, K. Kim,
        G. Turk, "A Shadow Volume Algorithm for Opaque and Transparent Non-Manifold Casters",
        Journal of Graphics Tools 13(3), 2008.
    """
    source = _homogeneous(light)
    if edges is None:
        edges = mesh_edges(mesh.positions, mesh.faces)
    if edges.edge_ids.shape != mesh.faces.shape:
        raise ValueError(
            f"blocker_counts: expected `edges` of the mesh's {mesh.faces.shape[0]} faces, got "
            f"those of {edges.edge_ids.shape[0]}; pass mesh_edges(mesh.positions, mesh.faces)"
        )
    positions, faces = jnp.asarray(mesh.positions), jnp.asarray(mesh.faces)
    ends, count = jnp.asarray(edges.vertices), positions.shape[0]
    missing = jnp.any((faces < 0) | (faces >= count)) | jnp.any((ends < 0) | (ends >= count))
    message = f"blocker_counts: `edges` or `faces` refer to a vertex outside 0..{count - 1}"
    positions = eqx.error_if(positions, missing, message)
    count_all = functools.partial(_count, isinstance(light, DirectionalLight))
    arguments = (positions, faces, edges, camera, surface.position, surface.covered, source)
    arguments = jax.tree.map(lambda leaf: lax.stop_gradient(jnp.asarray(leaf)), arguments)
    return sequential_vmap(count_all)(*arguments)


def _homogeneous(light: Light) -> Float[Array, "4"]:
    """Return the light's position and 1, or the direction towards it and 0."""
    if isinstance(light, DirectionalLight):
        return jnp.append(jnp.asarray(light.direction), 0)
    if isinstance(light, PointLight | SpotLight):
        return jnp.append(jnp.asarray(light.position), 1)
    raise ValueError(
        "blocker_counts: expected `light` to be a DirectionalLight, SpotLight or PointLight, "
        f"got a {type(light).__name__}; choose a shadow map for it"
    )


def _count(
    parallel: bool,
    positions: Float[Array, "vertices 3"],
    faces: Int[Array, "faces 3"],
    edges: MeshEdges,
    camera: Camera,
    points: Float[Array, "height width 3"],
    covered: Bool[Array, "height width"],
    light: Float[Array, "4"],
) -> Int[Array, "height width"]:
    """Count the prisms round each point."""
    height, width = covered.shape
    matrix = _clip_from_world(camera, width / height)
    turned = turned_to_light(positions, faces, light)
    away = -light[None, :3] if parallel else positions - light[:3]
    flat = isinstance(camera, OrthographicCamera)
    if flat:
        nudge = jnp.asarray(_NUDGE * jnp.finfo(away.dtype).eps, away.dtype)
        away = away + nudge * jnp.max(jnp.abs(away))
    boundary = volume_boundary(positions, away, faces, edges, turned, matrix)
    x, y, z = (points[..., k] for k in range(3))
    depth, w = (row[0] * x + row[1] * y + row[2] * z + row[3] for row in matrix[2:])
    depth = jnp.where(covered, depth / jnp.where(covered, w, 1), jnp.inf)
    counts = _sum_behind(boundary, depth)
    if flat and not parallel:
        counts = counts + _count_at_infinity(away, faces, turned, camera)
    return jnp.where(covered, counts, 0)


def _clip_from_world(camera: Camera, aspect: float) -> Float[Array, "4 4"]:
    """Return the camera's matrix with a depth from -1 at the near plane, exact far away.

    In perspective it is ``-near / w``: 0 at infinity, where floating-point numbers are
    densest. On a bunny 4 pixels of 100 000 are wrong then, however close the near plane; with
    the camera's own depth 75, where that is at a hundredth of the usual distance.
    """
    matrix = camera.clip_from_world(aspect)
    if isinstance(camera, OrthographicCamera):
        return matrix
    return matrix.at[2].set(jnp.zeros(4, matrix.dtype).at[3].set(-camera.near))


def _sum_behind(
    boundary: Boundary, depth: Float[Array, "height width"]
) -> Int[Array, "height width"]:
    """Sum over what lies behind each pixel's depth: back faces +1, front faces -1."""
    depths = depth.ravel()

    def write(counts: Array, fragments: Fragments) -> Array:
        limit = depths.at[fragments.pixel].get(mode="clip")
        # Caps are behind, unless the near plane at -1 cut them away.
        cap = fragments.face < boundary.cap_count
        limit = jnp.where(cap[:, None], 0.5 * (limit - 1), limit)
        behind = fragments.inside & (fragments.depth > limit)
        weight = get(boundary.weights, fragments.face)
        weight = jnp.where(fragments.front, -weight, weight)
        pixel = jnp.where(behind, fragments.pixel, depths.size)
        return counts.at[pixel].add(weight[:, None], mode="drop")

    height, width = depth.shape
    return draw(
        Drawing(height, width, _CHUNK, cull_far=False),
        boundary.clip_positions,
        boundary.faces,
        jnp.zeros(depths.size, jnp.int32),
        write,
        face_count=boundary.face_count,
    ).reshape(depth.shape)


def _count_at_infinity(
    away: Float[Array, "vertices 3"],
    faces: Int[Array, "faces 3"],
    turned: Int[Array, " faces"],
    camera: OrthographicCamera,
) -> Int[Array, "1 1"]:
    """Count the prisms round the point at infinity where an orthographic view's rays end.

    All its rays end in one, so the back caps have no image; but whether that point lies in
    them is what a single pixel in its direction tells, of a perspective view from the light.
    """
    x, y, z = jnp.matmul(away, camera.view_from_world[:3, :3].T, precision="highest").T
    clip_positions = jnp.stack([x, y, jnp.zeros_like(z), -z], axis=-1)
    caps = Boundary(clip_positions, faces, -turned, faces.shape[0], faces.shape[0])
    return _sum_behind(caps, jnp.full((1, 1), -jnp.inf, away.dtype))
