"""Hardening a controller: attack, fine-tune on what was found, attack afresh; then the judgement on other streets.

    OUT/run.json                       what was asked for, and what the stages took (`pipeline.stage_costs`)
    OUT/town/drive-00000.npz           clean drives through the town
    OUT/round-0/SCENARIO/              the attack on the controller as it came (`pipeline.stress_test`)
    OUT/round-1/hardened.safetensors   the controller after the first tuning
    OUT/round-1/SCENARIO/              the attack afresh on it: its re-test, and what round 2 learns from
    OUT/round-N/judged/SCENARIO/       the judgement, of round 0 and of the best round (`hardening.judgement`)
    OUT/hardened.safetensors           the best round's weights
    OUT/hardening.json, .html          what came of it

The same call goes on from what the folder holds, however it was interrupted.

References:
    Kerr et al., "ARC: adversarially robust control policies for autonomous vehicles", 2021 (arXiv:2107.04487);
    Lechner et al., "Revisiting the adversarial robustness-accuracy tradeoff in robot learning", 2022
    (arXiv:2204.07373).
"""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial

import numpy as np
import torch
from torch import nn

from roadproof.attacks.objective import variation_of
from roadproof.controllers import CIL, ConditionalPilotNet, Controller
from roadproof.controllers.identity import identity_of
from roadproof.controllers.loading import load_trainable, runs_code, save_controller
from roadproof.controllers.steering import NetworkController
from roadproof.driving.evaluation import ATTACK
from roadproof.errors import TrainingError
from roadproof.hardening.budget import HardeningBudget, check_streets
from roadproof.hardening.judgement import Clean, Judge, Judged, Judgement, clean_drives
from roadproof.hardening.run import WEIGHTS, Run
from roadproof.hardening.together import StreetWork, attack_street, judge_street
from roadproof.hardening.tuning import TrainingStep, tune
from roadproof.hardening.tuning import training_step as usual_step
from roadproof.hardening.views import Street
from roadproof.io.files import AnyPath, as_path, write_atomically, write_json, write_tensors
from roadproof.io.identity import ANSWERS
from roadproof.io.locks import working_in
from roadproof.pipeline.stage_costs import Ledger, StageCost
from roadproof.pipeline.stress_test import OnProgress, StressTest
from roadproof.processes import Opened, spread
from roadproof.recordings import load_recordings
from roadproof.scenarios import Scenario, identity
from roadproof.search_space import SearchSpace
from roadproof.simulators.protocol import Simulator, SimulatorFactory
from roadproof.simulators.town.simulator import TownSimulator
from roadproof.training.collection import CollectionPlan, record_drive
from roadproof.training.dataset import Dataset

FORMAT = "roadproof-hardening"
FORMAT_VERSION = 1
STAGES = ("town", "attack", "learn", "bare road", "judge")


@dataclass(frozen=True, slots=True)
class Round:
    """What an attack afresh reached on the streets for training, driven.

    Args:
        number: the round's number; 0 is the round before anything was learnt.
        deviation_m: mean deviation over the drives of each scenario's evaluation, metres, by the scenario's name.
        left_lane: share of all the evaluations' drives that leave their lane, 0 to 1.
    """

    number: int
    deviation_m: dict[str, float]
    left_lane: float

    @property
    def mean_m(self) -> float:
        """The mean deviation over the scenarios, metres."""
        return float(np.mean(list(self.deviation_m.values())))


@dataclass(frozen=True, kw_only=True, slots=True)
class Hardened:
    """What came of a hardening.

    Args:
        controller: the spec of the controller that it began with.
        hardened: the spec of the hardened controller, for `load_controller` and every verb.
        rounds: the re-tests on the streets for training, round 0 first.
        best: number of the round whose controller is kept: the one after a tuning with the least mean deviation.
        judgement: before and after on other streets; None where none were given.
        cost: cost of each stage since the hardening began, by its name.
    """

    controller: str
    hardened: str
    rounds: tuple[Round, ...]
    best: int
    judgement: Judgement | None
    cost: dict[str, StageCost]


