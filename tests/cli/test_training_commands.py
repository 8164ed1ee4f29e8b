"""`roadproof controllers`, `check-controller` and `train` as their users call them."""

import dataclasses
import sys

import pytest

import needs
from command import answered
from roadproof.controllers import CIL, load_controller, model_card, shipped_names
from roadproof.scenarios import find_scenario, save_scenarios


@pytest.fixture
def short(tmp_path):
    """Two scenarios in whose time nobody arrives."""
    easy, bend = (find_scenario(name) for name in ("straight-02", "left-11"))
    save_scenarios([dataclasses.replace(one, time_limit_s=0.5) for one in (easy, bend)], tmp_path / "short.toml")
    return tmp_path / "short.toml"


def test_every_shipped_controller_is_listed(invoke):
    code, printed = invoke("controllers")
    assert code == 0, printed.err
    for name in shipped_names():
        assert name in printed.out.split()


def test_a_card_is_shown_whole(invoke):
    code, printed = invoke("controllers", "cil")
    assert code == 0, printed.err
    for text in (model_card("cil").cannot, model_card("cil").data):
        assert " ".join(text.split()) in " ".join(printed.out.split())


def test_without_the_large_weights_cards_are_shown_with_what_to_install(invoke, monkeypatch):
    monkeypatch.setitem(sys.modules, "roadproof_cil", None)
    code, printed = invoke("controllers")
    assert code == 0, printed.err
    assert printed.out.count("not installed  ") == 3
    assert "The weights of cil, cil-hardened, cil-small are not installed: pip install 'roadproof[cil]'" in printed.out
    code, printed = invoke("controllers", "cil")
    assert code == 0
    assert " ".join(model_card("cil").cannot.split()) in " ".join(printed.out.split())
    assert printed.out.endswith("\nThe weights of cil are not installed: pip install 'roadproof[cil]'\n")
    code, printed = invoke("controllers", "cil", "--json")
    assert code == 0
    assert [each["megabytes"] for each in answered(printed.out)["controllers"]] == [None]


@pytest.mark.parametrize(
    "words",
    [
        ["check-controller", "cil", "--no-drive"],
        ["drive", "--controller", "cil"],
        ["train", "--start", "cil"],
        ["demo", "--controller", "cil"],
    ],
)
def test_without_the_large_weights_whatever_needs_them_is_one_line(invoke, tmp_path, monkeypatch, words):
    monkeypatch.setitem(sys.modules, "roadproof_cil", None)
    if words[0] != "check-controller":
        words = [*words, "--out", tmp_path / "out"]
    code, printed = invoke(*words)
    said = "the controller 'cil' needs its weights, which are not installed: pip install 'roadproof[cil]'"
    assert (code, printed.err) == (2, f"roadproof: {said}\n")
    assert not (tmp_path / "out" / "drives").exists()


def test_an_unknown_controller_is_one_line(invoke):
    for command in ("controllers", "check-controller"):
        code, printed = invoke(command, "cill")
        assert code == 2
        assert printed.err == "roadproof: no controller called 'cill' comes with roadproof; did you mean 'cil'?\n"


def test_promises_are_checked_without_driving(invoke):
    code, printed = invoke("check-controller", "cil", "--no-drive")
    assert code == 0, printed.err
    assert "ok  gradients" in printed.out
    assert "scenarios clean" not in printed.out


def test_scenarios_that_are_not_clean_are_named(invoke, short):
    needs.town()
    code, printed = invoke("check-controller", "cil", "--scenarios", short, "--processes", 1, "--json")
    assert code == 0, printed.err
    assert "0 of 2 scenarios clean" in printed.err
    assert "left-11: did not arrive" in printed.err
    told = answered(printed.out)
    assert told["passed"] is True
    drives = [(each["scenario"], each["clean"], each["arrived"]) for each in told["drives"]]
    assert drives == [("left-11", False, False), ("straight-02", False, False)]


def test_a_controller_is_trained_from_the_command_line(invoke, tmp_path):
    needs.town()
    options = ["--out", tmp_path, "--width", 0.05, "--drives", 1, "--samples", 128, "--rounds", 0, "--processes", 1]
    code, printed = invoke("train", *options, "--collect-only")
    assert code == 0, printed.err
    assert "1 drives in" in printed.out
    code, printed = invoke("train", *options)
    assert code == 0, printed.err
    assert "check-controller" in printed.out
    assert isinstance(load_controller(tmp_path / "cil.safetensors"), CIL)
    code, printed = invoke("train", *options[:-2], "--seed", 3)
    assert code == 2
    assert "holds a training with seed 0, now it is 3" in printed.err


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--network", "resnet"], "network is 'resnet', expected one of cil, pilotnet, waypoint"),
        (["--drives", "0"], "--drives is 0, expected 1 to"),
        (["--samples", "5"], "5 samples are less than one batch of 128"),
        (["--start", "none.safetensors"], "none.safetensors does not exist"),
    ],
)
def test_mistakes_are_one_line_before_anything_is_driven(invoke, tmp_path, options, message):
    code, printed = invoke("train", "--out", tmp_path / "out", *options)
    assert code == 2
    assert message in printed.err
    assert printed.err.count("\n") == 1
    assert not (tmp_path / "out" / "drives").exists()
