"""The recorded world as a simulator: what it promises and what it refuses."""

import dataclasses

import numpy as np
import pytest
import torch

from paint_shy import PaintShy
from recorded_drives import CANVAS, VEHICLE, drivable_set, shown_from, track
from roadproof.datatypes import Control, Ending, Weather
from roadproof.driving.deviation import path_of
from roadproof.driving.episode import Episode
from roadproof.driving.rollout import rollout
from roadproof.errors import RecordingError, SimulatorError
from roadproof.recorded.simulator import FURTHEST_ASIDE_M, FURTHEST_TURNED_RAD, RecordedSimulator
from roadproof.recorded.vehicle import Motion, Vehicle
from roadproof.simulators.checks import check_simulator
from roadproof.simulators.protocol import Identified, PaintKind, Simulator

MAGENTA = np.full((400, 400, 4), (255, 0, 255, 255), np.uint8)
TRACK = track()


@dataclasses.dataclass(frozen=True, kw_only=True, slots=True)
class OnRails(Vehicle):
    """Follows the clean drive's track, whatever it is told."""

    def step(self, car, steer, throttle, brake):
        x, y = TRACK.x_m - CANVAS.x_m, TRACK.y_m - CANVAS.y_m
        row = int(np.hypot(x - float(car.x_m), y - float(car.y_m)).argmin()) + 1
        values = (x[row], y[row], TRACK.yaw_rad[row], TRACK.speed_mps[row], 0.0, 0.0)
        return Motion(*(torch.tensor([value], dtype=torch.float64) for value in values))


ON_RAILS = OnRails(**{field.name: getattr(VEHICLE, field.name) for field in dataclasses.fields(Vehicle)})


@pytest.fixture(scope="module")
def recordings():
    return drivable_set()


@pytest.fixture
def world(recordings):
    with RecordedSimulator(recordings) as simulator:
        yield simulator


def holding(steer, throttle=0.05):
    """A driver that holds its wheel."""
    return lambda _: lambda _: Control(steer, throttle=throttle)


def watched(world, driver, **options):
    """A drive and its frames."""
    frames = []
    episode = rollout(world, driver, world.scenario, on_step=lambda seen, _: frames.append(seen.frame), **options)
    return episode, frames


def test_it_is_a_simulator_that_knows_its_own_stretch(world, recordings):
    assert isinstance(world, Simulator)
    assert isinstance(world, Identified)
    assert (world.camera, world.input, world.dt_s) == (recordings.camera, recordings.view, 0.05)
    assert world.paint is PaintKind.COMPOSITED
    clean = recordings.recordings[0]
    start = clean.track.state(int(clean.frame_number[0]))
    scenario = world.scenario
    assert (scenario.name, scenario.kind, scenario.canvas) == ("test-road", "straight", CANVAS)
    np.testing.assert_allclose(dataclasses.astuple(scenario.start), dataclasses.astuple(start), atol=1e-9)
    past = np.array(scenario.goal_m) - (CANVAS.x_m, CANVAS.y_m)
    assert past @ (np.cos(CANVAS.yaw_rad), np.sin(CANVAS.yaw_rad)) == pytest.approx(CANVAS.length_m / 2, abs=0.4)
    assert world.way.shape == (len(world.way), 2)
    np.testing.assert_allclose(world.way[[0, -1]], [(start.x_m, start.y_m), scenario.goal_m], atol=1e-9)


def test_it_keeps_the_promises_of_simulators_that_recordings_can_keep(world):
    # A frame is four times as coarse as the camera picture in which the kit looks for squares of paint; traffic and
    # other weathers, which two more of its checks ask for, are refused.
    left_out = {"determinism", "reset", "paint"}
    report = check_simulator(world, world.scenario)
    assert {check.name for check in report.checks if not check.passed} == left_out, str(report)


def test_at_recorded_poses_the_recorded_frames_are_seen_bit_for_bit(recordings):
    clean = recordings.recordings[0]
    with RecordedSimulator(recordings, vehicle=ON_RAILS) as world:
        _, bare = watched(world, holding(0.0))
        _, painted = watched(world, holding(0.0), pattern=MAGENTA)
        world.reset(world.scenario)
        first = int(clean.frame_number[0])
        assert len(bare) > clean.frame_number[-1] - first
        for number, frame in zip(clean.frame_number - first, clean.frames, strict=True):
            np.testing.assert_array_equal(bare[number], frame)
            changed = (painted[number] != frame).any(-1)
            assert changed.sum() > 40
            views = world._world.bank.show(*shown_from(world._world.bank, clean.track, number + first))
            on_canvas = np.isin(np.arange(changed.size), views.canvas.pixel.numpy()).reshape(changed.shape)
            assert not (changed & ~on_canvas).any(), "outside the canvas nothing changes"
            inside = views.canvas.pixel[views.canvas.gain[..., 0] > 0.999].numpy()
            assert (painted[number].reshape(-1, 3)[inside] == (255, 0, 255)).all(), "and inside it is all paint"


