import dataclasses

from hand_made_study import BO, GRADOPT, bad, results, row
from roadproof.study.kept_jobs import StatedMethod
from roadproof.study.paper_tables import ablation_table, methods_table, paper_tables
from roadproof.study.results import DEVIATION, LEFT_OUT


def text(cell):
    return cell if isinstance(cell, str) else cell.value


def tables_of(records, methods=(GRADOPT, BO)):
    return {table.name: table for table in paper_tables(results(records, methods))}


def rows_of(table):
    return [tuple(map(text, row)) for row in table.rows]


def test_the_overall_table_has_the_papers_layout(records):
    table = tables_of(records)["overall-bo"]
    assert [(heading.text, heading.span) for heading in table.header[0]] == [
        ("", 1), ("Deviation", 3), ("Infraction penalty", 3),
    ]  # fmt: skip
    assert [heading.text for heading in table.header[1]] == ["K", *("BO", "GradOpt", "% ≥") * 2]
    # Deviations 1, 2, 1.5, 3 against 0.5, 2, 2.5, 1; penalties in traffic twice that and 1.5 more.
    assert rows_of(table) == [
        ("1", "1.50", "1.88", "75%", "4.50", "5.25", "75%"),
        ("5", "2.50", "2.88", "75%", "4.50", "5.25", "75%"),
    ]
    assert [cell.best for cell in table.rows[0][1:3]] == [False, True]
    assert "in traffic" in table.note
    assert "4 scenarios × 1 seed" in table.note
    assert "bare road: 0.50" in table.note
    assert "too narrow for as few as 4" in table.note


def test_types_weathers_and_static_only_have_tables_of_their_own(records):
    tables = tables_of(records)
    assert list(tables) == [
        "methods", "scenarios", "overall-bo", "paired-bo", "type-penalty-bo", "type-static-bo", "type-deviation-bo",
        "weathers-bo", "rainy-noon-alone-bo",
    ]  # fmt: skip
    assert rows_of(tables["type-deviation-bo"])[0] == (
        "1", "0.50", "1.00", "100%", "2.25", "1.75", "50%", "1.00", "3.00", "100%",
    )  # fmt: skip
    assert rows_of(tables["type-static-bo"])[0][4:7] == ("4.50", "3.50", "50%")
    assert rows_of(tables["weathers-bo"])[0] == ("1", "4.50", "5.25", "75%")
    assert rows_of(tables["rainy-noon-alone-bo"])[0] == ("1", "1.25", "1.62", "75%", "3.00", "3.75", "75%")


def test_differences_come_with_ties_test_and_all_k_together(records):
    rows = rows_of(tables_of(records)["paired-bo"])
    assert [row[:2] for row in rows[:4]] == [
        ("Deviation", "1"), ("", "5"), ("", "all"), ("Infraction penalty", "1"),
    ]  # fmt: skip
    assert rows[0][2:5] == ("0.38", "75%", "1")
    assert rows[2][6:] == ("8", "4")
    # 0.5, −1 and 2: the ranks against are 2 of 6, and 6 of the 8 signs are at least as extreme.
    assert rows[0][5] == "0.750"


def test_cost_stands_beside_what_was_found(records):
    table = tables_of(records)["methods"]
    assert rows_of(table)[0] == ("1", "GradOpt", "4", "61", "30", "1.88", "5.25", "1.75 (1.38 to 2.25)", "100%")
    assert rows_of(table)[1] == ("", "BO", "4", "1000", "30", "1.50", "4.50", "1.50 (0.88 to 2.12)", "100%")


def test_scenario_by_scenario_medians_stand_with_their_range_and_what_left_the_lane(records):
    uneven = [row("left-01", deviation_m=d, left_lane=d > 1, points=d) for d in (0.5, 1.5, 4.0)] + [
        row("left-01", method="BO", deviation_m=2.0),
        row("left-02", method="BO", deviation_m=9.0),
    ]
    table = tables_of(uneven)["scenarios"]
    assert rows_of(table) == [
        ("1", "left-01", "GradOpt", "61", "30", "1.50", "2 of 3", "1.5"),
        ("", "", "BO", "1000", "30", "2.00", "1 of 1", "2"),
        ("1", "left-02", "GradOpt", "–", "–", "–", "–", "–"),
        ("", "", "BO", "1000", "30", "9.00", "1 of 1", "2"),
    ]
    assert table.rows[0][5].interval == ("0.50", "4.00")
    assert [cells[5].best for cells in table.rows[:2]] == [False, True]
    # left-02 has nothing to be compared with.
    assert "in so many of 1 cases of scenario, K and weather: GradOpt 0, BO 1." in table.note
    assert "left-02, K = 1, GradOpt, seed 0" in table.note

    whole = tables_of(records)["scenarios"]
    # Alone on the road, one drive in each of two weathers: medians are the deviations, and their means stand last.
    assert rows_of(whole)[8:10] == [
        ("1", "mean of 4", "GradOpt", "61", "30", "1.88", "1.62", "8 of 8", "3.5"),
        ("", "", "BO", "1000", "30", "1.50", "1.25", "8 of 8", "3"),
    ]
    assert "of 16 cases of scenario, K and weather: GradOpt 12, BO 8." in whole.note  # left-01 is a tie


