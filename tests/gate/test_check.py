"""Whole checks in the recorded world, with a controller that reacts to magenta paint alone."""

import json
import shutil
import xml.etree.ElementTree as ET
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image

import needs
import roadproof
from command import answered, stored
from roadproof.controllers import load_controller
from roadproof.datatypes import Control, Weather
from roadproof.driving.drive_store import Episodes
from roadproof.driving.evaluation import Evaluation
from roadproof.errors import CanvasNotReachedError, CheckError, PatternError, RecordingError
from roadproof.gate.check import run_check
from roadproof.gate.places import places_of
from roadproof.gate.plan import load_check
from roadproof.gate.result import CHECK_FILE
from roadproof.gate.stretch import Stretch, known_paints
from roadproof.gate.verdict import Kind, Status
from roadproof.paint import PaintLimits
from roadproof.paint.site import LaneMark, Site
from roadproof.patterns import raster
from team_folder import PLAN, MagentaShy, magenta_shy

CHANGE = '[change]\nreference = "reference"\ndeviation_m = { absolute = 0.1, relative = 0.2 }\n'


@pytest.fixture(scope="module")
def failed(team):
    """A check of the team's plan, which magenta paint fails."""
    out = team / "out"
    return out, run_check(load_check(team / "check.toml", trust=True), magenta_shy(), out)


def by_name(result):
    return {case.name: case for case in result.cases}


def test_the_pattern_that_moves_the_car_fails_and_no_other(failed):
    _, result = failed
    found = by_name(result)
    assert result.status is Status.FAILED
    assert {name: case.status for name, case in found.items()} == {
        "bare road": Status.PASSED,
        "green": Status.PASSED,
        "magenta": Status.FAILED,
    }
    assert found["green"].measures["deviation_m"].value == pytest.approx(0.0, abs=0.01)
    assert found["magenta"].measures["deviation_m"].low > 0.2
    assert [len(case.drives) for case in result.cases] == [6, 6, 6]
    assert len({each.start for each in found["magenta"].drives}) == 6


def test_measures_are_those_of_an_evaluation(failed, team, tmp_path, invoke, monkeypatch):
    """The command that is told gives the numbers that were told."""
    out, result = failed
    case = by_name(result)["magenta"]
    monkeypatch.chdir(team)
    words = case.command.replace(str(out / "show"), str(tmp_path)).split()[1:]
    code, said = invoke(*words, "--no-film")
    assert code == 0, said.err
    seed = int(words[words.index("--seed") + 1])
    shown = {trial.start: trial.deviation_m for trial in Evaluation.load(tmp_path).trials}
    assert shown == {each.start: each.deviation_m for each in case.drives if each.seed == seed}


def test_a_ci_reads_the_verdict_and_its_reason(failed):
    out, result = failed
    suite = ET.parse(out / "junit.xml").getroot().find("testsuite")
    assert (suite.get("tests"), suite.get("failures"), suite.get("errors")) == ("3", "1", "0")
    failures = {test.get("name"): test.find("failure") for test in suite.iter("testcase")}
    assert [name for name, failure in failures.items() if failure is not None] == ["clear-noon, magenta"]
    failure = failures["clear-noon, magenta"]
    assert "is above the limit of 0.20 m" in failure.get("message")
    assert by_name(result)["magenta"].command in failure.text


def test_people_read_a_table_and_see_the_worst_passage(failed):
    out, _ = failed
    text = (out / "summary.md").read_text()
    assert text.startswith("## roadproof check: failed: 2 of 3 cases passed")
    assert "### failed: test-road, clear-noon, magenta" in text
    assert "![Furthest astray of what does not pass, test-road, clear-noon, magenta" in text
    with Image.open(out / "worst.jpg") as picture:
        red, green, blue = np.moveaxis(np.asarray(picture.convert("RGB"), int), 2, 0)
    magenta = np.minimum(red, blue) - green > 100
    middle = len(magenta) // 2
    assert magenta.shape[1] == 1500
    assert not magenta[:middle].any()
    assert magenta[middle:].sum() > 1000


