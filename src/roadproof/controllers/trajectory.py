"""Networks that answer with a trajectory: a tracking law steers along it, and its speed is held."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor, nn

from roadproof.controllers.frames import FramePreparation, control_of
from roadproof.controllers.protocol import Commands, Speeds, Stacks
from roadproof.controllers.steering import CruiseControl, NetworkController
from roadproof.controllers.tracking import LinearMPC, PurePursuit, lengths_of
from roadproof.datatypes import Control
from roadproof.errors import ControllerError


class Plan(NamedTuple):
    """Where the car shall go, and how fast.

    Args:
        path: points to pass, in order, from near to far: metres ahead of and left of the car's middle.
        target_mps: speed to approach, m/s; None leaves it to the cruise control.
    """

    path: Float[Tensor, "b n 2"]
    target_mps: Float[Tensor, " b"] | None


class TrajectoryController(NetworkController):
    """A `Controller` around a network that answers with points ahead of the car.

    The network answers with a `Plan`, or with the points alone, (B, N, 2) or (B, 2 N): metres ahead and left, from near
    to far. Points at known times say how fast to drive too.

    Args:
        law: law that steers along the points; arguments that are not named here are those of `NetworkController`.
        dt_s: time from point to point, seconds, the first one lying that far ahead; None where points have no times.
        cruise: cruise control that approaches the speed of the plan, or holds its own where the plan has none.

    Raises:
        ControllerError: the time from point to point is not positive.
    """

    def __init__(
        self,
        network: nn.Module,
        *,
        preparation: FramePreparation,
        law: PurePursuit | LinearMPC | None = None,
        dt_s: float | None = None,
        inputs: Sequence[str] = ("frames",),
        cruise: CruiseControl | None = None,
    ) -> None:
        super().__init__(network, preparation=preparation, inputs=inputs, cruise=cruise)
        if dt_s is not None and not 0 < dt_s <= 10:
            raise ControllerError(f"points of a trajectory lie {dt_s} s apart, expected above 0, at most 10")
        self.law = law or PurePursuit()
        self.dt_s = dt_s

    def forward(self, frames: Stacks, speed_mps: Speeds, command: Commands) -> Plan:
        """The plan for each frame, differentiable in the frames.

        Raises:
            ControllerError: the frames have the wrong size, or the answer is no plan.
        """
        answer = self.answer(frames, speed_mps, command)
        if isinstance(answer, Plan):
            return answer
        if not isinstance(answer, Tensor):
            raise ControllerError(f"network answers with a {type(answer).__name__}, expected one tensor of points")
        values = answer.numel() // max(len(frames), 1)
        whole = answer.ndim in (2, 3) and len(answer) == len(frames) and values >= 2 and answer.shape[-1] % 2 == 0
        if not whole or (answer.ndim == 3 and answer.shape[2] != 2):
            raise ControllerError(
                f"network answers {len(frames)} frames with shape {tuple(answer.shape)}, expected points ahead and "
                "left, (b, n, 2)"
            )
        path = answer.reshape(len(frames), -1, 2)
        if self.dt_s is None:
            return Plan(path, None)
        steps = torch.diff(torch.cat([torch.zeros_like(path[:, :1]), path], 1), dim=1)
        return Plan(path, lengths_of(steps).mean(1) / self.dt_s)

    def steer(self, frames: Stacks, speed_mps: Speeds, command: Commands) -> Float[Tensor, " b"]:
        """Steering along the plan, positive to the right and not clipped; see `Controller.steer`.

        Raises:
            ControllerError: the frames have the wrong size, or the answer is no plan.
        """
        return self.steer_along(self(frames, speed_mps, command), speed_mps).to(frames.dtype)

    def controls(self, frames: Stacks, speed_mps: Speeds, command: Commands) -> Float[Tensor, "b 3"]:
        """Steer along the plan, throttle and brake by its speed; see `controllers.PedalController`.

        Raises:
            ControllerError: the frames have the wrong size, or the answer is no plan.
        """
        return self.controls_along(self(frames, speed_mps, command), speed_mps).to(frames.dtype)

    def act(self, frame: UInt8[np.ndarray, "h w 3"], speed_mps: float, command: int) -> Control:
        """The control that `controls` gives for one frame."""
        return control_of(self, frame, speed_mps, command)

    def controls_along(self, plan: Plan, speed_mps: Speeds) -> Float[Tensor, "b 3"]:
        """Steer, throttle and brake along a plan that was made already, inside their ranges, (B, 3)."""
        return self.cruise.controls(self.steer_along(plan, speed_mps), speed_mps, plan.target_mps)

    def steer_along(self, plan: Plan, speed_mps: Speeds) -> Float[Tensor, " b"]:
        """Steering along a plan that was made already, positive to the right, (B,)."""
        # A network may compute in half precision; distances squared need more.
        return self.law.steer(plan.path.float() if plan.path.dtype.itemsize < 4 else plan.path, speed_mps)
