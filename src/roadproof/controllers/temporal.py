"""The waypoint network with a short memory: notes of what it saw, as of late drivers that keep their features.

Notation:
    | name | meaning | shape |
    |---|---|---|
    | maps | what the waypoint network makes of a frame | b 16 6 13 |
    | note | what is kept of them | b 32 |
    | past | notes of 0.1 to 0.7 s before, as differences from the present one | b 7 32 |

Differences say what moved; in a still world they vanish, as at the first frame of a drive.

References:
    comma.ai, openpilot's driving model, which answers from a buffer of features of the last seconds, 2022 and later.
"""

from __future__ import annotations

from typing import cast

import torch
from jaxtyping import Float
from torch import Tensor, nn

from roadproof.controllers.frames import FramePreparation
from roadproof.controllers.history import TICK_S, kept_after
from roadproof.controllers.protocol import Commands, Frames, Speeds
from roadproof.controllers.tracking import LinearMPC, PurePursuit
from roadproof.controllers.trajectory import Plan, TrajectoryController
from roadproof.controllers.waypoint import FLAT, WaypointNet, planner
from roadproof.controllers.weights import seeded

NOTES, APART_S = 7, 0.1
"""Number of notes that are looked back at, and the time from one to the next, seconds: the training's step."""

WINDOW = NOTES + 1
"""Frames of a training window, `APART_S` apart: the last of them has all its notes."""

_NOTE, _RECALLED = 32, 64
_APART = round(APART_S / TICK_S)


class TemporalNet(WaypointNet):
    """The network alone: prepared frames, speed, command and notes of the frames before in, a `Plan` out.

    Args:
        seed: seed of the initial weights, drawn without touching the global random state.
    """

    def __init__(self, *, seed: int = 0) -> None:
        super().__init__(seed=seed, more=_RECALLED)
        with seeded(seed + 1):
            self.note = nn.Sequential(
                nn.Flatten(), nn.LayerNorm(FLAT, elementwise_affine=False), nn.Linear(FLAT, _NOTE)
            )
            self.recall = nn.Sequential(nn.Flatten(), nn.Linear(NOTES * _NOTE, _RECALLED), nn.SiLU())

    def after(
        self,
        maps: Float[Tensor, "b c 6 13"],
        past: Float[Tensor, "b n m"],
        speed_mps: Speeds,
        command: Commands,
    ) -> Plan:
        """The plan that follows from a frame's maps and the past."""
        return self.plan(torch.cat([self.image(maps), self.recall(past)], 1), speed_mps, command)

    def forward(self, frames: Float[Tensor, "b 3 88 200"], speed_mps: Speeds, command: Commands) -> Plan:
        """The plan at the first frames of drives."""
        maps = self.maps(frames)
        return self.after(maps, maps.new_zeros(len(maps), NOTES, _NOTE), speed_mps, command)

    def along(self, frames: Float[Tensor, "b 3 88 200"], speed_mps: Speeds, command: Commands) -> Plan:
        """The plans at every frame of windows of `WINDOW` frames, one window after the other, each a drive's first."""
        maps = self.maps(frames)
        notes = self.note(maps).unflatten(0, (-1, WINDOW))
        now = torch.arange(WINDOW, device=frames.device)
        back = torch.arange(1, NOTES + 1, device=frames.device)
        past = notes[:, (now[:, None] - back).clamp_min(0)] - notes[:, :, None]
        return self.after(maps, past.flatten(0, 1), speed_mps, command)


class TemporalPlanner(TrajectoryController):
    """A `TemporalController` around a `TemporalNet`; see `TrajectoryController`."""

    network: TemporalNet

    def along(self, frames: Frames, speed_mps: Speeds, command: Commands) -> Plan:
        """The plans at every frame of windows of `WINDOW` frames, for training."""
        return self.network.along(self.preparation(frames), speed_mps, command)

    def controls_after(
        self, memory: object, frames: Frames, speed_mps: Speeds, command: Commands, elapsed_s: float
    ) -> tuple[Float[Tensor, "b 3"], object]:
        """Controls after what was seen so far; see `TemporalController.controls_after`."""
        network = self.network
        prepared, dtype = self.preparation(frames), network.squeeze.weight.dtype
        maps = network.maps(prepared.to(dtype))
        kept = kept_after(cast("tuple[Tensor, ...] | None", memory), network.note(maps), elapsed_s, NOTES * _APART)
        past = torch.stack(kept[_APART::_APART], 1) - kept[0][:, None]
        plan = network.after(maps, past, speed_mps.to(dtype), command.to(torch.int64))
        return self.controls_along(plan, speed_mps).to(frames.dtype), kept


def temporal_controller(
    *, preparation: FramePreparation | None = None, law: PurePursuit | LinearMPC | None = None, seed: int = 0
) -> TemporalPlanner:
    """The network as a controller, with fresh weights; its arguments are those of `waypoint_controller`."""
    return planner(TemporalPlanner, TemporalNet(seed=seed), preparation, law)
