"""Baked normals against planes and spheres with known answers, and rays against spheres."""

import jax
import numpy as np
import pytest

from experiments.baking.bake_cage import Detail, find_cage
from experiments.baking.bake_normals import bake_normals
from experiments.files.smooth_normals import smooth_normals
from tangentspace.mesh import Mesh
from tangentspace.mikktspace import with_tangents
from tangentspace.normal_map import decode_normals
from tangentspace.pixel_frame import perturb_normal
from tangentspace.shapes import box, icosphere, merge, plane, uv_sphere
from tangentspace.texture import sample_bilinear

LOW_SPHERE = uv_sphere(rings=12, segments=24)
SIZE = 64


def unit(vectors):
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def degrees(a, b):
    """Return the angles between unit vectors."""
    half_chord = 0.5 * np.linalg.norm(np.asarray(a, np.float64) - b, axis=-1)
    return np.rad2deg(2 * np.arcsin(np.minimum(half_chord, 1)))


def with_uvs(mesh, *, factor, shift=0.0):
    """Scale and move a mesh in its texture."""
    return mesh._replace(uvs=np.float32(factor) * np.asarray(mesh.uvs) + np.float32(shift))


def displaced(mesh, heights):
    """Move vertices along their normals and give them the normals of the new surface."""
    positions = mesh.positions + heights[:, None] * mesh.normals
    positions = positions.astype(np.float32)
    return mesh._replace(positions=positions, normals=smooth_normals(positions, mesh.faces))


def wave(points):
    """Return heights of up to 0.04, on both sides of zero."""
    x, y, z = points.T
    return 0.04 * np.sin(7 * x) * np.sin(6 * y + 1) * np.cos(6 * z + 2)


def bumpy_sphere():
    sphere = icosphere(subdivisions=5)
    return displaced(sphere, wave(sphere.positions))


def decoded(bake):
    """Return the map's normals, checked to be unit vectors."""
    normals = np.asarray(decode_normals(bake.texels), np.float64)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=-1), 1, atol=1e-6)
    return normals


def random_points(mesh, count):
    """Return faces and weights of points all over a surface."""
    rng = np.random.default_rng(0)
    corners = mesh.positions[mesh.faces]
    area = np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    )
    faces = rng.choice(len(area), count, p=area / area.sum())
    return faces, rng.dirichlet([1, 1, 1], count).astype(np.float32)


def blended(mesh, values, points):
    faces, weights = points
    return np.einsum("pk,pkx->px", weights, np.asarray(values)[mesh.faces[faces]])


def shaded(bake, low, points):
    """Return the shading normals that a renderer makes of the map at points of the mesh."""
    low = with_tangents(low)
    attributes = [blended(low, values, points) for values in (low.uvs, low.tangents, low.normals)]
    return np.asarray(_shade(bake.texels, *attributes))


@jax.jit
def _shade(texels, uvs, tangents, normals):
    return perturb_normal(decode_normals(sample_bilinear(texels, uvs)), tangents, normals)


# Rays


def shells(*radii):
    """Return spheres one in another."""
    return merge(*(icosphere(radius, subdivisions=4) for radius in radii))


def test_rays_meet_the_outermost_front_and_say_where():
    mesh = shells(0.7, 1.0, 1.2)
    outwards = unit(np.random.default_rng(0).normal(size=(2000, 3)))
    for start, radius in ((1.5, 1.2), (1.1, 1.0), (0.9, 0.7)):
        hits = Detail(mesh).first_front(start * outwards, outwards, 1.0)
        assert (hits.faces >= 0).all()
        points = np.einsum("rk,rkx->rx", hits.weights, mesh.positions[mesh.faces[hits.faces]])
        np.testing.assert_allclose(points, (start - hits.distances)[:, None] * outwards, atol=1e-6)
        np.testing.assert_allclose(np.linalg.norm(points, axis=1), radius, rtol=2e-3)
    # From inside, what is seen from behind going inwards is a front going outwards.
    hits = Detail(mesh).first_front(0.9 * outwards, outwards, 1.0, inwards=False)
    np.testing.assert_allclose(0.9 + hits.distances, 1, rtol=2e-3)


