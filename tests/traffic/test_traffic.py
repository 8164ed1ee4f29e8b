"""Traffic keeps its lanes, its distance and its promises: the same seed, the same day."""

import math
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from carla_serving import straight_map
from roadproof.datatypes import VehicleState
from roadproof.errors import SimulatorError
from roadproof.roads.maps import load_map
from roadproof.roads.roadmap import RoadMap, Surface
from roadproof.traffic.agents import (
    CAR_LENGTH_M,
    CAR_WIDTH_M,
    NOBODY,
    Agents,
    first_in_way,
    idm_acceleration,
    obstacles,
)
from roadproof.traffic.tracks import Tracks
from roadproof.traffic.traffic import Traffic

PARKED = VehicleState(150.0, -1.75, 0.0, 0.0, 0.0)
AWAY = VehicleState(0.0, -60.0, 0.0, 0.0, 0.0)


def agents(rows: list[tuple[float, float, float, float]]) -> Agents:
    x, y, yaw, speed = np.array(rows, dtype=float).T.copy()
    return Agents(x, y, yaw, speed, np.zeros(len(x)), np.zeros(len(x), dtype=np.int64))


def corners(cars: Agents, *, shrink_m: float = 0.0) -> np.ndarray:
    ahead, aside = CAR_LENGTH_M / 2 - shrink_m, CAR_WIDTH_M / 2 - shrink_m
    c, s = np.cos(cars.yaw_rad), np.sin(cars.yaw_rad)
    local = np.array([[ahead, aside], [ahead, -aside], [-ahead, -aside], [-ahead, aside]])
    x = cars.x_m[:, None] + c[:, None] * local[:, 0] - s[:, None] * local[:, 1]
    y = cars.y_m[:, None] + s[:, None] * local[:, 0] + c[:, None] * local[:, 1]
    return np.stack([x, y], axis=2)


def overlapping(one: np.ndarray, other: np.ndarray) -> bool:
    """Whether two rectangles overlap: no side of either parts them."""
    for shape in (one, other):
        for k in range(4):
            edge = shape[(k + 1) % 4] - shape[k]
            normal = np.array([edge[1], -edge[0]])
            if (one @ normal).max() < (other @ normal).min() or (other @ normal).max() < (one @ normal).min():
                return False
    return True


def anyone_inside(cars: Agents, people: Agents) -> bool:
    """Whether a person stands in a moving car."""
    dx, dy = people.x_m[:, None] - cars.x_m, people.y_m[:, None] - cars.y_m
    ahead = dx * np.cos(cars.yaw_rad) + dy * np.sin(cars.yaw_rad)
    aside = dy * np.cos(cars.yaw_rad) - dx * np.sin(cars.yaw_rad)
    inside = (np.abs(ahead) < CAR_LENGTH_M / 2) & (np.abs(aside) < CAR_WIDTH_M / 2)
    return bool((inside & (cars.speed_mps > 0.1)).any())


@pytest.mark.parametrize(("name", "ego"), [("town", AWAY), ("town", PARKED), ("second", AWAY)])
def test_a_busy_town_flows_without_collisions(name: str, ego: VehicleState) -> None:
    road_map = load_map(name)
    traffic = Traffic(road_map, cars=30, pedestrians=30, seed=3, ego=ego)
    crossed = 0
    for step in range(700):
        traffic.step(0.1, ego)
        cars, people = traffic.cars, traffic.pedestrians
        assert not anyone_inside(cars, people)
        apart = np.hypot(cars.x_m[:, None] - cars.x_m, cars.y_m[:, None] - cars.y_m)
        shapes = corners(cars, shrink_m=0.05)
        for a, b in zip(*np.nonzero(np.triu(apart < 5.0, 1)), strict=True):
            assert not overlapping(shapes[a], shapes[b]), f"cars {a} and {b} at step {step}"
        crossed += int((road_map.surface_at(np.stack([people.x_m, people.y_m], axis=1)) == Surface.DRIVING).sum())
    assert crossed > 50  # person-steps on the road
    moved = cars.travelled_m
    if ego is AWAY:
        assert moved.min() > 130.0  # nobody is stuck
    else:
        assert np.median(moved) > 130.0  # a parked car holds up its lane, not the town


