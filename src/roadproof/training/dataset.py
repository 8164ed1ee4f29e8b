"""All recorded drives in memory, and batches drawn from them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Float32, Int, Int8, Int64, UInt8
from torch import Tensor

from roadproof.datatypes import Command
from roadproof.errors import TrainingError
from roadproof.training.shards import Shard

_TOLD = ("frames", "speed_mps", "command", "expert", "path_m")

SHARES = {Command.FOLLOW: 0.46, Command.LEFT: 0.2, Command.RIGHT: 0.2, Command.STRAIGHT: 0.14}
"""How often each command is seen while learning, however often it was recorded."""


class Batch(NamedTuple):
    """What the network sees, and what the expert would do.

    Args:
        frames: RGB in [0, 1].
        speed_mps: speed of the car at each frame.
        command: command at each frame, in CARLA's codes.
        expert: steer, throttle and brake that the expert would give at each frame.
        path_m: points of the route ahead, metres ahead of and left of the car.
    """

    frames: Float[Tensor, "b 3 h w"]
    speed_mps: Float[Tensor, " b"]
    command: Int[Tensor, " b"]
    expert: Float[Tensor, "b 3"]
    path_m: Float[Tensor, "b p 2"]


@dataclass(frozen=True, slots=True, eq=False)
class Dataset:
    """Frames and answers of many drives, one after the other; what is not named here is as in a `Shard`.

    Args:
        first: number of the first frame of each frame's drive.
    """

    frames: UInt8[np.ndarray, "n h w 3"]
    speed_mps: Float32[np.ndarray, " n"]
    command: Int8[np.ndarray, " n"]
    expert: Float32[np.ndarray, "n 3"]
    path_m: Float32[np.ndarray, "n p 2"]
    first: Int64[np.ndarray, " n"]

    @classmethod
    def load(cls, paths: Sequence[Path]) -> Dataset:
        """Read all frames of the drives in shards.

        Raises:
            TrainingError: there is no shard, one is damaged, or their frames differ in size.
        """
        shards = [shard for shard in map(Shard.load, paths) if len(shard)]
        if not shards:
            raise TrainingError("there are no recorded drives to learn from; collect some first")
        sizes = {shard.frames.shape[1:] for shard in shards}
        if len(sizes) > 1:
            raise TrainingError(f"recorded frames have sizes {sorted(sizes)}, expected one size")
        lengths = [len(shard) for shard in shards]
        first = np.repeat(np.cumsum([0, *lengths[:-1]]), lengths)
        told = {name: np.concatenate([getattr(shard, name) for shard in shards]) for name in _TOLD}
        return cls(**told, first=first)

    def __len__(self) -> int:
        """How many frames there are."""
        return len(self.frames)

    def weights(self) -> Float[Tensor, " n"]:
        """How often each frame is to be drawn, so that commands come in their `SHARES`; sums to 1.

        Raises:
            TrainingError: no frame has a known command.
        """
        weight = np.zeros(len(self))
        for command, share in SHARES.items():
            chosen = self.command == int(command)
            weight[chosen] = share / max(int(chosen.sum()), 1)
        if not weight.any():
            raise TrainingError("no recorded frame has a known command")
        return torch.from_numpy(weight / weight.sum())

    def windows(self, last: Int[Tensor, " w"], length: int) -> Int[Tensor, " n"]:
        """Numbers of the frames of windows, one window after the other: the `last` frame of each and those before it.

        A window that would begin before its drive repeats the drive's first frame.
        """
        numbers = last[:, None] - torch.arange(length - 1, -1, -1)
        return numbers.maximum(torch.from_numpy(self.first)[last][:, None]).flatten()

    def batch(self, chosen: Int[Tensor, " b"], device: torch.device | str = "cpu") -> Batch:
        """The chosen frames, as a network takes them."""
        index = chosen.numpy()
        pictures = torch.from_numpy(self.frames[index]).to(device)
        return Batch(
            pictures.permute(0, 3, 1, 2).float().div_(255.0),
            torch.from_numpy(self.speed_mps[index]).to(device),
            torch.from_numpy(self.command[index].astype(np.int64)).to(device),
            torch.from_numpy(self.expert[index]).to(device),
            torch.from_numpy(self.path_m[index]).to(device),
        )
