"""Hardening a controller: attack, fine-tune on what was found, attack afresh; then the judgement on other streets.

    OUT/run.json                       what was asked for, and what the stages took (`pipeline.stage_costs`)
    OUT/round-0/judged/SCENARIO/       the judgement of the controller as it came (`hardening.judgement`)
    OUT/town/drive-00000.npz           drives through the town over bare roads; later rounds have their own
    OUT/round-0/SCENARIO/              the attack on the controller as it came (`pipeline.stress_test`)
    OUT/round-1/hardened.safetensors   the controller after the first tuning
    OUT/round-1/SCENARIO/              the attack afresh on it: its re-test, and what round 2 learns from
    OUT/round-N/judged/SCENARIO/       the judgement of the best round
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
from pathlib import Path

from roadproof.controllers.checks import require_usable
from roadproof.controllers.loading import files_of, load_trainable
from roadproof.errors import TrainingError
from roadproof.hardening.budget import HardeningBudget, by_street, check_streets
from roadproof.hardening.judgement import Judgement
from roadproof.hardening.plan import STEP_PARTS, WEIGHTS, HardeningPlan
from roadproof.hardening.result import Hardened, best_of
from roadproof.hardening.stages import HardeningStages
from roadproof.hardening.tuning import TrainingStep, require_loss
from roadproof.hardening.tuning import training_step as usual_step
from roadproof.io.files import AnyPath, as_path, write_atomically
from roadproof.io.locks import working_in
from roadproof.limits import check_seed, is_whole
from roadproof.pipeline.stage_costs import Ledger
from roadproof.pipeline.stages import OnProgress, check_street
from roadproof.processes import require_opened
from roadproof.roads.maps import require_route
from roadproof.scenarios import Scenario
from roadproof.search_space import SearchSpace
from roadproof.simulators.protocol import Simulator, SimulatorFactory

STAGES = ("town", "attack", "learn", "bare road", "judge")


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
        space: the space of the patterns that are searched; five rectangles of the published family by default.
        training_step: gives the loss of a batch; your own where the usual one does not fit your controller.
        seed: the seed of everything random, 0 to 2³² − 1; judging has fresh ones.
        device: the torch device on which to search and learn, such as "cpu" or "cuda".
        factory: opens one more simulator of the same kind; needed for several processes.
        processes: how many streets are attacked or driven at once, each in a process with a simulator of its own.
        on_progress: called at every step with the stage's name, the steps done, their number, and a word on them.

    Raises:
        TrainingError: there are no rounds, the seed is out of range, streets for training and judging are not disjoint,
            there are some for clean driving and none for judging, the controller does not drive one for judging, or
            the training step gives no finite loss.
        ControllerError: the controller cannot learn, raises or answers wrongly.
        RoadproofError: the folder holds another hardening, or a stage refuses; the message says why.
    """
    folder = as_path(folder)
    check_streets(scenarios, judge_on)
    if not is_whole(rounds) or rounds < 1:
        raise TrainingError(f"rounds is {rounds!r:.40}, expected a whole number, 1 or more")
    if clean_on and not judge_on:
        raise TrainingError("clean_on is driven where the result is judged; give judge_on too, or leave it out")
    check_seed(seed, "seed", TrainingError)
    budget, space = budget or HardeningBudget(), space or SearchSpace(figures=5)
    if judge_on:
        budget.require_unseen(space)
    require_opened(processes, factory)
    streets = (*scenarios, *judge_on)
    budget.attack.method.check_space(space)
    for street in streets:
        check_street(simulator, street, space, budget.attack if street in scenarios else budget.judge)
    for each in dict.fromkeys((*streets, *clean_on)):
        require_route(simulator, each)
    network = load_trainable(controller)
    _keep_apart(controller, folder)
    plan = HardeningPlan(
        spec=controller,
        scenarios=tuple(scenarios),
        folder=folder,
        budget=budget,
        space=space,
        seed=seed,
        device=device,
    )
    teacher, size = plan.controller(0), (simulator.input.height_px, simulator.input.width_px)
    require_usable(teacher, size=size, device=device, gradients=budget.attack.method.by_gradient)
    require_loss(training_step, network, teacher, size=size, device=device)
    with working_in(folder):
        # Attacks of round 0 and drives through the town do not depend on the step: one that failed may be mended.
        unused = () if plan.weights(1).exists() else STEP_PARTS
        ledger = Ledger(folder, plan.made_of(simulator, teacher, training_step), STAGES, "a hardening", unused)
        stages = HardeningStages(plan, simulator, teacher, training_step, factory, processes, ledger, on_progress)
        # First of all, so that a street which cannot be judged on is refused before anything is learnt.
        before = stages.judge_before(judge_on)
        done = stages.rounds(rounds)
        best, judgement = best_of(done), None
        if judge_on:
            clean = stages.drive_clean(best, clean_on or streets)
            after, unjudged = stages.judge(best, judge_on)
            judgement = Judgement(before + after, clean, unjudged, by_street(judge_on))
            ledger.calls("judge", sum(each.simulator_calls for each in judgement.judged))
        # Not before they are judged: those of fewer rounds may lie there beside their own verdict.
        weights = folder / WEIGHTS
        write_atomically(weights, lambda part: shutil.copyfile(plan.weights(best), part))
        found = Hardened(
            controller=controller,
            hardened=plan.spec_with(weights),
            rounds=done,
            best=best,
            judgement=judgement,
            cost=ledger.cost,
        )
        found.save(folder)
    return found


def _keep_apart(controller: str, folder: Path) -> None:
    """See that no weights of the user's are written over, or taken for those of a round."""
    own = {each.resolve() for each in (folder / WEIGHTS, *folder.glob(f"round-*/{WEIGHTS}"))}
    for path in files_of(controller):
        if path.resolve() in own:
            raise TrainingError(f"{path} is where {folder} keeps its results; choose another folder for them")
