"""Intervals against their definitions, and verdicts at their limits."""

import math
from itertools import product

import numpy as np
import pytest
from scipy import stats

from roadproof.driving.intervals import Estimate
from roadproof.gate.verdict import Change, Status, judge, least_drives, median_95, share_95


def covered(count, low, high):
    """How often the median lies between two order statistics, counted over all the ways to fall on its sides."""
    ways = [sum(sides) for sides in product((0, 1), repeat=count)]
    return sum(low <= below < high for below in ways) / len(ways)


@pytest.mark.parametrize("count", [6, 9, 12])
def test_the_interval_of_a_median_is_the_shortest_pair_of_drives_that_covers_it(count):
    values = np.arange(1.0, count + 1)
    found = median_95(list(np.random.default_rng(0).permutation(values)))
    assert found.value == np.median(values)
    low, high = int(found.low), int(found.high)
    assert covered(count, low, high) >= 0.95
    assert covered(count, low + 1, high - 1) < 0.95


def test_five_drives_have_no_interval():
    assert median_95([0.1, 0.2, 0.3, 0.4, 0.5]) == Estimate(0.3, None, None, 5)
    assert least_drives("deviation_m", 0.5) == 6


@pytest.mark.parametrize(("yes", "count"), [(0, 6), (3, 10), (14, 14)])
def test_the_interval_of_a_share_is_exact(yes, count):
    found = share_95(yes, count)
    assert found.value == yes / count
    if yes:
        assert stats.binom.sf(yes - 1, count, found.low) == pytest.approx(0.025)
    if yes < count:
        assert stats.binom.cdf(yes, count, found.high) == pytest.approx(0.025)


@pytest.mark.parametrize("limit", [0.01, 0.05, 0.25, 0.6])
def test_the_least_number_of_drives_is_the_first_that_can_pass(limit):
    least = least_drives("left_lane", limit)
    assert share_95(0, least).high <= limit < share_95(0, least - 1).high


def test_a_share_of_zero_is_met_by_the_drives_made():
    assert least_drives("left_lane", 0.0) == 1
    assert least_drives("left_lane", 1e-320) >= 2**62, "more than there ever are"
    assert judge({"left_lane": share_95(0, 6)}, {"left_lane": 0.0}, {}, None)[0] is Status.PASSED
    assert judge({"left_lane": share_95(0, 6)}, {"left_lane": 0.0}, {}, None, is_new=True)[0] is Status.PASSED
    assert judge({"left_lane": share_95(1, 6)}, {"left_lane": 0.0}, {}, None)[0] is Status.FAILED


@pytest.mark.parametrize(
    ("value", "high", "status"),
    [(0.3, 0.5, Status.PASSED), (0.3, 0.51, Status.TOO_FEW), (0.3, None, Status.TOO_FEW), (0.51, 0.9, Status.FAILED)],
)
def test_a_limit_is_passed_with_its_whole_interval(value, high, status):
    measures = {"deviation_m": Estimate(value, None if high is None else 0.1, high, 20)}
    found, reasons = judge(measures, {"deviation_m": 0.5}, {}, None)
    assert found is status
    assert bool(reasons) == (status is not Status.PASSED)


@pytest.mark.parametrize(
    ("before", "now", "fails"),
    [
        (0.50, 0.59, False),  # worse by less than 0.1 m
        (0.50, 0.61, True),
        (1.00, 1.15, False),  # by more than 0.1 m, by less than a fifth
        (1.00, 1.21, True),
        (0.00, 0.09, False),
        (0.00, 0.11, True),
        (1.00, 0.10, False),  # better
    ],
)
def test_a_change_fails_where_it_exceeds_both(before, now, fails):
    change = Change(absolute=0.1, relative=0.2)
    measures = {"deviation_m": Estimate(now, now, now, 20)}
    stored = {"deviation_m": Estimate(before, before, before, 20)}
    status, reasons = judge(measures, {}, {"deviation_m": change}, stored)
    assert status is (Status.FAILED if fails else Status.PASSED)
    assert not fails or f"was {before:.2f} m in the reference" in reasons[0]
    assert judge(measures, {}, {"deviation_m": change}, None)[0] is Status.PASSED
    status, reasons = judge(measures, {}, {"deviation_m": change}, None, is_new=True)
    assert status is Status.FAILED
    assert "nothing judges it" in reasons[0]


def shares(before, now, count):
    return {"left_lane": share_95(before, count)}, {"left_lane": share_95(now, count)}


@pytest.mark.parametrize("count", [10, 12, 20, 30])
@pytest.mark.parametrize("more", [1, 2, 3])
def test_a_change_of_exactly_the_limit_passes_and_a_drive_more_fails(count, more):
    absolute = {"left_lane": Change(absolute=more / count, relative=0.0)}
    for yes in range(count - more):
        before, now = shares(yes, yes + more, count)
        assert judge(now, {}, absolute, before)[0] is Status.PASSED
        assert judge(shares(yes, yes + more + 1, count)[1], {}, absolute, before)[0] is Status.FAILED
        if yes:
            relative = {"left_lane": Change(absolute=0.0, relative=more / yes)}
            assert judge(now, {}, relative, before)[0] is Status.PASSED


def test_a_median_of_exactly_the_limit_passes():
    # (0.1 + 0.2) / 2 is 0.15 and a bit.
    measures = {"deviation_m": median_95([0.1, 0.2] * 10)}
    assert measures["deviation_m"].value > 0.15
    _, reasons = judge(measures, {"deviation_m": 0.15}, {}, None)
    assert "does not exceed the limit of 0.15 m" in reasons[0]
    ends = Estimate(0.15, 0.1, 0.1 + 0.2, 20)
    assert judge({"deviation_m": ends}, {"deviation_m": 0.3}, {}, None)[0] is Status.PASSED


def test_numbers_that_differ_read_differently():
    (reason,) = judge({"left_lane": share_95(1, 300)}, {"left_lane": 0.0}, {}, None)[1]
    assert reason.endswith("leave their lane or do not arrive 0.3% (0.0% to 1.8%) is above the limit of 0.0%")
    (reason,) = judge({"deviation_m": Estimate(0.5004, 0.1, 0.9, 20)}, {"deviation_m": 0.5}, {}, None)[1]
    assert reason == "median deviation 0.5004 m (0.1000 m to 0.9000 m) is above the limit of 0.5000 m"
    before, now = shares(60, 64, 300)
    changes = {"left_lane": Change(absolute=0.01, relative=0.025)}
    (reason,) = judge(now, {}, changes, before)[1]
    assert "21.3% (16.8% to 26.4%) was 20.0% in the reference" in reason
    assert reason.endswith("worse by more than 1.0% and by more than 2.5%")


def test_a_case_without_drives_does_not_pass():
    assert judge({}, {}, {}, None)[0] is Status.TOO_FEW


def test_a_case_without_all_of_its_drives_does_not_pass():
    status, reasons = judge({"left_lane": share_95(0, 1)}, {"left_lane": 0.0}, {}, None, left_out=5)
    assert status is Status.TOO_FEW
    assert reasons == ("too few drives: 5 had no good drive on the bare road to compare with",)
    assert judge({"left_lane": share_95(1, 1)}, {"left_lane": 0.0}, {}, None, left_out=5)[0] is Status.FAILED


def test_the_least_for_a_median_follows_from_its_tails():
    assert 2 * 0.5 ** least_drives("deviation_m", math.inf) <= 0.05 < 2 * 0.5**5
