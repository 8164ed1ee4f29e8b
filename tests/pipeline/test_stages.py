"""Stages that go on from what their folder holds."""

from __future__ import annotations

import json
import sys
from dataclasses import asdict, replace

import numpy as np
import pytest

import needs
from roadproof.attacks import AttackResult
from roadproof.controllers import load_controller
from roadproof.drives import Drives
from roadproof.errors import RoadproofError
from roadproof.pipeline import stages
from roadproof.pipeline.budget import QUICK
from roadproof.pipeline.prediction import Prediction
from roadproof.pipeline.selection import Selection
from roadproof.pipeline.stages import Stages
from roadproof.processes import here_or_beside
from roadproof.scenarios import find_scenario
from roadproof.search_space import SearchSpace
from runs import write_attack, write_record, write_selection
from scenes import recording_set

needs.town()
from roadproof.simulators.town.simulator import TownSimulator


def stages_in(folder, **options):
    return Stages(
        simulator=(town := TownSimulator()),
        controller=load_controller("pilotnet"),
        scenario=find_scenario("left-03"),
        folder=folder,
        budget=QUICK,
        space=SearchSpace(figures=2),
        seed=0,
        controller_name="pilotnet",
        device="cpu",
        pool=here_or_beside(town, None, 1),
        on_progress=lambda *_: None,
        **options,
    )


def test_a_run_knows_a_map_by_what_is_in_it_wherever_it_lies(tmp_path):
    parts = []
    for folder, content in (("one", "<OpenDRIVE/>"), ("two", "<OpenDRIVE/>"), ("two", "<OpenDRIVE />")):
        (tmp_path / folder).mkdir(exist_ok=True)
        own = tmp_path / folder / "own.xodr"
        own.write_text(content)
        run = stages_in(tmp_path)
        parts.append(replace(run, scenario=replace(run.scenario, map_name=str(own))).made_of["scenario"])
    assert parts[0] == parts[1] != parts[2]
    in_town = stages_in(tmp_path)
    assert in_town.made_of["scenario"] == asdict(in_town.scenario), "as before maps were known by their content"


def in_black(found):
    return replace(found, pattern=replace(found.pattern, colours=0 * found.pattern.colours))


@pytest.fixture
def asked(monkeypatch):
    """What the search for less paint was asked for; it finds nothing."""
    asked = []
    monkeypatch.setattr(
        sys.modules["roadproof.attacks.cheapest"], "cheapest", lambda *given, **_: asked.append(given[3])
    )
    return asked


def test_a_search_for_less_paint_that_found_none_is_not_repeated(tmp_path, asked):
    run = stages_in(tmp_path)
    write_attack(tmp_path)
    write_record(tmp_path / "record", run.scenario)
    found, drives = AttackResult.load(tmp_path), Drives.load(tmp_path / "record")
    for wanted_m in (0.5, 0.5, 0.7):
        assert run.cheapest(recording_set(), found, wanted_m, drives) is None
    assert asked == [0.5, 0.7]
    run.cheapest(recording_set(), in_black(found), 0.7, drives)
    assert asked == [0.5, 0.7, 0.7], "the same figures in other colours are another pattern"


@pytest.mark.parametrize(
    ("kept", "message"),
    [
        ({}, "does not say what it was made of"),
        ({"wanted_m": 0.5, "pattern": "0"}, "does not say its strongest"),
        ({"wanted_m": 0.7, "pattern": "0"}, "holds a search with wanted_m 0.7, now it is 0.5"),
    ],
)
def test_less_paint_of_another_search_is_refused(tmp_path, asked, kept, message):
    run = stages_in(tmp_path)
    write_attack(tmp_path)
    write_record(tmp_path / "record", run.scenario)
    kept = {"format": "roadproof-cheapest", "version": 1, "made_of": kept}
    (tmp_path / "cheapest").mkdir()
    (tmp_path / "cheapest" / "cheapest.json").write_text(json.dumps(kept))
    with pytest.raises(RoadproofError, match=message):
        run.cheapest(recording_set(), AttackResult.load(tmp_path), 0.5, Drives.load(tmp_path / "record"))
    assert asked == []


def test_a_prediction_is_that_of_the_pattern_the_drive_and_the_controller_at_hand(tmp_path, monkeypatch):
    made = []

    def predicted(recordings, controller, pattern, *drives, device):
        made.append(pattern)
        path = np.zeros((3, 2))
        numbers = dict.fromkeys(
            ("predicted_m", "least_m", "most_m", "driven_m", "path_error_m", "gap_m", "gap_rad"), 0.5
        )
        return Prediction(**numbers, clean_xy=path, predicted_xy=path, driven_xy=path)

    monkeypatch.setattr(stages, "predict", predicted)
    monkeypatch.setattr(Selection, "episodes", lambda self, folder: (None, None))
    run = stages_in(tmp_path)
    write_selection(tmp_path / "selection", 0.5, 1.5, chosen=1)
    chosen = Selection.load(tmp_path / "selection")
    pattern, recordings = chosen.pattern, recording_set()
    first = run.predict(recordings, pattern, chosen, None)
    assert run.predict(recordings, pattern, chosen, None).made_of == first.made_of
    assert len(made) == 1
    run.predict(recordings, in_black(chosen).pattern, chosen, None)
    run.predict(recordings, pattern, chosen, None)
    run.predict(recordings, pattern, replace(chosen, chosen=0), None)
    replace(run, controller=load_controller("pilotnet-b")).predict(recordings, pattern, replace(chosen, chosen=0), None)
    assert len(made) == 5
    replace(first, made_of="").save(tmp_path / "prediction.npz")
    run.predict(recordings, pattern, chosen, None)
    assert len(made) == 6, "it does not say of what it is"


class Unnamed:
    """One whose repr tells where it lies."""

    name = "own"

    def __init__(self, factor):
        self.factor = factor

    def measure(self, recordings, controller, groups, *, device):
        raise NotImplementedError


def test_a_users_objective_is_known_by_its_fields_and_not_by_its_place_in_memory(tmp_path):
    made_of = [
        replace(run, budget=replace(QUICK, objective=objective)).made_of
        for run in [stages_in(tmp_path)]
        for objective in (Unnamed(1.0), Unnamed(1.0), Unnamed(2.0))
    ]
    assert made_of[0] == made_of[1]
    assert made_of[0] != made_of[2]
