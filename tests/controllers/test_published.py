"""The converter of the published CIL checkpoint against a forward pass in plain numpy that shares no code with it."""

import sys
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from numpy.lib.stride_tricks import sliding_window_view
from safetensors import safe_open
from safetensors.torch import load_file

from published_checkpoint import DENSE_AND_BIASES, KERNELS, made_up_checkpoint
from roadproof.controllers import check_controller, convert_cil, load_controller
from roadproof.controllers.cards import read_card
from roadproof.controllers.weights_file import load_network
from roadproof.errors import ControllerError, OutputError

STRIDES = (2, 1, 2, 1, 2, 1, 1, 1)
BRANCH_OF = {0: 0, 2: 0, 3: 2, 4: 3, 5: 1, 1: 1}
LAYERS_OF = {0: (6, 7, 8), 1: (9, 10, 11), 2: (12, 13, 14), 3: (15, 16, 17), 4: (18, 19, 20)}


class NumpyAgent:
    """The published network and agent, written in NHWC and float64 from their description."""

    def __init__(self, held: dict[str, np.ndarray]) -> None:
        self.held = {name: values.astype(np.float64) for name, values in held.items()}

    def dense(self, number: int, x: np.ndarray) -> np.ndarray:
        name = f"W_f_{number}"
        return x @ self.held[name] + self.held[DENSE_AND_BIASES[name][1]]

    def image(self, frame: np.ndarray) -> np.ndarray:
        x = frame / 255.0
        for layer, (name, stride) in enumerate(zip(KERNELS, STRIDES, strict=True)):
            kernel = self.held[name]
            size = kernel.shape[0]
            windows = sliding_window_view(x, (size, size), axis=(0, 1))[::stride, ::stride]  # rows, columns, in, i, j
            x = np.einsum("rcnij,ijno->rco", windows, kernel, optimize=True)
            x = x + self.held[f"Network/conv_block{layer}/Variable"]
            mean, variance = (self.held[f"bn{layer + 1}/moving_{what}"] for what in ("mean", "variance"))
            x = np.maximum((x - mean) / np.sqrt(variance + 0.001) + self.held[f"bn{layer + 1}/beta"], 0)
        assert x.shape == (2, 16, 256)
        for number in (1, 2):
            x = np.maximum(self.dense(number, x.reshape(-1)), 0)
        return x

    def head(self, branch: int, x: np.ndarray) -> np.ndarray:
        first, second, last = LAYERS_OF[branch]
        return self.dense(last, np.maximum(self.dense(second, np.maximum(self.dense(first, x), 0)), 0))

    def answers(self, image: np.ndarray, speed_mps: float, command: int) -> np.ndarray:
        speed = np.array([speed_mps / 25])
        for number in (3, 4):
            speed = np.maximum(self.dense(number, speed), 0)
        return self.head(BRANCH_OF[command], np.maximum(self.dense(5, np.concatenate([image, speed])), 0))

    @staticmethod
    def applied(answers: np.ndarray, speed_mps: float) -> list[float]:
        """What the simulator makes of the agent's answer: it keeps controls inside their ranges."""
        steer, gas, brake = (float(answer) for answer in answers)
        if brake < 0.1 or gas > brake:
            brake = 0.0
        if speed_mps > 10 and brake == 0:
            gas = 0.0
        return [min(max(steer, -1.0), 1.0), min(max(gas, 0.0), 1.0), min(max(brake, 0.0), 1.0)]


@pytest.fixture(scope="module")
def held():
    return made_up_checkpoint(seed=7)


@pytest.fixture(scope="module")
def archive(held, tmp_path_factory):
    path = tmp_path_factory.mktemp("published") / "cil.npz"
    np.savez(path, **held)
    return path


@pytest.fixture(scope="module")
def converted(archive):
    out = archive.with_name("converted.safetensors")
    convert_cil(archive, out)
    return out


