"""Means with bootstrap intervals over scenarios, and two methods compared pair by pair.

Trials in one scenario share its road and are not independent, so scenarios are what is drawn anew, and what is tested.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from scipy import stats as _stats

from roadproof.driving.intervals import Estimate

stats: Any = _stats  # which types its own results as anything
Values: TypeAlias = Any
"""A pandas Series of one number a case, indexed by the scenario first."""

DRAWS = 10_000
SEED = 0
EQUAL = 1e-9
"""Means of equal drives may differ by their rounding; such a pair is a tie."""


def mean_over_scenarios(values: Values) -> Estimate | None:
    """The mean of all cases with its 95 % percentile bootstrap interval over scenarios.

    Whole scenarios are drawn with replacement, with all their cases; the draws are the same in every call. With
    fewer than ten scenarios such an interval is too narrow; with one there is none.

    Returns:
        The mean, where `count` is the number of cases; None where there is no case.
    """
    if values.empty:
        return None
    scenarios = values.groupby(level=0, sort=False)
    mean, sums, counts = float(values.mean()), scenarios.sum().to_numpy(), scenarios.size().to_numpy()
    if len(sums) < 2:
        return Estimate(mean, None, None, len(values))
    interval = stats.bootstrap(
        (sums, counts),
        _ratio,
        paired=True,
        vectorized=True,
        n_resamples=DRAWS,
        method="percentile",
        random_state=np.random.default_rng(SEED),
    ).confidence_interval
    # Where all draws are equal, their rounding may put the mean outside.
    return Estimate(mean, min(float(interval.low), mean), max(float(interval.high), mean), len(values))


def _ratio(sums: np.ndarray, counts: np.ndarray, axis: int) -> np.ndarray:
    return sums.sum(axis) / counts.sum(axis)


@dataclass(frozen=True, kw_only=True, slots=True)
class Paired:
    """One method against another, over the cases that both have.

    Args:
        ours: mean of the first method, over the cases that both have.
        theirs: mean of the second method, over the cases that both have.
        difference: mean of the first less the second method, with its interval.
        at_least: share of cases in which the first method is at least the second, in [0, 1], with its interval.
        ties: how many cases are equal for both methods.
        by_scenario: mean difference of each scenario.
    """

    ours: Estimate
    theirs: Estimate
    difference: Estimate
    at_least: Estimate
    ties: int
    by_scenario: tuple[float, ...]


def paired(ours: Values, theirs: Values) -> Paired | None:
    """Compare two methods case by case; None where they have no case in common."""
    common = ours.index.intersection(theirs.index, sort=False)
    first, second = ours.loc[common], theirs.loc[common]
    gap = first - second
    means = [mean_over_scenarios(each) for each in (first, second, gap, (gap >= -EQUAL).astype(float))]
    a, b, difference, at_least = means
    if a is None or b is None or difference is None or at_least is None:
        return None
    return Paired(
        ours=a,
        theirs=b,
        difference=difference,
        at_least=at_least,
        ties=int((gap.abs() <= EQUAL).sum()),
        by_scenario=tuple(gap.groupby(level=0, sort=False).mean()),
    )


def wilcoxon_p(differences: Sequence[float]) -> float | None:
    """Two-sided p of the Wilcoxon signed-rank test that differences lie around 0, zeros left out as Wilcoxon did.

    None where all are zero, or there are fewer than two.
    """
    apart = [gap for gap in differences if abs(gap) > EQUAL]
    return float(stats.wilcoxon(apart).pvalue) if apart and len(differences) > 1 else None
