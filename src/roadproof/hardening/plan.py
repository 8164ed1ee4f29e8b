"""A hardening as it was asked for: where each round lies, who drives there, and the attack on one of its streets."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from roadproof.attacks.objective import own_objective, variation_of
from roadproof.controllers import Controller, load_controller
from roadproof.controllers.identity import parts_of
from roadproof.controllers.loading import runs_code
from roadproof.hardening.budget import HardeningBudget
from roadproof.hardening.tuning import TrainingStep
from roadproof.io.known import known_by, without_addresses
from roadproof.limits import MAX_SEED
from roadproof.pipeline.stress_test import OnProgress, StressTest, stress_test
from roadproof.scenarios import Scenario, identity
from roadproof.search_space import SearchSpace, derived_seed
from roadproof.simulators.protocol import Simulator, world_of

WEIGHTS = "hardened.safetensors"
_STEP, _SOURCE = STEP_PARTS = ("training step", "training step's source")
_FRESH = 1000
"""The least seed of judging; those of the rounds are below it."""


@dataclass(frozen=True, kw_only=True, slots=True)
class HardeningPlan:
    """What `harden` was asked for, as far as its attacks need it; it travels between processes.

    Args:
        spec: the spec of the controller that it begins with.
        scenarios: the scenarios on the streets for training.
        folder: the folder that keeps everything.
        budget: how much is spent.
        space: the search space of the attacks.
        seed: the seed of everything random.
        device: the torch device on which to search and learn.
    """

    spec: str
    scenarios: tuple[Scenario, ...]
    folder: Path
    budget: HardeningBudget
    space: SearchSpace
    seed: int
    device: str

    def round(self, number: int) -> Path:
        """The folder of a round; 0 is the controller as it came."""
        return self.folder / f"round-{number}"

    def town_drive(self, number: int, drive: int) -> Path:
        """The file of a drive through the town by a round's controller."""
        return (self.round(number) if number else self.folder) / "town" / f"drive-{drive:05d}.npz"

    def judged(self, number: int, scenario: Scenario) -> Path:
        """The folder of the judgement of a round's controller on one street."""
        return self.round(number) / "judged" / scenario.name

    def weights(self, number: int) -> Path:
        """The weights file of a round's controller."""
        return self.round(number) / WEIGHTS

    def spec_with(self, weights: Path) -> str:
        """The spec of the controller with other weights."""
        return f"{self.spec.partition('@')[0]}@{weights}" if runs_code(self.spec) else str(weights)

    def spec_of(self, number: int) -> str:
        """The spec of a round's controller."""
        return self.spec_with(self.weights(number)) if number else self.spec

    def name(self, number: int) -> str:
        """The name of a round's controller in reports; the same wherever the folder lies."""
        return f"{self.spec}, hardened in round {number}" if number else self.spec

    def controller(self, number: int) -> Controller:
        """The controller of a round, on the device."""
        return load_controller(self.spec_of(number), device=self.device)

    def seed_of(self, number: int) -> int:
        """The seed of a round's attacks and of its tuning, which no other round has."""
        seeds: list[int] = []
        for each in range(number + 1):
            seed = derived_seed(self.seed, each) % _FRESH
            while seed in seeds:
                seed = (seed + 1) % _FRESH
            seeds.append(seed)
        return seeds[number]

    @property
    def judging_seed(self) -> int:
        """The seed of all judging, which no round has."""
        return _FRESH + self.seed % (MAX_SEED + 1 - _FRESH)

    def made_of(self, simulator: Simulator, teacher: Controller, step: TrainingStep) -> dict[str, object]:
        """What identifies the hardening; judging may be asked for later."""
        view, usual, attack = simulator.input, HardeningBudget(), self.budget.attack
        judging = {name: getattr(usual, name) for name in ("unseen", "clean_weathers")}
        return {
            "controller": self.spec,
            "world": world_of(simulator),
            **parts_of(teacher, (view.height_px, view.width_px)),
            "scenarios": [identity(each) for each in self.scenarios],
            "budget": without_addresses(repr(replace(self.budget, judge=attack, **judging))),
            "objective": own_objective(attack.objective),
            "space": repr(self.space),
            "learnt": [repr(each) for each in self.budget.learnt(self.space)],
            "variation": repr(variation_of(attack.objective)),
            "seed": self.seed,
            _STEP: f"{step.__module__}:{getattr(step, '__qualname__', type(step).__qualname__)}",
            _SOURCE: known_by(step),
        }

    def attack(
        self, simulator: Simulator, number: int, scenario: Scenario, on_progress: OnProgress, *, judging: bool = False
    ) -> StressTest:
        """Attack a round's controller afresh on a street for training, or in the same way on one for judging.

        Raises:
            RoadproofError: a stage refuses; the message says why.
        """
        return stress_test(
            simulator,
            self.controller(number),
            scenario,
            self.judged(number, scenario) if judging else self.round(number) / scenario.name,
            budget=self.budget.judge if judging else self.budget.attack,
            space=self.space,
            seed=self.judging_seed if judging else self.seed_of(number),
            controller_name=self.name(number),
            device=self.device,
            film=False,
            on_progress=on_progress,
        )
