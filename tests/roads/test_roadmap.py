"""Lanes, surfaces and routes: against CARLA's own reading of its towns, and against plain geometry."""

import math
import random
import time
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest

from roadproof.datatypes import Command, VehicleState
from roadproof.errors import ScenarioError
from roadproof.roads.junctions import triangulated
from roadproof.roads.roadmap import RoadMap, Surface, lane_triangles

SECOND = Path(__file__).parents[2] / "src" / "roadproof" / "roads" / "assets" / "second.xodr"


def street(number: int, x: float, *, link: str = "", junction: str = "-1", width: float = 3.5) -> str:
    """A straight two-way road of 40 m along x."""
    lanes = {
        side: f'<{side}><lane id="{k}" type="driving"><link><predecessor id="{k}"/><successor id="{k}"/></link>'
        f'<width sOffset="0" a="{width}" b="0" c="0" d="0"/></lane></{side}>'
        for side, k in (("left", 1), ("right", -1))
    }
    return (
        f'<road id="{number}" length="40" junction="{junction}"><link>{link}</link><planView>'
        f'<geometry s="0" x="{x}" y="0" hdg="0" length="40"><line/></geometry></planView>'
        f'<lanes><laneSection s="0">{lanes["left"]}<center><lane id="0"/></center>{lanes["right"]}'
        "</laneSection></lanes></road>"
    )


def loaded(folder: Path, *parts: str) -> RoadMap:
    path = folder / "map.xodr"
    path.write_text(f"<OpenDRIVE>{''.join(parts)}</OpenDRIVE>")
    return RoadMap.from_opendrive(path)


@pytest.fixture(scope="module", params=["Town01", "Town02"])
def town(request: pytest.FixtureRequest, opendrive_data: Path) -> tuple[RoadMap, Path]:
    path = opendrive_data / f"{request.param}.xodr"
    return RoadMap.from_opendrive(path), path


def triangle_area(triangles: np.ndarray) -> float:
    u, v = triangles[:, 1, :2] - triangles[:, 0, :2], triangles[:, 2, :2] - triangles[:, 0, :2]
    return float(0.5 * np.abs(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]).sum())


def polygon_area(outline: np.ndarray) -> float:
    x, y = outline[:, 0], outline[:, 1]
    return float(0.5 * (x * np.roll(y, -1) - np.roll(x, -1) * y).sum())


def state_on(road_map: RoadMap, index: int, share: float = 0.5) -> VehicleState:
    lane = road_map.lanes[index]
    k = int(share * (len(lane.centre) - 1))
    x, y, z = (float(value) for value in lane.centre[k])
    return VehicleState(x, y, z, float(lane.headings_rad[k]), 0.0)


def test_waypoints_of_carla_lie_on_our_lanes(town: tuple[RoadMap, Path]) -> None:
    carla = pytest.importorskip("carla", reason="the carla wheel is not installed")
    road_map, path = town
    waypoints = carla.Map("town", path.read_text()).generate_waypoints(2.0)
    driving = [w for w in waypoints if w.lane_type == carla.LaneType.Driving]
    assert len(driving) > 1000
    for waypoint in driving:
        # CARLA's world is left-handed: y and yaw change sign.
        place = waypoint.transform.location
        found = road_map.nearest_lane(place.x, -place.y, -math.radians(waypoint.transform.rotation.yaw))
        lane = road_map.lanes[found.lane]
        on_lane = [np.interp(found.arclength_m, lane.stations_m, lane.centre[:, axis]) for axis in range(2)]
        assert math.dist(on_lane, (place.x, -place.y)) < 0.01
        assert abs(found.heading_error_rad) < 0.04
        width = np.interp(found.arclength_m, lane.stations_m, np.linalg.norm(lane.left - lane.right, axis=1))
        assert width == pytest.approx(waypoint.lane_width, abs=1e-6)


