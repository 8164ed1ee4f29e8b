"""What a stranger's controller raises or answers wrongly is one line, asked from Python."""

import copy
import pickle
from pathlib import Path

import numpy as np
import pytest
import torch

import bad_drivers
from roadproof.controllers import check_controller, load_controller, pilotnet_controller
from roadproof.controllers.asking import act_of, controls_of, frame_size_of, steer_of
from roadproof.controllers.checks import require_usable
from roadproof.datatypes import Control
from roadproof.errors import ControllerError

FRAME = np.full((88, 200, 3), 120, np.uint8)


def batch(count=4, *, gradient=True):
    frames = torch.rand(count, 3, 88, 200, generator=torch.Generator().manual_seed(0))
    return frames.requires_grad_(gradient), torch.full((count,), 6.0), torch.full((count,), 2)


def refused(match, function, *arguments):
    with pytest.raises(ControllerError, match=match) as told:
        function(*arguments)
    message = str(told.value)
    assert "\n" not in message
    assert len(message) < 600
    return told.value


def told_as(name):
    return rf"raised {name} at \S*bad_drivers\.py:\d+"


@pytest.mark.parametrize("name", bad_drivers.STEER_RAISES)
def test_what_steer_raises_is_one_line_with_its_own_file_and_line(name):
    error = refused(f"^the controller's steer {told_as(name)}", steer_of, bad_drivers.STEER_RAISES[name](), *batch())
    assert type(error.__cause__).__name__ == name


@pytest.mark.parametrize("name", bad_drivers.ACT_RAISES)
def test_what_act_raises_is_one_line_with_its_own_file_and_line(name):
    refused(f"^the controller's act {told_as(name)}", act_of, bad_drivers.ACT_RAISES[name](), FRAME, 6.0, 2)


def test_the_line_is_the_one_that_raised():
    lines = Path(bad_drivers.__file__).read_text().splitlines()
    line = next(k for k, text in enumerate(lines, 1) if "the line that is told" in text)
    refused(f":{line}: division by zero$", act_of, bad_drivers.ACT_RAISES["ZeroDivisionError"](), FRAME, 6.0, 2)


def test_ctrl_c_passes():
    with pytest.raises(KeyboardInterrupt):
        act_of(bad_drivers.INTERRUPTED(), FRAME, 6.0, 2)


@pytest.mark.parametrize("name", bad_drivers.STEERS)
def test_a_wrong_answer_of_steer_names_what_came_and_what_was_expected(name):
    refused(
        f"the controller's steer .*{bad_drivers.STEERS_WRONG[name][1]}", steer_of, bad_drivers.STEERS[name](), *batch()
    )


@pytest.mark.parametrize("name", ["detached", "argmax"])
def test_a_gradient_is_asked_for_only_where_one_is_needed(name):
    steer = steer_of(bad_drivers.STEERS[name](), *batch(gradient=False))
    assert steer.shape == (4,)
    with torch.no_grad():
        assert steer_of(bad_drivers.STEERS[name](), *batch()).shape == (4,)


@pytest.mark.parametrize("name", bad_drivers.ACTS)
def test_a_wrong_answer_of_act_names_what_came_and_what_was_expected(name):
    refused(f"^the controller's act {bad_drivers.ACTS_WRONG[name][1]}", act_of, bad_drivers.ACTS[name](), FRAME, 6.0, 2)


def test_numbers_of_other_libraries_become_plain_ones():
    control = act_of(bad_drivers.TENSOR(), FRAME, 6.0, 2)
    assert control == Control(0.25)
    assert type(control.steer) is float


def test_a_network_of_ours_whose_weights_are_broken_is_told_of_as_any_other():
    network = pilotnet_controller()
    with torch.no_grad():
        for each in network.parameters():
            each.mul_(1e30)
    # With the tests' checks of types a line of theirs leads there too.
    refused(r"^the controller's act .*: control \w+ is nan, expected a finite number", act_of, network, FRAME, 6.0, 2)
    failed = [check.name for check in check_controller(network).failures]
    assert {"finite answers", "drives"} <= {*failed}


def test_wrong_pedals_are_named():
    refused(r"controls answered shape \(4, 1\), .* expected .* \(4, 3\), steer, throttle and brake", controls_of,
            bad_drivers.Pedals(), *batch())  # fmt: skip
    report = check_controller(bad_drivers.Pedals())
    assert [check.name for check in report.failures] == ["pedals"]


@pytest.mark.parametrize("name", bad_drivers.SIZES)
def test_a_size_that_is_none_is_named(name):
    refused("the controller's input_size", frame_size_of, bad_drivers.SIZES[name]())
    (check,) = check_controller(bad_drivers.SIZES[name]()).checks
    assert (check.name, check.passed) == ("interface", False)


def test_a_size_that_raises_is_in_the_report():
    (check,) = check_controller(bad_drivers.SIZE_RAISES()).checks
    assert check.name == "interface"
    assert "raised OSError" in check.finding


EVERYTHING_BAD = {
    **{f"steer raises {name}": make for name, make in bad_drivers.STEER_RAISES.items()},
    **{f"act raises {name}": make for name, make in bad_drivers.ACT_RAISES.items()},
    **{f"steers {name}": make for name, make in bad_drivers.STEERS.items()},
    **{f"acts {name}": make for name, make in bad_drivers.ACTS.items()},
    "in place": bad_drivers.InPlace,
    "writes into frames": bad_drivers.WritesIntoFrames,
}


