"""Specs: every kind loads and answers as the network it was made from; every mistake gets one clear line."""

import sys

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from roadproof.controllers import (
    CIL,
    CruiseControl,
    FramePreparation,
    SteeringController,
    check_controller,
    load_controller,
    pilotnet_controller,
    save_controller,
)
from roadproof.controllers.loading import files_of, load_trainable, runs_code
from roadproof.errors import ControllerError, DeviceError


def drive(height: int = 88, width: int = 200) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    frames = torch.rand(4, 3, height, width, generator=torch.Generator().manual_seed(0))
    return frames, torch.tensor([0.0, 3.0, 6.0, 9.0]), torch.tensor([2, 3, 4, 5])


def test_cil_is_saved_and_loaded_folded_and_frozen(cil, tmp_path):
    save_controller(cil, str(tmp_path / "new" / "cil.safetensors"))
    loaded = load_controller(tmp_path / "new" / "cil.safetensors")
    assert isinstance(loaded, CIL)
    assert (loaded.width, loaded.is_folded, loaded.training) == (0.1, True, False)
    assert not any(parameter.requires_grad for parameter in loaded.parameters())
    torch.testing.assert_close(loaded.steer(*drive()), cil.steer(*drive()).detach(), rtol=1e-4, atol=1e-6)
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["cil.safetensors"]


def test_pilotnet_keeps_its_activation_preparation_and_speed(tmp_path):
    preparation = FramePreparation(frame_size=(160, 320), rows=(60, 135), network_size=(66, 200), colour="rgb")
    saved = pilotnet_controller(
        activation="relu", preparation=preparation, cruise=CruiseControl(target_mps=9.0), seed=2
    )
    save_controller(saved, tmp_path / "p.safetensors")
    loaded = load_controller(tmp_path / "p.safetensors")
    assert isinstance(loaded, SteeringController)
    assert (loaded.preparation, loaded.cruise) == (preparation, CruiseControl(target_mps=9.0))
    torch.testing.assert_close(loaded.steer(*drive(160, 320)), saved.steer(*drive(160, 320)).detach())


def test_a_spec_may_name_the_architecture_of_bare_weights(pilotnet_data):
    controller = load_controller(f"pilotnet:{pilotnet_data / 'pilotnet.safetensors'}")
    assert controller.input_size == (88, 200)
    report = check_controller(controller)
    assert report.passed, report.failures


@pytest.mark.parametrize(("dtype", "tolerance"), [("float64", 1e-5), ("bfloat16", 0.03)])
def test_other_precisions_answer_alike_in_the_dtype_of_the_frames(cil, tmp_path, dtype, tolerance):
    save_controller(cil, tmp_path / "cil.safetensors")
    loaded = load_controller(tmp_path / "cil.safetensors", dtype=dtype)
    steer = loaded.steer(*drive())
    assert steer.dtype == torch.float32
    torch.testing.assert_close(steer, cil.steer(*drive()).detach(), rtol=0.0, atol=tolerance)
    assert check_controller(loaded, tolerance=tolerance).passed


def test_a_network_with_convolutions_over_time_is_loaded(tmp_path, monkeypatch):
    (tmp_path / "over_time.py").write_text(
        "from torch import nn\n"
        "from roadproof.controllers import CIL\n"
        "class OverTime(CIL):\n"
        "    def __init__(self):\n"
        "        super().__init__(width=0.1)\n"
        "        self.over_time = nn.Conv3d(3, 3, 3, padding=1)\n"
        "    def folded(self):\n        return self\n"
    )
    monkeypatch.chdir(tmp_path)
    assert load_controller("over_time:OverTime").over_time.weight.ndim == 5


def test_a_users_own_convolution_may_look_at_its_weights_in_their_order(tmp_path, monkeypatch):
    (tmp_path / "standardised.py").write_text(
        "from torch import nn\n"
        "from roadproof.controllers import CIL\n"
        "class Standardised(nn.Conv2d):\n"
        "    def forward(self, x):\n"
        "        rows = self.weight.view(len(self.weight), -1)\n"
        "        rows = rows / rows.std(1, keepdim=True)\n"
        "        return self._conv_forward(x, rows.view_as(self.weight), self.bias)\n"
        "class Standard(CIL):\n"
        "    def __init__(self):\n"
        "        super().__init__(width=0.1)\n"
        "        self.first = Standardised(3, 3, 3, padding=1)\n"
        "    def folded(self):\n        return self\n"
        "    def image_feature(self, frames):\n        return super().image_feature(self.first(frames))\n"
    )
    monkeypatch.chdir(tmp_path)
    controller = load_controller("standardised:Standard")
    assert controller.steer(*drive()).isfinite().all()
    assert controller.convolutions[0][0].weight.is_contiguous(memory_format=torch.channels_last), (
        "torch's own are faster"
    )


