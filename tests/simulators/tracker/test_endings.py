"""Drives end as the challenge ends them, and one object that is hit costs once."""

import dataclasses
import math

import numpy as np
import pytest

import needs
from carla_serving import straight_map
from roadproof.datatypes import Control, Ending, EventKind, VehicleState
from roadproof.driving.infractions import counted, infraction_points
from roadproof.driving.rollout import rollout
from roadproof.roads.maps import load_map, scenario_route
from roadproof.scenarios import find_scenario
from roadproof.simulators.tracker.judge import BLOCKED_S, STANDS_S, Contact, Endings, Judge

SCENARIO = find_scenario("left-03")
ROUTE = scenario_route(SCENARIO, load_map(SCENARIO.map_name))
RAIL = (Contact("static", "guard rail 0"),)


def place(along_m, left_m=0.0, speed_mps=5.0):
    x, y, z, yaw = ROUTE.at(along_m)
    nx, ny = -ROUTE.at(along_m + 0.5)[1] + ROUTE.at(along_m)[1], ROUTE.at(along_m + 0.5)[0] - ROUTE.at(along_m)[0]
    state = VehicleState(x + left_m * nx / 0.5, y + left_m * ny / 0.5, z, yaw, speed_mps)
    return state, ROUTE.locate(state.x_m, state.y_m, along_m)


def test_a_drive_goes_on_until_the_goal_or_its_time_is_up():
    watch = Endings(ROUTE, 40.0).watch
    assert watch(*place(10.0), 1.0, ()) is None
    assert watch(*place(10.0, 14.0), 2.0, ()) is None
    assert watch(*place(ROUTE.length_m - 1.0), 3.0, ()) is Ending.GOAL_REACHED
    assert watch(*place(20.0), 40.0, ()) is Ending.TIME_LIMIT


def test_fifteen_metres_beside_the_route_it_is_over():
    assert Endings(ROUTE, 40.0).watch(*place(10.0, 16.0), 2.0, ()) is Ending.OFF_ROUTE


def test_who_stands_after_a_collision_is_not_waited_for():
    watch = Endings(ROUTE, 400.0).watch
    assert watch(*place(10.0), 1.0, RAIL) is None
    assert watch(*place(10.0, speed_mps=0.0), 1.0 + STANDS_S - 0.1, RAIL) is None
    assert watch(*place(10.0, speed_mps=0.5), 1.0 + STANDS_S, ()) is None, "moves on"
    assert watch(*place(10.0, speed_mps=0.0), 1.0 + 2 * STANDS_S, ()) is Ending.STANDS


def test_a_touch_long_before_is_no_reason_to_stand():
    watch = Endings(ROUTE, 400.0).watch
    assert watch(*place(10.0), 1.0, RAIL) is None
    assert watch(*place(30.0), 5.0, ()) is None
    assert watch(*place(30.0, speed_mps=0.0), 5.0 + 2 * STANDS_S, ()) is None


def test_leaving_the_road_slowly_over_the_sidewalk_is_one_event():
    judge, found = Judge(load_map(SCENARIO.map_name)), []
    for step in range(200):
        state, _ = place(10.0, left_m=-0.05 * step)
        found += judge.watch(state, 0.05 * step, (), np.zeros((0, 2)))
    assert [event.kind for event in found] == [EventKind.SIDEWALK]


@pytest.mark.parametrize("width", ['a="2.5" b="0"', 'a="0" b="0.04"'], ids=["narrow", "widening"])
def test_only_lanes_that_lead_the_other_way_are_wrong(tmp_path, width):
    path = straight_map(tmp_path)
    two_each_way = path.read_text().replace('type="sidewalk"', 'type="driving"').replace('a="2.5" b="0"', width)
    path.write_text(two_each_way)
    roads = load_map(str(path))
    for x_m, right_m in ((x, right) for x in (30.0, 80.0, 130.0) for right in np.arange(0.1, 3.5, 0.1)):
        for yaw, wrong in ((0.0, False), (math.pi, True)):
            for side in (1.0, -1.0):
                state = VehicleState(x_m, -side * right_m, 0.0, yaw + (0.0 if side > 0 else math.pi), 5.0)
                kinds = [event.kind for event in Judge(roads).watch(state, 0.0, (), np.zeros((0, 2)))]
                assert (EventKind.WRONG_LANE in kinds) == wrong, (state, kinds)


def test_who_stands_for_no_reason_is_waited_for_half_a_minute():
    watch = Endings(ROUTE, 400.0).watch
    assert watch(*place(10.0), 1.0, ()) is None
    assert watch(*place(10.0, speed_mps=0.0), BLOCKED_S, ()) is None
    assert watch(*place(10.0, speed_mps=0.0), BLOCKED_S + 1.0, ()) is Ending.BLOCKED


def straight_on(_simulator):
    """Goes straight on where the road bends, and slides along what is there."""
    return lambda _seen: Control(0.0, throttle=0.45)


BEND = find_scenario("right-02")


@pytest.fixture(scope="module")
def slides():
    """The same slide along a guard rail: as its pieces would be counted, and as one object."""
    needs.town()
    from roadproof.simulators.town.simulator import TownSimulator

    with TownSimulator() as town:
        after = rollout(town, straight_on, BEND)
        built = town._town
        pieces = tuple(dataclasses.replace(solid, thing="") for solid in built.scenery.solids)
        town._town = dataclasses.replace(built, scenery=dataclasses.replace(built.scenery, solids=pieces))
        return rollout(town, straight_on, BEND), after


def test_a_slide_along_a_rail_costs_six_points_however_many_pieces_it_has(slides):
    before, after = (counted(drive.events) for drive in slides)
    pieces, rail = ([event for event in each if event.kind is EventKind.COLLISION_STATIC] for each in (before, after))
    assert len({event.detail for event in pieces if event.detail.startswith("guard rail")}) > 1
    assert infraction_points(pieces) >= 12.0
    assert infraction_points(rail) == 6.0
    # The whole drive: over the other lane and the sidewalk into the rail. Being on the lawn afterwards is no new fault.
    assert [(event.kind, event.detail.rsplit(" ", 1)[0]) for event in after] == [
        (EventKind.WRONG_LANE, "1.8 m beside its lane on road"),
        (EventKind.SIDEWALK, "a wheel on the"),
        (EventKind.COLLISION_STATIC, "guard rail"),
    ]
    assert infraction_points(slides[1].events) == 2.0 + 2.0 + 6.0
    assert infraction_points(slides[0].events) == 2.0 + 2.0 + 6.0 * len(pieces)


def test_a_drive_that_ends_beside_the_route_says_so(slides):
    assert slides[1].ending is Ending.OFF_ROUTE
    assert slides[1].time_s[-1] < BEND.time_limit_s
