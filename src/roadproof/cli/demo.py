"""`roadproof demo`: the whole loop for one scenario, from nothing to the report."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from roadproof.cli import options
from roadproof.cli.options import number
from roadproof.cli.output import answer, say, stored
from roadproof.cli.paint import Paint
from roadproof.cli.verbs import begin, keep_command
from roadproof.io.text import count_of

if TYPE_CHECKING:
    from roadproof.pipeline.stress_test import StressTest


def demo(
    scenario: options.ScenarioName = "left-03",
    scenarios: options.ScenarioFile = None,
    controller: options.ControllerSpec = "pilotnet",
    budget: options.BudgetName = "quick",
    rounds: Annotated[int, number("Rounds of searching on along the way that the attacked car took.", 0, 100)] = 0,
    attack_weathers: Annotated[str, options.several_weathers("over which the mean is attacked")] = "clear-noon",
    figures: options.Figures = 5,
    cheapest: options.CheapestFor = None,
    limit_costs: options.LimitCosts = False,
    seed: options.Seed = 0,
    simulator: options.SimulatorSpec = "town",
    device: options.Device = "cpu",
    processes: options.Processes = 1,
    out: options.Out = Path("out/demo"),
    *,
    paint: Paint,
) -> None:
    """Record, calibrate, attack, choose by driving, evaluate and report: the whole loop for one scenario."""
    from roadproof.attacks.cheapest import cheapest_in_words
    from roadproof.attacks.objective import varied
    from roadproof.cli.progress import stages
    from roadproof.controllers import load_controller
    from roadproof.pipeline.budget import BUDGETS
    from roadproof.pipeline.limit_costs import relaxed_limits
    from roadproof.pipeline.stress_test import check_asked, stress_test
    from roadproof.pipeline.workload import of_cheapest, of_drives, of_finding, of_run
    from roadproof.search_space import SearchSpace
    from roadproof.simulators.loading import open_simulator

    tested = options.scenario_of(scenario, scenarios)
    options.check_processes(simulator, processes)
    spent = BUDGETS[options.choice(budget, "budget", tuple(BUDGETS))]
    spent = replace(spent, rounds=rounds, attack_weathers=options.weathers_of(attack_weathers, "attack-weathers"))
    spent = replace(spent, objective=varied(spent.objective, paint.variation))
    space = SearchSpace(figures=figures, limits=paint.limits)
    check_asked(spent, space, cheapest_m=cheapest, limit_costs=limit_costs)
    who = load_controller(controller, device=device)
    work = of_run(spent, who, processes=processes)
    if cheapest is not None:
        work += of_cheapest(figures, spent.objective, who) + of_drives(1)
    if limit_costs:
        searched = of_finding(replace(spent, rounds=0, select=1), who)
        work += searched.times(len(relaxed_limits(space, spent.objective))) + of_drives(1)
    begin(work, out)
    with open_simulator(simulator) as world, stages() as show:
        result = stress_test(
            world,
            who,
            tested,
            out,
            budget=spent,
            space=space,
            seed=seed,
            controller_name=controller,
            device=device,
            factory=partial(open_simulator, simulator),
            processes=processes,
            cheapest_m=cheapest,
            limit_costs=limit_costs,
            on_progress=show,
        )
    keep_command(out)
    _report(result, out)
    if cheapest is not None:
        less = result.cheapest
        driven = "" if less is None else f"; driven {less[1].deviation_m:.2f} m"
        say(cheapest_in_words(less and less[0], cheapest) + driven)
    if result.limit_costs is not None:
        say(*result.limit_costs.sentences)
    answer(stored(out / "result.json"))


def _report(result: StressTest, out: Path) -> None:
    from roadproof.pipeline.stage_costs import StageCost
    from roadproof.report.page import write_report

    page = write_report(out)
    say(stored(out / "result.json")["verdict"]["sentence"])
    if result.rounds is not None and result.rounds.stopped:
        say(f"Searching on ended early: {result.rounds.stopped}")
    if (prediction := result.prediction) is not None:
        apart_m = prediction.path_error_m
        say(
            f"Predicted in the recordings {prediction.predicted_m:.2f} m of deviation ({prediction.least_m:.2f} to "
            f"{prediction.most_m:.2f} over small errors), driven {prediction.driven_m:.2f} m"
            + ("" if apart_m is None else f"; {apart_m:.2f} m between the paths on average")
        )
    spent = [(stage, cost) for stage, cost in result.cost.items() if cost != StageCost()]
    drives = [f" ({count_of(cost.simulator_calls, 'drive')})" if cost.simulator_calls else "" for _, cost in spent]
    say("Took " + ", ".join(f"{stage} {c.seconds:.0f} s{n}" for (stage, c), n in zip(spent, drives, strict=True)))
    say(f"The report is {page}, its numbers are in {page.with_name('result.json')}")