SHARED = """
import torch
from torch import nn
class Shared(nn.Module):
    input_size = None
    def __init__(self):
        super().__init__()
        self.fixed, self.scale = nn.Linear(3, 3), nn.Parameter(torch.tensor(1.1234567))
        self.fixed.requires_grad_(False)
    def steer(self, frames, speed_mps, command):
        return self.scale * self.fixed(frames.mean((2, 3)).to(self.scale.dtype)).sum(1).to(frames.dtype)
    def act(self, frame, speed_mps, command):
        raise NotImplementedError
ONE = Shared()
def make():
    return ONE
class Normed(Shared):
    def __init__(self):
        super().__init__()
        self.fixed = torch.nn.utils.weight_norm(nn.Linear(3, 3))
OTHER = Normed()
class Wrapper(nn.Module):
    input_size, act = None, Shared.act
    def __init__(self):
        super().__init__()
        self.inner = ONE
    def steer(self, frames, speed_mps, command):
        return self.inner.steer(frames, speed_mps, command)
def normed():
    return OTHER
"""


@pytest.fixture
def held(tmp_path, monkeypatch):
    """Writes the module of shared networks, and gives a controller that somebody holds, with its answer."""
    monkeypatch.chdir(tmp_path)

    def hold(spec):
        (tmp_path / f"{spec.partition(':')[0]}.py").write_text(SHARED)
        before = load_controller(spec)
        return before, before.steer(*drive()).clone()

    return hold


@pytest.mark.filterwarnings("ignore:.*weight_norm.*:FutureWarning")
def test_one_object_of_a_factory_is_not_changed_under_another_that_holds_it(held, tmp_path):
    before, answer = held("shared_driver:make")
    tuned = load_trainable("shared_driver:make")
    assert [name for name, each in tuned.named_parameters() if each.requires_grad] == ["scale"], "the rest stays frozen"
    with torch.no_grad():
        tuned.scale += 1.0
    save_file(dict(tuned.state_dict()), tmp_path / "tuned.safetensors")
    after = load_controller(f"shared_driver:make@{tmp_path / 'tuned.safetensors'}")
    load_controller("shared_driver:make", dtype="bfloat16")
    assert torch.equal(before.steer(*drive()), answer)
    assert not torch.allclose(after.steer(*drive()), answer)
    # Torch cannot copy this one: a new one each time it can use, the same one it cannot.
    assert [name for name, _ in load_trainable("shared_driver:Normed").named_parameters()]
    with pytest.raises(ControllerError, match=r"copying what shared_driver:normed returns each time \(let it return a"):
        load_trainable("shared_driver:normed")


@pytest.mark.filterwarnings("ignore:.*weight_norm.*:FutureWarning")
def test_a_new_wrapper_around_the_same_network_is_no_new_one(held):
    before, answer = held("wrapped_driver:Wrapper")
    learner = load_trainable("wrapped_driver:Wrapper")
    assert [name for name, each in learner.named_parameters() if each.requires_grad] == ["inner.scale"]
    with torch.no_grad():
        learner.inner.scale += 1.0
    load_controller("wrapped_driver:Wrapper", dtype="bfloat16")
    assert torch.equal(before.steer(*drive()), answer)
    assert all(each.requires_grad == (name == "inner.scale") for name, each in learner.named_parameters())


def test_what_no_weights_file_holds_is_said_before_anything_learns(tmp_path, monkeypatch):
    (tmp_path / "keeps_more.py").write_text(
        "from roadproof.controllers import CIL\n"
        "class KeepsMore(CIL):\n"
        "    def __init__(self):\n        super().__init__(width=0.1)\n"
        "    def get_extra_state(self):\n        return {}\n"
    )
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ControllerError, match=r"KeepsMore keeps _extra_state beside its tensors"):
        load_trainable("keeps_more:KeepsMore")


