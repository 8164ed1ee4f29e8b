"""Hardening a controller: attack, fine-tune on what was found, attack afresh; then the judgement on other streets.

    OUT/plan.json                      what was asked for
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

import json
import shutil
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import nn

from roadproof.attacks.objective import variation_of
from roadproof.controllers import CIL, ConditionalPilotNet, Controller, load_controller
from roadproof.controllers.identity import identity_of
from roadproof.controllers.loading import load_trainable, runs_code, save_controller
from roadproof.controllers.steering import NetworkController
from roadproof.driving.evaluation import ATTACK
from roadproof.errors import TrainingError
from roadproof.hardening.budget import HardeningBudget, check_streets
from roadproof.hardening.judgement import Clean, Judge, Judged, Judgement, clean_drives
from roadproof.hardening.tuning import TrainingStep, tune
from roadproof.hardening.tuning import training_step as usual_step
from roadproof.hardening.views import Street
from roadproof.io.files import AnyPath, as_path, read_json, write_atomically, write_json, write_tensors
from roadproof.io.identity import ANSWERS, require_same, stated
from roadproof.io.locks import working_in
from roadproof.pipeline.stress_test import OnProgress, StressTest, stress_test
from roadproof.recordings import load_recordings
from roadproof.scenarios import Scenario, identity
from roadproof.search_space import SearchSpace, derived_seed
from roadproof.simulators.protocol import Simulator
from roadproof.simulators.town.simulator import TownSimulator
from roadproof.training.collection import CollectionPlan, record_drive
from roadproof.training.dataset import Dataset

FORMAT = "roadproof-hardening"
FORMAT_VERSION = 1
WEIGHTS = "hardened.safetensors"
_FRESH = 1000
"""Distance between the seeds of training and those of judging."""


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
    """

    controller: str
    hardened: str
    rounds: tuple[Round, ...]
    best: int
    judgement: Judgement | None


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
        on_progress: called at every step with the stage's name, the steps done, their number, and a word on them.

    Raises:
        TrainingError: there are no rounds, streets for training and judging are not disjoint, the folder holds another
            hardening, or the training step gives no finite loss.
        ControllerError: the controller cannot learn, raises or answers wrongly.
        RoadproofError: a stage refuses; the message says why.
    """
    folder = as_path(folder)
    check_streets(scenarios, judge_on)
    if rounds < 1:
        raise TrainingError(f"rounds is {rounds}, expected 1 or more")
    budget, space = budget or HardeningBudget(), space or SearchSpace(figures=5)
    if judge_on:
        budget.require_libraries(space)
    load_trainable(controller)
    run = _Run(
        simulator=simulator,
        spec=controller,
        teacher=load_controller(controller, device=device),
        scenarios=tuple(scenarios),
        folder=folder,
        budget=budget,
        space=space,
        step=training_step,
        seed=seed,
        device=device,
        on_progress=on_progress,
    )
    with working_in(folder):
        _claim(run)
        tests, done = list[list[StressTest]](), list[Round]()
        for number in range(rounds + 1):
            if number:
                _tuned(run, number, tests)
            tests.append([_attacked(run, number, scenario) for scenario in scenarios])
            done.append(_round(number, tests[-1]))
        best = min(done[1:], key=lambda each: each.mean_m).number
        weights = folder / WEIGHTS
        write_atomically(weights, lambda part: shutil.copyfile(run.weights(best), part))
        judgement = None
        if judge_on:
            clean = _clean(run, best, clean_on or (*scenarios, *judge_on))
            judgement = Judgement(_judged(run, best, judge_on), clean)
        found = Hardened(
            controller=controller,
            hardened=_spec(controller, weights),
            rounds=tuple(done),
            best=best,
            judgement=judgement,
        )
        _write(found, folder)
    return found


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class _Run:
    """The arguments of `harden`."""

    simulator: Simulator
    spec: str
    teacher: Controller
    scenarios: tuple[Scenario, ...]
    folder: Path
    budget: HardeningBudget
    space: SearchSpace
    step: TrainingStep
    seed: int
    device: str
    on_progress: OnProgress

    def weights(self, number: int) -> Path:
        """The weights file of a round's controller."""
        return self.folder / f"round-{number}" / WEIGHTS

    def spec_of(self, number: int) -> str:
        """The spec of a round's controller."""
        return _spec(self.spec, self.weights(number)) if number else self.spec

    def name(self, number: int) -> str:
        """The name of a round's controller in reports; the same wherever the folder lies."""
        return f"{self.spec}, hardened in round {number}" if number else self.spec

    def under(self, title: str) -> OnProgress:
        """Progress of the stages of one attack, told under one title."""
        return lambda stage, done, total, word: self.on_progress(title, done, total, f"{stage.lower()} {word}".strip())

    def controller(self, number: int) -> Controller:
        """The controller of a round."""
        return load_controller(self.spec_of(number), device=self.device) if number else self.teacher


def _spec(controller: str, weights: Path) -> str:
    """How the controller of a spec is loaded with other weights."""
    return f"{controller.partition('@')[0]}@{weights}" if runs_code(controller) else str(weights)


def _attacked(run: _Run, number: int, scenario: Scenario) -> StressTest:
    title = f"Round {number}, {scenario.name}"
    return stress_test(
        run.simulator,
        run.controller(number),
        scenario,
        run.folder / f"round-{number}" / scenario.name,
        budget=run.budget.attack,
        space=run.space,
        seed=derived_seed(run.seed, number) % _FRESH,
        controller_name=run.name(number),
        device=run.device,
        film=False,
        on_progress=run.under(title),
    )


