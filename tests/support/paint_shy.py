"""Drivers for tests that really react to paint; importable by other processes."""

import dataclasses

import torch

from carla_serving import straight_map
from roadproof.coverage import Shape
from roadproof.datatypes import Control, VehicleState
from roadproof.geometry import CanvasPlacement
from roadproof.patterns import Pattern
from roadproof.scenarios import Scenario, find_scenario


def magenta(size_px):
    """One square in the middle of the canvas, of what `PaintShy` flees from."""
    box = torch.tensor([[200.0, 200.0, size_px, size_px, 0.0]])
    return Pattern((Shape.RECTANGLE,), box, torch.tensor([[1.0, 0.0, 1.0]]))


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
    left = find_scenario("left-03")
    return dataclasses.replace(left, name="short", start=start, time_limit_s=time_limit_s)


def along_a_street(folder, time_limit_s=4.0):
    """A straight street of its own, which is built far sooner than the town, with a canvas 17 m ahead."""
    return Scenario(
        name="street",
        kind="straight",
        map_name=str(straight_map(folder, length_m=100.0)),
        start=VehicleState(x_m=15.0, y_m=-1.75, z_m=0.0, yaw_rad=0.0, speed_mps=6.0),
        goal_m=(80.0, -1.75),
        canvas=CanvasPlacement(x_m=32.0, y_m=0.0, width_m=6.6),
        time_limit_s=time_limit_s,
    )


class BrakeShy(PaintShy):
    """Goes straight on as recorded, and brakes for magenta paint, the more of it there is; a grainy road is none."""

    def controls(self, frames, speed_mps, command):
        red, green, blue = frames.unbind(1)
        fear = self.gain * (torch.minimum(red, blue) - green - 0.5).clamp_min(0).mean((1, 2))
        return torch.stack([torch.zeros_like(fear), torch.full_like(fear, 0.05), fear.clamp(0.0, 1.0)], 1)

    def act(self, frame, speed_mps, command):
        frames = torch.tensor(frame).permute(2, 0, 1)[None].float() / 255
        controls = self.controls(frames, torch.tensor([speed_mps]), torch.tensor([command]))
        return Control(*map(float, controls[0]))


def brake_shy():
    return BrakeShy()
