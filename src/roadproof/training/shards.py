"""Recorded drives to learn from, one file each: frames, what was asked, and what the expert would do.

A shard is a NumPy archive of named arrays and a JSON header, lightly compressed. Nothing is pickled.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
from jaxtyping import Float32, Int8, UInt8

from roadproof.errors import TrainingError
from roadproof.io.arrays import read_record
from roadproof.io.records import RecordFile, Saved


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Shard(Saved):
    """What was seen on one drive, and the expert's answer to it.

    Args:
        frames: (n, h, w, 3) RGB at the controller's resolution.
        speed_mps: (n,) speed of the car at each frame.
        command: (n,) command at each frame, in CARLA's codes (`datatypes.Command`).
        expert: (n, 3) steer, throttle and brake the expert would give there; never what disturbed the drive.
        lateral_m: (n,) offset of the car from the route, metres, left positive.
        path_m: (n, p, 2) points of the route ahead, from near to far, metres ahead of and left of the car's middle.
        about: plan and number of the drive, by which a folder knows it; weather and traffic; whether it was disturbed
            or painted.

    Raises:
        TrainingError: shapes do not fit each other, or a value is not finite.
    """

    frames: UInt8[np.ndarray, "..."]
    speed_mps: Float32[np.ndarray, "..."]
    command: Int8[np.ndarray, "..."]
    expert: Float32[np.ndarray, "..."]
    lateral_m: Float32[np.ndarray, "..."]
    path_m: Float32[np.ndarray, "..."]
    about: Mapping[str, Any]

    def __post_init__(self) -> None:
        count = len(self.frames)
        if self.frames.ndim != 4 or self.frames.shape[3] != 3 or self.expert.shape != (count, 3):
            raise TrainingError(
                f"frames of shape {self.frames.shape} with answers of shape {self.expert.shape}, "
                "expected (n, h, w, 3) and (n, 3)"
            )
        if self.path_m.ndim != 3 or self.path_m.shape[::2] != (count, 2):
            raise TrainingError(f"path_m has shape {self.path_m.shape}, expected ({count}, p, 2)")
        for name in ("speed_mps", "command", "lateral_m"):
            if getattr(self, name).shape != (count,):
                raise TrainingError(f"{name} has shape {getattr(self, name).shape}, expected ({count},)")
        for name in ("speed_mps", "expert", "lateral_m", "path_m"):
            if not np.isfinite(getattr(self, name)).all():
                raise TrainingError(f"{name} of the drive has NaN or infinite values")

    @staticmethod
    def about_of(path: Path) -> Mapping[str, Any]:
        """What a shard says about itself; its arrays are not read.

        Raises:
            TrainingError: the file is missing or damaged, or no shard.
        """
        file = Shard.FILE
        stated, _ = read_record(path, (), file.error, file.remedy, format_version=(file.name, file.version))
        if not isinstance(about := stated.get("about"), dict):
            raise TrainingError(f"{path} says nothing about itself; {file.remedy}")
        return cast("dict[str, Any]", about)

    def __len__(self) -> int:
        """How many frames there are."""
        return len(self.frames)


# Full compression takes longer than the drive's pictures take to render.
Shard.FILE = RecordFile(
    kind=Shard,
    name="roadproof-shard",
    version=2,
    error=TrainingError,
    remedy="the same command collects it again once no such file is there",
    level=1,
)
