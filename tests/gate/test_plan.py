"""A check's plan: every mistake is told before work begins."""

import os
import shlex
from pathlib import Path

import pytest

from roadproof.datatypes import Weather
from roadproof.errors import CheckError
from roadproof.gate.plan import load_check
from roadproof.gate.verdict import Kind
from roadproof.patterns import save_pattern
from roadproof.scenarios import builtin_scenarios, save_scenarios
from team_folder import BAR, PLAN, write_team

EXAMPLE = Path(__file__).parents[2] / "examples" / "check" / "check.toml"


def test_the_plan_of_the_docs_is_the_example_and_can_be_followed(tmp_path):
    text = EXAMPLE.read_text(encoding="utf-8")
    assert f"```toml\n{text}```" in (EXAMPLE.parents[2] / "docs" / "check.md").read_text(encoding="utf-8")
    (tmp_path / "check.toml").write_text(text, encoding="utf-8")
    save_pattern(BAR, tmp_path / "patterns" / "bar.json")
    found = load_check(tmp_path / "check.toml", budget="full")
    assert len(found.keys) == 5 * 2 * 5
    assert found.reference == tmp_path / "reference" / "full" / "check.json"
    with pytest.raises(CheckError, match="no recording of left-03 at clear-noon") as refused:
        load_check(tmp_path / "check.toml")
    assert "--scenarios" not in str(refused.value)


def test_the_advice_for_a_missing_recording_names_the_file_of_scenarios(tmp_path):
    save_scenarios(builtin_scenarios(), tmp_path / "own.toml")
    text = EXAMPLE.read_text(encoding="utf-8").replace("# scenario_file", "scenario_file")
    (tmp_path / "check.toml").write_text(text, encoding="utf-8")
    save_pattern(BAR, tmp_path / "patterns" / "bar.json")
    with pytest.raises(CheckError) as refused:
        load_check(tmp_path / "check.toml")
    advice = str(refused.value).partition("make one with: ")[2]
    words = shlex.split(advice)
    assert words[:3] == ["roadproof", "record", "left-03"]
    assert words[words.index("--scenarios") :][:2] == ["--scenarios", str(tmp_path / "own.toml")]


def plan(team, text):
    path = team / "other.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_a_plan_is_read_with_all_that_it_names(team):
    found = load_check(team / "check.toml", trust=True)
    assert [each.name for each in found.stored["test-road"]] == ["green", "magenta"]
    assert found.recordings == {("test-road", Weather.CLEAR_NOON): team / "recordings" / "test-road"}
    assert found.limits[Kind.STORED] == {"deviation_m": 0.2, "left_lane": 0.0}
    assert found.limits[Kind.BARE] == {"failed": 0.0}
    assert [key[2:] for key in found.keys] == [
        (Kind.BARE, "bare road"),
        (Kind.STORED, "green"),
        (Kind.STORED, "magenta"),
    ]


def test_a_full_check_needs_no_recordings_and_adds_an_attack(team):
    text = PLAN.replace("[smoke]\nrecordings", "[full]\n# ") + "fresh = { deviation_m = 1.0 }\n"
    found = load_check(plan(team, text), budget="full", trust=True)
    assert found.keys[-2:] == tuple(
        ("test-road", Weather.CLEAR_NOON, Kind.FRESH, f"fresh attack, seed {seed}") for seed in (0, 1)
    ), "one for each pattern: drives over one say nothing of what the other finds"
    assert not found.recordings


def test_random_patterns_of_some_contrast_need_the_asphalt_before_anything_is_measured(team):
    text = PLAN.replace("random = 0", "random = 3").replace("[smoke]\nrecordings", "[full]\n# ")
    text += "random = { deviation_m = 1.0 }\nfresh = { deviation_m = 1.0 }\n\n[paint]\ncontrast = [0.0, 0.25]\n"
    with pytest.raises(CheckError, match="contrast needs the colour of the asphalt for random patterns in a full"):
        load_check(plan(team, text), budget="full", trust=True)
    for mended in (text + 'asphalt = "#5a5a5b"\n', text.replace("random = 3", "random = 0")):
        assert load_check(plan(team, mended), budget="full", trust=True).paint.contrast == (0.0, 0.25)


