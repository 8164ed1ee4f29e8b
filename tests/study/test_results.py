import numpy as np
import pytest

from hand_made_study import BO, GRADOPT, bad, results, row
from roadproof.errors import StudyError
from roadproof.study.results import DEVIATION, LEFT_OUT, PENALTY, Block
from roadproof.study.rows import JobId


def test_drives_in_traffic_become_one_mean(records):
    found = results(records)
    assert found.figures == ("1", "5")
    assert found.home == "clear-noon"
    assert [method.name for method in found.methods] == ["GradOpt", "BO"]
    points = found.values(Block("", PENALTY, "clear-noon", True), "GradOpt", "1")
    # 2 · 2.0 + 1 and 2 · 2.0 + 2
    assert points["left-01", 0] == 5.5
    left = found.values(Block("", PENALTY, "rainy-noon", False, "left"), "BO", "5")
    assert set(left.index) == {("left-01", 0), ("left-02", 0)}
    every = found.values(Block("", DEVIATION, "clear-noon", False), "BO")
    assert every["left-01", 0, "5"] == every["left-01", 0, "1"] + 1.0 == 3.0


def test_one_black_figure_stands_first():
    assert results([row(figures=k) for k in ("10", "2", "1-b", "1")]).figures == ("1-b", "1", "2", "10")


def test_what_failed_or_is_missing_is_said():
    rows = [
        row("left-01"),
        bad("its process died", scenario="left-01", method="BO"),
        row("left-02"),
        row("left-02", method="BO"),
        row("left-02", method="BO", traffic=True),
        row("left-02", method="BO", traffic=True),
        row("left-02", traffic=True),
        row("left-03"),
        row("left-03", traffic=True),
        row("left-03", traffic=True),
    ]
    gaps = results(rows, (GRADOPT, BO)).gaps()
    assert gaps == {
        JobId("left-01", "1", "GradOpt", 0): f"0 of 2 drives at clear noon in traffic; {LEFT_OUT}",
        JobId("left-01", "1", "BO", 0): "its process died",
        JobId("left-02", "1", "GradOpt", 0): f"1 of 2 drives at clear noon in traffic; {LEFT_OUT}",
        JobId("left-03", "1", "BO", 0): "no row; not done yet",
    }
    assert len(results(rows).gaps(["GradOpt"], {("clear-noon", False)})) == 0


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ([], "no rows yet"),
        ([{"scenario": "left-01"}], "no column 'kind'"),
        ([bad("no luck")], r"first of 1 that failed \(left-01, K = 1, GradOpt, seed 0\): no luck"),
        ([row(deviation_m=float("nan"))], "deviation_m is nan, expected a finite number"),
        ([row(points=None)], "points is None"),
        ([row(figures=5)], "figures of the rows is .*5.*, expected text; run the study again"),
        ([row(), row(method=None)], "method of the rows is .*, expected text"),
        ([row(seed=float("nan"))], "seed of the rows is .*nan.*, expected a whole number"),
        ([row(job=["a"])], r"job of the rows is \['a'\], expected text"),
        ([row(kind=np.array([["a"], ["b"]]))], r"kind of the rows is array\(\[\['a'\], \['b'\]\].*, expected text"),
        ([row(method=["a"])], r"method of the rows is \['a'\], expected text"),
        ([row(weather=["a"])], r"weather of the rows is \['a'\], expected text"),
        ([row(), row(error=["a"])], r"error of the rows is \['a'\], expected text"),
        ([row(traffic="False")], "traffic of the rows is 'False', expected true or false; run the study again"),
        ([row(traffic=["a"])], r"traffic of the rows is \['a'\], expected true or false"),
        ([row(points=[1.0])], "points of the rows is not all numbers"),
        ([row(), row(weather=None)], "weather of the rows is .*, expected text"),
    ],
)
def test_rows_that_cannot_be_compared_are_named(rows, message):
    with pytest.raises(StudyError, match=message) as caught:
        results(rows)
    assert "\n" not in str(caught.value)
