"""The expert in the town itself: its physics, its traffic, its judge."""

import pytest

import needs
from roadproof.datatypes import Event
from roadproof.scenarios import Scenario, builtin_scenarios, find_scenario

needs.town()
from roadproof.simulators.town.simulator import TownSimulator
from roadproof.training.expert import Expert

SCENARIOS = builtin_scenarios()
FEW = [find_scenario(name, SCENARIOS) for name in ("straight-16", "left-03", "right-11")]


def driven(town: TownSimulator, scenario: Scenario, agents: int, seed: int) -> tuple[bool, list[Event], float]:
    """Whether the goal was reached, what happened, and the largest distance from the route."""
    seen = town.reset(scenario, cars=agents, pedestrians=agents, seed=seed)
    expert, events, at, aside = Expert(town.route), list(seen.events), 0.0, 0.0
    while not seen.done:
        seen = town.step(expert.drive(seen.state, town.cars, town.pedestrians))
        events += seen.events
        place = town.route.locate(seen.state.x_m, seen.state.y_m, at)
        at, aside = place.arclength_m, max(aside, abs(place.lateral_m))
    return seen.time_s < scenario.time_limit_s - 1e-6, events, aside


@pytest.mark.parametrize("scenario", FEW, ids=lambda scenario: scenario.name)
def test_the_expert_completes_a_scenario_alone(town: TownSimulator, scenario: Scenario) -> None:
    arrived, events, aside = driven(town, scenario, 0, 0)
    assert arrived
    assert events == []
    assert aside < 0.4


@pytest.mark.slow
def test_the_expert_completes_scenarios_of_every_kind_among_cars_and_people(town: TownSimulator) -> None:
    # benchmarks/expert_drives.py drives them all.
    for scenario in SCENARIOS[4::12]:
        arrived, events, _ = driven(town, scenario, 20, 1)
        assert arrived
        assert events == []
