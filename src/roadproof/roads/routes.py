"""Routes: the shortest way along lanes from a pose to a place, and what it commands at junctions."""

from __future__ import annotations

import heapq
import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Float, Int

from roadproof.datatypes import Command
from roadproof.errors import ScenarioError
from roadproof.roads.lanes import Lane, Line
from roadproof.roads.polylines import interpolated, polyline_stations

SPACING_M = 0.5
COMMAND_LEAD_M = 20.0
TURN_RAD = math.radians(35.0)
_APART_M = 1e-4  # nearer points are one


@dataclass(frozen=True, slots=True)
class RoutePosition:
    """Where something is along a route: how far, how much left of it, and the route's command there."""

    arclength_m: float
    lateral_m: float
    command: Command


@dataclass(frozen=True, slots=True)
class Crossing:
    """A junction on a route: where along it the route enters and leaves, and a circle round all of its lanes."""

    enters_m: float
    leaves_m: float
    command: Command
    x_m: float
    y_m: float
    radius_m: float


@dataclass(frozen=True, slots=True, eq=False)
class Route:
    """A way along lane centres.

    Args:
        points: points of the way, about half a metre apart, (N, 3), metres.
        headings_rad: direction of travel at each point, unwrapped.
        arclengths_m: distance driven from the start up to each point.
        commands: codes of `Command`: a turn or straight on from 20 m before a junction to its end, else follow.
        crossings: the junctions it crosses, in order.
    """

    points: Line
    headings_rad: Float[np.ndarray, " n"]
    arclengths_m: Float[np.ndarray, " n"]
    commands: Int[np.ndarray, " n"]
    crossings: tuple[Crossing, ...]

    @property
    def length_m(self) -> float:
        """Distance from start to goal."""
        return float(self.arclengths_m[-1])

    def locate(self, x_m: float, y_m: float, near_m: float | None = None) -> RoutePosition:
        """Where a point is along the route.

        Args:
            x_m: world x, metres.
            y_m: world y, metres.
            near_m: the arc length where it was last, where that is known: only the 30 m around it are searched, so
                that a route that meets itself is followed in order.
        """
        low, high = 0, len(self.points) - 1
        if near_m is not None:
            low = max(0, int(np.searchsorted(self.arclengths_m, near_m - 15.0)) - 1)
            high = min(high, max(low + 1, int(np.searchsorted(self.arclengths_m, near_m + 15.0))))
        start = self.points[low:high, :2]
        step = self.points[low + 1 : high + 1, :2] - start
        reach = np.array([x_m, y_m]) - start
        length = self.arclengths_m[low + 1 : high + 1] - self.arclengths_m[low:high]
        along = np.clip((reach * step).sum(axis=1) / length, 0.0, length)
        off = reach - step * (along / length)[:, None]
        k = int(np.argmin((off * off).sum(axis=1)))
        ux, uy = step[k] / length[k]
        return RoutePosition(
            arclength_m=float(self.arclengths_m[low + k] + along[k]),
            lateral_m=float(ux * reach[k, 1] - uy * reach[k, 0]),
            command=Command(int(self.commands[low + k])),
        )

    def ahead(self, arclengths_m: Float[np.ndarray, " k"]) -> Float[np.ndarray, "k 2"]:
        """World x, y at distances from the start, metres; beyond its end the route goes straight on."""
        beyond = np.maximum(arclengths_m - self.length_m, 0.0)[:, None]
        end = self.headings_rad[-1]
        inside = interpolated(arclengths_m, self.arclengths_m, self.points[:, :2])
        return inside + beyond * np.array([math.cos(end), math.sin(end)])

    def at(self, arclength_m: float) -> tuple[float, float, float, float]:
        """(x, y, z, heading) at a distance from the start, held at both ends."""
        x, y, z = interpolated(arclength_m, self.arclengths_m, self.points).tolist()
        return x, y, z, float(np.interp(arclength_m, self.arclengths_m, self.headings_rad))


