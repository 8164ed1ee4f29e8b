"""The candidates that were driven, and which of them was chosen."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from roadproof.pipeline.selection import Selection
from roadproof.report.words import MISSING, in_words


def driven_candidates(selections: Sequence[Selection]) -> dict[str, Any] | None:
    """Rows for every candidate of the search and of each round; None where none was driven.

    Args:
        selections: of the search, then of each round.
    """
    if not selections:
        return None
    best = max(selections, key=lambda each: each.deviation_m)
    return {
        "weather": in_words(selections[0].driven[0].trial.weather),
        "rounds": len(selections) > 1,
        "predicted": best.predicted,
        "rows": [
            {
                "found_by": f"round {number}" if number else "the search",
                "group": one.group,
                "rank": one.rank,
                "deviation": f"{one.trial.deviation_m:.2f}",
                "lateral": f"{abs(one.trial.lateral_m):.2f}",
                "points": MISSING if one.trial.points is None else f"{one.trial.points:.0f}",
                "chosen": selection is best and index == selection.chosen,
            }
            for number, selection in enumerate(selections)
            for index, one in enumerate(selection.driven)
        ],
    }
