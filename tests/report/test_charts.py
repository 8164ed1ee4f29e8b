"""Charts take their colours from the page, and are drawn where things are."""

import re
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from matplotlib.figure import Figure

from recorded_drives import drivable_set
from roadproof.datatypes import Ending
from roadproof.driving.deviation import beside_m, path_of
from roadproof.driving.intervals import Estimate
from roadproof.patterns import raster
from roadproof.pipeline.fidelity import Agreement, Fidelity
from roadproof.report import charts
from roadproof.report.formatting import mean_in_words
from roadproof.report.page import _compared
from roadproof.report.plots import save
from roadproof.report.top_view import top_view
from roadproof.scenarios import find_scenario
from runs import CRASH, PATTERN, driven

AGREEMENT = Agreement(
    frames=1, paint_error=0.0, elsewhere_error=0.0, steer_error=0.0, predicted_shift=0.0, rendered_shift=0.0
)
SCENARIO = find_scenario("straight-01")


@pytest.fixture(scope="module")
def drives():
    return driven(SCENARIO), driven(SCENARIO, 1.0, events=CRASH, painted=True)


def test_metres_are_counted_from_the_canvas_near_edge(drives):
    clean, canvas = drives[0], SCENARIO.canvas
    metres = charts.metres_past(path_of(clean), canvas)
    ahead = np.array([np.cos(canvas.yaw_rad), np.sin(canvas.yaw_rad)])
    along = (path_of(clean) - (canvas.x_m, canvas.y_m)) @ ahead + canvas.length_m / 2
    near = np.abs(along) < 5.0
    assert near.sum() > 20
    # The driven positions are 0.35 m apart, so the nearest to the middle is off by half of that at most.
    np.testing.assert_allclose(metres[near], along[near], atol=0.2)


def test_composites_are_drawn_where_they_were_recorded_wherever_the_shown_drive_begins(drives):
    recordings = drivable_set()
    recorded = recordings.clean
    frames, steer = np.zeros((len(recorded.frames), 2, 3, 3), np.uint8), np.zeros(len(recorded.frames))
    fidelity = Fidelity(
        drive=recorded.name, frame_number=recorded.frame_number, clean=frames, composited=frames, rendered=frames,
        clean_steer=steer, composited_steer=steer, rendered_steer=steer, agreement=AGREEMENT,
    )  # fmt: skip
    at_m, told = _compared(fidelity, recordings, recordings.canvas)
    assert told is fidelity
    rows = recorded.track.rows(recorded.frame_number)
    ahead = np.array([np.cos(recordings.canvas.yaw_rad), np.sin(recordings.canvas.yaw_rad)])
    away = np.stack([recorded.track.x_m, recorded.track.y_m], 1)[rows] - (recordings.canvas.x_m, recordings.canvas.y_m)
    np.testing.assert_allclose(at_m, away @ ahead + recordings.canvas.length_m / 2, atol=0.5)
    chart = charts.steering(*drives, SCENARIO.canvas, compared=(at_m, told))
    assert "composites along the recorded path" in chart.caption
    assert _compared(fidelity, None, recordings.canvas) is None


def test_a_chart_has_no_colour_of_its_own_and_the_page_has_all_it_asks_for(drives):
    drawn = [
        charts.offsets([("clear-noon", *drives)], SCENARIO.canvas),
        charts.steering(*drives, SCENARIO.canvas),
        charts.search(np.zeros((5, 2, 3)), ["clean+right", "clean+left"], "path deviation, m", driven=False),
    ]
    for chart in drawn:
        assert not re.search(r"#0101", chart.svg)
        asked = set(re.findall(r"var\(--([\w-]+)\)", chart.svg))
        assert asked <= {*charts.VARIABLES, "sans"}
        assert {"muted", "sans"} <= asked
        assert "<script" not in chart.svg
        assert not re.search(r'<svg[^>]* (width|height)="', chart.svg), "as wide as the page allows"


