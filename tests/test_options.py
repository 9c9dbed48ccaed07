import abc
import re

import equinox as eqx
import pytest

from experiments.options import (
    describe,
    hint,
    join_options,
    numbers,
    parse_technique,
    parse_techniques,
    technique_name,
    techniques,
)
from shadows.bias import Bias, CombinedBias, ConstantBias, NormalOffsetBias, SlopeBias
from shadows.compare import Compare, HardCompare, SoftCompare
from shadows.filters import Filter, NearestFilter
from shadows.layer_bias import MidpointBias
from shadows.layouts import CubeLayout, Layout
from shadows.window_filters import PCFFilter, WindowFilter


class Toy(eqx.Module):
    """A base with a class that is ready, one that is abstract and one that holds others."""


class Halfway(Toy):
    """Not ready.

    Attributes:
        width: Of something.
    """

    width: float = eqx.field(default=3.0, metadata={"unit": "feet"})

    @abc.abstractmethod
    def walk(self):
        """Do nothing."""


class LongWayToy(Halfway):
    """Ready. With a second sentence."""

    height: float = eqx.field(default=0.5, metadata={"unit": "inches"})

    def walk(self):
        """Do nothing."""


class ManyToy(Toy):
    """Holds others."""

    toys: tuple[Toy, ...] = ()


def test_words_become_techniques_in_their_order():
    words = ["slope", "constant=0.02", "slope.factor=1.5"]
    assert parse_techniques(Bias, words, option="--bias") == (SlopeBias(1.5), ConstantBias(0.02))


def test_what_is_not_said_keeps_its_default():
    made = parse_techniques(Bias, ["constant", "slope", "normal-offset"], option="--bias")
    assert made == (ConstantBias(0.0), SlopeBias(2.0), NormalOffsetBias(1.0))
    assert parse_techniques(Bias, [], option="--bias") == ()
    assert parse_technique(Compare, ["soft"], option="--compare") == SoftCompare(0.5)


def test_every_technique_of_shadows_is_found():
    assert {"constant": ConstantBias, "midpoint": MidpointBias}.items() <= techniques(Bias).items()
    assert techniques(Compare) == {"hard": HardCompare, "soft": SoftCompare}
    assert {"nearest": NearestFilter, "pcf": PCFFilter}.items() <= techniques(Filter).items()
    assert techniques(Layout)["cube"] is CubeLayout
    assert CombinedBias not in techniques(Bias).values()
    assert WindowFilter not in techniques(Filter).values()


def test_a_new_class_is_found_by_its_name():
    assert techniques(Toy) == {"long-way": LongWayToy}
    assert technique_name(LongWayToy) == "long-way"
    made = parse_technique(Toy, ["long-way.height=7"], option="--toy")
    assert made == LongWayToy(3.0, 7.0)
    assert parse_technique(Toy, ["long-way=7"], option="--toy") == LongWayToy(7.0, 0.5)


def test_a_description_names_numbers_defaults_and_units():
    (line,) = describe(Toy)
    assert line.startswith("long-way (")
    assert line.endswith("): Ready. With a second sentence")
    for part in ("width", "3.0 feet", "height", "0.5 inches"):
        assert part in line
    names = [line.partition(": ")[0].partition(" (")[0] for line in describe(Bias)]
    assert names == [*techniques(Bias)]


def test_numbers_have_their_unit_and_full_name():
    assert numbers(SlopeBias(1.5)) == {"slope.factor": (1.5, "texel footprints")}
    assert numbers(SlopeBias(1.5, unit="reach")) == {"slope.factor": (1.5, "reaches of the filter")}
    assert numbers(PCFFilter(2)) == {}  # a whole number is not fitted
    assert numbers(HardCompare()) == {}


def test_words_and_whole_numbers_are_options_too():
    words = ["constant.unit=reach", "constant=2", "slope"]
    made = parse_techniques(Bias, words, option="--bias")
    assert made == (ConstantBias(2.0, unit="reach"), SlopeBias())
    assert parse_technique(Filter, ["pcf", ".radius=3"], option="--filter") == PCFFilter(3)
    for word, says in (
        ("pcf=1.5", "expected a whole number, got 1.5"),
        ("pcf=-1", "pcf: PCFFilter: expected `radius` to be a whole number of texels from 0 to 16"),
        (".radius=1", "--filter.radius: of which technique"),
    ):
        with pytest.raises(ValueError, match=says):
            parse_technique(Filter, [word], option="--filter")
    with pytest.raises(ValueError, match="expected world or texel or reach, got 'inch'"):
        parse_techniques(Bias, ["slope.unit=inch"], option="--bias")


def test_options_of_a_technique_join_its_words():
    options = ("--filter", "--bias")
    line = "render s --filter.radius 2 --filter pcf --out a --bias.unit=reach --bias slope"
    joined = "render s --filter pcf .radius=2 --out a --bias slope .unit=reach"
    assert join_options(line.split(), options) == joined.split()
    assert join_options(["--filter.radius", "--out"], options) == ["--out", "--filter", ".radius="]
    assert join_options(["--image.size", "3"], options) == ["--image.size", "3"]


@pytest.mark.parametrize(
    ("word", "says"),
    [
        ("slop=1", "no such technique 'slop'; did you mean 'slope'?"),
        ("", "no such technique ''; choose from: constant, "),
        ("slope.fctor=1", "'slope' has no such option; did you mean 'factor'?"),
        ("slope.factor.x=1", "has no such option"),
        ("slope.factor", "expected a number after '=', got ''"),
        ("slope=", "expected a number after '=', got ''"),
        ("slope=two", "expected a number after '=', got 'two'"),
        ("slope=1=2", "expected a number after '=', got '1=2'"),
        ("slope=nan", "expected a finite number, got nan"),
        ("slope=-inf", "expected a finite number, got -inf"),
        ("slope=1e39", "expected a finite number, got 1e39"),  # infinite in single precision
        ("slope=-0.5", "expected a number of at least 0, got -0.5"),
    ],
)
def test_a_word_that_is_not_understood_is_named(word, says):
    with pytest.raises(ValueError, match=f"^--bias {re.escape(word)}: .*{re.escape(says)}"):
        parse_techniques(Bias, ["constant", word], option="--bias", least=0.0)


def test_a_number_for_a_technique_without_numbers_is_refused():
    with pytest.raises(ValueError, match="--compare hard=1: 'hard' has no such option"):
        parse_technique(Compare, ["hard=1"], option="--compare")


def test_numbers_may_be_negative_where_nothing_forbids_it():
    assert parse_techniques(Bias, ["constant=-1"], option="--bias") == (ConstantBias(-1.0),)


def test_hint():
    assert hint("spehre", ["spot", "sphere"]) == "did you mean 'sphere'?"
    assert hint("xyz", ["spot", "sphere"]) == "choose from: spot, sphere"
    assert hint("xyz", []) == "choose from: none"