def test_the_same_seed_gives_the_same_bytes_and_drives_nothing_twice(failed, team, monkeypatch):
    out, _ = failed
    before = (out / "check.json").read_bytes()

    def forbidden(*_):
        raise AssertionError("driven again")

    monkeypatch.setattr("roadproof.driving.drive_store.rollout", forbidden)
    run_check(load_check(team / "check.toml", trust=True), magenta_shy(), out)
    assert (out / "check.json").read_bytes() == before


def test_an_interrupted_check_keeps_its_drives_and_leaves_no_verdict(failed, team, tmp_path, monkeypatch):
    out, result = failed
    for name in ("check.json", "summary.md"):
        shutil.copy(out / name, tmp_path / name)
    shutil.copytree(out / "drives", tmp_path / "drives")
    kept = sorted((tmp_path / "drives/test-road/episodes").iterdir())
    for path in kept[4:]:
        path.unlink()
    plan = load_check(team / "check.toml", trust=True)
    make, made = Episodes.make, []

    def until_the_third(episodes, simulator, drive):
        if len(made) == 3:
            raise KeyboardInterrupt
        made.append(drive)
        make(episodes, simulator, drive)

    monkeypatch.setattr(Episodes, "make", until_the_third)
    with pytest.raises(KeyboardInterrupt):
        run_check(plan, magenta_shy(), tmp_path)
    assert not any((tmp_path / name).exists() for name in ("check.json", "junit.xml", "summary.md", "worst.jpg"))
    assert len(list((tmp_path / "drives/test-road/episodes").iterdir())) == 7
    monkeypatch.setattr(Episodes, "make", make)
    again = run_check(plan, magenta_shy(), tmp_path)
    assert [(c.measures, c.status) for c in again.cases] == [(c.measures, c.status) for c in result.cases]


class Blind(MagentaShy):
    """Sees nothing, so no paint moves it; and drives into the verge."""

    def steer(self, frames, speed_mps, command):
        return 0.0 * frames.mean((1, 2, 3)) + 0.3


class Parked(MagentaShy):
    """Never drives off."""

    def act(self, frame, speed_mps, command):
        return Control(0.0, brake=1.0)


@pytest.mark.parametrize("controller", [Blind(), Parked()])
def test_who_does_not_drive_well_without_paint_does_not_pass(team, tmp_path, controller):
    result = run_check(load_check(team / "check.toml", trust=True), controller, tmp_path)
    assert result.status is Status.FAILED
    found = by_name(result)
    assert found["bare road"].status is Status.FAILED
    assert {found[name].status for name in ("green", "magenta")} == {Status.TOO_FEW}
    summary = (tmp_path / "summary.md").read_text()
    assert "![Not clean, test-road, clear-noon, bare road: one of these drives, from its start to its end]" in summary
    with Image.open(tmp_path / "worst.jpg") as picture:
        assert picture.width == 1500
        assert np.asarray(picture).std() > 10


def full_plan(team):
    """The team's plan with fresh attacks in a scenario of the town."""
    plan = PLAN.replace('scenario_file = "scenarios.toml"\n', "")
    plan = plan.replace('patterns = "patterns"\n', "").replace("test-road", "left-03")
    plan = plan.replace("[smoke]\nrecordings", "[full]\n# recordings")
    plan = plan.replace("stored = { deviation_m = 0.2, left_lane = 0.0 }", "fresh = { deviation_m = 0.5 }")
    (team / "full.toml").write_text(plan)
    return load_check(team / "full.toml", budget="full", trust=True)


def test_the_estimate_counts_all_looks_of_a_variation(team, tmp_path, invoke, monkeypatch):
    monkeypatch.setattr("roadproof.pipeline.workload.frame_seconds", lambda *_, **__: 0.01)
    monkeypatch.chdir(team)
    full_plan(team)
    seconds = []
    for more in ("", "[variation]\ndraws = 4\n"):
        (team / "varied.toml").write_text((team / "full.toml").read_text() + more)
        asked = ("check", "varied.toml", "--budget", "full", "--trust", "--out", tmp_path, "--dry-run", "--json")
        code, said = invoke(*map(str, asked))
        assert code == 0, said.err
        seconds.append(json.loads(said.out)["seconds"])
    assert seconds[1] > 2 * seconds[0]


