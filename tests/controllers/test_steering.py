"""Steering-only networks as controllers."""

import numpy as np
import pytest
import torch
from torch import nn

from roadproof.controllers import CruiseControl, FramePreparation, SteeringController
from roadproof.errors import ControllerError


class Weigh(nn.Module):
    """Answers the mean brightness, plus a share of the speed and command."""

    def __init__(self, columns: int | None = None) -> None:
        super().__init__()
        self.columns = columns
        self.gain = nn.Parameter(torch.tensor(2.0))

    def forward(self, frames, command, speed_mps):
        answer = self.gain * frames.mean(dim=(1, 2, 3)) + 10 * command + 0.1 * speed_mps
        return answer if self.columns is None else answer[:, None].expand(-1, self.columns)


@pytest.mark.parametrize("columns", [None, 1])
def test_inputs_are_handed_over_by_name(columns):
    controller = SteeringController(
        Weigh(columns), preparation=FramePreparation(), inputs=("frames", "command", "speed_mps")
    )
    steer = controller.steer(torch.ones(2, 3, 4, 4), torch.tensor([1.0, 2.0]), torch.tensor([0, 1]))
    assert steer.tolist() == pytest.approx([2.1, 12.2])


def test_an_answer_that_is_not_one_value_a_frame_is_refused():
    controller = SteeringController(Weigh(3), preparation=FramePreparation(), inputs=("frames", "command", "speed_mps"))
    with pytest.raises(ControllerError, match=r"2 frames with shape \(2, 3\)"):
        controller.steer(torch.ones(2, 3, 4, 4), torch.zeros(2), torch.zeros(2, dtype=torch.int64))


def test_the_answer_keeps_the_dtype_of_the_frames():
    controller = SteeringController(
        Weigh().bfloat16(), preparation=FramePreparation(), inputs=("frames", "command", "speed_mps")
    )
    steer = controller.steer(torch.ones(1, 3, 4, 4), torch.zeros(1), torch.zeros(1, dtype=torch.int64))
    assert steer.dtype == torch.float32


def test_driving_reaches_and_holds_the_target_speed():
    controller = SteeringController(
        Weigh(),
        preparation=FramePreparation(),
        inputs=("frames", "command", "speed_mps"),
        cruise=CruiseControl(target_mps=7.0),
    )
    frame, speed = np.zeros((4, 4, 3), np.uint8), 0.0
    for _ in range(300):
        control = controller.act(frame, speed, 0)
        # A car that gains 4 m/s² at full throttle, brakes at 8 m/s² and loses 0.17/s to drag.
        speed += 0.1 * (4 * control.throttle - 8 * control.brake - 0.17 * speed)
    assert speed == pytest.approx(7.0, abs=0.2)
    assert controller.act(frame, 20.0, 0).brake == 1.0
    assert controller.act(frame, 20.0, 0).throttle == 0.0
    assert controller.act(frame, 7.0, 0).steer == pytest.approx(0.7)


@pytest.mark.parametrize("target", [0.0, -1.0, float("nan")])
def test_standing_still_is_no_target(target):
    with pytest.raises(ControllerError, match="target speed"):
        CruiseControl(target_mps=target)


def test_a_network_that_answers_with_a_tuple_is_named():
    controller = SteeringController(torch.nn.Identity(), preparation=FramePreparation(frame_size=(8, 8)))
    controller.network.forward = lambda frames: (frames.mean((1, 2, 3)), None)
    with pytest.raises(ControllerError, match="network answers with a tuple, expected one tensor"):
        controller.steer(torch.rand(2, 3, 8, 8), torch.zeros(2), torch.full((2,), 2))
