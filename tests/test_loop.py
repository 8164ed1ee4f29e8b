from __future__ import annotations

import dataclasses

import pytest

from roadproof.attacks import Schedule
from roadproof.controllers import load_controller
from roadproof.datatypes import Weather
from roadproof.drives import load_drives
from roadproof.errors import RoadproofError
from roadproof.evaluation import Evaluation, Selection
from roadproof.loop import BUDGETS, STAGES, Budget, stress_test
from roadproof.recordings import load_recordings
from roadproof.scenarios import builtin_scenarios, find_scenario
from roadproof.search_space import SearchSpace

TINY = Budget(frames=4, schedule=Schedule.stretched(3), restarts=2, select=2, weathers=(Weather.CLEAR_NOON,), runs=0)
STAGE_OF_WORD = {
    "Recording": "record",
    "Calibrating": "calibrate",
    "Searching": "attack",
    "Choosing by driving": "select",
    "Evaluating": "evaluate",
}


@pytest.fixture(scope="module")
def town():
    pytest.importorskip("panda3d", reason="panda3d is not installed")
    from roadproof.simulators.town.simulator import TownSimulator

    with TownSimulator() as world:
        yield world


def run(town, folder, **options):
    scenario = find_scenario("left-03", builtin_scenarios())
    options = {"budget": TINY, "space": SearchSpace(figures=1), "controller_name": "pilotnet"} | options
    return stress_test(town, load_controller("pilotnet"), scenario, folder, **options)


class StoppedError(Exception):
    pass


@pytest.mark.slow
def test_the_whole_loop_resumes_in_every_stage_and_ends_the_same(town, tmp_path):
    straight = run(town, tmp_path / "straight")
    stopped: set[str] = set()

    def stop_once_in_each(stage, done, _total, _word):
        if done == 2 and stage not in stopped:
            stopped.add(stage)
            raise StoppedError

    while True:
        try:
            result = run(town, tmp_path / "stopped", on_progress=stop_once_in_each)
            break
        except StoppedError:
            unfinished = [path for path in (tmp_path / "stopped").rglob("*") if path.name.startswith(".")]
            assert unfinished == []
    assert stopped == set(STAGE_OF_WORD)
    assert result.selection.driven == straight.selection.driven
    assert result.evaluation.trials == straight.evaluation.trials
    assert {stage: cost.simulator_calls for stage, cost in result.cost.items()} == {
        stage: cost.simulator_calls for stage, cost in straight.cost.items()
    }
    check_folder(tmp_path / "stopped", result)
    with pytest.raises(RoadproofError, match="other settings"):
        run(town, tmp_path / "straight", seed=1)


def check_folder(folder, result):
    assert [drive.name for drive in load_drives(folder / "record").drives] == ["clean", "right", "left"]
    assert len(load_recordings(folder / "recordings").recordings) == 3
    assert Selection.load(folder / "selection").driven == result.selection.driven
    assert Evaluation.load(folder / "evaluation").trials == result.evaluation.trials
    # Nine calls to calibrate at T = 3 by two paints, the clean drives included.
    assert result.cost["record"].simulator_calls + result.cost["calibrate"].simulator_calls == 9
    assert result.cost["select"].simulator_calls == 3
    assert set(result.cost) == set(STAGES)
    assert len(result.attack.candidates) == 4
    shifts = [candidate.surrogate_shift for candidate in result.attack.candidates]
    assert shifts == sorted(shifts, reverse=True)
    # One of each group is driven, whichever the surrogate thinks stronger.
    assert {each.group for each in result.selection.driven} == {"clean+right", "clean+left"}
    deviations = [each.trial.deviation_m for each in result.selection.driven]
    assert deviations[result.selection.chosen] == max(deviations)


def test_budgets_say_what_they_spend():
    assert BUDGETS["paper"].trajectories == 3
    assert BUDGETS["paper"].restarts * BUDGETS["paper"].schedule.iterations == 1000
    assert dataclasses.replace(TINY, deviations_m=(0.7, 1.5)).trajectories == 5
    assert dataclasses.replace(TINY, deviations_m=()).trajectories == 1
