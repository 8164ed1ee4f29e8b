"""What is made of drives in recordings: evaluations, selections, films and reports that are called predicted."""

import dataclasses
import json

import numpy as np
import pytest
import torch

from paint_shy import BrakeShy, PaintShy, magenta
from recorded_drives import CANVAS, drivable_set
from roadproof.attacks import Candidate
from roadproof.datatypes import VehicleState, Weather
from roadproof.driving.deviation import passage, passage_deviation_m, path_of
from roadproof.driving.evaluate import evaluate
from roadproof.driving.evaluation import Evaluation
from roadproof.driving.rollout import rollout
from roadproof.driving.speed import speed_difference
from roadproof.errors import RoadproofError
from roadproof.patterns import Pattern, raster
from roadproof.pipeline.film import film_drives
from roadproof.pipeline.selection import Selection, select_by_driving
from roadproof.recorded.simulator import RecordedSimulator
from roadproof.recorded.world import RecordedWorld
from roadproof.report.page import write_report
from roadproof.scenarios import find_scenario
from roadproof.simulators.protocol import PaintKind
from runs import driven

BAR = magenta(300.0)


@pytest.fixture(scope="module")
def recordings():
    return drivable_set()


def briefly(world):
    """The recorded scenario, in which who stops need not stand for long."""
    return dataclasses.replace(world.scenario, time_limit_s=8.0)


@pytest.fixture(scope="module")
def predicted(recordings, tmp_path_factory):
    """A run that holds nothing but an evaluation in recordings, filmed and reported."""
    run = tmp_path_factory.mktemp("predicted")
    with RecordedSimulator(recordings) as world:
        done = evaluate(
            world,
            PaintShy(),
            world.scenario,
            BAR,
            folder=run / "evaluation",
            weathers=(Weather.CLEAR_NOON,),
            starts=0,
            runs=0,
        )
        shown = done.shown()
        film_drives(world, world.scenario, (shown.clean, shown.painted), raster(BAR), run / "evaluation")
    write_report(run)
    return run, done


def test_an_evaluation_in_recordings_is_called_predicted_and_knows_nothing_of_infractions(predicted):
    run, done = predicted
    (trial,), (row,) = done.trials, done.rows()
    assert trial.lateral_m < -0.05, "away from the paint, to the right"
    assert trial.deviation_m > 0.01
    assert (trial.points, trial.clean_points, trial.leaderboard, trial.first_event_s) == (None,) * 4
    assert (row.count, row.points, row.clean_points, row.leaderboard, row.failed) == (1, None, None, None, None)
    assert (done.predicted, done.simulator_calls, done.drives) == (True, 0, 2)
    content = json.loads((run / "evaluation" / "evaluation.json").read_text())
    assert content["kind"] == "predicted"
    assert content["trials"][0]["points"] is None
    assert Evaluation.load(run / "evaluation") == done


def test_predicted_deviation_is_over_the_stretch_that_driven_ones_are_over():
    """Drives that begin nearer to the canvas count as if they had come straight from where it comes into view."""
    scenario = find_scenario("left-03")
    whole = [driven(scenario, aside_m) for aside_m in (0.0, 1.5)]
    first = passage(path_of(whole[0]), scenario.canvas, horizon_m=15.0).start

    def later(episode, paint):
        seen = {name: getattr(episode, name)[first:] for name in (*VehicleState.__slots__, "time_s", "command")}
        given = {name: getattr(episode, name)[first:] for name in ("steer", "throttle", "brake")}
        return dataclasses.replace(episode, paint=paint, **seen, **given)

    expected = passage_deviation_m(*whole, scenario.canvas)
    cut = [later(episode, PaintKind.RENDERED) for episode in whole]
    assert passage_deviation_m(*cut, scenario.canvas) > 1.2 * expected
    cut = [later(episode, PaintKind.COMPOSITED) for episode in whole]
    assert passage_deviation_m(*cut, scenario.canvas) == pytest.approx(expected, rel=0.04)