def test_a_full_check_of_who_does_not_drive_well_fails_and_attacks_nothing(team, tmp_path):
    needs.town()
    result = run_check(full_plan(team), Blind(), tmp_path)
    assert [(case.kind, case.status) for case in result.cases] == [
        (Kind.BARE, Status.FAILED),
        (Kind.FRESH, Status.TOO_FEW),
        (Kind.FRESH, Status.TOO_FEW),
    ]
    assert not (tmp_path / "fresh").exists()
    assert "not-searched-0.json" in result.cases[1].command
    assert "on the bare road no drive went well in clear-noon" in result.cases[1].reasons[0]
    assert (tmp_path / "summary.md").exists() and (tmp_path / "junit.xml").exists()


def test_a_case_some_of_whose_bare_drives_fail_has_too_few_drives(team, tmp_path, monkeypatch):
    bare = Stretch.bare
    monkeypatch.setattr(
        Stretch, "bare", lambda *given: tuple(replace(each, wrong="off" * (not each.seed)) for each in bare(*given))
    )
    (team / "half.toml").write_text(PLAN + "bare = { failed = 1.0 }\n")
    result = run_check(load_check(team / "half.toml", trust=True), MagentaShy(gain=0.0), tmp_path)
    green = by_name(result)["green"]
    assert (green.status, len(green.drives)) == (Status.TOO_FEW, 3)
    assert "too few drives: 3 had no good drive on the bare road to compare with" in green.reasons
    assert by_name(result)["bare road"].status is Status.PASSED


class Scared(MagentaShy):
    """Drives as the recorded car did, and stops before paint."""

    def act(self, frame, speed_mps, command):
        shown = torch.as_tensor(frame).movedim(2, 0)[None] / 255
        if float(torch.minimum(shown[:, 0], shown[:, 2]).sub(shown[:, 1]).sub(0.5).clamp_min(0).mean()) > 0:
            return Control(0.0, brake=1.0)
        return super().act(frame, speed_mps, command)


def test_paint_that_stops_the_car_fails_though_it_keeps_its_lane(team, tmp_path):
    text = PLAN.replace("deviation_m = 0.2, left_lane = 0.0", "left_lane = 0.0")
    (team / "lane.toml").write_text(text)
    found = by_name(run_check(load_check(team / "lane.toml", trust=True), Scared(gain=0.0), tmp_path))
    assert {name: case.status for name, case in found.items()} == {
        "bare road": Status.PASSED,
        "green": Status.PASSED,
        "magenta": Status.FAILED,
    }
    assert max(abs(each.lateral_m) for each in found["magenta"].drives) < 0.1
    assert all(each.wrong.endswith("time limit") for each in found["magenta"].drives)


def test_what_cannot_be_driven_in_is_refused_before_anything_is_driven(team, tmp_path):
    own = tmp_path / "team"
    shutil.copytree(team, own)
    (own / "recordings/test-road/recordings/recordings.json").write_text("{")
    with pytest.raises(RecordingError, match=r"recordings\.json"):
        run_check(load_check(own / "check.toml", trust=True), MagentaShy(gain=0.0), tmp_path / "out")
    assert not (tmp_path / "out/drives/test-road/episodes").exists()


def test_a_check_of_fewer_patterns_leaves_none_of_those_before(team, tmp_path):
    text = PLAN.replace("random = 0", "random = 3").replace('patterns = "patterns"', "")
    for name, plan in (("random.toml", text), ("fewer.toml", text.replace("random = 3", "random = 2"))):
        (team / name).write_text(plan.replace("seeds = [0, 1]", "seeds = [0, 1, 2]") + "random = { left_lane = 1.0 }\n")
    run_check(load_check(team / "random.toml", trust=True), MagentaShy(gain=0.0), tmp_path)
    patterns = tmp_path / "patterns/test-road/clear-noon"
    for name in ("mine.json", "random-cars.json"):
        (patterns / name).write_text("mine")
    run_check(load_check(team / "fewer.toml", trust=True), MagentaShy(gain=0.0), tmp_path)
    assert sorted(path.name for path in patterns.glob("*.json")) == [
        "mine.json",
        *(f"random-{seed}-{k}.json" for seed in range(3) for k in (1, 2)),
        "random-cars.json",
    ]


