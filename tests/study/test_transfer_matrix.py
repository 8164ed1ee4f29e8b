import pytest
from pandas import DataFrame
from PIL import Image

from roadproof.errors import StudyError
from roadproof.report.plots import save
from roadproof.study.results import PENALTY
from roadproof.study.table import Number
from roadproof.study.transfer_matrix import transfer_map, transfer_table


def drive(found_on, controller, deviation_m, scenario="left-01", **changed):
    return {
        "found_on": found_on,
        "controller": controller,
        "scenario": scenario,
        "figures": "3",
        "method": "GradOpt",
        "seed": 0,
        "weather": "clear-noon",
        "start_right_m": 0.1,
        "start_turned_rad": 0.02,
        "start_faster_mps": 1.0,
        "deviation_m": deviation_m,
        "points": 2 * deviation_m,
    } | changed


DRIVES = [
    drive("cil", "cil", 2.0),
    drive("cil", "cil", 1.0, "left-02"),
    drive("cil", "pilotnet", 0.5),
    drive("cil", "pilotnet", 0.5, "left-02"),
    drive("cil", "robust", 0.25),
    drive("cil", "robust", 0.25, "left-02"),
    drive("pilotnet", "pilotnet", 1.5),
    # Twice the same pattern, in two runs: one value.
    drive("pilotnet", "cil", 0.2),
    drive("pilotnet", "cil", 0.4),
]


def test_the_matrix_is_found_on_by_driven_by():
    table = transfer_table(DataFrame(DRIVES))
    assert [heading.text for heading in table.header[1]] == ["found on", "cil", "pilotnet", "robust"]
    shown = [[cell.value if isinstance(cell, Number) else cell for cell in row] for row in table.rows]
    assert shown == [["cil", "1.50", "0.50", "0.25"], ["pilotnet", "0.30", "1.50", "–"]]
    assert [cell.best for cell in table.rows[0][1:]] == [True, False, True]
    assert "1 to 2 patterns a cell" in table.note
    assert "1 pairs were not driven" in table.note
    assert "too narrow for as few as 1." in table.note


def test_controllers_are_compared_over_the_patterns_that_all_of_them_drove():
    unjudged = [drive("cil", "cil", 9.0, "left-03"), drive("cil", "robust", 9.0, "left-04")]
    assert transfer_table(DataFrame([*DRIVES, *unjudged])) == transfer_table(DataFrame(DRIVES))
    with pytest.raises(StudyError, match="no pattern of the transfer was driven over by every controller"):
        transfer_table(DataFrame(unjudged))


def test_controllers_are_compared_over_the_starts_that_all_of_them_drove_from():
    # One that never came to the canvas from this start has no drive from there.
    other = [drive("cil", "cil", 9.0, start_right_m=0.2), drive("cil", "robust", 9.0, start_right_m=0.2)]
    assert transfer_table(DataFrame([*DRIVES, *other])) == transfer_table(DataFrame(DRIVES))


def test_the_penalty_has_a_matrix_of_its_own():
    table = transfer_table(DataFrame(DRIVES), PENALTY)
    assert table.rows[0][1].value == "3.00"
    assert table.name == "transfer-infraction-penalty"


def test_the_heat_map_is_a_picture(tmp_path):
    picture = transfer_map(DataFrame(DRIVES))
    save(picture.figure, tmp_path / "map.png")
    with Image.open(tmp_path / "map.png") as drawn:
        assert drawn.size[0] > 300
    texts = [text.get_text() for text in picture.figure.axes[0].texts]
    assert texts == ["1.50", "0.50", "0.25", "0.30", "1.50", "–"]


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ([], "no rows"),
        ([{"found_on": "cil"}], "no column 'controller'"),
        ([drive("a", "b", float("nan"))], "is nan"),
        ([drive(["a"], "b", 1.0)], r"found_on of the rows is \['a'\], expected text"),
        ([drive("a", "b", 1.0, method=["a"])], r"method of the rows is \['a'\], expected text"),
        ([drive("a", "b", 1.0, seed=[0])], r"seed of the rows is \[0\], expected a whole number"),
    ],
)
def test_rows_that_make_no_matrix_are_named(rows, message):
    with pytest.raises(StudyError, match=message):
        transfer_table(DataFrame(rows))


def test_one_source_of_patterns_is_not_the_worst_of_any():
    table = transfer_table(DataFrame([each for each in DRIVES if each["found_on"] == "cil"]))
    assert not any(cell.best for cell in table.rows[0][1:])
    assert "bold" not in table.note
