"""What conditional imitation learning networks have in common: command heads, a speed head, and the agent around them.

References:
    Codevilla et al., "End-to-end driving via conditional imitation learning", ICRA 2018; the agent and the order of
    the heads are those of the published code (carla-simulator/imitation-learning).
"""

from __future__ import annotations

from typing import NamedTuple, cast

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor, nn

from roadproof.controllers.frames import control_of
from roadproof.controllers.protocol import Commands, Frames, PedalController, Speeds
from roadproof.datatypes import Command, Control

SPEED_SCALE_MPS = 25.0
"""Speeds go in and come out divided by this (90 km/h)."""

BRANCHES = 4
"""Heads, in order: follow, straight, left, right."""

# Plain integers: torch.compile does not compare tensors with members of an enum.
_FOLLOW, _LEFT, _RIGHT = int(Command.FOLLOW), int(Command.LEFT), int(Command.RIGHT)


class ConditionalOutput(NamedTuple):
    """The output of a conditional network in training.

    Args:
        controls: steer, gas and brake of the commanded head; linear, so slightly outside their ranges at times.
        speed: speed that the network estimates from the frames, divided by `SPEED_SCALE_MPS`.
    """

    controls: Float[Tensor, "b 3"]
    speed: Float[Tensor, " b"]


class ConditionalNetwork(nn.Module):
    """A `Controller` whose head is picked by the command.

    A network says what it makes of frames (`image_feature`) and of speed beside it (`joined`), and brings
    `branches`, one for each command, and `speed_branch`.
    """

    branches: nn.ModuleList
    speed_branch: nn.Module

    def image_feature(self, frames: Frames) -> Float[Tensor, "b image"]:
        """The feature of what the frames show, in the network's own dtype."""
        raise NotImplementedError

    def joined(self, image: Float[Tensor, "b image"], speed: Float[Tensor, "b 1"]) -> Float[Tensor, "b joined"]:
        """The input of the heads, from the image feature and the scaled speed."""
        raise NotImplementedError

    def forward(self, frames: Frames, speed_mps: Speeds, command: Commands) -> ConditionalOutput:
        """Controls and predicted speed, in the network's own dtype; what training needs."""
        image = self.image_feature(frames)
        return ConditionalOutput(self._controls(image, speed_mps, command), self.speed_branch(image)[:, 0])

    def steer(self, frames: Frames, speed_mps: Speeds, command: Commands) -> Float[Tensor, " b"]:
        """Steering, positive to the right, linear and not clipped; see `Controller.steer`.

        Raises:
            ControllerError: the frames have the wrong size.
        """
        return self._controls(self.image_feature(frames), speed_mps, command)[:, 0].to(frames.dtype)

    def controls(self, frames: Frames, speed_mps: Speeds, command: Commands) -> Float[Tensor, "b 3"]:
        """The published agent's steer, throttle and brake; see `controllers.PedalController`.

        It does not brake below 0.1, nor less than it gives gas; where it does not brake, it gives no gas above 10 m/s.

        Raises:
            ControllerError: the frames have the wrong size.
        """
        steer, gas, brake = self._controls(self.image_feature(frames), speed_mps, command).to(frames.dtype).unbind(1)
        brake = torch.where((brake < 0.1) | (gas > brake), 0.0, brake)
        gas = torch.where((speed_mps > 10.0) & (brake == 0.0), 0.0, gas)
        return torch.stack([steer.clamp(-1.0, 1.0), gas.clamp(0.0, 1.0), brake.clamp(0.0, 1.0)], 1)

    def act(self, frame: UInt8[np.ndarray, "h w 3"], speed_mps: float, command: int) -> Control:
        """The control that `controls` gives for one frame."""
        return control_of(cast("PedalController", self), frame, speed_mps, command)  # with a subclass's input_size

    def _controls(self, image: Float[Tensor, "b image"], speed_mps: Speeds, command: Commands) -> Float[Tensor, "b 3"]:
        joined = self.joined(image, (speed_mps / SPEED_SCALE_MPS).to(image.dtype)[:, None])
        return commanded(self.branches, joined, command)


def commanded(heads: nn.ModuleList, joined: Float[Tensor, "b joined"], command: Commands) -> Float[Tensor, "b out"]:
    """What the head of each command answers."""
    # All heads, then the commanded one: they are half a percent of the work, and nothing waits for the device.
    every = torch.stack([head(joined) for head in heads], dim=1)
    return every.gather(1, branch_of(command)[:, None, None].expand(-1, 1, every.shape[2]))[:, 0]


def branch_of(command: Commands) -> Int[Tensor, " b"]:
    """Index of the head for CARLA's codes: follow (and 0, goal reached) 0, left 2, right 3, everything else 1."""
    branch = torch.ones_like(command, dtype=torch.int64)
    branch = branch.masked_fill((command == _FOLLOW) | (command == 0), 0)
    return branch.masked_fill(command == _LEFT, 2).masked_fill(command == _RIGHT, 3)
