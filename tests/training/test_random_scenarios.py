"""Random scenarios fit their map and ask what they should; disturbances have the shape they promise."""

import math
from dataclasses import replace

import numpy as np
import pytest

from roadproof.datatypes import Command, Control
from roadproof.errors import ScenarioError
from roadproof.roads.maps import load_map, scenario_route
from roadproof.roads.roadmap import RoadMap
from roadproof.training.random_scenarios import LENGTHS_M, Disturbance, random_scenario


@pytest.mark.parametrize("map_name", ["town", "second"])
@pytest.mark.parametrize("command", list(Command))
def test_a_random_scenario_asks_for_its_command(map_name, command):
    roads = load_map(map_name)
    for seed in range(4):
        scenario = random_scenario(roads, map_name, np.random.default_rng(seed), name="x", command=command)
        route = scenario_route(scenario, roads)
        assert 0.7 * LENGTHS_M[0] < route.length_m < 1.3 * LENGTHS_M[1]
        assert command is Command.FOLLOW or command in [crossing.command for crossing in route.crossings]
        assert scenario.start.speed_mps == 0.0
        assert abs(route.locate(scenario.start.x_m, scenario.start.y_m).lateral_m) < 0.05


def test_the_same_seed_gives_the_same_scenario():
    roads = load_map("town")
    one, other, third = (random_scenario(roads, "town", np.random.default_rng(s), name="x") for s in (3, 3, 4))
    assert one == other
    assert one != third


def test_displaced_starts_spread_to_their_limits(monkeypatch):
    monkeypatch.setattr("roadproof.training.random_scenarios.ASIDE_M", 1.0)
    monkeypatch.setattr("roadproof.training.random_scenarios.ASIDE_LIMIT_M", 1.2)
    roads = load_map("town")
    generator = np.random.default_rng(0)
    asides, speeds = [], []
    for _ in range(60):
        scenario = random_scenario(roads, "town", generator, name="x", displaced=True)
        place = scenario_route(scenario, roads).locate(scenario.start.x_m, scenario.start.y_m)
        asides.append(place.lateral_m)
        speeds.append(scenario.start.speed_mps)
    assert 0.5 < np.std(asides) < 1.1
    assert max(map(abs, asides)) < 1.3
    assert 0.3 < np.mean(np.array(speeds) == 0.0) < 0.7


def test_a_map_without_junctions_has_no_route_that_turns():
    town = load_map("town")
    apart = [replace(lane, successors=()) for lane in town.lanes]
    roads = RoadMap(tuple(apart), town.mark_lines, town.junctions)
    with pytest.raises(ScenarioError, match="no route"):
        random_scenario(roads, "town", np.random.default_rng(0), name="x", command=Command.LEFT)


def test_disturbances_are_triangles_within_their_peak():
    disturbance = Disturbance(4000, 0.1, np.random.default_rng(1))
    steer = np.array([disturbance.on(Control(0.0), step).steer for step in range(4000)])
    assert 0.2 < np.mean(steer != 0) < 0.7
    assert 0.4 < np.abs(steer).max() <= Disturbance.STEER[1]
    assert abs(steer.mean()) < 0.03
    # A triangle that lasts half a second or more moves by no more than 2·peak / 0.5 s.
    assert np.abs(np.diff(steer)).max() <= 2 * Disturbance.STEER[1] / 0.5 * 0.1 * 1.5


def test_a_disturbance_of_the_pedals_never_presses_both():
    disturbance = Disturbance(2000, 0.1, np.random.default_rng(2))
    controls = [disturbance.on(Control(0.0, throttle=0.4), step) for step in range(2000)]
    assert all(c.throttle * c.brake == 0.0 for c in controls)
    assert any(c.brake > 0.2 for c in controls)
    assert sum(math.isclose(c.throttle, 0.4) for c in controls) > 500
