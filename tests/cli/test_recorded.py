"""The commands that drive in recordings, as their users call them."""

import dataclasses
import json
import sys

import pytest

from command import answered, roadproof, stored
from paint_shy import magenta
from recorded_drives import drivable_set
from roadproof.attacks import AttackResult, Cheapest
from roadproof.attacks.cheapest import Level
from roadproof.datatypes import Weather
from roadproof.driving.episode import Episode
from roadproof.driving.evaluation import Evaluation
from roadproof.patterns import save_pattern
from roadproof.pipeline.worlds import recorded_in
from roadproof.recordings import save_recordings
from roadproof.report.page import write_report
from runs import write_attack
from team_folder import write_recorded, write_team

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


def test_a_predicted_drive_says_so_to_programs(workplace, tmp_path, invoke, monkeypatch):
    monkeypatch.chdir(workplace)
    where = ["--simulator", "recorded:run", "--controller", "paint_shy:paint_shy", "--out", tmp_path]
    code, printed = invoke("drive", *where, "--json")
    assert code == 0, printed.err
    told, episode = answered(printed.out), Episode.load(tmp_path / "episode.npz")
    assert (told["kind"], told["paint"], told["ending"]) == ("predicted", "composited", episode.ending)
    assert told["x_m"] == episode.x_m.tolist()


def test_the_least_paint_stands_beside_the_strongest(workplace, tmp_path, invoke, monkeypatch):
    def least(_drives, _attacked, found, wanted_m, **_how):
        told = {"group": found.group, "wanted_m": wanted_m, "predicted_m": 0.06, "levels": (Level(8.0, 1, 0.06),)}
        return Cheapest(pattern=found.pattern, conspicuousness=found.conspicuousness, **told)

    monkeypatch.setattr(sys.modules["roadproof.attacks.cheapest"], "cheapest", least)
    quick = [
        "--objective",
        "steering",
        "--method",
        "random",
        "--calls",
        "1",
        "--random-patterns",
        "0",
        "--figures",
        "1",
    ]
    shy = ["--controller", "paint_shy:paint_shy", "--cheapest", "0.05", "--out", tmp_path]
    code, printed = invoke("attack", workplace / "run" / "recordings", *shy, *quick, "--json")
    assert code == 0, printed.err
    told = answered(printed.out)
    assert told.pop("cheapest") == stored(tmp_path / "cheapest" / "cheapest.json")
    assert told == stored(tmp_path / "result.json")
    # It is not looked for twice, and what was found for one deviation is none for another.
    monkeypatch.setattr(sys.modules["roadproof.attacks.cheapest"], "cheapest", lambda *_, **_how: None)
    code, printed = invoke("attack", workplace / "run" / "recordings", *shy, *quick, "--json")
    assert code == 0, printed.err
    assert answered(printed.out)["cheapest"] == stored(tmp_path / "cheapest" / "cheapest.json")
    shy[shy.index("0.05")] = "0.07"
    code, printed = invoke("attack", workplace / "run" / "recordings", *shy, *quick)
    assert code == 2
    assert "holds a search with wanted_m 0.05, now it is 0.07" in printed.err
    shy[-1] = tmp_path / "none"
    code, printed = invoke("attack", workplace / "run" / "recordings", *shy, *quick, "--json")
    assert code == 0, printed.err
    assert answered(printed.out)["cheapest"] is None
    (none,) = (tmp_path / "none" / "cheapest").iterdir()
    said = json.loads(none.read_text())
    none.write_text(json.dumps({name: said[name] for name in ("format", "version")}))
    code, printed = invoke("attack", workplace / "run" / "recordings", *shy, *quick, "--json")
    assert (code, json.loads(none.read_text())) == (0, said), "what does not say what it is of is searched again"


def test_the_least_paint_needs_gradients_whatever_the_method(workplace, tmp_path, invoke):
    without = ["--controller", "bad_drivers:InPlace", "--method", "random", "--cheapest", "0.05"]
    code, printed = invoke("attack", workplace / "run" / "recordings", *without, "--out", tmp_path / "out")
    assert (code, printed.out) == (2, "")
    assert "gradient" in printed.err
    assert not (tmp_path / "out").exists()


