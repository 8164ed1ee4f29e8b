import pytest

from roadproof.datatypes import Control, Weather
from roadproof.errors import SimulatorError


def test_there_are_eight_weathers_and_the_paper_s_come_first():
    assert len(Weather) == 8
    assert [w.value for w in Weather][:4] == ["clear-noon", "cloudy-noon", "rainy-noon", "clear-sunset"]


def test_an_unknown_weather_is_one_line_that_lists_the_known_ones():
    with pytest.raises(
        SimulatorError, match=r"'snow' is unknown, expected one of clear-noon, .*foggy-morning"
    ) as caught:
        Weather("snow")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_a_control_that_is_not_finite_is_refused(value):
    with pytest.raises(SimulatorError, match="steer is"):
        Control(value)
