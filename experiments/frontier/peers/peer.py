"""What peers have in common: what they are asked, and how their errors and costs are taken."""

import abc
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from types import MappingProxyType
from typing import Any, ClassVar, NamedTuple

import numpy as np
from jaxtyping import Array, Float

from shadows.lights import Light
from shadows.render import shade
from shadows.surface import Surface

from ...metrics import soft_shadow_errors
from ..errors import errors
from ..pictures import picture
from ..programs import Programs, Timed, time_stages
from ..view import View

INSTALL = "pip install 'tangentspace[peers]'"
Image = Float[np.ndarray, "height width"]
_NO_BIAS: Mapping[str, Callable[[], None]] = MappingProxyType({"none": lambda: None})


class Work(NamedTuple):
    """A peer at work on a view; each part runs to its end, in this order.

    Attributes:
        image: Returns the visibility at the view's surface points; any value where the
            light is not faced.
        draw: The light's pass, for those that have one.
        prepare: What rays are traced through, for those that trace.
        biases: The biases that are tried: by their names, what sets them.
        kept_bytes: What lies in memory between images, where it is known.
    """

    image: Callable[[], Image]
    draw: Callable[[], None] | None = None
    prepare: Callable[[], None] | None = None
    biases: Mapping[str, Callable[[], None]] = _NO_BIAS
    kept_bytes: int | None = None


class Peer(abc.ABC):
    """A renderer with its number of samples or size of map.

    Attributes:
        kind: Of the row in the table.
        technique: Name of the renderer.
        note: What a reader of the chart should know about it, one sentence.
    """

    kind: ClassVar[str] = "peer"
    technique: ClassVar[str]
    note: ClassVar[str]

    @property
    @abc.abstractmethod
    def label(self) -> str:
        """Name with its samples, ``embree 4 rays``."""

    @property
    def map_size(self) -> int | None:
        """Texels on each side of its shadow map; None without one."""
        return None

    @property
    def name(self) -> str:
        """As in tables, ``opengl 2x2 @ 256``; tells peers apart."""
        return self.label if self.map_size is None else f"{self.label} @ {self.map_size}"

    @classmethod
    @abc.abstractmethod
    def absent(cls) -> str | None:
        """Return why it cannot run here and what helps; None if it can."""

    @abc.abstractmethod
    def applies(self, view: View) -> bool:
        """Whether it can answer for a view, and has not answered with fewer samples."""

    @abc.abstractmethod
    def open(self, view: View) -> AbstractContextManager[Work]:
        """Load a view; neither that nor its end counts as cost."""

    def visibility(self, view: View) -> tuple[Image, str]:
        """Return its visibility, 0 where the light is not faced, and its best bias."""
        covered = np.asarray(view.surface.covered)
        best: tuple[float, Image, str] | None = None
        with self.open(view) as work:
            for bias, choose in work.biases.items():
                choose()
                for stage in (work.draw, work.prepare):
                    if stage is not None:
                        stage()
                seen = _faced(view, work)
                rmse = soft_shadow_errors(seen, view.share, covered).rmse
                if best is None or rmse < best[0]:
                    best = rmse, seen, bias
        assert best is not None
        return best[1:]

    def accuracy(self, view: View, programs: Programs) -> tuple[dict[str, Any], bytes]:
        """Return how wrong it is, as of shadow filters, and its picture; it has no gradient."""
        visibility, bias = self.visibility(view)
        color = np.asarray(_shaded(view, programs, visibility))
        figures = errors(view, visibility, color) | {"gradient_error": None, "bias": bias}
        return figures, picture(view, visibility, color)

    def timing(self, view: View, programs: Programs, *, runs: int) -> dict[str, Any]:
        """Return what it costs, as of shadow filters; None for stages that it lacks.

        The image is the visibility, brought to where ours is, and the same shading as ours.
        What they compile they keep as they like, also on disk, so that is not known.

        Args:
            view: Where.
            programs: Compiled so far; for the shading.
            runs: Of each stage, as ``time_stages`` takes them.
        """
        with self.open(view) as work:
            next(iter(work.biases.values()))()
            stages = {
                "draw": work.draw and _timed(work.draw),
                "prepare": work.prepare and _timed(work.prepare),
                "image": _timed(lambda: _shaded(view, programs, _faced(view, work))),
                "gradient": None,
            }
            return {"stages": time_stages(stages, runs=runs), "kept_bytes": work.kept_bytes}


def _faced(view: View, work: Work) -> Image:
    return np.where(view.facing, work.image(), np.float32(0))


def _shaded(view: View, programs: Programs, visibility: Image) -> Float[Array, "height width 3"]:
    return programs.get("shade", _shade, view.surface, view.light, np.float32(visibility))()


def _shade(
    surface: Surface, light: Light, visibility: Float[Array, "height width"]
) -> Float[Array, "height width 3"]:
    return shade(surface, (light,), (visibility,))


def _timed(stage: Callable[[], Any]) -> Timed:
    """Return a stage ready for ``time_stages``."""
    return Timed(stage, {"compile_s": None, "temporary_bytes": None}, ())
