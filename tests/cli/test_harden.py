"""`roadproof harden` as its users call it: what cannot work is one line, before anything is driven."""

import json

import pytest


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--train-on", "left-08", "--judge-on", "right-07"], "left-08 is trained on and right-07 judged on"),
        (["--train-on", "left-99"], "did you mean"),
        (["--train-on", ","], "there is no scenario to train on"),
        (["--train-on", "left-07", "--clean-on", "all"], "give --judge-on too"),
        (["--train-on", "left-07", "--rounds", "0"], "--rounds is 0, expected 1 to"),
        (["--train-on", "left-07", "--budget", "endless"], "--budget is 'endless', expected one of quick, full"),
        (["--train-on", "left-07", "--training-step", "nowhere:step"], "cannot import nowhere:step"),
        (["--train-on", "left-07", "--simulator", "moon"], "moon"),
    ],
    ids=lambda value: value[-1] if isinstance(value, list) else "",
)
def test_mistakes_are_one_line_before_anything_is_driven(invoke, tmp_path, words, message):
    code, printed = invoke("harden", "pilotnet", *words, "--out", tmp_path / "out")
    assert code == 2
    assert message in printed.err
    assert printed.err.count("\n") == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("controller", "message"),
    [
        ("resnet", "no controller called 'resnet'"),
        ("paint_shy:paint_shy", "gives a PaintShy, expected a torch.nn.Module with parameters"),
        ("own.onnx", "own.onnx is an exported network; to train on, give the Python it came from"),
    ],
)
def test_controllers_that_cannot_learn_are_one_line(invoke, tmp_path, controller, message):
    code, printed = invoke("harden", controller, "--train-on", "left-07", "--out", tmp_path / "out")
    assert code == 2
    assert message in printed.err
    assert printed.err.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_the_estimate_counts_the_drives_over_the_bare_road_that_are_asked_for(invoke):
    asked = ("harden", "pilotnet", "--train-on", "left-07", "--judge-on", "straight-04", "--dry-run", "--json")
    usual, all_forty = (json.loads(invoke(*asked, *more)[1].out)["drives"] for more in ((), ("--clean-on", "all")))
    assert all_forty - usual == 2 * 4 * (40 - 2)


def test_the_estimate_counts_what_each_weather_takes(invoke, monkeypatch):
    monkeypatch.setattr("roadproof.pipeline.workload.frame_seconds", lambda _, gradients=True: 0.01)
    # On several streets, so that attacks count beside the tuning, which takes as long in any weathers.
    streets = "left-07,right-06,straight-06,left-11"
    asked = ("harden", "pilotnet", "--train-on", streets, "--judge-on", "straight-04", "--dry-run", "--json")
    seconds = [
        json.loads(invoke(*asked, "--weathers", weathers)[1].out)["seconds"]
        for weathers in ("clear-noon", "clear-noon,rainy-noon")
    ]
    assert 1.3 < seconds[1] / seconds[0] < 2.0


def test_the_estimate_counts_drives_through_the_town_where_they_are_made(invoke):
    asked = ("harden", "pilotnet", "--train-on", "left-07", "--rounds", "1", "--dry-run", "--json", "--simulator")
    worlds = ("town", "town:egl", "carla://localhost:2000")
    software, egl, server = (json.loads(invoke(*asked, world)[1].out)["drives"] for world in worlds)
    assert software - server == egl - server == 80


def test_the_estimate_counts_all_drives_of_judging_and_what_is_done_at_once(invoke, monkeypatch):
    # Measured anew it may come out slower while a machine is busy.
    monkeypatch.setattr("roadproof.pipeline.workload.frame_seconds", lambda _, gradients=True: 0.01)
    asked = ("harden", "pilotnet", "--train-on", "left-07", "--dry-run", "--json", "--judge-on")
    streets = ("straight-04", "straight-04,left-03", "straight-04,left-03")
    told = [
        json.loads(invoke(*asked, names, "--processes", processes)[1].out)
        for names, processes in zip(streets, (1, 1, 2), strict=True)
    ]
    # As studies/harden.py made them: 44 a street on average over before and after, and four over the bare road each.
    assert told[1]["drives"] - told[0]["drives"] == 2 * (44 + 4)
    assert told[2]["drives"] == told[1]["drives"]
    assert told[2]["seconds"] < told[1]["seconds"]
