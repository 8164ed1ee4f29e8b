"""The whole of it, tiny: every round leaves its files, a stopped one goes on to the same, another is refused."""

import dataclasses
import json
import math
from functools import partial

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

import needs
from carla_serving import straight_map
from roadproof.attacks import GradOpt, RandomSearch
from roadproof.controllers import ConditionalPilotNet, load_controller, save_controller
from roadproof.controllers.loading import load_trainable
from roadproof.datatypes import VehicleState, Weather
from roadproof.drives import Trajectories, Window
from roadproof.driving.starts import StartRange
from roadproof.errors import EpisodeError, RecordingError, RoadproofError, TrainingError
from roadproof.geometry import CanvasPlacement
from roadproof.hardening.budget import ALONE, HardeningBudget
from roadproof.hardening.harden import STAGES, harden
from roadproof.hardening.judgement import StreetJudge
from roadproof.hardening.page import write_hardening
from roadproof.hardening.plan import HardeningPlan
from roadproof.hardening.result import Round, best_of
from roadproof.hardening.stages import HardeningStages
from roadproof.hardening.tuning import Tuning, training_step
from roadproof.hardening.views import Street
from roadproof.paint import PaintLimits
from roadproof.pipeline.stage_costs import Ledger, read_cost
from roadproof.scenarios import Scenario
from roadproof.search_space import SearchSpace
from roadproof.training.shards import Shard

needs.town()
from roadproof.simulators.town.simulator import TownSimulator

SEARCH = dataclasses.replace(
    ALONE,
    method=GradOpt(iterations=1, restarts=1, halving=False),
    starts=0,
    trajectories=Trajectories(count=1),
    window=Window(frames=8, least_px=8),
)
TINY = HardeningBudget(
    attack=SEARCH,
    judge=dataclasses.replace(SEARCH, starts=2),
    tuning=Tuning(steps=2, repeats=2, batch=8),
    town_drives=0,
    unseen=RandomSearch(calls=2),
    clean_weathers=(Weather.CLEAR_NOON,),
)


@pytest.fixture(scope="module")
def town():
    """A quarter of the usual steps a second."""
    with TownSimulator(dt_s=0.2) as simulator:
        yield simulator


def street(folder, name, begin_m):
    """A stretch of one long, straight road, from 17 m before its canvas."""
    return Scenario(
        name=name,
        kind="straight",
        map_name=str(straight_map(folder, length_m=220.0)),
        start=VehicleState(x_m=begin_m, y_m=-1.75, z_m=0.0, yaw_rad=0.0, speed_mps=6.0),
        goal_m=(begin_m + 24.0, -1.75),
        canvas=CanvasPlacement(x_m=begin_m + 17.0, y_m=0.0, width_m=6.6),
        time_limit_s=6.0,
    )


def run(town, folder, **options):
    near, far = street(folder.parent, "near", 15.0), street(folder.parent, "far", 115.0)
    given = {"judge_on": [far], "rounds": 1, "budget": TINY, "space": SearchSpace(figures=1)} | options
    return harden(town, "pilotnet", [near], folder, **given)


class StoppedError(Exception):
    """The plug is pulled."""


def planned(folder, budget):
    return HardeningPlan(
        spec="pilotnet",
        scenarios=(street(folder, "near", 15.0),),
        folder=folder / "out",
        budget=budget,
        space=SearchSpace(figures=1),
        seed=0,
        device="cpu",
    )


def stages_of(plan, town, *, processes=1, on_progress=lambda *_: None):
    ledger, factory = Ledger(plan.folder, {}, STAGES), partial(TownSimulator, dt_s=0.2)
    teacher = load_controller("pilotnet")
    return HardeningStages(plan, town, teacher, training_step, factory, processes, ledger, on_progress)


def test_the_round_is_kept_that_leaves_its_lane_least_often_and_then_deviates_least():
    told = [(2.0, 0.0), (0.1, 0.5), (0.3, 0.25), (0.2, 0.25)]
    rounds = [Round(number, {"near": metres}, left) for number, (metres, left) in enumerate(told)]
    assert best_of(rounds) == 3
    lost = Round(4, {"near": 0.01}, 0.0, left_out=0.9)
    assert best_of([*rounds, lost]) == 3


def test_a_tuning_that_was_ended_after_its_weights_were_kept_leaves_nothing_else(town, tmp_path):
    plan = planned(tmp_path, TINY)
    plan.round(1).mkdir(parents=True)
    for name in ("hardened.safetensors", "learning.safetensors"):
        (plan.round(1) / name).touch()
    stages_of(plan, town).tune(1, [])
    assert [path.name for path in plan.round(1).iterdir()] == ["hardened.safetensors"]


