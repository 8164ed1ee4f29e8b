"""The tables and figures of a study as files: one self-contained page, Markdown, LaTeX, PNG.

OUT/tables.html     everything, pictures included
OUT/tables.md       the same for a repository; its pictures lie in figures/
OUT/NAME.tex        each table, with booktabs
OUT/figures/*.png
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

from roadproof.io.files import write_text
from roadproof.io.html import data_url
from roadproof.io.text import count_of
from roadproof.report.formatting import in_words, markdown_text
from roadproof.report.html import rendered
from roadproof.report.plots import save
from roadproof.study.charts import Picture, by_figures, progress
from roadproof.study.folder import planned_in
from roadproof.study.kept_jobs import KeptJob, StatedMethod, read_jobs
from roadproof.study.paper_tables import GAPS, paper_tables
from roadproof.study.pictures import gallery, passages, trajectories
from roadproof.study.plan import BLACK
from roadproof.study.results import DEVIATION, PENALTY, Results, check_jobs, check_kind, results_of
from roadproof.study.rows import Frame
from roadproof.study.table import Table, in_latex, in_markdown
from roadproof.study.transfer_matrix import shared_drives, transfer_map, transfer_table


def write_tables(rows: Frame, folder: Path, out: Path, transfer: Frame | None = None) -> Path:
    """Make every table and figure of a study.

    Args:
        rows: the rows of the study (`folder.read_table`).
        folder: the folder of the study, for what its jobs left there.
        out: the folder for the files; older ones of the same names are replaced.
        transfer: rows of the same patterns driven by other controllers, those of other patterns are left out; None
            where nobody drove them.

    Returns:
        The path of the page, tables.html.

    Raises:
        StudyError: there is nothing to show, or a file of a job is damaged.
        OutputError: a file cannot be written.
    """
    check_jobs(rows)
    jobs = read_jobs(folder, rows)
    any_job = next(iter(jobs.values()), None)  # all have the plan's conditions
    weathers, planned = ((), None) if any_job is None else (any_job.weathers, any_job.planned)
    plan = planned_in(folder)
    methods = [job.method for job in jobs.values()]
    results = results_of(rows, methods, plan.reference, weathers, planned, plan.jobs)
    kept, again = (None, "") if transfer is None else _of_these_jobs(transfer, results)
    unshared = kept is not None and not kept.empty and shared_drives(kept).empty
    driven = [] if kept is None or kept.empty or unshared else [(kept, metric) for metric in (DEVIATION, PENALTY)]
    drawn = (by_figures(results), progress(results, tuple(jobs.values())), trajectories(results, jobs))
    shown = (*drawn, gallery(results, jobs), *passages(results, jobs), *(transfer_map(*each) for each in driven))
    pictures = [picture for picture in shown if picture is not None]
    for picture in pictures:
        save(picture.figure, out / "figures" / f"{picture.name}.png")
    matrices = [transfer_table(*each) for each in driven]
    tables = [*paper_tables(results), *(replace(each, note=each.note + again) for each in matrices)]
    # A list of what was missing does not outlive the gaps.
    (out / f"{GAPS}.tex").unlink(missing_ok=True)
    for table in tables:
        write_text(out / f"{table.name}.tex", in_latex(table))
    name, sentence = folder.resolve().name, _sentence(results, jobs.values())
    if unshared:
        sentence += " The transfer is left out: none of its patterns was driven over by every controller."
    write_text(out / "tables.md", _markdown(name, sentence, results, tables, pictures))
    write_text(out / "tables.html", _page(name, sentence, results, tables, pictures, out))
    return out / "tables.html"


def _of_these_jobs(transfer: Frame, results: Results) -> tuple[Frame, str]:
    """The rows of a transfer that are of a study's patterns, and what a note says where these are not all of both."""
    if "job" not in transfer or "job" not in results.drives:
        return transfer, ""
    check_kind(transfer, "job", str, "text")
    known, driven = transfer["job"].isin(results.drives["job"]), results.drives["job"].isin(transfer["job"])
    lacking = results.drives.loc[~driven, "job"].nunique()
    note = "" if known.all() else " Patterns that the study no longer has are left out; run the transfer again."
    if lacking:
        note += f" {lacking} of the study's patterns are not in it: found since, or none could drive over them."
    return transfer[known], note


def _page(
    name: str, sentence: str, results: Results, tables: Sequence[Table], pictures: Sequence[Picture], out: Path
) -> str:
    jobs, undone = len(results.jobs), len(results.undone)
    lacking = len(results.gaps()) - undone
    told = [f"{undone} failed or missing"] * (undone > 0) + [f"{lacking} without some drives"] * (lacking > 0)
    black = "1-b is one black figure" if BLACK in results.figures else "figures a pattern"
    kinds = list(results.kinds.values())
    facts = [
        (len(kinds), "scenarios", ", ".join(f"{kinds.count(kind)} {kind}" for kind in dict.fromkeys(kinds))),
        (", ".join(results.figures), "K", black),
        (len(results.methods), "methods", ", ".join(map(described, results.methods))),
        (f"{jobs - undone} of {jobs}", "jobs done", f"{', '.join(told)}, listed below" if told else ""),
    ]
    return rendered(
        "study.html.jinja",
        name=name,
        sentence=sentence,
        facts=[{"value": value, "label": label, "note": note} for value, label, note in facts],
        tables=tables,
        pictures=[
            {
                "name": picture.name,
                "caption": picture.caption,
                "source": data_url((out / "figures" / f"{picture.name}.png").read_bytes(), "image/png"),
            }
            for picture in pictures
        ],
    )


def _markdown(name: str, sentence: str, results: Results, tables: Sequence[Table], pictures: Sequence[Picture]) -> str:
    shown = [
        f"![{markdown_text(picture.caption)}](figures/{picture.name}.png)\n\n{markdown_text(picture.caption)}\n"
        for picture in pictures
    ]
    methods = [f"- {markdown_text(described(method))}" for method in results.methods]
    return "\n".join(
        [f"# {markdown_text(name)}\n\n{markdown_text(sentence)}\n", *methods, "", *map(in_markdown, tables), *shown]
    )


def described(method: StatedMethod) -> str:
    """A method and what is known of it, as "GradOpt (group, T=3)"."""
    if method.search == "gradopt":
        weathers: list[str] = method.settings.get("attack_weathers", [])
        searched = "".join(f", {in_words(each)}" for each in weathers)
        return f"{method.name} ({method.scheme}, T={method.trajectories}{searched})"
    return f"{method.name} ({method.search})" if method.search not in ("", method.name) else method.name


def _sentence(results: Results, jobs: Iterable[KeptJob]) -> str:
    """What the study was, in a sentence."""
    jobs = tuple(jobs)
    controllers = dict.fromkeys(job.controller for job in jobs)
    home, *others = map(in_words, results.weathers)
    # A method that searches in weathers of its own says which.
    where = "judged first at" if any(job.method.settings.get("attack_weathers") for job in jobs) else "found at"
    against = f" against {', '.join(controllers)}" if controllers else ""
    seeds = f"seed{'s' if len(results.seeds) > 1 else ''} {', '.join(map(str, results.seeds))}"
    also = f", judged also at {', '.join(others)}" if others else ""
    traffic = " alone and in traffic" if results.has(traffic=True) and results.has(traffic=False) else ""
    scenarios = count_of(len(results.kinds), "scenario")
    return f"Patterns{against} on {scenarios}, {seeds}, {where} {home}{also}, driven{traffic}."