def test_the_same_calls_give_the_same_pixels_and_nothing_of_another_drive_is_left(world):
    one, first = watched(world, PaintShy(), pattern=MAGENTA)
    _, other = watched(world, holding(0.1))
    two, second = watched(world, PaintShy(), pattern=MAGENTA, seed=7)
    np.testing.assert_array_equal(np.stack(first), np.stack(second))
    np.testing.assert_array_equal(path_of(one), path_of(two))
    assert not np.array_equal(other[5], first[5])


def test_a_drive_begins_where_the_recordings_do_whatever_the_scenario_says(world):
    moved = dataclasses.replace(world.scenario, start=dataclasses.replace(world.scenario.start, x_m=0.0, speed_mps=1.0))
    assert world.reset(moved).state == world.scenario.start


def test_a_drive_ends_at_the_canvas_end_or_when_its_time_is_up(world):
    episode = rollout(world, holding(0.0), world.scenario)
    assert episode.ending is Ending.GOAL_REACHED
    ahead = (path_of(episode) - (CANVAS.x_m, CANVAS.y_m)) @ (np.cos(CANVAS.yaw_rad), np.sin(CANVAS.yaw_rad))
    assert ahead[-2] < CANVAS.length_m / 2 < ahead[-1] + 0.4
    short = rollout(world, holding(0.0), dataclasses.replace(world.scenario, time_limit_s=1.0))
    assert short.ending is Ending.TIME_LIMIT
    assert len(short) == 21


@pytest.mark.parametrize("steer", [-0.5, 0.5])
def test_a_car_that_leaves_the_recorded_band_ends_its_drive(world, tmp_path, steer):
    gaps = []
    episode = rollout(world, holding(steer), world.scenario, on_step=lambda *_: gaps.append(world.gap))
    assert episode.ending is Ending.LEFT_RECORDED
    for gap in gaps[:-1]:
        assert abs(gap.left_m) <= FURTHEST_ASIDE_M
        assert abs(gap.turned_rad) <= FURTHEST_TURNED_RAD
    assert abs(gaps[-1].left_m) > FURTHEST_ASIDE_M or abs(gaps[-1].turned_rad) > FURTHEST_TURNED_RAD
    assert np.sign(gaps[-1].turned_rad) == -np.sign(steer), "right is to the right"
    episode.save(tmp_path / "one.npz")
    kept = Episode.load(tmp_path / "one.npz")
    assert (kept.ending, kept.paint) == (Ending.LEFT_RECORDED, PaintKind.COMPOSITED)


def test_the_gap_is_that_to_a_recorded_pose(world, recordings):
    world.reset(world.scenario)
    assert world.gap == pytest.approx((0, 0, 0), abs=1e-9)
    for _ in range(25):
        state = world.step(Control(0.15)).state
    gap, states = world.gap, []
    for drive in recordings.recordings:
        states += [drive.track.state(int(number)) for number in drive.frame_number]
    forward = np.array([np.cos(state.yaw_rad), np.sin(state.yaw_rad)])
    apart = [np.array([state.x_m - each.x_m, state.y_m - each.y_m]) for each in states]
    told = [
        (a @ forward, a @ (-forward[1], forward[0]), state.yaw_rad - each.yaw_rad)
        for a, each in zip(apart, states, strict=True)
    ]
    assert min(np.abs(np.array(told) - gap).max(1)) < 1e-9


def test_frames_that_nobody_asks_for_are_black(world):
    first = world.reset(world.scenario, frames=frozenset({1}), full_pictures=frozenset({2}))
    second, third = world.step(Control(0.0)), world.step(Control(0.0))
    assert [seen.frame.any() for seen in (first, second, third)] == [False, True, True]
    world.reset(world.scenario)
    np.testing.assert_array_equal(world.step(Control(0.0)).frame, second.frame)