@pytest.mark.parametrize(("number", "cure"), [(1, "another seed$"), (2, "another seed or fewer rounds$")])
def test_a_tuning_that_spoils_the_driving_is_told_with_what_to_do(town, tmp_path, number, cure):
    plan = dataclasses.replace(planned(tmp_path, TINY), scenarios=(street(tmp_path, "near", 15.0),))
    network = load_trainable("pilotnet")
    for tuned in range(1, number + 1):
        if tuned == number:
            with torch.no_grad():
                for branch in network.branches:
                    branch[-1].bias[0] = 3.0
        plan.round(tuned).mkdir(parents=True)
        save_controller(network, plan.weights(tuned), origin="spoilt")
    with pytest.raises(TrainingError, match=f"^tuning {number} spoilt the driving without paint: only .*{cure}"):
        stages_of(plan, town).rounds(number)


def test_one_that_no_longer_drives_a_street_for_judging_is_told_with_the_reason(town, tmp_path):
    plan, near = planned(tmp_path, TINY), street(tmp_path, "near", 15.0)
    network = load_trainable("pilotnet")
    with torch.no_grad():
        for branch in network.branches:
            branch[-1].bias[0] = 3.0
    plan.round(1).mkdir(parents=True)
    save_controller(network, plan.weights(1), origin="spoilt")
    far = street(tmp_path, "far", 25.0)
    before = stages_of(plan, town).judge_before([near, far])
    assert {each.after for each in before} == {False}
    # What was found there is driven over in the rain from the same starts.
    rain = StreetJudge(plan, town, 0, near, lambda *_: None).judge_in([Weather.RAINY_NOON])
    at_noon = [each for each in before if each.scenario == "near"]
    assert [(each.kind, each.starts) for each in rain] == [(each.kind, each.starts) for each in at_noon]
    assert [each.deviation_m for each in rain] != [each.deviation_m for each in at_noon]
    judged, unjudged = stages_of(plan, town, processes=2).judge(1, [near, far])
    assert (judged, list(unjudged)) == ((), ["near", "far"])
    assert stages_of(plan, town).judge(1, [near, far]) == (judged, unjudged)


def test_a_street_for_judging_that_the_controller_does_not_drive_is_refused_before_anything_is_learnt(town, tmp_path):
    late = dataclasses.replace(street(tmp_path, "late", 115.0), time_limit_s=0.6)
    with pytest.raises(TrainingError, match=r"^late cannot be judged on: .*; judge on streets that the controller dr"):
        run(town, tmp_path / "out", judge_on=[late])
    assert not list((tmp_path / "out").glob("round-0/near*"))


def test_weights_that_are_not_judged_yet_do_not_replace_those_that_are(town, tmp_path):
    out = tmp_path / "out"
    run(town, out, judge_on=())
    kept = (out / "hardened.safetensors").read_bytes()

    def stop(title, *_):
        if title.startswith("Bare road, after"):
            raise StoppedError

    with pytest.raises(StoppedError):
        run(town, out, rounds=2, on_progress=stop)
    assert (out / "round-2" / "hardened.safetensors").exists()
    assert (out / "hardened.safetensors").read_bytes() == kept


@pytest.mark.slow
def test_hardening_in_two_weathers_attacks_learns_and_judges_in_both(town, tmp_path, monkeypatch):
    learnt = list[str]()

    class Noted(Street):
        def __init__(self, recordings, *given, **named):
            learnt.extend({each.weather for each in recordings.recordings})
            super().__init__(recordings, *given, **named)

    monkeypatch.setattr("roadproof.hardening.stages.Street", Noted)
    found = run(town, tmp_path / "out", budget=TINY.in_weathers((Weather.CLEAR_NOON, Weather.RAINY_NOON)))
    near = tmp_path / "out" / "round-0" / "near"
    assert all((near / place / "recordings").is_dir() for place in ("", "rainy-noon"))
    assert learnt == ["clear-noon", "rainy-noon"]
    assert {len(each.deviation_m) for each in found.judgement.judged} == {2 * 2}
    assert {len(each.by_start()) for each in found.judgement.judged} == {2}
    with pytest.raises(RoadproofError, match="holds a hardening with budget"):
        run(town, tmp_path / "out")


def test_a_file_that_is_damaged_is_no_verdict(town, tmp_path, monkeypatch):
    def damaged(judge):
        raise RecordingError("drive.npz is incomplete or damaged; record again")

    monkeypatch.setattr(StreetJudge, "judge", damaged)
    with pytest.raises(RecordingError, match="damaged"):
        stages_of(planned(tmp_path, TINY), town).judge(0, [street(tmp_path, "near", 15.0)])


