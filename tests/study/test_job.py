"""Jobs of a study on the real town, with budgets as small as they can be."""

from __future__ import annotations

import dataclasses
import io
import json
import multiprocessing
import os
import signal
import time

import numpy as np
import pytest
import torch
from PIL import Image
from safetensors.torch import load_file

import needs
from roadproof.attacks import AttackResult, PathDeviation, Schedule, SteeringShift, proposals
from roadproof.calibration import Method
from roadproof.datatypes import Weather
from roadproof.drives import Scheme
from roadproof.patterns import load_pattern
from roadproof.study.job import MEASURED, budget_of, run_job, space_of
from roadproof.study.plan import Job, MethodPlan, TrafficPlan
from roadproof.study.rows import JOB_COLUMNS
from short_drive import SHORT

COSTS = ("search_seconds", "seconds")
GRADOPT = MethodPlan(
    name="GradOpt",
    search="gradopt",
    trajectories=1,
    restarts=1,
    iterations=2,
    schedule="published",
    frames=4,
    select=1,
)
BO = MethodPlan(name="BO", search="published-bo", calls=3, random_calls=2)
CHANCE = MethodPlan(name="chance", search="random", calls=4, objective="deviation")


def job_of(method, figures=1, **changes):
    job = Job(
        controller="pilotnet",
        scenario=SHORT,
        figures=figures,
        method=method,
        seed=0,
        weathers=(Weather.CLEAR_NOON,),
        traffic=None,
    )
    return dataclasses.replace(job, **changes)


def timeless(rows):
    return [{name: value for name, value in row.items() if name not in COSTS} for row in rows]


@pytest.fixture
def _town():
    needs.town()


@pytest.mark.slow
@pytest.mark.usefixtures("_town")
def test_gradopt_finds_and_is_judged_in_every_condition(tmp_path):
    traffic = TrafficPlan(cars=1, pedestrians=1, runs=1, weathers="first")
    job = job_of(GRADOPT, traffic=traffic, weathers=(Weather.CLEAR_NOON, Weather.RAINY_NOON))
    result = run_job(job, tmp_path)
    assert [(row["weather"], row["traffic"]) for row in result.rows] == [
        ("clear-noon", False),
        ("clear-noon", True),
        ("rainy-noon", False),
    ]
    assert all(tuple(row) == (*JOB_COLUMNS, *MEASURED) for row in result.rows)
    first = result.rows[0]
    # One drive recorded, two to calibrate, one over the only candidate; a pair for each row.
    assert (first["search_calls"], first["evaluation_calls"]) == (4, 6)
    assert 0 < first["search_seconds"] < first["seconds"]
    history = json.loads(result.files["history.json"])
    assert (history["kind"], history["calls"]) == ("surrogate", [3, 3])
    assert history["best"] == sorted(history["best"])
    assert history["driven"]["calls"] == [4]
    assert history["driven"]["best"] == [first["deviation_m"]]
    check_files(result, figures=1, weathers=("clear-noon", "rainy-noon"))


def check_files(result, figures, weathers=("clear-noon",)):
    stored = np.load(io.BytesIO(result.files["paths.npz"]))
    assert stored["clean_xy"].shape[1] == stored["painted_xy"].shape[1] == 2
    assert np.ptp(stored["clean_xy"], 0).max() > 20
    views = {f"view-{weather}.jpg" for weather in weathers}
    assert set(result.files) == {"pattern.json", "pattern.png", "paths.npz", "history.json"} | views
    for name in views:
        with Image.open(io.BytesIO(result.files[name])) as picture:
            assert picture.size == (400, 300)
            assert np.asarray(picture).std() > 10
    assert len({result.files[name] for name in views}) == len(views), "every weather looks different"
    assert len(json.loads(result.files["pattern.json"])["figures"]) == figures


@pytest.mark.slow
@pytest.mark.usefixtures("_town")
def test_the_published_baseline_is_driven_and_judged(tmp_path, monkeypatch):
    pytest.importorskip("bayes_opt", reason="bayesian-optimization is not installed")
    monkeypatch.setattr(proposals, "PUBLISHED_ACQUISITION", {"n_random": 100, "n_smart": 1})
    result = run_job(job_of(BO), tmp_path)
    (row,) = result.rows
    assert (row["search_calls"], row["evaluation_calls"]) == (4, 2)
    history = json.loads(result.files["history.json"])
    assert (history["kind"], history["measure"], history["calls"]) == ("closed loop", "steering", [2, 3, 4])
    assert history["best"] == sorted(history["best"])
    assert history["deviation_m"][-1] == row["deviation_m"] > 0
    check_files(result, figures=1)


