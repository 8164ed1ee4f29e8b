"""Figures of independent runs with their intervals, and the mean."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import special

from roadproof.errors import EpisodeError


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
    half = float(special.stdtrit(numbers.size - 1, 0.975)) * float(numbers.std(ddof=1)) / math.sqrt(numbers.size)
    return Estimate(mean, mean - half, mean + half, numbers.size)
