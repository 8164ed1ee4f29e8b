"""CIL against the published sizes, a plain second writing of the network, and closed forms."""

import subprocess
import sys

import numpy as np
import pytest
import torch
from torch.nn import functional

from roadproof.controllers import CIL, Controller
from roadproof.controllers.conditional import branch_of
from roadproof.errors import ControllerError


@pytest.fixture(scope="module")
def lively() -> CIL:
    """A quarter-width network whose batch normalisation does something."""
    network = CIL(width=0.25, seed=3).eval().requires_grad_(False)
    generator = torch.Generator().manual_seed(0)
    for name, tensor in network.state_dict().items():
        if "norm" in name:
            low, high = (0.5, 2.0) if name.endswith("running_var") else (-0.3, 0.3)
            tensor.uniform_(low, high, generator=generator)
    return network


def batch(size: int = 6, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    frames = torch.rand(size, 3, 88, 200, generator=generator)
    return frames, torch.linspace(0.0, 12.0, size), torch.tensor([2, 3, 4, 5, 0, 1])[:size]


def test_parameters_are_as_many_as_published():
    network = CIL()
    trainable = sum(parameter.numel() for parameter in network.parameters())
    centres = sum(value.numel() for name, value in network.named_parameters() if "norm" in name)
    assert (trainable, centres) == (6_966_125, 960)
    assert sum(value.numel() for value in network.state_dict().values()) == 6_968_045


def test_feature_maps_have_the_published_sizes():
    seen = []
    maps = torch.zeros(1, 3, 88, 200)
    for block in CIL().convolutions:
        maps = block(maps)
        seen.append(tuple(maps.shape[1:]))
    sizes = [(32, 42, 98), (32, 40, 96), (64, 19, 47), (64, 17, 45), (128, 8, 22), (128, 6, 20), (256, 4, 18)]
    assert seen == [*sizes, (256, 2, 16)]


def test_half_width_has_about_a_quarter_of_the_parameters():
    count = sum(parameter.numel() for parameter in CIL(width=0.5).parameters())
    assert 0.24 < count / 6_966_125 < 0.27


@pytest.mark.parametrize(("command", "branch"), [(2, 0), (0, 0), (5, 1), (1, 1), (99, 1), (3, 2), (4, 3)])
def test_commands_pick_the_published_branch(command, branch):
    assert branch_of(torch.tensor([command])).tolist() == [branch]


def test_answers_are_those_of_a_plain_second_writing(lively):
    state = {name: value.double() for name, value in lively.state_dict().items()}
    frames, speed, command = batch()

    def dense(name: str, x: torch.Tensor) -> torch.Tensor:
        return functional.linear(x, state[f"{name}.weight"], state[f"{name}.bias"])

    x = frames.double()
    for layer, stride in enumerate((2, 1, 2, 1, 2, 1, 1, 1)):
        name = f"convolutions.{layer}"
        x = functional.conv2d(x, state[f"{name}.conv.weight"], state[f"{name}.conv.bias"], stride=stride)
        mean, variance, centre = (state[f"{name}.norm.{k}"] for k in ("running_mean", "running_var", "bias"))
        x = (x - mean[:, None, None]) / (variance[:, None, None] + 0.001) ** 0.5 + centre[:, None, None]
        x = x.clamp(min=0)
    # Flattened in rows, columns, channels.
    x = torch.stack([torch.cat([x[:, :, i, j] for i in range(2) for j in range(16)], dim=1)])[0]
    x = dense("image.3", dense("image.0", x).relu()).relu()
    seen_speed = dense("speed_branch.6", dense("speed_branch.3", dense("speed_branch.0", x).relu()).relu())
    v = dense("speed.3", dense("speed.0", speed.double()[:, None] / 25).relu()).relu()
    joined = dense("join.0", torch.cat([x, v], dim=1)).relu()
    branch = {2: 0, 0: 0, 3: 2, 4: 3}
    rows = []
    for i, code in enumerate(command.tolist()):
        name = f"branches.{branch.get(code, 1)}"
        rows.append(dense(f"{name}.6", dense(f"{name}.3", dense(f"{name}.0", joined[i]).relu()).relu()))
    expected = torch.stack(rows)

    output = lively(frames, speed, command)
    torch.testing.assert_close(output.controls.double(), expected, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(output.speed.double(), seen_speed[:, 0], rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(lively.steer(frames, speed, command), output.controls[:, 0])
    assert expected[:, 0].std() > 1e-3


def test_folding_batch_normalisation_changes_no_answer_and_no_gradient(lively):
    frames, speed, command = batch()
    answers, gradients = [], []
    folded = lively.folded()
    assert folded.is_folded
    assert not lively.is_folded
    for network in (lively, folded, folded.folded()):
        leaf = frames.clone().requires_grad_()
        steer = network.steer(leaf, speed, command)
        gradients.append(torch.autograd.grad(steer.sum(), leaf)[0])
        answers.append(steer.detach())
    for answer, gradient in zip(answers[1:], gradients[1:], strict=True):
        torch.testing.assert_close(answer, answers[0], rtol=1e-4, atol=1e-6)
        torch.testing.assert_close(gradient, gradients[0], rtol=1e-3, atol=1e-6 * float(gradients[0].abs().max()))


def test_steering_is_not_clipped_and_keeps_the_dtype_of_the_frames(lively):
    frames, speed, command = batch()
    loud = lively.folded()
    for branch in loud.branches:
        branch[-1].weight.mul_(1000.0)
    assert loud.steer(frames, speed, command).abs().max() > 1
    assert lively.folded().bfloat16().steer(frames, speed, command).dtype == torch.float32


def test_gradients_are_those_of_central_differences(lively):
    network = lively.folded().double()
    frames, speed, command = (value[:1] for value in batch())
    leaf = frames.double().requires_grad_()
    (gradient,) = torch.autograd.grad(network.steer(leaf, speed, command).sum(), leaf)
    direction = torch.rand(leaf.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64) - 0.5
    step = 1e-6
    with torch.no_grad():
        after, before = (network.steer(leaf + s * direction, speed, command).item() for s in (step, -step))
    assert float((gradient * direction).sum()) == pytest.approx((after - before) / (2 * step), rel=1e-4)


COMPILED = """
import torch
from roadproof.controllers import CIL
network = CIL(width=0.05).eval().requires_grad_(False).folded()
batch = torch.rand(4, 3, 88, 200), torch.rand(4), torch.tensor([2, 3, 4, 5])
compiled = torch.compile(network.steer, backend="eager", fullgraph=True)
torch.testing.assert_close(compiled(*batch), network.steer(*batch))
"""


def test_it_compiles_as_one_graph():
    # In a process of its own: torch.compile does not look through the shape checks that the tests switch on.
    done = subprocess.run([sys.executable, "-c", COMPILED], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def _answering(network: CIL, steer: float, gas: float, brake: float) -> CIL:
    network = network.folded()
    for branch in network.branches:
        branch[-1].weight.zero_()
        branch[-1].bias.copy_(torch.tensor([steer, gas, brake]))
    return network


@pytest.mark.parametrize(
    ("answer", "speed_mps", "expected"),
    [
        ((0.2, 0.5, 0.05), 5.0, (0.2, 0.5, 0.0)),  # too little to brake
        ((0.2, 0.5, 0.4), 5.0, (0.2, 0.5, 0.0)),  # gas wins over a weaker brake
        ((0.2, 0.3, 0.6), 5.0, (0.2, 0.3, 0.6)),  # a stronger brake stays
        ((0.2, 0.5, 0.0), 11.0, (0.2, 0.0, 0.0)),  # fast enough
        ((0.2, 0.5, 0.6), 11.0, (0.2, 0.5, 0.6)),  # but only without braking
        ((-1.2, 1.3, -0.1), 5.0, (-1.0, 1.0, 0.0)),  # inside the ranges
    ],
)
def test_driving_follows_the_published_rules(lively, answer, speed_mps, expected):
    control = _answering(lively, *answer).act(np.zeros((88, 200, 3), np.uint8), speed_mps, 2)
    assert (control.steer, control.throttle, control.brake) == pytest.approx(expected)


def test_driving_and_attack_see_the_same_steering(lively):
    frame = np.random.default_rng(0).integers(0, 256, (88, 200, 3), dtype=np.uint8)
    frames = torch.tensor(frame).permute(2, 0, 1)[None] / 255
    steer = lively.steer(frames, torch.tensor([6.0]), torch.tensor([4]))
    assert lively.act(frame, 6.0, 4).steer == pytest.approx(steer.item(), abs=1e-6)


def test_weights_come_from_the_seed_alone():
    before = torch.random.get_rng_state()
    one, same, other = CIL(width=0.1, seed=1), CIL(width=0.1, seed=1), CIL(width=0.1, seed=2)
    assert torch.equal(torch.random.get_rng_state(), before)
    assert torch.equal(one.join[0].weight, same.join[0].weight)
    assert not torch.equal(one.join[0].weight, other.join[0].weight)
    assert torch.equal(one.convolutions[0].conv.bias, torch.full_like(one.convolutions[0].conv.bias, 0.1))


def test_training_moves_the_statistics_that_inference_uses():
    network = CIL(width=0.05).train()
    before = network.convolutions[0].norm.running_mean.clone()
    with torch.random.fork_rng(devices=[]):
        output = network(*batch())
    (output.controls.sum() + output.speed.sum()).backward()
    assert not torch.equal(network.convolutions[0].norm.running_mean, before)
    assert all(parameter.grad is not None for parameter in network.speed_branch.parameters())


def test_cil_is_a_controller(lively):
    assert isinstance(lively, Controller)


def test_wrong_frames_and_widths_are_refused(lively):
    _, speed, command = batch()
    with pytest.raises(ControllerError, match="frames are 320×160, this controller takes 200×88"):
        lively.steer(torch.zeros(6, 3, 160, 320), speed, command)
    with pytest.raises(ControllerError, match="width is 0"):
        CIL(width=0.0)