def test_starts_off_the_road_of_a_street_for_judging_are_refused_before_anything_is_driven(town, tmp_path):
    wide = dataclasses.replace(TINY.judge, start_range=StartRange(right_m=1.0, turned_rad=0.3))
    with pytest.raises(EpisodeError, match="starts of far reach 1 m to the"):
        run(town, tmp_path / "out", budget=dataclasses.replace(TINY, judge=wide))
    assert not (tmp_path / "out").exists()


def test_each_round_learns_from_drives_of_the_rounds_before_too(town, tmp_path):
    asked = planned(tmp_path, dataclasses.replace(TINY, town_drives=1))
    spoilt = load_trainable("pilotnet")
    with torch.no_grad():
        for weights in spoilt.parameters():
            weights.mul_(0.5)
    asked.round(1).mkdir(parents=True)
    save_controller(spoilt, asked.weights(1), origin="spoilt")
    stages = stages_of(asked, town)
    first = stages.town(1).draw(500, torch.Generator().manual_seed(0), to_paint=False)
    assert not (asked.round(1) / "town").exists()
    both = stages.town(2).draw(500, torch.Generator().manual_seed(0), to_paint=False)
    assert stages.ledger.cost["town"].simulator_calls == 2
    drives = [Shard.load(asked.town_drive(number, 0)) for number in (0, 1)]
    seen = [{int(frame.sum()) for frame in drive.frames} for drive in drives]
    shown = [{round(255 * float(frame.double().sum())) for frame in views.frames} for views in (first, both)]
    assert shown[0] <= seen[0]
    assert shown[1] & (seen[1] - seen[0]), "where the controller of round 1 went"


@pytest.mark.slow
def test_two_processes_drive_through_the_town_and_over_the_bare_road_as_one_does(town, tmp_path):
    streets = [street(tmp_path, "near", 15.0), street(tmp_path, "far", 115.0)]
    budget = dataclasses.replace(TINY, town_drives=2)
    plans = [dataclasses.replace(planned(tmp_path, budget), folder=tmp_path / name) for name in ("one", "two")]
    told = []
    for plan, processes in zip(plans, (1, 2), strict=True):
        plan.folder.mkdir()
        stages = stages_of(plan, town, processes=processes, on_progress=lambda *each: told.append(each))
        stages.town(1)
        assert [each.drives for each in stages.drive_clean(0, [*streets, streets[0]])] == [2, 2]
    for path in sorted(plans[0].folder.rglob("*.npz")):
        other = plans[1].folder / path.relative_to(plans[0].folder)
        with np.load(path) as one, np.load(other) as two:
            assert one.files == two.files
            assert all(
                np.array_equal(one[name], two[name], equal_nan=one[name].dtype.kind == "f") for name in one.files
            )
    assert ("Round 0: driving through the town", 2, 2, "drives") in told
    assert {each[3] for each in told if each[0] == "Bare road, before"} >= {"streets", "streets, far is done"}


def failing():
    """A training step that gives no number after the first batches, as one that divides by zero."""
    calls = []

    def step(model, batch):
        calls.append(batch)
        return training_step(model, batch) * (math.nan if len(calls) > 2 else 1.0)

    return step


@pytest.mark.slow
def test_a_stopped_hardening_goes_on_to_the_same_controller_verdict_and_page(town, tmp_path):
    out, whole = tmp_path / "a" / "out", tmp_path / "b" / "out"
    for folder in (out, whole):
        folder.parent.mkdir()
    for stage in ("Round 0, near: calibrating", "Round 1: learning", "Judging after, far: searching"):

        def stop(title, _done, _total, word, stage=stage):
            if f"{title}: {word}".startswith(stage):
                raise StoppedError

        with pytest.raises(StoppedError):
            run(town, out, on_progress=stop)
        if stage.endswith("calibrating"):
            with pytest.raises(TrainingError, match=r"the loss is nan at step \d; mend the step"):
                run(town, out, training_step=failing())
    found = run(town, out)
    # The judged controller is none but the saved one.
    learnt, before = load_controller(found.hardened), load_controller("pilotnet")
    assert isinstance(learnt, ConditionalPilotNet)
    assert not torch.equal(learnt.image.weight, before.image.weight)
    assert {each.dtype for each in load_file(found.hardened).values() if each.is_floating_point()} == {torch.float16}
    again = run(town, whole, judge_on=())
    assert again.judgement is None
    assert torch.equal(load_controller(again.hardened).image.weight, learnt.image.weight)
    check_result(found, out)
    told = []
    same = run(town, out, on_progress=lambda title, _done, _total, word: told.append(f"{title}: {word}"))
    assert told
    assert dataclasses.replace(same, cost=found.cost) == found
    assert not any("searching" in each or "learning" in each for each in told)
    with pytest.raises(RoadproofError, match="holds a hardening with seed 0, now it is 1"):
        run(town, out, seed=1)
    with pytest.raises(RoadproofError, match="holds a hardening with training step"):
        run(town, out, training_step=failing())
    with pytest.raises(RoadproofError, match="holds a hardening with budget"):
        run(town, out, budget=dataclasses.replace(TINY, tuning=Tuning(steps=3, repeats=2, batch=8)))