LIMITS = "stored = { deviation_m = 0.2, left_lane = 0.0 }"
CHANGE = '\n[change]\nreference = "reference"\n'
RANGE = "right_m = 0.05\nturned_rad = 0.004\nfaster_mps = 0.5"
SEEDED = "seeds = [0, 1]\n\n[starts]\ncount = 3\n"
MISTAKES = {
    "no header": (('format = "roadproof-check"', ""), 'expected format = "roadproof-check"'),
    "version": (("version = 1", "version = 3"), "version is 3, expected 1"),
    "version that is no number": (("version = 1", "version = true"), "version is True, expected 1"),
    "not TOML": (("version = 1", "version ="), "not valid TOML"),
    "unknown key": (("random = 0", "randon = 0"), "unknown key 'randon'; did you mean 'random'"),
    "unknown start": (("right_m = 0.05", "right = 0.05"), "unknown key 'right'; did you mean 'right_m'"),
    "unknown kind": ((LIMITS, "storred = { left_lane = 0.0 }"), "a key of limits is 'storred', expected one of bare"),
    "unknown measure": ((LIMITS, "stored = { left = 0.0 }"), "a key of limits.stored is 'left', expected one of"),
    "a measure of paint": ((LIMITS, "bare = { left_lane = 0.0 }"), "expected one of failed"),
    "a limit's type": ((LIMITS, 'stored = { left_lane = "0" }'), "expected float"),
    "a limit's range": (
        (LIMITS, "stored = { left_lane = 20.0 }"),
        "limits.stored.left_lane is 20.0, expected 0.0 to 1",
    ),
    "no number": ((LIMITS, "stored = { deviation_m = nan }"), "limits.stored.deviation_m is nan, expected"),
    "no limit": ((LIMITS, ""), "limits has nothing for stored patterns"),
    "a change of the bare road alone": (
        (LIMITS, CHANGE + "failed = { absolute = 0.0, relative = 0.0 }"),
        "limits has nothing for stored patterns",
    ),
    "too few for a median": (("count = 3", "count = 2"), "too few drives: 4 a case (starts × seeds) can never show"),
    "too few for a share": ((LIMITS, "stored = { left_lane = 0.05 }"), "left_lane at most 0.05 for stored"),
    "equal starts": ((RANGE, "right_m = 0.0\nturned_rad = 0.0\nfaster_mps = 0.0"), "starts has the scenario's own"),
    "starts equal but for rounding": (
        (RANGE, "right_m = 0.00001\nturned_rad = 0.0\nfaster_mps = 0.0"),
        "starts has the scenario's own",
    ),
    "two seeds with an equal start": (
        (SEEDED + RANGE, SEEDED.replace("1", "6") + "right_m = 0.001\nturned_rad = 0.0\nfaster_mps = 0.0"),
        "starts has 5 that differ among the 6 drawn",
    ),
    "start range": (("right_m = 0.05", "right_m = 3.0"), "right_m of the starts is 3.0, expected a number from 0 to 1"),
    "seed": (("seeds = [0, 1]", "seeds = [0, -1]"), "seeds is -1, expected a whole number from 0 to"),
    "seed twice": (("seeds = [0, 1]", "seeds = [1, 1]"), "seeds has 1 twice"),
    "no seed": (("seeds = [0, 1]", "seeds = []"), "seeds is empty"),
    "budget": (("version = 1", 'version = 1\nbudget = "huge"'), "budget is 'huge', expected one of smoke, full"),
    "simulator": (
        (LIMITS, LIMITS + '\n[full]\nsimulator = "moon"'),
        "simulator 'moon' is unknown, expected town, town:egl or carla://",
    ),
    "scenario": (('scenarios = ["test-road"]', 'scenarios = ["test-raod"]'), "did you mean 'test-road'"),
    "outside": (('scenario_file = "', 'scenario_file = "../'), "leaves the plan's folder"),
    "patterns outside": (
        ('patterns = "patterns"', 'patterns = "../out"'),
        "patterns '../out' leaves the plan's folder",
    ),
    "recordings outside": (('["recordings"]', '["recordings", "/"]'), "recordings '/' leaves the plan's folder"),
    "patterns": (('patterns = "patterns"', 'patterns = "nowhere"'), "patterns 'nowhere' is no folder"),
    "nothing painted": (('patterns = "patterns"', ""), "nothing would be painted there"),
    "no smoke": (('[smoke]\nrecordings = ["recordings"]', ""), "add [smoke] with recordings"),
    "no recordings": (('recordings = ["recordings"]', 'recordings = ["nowhere"]'), "roadproof record test-road"),
    "weather": (
        ('recordings = ["recordings"]', 'recordings = ["recordings"]\nweathers = ["rainy-noon"]'),
        "add 'recordings-rainy-noon' to recordings and make one with: roadproof record test-road --weather rainy-noon",
    ),
    "a reference without a name": (
        (LIMITS, LIMITS + CHANGE.replace('"reference"', '""') + "left_lane = { absolute = 0.1, relative = 0.0 }"),
        "change needs reference, a folder beside the plan",
    ),
    "an asphalt that is no colour": ((LIMITS, LIMITS + '\n[paint]\nasphalt = ""'), "paint: colour is '', expected #"),
    "change without a measure": ((LIMITS, LIMITS + CHANGE), "change needs reference"),
    "a change's key": (
        (LIMITS, LIMITS + CHANGE + "deviation_m = { absolut = 0.1, relative = 0.2 }"),
        "change.deviation_m has an unknown key 'absolut'; did you mean 'absolute'",
    ),
    "a change's range": (
        (LIMITS, LIMITS + CHANGE + "deviation_m = { absolute = -0.1, relative = 0.2 }"),
        "change.deviation_m.absolute is -0.1, expected",
    ),
    "half a change": ((LIMITS, LIMITS + CHANGE + "left_lane = { absolute = 0.1 }"), "change.left_lane lacks relative"),
}


