"""Going astray on purpose, on a car whose equations are known: a kinematic bicycle."""

import dataclasses
import math

import numpy as np
import pytest

from roadproof.datatypes import Command, Control, Ending, Observation, VehicleState, Weather
from roadproof.drives import SteeringNoise
from roadproof.drives.perturb import CleanPath, noisy, offsets, steering_noise, swerving
from roadproof.driving.episode import Episode
from roadproof.errors import CanvasNotReachedError
from roadproof.recordings import Side

DT_S, SPEED_MPS = 0.05, 7.0
FRAME = np.zeros((4, 4, 3), np.uint8)


def move(state, steer, gain):
    yaw = state.yaw_rad - gain * steer * SPEED_MPS * DT_S
    x = state.x_m + SPEED_MPS * DT_S * math.cos(yaw)
    y = state.y_m + SPEED_MPS * DT_S * math.sin(yaw)
    return VehicleState(x, y, 0.0, yaw, SPEED_MPS)


def drive(policy, gain, steps=160):
    """States, and the controls given."""
    states, controls = [VehicleState(0.0, 0.0, 0.0, 3.0, SPEED_MPS)], []
    for k in range(steps):
        controls.append(policy(Observation(FRAME, states[-1], Command.FOLLOW, DT_S * k)))
        states.append(move(states[-1], controls[-1].steer, gain))
    return states, controls


def episode(states, controls):
    columns = {name: np.array([getattr(s, name) for s in states]) for name in VehicleState.__slots__}
    given = {name: np.array([getattr(c, name) for c in controls]) for name in ("steer", "throttle", "brake")}
    return Episode(
        scenario="round", weather=Weather.CLEAR_NOON, painted=False, cars=0, pedestrians=0, seed=0, dt_s=DT_S,
        ending=Ending.GOAL_REACHED, events=(), time_s=DT_S * np.arange(len(states)),
        command=np.full(len(states), 2), **columns, **given,
    )  # fmt: skip


def bend(seen):
    """A left bend after a straight, its heading through ±π."""
    return Control(0.0 if seen.time_s < 2.0 else -0.25, throttle=0.5)


@pytest.mark.parametrize("gain", [0.23, 0.42])
def test_the_gain_of_the_steering_is_read_from_the_clean_drive(gain):
    path = CleanPath.of(episode(*drive(bend, gain)))
    assert path.curvature_per_steer == pytest.approx(gain, rel=0.05)


def test_where_a_car_is_beside_the_path_is_told_in_metres_to_the_right():
    clean = episode(*drive(bend, 0.3))
    path = CleanPath.of(clean)
    k = 100
    heading = clean.yaw_rad[k]
    aside = VehicleState(
        clean.x_m[k] + 0.8 * math.sin(heading), clean.y_m[k] - 0.8 * math.cos(heading), 0.0, heading, 7.0
    )
    s, d = path.locate(aside, None)
    assert d == pytest.approx(0.8, abs=0.01)
    assert s == pytest.approx(SPEED_MPS * DT_S * k, abs=0.05)
    assert path.locate(aside, s)[0] == pytest.approx(s)


@pytest.mark.parametrize("side", [Side.RIGHT, Side.LEFT, Side.RANDOM])
@pytest.mark.parametrize("gain", [0.23, 0.42])
def test_a_swerve_has_the_size_that_was_asked_for_whatever_the_car(side, gain):
    path = CleanPath.of(episode(*drive(bend, gain)))
    wanted = offsets(side, 1.5, 15.0, 45.0, float(path.arclength_m[-1]), np.random.default_rng(3))
    answers = []
    states, controls = drive(swerving(lambda _: Control(0.9, throttle=0.4), path, wanted, answers.append), gain, 130)
    aside = np.array([path.locate(state, None)[1] for state in states])
    towards = {Side.RIGHT: aside, Side.LEFT: -aside, Side.RANDOM: np.abs(aside)}[side]
    assert towards.max() == pytest.approx(1.5, rel=0.1)
    assert side is Side.RANDOM or towards.min() > -0.05, "one-sided"
    assert set(answers) == {0.9}
    assert {control.throttle for control in controls} == {0.4}


