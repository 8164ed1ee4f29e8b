"""The paper's tables, from one study: ablation, methods against each other overall, by scenario type and by weather.

Where the study has no traffic, penalties are those of drives alone. A table that would have nothing to compare is left
out. In every row that compares two methods both means are over the cases that both have.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from roadproof.driving.intervals import Mean
from roadproof.report.formatting import MISSING, in_words
from roadproof.report.study.blocks import DEVIATION, LEFT_LANE, PENALTY, Block, Metric, overall, reference, rivals
from roadproof.report.study.notes import note
from roadproof.report.study.results import Method, Results
from roadproof.report.study.statistics import Paired, mean_over_scenarios, paired
from roadproof.report.study.table import Cell, Estimate, Heading, Table, slug
from roadproof.scenarios import KINDS

SCHEMES = {"group": "Group", "group-all": "Group-All", "random": "Random"}
GAPS = "missing"
"""The table of what failed or is missing; there is none where nothing is."""


def paper_tables(results: Results) -> tuple[Table, ...]:
    """Every table that makes sense for a study, in the paper's order; what failed comes last."""
    ours = reference(results.methods)
    tables = [methods_table(results)]
    gradopt = [method for method in results.methods if method.search == "gradopt"]
    if len(gradopt) > 1:
        tables += [ablation_table(results, gradopt, metric) for metric in (DEVIATION, PENALTY)]
    taken: set[str] = set()
    for theirs in rivals(results.methods):
        name = slug(theirs.name)
        while name in taken:
            name += "-2"
        taken.add(name)
        tables += _against(results, ours.name, theirs.name, name)
    gaps = gaps_table(results)
    return tuple(tables) + (() if gaps is None else (gaps,))


