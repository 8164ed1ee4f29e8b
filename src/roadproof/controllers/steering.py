"""Networks that only steer, made into controllers: their frames prepared, their speed held."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor, nn

from roadproof.controllers.frames import FramePreparation, one_frame_batch
from roadproof.controllers.protocol import Commands, Speeds, Stacks
from roadproof.datatypes import Control
from roadproof.errors import ControllerError


@dataclass(frozen=True, kw_only=True, slots=True)
class CruiseControl:
    """Holds a speed: throttle, or brake, in proportion to how much is missing.

    Args:
        target_mps: speed to hold, m/s, above 0; CARLA's agent takes its turns at 5.5 to 7.
        gain_per_mps: throttle for each m/s by which the speed is too low.
        hold: throttle at the target speed, which makes up for drag.

    Raises:
        ControllerError: the target is not positive.
    """

    target_mps: float = 6.0
    gain_per_mps: float = 0.25
    hold: float = 0.3

    def __post_init__(self) -> None:
        if not self.target_mps > 0:
            raise ControllerError(f"target speed is {self.target_mps} m/s, expected a value above 0")

    def control(self, steer: float, speed_mps: float) -> Control:
        """The control with this steering that approaches the target speed."""
        effort = self.hold + self.gain_per_mps * (self.target_mps - speed_mps)
        return Control(steer=steer, throttle=max(effort, 0.0), brake=max(-effort, 0.0)).clipped()

    def controls(
        self, steer: Float[Tensor, " b"], speed_mps: Speeds, target_mps: Float[Tensor, " b"] | None = None
    ) -> Float[Tensor, "b 3"]:
        """Controls of many cars: steer, throttle and brake inside their ranges, differentiable.

        Args:
            steer: steering of each car.
            speed_mps: speed of each car, m/s.
            target_mps: speed that each shall approach, m/s; None for `target_mps` of the cruise control.
        """
        wanted = self.target_mps if target_mps is None else target_mps
        effort = self.hold + self.gain_per_mps * (wanted - speed_mps)
        return torch.stack([steer.clamp(-1.0, 1.0), effort.clamp(0.0, 1.0), (-effort).clamp(0.0, 1.0)], 1)


class NetworkController(nn.Module):
    """What controllers around a network share: its frames prepared, its inputs by name, its speed held.

    Args:
        network: network that takes the `inputs`, in order.
        preparation: how the network's frames are made from those of a recording.
        inputs: what the network takes: "frames", and "speed_mps" and "command" if it wants them.
        cruise: cruise control that holds the speed when driving.
    """

    def __init__(
        self,
        network: nn.Module,
        *,
        preparation: FramePreparation,
        inputs: Sequence[str] = ("frames",),
        cruise: CruiseControl | None = None,
    ) -> None:
        super().__init__()
        self.network = network
        self.preparation = preparation
        self.inputs = tuple(inputs)
        self.cruise = cruise or CruiseControl()

    @property
    def input_size(self) -> tuple[int, int] | None:
        """(height, width) of the frames it takes, or None when it takes any size."""
        return self.preparation.frame_size

    def answer(self, frames: Stacks, speed_mps: Speeds, command: Commands) -> object:
        """What the network answers, in its own dtype.

        Raises:
            ControllerError: the frames have the wrong size.
        """
        tensors = chain(self.network.parameters(), self.network.buffers())
        dtype = next((tensor.dtype for tensor in tensors if tensor.is_floating_point()), frames.dtype)
        values = {
            "frames": self._prepared(frames).to(dtype),
            "speed_mps": speed_mps.to(dtype),
            "command": command.to(torch.int64),
        }
        return self.network(*(values[name] for name in self.inputs))

    def _prepared(self, frames: Stacks) -> Float[Tensor, "b *n 3 hn wn"]:
        if frames.ndim == 4:
            return self.preparation(frames)
        prepared = self.preparation(frames.flatten(0, 1))
        return prepared.reshape(*frames.shape[:2], *prepared.shape[1:])


class SteeringController(NetworkController):
    """A `Controller` around a network that answers with one steering value a frame, of shape (B,) or (B, 1)."""

    def steer(self, frames: Stacks, speed_mps: Speeds, command: Commands) -> Float[Tensor, " b"]:
        """Steering, positive to the right and not clipped; see `Controller.steer`.

        Raises:
            ControllerError: the frames have the wrong size, or the answer is not one value per frame.
        """
        answer = self.answer(frames, speed_mps, command)
        if not isinstance(answer, Tensor):
            raise ControllerError(
                f"network answers with a {type(answer).__name__}, expected one tensor: a steering value a frame"
            )
        if answer.shape not in ((len(frames),), (len(frames), 1)):
            raise ControllerError(
                f"network answers {len(frames)} frames with shape {tuple(answer.shape)}, "
                "expected one steering value a frame"
            )
        return answer.reshape(-1).to(frames.dtype)

    def controls(self, frames: Stacks, speed_mps: Speeds, command: Commands) -> Float[Tensor, "b 3"]:
        """Steer by the network, throttle and brake by `cruise`; see `controllers.PedalController`.

        Raises:
            ControllerError: the frames have the wrong size, or the answer is not one value per frame.
        """
        return self.cruise.controls(self.steer(frames, speed_mps, command), speed_mps)

    def act(self, frame: UInt8[np.ndarray, "h w 3"], speed_mps: float, command: int) -> Control:
        """Steer by the network, hold the speed by `cruise`."""
        with torch.no_grad():
            steer = self.steer(*one_frame_batch(self, frame, speed_mps, command)).item()
        return self.cruise.control(steer, speed_mps)
