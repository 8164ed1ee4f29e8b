"""The PilotNet that is told the command: each command has its own head, and the car's speed matters."""

import numpy as np
import pytest
import torch

from roadproof.controllers import ConditionalPilotNet, check_controller, load_controller, save_controller
from roadproof.controllers.weights_file import load_network
from roadproof.errors import ControllerError


def drive(count=4):
    frames = torch.rand(count, 3, 88, 200, generator=torch.Generator().manual_seed(0))
    return frames, torch.full((count,), 5.0), torch.tensor([2, 3, 4, 5])[:count]


def test_it_keeps_the_promises_that_attacks_rely_on():
    check_controller(ConditionalPilotNet(seed=1).eval()).require()


def test_only_the_commanded_head_answers():
    network = ConditionalPilotNet(seed=1).eval()
    before = network.steer(*drive()).detach()
    with torch.no_grad():
        network.branches[2][-1].bias += 1.0  # left
    after = network.steer(*drive()).detach()
    torch.testing.assert_close(after - before, torch.tensor([0.0, 1.0, 0.0, 0.0]))


def test_rows_outside_its_crop_do_not_matter():
    network = ConditionalPilotNet(seed=1).eval()
    frames, speed, command = drive()
    other = frames.clone()
    other[:, :, :15] = 0.0
    other[:, :, 81:] = 1.0
    torch.testing.assert_close(network.steer(frames, speed, command), network.steer(other, speed, command))


def test_speed_changes_the_answer():
    network = ConditionalPilotNet(seed=1).eval()
    frames, speed, command = drive()
    assert (network.steer(frames, speed, command) != network.steer(frames, speed * 0.0, command)).all()


def test_it_acts_inside_the_ranges_of_a_control():
    network = ConditionalPilotNet(seed=1).eval()
    with torch.no_grad():
        network.branches[0][-1].bias.copy_(torch.tensor([3.0, 0.2, 0.7]))
    control = network.act(np.zeros((88, 200, 3), np.uint8), 4.0, 2)
    assert control.steer == 1.0
    assert control.brake > 0.3
    assert control == control.clipped()


@pytest.mark.parametrize("dtype", ["float32", "float16"])
def test_it_survives_its_file(tmp_path, dtype):
    saved = ConditionalPilotNet(seed=3).eval()
    save_controller(saved, tmp_path / "p.safetensors", dtype=dtype)
    loaded = load_controller(tmp_path / "p.safetensors")
    assert isinstance(loaded, ConditionalPilotNet)
    near = {"rtol": 1e-5, "atol": 1e-6} if dtype == "float32" else {"rtol": 0.0, "atol": 5e-3}
    torch.testing.assert_close(loaded.steer(*drive()), saved.steer(*drive()).detach(), **near)
    again = load_network(tmp_path / "p.safetensors")
    assert all(parameter.requires_grad for parameter in again.parameters())


def test_frames_of_another_size_are_refused():
    with pytest.raises(ControllerError, match="this controller takes 200×88"):
        ConditionalPilotNet().steer(torch.zeros(1, 3, 66, 200), torch.zeros(1), torch.tensor([2]))