def test_an_attack_that_cannot_be_made_is_a_case_with_its_reason(team, tmp_path, monkeypatch):
    needs.town()

    def never_seen(*_, **__):
        raise CanvasNotReachedError("drive clean of left-03 never sees 60 pixels of the canvas")

    monkeypatch.setattr("roadproof.gate.check.stress_test", never_seen)
    result = run_check(full_plan(team), load_controller("pilotnet"), tmp_path)
    assert [(case.kind, case.status) for case in result.cases] == [
        (Kind.BARE, Status.PASSED),
        (Kind.FRESH, Status.TOO_FEW),
        (Kind.FRESH, Status.TOO_FEW),
    ]
    assert result.cases[1].reasons == (
        "too few drives: no attack could be made: drive clean of left-03 never sees 60 pixels of the canvas",
    )
    assert "not-searched-0.json" in result.cases[1].command


def test_a_fresh_attack_of_an_edited_plan_has_a_folder_of_its_own(team, tmp_path, monkeypatch):
    needs.town()
    folders = list[str]()

    def noted(_world, _controller, _scenario, folder, **_):
        folders.append(folder.name)
        raise CanvasNotReachedError("noted")

    monkeypatch.setattr("roadproof.gate.check.stress_test", noted)
    plan, known = full_plan(team), load_controller("pilotnet")
    for each in (plan, plan, replace(plan, figures=4), replace(plan, paint=PaintLimits(max_area_m2=2.0))):
        run_check(each, known, tmp_path)
    first, again, fewer, limited = zip(folders[::2], folders[1::2], strict=True)
    assert first == again
    assert len({*first, *fewer, *limited}) == 6


def test_random_patterns_are_one_case(team, tmp_path):
    text = PLAN.replace("random = 0", "random = 3").replace('patterns = "patterns"', "")
    (team / "random.toml").write_text(text + "random = { left_lane = 1.0 }\n")
    result = run_check(load_check(team / "random.toml", trust=True), MagentaShy(gain=0.0), tmp_path)
    assert [case.kind for case in result.cases] == [Kind.BARE, Kind.RANDOM]
    drives = result.cases[1].drives
    assert len({each.paint for each in drives}) == len(drives) == 6
    assert result.status is Status.PASSED


@pytest.fixture(scope="module")
def accepted(team):
    """A plan with a reference, made from a controller that hardly minds."""
    (team / "change.toml").write_text(
        PLAN.replace("left_lane = 0.0 }", "left_lane = 1.0 }").replace("0.2, ", "9.0, ") + CHANGE
    )
    plan = load_check(team / "change.toml", trust=True)
    out = team / "accepted"
    assert run_check(plan, MagentaShy(gain=0.5), out, compare=False).status is Status.PASSED
    plan.reference.parent.mkdir(parents=True)
    shutil.copy(out / "check.json", plan.reference)
    return plan


def test_a_controller_worse_than_the_reference_fails(accepted, failed, tmp_path):
    # Drives that were made before are not made again.
    shutil.copytree(accepted.reference.parents[2] / "accepted/drives", tmp_path / "same/drives")
    same = run_check(accepted, MagentaShy(gain=0.5), tmp_path / "same")
    assert (same.status, same.compared) == (Status.PASSED, True)
    # A pattern that the reference lacks is judged by a limit, or not at all.
    fewer = CHECK_FILE.content(accepted.reference)
    fewer["cases"] = [case for case in fewer["cases"] if case["name"] != "magenta"]
    accepted.reference.with_name("fewer.json").write_text(json.dumps(fewer))
    added = replace(accepted, reference=accepted.reference.with_name("fewer.json"))
    assert run_check(added, MagentaShy(gain=0.5), tmp_path / "same").status is Status.PASSED
    unlimited = replace(added, limits={**added.limits, Kind.STORED: {}})
    (new,) = run_check(unlimited, MagentaShy(gain=0.5), tmp_path / "same").not_passed
    assert (new.name, new.reasons[0].partition(":")[0]) == ("magenta", "nothing judges it")
    shutil.copytree(failed[0] / "drives", tmp_path / "worse/drives")
    worse = run_check(accepted, magenta_shy(), tmp_path / "worse")
    assert [case.name for case in worse.not_passed] == ["magenta"]
    assert "in the reference: worse by more than 0.10 m and by more than 20%" in worse.not_passed[0].reasons[0]


