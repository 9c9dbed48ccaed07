"""The failure catalogue as scenes: for each row what to look at, and what fails on it.

A scene is a function that makes it, with the row's variable as an argument where it has one
(the tilt of a plane, the thickness of a wall); the table holds the defaults. Rows are those of
the catalogue of 43 known failures of shadow maps, tangent frames and fits.

These rows are no scenes. 11, 13, 14, 15: distributions of depths within a texel, which are
numbers, not geometry. 16, 21: convolution shadow maps and dual paraboloids, which there are
none of. 37: a convention of normal maps, which any mapped scene shows if it is broken. 42, 43:
how fits behave on the scene of row 1.
"""

from collections.abc import Callable
from typing import NamedTuple

from ..scene import Scene
from . import bias_failures as bias
from . import frame_failures as frames
from . import light_failures as lights
from .layout_scenes import avenue, room


class Failure(NamedTuple):
    """A row of the catalogue.

    Attributes:
        row: Its number.
        make: Makes its scene.
        fails: What fails there, and how that looks.
    """

    row: int
    make: Callable[[], Scene]
    fails: str


FAILURES: dict[str, Failure] = {
    "tilted-plane": Failure(1, bias.tilted_plane, "no bias: stripes on half of the plane"),
    "turned-plane": Failure(2, bias.turned_plane, "a bias by the larger slope: diagonal acne"),
    "contact-wall": Failure(3, bias.contact_wall, "offsets in depth or space: detached shadow"),
    "contact-plate": Failure(3, bias.contact_plate, "offsets in depth or space: lost shadow"),
    "box-corner": Failure(4, bias.box_corner, "back faces in the map: light at the contact"),
    "open-fold": Failure(4, bias.open_fold, "back faces or midpoints in the map: no shadow"),
    "thin-wall": Failure(5, bias.thin_wall, "any bias above the thickness: light through it"),
    "coarse-sphere": Failure(6, bias.coarse_sphere, "constant and slope bias: rings of acne"),
    "wide-kernel": Failure(7, bias.wide_kernel, "wide filters with one depth: bands of acne"),
    "crease": Failure(8, bias.crease, "receiver planes: dark or lit lines at the edges"),
    "edge-on-triangle": Failure(9, bias.edge_on_triangle, "receiver planes: NaN, random pixels"),
    "two-occluders": Failure(10, lights.two_occluders, "VSM, ESM, EVSM2: light in the umbra"),
    "contact-halo": Failure(12, lights.contact_halo, "ESM, soft comparison: light at the feet"),
    "tall-and-short": Failure(17, lights.tall_and_short, "PCSS: jump of the penumbra's width"),
    "near-far": Failure(18, lights.near_far, "bias in depth units: acne far, detached near"),
    "behind-spot": Failure(19, lights.behind_spot, "naive projection: light and shadow mirrored"),
    "room": Failure(20, room, "filters on cube maps: dark lines where faces meet"),
    "duelling-frusta": Failure(22, lights.duelling_frusta, "one map, warped or not: coarse near"),
    "panning-camera": Failure(23, lights.panning_camera, "unsteady cascades: crawling edges"),
    "avenue": Failure(24, avenue, "cascades: a seam where one map ends"),
    "near-plane-triangle": Failure(25, lights.near_plane_triangle, "no clipping: wrong shadow"),
    "t-junction": Failure(26, lights.t_junction, "volumes, fill rules: lines of light"),
    "eye-in-shadow": Failure(27, lights.eye_in_shadow, "volumes counted from the eye: inverted"),
    "low-poly-sphere": Failure(28, frames.low_poly_sphere, "any shadow: dark blocks"),
    "grazing-normal-map": Failure(29, frames.grazing_normal_map, "any shadow: hard terminator"),
    "bent-normals": Failure(30, bias.bent_normals, "offset along smooth normals: lost shadow"),
    "mirrored-strip": Failure(31, frames.mirrored_strip, "frames by index: tangents cancel"),
    "equal-uvs": Failure(32, frames.equal_uvs, "most frames: NaN or black"),
    "collinear-sliver": Failure(33, frames.collinear_sliver, "MikkTSpace: zero tangents"),
    "duplicate-vertex": Failure(34, frames.duplicate_vertex, "unguarded norms: NaN gradients"),
    "pole-cap": Failure(35, frames.pole_cap, "frames by vertex: a swirl at the pole"),
    "sheared-uvs": Failure(36, frames.sheared_uvs, "orthonormal frames: lighting turned"),
    "split-quads": Failure(38, frames.split_quads, "a map baked on the other cut: crosses"),
    "wide-triangles": Failure(39, frames.wide_triangles, "frames made unit per pixel: shading"),
    "glossy-bumps": Failure(40, frames.glossy_bumps, "plain mips of normals: too bright"),
    "no-gutter": Failure(41, frames.no_gutter, "light maps: seams bleed"),
}
FAILURE_SCENES: dict[str, Callable[[], Scene]] = {
    name: failure.make for name, failure in FAILURES.items()
}
