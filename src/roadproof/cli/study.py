"""`roadproof study`: many scenarios, figures and methods compared, and what came of it as tables."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from roadproof.cli.group import Verbs
from roadproof.cli.options import Out, Trust, argument, number, unset
from roadproof.cli.output import answer, say
from roadproof.cli.verbs import begin, is_dry_run, verb
from roadproof.limits import MAX_PROCESSES

if TYPE_CHECKING:
    from roadproof.controllers import Controller
    from roadproof.pipeline.workload import Workload
    from roadproof.study.plan import Job, Study
    from roadproof.study.rows import JobResult

study = Verbs("Compare methods over many scenarios.")


def run(
    plan: Annotated[Path, argument("TOML file that says what is compared.")],
    out: Out = Path("out/study"),
    workers: Annotated[
        int, number("Jobs at once on this machine, each in a process of its own.", 1, MAX_PROCESSES)
    ] = 1,
    cluster: Annotated[str | None, unset("Address of a Ray cluster, or local for one on this machine.")] = None,
    trust: Trust = False,
) -> None:
    """Find and evaluate a pattern for every scenario, number of figures, method and seed of a plan."""
    from roadproof.cli.progress import HOURS_S, progress
    from roadproof.controllers import load_controller
    from roadproof.study.folder import is_done
    from roadproof.study.job import run_job
    from roadproof.study.plan import load_study
    from roadproof.study.run import check_workers, run_study
    from roadproof.study.summary import failures, summary

    chosen = load_study(plan, trust=trust)
    check_workers(chosen, workers, cluster)
    jobs = chosen.jobs
    begun = sum(is_done(job, out) for job in jobs)
    if begun < len(jobs) or is_dry_run():
        # One that is not there is refused at once, not job by job.
        begin(_workload(chosen, load_controller(chosen.controller), workers), out)
    failed = 0
    with progress("Jobs", len(jobs), "{:.0f} failed", begun=begun, remember_s=HOURS_S) as show:

        def told(done: int, _: Job, result: JobResult) -> None:
            nonlocal failed
            failed += any(row.get("error") for row in result.rows)
            show(done, failed)

        rows = run_study(chosen, out, run_job, workers=workers, cluster=cluster, on_job=told)
    say(*summary(rows, str(chosen.weathers[0])))
    say(f"Rows in {out / 'rows.parquet'}; tables and figures: roadproof study tables {out}")
    bad = failures(rows)
    say(*(f"FAILED {line}" for line in bad))
    if bad:
        say("Give the same command again to try those once more; remove a file first that is called damaged")
    answer({"rows": rows.to_dict("records")})
    if bad:
        raise typer.Exit(1)


def _workload(study: Study, who: Controller, workers: int) -> Workload:
    """All jobs, also of those that are done already; what they share is made once for each scenario and seed."""
    import torch

    from roadproof.machine import threads
    from roadproof.pipeline.workload import Workload, of_drives, of_finding, of_proposals, of_recording
    from roadproof.study.methods import budget_of, tries_by_driving
    from roadproof.study.shared import recorded_by

    traffic, weathers = study.traffic, len(study.weathers)
    crowded = 0 if traffic is None else traffic.runs * (1 if traffic.weathers == "first" else weathers)
    judging = of_drives(weathers * study.starts.count, crowded)
    own, recordings = Workload(), dict[str, Workload]()
    for method in study.methods:
        own += judging
        budget = budget_of(method, study.weathers[0], study.variation)
        if tries_by_driving(method):
            own += of_drives(method.calls + 1) + of_proposals(budget.method)
        else:
            # Jobs side by side share out the cores.
            with threads(max(1, torch.get_num_threads() // workers)):
                own += of_finding(budget, who)
            recordings[recorded_by(budget)] = of_recording(budget)
    shared = sum(recordings.values(), judging)
    places = len(study.scenarios) * len(study.seeds)
    return own.times(places * len(study.figures), at_once=workers) + shared.times(places, at_once=workers)


def transfer(
    plan: Annotated[Path, argument("TOML file that says what is compared.")],
    controllers: Annotated[str, unset("Whom to try, with commas between.")],
    out: Out = Path("out/study"),
    trust: Trust = False,
) -> None:
    """Drive other controllers over the patterns that a study found; its results are in the same folder."""
    from roadproof.cli.progress import stages
    from roadproof.study.plan import load_study
    from roadproof.study.summary import transfer_summary
    from roadproof.study.transfer import transfer as run_transfer

    chosen = load_study(plan, trust=trust)
    specs = [spec.strip() for spec in controllers.split(",") if spec.strip()]
    with stages() as show:
        found = run_transfer(chosen, out, specs, on_pattern=lambda done, total: show("Patterns", done, total, ""))
    say(*transfer_summary(found.rows), f"Rows in {out / 'transfer.parquet'}")
    say(*(f"FAILED {line}" for line in found.failures))
    answer({"rows": found.rows.to_dict("records"), "failures": list(found.failures)})
    if found.failures:
        raise typer.Exit(1)


def tables(
    folder: Annotated[Path, argument("Of the study, with its rows.parquet.")],
    out: Annotated[Path | None, unset("Folder for the results.", default="FOLDER/tables")] = None,
) -> None:
    """Make a study's tables and figures: tables.html, tables.md, a .tex of each table, figures as PNG."""
    from roadproof.study.folder import read_table, read_transfers
    from roadproof.study.page import write_tables

    page = write_tables(read_table(folder), folder, out or folder / "tables", read_transfers(folder))
    say(f"The tables are {page}, as Markdown and LaTeX beside it; figures in {page.parent / 'figures'}")


study.command()(verb(run, estimates=True))
study.command()(verb(transfer))
study.command()(tables)
