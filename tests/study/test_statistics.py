import math

import numpy as np
import pytest
from pandas import Series
from scipy import stats

from roadproof.study.statistics import mean_over_scenarios, paired, wilcoxon_p


def cases(*values, **more):
    """A value for each of some scenarios, all of seed 0."""
    return Series(
        {(f"s{k}", 0): value for k, value in enumerate(values)} | {(name, 0): value for name, value in more.items()}
    )


def test_the_mean_is_over_cases_and_the_interval_over_scenarios():
    # Ten equal seeds of a scenario are no ten independent findings.
    many = Series({("a", k): 0.0 for k in range(10)} | {("b", k): 1.0 for k in range(10)})
    found = mean_over_scenarios(many)
    assert (found.value, found.count) == (0.5, 20)
    assert (found.low, found.high) == (0.0, 1.0)


def test_an_uneven_scenario_weighs_by_its_cases():
    assert mean_over_scenarios(Series({("a", 0): 1.0, ("a", 1): 1.0, ("b", 0): 4.0})).value == 2.0


def test_intervals_are_the_same_in_every_call():
    values = cases(*np.random.default_rng(3).normal(size=12).tolist())
    first = mean_over_scenarios(values)
    assert mean_over_scenarios(values.copy()) == first


def test_the_interval_is_that_of_means_drawn_by_hand():
    values = np.random.default_rng(1).gamma(2.0, size=40)
    found = mean_over_scenarios(cases(*values.tolist()))
    drawn = np.random.default_rng(1).choice(values, (20_000, 40)).mean(1)
    low, high = np.quantile(drawn, (0.025, 0.975))
    assert found.low == pytest.approx(low, abs=0.03)
    assert found.high == pytest.approx(high, abs=0.03)


@pytest.mark.parametrize("value", [0.1, 0.3, 1.1, 1.23])
@pytest.mark.parametrize("scenarios", range(2, 8))
def test_the_mean_of_equal_scenarios_lies_within_its_interval(value, scenarios):
    found = mean_over_scenarios(Series({(f"s{k}", seed): value for k in range(scenarios) for seed in range(2)}))
    assert found.low <= found.value <= found.high


def test_one_scenario_has_no_interval_and_none_no_mean():
    one = Series({("a", 0): 1.0, ("a", 1): 3.0})
    assert mean_over_scenarios(one) is not None
    assert mean_over_scenarios(one).low is None
    assert mean_over_scenarios(one[[]]) is None


def test_pairs_are_those_that_both_have_and_ties_count_as_at_least():
    ours = cases(1.0, 2.0, 0.3, 5.0, only_ours=100.0)
    theirs = cases(0.5, 2.0, 0.1 + 0.2, 6.0, only_theirs=100.0)
    found = paired(ours, theirs)
    # 0.1 + 0.2 is a little more than 0.3: still a tie.
    assert (found.at_least.value, found.ties, len(found.by_scenario)) == (0.75, 2, 4)
    assert found.ours.value == pytest.approx(8.3 / 4)
    assert found.theirs.value == pytest.approx(8.8 / 4)
    assert found.difference.value == pytest.approx(-0.125)
    assert found.difference.count == 4


def test_methods_without_a_common_case_cannot_be_compared():
    assert paired(cases(1.0), cases(other=1.0)) is None


def test_wilcoxon_is_that_of_scipy_on_scenario_means():
    generator = np.random.default_rng(5)
    first, second = generator.normal(0.4, 1, (2, 15, 2))
    second -= 0.4
    ours, theirs = (
        Series({(f"s{k}", seed): float(each[k, seed]) for k in range(15) for seed in range(2)})
        for each in (first, second)
    )
    assert wilcoxon_p(paired(ours, theirs).by_scenario) == pytest.approx(
        stats.wilcoxon(first.mean(1), second.mean(1)).pvalue
    )


def test_wilcoxon_of_known_pairs():
    # All eight on one side: 2 of the 2^8 equally likely signs are as extreme.
    assert wilcoxon_p([1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0]) == pytest.approx(2 / 2**8)
    # Zeros say nothing of a side.
    assert wilcoxon_p([0.0, 1e-12, 1.0, 2.0, 3.0]) == pytest.approx(2 / 2**3)


@pytest.mark.parametrize("differences", [[], [1.0], [0.0, 0.0, 0.0]])
def test_wilcoxon_needs_differences(differences):
    assert wilcoxon_p(differences) is None


def test_a_p_is_a_number_also_where_many_are_equal():
    assert math.isfinite(wilcoxon_p([1.0, 1.0, 1.0, -1.0, 2.0] * 12))
