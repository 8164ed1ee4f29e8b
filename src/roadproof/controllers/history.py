"""Networks that see several frames at once: those of the drive so far are kept in order, and stacked for them.

What is kept is a tuple, newest first, with a place for every `TICK_S`: place k holds what was seen k ticks before the
newest. Frames that come further apart, as in the first rungs of a search, stand for the ticks between.
"""

from __future__ import annotations

from typing import TypeVar, cast

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor, nn

from roadproof.controllers.asking import next_act_of
from roadproof.controllers.protocol import Commands, Frames, Speeds
from roadproof.controllers.steering import SteeringController
from roadproof.controllers.trajectory import TrajectoryController
from roadproof.datatypes import Control
from roadproof.errors import ControllerError

TICK_S = 0.05
"""Time from one kept moment to the next, seconds: the town's step, and that of CARLA's synchronous mode by habit."""

FURTHEST_S, MOST_FRAMES = 10.0, 64

Kept = TypeVar("Kept")


def kept_after(before: tuple[Kept, ...] | None, now: Kept, elapsed_s: float, ticks: int) -> tuple[Kept, ...]:
    """What is kept once a new moment has come: `ticks` + 1 places, the newest first.

    Args:
        before: what was kept at the moment before; None at the first, which then stands for all before it.
        now: what the new moment gives.
        elapsed_s: seconds between the two moments.
        ticks: how many ticks back the last place lies.

    Raises:
        ControllerError: the moments are not a whole number of ticks apart, so that what is kept is older or newer than
            what the network learnt from.
    """
    if before is None:
        return (now,) * (ticks + 1)
    passed = round(elapsed_s / TICK_S)
    if passed < 1 or abs(passed * TICK_S - elapsed_s) > 1e-3:
        raise ControllerError(
            f"the moments of the drive are {elapsed_s:g} s apart, expected a multiple of {TICK_S} s for a controller "
            "that remembers; give the simulator or the recordings that time step"
        )
    return now, *(before[max(k - passed, 0)] for k in range(1, ticks + 1))


def ticks_of(apart_s: float) -> int:
    """How many ticks lie between two moments.

    Raises:
        ControllerError: the time between them is no whole number of ticks, or not in (0, 10] s.
    """
    ticks = round(apart_s / TICK_S) if 0 < apart_s <= FURTHEST_S else 0
    if ticks < 1 or abs(ticks * TICK_S - apart_s) > 1e-6:
        raise ControllerError(
            f"frames of a network lie {apart_s} s apart, expected a multiple of {TICK_S} s, at most {FURTHEST_S:g}"
        )
    return ticks


class HistoryController(nn.Module):
    """A `TemporalController` around a controller whose network takes the last N frames, (B, N, 3, H, W), oldest first.

    At the first frames of a drive, and where a single frame is asked about, the oldest known frame stands for those
    before it.

    Args:
        single: controller that answers one stack of frames with one steering or plan.
        frames: number N of frames that its network takes, 2 to 64.
        apart_s: time from frame to frame, seconds, a multiple of 0.05.

    Raises:
        ControllerError: a number is out of its range.
    """

    def __init__(self, single: SteeringController | TrajectoryController, *, frames: int, apart_s: float) -> None:
        super().__init__()
        if not 2 <= frames <= MOST_FRAMES:
            raise ControllerError(f"a network takes {frames} frames at once, expected 2 to {MOST_FRAMES}")
        self.single = single
        self.frames = frames
        self.apart = ticks_of(apart_s)

    @property
    def input_size(self) -> tuple[int, int] | None:
        """(height, width) of the frames it takes, or None when it takes any size."""
        return self.single.input_size

    def steer(self, frames: Frames, speed_mps: Speeds, command: Commands) -> Float[Tensor, " b"]:
        """Steering at frames that stand for all before them; see `Controller.steer`."""
        return self.single.steer(torch.stack([frames] * self.frames, 1), speed_mps, command)

    def controls(self, frames: Frames, speed_mps: Speeds, command: Commands) -> Float[Tensor, "b 3"]:
        """Controls at frames that stand for all before them; see `PedalController.controls`."""
        return self.single.controls(torch.stack([frames] * self.frames, 1), speed_mps, command)

    def act(self, frame: UInt8[np.ndarray, "h w 3"], speed_mps: float, command: int) -> Control:
        """The control at a frame that stands for all before it."""
        return next_act_of(self, None, frame, speed_mps, command, 0.0)[0]

    def controls_after(
        self, memory: object, frames: Frames, speed_mps: Speeds, command: Commands, elapsed_s: float
    ) -> tuple[Float[Tensor, "b 3"], object]:
        """Controls after the frames so far; see `TemporalController.controls_after`."""
        before = cast("tuple[Tensor, ...] | None", memory)
        kept = kept_after(before, frames, elapsed_s, (self.frames - 1) * self.apart)
        stack = torch.stack(kept[:: self.apart][::-1], 1)
        return self.single.controls(stack, speed_mps, command), kept
