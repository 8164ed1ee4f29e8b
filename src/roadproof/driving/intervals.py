"""Means, medians and shares of independent runs, each with its interval."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import special, stats

from roadproof.errors import EpisodeError

CONFIDENCE = 0.95


@dataclass(frozen=True, slots=True)
class Estimate:
    """A mean, a median or a share of drives with its 95 % interval.

    Args:
        value: the mean or median in the values' unit, or the share, 0 to 1.
        low: lower end of the interval; None where there are too few values for one.
        high: upper end of the interval; None where there are too few values for one.
        count: number of values.
    """

    value: float
    low: float | None
    high: float | None
    count: int


def mean_95(values: Sequence[float]) -> Estimate:
    """The mean of independent runs with its 95 % interval by Student's t.

    Student's t rather than a bootstrap: with the usual ten runs a percentile bootstrap covers less than it claims, and
    this one needs no random numbers. A single run has no interval; ten equal ones have a width of 0, which says that
    they did not differ, not that nothing else can happen.

    Raises:
        EpisodeError: there is no value, or one is not finite.
    """
    numbers = np.asarray(values, np.float64)
    if not numbers.size or not np.isfinite(numbers).all():
        raise EpisodeError(f"the mean of {list(values)} cannot be taken, expected at least one finite number")
    mean = float(numbers.mean())
    if numbers.size == 1:
        return Estimate(mean, None, None, 1)
    half = float(special.stdtrit(numbers.size - 1, 0.5 + CONFIDENCE / 2)) * float(numbers.std(ddof=1))
    half /= math.sqrt(numbers.size)
    return Estimate(mean, mean - half, mean + half, numbers.size)


def median_95(values: Sequence[float]) -> Estimate:
    """The median with the exact interval that its order statistics give; it needs six values.

    Nothing is assumed of how deviations are distributed: they lie near 0 and near a lane's width, and seldom between.

    Raises:
        ValueError: there is no value.
    """
    found: Any = stats.quantile_test(list(values), p=0.5).confidence_interval(CONFIDENCE)
    low, high = float(found.low), float(found.high)
    ends = None if math.isnan(low) else low, None if math.isnan(high) else high
    return Estimate(float(np.median(values)), *ends, len(values))


def share_95(yes: int, count: int) -> Estimate:
    """A share of drives with its exact (Clopper–Pearson) interval.

    Raises:
        ValueError: there is no drive, or there are fewer than say yes.
    """
    found: Any = stats.binomtest(yes, count).proportion_ci(CONFIDENCE)
    return Estimate(yes / count, float(found.low), float(found.high), count)
