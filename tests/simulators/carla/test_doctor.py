"""The doctor and the scenario maker against `roadproof carla serve`."""

import math

import numpy as np
import pytest

import needs
from carla_serving import CAMERA, INPUT, free_port, serving
from command import roadproof

pytest.importorskip("carla", reason="CARLA's client is not installed: pip install 'roadproof[carla]'")
needs.town()
pytest.importorskip("msgpack", reason="serving needs the extra roadproof[carla]")
from roadproof.datatypes import VehicleState
from roadproof.errors import ScenarioError
from roadproof.roads.maps import load_map, scenario_route
from roadproof.scenarios import load_scenarios
from roadproof.simulators.carla.doctor import examine
from roadproof.simulators.carla.places import scenario_between, straight_stretch
from roadproof.simulators.carla.simulator import CarlaSimulator

ALL = [
    "connection",
    "map",
    "pictures",
    "speed",
    "repeatability",
    "road",
    "paint",
    "native paint",
    "traffic",
    "clean-up",
]

# A server whose depth camera is wrong by a tenth: paint would lie elsewhere.
WRONG_DEPTH = """
from roadproof.simulators.carla_server import sensors
right = sensors.depth_levels
sensors.depth_levels = lambda depth_m: right(1.1 * depth_m)
from roadproof.cli import main
main()
"""

# A server that shows a cloud more than asked for: the weather that was there never comes back.
CLOUDY = """
from roadproof.simulators.carla_server.world import World
obedient = World.set_weather
World.set_weather = lambda self, parameters: obedient(self, [parameters[0] + 1.0, *parameters[1:]])
from roadproof.cli import main
main()
"""


@pytest.mark.slow
def test_a_sound_server_is_found_sound(port):
    told = []
    findings = examine(CarlaSimulator(port=port, camera=CAMERA, input=INPUT), told.append)
    assert findings.passed, str(findings)
    assert [check.name for check in findings.checks] == ALL
    assert tuple(told) == findings.checks
    assert "native: squares are seen within" in str(findings)
    assert "differ by up to 0.000 m and 0.00 levels" in str(findings)
    assert str(findings).endswith("all checks passed")


@pytest.mark.slow
def test_a_wrong_depth_camera_is_found(street):
    with serving("--map", street, program=WRONG_DEPTH) as (_, port):
        findings = examine(CarlaSimulator(port=port, camera=CAMERA, input=INPUT))
    bad = [check.name for check in findings.checks if not check.passed]
    assert bad == ["road", "paint"], str(findings)
    assert "m from the plane of the canvas" in str(findings)


@pytest.mark.slow
def test_what_is_not_put_back_is_told(street):
    with serving("--map", street, program=CLOUDY) as (_, port):
        findings = examine(CarlaSimulator(port=port, camera=CAMERA, input=INPUT))
    assert [check.name for check in findings.checks if not check.passed] == ["clean-up"], str(findings)
    assert "the weather is not put back" in str(findings)


def test_nobody_there_is_one_finding():
    findings = examine(CarlaSimulator(port=free_port(), patience_s=1.0))
    assert [(check.name, check.passed) for check in findings.checks] == [("connection", False)]
    assert "check that it runs" in str(findings)


def test_the_command_writes_a_scenario_between_two_spawn_points(port, tmp_path):
    out = tmp_path / "carla.toml"
    for numbers, code in ((("0", "5"), 0), (("0", "6"), 0), (("0", "99"), 2)):
        told = roadproof("carla", "scenario", *numbers, "--port", port, "--out", out)
        assert told.returncode == code, told.stderr
    assert "street has no spawn point 99, expected 0 to 19" in told.stderr
    assert [(made.name, made.kind, made.map_name) for made in load_scenarios(out)] == [
        ("street-0-5", "straight", "street"),
        ("street-0-6", "straight", "street"),
    ]


@pytest.mark.parametrize("name", ["town", "second"])
def test_scenarios_between_places_fit_their_map(name):
    roads = load_map(name)
    lanes = [lane for lane in roads.lanes if lane.kind == "driving" and lane.junction is None and lane.length_m > 40]
    rng = np.random.default_rng(1)
    kinds = set()
    for _ in range(12):
        a, b = rng.choice(len(lanes), 2, replace=False)
        start, goal = (
            VehicleState(*(float(v) for v in lane.centre[k]), float(lane.headings_rad[k]), 0.0)
            for lane, k in ((lanes[a], 2), (lanes[b], len(lanes[b].centre) // 2))
        )
        made = scenario_between(roads, name, start, goal, canvas_at_m=15.0, name="drawn")
        route = scenario_route(made, roads)
        assert route.locate(made.canvas.x_m, made.canvas.y_m).arclength_m == pytest.approx(15.0, abs=1.5)
        assert made.time_limit_s > route.length_m / 8
        kinds.add(made.kind)
    assert len(kinds) >= 2


def test_a_straight_stretch_is_straight_and_one_that_is_not_there_is_refused():
    roads = load_map("town")
    places = [
        VehicleState(*(float(v) for v in lane.centre[1]), float(lane.headings_rad[1]), 0.0)
        for lane in roads.lanes
        if lane.kind == "driving" and lane.junction is None and len(lane.centre) > 3
    ]
    start, goal = straight_stretch(roads, places, 50.0)
    assert math.dist((start.x_m, start.y_m), (goal.x_m, goal.y_m)) == pytest.approx(50.0, abs=1.5)
    with pytest.raises(ScenarioError, match="5000 m of straight road"):
        straight_stretch(roads, places, 5000.0)


def test_a_canvas_beyond_the_goal_is_refused():
    roads = load_map("town")
    start = VehicleState(33.0, -1.75, 0.0, 0.0, 0.0)
    with pytest.raises(ScenarioError, match="expected it on the route of"):
        scenario_between(roads, "town", start, VehicleState(63.0, -1.75, 0.0, 0.0, 0.0), canvas_at_m=40.0, name="far")
