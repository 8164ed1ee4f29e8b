"""The verdict is of the strongest attack on each street, with an interval over streets, and minds clean driving."""

from dataclasses import replace

import pytest

from roadproof.driving.starts import StartOffset
from roadproof.hardening.judgement import BareDrives, JudgedAttack, Judgement


def judged(scenario, kind, before, after, starts=((), ())):
    """A kind of attack on a street; each drive has a start of its own, or those of before and after are given."""
    return [
        JudgedAttack(
            scenario=scenario,
            kind=kind,
            after=bool(number),
            deviation_m=tuple(values),
            left_lane=tuple(value > 1.0 for value in values),
            starts=tuple(StartOffset(right_m=k / 10) for k in (starts[number] or range(len(values)))),
            simulator_calls=2 * len(values),
        )
        for number, values in enumerate((before, after))
        if values
    ]


def verdict(*rows, clean=(4, 4)):
    drives = tuple(BareDrives(4, count, ("left-03, rainy-noon",) * (4 - count)) for count in clean)
    return Judgement(tuple(each for row in rows for each in judged(*row)), drives).verdict()


HELPED = (
    ("a", "gradient", [1.8, 2.2], [0.1, 0.1]),
    ("a", "black box", [0.5, 0.5], [0.2, 0.4]),
    ("b", "gradient", [1.4, 1.6], [0.2, 0.2]),
    ("c", "gradient", [1.2, 1.4], [0.1, 0.1]),
    ("c", "old", [], [0.3, 0.3]),
)


def test_the_strongest_attack_on_each_street_is_compared():
    told = verdict(*HELPED)
    # a: 2.0 to 0.3, b: 1.5 to 0.2, c: 1.3 to 0.3, where the old pattern is the strongest.
    assert (told.compared.before_m, told.compared.after_m) == pytest.approx((1.5, 0.3))
    assert told.compared.change_m.value == pytest.approx(-(1.7 + 1.3 + 1.0) / 3)
    assert told.compared.change_m.count == 3
    assert told.compared.change_m.high < 0
    assert (told.outcome, told.compared.over) == ("helped", "streets")
    assert (told.compared.left_lane_before, told.compared.left_lane_after) == (1.0, 0.0)
    assert told.sentence.startswith("It helped: over the strongest attack")
    assert "0.30 m instead of 1.50 m in the median" in told.sentence
    assert "95 % over 3 streets)" in told.sentence


def test_an_attack_that_leads_it_out_of_its_lane_by_fewer_metres_is_not_hidden():
    rows = [each for name in "ab" for each in judged(name, "gradient", [1.5, 1.5], [0.3, 0.3])]
    ellipses = judged("a", "ellipses", [1.4, 1.4], [0.28, 0.28])
    ellipses[1] = replace(ellipses[1], left_lane=(True, False))
    told = Judgement((*rows, *ellipses), (BareDrives(4, 4, ()),) * 2).verdict()
    assert (told.compared.left_lane_before, told.compared.left_lane_after) == (1.0, 0.25)
    assert told.compared.after_m == pytest.approx(0.3)
    assert told.sentence.endswith("it leaves it in 25% of the drives instead of 100%.")


def test_fewer_metres_are_no_help_where_more_drives_leave_their_lane():
    rows = [each for name in "abc" for each in judged(name, "gradient", [1.0, 1.0], [0.3, 0.3])]
    assert Judgement(tuple(rows), (BareDrives(4, 4, ()),) * 2).verdict().outcome == "helped"
    rows[1] = replace(rows[1], left_lane=(True, False))
    told = Judgement(tuple(rows), (BareDrives(4, 4, ()),) * 2).verdict()
    assert (told.outcome, told.compared.better) == ("not shown", True)


def test_hardening_that_spoils_clean_driving_did_not_help():
    told = verdict(*HELPED, clean=(4, 3))
    assert (told.outcome, told.clean_worse) == ("did not help", True)
    assert told.sentence.startswith("It helped against paint but not on the whole: over the strongest attack")
    assert told.sentence.endswith("fewer drives over the bare road are clean.")


def test_scenarios_of_one_street_count_once():
    rows = tuple(each for row in HELPED for each in judged(*row))
    clean = (BareDrives(4, 4, ()),) * 2
    told = Judgement(rows, clean, streets=(("a", "c"), ("b",))).verdict().compared
    assert told.change_m.count == 2
    assert told.change_m.value == pytest.approx(-((1.7 + 1.0) / 2 + 1.3) / 2)
    assert told.before_m == verdict(*HELPED).compared.before_m
    # Of one street alone the interval is over the starts, from each of which all its scenarios are driven.
    alone = Judgement(rows, clean, streets=(("a", "b", "c"),)).verdict().compared
    assert (alone.over, alone.change_m.count) == ("starts", 2)
    assert alone.change_m.value == pytest.approx(-(1.7 + 1.3 + 1.0) / 3)