def test_cars_queue_at_a_dead_end_and_behind_the_driven_car_there(tmp_path: Path) -> None:
    path = straight_map(tmp_path, 300.0)
    ego = VehicleState(290.0, -1.75)
    traffic = Traffic(load_map(str(path)), cars=8, pedestrians=0, seed=0, ego=ego)
    for step in range(700):
        traffic.step(0.1, ego)
        x, y = np.append(traffic.cars.x_m, ego.x_m), np.append(traffic.cars.y_m, ego.y_m)
        apart = np.hypot(x[:, None] - x, y[:, None] - y)[np.triu_indices(len(x), 1)]
        assert apart.min() > CAR_WIDTH_M, f"two cars at one place at step {step}"
    assert traffic.cars.speed_mps.max() < 0.1, "all wait"
    assert ((traffic.cars.x_m > 2.0) & (traffic.cars.x_m < 298.0)).all(), "on the road"


def test_cars_keep_their_lanes() -> None:
    road_map = load_map("town")
    traffic = Traffic(road_map, cars=20, pedestrians=0, seed=0, ego=AWAY)
    for step in range(300):
        traffic.step(0.1, AWAY)
        if step % 10 == 0:
            for x, y, yaw in zip(traffic.cars.x_m, traffic.cars.y_m, traffic.cars.yaw_rad, strict=True):
                found = road_map.nearest_lane(float(x), float(y), float(yaw))
                assert abs(found.lateral_m) < 0.05
                assert abs(found.heading_error_rad) < 0.1


def test_the_same_seed_gives_the_same_traffic_and_another_seed_another() -> None:
    road_map = load_map("town")
    runs: list[np.ndarray] = []
    for seed in (5, 5, 6):
        traffic = Traffic(road_map, cars=20, pedestrians=20, seed=seed, ego=PARKED)
        for _ in range(200):
            traffic.step(0.05, PARKED)
        both = (traffic.cars, traffic.pedestrians)
        runs.append(np.concatenate([np.stack([a.x_m, a.y_m, a.yaw_rad, a.speed_mps]) for a in both]))
    np.testing.assert_array_equal(runs[0], runs[1])
    assert not np.array_equal(runs[0], runs[2])


def test_another_process_gives_the_same_traffic() -> None:
    script = (
        "from roadproof.datatypes import VehicleState\n"
        "from roadproof.roads.maps import load_map\n"
        "from roadproof.traffic.traffic import Traffic\n"
        "ego = VehicleState(150.0, -1.75, 0.0, 0.0, 0.0)\n"
        "traffic = Traffic(load_map('town'), cars=20, pedestrians=20, seed=5, ego=ego)\n"
        "for _ in range(200): traffic.step(0.05, ego)\n"
        "print([a.tobytes().hex() for who in (traffic.cars, traffic.pedestrians) for a in (who.x_m, who.y_m)])\n"
    )
    outputs = [
        subprocess.run(
            [sys.executable, "-c", script],
            env={**os.environ, "PYTHONHASHSEED": seed, "PYTHONPATH": os.pathsep.join(sys.path)},
            capture_output=True,
            check=True,
        ).stdout
        for seed in ("1", "2")
    ]
    assert outputs[0] == outputs[1]
    assert len(outputs[0]) > 1000


def test_cars_stop_behind_the_driven_car() -> None:
    road_map = load_map("town")
    waiting = 0
    traffic = Traffic(road_map, cars=30, pedestrians=0, seed=1, ego=PARKED)
    for _ in range(900):
        traffic.step(0.1, PARKED)
        apart = np.hypot(traffic.cars.x_m - PARKED.x_m, traffic.cars.y_m - PARKED.y_m)
        ego = corners(agents([(PARKED.x_m, PARKED.y_m, 0.0, 0.0)]))[0]
        for car in np.flatnonzero(apart < 5.0):
            assert not overlapping(corners(traffic.cars)[car], ego)
        waiting += int(((apart < 10.0) & (traffic.cars.speed_mps < 0.1)).any())
    assert waiting > 50