@pytest.mark.slow
def test_two_processes_attack_a_street_each_and_one_goes_on_from_there(town, tmp_path):
    streets = [street(tmp_path, "near", 15.0), street(tmp_path, "far", 115.0)]
    given = {"rounds": 1, "budget": TINY, "space": SearchSpace(figures=1)}
    told = []
    found = harden(
        town,
        "pilotnet",
        streets,
        tmp_path / "out",
        **given,
        factory=partial(TownSimulator, dt_s=0.2),
        processes=2,
        on_progress=lambda title, done, total, word: told.append((title, done, total, word)),
    )
    assert {each[3] for each in told if each[0] == "Round 1"} == {
        "streets",
        "streets, near is done",
        "streets, far is done",
    }
    assert [each[1:3] for each in told if each[0] == "Round 0"] == [(0, 2), (1, 2), (2, 2)]
    assert set(found.rounds[1].deviation_m) == {"near", "far"}
    assert harden(town, "pilotnet", streets, tmp_path / "out", **given).rounds == found.rounds


def check_result(found, out):
    assert [each.number for each in found.rounds] == [0, 1]
    assert found.best == 1
    kinds = ["by gradient, as in training", "random, 2 patterns tried", "ellipses by gradient"]
    judged = found.judgement.judged
    assert [each.kind for each in judged if not each.after] == kinds
    assert [each.kind for each in judged if each.after] == [*kinds, "found against the controller before"]
    assert all(len(each.deviation_m) == 2 for each in judged)
    assert [each.drives for each in found.judgement.clean] == [2, 2]
    assert list(found.cost) == ["town", "attack", "learn", "bare road", "judge"]
    assert found.cost["learn"].seconds > 0
    assert found.cost["judge"].simulator_calls == sum(each.simulator_calls for each in judged) > 4 * len(judged)
    assert read_cost(out)["judge"] == found.cost["judge"], "told to whoever goes on, too"
    assert not (out / "round-1" / "learning.safetensors").exists()
    stored = json.loads((out / "hardening.json").read_text())
    assert stored["hardened"] == found.hardened
    assert stored["verdict"]["outcome"] == found.judgement.verdict().outcome
    page = write_hardening(found, out).read_text()
    assert found.judgement.verdict().sentence in page
    for word in (*kinds, "far", "near, m", "data:image/png", "<svg", "What it took"):
        assert word in page


@pytest.mark.parametrize("place", ["", "round-1"])
def test_weights_that_the_results_would_be_written_over_are_refused_and_kept(town, tmp_path, place):
    own = tmp_path / place / "hardened.safetensors"
    own.parent.mkdir(exist_ok=True)
    save_controller(load_controller("pilotnet"), own)
    before = own.read_bytes()
    with pytest.raises(TrainingError, match="keeps its results; choose another folder for them"):
        harden(town, str(own), [street(tmp_path, "near", 15.0)], tmp_path, rounds=1, budget=TINY)
    assert own.read_bytes() == before
    assert not (tmp_path / "run.json").exists()


def test_mistakes_are_refused_before_anything_is_driven(town, tmp_path):
    folder = tmp_path / "out"
    nowhere = dataclasses.replace(street(tmp_path, "far", 115.0), goal_m=(500.0, 500.0))
    for options, message in (
        ({"judge_on": [nowhere]}, "scenario far: "),
        ({"clean_on": [nowhere]}, "scenario far: "),
        ({"clean_on": [street(tmp_path, "far", 115.0)], "judge_on": []}, "give judge_on too, or leave it out"),
        ({"space": SearchSpace(figures=1, limits=PaintLimits(keep_out_m=9.0))}, "leaves no place for paint"),
        ({"training_step": lambda model, batch: batch.target.mean()}, "expected one number with a gradient"),
        ({"judge_on": [street(tmp_path, "next", 40.0)]}, "lie 25 m apart, on one street; expected at least 40 m"),
        ({"rounds": 0}, "rounds is 0, expected a whole number"),
        ({"seed": -1}, "seed is -1, expected a whole number from 0 to"),
        ({"processes": 2}, "2 processes; expected 1, or more with a factory"),
    ):
        with pytest.raises(RoadproofError, match=message):
            run(town, folder, **options)
    assert not folder.exists()