@pytest.mark.parametrize(
    ("what", "other", "message"),
    [
        ("roadproof", "0.0.9", f"roadproof 0.0.9, this check has {roadproof.__version__}"),
        ("architecture", "CIL-1234", "a controller of architecture CIL-1234, this check has MagentaShy"),
        ("budget", "full", "budget full, this check has smoke"),
        ("cases", [], r"did not pass \(it has no case\)"),
    ],
)
def test_a_reference_of_something_else_is_refused(accepted, tmp_path, what, other, message):
    stored = CHECK_FILE.content(accepted.reference)
    path = tmp_path / "check.json"
    path.write_text(json.dumps(stored | {what: other}))
    with pytest.raises(CheckError, match=message):
        run_check(replace(accepted, reference=path), magenta_shy(), tmp_path / "out")
    assert not (tmp_path / "out" / "drives").exists()


def test_a_reference_that_did_not_pass_is_refused(accepted, tmp_path):
    stored = CHECK_FILE.content(accepted.reference)
    path = tmp_path / "check.json"
    path.write_text(json.dumps(stored | {"cases": [*stored["cases"][:2], stored["cases"][2] | {"status": "failed"}]}))
    with pytest.raises(CheckError, match=r"did not pass \(test-road, clear-noon, magenta: failed\)"):
        run_check(replace(accepted, reference=path), magenta_shy(), tmp_path / "out")


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({}, "has measured nothing for test-road, clear-noon, magenta, expected deviation_m and left_lane from 0 on"),
        ({"deviation_m": -5.0}, "has measured deviation_m -5, left_lane 1 for test-road, clear-noon, magenta"),
    ],
)
def test_a_reference_with_which_nothing_could_be_compared_is_refused(accepted, tmp_path, changed, message):
    stored = CHECK_FILE.content(accepted.reference)
    case = next(each for each in stored["cases"] if each["name"] == "magenta")
    measures = {name: case["measures"][name] | {"value": value} for name, value in changed.items()}
    case["measures"] = case["measures"] | measures if measures else {}
    path = tmp_path / "check.json"
    path.write_text(json.dumps(stored))
    with pytest.raises(CheckError, match=message):
        run_check(replace(accepted, reference=path), magenta_shy(), tmp_path / "out")
    assert not (tmp_path / "out" / "drives").exists()


def test_a_machine_that_rounds_otherwise_keeps_the_reference(accepted, team, tmp_path, monkeypatch):
    def rounded_otherwise(pattern):
        paint = raster(pattern)
        paint[0, 0, :3] ^= 1
        return paint

    text = (team / "change.toml").read_text().replace("random = 0", "random = 3")
    (team / "both.toml").write_text(text.replace("[limits]", "[limits]\nrandom = { left_lane = 1.0 }"))
    plan = load_check(team / "both.toml", trust=True)
    assert run_check(plan, MagentaShy(gain=0.5), tmp_path, compare=False).status is Status.PASSED
    plan = replace(plan, reference=tmp_path / "check.json")
    monkeypatch.setattr("roadproof.gate.check.raster", rounded_otherwise)
    assert run_check(plan, MagentaShy(gain=0.5), tmp_path / "out").status is Status.PASSED
    ((name, (stored, *others)),) = plan.stored.items()
    moved = replace(stored, pattern=stored.pattern.mapped(lambda values: values * 0.999))
    for other in (replace(plan, random=4), replace(plan, stored={name: (moved, *others)})):
        with pytest.raises(CheckError, match="other patterns, starts, seeds or recordings"):
            run_check(other, MagentaShy(gain=0.5), tmp_path / "out")


