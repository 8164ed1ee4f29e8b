"""Lane marks of a map on a canvas."""

from __future__ import annotations

import numpy as np
import pytest

from recorded_drives import drivable_set
from roadproof.geometry import CANVAS_SIZE_PX
from roadproof.recordings import load_recordings, save_recordings
from roadproof.roads.maps import load_map
from roadproof.roads.marks import marks_of, marks_on
from roadproof.scenarios import builtin_scenarios, find_scenario


@pytest.mark.parametrize("scenario", builtin_scenarios()[::5], ids=lambda each: each.name)
def test_marks_lie_on_the_maps_lines(scenario):
    roads, canvas = load_map(scenario.map_name), scenario.canvas
    lines = np.concatenate([line.points[:, :2] for line in roads.mark_lines if line.junction is None])
    for mark in marks_on(canvas, roads):
        points = np.array(mark.points_m) / [canvas.width_m, canvas.length_m] * CANVAS_SIZE_PX - 0.5
        world = (canvas.world_from_canvas @ np.column_stack([points, np.ones(len(points))]).T)[:2].T
        # Its ends and bends are points of a line itself.
        assert np.linalg.norm(world[:, None] - lines, axis=2).min(1).max() < 1e-3
        assert 0.05 < mark.width_m < 1.0


def test_a_straight_two_lane_road_has_its_middle_line_within_the_canvas():
    scenario = find_scenario("straight-02")
    marks = marks_on(scenario.canvas, load_map(scenario.map_name))
    middle = [m for m in marks if all(1.0 < x < scenario.canvas.width_m - 1.0 for x, _ in m.points_m)]
    assert len(marks) >= 2
    assert len(middle) == 1
    assert max(y for _, y in middle[0].points_m) > scenario.canvas.length_m


def test_what_has_no_map_has_no_marks():
    assert marks_of(object(), find_scenario("straight-02")) is None


def test_recordings_keep_their_marks(tmp_path):
    scenario = find_scenario("left-03")
    marks = marks_on(scenario.canvas, load_map(scenario.map_name))
    save_recordings(drivable_set(marks=marks), tmp_path / "with", compact=True)
    assert load_recordings(tmp_path / "with").marks == marks
    save_recordings(drivable_set(), tmp_path / "without", compact=True)
    assert load_recordings(tmp_path / "without").marks is None
