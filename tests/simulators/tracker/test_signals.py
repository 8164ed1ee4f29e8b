"""Red lights and stop signs on scripted drives: what the rules of the 2019 challenge count, and what they do not."""

import math

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from carla_serving import straight_map
from roadproof.datatypes import EventKind, VehicleState
from roadproof.roads.maps import load_map
from roadproof.simulators.tracker.signals import RedLights, StopLine, StopSigns, TriggerVolume, places_ahead, stop_line

ROADS = load_map("town")
APPROACHES = [
    lane
    for lane in ROADS.lanes
    if lane.kind == "driving" and lane.junction is None and any(ROADS.lanes[k].junction for k in lane.successors)
]
# Every way from a road over a junction to the next road.
WAYS = [
    (approach.index, crossing, ROADS.lanes[crossing].successors[0])
    for approach in APPROACHES
    for crossing in approach.successors
]
BEFORE_M = 6.0
DT_S = 0.05


def volume(lane, *, before_m=BEFORE_M, along_x=False, half_along_m=1.5):
    """A trigger volume as wide as its lane, so far before the lane's end; its x axis across the lane, or along it."""
    k = int(np.searchsorted(lane.stations_m, lane.length_m - before_m))
    x, y, z = lane.centre[k]
    halves = (half_along_m, lane.width_m / 2) if along_x else (lane.width_m / 2, half_along_m)
    yaw = float(lane.headings_rad[k]) + (0.0 if along_x else math.pi / 2)
    return TriggerVolume(x_m=float(x), y_m=float(y), z_m=float(z), yaw_rad=yaw, half_x_m=halves[0], half_y_m=halves[1])


def driven(way, speeds_mps, from_m):
    """States along the middle of lanes, at these speeds, from so far after the beginning of the first."""
    lanes = [ROADS.lanes[k] for k in way]
    begins = np.concatenate([[0.0], np.cumsum([lane.length_m for lane in lanes])])
    at_m = from_m
    for speed in speeds_mps:
        k = min(int(np.searchsorted(begins, at_m, side="right")) - 1, len(lanes) - 1)
        lane, station = lanes[k], at_m - begins[k]
        x, y, z = (float(np.interp(station, lane.stations_m, lane.centre[:, axis])) for axis in range(3))
        yield VehicleState(x, y, z, float(np.interp(station, lane.stations_m, lane.headings_rad)), speed)
        at_m += speed * DT_S


def through(way, speed_mps=8.0, until_m=26.0):
    """A drive at one speed, from 30 m before a junction (or the beginning of the road) to so far after its entry."""
    entry = ROADS.lanes[way[0]].length_m
    begin = max(entry - 30.0, 0.0)
    return driven(way, [speed_mps] * int((entry - begin + until_m) / (speed_mps * DT_S)), begin)


def beyond_m(approach, state):
    """How far the car's middle is beyond the end of a lane."""
    end, heading = approach.centre[-1], float(approach.headings_rad[-1])
    return (state.x_m - end[0]) * math.cos(heading) + (state.y_m - end[1]) * math.sin(heading)


def lights_run(states, red, watch=None):
    """(step, event) of every red light that is run; `red` is asked with the step."""
    watch = watch or RedLights(ROADS, [volume(ROADS.lanes[WAYS[0][0]])])
    return [
        (step, event)
        for step, state in enumerate(states)
        for event in watch.watch(state, step * DT_S, lambda _, step=step: red(step))
    ]


def signs_run(states, signs):
    watch = StopSigns(ROADS, signs)
    return [(step, event) for step, state in enumerate(states) for event in watch.watch(state, step * DT_S)]


def test_passing_a_red_light_counts_once_as_the_end_of_the_car_crosses_its_line():
    states = list(through(WAYS[0]))
    ((step, event),) = lights_run(states, lambda _: True)
    approach = ROADS.lanes[WAYS[0][0]]
    assert [beyond_m(approach, states[k]) >= 1.0 for k in (step - 1, step)] == [False, True]
    light = volume(approach)
    assert event.kind is EventKind.RED_LIGHT
    assert event.time_s == step * DT_S
    assert event.detail == f"traffic light at ({light.x_m:.1f}, {light.y_m:.1f})"


def test_passing_a_green_light_is_no_event():
    assert lights_run(through(WAYS[0]), lambda _: False) == []


def test_stopping_before_red_and_going_on_at_green_is_no_event():
    # The front of the car, 2.25 m before its middle, comes to stand half a metre before the line.
    entry = ROADS.lanes[WAYS[0][0]].length_m
    speeds = [2.75 / DT_S / 50] * 50 + [0.0] * 60 + [6.0] * 80
    states = list(driven(WAYS[0], speeds, entry - 5.5))
    assert beyond_m(ROADS.lanes[WAYS[0][0]], states[80]) == pytest.approx(-2.75, abs=0.05)
    assert beyond_m(ROADS.lanes[WAYS[0][0]], states[-1]) > 15.0
    assert lights_run(states, lambda step: step < 105) == []


