"""`roadproof record`, `calibrate` and `attack` one after another, as their users call them."""

import html
import json
import shlex
import shutil
import textwrap

import pytest

import needs
from command import answered, stored
from roadproof.cli import verbs
from roadproof.drives import Drives
from roadproof.io import commands
from roadproof.pipeline.selection import Selection
from roadproof.recordings import load_recordings
from roadproof.report.run import read_run

needs.town()

CONTROLLER = textwrap.dedent(
    """
    import torch
    from roadproof.datatypes import Control

    class Bright:
        input_size = (88, 200)

        def steer(self, frames, speed_mps, command):
            return frames[..., :100].mean((1, 2, 3)) - frames[..., 100:].mean((1, 2, 3))

        def act(self, frame, speed_mps, command):
            return Control(0.0, throttle=0.7)
    """
)
RECORD = ["record", "straight-04", "--budget", "steering", "--trajectories", "1", "--frames", "3", "--out", "runs"]


@pytest.fixture(scope="module")
def workplace(tmp_path_factory):
    folder = tmp_path_factory.mktemp("workplace")
    (folder / "own_bright.py").write_text(CONTROLLER)
    return folder


@pytest.fixture
def call(workplace, invoke, monkeypatch):
    monkeypatch.chdir(workplace)

    def run(*options, code=0):
        left, said = invoke(*options)
        assert left == code, said.err
        return said.err if code else said.out

    return run


@pytest.fixture
def run(workplace, call):
    """The folder of a recorded and calibrated run; made by the first test that asks, resumed by the others."""
    call(*RECORD)
    call("calibrate", "runs", "--method", "pose")
    return workplace / "runs" / "straight-04"


def test_a_recorded_and_calibrated_run_is_attacked_as_it_is(run, call, workplace):
    attack = ["attack", "runs/straight-04/recordings", "--controller", "own_bright:Bright", "--groups", "all"]
    small = ["--figures", "1", "--iterations", "2", "--restarts", "1", "--random-patterns", "0", "--out", "out"]
    assert answered(call(*attack, *small, "--json")) == stored(workplace / "out" / "result.json")
    assert (workplace / "out" / "pattern.json").is_file()
    assert sorted(path.name for path in run.iterdir()) == ["calibration", "record", "recordings"]
    assert len(load_recordings(run / "recordings").recordings[0].frames) == 3
    assert json.loads((run / "calibration" / "report.json").read_text())["calls"] == 3


def test_what_an_attack_found_is_driven_over_and_the_strongest_is_kept(run, call, tmp_path):
    place = shutil.copytree(run, tmp_path / "driven")
    bright = ["--controller", "own_bright:Bright"]
    select = ["select", place, *bright, "--best", "2"]
    assert f"{place}/attack holds no attack; make it with: roadproof attack" in call(*select, code=2)
    assert "--best is 0, expected 1 to 1,000" in call(*select[:-1], "0", code=2)
    small = ["--groups", "all", "--figures", "1", "--iterations", "1", "--restarts", "2", "--random-patterns", "0"]
    call("attack", place / "recordings", *bright, *small, "--out", place / "attack")
    said = call(*select)
    assert f"3 drives; the strongest is {place}/pattern.json" in said
    selection = Selection.load(place / "selection")
    deviations = [each.trial.deviation_m for each in selection.driven]
    assert selection.deviation_m == max(deviations)
    assert said.splitlines()[selection.chosen].endswith("kept")
    chosen = place / "attack" / "candidates" / f"{selection.driven[selection.chosen].rank}.json"
    assert (place / "pattern.json").read_text() == chosen.read_text()
    before = {path: path.stat().st_mtime_ns for path in (place / "selection").rglob("*.npz")}
    (place / "prediction.npz").write_bytes(b"")
    assert call(*select) == said
    assert (place / "prediction.npz").exists()
    (place / "pattern.json").write_text("{}")
    assert call(*select) == said
    assert not (place / "prediction.npz").exists(), "it was of another pattern"
    assert all("steering shift " in line for line in said.splitlines()[:2])
    assert answered(call(*select, "--json")) == stored(place / "selection" / "selection.json")
    assert {path: path.stat().st_mtime_ns for path in (place / "selection").rglob("*.npz")} == before
    assert "holds a choice with candidates 2, now it is 1" in call(*select[:-1], "1", code=2)
    call("report", place)
    commands = read_run(place).commands
    assert commands[0] == shlex.join(["roadproof", *RECORD])
    assert commands[1] == "roadproof calibrate runs --method pose"
    assert commands[3:] == (shlex.join(["roadproof", *map(str, select)]), f"roadproof report {place}")
    page = (place / "report.html").read_text(encoding="utf-8")
    assert all(html.escape(each, quote=False) in page for each in commands)


