"""The studies of hardening: each stage is one line, results are one file, and streets lie apart."""

import json
import runpy
import sys
from dataclasses import replace
from pathlib import Path

import pytest

import needs
from roadproof.datatypes import Weather
from roadproof.errors import CanvasNotReachedError, TrainingError
from roadproof.hardening.budget import HARDENING_BUDGETS, check_streets
from roadproof.hardening.judgement import StreetJudge
from roadproof.roads.maps import load_map, scenario_route
from roadproof.scenarios import load_scenarios
from runs import hardened

needs.town()

STUDIES = Path(__file__).parents[2] / "studies"
STUDY = STUDIES / "harden.py"
AGAIN = STUDIES / "judge_again.py"


def test_the_study_says_each_stage_once_and_writes_its_results_where_asked(tmp_path, monkeypatch, capfd):
    found = hardened()

    def harden(*_, on_progress, **__):
        for done in range(40):
            on_progress("Round 1: learning", done + 1, 40, "loss 0.1")
        found.save(tmp_path)
        return found

    monkeypatch.setattr("roadproof.hardening.harden", harden)
    monkeypatch.setattr("roadproof.hardening.write_hardening", lambda *_: None)
    written = tmp_path / "new" / "rows.json"
    monkeypatch.setattr(sys, "argv", [str(STUDY), "--json", str(written), "--keep", str(tmp_path)])
    runpy.run_path(str(STUDY), run_name="__main__")
    said = capfd.readouterr()
    assert (said.out + said.err).count("Round 1: learning") == 1
    assert found.judgement.verdict().sentence in said.out
    assert written.read_text() == (tmp_path / "hardening.json").read_text()


def test_the_streets_of_the_study_lie_apart_and_its_crossings_are_painted_inside():
    study = runpy.run_path(str(STUDY))
    crossings = load_scenarios(study["CROSSINGS"])
    training, judging = [*study["streets"](study["TRAIN_ON"]), *crossings], study["streets"](study["JUDGE_ON"])
    assert (len(training), len(judging)) == (26, 12)
    check_streets(training, judging)
    for scenario in crossings:
        route = scenario_route(scenario, load_map(scenario.map_name))
        (crossing,) = route.crossings
        at_m = route.locate(scenario.canvas.x_m, scenario.canvas.y_m).arclength_m
        assert crossing.enters_m < at_m < crossing.leaves_m, scenario.name


@pytest.fixture
def judge_again(tmp_path, monkeypatch):
    """Runs the study of other seeds with some arguments; its file."""

    def run(*given):
        written = tmp_path / "rows.json"
        argv = [
            str(AGAIN),
            "--json",
            str(written),
            "--keep",
            str(tmp_path / "kept"),
            "--controller",
            "pilotnet",
            *given,
        ]
        monkeypatch.setattr(sys, "argv", argv)
        monkeypatch.syspath_prepend(str(STUDIES))
        runpy.run_path(str(AGAIN), run_name="__main__")
        return json.loads(written.read_text())

    return run


def test_the_study_of_other_seeds_counts_the_attack_that_leads_most_drives_out(judge_again, monkeypatch, capfd):
    far, often = (each for each in hardened().judgement.judged if not each.after)
    far = replace(far, deviation_m=(1.4, 1.0), left_lane=(True, False))
    often = replace(often, deviation_m=(0.9, 0.9), left_lane=(True, True), left_out=1)

    def judge(self):
        assert self.plan.budget is HARDENING_BUDGETS["full"]
        if self.scenario.name == "left-05":
            raise CanvasNotReachedError("it stops before the canvas")
        return [far, often]

    def judge_in(self, weathers):
        assert weathers == [Weather.RAINY_NOON]
        return [replace(often, scenario=self.scenario.name, deviation_m=(0.1, 0.3), left_lane=(False, False))]

    monkeypatch.setattr(StreetJudge, "judge", judge)
    monkeypatch.setattr(StreetJudge, "judge_in", judge_in)
    asked = ("--streets", "left-03", "left-05", "--seed", "3", "--budget", "full")
    assert judge_again(*asked)["judged_there"] == []
    capfd.readouterr()
    found = judge_again(*asked, "--weathers", "rainy-noon")
    assert found["weathers"] == ["rainy-noon"]
    (there,) = found["judged_there"]
    assert (there["scenario"], there["deviation_m"]) == ("left-03", [0.1, 0.3])
    assert (found["controller"], found["seed"], found["budget"]) == ("pilotnet", 3, "full")
    assert found["unjudged"] == {"left-05": "it stops before the canvas"}
    assert [each["kind"] for each in found["judged"]] == ["by gradient", "random"]
    assert all("after" not in each for each in found["judged"])
    assert "| strongest on each street | 1.20 m (1.20–1.20) | 50% |" in (said := capfd.readouterr().out)
    assert "In rainy-noon:\n| kind of attack |" in said
    assert "| random | 0.20 m (0.20–0.20) | 0% |" in said
    assert "Leaves its lane in 2 of 2 drives. In 1 more of all kinds it never came to the canvas." in said
    assert "left-05 could not be judged: it stops before the canvas" in said


def test_the_study_of_other_seeds_refuses_a_street_that_was_trained_on(judge_again):
    with pytest.raises(TrainingError, match=r"left-01 is trained on and left-01 judged on"):
        judge_again("--streets", "left-01", "--seed", "1")
