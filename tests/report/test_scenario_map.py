"""The map with the scenarios: a picture that shows what it should."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from roadproof.errors import OutputError, ScenarioError
from roadproof.geometry import CanvasPlacement
from roadproof.report.road_view import on_asphalt
from roadproof.report.scenario_map import COLOURS, draw_scenarios
from roadproof.roads.maps import load_map
from roadproof.scenarios import builtin_scenarios, find_scenario


def count_of(path: Path, colour: str) -> int:
    wanted = np.array([int(colour[k : k + 2], 16) for k in (1, 3, 5)])
    with Image.open(path) as picture:
        pixels = np.asarray(picture.convert("RGB")).astype(int)
    return int((np.abs(pixels - wanted).max(axis=2) < 12).sum())


def test_all_scenarios_are_drawn_in_the_colour_of_their_kind(tmp_path: Path) -> None:
    draw_scenarios(builtin_scenarios(), load_map("town"), tmp_path / "map.png")
    for colour in COLOURS.values():
        assert count_of(tmp_path / "map.png", colour) > 1000
    assert [path.name for path in tmp_path.iterdir()] == ["map.png"]


def test_kinds_that_are_not_asked_for_are_not_drawn(tmp_path: Path) -> None:
    lefts = [scenario for scenario in builtin_scenarios() if scenario.kind == "left"]
    draw_scenarios(lefts, load_map("town"), tmp_path / "map.png")
    assert count_of(tmp_path / "map.png", COLOURS["left"]) > 1000
    assert count_of(tmp_path / "map.png", COLOURS["right"]) == 0


def test_a_long_name_neither_covers_its_start_nor_leaves_the_map(tmp_path: Path) -> None:
    left = find_scenario("left-03")
    assert left.start.x_m > load_map("town").bounds_m[2] - 5.0
    counts = []
    for name in ("left-03", "left-of-a-name-that-is-long"):
        draw_scenarios([replace(left, name=name)], load_map("town"), tmp_path / "map.png")
        with Image.open(tmp_path / "map.png") as picture:
            edge = np.asarray(picture.convert("RGB"))[:, -3:]
        assert len(np.unique(edge.reshape(-1, 3), axis=0)) == 1, "nothing is cut off"
        counts.append(count_of(tmp_path / "map.png", COLOURS["left"]))
    assert counts[1] > counts[0] + 200, "all of it is there"


def test_a_way_of_four_points_is_drawn(tmp_path: Path) -> None:
    scenario = find_scenario("straight-02")
    start, canvas = scenario.start, scenario.canvas
    goal = (start.x_m + 1.2 * math.cos(start.yaw_rad), start.y_m + 1.2 * math.sin(start.yaw_rad))
    middle = {"x_m": (start.x_m + goal[0]) / 2, "y_m": (start.y_m + goal[1]) / 2, "width_m": 2.0, "length_m": 0.5}
    short = replace(scenario, goal_m=goal, canvas=replace(canvas, **middle))
    draw_scenarios([short], load_map("town"), tmp_path / "map.png")
    assert (tmp_path / "map.png").exists()


def test_a_ribbon_of_paint_fills_no_memory() -> None:
    paint = np.zeros((8, 8, 4), np.uint8)
    for width_m, size in ((1e-5, (4, 400)), (2.0, (4, 8)), (9e8, (4, 1))):
        assert on_asphalt(paint, 4, CanvasPlacement(x_m=0.0, y_m=0.0, width_m=width_m, length_m=4.0)).size == size


def test_what_cannot_be_drawn_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ScenarioError, match="no scenario to draw"):
        draw_scenarios([], load_map("town"), tmp_path / "map.png")
    with pytest.raises(ScenarioError, match="straight-01"):
        draw_scenarios(builtin_scenarios(), load_map("second"), tmp_path / "map.png")
    for name in ("map.picture", "map.pgf", "map"):
        with pytest.raises(
            OutputError, match=rf"cannot be drawn to .*{name}, expected a name that ends in one of .png"
        ):
            draw_scenarios(builtin_scenarios(), load_map("town"), tmp_path / name)
