"""Recorded drives hold the expert's clean answers, can be filled up later, and are the same in every process."""

from dataclasses import asdict, replace

import numpy as np
import pytest
import torch

import needs
from roadproof.controllers import CIL, PurePursuit, save_controller
from roadproof.errors import TrainingError
from roadproof.scenarios import builtin_scenarios
from roadproof.training.collection import CollectionPlan, collect, record_drive
from roadproof.training.random_scenarios import Disturbance
from roadproof.training.shards import Shard
from roadproof.training.workers import driving

needs.town()


@pytest.fixture(scope="module")
def worker():
    with driving(None, 0.1) as worker:
        yield worker


def test_a_quiet_drive_follows_the_route_and_a_disturbed_one_leaves_it(worker):
    quiet = record_drive(worker.town, CollectionPlan(drives=1, seed=3, disturbed=0.0, traffic=0.0), 0, None)
    disturbed = record_drive(worker.town, CollectionPlan(drives=1, seed=3, disturbed=1.0, traffic=0.0), 0, None)
    assert len(quiet) > 60
    assert np.abs(quiet.lateral_m).max() < 0.35
    assert np.abs(disturbed.lateral_m).max() > 0.5
    # The label is what brings the car back: right of the route it steers left of what the route asks, and the
    # other way round.
    assert np.corrcoef(disturbed.lateral_m, disturbed.expert[:, 0])[0, 1] > 0.2
    assert quiet.frames.shape[1:] == (88, 200, 3)
    assert quiet.about["weather"] == disturbed.about["weather"]
    assert (quiet.about["disturbed"], disturbed.about["disturbed"]) == (False, True)


def test_the_recorded_path_is_the_one_that_the_expert_steers_along(worker):
    drive = record_drive(worker.town, CollectionPlan(drives=1, seed=3, disturbed=1.0, traffic=0.0), 0, None)
    path, speed = torch.tensor(drive.path_m), torch.tensor(drive.speed_mps)
    steer = PurePursuit().steer(path, speed).clamp(-1.0, 1.0).numpy()
    off = np.abs(steer - drive.expert[:, 0])
    assert off.mean() < 0.02
    assert off.mean() < 0.1 * np.abs(drive.expert[:, 0]).max()
    # Points lie where they say, along the route: never nearer to the car than the way along it is long.
    assert (np.linalg.norm(np.diff(drive.path_m, axis=1), axis=2) < 2.5 + 1e-4).all()


def test_drives_start_at_rest_and_the_expert_wants_to_go(worker):
    quiet = record_drive(worker.town, CollectionPlan(drives=1, seed=3, disturbed=0.0, traffic=0.0), 1, None)
    assert quiet.speed_mps[0] < 0.1
    assert quiet.expert[0, 1] > 0.3
    assert quiet.speed_mps.max() > 4.0


def test_paint_is_seen_only_where_it_was_asked_for(worker):
    bare = record_drive(worker.town, CollectionPlan(drives=1, seed=5, disturbed=0.0, traffic=0.0), 0, None)
    painted = record_drive(
        worker.town, CollectionPlan(drives=1, seed=5, disturbed=0.0, traffic=0.0, painted=1.0), 0, None
    )
    assert painted.about["painted"]
    assert not bare.about["painted"]
    assert len(bare) == len(painted)
    changed = (bare.frames.astype(int) - painted.frames).any(axis=(1, 2, 3))
    assert 5 < changed.sum() < len(bare)
    # The same drive otherwise: the expert does not look at the road.
    np.testing.assert_array_equal(bare.expert, painted.expert)


def test_a_controller_drives_and_the_expert_answers(worker, tmp_path):
    save_controller(CIL(width=0.05, seed=1).eval(), tmp_path / "untrained.safetensors")
    plan = CollectionPlan(
        drives=1, seed=3, controller=str(tmp_path / "untrained.safetensors"), disturbed=0.0, traffic=0.0
    )
    from roadproof.controllers import load_controller

    shard = record_drive(worker.town, plan, 0, load_controller(plan.controller))
    assert np.abs(shard.lateral_m).max() <= 2.6
    assert np.isfinite(shard.expert).all()


