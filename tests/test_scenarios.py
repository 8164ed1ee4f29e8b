"""Scenarios as values and as files."""

import dataclasses
import math
from collections import Counter
from pathlib import Path

import pytest

from roadproof.datatypes import VehicleState
from roadproof.errors import OutputError, ScenarioError
from roadproof.geometry import CanvasPlacement
from roadproof.scenarios import Scenario, builtin_scenarios, find_scenario, load_scenarios, save_scenarios

START = VehicleState(1.5, -2.0, 0.0, 0.25, 3.0)
SCENARIO = Scenario(
    name="odd (name), ü 𠮷",
    kind="left",
    map_name="town",
    start=START,
    goal_m=(60.0, 1.0 / 3.0),
    canvas=CanvasPlacement(x_m=25.0, y_m=0.1, yaw_rad=-0.5, width_m=7.0),
    time_limit_s=40.0,
)
TEXT = """[[scenario]]
name = "one"
kind = "straight"
map_name = "town"
start = { x_m = 0, y_m = 0 }
goal_m = [50, 0]
canvas = { x_m = 20.0, y_m = 0.0 }
time_limit_s = 30
"""


def test_forty_are_built_in_as_in_the_paper() -> None:
    scenarios = builtin_scenarios()
    assert Counter(scenario.kind for scenario in scenarios) == {"straight": 16, "left": 12, "right": 12}
    assert len({scenario.name for scenario in scenarios}) == 40
    for scenario in scenarios:
        assert scenario.name.startswith(scenario.kind)
        assert scenario.canvas.length_m == 9.5
        assert 6.0 <= scenario.canvas.width_m <= 7.6
        away = math.dist((scenario.canvas.x_m, scenario.canvas.y_m), (scenario.start.x_m, scenario.start.y_m))
        assert 10.0 < away < 40.0


def test_what_is_saved_is_loaded_to_the_last_bit(tmp_path: Path) -> None:
    many = [SCENARIO, dataclasses.replace(SCENARIO, name="two", map_name=str(tmp_path / "my map.xodr"))]
    save_scenarios(many, tmp_path / "list.toml")
    assert list(load_scenarios(tmp_path / "list.toml")) == many
    assert sorted(path.name for path in tmp_path.iterdir()) == ["list.toml"]


def test_what_a_file_leaves_out_has_the_usual_values(tmp_path: Path) -> None:
    path = tmp_path / "list.toml"
    path.write_text(TEXT)
    (scenario,) = load_scenarios(path)
    assert scenario.start == VehicleState(0.0, 0.0, 0.0, 0.0, 0.0)
    assert scenario.canvas == CanvasPlacement(x_m=20.0, y_m=0.0)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('kind = "straight"', 'kind = "up"', "entry 1: kind is 'up'"),
        ('kind = "straight"', "kind = 3", "entry 1: kind is 3, expected str, got int"),
        ("time_limit_s = 30", "time_limit = 30", "unknown key 'time_limit'; did you mean 'time_limit_s'?"),
        ("time_limit_s = 30", "", "entry 1 lacks time_limit_s"),
        ("time_limit_s = 30", "time_limit_s = 0", "time_limit_s is 0.0, expected more than 0"),
        ("time_limit_s = 30", "time_limit_s = nan", "time_limit_s is nan, expected a finite number"),
        ("time_limit_s = 30", "time_limit_s = 1" + 400 * "0", "an integer has more than 20 digits"),
        ("x_m = 20.0", "x_m = nan", "canvas x_m is nan, expected a finite number"),
        ("start = { x_m = 0, y_m = 0 }", "start = { x_m = nan, y_m = 0 }", "start x_m is nan, expected a finite"),
        ("start = { x_m = 0, y_m = 0 }", "start = { x_m = 2e9, y_m = 0 }", "start x_m is 2000000000.0, expected"),
        ("x_m = 20.0", "x_m = 1e400", "canvas x_m is inf, expected a finite number below 1e9"),
        ("time_limit_s = 30", "time_limit_s = " + 5000 * "[", "not valid TOML"),
        (
            "time_limit_s = 30",
            "time_limit_s = 0x" + 5000 * "f",
            "an integer has more than 20 digits",
        ),
        ("time_limit_s = 30", "time_limit_s = true", "time_limit_s is True, expected float, got bool"),
        ("goal_m = [50, 0]", "goal_m = [50]", "goal_m is [50], expected array of length 2, got 1"),
        ("goal_m = [50, 0]", "goal_m = [0.5, 0]", "less than 1 m from the start"),
        ("start = { x_m = 0, y_m = 0 }", "start = { x_m = 0 }", "entry 1: start lacks y_m"),
        ("start = { x_m = 0, y_m = 0 }", "start = { x_m = 0, y_m = 0, speed_mps = -1 }", "expected 0 to 100"),
        ("start = { x_m = 0, y_m = 0 }", "start = 7", "start is 7, expected table, got int"),
        ("x_m = 20.0, y_m = 0.0", "x_m = 20.0, y_m = 0.0, width_m = -2", "canvas is -2.0 m"),
        ('map_name = "town"', 'map_name = "../town.xodr"', "is not a plain name"),
        ("[[scenario]]", "[scenario]", "no [[scenario]]"),
        ("[[scenario]]", "[[scenaro]]\nname = 'two'\n[[scenario]]", "an unknown key 'scenaro'"),
        ("goal_m", "goal_m =", "not valid TOML"),
    ],
)
def test_bad_entries_are_named_in_one_line(tmp_path: Path, old: str, new: str, said: str) -> None:
    path = tmp_path / "list.toml"
    assert old in TEXT
    path.write_text(TEXT.replace(old, new))
    with pytest.raises(ScenarioError) as error:
        load_scenarios(path)
    assert said in str(error.value)
    assert "\n" not in str(error.value)


def test_names_are_used_once(tmp_path: Path) -> None:
    path = tmp_path / "list.toml"
    path.write_text(TEXT + TEXT)
    with pytest.raises(ScenarioError, match="'one' is used twice"):
        load_scenarios(path)


def test_an_unknown_name_is_answered_with_the_nearest() -> None:
    assert find_scenario("left-03").kind == "left"
    with pytest.raises(ScenarioError, match="no scenario is called 'left3'; did you mean 'left-0"):
        find_scenario("left3")


def test_lists_that_cannot_be_read_or_written_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ScenarioError, match="cannot read"):
        load_scenarios(tmp_path / "missing.toml")
    (tmp_path / "file").touch()
    with pytest.raises(OutputError, match="cannot write"):
        save_scenarios([SCENARIO], tmp_path / "file" / "list.toml")
    elsewhere = dataclasses.replace(SCENARIO, map_name="/elsewhere/map.xodr")
    with pytest.raises(ScenarioError, match="copy it there first"):
        save_scenarios([elsewhere], tmp_path / "list.toml")
