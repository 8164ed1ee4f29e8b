"""Honest controllers pass; each broken one is caught by the check that is about it."""

import numpy as np
import pytest
import torch
from markupsafe import escape
from torch import nn

from roadproof.controllers import CIL, ControllerReport, check_controller, pilotnet_controller
from roadproof.datatypes import Control
from roadproof.errors import ControllerError, DeviceError


class Linear:
    """An honest controller of nine lines, without torch.nn."""

    input_size = (6, 8)

    def __init__(self):
        self.weights = torch.randn(3, 6, 8, generator=torch.Generator().manual_seed(0))

    def steer(self, frames, speed_mps, command):
        return (frames * self.weights).mean(dim=(1, 2, 3)) + 0.01 * speed_mps

    def act(self, frame, speed_mps, command):
        frames = torch.tensor(frame).permute(2, 0, 1)[None] / 255
        return Control(float(self.steer(frames, torch.tensor([speed_mps]), None)))


class Raising(Linear):
    def steer(self, frames, speed_mps, command):
        raise ValueError("out of order")


class ThreeAnswers(Linear):
    def steer(self, frames, speed_mps, command):
        return super().steer(frames, speed_mps, command)[:, None].expand(-1, 3)


class Blocked(Linear):
    def steer(self, frames, speed_mps, command):
        return super().steer(frames.detach(), speed_mps, command)


class Rounded(Linear):
    def steer(self, frames, speed_mps, command):
        return super().steer((frames * 255).round() / 255, speed_mps, command)


class Stochastic(Linear):
    def __init__(self):
        super().__init__()
        self.generator = torch.Generator().manual_seed(0)

    def steer(self, frames, speed_mps, command):
        kept = torch.rand(frames.shape, generator=self.generator) < 0.5
        return super().steer(frames * kept, speed_mps, command)


class Mixing(Linear):
    def steer(self, frames, speed_mps, command):
        return super().steer(frames - frames.mean(dim=0, keepdim=True), speed_mps, command)


class Broken(Linear):
    def steer(self, frames, speed_mps, command):
        return super().steer(frames, speed_mps, command) / (command - 4)


class InfiniteSlope(Linear):
    def steer(self, frames, speed_mps, command):
        return super().steer(frames, speed_mps, command) + (frames - frames).pow(2).sum(dim=(1, 2, 3)).sqrt()


class Scribbling(Linear):
    def steer(self, frames, speed_mps, command):
        if not frames.requires_grad:
            frames *= 0.5
            return super().steer(frames * 2, speed_mps, command)
        return super().steer(frames, speed_mps, command)


class Reckless(Linear):
    def act(self, frame, speed_mps, command):
        return Control(steer=3.0)


@pytest.mark.parametrize("make", [Linear, lambda: CIL(width=0.1).eval(), lambda: pilotnet_controller().eval()])
def test_honest_controllers_pass(make):
    report = check_controller(make())
    assert report.passed, report.failures
    assert len(report.checks) == 8 + hasattr(make(), "controls")
    report.require()


@pytest.mark.parametrize(
    ("broken", "check"),
    [
        (Raising, "answers"),
        (ThreeAnswers, "answers"),
        (Blocked, "gradients"),
        (Rounded, "gradients"),
        (Stochastic, "determinism"),
        (Mixing, "batch consistency"),
        (Broken, "finite answers"),
        (InfiniteSlope, "finite gradients"),
        (Scribbling, "frames untouched"),
        (Reckless, "drives"),
    ],
)
def test_each_broken_controller_is_caught_by_its_check(broken, check):
    report = check_controller(broken())
    assert check in [failure.name for failure in report.failures]
    with pytest.raises(ControllerError, match=check) as refusal:
        report.require()
    assert "\n" not in str(refusal.value)


def test_a_network_left_in_training_mode_is_caught():
    with torch.random.fork_rng(devices=[]):
        failures = [failure.name for failure in check_controller(CIL(width=0.1).train()).failures]
    assert {"determinism", "batch consistency"} <= set(failures)


def test_something_that_is_no_controller_is_told_what_it_lacks():
    report = check_controller(nn.Linear(2, 2))
    assert [failure.name for failure in report.failures] == ["interface"]
    assert "input_size, steer, act" in report.failures[0].finding


def test_a_controller_of_any_size_needs_a_size():
    controller = Linear()
    controller.input_size = None
    with pytest.raises(ControllerError, match="any size"):
        check_controller(controller)
    assert check_controller(controller, size=(6, 8)).passed


@pytest.mark.parametrize(
    ("given", "error", "told"),
    [
        ({"device": "foo"}, DeviceError, "foo"),
        ({"size": (0, 0)}, ControllerError, r"size is \(0, 0\), expected a height and a width"),
    ],
)
def test_no_device_and_no_size_are_told_in_one_line(given, error, told):
    with pytest.raises(error, match=told) as refused:
        check_controller(Linear(), **given)
    assert "\n" not in str(refused.value)


def test_a_report_survives_its_file_and_shows_what_to_do(tmp_path):
    report = check_controller(ThreeAnswers())
    report.save(tmp_path / "report.json")
    assert ControllerReport.load(tmp_path / "report.json") == report
    shown = report._repr_html_()
    assert shown.count("<tr>") == 1 + len(report.checks)
    assert all(str(escape(check.advice)) in shown for check in report.failures)
    (tmp_path / "report.json").write_text("{}")
    with pytest.raises(ControllerError, match=r"report\.json"):
        ControllerReport.load(tmp_path / "report.json")


def test_the_same_seed_gives_the_same_report():
    assert check_controller(Broken(), seed=1) == check_controller(Broken(), seed=1)


def test_global_random_state_is_left_alone():
    state, numbers = torch.random.get_rng_state(), np.random.get_state()[1].copy()  # noqa: NPY002
    check_controller(Linear())
    assert torch.equal(torch.random.get_rng_state(), state)
    assert (np.random.get_state()[1] == numbers).all()  # noqa: NPY002
