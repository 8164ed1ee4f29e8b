"""The paper's tables, from one study: ablation, methods against each other overall, by scenario type and by weather.

Where the study has no traffic, penalties are those of drives alone. A table that would have nothing to compare is left
out. In every row that compares two methods both means are over the cases that both have.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from roadproof.report.formatting import MISSING, in_words
from roadproof.scenarios import KINDS
from roadproof.study.kept_jobs import StatedMethod
from roadproof.study.method_tables import methods_table, scenarios_table
from roadproof.study.results import DEVIATION, PENALTY, Block, Metric, Results
from roadproof.study.rows import JobId
from roadproof.study.statistics import mean_over_scenarios, paired, wilcoxon_p
from roadproof.study.table import Cell, Heading, Number, Table, headings, marked, share_of, slug
from roadproof.study.table_notes import table_note

SCHEMES = {"group": "Group", "group-all": "Group-All", "random": "Random"}
LONGEST_NAME = 60
"""Of a method in the name of a table's file, which must not be longer than file names may be."""
GAPS = "missing"
"""The table of what failed or is missing; there is none where nothing is."""


def paper_tables(results: Results) -> tuple[Table, ...]:
    """Every table that makes sense for a study, in the paper's order; what failed comes last."""
    tables = [methods_table(results), scenarios_table(results)]
    if variants := results.ablation:
        tables += [ablation_table(results, variants, metric) for metric in (DEVIATION, PENALTY)]
    taken: set[str] = set()
    for theirs in results.rivals:
        name = slug(theirs.name)[:LONGEST_NAME].strip("-")
        while name in taken:
            name += "-2"
        taken.add(name)
        tables += _against(results, results.reference.name, theirs.name, name)
    if gaps := results.gaps():
        tables.append(_gaps_table(results, gaps))
    return tuple(tables)


def _against(results: Results, ours: str, theirs: str, name: str) -> list[Table]:
    """The tables of two methods."""
    home, busy, alone = results.home, results.has(traffic=True), not results.has(traffic=False)

    def table(kind: str, title: str, blocks: Sequence[Block]) -> Table:
        return _compare_table(results, ours, theirs, blocks, f"{kind}-{name}", f"{ours} and {theirs}: {title}")

    differences = f"{ours} and {theirs}: differences pair by pair"
    tables = [
        table("overall", f"all scenarios, {in_words(home)}", results.overall),
        _paired_table(results, ours, theirs, results.overall, f"paired-{name}", differences),
    ]
    kinds = [kind for kind in KINDS if kind in results.kinds.values()]
    if len(kinds) > 1:

        def by_type(metric: Metric, traffic: bool) -> list[Block]:
            return [Block(kind.capitalize(), metric, home, traffic, kind) for kind in kinds]

        tables.append(table("type-penalty", "infraction penalty by scenario type", by_type(PENALTY, busy)))
        if busy and not alone:
            tables.append(table("type-static", "penalty by scenario type, static only", by_type(PENALTY, False)))
        tables.append(table("type-deviation", "deviation by scenario type", by_type(DEVIATION, alone)))
    others = results.weathers[1:]
    if others:
        blocks = [_penalty_at(results, weather, busy) for weather in others]
        tables.append(table("weathers", f"infraction penalty in other weathers than {in_words(home)}", blocks))
    for weather in others:
        blocks = [Block(each.title, each, weather, alone) for each in (DEVIATION, PENALTY)]
        where = "in traffic" if alone else "alone on the road"
        tables.append(table(f"{slug(weather)}-alone", f"all scenarios, {in_words(weather)}, {where}", blocks))
    return tables


def _penalty_at(results: Results, weather: str, busy: bool) -> Block:
    """The penalty in a weather; a study may have traffic in its first one alone, which is then said."""
    traffic = results.has(traffic=True, weather=weather)
    heading = in_words(weather).capitalize() + (" (alone)" if busy and not traffic else "")
    return Block(heading, PENALTY, weather, traffic)


