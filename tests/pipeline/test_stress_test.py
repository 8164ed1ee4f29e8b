from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
import torch

from paint_shy import along_a_street
from roadproof.attacks import GradOpt, PathDeviation, SteeringShift
from roadproof.calibration import CalibrationMethod, CalibrationReport
from roadproof.controllers import load_controller
from roadproof.datatypes import Weather
from roadproof.drives import Drives, Swerve, Trajectories, Window
from roadproof.driving.evaluation import Evaluation
from roadproof.errors import RoadproofError
from roadproof.paint import PaintLimits
from roadproof.pipeline.budget import BUDGETS, Budget
from roadproof.pipeline.fidelity import Fidelity
from roadproof.pipeline.film import Strip
from roadproof.pipeline.limit_costs import LimitCosts, Unlimited
from roadproof.pipeline.selection import Selection
from roadproof.pipeline.stress_test import STAGES, StressTest, stress_test
from roadproof.recordings import load_recordings
from roadproof.report.page import write_report
from roadproof.search_space import SearchSpace

TINY = Budget(
    objective=SteeringShift(),
    method=GradOpt(iterations=3, restarts=2, halving=False),
    trajectories=Trajectories(perturbation=Swerve((1.5,))),
    window=Window(frames=4),
    select=2,
    weathers=(Weather.CLEAR_NOON,),
    starts=0,
    runs=0,
)


def run(town, folder, **options):
    scenario = along_a_street(folder.parent, 2.5)
    options = {"budget": TINY, "space": SearchSpace(figures=1), "controller_name": "pilotnet"} | options
    return stress_test(town, load_controller("pilotnet"), scenario, folder, **options)


@pytest.mark.slow
def test_the_whole_loop_leaves_every_stage_in_its_folder_and_two_processes_the_same(
    town, few_pictures, two_threads, tmp_path
):
    from roadproof.simulators.town.simulator import TownSimulator

    folders = tmp_path / "alone", tmp_path / "shared"
    alone = run(town, folders[0])
    check_folder(folders[0], alone)
    with pytest.raises(RoadproofError, match="holds a run with seed 0, now it is 1"):
        run(town, folders[0], seed=1)
    shared = run(town, folders[1], factory=TownSimulator, processes=2)
    assert shared.selection.driven == alone.selection.driven
    assert shared.evaluation.trials == alone.evaluation.trials
    assert shared.fidelity.agreement == alone.fidelity.agreement
    calls = [{stage: cost.simulator_calls for stage, cost in each.cost.items()} for each in (alone, shared)]
    assert calls[0] == calls[1]
    reports = [CalibrationReport.load(folder / "calibration" / "report.json") for folder in folders]
    assert (reports[0].drives, reports[0].calls) == (reports[1].drives, reports[1].calls)
    for one, two in zip(*(load_recordings(folder / "recordings").recordings for folder in folders), strict=True):
        assert one.name == two.name
        for name in ("frames", "steer", "image_from_canvas"):
            np.testing.assert_array_equal(getattr(one, name), getattr(two, name))
        for name in ("gain", "offset", "visible"):
            assert torch.equal(getattr(one.maps, name), getattr(two.maps, name))
    strips = [Strip.load(folder / "evaluation" / "strip.npz") for folder in folders]
    np.testing.assert_array_equal(strips[0].clean, strips[1].clean)
    np.testing.assert_array_equal(strips[0].painted, strips[1].painted)


def check_folder(folder, result):
    assert [drive.name for drive in Drives.load(folder / "record").drives] == ["clean", "right", "left"]
    assert len(load_recordings(folder / "recordings").recordings) == 3
    assert Selection.load(folder / "selection").driven == result.selection.driven
    assert Evaluation.load(folder / "evaluation").trials == result.evaluation.trials
    assert (folder / "evaluation" / "film.jpg").exists()
    kept = Fidelity.load(folder / "evaluation" / "fidelity.npz")
    assert kept.agreement == result.fidelity.agreement
    assert kept.agreement.elsewhere_error < 1.0, "rendered from the places of the recorded frames"
    # Nine calls to calibrate at T = 3 by two paints, the clean drives included.
    assert result.cost["record"].simulator_calls + result.cost["calibrate"].simulator_calls == 9
    # The recorded clean drive is not driven again.
    assert result.cost["select"].simulator_calls == 2
    assert set(result.cost) == set(STAGES)
    assert len(result.attack.candidates) == 4
    shifts = [candidate.surrogate_shift for candidate in result.attack.candidates]
    assert shifts == sorted(shifts, reverse=True)
    # One of each group is driven, whichever the surrogate thinks stronger.
    assert {each.group for each in result.selection.driven} == {"clean+right", "clean+left"}
    deviations = [each.trial.deviation_m for each in result.selection.driven]
    assert deviations[result.selection.chosen] == max(deviations)


