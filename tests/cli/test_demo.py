from __future__ import annotations

import functools
import html
import shlex

import pytest

import needs
from command import answered, stored
from paint_shy import along_a_street
from roadproof.attacks import GradOpt, SteeringShift
from roadproof.datatypes import Weather
from roadproof.drives import Swerve, Trajectories, Window
from roadproof.pipeline.budget import BUDGETS, Budget
from roadproof.scenarios import save_scenarios

TINY = Budget(
    objective=SteeringShift(),
    method=GradOpt(iterations=2, restarts=1, halving=False),
    trajectories=Trajectories(perturbation=Swerve((1.5,))),
    window=Window(frames=4),
    select=1,
    weathers=(Weather.CLEAR_NOON,),
    starts=0,
    runs=0,
)


@pytest.fixture
def demo(invoke):
    return functools.partial(invoke, "demo")


@pytest.mark.slow
def test_one_command_goes_from_nothing_to_the_report(demo, few_pictures, tmp_path, monkeypatch):
    needs.town()
    pytest.importorskip("av", reason="av is not installed")
    monkeypatch.setitem(BUDGETS, "quick", TINY)
    file, out = tmp_path / "scenarios.toml", tmp_path / "run"
    save_scenarios([along_a_street(tmp_path, 2.5)], file)
    words = ["--scenarios", file, "--scenario", "street", "--figures", 1, "--processes", 2, "--out", out]
    code, printed = demo(*words)
    assert code == 0, printed.err
    assert "street" in printed.out
    assert "record" in printed.out
    code, printed = demo(*words, "--json")  # finds all done
    assert code == 0, printed.err
    assert "record" in printed.err
    assert answered(printed.out) == stored(out / "result.json")
    page = (out / "report.html").read_text()
    assert "pilotnet" in page
    assert html.escape(shlex.join(["roadproof", "demo", *map(str, words)]), quote=False) in page
    assert (out / "evaluation" / "film.mp4").stat().st_size > 10_000
    assert (out / "evaluation" / "fidelity.npz").exists()


def test_mistakes_are_one_clear_line(demo, tmp_path):
    for options, message in (
        (["--budget", "endless"], "--budget is 'endless'"),
        (["--scenario", "left-99"], "did you mean"),
        (["--attack-weathers", "clear-noon,rainy"], "--attack-weathers is 'rainy'"),
        (
            ["--attack-weathers", "clear-noon,rainy-noon", "--budget", "published"],
            "weathers attacked 2: as published it is 1",
        ),
        (["--budget", "published", "--max-area", "3"], "the published search knows the families published and"),
        (["--budget", "published", "--cheapest", "0.5"], "the cheapest pattern is looked for in the recorded world"),
        (["--limit-costs"], "limit costs were asked for, but there is no limit on paint"),
        (["--controller", "resnet"], "no controller called 'resnet'"),
        (["--simulator", "moon"], "moon"),
        (["--processes", "-1"], "--processes is -1, expected 0"),
        (["--rounds", "-1"], "--rounds is -1, expected 0 to"),
        (["--processes", "2", "--simulator", "carla://localhost:2000"], "would step the one server"),
    ):
        code, printed = demo(*options, "--out", tmp_path)
        assert code == 2
        assert message in printed.err
        assert printed.err.count("\n") == 1
