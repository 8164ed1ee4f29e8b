"""Evaluations in the town itself: what is driven, what is judged, what is not driven twice."""

import dataclasses
import functools
import json
import math
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

import bad_drivers
import needs
from paint_shy import PaintShy, along_a_street, magenta
from roadproof.controllers import load_controller
from roadproof.datatypes import Control, Weather
from roadproof.driving.deviation import deviation_m, lateral_m, passage, path_of
from roadproof.driving.drive_store import CLEAN, DriveConditions, Episodes, driver_in_words, load_episodes
from roadproof.driving.episode import Episode
from roadproof.driving.evaluate import evaluate, random_patterns
from roadproof.driving.evaluation import Evaluation, load_paint
from roadproof.driving.infractions import infraction_points
from roadproof.driving.rollout import rollout
from roadproof.driving.starts import StartOffset, StartPlan, StartRange, require_on_road
from roadproof.errors import ControllerError, EpisodeError, OutputError, PatternError, SimulatorError
from roadproof.patterns import Pattern, raster
from roadproof.pipeline.budget import QUICK
from roadproof.pipeline.stress_test import stress_test
from roadproof.roads.maps import builtin_map_file
from roadproof.scenarios import builtin_scenarios, find_scenario, identity

needs.town()
from roadproof.simulators.protocol import world_of
from roadproof.simulators.town.simulator import TownSimulator
from runs import write_evaluation

MAGENTA = magenta(380.0)
WEATHERS = (Weather.CLEAR_NOON, Weather.CLOUDY_NOON)
CONDITIONS = {"weathers": WEATHERS, "starts": 0, "runs": 2, "cars": 2, "pedestrians": 2, "seed": 3}


@pytest.fixture(scope="module")
def street(tmp_path_factory):
    return along_a_street(tmp_path_factory.mktemp("street"), 2.5)


@pytest.fixture(scope="module")
def done(town, street, tmp_path_factory):
    folder = tmp_path_factory.mktemp("evaluation")
    told = []
    evaluation = evaluate(
        town,
        PaintShy(),
        street,
        MAGENTA,
        folder=folder,
        baseline=random_patterns(MAGENTA, 1, seed=1),
        on_drive=lambda *args: told.append(args),
        **CONDITIONS,
    )
    return folder, evaluation, told


def test_every_condition_is_driven_bare_and_over_every_pattern(done):
    folder, evaluation, told = done
    conditions = [(trial.pattern, trial.weather, trial.traffic, trial.seed) for trial in evaluation.trials]
    expected = [
        (pattern, weather, traffic, seed)
        for weather in WEATHERS
        for traffic, seed in ((False, 3), (True, 3), (True, 4))
        for pattern in ("attack", "random-1")
    ]
    assert conditions == expected
    # Clean drives are shared between the patterns.
    assert evaluation.simulator_calls == 2 * 3 * 3 == len(list((folder / "episodes").iterdir()))
    assert told == [(k, 18) for k in range(19)]


def test_trials_are_the_metrics_of_their_two_episodes(done, street):
    folder, evaluation, _ = done
    for trial in evaluation.trials:
        clean, painted = load_episodes(folder, (trial.clean, trial.painted))
        assert (clean.painted, painted.painted) == (False, True)
        assert (clean.weather, clean.cars, clean.seed) == (painted.weather, painted.cars, painted.seed)
        assert (clean.weather, clean.cars > 0, clean.seed) == (trial.weather, trial.traffic, trial.seed)
        seen = passage(path_of(clean), street.canvas)
        assert trial.deviation_m == deviation_m(path_of(clean)[seen], path_of(painted)[seen])
        assert abs(trial.lateral_m) == np.abs(lateral_m(path_of(clean), path_of(painted))).max()
        assert (trial.points, trial.clean_points) == (
            infraction_points(painted.events),
            infraction_points(clean.events),
        )


def test_the_paint_moves_the_car_to_where_the_driver_flees(done):
    _, evaluation, _ = done
    for trial in evaluation.of("attack", traffic=False):
        assert trial.lateral_m < -0.1, "to the right"
        assert trial.deviation_m > 0.01


def test_an_episode_is_the_plain_rollout_of_its_conditions(done, town, street):
    folder, evaluation, _ = done
    trial = evaluation.of("attack", traffic=True, weather=Weather.CLOUDY_NOON)[1]
    (kept,) = load_episodes(folder, [trial.painted])
    again = rollout(
        town, PaintShy(), street, weather=Weather.CLOUDY_NOON, pattern=MAGENTA, cars=2, pedestrians=2, seed=4
    )
    assert all(np.array_equal(getattr(kept, f.name), getattr(again, f.name)) for f in dataclasses.fields(Episode))


