"""Maps by name, and what a scenario means on its map."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from roadproof.errors import ScenarioError
from roadproof.geometry import CANVAS_SIZE_PX, CanvasPlacement
from roadproof.roads.roadmap import ON_ROAD, RoadMap, Surface
from roadproof.roads.routes import Route
from roadproof.scenarios import Scenario

BUILTIN_MAPS = ("town", "second")
CANVAS_NEAR_ROUTE_M = 4.0
CANVAS_OVER_ROAD_M, START_OVER_ROAD_M = 0.1, 1.0


@runtime_checkable
class Mapped(Protocol):
    """What can show the map of a scenario, such as a simulator."""

    def road_map(self, name: str) -> RoadMap:
        """The map that a scenario names.

        Raises:
            SimulatorError: the simulator does not answer.
            ScenarioError: the simulator has no such map.
        """
        ...


def load_map(name: str) -> RoadMap:
    """A built-in map by name, or an OpenDRIVE file by path; kept until the file changes, so that the next call is free.

    Raises:
        ScenarioError: there is no such map, or it cannot be read.
    """
    if name not in BUILTIN_MAPS and not name.endswith(".xodr"):
        known = ", ".join(BUILTIN_MAPS)
        raise ScenarioError(f"the town simulator has no map {name!r}, expected {known} or the path of an .xodr file")
    file = builtin_map_file(name) if name in BUILTIN_MAPS else Path(name)
    try:
        found = file.stat()
    except (OSError, ValueError):  # what is wrong with it is told where it is read
        return RoadMap.from_opendrive(file)
    return _as_it_is(file.absolute(), found.st_mtime_ns, found.st_size)


@lru_cache(maxsize=4)
def _as_it_is(file: Path, _changed_ns: int, _size: int) -> RoadMap:
    return RoadMap.from_opendrive(file)


def builtin_map_file(name: str) -> Path:
    """The OpenDRIVE file of a built-in map."""
    return Path(__file__).parent / "assets" / f"{name}.xodr"


def scenario_route(scenario: Scenario, road_map: RoadMap) -> Route:
    """The route of a scenario, once all of it is known to fit the map.

    Raises:
        ScenarioError: the start is not along a lane or far above or below it, the goal cannot be reached, or the canvas
            is off the road or away from the route.
    """
    try:
        route = road_map.route(scenario.start, scenario.goal_m)
        check_canvas(scenario.canvas, road_map)
    except ScenarioError as error:
        raise ScenarioError(f"scenario {scenario.name}: {error}") from error
    start, road_m = scenario.start, route.at(0.0)[2]
    if abs(start.z_m - road_m) > START_OVER_ROAD_M:
        raise ScenarioError(
            f"scenario {scenario.name}: start ({start.x_m:.1f}, {start.y_m:.1f}) has z_m {start.z_m:.2f}, but the road "
            f"there is {road_m:.2f} m high, expected within {START_OVER_ROAD_M:g} m; set its z_m"
        )
    nearest = route.locate(scenario.canvas.x_m, scenario.canvas.y_m)
    if abs(nearest.lateral_m) > CANVAS_NEAR_ROUTE_M or not 0.0 < nearest.arclength_m < route.length_m:
        raise ScenarioError(
            f"scenario {scenario.name}: the canvas at ({scenario.canvas.x_m:.1f}, {scenario.canvas.y_m:.1f}) is not on "
            f"the way from start to goal, expected its middle within {CANVAS_NEAR_ROUTE_M:.0f} m of the route; move it"
        )
    return route


def require_route(simulator: object, scenario: Scenario) -> None:
    """Refuse a scenario that does not fit the simulator's map, before anything is driven; without a map none is.

    Raises:
        SimulatorError: the simulator does not answer.
        ScenarioError: it has no such map, or start, goal and canvas do not fit it.
    """
    if isinstance(simulator, Mapped):
        scenario_route(scenario, simulator.road_map(scenario.map_name))


def check_canvas(canvas: CanvasPlacement, road_map: RoadMap) -> None:
    """Refuse a canvas of which some part lies beside the carriageway, above it or below it.

    Raises:
        ScenarioError: a part of the canvas lies off the road; the message says where, and what is there.
    """
    points = canvas_points(canvas)
    codes = road_map.surface_at(points)
    off = np.flatnonzero(np.isin(codes, ON_ROAD, invert=True))
    if len(off):
        x, y = points[off[0]]
        what = Surface(int(codes[off[0]])).name.lower()
        raise ScenarioError(
            f"the canvas at ({canvas.x_m:.1f}, {canvas.y_m:.1f}) is off the road at ({x:.1f}, {y:.1f}), where there is "
            f"{'no pavement' if what == 'other' else what}; move, turn or shrink it"
        )
    for x, y in points[[0, -1, len(points) // 2]].tolist():
        road_m = road_map.height_m(x, y, canvas.yaw_rad)
        if abs(canvas.z_m - road_m) > CANVAS_OVER_ROAD_M:
            raise ScenarioError(
                f"the canvas at ({canvas.x_m:.1f}, {canvas.y_m:.1f}) has z_m {canvas.z_m:.2f}, but the road under it "
                f"is {road_m:.2f} m high at ({x:.1f}, {y:.1f}), expected within {CANVAS_OVER_ROAD_M} m; set its z_m, "
                "or move it to where the road is level"
            )


def fitting_canvas(at: CanvasPlacement, tries: Iterable[tuple[float, float]], road_map: RoadMap) -> CanvasPlacement:
    """The first canvas of some that lies on the carriageway.

    Args:
        at: a canvas in the middle of the lane, whose place and length the others have.
        tries: for each canvas, how far to the left its middle lies, and its width, metres; at least one.
        road_map: the map that it must fit.

    Raises:
        ScenarioError: none fits; the message is that of the last.
    """
    problem: ScenarioError | None = None
    for left_m, width_m in tries:
        x_m, y_m = at.x_m - left_m * math.sin(at.yaw_rad), at.y_m + left_m * math.cos(at.yaw_rad)
        canvas = replace(at, x_m=x_m, y_m=y_m, width_m=width_m)
        try:
            check_canvas(canvas, road_map)
        except ScenarioError as error:
            problem = error
            continue
        return canvas
    assert problem is not None
    raise problem


def canvas_points(canvas: CanvasPlacement) -> Float[np.ndarray, "n 2"]:
    """World points (x, y) all over a canvas, its corners among them, less than a metre apart."""
    steps = [int(np.ceil(extent)) + 1 for extent in (canvas.width_m, canvas.length_m)]
    x, y = (np.linspace(-0.5, CANVAS_SIZE_PX - 0.5, n) for n in steps)
    pixels = np.stack([*(axis.ravel() for axis in np.meshgrid(x, y)), np.ones(len(x) * len(y))])
    return (canvas.world_from_canvas @ pixels)[:2].T