def test_rays_pass_through_faces_seen_from_behind():
    """A shell turned inside out round a sphere hides nothing."""
    inner, outer = icosphere(1.0, subdivisions=4), icosphere(1.2, subdivisions=4)
    mesh = merge(outer._replace(faces=outer.faces[:, ::-1]), inner)
    outwards = unit(np.random.default_rng(0).normal(size=(2000, 3)))
    hits = Detail(mesh).first_front(1.5 * outwards, outwards, 1.0)
    np.testing.assert_allclose(1.5 - hits.distances, 1, rtol=2e-3)
    assert (hits.faces >= len(outer.faces)).all()


def test_rays_end_at_their_reach():
    outwards = unit(np.random.default_rng(0).normal(size=(100, 3)))
    hits = Detail(icosphere(subdivisions=4)).first_front(1.5 * outwards, outwards, 0.49)
    assert (hits.faces == -1).all()
    assert np.isinf(hits.distances).all()
    assert not hits.weights.any()


def test_no_ray_slips_through_an_edge_or_a_vertex():
    mesh = icosphere(subdivisions=4)
    for points in (mesh.positions, mesh.positions[mesh.faces[:, :2]].mean(axis=1)):
        outwards = unit(points.astype(np.float64))
        assert (Detail(mesh).first_front(1.5 * outwards, outwards, 1.0).faces >= 0).all()


# The cage


@pytest.mark.parametrize("offset", [0.1, -0.1])
def test_the_cage_is_half_as_far_again_as_a_shell_on_either_side(offset):
    sphere = icosphere(subdivisions=4)
    shell = displaced(sphere, np.full(len(sphere.positions), offset))
    assert find_cage(sphere, Detail(shell)) == pytest.approx(0.15, rel=1e-3)  # measured 5e-5


def test_the_cage_holds_detail_that_goes_both_ways():
    sphere, bumpy = icosphere(subdivisions=4), bumpy_sphere()
    farthest = np.abs(np.linalg.norm(bumpy.positions, axis=1) - 1).max()
    cage = find_cage(sphere, Detail(bumpy))
    assert farthest < cage < 1.6 * farthest  # measured 1.48
    bake = bake_normals(bumpy, LOW_SPHERE, size=SIZE, samples=1)
    assert bake.missed == 0
    assert find_cage(LOW_SPHERE, Detail(bumpy)) == bake.cage


def test_the_cage_scales_with_the_meshes():
    sphere, bumpy = icosphere(subdivisions=4), bumpy_sphere()
    large, far = (
        sphere._replace(positions=1000 * sphere.positions + 70000),
        bumpy._replace(positions=1000 * bumpy.positions + 70000),
    )
    cage = find_cage(sphere, Detail(bumpy))
    assert find_cage(large, Detail(far)) == pytest.approx(1000 * cage, rel=1e-3)  # measured 6e-5


def test_the_cage_of_equal_meshes_is_not_zero():
    sphere = icosphere(subdivisions=4)
    assert find_cage(sphere, Detail(sphere)) == pytest.approx(1e-3, rel=1e-6)


def test_holes_do_not_widen_the_cage():
    """Through a hole rays see the far side's inside, which is no detail."""
    sphere = icosphere(subdivisions=4)
    shell = displaced(sphere, np.full(len(sphere.positions), 0.05))
    open_shell = shell._replace(
        faces=shell.faces[shell.positions[shell.faces][:, :, 1].min(1) < 0.8]
    )
    assert find_cage(sphere, Detail(open_shell)) == pytest.approx(0.075, rel=1e-3)  # measured 5e-5


def test_a_speck_far_away_does_not_widen_the_cage():
    sphere = icosphere(subdivisions=4)
    shell = displaced(sphere, np.full(len(sphere.positions), 0.05))
    patch = plane(0.01)
    patch = patch._replace(positions=patch.positions + np.float32([0, 1.4, 0]), uvs=None)
    inside = patch._replace(positions=patch.positions - np.float32([0, 0.75, 0]))
    open_at_top = shell._replace(
        faces=shell.faces[shell.positions[shell.faces][..., 1].max(1) < 1.02]
    )
    assert find_cage(sphere, Detail(merge(open_at_top, patch, inside))) == pytest.approx(
        0.075, rel=1e-3
    )