def test_a_folder_is_filled_up_and_processes_agree(tmp_path):
    plan = CollectionPlan(drives=2, seed=8, disturbed=0.5, traffic=0.0)
    told = []
    first = collect(plan, tmp_path / "a", processes=2, on_drive=told.append)
    assert sorted(told) == [1, 2]
    frames = [Shard.load(path).frames for path in first]
    first[0].unlink()
    kept = first[1].stat().st_mtime_ns
    told.clear()
    again = collect(plan, tmp_path / "a", processes=1, on_drive=told.append)
    assert told == [2]
    assert again == first
    assert first[1].stat().st_mtime_ns == kept
    np.testing.assert_array_equal(Shard.load(again[0]).frames, frames[0])


def test_a_folder_that_was_carried_elsewhere_goes_on_with_its_network(tmp_path):
    def plan(folder):
        return CollectionPlan(drives=1, seed=8, controller=str(folder / "network-0.safetensors"))

    here, there = tmp_path / "here", tmp_path / "there"
    (path,) = collect(CollectionPlan(drives=1, seed=8, disturbed=0.0, traffic=0.0), here)
    shard = Shard.load(path)
    replace(shard, about=shard.about | {"plan": asdict(plan(here))}).save(path)
    here.rename(there)
    assert collect(plan(there), there) == (there / path.name,)
    with pytest.raises(TrainingError, match="another plan"):
        collect(replace(plan(there), controller=str(there / "network-1.safetensors")), there)


def test_drives_of_another_plan_are_not_taken_for_this_ones(tmp_path):
    plan = CollectionPlan(drives=1, seed=8, disturbed=0.0, traffic=0.0)
    (path,) = collect(plan, tmp_path)
    assert collect(plan, tmp_path) == (path,)
    for changes in ({"seed": 7}, {"painted": 1.0}, {"controller": "cil"}):
        with pytest.raises(TrainingError, match=r"00000\.npz is a drive of another plan"):
            collect(replace(plan, **changes), tmp_path)


def test_scenarios_are_not_what_is_driven():
    from roadproof.roads.maps import load_map
    from roadproof.training.random_scenarios import random_scenario

    built_in = {(s.start.x_m, s.start.y_m, s.goal_m) for s in builtin_scenarios()}
    roads = load_map("town")
    for number in range(20):
        drawn = random_scenario(roads, "town", np.random.default_rng([0, number]), name="x")
        assert (drawn.start.x_m, drawn.start.y_m, drawn.goal_m) not in built_in


@pytest.mark.parametrize("changes", [{"drives": 0}, {"disturbed": 1.2}, {"traffic": -0.1}, {"painted": 2.0}])
def test_plans_that_make_no_sense_are_refused(changes):
    with pytest.raises(TrainingError, match=next(iter(changes))):
        CollectionPlan(**({"drives": 1, "seed": 0} | changes))


def test_a_disturbance_lasts_as_long_in_a_simulator_with_shorter_steps(monkeypatch):
    made = []

    class Kept(Disturbance):
        def __init__(self, steps, dt_s, generator):
            super().__init__(steps, dt_s, generator)
            made.append((steps * dt_s, self))

    monkeypatch.setattr("roadproof.training.collection.Disturbance", Kept)
    plan = CollectionPlan(drives=1, seed=3, disturbed=1.0, traffic=0.0)
    lengths = []
    for dt_s in (0.1, 0.05):
        with driving(None, dt_s) as worker:
            lengths.append(len(record_drive(worker.town, plan, 0, None)) * dt_s)
    (long_s, long), (short_s, short) = made
    assert long_s == pytest.approx(short_s, abs=0.25)
    assert lengths[0] == pytest.approx(lengths[1], rel=0.2)
    # The same pushes, told at twice as many instants.
    assert np.abs(short._steer).sum() * 0.05 == pytest.approx(np.abs(long._steer).sum() * 0.1, rel=0.1)
