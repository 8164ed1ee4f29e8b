"""Exported networks load as controllers that answer and differentiate as what they were exported from."""

import os
import pickle
import subprocess
import sys
import warnings
from contextlib import nullcontext

import numpy as np
import pytest
import torch
from torch import nn

from roadproof.controllers import (
    CIL,
    ControllerCard,
    FramePreparation,
    SteeringController,
    check_controller,
    load_controller,
)
from roadproof.controllers.exported import TorchProgram, _pickles_refused
from roadproof.controllers.loading import PICKLES
from roadproof.errors import ControllerError, DeviceError
from roadproof.io.known import known_by

CARD = ControllerCard(
    target_speed_mps=7.0, preparation=FramePreparation(frame_size=(24, 32), rows=(8, 24), network_size=(16, 16))
)


class Net(nn.Module):
    """A small network with the inputs of a commanded controller."""

    def __init__(self) -> None:
        super().__init__()
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(0)
            self.conv = nn.Conv2d(3, 4, 3, stride=2)
            self.dense = nn.Linear(4 * 7 * 7 + 1, 2)

    def forward(self, frames, speed_mps, command):
        maps = torch.tanh(self.conv(frames)).flatten(1)
        answers = self.dense(torch.cat([maps, speed_mps[:, None] / 25], dim=1))
        return torch.where(command == 3, answers[:, 0], answers[:, 1])


class FramesAlone(nn.Module):
    def forward(self, picture):
        return picture.mean(dim=(1, 2, 3))


def inputs(size: int = 3, height: int = 16, width: int = 16) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    frames = torch.rand(size, 3, height, width, generator=torch.Generator().manual_seed(0))
    return frames, torch.linspace(0, 9, size), torch.tensor([2, 3, 4] * size)[:size]


def export(network: nn.Module, arguments, path, *, fixed: bool = False) -> None:
    batch = torch.export.Dim("batch")
    shapes = None if fixed else tuple({0: batch} for _ in arguments)
    torch.export.save(torch.export.export(network, arguments, dynamic_shapes=shapes), path)


@pytest.fixture(scope="module")
def program(tmp_path_factory):
    path = tmp_path_factory.mktemp("program") / "net.pt2"
    export(Net().eval(), inputs(), path)
    return path


def agree(controller, network, frames, prepare=lambda frames: frames) -> None:
    answers, gradients = [], []
    for call in (controller.steer, lambda leaf, *rest: network(prepare(leaf), *rest)):
        leaf = frames.clone().requires_grad_()
        steer = call(leaf, *inputs(len(leaf))[1:])
        answers.append(steer.detach())
        gradients.append(torch.autograd.grad(steer.sum(), leaf)[0])
    torch.testing.assert_close(answers[0], answers[1], rtol=1e-4, atol=1e-6)
    torch.testing.assert_close(gradients[0], gradients[1], rtol=1e-3, atol=1e-5 * float(gradients[1].abs().max()))
    assert gradients[1].abs().max() > 0


def test_a_program_answers_and_differentiates_as_its_network(program):
    controller = load_controller(program)
    assert controller.input_size == (16, 16)
    agree(controller, Net().eval(), inputs(5)[0])
    report = check_controller(controller)
    assert report.passed, report.failures


def test_programs_of_equal_weights_are_told_apart(tmp_path):
    class Steers(nn.Module):
        def __init__(self, most):
            super().__init__()
            self.weight, self.most = nn.Parameter(torch.ones(3)), most

        def forward(self, frames):
            return (frames.mean((2, 3)) * self.weight).sum(1).clamp(-self.most, self.most)

    known = []
    for name, most in (("one", 0.9), ("same", 0.9), ("other", 0.8)):
        export(Steers(most), inputs()[:1], tmp_path / f"{name}.pt2")
        known.append(known_by(TorchProgram(tmp_path / f"{name}.pt2", torch.device("cpu"))))
    assert known[0] == known[1] != known[2]