def test_a_change_takes_as_many_drives_as_a_median(team):
    """One drive that keeps its lane is no worse than before, and shows nothing."""
    text = PLAN.replace(SEEDED, SEEDED.replace("3", "2")).replace(LIMITS, "stored = { left_lane = 0.0 }")
    load_check(plan(team, text), trust=True)
    compared = text + CHANGE + "left_lane = { absolute = 0.1, relative = 0.0 }\n"
    with pytest.raises(CheckError, match=r"4 a case .* can never show a change of left_lane for stored"):
        load_check(plan(team, compared), trust=True)


@pytest.mark.parametrize("name", MISTAKES)
def test_a_mistake_is_named(team, name):
    (old, new), message = MISTAKES[name]
    assert old in PLAN
    path = plan(team, PLAN.replace(old, new))
    with pytest.raises(CheckError) as told:
        load_check(path, trust=True)
    assert str(told.value).startswith(str(path))
    assert message in str(told.value)
    assert "\n" not in str(told.value)


def test_a_plan_in_a_folder_that_no_file_could_name_is_refused(tmp_path):
    folder = tmp_path / os.fsdecode(b"t\xe9am")
    try:
        write_team(folder)
    except OSError:
        pytest.skip("file names are UTF-8 here")
    with pytest.raises(CheckError, match="its path is not UTF-8"):
        load_check(folder / "check.toml", trust=True)


def test_code_and_other_machines_need_trust(team):
    with pytest.raises(CheckError, match="runs what its author wrote"):
        load_check(team / "check.toml")
    text = (
        PLAN.replace("team_folder:magenta_shy", "pilotnet")
        + 'fresh = { left_lane = 0.0 }\n[full]\nsimulator = "carla://far:2000"'
    )
    with pytest.raises(CheckError, match="another machine"):
        load_check(plan(team, text), budget="full")


def test_a_recording_that_is_not_calibrated_is_named_with_what_to_do(team):
    run = team / "recordings" / "test-road"
    (run / "recordings").rename(run / "elsewhere")
    with pytest.raises(CheckError, match=f"test-road is not calibrated; do so with: roadproof calibrate {run}"):
        load_check(plan(team, PLAN), trust=True)


def test_a_folder_of_patterns_is_named_after_a_scenario(team):
    (team / "patterns" / "tset-road").mkdir()
    try:
        with pytest.raises(CheckError, match="did you mean 'test-road'"):
            load_check(team / "check.toml", trust=True)
    finally:
        (team / "patterns" / "tset-road").rmdir()


def test_a_damaged_pattern_is_named(team):
    bad = team / "patterns" / "test-road" / "bad.json"
    bad.write_text("{}")
    try:
        with pytest.raises(CheckError, match=r"bad\.json"):
            load_check(team / "check.toml", trust=True)
    finally:
        bad.unlink()
