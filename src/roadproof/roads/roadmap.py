"""The map of a town: lanes, what a place is paved with, which lane a car is on, routes.

Convention:
    World frame of OpenDRIVE, which is right-handed: x, y in metres, z up, yaw 0 along x. Lateral offsets and heading
    errors are positive to the left.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from enum import IntEnum
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from roadproof.datatypes import VehicleState
from roadproof.errors import ScenarioError
from roadproof.roads.junctions import Corner, JunctionArea, junction_areas, triangulated
from roadproof.roads.lanes import Lane, MarkLine, build_lanes
from roadproof.roads.opendrive import read_opendrive
from roadproof.roads.routes import Route, route_along, shortest_path
from roadproof.roads.spatial import SHORTEST_M, SegmentIndex, TriangleIndex

MAX_EXTENT_M = 5000.0
HEADING_WEIGHT_M = 2.0
ON_ROUTE_M = 5.0


class Surface(IntEnum):
    """What a place is paved with; where strips overlap the largest counts."""

    OTHER = 0
    SIDEWALK = 1
    SHOULDER = 2
    DRIVING = 3


ON_ROAD = (Surface.SHOULDER, Surface.DRIVING)
"""What a car stands on that is on the road."""


PAVED = (
    *("shoulder", "border", "parking", "stop", "biking", "bidirectional", "bus", "taxi", "HOV"),
    *("entry", "exit", "mwyEntry", "mwyExit", "onRamp", "offRamp", "connectingRamp", "slipLane"),
)
"""OpenDRIVE's types of lanes with asphalt that no route follows."""

SURFACE_OF_KIND = {
    "driving": Surface.DRIVING,
    "sidewalk": Surface.SIDEWALK,
    **dict.fromkeys(PAVED, Surface.SHOULDER),
}


@dataclass(frozen=True, slots=True)
class LanePosition:
    """Where a car is on a lane: index of the lane, how far along it, how much left of its centre, how it is turned."""

    lane: int
    arclength_m: float
    lateral_m: float
    heading_error_rad: float


