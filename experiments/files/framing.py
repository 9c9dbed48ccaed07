"""What a mesh needs to become a scene: a floor to throw a shadow on, a camera and a light."""

import numpy as np
from jaxtyping import Array, Float, Int

from shadows.lights import DirectionalLight
from shadows.transforms import PerspectiveCamera
from tangentspace.mesh import Mesh
from tangentspace.shapes import merge, plane

from ..scene import Material, Scene

VERTICAL_FOV = np.deg2rad(40.0)
FLOOR = Material(base_color=(0.5, 0.5, 0.5))


def frame_mesh(
    mesh: Mesh,
    name: str,
    notes: tuple[str, ...] = (),
    *,
    face_materials: Int[np.ndarray, " faces"] | None = None,
    materials: tuple[Material, ...] = (Material(),),
) -> Scene:
    """Return a scene of the mesh on a gray floor, seen and lit so that its shadow shows.

    The floor is a square of four bounding-sphere radii to each side that touches the lowest
    point; under a flat, level mesh it lies half a radius lower, so that the two do not fight.

    Args:
        mesh: World space, NumPy arrays.
        name: The scene's name.
        notes: The scene's notes.
        face_materials: For each face, the index of its material; all 0 if None.
        materials: At least one; the floor's is added behind them.
    """
    positions = np.asarray(mesh.positions, np.float64)
    centre, radius = bounding_sphere(positions)
    height = positions[:, 1].min()
    if positions[:, 1].max() - height <= 1e-3 * radius:
        height -= 0.5 * radius
        notes = (*notes, "the mesh is flat and level: the floor lies half its radius below it")
    floor = _floor(mesh, np.array([centre[0], height, centre[2]]), 4 * radius)
    light = key_light()
    # Every vertex along the light's ray to the floor: the outline of the shadow.
    direction = np.asarray(light.direction, np.float64)
    shadow = positions - (positions[:, 1:2] - height) * (direction / direction[1])
    if face_materials is None:
        face_materials = np.zeros(len(mesh.faces), np.int32)
    floor_materials = np.full(len(floor.faces), len(materials), np.int32)
    return Scene(
        name=name,
        mesh=merge(mesh, floor),
        face_materials=np.concatenate([face_materials, floor_materials]),
        materials=(*materials, FLOOR),
        camera=framing_camera(np.concatenate([positions, shadow]), floor.positions),
        lights=(light,),
        notes=notes,
    )


def framing_camera(
    points: Float[Array | np.ndarray, "points 3"],
    background: Float[Array | np.ndarray, "others 3"] | None = None,
) -> PerspectiveCamera:
    """Return a camera half above, a little right of +z, just far enough to see all points.

    Args:
        points: Filled into a square image with a margin of 5 %; wider images see more.
        background: Points (a floor's corners, level and below) that the far and near planes
            must not cut inside the image.
    """
    axes = _camera_axes(azimuth=np.deg2rad(35), elevation=np.deg2rad(25))
    _, up, back = axes
    x, y, z = axes @ np.asarray(points, np.float64).T
    # In view axes the eye (ex, ey, ez) sees x where |x - ex| <= t (ez - z). That bounds ex
    # from both sides; the nearest ez at which the bounds meet frames the points.
    t = np.tan(VERTICAL_FOV / 2)
    slack = 0.95 * t
    spans = [(np.max(c + slack * z), np.min(c - slack * z)) for c in (x, y)]
    eye_z = max((high - low) / (2 * slack) for high, low in spans)
    eye = axes.T @ [*((high + low) / 2 for high, low in spans), eye_z]
    near, far = eye_z - z.max(), eye_z - z.min()
    if background is not None:
        # The lowest row of the image looks along -back - t up and meets the floor there.
        near = min(near, (eye[1] - np.max(background[:, 1])) / (back[1] + t * up[1]))
        far = max(far, eye_z - np.min(background @ back))
    view_from_world = np.eye(4)
    view_from_world[:3, :3] = axes
    view_from_world[:3, 3] = -axes @ eye
    return PerspectiveCamera(
        view_from_world=view_from_world.astype(np.float32),
        vertical_fov=np.array(VERTICAL_FOV, np.float32),
        near=np.array(max(0.5 * near, 1e-3 * far), np.float32),
        far=np.array(1.05 * far, np.float32),
    )


def key_light() -> DirectionalLight:
    """Return white light from the upper left front of ``framing_camera``, 50 degrees high."""
    elevation = np.deg2rad(50)
    direction = [-np.cos(elevation), np.sqrt(2) * np.sin(elevation), np.cos(elevation)]
    return DirectionalLight(direction=(np.array(direction) / np.sqrt(2)).astype(np.float32))


def bounding_sphere(
    points: Float[Array | np.ndarray, "points 3"],
) -> tuple[Float[np.ndarray, "3"], float]:
    """Return the middle of the points' box and the radius round it that holds them all."""
    points = np.asarray(points, np.float64)
    centre = 0.5 * (points.min(axis=0) + points.max(axis=0))
    return centre, float(np.linalg.norm(points - centre, axis=1).max())


def _camera_axes(azimuth: float, elevation: float) -> Float[np.ndarray, "3 3"]:
    """Return right, up and back of a camera turned from +z to +x, then raised."""
    sin_a, cos_a = np.sin(azimuth), np.cos(azimuth)
    sin_e, cos_e = np.sin(elevation), np.cos(elevation)
    right, back = [cos_a, 0, -sin_a], [cos_e * sin_a, sin_e, cos_e * cos_a]
    return np.array([right, np.cross(back, right), back])


def _floor(mesh: Mesh, centre: Float[np.ndarray, "3"], half_width: float) -> Mesh:
    """Return a square facing up, with tangents if the mesh has them: a merge needs both."""
    square = plane(half_width)
    tangents = np.tile(np.array([1, 0, 0, 1], np.float32), (len(square.positions), 1))
    return square._replace(
        positions=(square.positions + centre).astype(np.float32),
        uvs=None if mesh.uvs is None else square.uvs,
        tangents=None if mesh.tangents is None else tangents,
    )