def test_rows_average_the_trials_and_lose_none(done):
    _, evaluation, _ = done
    rows = evaluation.rows()
    assert [(row.pattern, row.traffic, row.weather) for row in rows] == [
        (pattern, traffic, weather)
        for pattern in ("attack", "random")
        for traffic in (False, True)
        for weather in (*WEATHERS, None)
    ]
    for row in rows:
        trials = evaluation.of(row.pattern, traffic=row.traffic, weather=row.weather)
        assert row.count == len(trials)
        runs = {(trial.pattern, trial.seed, trial.start) for trial in trials}
        assert row.points.count == len(runs), "the same run in two weathers is one run"
        assert row.deviation_m.value == pytest.approx(np.mean([trial.deviation_m for trial in trials]))
        assert row.failed == pytest.approx(np.mean([trial.first_event_s is not None for trial in trials]))
        single = len(runs) == 1 or (row.pattern == "attack" and not row.traffic)
        assert (row.deviation_m.high is None) == single, "weathers are no sample"


def test_what_is_saved_is_what_is_loaded(done, street):
    folder, evaluation, _ = done
    loaded = Evaluation.load(folder)
    # The map of its own lies beside it.
    assert identity(loaded.scenario) == identity(street)
    assert dataclasses.replace(loaded, scenario=street) == evaluation
    assert np.array_equal(load_paint(folder), raster(MAGENTA))
    content = json.loads((folder / "evaluation.json").read_text())
    assert content["kind"] == "closed loop"
    assert len(content["trials"]) == 12
    assert len(content["rows"]) == 12


def test_a_second_call_drives_nothing_and_a_lost_drive_alone_is_made_again(done, town, street):
    folder, evaluation, _ = done
    stamps = {path.name: path.stat().st_mtime_ns for path in (folder / "episodes").iterdir()}
    lost = evaluation.trials[-1].painted
    (folder / "episodes" / lost).unlink()
    again = evaluate(
        town, PaintShy(), street, MAGENTA, folder=folder, baseline=random_patterns(MAGENTA, 1, seed=1), **CONDITIONS
    )
    assert again.trials == evaluation.trials
    now = {path.name: path.stat().st_mtime_ns for path in (folder / "episodes").iterdir()}
    assert {name for name in now if now[name] != stamps[name]} == {lost}


def test_other_inputs_are_other_drives(done, town, street):
    folder = done[0]
    one = {"weathers": WEATHERS[:1], "starts": 0, "runs": 0, "seed": 3}
    known = {path.name for path in (folder / "episodes").iterdir()}

    def files(driver, pattern, scenario=street):
        made = evaluate(town, driver, scenario, pattern, folder=folder, **one).trials[0]
        return made.clean in known, made.painted in known

    other = Pattern(MAGENTA.shapes, MAGENTA.boxes, torch.tensor([[1.0, 0, 0.9]]))
    assert files(PaintShy(), MAGENTA) == (True, True)
    assert files(PaintShy(), other) == (True, False), "another paint, the same bare road"
    assert files(PaintShy(gain=5.0), MAGENTA) == (False, False), "a controller that answers otherwise"
    assert files(PaintShy(), MAGENTA, dataclasses.replace(street, time_limit_s=2.0)) == (False, False)


@pytest.mark.slow
def test_two_processes_drive_what_one_does(done, street, tmp_path):
    _, evaluation, _ = done
    together = evaluate(
        TownSimulator,
        PaintShy(),
        street,
        MAGENTA,
        folder=tmp_path,
        weathers=WEATHERS[:1],
        starts=0,
        runs=1,
        cars=2,
        pedestrians=2,
        seed=3,
        processes=2,
    )
    assert together.trials == tuple(
        trial
        for trial in evaluation.trials
        if trial.pattern == "attack" and trial.seed == 3 and trial.weather == WEATHERS[0]
    )


def test_random_patterns_are_drawn_by_their_seed():
    one, two, other = (random_patterns(MAGENTA, 3, seed=seed) for seed in (5, 5, 6))
    assert len(one) == 3
    assert all(
        torch.equal(a.boxes, b.boxes) and torch.equal(a.colours, b.colours) for a, b in zip(one, two, strict=True)
    )
    assert not torch.equal(one[0].boxes, other[0].boxes)
    assert len(one[0].shapes) == len(MAGENTA.shapes)


