"""Scores tell a clean drive from a bad one, and a turn taken from a turn missed."""

import dataclasses

import pytest

import needs
from roadproof.datatypes import Control, Weather
from roadproof.scenarios import builtin_scenarios, find_scenario
from roadproof.training.scores import BareDrive, score_drive, score_drives
from roadproof.training.workers import driving

needs.town()

SCENARIOS = builtin_scenarios()


class Held:
    """Drives on with one control for ever."""

    input_size = (88, 200)

    def __init__(self, control: Control) -> None:
        self.control = control

    def steer(self, frames, speed_mps, command):
        return frames.new_full((len(frames),), self.control.steer)

    def act(self, frame, speed_mps, command):
        return self.control if speed_mps < 6 else Control(self.control.steer)


@pytest.fixture(scope="module")
def town():
    with driving(None, 0.05) as worker:
        yield worker.town


def test_the_expert_drives_a_turn_clean(town):
    score = score_drive(town, None, BareDrive(scenario=find_scenario("left-11", SCENARIOS)))
    assert score.clean
    assert (score.turns, score.turns_taken) == (1, 1)
    assert score.failed_at_m is None
    assert score.lateral_m < 0.4
    assert 0.0 < score.steer_change < 0.02


def test_who_drives_straight_on_does_not_take_the_turn(town):
    drive = BareDrive(scenario=find_scenario("left-11", SCENARIOS))
    score = score_drive(town, Held(Control(0.0, throttle=0.5)), drive)
    assert not score.clean
    assert (score.turns, score.turns_taken) == (1, 0)
    assert score.failed_at_m is not None
    assert score.steer_change == 0.0


def test_a_drive_alone_ends_at_its_first_event(town):
    drive = BareDrive(scenario=find_scenario("straight-02", SCENARIOS))
    score = score_drive(town, Held(Control(0.4, throttle=0.5)), drive)
    assert len({event.time_s for event in score.events}) == 1
    assert score.seconds == score.events[0].time_s
    assert not score.arrived
    assert score.collisions == sum("collision" in event.kind for event in score.events)


def test_who_stands_does_not_arrive(town):
    short = dataclasses.replace(find_scenario("straight-02", SCENARIOS), time_limit_s=1.0)
    score = score_drive(town, Held(Control(0.0)), BareDrive(scenario=short))
    assert not score.arrived
    assert score.events == ()
    assert score.failed_at_m == pytest.approx((short.start.x_m, short.start.y_m), abs=0.2)


def test_who_stands_until_the_drive_is_given_up_does_not_arrive(town):
    long = dataclasses.replace(find_scenario("straight-02", SCENARIOS), time_limit_s=60.0)
    score = score_drive(town, Held(Control(0.0)), BareDrive(scenario=long))
    assert (score.arrived, score.clean, score.events) == (False, False, ())
    assert score.seconds == pytest.approx(30.0)


def test_processes_and_one_process_agree():
    wanted = [
        BareDrive(scenario=find_scenario(name, SCENARIOS), weather=Weather.RAINY_NOON, cars=3, pedestrians=3, seed=1)
        for name in ("straight-10", "right-07")
    ]
    alone, spread = dict(score_drives(wanted, None)), dict(score_drives(wanted, None, processes=2))
    assert alone == spread
    assert set(alone) == set(wanted)