def test_what_limits_cost_is_told_of_a_search_alone(workplace, tmp_path, invoke, monkeypatch):
    monkeypatch.chdir(workplace)
    quick = ["--method", "random", "--calls", "2", "--random-patterns", "0", "--figures", "1", "--max-area", "2"]
    asked = ["attack", "run/recordings", "--controller", "paint_shy:paint_shy", *quick, "--contrast", "0", "0.3"]
    code, printed = invoke(*asked, "--limit-costs", "--out", tmp_path / "attack", "--json")
    assert code == 0, printed.err
    told = answered(printed.out)["limits"]
    assert told == stored(tmp_path / "attack" / "limits" / "limits.json")
    assert [each["without"] for each in told["searches"]] == ["", "area", "contrast", "any"]
    assert {each["driven_m"] for each in told["searches"]} == {None}
    first, area = told["searches"][:2]
    more_m = area["predicted_m"] - first["predicted_m"]
    assert f"Without the limit on area: predicted {area['predicted_m']:.2f} m, {more_m:+.2f} m\n" in printed.err
    code, printed = invoke("report", tmp_path)
    assert code == 0, printed.err
    page = (tmp_path / "report.html").read_text()
    assert "What each limit on paint costs" in page
    assert "Cost,<br>driven m" not in page, "nobody has driven"


def test_what_a_search_predicted_is_said_in_metres(tmp_path, invoke):
    write_recorded(tmp_path)
    write_attack(tmp_path / "attack")
    found = AttackResult.load(tmp_path / "attack")
    seen = dataclasses.replace(found.candidates[0], predicted_m=1.25, predicted_range_m=(1.0, 1.5))
    dataclasses.replace(found, candidates=(seen,)).save(tmp_path / "attack")
    where = ["--simulator", f"recorded:{tmp_path}", "--controller", "team_folder:magenta_shy"]
    code, printed = invoke("select", tmp_path, *where)
    assert code == 0, printed.err
    assert printed.out.startswith("   1 clean+left   predicted 1.25 m, predicted drive: deviation ")
    page = write_report(tmp_path).read_text()
    assert "Predicted once more" in page
    assert "Verified by driving" not in page


def test_what_a_search_for_the_speed_predicted_is_said_in_metres_a_second(tmp_path, invoke):
    write_recorded(tmp_path)
    write_attack(tmp_path / "attack")
    found = AttackResult.load(tmp_path / "attack")
    seen = dataclasses.replace(found.candidates[0], group="slower", predicted_mps=-1.25)
    dataclasses.replace(found, candidates=(seen,)).save(tmp_path / "attack")
    where = ["--simulator", f"recorded:{tmp_path}", "--controller", "team_folder:magenta_shy"]
    code, printed = invoke("select", tmp_path, *where)
    assert code == 0, printed.err
    assert printed.out.startswith("   1 slower       predicted 1.25 m/s slower, predicted drive: ")
    trial = stored(tmp_path / "selection" / "selection.json")["driven"][0]["trial"]
    assert f"predicted drive: {abs(trial['speed_change_mps']):.2f} m/s " in printed.out
    assert "by speed change" in printed.out


SPEED = ["--objective", "speed", "--figures", "1", "--random-patterns", "0"]


def test_the_command_searches_what_changes_the_speed(workplace, tmp_path, invoke, monkeypatch):
    monkeypatch.chdir(workplace)
    brakes = ["--controller", "paint_shy:brake_shy", "--out", tmp_path, "--method", "random", "--calls", "2"]
    code, printed = invoke("attack", "run/recordings", *SPEED, *brakes, "--groups", "slower")
    assert code == 0, printed.err
    assert "Strongest for slower: " in printed.out
    assert "Best of each group (speed change, predicted m/s): slower" in printed.out
    found = stored(tmp_path / "result.json")
    assert (found["objective"], found["group"], found["predicted_m"]) == ("speed change", "slower", None)
    assert f"{abs(found['predicted_mps']):.2f} m/s " in printed.out
    options = ["--simulator", "recorded:run", "--no-film", "--starts", "0"]
    code, printed = invoke("evaluate", tmp_path / "pattern.json", *options, *brakes[:2], "--out", tmp_path / "judged")
    assert code == 0, printed.err
    (trial,) = stored(tmp_path / "judged" / "evaluation.json")["trials"]
    assert f"{trial['speed_change_mps']:.2f}" in printed.out