def test_full_pictures_are_the_frame_in_its_place(world):
    seen = world.reset(world.scenario, full_pictures=frozenset({1}))
    assert seen.picture is None
    seen = world.step(Control(0.0))
    assert seen.picture.shape == (600, 800, 3)
    assert not seen.picture[:115].any()
    assert not seen.picture[510:].any()
    np.testing.assert_array_equal(seen.picture[120, 2::4], seen.frame[1])


@pytest.mark.parametrize(
    ("said", "light"),
    [("rainy-noon", Weather.RAINY_NOON), ("", Weather.CLEAR_NOON), ("drizzle", Weather.CLEAR_NOON)],
)
def test_its_light_is_what_the_drives_say(recordings, said, light):
    drives = tuple(dataclasses.replace(each, weather=said) for each in recordings.recordings)
    with RecordedSimulator(dataclasses.replace(recordings, recordings=drives)) as world:
        assert not world.reset(world.scenario, weather=light).done


REFUSED = {
    "cars": ({"cars": 3}, "3 cars and 0 pedestrians are asked for, but recordings hold no others"),
    "people": ({"pedestrians": 1}, "expected 0 of both"),
    "weather": ({"weather": Weather.RAINY_NOON}, "one light, called clear-noon"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_recordings_cannot_give_is_refused_in_one_line(world, name):
    options, message = REFUSED[name]
    with pytest.raises(SimulatorError, match=message) as refused:
        world.reset(world.scenario, **options)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("change", "fits"),
    [
        ({"x_m": CANVAS.x_m + 0.009}, True),
        ({"yaw_rad": CANVAS.yaw_rad + 2 * np.pi}, True),
        ({"x_m": CANVAS.x_m + 0.02}, False),
        ({"yaw_rad": CANVAS.yaw_rad - 0.05}, False),
        ({"length_m": 9.0}, False),
    ],
)
def test_the_scenarios_canvas_must_be_the_recorded_one(world, change, fits):
    scenario = dataclasses.replace(world.scenario, canvas=dataclasses.replace(CANVAS, **change))
    if fits:
        world.reset(scenario)
        return
    with pytest.raises(SimulatorError, match=f"the scenario's canvas has {next(iter(change))} .*that was recorded"):
        world.reset(scenario)


def test_it_is_used_in_a_with_block_and_reset_before_it_is_driven(recordings):
    closed = RecordedSimulator(recordings)
    with pytest.raises(SimulatorError, match="closed; use it in a with-block"):
        closed.reset(closed.scenario)
    with closed:
        for call in (lambda: closed.step(Control(0.0)), closed.image_from_canvas, lambda: closed.gap):
            with pytest.raises(SimulatorError, match="call reset first"):
                call()
        closed.reset(closed.scenario)
    with closed, pytest.raises(SimulatorError, match="call reset first"):
        closed.step(Control(0.0))


def test_what_cannot_be_driven_in_is_refused(recordings):
    with pytest.raises(RecordingError, match="canvas"):
        RecordedSimulator(dataclasses.replace(recordings, canvas=None))
    slow = Vehicle.bicycle(wheelbase_m=2.8, steer_range_rad=0.7, dt_s=0.1)
    with pytest.raises(SimulatorError, match=r"steps of 0\.1 s, the recordings have 0\.05"):
        RecordedSimulator(recordings, vehicle=slow)


def test_other_recordings_another_vehicle_and_the_same_ones_are_told_apart(recordings):
    known = RecordedSimulator(recordings).identity
    assert RecordedSimulator(drivable_set()).identity == known
    clean = recordings.recordings[0]
    other = dataclasses.replace(clean, frames=clean.frames // 2)
    darker = dataclasses.replace(recordings, recordings=(other, *recordings.recordings[1:]))
    assert RecordedSimulator(darker).identity != known
    heavy = Vehicle.bicycle(wheelbase_m=4.0, steer_range_rad=0.7, dt_s=0.05)
    assert RecordedSimulator(recordings, vehicle=heavy).identity != known


def test_another_processor_which_identifies_the_vehicle_to_other_last_digits_drives_in_the_same_world(
    recordings, monkeypatch
):
    known, identified = RecordedSimulator(recordings), Vehicle.identified

    def elsewhere(tracks):
        found = identified(tracks)
        return dataclasses.replace(found, slipping=tuple(value * (1 + 1e-12) + 1e-15 for value in found.slipping))

    monkeypatch.setattr(Vehicle, "identified", staticmethod(elsewhere))
    assert RecordedSimulator(recordings).identity == known.identity
