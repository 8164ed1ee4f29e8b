"""Scenarios on a CARLA server's map, from the numbers of its spawn points."""

from __future__ import annotations

import math

from roadproof.datatypes import VehicleState
from roadproof.errors import ScenarioError
from roadproof.geometry import CanvasPlacement
from roadproof.roads.maps import fitting_canvas
from roadproof.roads.roadmap import RoadMap
from roadproof.roads.routes import TURN_RAD, Route
from roadproof.scenarios import Kind, Scenario
from roadproof.simulators.carla.session import Session, carla

CANVAS_LENGTH_M = 9.5
EDGE_M = 0.2
CRUISE_MPS, SLACK_S = 4.0, 20.0


def scenario_between(
    roads: RoadMap,
    map_name: str,
    start: VehicleState,
    goal: VehicleState,
    *,
    canvas_at_m: float,
    name: str,
) -> Scenario:
    """A drive from one place to another with a canvas on the way, as wide as the road allows.

    Args:
        roads: the server's map.
        map_name: the map's name on the server.
        start: pose to start from, along a lane.
        goal: pose to drive to, on a lane.
        canvas_at_m: distance along the way from the start to the middle of the canvas.
        name: the name of the scenario.

    Raises:
        ScenarioError: no way leads to the goal, or the canvas does not fit on the way.
    """
    route = roads.route(start, (goal.x_m, goal.y_m))
    if not CANVAS_LENGTH_M / 2 < canvas_at_m < route.length_m - CANVAS_LENGTH_M / 2:
        raise ScenarioError(
            f"the canvas is asked for {canvas_at_m:.0f} m from the start, expected it on the route of "
            f"{route.length_m:.0f} m"
        )
    return Scenario(
        name=name,
        kind=_kind(route),
        map_name=map_name,
        start=VehicleState(start.x_m, start.y_m, route.at(0.0)[2], start.yaw_rad, 0.0),
        goal_m=(goal.x_m, goal.y_m),
        canvas=_canvas(roads, route, canvas_at_m),
        time_limit_s=float(math.ceil(route.length_m / CRUISE_MPS + SLACK_S)),
    )


def straight_stretch(roads: RoadMap, places: list[VehicleState], length_m: float) -> tuple[VehicleState, VehicleState]:
    """The first of some places from which a lane leads straight on so far outside of junctions, and its end.

    Raises:
        ScenarioError: no place has such a stretch ahead.
    """
    for start in places:
        here = roads.nearest_lane(start.x_m, start.y_m, start.yaw_rad)
        lane = roads.lanes[here.lane]
        end_m = here.arclength_m + length_m
        if lane.junction is not None or end_m > lane.length_m or abs(here.lateral_m) > 0.5:
            continue
        k, n = (int(lane.stations_m.searchsorted(s)) for s in (here.arclength_m, end_m))
        turned = lane.headings_rad[k : n + 1]
        if float(turned.max() - turned.min()) < 0.02:
            x, y, z = (float(value) for value in lane.centre[min(n, len(lane.centre) - 1)])
            return start, VehicleState(x, y, z, float(turned[-1]), 0.0)
    raise ScenarioError(f"no spawn point of the map has {length_m:.0f} m of straight road before it; load another map")


def spawn_places(session: Session) -> list[VehicleState]:
    """The server's spawn points in the town's world, in its order.

    Raises:
        SimulatorError: the server does not answer.
    """
    points = session.ask("its map", session.world.get_map).get_spawn_points()
    return [_place(point) for point in points]


def _place(point: carla.Transform) -> VehicleState:
    return VehicleState(point.location.x, -point.location.y, point.location.z, -math.radians(point.rotation.yaw), 0.0)


def _kind(route: Route) -> Kind:
    turned = float(route.headings_rad[-1] - route.headings_rad[0])
    return "left" if turned > TURN_RAD else "right" if turned < -TURN_RAD else "straight"


def _canvas(roads: RoadMap, route: Route, at_m: float) -> CanvasPlacement:
    """A canvas over both lanes of the road where there are two, else over the car's own."""
    x, y, z, heading = route.at(at_m)
    lane = roads.lanes[roads.nearest_lane(x, y, heading).lane]
    tries = ((lane.width_m / 2, 2 * lane.width_m - 2 * EDGE_M), (0.0, lane.width_m - 2 * EDGE_M))
    at = CanvasPlacement(x_m=x, y_m=y, z_m=z, yaw_rad=heading, length_m=CANVAS_LENGTH_M)
    return fitting_canvas(at, tries, roads)