MISTAKES = {
    "0 weathers": {"weathers": ()},
    "-1 runs": {"runs": -1},
    "-1 starts": {"starts": -1},
    "no cars and no pedestrians": {"runs": 2, "cars": 0, "pedestrians": 0},
    "need a simulator each": {"processes": 2},
}


@pytest.mark.parametrize("message", MISTAKES)
def test_conditions_that_make_no_sense_are_refused(town, street, tmp_path, message):
    with pytest.raises(EpisodeError, match=message):
        evaluate(town, PaintShy(), street, MAGENTA, folder=tmp_path, **MISTAKES[message])
    assert list(tmp_path.iterdir()) == []


def test_a_drive_is_told_of_once_however_often_it_is_asked_for(town, street, tmp_path):
    with pytest.raises(EpisodeError, match="weathers has clear-noon twice"):
        evaluate(town, PaintShy(), street, MAGENTA, folder=tmp_path, weathers=(WEATHERS[0], WEATHERS[0]))
    with pytest.raises(EpisodeError, match="seed is -1, expected a whole number from 0 to"):
        evaluate(town, PaintShy(), street, MAGENTA, folder=tmp_path, seed=-1)
    nowhere = StartRange(right_m=0.0, turned_rad=0.0, faster_mps=0.0)
    options = {"weathers": WEATHERS[:1], "starts": 3, "start_range": nowhere, "runs": 0}
    told = evaluate(town, PaintShy(), street, MAGENTA, folder=tmp_path, **options)
    assert (len(told.trials), told.simulator_calls, told.rows()[0].deviation_m.low) == (1, 2, None)


def test_a_pattern_is_judged_from_starts_that_did_not_choose_it(town, street, tmp_path):
    narrow = StartRange(right_m=0.2, turned_rad=0.02, faster_mps=1.0)
    options = {"weathers": WEATHERS, "starts": 3, "start_range": narrow, "runs": 1, "cars": 1, "seed": 3}
    told = evaluate(town, PaintShy(), street, MAGENTA, folder=tmp_path, **options)
    alone = told.of(traffic=False, weather=WEATHERS[0])
    starts = [trial.start for trial in alone]
    assert (
        starts == list(narrow.draw(3, seed=3)) == [trial.start for trial in told.of(traffic=False, weather=WEATHERS[1])]
    )
    assert len(set(starts)) == 3
    assert told.of(traffic=True)[0].start == starts[0]
    for trial in alone:
        clean, painted = load_episodes(tmp_path, (trial.clean, trial.painted))
        right = math.sin(street.start.yaw_rad) * (clean.x_m[0] - street.start.x_m)
        right -= math.cos(street.start.yaw_rad) * (clean.y_m[0] - street.start.y_m)
        assert right == pytest.approx(trial.start.right_m, abs=1e-3)
        assert clean.speed_mps[0] - street.start.speed_mps == pytest.approx(trial.start.faster_mps, abs=1e-3)
        assert (painted.x_m[0], painted.yaw_rad[0]) == (clean.x_m[0], clean.yaw_rad[0])
    row = told.rows()[0]
    deviations = sorted(trial.deviation_m for trial in alone)
    assert (row.count, row.median_m, row.least_m, row.most_m) == (3, deviations[1], deviations[0], deviations[2])
    assert row.left_lane == np.mean([trial.leaves_lane for trial in alone])
    assert row.deviation_m.low is not None, "drawn starts are a sample"
    assert Evaluation.load(tmp_path).trials == told.trials
    assert Evaluation.load(tmp_path).start_range == narrow


def waits_among_others(simulator):
    """Drives on, but for who sees another car on the road, which stands."""
    waits = len(simulator.cars) > 0
    return lambda _seen: Control(0.0, throttle=0.0 if waits else 0.5, brake=1.0 if waits else 0.0)


def test_what_never_came_to_the_canvas_without_paint_is_no_comparison(town, tmp_path):
    far = dataclasses.replace(find_scenario("straight-08"), time_limit_s=8.0)
    options = {"weathers": WEATHERS[:1], "starts": 0, "runs": 1, "pedestrians": 0}
    told = evaluate(town, waits_among_others, far, MAGENTA, folder=tmp_path / "one", cars=1, **options)
    assert ([trial.traffic for trial in told.trials], told.left_out) == ([False], 1)
    assert Evaluation.load(tmp_path / "one").left_out == 1
    with pytest.raises(EpisodeError, match="without paint the car never comes near the canvas of straight-08"):
        evaluate(town, stands, far, MAGENTA, folder=tmp_path / "none", cars=1, **options)


def stands(_simulator):
    return lambda _seen: Control(0.0, brake=1.0)


