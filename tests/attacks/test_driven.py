from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
import torch

from paint_shy import PaintShy, along_a_street
from recorded_drives import VEHICLE, drivable_set
from roadproof.attacks import (
    CMAES,
    AttackResult,
    GradOpt,
    InSimulator,
    PathDeviation,
    RandomSearch,
    SteeringShift,
    attack,
    usual_objective,
)
from roadproof.attacks.driven import DrivenMeasure, effect_of
from roadproof.attacks.groups import LEFT_GROUP
from roadproof.controllers import load_controller
from roadproof.datatypes import Control, Weather
from roadproof.driving.rollout import rollout
from roadproof.driving.trial import judge
from roadproof.errors import EpisodeError, RoadproofError
from roadproof.recorded import RecordedSimulator
from roadproof.scenarios import find_scenario
from roadproof.search_space import SearchSpace
from roadproof.simulators.town.simulator import TownSimulator
from runs import driven

SPACE = SearchSpace(figures=2)


@pytest.fixture(scope="module")
def street(tmp_path_factory):
    return along_a_street(tmp_path_factory.mktemp("street"), 2.5)


def test_steering_is_summed_over_the_first_four_fifths_as_published():
    scenario = find_scenario("left-03")
    clean = driven(scenario)
    frames = int(0.8 * clean.steer.size)
    shift = np.zeros(clean.steer.size)
    shift[:10], shift[frames:] = -0.02, 5.0
    painted = dataclasses.replace(clean, steer=clean.steer + shift)
    effect = effect_of(clean, painted, scenario.canvas)
    assert effect.steering == pytest.approx(0.2)
    assert effect.deviation == 0.0
    # A drive that ends before counts as the clean one from there on.
    short = {
        name: getattr(clean, name)[:201] for name in clean.__slots__ if np.size(getattr(clean, name)) == len(clean)
    }
    short |= {name: getattr(painted, name)[:200] for name in ("steer", "throttle", "brake")}
    assert effect_of(clean, dataclasses.replace(clean, **short), scenario.canvas).steering == pytest.approx(0.2)


def test_deviation_is_the_one_that_evaluations_report():
    scenario = find_scenario("left-03")
    clean, painted = driven(scenario), driven(scenario, 1.3, painted=True)
    trial = judge(clean, painted, scenario.canvas, pattern="attack", clean_file="a.npz", painted_file="b.npz")
    assert effect_of(clean, painted, scenario.canvas).deviation == trial.deviation_m > 0.1


def test_drives_are_kept_in_a_file_named_by_a_text(tmp_path):
    class Straight(torch.nn.Module):
        input_size = (88, 200)

        def steer(self, frames, speed_mps, command):
            return frames.mean((1, 2, 3)) - 0.4

        def act(self, frame, speed_mps, command):
            return Control(steer=float(frame.mean()) / 255 - 0.4, throttle=0.05)

    with RecordedSimulator(drivable_set(12.0), vehicle=VEHICLE) as world:
        place = InSimulator(world, world.scenario, keep=str(tmp_path / "driven.json"))
        twice = [attack(place, Straight(), SPACE, method=RandomSearch(calls=1)) for _ in range(2)]
    assert [each.cost.simulator_calls for each in twice] == [2, 1]
    assert twice[0].driven == twice[1].driven


@pytest.mark.slow
def test_a_value_is_that_of_a_whole_drive_and_is_driven_once(town, street, tmp_path):
    controller = load_controller("pilotnet")
    place = InSimulator(town, street, keep=tmp_path / "driven.json")
    unit = SPACE.random((1, 1), torch.Generator().manual_seed(1))
    first = DrivenMeasure(place, controller, SteeringShift())
    steering = first.values(SPACE, unit)
    assert first.calls == 2
    second = DrivenMeasure(place, controller, PathDeviation())
    deviation = second.values(SPACE, unit)
    assert second.calls == 1  # the clean one again
    assert first.fingerprint() != second.fingerprint()
    with pytest.raises(RoadproofError, match=r"driven\.json holds drives over patterns by another controller"):
        DrivenMeasure(place, load_controller("pilotnet-b"), PathDeviation())
    moved = dataclasses.replace(street, canvas=dataclasses.replace(street.canvas, y_m=street.canvas.y_m + 0.1))
    for other in ({"scenario": moved}, {"seed": 1}, {"weather": Weather.CLEAR_SUNSET}):
        with pytest.raises(RoadproofError, match="its clean drive, scenario, canvas, weather, seed or simulator is an"):
            DrivenMeasure(dataclasses.replace(place, **other), controller, PathDeviation())
    for damage in ({"conditions": None}, {"drives": [["a", "b"]]}):
        told = json.loads(place.keep.read_text()) | damage
        damaged = tmp_path / "damaged.json"
        damaged.write_text(json.dumps({name: value for name, value in told.items() if value is not None}))
        with pytest.raises(RoadproofError, match=r"damaged\.json is incomplete or damaged .*; remove it$"):
            DrivenMeasure(dataclasses.replace(place, keep=damaged), controller, SteeringShift())
    clean = rollout(town, controller, street)
    whole = effect_of(clean, rollout(town, controller, street, pattern=SPACE.pattern(unit[0, 0])), street.canvas)
    assert (float(steering), float(deviation)) == (whole.steering, whole.deviation)
    assert whole.steering > 0.01


