"""What a check leaves for others, whatever names are in it."""

from roadproof.datatypes import Weather
from roadproof.driving.starts import NOMINAL
from roadproof.gate.outputs import rows_of
from roadproof.gate.result import Case, CheckResult, JudgedDrive
from roadproof.gate.verdict import Kind, Status, share_95


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