def test_a_card_beside_it_says_how_frames_are_prepared(program):
    card = program.with_suffix(".json")
    card.write_text(CARD.to_json())
    try:
        controller = load_controller(program)
    finally:
        card.unlink()
    assert isinstance(controller, SteeringController)
    assert (controller.input_size, controller.cruise.target_mps) == ((24, 32), 7.0)
    halved = lambda frames: frames[:, :, 8:].reshape(-1, 3, 16, 16, 2).mean(dim=-1)  # noqa: E731
    agree(controller, Net().eval(), inputs(4, 24, 32)[0], halved)


def test_a_single_input_may_have_any_name(tmp_path):
    export(FramesAlone(), inputs()[:1], tmp_path / "mean.pt2")
    controller = load_controller(tmp_path / "mean.pt2")
    frames, speed, command = inputs()
    torch.testing.assert_close(controller.steer(frames, speed, command), frames.mean(dim=(1, 2, 3)))


def test_programs_that_cannot_serve_are_refused(program, tmp_path):
    export(Net().eval(), inputs(), tmp_path / "fixed.pt2", fixed=True)
    with pytest.raises(ControllerError, match="frames was exported for batches of exactly 3"):
        load_controller(tmp_path / "fixed.pt2")

    class Odd(Net):
        def forward(self, frames, velocity, command):
            return super().forward(frames, velocity, command)

    export(Odd().eval(), inputs(), tmp_path / "odd.pt2")
    with pytest.raises(ControllerError, match="inputs named frames, velocity, command; expected"):
        load_controller(tmp_path / "odd.pt2")
    (tmp_path / "bad.pt2").write_bytes(b"no program")
    with pytest.raises(ControllerError, match=r"bad\.pt2 is not a torch\.export file"):
        load_controller(tmp_path / "bad.pt2")
    with pytest.raises(DeviceError, match=r"computes in torch\.float32, not torch\.float64"):
        load_controller(program, dtype="float64")
    wrong = ControllerCard(preparation=FramePreparation(network_size=(66, 200)))
    (tmp_path / "net.pt2").write_bytes(program.read_bytes())
    (tmp_path / "net.json").write_text(wrong.to_json())
    with pytest.raises(ControllerError, match=r"says network_size \(66, 200\), the file \(16, 16\)"):
        load_controller(tmp_path / "net.pt2")


def test_a_card_that_denies_what_the_inputs_name_says_is_refused(tmp_path):
    class Yuv(FramesAlone):
        def forward(self, frames_yuv):
            return super().forward(frames_yuv)

    export(Yuv(), inputs()[:1], tmp_path / "net.pt2")
    for colour, fits in (("yuv", True), ("rgb", False)):
        (tmp_path / "net.json").write_text(ControllerCard(preparation=FramePreparation(colour=colour)).to_json())
        with (
            nullcontext() if fits else pytest.raises(ControllerError, match="takes frames_yuv and its card says colour")
        ):
            assert load_controller(tmp_path / "net.pt2").preparation.colour == "yuv"


class Other(nn.Module):
    """A network that takes a picture as others have it, and would answer to ours too."""

    def forward(self, frames, speed_mps):
        return frames.float().mean(dim=(1, 2, 3)) * speed_mps.flatten()


BYTES = torch.zeros(2, 3, 16, 16, dtype=torch.uint8)


@pytest.mark.parametrize(
    ("frames", "speed", "told"),
    [
        (torch.zeros(2, 16, 16, 3), torch.zeros(2), r"frames as floating-point numbers of shape \(any, 16, 16, 3\)"),
        (torch.zeros(2, 1, 16, 16), torch.zeros(2), r"frames as floating-point numbers of shape \(any, 1, 16, 16\)"),
        (BYTES, torch.zeros(2), r"frames as whole numbers of shape \(any, 3, 16, 16\)"),
        (torch.zeros(2, 3, 16, 16), torch.zeros(2, 1), r"speed_mps as floating-point numbers of shape \(any, 1\)"),
    ],
    ids=["channels-last", "grey", "bytes", "columns"],
)
def test_inputs_in_another_shape_or_type_than_they_are_given_are_refused(frames, speed, told, tmp_path):
    export(Other(), (frames, speed), tmp_path / "net.pt2")
    with pytest.raises(ControllerError, match=told):
        load_controller(tmp_path / "net.pt2")


