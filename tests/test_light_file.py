"""Lights from text: what the format allows, and one clear line for what it does not."""

import numpy as np
import pytest

from experiments.files.light_file import read_lights
from shadows import DirectionalLight

from .tools import assert_close

WHITE = np.ones(3, np.float32)


@pytest.fixture
def lights_of(tmp_path):
    """Read lights from a text."""
    path = tmp_path / "lights.txt"

    def read(text):
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return read_lights(path)

    return read


def unit(*vector):
    return np.array(vector) / np.linalg.norm(vector)


def test_one_light_a_line(lights_of):
    """Comments and empty lines do not count; directions need not have unit length."""
    lights = lights_of("# x y z\n0 0 2\n\n  3 0 -4   # low\n1 2 3 0.5 0 4e-1\n\t\n")
    assert all(isinstance(light, DirectionalLight) for light in lights)
    expected = [(unit(0, 0, 1), WHITE), (unit(3, 0, -4), WHITE), (unit(1, 2, 3), [0.5, 0, 0.4])]
    assert len(lights) == len(expected)
    for light, (direction, color) in zip(lights, expected, strict=True):
        assert light.direction.dtype == light.color.dtype == np.float32
        assert_close(light.direction, np.asarray(direction), ulps=2)
        assert_close(light.color, np.asarray(color), ulps=1)


@pytest.mark.parametrize(
    "text",
    [
        "1 -2 2.5 1 0 3",
        "1\t-2\t2.5\t1\t0\t3",
        "1,-2,2.5,1,0,3",
        "1, -2, 2.5, 1, 0, 3",
        "  1 -2 , 2.5   1 0 3 ",
        "1 -2 2.5 1 0 3# a comment, with 4 5 6",
        "+1 -2. 25e-1 1.0 0 .3e1",
        "1 -2 2.5 1 0 3\r\n",
        "\r\n\r\n1 -2 2.5 1 0 3\r\n\r\n",
        "1 -2 2.5 1 -0 3",
    ],
)
def test_spaces_tabs_and_commas_separate(text, lights_of):
    (light,) = lights_of(text)
    assert_close(light.direction, unit(1, -2, 2.5), ulps=2)
    assert_close(light.color, np.array([1, 0, 3]), ulps=0)


def test_lights_keep_the_order_of_their_lines(lights_of):
    lights = lights_of("".join(f"{k} 1 0\n" for k in range(50)))
    slopes = [light.direction[0] / light.direction[1] for light in lights]
    assert_close(np.array(slopes), np.arange(50), ulps=4)


def test_a_light_may_be_dark_or_any_number_of_times_white(lights_of):
    dark, bright = lights_of("0 0 1 0 0 0\n0 0 1 1e6 1e6 1e6")
    assert_close(dark.color, np.zeros(3), ulps=0)
    assert_close(bright.color, np.full(3, 1e6), ulps=1)


NO_LIGHT = {
    "a number too few": "1 2",
    "one number": "1",
    "four numbers": "1 2 3 4",
    "five numbers": "1 2 3 0.5 0.5",
    "seven numbers": "1 2 3 1 1 1 1",
    "a word": "1 2 up",
    "only words": "light one",
    "not a number": "1 nan 3",
    "infinite": "1 2 inf",
    "color not a number": "1 2 3 1 1 nan",
    "a hexadecimal number": "0x1 2 3",
    "semicolons": "1;2;3",
    "a decimal comma": "0,5 0,5 0,7 1",
}
NO_DIRECTION_OR_COLOR = {
    "zero": "0 0 0",
    "signed zero": "0 -0 0.0",
    "zero of a color": "0 0 0 1 1 1",
    "negative color": "1 2 3 1 -0.5 1",
}


@pytest.mark.parametrize("flaw", [*NO_LIGHT, *NO_DIRECTION_OR_COLOR])
def test_the_line_that_is_no_light_is_named_and_quoted(flaw, lights_of, tmp_path):
    """Empty lines and comments count as lines, so that an editor finds it."""
    line = {**NO_LIGHT, **NO_DIRECTION_OR_COLOR}[flaw]
    expected = "x y z or x y z r g b"
    if flaw in NO_DIRECTION_OR_COLOR:
        expected = "a direction that is not zero and a color that is not negative"
    with pytest.raises(ValueError, match="line 4") as error:
        lights_of(f"# lights\n0 0 1\n\n  {line}  \n0 1 0\n")
    said = f"{tmp_path / 'lights.txt'}: line 4: expected {expected}, got '{line}'"
    assert str(error.value) == said


@pytest.mark.parametrize("text", ["", "\n \n\t\n", "# 0 0 1\n#\n"])
def test_a_file_without_light(text, lights_of):
    with pytest.raises(ValueError, match=r"lights\.txt: holds no light; write one a line as x y z"):
        lights_of(text)


def test_a_file_that_is_no_text(lights_of):
    with pytest.raises(ValueError, match=r"lights\.txt: cannot be read \(.*\); give a text file$"):
        lights_of(b"0 0 1\n\xff\xfe\x00\x01")


@pytest.mark.parametrize("name", ["missing.txt", "."])
def test_a_file_that_is_none(name, tmp_path):
    with pytest.raises(ValueError, match=r"cannot be read .*; give a text file$") as error:
        read_lights(tmp_path / name)
    assert str(error.value).startswith(f"{tmp_path / name}: ")
    assert "\n" not in str(error.value)