@pytest.mark.parametrize(("red_from_m", "events"), [(4.1, 0), (3.0, 1)], ids=["behind the car", "under its end"])
def test_a_light_that_turns_red_counts_only_while_the_end_of_the_car_crosses_the_line(red_from_m, events):
    states = list(through(WAYS[0]))
    approach = ROADS.lanes[WAYS[0][0]]
    found = lights_run(states, lambda step: beyond_m(approach, states[step]) >= red_from_m)
    assert len(found) == events


@pytest.mark.parametrize("along_x", [False, True], ids=["placed by hand", "generated from OpenDRIVE"])
def test_on_every_way_over_every_junction_only_the_light_of_its_own_road_is_run(along_x):
    lights = [volume(lane, along_x=along_x) for lane in APPROACHES]
    for way in WAYS:
        own = [lane.index for lane in APPROACHES].index(way[0])
        asked = []
        watch = RedLights(ROADS, lights)
        for step, state in enumerate(through(way)):
            watch.watch(state, step * DT_S, lambda i, asked=asked: asked.append(i) or True)
        assert asked == [own], f"way {way}: nobody asks about other lights, nor about this one twice"


def test_a_car_that_leaves_the_junction_beside_the_light_or_backs_out_of_it_runs_nothing():
    # The end of the car crosses the line against its direction.
    backwards = [
        VehicleState(state.x_m, state.y_m, state.z_m, state.yaw_rad + math.pi, 8.0) for state in through(WAYS[0])
    ]
    assert lights_run(backwards[::-1], lambda _: True) == []


def test_the_same_light_counts_again_only_after_another_one():
    lights = [volume(lane) for lane in APPROACHES]
    watch = RedLights(ROADS, lights)
    other = next(way for way in WAYS if way[0] != WAYS[0][0])
    runs = [len(lights_run(through(way), lambda _: True, watch)) for way in (WAYS[0], WAYS[0], other, WAYS[0])]
    assert runs == [1, 0, 1, 1]


def test_two_lights_over_one_line_count_once_each():
    light = volume(ROADS.lanes[WAYS[0][0]])
    found = lights_run(through(WAYS[0]), lambda _: True, RedLights(ROADS, [light, light]))
    assert len(found) == 2
    assert found[0] == found[1]


def test_the_line_of_a_light_lies_where_its_lane_enters_the_junction():
    for lane in APPROACHES:
        line = stop_line(ROADS, volume(lane))
        np.testing.assert_allclose((line.x_m, line.y_m), lane.centre[-1, :2], atol=0.05)
        assert math.cos(line.heading_rad - float(lane.headings_rad[-1])) > 0.999
        assert line.half_m == pytest.approx(0.9 * lane.width_m / 2)


def test_a_light_before_no_junction_has_its_line_under_its_volume(tmp_path):
    street = load_map(str(straight_map(tmp_path)))
    light = TriggerVolume(x_m=60.0, y_m=-1.5, z_m=0.0, yaw_rad=math.pi / 2, half_x_m=1.0, half_y_m=2.0)
    line = stop_line(street, light)
    assert (line.x_m, line.y_m, line.half_m) == pytest.approx((60.0, -1.5, 0.9))
    assert math.cos(line.heading_rad) == pytest.approx(1.0)
    assert not RedLights(street, [light]).watch(VehicleState(60.9, -1.75, 0.0, 0.0, 8.0), 0.0, lambda _: True)
    assert RedLights(street, [light]).watch(VehicleState(61.1, -1.75, 0.0, 0.0, 8.0), 0.0, lambda _: True)


def test_without_lights_or_signs_nothing_is_found():
    assert lights_run(through(WAYS[0]), lambda _: True, RedLights(ROADS, [])) == []
    assert signs_run(through(WAYS[0]), []) == []


def test_a_volume_beside_the_middle_of_its_lane_has_its_line_there():
    lane = APPROACHES[0]
    middle, heading = volume(lane), float(lane.headings_rad[-1])
    aside = TriggerVolume(
        x_m=middle.x_m - 1.2 * math.sin(heading),
        y_m=middle.y_m + 1.2 * math.cos(heading),
        z_m=0.0,
        yaw_rad=middle.yaw_rad,
        half_x_m=3.0,
        half_y_m=1.0,
    )
    line = stop_line(ROADS, aside)
    end = lane.centre[-1, :2] + 1.2 * np.array([-math.sin(heading), math.cos(heading)])
    np.testing.assert_allclose((line.x_m, line.y_m), end, atol=1e-6)
    assert line.half_m == pytest.approx(2.7)


METRES, ANGLE = st.floats(-6.0, 6.0), st.floats(-math.pi, math.pi)


def turned_left(a, b, c):
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])


