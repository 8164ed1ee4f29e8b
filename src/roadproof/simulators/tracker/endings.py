"""When a drive is over, by the rules of the 2019 CARLA challenge as far as one canvas needs them."""

from __future__ import annotations

import math
from collections.abc import Sequence

from roadproof.datatypes import Ending, Event, EventKind, VehicleState
from roadproof.roads.routes import Route, RoutePosition

GOAL_M = 2.0
OFF_ROUTE_M = 15.0
STANDS_MPS = 0.1
STANDS_S = 3.0
BLOCKED_S = 30.0


class Endings:
    """Watches one drive.

    It is over at the goal, when its time is up, 15 m beside the route, three seconds after the car has come to stand
    where it had hit something static, and when it has not moved for half a minute, whatever the reason.

    Args:
        route: the way to the goal.
        limit_s: the scenario's time limit.
    """

    def __init__(self, route: Route, limit_s: float) -> None:
        self._route, self._limit_s = route, limit_s
        self._hit, self._moved_s = False, 0.0

    def watch(self, state: VehicleState, place: RoutePosition, time_s: float, events: Sequence[Event]) -> Ending | None:
        """Why the drive is over now, or None.

        Args:
            state: of the car.
            place: where it is along the route.
            time_s: now.
            events: that began now.
        """
        self._hit |= any(event.kind is EventKind.COLLISION_STATIC for event in events)
        if abs(state.speed_mps) > STANDS_MPS:
            self._moved_s = time_s
        stood_s = time_s - self._moved_s
        if place.arclength_m >= self._route.length_m - GOAL_M:
            return Ending.GOAL_REACHED
        if math.dist((state.x_m, state.y_m), self._route.at(place.arclength_m)[:2]) > OFF_ROUTE_M:
            return Ending.OFF_ROUTE
        if self._hit and stood_s >= STANDS_S:
            return Ending.STANDS
        if stood_s >= BLOCKED_S:
            return Ending.BLOCKED
        return Ending.TIME_LIMIT if time_is_up(time_s, self._limit_s) else None


def time_is_up(time_s: float, limit_s: float) -> bool:
    """Whether a time limit is reached, whatever the rounding of steps."""
    return time_s >= limit_s - 1e-9