@pytest.mark.parametrize(
    ("spec", "runs"),
    [
        ("my_driver:make", True),
        ("pack.my_driver:make@net.safetensors", True),
        ("net.pt2", True),
        ("2026-11-29T10:30:00/net.safetensors", False),
        ("pilotnet:net.safetensors", False),
        ("pilotnet", False),
    ],
)
def test_what_runs_its_authors_code_is_known_by_its_spec(spec, runs):
    assert runs_code(spec) is runs


def test_a_factory_is_found_in_the_current_directory(tmp_path, monkeypatch):
    (tmp_path / "my_driver.py").write_text(
        "from roadproof.controllers import CIL\n"
        "def make():\n    return CIL(width=0.1, seed=9)\n"
        "class Nested:\n    make = staticmethod(make)\n"
        "def wrong():\n    return 3\n"
        "value = 4\n"
    )
    monkeypatch.chdir(tmp_path)
    before = list(sys.path)
    for spec in ("my_driver:make", "my_driver:Nested.make"):
        controller = load_controller(spec)
        assert isinstance(controller, CIL)
        assert not controller.training
        torch.testing.assert_close(controller.steer(*drive()), CIL(width=0.1, seed=9).eval().steer(*drive()).detach())
    for spec, message in (
        ("my_driver:wrong", "returned a int without input_size, steer, act"),
        ("my_driver:value", "is 4, expected a function"),
        ("my_driver:other", "cannot import my_driver:other"),
        ("no_such_module:make", "No module named 'no_such_module'"),
    ):
        with pytest.raises(ControllerError, match=message):
            load_controller(spec)
    assert sys.path == before