@pytest.mark.slow
def test_limits_on_paint_are_told_by_what_each_costs(town, few_pictures, tmp_path):
    once = GradOpt(iterations=1, restarts=1, halving=False)
    budget = dataclasses.replace(TINY, objective=PathDeviation(every=8), method=once, select=1)
    space = SearchSpace(figures=1, limits=PaintLimits(max_area_m2=2.0, printable=True))
    asked = {"budget": budget, "space": space, "film": False, "limit_costs": True}
    folder = tmp_path / "run"
    result = run(town, folder, **asked)
    costs = result.limit_costs
    assert [each.without for each in costs.searches] == ["", "area", "print", "any"]
    given, without_area = costs.searches[:2]
    assert given.predicted_m == result.attack.predicted_m
    assert given.conspicuousness.area_m2 <= 2.0 < without_area.conspicuousness.area_m2
    assert given.driven_m == pytest.approx(result.selection.deviation_m)
    assert costs.driven_cost_m(without_area) == without_area.driven_m - given.driven_m
    assert costs.sentences[0] == (
        f"Without the limit on area: predicted {without_area.predicted_m:.2f} m, "
        f"{without_area.predicted_m - given.predicted_m:+.2f} m; driven {without_area.driven_m:.2f} m, "
        f"{without_area.driven_m - given.driven_m:+.2f} m"
    )
    assert costs.sentences[2].startswith("Without any limit on paint: ")
    assert result.cost["limits"].simulator_calls == 4
    searched = {path: path.stat().st_mtime_ns for path in (folder / "limits").rglob("*.npz")}
    assert run(town, folder, **asked).limit_costs == costs == StressTest.load(folder).limit_costs
    assert {path: path.stat().st_mtime_ns for path in searched} == searched, "something was done twice"
    page = write_report(folder).read_text()
    assert "What each limit on paint costs" in page
    assert f"{costs.predicted_cost_m(without_area):+.2f}</td>" in page
    told = json.loads((folder / "result.json").read_text())["limits"]["searches"]
    assert [each["driven_m"] for each in told] == [each.driven_m for each in costs.searches]


def test_limit_costs_in_a_file_that_is_none_are_named(tmp_path):
    one = Unlimited(without="", predicted_m=1.0, predicted_range_m=(0.9, 1.1), conspicuousness=None)
    costs = LimitCosts(searches=(one, dataclasses.replace(one, without="area")))
    path = tmp_path / "limits.json"
    costs.save(path)
    assert LimitCosts.load(path) == costs
    assert costs.sentences == ("Without the limit on area: predicted 1.00 m, +0.00 m",)
    content = json.loads(path.read_text())
    content["searches"][1]["driven_m"] = 2.0
    for searches in ([], content["searches"]):
        path.write_text(json.dumps(content | {"searches": searches}))
        with pytest.raises(RoadproofError, match=r"limits\.json .*expected one or more, and all driven or"):
            LimitCosts.load(path)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"budget": dataclasses.replace(TINY, objective=PathDeviation())}, "there is no limit on paint; give one"),
        (
            {"space": SearchSpace(figures=1, limits=PaintLimits(printable=True))},
            "in metres of deviation, the search is for the st",
        ),
        (
            {
                "budget": dataclasses.replace(TINY, objective=PathDeviation()),
                "space": SearchSpace(figures=1, limits=PaintLimits(max_area_m2=2.0), max_painted_share=0.05),
            },
            "limit costs know no max_painted_share, which is 0.05",
        ),
    ],
)
def test_limit_costs_without_limits_or_metres_are_refused_before_anything_is_driven(town, tmp_path, given, message):
    with pytest.raises(RoadproofError, match=message):
        run(town, tmp_path / "run", limit_costs=True, **given)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("processes", [0, 2])
def test_processes_that_have_no_simulator_are_refused_before_anything_is_driven(town, tmp_path, processes):
    with pytest.raises(RoadproofError, match=f"{processes} processes; expected 1, or more with a factory"):
        run(town, tmp_path / "run", processes=processes)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("given", "message"),
    [({"seed": -1}, "seed is -1, expected a whole number"), ({"device": "gpu"}, "'gpu' is unknown")],
)
def test_a_seed_or_device_that_is_none_is_refused_before_anything_is_driven(town, tmp_path, given, message):
    with pytest.raises(RoadproofError, match=message):
        run(town, tmp_path / "run", **given)
    assert not (tmp_path / "run").exists()


def test_budgets_say_what_they_spend():
    published = BUDGETS["published"]
    assert published.trajectories.count == 3
    assert published.method.restarts * published.method.steps(published.objective) == 1000
    assert published.select == 0
    assert BUDGETS["quick"].is_predicted
    assert not BUDGETS["steering"].is_predicted


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"select": 2}, "select 2: as published it is 0"),
        ({"objective": PathDeviation()}, "objective path deviation: as published it is steering shift"),
        ({"calibration": CalibrationMethod.TWO_PAINT}, "calibration two-paint: as published it is published"),
        ({"trajectories": Trajectories()}, "perturbation Swerve: as published it is SteeringNoise"),
    ],
    ids=lambda value: "" if isinstance(value, str) else next(iter(value)),
)
def test_a_published_search_with_an_improvement_is_refused(change, message):
    with pytest.raises(RoadproofError, match=message):
        dataclasses.replace(BUDGETS["published"], **change)
