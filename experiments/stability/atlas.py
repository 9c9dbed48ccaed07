"""The whole catalogue: what is measured for each row, and why two rows have nothing to measure."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from . import frame_rows, layout_rows, map_rows, texel_rows
from .cells import Cell
from .shadow_rows import ROWS, measure_row
from .sweeps import SWEEPS

FLOATS = (np.float32, np.float64)

# Rows of techniques that the toolkit does not have.
ABSENT = {
    16: "the toolkit has no convolution shadow maps",
    21: "the toolkit has no dual paraboloid maps; points have cubes",
}
# What else the catalogue names of rows that are measured.
MISSING = {
    10: "no light-bleeding reduction but VSM's own number",
    13: "no float16 maps",
    15: "no float16 maps",
    22: "no perspective warps (LiSPSM, TSM, PSM)",
    32: "no cotangent frames by differences of pixels",
}


class Task(NamedTuple):
    """A part of the atlas that is measured and stored at once.

    Attributes:
        name: Of a scene, of what stands for one, or of a parameter.
        rows: Of the catalogue.
        measure: From a type of floats, and whether few techniques will do, to cells.
        sweep: Whether it varies a parameter.
        dtypes: Types that it is measured in.
        slow: Left out of quick runs, for what compiling it takes.
    """

    name: str
    rows: tuple[int, ...]
    measure: Callable[[Any, bool], list[Cell]]
    sweep: bool = False
    dtypes: tuple[Any, ...] = FLOATS
    slow: bool = False


def _of_row(row: Any) -> Task:
    measure = lambda dtype, quick: measure_row(row, dtype, quick=quick)
    return Task(row.scene, (row.row,), measure, slow=row.scene == "room")


def _plain(function: Callable[[Any], list[Cell]], dtype: Any, quick: bool) -> list[Cell]:
    del quick
    return function(dtype)


def _of(name: str, rows: tuple[int, ...], function: Any, **more: Any) -> Task:
    return Task(name, rows, functools.partial(_plain, function), **more)


TASKS: tuple[Task, ...] = (
    *map(_of_row, ROWS),
    _of("three-layers", (11,), texel_rows.three_layers),
    _of("ends-of-depth", (13,), texel_rows.overflow),
    _of("one-depth", (14,), texel_rows.single_depths),
    _of("half-precision", (15,), texel_rows.half_precision),
    _of("tall-and-short", (17,), layout_rows.penumbrae),
    _of("duelling-frusta", (22,), layout_rows.duelling),
    _of("panning-camera", (23,), layout_rows.panning),
    _of("avenue", (24,), layout_rows.seams),
    _of("grazing-normal-map", (29,), layout_rows.hard_terminator),
    _of("mirrored-strip", (31,), frame_rows.mirrored_strip),
    _of("equal-uvs", (32,), frame_rows.equal_uvs),
    _of("collinear-sliver", (33,), frame_rows.collinear_sliver),
    _of("duplicate-vertex", (34,), frame_rows.zero_area),
    _of("pole-cap", (35,), frame_rows.pole),
    _of("sheared-uvs", (36,), frame_rows.sheared),
    _of("knob", (37,), frame_rows.green),
    _of("split-quads", (38,), frame_rows.other_cut),
    _of("wide-triangles", (39,), frame_rows.unit_per_pixel),
    _of("glossy-bumps", (40,), map_rows.glossy_mips, dtypes=(np.float32,)),
    _of("no-gutter", (41,), map_rows.light_map_seams, slow=True),
    _of("hard-gradient", (42,), map_rows.hard_gradient),
    _of("softness-of-fits", (43,), map_rows.fits),
    *(_of(name, (), sweep, sweep=True) for name, sweep in SWEEPS.items()),
)