def harden(
    simulator: Simulator,
    controller: str,
    scenarios: Sequence[Scenario],
    folder: AnyPath,
    *,
    judge_on: Sequence[Scenario] = (),
    clean_on: Sequence[Scenario] = (),
    rounds: int = 2,
    budget: HardeningBudget | None = None,
    space: SearchSpace | None = None,
    training_step: TrainingStep = usual_step,
    seed: int = 0,
    device: str = "cpu",
    factory: SimulatorFactory | None = None,
    processes: int = 1,
    on_progress: OnProgress = lambda _stage, _done, _total, _word: None,
) -> Hardened:
    """Make a controller robust against paint, and judge on other streets whether that helped.

    Args:
        simulator: an open simulator.
        controller: spec of a `torch.nn.Module`, as `load_controller` takes it; it learns from its own answers to the
            bare road, and no weights but those of OUT are written.
        scenarios: the scenarios on the streets for training.
        folder: keeps everything; the same call goes on from it, also with more rounds or other streets for judging.
        judge_on: scenarios on other streets, for judging; without any, nothing is judged.
        clean_on: scenarios driven over the bare road before and after; by default those of training and judging.
        rounds: how many rounds of attack, tuning and re-test there are, at least 1.
        budget: how much is spent on attacks, tuning and judging; `HardeningBudget()` by default.
        space: which patterns are searched; five rectangles of the published family by default.
        training_step: gives the loss of a batch; your own where the usual one does not fit your controller.
        seed: the seed of everything random; judging has fresh ones.
        device: the torch device on which to search and learn, such as "cpu" or "cuda".
        factory: opens one more simulator of the same kind; needed for several processes.
        processes: how many streets are attacked at once, each in a process with a simulator of its own.
        on_progress: called at every step with the stage's name, the steps done, their number, and a word on them.

    Raises:
        TrainingError: there are no rounds, streets for training and judging are not disjoint, or the training step
            gives no finite loss.
        ControllerError: the controller cannot learn, raises or answers wrongly.
        RoadproofError: the folder holds another hardening, or a stage refuses; the message says why.
    """
    folder = as_path(folder)
    check_streets(scenarios, judge_on)
    if rounds < 1:
        raise TrainingError(f"rounds is {rounds}, expected 1 or more")
    budget, space = budget or HardeningBudget(), space or SearchSpace(figures=5)
    if judge_on:
        budget.require_libraries(space)
    if processes < 1 or (processes > 1 and factory is None):
        raise TrainingError(
            f"{processes} processes; expected 1, or more with a factory that opens a simulator for each"
        )
    load_trainable(controller)
    run = Run(
        spec=controller,
        scenarios=tuple(scenarios),
        folder=folder,
        budget=budget,
        space=space,
        seed=seed,
        device=device,
    )
    teacher = run.controller(0)
    with working_in(folder):
        ledger = Ledger(folder, _made_of(run, simulator, teacher, training_step), STAGES, "a hardening")
        hardening = _Hardening(run, simulator, teacher, training_step, factory, processes, ledger, on_progress)
        town = hardening.town()
        tests, done = list[list[StressTest]](), list[Round]()
        for number in range(rounds + 1):
            if number:
                hardening.tune(number, tests, town)
            tests.append(hardening.attack(number))
            done.append(_round(number, tests[-1]))
        ledger.calls(
            "attack", sum(cost.simulator_calls for each in tests for test in each for cost in test.cost.values())
        )
        best = min(done[1:], key=lambda each: each.mean_m).number
        weights = folder / WEIGHTS
        write_atomically(weights, lambda part: shutil.copyfile(run.weights(best), part))
        judgement = None
        if judge_on:
            clean = hardening.drive_clean(best, clean_on or (*scenarios, *judge_on))
            judgement = Judgement(hardening.judge(best, judge_on), clean)
        found = Hardened(
            controller=controller,
            hardened=run.spec_with(weights),
            rounds=tuple(done),
            best=best,
            judgement=judgement,
            cost=ledger.cost,
        )
        content = {"format": FORMAT, "version": FORMAT_VERSION, "kind": "closed loop"} | asdict(found)
        if found.judgement is not None:
            content["verdict"] = asdict(found.judgement.verdict())
        write_json(folder / "hardening.json", content)
    return found


