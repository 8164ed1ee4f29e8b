"""Holding cars in one kernel: what plain operations give; by Triton's interpreter where there is no GPU."""

import numpy as np
import pytest
import torch

from kernels import DEVICE  # isort: skip  # before Triton is imported
from roadproof.datatypes import Obstacle
from roadproof.recorded import obstacles
from roadproof.recorded.contact import held
from roadproof.recorded.vehicle import Motion

PATH = np.stack([np.linspace(0, 40, 41), np.zeros(41)], 1)
RAIL = Obstacle(x_m=20.0, y_m=3.5, yaw_rad=0.1, half_length_m=15.0, half_width_m=0.1)
POST = Obstacle(x_m=12.0, y_m=-4.0, yaw_rad=0.5, half_length_m=1.0, half_width_m=0.5)
BIN = Obstacle(x_m=16.0, y_m=-3.0, yaw_rad=-0.3, half_length_m=0.4, half_width_m=0.4)


def cars(number, seed=0):
    """Cars around the obstacles, and where they were a step before: (R, 6)."""
    draw = np.random.default_rng(seed).uniform(size=(number, 4))
    x, y, yaw, speed = (draw * [12, 9, 2, 8] + [8, -5, -1, 0]).T
    return torch.tensor(np.stack([x, y, yaw, speed, x - 0.05 * speed * np.cos(yaw), y - 0.05 * speed * np.sin(yaw)], 1))


@pytest.mark.parametrize("some", [(RAIL,), (RAIL, POST, BIN)], ids=["rail", "several"])
def test_one_kernel_holds_cars_as_plain_operations_do(some):
    among = obstacles.Obstacles(some, PATH, (0.0, 0.0), device=DEVICE)
    assert len(among) == len(some)
    states = cars(24).to(DEVICE).requires_grad_()
    x, y, yaw, speed, before_x, before_y = states.unbind(1)
    o = torch.zeros_like(x)
    plain = among._pushed(Motion(before_x, before_y, o, o, o, o), Motion(x, y, yaw, speed, o, o), 0.05, asks=False)
    expected = torch.stack(plain[:4], 1)
    found = held(states, among._boxes, among._ahead, obstacles._rules(0.05))
    assert ((found != states[:, :4]).any(1)).sum() > 3
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-12)
    weight = torch.randn(found.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64).to(DEVICE)
    slopes = [torch.autograd.grad((each * weight).sum(), states)[0] for each in (found, expected)]
    torch.testing.assert_close(*slopes, rtol=1e-9, atol=1e-9)
