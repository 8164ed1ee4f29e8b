"""What tells one hardening from another."""

import pytest

import needs
from hardening_road import SPACE
from painted_ground import RampFollower
from roadproof.errors import RoadproofError
from roadproof.hardening.budget import HardeningBudget
from roadproof.hardening.plan import HardeningPlan
from roadproof.hardening.tuning import training_step
from roadproof.io.identity import require_same

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
