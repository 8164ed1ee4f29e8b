import pytest
import torch
from torch import nn

from painted_ground import RampFollower
from roadproof.controllers import load_controller
from roadproof.controllers.frames import FramePreparation
from roadproof.controllers.precision import for_climbing, multiplies_bfloat16, multiply_in
from roadproof.controllers.shipped import installed_weights, shipped_names
from roadproof.controllers.steering import SteeringController

CPU = torch.device("cpu")


@pytest.mark.parametrize(("capability", "expected"), [("AVX512", True), ("AVX2", False), ("DEFAULT", False)])
def test_a_processor_without_wide_vectors_has_no_bfloat16_arithmetic(
    capability: str, expected: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch.backends.cpu, "get_cpu_capability", lambda: capability)
    monkeypatch.setattr(torch.cpu, "get_capabilities", dict, raising=False)
    assert multiplies_bfloat16("cpu") is expected


@pytest.mark.parametrize("has", [True, False])
def test_wide_vectors_without_its_instructions_are_not_enough(has: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.backends.cpu, "get_cpu_capability", lambda: "AVX512")
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: {"avx512_bf16": has}, raising=False)
    assert multiplies_bfloat16("cpu") is has


def test_a_gpu_has_it() -> None:
    assert multiplies_bfloat16("cuda:0")


@pytest.fixture
def wide(monkeypatch: pytest.MonkeyPatch) -> None:
    """A processor with instructions for bfloat16, wherever this runs."""
    monkeypatch.setattr(torch.cpu, "get_capabilities", dict, raising=False)
    monkeypatch.setattr(torch.backends.cpu, "get_cpu_capability", lambda: "AVX512")


@pytest.mark.usefixtures("wide")
@pytest.mark.parametrize("name", [name for name in shipped_names() if installed_weights(name)])
def test_a_network_is_climbed_with_in_bfloat16_and_stays_as_it_was(name: str) -> None:
    network = load_controller(name)
    frames, speed, command = torch.rand(3, 3, 88, 200), torch.full((3,), 5.0), torch.full((3,), 2)
    before = network.steer(frames, speed, command)
    quick = for_climbing(network, CPU)
    assert isinstance(quick, nn.Module)
    assert {each.dtype for each in quick.parameters()} == {torch.bfloat16}
    found = quick.steer(frames, speed, command)
    assert found.dtype == torch.float32
    assert torch.allclose(found, before, atol=0.03)
    assert torch.equal(network.steer(frames, speed, command), before)


class OfAUser(nn.Linear):
    """A layer of which nobody knows what it computes in."""


@pytest.mark.usefixtures("wide")
@pytest.mark.parametrize("kind", ["another format", "a user's module", "a user's network", "a GPU", "no module"])
def test_other_controllers_are_climbed_with_as_they_are(kind: str) -> None:
    controller = load_controller("pilotnet", dtype="float64" if kind == "another format" else "float32")
    if kind == "a user's module":
        controller.more = OfAUser(1, 1)
    elif kind == "a user's network":
        controller = SteeringController(nn.Flatten(), preparation=FramePreparation())
    elif kind == "no module":
        controller = RampFollower()
    assert for_climbing(controller, torch.device("cuda:0" if kind == "a GPU" else "cpu")) is controller


def test_without_the_arithmetic_all_digits_are_climbed_with(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.backends.cpu, "get_cpu_capability", lambda: "AVX2")
    network = load_controller("pilotnet")
    assert for_climbing(network, CPU) is network


def test_multiplications_round_to_tf32_only_where_that_is_asked_for() -> None:
    before = torch.backends.cudnn.allow_tf32, torch.get_float32_matmul_precision()
    try:
        for dtype, rounds in (("float32", False), ("tf32", True), ("bfloat16", False)):
            multiply_in(dtype)
            assert torch.backends.cudnn.allow_tf32 is rounds
            assert torch.get_float32_matmul_precision() == ("high" if rounds else "highest")
    finally:
        torch.backends.cudnn.allow_tf32 = before[0]
        torch.set_float32_matmul_precision(before[1])
