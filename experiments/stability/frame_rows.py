"""Rows of the catalogue about normals and tangent frames: 31 to 39."""

import itertools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from tangentspace import (
    flip_green,
    gradient_from_parameters,
    normals_from_heights,
    perturb_by_gradient,
    perturb_normal,
    split_mirrored,
)
from tangentspace.mesh import Mesh

from ..scene import Scene
from ..scenes import load_scene
from .cells import Cell, not_finite
from .frames import BUMP, LARGEST, Framed, frames_of
from .views import on_device, quick

_DEGREES = 180 / np.pi


def mirrored_strip(dtype: Any) -> list[Cell]:
    """Row 31: the shortest tangent where two charts mirror each other."""
    base = _base(31, "mirrored-strip", dtype, "1 - least |T|", 0.5)
    mesh = load_scene("mirrored-strip").mesh
    sheet = _sheet("mirrored-strip")
    cells = []
    for name, framed, said in (
        ("", frames_of(mesh, dtype), "tangents of one index cancel"),
        (", split", frames_of(split_mirrored(mesh), dtype), ""),
    ):
        tangents = _by_corner(framed)
        flaws = not_finite(framed.made["frames"]), not_finite(framed.slopes)
        value = 1 - _lengths(tangents["vertex frames"])[sheet].min()
        cells.append(_cell(base, f"vertex frames{name}", value, flaws, said))
        if not name:
            for other in ("corner tangents", "group tangents"):
                value = 1 - _lengths(tangents[other])[sheet].min()
                cells.append(_cell(base, other, value, flaws))
    length, said = np.nanmin(_lengyel(mesh)[1]), "tangents of one index cancel"
    return [*cells, _cell(base, "(Lengyel, by index)", 1 - length, (0, 0), said)]


def equal_uvs(dtype: Any) -> list[Cell]:
    """Row 32: corners without a tangent where all texture coordinates of a face are equal."""
    none = "none there; it says so"
    said = {
        "triangle frames": none, "vertex frames": none, "(Lengyel, by index)": "divides by zero",
    }  # fmt: skip
    return _without_tangents(32, "equal-uvs", dtype, said)


def collinear_sliver(dtype: Any) -> list[Cell]:
    """Row 33: corners without a tangent where a face's corners lie on a line."""
    none, mikktspace = "no area; it says so", "as MikkTSpace"
    said = {
        "triangle frames": none, "vertex frames": none,
        "corner tangents": mikktspace, "group tangents": mikktspace,
    }  # fmt: skip
    return _without_tangents(33, "collinear-sliver", dtype, said)


def _without_tangents(row: int, name: str, dtype: Any, said: dict[str, str]) -> list[Cell]:
    base = _base(row, name, dtype, "corners without T", 0.0)
    scene = load_scene(name)
    cells = [
        _cell(base, technique, count, flaws, said.get(technique, ""))
        for technique, count, flaws in corners_without_tangent(scene, dtype)
    ]
    faces = np.asarray(scene.mesh.faces)
    naive = _lengyel(scene.mesh)[0][faces][_sheet(name)[: len(faces)]]
    count, technique = np.count_nonzero(~(_lengths(naive) > 0.5)), "(Lengyel, by index)"
    cell = _cell(base, technique, count, (not_finite(naive), 0), said.get(technique, ""))
    # Where its division does not meet a zero, rounding decides what it returns.
    return [*cells, cell._replace(documented=False, may="no area")]


def corners_without_tangent(scene: Scene, dtype: Any) -> list[tuple[str, int, tuple[int, int]]]:
    """Return how many corners have none by each way to make frames, and what is not finite."""
    framed, sheet = frames_of(scene.mesh, dtype), _sheet(scene.name)
    flaws = not_finite(framed.made), not_finite(framed.slopes)
    return [
        (technique, int(np.count_nonzero(~(_lengths(tangents)[sheet] > 0.5))), flaws)
        for technique, tangents in _by_corner(framed).items()
    ]