def shortest_path(lanes: Sequence[Lane], start: tuple[int, float], goal: tuple[int, float]) -> tuple[int, ...]:
    """Driving lanes from a place (lane, arc length) to another, by A* over lengths with the straight line as its bound.

    Raises:
        ScenarioError: no way leads from the start to the goal.
    """
    (first, from_m), (last, to_m) = start, goal
    if first == last and to_m >= from_m - SPACING_M:
        return (first,)
    goal_point = lanes[last].centre[0, :2]

    def bound(index: int) -> float:
        return float(np.linalg.norm(lanes[index].centre[-1, :2] - goal_point))

    # Costs count to the end of a lane; the goal is reached when its lane is entered.
    begin = lanes[first].length_m - from_m
    queue: list[tuple[float, float, int, tuple[int, ...]]] = [(begin + bound(first), begin, first, (first,))]
    done: set[int] = set()
    while queue:
        _, cost, index, way = heapq.heappop(queue)
        if last in lanes[index].successors:
            return (*way, last)
        if index in done:
            continue
        done.add(index)
        for after in lanes[index].successors:
            if after not in done and lanes[after].kind == "driving":
                total = cost + lanes[after].length_m
                heapq.heappush(queue, (total + bound(after), total, after, (*way, after)))
    at, to = lanes[first].centre[0], lanes[last].centre[0]
    raise ScenarioError(
        f"no way leads from lane {lanes[first].number} of road {lanes[first].road} ({at[0]:.0f}, {at[1]:.0f}) to lane "
        f"{lanes[last].number} of road {lanes[last].road} ({to[0]:.0f}, {to[1]:.0f}); move the goal or the start"
    )


def route_along(lanes: Sequence[Lane], way: tuple[int, ...], from_m: float, to_m: float) -> Route:
    """The route along consecutive lanes, from an arc length of the first to one of the last."""
    centre = np.concatenate([lanes[index].centre for index in way])
    keep = np.concatenate([[True], np.linalg.norm(np.diff(centre, axis=0), axis=1) > _APART_M])
    centre = centre[keep]
    stations = polyline_stations(centre)
    ends = _ends(lanes, way)
    end_m = max(float(ends[-1]) - lanes[way[-1]].length_m + to_m, from_m + SPACING_M)
    count = max(1, math.ceil((end_m - from_m) / SPACING_M)) + 1
    at = np.linspace(from_m, end_m, count)
    points = interpolated(at, stations, centre)
    along = np.gradient(points[:, :2], axis=0)
    crossings = _crossings(lanes, way, ends, from_m, end_m)
    return Route(
        points=points,
        headings_rad=np.unwrap(np.arctan2(along[:, 1], along[:, 0])),
        arclengths_m=polyline_stations(points),
        commands=_commands(crossings, at - from_m),
        crossings=crossings,
    )


def _ends(lanes: Sequence[Lane], way: tuple[int, ...]) -> Float[np.ndarray, " w"]:
    """Where each lane of a way ends along the line that joins them, with the gaps where lanes do not quite meet."""
    lines = [lanes[index].centre for index in way]
    gaps = np.array([0.0, *(np.linalg.norm(after[0] - before[-1]) for before, after in pairwise(lines))])
    return np.cumsum([lanes[index].length_m for index in way]) + np.cumsum(np.where(gaps > _APART_M, gaps, 0.0))


def _crossings(
    lanes: Sequence[Lane], way: tuple[int, ...], ends: Float[np.ndarray, " w"], from_m: float, end_m: float
) -> tuple[Crossing, ...]:
    crossings: list[Crossing] = []
    k = 0
    while k < len(way):
        junction, first = lanes[way[k]].junction, k
        while k + 1 < len(way) and lanes[way[k + 1]].junction == junction:
            k += 1
        passed = [lanes[index] for index in way[first : k + 1]]
        enters = float(ends[first] - passed[0].length_m)
        if junction is not None and enters < end_m:
            turn = sum(float(lane.headings_rad[-1] - lane.headings_rad[0]) for lane in passed)
            command = Command.LEFT if turn > TURN_RAD else Command.RIGHT if turn < -TURN_RAD else Command.STRAIGHT
            inside = [lane.centre[:, :2] for lane in lanes if lane.junction == junction and lane.kind == "driving"]
            low, high = np.concatenate(inside).min(axis=0), np.concatenate(inside).max(axis=0)
            x, y = (float(value) for value in 0.5 * (low + high))
            radius = 0.5 * float((high - low).max())
            crossings.append(Crossing(enters - from_m, float(ends[k]) - from_m, command, x, y, radius))
        k += 1
    return tuple(crossings)


def _commands(crossings: tuple[Crossing, ...], at_m: Float[np.ndarray, " n"]) -> Int[np.ndarray, " n"]:
    commands = np.full(len(at_m), int(Command.FOLLOW))
    # Backwards, so that a junction close behind another one does not change what is asked at the first.
    for crossing in reversed(crossings):
        ahead = (at_m >= crossing.enters_m - COMMAND_LEAD_M) & (at_m <= crossing.leaves_m)
        commands[ahead] = int(crossing.command)
    return commands
