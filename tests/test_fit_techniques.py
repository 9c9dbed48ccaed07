"""Fits of numbers that are no bias: of filters and comparisons, recovered from an image."""

import jax
import numpy as np
import pytest

from experiments.bias_fits.bias_space import free_numbers
from experiments.bias_fits.bias_study import prepare_study, with_target
from experiments.bias_fits.fit_bias import fit_bias
from experiments.scenes import load_scene
from shadows import (
    AdaptiveBias,
    AnalyticBias,
    BilinearFilter,
    CombinedBias,
    HardCompare,
    PCSSFilter,
    PoissonFilter,
    SlopeBias,
    SoftCompare,
    VSMFilter,
)
from tangentspace.shading import BlinnPhongShading

ADAPTIVE, ANALYTIC = CombinedBias((AdaptiveBias(),)), CombinedBias((AnalyticBias(),))
SLOPE, HARD, SOFT = CombinedBias((SlopeBias(2.0),)), HardCompare(), SoftCompare(0.5)
# Bias, filter and comparison: as they were in truth, as a fit starts, and what is free.
CASES = {
    "poisson radius": (
        (ADAPTIVE, PoissonFilter(4.0), SOFT),
        (ADAPTIVE, PoissonFilter(1.5), SOFT),
        "poisson.radius",
    ),
    "light size": (
        (ADAPTIVE, PCSSFilter(0.3), SOFT),
        (ADAPTIVE, PCSSFilter(0.15), SOFT),
        "pcss.light_size",
    ),
    "softness": (
        (SLOPE, BilinearFilter(), SoftCompare(2.0)),
        (SLOPE, BilinearFilter(), SOFT),
        "soft.softness",
    ),
    "variance map": (
        (ANALYTIC, VSMFilter(bleeding=0.3), HARD),
        (ANALYTIC, VSMFilter(bleeding=0.1), HARD),
        "vsm.bleeding",
    ),
}


def recover(case):
    """Return the true number, and the fit to the image that it gives."""
    true, (bias, filter, compare), name = CASES[case]
    study = prepare_study(
        load_scene("sphere"),
        image_size=(64, 64),
        map_size=128,
        filter=filter,
        shading=BlinnPhongShading(),
        bias=bias,
        compare=compare,
    )
    study = with_target(study, study.picture(study.visibility(true)))
    fit = fit_bias(study.trial, bias, filter, free=[name], compare=compare)
    technique = next(t for t in true[1:] if name.startswith(type(t).__name__[:3].lower()))
    return getattr(technique, name.partition(".")[2]), fit


@pytest.mark.parametrize("case", CASES)
def test_a_number_is_recovered_from_the_image_it_gave(case):
    with jax.enable_x64(False):
        true, fit = recover(case)
    (value,) = fit.values.values()
    assert value == pytest.approx(true, rel=1e-3)  # measured 1e-6
    assert fit.error < 1e-5  # measured 6e-8
    assert len(fit.levels) == 1
    assert np.isfinite([float(leaf) for leaf in jax.tree.leaves(fit.techniques)]).all()
    assert fit.untold == ()


def test_names_of_all_techniques_can_be_free():
    names = free_numbers(SLOPE, ["slope.factor", "poisson.radius"], filter=PoissonFilter())
    assert names == ("slope.factor", "poisson.radius")
    assert free_numbers(SLOPE, None, filter=PoissonFilter(), compare=SOFT) == ("slope.factor",)
    assert free_numbers(CombinedBias(), ["soft.softness"], compare=SOFT) == ("soft.softness",)
    with pytest.raises(ValueError, match=r"free poisson\.radis: no such number; did you mean"):
        free_numbers(SLOPE, ["poisson.radis"], filter=PoissonFilter())
    with pytest.raises(ValueError, match=r"free pcf\.radius: no such number"):
        free_numbers(SLOPE, ["pcf.radius"], filter=BilinearFilter())