def _round(number: int, tests: Sequence[StressTest]) -> Round:
    trials = {test.evaluation.scenario.name: test.evaluation.of(ATTACK, traffic=False) for test in tests}
    left = [trial.leaves_lane for each in trials.values() for trial in each]
    deviations = {name: float(np.mean([trial.deviation_m for trial in each])) for name, each in trials.items()}
    return Round(number, deviations, float(np.mean(left)))


def _tuned(run: _Run, number: int, tests: Sequence[Sequence[StressTest]]) -> None:
    """Tune on what all attacks so far found, from the weights of the round before."""
    if run.weights(number).exists():
        return
    town = _town(run)
    network = load_trainable(run.spec_of(number - 1))
    streets: list[Street] = []
    found: list[torch.Tensor] = []
    # It learns from paint of all kinds, also where attacks are limited.
    space = run.space.unlimited
    for past, attacked in enumerate(tests):
        driver = run.controller(past)
        for scenario, test in zip(run.scenarios, attacked, strict=True):
            recordings = load_recordings(run.folder / f"round-{past}" / scenario.name / "recordings")
            points = torch.stack([space.point(each.pattern) for each in test.attack.candidates])
            street = Street(recordings, run.teacher, device=run.device)
            street.add_ways(driver, space.pattern(points.to(run.device)))
            streets.append(street)
            found.append(points)
    tuning = run.budget.tuning
    tune(
        network,
        run.teacher,
        streets,
        space,
        torch.cat(found),
        town,
        tuning,
        seed=derived_seed(run.seed, number) % _FRESH,
        device=run.device,
        step=run.step,
        on_step=lambda step, loss: run.on_progress(f"Round {number}: learning", step, tuning.steps, f"loss {loss:.4f}"),
    )
    _save(network, run, run.weights(number), number)


def _save(network: nn.Module, run: _Run, path: Path, number: int) -> None:
    origin = f"{run.spec}, hardened for {number} rounds on {', '.join(each.name for each in run.scenarios)}"
    if isinstance(network, CIL | ConditionalPilotNet | NetworkController) and not runs_code(run.spec):
        save_controller(network, path, origin=origin)
        return
    tensors = {name: tensor.detach().cpu().clone().contiguous() for name, tensor in network.state_dict().items()}
    write_tensors(path, tensors, {"roadproof-origin": origin})


def _town(run: _Run) -> Dataset | None:
    """Frames of the controller's clean drives through the town, where there is one."""
    drives = run.budget.town_drives
    if not drives or not isinstance(run.simulator, TownSimulator):
        return None
    plan = CollectionPlan(drives=drives, seed=run.seed, controller=run.spec)
    paths = [run.folder / "town" / f"drive-{number:05d}.npz" for number in range(drives)]
    for number, path in enumerate(paths):
        if not path.exists():
            record_drive(run.simulator, plan, number, run.teacher).save(path)
        run.on_progress("Driving through the town", number + 1, drives, "drives")
    return Dataset.load(paths)


def _judged(run: _Run, best: int, judge_on: Sequence[Scenario]) -> tuple[Judged, ...]:
    judged: list[Judged] = []
    for scenario in judge_on:
        for number in (0, best):
            title = f"Judging {'after' if number else 'before'}, {scenario.name}"
            judged += Judge(
                simulator=run.simulator,
                controller=run.controller(number),
                scenario=scenario,
                folder=run.folder / f"round-{number}" / "judged" / scenario.name,
                budget=run.budget,
                space=run.space,
                seed=run.seed + _FRESH,
                name=run.name(number),
                device=run.device,
                before=run.folder / "round-0" / "judged" / scenario.name if number else None,
                on_progress=run.under(title),
            ).judge()
    return tuple(judged)


def _clean(run: _Run, best: int, scenarios: Sequence[Scenario]) -> tuple[Clean, Clean]:
    def of(number: int) -> Clean:
        title = f"Bare road, {'after' if number else 'before'}"
        return clean_drives(
            run.simulator,
            run.controller(number),
            scenarios,
            run.budget.clean_weathers,
            run.folder / f"round-{number}" / "clean",
            on_drive=lambda done, total: run.on_progress(title, done, total, "drives"),
        )

    return of(0), of(best)


def _write(found: Hardened, folder: Path) -> None:
    content = {"format": FORMAT, "version": FORMAT_VERSION, "kind": "closed loop"} | asdict(found)
    if found.judgement is not None:
        content["verdict"] = asdict(found.judgement.verdict())
    write_json(folder / "hardening.json", content)


def _claim(run: _Run) -> None:
    """Write what was asked for into the folder, or refuse a folder that was begun with something else."""
    view = run.simulator.input
    asked = {
        "controller": run.spec,
        ANSWERS: identity_of(run.teacher, (view.height_px, view.width_px)),
        "scenarios": [identity(each) for each in run.scenarios],
        "budget": repr(replace(run.budget, judge=run.budget.attack)),
        "space": repr(run.space),
        "variation": repr(variation_of(run.budget.attack.objective)),
        "seed": run.seed,
        "training step": f"{run.step.__module__}:{getattr(run.step, '__qualname__', type(run.step).__qualname__)}",
    }
    path = run.folder / "plan.json"
    if path.exists():
        kept = read_json(path, FORMAT, FORMAT_VERSION, TrainingError).get("asked")
        require_same(run.folder, "a hardening", kept, asked, TrainingError)
    else:
        write_json(path, {"format": FORMAT, "version": FORMAT_VERSION, "asked": json.loads(stated(asked))})
