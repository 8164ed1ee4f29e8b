"""The stages of a hardening, each of which goes on from what the folder holds (`hardening.harden`)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias, TypeVar

import torch
from torch import nn

from roadproof.attacks.checkpoint import Checkpoint
from roadproof.controllers import CIL, ConditionalPilotNet, Controller, save_controller
from roadproof.controllers.loading import load_trainable, runs_code
from roadproof.controllers.steering import NetworkController
from roadproof.controllers.weights_file import tensors_of
from roadproof.errors import CanvasNotReachedError, TrainingError
from roadproof.hardening.judgement import BareDrives, JudgedAttack, StreetJudge, clean_drives
from roadproof.hardening.plan import HardeningPlan
from roadproof.hardening.result import Round
from roadproof.hardening.town import Town
from roadproof.hardening.tuning import TrainingStep, tune
from roadproof.hardening.views import Street
from roadproof.io.files import write_tensors
from roadproof.io.identity import stated
from roadproof.io.known import known_by
from roadproof.io.text import count_of
from roadproof.machine import give_back_freed_memory
from roadproof.pipeline.stage_costs import Ledger
from roadproof.pipeline.stages import recordings_of
from roadproof.pipeline.stress_test import OnProgress, StressTest
from roadproof.processes import spread, stopping
from roadproof.scenarios import Scenario
from roadproof.simulators.protocol import Simulator, SimulatorFactory
from roadproof.simulators.town.simulator import TownSimulator
from roadproof.training.collection import CollectionPlan, record_drive
from roadproof.training.dataset import Dataset

Work = TypeVar("Work", Scenario, int)
RoundWork: TypeAlias = Callable[[HardeningPlan, int, Any, Work], object]
"""What a round's controller does on a street, or in a drive, in a process with a simulator of its own; the folder keeps
it."""


@dataclass(frozen=True, slots=True, eq=False)
class HardeningStages:
    """The stages of one run; its other fields are arguments of `harden`, and the controller before."""

    plan: HardeningPlan
    simulator: Simulator
    teacher: Controller
    step: TrainingStep
    factory: SimulatorFactory | None
    processes: int
    ledger: Ledger
    on_progress: OnProgress

    def tell(self, title: str, done: int, total: int, word: str) -> None:
        """Note the time, and tell the caller how far it is."""
        self.ledger.step()
        self.on_progress(title, done, total, word)

    def rounds(self, count: int) -> tuple[Round, ...]:
        """Attack, then tune and attack afresh for so many rounds.

        Raises:
            TrainingError: a tuned controller no longer drives a street as far as its canvas.
        """
        tests = list[list[StressTest]]()
        for number in range(count + 1):
            if number:
                self.tune(number, tests)
                # The streets took gigabytes, which the processes that attack next need.
                give_back_freed_memory()
            try:
                tests.append(self.attack(number))
            except CanvasNotReachedError as error:
                if not number:
                    raise
                cure = "other streets, another seed or fewer rounds" if number > 1 else "other streets or another seed"
                raise TrainingError(
                    f"tuning {number} spoilt the driving without paint: {error}; harden with {cure}"
                ) from None
        costs = [cost for each in tests for test in each for cost in test.cost.values()]
        self.ledger.calls("attack", sum(cost.simulator_calls for cost in costs))
        return tuple(Round.of(number, each) for number, each in enumerate(tests))

    def attack(self, number: int) -> list[StressTest]:
        """Attack the controller of a round afresh on every street for training."""
        with self.ledger.stage("attack"):
            self._together(f"Round {number}", _attack_street, number, self.plan.scenarios)
            return [
                self.plan.attack(self.simulator, number, each, self._under(f"Round {number}, {each.name}"))
                for each in self.plan.scenarios
            ]

    def tune(self, number: int, tests: Sequence[Sequence[StressTest]]) -> None:
        """Tune on what all attacks so far found, from the weights of the round before."""
        plan, tuning = self.plan, self.plan.budget.tuning
        path = plan.round(number) / "learning.safetensors"
        if plan.weights(number).exists():
            # One that was ended between writing the one file and removing the other left both.
            path.unlink(missing_ok=True)
            return
        network, town = load_trainable(plan.spec_of(number - 1)), self.town(number)
        spaces = plan.budget.learnt(plan.space)
        space = spaces[0]
        told: list[object] = [network, tuning, plan.seed_of(number), self.step, *(each.stated for each in spaces)]
        streets: list[Street] = []
        found: list[torch.Tensor] = []
        for past, attacked in enumerate(tests):
            driver = plan.controller(past)
            for scenario, test in zip(plan.scenarios, attacked, strict=True):
                recordings = recordings_of(plan.round(past) / scenario.name, plan.budget.attack)
                points = torch.stack([space.point(each.pattern) for each in test.attack.candidates])
                # A recorded world has one light.
                for each in recordings.by_weather():
                    street = Street(each, self.teacher, device=plan.device)
                    street.add_ways(driver, space.pattern(points.to(plan.device)))
                    streets.append(street)
                found.append(points)
                told += [recordings.digest(), points]
        title = f"Round {number}: learning"
        with self.ledger.stage("learn"):
            tune(
                network,
                self.teacher,
                streets,
                spaces,
                torch.cat(found),
                town,
                tuning,
                seed=plan.seed_of(number),
                device=plan.device,
                step=self.step,
                checkpoint=Checkpoint(path, stated(known_by(told))),
                on_step=lambda step, loss: self.tell(title, step, tuning.steps, f"loss {loss:.4f}"),
            )
        _save(network, plan, number)
        path.unlink(missing_ok=True)

    def judge(self, number: int, judge_on: Sequence[Scenario]) -> tuple[tuple[JudgedAttack, ...], dict[str, str]]:
        """Judge the controller of a round on other streets; one after tuning when the one before, 0, has been.

        Returns:
            Every kind of attack on every street, and why a street could not be judged, by its name.
        """
        when = "after" if number else "before"
        judged, unjudged = list[JudgedAttack](), dict[str, str]()
        with self.ledger.stage("judge"):
            self._together(f"Judging {when}", _judge_street, number, judge_on)
            for scenario in judge_on:
                told = self._under(f"Judging {when}, {scenario.name}")
                try:
                    judged += StreetJudge(self.plan, self.simulator, number, scenario, told).judge()
                except CanvasNotReachedError as error:
                    unjudged[scenario.name] = str(error)
        return tuple(judged), unjudged

    def judge_before(self, judge_on: Sequence[Scenario]) -> tuple[JudgedAttack, ...]:
        """Judge the controller as it came, on streets that it has to drive.

        Raises:
            TrainingError: it does not drive one of them as far as its canvas.
        """
        judged, unjudged = self.judge(0, judge_on)
        for name, why in unjudged.items():
            raise TrainingError(f"{name} cannot be judged on: {why}; judge on streets that the controller drives")
        return judged

    def drive_clean(self, best: int, scenarios: Sequence[Scenario]) -> tuple[BareDrives, BareDrives]:
        """Drive over the bare road with the controllers before and after."""
        scenarios = list(dict.fromkeys(scenarios))  # no two processes drive into one folder
        with self.ledger.stage("bare road"):
            driven: list[BareDrives] = []
            for number, title in ((0, "Bare road, before"), (best, "Bare road, after")):
                self._together(title, _drive_clean, number, scenarios)
                told = partial(self.tell, title, word="drives")
                driven.append(_drive_over(self.plan, number, self.simulator, scenarios, told))
            before, after = driven
            self.ledger.calls("bare road", before.drives + after.drives)
        return before, after

    def town(self, number: int) -> Town | None:
        """Drives over the town's bare roads by the controllers of all rounds before, where there is a town.

        A tuned controller drives elsewhere than the one before, and learns there what that one would do.
        """
        plan, drives = self.plan, self.plan.budget.town_drives
        if not drives or not isinstance(self.simulator, TownSimulator):
            return None
        paths: list[Path] = []
        with self.ledger.stage("town"):
            for past in range(number):
                title = f"Round {past}: driving through the town"
                own = [plan.town_drive(past, k) for k in range(drives)]
                self._together(title, _drive_in_town, past, [k for k, path in enumerate(own) if not path.exists()])
                for k in range(drives):
                    _drive_in_town(plan, past, self.simulator, k)
                    self.tell(title, k + 1, drives, "drives")
                paths += own
            self.ledger.calls("town", len(paths))
        return Town(Dataset.load(paths), self.simulator.camera, self.simulator.input, device=plan.device)

    def _together(self, title: str, work: RoundWork[Work], number: int, works: Sequence[Work]) -> None:
        """Let several processes do a street or drive each, where they are asked for; the folder keeps all of it."""
        if self.processes > 1 and len(works) > 1 and self.factory is not None:
            what = "streets" if isinstance(works[0], Scenario) else "drives"
            self.tell(title, 0, len(works), what)
            done = spread(partial(work, self.plan, number), works, self.factory, processes=self.processes)
            for count, (each, _) in enumerate(done, 1):
                named = f", {each.name} is done" if isinstance(each, Scenario) else ""
                self.tell(title, count, len(works), f"{what}{named}")

    def _under(self, title: str) -> OnProgress:
        """Progress of the stages of one attack, told under one title."""
        return lambda stage, done, total, word: self.tell(title, done, total, f"{stage.lower()} {word}".strip())


def _attack_street(plan: HardeningPlan, number: int, simulator: Simulator, scenario: Scenario) -> None:
    plan.attack(simulator, number, scenario, _go_on)


def _drive_clean(plan: HardeningPlan, number: int, simulator: Simulator, scenario: Scenario) -> None:
    _drive_over(plan, number, simulator, [scenario], lambda done, total: _go_on("", done, total, ""))


def _drive_over(
    plan: HardeningPlan,
    number: int,
    simulator: Simulator,
    scenarios: Sequence[Scenario],
    on_drive: Callable[[int, int], object],
) -> BareDrives:
    weathers, folder = plan.budget.clean_weathers, plan.round(number) / "clean"
    return clean_drives(simulator, plan.controller(number), scenarios, weathers, folder, on_drive=on_drive)


def _drive_in_town(plan: HardeningPlan, number: int, town: TownSimulator, drive: int) -> None:
    path = plan.town_drive(number, drive)
    if not path.exists():
        seed = plan.seed_of(number) if number else plan.seed
        drawn = CollectionPlan(drives=plan.budget.town_drives, seed=seed, controller=plan.spec_of(number))
        record_drive(town, drawn, drive, plan.controller(number)).save(path)
    _go_on("", drive, drive, "")


def _judge_street(plan: HardeningPlan, number: int, simulator: Simulator, scenario: Scenario) -> None:
    # Where a controller does not drive is told where all streets are gathered.
    with suppress(CanvasNotReachedError):
        StreetJudge(plan, simulator, number, scenario, _go_on).judge()


def _go_on(_stage: str, _done: int, _total: int, _word: str) -> None:
    if stopping():
        raise TrainingError("another of them failed")


def _save(network: nn.Module, plan: HardeningPlan, number: int) -> None:
    path = plan.weights(number)
    rounds = count_of(number, "round")
    origin = f"{plan.spec}, hardened for {rounds} on {', '.join(each.name for each in plan.scenarios)}"
    if isinstance(network, CIL | ConditionalPilotNet | NetworkController) and not runs_code(plan.spec):
        save_controller(network, path, dtype="float16", origin=origin)
        return
    write_tensors(path, tensors_of(network), {"roadproof-origin": origin})