def test_lanes_of_carla_go_on_where_carla_says(town: tuple[RoadMap, Path]) -> None:
    carla = pytest.importorskip("carla", reason="the carla wheel is not installed")
    road_map, path = town
    checked = 0
    for start, end in carla.Map("town", path.read_text()).get_topology():
        key = (str(start.road_id), start.section_id, start.lane_id)
        after = (str(end.road_id), end.section_id, end.lane_id)
        lanes = {(lane.road, lane.section, lane.number): lane for lane in road_map.lanes if lane.kind == "driving"}
        if key == after or key not in lanes or lanes[key].length_m < 0.1:
            continue
        checked += 1
        reached = set(lanes[key].successors)
        for _ in range(8):  # CARLA's topology leaves out the sections in between
            reached |= {i for index in reached for i in road_map.lanes[index].successors}
        assert lanes[after].index in reached
    assert checked > 50


def test_every_lane_leads_on_without_a_jump(town: tuple[RoadMap, Path]) -> None:
    road_map, _ = town
    for lane in road_map.lanes:
        assert np.diff(lane.stations_m).max() <= 1.05 * max(1.0, lane.width_m / 4)
        for index in lane.successors:
            after = road_map.lanes[index]
            assert np.linalg.norm(after.centre[0] - lane.centre[-1]) < 0.05
        if lane.kind == "driving":
            assert lane.successors


