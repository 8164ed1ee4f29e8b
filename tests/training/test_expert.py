"""The expert on a car of a few lines: it keeps to the route, slows for bends, and hits nobody."""

import math
from importlib import import_module

import numpy as np
import pytest

from roadproof.datatypes import Control, VehicleState
from roadproof.roads.maps import load_map, scenario_route
from roadproof.scenarios import Scenario, builtin_scenarios, find_scenario
from roadproof.traffic.agents import NOBODY, Agents
from roadproof.traffic.traffic import Traffic
from roadproof.training.expert import SLOW_MPS2, Expert, pedals, speed_limits

SCENARIOS = builtin_scenarios()
DT_S = 0.05


def moved(state: VehicleState, control: Control) -> VehicleState:
    """A kinematic bicycle: its centre between the axles, wheels that obey at once."""
    pull = 4.2 * control.throttle - 7.9 * control.brake - 0.025 * state.speed_mps
    speed = max(state.speed_mps + pull * DT_S, 0.0)
    wheel = -0.65 * control.steer
    slip = math.atan(0.5 * math.tan(wheel))
    yaw = state.yaw_rad + speed * math.cos(slip) * math.tan(wheel) / 2.8 * DT_S
    way = state.yaw_rad + slip
    return VehicleState(
        state.x_m + speed * math.cos(way) * DT_S, state.y_m + speed * math.sin(way) * DT_S, 0.0, yaw, speed
    )


def standing(x: float, y: float) -> Agents:
    return Agents(np.array([x]), np.array([y]), np.zeros(1), np.zeros(1), np.zeros(1), np.zeros(1, dtype=np.int64))


@pytest.mark.parametrize("scenario", SCENARIOS, ids=lambda scenario: scenario.name)
def test_the_expert_drives_every_scenario_alone(scenario: Scenario) -> None:
    route = scenario_route(scenario, load_map(scenario.map_name))
    expert, state, at = Expert(route), scenario.start, 0.0
    steers: list[float] = []
    for _ in range(int(scenario.time_limit_s / DT_S)):
        control = expert.drive(state)
        steers.append(control.steer)
        state = moved(state, control)
        place = route.locate(state.x_m, state.y_m, at)
        at = place.arclength_m
        assert abs(place.lateral_m) < 0.3
        if at > route.length_m - 1.0:
            break
    assert at > route.length_m - 1.0
    assert 7.0 < len(steers) * DT_S < 21.0
    assert np.abs(np.diff(steers)).max() < 0.25


def test_the_expert_comes_back_to_the_route() -> None:
    scenario = find_scenario("straight-02", SCENARIOS)
    route = scenario_route(scenario, load_map("town"))
    start = scenario.start
    state = VehicleState(start.x_m, start.y_m + 1.2, 0.0, start.yaw_rad + 0.15, 5.0)
    expert = Expert(route)
    for _ in range(120):
        state = moved(state, expert.drive(state))
    assert abs(route.locate(state.x_m, state.y_m).lateral_m) < 0.05


def test_the_expert_turns_the_wheel_towards_the_route() -> None:
    scenario = find_scenario("straight-02", SCENARIOS)
    route = scenario_route(scenario, load_map("town"))
    start = scenario.start
    left_of_it = VehicleState(start.x_m + 5.0, start.y_m + 1.0, 0.0, start.yaw_rad, 5.0)
    assert Expert(route).drive(left_of_it).steer > 0.05  # positive is right
    right_of_it = VehicleState(start.x_m + 5.0, start.y_m - 1.0, 0.0, start.yaw_rad, 5.0)
    assert Expert(route).drive(right_of_it).steer < -0.05


def test_speed_falls_in_time_for_bends(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(import_module("roadproof.training.expert"), "CRUISE_MPS", 9.0)
    for scenario in SCENARIOS:
        route = scenario_route(scenario, load_map("town"))
        limit = speed_limits(route)
        assert limit.max() <= 9.0 + 1e-9
        slowing = -np.diff(limit**2) / (2 * np.diff(route.arclengths_m))
        assert slowing.max() <= SLOW_MPS2 + 1e-9
        if scenario.kind != "straight":
            assert limit.min() < 8.8


@pytest.mark.parametrize(("aside_m", "stops"), [(0.0, True), (1.3, True), (-3.5, False), (4.0, False)])
def test_the_expert_stops_for_what_stands_in_its_way_and_passes_what_does_not(aside_m: float, stops: bool) -> None:
    scenario = find_scenario("straight-02", SCENARIOS)
    route = scenario_route(scenario, load_map("town"))
    thing = standing(scenario.start.x_m + 40.0, scenario.start.y_m + aside_m)
    for cars, people in ((thing, NOBODY), (NOBODY, thing)):
        expert, state = Expert(route), scenario.start
        for _ in range(300):
            state = moved(state, expert.drive(state, cars, people))
        gone = state.x_m - scenario.start.x_m
        assert (gone < 40.0 - 2.25) == stops
        if stops:
            assert state.speed_mps < 0.1
            assert gone > 25.0


def test_a_car_inside_a_junction_is_waited_for() -> None:
    scenario = find_scenario("straight-16", SCENARIOS)
    route = scenario_route(scenario, load_map("town"))
    (crossing,) = route.crossings
    crossing_car = standing(crossing.x_m + 8.0, crossing.y_m + 1.75)
    expert, state = Expert(route), scenario.start
    for _ in range(300):
        state = moved(state, expert.drive(state, crossing_car))
    assert state.speed_mps < 0.1
    assert route.locate(state.x_m, state.y_m).arclength_m < crossing.enters_m - 5.0
    for _ in range(200):
        state = moved(state, expert.drive(state))
    assert route.locate(state.x_m, state.y_m).arclength_m > crossing.leaves_m


def test_pedals_are_never_both_pressed() -> None:
    for acceleration in np.linspace(-10.0, 5.0, 61):
        throttle, brake = pedals(float(acceleration), 5.0)
        assert 0.0 <= throttle <= 1.0
        assert 0.0 <= brake <= 1.0
        assert throttle * brake == 0.0


def test_in_traffic_nobody_is_hit() -> None:
    road_map = load_map("town")
    arrived = 0
    for scenario in SCENARIOS[::8]:
        route = scenario_route(scenario, road_map)
        traffic = Traffic(road_map, cars=20, pedestrians=20, seed=0, ego=scenario.start)
        expert, state, at = Expert(route), scenario.start, 0.0
        for _ in range(int(scenario.time_limit_s / DT_S)):
            control = expert.drive(state, traffic.cars, traffic.pedestrians)
            traffic.step(DT_S, state)
            state = moved(state, control)
            at = route.locate(state.x_m, state.y_m, at).arclength_m
            apart = np.hypot(traffic.cars.x_m - state.x_m, traffic.cars.y_m - state.y_m)
            assert apart.min() > 1.9
            apart = np.hypot(traffic.pedestrians.x_m - state.x_m, traffic.pedestrians.y_m - state.y_m)
            assert apart.min() > 1.25
            if at > route.length_m - 1.0:
                arrived += 1
                break
    assert arrived == 5
