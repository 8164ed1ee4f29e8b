import math

import numpy as np
import pytest

import needs
from roadproof.datatypes import Control, EventKind, VehicleState

needs.town()
from roadproof.roads.maps import load_map
from roadproof.roads.roadmap import Surface
from roadproof.simulators.town.meshes import Pose
from roadproof.simulators.town.physics import CAR_WHEELBASE_M, MAX_STEER_RAD, Contact, Physics
from roadproof.simulators.town.scenery import Solid
from roadproof.simulators.tracker.judge import Judge, people_hit

NOBODY = np.zeros((0, 2))


def at_origin(speed=0.0):
    return VehicleState(0.0, 0.0, 0.0, 0.0, speed)


def states(control, steps, start=None, solids=()):
    physics = Physics(solids, start or at_origin())
    seen = [physics.state()]
    for _ in range(steps):
        physics.step(control(seen[-1]) if callable(control) else control, 0.05)
        seen.append(physics.state())
    physics.close()
    return seen


def hold(steer, speed):
    return lambda state: Control(steer, throttle=min(max(0.5 * (speed - state.speed_mps) + 0.08, 0.0), 1.0))


def test_it_starts_exactly_where_and_as_fast_as_asked():
    start = VehicleState(3.5, -2.25, 0.0, 1.1, 6.0)
    state = states(Control(0.0), 0, start)[0]
    assert (state.x_m, state.y_m, state.z_m) == (3.5, -2.25, 0.0)
    assert state.yaw_rad == pytest.approx(1.1, abs=1e-6)
    assert state.speed_mps == pytest.approx(6.0, abs=1e-5)


@pytest.mark.parametrize("steer", [0.1, -0.3, 0.5])
def test_it_turns_on_the_circle_of_the_bicycle_model(steer):
    seen = states(hold(steer, 5.0), 120, at_origin(5.0))[60:]
    yaw = np.unwrap([state.yaw_rad for state in seen])
    turned = (yaw[-1] - yaw[0]) / ((len(seen) - 1) * 0.05)
    speed = np.mean([state.speed_mps for state in seen])
    wanted = math.hypot(CAR_WHEELBASE_M / math.tan(abs(steer) * MAX_STEER_RAD), CAR_WHEELBASE_M / 2)
    assert speed / abs(turned) == pytest.approx(wanted, rel=0.05)
    assert np.sign(turned) == -np.sign(steer)


def test_it_accelerates_and_brakes_like_a_mid_size_car():
    speed = [state.speed_mps for state in states(Control(0.0, throttle=1.0), 240)]
    to_100 = next(i for i, v in enumerate(speed) if v > 27.8) * 0.05
    assert 6.0 < to_100 < 12.0
    stopping = states(Control(0.0, brake=1.0), 80, at_origin(15.0))
    assert 11.0 < stopping[-1].x_m < 17.0
    assert abs(stopping[-1].speed_mps) < 0.1


def test_it_rolls_to_a_stop_and_stands_still_under_the_brake():
    still = states(Control(0.0, brake=1.0), 60)
    assert abs(still[-1].x_m) < 0.02
    coasting = [state.speed_mps for state in states(Control(0.0), 100, at_origin(10.0))]
    assert np.all(np.diff(coasting[2:]) < 0)


def test_a_wall_stops_it_and_is_named():
    wall = Solid("building", Pose(20.0, 0.0), (1.0, 8.0), 5.0)
    physics = Physics([wall], at_origin(8.0))
    touched = []
    for _ in range(80):
        physics.step(Control(0.0, throttle=0.4), 0.05)
        touched += physics.contacts()
    assert set(touched) == {Contact("static", "building 0")}
    assert physics.state().x_m < 17.5


def test_a_kerb_or_the_ground_is_not_a_contact():
    physics = Physics([], at_origin(8.0))
    for _ in range(40):
        physics.step(Control(0.6, throttle=0.4), 0.05)
        assert physics.contacts() == []


def test_the_same_drive_is_the_same_to_the_bit():
    wall = Solid("tree", Pose(25.0, -1.0), (0.2, 0.2), 3.0)

    def wavering(state):
        return Control(0.3 * math.sin(state.x_m), throttle=0.6)

    assert states(wavering, 150, solids=[wall]) == states(wavering, 150, solids=[wall])


