"""`roadproof harden`: a controller made robust against paint, and judged on other streets."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast

import typer

from roadproof.cli import options
from roadproof.cli.options import argument, choice, number, unset
from roadproof.cli.output import answer, say, stored
from roadproof.cli.paint import Paint
from roadproof.cli.verbs import begin
from roadproof.errors import RoadproofError

if TYPE_CHECKING:
    from roadproof.controllers import Controller
    from roadproof.hardening.budget import HardeningBudget
    from roadproof.hardening.tuning import TrainingStep
    from roadproof.pipeline.workload import Workload
    from roadproof.scenarios import Scenario


def harden(
    controller: Annotated[str, argument(f"A torch.nn.Module: {options.TRAINABLE}")],
    train_on: Annotated[str, unset("Scenarios to train on, with commas between.")],
    judge_on: Annotated[str, unset("Scenarios on other streets to judge on, with commas between.")] = "",
    clean_on: Annotated[
        str, unset("Scenarios driven over the bare road before and after: all, or names.", default="those above")
    ] = "",
    scenarios: options.ScenarioFile = None,
    rounds: Annotated[int, number("Rounds of attack, tuning and re-test.", 1, 100)] = 2,
    budget: Annotated[str, typer.Option(help="quick, or full: ten times the tuning; see --dry-run.")] = "quick",
    weathers: Annotated[str, options.several_weathers("in which it is attacked, learns and is judged")] = "clear-noon",
    training_step: Annotated[
        str | None, unset("module:function(model, batch) that gives the loss, where the usual does not fit.")
    ] = None,
    figures: options.Figures = 5,
    seed: options.Seed = 0,
    simulator: options.SimulatorSpec = "town",
    device: options.Device = "auto",
    processes: options.Processes = 1,
    out: options.Out = Path("out/harden"),
    *,
    paint: Paint,
) -> None:
    """Attack, fine-tune on what was found, attack afresh, in rounds; then judge on held-out streets."""
    from roadproof.cli.progress import stages
    from roadproof.controllers.loading import imported, load_controller, load_trainable
    from roadproof.hardening.budget import HARDENING_BUDGETS, check_streets
    from roadproof.hardening.harden import harden as run
    from roadproof.hardening.page import write_hardening
    from roadproof.hardening.tuning import training_step as usual_step
    from roadproof.scenarios import find_scenario
    from roadproof.search_space import SearchSpace
    from roadproof.simulators.loading import is_server, open_simulator

    options.check_processes(simulator, processes)
    known = options.scenarios_of(scenarios)

    def named(names: str) -> list[Scenario]:
        return [find_scenario(name.strip(), known) for name in names.split(",") if name.strip()]

    spent = HARDENING_BUDGETS[choice(budget, "budget", tuple(HARDENING_BUDGETS))].varied(paint.variation)
    spent = spent.in_weathers(options.weathers_of(weathers, "weathers"))
    training, judging = named(train_on), named(judge_on)
    if clean_on and not judging:
        raise RoadproofError("--clean-on is driven where the result is judged; give --judge-on too, or leave it out")
    clean = list(known) if clean_on == "all" else named(clean_on)
    step = (
        usual_step
        if training_step is None
        else cast("TrainingStep", imported(training_step, "a function of model and batch that gives the loss"))
    )
    check_streets(training, judging)
    load_trainable(controller)
    who = load_controller(controller, device=device)
    # A server has no town of ours to drive through.
    estimated = replace(spent, town_drives=0) if is_server(simulator) else spent
    begin(_workload(estimated, who, rounds, len(training), len(judging), len(clean), processes), out)
    with open_simulator(simulator) as world, stages() as show:
        found = run(
            world,
            controller,
            training,
            out,
            judge_on=judging,
            clean_on=clean,
            rounds=rounds,
            budget=spent,
            space=SearchSpace(figures=figures, limits=paint.limits),
            training_step=step,
            seed=seed,
            device=device,
            factory=partial(open_simulator, simulator),
            processes=processes,
            on_progress=show,
        )
    page = write_hardening(found, out)
    for each in found.rounds:
        kept = "  <- kept" if each.number == found.best else ""
        say(f"  round {each.number}: {each.mean_m:.2f} m on the streets trained on, attacked afresh{kept}")
    if found.judgement is not None:
        say(found.judgement.verdict().sentence)
        for name, why in found.judgement.unjudged.items():
            say(f"  {name} after it: {why}")
    say(f"The hardened controller is {found.hardened}, the page {page}")
    answer(stored(out / "hardening.json"))


def _workload(
    budget: HardeningBudget, who: Controller, rounds: int, training: int, judging: int, clean: int, processes: int
) -> Workload:
    """Attacks, tuning and judging, from numbers of streets; clean drives, on all streets for 0, are made twice."""
    from roadproof.pipeline.workload import Workload, frame_seconds, of_drives, of_evaluation, of_run, of_search

    learnt = Workload(seconds=budget.tuning.pictures * frame_seconds(who))
    learnt += of_drives(budget.town_drives, processes=processes)
    whole = of_run(budget.attack, who, film=False).times(training, at_once=processes).times(rounds + 1)
    whole += learnt.times(rounds)
    if judging:
        judge = budget.judge
        worlds = len(judge.recorded_in)
        found = of_search(budget.unseen, judge.objective, 0, who, worlds=worlds)
        again = of_search(judge.method, judge.objective, judge.window.frames * worlds, who, worlds=worlds)
        driven = of_evaluation(len(judge.weathers), judge.starts, judge.runs, film=False)
        before = of_run(judge, who, film=False) + found + again + driven.times(2)
        # The one after also drives over what was found against the one before.
        for each in (before, before + driven):
            whole += each.times(judging, at_once=processes)
        bare = 2 * len(budget.clean_weathers) * (clean or training + judging)
        whole += of_drives(bare, processes=processes)
    return whole