@pytest.mark.slow
def test_attack_in_a_simulator_finds_the_best_it_drove_over(town, street, tmp_path):
    controller = load_controller("pilotnet")
    place, method = InSimulator(town, street), CMAES(calls=4)
    found = attack(place, controller, SPACE, method=method, objective=PathDeviation(), seed=3)
    assert found.cost.simulator_calls == 5, "the clean drive, and one for each pattern"
    assert found.surrogate_shift is None and found.predicted_m is None
    assert found.driven is not None
    assert found.driven.deviation == max(each.driven.deviation for each in found.candidates if each.driven)
    assert found.history.shape == (4, 1, 1)
    assert found.history[-1, 0, 0] == pytest.approx(found.driven.deviation)
    found.save(tmp_path / "attack")
    again = AttackResult.load(tmp_path / "attack")
    assert again.driven == found.driven
    assert [each.driven for each in again.candidates] == [each.driven for each in found.candidates]
    on = attack(place, controller, SPACE, method=method, objective=PathDeviation(), starts=again.candidates[:1])
    assert on.history[0, 0, 0] == pytest.approx(found.driven.deviation), "the start is the first that is driven"


def test_where_nothing_can_be_measured_nothing_is_searched(town):
    far = dataclasses.replace(find_scenario("straight-08"), time_limit_s=1.0)
    for objective in (SteeringShift(), PathDeviation()):
        with pytest.raises(EpisodeError, match="without paint the car never comes near the canvas of straight-08"):
            DrivenMeasure(InSimulator(town, far), PaintShy(), objective)


@pytest.mark.slow
def test_an_interrupted_search_counts_all_its_drives(town, street, tmp_path):
    def searched(name, stop):
        def pull_the_plug(calls, _best):
            if calls == stop:
                raise KeyboardInterrupt

        place = InSimulator(town, street, keep=tmp_path / f"{name}.json")
        return attack(
            place, PaintShy(), SPACE, method=RandomSearch(calls=4), objective=PathDeviation(),
            checkpoint=tmp_path / f"{name}.safetensors", on_step=pull_the_plug,
        )  # fmt: skip

    whole = searched("whole", None).cost
    with pytest.raises(KeyboardInterrupt):
        searched("again", 2)
    again = searched("again", None).cost
    assert (again.controller_frames, again.simulator_calls) == (whole.controller_frames, whole.simulator_calls)
    assert whole.simulator_calls == 5


def test_a_search_by_gradient_in_a_simulator_is_refused_before_it_drives():
    # Not opened: whatever is driven there fails with another error.
    place = InSimulator(TownSimulator(), find_scenario("left-03"))
    with pytest.raises(RoadproofError, match="needs gradients, and a drive in a simulator has none"):
        attack(place, load_controller("pilotnet"), SPACE, method=GradOpt())
    assert isinstance(usual_objective(place, CMAES(calls=4)), PathDeviation)


@pytest.mark.parametrize(
    "given",
    [{"groups": (LEFT_GROUP,)}, {"device": "cuda"}, {"random_patterns": 3}],
    ids=lambda given: next(iter(given)),
)
def test_what_only_recordings_use_is_refused_in_a_simulator(given):
    place = InSimulator(TownSimulator(), find_scenario("left-03"))
    with pytest.raises(RoadproofError, match=f"in a simulator does not use {next(iter(given))}; leave it out"):
        attack(place, load_controller("pilotnet"), SPACE, method=CMAES(calls=4), **given)