def test_nobody_is_placed_upon_the_driven_car() -> None:
    for seed in range(5):
        cars = Traffic(load_map("town"), cars=20, pedestrians=0, seed=seed, ego=PARKED).cars
        assert np.hypot(cars.x_m - PARKED.x_m, cars.y_m - PARKED.y_m).min() > 25.0


def test_nobody_is_none_by_default_cost_and_size() -> None:
    traffic = Traffic(load_map("town"), cars=0, pedestrians=0, seed=0, ego=PARKED)
    traffic.step(0.05, PARKED)
    assert len(traffic.cars) == len(traffic.pedestrians) == 0


@pytest.mark.parametrize("length_m", [11.0, 12.3])
def test_a_street_too_short_for_a_car_is_none(tmp_path: Path, length_m: float) -> None:
    width = '<width sOffset="0" a="3.5" b="0" c="0" d="0"/>'
    lane = f'<lanes><laneSection s="0"><right><lane id="-1" type="driving">{width}</lane></right></laneSection></lanes>'
    (tmp_path / "short.xodr").write_text(
        f'<OpenDRIVE><road id="7" length="{length_m}" junction="-1"><planView><geometry s="0" x="0" y="0" hdg="0" '
        f'length="{length_m}"><line/></geometry></planView>{lane}</road></OpenDRIVE>'
    )
    road_map = load_map(str(tmp_path / "short.xodr"))
    with pytest.raises(SimulatorError, match="1 cars do not fit on the map, which has no street"):
        Traffic(road_map, cars=1, pedestrians=0, seed=0, ego=AWAY)
    assert len(Traffic(road_map, cars=0, pedestrians=0, seed=0, ego=AWAY).cars) == 0


def test_what_cannot_be_is_refused() -> None:
    road_map = load_map("town")
    with pytest.raises(SimulatorError, match="-1 cars were asked for"):
        Traffic(road_map, cars=-1, pedestrians=0, seed=0, ego=PARKED)
    with pytest.raises(SimulatorError, match="the seed of the traffic is -1, expected a whole number, 0 or more"):
        Traffic(road_map, cars=1, pedestrians=0, seed=-1, ego=PARKED)
    with pytest.raises(SimulatorError, match="5000 cars do not fit"):
        Traffic(road_map, cars=5000, pedestrians=0, seed=0, ego=PARKED)


def test_traffic_drives_on_the_towns_of_carla(opendrive_data: Path) -> None:
    road_map = load_map(str(opendrive_data / "Town02.xodr"))
    traffic = Traffic(road_map, cars=20, pedestrians=20, seed=0, ego=AWAY)
    for _ in range(600):
        traffic.step(0.1, AWAY)
    assert traffic.cars.travelled_m.min() > 100.0


def test_a_step_is_quick() -> None:
    traffic = Traffic(load_map("town"), cars=20, pedestrians=20, seed=0, ego=PARKED)
    begin = time.process_time()
    for _ in range(100):
        traffic.step(0.05, PARKED)
    assert (time.process_time() - begin) / 100 < 0.01  # 0.35 ms on a quiet core without checked types


def test_idm_keeps_its_equilibrium_and_brakes_for_a_standing_leader() -> None:
    speed = np.array([5.0])
    gap = (2.0 + 1.2 * speed) / np.sqrt(1.0 - (speed / 8.0) ** 4)  # where eq. 2 and 3 balance
    rest = idm_acceleration(speed, np.array([8.0]), gap, speed)
    assert float(rest[0]) == pytest.approx(0.0, abs=1e-12)
    free = idm_acceleration(np.array([0.0]), np.array([8.0]), np.array([np.inf]), np.array([0.0]))
    assert float(free[0]) == pytest.approx(1.8)
    v, x = 8.0, 0.0
    for _ in range(2000):
        a = float(idm_acceleration(np.array([v]), np.array([8.0]), np.array([60.0 - x]), np.array([0.0]))[0])
        after = max(v + a * 0.02, 0.0)
        x, v = x + 0.01 * (v + after), after
    assert v < 0.05
    assert 56.5 < x < 58.5  # two metres short