def _compare_table(results: Results, ours: str, theirs: str, blocks: Sequence[Block], name: str, title: str) -> Table:
    """The paper's layout: for each K and block theirs, ours, and in how many cases ours is at least theirs."""
    rows: list[tuple[Cell, ...]] = []
    for figures in results.figures:
        cells: list[Cell] = [figures]
        for block in blocks:
            found = paired(results.values(block, ours, figures), results.values(block, theirs, figures))
            cells += [*marked([found.theirs, found.ours]), share_of(found.at_least)] if found else [MISSING] * 3
        rows.append(tuple(cells))
    said = f"% ≥: cases (scenario and seed) in which {ours} is at least {theirs}, of those that both have."
    return Table(
        name=name,
        title=title,
        note=table_note(results, blocks, (ours, theirs), said),
        header=(
            (Heading(""), *(Heading(block.heading, 3) for block in blocks)),
            headings("K", *(theirs, ours, "% ≥") * len(blocks)),
        ),
        rows=tuple(rows),
    )


def _paired_table(results: Results, ours: str, theirs: str, blocks: Sequence[Block], name: str, title: str) -> Table:
    """Mean differences with intervals, ties, and Wilcoxon's test, for each K and for all together."""
    rows: list[tuple[Cell, ...]] = []
    for block in blocks:
        wanted = [*results.figures, *([None] if len(results.figures) > 1 else [])]
        for number, figures in enumerate(wanted):
            found = paired(results.values(block, ours, figures), results.values(block, theirs, figures))
            where = (block.heading if number == 0 else "", figures or "all")
            if found is None:
                rows.append((*where, *[MISSING] * 6))
                continue
            p = wilcoxon_p(found.by_scenario)
            told = MISSING if p is None else "< 0.001" if p < 0.001 else f"{p:.3f}"
            share = Number(found.at_least, 0, unit="%")
            counts = (str(found.difference.count), str(len(found.by_scenario)))
            rows.append((*where, Number(found.difference), share, str(found.ties), told, *counts))
    said = (
        f"Difference: {ours} less {theirs}, above 0 where {ours} is stronger. p: two-sided Wilcoxon signed-rank "
        "test of the scenarios’ mean differences, not corrected for the number of rows. An interval without a width "
        "says that no scenario differed, not that none would."
    )
    return Table(
        name=name,
        title=title,
        note=table_note(results, blocks, (ours, theirs), said),
        header=(headings("", "K", "difference", "% ≥", "ties", "p", "pairs", "scenarios"),),
        rows=tuple(rows),
        left=2,
    )


def ablation_table(results: Results, variants: Sequence[StatedMethod], metric: Metric) -> Table:
    """The paper's ablation: one metric for each K and variant of GradOpt, over the cases that all variants have."""
    traffic = results.has(traffic=True) if metric is PENALTY else not results.has(traffic=False)
    ordered = sorted(variants, key=lambda method: (list(SCHEMES).index(method.scheme), method.trajectories))
    facts = [(method.scheme, method.trajectories) for method in ordered]
    labels = [
        f"T={method.trajectories}" if facts.count((method.scheme, method.trajectories)) == 1 else method.name
        for method in ordered
    ]
    names = [method.name for method in ordered]
    block = Block(metric.title, metric, results.home, traffic)
    rows: list[tuple[Cell, ...]] = []
    for figures in results.figures:
        values = [results.values(block, name, figures) for name in names]
        common = values[0].index
        for own in values[1:]:
            common = common.intersection(own.index, sort=False)
        rows.append((figures, *marked([mean_over_scenarios(own.loc[common]) for own in values])))
    spans = {scheme: sum(method.scheme == scheme for method in ordered) for scheme in SCHEMES}
    return Table(
        name=f"ablation-{slug(metric.title)}",
        title=f"Variants of GradOpt: {metric.title.lower()}, {in_words(results.home)}",
        note=table_note(results, [block], names, "Each row is over the cases that all variants have."),
        header=(
            (Heading(""), *(Heading(SCHEMES[scheme], span) for scheme, span in spans.items() if span)),
            headings("K", *labels),
        ),
        rows=tuple(rows),
    )


def _gaps_table(results: Results, gaps: Mapping[JobId, str]) -> Table:
    """Every job that failed or is not complete, and why."""
    again = " The same study run again tries those again that failed or are not done." if results.undone else ""
    return Table(
        name=GAPS,
        title="What failed or is missing",
        note=f"{len(gaps)} of {len(results.jobs)} jobs.{again}",
        header=(headings("scenario", "K", "method", "seed", "why"),),
        rows=tuple((*map(str, job), reason) for job, reason in gaps.items()),
        left=5,
    )