def shrunk_uvs(area: float) -> Scene:
    """Return the scene of row 32 with its collapsed triangle grown to an area in UV space."""
    scene = load_scene("equal-uvs")
    uvs = np.array(scene.mesh.uvs)
    side = np.sqrt(2 * area)
    uvs[-3:] += np.array([[0.0, 0.0], [side, 0.0], [0.0, side]], np.float32)
    return scene._replace(mesh=scene.mesh._replace(uvs=uvs))


def zero_area(dtype: Any) -> list[Cell]:
    """Row 34: derivatives that are not finite, of faces without area."""
    base = _base(34, "duplicate-vertex", dtype, "not finite", 0.0)
    mesh = load_scene("duplicate-vertex").mesh
    framed = frames_of(mesh, dtype)
    names = {
        "face normals": "faces", "vertex normals": "vertices", "triangle frames": "triangles",
        "vertex frames": "frames", "group tangents": "corners", "pixel normals": "pixels",
    }  # fmt: skip
    slopes = not_finite(framed.slopes)
    cells = []
    for name, key in names.items():
        flaws = not_finite(framed.made[key]), slopes
        cells.append(_cell(base, name, sum(flaws), flaws))

    def unguarded(positions: Any) -> Any:
        a, b, c = jnp.moveaxis(positions[np.asarray(mesh.faces)], 1, 0)
        cross = jnp.cross(b - a, c - a)
        length = jnp.sqrt(jnp.sum(cross**2, axis=-1, keepdims=True))
        return jnp.sum(jnp.where(length > 0, cross / length, 0.0))

    count = not_finite(quick(jax.grad(unguarded))(jnp.asarray(mesh.positions, dtype)))
    said = "masked after the division"
    naive = _cell(base, "(masked after dividing)", count, (0, count), said)
    return [*cells, naive._replace(documented=False)]


def pole(dtype: Any) -> list[Cell]:
    """Row 35: tangents against the sphere's own, at the pole's faces and at all others."""
    framed, sheet = frames_of(load_scene("pole-cap").mesh, dtype), _sheet("pole-cap")
    mesh = framed.mesh
    corners = np.asarray(mesh.positions, np.float64)[np.asarray(mesh.faces)]
    heights = corners[sheet][..., 1]
    tips = (corners[..., 1] > heights.max() - 1e-5) | (corners[..., 1] < heights.min() + 1e-5)
    at_pole = sheet & tips.any(axis=1)
    flaws = not_finite(framed.made["frames"]), not_finite(framed.slopes)
    weights = np.array(list(itertools.permutations((0.9, 0.1, 0.0))))  # near each corner
    points = np.einsum("pk,fkx->fpx", weights, corners)
    round_axis = np.stack([points[..., 2], 0 * points[..., 0], -points[..., 0]], axis=-1)
    cells = []
    for technique, tangents in _by_corner(framed).items():
        angle = _angle(np.einsum("pk,fkx->fpx", weights, tangents), round_axis)
        angle = np.minimum(angle, 180 - angle)
        for metric, faces in (("turn at the pole", at_pole), ("turn elsewhere", sheet & ~at_pole)):
            base = _base(35, "pole-cap", dtype, metric, 3.0)
            fan = "tangents of a fan turn about its tip" if faces is at_pole else ""
            faceted = "one tangent a face" if technique == "triangle frames" else ""
            cell = _cell(base, technique, angle[faces].mean(), flaws, fan)
            cells.append(
                cell._replace(
                    may=faceted, note="mean degrees from the sphere's own tangent, near corners"
                )
            )
    return cells