# Known answers


@pytest.mark.parametrize("height", [0.2, -0.2, 0.0])
def test_a_tilted_normal_over_a_plane_on_either_side(height):
    """On the plane the tangent is +x, the bitangent -z, the normal +y."""
    tilted = unit(np.array([0.3, 0.8, -0.5]))
    high = plane(1.5)._replace(normals=np.tile(tilted.astype(np.float32), (4, 1)))
    high = high._replace(positions=high.positions + np.float32([0, height, 0]))
    bake = bake_normals(high, plane(), size=32, cage=0.3, samples=2)
    np.testing.assert_allclose(
        decoded(bake),
        np.broadcast_to([0.3, 0.5, 0.8], (32, 32, 3)) / np.linalg.norm([0.3, 0.5, 0.8]),
        atol=1e-6,
    )
    assert bake.found.all()
    assert bake.charted.all()
    assert (bake.missed, bake.notes) == (0, ())


def test_a_displaced_plane_has_its_analytic_normals():
    high = plane(segments=128)
    x, _, z = high.positions.astype(np.float64).T
    heights = 0.1 * np.sin(3 * x + 1) * np.cos(2 * z)
    slopes = lambda x, z: (
        0.3 * np.cos(3 * x + 1) * np.cos(2 * z),
        -0.2 * np.sin(3 * x + 1) * np.sin(2 * z),
    )
    along_x, along_z = slopes(x, z)
    high = high._replace(
        positions=(high.positions + np.stack([0 * x, heights, 0 * x], -1)).astype(np.float32),
        normals=unit(np.stack([-along_x, np.ones_like(x), -along_z], -1)).astype(np.float32),
    )
    bake = bake_normals(high, plane(), size=32)
    rows, columns = np.mgrid[:32, :32]
    along_x, along_z = slopes(2 * (columns + 0.5) / 32 - 1, 2 * (rows + 0.5) / 32 - 1)
    expected = unit(np.stack([-along_x, along_z, np.ones_like(along_x)], -1))
    assert degrees(decoded(bake), expected).max() < 0.1  # measured 0.034
    assert 0.13 < bake.cage < 0.16  # measured 0.1496


def test_a_texel_holds_the_mean_of_its_points():
    """Detail whose normal changes at a quarter of a texel, seen by 4 x 4 rays."""
    left, right = unit(np.array([[-0.6, 0.8, 0.0], [0.6, 0.8, 0.0]]))
    edge = 2 * (20.25 / 32) - 1
    x = np.array([-1, edge, edge, 1])
    positions = np.stack([np.tile(x, 2), np.full(8, 0.1), np.repeat([1.0, -1.0], 4)], axis=-1)
    faces = [[0, 1, 5], [0, 5, 4], [2, 3, 7], [2, 7, 6]]
    normals = np.tile([left, left, right, right], (2, 1))
    high = Mesh(positions.astype(np.float32), normals.astype(np.float32), np.array(faces, np.int32))
    bake = bake_normals(high, plane(), size=32, cage=0.2, samples=4)
    mean = unit(0.25 * left + 0.75 * right)
    expected = np.stack([left] * 20 + [mean] + [right] * 11)[:, [0, 2, 1]]
    np.testing.assert_allclose(decoded(bake), np.tile(expected, (32, 1, 1)), atol=1e-6)


def test_a_mesh_baked_onto_itself_is_flat():
    bake = bake_normals(LOW_SPHERE, LOW_SPHERE, size=SIZE, samples=1)
    assert bake.missed == 0
    assert degrees(decoded(bake), [0, 0, 1]).max() < 1e-4  # measured 1e-5


def test_a_hard_edged_box_takes_on_the_roundness_of_a_sphere():
    """The cage has no gaps at hard edges: every texel of every side finds the sphere."""
    sides = box((0.6, 0.6, 0.6))
    grid = np.array([[0, 0], [1, 0], [2, 0], [0, 1], [1, 1], [2, 1]]) / [3, 2]
    sides = with_uvs(sides, factor=0.3, shift=np.repeat(grid, 4, axis=0))
    bake = bake_normals(icosphere(subdivisions=5), sides, size=SIZE, samples=1, cage=0.8)
    assert bake.missed == 0
    points = random_points(sides, 5000)
    outward = unit(blended(sides, smooth_normals(sides.positions, sides.faces), points))
    position = blended(sides, sides.positions, points)
    along = np.sum(position * outward, axis=1)
    there = position + outward * (np.sqrt(along**2 + 1 - np.sum(position**2, 1)) - along)[:, None]
    assert degrees(shaded(bake, sides, points), there).mean() < 0.5  # measured 0.11


