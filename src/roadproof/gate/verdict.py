"""When a case passes: its measures with their intervals against limits, and against what they were before."""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from itertools import pairwise
from typing import Any, TypeAlias

import numpy as np
from scipy import stats

from roadproof.driving.intervals import Estimate

CONFIDENCE = 0.95
EQUAL = 1e-9
"""Two numbers no further apart are equal: 4/10 is 0.1 above 3/10, though rounding makes it more."""


class Kind(StrEnum):
    """What is painted in a case."""

    BARE = "bare"
    """Nothing: whoever does not drive well there deviates from nothing."""

    STORED = "stored"
    """One pattern of the plan's folder."""

    RANDOM = "random"
    """Patterns drawn at random, all together."""

    FRESH = "fresh"
    """What a fresh attack on this controller finds."""


class Status(StrEnum):
    """What is said of a case, and of a whole check."""

    PASSED = "passed"
    FAILED = "failed"
    TOO_FEW = "too few drives"


Measures: TypeAlias = Mapping[str, Estimate]
"""`failed` on the bare road; `deviation_m` and `left_lane` over paint."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Change:
    """How much worse than the reference a measure may be: it fails where both are exceeded.

    Args:
        absolute: the largest increase that passes, in the measure's own unit.
        relative: the largest increase that passes, as a share of the reference's value.
    """

    absolute: float
    relative: float

    def is_exceeded(self, before: float, now: float) -> bool:
        """Whether a measure is worse by more than both; beside a reference of 0 every relative change is."""
        worse = now - before
        return is_above(worse, self.absolute) and is_above(worse, self.relative * before)


def is_above(value: float, limit: float) -> bool:
    """Whether a value is above a limit, however both were rounded."""
    return value > limit + EQUAL


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


def least_drives(measure: str, limit: float) -> int:
    """How many drives a case needs so that its interval can lie under a limit at all.

    A share of 0 is met by the drives that are made: none of them may. No number of drives shows that none ever would.
    """
    tail = (1 - CONFIDENCE) / 2
    if measure == "deviation_m":
        return math.ceil(math.log(tail) / math.log(0.5))
    # No case has more drives than the largest number here.
    return 1 if limit in (0.0, 1.0) else math.ceil(min(math.log(tail) / math.log1p(-limit), sys.maxsize))


def judge(
    measures: Measures,
    limits: Mapping[str, float],
    changes: Mapping[str, Change],
    before: Measures | None,
    left_out: int = 0,
    *,
    is_new: bool = False,
    unjudged: str = "",
) -> tuple[Status, tuple[str, ...]]:
    """Whether a case passes, and why not.

    Args:
        measures: the measures of the case; none at all where no drive could be judged.
        limits: the greatest values that pass, by measure.
        changes: how much worse than the reference each measure may be, by measure.
        before: the reference's measures; None where nothing is compared.
        left_out: how many drives over paint were not made, since the same drive on the bare road did not go well.
        is_new: whether there is a reference, and it lacks the case; without a limit nothing would judge it then.
        unjudged: why no drive could be judged, where it is not that none on the bare road went well.
    """
    if not measures:
        why = unjudged or "on the bare road none went well, so there is none to compare with"
        return Status.TOO_FEW, (f"too few drives: {why}",)
    failed: list[str] = []
    undecided = [f"too few drives: {left_out} had no good drive on the bare road to compare with"] if left_out else []
    if is_new and not limits:
        failed.append(
            "nothing judges it: it has no limit, and the reference lacks it; give it one, or make the reference again "
            "with --accept"
        )
    for name, limit in limits.items():
        found = measures[name]
        if is_above(found.value, limit):
            digits = digits_apart(name, found.value, limit)
            failed.append(f"{_estimate(name, found, digits)} is above the limit of {_one(name, limit, digits)}")
        elif limit and (found.high is None or is_above(found.high, limit)):
            digits = digits_apart(name, found.value, limit, *([] if found.high is None else [found.high]))
            undecided.append(
                f"too few drives: {_estimate(name, found, digits)} does not exceed the limit of "
                f"{_one(name, limit, digits)}, but its interval does; drive more starts or seeds"
            )
    for name, change in changes.items():
        if before is None or name not in measures:
            continue
        found, then = measures[name], before[name].value
        digits = digits_apart(name, found.value, then, then + change.absolute)
        if found.high is None:
            undecided.append(f"too few drives: {_estimate(name, found, digits)} has no interval; drive more")
        if change.is_exceeded(then, found.value):
            failed.append(
                f"{_estimate(name, found, digits)} was {_one(name, then, digits)} in the reference: worse by more "
                f"than {_one(name, change.absolute, digits)} and by more than {100 * change.relative:.6g}%"
            )
    status = Status.FAILED if failed else Status.TOO_FEW if undecided else Status.PASSED
    return status, (*failed, *undecided)


_NAMES = {
    "failed": "share of bare drives that fail",
    "deviation_m": "median deviation",
    "left_lane": "share of drives that leave their lane or do not arrive",
}


def digits_apart(name: str, *values: float) -> int:
    """How many digits behind the point tell values of a measure apart that are not equal; as few as are usual, or more.

    Args:
        name: the name of the measure.
        *values: the values; those that are no further apart than `EQUAL` may read alike.
    """
    ordered = sorted(values)
    apart = [(one, other) for one, other in pairwise(ordered) if is_above(other, one)]
    digits = 2 if name == "deviation_m" else 0
    while any(_one(name, one, digits) == _one(name, other, digits) for one, other in apart):
        digits += 1
    return digits


def _estimate(name: str, found: Estimate, digits: int) -> str:
    """A measure's name, value and interval: "median deviation 0.31 m (0.12 to 0.44)"."""
    low, high = found.low, found.high
    interval = "" if low is None or high is None else f" ({_one(name, low, digits)} to {_one(name, high, digits)})"
    return f"{_NAMES[name]} {_one(name, found.value, digits)}{interval}"


def _one(name: str, value: float, digits: int) -> str:
    return f"{value:.{digits}f} m" if name == "deviation_m" else f"{value:.{digits}%}"
