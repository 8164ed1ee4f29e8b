"""The commands that drive in recordings, as their users call them."""

import dataclasses

import pytest

from command import roadproof
from paint_shy import magenta
from recorded_drives import drivable_set
from roadproof.datatypes import Weather
from roadproof.driving.episode import Episode
from roadproof.driving.evaluation import Evaluation
from roadproof.patterns import save_pattern
from roadproof.recordings import save_recordings

BAR = magenta(300.0)


@pytest.fixture(scope="module")
def workplace(tmp_path_factory):
    recordings = drivable_set(speed_mps=12.0)
    folder = tmp_path_factory.mktemp("workplace")
    save_recordings(recordings, folder / "run" / "recordings")
    save_recordings(dataclasses.replace(recordings, canvas=None), folder / "nowhere-known")
    save_pattern(BAR, folder / "pattern.json")
    return folder


def test_the_command_evaluates_in_a_set_alone(workplace, tmp_path):
    options = ["--simulator", "recorded:run", "--controller", "paint_shy:paint_shy", "--no-film", "--quiet"]
    done = roadproof("evaluate", "pattern.json", *options, "--out", tmp_path, folder=workplace)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    for words in ("nothing was driven for real", "predicted", "not known", "10 predicted drives", "paint composited"):
        assert words in done.stdout
    evaluation = Evaluation.load(tmp_path)
    assert (evaluation.scenario.name, evaluation.weathers, evaluation.runs) == ("test-road", (Weather.CLEAR_NOON,), 0)


def test_the_command_drives_in_recordings_and_films_it(workplace, tmp_path):
    """Given their own folder, and not the run's."""
    av = pytest.importorskip("av", reason="films need the extra roadproof[video]")
    options = [
        "--simulator",
        "recorded:run/recordings",
        "--controller",
        "paint_shy:paint_shy",
        "--pattern",
        "pattern.json",
    ]
    done = roadproof("drive", *options, "--out", tmp_path, folder=workplace)
    assert done.returncode == 0, done.stderr
    assert "predicted: nothing was driven for real, and infractions are not known" in done.stdout
    with av.open(str(tmp_path / "drive.mp4")) as film:
        assert sum(1 for _ in film.decode(video=0)) == len(Episode.load(tmp_path / "episode.npz"))


EVALUATE = ["evaluate", "pattern.json", "--controller", "pilotnet", "--simulator", "recorded:run"]
MISTAKES = {
    "runs": ([*EVALUATE, "--runs", "2"], "--runs is 2, but recordings hold no others"),
    "renders": ([*EVALUATE, "--recordings", "run/recordings"], "nothing is rendered in recordings"),
    "another scenario": ([*EVALUATE, "--scenario", "left-03"], "the scenario's canvas has y_m"),
    "no folder": ([*EVALUATE[:-1], "recorded:"], "expected the folder of recordings"),
    "missing set": ([*EVALUATE[:-1], "recorded:nobody"], "no folder nobody"),
    "no canvas": ([*EVALUATE[:-1], "recorded:nowhere-known"], "canvas"),
    "expert": (["drive", "--simulator", "recorded:run"], "the expert needs a map"),
    "traffic": (
        ["drive", "--simulator", "recorded:run", "--controller", "pilotnet", "--cars", "3"],
        "recordings hold no others",
    ),
    "recording": (["record", "left-03", "--simulator", "recorded:run"], "evaluate, select and drive alone"),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_a_mistake_is_one_clear_line(workplace, tmp_path, invoke, monkeypatch, name):
    words, message = MISTAKES[name]
    monkeypatch.chdir(workplace)
    code, said = invoke(*words, "--out", tmp_path / "out")
    assert code == 2
    assert message in said.err
    assert said.err.count("\n") == 1