def test_no_mean_is_marked_over_other_cases_than_those_of_the_others(records):
    rows = [
        row(f"left-0{k}", method=name, deviation_m=k + (name == "BO")) for k in (1, 2) for name in ("GradOpt", "BO")
    ]
    assert [cells[5].best for cells in tables_of(rows)["methods"].rows] == [False, True]
    assert not any(cells[5].best for cells in tables_of(rows[:3])["methods"].rows)


def test_the_median_of_two_seeds_is_the_mean_of_theirs():
    rows = [
        row("left-01", seed=seed, deviation_m=d)
        for seed, found in ((0, (0.1, 0.2, 0.3)), (1, (1.0, 3.0)))
        for d in found
    ]
    assert rows_of(tables_of(rows, [GRADOPT])["scenarios"])[0][5] == "1.10"


def test_scenarios_are_compared_only_over_the_seeds_that_every_method_has():
    found = {"GradOpt": (1.0, 1.0), "BO": (1.2, 0.2)}
    rows = [
        row(scenario, method=method, seed=seed, deviation_m=deviation)
        for scenario in ("left-01", "left-02", "left-03")
        for method, deviations in found.items()
        for seed, deviation in enumerate(deviations)
        if (scenario, method, seed) != ("left-01", "GradOpt", 1)
    ]
    table = tables_of(rows)["scenarios"]
    # On the only seed of left-01 that both have BO is ahead; its other seed would turn that round.
    assert not any(cells[5].best for cells in table.rows[:2])
    assert [(cells[1], cells[5].best) for cells in table.rows[2:]] == [
        ("left-02", True), ("", False), ("left-03", True), ("", False), ("mean of 2", True), ("", False),
    ]  # fmt: skip
    assert "in so many of 2 cases of scenario, K and weather: GradOpt 2, BO 0." in table.note
    assert "left-01, K = 1, GradOpt, seed 1" in table.note
    # Where all of them lack the same seed, the other is one to compare them by.
    alike = [each for each in rows if each["scenario"] != "left-01" or each["seed"] == 0]
    assert tables_of(alike)["scenarios"].rows[1][5].best


def test_the_ablation_compares_variants_over_what_all_have():
    variants = [
        StatedMethod(name=name, search="gradopt", scheme=scheme, trajectories=t)
        for name, scheme, t in (("R", "random", 3), ("G3", "group", 3), ("A", "group-all", 3), ("G1", "group", 1))
    ]
    rows = [
        row(f"left-0{k}", method=method.name, deviation_m=float(k + len(method.scheme)))
        for method in variants
        for k in (1, 2)
    ]
    rows[0] = bad(scenario="left-01", method="R")
    table = ablation_table(results(rows, variants), variants, DEVIATION)
    assert [(heading.text, heading.span) for heading in table.header[0]] == [
        ("", 1), ("Group", 2), ("Group-All", 1), ("Random", 1),
    ]  # fmt: skip
    assert [heading.text for heading in table.header[1]] == ["K", "T=1", "T=3", "T=3", "T=3"]
    assert rows_of(table) == [("1", "7.00", "7.00", "11.00", "8.00")]
    assert "1 job: left-01, K = 1, R, seed 0 (no luck)" in table.note
    rows.append(row(method="BO"))
    assert results(rows, [*variants, BO]).reference.name == "G3"
    assert results(rows, [*variants, BO], "BO").reference.name == "BO", "what the plan names"


def test_the_reference_is_compared_with_all_but_its_own_ablation():
    ours, others = (
        StatedMethod(name=name, search="gradopt", scheme="group", trajectories=t) for name, t in (("A", 3), ("B", 1))
    )
    alike = dataclasses.replace(ours, name="two weathers")
    rows = [row(method=each.name) for each in (ours, others, alike, BO)]
    assert results(rows, [ours, others, alike, BO], "A").compared == ["A", "two weathers", "BO"]
    assert results(rows, [ours, others, alike, BO], "BO").compared == ["BO", "A", "B", "two weathers"]


def test_variants_that_differ_otherwise_go_by_their_names():
    variants = [dataclasses.replace(GRADOPT, name=name) for name in ("short", "long")]
    rows = [row(method=method.name) for method in variants]
    table = ablation_table(results(rows, variants), variants, DEVIATION)
    assert [heading.text for heading in table.header[1]] == ["K", "short", "long"]


def test_variants_of_unknown_schemes_are_not_compared():
    variants = [StatedMethod(name=name, search="gradopt") for name in ("GradOpt", "BO")]
    rows = [row(method=method.name) for method in variants]
    assert not any(table.name.startswith("ablation") for table in paper_tables(results(rows, variants)))


