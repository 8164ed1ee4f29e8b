"""What an attack and a drive need of a controller."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from roadproof.datatypes import Control

Frames = Float[Tensor, "b 3 h w"]
"""RGB in [0, 1], one picture a car."""

Stacks = Float[Tensor, "b *n 3 h w"]
"""Frames, or for each car N of them, oldest first."""

Speeds = Float[Tensor, " b"]
"""Speed of the car at each frame, m/s."""

Commands = Int[Tensor, " b"]
"""What the route asks at each frame, in CARLA's codes (`datatypes.Command`)."""


@runtime_checkable
class Controller(Protocol):
    """A camera-driven controller: differentiable for attacks, and able to drive.

    Any object with these three members is one; nothing has to be inherited. `check_controller` proves that it keeps
    the promises below.

    Convention:
        Frames are RGB. `steer` is positive to the right. `command` holds CARLA's codes (`datatypes.Command`).
    """

    @property
    def input_size(self) -> tuple[int, int] | None:
        """(height, width) of the frames it takes, or None when it takes any size."""
        ...

    def steer(self, frames: Frames, speed_mps: Speeds, command: Commands) -> Float[Tensor, " b"]:
        """Steering of each frame by itself, differentiable in the frames.

        Args:
            frames: RGB in [0, 1], (B, 3, H, W).
            speed_mps: speed of the car at each frame, m/s, (B,).
            command: what the route asks at each frame, in CARLA's codes (`datatypes.Command`), (B,).

        Returns:
            Steering in about [−1, 1], not clipped, in the frames' dtype.
        """
        ...

    def act(self, frame: UInt8[np.ndarray, "h w 3"], speed_mps: float, command: int) -> Control:
        """What the car shall do now; every value of the control is inside its range."""
        ...


@runtime_checkable
class PedalController(Controller, Protocol):
    """A controller that also says throttle and brake for many frames at once.

    Recorded worlds drive many cars side by side. A controller that only steers is given the clean drive's speed there;
    one of these its own, also where paint changes it.
    """

    def controls(self, frames: Frames, speed_mps: Speeds, command: Commands) -> Float[Tensor, "b 3"]:
        """Steer, throttle and brake of each frame by itself, inside their ranges, differentiable in the frames.

        Args:
            frames: RGB in [0, 1], (B, 3, H, W).
            speed_mps: speed of the car at each frame, m/s, (B,).
            command: what the route asks at each frame, in CARLA's codes (`datatypes.Command`), (B,).
        """
        ...


@runtime_checkable
class TemporalController(Controller, Protocol):
    """A controller that remembers: what it does depends on the frames before, too.

    `steer`, `controls` and `act` answer a frame as the first one of a drive, which is what searches on single recorded
    frames ask for. In a simulator and in the recorded world frames come in the order of the drive, each of them to
    `controls_after`. The controller itself keeps nothing, so that many cars can be driven side by side.
    """

    def controls_after(
        self, memory: object, frames: Frames, speed_mps: Speeds, command: Commands, elapsed_s: float
    ) -> tuple[Float[Tensor, "b 3"], object]:
        """Steer, throttle and brake of B cars at the next frame of their drives, and what is remembered from then on.

        Args:
            memory: what was remembered at the frame before, of whatever kind; None at the first frame. It is not
                written to, and gradients flow through its tensors to the frames before.
            frames: RGB in [0, 1], (B, 3, H, W).
            speed_mps: speed of the car at each frame, m/s, (B,).
            command: what the route asks at each frame, in CARLA's codes (`datatypes.Command`), (B,).
            elapsed_s: seconds since the frame before; 0 at the first.
        """
        ...


def missing_members(candidate: object) -> tuple[str, ...]:
    """The members that an object lacks to be a `Controller`; its properties are read, which may raise."""
    return tuple(name for name in ("input_size", "steer", "act") if not hasattr(candidate, name))