def test_offsets_begin_at_zero_with_the_view_and_differ_by_seed():
    first, second = (offsets(Side.RIGHT, 1.0, 10.0, 40.0, 60.0, np.random.default_rng(seed)) for seed in (1, 2))
    assert first.at(9.0) == (0.0, 0.0, 0.0)
    assert first.at(40.0)[0] == pytest.approx(1.0)
    assert np.abs(first.offset_m - second.offset_m).max() > 0.02


@pytest.mark.parametrize("side", [Side.RIGHT, Side.RANDOM])
def test_nothing_swerves_over_a_canvas_that_is_seen_from_one_place(side):
    with pytest.raises(
        CanvasNotReachedError, match=r"the clean drive goes 0\.00 m .* expected 1 m or more to swerve over"
    ):
        offsets(side, 1.5, 10.0, 10.0, 60.0, np.random.default_rng(0))


def test_weaves_to_any_side_begin_where_the_generator_says():
    one, other = (
        offsets(Side.RANDOM, 0.5, 15.0, 45.0, 60.0, np.random.default_rng(seed), weaves=True) for seed in (1, 2)
    )
    assert np.abs(one.offset_m - other.offset_m).max() > 0.1
    assert max(np.abs(each.offset_m).max() for each in (one, other)) <= 0.5


def test_a_weave_turns_the_car_both_ways_about_the_clean_path():
    path = CleanPath.of(episode(*drive(bend, 0.3)))
    length_m = float(path.arclength_m[-1])
    for side, sign in ((Side.RIGHT, 1.0), (Side.LEFT, -1.0)):
        wanted = offsets(side, 0.5, 15.0, 45.0, length_m, np.random.default_rng(3), weaves=True)
        states, _ = drive(swerving(lambda _: Control(0.0, throttle=0.4), path, wanted, lambda _: None), 0.3, 130)
        placed = [path.locate(state, None) for state in states]
        s, aside = np.array(placed).T
        turned = np.array([state.yaw_rad - path.at(path.heading_rad, at) for state, at in zip(states, s, strict=True)])
        assert (sign * aside[(s > 15.0) & (s < 20.0)]).max() > 0.3, "begins to its own side"
        assert aside.min() < -0.3
        assert aside.max() > 0.3
        assert turned.min() < -0.2
        assert turned.max() > 0.2


def test_published_noise_is_whole_degrees_to_one_side_for_two_seconds():
    clean = episode(*drive(bend, 0.3))
    draws = [
        steering_noise(side, SteeringNoise(4, 20), clean, 100, np.random.default_rng(0))
        for side in (Side.RIGHT, Side.LEFT, Side.RANDOM)
    ]
    for noise in draws:
        steps = np.flatnonzero(noise)
        assert (steps[0], len(steps)) == (70, 42)
        assert set(np.abs(noise[steps])) <= set(range(4, 21))
    assert draws[0].min() == 0.0 == draws[1].max()
    assert draws[2].min() < 0.0 < draws[2].max()


def test_noise_goes_on_top_of_the_clean_controls_while_the_policy_only_answers():
    clean = episode(*drive(bend, 0.3))
    noise = np.zeros(clean.steer.size)
    noise[50:60] = 10.0
    answers = []
    _, controls = drive(noisy(lambda _: Control(-0.9, brake=1.0), clean, noise, answers.append), 0.3)
    given = np.array([control.steer for control in controls])
    np.testing.assert_allclose(given[:50], clean.steer[:50])
    np.testing.assert_allclose(given[50:60], clean.steer[50:60] + np.deg2rad(10))
    assert {control.throttle for control in controls} == {0.5}
    assert set(answers) == {-0.9}


def test_a_car_that_stands_still_has_no_path():
    clean = episode(*drive(bend, 0.3))
    still = dataclasses.replace(clean, x_m=clean.x_m * 0, y_m=clean.y_m * 0)
    with pytest.raises(CanvasNotReachedError, match="hardly moves in round"):
        CleanPath.of(still)