def test_scenarios_of_one_street_that_left_out_other_starts_are_averaged_from_the_same_one():
    rows = (
        *judged("a", "k", [1.0, 2.0, 3.0], [0.9, 1.5, 2.1], ([2, 3, 4], [2, 3, 4])),
        *judged("b", "k", [3.0, 2.0, 1.0], [2.1, 1.5, 0.9], ([1, 2, 3], [1, 2, 3])),
    )
    told = Judgement(rows, (BareDrives(4, 4, ()),) * 2, streets=(("a", "b"),)).verdict().compared
    # From start 2 by 0.1 and 0.5 less, from start 3 by 0.5 and 0.1.
    assert (told.over, told.change_m.count, told.change_m.value) == ("starts", 2, pytest.approx(-0.3))
    apart = (*judged("a", "k", [1.0], [0.5], ([1], [1])), *judged("b", "k", [1.0], [0.2], ([2], [2])))
    none = Judgement(apart, (BareDrives(4, 4, ()),) * 2, streets=(("a", "b"),)).verdict().compared
    assert (none.change_m.low, none.change_m.value) == (None, pytest.approx(-0.65))


def test_what_streets_disagree_on_is_not_shown_and_what_got_worse_is_said():
    assert verdict(("a", "k", [1.0], [0.1]), ("b", "k", [1.0], [1.2])).outcome == "not shown"
    assert verdict(("a", "k", [1.0], [1.9]), ("b", "k", [1.0], [2.0])).outcome == "did not help"


def test_one_street_has_an_interval_over_its_starts_and_one_start_has_none():
    told = verdict(("a", "k", [1.0, 1.2, 1.1], [0.1, 0.2, 0.2]))
    assert (told.outcome, told.compared.over, told.compared.change_m.count) == ("helped", "starts", 3)
    assert "95 % over 3 starts on one street)" in told.sentence
    alone = verdict(("a", "k", [1.0], [0.1]))
    assert (alone.outcome, alone.compared.change_m.low) == ("not shown", None)
    assert "95 %" not in alone.sentence


def test_drives_from_one_start_in_several_weathers_are_not_independent():
    # Two starts, four weathers: eight drives, two of them independent.
    before, after = [1.0, 1.0] * 4, [0.5, 0.95] * 4
    told = verdict(("a", "k", before, after, ([0, 1] * 4, [0, 1] * 4)))
    assert told.compared.change_m.count == 2
    assert told.compared.change_m.value == pytest.approx(-0.275)
    assert told.outcome == "not shown"


def test_starts_that_were_left_out_on_one_side_are_not_compared():
    told = verdict(("a", "k", [1.0, 1.4, 1.6, 9.0], [0.2, 0.3, 0.5], ([0, 1, 2, 3], [2, 1, 0])))
    assert told.compared.change_m.count == 3
    assert told.compared.change_m.value == pytest.approx(((0.5 - 1.0) + (0.3 - 1.4) + (0.2 - 1.6)) / 3)
    none = verdict(("a", "k", [1.0, 1.4], [0.2], ([0, 1], [2])))
    assert (none.outcome, none.compared.change_m.low) == ("not shown", None)
    assert none.compared.change_m.value == pytest.approx(-1.0)


def test_a_car_that_no_longer_comes_to_the_canvas_was_not_helped():
    kept = judged("a", "k", [0.5, 0.5, 0.0, 0.0], [0.3, 0.29], ([0, 1, 2, 3], [0, 1]))
    kept[1] = replace(kept[1], left_out=2)
    clean = BareDrives(4, 4, ())
    told = Judgement(tuple(kept), (clean, clean)).verdict()
    assert (told.outcome, told.lost) == ("not shown", 2)
    assert (told.compared.before_m, told.compared.after_m) == pytest.approx((0.5, 0.295)), "over the starts of both"
    assert told.sentence.endswith("; in 2 more drives it never came to the canvas.")


def test_a_street_that_cannot_be_judged_after_it_is_named_and_never_helped():
    rows = tuple(each for row in HELPED for each in judged(*row)) + tuple(judged("d", "gradient", [2.0, 2.0], []))
    clean = (BareDrives(4, 4, ()),) * 2
    told = Judgement(rows, clean, {"d": "without paint the car never comes near the canvas of d"}).verdict()
    assert (told.outcome, told.unjudged) == ("not shown", ("d",))
    assert told.compared == verdict(*HELPED).compared, "the others are compared as ever"
    assert told.sentence.endswith("; d could not be judged after it.")


def test_where_no_street_can_be_judged_after_it_the_bare_road_decides():
    before = tuple(judged("a", "gradient", [1.8, 2.2], []))
    clean = BareDrives(4, 4, ())
    told = Judgement(before, (clean, clean), {"a": "it stands"}).verdict()
    assert (told.outcome, told.compared) == ("not shown", None)
    assert told.sentence == "That it helped is not shown: no held-out street could be judged after it."
    told = Judgement(before, (clean, BareDrives(4, 0, ("a, noon",) * 4)), {"a": "it stands"}).verdict()
    assert told.outcome == "did not help"
    assert told.sentence.endswith("judged after it; fewer drives over the bare road are clean.")