WRONG_STARTS = [{"right_m": 1.5}, {"turned_rad": -0.1}, {"faster_mps": math.nan}]


@pytest.mark.parametrize("wrong", WRONG_STARTS, ids=str)
def test_starts_off_any_road_are_refused(wrong):
    name, value = next(iter(wrong.items()))
    with pytest.raises(EpisodeError, match=f"{name} of the starts is {value!r}, expected a number from 0 to"):
        StartRange(**wrong)


def test_starts_off_the_road_that_is_driven_are_refused_before_anything_is(town, tmp_path):
    scenario, wide = find_scenario("straight-02"), StartRange(right_m=1.0, turned_rad=0.3)
    with pytest.raises(EpisodeError, match=r"starts of straight-02 reach 1 m to the .* where a wheel is off"):
        evaluate(town, PaintShy(), scenario, MAGENTA, folder=tmp_path / "out", starts=1, start_range=wide)
    with pytest.raises(EpisodeError, match="where a wheel is off the road"):
        stress_test(
            town,
            load_controller("pilotnet"),
            scenario,
            tmp_path / "out",
            budget=dataclasses.replace(QUICK, starts=1, start_range=wide),
        )
    assert not (tmp_path / "out").exists()
    for each in builtin_scenarios():
        require_on_road(StartRange(), each, town)
    require_on_road(wide, scenario, object())  # nobody knows the road
    aside = dataclasses.replace(scenario, start=StartOffset(right_m=3.0).of(scenario).start)
    require_on_road(wide, aside, town)  # whoever begins beside the road meant it


def test_a_range_of_minus_nothing_is_one_of_nothing():
    assert StartRange(right_m=-0.0, turned_rad=-0.0, faster_mps=-0.0).draw(1, 0) == (StartOffset(),)


def test_starts_that_are_drawn_twice_or_choose_patterns_are_refused():
    StartPlan().check_drawn(range(20))
    with pytest.raises(EpisodeError, match="starts has 5 that differ among the 10 drawn, expected all to"):
        StartPlan().check_drawn([3, 3])
    rounded = StartPlan(count=1, right_m=0.00004, turned_rad=0.00004, faster_mps=0.00004)
    (start,) = rounded.range.draw(1, 0)
    assert math.copysign(1.0, min(start.right_m, start.turned_rad)) == -1.0, "so that this is about −0.0"
    with pytest.raises(EpisodeError, match="the scenario's own"):
        rounded.check_drawn([0])


def test_a_controller_that_cannot_travel_is_refused_before_anything_is_driven(street, tmp_path):
    class Local(bad_drivers.Honest):
        pass

    with pytest.raises(ControllerError, match=r"pickling the controller raised \w+: Can't.* its class in a module"):
        evaluate(TownSimulator, Local(), street, MAGENTA, folder=tmp_path, processes=2)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_what_fails_in_one_process_stops_the_others(street, tmp_path):
    driver = bad_drivers.FailingInOneWorker(str(tmp_path / "taken"))
    with pytest.raises(ControllerError, match="ZeroDivisionError"):
        evaluate(
            TownSimulator, driver, street, MAGENTA, folder=tmp_path / "drives", weathers=WEATHERS, starts=20, runs=0,
            processes=2,
        )  # fmt: skip
    assert len(list((tmp_path / "drives").glob("episodes/*"))) < 20


def test_a_function_with_arguments_is_known_by_them():
    drive = functools.partial(random_patterns, seed=1)
    assert driver_in_words(drive) == "random_patterns with (), {'seed': 1}"
    assert driver_in_words(drive) != driver_in_words(functools.partial(random_patterns, seed=2))


def test_an_edited_function_makes_other_drives(town, street, tmp_path):
    def made(gain):
        return lambda world: lambda seen: gain

    bare = DriveConditions(paint=CLEAN, weather=Weather.CLEAR_NOON)
    drivers = made(1), made(2), lambda world: lambda seen: 1, functools.partial(made(1), None)
    names = [Episodes.of(town, each, street, {}, tmp_path).file(bare) for each in (*drivers, made(1))]
    assert len(set(names)) == 4
    assert names[-1] == names[0]


class Slippery(TownSimulator):
    """A simulator of a user's own."""

    def __init__(self, friction):
        super().__init__()
        self.friction = friction


