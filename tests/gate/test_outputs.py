"""What a check leaves for others, whatever names are in it."""

import xml.etree.ElementTree as ET

import numpy as np
import pytest
from PIL import Image

from roadproof.datatypes import Weather
from roadproof.driving.starts import NOMINAL
from roadproof.errors import EpisodeError
from roadproof.gate.outputs import SHOWN_PX, WORST_COLUMNS, rows_of, write_junit, write_summary, write_worst
from roadproof.gate.result import Case, CheckResult, JudgedDrive
from roadproof.gate.verdict import Kind, Status, share_95
from roadproof.pipeline.film import Strip


def result(*, controller="pilotnet", name="magenta", yes=1, count=6):
    """A check of one case that fails."""
    drive = JudgedDrive(seed=0, start=NOMINAL, wrong="1.00 m to the left, timeout", clean="a", painted="b", paint="c")
    case = Case(
        scenario="left-03",
        weather=Weather.CLEAR_NOON,
        kind=Kind.STORED,
        name=name,
        conditions="",
        measures={"left_lane": share_95(yes, count)},
        status=Status.FAILED,
        reasons=("above the limit",),
        command=f"roadproof evaluate {name}.json --controller {controller}",
        drives=(drive,),
    )
    return CheckResult(
        roadproof="0.1.0", controller=controller, architecture="A", budget="smoke", compared=False, cases=(case,)
    )


def test_one_drive_of_many_does_not_read_as_none():
    assert rows_of(result(yes=1, count=300))[0][4] == "0.3% (0.0–1.8)"
    assert rows_of(result(yes=299, count=300))[0][4] == "99.7% (98.2–100.0)"
    assert rows_of(result(yes=0, count=6))[0][4] == "0% (0–46)"


@pytest.mark.parametrize(
    ("controller", "name", "in_text"),
    [
        ("w/<img src=x onerror=alert(1)>.safetensors", "[x](y)", r"\[x\](y)"),
        ("a|b&amp;*c*", "`x`\n```\n# y", r"\`x\`\\n\`\`\`\\n\# y"),
        ("bell\x07", "one\x01", r"one\\x01"),
        ("other\udcff", "half\ud800", r"half\\ud800"),
    ],
)
def test_names_are_shown_as_they_are_whatever_is_in_them(tmp_path, controller, name, in_text):
    told = result(controller=controller, name=name)
    write_summary(told, told.cases[0], tmp_path / "summary.md")
    text = (tmp_path / "summary.md").read_text(encoding="utf-8")
    shown, _, rest = text.partition("```sh\n")
    command, _, caption = rest.partition("\n```\n")
    assert command.startswith("roadproof evaluate ") and command.isprintable(), "the block ends where it should"
    for each in (shown, caption):
        assert in_text in each
        assert "<" not in each
    assert f"| {in_text} |" in shown
    assert f"### failed: left-03, clear-noon, {in_text}" in shown
    write_junit(told, 1.0, tmp_path / "junit.xml")
    suite = ET.parse(tmp_path / "junit.xml").getroot().find("testsuite")
    plain = "".join(mark if mark.isprintable() else repr(mark)[1:-1] for mark in name)
    assert suite.find("testcase").get("name") == f"clear-noon, {plain}"
    assert f"see it: roadproof evaluate {plain}.json" in suite.find("testcase/failure").text


@pytest.mark.parametrize(("level", "rows"), [(3, 120), (90, 80)])
def test_the_worst_drive_is_shown_without_what_was_not_recorded_however_dark_it_was(tmp_path, level, rows):
    pictures = np.zeros((6, 60, 80, 3), np.uint8)
    pictures[:, 20:] = level
    write_worst([pictures, pictures], tmp_path / "worst.jpg")
    with Image.open(tmp_path / "worst.jpg") as shown:
        assert shown.size == (SHOWN_PX, round(SHOWN_PX * rows / (80 * WORST_COLUMNS)))


@pytest.mark.parametrize(("count", "lateral_m"), [(0, 0.0), (3, np.nan), (3, np.inf)])
def test_a_strip_of_nothing_or_of_no_number_is_none(count, lateral_m):
    pictures = np.zeros((count, 60, 80, 3), np.uint8)
    with pytest.raises(EpisodeError, match=r"or none at all|are not finite"):
        Strip(time_s=np.arange(float(count)), lateral_m=np.full(count, lateral_m), clean=pictures, painted=pictures)
