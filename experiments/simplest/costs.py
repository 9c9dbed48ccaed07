"""What models are expected to cost: from counts of operations, corrected by what was timed.

Only ratios of the counts matter: a stage that was timed tells by how much the others of its
kind, and best those of its filter, are cheaper or dearer on this machine and scene.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from shadows.disc_filters import PoissonFilter
from shadows.layouts import CubeLayout
from shadows.pcss_filter import PCSSFilter
from shadows.window_filters import WindowFilter

from .bench import Stage, stages, techniques
from .models import Model
from .sight import Sight


class Costs:
    """Expects the time of stages, and learns."""

    def __init__(self, sight: Sight) -> None:
        """Begin with counts of operations alone."""
        self._pixels = sight.covered.size * len(sight.seen)
        self._maps = (6 if isinstance(sight.layout, CubeLayout) else 1) * len(sight.seen)
        self._faces = len(sight.scene.mesh.faces)
        self._timed: dict[Stage, float] = {}
        self._counted: dict[Stage, float] = {}

    def learn(self, ms: Mapping[Stage, float]) -> None:
        """Take in the time of stages."""
        self._timed |= ms

    def expect(self, models: Sequence[Model]) -> np.ndarray:
        """Return the time of models in ms, as well as it is known."""
        known: dict[Stage, float] = {}
        for stage in {stage for model in models for stage in stages(model)}:
            known[stage] = self._stage(stage)
        return np.array([sum(known[stage] for stage in stages(model)) for model in models])

    def _stage(self, stage: Stage) -> float:
        if stage in self._timed:
            return self._timed[stage]
        same_kind = [other for other in self._timed if other[0] == stage[0]]
        nearest = [other for other in same_kind if other[1] == stage[1]] or same_kind
        ratios = [self._timed[other] / self._count(other) for other in nearest]
        return self._count(stage) * float(np.exp(np.mean(np.log(ratios or [1.0]))))

    def _count(self, stage: Stage) -> float:
        """Return the operations of a stage, in what may be ms."""
        if stage not in self._counted:
            self._counted[stage] = 1e-6 * self._operations(*stage)
        return self._counted[stage]

    def _operations(self, kind: str, name: str, size: str = "0", bias: str = "none") -> float:
        if kind == "draw":
            return self._maps * (10.0 * self._faces + 8.0 * int(name) ** 2 + 1e6)
        if kind == "shade":
            return self._pixels * (40.0 if name == "normal map" else 10.0)
        filter, _ = techniques(Model("plain", name, int(size), bias), 1.0)
        if kind == "prepare":
            return 3e4 + (self._maps * 4.0 * int(size) ** 2 if not filter.needs_bias else 0)
        taps = 8.0
        if isinstance(filter, PCSSFilter):
            taps = 4.0 * 8 * (filter.taps + filter.search_taps)
        elif isinstance(filter, PoissonFilter):
            taps = 4.0 * 4 * filter.taps
        elif isinstance(filter, WindowFilter):
            taps = (2.0 * float(filter.reach())) ** 2
        return self._pixels * (8 + taps * (1.3 if bias == "adaptive" else 1.0))
