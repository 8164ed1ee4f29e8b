"""Means with bootstrap intervals over scenarios, and two methods compared pair by pair.

Trials in one scenario share its road and are not independent, so scenarios are what is drawn anew, and what is tested.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, TypeAlias

import numpy as np
from jaxtyping import Float, Int

from roadproof.driving.intervals import Mean
from roadproof.errors import StudyError

Case: TypeAlias = tuple[str, ...]
"""What a value belongs to: the scenario first, then what else tells it apart, the seed for instance."""

DRAWS = 10_000
SEED = 0
EQUAL = 1e-9
"""Means of equal drives may differ by their rounding; such a pair is a tie."""


def mean_over_scenarios(values: Mapping[Case, float]) -> Mean | None:
    """The mean of all cases with its 95 % percentile bootstrap interval over scenarios.

    Whole scenarios are drawn with replacement, with all their cases; the draws are the same in every call. With
    fewer than ten scenarios such an interval is too narrow; with one there is none.

    Args:
        values: one finite number a case.

    Returns:
        The mean, where `count` is the number of cases; None where there is no case.
    """
    if not values:
        return None
    by_scenario = _by_scenario(values)
    sums = np.array([sum(own) for own in by_scenario.values()])
    counts = np.array([len(own) for own in by_scenario.values()])
    mean = float(sums.sum() / counts.sum())
    if len(sums) < 2:
        return Mean(mean, None, None, len(values))
    drawn = _draws(len(sums))
    means: Float[np.ndarray, " d"] = sums[drawn].sum(1) / counts[drawn].sum(1)
    low, high = np.quantile(means, (0.025, 0.975)).tolist()
    return Mean(mean, low, high, len(values))


@dataclass(frozen=True, kw_only=True, slots=True)
class Paired:
    """One method against another, over the cases that both have.

    Args:
        ours: mean of the first, over these cases.
        theirs: mean of the second.
        difference: first less second, with its interval.
        at_least: share of cases in which the first is at least the second, in [0, 1], with its interval.
        ties: how many cases are equal.
        by_scenario: mean difference of every scenario.
    """

    ours: Mean
    theirs: Mean
    difference: Mean
    at_least: Mean
    ties: int
    by_scenario: tuple[float, ...]

    @property
    def p(self) -> float | None:
        """Two-sided Wilcoxon signed-rank test of the scenarios' mean differences.

        None where all are zero, or there are fewer than two scenarios.

        Raises:
            StudyError: scipy is not installed.
        """
        return wilcoxon_p(self.by_scenario)


def paired(ours: Mapping[Case, float], theirs: Mapping[Case, float]) -> Paired | None:
    """Compare two methods case by case; None where they have no case in common."""
    common = [case for case in ours if case in theirs]
    first, second = ({case: each[case] for case in common} for each in (ours, theirs))
    differences = {case: ours[case] - theirs[case] for case in common}
    means = [mean_over_scenarios(each) for each in (first, second, differences)]
    at_least = mean_over_scenarios({case: float(gap >= -EQUAL) for case, gap in differences.items()})
    a, b, difference = means
    if a is None or b is None or difference is None or at_least is None:
        return None
    return Paired(
        ours=a,
        theirs=b,
        difference=difference,
        at_least=at_least,
        ties=sum(abs(gap) <= EQUAL for gap in differences.values()),
        by_scenario=tuple(float(np.mean(own)) for own in _by_scenario(differences).values()),
    )


def wilcoxon_p(differences: Sequence[float]) -> float | None:
    """Two-sided p of the Wilcoxon signed-rank test that differences lie around 0, zeros left out as Wilcoxon did.

    Raises:
        StudyError: scipy is not installed.
    """
    if len(differences) < 2 or all(abs(gap) <= EQUAL for gap in differences):
        return None
    try:
        from scipy import stats as imported
    except ImportError as error:
        raise StudyError(f"tables of studies need {error.name}; install roadproof[study]") from None
    stats: Any = imported
    rounded = np.where(np.abs(differences) <= EQUAL, 0.0, differences)
    return float(stats.wilcoxon(rounded[rounded != 0]).pvalue)


def _by_scenario(values: Mapping[Case, float]) -> dict[str, list[float]]:
    found: dict[str, list[float]] = {}
    for case, value in values.items():
        found.setdefault(case[0], []).append(value)
    return found


@lru_cache
def _draws(scenarios: int) -> Int[np.ndarray, "d s"]:
    return np.random.default_rng(SEED).integers(scenarios, size=(DRAWS, scenarios))
