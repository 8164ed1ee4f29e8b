"""What a pattern does to a controller on recorded drives, frame by frame."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, UInt8

from roadproof.attacks.groups import Direction, Group
from roadproof.attacks.surrogate import Surrogate
from roadproof.compositing import composite
from roadproof.controllers import Controller
from roadproof.patterns import Pattern
from roadproof.recordings import RecordingSet


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class ShownDrive:
    """One recorded drive without and with a pattern composited in.

    Args:
        name: name of the drive.
        clean: frames of the drive without paint, RGB, (F, H, W, 3).
        painted: the same frames with the pattern composited in, (F, H, W, 3).
        clean_steer: the controller's answers to the clean frames, in steer units, positive to the right, (F,).
        painted_steer: the controller's answers to the composited frames, in steer units, (F,).
    """

    name: str
    clean: UInt8[np.ndarray, "f h w 3"]
    painted: UInt8[np.ndarray, "f h w 3"]
    clean_steer: Float[np.ndarray, " f"]
    painted_steer: Float[np.ndarray, " f"]

    @property
    def mean_shift(self) -> float:
        """Mean shift of steering per frame, in steer units, positive to the right."""
        return float((self.painted_steer - self.clean_steer).mean())


def show_pattern(
    pattern: Pattern,
    recordings: RecordingSet,
    controller: Controller,
    group: Group,
    *,
    device: torch.device | str = "cpu",
) -> tuple[ShownDrive, ...]:
    """Composite a pattern into the drives of a group and ask the controller about the frames.

    Args:
        pattern: the pattern to composite; one pattern, not a batch.
        recordings: calibrated recordings of the drives.
        controller: the controller that is asked; it computes on `device`.
        group: the group whose drives are shown.
        device: torch device on which frames are composited.
    """
    # What the controller answers has no direction.
    surrogate = Surrogate(recordings, controller, [replace(group, direction=Direction.EITHER)], device=device)
    view = surrogate.views[0]
    on_device = pattern[None].mapped(lambda part: part.to(device))
    with torch.no_grad():
        shift = surrogate.shifts([on_device])[0][0].cpu().numpy()
        painted = composite(on_device, view)[0].permute(0, 2, 3, 1).mul(255).round().to(torch.uint8).cpu().numpy()
    clean_steer = surrogate.clean_steer[0].cpu().numpy()
    drives = group.select(recordings)
    ends = np.cumsum([len(drive.frames) for drive in drives])
    return tuple(
        ShownDrive(
            name=drive.name,
            clean=drive.frames,
            painted=painted[end - len(drive.frames) : end],
            clean_steer=clean_steer[end - len(drive.frames) : end],
            painted_steer=(clean_steer + shift)[end - len(drive.frames) : end],
        )
        for drive, end in zip(drives, ends, strict=True)
    )
