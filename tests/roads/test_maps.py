"""The built-in scenarios on their map, and what does not fit a map."""

import contextlib
import dataclasses
import importlib.util
import math
import sys
from pathlib import Path

import numpy as np
import pytest

from carla_serving import straight_map
from roadproof.datatypes import Command
from roadproof.errors import ScenarioError
from roadproof.geometry import CanvasPlacement
from roadproof.roads.maps import builtin_map_file, canvas_points, check_canvas, load_map, scenario_route
from roadproof.scenarios import BUILTIN_FILE, Scenario, builtin_scenarios, find_scenario, load_scenarios, save_scenarios

SCENARIOS = builtin_scenarios()


@pytest.mark.parametrize("scenario", SCENARIOS, ids=lambda scenario: scenario.name)
def test_every_built_in_scenario_is_what_its_kind_says(scenario: Scenario) -> None:
    road_map = load_map(scenario.map_name)
    route = scenario_route(scenario, road_map)
    assert 38.0 < route.length_m < 110.0
    canvas = route.locate(scenario.canvas.x_m, scenario.canvas.y_m)
    assert 12.0 < canvas.arclength_m < 42.0
    assert route.length_m - canvas.arclength_m > 10.0
    *_, heading_rad = route.at(canvas.arclength_m)
    assert math.remainder(scenario.canvas.yaw_rad - heading_rad, 2 * math.pi) == pytest.approx(0.0, abs=0.1)
    begin = road_map.nearest_lane(scenario.start.x_m, scenario.start.y_m, scenario.start.yaw_rad)
    assert abs(begin.lateral_m) < 0.05
    assert abs(begin.heading_error_rad) < 0.05
    assert road_map.lanes[begin.lane].junction is None
    # From just before the canvas on, the road turns the way the kind says.
    after = route.headings_rad[route.arclengths_m > canvas.arclength_m - 8.0]
    turn = after - after[0]
    if scenario.kind == "straight":
        assert np.abs(route.headings_rad - route.headings_rad[0]).max() < 0.02
        assert set(route.commands.tolist()) <= {int(Command.FOLLOW), int(Command.STRAIGHT)}
    else:
        sign = 1.0 if scenario.kind == "left" else -1.0
        assert (sign * turn).max() > math.radians(35)


def test_canvases_lie_on_stretches_of_their_own() -> None:
    places = np.array([[scenario.canvas.x_m, scenario.canvas.y_m] for scenario in SCENARIOS])
    apart = np.linalg.norm(places[:, None] - places[None], axis=2)
    yaws = np.array([scenario.canvas.yaw_rad for scenario in SCENARIOS])
    opposite = np.cos(yaws[:, None] - yaws[None]) < -0.5
    same = (apart < 5.0) & ~opposite & ~np.eye(len(SCENARIOS), dtype=bool)
    assert not same.any()


def test_canvas_points_reach_its_corners() -> None:
    canvas = find_scenario("straight-02", SCENARIOS).canvas
    points = canvas_points(canvas)
    assert np.ptp(points[:, 0]) == pytest.approx(canvas.length_m)
    assert np.ptp(points[:, 1]) == pytest.approx(canvas.width_m)
    np.testing.assert_allclose(points.mean(axis=0), [canvas.x_m, canvas.y_m], atol=1e-9)


def test_the_committed_list_is_what_the_script_writes(tmp_path: Path) -> None:
    path = Path(__file__).parents[2] / "tools" / "make_scenarios.py"
    spec = importlib.util.spec_from_file_location("make_scenarios", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["make_scenarios"] = module
    spec.loader.exec_module(module)
    save_scenarios(module.all_scenarios(), tmp_path / "list.toml")
    assert (tmp_path / "list.toml").read_text() == BUILTIN_FILE.read_text()


def test_scenarios_that_do_not_fit_are_refused() -> None:
    road_map = load_map("town")
    good = find_scenario("straight-02", SCENARIOS)
    for changes, said in [
        (
            {"canvas": dataclasses.replace(good.canvas, y_m=1.0)},
            "straight-02: the canvas .* off the road at .* sidewalk",
        ),
        ({"canvas": dataclasses.replace(good.canvas, y_m=40.0)}, "no pavement"),
        ({"canvas": dataclasses.replace(good.canvas, z_m=0.5)}, "z_m 0.50, but the road under it is 0.00 m high"),
        ({"canvas": dataclasses.replace(good.canvas, x_m=60.0)}, "not on the way from start to goal"),
        ({"goal_m": (150.0, 40.0)}, "goal .* from the nearest driving lane"),
        ({"start": dataclasses.replace(good.start, yaw_rad=math.pi / 2)}, "start .* is not along a driving lane"),
        ({"start": dataclasses.replace(good.start, z_m=3.0)}, "start .* z_m 3.00, but the road there is 0.00 m high"),
        ({"start": dataclasses.replace(good.start, y_m=-20.0)}, "start .* is not along a driving lane"),
    ]:
        with pytest.raises(ScenarioError, match=said) as error:
            scenario_route(dataclasses.replace(good, **changes), road_map)
        assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("elevation", "z_m", "fits"),
    [
        ('a="3" b="0"', 3.0, True),
        ('a="3" b="0"', 0.0, False),
        ('a="3" b="0.01"', 3.4, True),
        ('a="0" b="0.05"', 2.0, False),
    ],
    ids=["level", "below", "slight slope", "slope"],
)
def test_a_canvas_lies_on_its_road_and_not_above_or_below_it(
    tmp_path: Path, elevation: str, z_m: float, fits: bool
) -> None:
    path = straight_map(tmp_path)
    path.write_text(path.read_text().replace('<elevation s="0" a="0" b="0"', f'<elevation s="0" {elevation}'))
    canvas = CanvasPlacement(x_m=40.0, y_m=0.0, z_m=z_m, width_m=6.0, length_m=9.5)
    with contextlib.nullcontext() if fits else pytest.raises(ScenarioError, match=f"z_m {z_m:.2f}, but the road under"):
        check_canvas(canvas, load_map(str(path)))


def test_a_map_that_is_edited_is_read_again(tmp_path: Path) -> None:
    path = tmp_path / "map.xodr"
    path.write_text(builtin_map_file("town").read_text())
    first = load_map(str(path))
    assert load_map(str(path)) is first
    path.write_text(builtin_map_file("second").read_text())
    assert len(load_map(str(path)).lanes) != len(first.lanes)


def test_unknown_maps_are_refused() -> None:
    with pytest.raises(ScenarioError, match=r"no map 'Town01', expected town, second or the path"):
        load_map("Town01")
    with pytest.raises(ScenarioError, match="cannot be read"):
        load_map("/missing/map.xodr")


def test_the_example_of_the_docs_is_valid(tmp_path: Path) -> None:
    text = (Path(__file__).parents[2] / "docs" / "scenarios.md").read_text(encoding="utf-8")
    path = tmp_path / "list.toml"
    path.write_text(text.split("```toml\n")[1].split("```")[0], encoding="utf-8")
    (scenario,) = load_scenarios(path)
    assert 70.0 < scenario_route(scenario, load_map(scenario.map_name)).length_m < 80.0
