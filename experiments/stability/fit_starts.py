"""From how many starts a fit of a bias ends at the best: by softness, noise and distance.

The best is the sweep's. A fit has reached it if its error under hard comparison, against
clean truth, is at most 1.05 times that.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from shadows.bias import CombinedBias, ConstantBias, SlopeBias
from shadows.window_filters import BilinearFilter
from tangentspace.shading import BlinnPhongShading

from ..bias_fits.bias_study import Study, TruthGoal, prepare_study
from ..bias_fits.fit_bias import LEVELS, fit_bias_from
from ..bias_fits.sweep_bias import sweep_bias
from ..scenes import load_scene

_REACHED = 1.05
_FILTER, _TERMS = BilinearFilter(), CombinedBias((ConstantBias(), SlopeBias()))


class Setting(NamedTuple):
    """How fits are made.

    Attributes:
        levels: Softness of each solve, half texels.
        scale: Starts are drawn evenly from zero to so many steps of each number: texel
            footprints of the constant, times the slope.
        noise: Share of pixels whose truth is turned round.
    """

    levels: tuple[float, ...] = LEVELS
    scale: float = 8.0
    noise: float = 0.0


USUAL = Setting()
SETTINGS = (
    USUAL,
    *(Setting(levels=(softness,)) for softness in (10.0, 1.0, 0.1, 0.01)),
    *(Setting(scale=scale) for scale in (1.0, 64.0)),
    *(Setting(noise=noise) for noise in (0.01, 0.1)),
)


def fit_starts(
    scene: str,
    *,
    starts: int = 100,
    others: int = 20,
    image_size: int = 512,
    settings: Sequence[Setting] = SETTINGS,
) -> list[dict[str, Any]]:
    """Return a row for each setting.

    Args:
        scene: Embedded scene or mesh file, with a hard light.
        starts: How many of the usual setting.
        others: How many of each other one.
        image_size: Pixels on each side; the map has twice as many texels.
        settings: How fits are made.
    """
    study = prepare_study(
        load_scene(scene),
        image_size=(image_size, image_size),
        map_size=2 * image_size,
        filter=_FILTER,
        shading=BlinnPhongShading(),
    )
    best = sweep_bias(study.trial, _TERMS, _FILTER).error
    return [_row(study, s, starts if s == USUAL else others, best) for s in settings]


def _row(study: Study, setting: Setting, starts: int, best: float) -> dict[str, Any]:
    rng = np.random.default_rng(0)
    goal = study.trial.goal
    assert isinstance(goal, TruthGoal)
    truth = np.asarray(goal.truth)
    turned = rng.uniform(size=truth.shape) < setting.noise
    noisy = np.where(turned, 1 - truth, truth)
    trial = study.trial._replace(goal=TruthGoal(jnp.asarray(noisy), goal.surface_count))
    fits = fit_bias_from(
        trial,
        _TERMS,
        _FILTER,
        list(rng.uniform(0, setting.scale, (starts, 2))),
        levels=setting.levels,
    )
    errors = np.array([study.objective(fit.techniques) for fit in fits])
    return {
        "scene": study.scene.name,
        "levels": " ".join(f"{softness:g}" for softness in setting.levels),
        "scale": setting.scale,
        "noise": setting.noise,
        "starts": starts,
        "reached": float(np.mean(errors <= _REACHED * best)),
        "best_error": best,
        "median_error": float(np.median(errors)),
        "worst_error": float(errors.max()),
        "steps": float(np.median([fit.steps for fit in fits])),
    }
