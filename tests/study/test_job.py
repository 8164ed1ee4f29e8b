"""Jobs of a study on the real town, with budgets as small as they can be."""

from __future__ import annotations

import dataclasses
import io
import json
import multiprocessing
import os
import shutil
import signal
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from safetensors.torch import load_file

import needs
from paint_shy import along_a_street
from roadproof.attacks import CMAES, AttackResult, GradOpt, PathDeviation, Published, SteeringShift, proposals
from roadproof.calibration import CalibrationMethod
from roadproof.controllers.shipped import installed_weights
from roadproof.datatypes import Weather
from roadproof.drives import Scheme, SteeringNoise, Swerve, Trajectories, Window
from roadproof.driving.starts import StartPlan
from roadproof.errors import StudyError
from roadproof.patterns import load_pattern
from roadproof.pipeline.budget import PUBLISHED, QUICK, STEERING
from roadproof.pipeline.stage_costs import read_cost
from roadproof.scenarios import find_scenario
from roadproof.simulators.town.simulator import TownSimulator
from roadproof.study import job as job_module
from roadproof.study.job import run_job, space_of
from roadproof.study.methods import BlackBoxPlan, GradOptPlan, PublishedPlan, budget_of
from roadproof.study.plan import Job, TrafficPlan, weights_digest
from roadproof.study.rows import CostColumns, DriveColumns, JobColumns, PaintColumns
from roadproof.study.shared import SharedRecordings, _link

COSTS = ("search_seconds", "seconds")
GRADOPT = GradOptPlan(
    name="GradOpt",
    objective="steering",
    trajectories=1,
    restarts=1,
    iterations=2,
    halving=False,
    frames=4,
    select=1,
)
BO = BlackBoxPlan(name="BO", search="published-bo", calls=3, random_calls=2, objective="steering")
CHANCE = BlackBoxPlan(name="chance", search="random", calls=4, objective="deviation")
ANY = find_scenario("left-01")


def job_of(method, scenario=ANY, **changes):
    job = Job(
        controller="pilotnet",
        scenario=scenario,
        figures=1,
        method=method,
        seed=0,
        weathers=(Weather.CLEAR_NOON,),
        traffic=None,
        starts=StartPlan(count=1),
    )
    return dataclasses.replace(job, **changes)


def timeless(rows):
    return [{name: value for name, value in row.items() if name not in COSTS} for row in rows]


@pytest.fixture(scope="module")
def street(tmp_path_factory):
    """A scenario that is driven in a second, on a street that is built in one."""
    needs.town()
    return along_a_street(tmp_path_factory.mktemp("street"))


@pytest.mark.slow
def test_gradopt_finds_and_is_judged_in_every_condition(street, tmp_path):
    traffic = TrafficPlan(cars=1, pedestrians=1, runs=1, weathers="first")
    job = job_of(GRADOPT, street, traffic=traffic, weathers=(Weather.CLEAR_NOON, Weather.RAINY_NOON))
    result = run_job(job, tmp_path / job.key)
    assert [(row["weather"], row["traffic"]) for row in result.rows] == [
        ("clear-noon", False),
        ("clear-noon", True),
        ("rainy-noon", False),
    ]
    parts = (DriveColumns, PaintColumns, CostColumns)
    columns = (*JobColumns.__annotations__, "controller", *(name for part in parts for name in part.__annotations__))
    assert all(sorted(row) == sorted(columns) for row in result.rows)
    assert {row["job"] for row in result.rows} == {job.key}
    first = result.rows[0]
    # One drive recorded, two to calibrate, one over the only candidate; a pair for each row.
    assert (first["search_calls"], first["evaluation_calls"]) == (4, 6)
    assert 0 < first["search_seconds"] < first["seconds"]
    history = json.loads(result.files["history.json"])
    assert (history["kind"], history["calls"]) == ("surrogate", [3, 3])
    assert history["best"] == sorted(history["best"])
    assert history["driven"]["calls"] == [4]
    # What chose the pattern is not what is reported: the drives that judge it begin elsewhere.
    assert history["driven"]["best"][0] > 0
    assert history["driven"]["best"] != [first["deviation_m"]]
    assert first["start_right_m"] != 0
    check_files(result, figures=1, conditions=("clear-noon", "clear-noon-traffic", "rainy-noon"))


def check_files(result, figures, conditions=("clear-noon",)):
    stored = np.load(io.BytesIO(result.files["paths.npz"]))
    assert stored["clean_xy"].shape[1] == stored["painted_xy"].shape[1] == 2
    assert np.ptp(stored["clean_xy"], 0).max() > 20
    views = {f"passage-{condition}.jpg" for condition in conditions}
    assert set(result.files) == {"pattern.json", "pattern.png", "paths.npz", "history.json"} | views
    for name in views:
        with Image.open(io.BytesIO(result.files[name])) as picture:
            assert picture.size == (6 * 240, 180)
            assert np.asarray(picture).std() > 10
    assert len({result.files[name] for name in views}) == len(views), "every condition looks different"
    assert len(json.loads(result.files["pattern.json"])["figures"]) == figures