def sheared(dtype: Any) -> list[Cell]:
    """Row 36: a bump's normal against that of the height it stands for, where u leans by 60."""
    base = _base(36, "sheared-uvs", dtype, "degrees off", 1.0)
    framed, sheet = frames_of(load_scene("sheared-uvs").mesh, dtype), _sheet("sheared-uvs")
    faces = np.asarray(framed.mesh.faces)
    triangles = framed.made["triangles"]
    normals = jnp.asarray(framed.mesh.normals, dtype)[faces[:, 0]]
    # A height that rises by so much per unit of u and v, in a map of square texels.
    along_u, along_v = (jnp.asarray(slope, dtype) for slope in (0.15, 0.1))
    side = jnp.linalg.vector_norm(triangles.tangent[sheet][0])
    bump = jnp.stack([-along_u / side, -along_v / side, jnp.ones_like(side)])
    ones = jnp.ones(len(faces), dtype)
    gradient = gradient_from_parameters(
        normals, triangles.tangent, triangles.bitangent, along_u * ones, along_v * ones
    )
    p_u, p_v = (np.asarray(x, np.float64)[sheet] for x in triangles[:2])
    rises = np.array([0.15, 0.1])
    plane = np.stack([p_u[:, :2], p_v[:, :2]], axis=1)
    slope = np.linalg.solve(plane, np.broadcast_to(rises, plane.shape[:2])[..., None])[..., 0]
    truth = _unit(np.concatenate([-slope, np.ones((len(slope), 1))], axis=-1))
    made = {"surface gradient": perturb_by_gradient(normals, gradient.vector)}
    for name, tangents in _by_corner(framed, signs=True).items():
        if name != "triangle frames":
            made[name] = perturb_normal(bump, jnp.asarray(tangents[:, 0], dtype), normals)
    flaws = not_finite(framed.made), not_finite(framed.slopes)
    cells = []
    for name, bumped in made.items():
        said = "" if name == "surface gradient" else "at right angles, which the texture is not"
        off = _angle(np.asarray(bumped)[sheet], truth).max()
        cells.append(_cell(base, name, off, flaws, said))
    return cells


def green(dtype: Any) -> list[Cell]:
    """Row 37: whether bumps look like dents: the sign of light from above against the slope."""
    base = _base(37, "knob", dtype, "1 - correlation", 0.5)
    centres = (np.arange(32) + 0.5) / 32 - 0.5
    heights = np.exp(-30 * (centres**2 + centres[:, None] ** 2))
    normals = normals_from_heights(jnp.asarray(heights, dtype))
    slope = np.gradient(heights, axis=0)  # rows go down, v goes up
    downwards = flip_green(normals)
    cells = []
    for name, read, said in (
        ("+Y map", normals, ""),
        ("-Y map, flipped", flip_green(downwards), ""),
        ("(-Y map, read as +Y)", downwards, "green points the other way"),
    ):
        light = np.asarray(read, np.float64)[..., 1]
        correlation = np.corrcoef(light.ravel(), slope.ravel())[0, 1]
        cells.append(_cell(base, name, 1 - correlation, (not_finite(read), 0), said))
    return cells


def other_cut(dtype: Any) -> list[Cell]:
    """Row 38: bumped normals of one sheet whose squares are cut along either diagonal."""
    base = _base(38, "split-quads", dtype, "degrees apart", 0.5)
    framed, sheet = frames_of(load_scene("split-quads").mesh, dtype), _sheet("split-quads")
    faces = np.asarray(framed.mesh.faces)
    left, right = (np.unique(half) for half in np.split(faces[sheet], 2))
    flaws = not_finite(framed.made), not_finite(framed.slopes)
    normals = jnp.asarray(framed.mesh.normals, dtype)
    cells = []
    for name, tangents in _by_corner(framed, signs=True).items():
        if name == "triangle frames":
            continue
        of_vertex = np.zeros((len(normals), 4))
        of_vertex[faces[sheet]] = tangents[sheet]
        bumped = np.asarray(perturb_normal(_bumps(dtype), jnp.asarray(of_vertex, dtype), normals))
        apart = _angle(bumped[left], bumped[right]).max()
        cells.append(_cell(base, name, apart, flaws, "baked on the other cut"))
    return cells


