"""The commands with controllers that do everything wrong: one line, before anything is driven."""

import dataclasses

import pytest

import bad_drivers
import needs
from command import roadproof
from recorded_drives import drivable_set
from roadproof.recordings import save_recordings
from roadproof.scenarios import find_scenario, save_scenarios


@pytest.fixture(scope="module")
def workplace(tmp_path_factory):
    folder = tmp_path_factory.mktemp("workplace")
    save_recordings(drivable_set(), folder / "set")
    left = find_scenario("left-03")
    save_scenarios([dataclasses.replace(left, name="short", time_limit_s=0.4)], folder / "own.toml")
    return folder


@pytest.fixture
def here(workplace, monkeypatch):
    monkeypatch.chdir(workplace)
    return workplace


def one_line(code, printed):
    assert code == 2
    assert printed.err.startswith("roadproof: ")
    assert printed.err.count("\n") == 1, printed.err
    return printed.err


STEERS = sorted(bad_drivers.STEERS)
DRIVES = [*(f"raises.{name}" for name in bad_drivers.ACT_RAISES), *(f"acts.{name}" for name in bad_drivers.ACTS)]


@pytest.mark.parametrize("name", STEERS)
def test_attack_refuses_a_wrong_answer_before_it_searches(here, tmp_path, invoke, name):
    given = ["set", "--controller", f"bad_drivers:steers.{name}", "--out", tmp_path / "out"]
    assert "the controller's steer" in one_line(*invoke("attack", *given))
    assert not list((tmp_path / "out").glob("*"))


@pytest.mark.parametrize("name", DRIVES)
def test_what_fails_in_a_predicted_drive_is_one_line(here, tmp_path, invoke, name):
    given = ["--simulator", "recorded:set", "--controller", f"bad_drivers:{name}", "--out", tmp_path / "out"]
    said = one_line(*invoke("drive", *given))
    assert "the controller's act" in said
    assert "acts" in name or "bad_drivers.py:" in said


@pytest.mark.parametrize("name", [*DRIVES, *(f"steers.{each}" for each in STEERS)])
def test_check_controller_says_it_check_by_check(here, invoke, name):
    code, printed = invoke("check-controller", f"bad_drivers:{name}", "--no-drive")
    assert code == 1, printed.err
    assert "BAD " in printed.out
    assert printed.err == ""


def test_check_controller_does_not_drive_what_cannot(here, invoke):
    code, printed = invoke("check-controller", "bad_drivers:acts.tuple", "--scenarios", "own.toml", "--processes", 1)
    assert code == 1
    assert "BAD drives: the controller's act answered a tuple" in printed.out
    assert printed.err == "not driven: act does not answer as a drive needs it\n"


def test_a_demo_is_refused_before_any_drive(here, tmp_path, invoke):
    needs.town()
    out = tmp_path / "out"
    for spec, message in (
        ("bad_drivers:acts.tuple", "act answered a tuple"),
        ("bad_drivers:steers.detached", "without a gradient"),
        ("bad_drivers:InPlace", "the gradient of the controller's steer raised RuntimeError"),
    ):
        given = ["--scenarios", "own.toml", "--scenario", "short", "--controller", spec, "--out", out]
        assert message in one_line(*invoke("demo", *given))
        assert not (out / "record").exists()


@pytest.mark.parametrize("spec", ["fails", "leaves", "nothing", "SIZES"])
def test_a_factory_that_fails_is_one_line_in_every_verb(here, tmp_path, invoke, spec):
    out = tmp_path / "out"
    for words in (
        ["check-controller", f"bad_drivers:{spec}"],
        ["attack", "set", "--controller", f"bad_drivers:{spec}", "--out", out],
        ["demo", "--controller", f"bad_drivers:{spec}", "--out", out],
        ["drive", "--simulator", "recorded:set", "--controller", f"bad_drivers:{spec}", "--out", out],
    ):
        assert f"bad_drivers:{spec}" in one_line(*invoke(*words))


def test_debug_shows_the_whole_traceback(here, invoke):
    code, printed = invoke("--debug", "check-controller", "bad_drivers:fails")
    assert code == 2
    assert "Traceback (most recent call last)" in printed.err
    assert "return 1 / 0" in printed.err
    assert printed.err.splitlines()[-1].startswith("roadproof: bad_drivers:fails raised ZeroDivisionError at ")


def test_a_fault_of_ours_does_not_end_as_a_check_that_failed(invoke, monkeypatch):
    def full(*_, **__):
        raise MemoryError("no memory left")

    monkeypatch.setattr("roadproof.controllers.load_controller", full)
    code, printed = invoke("check-controller", "pilotnet")
    assert (code, printed.out) == (2, "")
    assert "Traceback (most recent call last)" in printed.err
    last = printed.err.splitlines()[-1]
    assert last.startswith("roadproof: MemoryError: no memory left; that is a fault of roadproof, or of this machine")


HASTY = "from roadproof import cli, foreign; foreign.NOTICE_S = 0.3; cli.LIMIT_S = 1.0"


@pytest.mark.parametrize(("name", "how"), [("Hanging", "was ended"), ("Deaf", "; ended")])
def test_an_act_that_hangs_is_told_and_ended(workplace, tmp_path, name, how):
    hasty = f"{HASTY}; foreign.GRACE_S = 0.5"
    given = ["--simulator", "recorded:set", "--controller", f"bad_drivers:{name}", "--out", tmp_path / "out"]
    done = roadproof("drive", *given, folder=workplace, before=hasty)
    assert done.returncode == 2, done.stderr
    told = done.stderr.splitlines()
    assert told[0].startswith("the controller's act has not answered for ")
    assert "bad_drivers.py:" in told[0]
    assert told[-1].startswith("roadproof: the controller's act has not answered for ")
    assert how in told[-1]
    assert len(told) <= 4


def test_an_import_that_hangs_is_told_and_ended(tmp_path):
    (tmp_path / "own_endless.py").write_text("import time\nwhile True:\n    time.sleep(0.01)\n")
    done = roadproof("check-controller", "own_endless:make", folder=tmp_path, before=HASTY)
    assert done.returncode == 2, done.stderr
    assert "the import of own_endless has not answered" in done.stderr
    assert "own_endless.py:3" in done.stderr
    assert "Traceback" not in done.stderr
