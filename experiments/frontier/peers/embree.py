"""Embree: rays from our surface points to points of the light.

The truth that all are judged by is traced the same way, so under lights without a size the
error is 0 by construction: its place on the chart is the cost of an exact answer. Under an area
light truth has 64 rays to each point. One goes to the light's centre; a few make bands, since
they go to the same points of the light from each pixel.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from shadows.area_lights import AreaLight

from ...truth.area import area_visibility
from ...truth.rays import Occluders, trace_visibility
from ..view import View
from .peer import Image, Peer, Work


@dataclass(frozen=True)
class Embree(Peer):
    """Rays to a lattice of points on the light, through embreex, one after another.

    Attributes:
        samples: Points of the light.
    """

    samples: int
    technique: ClassVar[str] = "embree"
    note: ClassVar[str] = "traces truth itself: no error under lights without a size"

    @property
    def label(self) -> str:
        """Name with its rays."""
        return f"embree {self.samples} ray{'s' if self.samples > 1 else ''}"

    @classmethod
    def absent(cls) -> str | None:
        """Return None: truth needs it too."""
        return None

    def applies(self, view: View) -> bool:
        """Whether more rays than one have something to find."""
        return view.soft or self.samples == 1

    @contextmanager
    def open(self, view: View) -> Iterator[Work]:
        """Take mesh and points as they are."""
        mesh, surface, light = view.scene.mesh, view.surface, view.light
        position, normal = np.asarray(surface.position), np.asarray(surface.face_normal)
        points = position, normal, np.asarray(surface.face_ids)
        occluders: Occluders | None = None

        def prepare() -> None:
            nonlocal occluders
            occluders = Occluders(np.asarray(mesh.positions), np.asarray(mesh.faces))

        def image() -> Image:
            assert occluders is not None
            if isinstance(light, AreaLight) and self.samples > 1:
                seen = area_visibility(*points, light, occluders, samples=self.samples)
            else:
                seen = trace_visibility(*points, light, occluders)
            return seen.astype(np.float32)

        yield Work(image, prepare=prepare)
