"""PilotNet: five convolutions and four dense layers that turn a strip of road into a steering value.

References:
    Bojarski et al., "End to End Learning for Self-Driving Cars", 2016 (arXiv:1604.07316).
"""

from __future__ import annotations

from itertools import pairwise

from jaxtyping import Float
from torch import Tensor, nn

from roadproof.controllers.frames import FramePreparation
from roadproof.controllers.steering import CruiseControl, SteeringController
from roadproof.controllers.weights import initialise_xavier, seeded
from roadproof.errors import ControllerError

PILOTNET_SIZE = (66, 200)
"""(height, width) of the network's input."""

PILOTNET_ON_CARLA = FramePreparation(
    frame_size=(88, 200),
    rows=(15, 81),
    network_size=PILOTNET_SIZE,
    colour="yuv",
    mean=(0.5, 0.5, 0.5),
    std=(0.5, 0.5, 0.5),
)
"""The frames of CARLA's agent: rows 15…80 as they are, YUV, x / 127.5 − 1."""

_CHANNELS_KERNEL_STRIDE = ((24, 5, 2), (36, 5, 2), (48, 5, 2), (64, 3, 1), (64, 3, 1))
_UNITS = (1152, 100, 50, 10, 1)


class PilotNet(nn.Module):
    """The network alone: prepared frames in, steering out.

    Args:
        activation: activation after every layer but the last, "elu" or "relu".
        seed: seed of the initial weights (Xavier, biases 0), drawn without touching the global random state.

    Raises:
        ControllerError: the activation is unknown.

    Convention:
        The last feature map is flattened in C, H, W order.
    """

    def __init__(self, *, activation: str = "elu", seed: int = 0) -> None:
        if activation not in ("elu", "relu"):
            raise ControllerError(f"PilotNet activation is {activation!r}, expected 'elu' or 'relu'")
        super().__init__()
        self.activation = activation
        with seeded(seed):
            self.conv = pilotnet_convolutions()
            self.fc = nn.ModuleList(nn.Linear(i, o) for i, o in pairwise(_UNITS))
            initialise_xavier(self, bias=0.0)
        self.bend = nn.ELU() if activation == "elu" else nn.ReLU()

    def forward(self, x: Float[Tensor, "b 3 66 200"]) -> Float[Tensor, " b"]:
        """Steering of prepared frames, about [−1, 1], positive to the right."""
        for layer in self.conv:
            x = self.bend(layer(x))
        hidden = x.flatten(1)
        for layer in self.fc[:-1]:
            hidden = self.bend(layer(hidden))
        return self.fc[-1](hidden)[:, 0]


def pilotnet_convolutions() -> nn.ModuleList:
    """The five convolutions without their activations: 66×200 prepared frames in, 64×1×18 feature maps out."""
    inputs = (3, *(channels for channels, _, _ in _CHANNELS_KERNEL_STRIDE))
    return nn.ModuleList(
        nn.Conv2d(c_in, c_out, k, s) for (c_out, k, s), c_in in zip(_CHANNELS_KERNEL_STRIDE, inputs, strict=False)
    )


def pilotnet_controller(
    *,
    activation: str = "elu",
    preparation: FramePreparation = PILOTNET_ON_CARLA,
    cruise: CruiseControl | None = None,
    seed: int = 0,
) -> SteeringController:
    """PilotNet as a controller, with fresh weights.

    Args:
        activation: activation after every layer but the last, "elu" or "relu".
        preparation: how the network's 66×200 input is made from the frames; by default from those of CARLA's agent.
        cruise: cruise control that holds the speed when driving; None for the usual one.
        seed: seed of the initial weights.

    Raises:
        ControllerError: the activation is unknown, or the preparation does not end at 66×200.
    """
    if preparation.network_size != PILOTNET_SIZE:
        raise ControllerError(f"PilotNet's network_size is {preparation.network_size}, expected {PILOTNET_SIZE}")
    return SteeringController(PilotNet(activation=activation, seed=seed), preparation=preparation, cruise=cruise)