def test_a_reference_of_other_conditions_is_refused(accepted, tmp_path):
    with pytest.raises(CheckError, match="magenta, which the plan leaves out"):
        kept = {name: stored[:1] for name, stored in accepted.stored.items()}
        run_check(replace(accepted, stored=kept), magenta_shy(), tmp_path)
    with pytest.raises(CheckError, match="other patterns, starts, seeds or recordings"):
        run_check(replace(accepted, seeds=(0, 2)), magenta_shy(), tmp_path)
    with pytest.raises(CheckError, match="is not there; make it with --accept"):
        run_check(replace(accepted, reference=tmp_path / "check.json"), magenta_shy(), tmp_path / "out")
    accepted.reference.with_name("bad.json").write_text('{"format": "roadproof-check-result", "version": 1}')
    with pytest.raises(CheckError, match="incomplete or damaged"):
        run_check(replace(accepted, reference=accepted.reference.with_name("bad.json")), magenta_shy(), tmp_path)


def test_a_fresh_attack_in_another_weather_is_another_condition(team, tmp_path):
    plan = load_check(team / "check.toml", trust=True)
    with places_of(plan, "cpu")[0].factory() as world:
        drives = Episodes.of(world, magenta_shy(), plan.scenarios[0], {}, tmp_path)
    noon, rain = Weather.CLEAR_NOON, Weather.RAINY_NOON

    def known(*weathers, kind=Kind.FRESH):
        asked = replace(plan, weathers=weathers)
        stretch = Stretch(plan=asked, world=world, weathers=weathers, paints=(), episodes=drives)
        return [stretch.conditions(("test-road", weather, kind, ""), ()) for weather in (noon, rain)]

    noon_first, rain_first = known(noon, rain), known(rain, noon)
    assert not set(noon_first) & set(rain_first)
    assert known(noon) == noon_first
    assert known(noon, rain, kind=Kind.RANDOM) == known(rain, noon, kind=Kind.RANDOM)