@dataclass(frozen=True, slots=True, eq=False)
class _Hardening:
    """A run with what it is done with: the other arguments of `harden`, and the controller before."""

    run: Run
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

    def attack(self, number: int) -> list[StressTest]:
        """Attack the controller of a round afresh on every street for training."""
        with self.ledger.stage("attack"):
            self._together(f"Round {number}", attack_street, number, self.run.scenarios)
            return [
                self.run.attack(self.simulator, number, each, self._under(f"Round {number}, {each.name}"))
                for each in self.run.scenarios
            ]

    def tune(self, number: int, tests: Sequence[Sequence[StressTest]], town: Dataset | None) -> None:
        """Tune on what all attacks so far found, from the weights of the round before."""
        run, tuning = self.run, self.run.budget.tuning
        if run.weights(number).exists():
            return
        network = load_trainable(run.spec_of(number - 1))
        # It learns from paint of all kinds, also where attacks are limited.
        space = run.space.unlimited
        streets: list[Street] = []
        found: list[torch.Tensor] = []
        for past, attacked in enumerate(tests):
            driver = run.controller(past)
            for scenario, test in zip(run.scenarios, attacked, strict=True):
                recordings = load_recordings(run.round(past) / scenario.name / "recordings")
                points = torch.stack([space.point(each.pattern) for each in test.attack.candidates])
                street = Street(recordings, self.teacher, device=run.device)
                street.add_ways(driver, space.pattern(points.to(run.device)))
                streets.append(street)
                found.append(points)
        title, checkpoint = f"Round {number}: learning", run.round(number) / "learning.safetensors"
        with self.ledger.stage("learn"):
            tune(
                network,
                self.teacher,
                streets,
                space,
                torch.cat(found),
                town,
                tuning,
                seed=run.seed_of(number),
                device=run.device,
                step=self.step,
                checkpoint=checkpoint,
                on_step=lambda step, loss: self.tell(title, step, tuning.steps, f"loss {loss:.4f}"),
            )
        _save(network, run, number)
        checkpoint.unlink(missing_ok=True)

    def judge(self, best: int, judge_on: Sequence[Scenario]) -> tuple[Judged, ...]:
        """Judge the controllers before and after on other streets."""
        judged: list[Judged] = []
        with self.ledger.stage("judge"):
            # All before come first: the one after also drives over what was found against the one before.
            for number, when in ((0, "before"), (best, "after")):
                self._together(f"Judging {when}", judge_street, number, judge_on)
            for scenario in judge_on:
                for number, when in ((0, "before"), (best, "after")):
                    told = self._under(f"Judging {when}, {scenario.name}")
                    judged += Judge(self.run, self.simulator, number, scenario, told).judge()
            self.ledger.calls("judge", sum(each.simulator_calls for each in judged))
        return tuple(judged)

    def drive_clean(self, best: int, scenarios: Sequence[Scenario]) -> tuple[Clean, Clean]:
        """Drive over the bare road with the controllers before and after."""
        with self.ledger.stage("bare road"):
            before, after = (
                clean_drives(
                    self.simulator,
                    self.run.controller(number),
                    scenarios,
                    self.run.budget.clean_weathers,
                    self.run.round(number) / "clean",
                    on_drive=lambda done, total, when=when: self.tell(f"Bare road, {when}", done, total, "drives"),
                )
                for number, when in ((0, "before"), (best, "after"))
            )
            self.ledger.calls("bare road", before.drives + after.drives)
        return before, after

    def town(self) -> Dataset | None:
        """Frames of the controller's clean drives through the town, where there is one."""
        drives = self.run.budget.town_drives
        if not drives or not isinstance(self.simulator, TownSimulator):
            return None
        plan = CollectionPlan(drives=drives, seed=self.run.seed, controller=self.run.spec)
        paths = [self.run.folder / "town" / f"drive-{number:05d}.npz" for number in range(drives)]
        with self.ledger.stage("town"):
            for number, path in enumerate(paths):
                if not path.exists():
                    record_drive(self.simulator, plan, number, self.teacher).save(path)
                self.tell("Driving through the town", number + 1, drives, "drives")
            self.ledger.calls("town", drives)
        return Dataset.load(paths)

    def _together(self, title: str, work: StreetWork, number: int, scenarios: Sequence[Scenario]) -> None:
        """Let several processes work on a street each, where they are asked for; the folder keeps all of it."""
        if self.processes > 1 and len(scenarios) > 1 and self.factory is not None:
            self.tell(title, 0, len(scenarios), "streets")
            on_street = partial(work, self.run, number)
            done = spread(on_street, scenarios, Opened(self.factory), processes=self.processes)
            for count, (scenario, _) in enumerate(done, 1):
                self.tell(title, count, len(scenarios), f"streets, {scenario.name} is done")

    def _under(self, title: str) -> OnProgress:
        """Progress of the stages of one attack, told under one title."""
        return lambda stage, done, total, word: self.tell(title, done, total, f"{stage.lower()} {word}".strip())


def _made_of(run: Run, simulator: Simulator, teacher: Controller, step: TrainingStep) -> dict[str, object]:
    """What identifies a hardening; judging may be asked for later."""
    view = simulator.input
    return {
        "controller": run.spec,
        ANSWERS: identity_of(teacher, (view.height_px, view.width_px)),
        "scenarios": [identity(each) for each in run.scenarios],
        "budget": repr(replace(run.budget, judge=run.budget.attack)),
        "space": repr(run.space),
        "variation": repr(variation_of(run.budget.attack.objective)),
        "seed": run.seed,
        "training step": f"{step.__module__}:{getattr(step, '__qualname__', type(step).__qualname__)}",
    }


def _round(number: int, tests: Sequence[StressTest]) -> Round:
    trials = {test.evaluation.scenario.name: test.evaluation.of(ATTACK, traffic=False) for test in tests}
    left = [trial.leaves_lane for each in trials.values() for trial in each]
    deviations = {name: float(np.mean([trial.deviation_m for trial in each])) for name, each in trials.items()}
    return Round(number, deviations, float(np.mean(left)))


def _save(network: nn.Module, run: Run, number: int) -> None:
    path = run.weights(number)
    origin = f"{run.spec}, hardened for {number} rounds on {', '.join(each.name for each in run.scenarios)}"
    if isinstance(network, CIL | ConditionalPilotNet | NetworkController) and not runs_code(run.spec):
        save_controller(network, path, origin=origin)
        return
    tensors = {name: tensor.detach().cpu().clone().contiguous() for name, tensor in network.state_dict().items()}
    write_tensors(path, tensors, {"roadproof-origin": origin})
