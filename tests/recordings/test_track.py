"""Tracks: what they refuse, and which of their steps follow each other."""

from dataclasses import replace

import numpy as np
import pytest

from roadproof.errors import RecordingError
from roadproof.recordings import FASTEST_MPS, Track


def track(step=(3, 4, 5, 8, 9, 12)):
    count = len(step)
    return Track(
        dt_s=0.1,
        step=np.array(step),
        x_m=0.5 * np.array(step),
        y_m=np.zeros(count),
        yaw_rad=np.linspace(0.0, 0.1, count),
        speed_mps=np.full(count, 5.0),
        steer=np.linspace(-1.0, 1.0, count),
        throttle=np.linspace(0.0, 1.0, count),
        brake=np.zeros(count),
    )


def test_frames_are_found_by_their_number():
    assert track().rows(np.array([9, 3, 3, 12])).tolist() == [4, 0, 0, 5]
    for unknown in (2, 6, 13):
        with pytest.raises(RecordingError, match=f"no pose for frame {unknown}"):
            track().rows(np.array([3, unknown]))


def test_stretches_end_where_a_step_is_left_out():
    assert list(track().stretches()) == [slice(0, 3), slice(3, 5), slice(5, 6)]
    assert list(track((7, 8, 9)).stretches()) == [slice(0, 3)]
    assert list(track((7,)).stretches()) == [slice(0, 1)]


def test_steps_that_a_log_lost_lie_evenly_between_others():
    turned = replace(track(), yaw_rad=np.array([3.0, 3.1, -3.1, -3.1, -3.1, -3.1]))
    filled = turned.filled(0.35)
    assert filled.step.tolist() == list(range(3, 13))
    np.testing.assert_allclose(filled.x_m, 0.5 * filled.step)
    assert np.abs(np.diff(filled.yaw_rad)).max() < 0.11  # over half a turn, not all the way back
    assert track().filled(0.25).step.tolist() == [3, 4, 5, 8, 9, 12]
    assert np.array_equal(track((7, 8, 9)).filled(0.5).steer, track((7, 8, 9)).steer)


def test_a_state_holds_the_pose_of_its_row():
    state = track().state(3)
    assert (state.x_m, state.y_m, state.z_m, state.speed_mps) == (4.0, 0.0, 0.0, 5.0)
    assert state.yaw_rad == pytest.approx(0.06)
    assert len(track()) == 6


def at(name, index, value):
    values = getattr(track(), name).copy()
    values[index] = value
    return {name: values}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"dt_s": 0.0}, "dt_s"),
        ({"dt_s": float("nan")}, "dt_s"),
        ({"dt_s": 1.5}, "dt_s"),
        # Within half a second lie as many steps that a log may have lost as memory cannot hold.
        ({"dt_s": 1e-12}, "dt_s of the track is 1e-12, expected 0.001 to 1 seconds"),
        ({"step": np.zeros(0, int)}, "no step"),
        ({"step": np.array([[3, 4, 5], [8, 9, 12]])}, "step of the track has shape"),
        ({"x_m": np.zeros(5)}, "x_m of the track has shape"),
        (at("yaw_rad", 2, np.nan), "yaw_rad of the track has NaN"),
        (at("speed_mps", 2, np.inf), "speed_mps of the track has NaN or infinite"),
        (at("steer", 0, -1.01), "steer of the track goes from -1.01"),
        (at("throttle", 0, -0.1), "throttle of the track"),
        (at("brake", 0, 1.1), "brake of the track"),
        (at("speed_mps", 0, -2.0), "speed_mps of the track"),
        (at("speed_mps", 0, FASTEST_MPS + 1), "speed_mps of the track"),
        (at("step", 1, 3), "do not rise"),
        (at("step", 0, 20), "do not rise"),
        (at("x_m", 1, 2.0 + FASTEST_MPS * 0.1), "jumps by 7.5 m from step 3 to 4"),
    ],
)
def test_a_track_that_cannot_be_is_refused_in_one_line(change, message):
    with pytest.raises(RecordingError, match=message) as caught:
        replace(track(), **change)
    assert "\n" not in str(caught.value)


def test_a_car_may_go_far_while_steps_are_left_out():
    assert replace(track(), **at("x_m", 5, 6.0 + 0.3 * FASTEST_MPS - 1.6)) is not None