@settings(derandomize=True, deadline=None, max_examples=400)
@given(METRES, METRES, ANGLE, ANGLE, st.floats(0.2, 4.0))
def test_a_line_is_crossed_where_the_two_segments_meet_in_its_direction(x, y, yaw, heading, half_m):
    line, state = StopLine(1.0, -2.0, heading, half_m), VehicleState(x, y, 0.0, yaw, 5.0)
    near, far = ((x - back * math.cos(yaw), y - back * math.sin(yaw)) for back in (1.0, 4.0))
    left, right = (
        (1.0 - side * half_m * math.sin(heading), -2.0 + side * half_m * math.cos(heading)) for side in (1, -1)
    )
    sides = [
        turned_left(left, right, near), turned_left(left, right, far),
        turned_left(near, far, left), turned_left(near, far, right),
    ]  # fmt: skip
    assume(min(map(abs, sides)) > 1e-6 and abs(math.cos(yaw - heading)) > 1e-6)
    meet = sides[0] * sides[1] < 0 and sides[2] * sides[3] < 0
    assert line.crossed_by(state) == (meet and math.cos(yaw - heading) > 0)


@settings(derandomize=True, deadline=None)
@given(METRES, METRES, ANGLE)
def test_a_volume_holds_what_its_own_axes_say(x, y, yaw):
    box = TriggerVolume(x_m=1.0, y_m=2.0, z_m=0.0, yaw_rad=yaw, half_x_m=3.0, half_y_m=0.5)
    own = (complex(x, y) - complex(1.0, 2.0)) * complex(math.cos(yaw), -math.sin(yaw))
    assume(abs(abs(own.real) - 3.0) > 1e-9 and abs(abs(own.imag) - 0.5) > 1e-9)
    assert box.holds(np.array([[x, y]]))[0] == (abs(own.real) < 3.0 and abs(own.imag) < 0.5)


SIGN = volume(ROADS.lanes[WAYS[0][0]])


@pytest.mark.parametrize("half_along_m", [2.0, 0.3])
def test_passing_a_stop_sign_without_stopping_counts_once_when_the_car_has_left_it(half_along_m):
    sign = volume(ROADS.lanes[WAYS[0][0]], half_along_m=half_along_m)
    states = list(through(WAYS[0]))
    ((step, event),) = signs_run(states, [sign])
    held = np.flatnonzero(sign.holds(np.array([(state.x_m, state.y_m) for state in states])))
    assert step == held[-1] + 1
    assert event.kind is EventKind.STOP_SIGN
    assert event.detail == f"stop sign at ({sign.x_m:.1f}, {sign.y_m:.1f})"


def stopping(before_volume_m, slowest_mps, way=WAYS[0]):
    """A drive that is slow for a second, so far before the middle of the sign's volume, and then goes on."""
    entry = ROADS.lanes[way[0]].length_m
    steps = round((34.0 - before_volume_m) / (8.0 * DT_S))
    return driven(way, [8.0] * steps + [slowest_mps] * 20 + [8.0] * 120, entry - BEFORE_M - 34.0)


def test_stopping_at_a_stop_sign_and_going_on_is_no_event():
    assert signs_run(stopping(3.0, 0.0), [SIGN]) == []
    assert signs_run(stopping(18.0, 0.05), [SIGN]) == []


def test_slowing_down_or_stopping_too_far_away_is_not_stopping():
    assert len(signs_run(stopping(3.0, 0.2), [SIGN])) == 1
    assert len(signs_run(stopping(26.0, 0.0), [SIGN])) == 1


def test_on_every_way_over_every_junction_only_the_sign_of_its_own_road_is_run():
    signs = [volume(lane) for lane in APPROACHES]
    for way in WAYS:
        own = volume(ROADS.lanes[way[0]])
        found = [event.detail for _, event in signs_run(through(way), signs)]
        assert found == [f"stop sign at ({own.x_m:.1f}, {own.y_m:.1f})"], f"way {way}"


def test_a_sign_for_those_who_come_the_other_way_does_not_concern_the_car():
    approach = ROADS.lanes[WAYS[0][0]]
    coming = next(
        lane for lane in ROADS.lanes
        if (lane.road, lane.section, lane.number) == (approach.road, approach.section, -approach.number)
    )  # fmt: skip
    assert signs_run(through(WAYS[0]), [volume(coming, before_m=coming.length_m - BEFORE_M)]) == []


def test_the_next_pass_of_the_same_sign_counts_again():
    states = [*through(WAYS[0]), *through(WAYS[0])]
    assert len(signs_run(states, [SIGN])) == 2


def test_places_ahead_end_twenty_metres_on_or_where_ways_part():
    approach = ROADS.lanes[WAYS[0][0]]
    far, near = (next(driven(WAYS[0], [8.0], approach.length_m - back)) for back in (60.0, 12.0))
    for state, reach_m in ((far, 20.0), (near, 12.0)):
        places = places_ahead(ROADS, state)
        steps = np.hypot(*np.diff(places, axis=0).T)
        assert steps.max() <= 0.5 + 1e-6
        assert reach_m - 0.51 <= steps.sum() <= reach_m
    junction = next(driven(WAYS[0], [8.0], approach.length_m + 1.0))
    assert np.hypot(*np.diff(places_ahead(ROADS, junction), axis=0).T).sum() == pytest.approx(20.0, abs=0.6)