def unit_per_pixel(dtype: Any) -> list[Cell]:
    """Row 39: bumped normals at the centres of wide triangles, against what a baker inverts."""
    base = _base(39, "wide-triangles", dtype, "degrees off", 0.1)
    framed, sheet = frames_of(load_scene("wide-triangles").mesh, dtype), _sheet("wide-triangles")
    faces = np.asarray(framed.mesh.faces)
    tangents = framed.tangents.astype(np.float64)[sheet]
    normals = np.asarray(framed.mesh.normals, np.float64)[faces[sheet]]
    tangent, normal, sign = tangents[..., :3].mean(1), normals.mean(1), tangents[:, :1, 3]
    bitangent = sign * np.cross(normal, tangent)
    truth = _unit(BUMP[0] * tangent + BUMP[1] * bitangent + BUMP[2] * normal)
    interpolated = np.concatenate([tangent, sign], axis=-1)
    unit = np.concatenate([_unit(tangent), sign], axis=-1)
    cells = []
    for name, frame, up, said in (
        ("pixel normals", interpolated, normal, ""),
        ("(frames made unit per pixel)", unit, _unit(normal), "made unit before it is used"),
    ):
        arrays = on_device((frame, up), dtype)
        bumped = perturb_normal(_bumps(dtype), *arrays)
        slopes = jax.grad(lambda t, n: jnp.sum(perturb_normal(_bumps(dtype), t, n)))(*arrays)
        flaws = not_finite(bumped), not_finite(slopes)
        cells.append(_cell(base, name, _angle(np.asarray(bumped), truth).max(), flaws, said))
    return cells


def _base(row: int, scene: str, dtype: Any, metric: str, limit: float) -> Cell:
    return Cell(row, scene, "", np.dtype(dtype).name, metric, 0.0, limit)


def _cell(base: Cell, name: str, value: Any, flaws: tuple[int, int], said: str = "") -> Cell:
    return base._replace(
        technique=name, value=float(value), said=said,
        values_not_finite=flaws[0], slopes_not_finite=flaws[1],
    )  # fmt: skip


def _bumps(dtype: Any) -> jax.Array:
    return jnp.asarray(BUMP, dtype)


def _sheet(name: str) -> np.ndarray:
    """Return which faces of a padded mesh carry the bumps."""
    scene = load_scene(name)
    bumpy = scene.face_materials == len(scene.materials) - 1
    return np.pad(bumpy, (0, LARGEST[1] - len(bumpy)))


def _by_corner(framed: Framed, *, signs: bool = False) -> dict[str, np.ndarray]:
    """Return tangents of each corner by each way to make them; with handedness if asked for."""
    faces = np.asarray(framed.mesh.faces)
    triangles, frames = framed.made["triangles"], framed.made["frames"]
    along = _unit(np.asarray(triangles.tangent, np.float64))
    made = {
        "triangle frames": np.repeat(
            np.column_stack([along, np.asarray(triangles.handedness)])[:, None], 3, axis=1
        ),
        "vertex frames": np.column_stack([frames.tangent, frames.handedness])[faces],
        "corner tangents": framed.tangents.astype(np.float64),
        "group tangents": np.asarray(framed.made["corners"], np.float64),
    }
    return made if signs else {name: tangents[..., :3] for name, tangents in made.items()}


def _lengyel(mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
    """Return unit tangents of vertices, from sums over faces by index, nothing guarded.

    And how long the sums are, as shares of the lengths that were added.
    """
    positions, uvs = np.asarray(mesh.positions), np.asarray(mesh.uvs)
    corners, places = positions[mesh.faces], uvs[mesh.faces]
    first, second = (corners[:, k] - corners[:, 0] for k in (1, 2))
    (s1, t1), (s2, t2) = ((places[:, k] - places[:, 0]).T[..., None] for k in (1, 2))
    with np.errstate(all="ignore"):
        along = (t2 * first - t1 * second) / (s1 * t2 - s2 * t1)
        sums = np.zeros_like(positions)
        np.add.at(sums, np.asarray(mesh.faces), along[:, None])
        added = np.zeros(len(positions))
        np.add.at(added, np.asarray(mesh.faces), np.linalg.norm(along, axis=-1)[:, None])
        length = np.linalg.norm(sums, axis=-1)
        return sums / length[:, None], length / added


def _lengths(vectors: np.ndarray) -> np.ndarray:
    return np.linalg.norm(vectors[..., :3], axis=-1)


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-30)


def _angle(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return angles in degrees."""
    a, b = _unit(np.asarray(a, np.float64)), _unit(np.asarray(b, np.float64))
    sine = np.linalg.norm(np.cross(a, b), axis=-1)
    return np.arctan2(sine, np.sum(a * b, axis=-1)) * _DEGREES