def test_what_failed_is_noted_and_left_out_on_both_sides(records):
    broken = [each for each in records if (each["scenario"], each["method"]) != ("right-01", "BO")]
    broken += [bad("out of memory", scenario="right-01", method="BO", figures=k) for k in ("1", "5")]
    tables = tables_of(broken)
    # Without right-01 on either side: 1, 2, 1.5 against 0.5, 2, 2.5.
    assert rows_of(tables["overall-bo"])[0][1:4] == ("1.67", "1.50", "67%")
    for name, table in tables.items():
        if name != "missing":
            assert "2 jobs: right-01, K = 1, BO, seed 0 (out of memory)" in table.note, name
    assert rows_of(tables["missing"])[0] == ("right-01", "1", "BO", "0", "out of memory")
    assert tables["missing"].note.startswith("2 of 16 jobs. The same study run again tries those again")
    right = tables["type-deviation-bo"].rows[0][7:]
    assert right == ("–", "–", "–")


def test_drives_that_were_left_out_are_not_promised_to_be_tried_again(records):
    table = tables_of(records[:-1])["missing"]
    (cells,) = rows_of(table)
    assert cells[4] == f"1 of 2 drives at rainy noon in traffic; {LEFT_OUT}"
    assert table.note == "1 of 16 jobs."


def test_a_note_says_how_few_scenarios_a_row_is_over(records):
    told = [
        each for each in records if (each["figures"], each["scenario"]) != ("5", "left-01") or each["method"] != "BO"
    ]
    note = tables_of(told)["overall-bo"].note
    assert "Means over 3 to 4 scenarios × 1 seed" in note
    assert "too narrow for as few as 3" in note


def test_a_note_is_about_the_cases_that_are_compared(records):
    worse = [each | {"clean_points": 90.0} if each["scenario"] == "left-01" else each for each in records]
    told = [each for each in worse if (each["scenario"], each["method"]) != ("left-01", "BO")]
    tables = tables_of(told)
    for name in ("overall-bo", "paired-bo"):
        assert "Means over 3 scenarios × 1 seed" in tables[name].note, name
        assert "as few as 3" in tables[name].note, name
        assert "bare road: 0.50 at clear noon" in tables[name].note, name
    assert "Means over 3 to 4 scenarios × 1 seed" in tables["methods"].note
    assert "bare road: 13.29 at clear noon" in tables["methods"].note  # two of 14 cases


def test_methods_that_have_no_case_in_common_are_not_averaged():
    told = tables_of([row(method="C"), row("left-02", method="C"), bad(method="GradOpt"), bad(method="BO")])
    for name in ("overall-c", "overall-bo"):
        assert "There is no case that all of them have." in told[name].note


def test_one_method_one_k_one_weather_give_what_makes_sense():
    alone = tables_of([row("left-01"), row("left-02")])
    assert list(alone) == ["methods", "scenarios"]
    assert "Highest" not in alone["scenarios"].note
    both = tables_of([row("left-01"), row("left-01", method="BO")])
    assert list(both) == ["methods", "scenarios", "overall-bo", "paired-bo"]
    assert [each[:2] for each in rows_of(both["paired-bo"])] == [("Deviation", "1"), ("Infraction penalty", "1")]
    assert "one scenario has no interval" in both["overall-bo"].note
    assert "alone on the road" in both["overall-bo"].note
    assert "in traffic" not in both["overall-bo"].note
    # Equal on both sides: neither is best.
    assert not any(cell.best for cell in both["overall-bo"].rows[0] if not isinstance(cell, str))


def test_without_gradopt_the_first_method_is_compared():
    names = ("random", "TPE")
    methods = [StatedMethod(name=name, search=name.lower()) for name in names]
    tables = tables_of([row(method=name, search_calls=5) for name in names], methods)
    assert "overall-tpe" in tables
    assert tables["overall-tpe"].title.startswith("random and TPE")


def test_methods_whose_names_look_alike_keep_their_files_apart():
    names = ("GradOpt", "a b", "a-b")
    tables = tables_of([row(method=name) for name in names])
    assert {"overall-a-b", "overall-a-b-2"} <= set(tables)


def test_methods_with_long_names_have_files_of_names_that_are_not_too_long():
    names = ("GradOpt", "long " * 50 + "one", "long " * 50 + "other")
    tables = tables_of([row(method=name) for name in names])
    assert len([name for name in tables if name.startswith("overall-long-long")]) == 2
    assert max(map(len, tables)) < 100


def test_an_unknown_search_is_compared_too():
    assert methods_table(results([row(method="own")])).rows[0][1] == "own"


def test_other_weathers_may_have_been_driven_alone(records):
    kept = [each for each in records if each["weather"] == "clear-noon" or not each["traffic"]]
    table = tables_of(kept)["weathers-bo"]
    assert table.header[0][1].text == "Rainy noon (alone)"
    assert rows_of(table)[0] == ("1", "3.00", "3.75", "75%")
    assert "Missing" not in table.note


def test_seeds_are_pairs_of_their_own():
    rows = [
        row("left-01", method=name, seed=seed, deviation_m=float(seed if name == "BO" else 0.5))
        for name in ("GradOpt", "BO")
        for seed in range(2)
    ]
    table = tables_of(rows)["overall-bo"]
    assert rows_of(table)[0][3] == "50%"