def test_a_simulator_of_ones_own_with_other_settings_makes_other_drives(street, tmp_path):
    bare = DriveConditions(paint=CLEAN, weather=Weather.CLEAR_NOON)
    worlds = Slippery(1.0), Slippery(0.2), TownSimulator(), Slippery(1.0)
    names = [Episodes.of(each, PaintShy(), street, {}, tmp_path).file(bare) for each in worlds]
    assert len(set(names)) == 3
    assert names[-1] == names[0]
    assert len({world_of(each) for each in worlds}) == 3
    assert world_of(TownSimulator()) == ""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("driver", "error", "message"),
    [
        (bad_drivers.DyingInWorkers, SimulatorError, "a driving process died"),
        (
            bad_drivers.FailingInWorkers,
            ControllerError,
            r"act raised ZeroDivisionError at \S*bad_drivers\.py:\d+",
        ),
        (
            bad_drivers.FailingFunction,
            ControllerError,
            r"the driver raised ZeroDivisionError at \S*bad_drivers\.py:\d+",
        ),
    ],
)
def test_what_fails_in_a_process_is_one_line_here(street, tmp_path, driver, error, message):
    with pytest.raises(error, match=message) as told:
        evaluate(TownSimulator, driver(), street, MAGENTA, folder=tmp_path, weathers=WEATHERS, runs=0, processes=2)
    assert "\n" not in str(told.value)


def test_a_simulator_that_cannot_travel_is_one_line_before_anything_is_driven(street, tmp_path):
    asked = {"folder": tmp_path / "drives", "weathers": WEATHERS, "runs": 0, "processes": 2}
    with pytest.raises(SimulatorError, match=r"opens a simulator .* cannot travel there: .*; give a function of"):
        evaluate(lambda: TownSimulator(), PaintShy(), street, MAGENTA, **asked)
    assert not list(tmp_path.rglob("*.npz"))


def test_a_plan_of_starts_draws_as_its_range_does():
    assert StartPlan(count=3, right_m=0.2).draw(3, 1) == StartRange(right_m=0.2).draw(3, 1)


def test_no_trials_stand_beside_another_paint(town, street, tmp_path, monkeypatch):
    asked = {"folder": tmp_path, "weathers": WEATHERS[:1], "starts": 0, "runs": 0}
    evaluate(town, PaintShy(), street, MAGENTA, **asked)

    def full(*_):
        raise OutputError("No space left")

    monkeypatch.setattr("roadproof.driving.evaluation.write_atomically", full)
    with pytest.raises(OutputError):
        evaluate(town, PaintShy(), street, magenta(100.0), **asked)
    assert not (tmp_path / "evaluation.json").exists()


def test_a_pattern_that_paints_nothing_is_refused(town, street, tmp_path):
    with pytest.raises(PatternError, match="paints nothing"):
        evaluate(town, PaintShy(), street, np.zeros((400, 400, 4), np.uint8), folder=tmp_path)


def test_starts_that_are_all_the_same_count_once(town, street, tmp_path):
    nowhere = StartRange(right_m=0.0, turned_rad=0.0, faster_mps=0.0)
    told = evaluate(
        town, PaintShy(), street, MAGENTA, folder=tmp_path, weathers=WEATHERS[:1], starts=5, start_range=nowhere, runs=0
    )
    assert (len(told.trials), told.starts) == (1, 1)


DAMAGE = {
    "is not valid JSON": lambda text: text[:100],
    "required field `trials`": lambda text: text.replace('"trials"', '"trails"'),
    "is not a plain name": lambda text: text.replace('"clean": "', '"clean": "../'),
    "has version 9": lambda text: text.replace('"version": 1', '"version": 9'),
    "Invalid enum value 'dry'": lambda text: text.replace('"clear-noon"', '"dry"'),
    "no drive over its pattern alone": lambda text: json.dumps(json.loads(text) | {"trials": []}),
}


@pytest.mark.parametrize("message", DAMAGE)
def test_a_damaged_evaluation_is_refused_by_name(done, tmp_path, message):
    evaluation = done[1]
    evaluation.save(tmp_path, raster(MAGENTA))
    path = tmp_path / "evaluation.json"
    path.write_text(DAMAGE[message](path.read_text()))
    with pytest.raises(EpisodeError, match=message):
        Evaluation.load(tmp_path)


def test_an_evaluation_on_a_map_of_any_name_can_be_read_again(tmp_path):
    own = tmp_path / "O'Hare.xodr"
    shutil.copy(builtin_map_file("town"), own)
    write_evaluation(
        tmp_path / "run", scenario=dataclasses.replace(find_scenario("left-03"), map_name=str(own)), runs=0
    )
    found = Evaluation.load(tmp_path / "run")
    assert Path(found.scenario.map_name).read_bytes() == own.read_bytes()
