"""PilotNet that is told where to go and how fast it goes: separate heads for the commands, and pedals besides steering.

Notation:
    | name | meaning | shape |
    |---|---|---|
    | prepared | 66×200 YUV in [−1, 1] | b 3 66 200 |
    | image | image feature: PilotNet's 5 convolutions, 1 dense layer | b 100 |
    | controls | steer, gas, brake of the head that the command picks | b 3 |

References:
    Bojarski et al., "End to End Learning for Self-Driving Cars", 2016 (arXiv:1604.07316); the heads are those of
    Codevilla et al., "End-to-end driving via conditional imitation learning", ICRA 2018.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor, nn

from roadproof.controllers.cil import SPEED_SCALE_MPS, CILOutput, agent_control, branch_of
from roadproof.controllers.frames import FramePreparation, one_frame_batch
from roadproof.controllers.pilotnet import PILOTNET_ON_CARLA, pilotnet_convolutions
from roadproof.controllers.weights import initialise_xavier, seeded
from roadproof.datatypes import Control

_FLAT, _IMAGE, _BRANCHES = 1152, 100, 4


class ConditionalPilotNet(nn.Module):
    """The network and the agent around it; a `Controller`.

    Args:
        preparation: how its 66×200 input is made from the frames.
        seed: of the initial weights (Xavier, biases 0), drawn without touching the global random state.

    Convention:
        Heads, in order: follow, straight, left, right.
    """

    def __init__(self, *, preparation: FramePreparation = PILOTNET_ON_CARLA, seed: int = 0) -> None:
        super().__init__()
        self.preparation = preparation
        with seeded(seed):
            self.conv = pilotnet_convolutions()
            self.image = nn.Linear(_FLAT, _IMAGE)
            self.branches = nn.ModuleList(_head(_IMAGE + 1, 3) for _ in range(_BRANCHES))
            self.speed_branch = _head(_IMAGE, 1)
            initialise_xavier(self, bias=0.0)
        self.bend = nn.ELU()

    @property
    def input_size(self) -> tuple[int, int] | None:
        """(height, width) of the frames it takes, or None when it takes any size."""
        return self.preparation.frame_size

    def forward(
        self, frames: Float[Tensor, "b 3 h w"], speed_mps: Float[Tensor, " b"], command: Int[Tensor, " b"]
    ) -> CILOutput:
        """Controls and predicted speed, in the network's own dtype; what training needs.

        Args:
            frames: RGB in [0, 1].
            speed_mps: measured speed.
            command: CARLA's codes.
        """
        image = self._image_feature(frames)
        return CILOutput(self._controls(image, speed_mps, command), self.speed_branch(image)[:, 0])

    def steer(
        self, frames: Float[Tensor, "b 3 h w"], speed_mps: Float[Tensor, " b"], command: Int[Tensor, " b"]
    ) -> Float[Tensor, " b"]:
        """Steering, positive to the right, linear and not clipped; see `Controller.steer`.

        Raises:
            ControllerError: frames of the wrong size.
        """
        return self._controls(self._image_feature(frames), speed_mps, command)[:, 0].to(frames.dtype)

    def act(self, frame: UInt8[np.ndarray, "h w 3"], speed_mps: float, command: int) -> Control:
        """The control of CARLA's published agent: gas or brake but not both, no braking below 0.1."""
        frames, speed, code = one_frame_batch(self, frame, speed_mps, command)
        with torch.no_grad():
            steer, gas, brake = map(float, self._controls(self._image_feature(frames), speed, code)[0])
        return agent_control(steer, gas, brake, speed_mps)

    def _image_feature(self, frames: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b image"]:
        x = self.preparation(frames).to(self.image.weight.dtype)
        for layer in self.conv:
            x = self.bend(layer(x))
        return self.bend(self.image(x.flatten(1)))

    def _controls(
        self, image: Float[Tensor, "b image"], speed_mps: Float[Tensor, " b"], command: Int[Tensor, " b"]
    ) -> Float[Tensor, "b 3"]:
        speed = (speed_mps / SPEED_SCALE_MPS).to(image.dtype)[:, None]
        joined = torch.cat([image, speed], dim=1)
        every = torch.stack([branch(joined) for branch in self.branches], dim=1)
        return every.gather(1, branch_of(command)[:, None, None].expand(-1, 1, 3))[:, 0]


def _head(inputs: int, outputs: int) -> nn.Sequential:
    return nn.Sequential(nn.Linear(inputs, 50), nn.ELU(), nn.Linear(50, 10), nn.ELU(), nn.Linear(10, outputs))