def test_the_first_thing_in_the_way_is_found_with_its_speed() -> None:
    cars = agents([(0.0, 0.0, 0.0, 3.0), (20.0, 0.3, 0.0, 4.0), (12.0, 3.5, math.pi, 6.0), (40.0, 0.0, 0.0, 0.0)])
    people = agents([(9.0, -3.0, math.pi / 2, 1.5)])
    ahead = np.arange(0.5, 30.0, 0.5)
    path_x, path_y = ahead[None], np.zeros((1, len(ahead)))
    own = np.array([0])
    free, leader = first_in_way(path_x, path_y, ahead, obstacles(cars, NOBODY, None), own, margin_m=0.9)
    # The rear disc of the car ahead, at 18.4 m, less the reach sqrt(1.9² − 0.3²).
    assert float(free[0]) == pytest.approx(18.4 - math.sqrt(1.9**2 - 0.3**2), abs=0.5)
    assert float(leader[0]) == pytest.approx(4.0)
    free, leader = first_in_way(path_x, path_y, ahead, obstacles(cars, people, None), own, margin_m=1.3)
    assert 7.0 < float(free[0]) < 9.0  # where the person will be in a second
    assert float(leader[0]) == 0.0
    free, _ = first_in_way(path_x, path_y + 50.0, ahead, obstacles(cars, people, None), own, margin_m=1.3)
    assert free[0] == np.inf


@pytest.fixture(scope="module")
def tracks() -> tuple[RoadMap, Tracks]:
    road_map = load_map("town")
    return road_map, Tracks(road_map, "driving")


def test_tracks_join_lanes_without_a_jump(tracks: tuple[RoadMap, Tracks]) -> None:
    road_map, joined = tracks
    for track, others in enumerate(joined.successors):
        end = joined.points(np.array([track]), joined.length_m[track : track + 1])
        for other in others:
            start = joined.points(np.array([other]), np.zeros(1))
            assert math.hypot(end[0][0] - start[0][0], end[1][0] - start[1][0]) < 0.01
    assert sorted(index for chain in joined.chains for index in chain) == sorted(
        lane.index for lane in road_map.lanes if lane.kind == "driving"
    )


def test_places_on_tracks_are_places_on_lanes(tracks: tuple[RoadMap, Tracks]) -> None:
    road_map, joined = tracks
    for index, (track, start_m) in joined.place.items():
        lane = road_map.lanes[index]
        middle = lane.length_m / 2
        x, y, limit = joined.points(np.array([track]), np.array([start_m + middle]))
        assert math.dist((x[0], y[0]), [np.interp(middle, lane.stations_m, lane.centre[:, k]) for k in (0, 1)]) < 0.02
        assert joined.lane_at(track, start_m + middle) == pytest.approx((index, middle))
        assert 3.0 < limit[0] <= math.sqrt(2.2 / 1e-3)


def test_ways_that_cross_are_in_conflict_and_opposite_ones_are_not(tracks: tuple[RoadMap, Tracks]) -> None:
    _, joined = tracks
    conflict = joined.conflicts(2.6)
    assert (conflict == conflict.T).all()
    crossings = [t for t, junction in enumerate(joined.junction) if junction is not None]
    turns = {t: float(np.ptp(joined.yaws(np.array([t, t]), np.array([0.0, joined.length_m[t]])))) for t in crossings}
    starts = {t: float(joined.yaws(np.array([t]), np.zeros(1))[0]) for t in crossings}
    pairs = [(a, b) for a in crossings for b in crossings if a < b and joined.junction[a] == joined.junction[b]]
    straight = [(a, b) for a, b in pairs if turns[a] < 0.1 and turns[b] < 0.1]
    for a, b in straight:
        assert conflict[a, b] == (abs(math.cos(starts[a] - starts[b])) < 0.5)
    assert len(straight) > 5
