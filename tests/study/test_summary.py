from __future__ import annotations

from pandas import DataFrame

from roadproof.study.summary import failures, summary, transfer_summary


def row(method, deviation_m, *, weather="clear-noon", traffic=False, error=None, **more):
    job = {"scenario": "left-01", "kind": "left", "figures": "1", "method": method, "seed": 0}
    costs = {"search_calls": 14, "search_seconds": 30.0}
    return {**job, "weather": weather, "traffic": traffic, "deviation_m": deviation_m, **costs, "error": error, **more}


def test_methods_are_summed_up_as_they_were_searched():
    rows = [
        row("GradOpt", 9.0, weather="rainy-noon"),
        row("GradOpt", 1.0),
        row("GradOpt", 9.0, traffic=True),
        row("GradOpt", 2.0, search_calls=16),
        row("BO", 0.5),
        {**row("BO", None), "error": "no luck"},
    ]
    ours, theirs = summary(DataFrame(rows), "clear-noon")
    assert "GradOpt: 1.50 m mean deviation, alone in clear-noon; found with 15 simulator calls in 30 s" in ours
    assert "BO: 0.50 m" in theirs
    assert failures(DataFrame(rows)) == ("left-01, K = 1, BO, seed 0: no luck",)


def test_a_job_of_which_drives_were_left_out_counts_as_much_as_others():
    rows = [row("GradOpt", 1.0), row("GradOpt", 2.0), row("GradOpt", 5.5, seed=1, search_calls=20)]
    (told,) = summary(DataFrame(rows), "clear-noon")
    assert told.startswith("GradOpt: 3.50 m mean deviation, alone in clear-noon; found with 17 simulator calls")


def test_a_study_in_which_all_failed_has_failures_alone():
    rows = [row("BO", None, error="no luck")]
    assert summary(DataFrame(rows), "clear-noon") == ()
    assert len(failures(DataFrame(rows))) == 1


def test_a_transfer_is_a_mean_for_each_method_and_controller():
    found = {"found_on": "cil"}
    rows = [row("BO", 1.0, controller="cil", **found), row("BO", 2.0, controller="cil", **found)]
    assert transfer_summary(DataFrame([*rows, row("BO", 0.25, controller="own", **found)])) == (
        "BO, found against cil: 1.50 m mean deviation of cil",
        "BO, found against cil: 0.25 m mean deviation of own",
    )


def test_a_pattern_of_which_drives_were_left_out_counts_as_much_as_others():
    told = {"found_on": "cil", "controller": "own"}
    five = [row("BO", 1.0, **told)] * 5
    assert transfer_summary(DataFrame([*five, row("BO", 4.0, seed=1, **told)])) == (
        "BO, found against cil: 2.50 m mean deviation of own",
    )
