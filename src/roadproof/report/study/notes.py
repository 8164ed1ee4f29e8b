"""What is said under a table: what its numbers are, over what they are means, and what is not in them."""

from __future__ import annotations

from collections.abc import Sequence

from roadproof.report.formatting import in_words
from roadproof.report.study.blocks import PENALTY, Block
from roadproof.report.study.results import Results

SHOWN_GAPS = 3
ENOUGH = 10
"""Scenarios; with fewer a percentile bootstrap covers clearly less than it claims."""


def note(results: Results, blocks: Sequence[Block], methods: Sequence[str], said: str) -> str:
    """The note of a table.

    Args:
        results: of the study.
        blocks: what the table shows.
        methods: names of those in it.
        said: what is particular to this table.
    """
    bare, missing = _bare_road(results, blocks, methods), _missing(results, blocks, methods)
    return " ".join([_measured(blocks), _averaged(results, blocks), said, *bare, *missing])


def _measured(blocks: Sequence[Block]) -> str:
    """What the numbers are and under which conditions they were driven."""
    found = dict.fromkeys((block.metric, block.traffic) for block in blocks)
    said = [
        f"{metric.title} in {metric.unit}, {'in traffic' if traffic else 'alone on the road'}"
        for metric, traffic in found
    ]
    return f"{'; '.join(said)}; all of it driven."


def _averaged(results: Results, blocks: Sequence[Block]) -> str:
    over = f"{_counted(len(results.kinds), 'scenario')} × {_counted(len(results.seeds), 'seed')}"
    if len(results.kinds) < 2:
        return f"Means over {over}; one scenario has no interval."
    fewest = min(sum(block.kind in (None, kind) for kind in results.kinds.values()) for block in blocks)
    narrow = f", which are too narrow for as few as {fewest}" if fewest < ENOUGH else ""
    return f"Means over {over} with 95 % bootstrap intervals over scenarios{narrow}."


def _bare_road(results: Results, blocks: Sequence[Block], methods: Sequence[str]) -> list[str]:
    """What the same drives cost without paint, where a penalty is shown over all scenarios."""
    said: list[str] = []
    for block in blocks:
        if block.metric == PENALTY and block.kind is None:
            clean = [
                each.clean_points
                for each in results.instances
                if each.job.method in methods and (each.weather, each.traffic) == (block.weather, block.traffic)
            ]
            said += [f"{sum(clean) / len(clean):.2f} at {in_words(block.weather)}"] if clean else []
    return [f"Penalty of the same drives on the bare road: {', '.join(said)}."] if said else []


def _missing(results: Results, blocks: Sequence[Block], methods: Sequence[str]) -> list[str]:
    gaps = results.gaps(methods, {(block.weather, block.traffic) for block in blocks})
    if not gaps:
        return []
    named = [f"{job} ({reason.rstrip('.')})" for job, reason in list(gaps.items())[:SHOWN_GAPS]]
    more = f"; and {len(gaps) - SHOWN_GAPS} more" if len(gaps) > SHOWN_GAPS else ""
    return [f"Missing or incomplete: {_counted(len(gaps), 'job')}: {'; '.join(named)}{more}."]


def _counted(count: int, what: str) -> str:
    return f"{count} {what}{'s' if count != 1 else ''}"