@pytest.mark.parametrize(
    ("kind", "shape", "told"),
    [
        ("FLOAT", ["b", 16, 16, 3], r"floating-point numbers of shape \(any, 16, 16, 3\), expected .* \(b, 3, h, w\)"),
        ("UINT8", ["b", 3, 16, 16], r"whole numbers of shape \(any, 3, 16, 16\), expected floating-point RGB"),
    ],
)
def test_so_are_those_of_onnx(kind, shape, told, tmp_path):
    onnx = pytest.importorskip("onnx", reason="the extra onnx is not installed")
    helper, path = onnx.helper, tmp_path / "net.onnx"
    nodes = [
        helper.make_node("Cast", ["frames"], ["x"], to=onnx.TensorProto.FLOAT),
        helper.make_node("ReduceMean", ["x"], ["y"], axes=[1, 2, 3], keepdims=0),
    ]
    frames = helper.make_tensor_value_info("frames", getattr(onnx.TensorProto, kind), shape)
    steer = helper.make_tensor_value_info("y", onnx.TensorProto.FLOAT, ["b"])
    graph = helper.make_graph(nodes, "graph", [frames], [steer])
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=10), path)
    with pytest.raises(ControllerError, match=told):
        load_controller(path)


DAMAGED = """
import sys
from roadproof.controllers import load_controller
from roadproof.errors import ControllerError
for spec in sys.argv[1:]:
    try:
        load_controller(spec)
        print("loaded")
    except ControllerError as error:
        print(error)
"""


