"""The map with the scenarios: a picture that shows what it should."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from roadproof.errors import OutputError, ScenarioError
from roadproof.report.scenario_map import COLOURS, draw_scenarios
from roadproof.roads.maps import load_map
from roadproof.scenarios import builtin_scenarios


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


def test_what_cannot_be_drawn_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ScenarioError, match="no scenario to draw"):
        draw_scenarios([], load_map("town"), tmp_path / "map.png")
    with pytest.raises(ScenarioError, match="straight-01"):
        draw_scenarios(builtin_scenarios(), load_map("second"), tmp_path / "map.png")
    with pytest.raises(OutputError, match=r"cannot be drawn to .*map\.picture"):
        draw_scenarios(builtin_scenarios(), load_map("town"), tmp_path / "map.picture")