def test_the_command_ends_with_0_1_or_2(failed, team, tmp_path, invoke, monkeypatch):
    monkeypatch.chdir(team)
    shutil.copytree(failed[0] / "drives", tmp_path / "drives")
    left = [tmp_path / name for name in ("check.json", "junit.xml", "summary.md", "worst.jpg")]
    command = ("check", "check.toml", "--trust", "--out", tmp_path)
    code, said = invoke(*command)
    assert (code, "roadproof: " in said.err) == (1, False)
    assert "failed: test-road, clear-noon, magenta" in said.out
    assert "see it: roadproof evaluate patterns/test-road/magenta.json --controller team_folder:magenta_shy" in said.out
    assert all(path.exists() for path in left)
    code, said = invoke(*command, "--json")
    assert code == 1
    assert answered(said.out) == stored(tmp_path / "check.json")
    assert "failed: test-road, clear-noon, magenta" in said.err
    # Nobody takes what a check before left for the result of one that could not be run.
    code, said = invoke(*command[:2], "--out", tmp_path)
    assert (code, said.out) == (2, "")
    assert "runs what its author wrote" in said.err
    assert not any(path.exists() for path in left)
    # What nobody's check has left is nobody's to take away.
    own = tmp_path / "own" / "summary.md"
    (own.parent / "drives" / "monday").mkdir(parents=True)
    own.write_text("mine")
    code, said = invoke(*command[:2], "--out", own.parent)
    assert (code, own.read_text()) == (2, "mine")
    assert "is no check's, without check.json or a check's drives beside it" in said.err
    code, said = invoke(*command, "--accept")
    assert code == 2
    assert "names none; add [change]" in said.err
    loose = PLAN.replace("deviation_m = 0.2, left_lane = 0.0", "deviation_m = 9.0") + CHANGE.replace(
        '"reference"', '"kept"'
    )
    (team / "loose.toml").write_text(loose)
    # What could not be kept at the end is not driven.
    (team / "kept").write_text("mine")
    code, said = invoke("check", "loose.toml", "--trust", "--out", tmp_path / "new", "--accept")
    assert (code, "cannot write" in said.err) == (2, True), said.err
    assert not (tmp_path / "new" / "drives").exists()
    (team / "kept").unlink()
    # Not even the first result, passed or not, is made where the references are.
    code, said = invoke("check", "loose.toml", "--trust", "--out", "kept/smoke", "--accept")
    assert (code, "kept for a reference" in said.err) == (2, True)
    # Nor where its patterns would be stored ones, which stay.
    (team / "drives" / "mine").mkdir(parents=True)
    (team / "drives" / "mine" / "film.mp4").write_text("mine")
    (team / "patterns" / "test-road" / "random-0-1.json").write_bytes(
        (team / "patterns" / "test-road" / "green.json").read_bytes()
    )
    for out in (".", "patterns/test-road", "patterns/test-road/out"):
        code, said = invoke("check", "loose.toml", "--trust", "--out", out)
        assert (code, "among the plan's patterns" in said.err) == (2, True), said.err
    assert (team / "drives" / "mine" / "film.mp4").read_text() == "mine"
    (team / "patterns" / "test-road" / "random-0-1.json").unlink()
    code, said = invoke("check", "loose.toml", "--trust", "--out", tmp_path, "--accept")
    assert code == 0, said.err
    assert (team / "kept/smoke/check.json").read_bytes() == (tmp_path / "check.json").read_bytes()
    code, said = invoke("check", "loose.toml", "--trust", "--out", tmp_path)
    assert code == 0
    assert "compared with the reference" in said.out
    # Nor where an option is wrong; and no reference is taken away, whatever else is wrong.
    code, said = invoke("check", "loose.toml", "--budget", "smok", "--out", tmp_path)
    assert (code, "did you mean smoke?" in said.err) == (2, True)
    assert not any(path.exists() for path in left)
    (team / "wrong.toml").write_text(loose.replace("version = 1", "version = 3"))
    for plan in ("loose.toml", "wrong.toml"):
        code, said = invoke("check", plan, "--trust", "--out", "kept/smoke")
        assert code == 2
        assert (
            "kept/smoke/check.json is kept for a reference of the plan; choose another folder for the results"
            in said.err
        )
        assert (team / "kept/smoke/check.json").exists()
    # Nor where the plan cannot say what it is: mistyped, unreadable, not there.
    (team / "typo.toml").write_text(loose.replace("[change]", "[chnage]"))
    (team / "broken.toml").write_text(loose.replace("version = 1", "version ="))
    for name, message in (
        ("typo.toml", "kept/smoke/check.json is no check's own, without summary.md beside it"),
        ("broken.toml", "not valid TOML"),
        ("gone.toml", "gone.toml"),
    ):
        code, said = invoke("check", name, "--trust", "--out", "kept/smoke")
        assert (code, message in said.err) == (2, True), said.err
        assert (team / "kept/smoke/check.json").exists()
    with pytest.raises(CheckError, match="is kept for a reference of the plan"):
        run_check(load_check("loose.toml", trust=True), magenta_shy(), "kept/smoke")


def test_a_pattern_that_paints_nothing_is_refused_before_anything_is_driven(team, tmp_path):
    plan = load_check(team / "check.toml", trust=True)
    (name, stored), *_ = plan.stored.items()
    thin = replace(stored[0].pattern, boxes=stored[0].pattern.boxes * torch.tensor([1, 1, 1e-6, 1, 1]))
    with pytest.raises(PatternError, match=f"test-road, {stored[0].path.name} paints nothing"):
        run_check(replace(plan, stored={name: (replace(stored[0], pattern=thin),)}), magenta_shy(), tmp_path / "out")
    assert not (tmp_path / "out" / "drives").exists()


def test_limits_that_leave_no_paint_are_refused_where_nothing_is_drawn_at_random_too(team, tmp_path):
    smoke = replace(load_check(team / "check.toml", trust=True), random=0, paint=PaintLimits(keep_out_m=10.0))
    line = LaneMark(points_m=((3.4, 0.0), (3.4, 9.5)), width_m=0.12, colour="#ffffff")
    given = (smoke.scenarios[0], Site(size_m=(6.8, 9.5), marks=(line,)), tmp_path)
    with pytest.raises(PatternError, match="a keep-out of 10 m around lane marks leaves no place"):
        known_paints(replace(smoke, budget="full"), *given)
    assert {each.kind for each in known_paints(smoke, *given)} == {Kind.STORED}, "there nothing is searched or drawn"
