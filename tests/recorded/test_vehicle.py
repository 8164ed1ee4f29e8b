"""The vehicle: a known one is found again from its drives; a bicycle turns as geometry says."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from roadproof.errors import RecordingError
from roadproof.recorded.vehicle import Motion, Vehicle, _steers_the_other_way
from roadproof.recordings import Track

KNOWN = Vehicle(
    dt_s=0.05,
    curving=(0.3, -0.06, -0.1, 0.0005),
    pulling=(4.0, -7.0, -0.2, -0.02, 0.8),
    slipping=(1.2, 0.001),
    steer_rate_per_s=4.0,
)


def driven(vehicle, steer, throttle, brake, speed_mps=6.0):
    """The track of a car that is told so."""
    one = torch.ones(1, dtype=torch.float64)
    car = Motion(0 * one, 0 * one, 0.3 * one, speed_mps * one, 0 * one, float(steer[0]) * one)
    rows = []
    for controls in zip(steer, throttle, brake, strict=True):
        rows.append([float(value) for value in (car.x_m, car.y_m, car.yaw_rad, car.speed_mps)])
        car = vehicle.step(car, *(float(value) * one for value in controls))
    x, y, yaw, speed = np.array(rows).T
    step = np.arange(len(rows))
    return Track(
        dt_s=vehicle.dt_s,
        step=step,
        x_m=x,
        y_m=y,
        yaw_rad=yaw,
        speed_mps=speed,
        steer=steer,
        throttle=throttle,
        brake=brake,
    )


def lively(seed, count=200, *, jumps=True):
    rng = np.random.default_rng(seed)
    steer = 0.3 * np.sin(np.arange(count) / rng.uniform(5, 9))
    if jumps:
        steer[-40:-30], steer[-30:-20] = 0.9, -0.9
    throttle = 0.4 + 0.2 * np.sin(np.arange(count) / 11)
    brake = np.where(np.arange(count) % 50 > 45, 0.3, 0.0)
    return steer, throttle, brake


def test_a_known_vehicle_is_found_again_from_its_drives():
    found = Vehicle.identified([driven(KNOWN, *lively(seed)) for seed in range(3)])
    assert found.curving == pytest.approx(KNOWN.curving, abs=2e-3)
    assert found.pulling == pytest.approx(KNOWN.pulling, abs=1e-3)
    assert found.slipping == pytest.approx(KNOWN.slipping, abs=1e-3)
    assert found.steer_rate_per_s == pytest.approx(4.0, rel=0.02)
    assert found.r2 > 0.999


def test_no_limit_is_believed_where_no_drive_shows_one():
    smooth = [driven(KNOWN, *lively(seed, jumps=False)) for seed in range(2)]
    assert Vehicle.identified(smooth).steer_rate_per_s == math.inf


def test_what_the_drives_do_not_show_stays_with_the_prior():
    steer, throttle, brake = lively(0)
    found = Vehicle.identified([driven(KNOWN, steer, throttle, 0 * brake)])
    assert found.pulling[1] == pytest.approx(-8.0, abs=0.01)


def test_a_driver_who_gives_gas_where_the_road_climbs_does_not_make_throttle_a_brake():
    """A speed held on slopes that poses do not show: throttle and pull have opposite signs all along."""
    plain, one = Vehicle.bicycle(wheelbase_m=2.8, steer_range_rad=0.7, dt_s=0.05), torch.ones(1, dtype=torch.float64)
    car = Motion(0 * one, 0 * one, 0 * one, 6.0 * one, 0 * one, 0 * one)
    rows = []
    for k in range(1200):
        throttle, steer = min(max(0.04 + 0.3 * (6.0 - float(car.speed_mps)), 0.0), 1.0), 0.2 * math.sin(k / 15)
        rows.append([*(float(value[0]) for value in car[:4]), steer, throttle])
        car = plain.step(car, steer * one, throttle * one, 0 * one)
        pull = 0.05 * 9.81 * math.sin(0.3 * k / 20)
        car = car._replace(speed_mps=car.speed_mps - 0.05 * pull)
    x, y, yaw, speed, steer, throttle = np.array(rows).T
    pose = {"x_m": x, "y_m": y, "yaw_rad": yaw, "speed_mps": speed}
    found = Vehicle.identified(
        [Track(dt_s=0.05, step=np.arange(1200), **pose, steer=steer, throttle=throttle, brake=0 * steer)]
    )
    assert found.pulling[0] == pytest.approx(4.0), "an ordinary car's"


@pytest.mark.parametrize("dt_s", [0.05, 0.005])
def test_a_log_may_be_of_many_steps_a_second(dt_s):
    true = Vehicle.bicycle(wheelbase_m=2.8, steer_range_rad=0.7, lag_s=0.0, dt_s=dt_s)
    steer = 0.3 * np.sin(np.arange(int(10 / dt_s)) * dt_s)
    track = driven(true, steer, np.full(len(steer), 0.15 / 4.0), 0 * steer, 3.5)
    slow = Vehicle.identified([track])
    assert slow.curving[1] == pytest.approx(true.curving[1], rel=0.02)


def test_the_identified_vehicle_repeats_a_drive_it_has_not_seen():
    found = Vehicle.identified([driven(KNOWN, *lively(seed)) for seed in range(3)])
    controls = lively(7)
    there, again = driven(KNOWN, *controls), driven(found, *controls)
    assert np.hypot(there.x_m - again.x_m, there.y_m - again.y_m).max() < 0.15


def test_a_bicycle_turns_on_the_circle_of_its_wheels():
    vehicle = Vehicle.bicycle(wheelbase_m=2.5, steer_range_rad=0.5, lag_s=0.0, dt_s=0.01)
    count = 400
    track = driven(vehicle, np.full(count, 0.4), np.full(count, 0.0), np.zeros(count))
    turned = np.diff(np.unwrap(track.yaw_rad))[5:] / (np.hypot(np.diff(track.x_m), np.diff(track.y_m))[5:])
    assert turned == pytest.approx(np.full(len(turned), -0.4 * 0.5 / 2.5), rel=2e-3)


def test_motion_is_differentiable_in_what_the_car_is_told():
    def end(steer):
        zero = torch.zeros(1, dtype=torch.float64)
        car = Motion(zero, zero, zero, zero + 6.0, zero, zero)
        for k in range(4):
            car = KNOWN.step(car, steer[k : k + 1], zero + 0.3, zero)
        return torch.cat([car.x_m, car.y_m, car.yaw_rad, car.speed_mps])

    steer = torch.tensor([0.05, -0.1, 0.02, 0.1], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(end, (steer,))


@pytest.mark.parametrize("late", [0, 4, 8])
def test_steering_to_the_wrong_side_is_told_however_late_the_car_follows(late):
    def stretches(sign):
        tracks = [driven(KNOWN, *lively(seed)) for seed in (1, 2)]
        tracks = [replace(track, steer=sign * np.roll(track.steer, -late)) for track in tracks]
        return [(track, part) for track in tracks for part in track.stretches()]

    assert not _steers_the_other_way(stretches(1.0), KNOWN.dt_s)
    assert _steers_the_other_way(stretches(-1.0), KNOWN.dt_s)
    flipped = [driven(KNOWN, *lively(seed)) for seed in (1, 2)]
    with pytest.raises(RecordingError, match="the cars turn left where they steer to the right"):
        Vehicle.identified([replace(track, steer=-track.steer) for track in flipped])


def test_drives_that_do_not_fit_are_one_clear_line():
    one, two = (
        driven(KNOWN, *lively(0)),
        driven(Vehicle.bicycle(wheelbase_m=3.0, steer_range_rad=0.5, dt_s=0.1), *lively(1)),
    )
    with pytest.raises(RecordingError, match=r"time steps \[0.05, 0.1\] s, expected one"):
        Vehicle.identified([one, two])
    short = driven(KNOWN, *(part[:8] for part in lively(0)))
    with pytest.raises(RecordingError, match="steps of the drives follow each other in motion, 12 are needed"):
        Vehicle.identified([short])
    steer, throttle, brake = lively(0, jumps=False)
    unrelated = driven(KNOWN, steer, throttle, brake)
    mixed = np.random.default_rng(0).permutation(steer)
    fields = {name: getattr(unrelated, name) for name in ("dt_s", "step", "x_m", "y_m", "yaw_rad", "speed_mps")}
    with pytest.raises(RecordingError, match="of the way the cars took, expected 50%"):
        Vehicle.identified([Track(**fields, steer=mixed, throttle=throttle, brake=brake)])
    with pytest.raises(RecordingError, match="expected lengths and times above 0"):
        Vehicle.bicycle(wheelbase_m=0.0, steer_range_rad=0.5, dt_s=0.1)
