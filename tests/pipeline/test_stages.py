"""Stages that go on from what their folder holds."""

from __future__ import annotations

import needs
from roadproof.attacks import AttackResult
from roadproof.controllers import load_controller
from roadproof.drives import Drives
from roadproof.driving.evaluate import drivers
from roadproof.pipeline import stages
from roadproof.pipeline.budget import QUICK
from roadproof.pipeline.stages import Stages
from roadproof.scenarios import find_scenario
from roadproof.search_space import SearchSpace
from runs import write_attack, write_record
from scenes import recording_set

needs.town()
from roadproof.simulators.town.simulator import TownSimulator


def test_a_search_for_less_paint_that_found_none_is_not_repeated(tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr(stages, "cheapest", lambda *given, **_: asked.append(given[3]))
    scenario = find_scenario("left-03")
    run = Stages(
        simulator=(town := TownSimulator()),
        controller=load_controller("pilotnet"),
        scenario=scenario,
        folder=tmp_path,
        budget=QUICK,
        space=SearchSpace(figures=2),
        seed=0,
        controller_name="pilotnet",
        device="cpu",
        pool=drivers(town, None, 1),
        on_progress=lambda *_: None,
    )
    write_attack(tmp_path)
    write_record(tmp_path / "record", scenario)
    found, drives = AttackResult.load(tmp_path), Drives.load(tmp_path / "record")
    for wanted_m in (0.5, 0.5, 0.7):
        assert run.cheapest(recording_set(), found, wanted_m, drives) is None
    assert asked == [0.5, 0.7]
