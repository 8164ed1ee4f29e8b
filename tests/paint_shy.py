"""Drivers for tests that really react to paint; importable by other processes."""

import torch

from roadproof.datatypes import Control


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
