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

import torch
from jaxtyping import Float
from torch import Tensor, nn

from roadproof.controllers.conditional import BRANCHES, ConditionalNetwork
from roadproof.controllers.frames import FramePreparation
from roadproof.controllers.pilotnet import PILOTNET_ON_CARLA, pilotnet_convolutions
from roadproof.controllers.weights import initialise_xavier, seeded

_FLAT, _IMAGE = 1152, 100


class ConditionalPilotNet(ConditionalNetwork):
    """PilotNet with a head per command, and the agent around it; a `Controller`.

    Args:
        preparation: how the network's 66×200 input is made from the frames.
        seed: seed of the initial weights (Xavier, biases 0), drawn without touching the global random state.

    Convention:
        Heads, in order: follow, straight, left, right.
    """

    def __init__(self, *, preparation: FramePreparation = PILOTNET_ON_CARLA, seed: int = 0) -> None:
        super().__init__()
        self.preparation = preparation
        with seeded(seed):
            self.conv = pilotnet_convolutions()
            self.image = nn.Linear(_FLAT, _IMAGE)
            self.branches = nn.ModuleList(_head(_IMAGE + 1, 3) for _ in range(BRANCHES))
            self.speed_branch = _head(_IMAGE, 1)
            initialise_xavier(self, bias=0.0)
        self.bend = nn.ELU()

    @property
    def input_size(self) -> tuple[int, int] | None:
        """(height, width) of the frames it takes, or None when it takes any size."""
        return self.preparation.frame_size

    def image_feature(self, frames: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b image"]:
        """The image feature, from convolutions and one dense layer.

        Raises:
            ControllerError: the frames have the wrong size.
        """
        x = self.preparation(frames).to(self.image.weight.dtype)
        for layer in self.conv:
            x = self.bend(layer(x))
        return self.bend(self.image(x.flatten(1)))

    def joined(self, image: Float[Tensor, "b image"], speed: Float[Tensor, "b 1"]) -> Float[Tensor, "b joined"]:
        """The image feature and the scaled speed side by side."""
        return torch.cat([image, speed], dim=1)


def _head(inputs: int, outputs: int) -> nn.Sequential:
    return nn.Sequential(nn.Linear(inputs, 50), nn.ELU(), nn.Linear(50, 10), nn.ELU(), nn.Linear(10, outputs))
