"""A small residual network that sees a path and a speed, as today's end-to-end drivers do.

Notation:
    | name | meaning | shape |
    |---|---|---|
    | frames | 88×200 RGB in [−1, 1] | b 3 88 200 |
    | maps | what four residual blocks make of them, a sixteenth of the size | b 96 6 13 |
    | image | image feature | b 256 |
    | path | points of the way ahead, `PATH_M` along it: metres ahead and left | b 8 2 |

References:
    Jaeger, Chitta, Geiger, "Hidden biases of end-to-end driving models", ICCV 2023: a path and a target speed rather
    than positions over time; He et al., "Deep residual learning for image recognition", CVPR 2016.
"""

from __future__ import annotations

from typing import TypeVar

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from roadproof.controllers.cil import CentredBatchNorm2d
from roadproof.controllers.conditional import BRANCHES, SPEED_SCALE_MPS, commanded
from roadproof.controllers.frames import FramePreparation
from roadproof.controllers.protocol import Commands, Speeds
from roadproof.controllers.steering import CruiseControl
from roadproof.controllers.tracking import LinearMPC, PurePursuit
from roadproof.controllers.trajectory import Plan, TrajectoryController
from roadproof.controllers.weights import seeded

PATH_M = (2.5, 5.0, 7.5, 10.0, 12.5, 15.0, 17.5, 20.0)
"""How far along the way the points of a path lie, metres from the place beside the car."""

WAYPOINT_ON_CARLA = FramePreparation(frame_size=(88, 200), mean=(0.5, 0.5, 0.5), std=(0.5, 0.5, 0.5))
"""The frames of CARLA's agent in [−1, 1]."""

WAYPOINT_CRUISE = CruiseControl(gain_per_mps=0.36, hold=0.04)
"""The pedals of the expert in the town, which the target speeds are learnt for."""

Kind = TypeVar("Kind", bound=TrajectoryController)

_CHANNELS, _SQUEEZED, _HEAD = (16, 32, 64, 96, 96), 16, 128
_STRIDES = (2, 2, 2, 1)
FLAT, IMAGE = _SQUEEZED * 6 * 13, 256
"""Values of a frame's feature maps, and of its image feature."""


class WaypointNet(nn.Module):
    """The network alone: prepared frames, speed and command in, a `Plan` out.

    Args:
        seed: seed of the initial weights, drawn without touching the global random state.
        more: number of features that the heads take beside those of the image and the speed.

    Convention:
        Heads, in order: follow, straight, left, right.
    """

    def __init__(self, *, seed: int = 0, more: int = 0) -> None:
        super().__init__()
        with seeded(seed):
            self.stem = _normed(3, _CHANNELS[0], kernel=5, stride=2)
            pairs = zip(_CHANNELS, _CHANNELS[1:], _STRIDES, strict=False)
            self.blocks = nn.Sequential(*(_Block(c_in, c_out, stride) for c_in, c_out, stride in pairs))
            self.squeeze = nn.Conv2d(_CHANNELS[-1], _SQUEEZED, 1)
            self.image = nn.Sequential(nn.SiLU(), nn.Flatten(), nn.Dropout(0.3), nn.Linear(FLAT, IMAGE), nn.SiLU())
            self.heads = nn.ModuleList(_head(IMAGE + more + 1) for _ in range(BRANCHES))
        straight = torch.stack([torch.tensor(PATH_M), torch.zeros(len(PATH_M))], 1)
        self.register_buffer("straight", straight, persistent=False)

    straight: Float[Tensor, "n 2"]

    def forward(self, frames: Float[Tensor, "b 3 88 200"], speed_mps: Speeds, command: Commands) -> Plan:
        """The path and the speed of the commanded head."""
        return self.plan(self.image(self.maps(frames)), speed_mps, command)

    def maps(self, frames: Float[Tensor, "b 3 88 200"]) -> Float[Tensor, "b c 6 13"]:
        """The feature maps of each frame, from which its image feature is made."""
        return self.squeeze(self.blocks(functional.silu(self.stem(frames))))

    def plan(self, features: Float[Tensor, "b f"], speed_mps: Speeds, command: Commands) -> Plan:
        """The path and the speed that the commanded head makes of features."""
        joined = torch.cat([features, speed_mps[:, None] / SPEED_SCALE_MPS], 1)
        answer = commanded(self.heads, joined, command)
        # The network says by how much the way differs from straight on, as a share of the distance.
        shares = answer[:, 1:].reshape(len(features), -1, 2)
        path = self.straight + shares * self.straight[:, :1]
        return Plan(path, speed_mps + answer[:, 0] / WAYPOINT_CRUISE.gain_per_mps)


class _Block(nn.Module):
    """Two convolutions beside a short cut; SiLU rather than ReLU, whose gradient does not jump."""

    def __init__(self, c_in: int, c_out: int, stride: int) -> None:
        super().__init__()
        self.first = _normed(c_in, c_out, kernel=3, stride=stride)
        self.second = _normed(c_out, c_out, kernel=3, stride=1)
        shrink = nn.AvgPool2d(stride, ceil_mode=True) if stride > 1 else nn.Identity()
        self.cut = nn.Sequential(shrink, nn.Conv2d(c_in, c_out, 1))

    def forward(self, x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b c2 h2 w2"]:
        """What the block makes of feature maps."""
        return functional.silu(self.cut(x) + self.second(functional.silu(self.first(x))))


def waypoint_controller(
    *, preparation: FramePreparation | None = None, law: PurePursuit | LinearMPC | None = None, seed: int = 0
) -> TrajectoryController:
    """The network as a controller, with fresh weights.

    Args:
        preparation: how the network's 88×200 input is made from the frames; by default from those of CARLA's agent.
        law: law that steers along the path; None for pure pursuit as the expert steers.
        seed: seed of the initial weights.
    """
    return planner(TrajectoryController, WaypointNet(seed=seed), preparation, law)


def planner(
    kind: type[Kind], network: WaypointNet, preparation: FramePreparation | None, law: PurePursuit | LinearMPC | None
) -> Kind:
    """A controller of some kind around the network; preparation and law are those of `waypoint_controller`."""
    return kind(
        network,
        preparation=preparation or WAYPOINT_ON_CARLA,
        law=law,
        inputs=("frames", "speed_mps", "command"),
        cruise=WAYPOINT_CRUISE,
    )


def _normed(c_in: int, c_out: int, *, kernel: int, stride: int) -> nn.Sequential:
    return nn.Sequential(nn.Conv2d(c_in, c_out, kernel, stride, kernel // 2), CentredBatchNorm2d(c_out))


def _head(inputs: int) -> nn.Sequential:
    return nn.Sequential(nn.Linear(inputs, _HEAD), nn.SiLU(), nn.Linear(_HEAD, 1 + 2 * len(PATH_M)))
