"""The least model of a scene that meets a tolerance: theory, search, and the proof."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from ..frontier.programs import Programs
from ..scene import Scene
from .bench import Bench, Measured, Stage
from .choice import Choice, choose
from .models import Model, all_models, filters
from .search import Search, Tried
from .sight import Measure, Sight, look_at_scene, shown
from .theory import Theory


class Simplest(NamedTuple):
    """The least model that meets a tolerance, and what says so.

    Attributes:
        model: Its name and parts.
        choice: The same, ready to render.
        error: Of the picture that ``choice.render`` makes, measured once more.
        cost: Time of its stages, ms.
        tolerance: What was asked for.
        measure: What errors are.
        failed: Of the measured models that cost less, the one that comes closest.
        further: The cheapest measured model that is better; None where none is.
        tried: All that were measured, in their order.
        skipped: Why each of the others was not, by the model.
        sight: The scene and its truth.
        slope: Of its constant biases, see ``bias_words``.
        stages_ms: Time of each of the model's stages.
    """

    model: Model
    choice: Choice
    error: float
    cost: float
    tolerance: float
    measure: Measure
    failed: Tried | None
    further: Tried | None
    tried: tuple[Tried, ...]
    skipped: dict[Model, str]
    sight: Sight
    slope: float
    stages_ms: dict[Stage, float]


class OutOfReach(ValueError):
    """No model meets the tolerance; carries the best there is."""

    def __init__(self, text: str, best: Tried) -> None:
        """Say what is out of reach."""
        super().__init__(text)
        self.best = best


def simplest(
    scene: Scene,
    tolerance: float,
    *,
    measure: Measure = "rmse",
    budget_ms: float = np.inf,
    techniques: Sequence[str] = (),
    image_size: int = 512,
    runs: int = 5,
    programs: Programs | None = None,
    tell: Callable[[str], None] = lambda text: None,
) -> Simplest:
    """Find the cheapest model whose picture is close enough to truth.

    Args:
        scene: As it was loaded.
        tolerance: Largest error, in the measure's unit.
        measure: Of the picture, see ``Sight.error``.
        budget_ms: Most that the model may cost.
        techniques: Names of filters to choose from; none for all.
        image_size: Pixels on each side of the picture.
        runs: Of each stage that is timed.
        programs: Compiled so far; None for none.
        tell: Is told what is measured.

    Raises:
        ValueError: If the tolerance or budget has no sense, there is no such filter, or a light
            cannot be mapped.
        OutOfReach: If no model meets the tolerance, or none within the budget.
    """
    if not tolerance >= 0:
        raise ValueError(f"simplest: expected a `tolerance` of at least 0, got {tolerance:g}")
    if not budget_ms > 0:
        raise ValueError(f"simplest: expected a budget above 0 ms, got {budget_ms:g}")
    filters(tuple(techniques))
    tell("truth")
    sight = look_at_scene(scene, image_size)
    theory = Theory(sight, measure)
    models = all_models(sight.looks, sight.layout, techniques)
    bench = Bench(
        sight,
        theory.slope,
        measure=measure,
        runs=runs,
        programs=Programs() if programs is None else programs,
    )
    search = Search(sight, theory, models, measure)
    errors: dict[int, float] = {}

    def measured(k: int) -> Measured:
        tell(search.models[k].name)
        return bench.measure(search.models[k])

    def confirm(k: int) -> float:
        # The picture that the user gets is fused otherwise, and rounds otherwise.
        tell(f"checking {search.models[k].name}")
        choice = choose(search.models[k], sight, theory.slope)
        picture = shown(np.asarray(choice.render(sight.scene, image_size).color))
        errors[k] = sight.error(picture, measure)
        return errors[k]

    end = search.run(measured, tolerance=tolerance, budget=budget_ms, confirm=confirm)
    if end is None:
        raise out_of_reach(search, tolerance, budget_ms)
    model = search.models[end.best]
    return Simplest(
        model, choose(model, sight, theory.slope), errors[end.best], search.tried[end.best].cost,
        tolerance, measure, search.told(end.failed), search.told(end.further),
        tuple(t for t in map(search.told, search.tried) if t is not None),
        search.reasons(end.best, tolerance), sight, theory.slope, bench.measure(model).ms,
    )  # fmt: skip


def out_of_reach(search: Search, tolerance: float, budget: float) -> OutOfReach:
    """Return what to say where a search found none: the best of those within the budget."""
    within = [k for k, found in search.tried.items() if found.cost <= budget]
    costly = "" if np.isinf(budget) else f" within {budget:g} ms"
    pool = within or list(search.tried)
    best = search.told(min(pool, key=lambda k: search.tried[k].error))
    assert best is not None
    if not within:
        least = min(found.cost for found in search.tried.values())
        text = f"no model costs at most {budget:g} ms; the cheapest tried costs {least:.3g} ms"
        return OutOfReach(text, best)
    reachable = f"the best reachable is {best.error:.4g} by {best.model.name}"
    text = f"no model reaches {tolerance:g}{costly}; {reachable} ({best.cost:.3g} ms)"
    return OutOfReach(text, best)