def test_the_report_says_that_nothing_was_driven(predicted):
    run, done = predicted
    result = json.loads((run / "result.json").read_text())
    assert result["verdict"]["key"] == "predicted"
    assert "closed_loop" not in result
    assert result["predicted"]["trials"][0]["deviation_m"] == done.trials[0].deviation_m
    page = (run / "report.html").read_text()
    for words in (
        "Predicted, not driven",
        "Nothing was driven for real",
        "median deviation, predicted",
        "Predicted<br>deviation m",
        "Not known: recordings have no map.",
        "Nothing here was driven for real.",
        "over the paint, predicted",
    ):
        assert words in page, words
    for words in ("penalty points a drive", "No infraction.", "happened in simulation", "driven over the paint"):
        assert words not in page, words


def test_film_and_strip_show_the_frames_enlarged(predicted):
    run, _ = predicted
    with np.load(run / "evaluation" / "strip.npz") as strip:
        shown = strip["painted"]
    assert shown.shape == (25, 300, 400, 3)
    assert int(shown[:, :50].max()) < 12, "black where nothing was recorded"
    magenta = (shown[..., 0].astype(int) - shown[..., 1] > 120).sum((1, 2))
    assert (magenta > 50).sum() >= 16


def test_a_selection_in_recordings_is_called_predicted(recordings, tmp_path):
    faint = dataclasses.replace(BAR, colours=torch.full((1, 3), 0.4))
    candidates = [Candidate(faint, "clean+right", 0.3), Candidate(BAR, "clean+right", 0.2)]
    with RecordedSimulator(recordings) as world:
        chosen = select_by_driving(world, PaintShy(), world.scenario, candidates, best=2, folder=tmp_path)
    assert (chosen.chosen, chosen.predicted, chosen.simulator_calls) == (1, True, 0)
    assert json.loads((tmp_path / "selection.json").read_text())["kind"] == "predicted"
    assert Selection.load(tmp_path).predicted


def test_drawn_starts_are_beside_the_recorded_one_wherever_the_scenario_begins(recordings, tmp_path):
    with RecordedSimulator(recordings) as world:
        start = dataclasses.replace(world.scenario.start, x_m=world.scenario.start.x_m - 40.0)
        before = dataclasses.replace(world.scenario, start=start)
        options = {"weathers": (Weather.CLEAR_NOON,), "starts": 2, "runs": 0}
        told = evaluate(world, PaintShy(), before, BAR, folder=tmp_path, **options)
    assert len({trial.lateral_m for trial in told.trials}) == 2
    assert told.scenario.start == world.scenario.start


def test_the_speed_predicted_in_a_batch_is_that_of_a_drive_step_by_step(recordings):
    with RecordedSimulator(recordings) as simulator:
        scenario = briefly(simulator)
        clean, painted = (rollout(simulator, BrakeShy(), scenario, pattern=pattern) for pattern in (None, BAR))
    driven = speed_difference(clean, painted, CANVAS)
    world = RecordedWorld(recordings)
    world.fit(BrakeShy())
    predicted = world.predict(BrakeShy(), Pattern(BAR.shapes, BAR.boxes[None], BAR.colours[None]))
    assert driven.most_mps < driven.mean_mps < -0.1
    assert predicted.speed_change_mps[0, 0] == pytest.approx(driven.mean_mps, abs=0.03)


def test_what_was_searched_to_change_the_speed_is_chosen_by_it(recordings, tmp_path):
    faint = dataclasses.replace(BAR, colours=torch.full((1, 3), 0.4))
    aside = [Candidate(each, "all", 0.3) for each in (faint, BAR)]
    slower = [Candidate(each.pattern, "slower", 0.3, predicted_mps=-0.5) for each in aside]
    faster = [Candidate(each.pattern, "faster", 0.3, predicted_mps=0.5) for each in aside]
    told = []
    with RecordedSimulator(recordings) as world:

        def chosen(candidates, folder):
            given = {"best": 2, "folder": folder, "on_drive": lambda *progress: told.append(progress)}
            return select_by_driving(world, BrakeShy(), briefly(world), candidates, **given)

        found = chosen(slower, tmp_path / "one")
        changes = [each.trial.speed_change_mps for each in found.driven]
        assert (found.chosen, found.chosen_by) == (1, "speed change")
        assert changes[1] < changes[0] - 0.1
        assert told[-1] == (3, -changes[1])
        assert chosen(faster, tmp_path / "two").chosen == 0, "what brakes least is the fastest"
        assert Selection.load(tmp_path / "one").chosen_by == "speed change"
        with pytest.raises(RoadproofError, match="a choice with chosen_by 'speed change', now it is 'path deviation'"):
            chosen(aside, tmp_path / "one")