class RoadMap:
    """Lanes, painted lines and junction areas of a map, with fast queries.

    Attributes:
        lanes: all lanes; `lanes[i].index == i`.
        mark_lines: every painted line once.
        junctions: the paved areas of the junctions.
        bounds_m: (x_min, y_min, x_max, y_max) of everything paved.
    """

    def __init__(
        self, lanes: tuple[Lane, ...], mark_lines: tuple[MarkLine, ...], junctions: tuple[JunctionArea, ...]
    ) -> None:
        """Index lanes and areas for queries.

        Raises:
            ScenarioError: there is no driving lane, or the map is larger than 5 km.
        """
        self.lanes = lanes
        self.mark_lines = mark_lines
        self.junctions = junctions
        self._driving = np.array([lane.index for lane in lanes if lane.kind == "driving"], dtype=np.intp)
        if not any(lane.kind == "driving" and lane.length_m > SHORTEST_M for lane in lanes):
            raise ScenarioError("the map has no lane of type driving, expected at least one")
        everything = np.concatenate([line[:, :2] for lane in lanes for line in (lane.left, lane.right)])
        (x0, y0), (x1, y1) = everything.min(axis=0).tolist(), everything.max(axis=0).tolist()
        if not max(x1 - x0, y1 - y0) <= MAX_EXTENT_M:
            raise ScenarioError(
                f"the map spans {x1 - x0:.0f} × {y1 - y0:.0f} m, expected at most "
                f"{MAX_EXTENT_M:.0f} m each way; cut out the part to be driven"
            )
        self.bounds_m: tuple[float, float, float, float] = (x0, y0, x1, y1)
        self._segments = SegmentIndex([lane.centre for lane in lanes if lane.kind == "driving"])
        self._heading = np.arctan2(self._segments.along[:, 1], self._segments.along[:, 0])
        self._surface = _surface_index(lanes, junctions)

    @classmethod
    def from_opendrive(cls, path: Path) -> RoadMap:
        """Read a map from an OpenDRIVE file.

        Raises:
            ScenarioError: the file cannot be read or is not supported; the message names the element.
        """
        lanes, marks = build_lanes(read_opendrive(path))
        areas, corners = junction_areas(lanes)
        return cls(tuple(_with_corners(lanes, corners)), tuple(marks), tuple(areas))

    def paved(self) -> Iterator[tuple[Surface, Float[np.ndarray, "_ 3"]]]:
        """Outlines of what is paved, in the order to draw them in: where strips overlap the largest counts."""
        lanes = [(SURFACE_OF_KIND[lane.kind], lane) for lane in self.lanes if lane.kind in SURFACE_OF_KIND]
        for surface, lane in sorted(lanes, key=lambda pair: pair[0]):
            yield surface, np.concatenate([lane.left, lane.right[::-1]])
        for area in self.junctions:
            yield Surface.DRIVING, area.outline

    def surface_at(self, points_m: Float[np.ndarray, "n 2"]) -> Int[np.ndarray, " n"]:
        """Code of `Surface` at each point."""
        return self._surface(points_m)

    def nearest_lane(self, x_m: float, y_m: float, yaw_rad: float) -> LanePosition:
        """The driving lane a car is most likely on.

        It minimises distance² + (2 m · heading error)², so a car in the opposite lane but turned the right way is told
        to be far left of its own lane, and in a junction the lane of its direction is found.
        """
        segments = self._segments
        # An error of π makes up for no more distance than this.
        near = segments.within(x_m, y_m, math.pi * HEADING_WEIGHT_M)
        start, along = segments.start[near], segments.along[near]
        dx, dy = x_m - start[:, 0], y_m - start[:, 1]
        ahead = dx * along[:, 0] + dy * along[:, 1]
        beside = along[:, 0] * dy - along[:, 1] * dx
        over = ahead - np.minimum(np.maximum(ahead, 0.0), segments.length_m[near])
        error = (yaw_rad - self._heading[near] + math.pi) % (2 * math.pi) - math.pi
        k = int((beside * beside + over * over + (HEADING_WEIGHT_M * error) ** 2).argmin())
        segment = near[k]
        return LanePosition(
            lane=int(self._driving[segments.owner[segment]]),
            arclength_m=float(segments.station_m[segment] + (ahead[k] - over[k]) * segments.stretch[segment]),
            lateral_m=float(beside[k]),
            heading_error_rad=float(error[k]),
        )

    def height_m(self, x_m: float, y_m: float, yaw_rad: float) -> float:
        """World z of the driving lane that a car there is most likely on, metres."""
        place = self.nearest_lane(x_m, y_m, yaw_rad)
        return self.lanes[place.lane].at(place.arclength_m)[2]

    def route(self, start: VehicleState, goal_m: tuple[float, float]) -> Route:
        """The shortest route from a pose to the place on a driving lane nearest to the goal, without lane changes.

        Args:
            start: pose of the car at the start, on a driving lane and turned along it.
            goal_m: (x, y) of the goal, on a driving lane; of two lanes as near, the one that a shorter way leads to.

        Raises:
            ScenarioError: start or goal is off the road, or no way leads to the goal.
        """
        begin = self.nearest_lane(start.x_m, start.y_m, start.yaw_rad)
        away_m = math.dist((start.x_m, start.y_m), self.lanes[begin.lane].at(begin.arclength_m)[:2])
        if away_m > ON_ROUTE_M or abs(begin.heading_error_rad) > math.pi / 3:
            raise ScenarioError(
                f"start ({start.x_m:.1f}, {start.y_m:.1f}) with yaw {start.yaw_rad:.2f} rad is not along a driving "
                f"lane (the nearest is {away_m:.1f} m away and {abs(begin.heading_error_rad):.2f} rad "
                "off); move or turn it"
            )
        ends = self._goal_places(goal_m)
        ways: list[tuple[float, tuple[int, ...], float]] = []
        problem: ScenarioError | None = None
        for index, to_m in ends:
            try:
                way = shortest_path(self.lanes, (begin.lane, begin.arclength_m), (index, to_m))
            except ScenarioError as error:
                problem = error
                continue
            length = sum(self.lanes[i].length_m for i in way[:-1]) + to_m - begin.arclength_m
            ways.append((length, way, to_m))
        if not ways:
            assert problem is not None
            raise problem
        _, way, to_m = min(ways)
        return route_along(self.lanes, way, begin.arclength_m, to_m)

    def _goal_places(self, goal_m: tuple[float, float]) -> list[tuple[int, float]]:
        """Lanes (index, arc length) whose centre passes the goal as near as the nearest one, within 0.5 m."""
        segments = self._segments
        near = segments.within(*goal_m, ON_ROUTE_M)
        reach = np.array(goal_m) - segments.start[near]
        ahead = np.clip((reach * segments.along[near]).sum(axis=1), 0.0, segments.length_m[near])
        distance = np.linalg.norm(reach - segments.along[near] * ahead[:, None], axis=1)
        if distance.min() > ON_ROUTE_M:
            raise ScenarioError(
                f"goal ({goal_m[0]:.1f}, {goal_m[1]:.1f}) is {distance.min():.1f} m from the nearest driving lane, "
                f"expected at most {ON_ROUTE_M:.0f} m; move it onto a lane"
            )
        best: dict[int, tuple[float, float]] = {}
        for k in np.flatnonzero(distance < distance.min() + 0.5):
            index = int(self._driving[segments.owner[near[k]]])
            place = (float(distance[k]), float(segments.station_m[near[k]] + ahead[k] * segments.stretch[near[k]]))
            best[index] = min(best.get(index, place), place)
        return [(index, place[1]) for index, place in best.items()]


def _with_corners(lanes: list[Lane], corners: list[Corner]) -> list[Lane]:
    """Corner strips added to the lanes, linked from and to the strips they join."""
    lanes = list(lanes)
    for corner in corners:
        index = len(lanes)
        lanes.append(replace(corner.lane, index=index, successors=(corner.after,)))
        lanes[corner.before] = replace(lanes[corner.before], successors=(*lanes[corner.before].successors, index))
    return lanes


def lane_triangles(lane: Lane) -> Float[np.ndarray, "t 3 3"]:
    """The lane's surface as triangles, two for each step along it."""
    a, b, c, d = lane.right[:-1], lane.right[1:], lane.left[1:], lane.left[:-1]
    return np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])


def _surface_index(lanes: tuple[Lane, ...], junctions: tuple[JunctionArea, ...]) -> TriangleIndex:
    paved = [(lane_triangles(lane), SURFACE_OF_KIND[lane.kind]) for lane in lanes if lane.kind in SURFACE_OF_KIND]
    paved += [(triangulated(area.outline), Surface.DRIVING) for area in junctions]
    corners = np.concatenate([triangles[:, :, :2] for triangles, _ in paved])
    codes = np.concatenate([np.full(len(triangles), int(code)) for triangles, code in paved])
    return TriangleIndex(corners, codes)