def test_lines_of_many_runs_look_different_and_all_are_in_the_legend(drives):
    names = ["_before", "run-2", "c", "d", "e", "f", "g", "h"]
    chart = charts.offsets([(name, *drives) for name in names], SCENARIO.canvas)
    assert {"_before", "run-2"} <= {text.strip() for text in re.findall(r"<text[^>]*>([^<]*)</text>", chart.svg)}
    looks = re.findall(r'style="fill: none; (stroke[^"]*stroke-width: 1\.8[^"]*)"', chart.svg)
    assert len(set(looks)) == len(names)


def test_dollars_in_names_are_no_mathematics(tmp_path):
    name = r"$\foo$ of $x"
    chart = charts.search(np.zeros((5, 1, 3)), [name], "path deviation, m", driven=True)
    assert r"$\foo$ of $x" in chart.svg
    figure = Figure()
    figure.add_subplot().set_title(name)
    save(figure, tmp_path / "titled.png")
    assert (tmp_path / "titled.png").exists()


def test_the_view_from_above_numbers_the_infractions(drives):
    chart = top_view(SCENARIO, raster(PATTERN), *drives)
    assert "2 numbered events" in chart.caption
    words = re.findall(r"<text[^>]*>([^<]*)</text>", chart.svg)
    assert {"1", "2", "5 m"} <= set(words)


def test_marks_lie_on_the_lines_that_they_move_along(drives):
    steps = np.arange(len(drives[1]) // 3, len(drives[1]) // 2, 5)
    for chart, name in (
        (charts.offsets([("clear-noon", *drives)], SCENARIO.canvas, steps), "painted"),
        (charts.steering(*drives, SCENARIO.canvas, steps), "painted"),
        (top_view(SCENARIO, raster(PATTERN), *drives, steps=steps), "clean"),
    ):
        marks = re.findall(rf'<circle class="at m(\d+) {name}" r="5" cx="([\d.]+)" cy="([\d.]+)"/>', chart.svg)
        assert [int(k) for k, _, _ in marks] == list(range(len(steps)))
        drawn = re.findall(r' d="M ([^"z]*)"', chart.svg)
        lines = [np.array(re.findall(r"(-?[\d.]+) (-?[\d.]+)", each), float) for each in drawn]
        # A straight stretch has few vertices.
        on_lines = [np.linspace(*ends, 300) for line in lines for ends in pairwise(line)]
        for _, x, y in marks:
            off = min(np.hypot(*(points - (float(x), float(y))).T).min() for points in on_lines)
            assert off < 2.0


def test_beyond_the_end_of_a_clean_drive_that_was_blocked_no_offset_is_drawn(drives):
    clean, painted = drives
    count = len(clean) // 2
    sides = {name: getattr(clean, name)[: count - 1] for name in ("steer", "throttle", "brake")}
    names = ("time_s", "x_m", "y_m", "z_m", "yaw_rad", "speed_mps", "command")
    blocked = replace(clean, ending=Ending.BLOCKED, **sides, **{name: getattr(clean, name)[:count] for name in names})
    known = len(beside_m(blocked, painted))
    assert count < known < len(painted) // 1.5
    steps = np.array([known - 1, len(painted) - 1])
    chart = charts.offsets([("clear-noon", blocked, painted)], SCENARIO.canvas, steps)
    marks = re.findall(r'<circle class="at m\d painted" r="5" (cx="[\d.]+" cy="[\d.]+")/>', chart.svg)
    assert len(set(marks)) == 1 and len(marks) == 2


def test_marks_beyond_the_axes_are_left_out(drives):
    steps = np.array([len(drives[1]) // 2, len(drives[1]) - 1])
    assert charts.metres_past(path_of(drives[1]), SCENARIO.canvas)[-1] > SCENARIO.canvas.length_m + charts.BEHIND_M
    chart = charts.steering(*drives, SCENARIO.canvas, steps)
    assert set(re.findall(r'class="at (m\d)', chart.svg)) == {"m0"}


def test_the_same_drives_give_the_same_chart(drives):
    one, two = (top_view(SCENARIO, raster(PATTERN), *drives) for _ in range(2))
    assert one == two


def test_means_are_written_with_half_their_interval():
    assert mean_in_words(Estimate(1.333, 1.1, 1.566, 10), 2) == "1.33 ± 0.23"
    assert mean_in_words(Estimate(2.0, None, None, 1), 1) == "2.0"
    assert mean_in_words(None, 1) == "–"
