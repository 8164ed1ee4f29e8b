"""What becomes of a car that runs into something in the recorded world."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from roadproof.datatypes import Obstacle
from roadproof.errors import SimulatorError
from roadproof.recorded.obstacles import RADIUS_M, Obstacles
from roadproof.recorded.vehicle import Motion, Vehicle

PATH = np.stack([np.linspace(0, 40, 41), np.zeros(41)], 1)
CAR = Vehicle.bicycle(wheelbase_m=2.7, steer_range_rad=0.6, dt_s=0.05)


def car(x_m=0.0, y_m=0.0, yaw_rad=0.0, speed_mps=8.0):
    values = (x_m, y_m, yaw_rad, speed_mps, 0.0, 0.0)
    return Motion(*(torch.tensor([value], dtype=torch.float64) for value in values))


def driven(obstacles, here, steps=60):
    """Where a car is that goes straight on among obstacles."""
    o = torch.zeros(1, dtype=torch.float64)
    for _ in range(steps):
        here = obstacles.hold(here, CAR.step(here, o, o + 0.1, o), CAR.dt_s)
    return here


def rail(**changed):
    """A guard rail three metres to the left of the path."""
    values = {"x_m": 20.0, "y_m": 3.0, "yaw_rad": 0.0, "half_length_m": 40.0, "half_width_m": 0.1} | changed
    return Obstacles([Obstacle(**values)], PATH, (0.0, 0.0))


def test_a_car_slides_along_a_rail_and_never_through_it():
    here = driven(rail(), car(yaw_rad=0.3))
    assert 0.9 < float(here.y_m) < 3.0 - 0.1 - RADIUS_M + 0.02
    assert float(here.x_m) > 8.0
    assert abs(float(here.yaw_rad)) < 0.15
    assert float(here.speed_mps) < 7.0


def test_a_car_stands_before_a_wall():
    here = driven(rail(y_m=0.0, x_m=12.0, yaw_rad=math.pi / 2, half_length_m=2.0), car(y_m=0.0))
    # The path goes through it, so it does not count.
    assert float(here.x_m) > 20.0
    wall = Obstacles([Obstacle(x_m=12.0, y_m=6.0, yaw_rad=0.0, half_length_m=0.1, half_width_m=4.0)], PATH, (0.0, 0.0))
    here = driven(wall, car(y_m=6.0))
    assert float(here.x_m) == pytest.approx(12.0 - 0.1 - RADIUS_M - 1.3, abs=0.05)
    assert float(here.speed_mps) < 0.5


def test_cars_that_touch_nothing_are_as_without_obstacles():
    free = Obstacles([], PATH, (0.0, 0.0))
    assert driven(rail(), car()) == driven(free, car())
    assert len(free) == 0


def test_what_is_far_from_the_path_does_not_count():
    assert len(rail(y_m=30.0)) == 0


def test_gradients_are_finite_at_a_contact():
    yaw = torch.tensor([0.3], dtype=torch.float64, requires_grad=True)
    here = driven(rail(), car()._replace(yaw_rad=yaw))
    (slope,) = torch.autograd.grad(here.y_m.sum(), yaw)
    assert torch.isfinite(slope).all()
    assert abs(float(slope)) < 1.0


@pytest.mark.parametrize("wrong", [{"half_width_m": -1.0}, {"x_m": math.nan}, {"half_length_m": 1e4}])
def test_values_out_of_range_are_refused(wrong):
    with pytest.raises(SimulatorError, match="no obstacle"):
        rail(**wrong)
