"""What went wrong on a drive, and when it is over, by the rules of the 2019 CARLA challenge for one canvas.

Events are facts: each thing hit once, each departure from the lane once until it is over.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from roadproof.datatypes import RECOUNT_S, Ending, Event, EventKind, VehicleState
from roadproof.roads.polylines import interpolated
from roadproof.roads.roadmap import LanePosition, RoadMap, Surface
from roadproof.roads.routes import Route, RoutePosition
from roadproof.traffic.agents import CAR_LENGTH_M, CAR_WHEELBASE_M, CAR_WIDTH_M

HEIGHT_M, TRACK_M = 1.45, 1.6
"""Measures of the driven car."""

PERSON_RADIUS_M = 0.3
GOAL_M = 2.0
EDGE_M = 0.05
OFF_ROUTE_M = 15.0
STANDS_MPS = 0.1
STANDS_S = 3.0
TOUCHED_S = 2.0
BLOCKED_S = 30.0

_COLLISIONS = {
    "static": EventKind.COLLISION_STATIC,
    "vehicle": EventKind.COLLISION_VEHICLE,
    "pedestrian": EventKind.COLLISION_PEDESTRIAN,
}


@dataclass(frozen=True, slots=True)
class Contact:
    """The car touches something: what kind of thing, and which one."""

    kind: str
    name: str


class Judge:
    """Watches one drive for events.

    A collision counts once per object and drive. Being in the wrong lane and having left the road, over the sidewalk or
    not, count when they begin, and again only after two seconds without.
    """

    def __init__(self, roads: RoadMap) -> None:
        self._roads = roads
        self._hit: set[str] = set()
        self._last: dict[str, float] = {}

    def watch(
        self, state: VehicleState, time_s: float, contacts: Sequence[Contact], people: Float[np.ndarray, "m 2"]
    ) -> tuple[Event, ...]:
        """Events that begin now.

        Args:
            state: where the car is now.
            time_s: seconds since the start.
            contacts: what the car touches.
            people: world x, y of everyone on foot.
        """
        touched = [*contacts, *(Contact("pedestrian", f"pedestrian {i}") for i in people_hit(state, people))]
        events: list[Event] = []
        for contact in touched:
            if contact.name not in self._hit:
                self._hit.add(contact.name)
                events.append(Event(_COLLISIONS[contact.kind], time_s, contact.name))
        for kind, detail in self._departures(state):
            last = self._last.get(kind.departure, -math.inf)
            self._last[kind.departure] = time_s
            if time_s - last > RECOUNT_S:
                events.append(Event(kind, time_s, detail))
        return tuple(events)

    def _departures(self, state: VehicleState) -> list[tuple[EventKind, str]]:
        """What is the matter with where the car is now."""
        *below, middle = self._roads.surface_at(np.array([*wheels(state), (state.x_m, state.y_m)])).tolist()
        found: list[tuple[EventKind, str]] = []
        if Surface.SIDEWALK in below:
            found.append((EventKind.SIDEWALK, "a wheel on the sidewalk"))
        if Surface.OTHER in below:
            found.append((EventKind.OFF_ROAD, "a wheel off the road"))
        place = self._roads.nearest_lane(state.x_m, state.y_m, state.yaw_rad)
        lane = self._roads.lanes[place.lane]
        if middle == Surface.DRIVING and lane.junction is None:
            backwards = abs(place.heading_error_rad) > math.pi / 2
            if backwards or not self._keeps_side(place):
                found.append(
                    (EventKind.WRONG_LANE, f"{abs(place.lateral_m):.1f} m beside its lane on road {lane.road}")
                )
        return found

    def _keeps_side(self, place: LanePosition) -> bool:
        """Whether a car is on the lane whose middle is nearest, or on another of its road that leads the same way."""
        lane = self._roads.lanes[place.lane]
        if abs(place.lateral_m) <= lane.width_at(place.arclength_m) / 2 + EDGE_M:
            return True
        heading = lane.at(place.arclength_m)[3]
        leftwards = np.array([-math.sin(heading), math.cos(heading), 0.0])
        for other in self._roads.lanes:
            same_way = (other.road, other.section) == (lane.road, lane.section) and other.number * lane.number > 0
            if same_way and other.kind == "driving":
                # All lanes of a section have their points side by side.
                borders = np.column_stack([(side - lane.centre) @ leftwards for side in (other.right, other.left)])
                low, high = interpolated(place.arclength_m, lane.stations_m, borders).tolist()
                if low - EDGE_M <= place.lateral_m <= high + EDGE_M:
                    return True
        return False


class Endings:
    """Watches one drive for the reason why it is over.

    It is over at the goal, when its time is up, 15 m beside the route, three seconds after the car has come to stand
    where it touched something static, within two seconds of touching it, and when it has not moved for half a minute,
    whatever the reason.

    Args:
        route: the way to the goal.
        limit_s: the scenario's time limit.
    """

    def __init__(self, route: Route, limit_s: float) -> None:
        self._route, self._limit_s = route, limit_s
        self._touched_s, self._moved_s = -math.inf, 0.0

    def watch(
        self, state: VehicleState, place: RoutePosition, time_s: float, contacts: Sequence[Contact]
    ) -> Ending | None:
        """Why the drive is over now; None where it goes on.

        Args:
            state: where the car is now.
            place: where the car is along the route.
            time_s: seconds since the start.
            contacts: what the car touches.
        """
        if any(contact.kind == "static" for contact in contacts):
            self._touched_s = time_s
        if abs(state.speed_mps) > STANDS_MPS:
            self._moved_s = time_s
        stood_s = time_s - self._moved_s
        if place.arclength_m >= self._route.length_m - GOAL_M:
            return Ending.GOAL_REACHED
        if math.dist((state.x_m, state.y_m), self._route.at(place.arclength_m)[:2]) > OFF_ROUTE_M:
            return Ending.OFF_ROUTE
        if stood_s >= STANDS_S and self._touched_s >= self._moved_s - TOUCHED_S:
            return Ending.STANDS
        if stood_s >= BLOCKED_S:
            return Ending.BLOCKED
        return Ending.TIME_LIMIT if time_is_up(time_s, self._limit_s) else None


def time_is_up(time_s: float, limit_s: float) -> bool:
    """Whether a time limit is reached, whatever the rounding of steps."""
    return time_s >= limit_s - 1e-9


def wheels(state: VehicleState) -> list[tuple[float, float]]:
    """World x, y where the wheels touch the ground."""
    c, s = math.cos(state.yaw_rad), math.sin(state.yaw_rad)
    half, side = CAR_WHEELBASE_M / 2, TRACK_M / 2
    return [
        (state.x_m + c * a - s * b, state.y_m + s * a + c * b)
        for a, b in ((half, side), (half, -side), (-half, side), (-half, -side))
    ]


def people_hit(state: VehicleState, people: Float[np.ndarray, "m 2"]) -> list[int]:
    """Indices of the people whom the car's outline touches."""
    if not len(people):
        return []
    c, s = math.cos(state.yaw_rad), math.sin(state.yaw_rad)
    away = people - (state.x_m, state.y_m)
    ahead, left = away @ (c, s), away @ (-s, c)
    gap_x = np.maximum(np.abs(ahead) - CAR_LENGTH_M / 2, 0)
    gap_y = np.maximum(np.abs(left) - CAR_WIDTH_M / 2, 0)
    return [int(i) for i in np.flatnonzero(np.hypot(gap_x, gap_y) < PERSON_RADIUS_M)]
