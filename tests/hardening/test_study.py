"""The study of hardening: each stage is one line, its results are one file, and its streets lie apart."""

import runpy
import sys
from pathlib import Path

import needs
from roadproof.hardening.budget import check_streets
from roadproof.roads.maps import load_map, scenario_route
from roadproof.scenarios import load_scenarios
from runs import hardened

needs.town()

STUDY = Path(__file__).parents[2] / "studies" / "harden.py"


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
    assert (len(training), len(judging)) == (20, 12)
    check_streets(training, judging)
    for scenario in crossings:
        route = scenario_route(scenario, load_map(scenario.map_name))
        (crossing,) = route.crossings
        at_m = route.locate(scenario.canvas.x_m, scenario.canvas.y_m).arclength_m
        assert crossing.enters_m < at_m < crossing.leaves_m, scenario.name