def test_damaged_files_are_one_line_each_and_nothing_on_the_side(program, tmp_path):
    """In a process of its own, whose standard error is all that anybody says."""
    whole = program.read_bytes()
    torch.save(Net().state_dict(), tmp_path / "weights.pt2")
    contents = {"empty": b"", "text": b"no network", "cut": whole[: len(whole) // 2], "other": whole}
    messages = {"pt2": "is not a torch.export file", "onnx": "is not a valid ONNX file", "safetensors": "is damaged"}
    expected = {tmp_path / "weights.pt2": messages["pt2"]}
    for kind, message in messages.items():
        (tmp_path / f"folder.{kind}").mkdir()
        expected[tmp_path / f"folder.{kind}"] = "is a folder, expected a file"
        for name, content in contents.items():
            if (name, kind) != ("other", "pt2"):
                (tmp_path / f"{name}.{kind}").write_bytes(content)
                expected[tmp_path / f"{name}.{kind}"] = message
    done = subprocess.run(
        [sys.executable, "-c", DAMAGED, *map(str, expected)],
        env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    lines = done.stdout.splitlines()
    assert len(lines) == len(expected) == 15
    for (path, message), line in zip(expected.items(), lines, strict=True):
        assert str(path) in line
        assert message in line or ("needs the ONNX reader" in line and path.suffix == ".onnx")


class Several(nn.Module):
    def forward(self, frames):
        return frames.mean(dim=(1, 2, 3)), frames.sum(dim=(1, 2, 3))


class Whole(nn.Module):
    def forward(self, frames):
        return frames.mean()


def test_networks_that_answer_otherwise_are_named(tmp_path):
    export(Several(), inputs()[:1], tmp_path / "several.pt2")
    export(Whole(), inputs()[:1], tmp_path / "whole.pt2")
    for name, message in (
        ("several", r"several\.pt2 answers with a tuple, expected one output: the steering"),
        ("whole", r"answers 3 frames with shape \(\)"),
    ):
        with pytest.raises(ControllerError, match=message):
            load_controller(tmp_path / f"{name}.pt2").steer(*inputs())


def test_frames_of_another_size_name_the_program(program):
    controller = TorchProgram(program, torch.device("cpu"))
    with pytest.raises(ControllerError, match=r"net\.pt2 cannot take shapes \(3, 3, 20, 16\), \(3,\), \(3,\)"):
        controller(*inputs(3, 20, 16))


def test_the_environment_is_as_before_after_loading(program, monkeypatch):
    monkeypatch.delenv("TORCH_FORCE_WEIGHTS_ONLY_LOAD", raising=False)
    load_controller(program)
    assert "TORCH_FORCE_WEIGHTS_ONLY_LOAD" not in os.environ
    monkeypatch.setenv("TORCH_FORCE_WEIGHTS_ONLY_LOAD", "0")
    load_controller(program)
    assert os.environ["TORCH_FORCE_WEIGHTS_ONLY_LOAD"] == "0"


def test_torchscript_and_pickled_networks_are_refused_with_what_to_do(tmp_path):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        torch.jit.script(torch.nn.Linear(2, 1)).save(tmp_path / "net.pt2")
    with pytest.raises(ControllerError, match=r"net\.pt2 is TorchScript, not a torch\.export file; export the Python"):
        load_controller(str(tmp_path / "net.pt2"))
    for suffix in PICKLES:
        with pytest.raises(ControllerError, match=r"may run code when it is opened; .* torch\.export\.save"):
            load_controller(str(tmp_path / f"net{suffix}"))


def test_pickles_in_an_archive_are_not_run(tmp_path):
    class Payload:
        def __reduce__(self):
            return (os.mkdir, (str(tmp_path / "ran"),))

    torch.save(Payload(), tmp_path / "payload")
    with _pickles_refused(), pytest.raises(pickle.UnpicklingError):
        torch.load(tmp_path / "payload", weights_only=False)
    assert not (tmp_path / "ran").exists()


class Steering(nn.Module):
    """CIL's steering alone, as its users would export it."""

    def __init__(self) -> None:
        super().__init__()
        self.cil = CIL(width=0.05, seed=1)

    def forward(self, frames, speed_mps, command):
        return self.cil.steer(frames, speed_mps, command)


@pytest.mark.parametrize(("network", "size"), [(Net(), (16, 16)), (Steering(), (88, 200))], ids=["small", "cil"])
def test_a_network_exported_to_onnx_answers_and_differentiates_as_it(network, size, tmp_path):
    pytest.importorskip("onnxscript", reason="exporting to ONNX needs onnxscript")
    network.eval().requires_grad_(False)
    path, shapes = tmp_path / "net.onnx", ({0: torch.export.Dim("batch")},) * 3
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the exporter's own
        torch.onnx.export(
            network, inputs(3, *size), path, dynamo=True, dynamic_shapes=shapes, external_data=False, verbose=False
        )
    controller = load_controller(path)
    assert controller.input_size == size
    agree(controller, network, inputs(5, *size)[0])
    report = check_controller(controller)
    assert report.passed, report.failures


def test_the_foreign_onnx_file_gets_yuv_by_its_input_name(pilotnet_data):
    controller = load_controller(pilotnet_data / "pilotnet.onnx")
    assert isinstance(controller, SteeringController)
    assert (controller.input_size, controller.preparation.colour) == ((66, 200), "yuv")
    frames = torch.rand(3, 3, 88, 200, generator=torch.Generator().manual_seed(0))
    same = load_controller(f"pilotnet:{pilotnet_data / 'pilotnet.safetensors'}")
    speed, command = torch.zeros(3), torch.full((3,), 2)
    ours = controller.steer(frames[:, :, 15:81], speed, command)
    np.testing.assert_allclose(ours.numpy(), same.steer(frames, speed, command).numpy(), atol=1e-5)
