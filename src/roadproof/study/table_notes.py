"""What is said under a table: what its numbers are, over what they are means, and what is not in them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from roadproof.io.text import count_of
from roadproof.report.formatting import in_words
from roadproof.study.results import PENALTY, Block, Results
from roadproof.study.rows import Frame

SHOWN_GAPS = 3
ENOUGH = 10
"""The least scenarios; with fewer a percentile bootstrap covers clearly less than it claims."""


def table_note(
    results: Results, blocks: Sequence[Block], methods: Sequence[str], said: str, *, compared: bool = True
) -> str:
    """The note of a table.

    Args:
        results: the numbers of the study.
        blocks: the blocks of columns that the table shows.
        methods: names of the methods in the table.
        said: what is particular to this table, in sentences.
        compared: whether its means are over the cases that all of the methods have, or each over those of its own.
    """
    measured = dict.fromkeys(
        f"{block.metric.title} in {block.metric.unit}, {'in traffic' if block.traffic else 'alone on the road'}"
        for block in blocks
    )
    cases = [cases_of(results, block, methods, compared=compared) for block in blocks]
    told = [averaged(cases, compared=compared), said, *_bare_road(blocks, cases), *missing(results, blocks, methods)]
    return " ".join([f"{'; '.join(measured)}; all of it driven.", *told])


def cases_of(results: Results, block: Block, methods: Sequence[str], *, compared: bool) -> Frame:
    """The cases that a block's means are over: the penalty of each on the bare road, a column a method.

    Where the methods are compared only the cases that all of them have.
    """
    drives = results.drives_of(block, methods)
    cases = drives.pivot_table("clean_points", ["scenario", "seed", "figures"], "method").reindex(columns=list(methods))
    return cases.dropna() if compared else cases


def averaged(cases: Sequence[Frame], *, compared: bool) -> str:
    """What the means of blocks are over, by the cases of each (`cases_of`), in a sentence."""
    # A number is of one K, and where methods are not compared of one method.
    columns = [[each] if compared else [each[method].dropna() for method in each] for each in cases]
    held = [one.reset_index() for each in columns for one in each if len(one)]
    if not held:
        return "There is no case that all of them have."
    counts: set[int] = {count for each in held for count in each.groupby("figures")["scenario"].nunique()}
    seeds: set[int] = {seed for each in held for seed in each["seed"]}
    fewest, most = min(counts), max(counts)
    scenarios = count_of(most, "scenario") if fewest == most else f"{fewest} to {most} scenarios"
    over = f"{scenarios} × {count_of(len(seeds), 'seed')}"
    if most < 2:
        return f"Means over {over}; one scenario has no interval."
    return f"Means over {over}{intervals_over(fewest)}."


def intervals_over(scenarios: int) -> str:
    """How means have their intervals, and that these are too narrow where the means are over so few scenarios."""
    narrow = f", which are too narrow for as few as {scenarios}" if scenarios < ENOUGH else ""
    return f" with 95 % bootstrap intervals over scenarios{narrow}"


def _bare_road(blocks: Sequence[Block], cases: Sequence[Frame]) -> list[str]:
    """What the same drives cost without paint, where a penalty is shown over all scenarios."""
    said = [
        f"{np.nanmean(each.to_numpy()):.2f} at {in_words(block.weather)}"
        for block, each in zip(blocks, cases, strict=True)
        if block.metric == PENALTY and block.kind is None and len(each)
    ]
    return [f"Penalty of the same drives on the bare road: {', '.join(said)}."] if said else []


def missing(results: Results, blocks: Sequence[Block], methods: Sequence[str]) -> list[str]:
    """Which drives of some blocks and methods are not there, in a sentence; none where all are."""
    gaps = results.gaps(methods, {(block.weather, block.traffic) for block in blocks})
    if not gaps:
        return []
    named = [f"{job} ({reason.rstrip('.')})" for job, reason in list(gaps.items())[:SHOWN_GAPS]]
    more = f"; and {len(gaps) - SHOWN_GAPS} more" if len(gaps) > SHOWN_GAPS else ""
    return [f"Missing or incomplete: {count_of(len(gaps), 'job')}: {'; '.join(named)}{more}."]
