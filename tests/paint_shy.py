"""Drivers for tests that really react to paint; importable by other processes."""

import dataclasses

import torch

from roadproof.datatypes import Control, VehicleState
from roadproof.scenarios import builtin_scenarios, find_scenario


class PaintShy:
    """Goes straight on, and away to the right from magenta paint, the more of it there is."""

    input_size = (88, 200)

    def __init__(self, gain=4.0):
        self.gain = gain

    def steer(self, frames, speed_mps, command):
        red, green, blue = frames.unbind(1)
        return self.gain * (torch.minimum(red, blue) - green - 0.15).clamp_min(0).mean((1, 2))

    def act(self, frame, speed_mps, command):
        frames = torch.tensor(frame).permute(2, 0, 1)[None].float() / 255
        steer = float(self.steer(frames, torch.tensor([speed_mps]), torch.tensor([command])))
        return Control(min(steer, 1.0), throttle=0.5)


def paint_shy():
    return PaintShy()


def just_before_the_canvas(time_limit_s):
    """The scenario left-03 from 17 m before its canvas on, at 22 km/h."""
    start = VehicleState(x_m=291.75, y_m=222.0, z_m=0.0, yaw_rad=1.571, speed_mps=6.0)
    left = find_scenario("left-03", builtin_scenarios())
    return dataclasses.replace(left, name="short", start=start, time_limit_s=time_limit_s)
