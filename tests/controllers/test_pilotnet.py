"""PilotNet against reference outputs and input gradients that other software computed from the same weights."""

import numpy as np
import pytest
import torch
from PIL import Image
from safetensors.torch import load_file

from roadproof.controllers import (
    PILOTNET_ON_CARLA,
    Controller,
    FramePreparation,
    PilotNet,
    SteeringController,
    pilotnet_controller,
)
from roadproof.errors import ControllerError


@pytest.fixture(scope="module")
def trained(pilotnet_data) -> PilotNet:
    network = PilotNet()
    network.load_state_dict(load_file(pilotnet_data / "pilotnet.safetensors"))
    return network.eval().requires_grad_(False)


def test_outputs_and_input_gradients_are_those_of_the_reference(trained, pilotnet_data):
    reference = np.load(pilotnet_data / "reference.npz", allow_pickle=False)
    frames = torch.tensor(reference["frames_yuv"]).requires_grad_()
    steer = trained(frames)
    (gradient,) = torch.autograd.grad(steer.sum(), frames)
    np.testing.assert_allclose(steer.detach().numpy(), reference["steer"], atol=2e-6)
    np.testing.assert_allclose(gradient.numpy(), reference["grad_of_sum"], atol=1e-6)


def test_real_frames_correlate_with_the_recorded_steering_as_documented(trained, carla_data):
    controller = SteeringController(trained, preparation=PILOTNET_ON_CARLA)
    log = np.genfromtxt(carla_data / "t1" / "log.csv", delimiter=",", names=True)
    frames, recorded = [], []
    for row in log:
        path = carla_data / "t1" / "frames" / f"{int(row['frame'])}.png"
        if path.is_file():
            frames.append(np.asarray(Image.open(path)))
            recorded.append(row["steer_clean"])
    batch = torch.tensor(np.stack(frames)).permute(0, 3, 1, 2) / 255
    steer = controller.steer(batch, torch.full((len(batch),), 6.0), torch.full((len(batch),), 2))
    assert np.corrcoef(steer.numpy(), recorded)[0, 1] == pytest.approx(0.39, abs=0.04)
    assert controller.act(frames[0], 6.0, 2).steer == pytest.approx(steer[0].item(), abs=1e-5)


def test_relu_and_elu_differ_and_others_are_refused():
    frames = torch.rand(2, 3, 66, 200, generator=torch.Generator().manual_seed(0))
    assert not torch.equal(PilotNet(activation="elu")(frames), PilotNet(activation="relu")(frames))
    with pytest.raises(ControllerError, match="activation is 'gelu'"):
        pilotnet_controller(activation="gelu")


def test_it_is_a_controller_for_carlas_frames():
    controller = pilotnet_controller()
    assert isinstance(controller, Controller)
    assert controller.input_size == (88, 200)


def test_frames_of_its_own_simulator_are_cut_and_resized():
    udacity = FramePreparation(frame_size=(160, 320), rows=(60, 135), network_size=(66, 200), colour="yuv")
    frames = torch.rand(2, 3, 160, 320, generator=torch.Generator().manual_seed(0))
    controller = pilotnet_controller(preparation=udacity).eval()
    steer = controller.steer(frames, torch.zeros(2), torch.full((2,), 2))
    blind = frames.clone()
    blind[:, :, :60] = 0
    blind[:, :, 135:] = 1
    assert torch.equal(controller.steer(blind, torch.zeros(2), torch.full((2,), 2)), steer)


def test_a_preparation_of_another_size_is_refused():
    with pytest.raises(ControllerError, match="network_size is None"):
        pilotnet_controller(preparation=FramePreparation())


def test_weights_come_from_the_seed_alone():
    before = torch.random.get_rng_state()
    one, same, other = PilotNet(seed=1), PilotNet(seed=1), PilotNet(seed=2)
    assert torch.equal(torch.random.get_rng_state(), before)
    assert torch.equal(one.fc[0].weight, same.fc[0].weight)
    assert not torch.equal(one.fc[0].weight, other.fc[0].weight)