@pytest.fixture(scope="module")
def drive(held):
    """Every frame at every speed under every command: what goes in, and what the numpy agent says."""
    agent = NumpyAgent(held)
    rng = np.random.default_rng(1)
    noise = rng.integers(0, 256, (2, 88, 200, 3), dtype=np.uint8)
    ramp = np.broadcast_to(np.linspace(0, 255, 200)[:, None], (88, 200, 3)).astype(np.uint8)
    frames = [*noise, ramp, ramp[::-1, ::-1] // 3]
    images = [agent.image(frame) for frame in frames]
    asked = [(i, speed, code) for i in range(len(frames)) for speed in (0.0, 4.5, 12.0) for code in BRANCH_OF]
    answers = np.array([agent.answers(images[i], speed, code) for i, speed, code in asked])
    return SimpleNamespace(
        frames=frames,
        asked=asked,
        answers=answers,
        applied=[agent.applied(answer, speed) for answer, (_, speed, _) in zip(answers, asked, strict=True)],
        seen_speeds=[agent.head(4, image)[0] for image in images],
    )


def test_the_made_up_network_answers_differently_to_everything(drive):
    steer = drive.answers[:, 0].reshape(4, 3, 6)
    assert min(steer.std(axis=axis).mean() for axis in range(3)) > 0.02  # frame, speed, command
    assert np.abs(steer).max() > 1  # not clipped
    applied = np.array(drive.applied)
    for pedal in (1, 2):
        assert 0 < (applied[:, pedal] > 0).sum() < len(applied)


def test_the_converted_network_answers_as_the_published_one(converted, drive):
    controller = load_controller(str(converted))
    frames = torch.stack([torch.tensor(np.array(drive.frames[i])) for i, _, _ in drive.asked])
    frames = frames.permute(0, 3, 1, 2).float() / 255
    speed, command = (torch.tensor([one[place] for one in drive.asked]) for place in (1, 2))
    expected = torch.tensor(drive.answers)
    output = controller(frames, speed, command)
    torch.testing.assert_close(output.controls.double(), expected, rtol=0, atol=1e-4)
    torch.testing.assert_close(controller.steer(frames, speed, command).double(), expected[:, 0], rtol=0, atol=1e-4)
    seen = torch.tensor([drive.seen_speeds[i] for i, _, _ in drive.asked])
    torch.testing.assert_close(output.speed.double(), seen, rtol=0, atol=1e-4)


def test_the_converted_controller_drives_as_the_published_agent(converted, drive):
    controller = load_controller(converted)
    for (i, speed, command), expected in zip(drive.asked, drive.applied, strict=True):
        control = controller.act(np.array(drive.frames[i]), speed, command)
        assert (control.steer, control.throttle, control.brake) == pytest.approx(expected, abs=1e-4)


def test_the_card_says_where_the_weights_came_from(converted):
    with safe_open(converted, framework="pt") as file:
        card = read_card(file.metadata()["roadproof"], "header")
    assert (card.architecture, card.width) == ("cil", 1.0)
    assert card.origin == "TensorFlow checkpoint of CARLA's imitation learning agent: cil.npz"


def test_a_converted_controller_keeps_its_promises_and_can_be_trained_on(converted):
    report = check_controller(load_controller(converted))
    assert report.passed, report.failures
    assert not load_network(converted).is_folded


@pytest.mark.parametrize(
    ("name", "change", "said"),
    [
        ("W_c_3", lambda x: x.transpose(3, 2, 0, 1), r"W_c_3 has shape \(64, 32, 3, 3\), expected \(3, 3, 32, 64\)"),
        ("W_f_1", lambda x: x.T, r"W_f_1 has shape \(512, 8192\), expected \(8192, 512\)"),
        ("bn1/beta", lambda x: x[:5], r"bn1/beta has shape \(5,\), expected \(32,\)"),
        ("Network/fc5/Variable", lambda x: np.where(x == x.max(), np.nan, x), "fc5/Variable has NaN or infinite"),
        ("W_f_2", lambda x: x * np.float64(1e60), "W_f_2 has NaN or infinite"),
        ("bn8/moving_variance", lambda x: -x, "bn8/moving_variance has the negative value -"),
        ("W_f_3", lambda x: x.astype(int), "W_f_3 is of type int64, expected floating-point"),
        ("W_c_1", lambda x: x.astype(object), r"is damaged \(W_c_1: it is of type object, expected numbers\)"),
    ],
)  # fmt: skip
def test_wrong_variables_are_named_and_nothing_is_written(held, tmp_path, name, change, said):
    np.savez(tmp_path / "bad.npz", **(held | {name: change(held[name])}))
    with pytest.raises(ControllerError, match=said) as refusal:
        convert_cil(tmp_path / "bad.npz", tmp_path / "out.safetensors")
    assert str(refusal.value).startswith(str(tmp_path / "bad.npz"))
    assert "\n" not in str(refusal.value)
    assert [path.name for path in tmp_path.iterdir()] == ["bad.npz"]


def test_missing_variables_are_named(held, tmp_path):
    lacking = {"bn4/moving_mean", "Network/Speed/fc3/Variable"}
    np.savez(tmp_path / "some.npz", **{name: values for name, values in held.items() if name not in lacking})
    with pytest.raises(ControllerError, match=r"lacks 2 of the 80 variables") as refusal:
        convert_cil(tmp_path / "some.npz", tmp_path / "out.safetensors")
    assert all(name in str(refusal.value) for name in lacking)
    np.savez(tmp_path / "foreign.npz", weights=np.zeros(3))
    with pytest.raises(ControllerError, match=r"foreign.npz lacks 80 of the 80 variables .*: W_c_1, .*, …; expected"):
        convert_cil(tmp_path / "foreign.npz", tmp_path / "out.safetensors")


def test_files_that_are_no_checkpoint_are_refused(tmp_path):
    (tmp_path / "words.npz").write_text("words")
    for name, said in (
        (
            "words.npz",
            r"words\.npz is damaged \(File is not a zip file\); make it where TensorFlow is installed: import",
        ),
        ("none.npz", r"none\.npz is missing; make it where TensorFlow is installed: import"),
        ("none", r"none is no checkpoint: .*none\.index does not exist; expected an \.npz file, or"),
        ("..", r"is no checkpoint: .*\.index does not exist"),
    ):
        with pytest.raises(ControllerError, match=said) as refusal:
            convert_cil(tmp_path / name, tmp_path / "out.safetensors")
        assert "\n" not in str(refusal.value)


def test_an_existing_file_is_replaced_only_where_asked(archive, converted, tmp_path):
    out = tmp_path / "out.safetensors"
    out.write_text("mine")
    with pytest.raises(OutputError, match=r"out\.safetensors exists already"):
        convert_cil(archive, out)
    assert out.read_text() == "mine"
    convert_cil(archive, out, overwrite=True)
    assert out.read_bytes() == converted.read_bytes()
    with pytest.raises(OutputError, match=r"out\.bin, expected a name that ends in \.safetensors"):
        convert_cil(archive, tmp_path / "out.bin")


def absence_of_tensorflow(monkeypatch, checkpoint):
    """What is said of a checkpoint where TensorFlow is not installed."""
    with monkeypatch.context() as patch:
        patch.setitem(sys.modules, "tensorflow", None)
        with pytest.raises(ControllerError) as refusal:
            convert_cil(checkpoint, checkpoint.with_name("out.safetensors"))
    return str(refusal.value)


def test_without_tensorflow_one_line_says_how_to_make_the_archive(monkeypatch, tmp_path):
    (tmp_path / "model.ckpt-450000.index").touch()
    said = absence_of_tensorflow(monkeypatch, tmp_path / "model.ckpt-450000")
    assert "needs TensorFlow, which cannot be imported (" in said
    assert "); where it can, make an .npz file and give that instead: import numpy" in said
    assert "tf.train.load_checkpoint('model.ckpt-450000')" in said
    assert "\n" not in said


@pytest.mark.filterwarnings("ignore")  # what TensorFlow says while it is imported is its own
def test_a_tensorflow_checkpoint_and_the_archive_made_of_it_give_the_same_weights(
    held, converted, monkeypatch, tmp_path
):
    tensorflow = pytest.importorskip("tensorflow", reason="TensorFlow, which reads its checkpoints, is not installed")
    names, prefix = list(held), tmp_path / "model.ckpt-450000"

    def save(chosen):
        tensorflow.raw_ops.SaveV2(
            prefix=str(prefix),
            tensor_names=chosen,
            shape_and_slices=[""] * len(chosen),
            tensors=[tensorflow.constant(held[name]) for name in chosen],
        )

    save(names)
    convert_cil(prefix, tmp_path / "direct.safetensors")
    monkeypatch.chdir(tmp_path)
    exec(absence_of_tensorflow(monkeypatch, prefix).split("instead: ")[1], {})
    convert_cil(tmp_path / "cil.npz", tmp_path / "by-way-of-npz.safetensors")
    for name in ("direct", "by-way-of-npz"):
        torch.testing.assert_close(load_file(tmp_path / f"{name}.safetensors"), load_file(converted), rtol=0, atol=0)

    save([name for name in names if name != "bn4/moving_mean"])
    with pytest.raises(ControllerError, match=r"lacks 1 of the 80 variables of the published CIL: bn4/moving_mean;"):
        convert_cil(prefix, tmp_path / "out.safetensors")
    save(names)
    data = tmp_path / "model.ckpt-450000.data-00000-of-00001"
    data.write_bytes(data.read_bytes()[:1000])
    with pytest.raises(ControllerError, match="is not a TensorFlow checkpoint or is damaged: ") as refusal:
        convert_cil(prefix, tmp_path / "out.safetensors")
    assert "\n" not in str(refusal.value)
    assert not (tmp_path / "out.safetensors").exists()
