"""Searching on where the attacked car went, with a driver that really reacts to paint."""

from __future__ import annotations

import dataclasses
import shutil

import numpy as np
import pytest
import torch

from paint_shy import PaintShy, along_a_street
from roadproof.attacks import GradOpt, SteeringShift, methods
from roadproof.attacks.gradopt import Rung
from roadproof.calibration import CalibrationMethod
from roadproof.cli.demo import _report
from roadproof.datatypes import Weather
from roadproof.drives import Swerve, Trajectories, Window
from roadproof.drives.folder import read_drive
from roadproof.driving.drive_store import load_episodes
from roadproof.errors import CalibrationError, RoadproofError
from roadproof.pipeline.budget import Budget
from roadproof.pipeline.stress_test import StressTest, stress_test
from roadproof.recordings import Side
from roadproof.search_space import SearchSpace

pytestmark = pytest.mark.slow
NOON, RAIN = Weather.CLEAR_NOON, Weather.RAINY_NOON
BUDGET = Budget(
    objective=SteeringShift(),
    method=GradOpt(iterations=6, restarts=2),
    trajectories=Trajectories(perturbation=Swerve((0.8,))),
    window=Window(frames=6),
    select=2,
    weathers=(NOON,),
    starts=0,
    runs=0,
    rounds=2,
)


@pytest.fixture(scope="module", autouse=True)
def _few_starts():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(methods, "SHIFT_RUNGS", (Rung(16, 3, every=3),))
        yield


@pytest.fixture(scope="module")
def street(tmp_path_factory):
    return along_a_street(tmp_path_factory.mktemp("map"), 3.2)


def run(town, street, folder, budget, **options):
    space = SearchSpace(figures=2)
    return stress_test(town, PaintShy(gain=30.0), street, folder, budget=budget, space=space, film=False, **options)


@pytest.fixture(scope="module")
def done(town, street, tmp_path_factory):
    folder, told = tmp_path_factory.mktemp("rounds"), []
    result = run(town, street, folder, BUDGET, on_progress=lambda *each: told.append(each))
    return folder, result, told


def test_a_round_records_the_bare_road_where_the_attacked_car_went(done):
    folder, result, _ = done
    assert result.fidelity is None
    assert not list((folder / "evaluation").glob("film.*")), "nobody asked for a film"
    chosen = result.selection.driven[result.selection.chosen].trial
    (attacked,) = load_episodes(folder / "selection", [chosen.painted])
    drive = read_drive("round-1", folder / "round-1")
    steps = drive.frame_number
    np.testing.assert_allclose(drive.episode.x_m[steps], attacked.x_m[steps], atol=1e-6)
    assert not drive.episode.painted
    assert drive.side is (Side.RIGHT if drive.offset_m > 0 else Side.LEFT)
    # This driver swerves to the right, away from the paint, and sees none of it here.
    assert drive.offset_m > 0.1
    assert (drive.steer == 0).all()
    assert attacked.steer.max() > 0.01


def test_the_best_driven_of_all_rounds_is_kept_and_every_drive_is_counted(done):
    _, result, _ = done
    rounds = result.rounds
    assert len(rounds.done) == 2
    assert rounds.stopped == ""
    found = [rounds.first.deviation_m, *(each.selection.deviation_m for each in rounds.done)]
    assert rounds.best.deviation_m == max(found)
    assert result.evaluation.of(traffic=False)[0].deviation_m == pytest.approx(max(found))
    # One over the bare road, two over paints, and the candidates; the clean drive is not made again.
    assert [each.simulator_calls for each in rounds.done] == [5, 5]
    assert result.cost["rounds"].simulator_calls == rounds.simulator_calls == 10
    assert result.cost["calibrate"].simulator_calls == 6


def test_a_round_begins_where_the_search_before_it_came_to(done):
    _, result, _ = done
    again = result.rounds.done[0].attack
    assert again.method == dataclasses.replace(BUDGET.method, halving=False)
    assert again.history.shape == (6, 2, 2)
    # The left group has the same drives as before, so it begins with what was found on them.
    assert list(again.by_group) == ["clean+right", "clean+left"]
    before = sorted(c.surrogate_shift for c in result.attack.candidates if c.group == "clean+left")
    np.testing.assert_allclose(sorted(again.history[0, 1]), before, atol=1e-3)


