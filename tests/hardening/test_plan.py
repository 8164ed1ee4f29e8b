"""What tells one hardening from another."""

from dataclasses import replace

import pytest

import needs
from hardening_road import SPACE
from painted_ground import RampFollower
from roadproof.attacks import TPE
from roadproof.datatypes import Weather
from roadproof.errors import RoadproofError
from roadproof.hardening.budget import HardeningBudget
from roadproof.hardening.judgement import clean_drives
from roadproof.hardening.plan import HardeningPlan
from roadproof.hardening.tuning import training_step
from roadproof.io.identity import require_same
from roadproof.limits import MAX_SEED
from roadproof.patterns import Shape
from roadproof.scenarios import find_scenario

needs.town()
from roadproof.simulators.town.simulator import TownSimulator


def test_an_edited_training_step_is_another_hardening(tmp_path):
    plan = HardeningPlan(
        spec="pilotnet", scenarios=(), folder=tmp_path, budget=HardeningBudget(), space=SPACE, seed=0, device="cpu"
    )

    def made(factor):
        return lambda model, batch: factor * training_step(model, batch)

    parts = [plan.made_of(TownSimulator(), RampFollower(), step) for step in (training_step, made(1), made(2), made(1))]
    require_same(tmp_path, "a hardening", parts[1], parts[3], RoadproofError)
    for other in (parts[0], parts[2]):
        with pytest.raises(RoadproofError, match="holds a hardening with training step"):
            require_same(tmp_path, "a hardening", parts[1], other, RoadproofError)


@pytest.mark.parametrize("seed", [0, 6, 417, 999, MAX_SEED - 1000, MAX_SEED])
def test_judging_has_a_seed_that_no_round_has_and_that_searches_take(tmp_path, seed):
    plan = HardeningPlan(
        spec="pilotnet", scenarios=(), folder=tmp_path, budget=HardeningBudget(), space=SPACE, seed=seed, device="cpu"
    )
    assert plan.judging_seed <= MAX_SEED
    rounds = [plan.seed_of(number) for number in range(101)]
    assert max(rounds) < plan.judging_seed
    assert len(set(rounds)) == 101, "each round attacks afresh"


def test_a_street_that_is_named_twice_is_driven_over_once(tmp_path):
    street = replace(find_scenario("left-03"), time_limit_s=0.2)
    with TownSimulator() as town:
        drives = clean_drives(town, RampFollower(), [street, street], [Weather.CLEAR_NOON], tmp_path)
    assert (drives.drives, drives.failed) == (1, ("left-03, clear-noon",))


def test_judging_otherwise_is_the_same_hardening(tmp_path):
    usual = HardeningBudget()
    parts = [
        HardeningPlan(
            spec="pilotnet", scenarios=(), folder=tmp_path, budget=budget, space=SPACE, seed=0, device="cpu"
        ).made_of(TownSimulator(), RampFollower(), training_step)
        for budget in (
            usual,
            replace(usual, clean_weathers=(Weather.RAINY_NOON,), unseen=TPE(calls=7)),
            replace(usual, town_drives=7),
            replace(usual, unseen_shape=Shape.TRIANGLE),
        )
    ]
    require_same(tmp_path, "a hardening", parts[0], parts[1], RoadproofError)
    assert parts[0]["budget"] == repr(replace(usual, judge=usual.attack)), "as before judging was left out"
    with pytest.raises(RoadproofError, match="holds a hardening with budget"):
        require_same(tmp_path, "a hardening", parts[0], parts[2], RoadproofError)
    with pytest.raises(RoadproofError, match=r"holds a hardening with budget .*TRIANGLE"):
        require_same(tmp_path, "a hardening", parts[0], parts[3], RoadproofError)