def test_a_kept_command_does_not_say_where_a_server_stood_or_how_much_was_said(tmp_path, monkeypatch):
    words = ("roadproof", "evaluate", "a b.json", "--simulator", "carla://10.0.0.7:2001?paint=native", "--json")
    monkeypatch.setattr(verbs, "words_given", lambda: words)
    verbs.keep_command(tmp_path)
    line = (tmp_path / commands.FILE).read_text()
    assert line == "roadproof evaluate 'a b.json' --simulator 'carla://HOST:PORT?paint=native'\n"
    monkeypatch.setattr(verbs, "words_given", lambda: ("roadproof", "evaluate", "--simulator=carla://10.0.0.7:2001"))
    verbs.keep_command(tmp_path / "other")
    assert (tmp_path / "other" / commands.FILE).read_text() == "roadproof evaluate --simulator=carla://HOST:PORT\n"


def test_a_second_call_goes_on_where_the_first_ended(run, call):
    before = {path: path.stat().st_mtime_ns for path in run.rglob("*") if path.is_file()}
    assert "1 drives" in call(*RECORD)
    assert "3 simulator calls" in call("calibrate", "runs", "--method", "pose")
    (recorded,) = answered(call(*RECORD, "--json"))["runs"]
    drives = recorded.pop("drives")
    assert recorded == {"folder": "runs/straight-04", **stored(run / "record" / "record.json")}
    assert [(drive["name"], drive["frames"], drive["offset_right_m"]) for drive in drives] == [("clean", 3, 0.0)]
    (calibrated,) = answered(call("calibrate", "runs", "--method", "pose", "--json"))["runs"]
    assert calibrated == {"folder": "runs/straight-04", **stored(run / "calibration" / "report.json")}
    assert {path: path.stat().st_mtime_ns for path in run.rglob("*") if path.is_file()} == before


def test_what_has_been_calibrated_is_not_mixed_with_another_method(run, call):
    said = call("calibrate", "runs", "--method", "published", code=2)
    assert "holds a calibration with method 'pose', now it is 'published'; choose another folder, or remove it" in said


def test_a_scenario_that_is_a_link_out_of_the_folder_is_not_followed(call, workplace):
    (workplace / "linked").mkdir()
    (workplace / "elsewhere").mkdir()
    (workplace / "linked" / "straight-04").symlink_to(workplace / "elsewhere")
    assert "leads out of linked" in call(*RECORD[:-1], "linked", code=2)
    assert not any((workplace / "elsewhere").iterdir())


def test_a_recording_is_not_mixed_with_another(run, call):
    said = call(*RECORD, "--weather", "rainy-noon", code=2)
    assert "holds a recording with weather 'clear-noon', now it is 'rainy-noon'" in said
    assert Drives.load(run / "record").settings.weather == "clear-noon"


MISTAKES = {
    "unknown scenario": (["record", "left-3"], "did you mean 'left-03'?"),
    "unknown weather": (["record", "left-03", "--weather", "dry"], "--weather is 'dry'"),
    "unknown scheme": (["record", "left-03", "--scheme", "grup"], "did you mean group?"),
    "two ways": (["record", "left-03", "--noise-deg", "1", "2", "--swerve-m", "1"], "choose one way"),
    "published swerves": (
        ["record", "left-03", "--budget", "published", "--swerve-m", "1"],
        "--swerve-m is given",
    ),
    "published, few frames": (
        ["record", "left-03", "--budget", "published", "--frames", "8"],
        "--frames is given",
    ),
    "even T": (["record", "left-03", "--trajectories", "2"], "T is 2 trajectories"),
    "no run": (["calibrate", "."], "holds no run with a folder named record"),
    "unknown method": (["calibrate", "runs", "--method", "two-paints"], "did you mean two-paint?"),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_a_mistake_is_one_clear_line(call, name):
    options, message = MISTAKES[name]
    said = call(*options, code=2)
    assert message in said
    assert said.count("\n") == 1
