"""Choosing by driving: what is driven, what is kept, and what is not taken for something else."""

import dataclasses
import json
import shutil

import pytest
import torch

import needs
from paint_shy import PaintShy, along_a_street
from roadproof.attacks import Candidate
from roadproof.coverage import Shape
from roadproof.datatypes import Weather
from roadproof.driving.drive_store import load_episodes
from roadproof.driving.evaluate import evaluate
from roadproof.driving.rollout import rollout
from roadproof.errors import EpisodeError, RoadproofError
from roadproof.patterns import Pattern
from roadproof.pipeline.selection import Selection, select_by_driving
from roadproof.scenarios import find_scenario

needs.town()


def candidate(group, size, blue=1.0):
    boxes = torch.tensor([[200.0, 200.0, size, size, 0.0]])
    pattern = Pattern((Shape.RECTANGLE,), boxes, torch.tensor([[1.0, 0, blue]]))
    return Candidate(group=group, pattern=pattern, surrogate_shift=0.1)


# The surrogate's order is the wrong one: the driver flees from much magenta, and the second has more.
CANDIDATES = [candidate("left", 60.0), candidate("left", 390.0), candidate("right", 30.0)]


@pytest.fixture(scope="module")
def street(tmp_path_factory):
    return along_a_street(tmp_path_factory.mktemp("street"), 3.0)


@pytest.fixture(scope="module")
def done(town, street, tmp_path_factory):
    folder, told = tmp_path_factory.mktemp("selection"), []
    selection = select_by_driving(
        town, PaintShy(), street, CANDIDATES, best=3, folder=folder, on_drive=lambda *args: told.append(args)
    )
    return folder, selection, told


def test_the_one_that_deviates_most_when_driven_is_chosen(done):
    _, selection, told = done
    deviations = [each.trial.deviation_m for each in selection.driven]
    assert [each.rank for each in selection.driven] == [1, 2, 3]
    assert selection.chosen == 1
    assert deviations[1] == max(deviations) == selection.deviation_m > 0.01
    assert torch.equal(selection.pattern.boxes, CANDIDATES[1].pattern.boxes)
    assert selection.simulator_calls == 4
    assert [n for n, _ in told] == [1, 2, 3, 4]
    assert told[-1][1] == selection.deviation_m


def test_every_group_is_driven_before_any_twice(done, town, street, tmp_path):
    selection = select_by_driving(town, PaintShy(), street, CANDIDATES, best=2, folder=tmp_path)
    assert [(each.group, each.rank) for each in selection.driven] == [("left", 1), ("right", 3)]
    assert [each.trial for each in selection.driven] != [each.trial for each in done[1].driven[:2]]


def test_a_second_call_reads_the_choice_and_drives_nothing(done, town, street):
    folder, selection, _ = done
    stamps = {path: path.stat().st_mtime_ns for path in folder.rglob("*.npz")}
    again = select_by_driving(town, PaintShy(), street, CANDIDATES, best=3, folder=folder)
    assert again.driven == selection.driven == Selection.load(folder).driven
    assert {path: path.stat().st_mtime_ns for path in folder.rglob("*.npz")} == stamps


def test_a_lost_choice_is_made_again_from_the_drives(done, town, street):
    folder, selection, _ = done
    stamps = {path: path.stat().st_mtime_ns for path in folder.rglob("*.npz")}
    (folder / "selection.json").unlink()
    again = select_by_driving(town, PaintShy(), street, CANDIDATES, best=3, folder=folder)
    assert again.driven == selection.driven
    assert {path: path.stat().st_mtime_ns for path in folder.rglob("*.npz")} == stamps


OTHERS = {
    "a choice of another controller, which answers otherwise": {"controller": PaintShy(gain=5.0)},
    "a choice with scenario.time_limit_s 3.0, now it is 2.0": {"scenario": {"time_limit_s": 2.0}},
    "a choice with weather 'clear-noon', now it is 'rainy-noon'": {"weather": Weather.RAINY_NOON},
    "a choice with patterns": {"candidates": [candidate("left", 60.0, blue=0.9), *CANDIDATES[1:]]},
    "a choice with candidates 3, now it is 2": {"best": 2},
}


@pytest.mark.parametrize("message", OTHERS)
def test_a_choice_of_other_inputs_is_refused(done, town, street, message):
    given = {"controller": PaintShy(), "candidates": CANDIDATES, "best": 3} | OTHERS[message]
    given["scenario"] = dataclasses.replace(street, **given.get("scenario", {}))
    with pytest.raises(RoadproofError, match=f"holds {message}"):
        select_by_driving(town, folder=done[0], **given)


def test_a_choice_that_does_not_say_what_it_was_made_of_is_refused(done, town, street, tmp_path):
    folder = shutil.copytree(done[0], tmp_path / "selection")
    path = folder / "selection.json"
    path.write_text(json.dumps({k: v for k, v in json.loads(path.read_text()).items() if k != "made_of"}))
    with pytest.raises(RoadproofError, match="holds a choice that does not say what it was made of; choose another fo"):
        select_by_driving(town, PaintShy(), street, CANDIDATES, best=3, folder=folder)


def test_the_clean_drive_that_is_given_is_not_made(town, street, tmp_path):
    clean = rollout(town, PaintShy(), street, weather=Weather.CLEAR_NOON)
    selection = select_by_driving(town, PaintShy(), street, CANDIDATES[:1], best=1, folder=tmp_path, clean=clean)
    assert selection.simulator_calls == 1
    (kept,) = load_episodes(tmp_path, [selection.driven[0].trial.clean])
    assert (kept.x_m == clean.x_m).all()


def test_an_evaluation_finds_the_bare_drive_of_a_selection(done, town, street):
    folder, selection, _ = done
    evaluation = evaluate(
        town, PaintShy(), street, selection.pattern, folder=folder, weathers=[Weather.CLEAR_NOON], starts=0, runs=0
    )
    assert evaluation.trials[0].clean == selection.driven[0].trial.clean
    assert evaluation.trials[0].deviation_m == selection.deviation_m, "the same drive again"


def test_a_canvas_that_is_never_reached_is_refused_before_any_paint_is_driven_over(town, tmp_path):
    far = dataclasses.replace(find_scenario("straight-08"), time_limit_s=1.0)
    with pytest.raises(EpisodeError, match="without paint the car never comes near the canvas"):
        select_by_driving(town, PaintShy(), far, CANDIDATES, best=3, folder=tmp_path)
    assert len(list(tmp_path.rglob("*.npz"))) == 1


def test_nothing_to_drive_is_refused(town, street, tmp_path):
    with pytest.raises(RoadproofError, match="0 candidates and 3 of them to drive"):
        select_by_driving(town, PaintShy(), street, [], best=3, folder=tmp_path)


def test_a_damaged_choice_is_refused_by_name(done, tmp_path):
    done[1].save(tmp_path)
    path = tmp_path / "selection.json"
    path.write_text(path.read_text().replace('"chosen": 1', '"chosen": 7'))
    with pytest.raises(RoadproofError, match="chosen 7 of 3"):
        Selection.load(tmp_path)
    path.write_text(path.read_text().replace('"clean": "', '"clean": "../'))
    with pytest.raises(RoadproofError, match="is not a plain name"):
        Selection.load(tmp_path)