def _against(results: Results, ours: str, theirs: str, name: str) -> list[Table]:
    """The tables of two methods."""
    home, busy, alone = results.home, results.has(traffic=True), not results.has(traffic=False)
    both = f"{ours} and {theirs}"

    def table(kind: str, title: str, blocks: Sequence[Block]) -> Table:
        return compare_table(results, ours, theirs, blocks, name=f"{kind}-{name}", title=f"{both}: {title}")

    tables = [
        table("overall", f"all scenarios, {in_words(home)}", overall(results)),
        paired_table(
            results, ours, theirs, overall(results), name=f"paired-{name}", title=f"{both}: differences pair by pair"
        ),
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
        tables += [
            table(
                f"{slug(weather)}-alone",
                f"all scenarios, {in_words(weather)}, {'in traffic' if alone else 'alone on the road'}",
                [Block(each.title, each, weather, alone) for each in (DEVIATION, PENALTY)],
            )
            for weather in others
        ]
    return tables


def compare_table(results: Results, ours: str, theirs: str, blocks: Sequence[Block], *, name: str, title: str) -> Table:
    """The paper's layout: for each K and block theirs, ours, and the share of cases in which ours is at least theirs.

    Args:
        results: of the study.
        ours: name of the method that is said to be better.
        theirs: name of the other.
        blocks: side by side.
        name: of the table.
        title: of the table.
    """
    rows: list[tuple[Cell, ...]] = []
    for figures in results.figures:
        cells: list[Cell] = [figures]
        for block in blocks:
            found = paired(block.values(results, ours, figures), block.values(results, theirs, figures))
            cells += _three(found)
        rows.append(tuple(cells))
    return Table(
        name=name,
        title=title,
        note=note(
            results,
            blocks,
            (ours, theirs),
            f"% ≥: cases (scenario and seed) in which {ours} is at least {theirs}, of those that both have.",
        ),
        header=(
            (Heading(""), *(Heading(block.heading, 3) for block in blocks)),
            (Heading("K"), *(Heading(text) for _ in blocks for text in (theirs, ours, "% ≥"))),
        ),
        rows=tuple(rows),
    )


def paired_table(results: Results, ours: str, theirs: str, blocks: Sequence[Block], *, name: str, title: str) -> Table:
    """Mean differences with intervals, ties, and Wilcoxon's test, for each K and for all together."""
    rows: list[tuple[Cell, ...]] = []
    for block in blocks:
        each = {
            figures: (block.values(results, ours, figures), block.values(results, theirs, figures))
            for figures in results.figures
        }
        pooled = tuple(
            {(*case, figures): value for figures, pair in each.items() for case, value in pair[side].items()}
            for side in (0, 1)
        )
        wanted = [*each.items(), *([("all", pooled)] if len(each) > 1 else [])]
        for number, (figures, (first, second)) in enumerate(wanted):
            found = paired(first, second)
            where = block.heading if number == 0 else ""
            if found is None:
                rows.append((where, figures, *[MISSING] * 6))
                continue
            rows.append((
                where,
                figures,
                Estimate(found.difference),
                Estimate(found.at_least, 0, unit="%"),
                str(found.ties),
                _p(found.p),
                str(found.difference.count),
                str(len(found.by_scenario)),
            ))  # fmt: skip
    return Table(
        name=name,
        title=title,
        note=note(
            results,
            blocks,
            (ours, theirs),
            f"Difference: {ours} less {theirs}, above 0 where {ours} is stronger. p: two-sided Wilcoxon signed-rank "
            "test of the scenarios’ mean differences, not corrected for the number of rows.",
        ),
        header=(tuple(map(Heading, ("", "K", "difference", "% ≥", "ties", "p", "pairs", "scenarios"))),),
        rows=tuple(rows),
        left=2,
    )


def ablation_table(results: Results, variants: Sequence[Method], metric: Metric) -> Table:
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
        values = [block.values(results, name, figures) for name in names]
        common = set(values[0]).intersection(*values[1:])
        means = [mean_over_scenarios({case: own[case] for case in own if case in common}) for own in values]
        rows.append((figures, *_row_of(means)))
    spans = {scheme: sum(method.scheme == scheme for method in ordered) for scheme in SCHEMES}
    return Table(
        name=f"ablation-{slug(metric.title)}",
        title=f"Variants of GradOpt: {metric.title.lower()}, {in_words(results.home)}",
        note=note(results, [block], names, "Each row is over the cases that all variants have."),
        header=(
            (Heading(""), *(Heading(SCHEMES[scheme], span) for scheme, span in spans.items() if span)),
            (Heading("K"), *map(Heading, labels)),
        ),
        rows=tuple(rows),
    )


def methods_table(results: Results) -> Table:
    """What every method found, and what finding it took: simulator calls and seconds of the search."""
    blocks = overall(results)
    lane = replace(blocks[0], metric=LEFT_LANE)
    rows: list[tuple[Cell, ...]] = []
    for figures in results.figures:
        found = {
            method.name: [mean_over_scenarios(block.values(results, method.name, figures)) for block in blocks]
            for method in results.methods
        }
        shown = [_row_of([means[k] for means in found.values()]) for k in range(len(blocks))]
        for number, name in enumerate(found):
            costs = [cost for job, cost in results.costs.items() if (job.method, job.figures) == (name, figures)]
            patterns = len(costs)
            rows.append((
                figures if number == 0 else "",
                name,
                str(patterns),
                _plain([cost.calls for cost in costs]),
                _plain([cost.seconds for cost in costs]),
                *(column[number] for column in shown),
                _spread(results.deviations(name, figures, blocks[0].weather, traffic=blocks[0].traffic)),
                _share(mean_over_scenarios(lane.values(results, name, figures))),
            ))  # fmt: skip
    return Table(
        name="methods",
        title=f"What each method found and what it cost, {in_words(results.home)}",
        note=note(
            results,
            blocks,
            [method.name for method in results.methods],
            "Simulator calls and seconds: mean of one search, without judging its pattern. Median "
            "and quartiles: over all drives, each from a start of its own. Leave the lane: share of those drives.",
        ),
        header=(
            (Heading(""), Heading(""), Heading(""), Heading("Search", 2), Heading("Found", 4)),
            tuple(
                map(
                    Heading,
                    (
                        "K",
                        "method",
                        "patterns",
                        "simulator calls",
                        "seconds",
                        "deviation",
                        "penalty",
                        "median",
                        "leave the lane",
                    ),
                )
            ),
        ),
        rows=tuple(rows),
        left=2,
    )


def gaps_table(results: Results) -> Table | None:
    """Every job that failed or is not complete, and why; None where all are done."""
    gaps = results.gaps()
    if not gaps:
        return None
    return Table(
        name=GAPS,
        title="What failed or is missing",
        note=f"{len(gaps)} of {len(results.jobs)} jobs. The same study run again tries them again.",
        header=(tuple(map(Heading, ("scenario", "K", "method", "seed", "why"))),),
        rows=tuple((job.scenario, job.figures, job.method, str(job.seed), reason) for job, reason in gaps.items()),
        left=5,
    )


def _penalty_at(results: Results, weather: str, busy: bool) -> Block:
    """The penalty in a weather; a study may have traffic in its first one alone, which is then said."""
    traffic = results.has(traffic=True, weather=weather)
    heading = in_words(weather).capitalize() + (" (alone)" if busy and not traffic else "")
    return Block(heading, PENALTY, weather, traffic)


def _three(found: Paired | None) -> list[Cell]:
    if found is None:
        return [MISSING] * 3
    return [*_row_of([found.theirs, found.ours]), f"{found.at_least.value:.0%}"]


def _row_of(means: Sequence[Mean | None]) -> list[Cell]:
    """Means side by side, the highest marked; equal ones all, unless all are equal."""
    values = [mean.value for mean in means if mean is not None]
    top = max(values, default=0.0)
    one = min(values, default=0.0) < top

    def cell(mean: Mean | None) -> Cell:
        return MISSING if mean is None else Estimate(mean, best=one and mean.value == top)

    return list(map(cell, means))


def _spread(values: Sequence[float]) -> str:
    """Median and quartiles."""
    if not values:
        return MISSING
    low, middle, high = np.quantile(values, (0.25, 0.5, 0.75)).tolist()
    return f"{middle:.2f} ({low:.2f} to {high:.2f})"


def _share(mean: Mean | None) -> str:
    return MISSING if mean is None else f"{mean.value:.0%}"


def _plain(values: Sequence[float]) -> str:
    mean = sum(values) / len(values) if values else 0.0
    return MISSING if not values else f"{mean:.0f}" if mean >= 10 or mean == int(mean) else f"{mean:.1f}"


def _p(p: float | None) -> str:
    return MISSING if p is None else "< 0.001" if p < 0.001 else f"{p:.3f}"
