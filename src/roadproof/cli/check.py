"""`roadproof check`: a regression gate for a team's CI."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from roadproof.cli.options import Device, Out, Processes, Trust, argument, check_processes, choice, unset
from roadproof.cli.output import answer, say, stored, table
from roadproof.cli.verbs import begin, is_dry_run

if TYPE_CHECKING:
    from roadproof.controllers import Controller
    from roadproof.gate.plan import CheckPlan
    from roadproof.gate.result import CheckResult
    from roadproof.pipeline.workload import Workload


def check(
    plan: Annotated[Path, argument("TOML file that says what is driven, and what passes.")],
    budget: Annotated[
        str | None,
        unset(
            "smoke: stored and random patterns in recordings; full: in the simulator, with fresh attacks.",
            default="the plan's",
        ),
    ] = None,
    accept: Annotated[
        bool, typer.Option("--accept", help="Compare with no reference; where all passes, this becomes it.")
    ] = False,
    trust: Trust = False,
    processes: Processes = 1,
    device: Device = "cpu",
    out: Out = Path("out/check"),
) -> None:
    """Check a controller against stored, random and fresh patterns: exit code 0 passed, 1 not, 2 not run."""
    from roadproof.cli.progress import stages
    from roadproof.controllers import load_controller
    from roadproof.errors import CheckError
    from roadproof.gate.check import clear, run_check
    from roadproof.gate.plan import BUDGETS, FILE, load_check, references_of
    from roadproof.gate.verdict import Status
    from roadproof.io.files import check_writable
    from roadproof.io.locks import hold

    references = references_of(plan)
    if not is_dry_run():
        hold(out)
        clear(out, references)
    asked = None if budget is None else choice(budget, "budget", BUDGETS)
    chosen = load_check(plan, budget=asked, trust=trust)
    if accept and chosen.reference is None:
        raise CheckError(f"--accept makes a reference, but {plan} names none; add [change] with reference")
    if accept and chosen.reference is not None and not is_dry_run():
        check_writable(chosen.reference.parent)
    if chosen.budget == "full":
        check_processes(chosen.simulator, processes)
    who = load_controller(chosen.controller, device=device)
    begin(_workload(chosen, who, processes))
    with stages() as show:
        result = run_check(chosen, who, out, compare=not accept, device=device, processes=processes, on_progress=show)
    _summarise(result, out)
    passed = result.status is Status.PASSED
    if accept and not passed:
        say("This does not become the reference, since not all of it passed")
    elif accept and chosen.reference is not None:
        result.save(chosen.reference)
        say(f"From now on the reference is {chosen.reference}; keep it beside the plan")
    answer(stored(out / FILE))
    if not passed:
        raise typer.Exit(1)


def _workload(plan: CheckPlan, who: Controller, processes: int) -> Workload:
    """All cases; a fresh attack is a whole stress test but for its evaluation."""
    from roadproof.pipeline.workload import of_drives, of_run

    seeds, full = len(plan.seeds), plan.budget == "full"
    stored = sum(map(len, plan.stored.values()))
    each_start = len(plan.scenarios) * (1 + full * seeds) + stored
    drives = len(plan.weathers) * seeds * (each_start * plan.starts.count + len(plan.scenarios) * plan.random)
    driven = of_drives(drives, processes=processes)
    if not full:
        return replace(driven, drives=0)
    return of_run(plan.attack, who, film=False).times(len(plan.scenarios) * seeds) + driven


def _summarise(result: CheckResult, out: Path) -> None:
    from roadproof.gate.outputs import COLUMNS, heading, rows_of, why

    shown = table(COLUMNS)
    for row in rows_of(result):
        shown.add_row(*row)
    say(shown)
    for case in result.not_passed:
        say("\n  ".join((f"{case.status}: {case}", *why(case), f"see it: {case.command}")))
    say(heading(result), f"Results in {out}: check.json, junit.xml, summary.md")