# Laws


@pytest.mark.parametrize("sign", [1, -1], ids=["bumps", "dents"])
def test_a_map_shades_as_the_detailed_sphere(sign):
    sphere = icosphere(subdivisions=5)
    high = displaced(sphere, sign * (0.04 + wave(sphere.positions)))
    bake = bake_normals(high, LOW_SPHERE, size=SIZE)
    points = random_points(LOW_SPHERE, 5000)
    outward = unit(blended(LOW_SPHERE, LOW_SPHERE.normals, points).astype(np.float64))
    starts = blended(LOW_SPHERE, LOW_SPHERE.positions, points) + bake.cage * outward
    hits = Detail(high).first_front(starts, outward, 2 * bake.cage)
    truth = unit(np.einsum("rk,rkx->rx", hits.weights, high.normals[high.faces[hits.faces]]))
    smooth = unit(blended(LOW_SPHERE, LOW_SPHERE.normals, points))
    assert degrees(smooth, truth).mean() > 5  # measured 5.9 and 6.4
    error = degrees(shaded(bake, LOW_SPHERE, points), truth)
    assert error.mean() < 0.5  # measured 0.36 and 0.39; at 1024 texels 0.01


def test_mirrored_halves_share_their_texels_and_both_shade_right():
    """The right half of a plane shows the left half's texels, mirrored."""
    low = plane(segments=2)
    low = low._replace(uvs=np.stack([1 - np.abs(low.positions[:, 0]), low.uvs[:, 1]], -1))
    high = plane(segments=64)
    x = high.positions[:, 0].astype(np.float64)
    slope = 0.2 * np.sin(2 * x)
    normals = unit(np.stack([slope, np.ones_like(x), 0 * x + 0.3], -1))
    high = high._replace(normals=normals.astype(np.float32))
    bake = bake_normals(high, low, size=32, cage=0.1)
    assert bake.notes == ("1024 texels shared by mirrored faces: the others' detail is baked",)
    points = random_points(low, 5000)
    x = blended(low, low.positions, points)[:, 0].astype(np.float64)
    truth = unit(np.stack([0.2 * np.sin(2 * x), np.ones_like(x), 0 * x + 0.3], -1))
    inner = np.abs(np.abs(x) - 0.5) < 0.48  # at the chart's sides the texture repeats
    error = degrees(shaded(bake, low, points), truth)[inner]
    assert error.max() < 0.05  # measured 0.011
    assert (x > 0).any()
    assert (x < 0).any()


def test_given_tangents_are_kept():
    """With tangent and bitangent exchanged, so are x and y of the map."""
    high = plane(1.5)._replace(normals=np.tile(np.float32([0.36, 0.8, -0.48]), (4, 1)))
    low = plane()
    turned = low._replace(tangents=np.tile(np.float32([0, 0, -1, -1]), (4, 1)))
    straight, exchanged = (
        decoded(bake_normals(high, mesh, size=32, cage=0.3, samples=2)) for mesh in (low, turned)
    )
    np.testing.assert_allclose(exchanged, straight[..., [1, 0, 2]], atol=1e-6)


# Gutters and holes


def test_gutters_repeat_the_nearest_texel_and_the_rest_is_flat():
    low = with_uvs(plane(), factor=0.5, shift=0.25)
    high = plane(1.5)._replace(normals=np.tile(np.float32([0.6, 0.8, 0]), (4, 1)))
    bake = bake_normals(high, low, size=32, cage=0.1, margin=4)
    assert bake.charted[8:24, 8:24].all()
    assert bake.charted.sum() == 256
    near = degrees(decoded(bake), [0.6, 0, 0.8]) < 0.01
    flat = degrees(decoded(bake), [0, 0, 1]) < 0.01
    assert near[4:28, 8:24].all()
    assert near[8:24, 4:28].all()
    assert (near ^ flat).all()
    assert flat[:4].all()
    assert flat[4, 4]


