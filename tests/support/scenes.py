"""Small recorded drives made from a known camera, and a linear controller whose best pattern is known."""

import numpy as np
import torch

from recorded_drives import PLAIN
from references import approach
from roadproof.datatypes import Control
from roadproof.geometry import CIL_CAMERA, CIL_INPUT
from roadproof.recordings import Recording, RecordingSet, Side


def road_frames(count, seed):
    """Grey, grainy frames, (count, 88, 200, 3)."""
    rng = np.random.default_rng(seed)
    return rng.integers(90, 140, (count, 88, 200, 3), dtype=np.uint8)


def recording(side, *, frames=4, lateral_m=0.0, seed=0):
    return Recording(
        name=str(side),
        side=side,
        frames=road_frames(frames, seed),
        frame_number=np.arange(10, 10 + frames),
        image_from_canvas=approach(frames, lateral_m=lateral_m),
        speed_mps=np.full(frames, 6.0),
        command=np.full(frames, 2),
        steer=np.zeros(frames),
    )


def recording_set(frames=4, colour=PLAIN):
    drives = (
        recording(Side.CLEAN, frames=frames),
        recording(Side.RIGHT, frames=frames, lateral_m=-0.5, seed=1),
        recording(Side.LEFT, frames=frames, lateral_m=0.5, seed=2),
    )
    return RecordingSet(camera=CIL_CAMERA, view=CIL_INPUT, colour=colour, recordings=drives)


class LinearController(torch.nn.Module):
    """Steering that is a weighted sum of the frame's pixels, so that the best pattern is known."""

    input_size = (88, 200)

    def __init__(self, weight):
        super().__init__()
        self.register_buffer("weight", weight)

    def steer(self, frames, speed_mps, command):
        return (frames * self.weight).sum((1, 2, 3))

    def act(self, frame, speed_mps, command):
        return Control(steer=0.0)