@pytest.mark.parametrize("name", EVERYTHING_BAD)
def test_the_report_says_it_and_never_raises(name):
    report = check_controller(EVERYTHING_BAD[name]())
    assert not report.passed
    names = [check.name for check in report.checks]
    assert names[-1] == "drives", "act is checked whatever steer does"
    assert names.count("drives") == 1
    with pytest.raises(ControllerError) as told:
        report.require()
    assert "\n" not in str(told.value)


@pytest.mark.parametrize("name", EVERYTHING_BAD)
def test_what_is_unusable_is_refused_before_anything_is_driven(name):
    refused("the controller's", lambda: require_usable(EVERYTHING_BAD[name](), size=(88, 200)))


def test_what_drives_alone_is_not_asked_to_act_by_a_search():
    require_usable(bad_drivers.ACT_RAISES["NotImplementedError"](), size=(88, 200), drives=False)
    refused(
        "takes frames of 200×88, here they have 200×66", lambda: require_usable(bad_drivers.Honest(), size=(66, 200))
    )


def test_a_gradient_that_reaches_weights_alone_is_refused():
    class Trained(bad_drivers.Honest):
        weight = torch.ones((), requires_grad=True)

        def steer(self, frames, speed_mps, command):
            return self.weight * super().steer(frames.detach(), speed_mps, command)

    said = "no gradient of the controller's steer reaches the frames; compute it in torch"
    refused(said, lambda: require_usable(Trained(), size=(88, 200)))
    assert "gradients" in [check.name for check in check_controller(Trained()).failures]


def test_answers_and_gradients_are_those_of_the_controller_itself():
    controller = pilotnet_controller(seed=1).eval()
    frames, speed, command = batch()
    steer = steer_of(controller, frames, speed, command)
    own = controller.steer(frames, speed, command)
    assert torch.equal(steer, own)
    assert torch.equal(torch.autograd.grad(steer.sum(), frames)[0], torch.autograd.grad(own.sum(), frames)[0])
    frame = np.random.default_rng(0).integers(0, 256, (88, 200, 3), np.uint8)
    assert act_of(controller, frame, 6.0, 2) == controller.act(frame, 6.0, 2)


def test_a_loaded_controller_is_the_users_own_object():
    controller = load_controller("bad_drivers:Honest")
    assert type(controller) is bad_drivers.Honest
    assert type(pickle.loads(pickle.dumps(controller))) is bad_drivers.Honest
    assert type(copy.deepcopy(controller)) is bad_drivers.Honest


@pytest.mark.parametrize(
    ("spec", "match"),
    [
        (
            "bad_drivers:fails",
            r"^bad_drivers:fails raised ZeroDivisionError at \S*bad_drivers\.py:\d+: division by zero$",
        ),
        ("bad_drivers:leaves", r"^bad_drivers:leaves raised SystemExit at \S*bad_drivers\.py:\d+: no licence$"),
        ("bad_drivers:nothing", "returned a NoneType without input_size, steer, act"),
        ("bad_drivers:SIZES", "is {.*, expected a function without arguments"),
        ("bad_drivers:raising", r"^bad_drivers:raising raised TypeError.*missing 1 required positional argument"),
    ],
)
def test_a_factory_that_fails_is_one_line(spec, match):
    refused(match, load_controller, spec)


MODULES = {
    "raises": (
        "x = 1\ny = x / 0\n",
        r"the import of own_raises raised ZeroDivisionError at own_raises\.py:2: div",
    ),
    "grammar": (
        "x = 1\ndef f(:\n",
        r"the import of own_grammar raised SyntaxError at own_grammar\.py:2: invalid",
    ),
    "exits": ("import sys\nsys.exit(3)\n", r"the import of own_exits raised SystemExit at own_exits\.py:2: 3$"),
    "lacks": (
        "import no_such_thing\n",
        r"raised ModuleNotFoundError at own_lacks\.py:1: No module",
    ),
    "deep": ("def f():\n    f()\nf()\n", r"raised RecursionError at own_deep\.py:2: maximum recursion"),
    "loads": (
        "from roadproof.controllers import load_controller\nload_controller('none.safetensors')\n",
        r"the import of own_loads failed at own_loads\.py:2: controller file none\.safetensors does not exist",
    ),
}


@pytest.mark.parametrize("name", MODULES)
def test_a_module_that_fails_is_one_line(name, tmp_path, monkeypatch):
    text, match = MODULES[name]
    (tmp_path / f"own_{name}.py").write_text(text)
    monkeypatch.chdir(tmp_path)
    refused(match, load_controller, f"own_{name}:make")


def test_what_a_property_raises_while_loading_is_one_line(tmp_path, monkeypatch):
    (tmp_path / "own_property.py").write_text(
        "class C:\n    @property\n    def input_size(self):\n        raise OSError('no camera')\n"
        "    def steer(self, *_): ...\n    def act(self, *_): ...\n"
    )
    monkeypatch.chdir(tmp_path)
    refused(r"^own_property:C raised OSError at own_property\.py:4: no camera$", load_controller, "own_property:C")


def test_an_installed_controller_is_told_by_the_first_line_of_its_package(tmp_path, monkeypatch):
    place = tmp_path / "site-packages"
    place.mkdir()
    (place / "installed_driver.py").write_text("import torch\ndef make():\n    return torch.nn.Linear(-1, 2)\n")
    monkeypatch.syspath_prepend(place)
    refused(r"raised RuntimeError at \S*installed_driver\.py:3: ", load_controller, "installed_driver:make")
