"""Random scenes in which something moves, to ask how fast their images change.

One to five casters over a floor: closed, open and with holes, of 10 to 5 000 faces together,
that hover, stand on the floor, or pass through it or each other, under a light of any kind. One
of the casters, or the light, moves at about unit speed: shifts, turns or grows. All meshes are
filled up to one size with faces that cover nothing, so that one program for each kind of light
serves them all.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float

from shadows import (
    DirectionalLight,
    Light,
    MeshEdges,
    PerspectiveCamera,
    PointLight,
    Projector,
    SpotLight,
    look_at,
    mesh_edges,
)
from tangentspace.mesh import Mesh
from tangentspace.shapes import box, icosphere, merge, plane, torus, transform_mesh, uv_sphere

LIGHT_KINDS = ("directional", "point", "spot", "projector")
MOTIONS = ("shift", "turn", "grow", "light")
LEAST_FACES, MOST_FACES = 10, 5000  # of the casters
MOST_CASTERS = 5
_FACES, _VERTICES, _EDGES = 5120, 8192, 12288  # of each mesh, filled up
_SMOOTH = 400  # faces from which on a caster's normals are interpolated
_UP = np.array([0.0, 1.0, 0.0])
_LIGHT_SPEED = 3.0  # so that shadows move about as fast as casters do


class Motion(NamedTuple):
    """A scene at rest, and how it moves.

    Attributes:
        mesh: World space, double precision.
        velocity: Of each vertex.
        normal_velocity: Of each normal.
        light: The light.
        light_velocity: Of each of its numbers.
        camera: The view.
        edges: Of the mesh.
    """

    mesh: Mesh
    velocity: Float[Array | np.ndarray, "vertices 3"]
    normal_velocity: Float[Array | np.ndarray, "vertices 3"]
    light: Light
    light_velocity: Light
    camera: PerspectiveCamera
    edges: MeshEdges

    def at(self, time: float | Float[Array, ""]) -> tuple[Mesh, Light]:
        """Return mesh and light at a time."""
        add = lambda value, rate: value + time * rate
        mesh = self.mesh._replace(
            positions=add(self.mesh.positions, self.velocity),
            normals=add(self.mesh.normals, self.normal_velocity),
        )
        return mesh, jax.tree.map(add, self.light, self.light_velocity)


class RandomScene(NamedTuple):
    """A moving scene, and what is asked of its image.

    Attributes:
        motion: The scene.
        window: First row, row after the last, first column, column after the last; shares of
            the image.
        light_kind: One of ``LIGHT_KINDS``.
        moves: One of ``MOTIONS``.
        caster_faces: Faces of each caster.
    """

    motion: Motion
    window: tuple[float, float, float, float]
    light_kind: str
    moves: str
    caster_faces: tuple[int, ...]


def random_scene(seed: int) -> RandomScene:
    """Return the scene of a number; every fourth has the same kind of light."""
    rng = np.random.default_rng([6, seed])
    kind = LIGHT_KINDS[seed % len(LIGHT_KINDS)]
    floor = plane(1.6, segments=int(rng.integers(1, 5)), dtype=np.float64)
    casters = _casters(rng)
    parts = [floor._replace(uvs=None), *casters]
    mesh = merge(*parts)
    light = _light(rng, kind)
    eye = np.array([rng.uniform(-1.2, 1.2), rng.uniform(1.4, 2.6), rng.uniform(2.0, 2.6)])
    camera = PerspectiveCamera(look_at(eye, _UP * 0.25, _UP), np.deg2rad(45.0), 0.1, 20.0)
    velocity, normal_velocity = np.zeros_like(mesh.positions), np.zeros_like(mesh.positions)
    light_velocity = jax.tree.map(lambda leaf: np.zeros(np.shape(leaf)), light)
    moves = str(rng.choice(MOTIONS))
    chosen = int(rng.integers(1, len(parts)))
    if moves == "light":
        light_velocity = _light_velocity(rng, light, light_velocity)
    else:
        first = sum(len(part.positions) for part in parts[:chosen])
        mine = slice(first, first + len(parts[chosen].positions))
        velocity[mine], normal_velocity[mine] = _caster_velocity(rng, parts[chosen], moves)
    window = _window(rng, camera, np.mean(parts[chosen].positions, axis=0))
    edges = _filled_edges(mesh_edges(mesh.positions, mesh.faces))
    mesh, velocity, normal_velocity = _filled(mesh, velocity, normal_velocity)
    motion = Motion(mesh, velocity, normal_velocity, light, light_velocity, camera, edges)
    return RandomScene(motion, window, kind, moves, tuple(len(part.faces) for part in casters))


def _casters(rng: np.random.Generator) -> list[Mesh]:
    """Return some casters in their places, together of no more faces than there may be."""
    count = int(rng.integers(1, MOST_CASTERS + 1))
    casters, left = [], MOST_FACES
    for others in reversed(range(count)):
        most = left - others * LEAST_FACES * 2
        faces = np.exp(rng.uniform(np.log(LEAST_FACES), np.log(most)))
        part = _caster(rng, faces)
        left -= len(part.faces)
        casters.append(_placed(rng, part))
    return casters


def _caster(rng: np.random.Generator, faces: float) -> Mesh:
    """Return a shape about as wide as 2, of nearly so many faces but no more (20 at the least)."""
    side = np.sqrt(faces / 2)
    around, along = max(int(1.5 * side), 4), max(int(side / 1.5), 3)
    shapes: list[Callable[[], Mesh]] = [
        lambda: plane(0.9, segments=max(int(side), 3), dtype=np.float64),
        lambda: torus(
            0.75, 0.3, major_segments=around, minor_segments=along, dtype=np.float64
        ),
        lambda: uv_sphere(0.9, segments=around, rings=along, dtype=np.float64),
        lambda: icosphere(subdivisions=max(int(np.log2(faces / 20) / 2), 0), dtype=np.float64),
    ]  # fmt: skip
    if faces < 100:
        shapes += 3 * [lambda: box(tuple(rng.uniform(0.3, 0.9, 3)), dtype=np.float64)]
    part = shapes[rng.integers(len(shapes))]()._replace(uvs=None, tangents=None)
    if rng.random() < 0.3:
        part = _with_holes(rng, part)
    return _faceted(part) if len(part.faces) < _SMOOTH else part


def _with_holes(rng: np.random.Generator, part: Mesh) -> Mesh:
    """Leave out the faces in some places, where enough are left."""
    middles = part.positions[part.faces].mean(axis=1)
    for _ in range(rng.integers(1, 4)):
        away = middles - middles[rng.integers(len(middles))]
        kept = np.sum(away**2, axis=1) > rng.uniform(0.2, 0.5) ** 2
        if np.sum(kept) >= LEAST_FACES:
            part, middles = part._replace(faces=part.faces[kept]), middles[kept]
    return part


def _faceted(part: Mesh) -> Mesh:
    """Give each face corners and a normal of its own, so that light ends where it turns away."""
    corners = part.positions[part.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.sqrt(np.sum(normals**2, axis=1, keepdims=True))
    faces = np.arange(3 * len(corners), dtype=np.int32).reshape(-1, 3)
    return Mesh(corners.reshape(-1, 3), np.repeat(normals, 3, axis=0), faces)


def _placed(rng: np.random.Generator, part: Mesh) -> Mesh:
    """Turn and scale a caster, and put it over, on or into the floor."""
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    turn *= np.sign(np.linalg.det(turn))
    where = rng.choice(["over", "upright", "on", "into"], p=[0.55, 0.15, 0.15, 0.15])
    if where == "upright":
        angle = rng.uniform(0, 2 * np.pi)
        c, s = np.cos(angle), np.sin(angle)
        turn = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    matrix = np.eye(4)
    matrix[:3, :3] = rng.uniform(0.2, 0.45) * turn
    lowest = np.min(part.positions @ matrix[1, :3])
    height = {"over": rng.uniform(0.3, 0.9), "into": rng.uniform(0.3, 0.8) * -lowest}
    matrix[:3, 3] = rng.uniform(-0.6, 0.6), height.get(where, -lowest), rng.uniform(-0.6, 0.6)
    return transform_mesh(part, matrix)


def _caster_velocity(
    rng: np.random.Generator, part: Mesh, moves: str
) -> tuple[Float[np.ndarray, "vertices 3"], Float[np.ndarray, "vertices 3"]]:
    """Return how vertices and normals move, those farthest out at unit speed."""
    arm = part.positions - part.positions.mean(axis=0)
    size = np.sqrt(np.max(np.sum(arm**2, axis=1)))
    axis = rng.normal(size=3)
    axis /= np.sqrt(axis @ axis)
    if moves == "turn":
        return np.cross(axis, arm) / size, np.cross(axis, part.normals) / size
    rate = np.broadcast_to(axis, arm.shape) if moves == "shift" else arm / size
    return rate, np.zeros_like(part.normals)


def _light(rng: np.random.Generator, kind: str) -> Light:
    up, around = np.deg2rad(rng.uniform(35, 80)), rng.uniform(0, 2 * np.pi)
    towards = np.array([np.cos(up) * np.sin(around), np.sin(up), np.cos(up) * np.cos(around)])
    if kind == "directional":
        return DirectionalLight(towards, np.ones(3))
    position = rng.uniform(3.0, 4.5) * towards
    if kind == "point":
        return PointLight(position, np.ones(3))
    if kind == "spot":
        return SpotLight(position, -towards, np.float64(0.2), np.float64(0.5), np.ones(3))
    image = rng.uniform(0.6, 1.0, (8, 8, 3))
    return Projector(position, -towards, image, np.float64(0.7), _UP, np.ones(3))


def _light_velocity(rng: np.random.Generator, light: Light, still: Light) -> Light:
    """Return a light that moves: its place, or where parallel light comes from."""
    parallel = isinstance(light, DirectionalLight)
    of = lambda light: light.direction if parallel else light.position
    change = rng.normal(size=3)
    if parallel:
        change -= of(light) * (change @ of(light))  # keeps its length
    # Parallel light counts as 4 away.
    speed = _LIGHT_SPEED / np.sqrt(change @ change) / (4 if parallel else 1)
    return eqx.tree_at(of, still, speed * change)


def _window(
    rng: np.random.Generator, camera: PerspectiveCamera, point: Float[np.ndarray, "3"]
) -> tuple[float, float, float, float]:
    """Return a window about a point, so that what is there is seen but mostly not whole."""
    x, y, _, w = np.asarray(camera.clip_from_world(1.0)) @ np.append(point, 1.0)
    middle = 0.5 * np.array([1 - y / w, 1 + x / w]) + rng.uniform(-0.15, 0.15, 2)
    half = rng.uniform(0.15, 0.25, 2)
    (top, left), (bottom, right) = np.clip(middle - half, 0, 1), np.clip(middle + half, 0, 1)
    return float(top), float(bottom), float(left), float(right)


def _filled(mesh: Mesh, *rates: np.ndarray) -> tuple[Mesh, np.ndarray, np.ndarray]:
    more, faces = _VERTICES - len(mesh.positions), _FACES - len(mesh.faces)
    fill = lambda array: np.concatenate([array, np.repeat(array[:1], more, axis=0)])
    none = np.zeros((faces, 3), np.int32)
    filled = Mesh(fill(mesh.positions), fill(mesh.normals), np.concatenate([mesh.faces, none]))
    position_rate, normal_rate = rates
    return filled, fill(position_rate), fill(normal_rate)


def _filled_edges(edges: MeshEdges) -> MeshEdges:
    fill = lambda array, size: np.pad(array, ((0, size - len(array)), (0, 0)))
    return MeshEdges(
        fill(edges.vertices, _EDGES), fill(edges.edge_ids, _FACES), fill(edges.directions, _FACES)
    )