EVALUATE = ["evaluate", "pattern.json", "--controller", "pilotnet", "--simulator", "recorded:run"]
ATTACK = ["attack", "run/recordings", "--controller"]
MISTAKES = {
    "speed without pedals": ([*ATTACK, "paint_shy:paint_shy", *SPEED], "the controller only steers"),
    "speed, dry run": ([*ATTACK, "paint_shy:paint_shy", *SPEED, "--dry-run"], "the controller only steers"),
    "speed to a side": ([*ATTACK, "pilotnet", *SPEED, "--groups", "clean+right"], "knows no group clean+right"),
    "cheapest in m/s": (
        [*ATTACK, "pilotnet", *SPEED, "--cheapest", "0.5"],
        "in metres of deviation, --objective",
    ),
    "limit costs without limits": (
        [*ATTACK, "pilotnet", "--limit-costs"],
        "no limit on paint; give one",
    ),
    "limit costs in m/s": (
        [*ATTACK, "pilotnet", *SPEED, "--limit-costs", "--max-area", "4"],
        "in metres of deviation",
    ),
    "runs": ([*EVALUATE, "--runs", "2"], "--runs is 2, but recordings hold no others"),
    "cars": ([*EVALUATE, "--cars", "50"], "--cars is 50, but recordings hold no others"),
    "renders": ([*EVALUATE, "--recordings", "run/recordings"], "nothing is rendered in recordings"),
    "another scenario": ([*EVALUATE, "--scenario", "left-03"], "the scenario's canvas has y_m"),
    "no folder": ([*EVALUATE[:-1], "recorded:"], "expected the folder of recordings"),
    "missing set": ([*EVALUATE[:-1], "recorded:nobody"], "nobody has no recordings.json"),
    "missing set, dry run": ([*EVALUATE[:-1], "recorded:nobody", "--dry-run"], "nobody has no recordings.json"),
    "another weather": (
        [*EVALUATE, "--weathers", "rainy-noon", "--dry-run"],
        "--weathers has rainy-noon, but the recordings have the light of clear-noon",
    ),
    "no canvas": ([*EVALUATE[:-1], "recorded:nowhere-known"], "canvas"),
    "expert": (["drive", "--simulator", "recorded:run"], "the expert needs a map"),
    "traffic": (
        ["drive", "--simulator", "recorded:run", "--controller", "pilotnet", "--cars", "3"],
        "recordings hold no others",
    ),
    "recording": (["record", "left-03", "--simulator", "recorded:run"], "evaluate, select and drive alone"),
}


def test_recordings_are_the_same_however_their_path_is_spelled(tmp_path, monkeypatch):
    write_team(tmp_path)
    run = tmp_path / "recordings" / "test-road"
    found = recorded_in(f"recorded:{run}")
    assert found.scenario is not None
    (tmp_path / "link").symlink_to(run / "recordings")
    assert recorded_in(f"recorded:{tmp_path / 'link'}") == found
    monkeypatch.chdir(run / "recordings")
    assert recorded_in("recorded:.") == recorded_in("recorded:..") == found


@pytest.mark.parametrize("said", ["rainy-noon", ""])
def test_a_set_alone_has_the_weather_that_it_states(tmp_path, said):
    made = drivable_set()
    drives = tuple(dataclasses.replace(each, weather=said) for each in made.recordings)
    save_recordings(dataclasses.replace(made, recordings=drives), tmp_path / "set")
    assert recorded_in(f"recorded:{tmp_path / 'set'}").weather == (said or "clear-noon")


@pytest.mark.parametrize("name", MISTAKES)
def test_a_mistake_is_one_clear_line(workplace, tmp_path, invoke, monkeypatch, name):
    words, message = MISTAKES[name]
    monkeypatch.chdir(workplace)
    code, said = invoke(*words, "--out", tmp_path / "out")
    assert code == 2
    assert message in said.err
    assert said.err.count("\n") == 1