def test_what_a_users_module_adds_to_the_path_stays_and_the_current_directory_goes(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    (tmp_path / "adds_a_folder.py").write_text(
        "import sys\n"
        "from roadproof import load_controller\n"
        "sys.path.append('/nowhere/of/theirs')\n"
        "def make():\n    return load_controller('pilotnet')\n"
    )
    before = list(sys.path)
    load_controller("adds_a_folder:make")
    assert sys.path == [*before, "/nowhere/of/theirs"]


def test_a_factory_is_given_other_weights_and_learns_unmerged(tmp_path, monkeypatch):
    (tmp_path / "small_driver.py").write_text(
        "from roadproof.controllers import CIL\none = CIL(width=0.1, seed=9)\ndef make():\n    return one\n"
    )
    monkeypatch.chdir(tmp_path)
    other = CIL(width=0.1, seed=3).eval()
    save_file(other.state_dict(), tmp_path / "other.safetensors")
    spec = f"small_driver:make@{tmp_path / 'other.safetensors'}"
    torch.testing.assert_close(load_controller(spec).steer(*drive()), other.steer(*drive()).detach())
    learner = load_trainable(spec)
    assert not learner.is_folded
    assert not learner.training
    assert all(each.requires_grad for each in learner.parameters())
    # The factory gives the same object every time: who learns has a copy.
    assert learner is not load_trainable(spec)
    save_file({"image.0.bias": torch.zeros(3)}, tmp_path / "few.safetensors")
    with pytest.raises(ControllerError, match=r"few\.safetensors (lacks|has an unexpected) tensor"):
        load_controller(f"small_driver:make@{tmp_path / 'few.safetensors'}")
    with pytest.raises(ControllerError, match=r"none\.safetensors does not exist"):
        load_controller("small_driver:make@none.safetensors")


def test_the_files_of_a_controller_are_known_whatever_they_are_called(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("weights", "net.safetensors", "pilotnet", "made.py"):
        (tmp_path / name).write_bytes(b"")
    found = {
        "cil:weights": ["weights"],
        "cil:net.safetensors": ["net.safetensors"],
        "made:make@weights": ["made.py", "weights"],
        "pilotnet": [],
    }
    assert {spec: [path.name for path in files_of(spec)] for spec in found} == found


@pytest.mark.parametrize(
    ("name", "counts"), [("weights", True), ("parts/0", True), ("../other.bin", False), (None, False)]
)
def test_external_data_of_an_onnx_file_are_its_files_where_they_lie_in_its_folder(tmp_path, name, counts):
    onnx = pytest.importorskip("onnx", reason="the extra onnx is not installed")
    path = tmp_path / "own" / "net.onnx"
    data = path.parent / (name or tmp_path / "absolute.bin")
    (path.parent / "parts").mkdir(parents=True)
    data.write_bytes(b"numbers")
    held = onnx.numpy_helper.from_array(np.zeros(3, np.float32), "w")
    onnx.external_data_helper.set_external_data(held, name or str(data))
    output = onnx.helper.make_tensor_value_info("w", onnx.TensorProto.FLOAT, [3])
    path.write_bytes(
        onnx.helper.make_model(onnx.helper.make_graph([], "graph", [], [output], [held])).SerializeToString()
    )
    assert files_of(str(path)) == ((path, data) if counts else (path,))


def test_frozen_parameters_of_a_factory_stay_frozen_and_weights_files_learn_whole(tmp_path, monkeypatch, cil):
    (tmp_path / "frozen_driver.py").write_text(
        "from roadproof.controllers import CIL\n"
        "def make():\n    net = CIL(width=0.1)\n    net.convolutions.requires_grad_(False)\n    return net\n"
    )
    monkeypatch.chdir(tmp_path)
    learner = load_trainable("frozen_driver:make")
    assert not any(each.requires_grad for each in learner.convolutions.parameters())
    assert all(each.requires_grad for each in learner.image.parameters())
    save_controller(cil, tmp_path / "cil.safetensors")
    learner = load_trainable(str(tmp_path / "cil.safetensors"))
    assert not learner.is_folded
    assert all(each.requires_grad for each in learner.parameters())


def test_an_error_inside_a_factory_is_not_hidden(tmp_path, monkeypatch):
    (tmp_path / "my_broken_driver.py").write_text("def make():\n    return 1 / 0\n")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ControllerError, match=r"^my_broken_driver:make raised ZeroDivisionError at my_broken") as told:
        load_controller("my_broken_driver:make")
    assert isinstance(told.value.__cause__, ZeroDivisionError)


def test_an_unknown_name_is_told_what_comes_with_the_package():
    with pytest.raises(ControllerError, match="no controller called 'nonsense' comes with roadproof"):
        load_controller("nonsense")


@pytest.mark.parametrize("spec", ["", "Nonsense", "net.h5", "pilotnet:", "a b:c", "https://x.org/net"])
def test_an_unknown_spec_lists_what_exists(spec):
    with pytest.raises(
        ControllerError, match=r"expected the name of a shipped one.*FILE\.safetensors, cil:FILE.*module:factory"
    ) as refusal:
        load_controller(spec)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize("name", ["net.safetensors", "cil:net.safetensors", "net.onnx", "net.pt2"])
def test_a_missing_file_is_named(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ControllerError, match=r"controller file net\.\w+ does not exist"):
        load_controller(name)


def test_devices_and_precisions_that_are_not_there_are_refused(cil, tmp_path):
    save_controller(cil, tmp_path / "cil.safetensors")
    for device, message in (
        (f"cuda:{torch.cuda.device_count()}", "is not there: this torch sees"),
        ("gpu", "'gpu' is unknown"),
        ("meta", "'meta' is not supported"),
    ):
        with pytest.raises(DeviceError, match=message):
            load_controller(tmp_path / "cil.safetensors", device=device)
    with pytest.raises(DeviceError, match="dtype tf32 is how GPUs multiply, cpu does not; use float32"):
        load_controller(tmp_path / "cil.safetensors", dtype="tf32")
    with pytest.raises(DeviceError, match="dtype 'int8' is unknown, expected one of float32"):
        load_controller(tmp_path / "cil.safetensors", dtype="int8")


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="this torch sees no CUDA device")
def test_on_the_gpu_it_answers_as_on_the_cpu(cil, pilotnet_data, tmp_path):
    save_controller(cil, tmp_path / "cil.safetensors")
    specs = (tmp_path / "cil.safetensors", f"pilotnet:{pilotnet_data / 'pilotnet.safetensors'}")
    for spec in (*specs, pilotnet_data / "pilotnet.onnx"):
        there, here = load_controller(spec, device="cuda"), load_controller(spec)
        batch = drive(*(here.input_size or (88, 200)))
        steer = there.steer(*(value.to("cuda") for value in batch))
        torch.testing.assert_close(steer.cpu(), here.steer(*batch), rtol=0.0, atol=5e-3)
        assert check_controller(there, device="cuda", tolerance=5e-3).passed