def test_people_are_hit_by_the_outline_of_the_car_not_its_circle():
    turned = VehicleState(10.0, 5.0, 0.0, math.pi / 2, 0.0)
    people = np.array([[10.0, 7.4], [10.0, 7.7], [11.2, 5.0], [11.4, 5.0], [11.4, 7.7]])
    assert people_hit(turned, people) == [0, 2]


@pytest.fixture(scope="module")
def roads():
    return load_map("town")


def on_lane(roads, offset_m, backwards=False):
    """A pose beside the middle of a long driving lane, `offset_m` to its right."""
    lane = max(
        (lane for lane in roads.lanes if lane.kind == "driving" and lane.junction is None), key=lambda v: v.length_m
    )
    k = len(lane.centre) // 2
    yaw = float(lane.headings_rad[k])
    x, y = lane.centre[k, :2] + offset_m * np.array([math.sin(yaw), -math.cos(yaw)])
    return VehicleState(float(x), float(y), 0.0, yaw + (math.pi if backwards else 0.0), 5.0)


def kinds(roads, state):
    return {event.kind for event in Judge(roads).watch(state, 0.0, [], NOBODY)}


def test_in_its_lane_nothing_is_wrong(roads):
    assert kinds(roads, on_lane(roads, 0.0)) == set()
    assert kinds(roads, on_lane(roads, -0.8)) == set()


def test_the_opposite_lane_is_the_wrong_lane_and_so_is_driving_backwards(roads):
    assert kinds(roads, on_lane(roads, -2.5)) == {EventKind.WRONG_LANE}
    assert EventKind.WRONG_LANE not in kinds(roads, on_lane(roads, -3.5, backwards=True))


def test_a_lane_is_as_wide_as_it_is_there(tmp_path):
    width = '<width sOffset="0" a="3.5" b="0" c="0" d="0"/>'
    lane = '<{0}><lane id="{1}" type="driving">{2}</lane></{0}>'
    widening = lane.format("right", -1, width.replace('b="0"', 'b="0.0175"'))
    (tmp_path / "map.xodr").write_text(
        '<OpenDRIVE><road id="1" length="200" junction="-1"><planView><geometry s="0" x="0" y="0" hdg="0" length="200">'
        f'<line/></geometry></planView><lanes><laneSection s="0">{lane.format("left", 1, width)}'
        f'<center><lane id="0"/></center>{widening}</laneSection></lanes></road></OpenDRIVE>'
    )
    roads = load_map(str(tmp_path / "map.xodr"))
    assert kinds(roads, VehicleState(6.0, 0.5, 0.0, 0.0, 8.0)) == {EventKind.WRONG_LANE}
    assert EventKind.WRONG_LANE not in kinds(roads, VehicleState(190.0, 0.0, 0.0, 0.0, 8.0))


def test_further_right_comes_the_sidewalk_and_then_the_land(roads):
    found = [kinds(roads, on_lane(roads, offset)) for offset in np.arange(0.0, 12.0, 0.25)]
    first = {kind: next(i for i, those in enumerate(found) if kind in those) for kind in set().union(*found)}
    assert first[EventKind.SIDEWALK] < first[EventKind.OFF_ROAD]
    assert EventKind.WRONG_LANE not in first


def test_wheels_decide_about_the_sidewalk_where_the_map_says_it_is(roads):
    from roadproof.simulators.tracker.judge import wheels

    for offset in np.arange(1.0, 5.0, 0.25):
        state = on_lane(roads, float(offset))
        expected = bool((roads.surface_at(np.array(wheels(state))) == Surface.SIDEWALK).any())
        assert (EventKind.SIDEWALK in kinds(roads, state)) == expected


def test_each_thing_is_hit_once_and_each_departure_counts_once_until_it_is_over(roads):
    judge, inside, outside = Judge(roads), on_lane(roads, 0.0), on_lane(roads, -2.5)
    tree = Contact("static", "tree 3")
    seen = []
    for step in range(120):
        away = 20 <= step < 40 or 45 <= step < 60 or step >= 100
        contacts = [tree] if step in (10, 11, 90) else []
        seen += judge.watch(outside if away else inside, step * 0.05, contacts, NOBODY)
    assert [(event.kind, round(event.time_s / 0.05)) for event in seen] == [
        (EventKind.COLLISION_STATIC, 10),
        (EventKind.WRONG_LANE, 20),
        (EventKind.WRONG_LANE, 100),
    ]
