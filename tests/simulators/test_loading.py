import pytest

import needs
from roadproof.errors import ScenarioError, SimulatorError
from roadproof.scenarios import builtin_scenarios
from roadproof.simulators.loading import open_simulator


def test_the_town_is_opened_by_its_name_and_closed_again():
    needs.town()
    with open_simulator("town") as simulator:
        assert simulator.road_map("town").lanes
        with pytest.raises(ScenarioError, match="no map 'elsewhere'"):
            simulator.road_map("elsewhere")
    with pytest.raises(SimulatorError, match="closed"):
        simulator.reset(builtin_scenarios()[0])


@pytest.mark.parametrize(
    ("spec", "complaint"),
    [
        ("carla://", "no address"),
        ("carla://host:port", "no address"),
        ("carla://host:99999", "no address"),
        ("carla://host:2000/Town01", "no address"),
        ("carla:host", "unknown"),
        ("carla://host:2000?paint=spray", "expected nothing or paint= and one of inject, native, auto"),
        ("carla://host:2000?colour=red", "asks for 'colour=red'"),
    ],
)
def test_what_is_no_address_is_refused(spec, complaint):
    with pytest.raises(SimulatorError, match=complaint), open_simulator(spec):
        pass


@pytest.mark.parametrize("spec", ["", "Town", "towm"])
def test_an_unknown_simulator_is_refused(spec):
    with pytest.raises(SimulatorError, match="unknown, expected town"), open_simulator(spec):
        pass
