from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
import torch

from paint_shy import along_a_street
from roadproof.controllers import load_controller
from roadproof.driving.rollout import rollout
from roadproof.driving.trial import judge
from roadproof.errors import RoadproofError
from roadproof.pipeline.driven_objective import DrivenObjective, effect_of
from roadproof.scenarios import find_scenario
from roadproof.search_space import SearchSpace
from runs import driven

SPACE = SearchSpace(figures=2)


def test_steering_is_summed_over_the_first_four_fifths_as_published():
    scenario = find_scenario("left-03")
    clean = driven(scenario)
    frames = int(0.8 * clean.steer.size)
    shift = np.zeros(clean.steer.size)
    shift[:10], shift[frames:] = -0.02, 5.0
    painted = dataclasses.replace(clean, steer=clean.steer + shift)
    effect = effect_of(clean, painted, scenario.canvas)
    assert effect.steering == pytest.approx(0.2)
    assert effect.deviation == 0.0
    # A drive that ends before counts as the clean one from there on.
    short = {
        name: getattr(clean, name)[:201] for name in clean.__slots__ if np.size(getattr(clean, name)) == len(clean)
    }
    short |= {name: getattr(painted, name)[:200] for name in ("steer", "throttle", "brake")}
    assert effect_of(clean, dataclasses.replace(clean, **short), scenario.canvas).steering == pytest.approx(0.2)


def test_deviation_is_the_one_that_evaluations_report():
    scenario = find_scenario("left-03")
    clean, painted = driven(scenario), driven(scenario, 1.3, painted=True)
    trial = judge(clean, painted, scenario.canvas, pattern="attack", clean_file="a.npz", painted_file="b.npz")
    assert effect_of(clean, painted, scenario.canvas).deviation == trial.deviation_m > 0.1


@pytest.mark.slow
def test_a_value_is_that_of_a_whole_drive_and_is_driven_once(town, tmp_path, monkeypatch):
    street, controller = along_a_street(tmp_path), load_controller("pilotnet")
    unit = SPACE.random((1,), torch.Generator().manual_seed(1))
    calls = []
    reset = town.reset
    monkeypatch.setattr(town, "reset", lambda *args, **options: calls.append(1) or reset(*args, **options))
    kept = {"keep": tmp_path / "driven.json"}
    steering = DrivenObjective(town, controller, street, SPACE, **kept)(unit)
    assert len(calls) == 2
    deviation = DrivenObjective(town, controller, street, SPACE, measure="deviation", **kept)(unit)
    assert len(calls) == 3  # the clean one again
    damaged = {"format": "roadproof-driven", "version": 1, "drives": [["a", "b"]]}
    (tmp_path / "damaged.json").write_text(json.dumps(damaged))
    with pytest.raises(RoadproofError, match="incomplete or damaged"):
        DrivenObjective(town, controller, street, SPACE, keep=tmp_path / "damaged.json")
    clean = rollout(town, controller, street)
    whole = effect_of(clean, rollout(town, controller, street, pattern=SPACE.pattern(unit[0])), street.canvas)
    assert (float(steering), float(deviation)) == (whole.steering, whole.deviation)
    assert whole.steering > 0.01
