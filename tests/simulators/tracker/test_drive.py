"""A drive is followed along its route, whatever moves the car and draws its pictures."""

import dataclasses

import numpy as np
import pytest

from roadproof.datatypes import Command, Ending, EventKind, VehicleState, Weather
from roadproof.errors import SimulatorError
from roadproof.roads.maps import load_map
from roadproof.scenarios import find_scenario
from roadproof.simulators.tracker.drive import DriveTracker, Request, RouteTracker
from roadproof.simulators.tracker.judge import Contact

SCENARIO = find_scenario("straight-16")
ROADS = load_map(SCENARIO.map_name)
FRAME = np.zeros((2, 3, 3), np.uint8)
DT_S = 0.1


def request(scenario=SCENARIO, *, cars=0, frames=True, full_pictures=False):
    return Request(scenario, Weather.CLEAR_NOON, None, cars, 0, 0, frames, full_pictures)


def driven(drive, arclength_m, contacts=()):
    """The observation one step further, at a place on the route."""
    x, y, z, yaw = drive.route.at(arclength_m)
    drive.state = VehicleState(x, y, z, yaw, 5.0)
    drive.steps += 1
    return drive.judged(FRAME, None, contacts)


def test_commands_events_and_the_ending_follow_from_where_the_car_is():
    drive = RouteTracker(request(), ROADS, DT_S)
    first = drive.judged(FRAME, None, ())
    assert (first.time_s, first.events, first.done) == (0.0, (), False)
    post, turn = Contact("static", "lamp post 1"), drive.route.crossings[0]
    for at_m in np.arange(0.5, drive.route.length_m - 2.5, 0.5):
        seen = driven(drive, at_m, (post,) if 10.0 < at_m < 12.0 else ())
        assert drive.place.arclength_m == pytest.approx(at_m, abs=0.3)
        assert not seen.done
        if turn.enters_m < at_m < turn.leaves_m:
            assert seen.command is turn.command is Command.STRAIGHT
        if at_m == 10.5:
            assert [(event.kind, event.detail) for event in seen.events] == [
                (EventKind.COLLISION_STATIC, "lamp post 1")
            ]
    end = driven(drive, drive.route.length_m)
    assert (end.ending, end.done) == (Ending.GOAL_REACHED, True)


def test_time_is_counted_in_steps_and_up_at_the_limit():
    drive = DriveTracker(request(dataclasses.replace(SCENARIO, time_limit_s=0.3)), DT_S)
    told = []
    for drive.steps in range(4):
        told.append((drive.time_s, drive.time_is_up))
    assert told == [(0.0, False), (0.1, False), (0.2, False), (pytest.approx(0.3), True)]


@pytest.mark.parametrize(("asked", "shown"), [(True, [0, 1, 2]), (False, []), (frozenset({1}), [1]), (frozenset(), [])])
def test_frames_and_full_pictures_are_shown_at_the_steps_asked_for(asked, shown):
    drive = DriveTracker(request(full_pictures=asked), DT_S)
    assert [drive.steps for drive.steps in range(3) if drive.shows_picture] == shown
    drive = DriveTracker(request(frames=asked), DT_S)
    assert [drive.steps for drive.steps in range(3) if drive.shows_frame] == shown


def test_a_crowd_that_cannot_be_is_refused():
    with pytest.raises(SimulatorError, match="-1 cars"):
        RouteTracker(request(cars=-1), ROADS, DT_S)