def test_a_job_is_not_done_with_other_weights_than_it_is_known_by(tmp_path):
    weights = tmp_path / "own.safetensors"
    weights.write_bytes(b"one")
    job = job_of(GRADOPT, controller=f"pilotnet:{weights}", weights=weights_digest(f"pilotnet:{weights}"))
    weights.write_bytes(b"another")
    with pytest.raises(StudyError, match=r"own\.safetensors are no longer those that the study began with") as refused:
        run_job(job, tmp_path / "job")
    assert "\n" not in str(refused.value)
    weights.unlink()
    with pytest.raises(StudyError, match="no longer those"):
        run_job(job, tmp_path / "job")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("written", "told"), [("own.safetensors", "no longer those"), ("own.xodr", "has changed while the job ran")]
)
def test_files_that_are_written_again_while_a_job_runs_give_it_no_rows(street, tmp_path, monkeypatch, written, told):
    weights, roads, again = tmp_path / "own.safetensors", tmp_path / "own.xodr", tmp_path / written
    shutil.copy(installed_weights("pilotnet"), weights)
    shutil.copy(street.map_name, roads)
    here = dataclasses.replace(street, map_name=str(roads))
    job = job_of(GRADOPT, here, controller=str(weights), weights=weights_digest(str(weights)))
    search = job_module.stress_test

    def meanwhile(*args, **options):
        found = search(*args, **options)
        again.write_bytes(again.read_bytes() + b" ")
        return found

    assert run_job(job, tmp_path / "whole").rows
    monkeypatch.setattr(job_module, "stress_test", meanwhile)
    with pytest.raises(StudyError, match=told):
        run_job(job, tmp_path / "job")