def test_what_is_done_is_not_done_again(done, town, street):
    folder, result, told = done
    files = {path: path.stat().st_mtime_ns for path in folder.rglob("*.npz")}
    words = []
    again = run(town, street, folder, BUDGET, on_progress=lambda *each: words.append(each))
    assert {path: path.stat().st_mtime_ns for path in folder.rglob("*.npz")} == files
    assert again.evaluation.trials == result.evaluation.trials
    assert again.rounds.best.driven == result.rounds.best.driven
    assert again.cost["rounds"].simulator_calls == 10
    on = [done for stage, done, total, _ in told if stage == "Searching on" and total == 16]
    assert on == sorted(on)
    assert on[-1] == 16


def test_the_folder_of_a_run_is_its_result(done):
    folder, result, _ = done
    loaded = StressTest.load(folder)
    assert loaded.evaluation.trials == result.evaluation.trials
    assert loaded.selection.driven == result.selection.driven
    assert loaded.rounds.best.driven == result.rounds.best.driven
    assert [each.simulator_calls for each in loaded.rounds.done] == [5, 5]
    assert torch.equal(loaded.pattern.boxes, result.pattern.boxes)
    assert loaded.cost.keys() == result.cost.keys()
    assert (loaded.prediction, loaded.fidelity, loaded.cheapest) == (None, None, None)
    with pytest.raises(RoadproofError, match=r"round-1.evaluation.evaluation\.json"):
        StressTest.load(folder / "round-1")


def test_a_controller_that_was_trained_again_is_not_answered_from_what_the_one_before_left(done, town, street):
    with pytest.raises(RoadproofError, match="a run of another controller, which answers otherwise"):
        stress_test(town, PaintShy(gain=1.0), street, done[0], budget=BUDGET, space=SearchSpace(figures=2), film=False)


def test_a_round_that_cannot_be_calibrated_ends_them_and_the_demo_says_why(
    done, town, street, tmp_path, monkeypatch, capsys
):
    folder = shutil.copytree(done[0], tmp_path / "run")
    shutil.rmtree(folder / "round-2")
    for path in (folder / "calibration").glob("round-2*"):
        path.unlink()

    def blind(*_, **__):
        raise CalibrationError("drive round-2 has 1 of 6 frames left")

    monkeypatch.setattr("roadproof.pipeline.rerecording.calibrate", blind)
    result = run(town, street, folder, BUDGET)
    assert len(result.rounds.done) == 1
    assert result.rounds.stopped == "round 2: drive round-2 has 1 of 6 frames left"
    _report(result, folder)
    assert "\nSearching on ended early: round 2: drive round-2 has 1 of 6 frames left\n" in capsys.readouterr().out


@pytest.mark.parametrize("what", ["round-1/drive.npz", "recordings/recordings.json"])
def test_a_damaged_file_of_a_round_is_named_and_ends_no_round(done, town, street, tmp_path, what):
    folder = shutil.copytree(done[0], tmp_path / "run")
    damaged = folder / "round-1" / what
    damaged.write_bytes(damaged.read_bytes()[:-200])
    with pytest.raises(RoadproofError, match=rf"round-1/{what}"):
        run(town, street, folder, BUDGET)


def test_one_search_may_be_for_several_weathers(town, street, tmp_path):
    budget = dataclasses.replace(BUDGET, rounds=1, attack_weathers=(NOON, RAIN), trajectories=Trajectories(count=1))
    result = run(town, street, tmp_path, budget)
    assert result.cost["record"].simulator_calls == 2
    assert result.cost["calibrate"].simulator_calls == 4
    assert (tmp_path / "rainy-noon" / "recordings" / "recordings.json").exists()
    # T = 1, pooled: both clean drives, and from the round on the attacked one.
    assert list(result.attack.by_group) == list(result.rounds.done[0].attack.by_group) == ["all"]
    assert result.rounds.done[0].attack.cost.controller_frames > 6 * 2 * 18


def test_budgets_that_contradict_themselves_are_refused():
    with pytest.raises(RoadproofError, match="2 rounds begin from candidates"):
        dataclasses.replace(BUDGET, select=0)
    with pytest.raises(RoadproofError, match="attack_weathers are clear-noon, clear-noon; expected each once"):
        dataclasses.replace(BUDGET, attack_weathers=(NOON, NOON))
    with pytest.raises(RoadproofError, match="published calibration holds in one weather"):
        dataclasses.replace(BUDGET, calibration=CalibrationMethod.PUBLISHED, attack_weathers=(NOON, RAIN))
    with pytest.raises(RoadproofError, match="weathers has clear-noon twice"):
        dataclasses.replace(BUDGET, weathers=(NOON, NOON))
    with pytest.raises(RoadproofError, match="weathers is empty"):
        dataclasses.replace(BUDGET, weathers=())
    with pytest.raises(RoadproofError, match=r"starts is -1, expected a whole number, 0 or more"):
        dataclasses.replace(BUDGET, starts=-1)
