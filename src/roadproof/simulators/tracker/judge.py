"""What went wrong on a drive, as facts: each thing hit once, each departure from the lane once until it is over."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from roadproof.datatypes import Event, EventKind, VehicleState
from roadproof.roads.roadmap import RoadMap, Surface

LENGTH_M, WIDTH_M, HEIGHT_M = 4.5, 1.9, 1.45
WHEELBASE_M, TRACK_M = 2.8, 1.6
"""Measures of the driven car."""

PERSON_RADIUS_M = 0.3
REARM_S = 1.0

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
    """Watches one drive.

    A collision counts once per object and drive. Wrong lane, sidewalk and off road count when they begin, and again
    only after a second without.
    """

    def __init__(self, roads: RoadMap) -> None:
        self._roads = roads
        self._hit: set[str] = set()
        self._last: dict[EventKind, float] = {}

    def watch(
        self, state: VehicleState, time_s: float, contacts: Sequence[Contact], people: Float[np.ndarray, "m 2"]
    ) -> tuple[Event, ...]:
        """Events that begin now.

        Args:
            state: of the car.
            time_s: now.
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
            last = self._last.get(kind, -math.inf)
            self._last[kind] = time_s
            if time_s - last > REARM_S:
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
            if backwards or abs(place.lateral_m) > lane.width_m / 2 + 0.05:
                found.append(
                    (EventKind.WRONG_LANE, f"{abs(place.lateral_m):.1f} m beside its lane on road {lane.road}")
                )
        return found


def wheels(state: VehicleState) -> list[tuple[float, float]]:
    """World x, y where the wheels touch the ground."""
    c, s = math.cos(state.yaw_rad), math.sin(state.yaw_rad)
    half, side = WHEELBASE_M / 2, TRACK_M / 2
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
    gap_x = np.maximum(np.abs(ahead) - LENGTH_M / 2, 0)
    gap_y = np.maximum(np.abs(left) - WIDTH_M / 2, 0)
    return [int(i) for i in np.flatnonzero(np.hypot(gap_x, gap_y) < PERSON_RADIUS_M)]