def test_sidewalks_go_round_the_corners_of_junctions(town: tuple[RoadMap, Path]) -> None:
    road_map, _ = town
    corners = [lane for lane in road_map.lanes if lane.kind == "sidewalk" and lane.junction is not None]
    assert len(corners) == 3 * len(road_map.junctions)  # all junctions of these towns have three arms
    for lane in corners:
        middle = lane.centre[len(lane.centre) // 2, :2]
        assert road_map.surface_at(middle[None])[0] == Surface.SIDEWALK


def test_surfaces_follow_the_cross_section_of_a_road(town: tuple[RoadMap, Path]) -> None:
    road_map, _ = town
    walks = [lane for lane in road_map.lanes if lane.kind == "sidewalk" and not lane.junction and len(lane.centre) > 9]
    beyond: list[int] = []
    for lane in walks:
        k = len(lane.centre) // 2
        inner, outer = lane.left[k, :2], lane.right[k, :2]
        out = (outer - inner) / np.linalg.norm(outer - inner)
        points = np.stack(
            [inner - 1.0 * out, inner - 0.1 * out, inner + 0.1 * out, outer - 0.1 * out, outer + 0.1 * out]
        )
        expected = [Surface.DRIVING, Surface.SHOULDER, Surface.SIDEWALK, Surface.SIDEWALK]
        codes = road_map.surface_at(points)
        np.testing.assert_array_equal(codes[:4], expected)
        beyond.append(int(codes[4]))
    assert beyond.count(Surface.OTHER) > 0.8 * len(beyond)  # a few sidewalks of Town02 lie back to back


def test_junction_areas_hold_every_lane_that_crosses_them(town: tuple[RoadMap, Path]) -> None:
    road_map, _ = town
    for area in road_map.junctions:
        assert polygon_area(area.outline) > 100.0
        covered = triangle_area(triangulated(area.outline))
        assert covered == pytest.approx(polygon_area(area.outline), rel=1e-4)
        crossing = [lane for lane in road_map.lanes if lane.junction == area.junction and lane.kind == "driving"]
        assert covered < sum(triangle_area(lane_triangles(lane)) for lane in crossing)


def test_surface_codes_agree_with_a_slow_search(town: tuple[RoadMap, Path]) -> None:
    road_map, _ = town
    rng = np.random.default_rng(0)
    lanes = [lane for lane in road_map.lanes if lane.kind == "driving"]
    middle = np.array([lane.centre[len(lane.centre) // 2, :2] for lane in lanes])
    points = middle[rng.integers(len(lanes), size=60)] + rng.normal(0.0, 4.0, (60, 2))
    triangles = np.concatenate(
        [lane_triangles(lane) for lane in lanes] + [triangulated(area.outline) for area in road_map.junctions]
    )[:, :, :2]
    edges = np.roll(triangles, -1, axis=1) - triangles
    driving = road_map.surface_at(points) == Surface.DRIVING
    for point, mine in zip(points, driving, strict=True):
        reach = point - triangles
        side = edges[..., 0] * reach[..., 1] - edges[..., 1] * reach[..., 0]
        assert mine == bool(((side >= 0).all(axis=1) | (side <= 0).all(axis=1)).any())


def test_the_nearest_lane_is_told_with_its_signs(town: tuple[RoadMap, Path]) -> None:
    road_map, _ = town
    for lane in road_map.lanes:
        if lane.kind != "driving" or lane.junction is not None or lane.length_m < 20:
            continue
        k = len(lane.centre) // 2
        yaw = float(lane.headings_rad[k])
        left = lane.centre[k, :2] + 0.8 * np.array([-math.sin(yaw), math.cos(yaw)])
        found = road_map.nearest_lane(float(left[0]), float(left[1]), yaw + 0.2)
        assert found.lane == lane.index
        assert found.lateral_m == pytest.approx(0.8, abs=0.02)
        assert found.heading_error_rad == pytest.approx(0.2, abs=0.03)
        assert found.arclength_m == pytest.approx(float(lane.stations_m[k]), abs=0.1)


def test_routes_are_shortest_and_command_their_turns(town: tuple[RoadMap, Path]) -> None:
    road_map, _ = town
    rng = np.random.default_rng(1)
    driving = [lane.index for lane in road_map.lanes if lane.kind == "driving" and not lane.junction]
    driving = [index for index in driving if road_map.lanes[index].length_m > 10]
    seen: set[int] = set()
    for _ in range(40):
        first, last = (int(driving[k]) for k in rng.integers(len(driving), size=2))
        start, goal = state_on(road_map, first), state_on(road_map, last)
        route = road_map.route(start, (goal.x_m, goal.y_m))
        assert math.dist(route.points[0, :2], (start.x_m, start.y_m)) < 0.05
        assert math.dist(route.points[-1, :2], (goal.x_m, goal.y_m)) < 0.6
        assert np.diff(route.arclengths_m).max() <= 0.51
        assert route.length_m == pytest.approx(plain_distance(road_map, first, last), abs=1.5)
        seen |= set(route.commands.tolist())
        for command, sign in ((Command.LEFT, 1), (Command.RIGHT, -1)):
            runs = np.split(np.arange(len(route.points)), np.flatnonzero(np.diff(route.commands)) + 1)
            for run in runs:
                if route.commands[run[0]] == command and run[-1] < len(route.points) - 1 and len(run) > 60:
                    assert sign * (route.headings_rad[run[-1]] - route.headings_rad[run[0]]) > math.radians(35)
    assert seen == {int(command) for command in Command}


def plain_distance(road_map: RoadMap, first: int, last: int) -> float:
    """Bellman-Ford over lanes: the length from the middle of one to the middle of another."""
    lengths = np.array([lane.length_m for lane in road_map.lanes])
    if first == last:
        return 0.0
    to_end = np.full(len(lengths), np.inf)
    to_end[first] = lengths[first] / 2
    edges = np.array([(lane.index, after) for lane in road_map.lanes for after in lane.successors])
    for _ in range(200):
        np.minimum.at(to_end, edges[:, 1], to_end[edges[:, 0]] + lengths[edges[:, 1]])
    return float(to_end[last] - lengths[last] / 2)


def test_a_point_is_located_on_a_route(town: tuple[RoadMap, Path]) -> None:
    road_map, _ = town
    lanes = [lane for lane in road_map.lanes if lane.kind == "driving" and lane.length_m > 10]
    goal = state_on(road_map, lanes[-1].index)
    route = road_map.route(state_on(road_map, lanes[0].index), (goal.x_m, goal.y_m))
    for k in range(10, len(route.points) - 10, 25):
        yaw = route.headings_rad[k]
        x, y = route.points[k, :2] + 0.5 * np.array([-math.sin(yaw), math.cos(yaw)])
        found = route.locate(float(x), float(y), near_m=float(route.arclengths_m[k]) + 2.0)
        assert found.arclength_m == pytest.approx(float(route.arclengths_m[k]), abs=0.1)
        assert found.lateral_m == pytest.approx(0.5, abs=0.02)
        assert route.at(found.arclength_m)[3] == pytest.approx(float(yaw), abs=0.06)


def test_places_off_the_road_are_refused(town: tuple[RoadMap, Path]) -> None:
    road_map, _ = town
    start = state_on(road_map, int(next(lane.index for lane in road_map.lanes if lane.kind == "driving")))
    with pytest.raises(ScenarioError, match=r"goal .* from the nearest driving lane"):
        road_map.route(start, (10_000.0, 0.0))
    with pytest.raises(ScenarioError, match=r"start .* is not along a driving lane"):
        road_map.route(VehicleState(10_000.0, 0.0, 0.0, 0.0, 0.0), (start.x_m, start.y_m))


def test_a_map_loads_within_a_second(town: tuple[RoadMap, Path]) -> None:
    begin = time.process_time()
    RoadMap.from_opendrive(town[1])
    assert time.process_time() - begin < 5.0  # 0.25 s on a quiet core; checked types and busy machines take longer


def test_ears_cover_a_polygon_with_a_notch() -> None:
    outline = np.array([[0, 0], [4, 0], [4, 4], [2, 1], [0, 4]], dtype=float)
    triangles = triangulated(np.column_stack([outline, np.zeros(5)]))
    assert len(triangles) == 3
    assert triangle_area(triangles) == pytest.approx(polygon_area(outline))


def test_a_road_goes_on_into_the_next(tmp_path: Path) -> None:
    onward = '<successor elementType="road" elementId="2" contactPoint="start"/>'
    back = '<predecessor elementType="road" elementId="1" contactPoint="end"/>'
    road_map = loaded(tmp_path, street(1, 0.0, link=onward), street(2, 40.0, link=back))
    route = road_map.route(VehicleState(5.0, -1.75, 0.0, 0.0, 0.0), (70.0, -1.75))
    assert route.length_m == pytest.approx(65.0)
    np.testing.assert_allclose(route.points[:, 1], -1.75)
    assert route.crossings == ()
    back_home = road_map.route(VehicleState(75.0, 1.75, 0.0, math.pi, 0.0), (5.0, 1.75))
    assert back_home.length_m == pytest.approx(70.0)


@pytest.mark.parametrize("gap_m", [0.4, -0.4])
def test_a_route_ends_at_its_goal_where_lanes_do_not_quite_meet(tmp_path: Path, gap_m: float) -> None:
    def link(number: int) -> str:
        after = f'<successor elementType="road" elementId="{number + 1}" contactPoint="start"/>'
        before = f'<predecessor elementType="road" elementId="{number - 1}" contactPoint="end"/>'
        return before * (number > 1) + after * (number < 8)

    road_map = loaded(tmp_path, *(street(k, (k - 1) * (40.0 + gap_m), link=link(k)) for k in range(1, 9)))
    goal = 7 * (40.0 + gap_m) + 30.0
    route = road_map.route(VehicleState(5.0, -1.75, 0.0, 0.0, 0.0), (goal, -1.75))
    assert route.points[-1, :2] == pytest.approx((goal, -1.75), abs=0.01)


def test_a_map_without_a_way_to_go_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ScenarioError, match="no lane of type driving"):
        loaded(tmp_path, street(1, 0.0).replace('length="40"', 'length="1e-7"'))


def test_a_route_keeps_to_driving_lanes(tmp_path: Path) -> None:
    roads = [
        street(1, 0.0, link='<successor elementType="road" elementId="2" contactPoint="start"/>'),
        street(2, 40.0, link='<successor elementType="road" elementId="3" contactPoint="start"/>').replace(
            '"driving"', '"biking"'
        ),
        street(3, 80.0),
    ]
    road_map = loaded(tmp_path, *roads)
    with pytest.raises(ScenarioError, match=r"no way leads from lane -1 of road 1 .* to lane -1 of road 3"):
        road_map.route(VehicleState(5.0, -1.75, 0.0, 0.0, 0.0), (110.0, -1.75))


@pytest.mark.parametrize("kind", ["shoulder", "biking", "bus", "bidirectional", "exit", "onRamp", "slipLane"])
def test_lanes_with_asphalt_are_no_lawn_whoever_drives_there(tmp_path: Path, kind: str) -> None:
    beside = f'<lane id="-2" type="{kind}"><width sOffset="0" a="2.5" b="0" c="0" d="0"/></lane></right>'
    road_map = loaded(tmp_path, street(1, 0.0).replace("</right>", beside))
    points = np.array([[20.0, -1.75], [20.0, -4.75], [20.0, -6.5]])
    assert road_map.surface_at(points).tolist() == [Surface.DRIVING, Surface.SHOULDER, Surface.OTHER]


def test_a_start_before_the_beginning_of_a_road_is_refused(tmp_path: Path) -> None:
    road_map = loaded(tmp_path, street(1, 0.0))
    with pytest.raises(ScenarioError, match=r"start .* is not along a driving lane \(the nearest is 20.0 m away"):
        road_map.route(VehicleState(-20.0, -1.75, 0.0, 0.0, 0.0), (30.0, -1.75))


def test_on_a_slope_arc_lengths_go_along_it(tmp_path: Path) -> None:
    hill = '<elevationProfile><elevation s="0" a="0" b="0.2" c="0" d="0"/></elevationProfile>'
    road_map = loaded(tmp_path, street(1, 0.0).replace("<planView>", f"{hill}<planView>"))
    place = road_map.nearest_lane(30.0, -1.75, 0.0)
    assert road_map.lanes[place.lane].at(place.arclength_m)[:3] == pytest.approx((30.0, -1.75, 6.0))
    route = road_map.route(VehicleState(5.0, -1.75, 1.0, 0.0, 0.0), (30.0, -1.75))
    assert route.points[-1, :2] == pytest.approx((30.0, -1.75))


def test_a_goal_no_way_leads_to_is_refused(tmp_path: Path) -> None:
    road_map = loaded(tmp_path, street(1, 0.0), street(2, 60.0))
    with pytest.raises(ScenarioError, match=r"no way leads from lane -1 of road 1 .* to lane -1 of road 2"):
        road_map.route(VehicleState(5.0, -1.75, 0.0, 0.0, 0.0), (80.0, -1.75))


@pytest.mark.parametrize(
    ("first", "said"),
    [
        (
            street(1, 0.0, link='<successor elementType="road" elementId="9" contactPoint="start"/>'),
            "links to road 9, which is not in the file",
        ),
        (
            street(1, 0.0, link='<successor elementType="junction" elementId="9"/>'),
            "names junction 9, which is not in the file",
        ),
        (
            street(1, 0.0, link='<successor elementType="road" elementId="2" contactPoint="start"/>'),
            "road 1: lane -1 ends 20.00 m from lane -1 of road 2",
        ),
        (
            street(1, 0.0, link='<successor elementType="road" elementId="2"/>'),
            "has contactPoint None, expected 'start' or 'end'",
        ),
        (street(1, 0.0, width=400.0), "road 1: lane 1 is 400 m wide"),
        (street(1, -9000.0), "expected at most 5000 m each way"),
    ],
)
def test_links_and_sizes_that_cannot_be_are_named(tmp_path: Path, first: str, said: str) -> None:
    with pytest.raises(ScenarioError) as error:
        loaded(tmp_path, first, street(2, 60.0))
    assert said in str(error.value)


@pytest.mark.parametrize("seed", range(30))
def test_a_damaged_map_loads_or_is_refused_in_one_line(tmp_path: Path, seed: int) -> None:
    dice = random.Random(seed)
    root = ET.fromstring(SECOND.read_text())
    for _ in range(dice.choice([1, 1, 2, 4])):
        parents = {child: parent for parent in root.iter() for child in parent}
        element = dice.choice(list(parents))
        if dice.random() < 0.3:
            parents[element].remove(element)
        elif element.attrib:
            name = dice.choice(list(element.attrib))
            element.set(name, dice.choice(["", "nan", "-1", "0", "1e9", "x", "3", "-7.5", "1e-12", "99"]))
    (tmp_path / "map.xodr").write_text(ET.tostring(root, encoding="unicode"))
    try:
        RoadMap.from_opendrive(tmp_path / "map.xodr")
    except ScenarioError as error:
        assert "\n" not in str(error)
