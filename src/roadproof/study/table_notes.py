"""What is said under a table: what its numbers are, over what they are means, and what is not in them."""

from __future__ import annotations

from collections.abc import Sequence

from roadproof.report.formatting import in_words
from roadproof.study.results import JOB, PENALTY, Block, Results

SHOWN_GAPS = 3
ENOUGH = 10
"""The least scenarios; with fewer a percentile bootstrap covers clearly less than it claims."""


def table_note(results: Results, blocks: Sequence[Block], methods: Sequence[str], said: str) -> str:
    """The note of a table.

    Args:
        results: the numbers of the study.
        blocks: the blocks of columns that the table shows.
        methods: names of the methods in the table.
        said: what is particular to this table, in sentences.
    """
    measured = dict.fromkeys(
        f"{block.metric.title} in {block.metric.unit}, {'in traffic' if block.traffic else 'alone on the road'}"
        for block in blocks
    )
    bare, missing = _bare_road(results, blocks, methods), _missing(results, blocks, methods)
    return " ".join([f"{'; '.join(measured)}; all of it driven.", _averaged(results, blocks), said, *bare, *missing])


def counted(count: int, what: str) -> str:
    """A number of things, as "1 job" or "2 jobs"."""
    return f"{count} {what}{'s' if count != 1 else ''}"


def _averaged(results: Results, blocks: Sequence[Block]) -> str:
    over = f"{counted(len(results.kinds), 'scenario')} × {counted(len(results.seeds), 'seed')}"
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
            clean = results.drives_of(block, methods).groupby(JOB)["clean_points"].mean()
            said += [f"{clean.mean():.2f} at {in_words(block.weather)}"] if len(clean) else []
    return [f"Penalty of the same drives on the bare road: {', '.join(said)}."] if said else []


def _missing(results: Results, blocks: Sequence[Block], methods: Sequence[str]) -> list[str]:
    gaps = results.gaps(methods, {(block.weather, block.traffic) for block in blocks})
    if not gaps:
        return []
    named = [f"{job} ({reason.rstrip('.')})" for job, reason in list(gaps.items())[:SHOWN_GAPS]]
    more = f"; and {len(gaps) - SHOWN_GAPS} more" if len(gaps) > SHOWN_GAPS else ""
    return [f"Missing or incomplete: {counted(len(gaps), 'job')}: {'; '.join(named)}{more}."]