@pytest.mark.slow
@pytest.mark.usefixtures("_town")
def test_a_black_box_search_may_begin_with_what_gradients_found(tmp_path):
    hybrid = dataclasses.replace(
        GRADOPT, name="hybrid", search="random", start="gradopt", calls=2, objective="deviation"
    )
    result = run_job(job_of(hybrid), tmp_path)
    (row,) = result.rows
    # One drive recorded and two to calibrate; then a clean one and two over patterns.
    assert row["search_calls"] == 6
    history = json.loads(result.files["history.json"])
    assert (history["kind"], history["calls"]) == ("closed loop", [5, 6])
    assert history["seconds"][0] > 1, "what came before counts"
    found = AttackResult.load(tmp_path / "start" / "attack")
    trials = load_file(tmp_path / "trials.safetensors")["unit"]
    first = space_of(job_of(hybrid)).pattern(trials[:1].float())
    assert torch.allclose(first.boxes[0], found.pattern.boxes, atol=1e-3)
    check_files(result, figures=1)


@pytest.mark.slow
@pytest.mark.usefixtures("_town")
def test_black_box_search_killed_in_a_job_goes_on_with_the_next_call(tmp_path):
    job = job_of(CHANCE, figures="1-b")
    straight = run_job(job, tmp_path / "straight")
    done = killed_within(job, tmp_path / "killed", calls=2)
    resumed = run_job(job, tmp_path / "killed")
    assert timeless(resumed.rows) == timeless(straight.rows)
    assert straight.rows[0]["search_calls"] == 1 + CHANCE.calls
    assert resumed.files["pattern.json"] == straight.files["pattern.json"]
    one, two = (json.loads(result.files["history.json"]) for result in (straight, resumed))
    assert {**one, "seconds": None} == {**two, "seconds": None}
    assert one["calls"] == [2, 3, 4, 5]
    assert one["best"] == one["deviation_m"] == sorted(one["best"])
    assert one["best"][-1] == straight.rows[0]["deviation_m"]
    assert 2 <= len(done) < CHANCE.calls
    assert two["seconds"][: len(done)] == done
    (tmp_path / "pattern.json").write_bytes(straight.files["pattern.json"])
    assert (load_pattern(tmp_path / "pattern.json").colours == 0).all()


def killed_within(job, scratch, *, calls):
    """Kill a job after so many calls of its search; gives the seconds of the calls it had done."""
    from safetensors.numpy import load_file

    process = multiprocessing.get_context("spawn").Process(target=run_job, args=(job, scratch))
    process.start()
    trials = scratch / "trials.safetensors"
    until = time.monotonic() + 120
    while not (trials.exists() and len(load_file(trials)["value"]) >= calls):
        assert time.monotonic() < until, "the search does not get on"
        assert process.is_alive()
        time.sleep(0.01)
    os.kill(process.pid, signal.SIGKILL)
    process.join()
    return load_file(trials)["seconds"].tolist()


def test_a_method_says_what_is_spent():
    plan = MethodPlan(name="a", search="gradopt", trajectories=5, schedule="heats", iterations=40, select=3)
    budget = budget_of(plan, Weather.CLEAR_NOON)
    assert budget.schedule == Schedule.in_heats(40)
    assert budget.calibration is Method.TWO_PAINT
    assert (budget.deviations_m, budget.pooled, budget.select) == ((1.5, 0.8), False, 3)
    published = budget_of(MethodPlan(name="b", search="gradopt", calibration="published"), Weather.CLEAR_NOON)
    assert published.schedule == Schedule()
    assert published.calibration is Method.PUBLISHED
    for scheme, recorded in (("group-all", Scheme.GROUP), ("random", Scheme.RANDOM)):
        budget = budget_of(MethodPlan(name="c", search="gradopt", scheme=scheme), Weather.CLEAR_NOON)
        assert (budget.pooled, budget.scheme, budget.deviations_m) == (True, recorded, (1.5,))


def test_a_black_box_begins_from_the_steering_shift_whatever_it_is_given_itself():
    hybrid = MethodPlan(name="d", search="cma-es", objective="deviation", start="gradopt", select=4, schedule="heats")
    assert budget_of(hybrid, Weather.CLEAR_NOON).objective == SteeringShift()
    assert budget_of(hybrid, Weather.CLEAR_NOON).schedule == Schedule.in_heats(250)
    own = MethodPlan(name="e", search="gradopt", objective="deviation", schedule="heats")
    assert budget_of(own, Weather.CLEAR_NOON).objective == PathDeviation()
    assert budget_of(own, Weather.CLEAR_NOON).schedule == Schedule.closed_loop(250)


def test_the_baseline_has_bounds_of_its_own():
    assert space_of(job_of(BO)).family == "published-bo"
    assert space_of(job_of(GRADOPT)).family == "published"
    assert space_of(job_of(GRADOPT, figures=4)).figures == 4
    black = space_of(job_of(GRADOPT, figures="1-b"))
    assert (black.figures, black.colour) == (1, False)