@pytest.mark.slow
def test_jobs_share_what_they_record_and_drive_over_the_bare_road(street, tmp_path, monkeypatch):
    begun: list[bool] = []
    reset = TownSimulator.reset

    def counted(simulator, *args, **options):
        begun.append(options.get("pattern") is None)
        return reset(simulator, *args, **options)

    monkeypatch.setattr(TownSimulator, "reset", counted)
    one, two = (job_of(GRADOPT, street, figures=figures) for figures in (1, 2))
    run_job(one, tmp_path / "work" / one.key)
    # One recorded, two to calibrate, one over the candidate; two that judge, one for pictures.
    assert (len(begun), sum(begun)) == (7, 2)
    begun.clear()
    second = run_job(two, tmp_path / "work" / two.key)
    assert begun == [False] * 3
    alone = run_job(two, tmp_path / "alone" / two.key)
    assert timeless(second.rows) == timeless(alone.rows)
    assert second.files["pattern.json"] == alone.files["pattern.json"]
    costs = [read_cost(tmp_path / "work" / job.key) for job in (one, two)]
    recorded = [cost["record"].seconds + cost["calibrate"].seconds for cost in costs]
    assert recorded[1] < recorded[0] / 2
    told = json.loads(second.files["history.json"])["seconds"][0], second.rows[0]["search_seconds"]
    assert min(told) > recorded[0], "what was recorded for another counts"
    # Another seed, controller or budget shares nothing.
    (kept,) = (place for place in (tmp_path / "work" / "shared").iterdir() if (place / "run.json").exists())
    other = dataclasses.replace(one, seed=1)
    run_job(other, tmp_path / "work" / other.key)
    assert sum((place / "run.json").exists() for place in kept.parent.iterdir()) == 2
    # A run that has drives of its own is given none of another's.
    own = tmp_path / "own"
    shutil.copytree(kept / "record", own / "record")
    SharedRecordings(kept, ("clear-noon",)).bring(own)
    assert [each.name for each in own.iterdir()] == ["record"]
    # What is damaged is made again, and shared anew.
    bare = kept.parent.glob("*/episodes/*.npz")
    damaged = [*kept.glob("recordings/clean/*.npz"), kept / "calibration" / "report.json", *bare, kept / "run.json"]
    for file in damaged:
        content = file.read_bytes()
        file.unlink()
        file.write_bytes(content[: len(content) // 2])
    third = dataclasses.replace(one, figures=3)
    begun.clear()
    run_job(third, tmp_path / "work" / third.key)
    assert (len(begun), sum(begun)) == (7, 2)
    begun.clear()
    fourth = dataclasses.replace(one, figures=4)
    run_job(fourth, tmp_path / "work" / fourth.key)
    assert begun == [False] * 3


def test_where_links_are_refused_files_are_copied_whole(tmp_path, monkeypatch):
    def refuses(*_):
        raise OSError("links are not permitted")

    def interrupted(source, target):
        Path(target).write_bytes(Path(source).read_bytes()[:2])
        raise KeyboardInterrupt

    (tmp_path / "shared").mkdir()
    (tmp_path / "shared" / "clear-noon-alone-clean-0123456789ab.npz").write_bytes(b"a drive")
    monkeypatch.setattr(os, "link", refuses)
    copy = shutil.copy2
    monkeypatch.setattr(shutil, "copy2", interrupted)
    with pytest.raises(KeyboardInterrupt):
        _link(tmp_path / "shared", tmp_path / "job")
    assert not list((tmp_path / "job").iterdir())
    monkeypatch.setattr(shutil, "copy2", copy)
    _link(tmp_path / "shared", tmp_path / "job")
    assert [each.read_bytes() for each in (tmp_path / "job").iterdir()] == [b"a drive"]


@pytest.mark.slow
def test_the_published_baseline_is_driven_and_judged(street, tmp_path, monkeypatch):
    pytest.importorskip("sklearn", reason="scikit-learn is not installed")
    monkeypatch.setattr(proposals, "PUBLISHED_ACQUISITION", {"drawn": 100, "climbs": 1})
    result = run_job(job_of(BO, street), tmp_path / "job")
    (row,) = result.rows
    assert (row["search_calls"], row["evaluation_calls"]) == (4, 2)
    history = json.loads(result.files["history.json"])
    assert (history["kind"], history["measure"], history["calls"]) == ("closed loop", "steering", [2, 3, 4])
    assert history["best"] == sorted(history["best"])
    assert history["deviation_m"][-1] > 0
    check_files(result, figures=1)


@pytest.mark.slow
def test_a_black_box_search_may_begin_with_what_gradients_found(street, tmp_path, monkeypatch):
    hybrid = BlackBoxPlan(name="hybrid", search="random", start=1, calls=2)
    little = GradOpt(iterations=2, restarts=1, halving=False)
    small = dataclasses.replace(STEERING, method=little, trajectories=Trajectories(count=1), window=Window(frames=4))
    monkeypatch.setattr("roadproof.study.job.STEERING", small)
    result = run_job(job_of(hybrid, street), tmp_path / "job")
    (row,) = result.rows
    # One drive recorded and two to calibrate; then a clean one and two over patterns.
    assert row["search_calls"] == 6
    history = json.loads(result.files["history.json"])
    assert (history["kind"], history["calls"]) == ("closed loop", [5, 6])
    assert history["seconds"][0] > 1, "what came before counts"
    found = AttackResult.load(tmp_path / "job" / "start" / "attack")
    trials = load_file(tmp_path / "job" / "trials.safetensors")["unit"]
    first = space_of(job_of(hybrid)).pattern(trials[:1].float())
    assert torch.allclose(first.boxes[0], found.pattern.boxes, atol=1e-3)
    check_files(result, figures=1)


@pytest.mark.slow
def test_black_box_search_killed_in_a_job_goes_on_with_the_next_call(street, tmp_path):
    job = job_of(CHANCE, street, figures="1-b")
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
    assert dataclasses.replace(QUICK, weathers=(Weather.CLEAR_NOON,)) == budget_of(
        GradOptPlan(name="a"), Weather.CLEAR_NOON
    )
    plan = GradOptPlan(name="b", objective="steering", trajectories=5, swerves_m=(1.5, 0.8), weaves_m=(), select=3)
    budget = budget_of(plan, Weather.CLEAR_NOON)
    assert (budget.objective, budget.calibration) == (SteeringShift(), CalibrationMethod.TWO_PAINT)
    assert budget.trajectories == Trajectories(count=5, perturbation=Swerve((1.5, 0.8)))
    assert (budget.pooled, budget.select) == (False, 3)
    for scheme, recorded in (("group-all", Scheme.GROUP), ("random", Scheme.RANDOM)):
        budget = budget_of(GradOptPlan(name="c", objective="steering", scheme=scheme), Weather.CLEAR_NOON)
        assert (budget.pooled, budget.trajectories.scheme) == (True, recorded)
    noisy = budget_of(GradOptPlan(name="d", noise_deg=(4, 20)), Weather.CLEAR_NOON)
    assert noisy.trajectories.perturbation == SteeringNoise(4, 20)


def test_a_published_method_is_the_published_budget():
    budget = budget_of(PublishedPlan(name="a", masks="antialiased"), Weather.CLEAR_NOON)
    assert budget.method == Published(masks="antialiased")
    same = dataclasses.replace(budget, method=Published(), weathers=PUBLISHED.weathers, runs=PUBLISHED.runs)
    assert same == PUBLISHED


def test_a_black_box_may_drive_in_the_recorded_world():
    plan = BlackBoxPlan(name="a", search="cma-es", calls=50, where="recorded")
    budget = budget_of(plan, Weather.CLEAR_NOON)
    assert budget.method == CMAES(calls=50)
    assert (budget.objective, budget.trajectories) == (PathDeviation(), QUICK.trajectories)


def test_the_baseline_has_bounds_of_its_own():
    assert space_of(job_of(BO)).family == "published-bo"
    assert space_of(job_of(GRADOPT)).family == "published"
    assert space_of(job_of(GRADOPT, figures=4)).figures == 4
    black = space_of(job_of(GRADOPT, figures="1-b"))
    assert (black.figures, black.colour) == (1, False)