def test_uncovered_texels_are_counted_and_filled():
    """The detailed plane ends before the low one does."""
    high = plane(0.75)._replace(normals=np.tile(np.float32([0.6, 0.8, 0]), (4, 1)))
    bake = bake_normals(high, plane(), size=32, cage=0.1, samples=2, margin=2)
    expected = np.zeros((32, 32), bool)
    expected[4:28, 4:28] = True
    np.testing.assert_array_equal(bake.found, expected)
    assert bake.charted.all()
    assert bake.missed == pytest.approx(1 - 0.75**2)
    assert len(bake.notes) == 1
    assert bake.notes[0].startswith("1792 of 4096 rays found no detail within 0.1 of")
    assert f"{32 * 32 - 24 * 24} texels" in bake.notes[0]
    near = degrees(decoded(bake), [0.6, 0, 0.8]) < 0.01
    assert near[2:30, 4:28].all()
    assert not near[:2].any()


def test_progress_is_told_to_the_end():
    said = []
    bake_normals(plane(1.5), plane(), size=32, samples=2, report=said.append)
    assert said[0] == "looking for the cage's distance"
    assert len(said) == 5


# Errors


def broken(mesh, field, value):
    values = np.array(getattr(mesh, field))
    values[0, 0] = value
    return mesh._replace(**{field: values})


SQUARE = plane()
BAD = {
    "no uvs": (SQUARE, SQUARE._replace(uvs=None), {}, "^l.obj: has no UVs"),
    "no uv area": (SQUARE, with_uvs(SQUARE, factor=0), {}, "^l.obj: no face has an area"),
    "nan uv": (SQUARE, broken(SQUARE, "uvs", np.nan), {}, "^l.obj: has UVs that are NaN"),
    "nan high": (broken(SQUARE, "positions", np.nan), SQUARE, {}, "^h.obj: has positions that"),
    "inf low": (SQUARE, broken(SQUARE, "positions", np.inf), {}, "^l.obj: has positions that"),
    "nan normal": (broken(SQUARE, "normals", np.nan), SQUARE, {}, "^h.obj: has normals that"),
    "missing vertex": (
        broken(SQUARE, "faces", 4),
        SQUARE,
        {},
        "^h.obj: expected faces from 0 to 3",
    ),
    "no face": (SQUARE._replace(faces=SQUARE.faces[:0]), SQUARE, {}, "^h.obj: has no faces"),
    "size": (SQUARE, SQUARE, {"size": 0}, "^bake_normals: size: expected 1 to 8192, got 0"),
    "samples": (SQUARE, SQUARE, {"samples": 17}, "samples: expected 1 to 16, got 17"),
    "margin": (SQUARE, SQUARE, {"margin": -1}, "margin: expected 0 to 8192, got -1"),
    "zero cage": (SQUARE, SQUARE, {"cage": 0.0}, "cage: expected a finite world length above 0"),
    "nan cage": (SQUARE, SQUARE, {"cage": np.nan}, "cage: .*got nan"),
    "elsewhere": (
        SQUARE._replace(positions=SQUARE.positions + np.float32(5)),
        SQUARE,
        {},
        "^h.obj: no ray from l.obj meets it",
    ),
    "tiny charts": (
        SQUARE,
        with_uvs(SQUARE, factor=1e-3, shift=0.5),
        {},
        "^l.obj: its faces reach no point of a map of 32 x 32 texels",
    ),
    "half of it": (
        plane(0.5),
        SQUARE,
        {"cage": 0.1},
        "^h.obj: 75% of the rays from l.obj do not meet it within 0.1",
    ),
}


@pytest.mark.errors
@pytest.mark.parametrize("flaw", BAD)
def test_what_cannot_be_baked(flaw):
    high, low, options, said = BAD[flaw]
    with pytest.raises(ValueError, match=said) as caught:
        bake_normals(high, low, **{"size": 32, "samples": 2, **options}, names=("h.obj", "l.obj"))
    assert "\n" not in str(caught.value)
