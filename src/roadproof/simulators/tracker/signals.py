"""Red lights and stop signs that the car runs, by the rules of the 2019 CARLA challenge.

The rules are those of CARLA's scenario_runner, branch carla_challenge_1.0, classes RunningRedLightTest and
RunningStopTest. The docstrings below say where this code departs from them, and why.

Convention:
    Right-handed world, metres, radians, yaw 0 along x, as in `roadproof.datatypes`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from roadproof.datatypes import Event, EventKind, VehicleState
from roadproof.roads.lanes import Lane
from roadproof.roads.polylines import interpolated
from roadproof.roads.roadmap import RoadMap

LIGHT_REACH_M = 10.0
LINE_SHARE = 0.9
TAIL_M = (1.0, 4.0)
SIGN_REACH_M = 50.0
LOOK_AHEAD_M = 20.0
LOOK_STEP_M = 0.5
STOPPED_MPS = 0.1


@dataclass(frozen=True, kw_only=True, slots=True)
class TriggerVolume:
    """The box on the road in which a traffic light or a stop sign concerns a car.

    Args:
        x_m: world x of its middle, metres.
        y_m: world y of its middle, metres.
        z_m: world z of its middle, metres.
        yaw_rad: direction of its own x axis.
        half_x_m: half its extent along its own x axis, metres.
        half_y_m: half its extent along its own y axis, metres.
    """

    x_m: float
    y_m: float
    z_m: float
    yaw_rad: float
    half_x_m: float
    half_y_m: float

    def holds(self, points_m: Float[np.ndarray, "n 2"]) -> Bool[np.ndarray, " n"]:
        """Which points lie in it, seen from above."""
        c, s = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        away = points_m - (self.x_m, self.y_m)
        return (np.abs(away @ (c, s)) < self.half_x_m) & (np.abs(away @ (-s, c)) < self.half_y_m)


@dataclass(frozen=True, slots=True)
class StopLine:
    """The line before which a light stops cars: its middle, the direction in which they cross it, half its length."""

    x_m: float
    y_m: float
    heading_rad: float
    half_m: float

    def crossed_by(self, state: VehicleState) -> bool:
        """Whether the end of a car, from 1 m to 4 m behind its middle, lies across the line in its direction."""
        turned = state.yaw_rad - self.heading_rad
        if math.cos(turned) <= 0.0:
            return False
        c, s = math.cos(self.heading_rad), math.sin(self.heading_rad)
        dx, dy = state.x_m - self.x_m, state.y_m - self.y_m
        beyond_m, left_m = c * dx + s * dy, c * dy - s * dx
        # So far behind the car's middle the line passes through its axis.
        behind_m = beyond_m / math.cos(turned)
        return TAIL_M[0] <= behind_m <= TAIL_M[1] and abs(left_m - behind_m * math.sin(turned)) <= self.half_m


class RedLights:
    """Watches one drive for red lights that the car runs.

    A light is run when the end of the car crosses its stop line while it is red, with the middle of its trigger volume
    within 10 m of the car. So it does not matter what a light shows after the car has passed it. The same light counts
    again only after another one was run and the car has left its line.

    Three things differ from scenario_runner. It asks whether the car is on a lane that the line lies on; in a junction,
    lanes to all sides lie over each other and the nearest one may be any of them, so here the car has to cross the
    line in the direction of its lane instead. And it takes the trigger volume's x axis to lie across the road, which
    holds for lights that were placed by hand; here the line is as wide as the volume is across the lane. And it
    counts two lights of one line by turns, step after step; here each counts once.

    Args:
        roads: the map that is driven on.
        lights: the trigger volumes of all lights on the map.
    """

    def __init__(self, roads: RoadMap, lights: Sequence[TriggerVolume]) -> None:
        self._lights = tuple(lights)
        self._lines = tuple(stop_line(roads, light) for light in lights)
        self._middles = np.array([(light.x_m, light.y_m, light.z_m) for light in lights]).reshape(-1, 3)
        # The lights that do not count now.
        self._spent: set[int] = set()

    def watch(self, state: VehicleState, time_s: float, red: Callable[[int], bool]) -> tuple[Event, ...]:
        """Red lights that are run now.

        Args:
            state: where the car is now.
            time_s: seconds since the start.
            red: whether the light of this index is red; asked only of lights whose line the car is crossing.
        """
        near = _near(self._middles, (state.x_m, state.y_m, state.z_m), LIGHT_REACH_M)
        crossed = [i for i in near if self._lines[i].crossed_by(state)]
        run = [i for i in crossed if i not in self._spent and red(i)]
        if run:
            self._spent = self._spent.intersection(crossed).union(run)
        return tuple(Event(EventKind.RED_LIGHT, time_s, _named("traffic light", self._lights[i])) for i in run)


class StopSigns:
    """Watches one drive for stop signs that the car passes without having stopped.

    A sign concerns the car while the car, or a place on its lane up to 20 m ahead of it, lies in the sign's trigger
    volume. A car that was never slower than 0.1 m/s in all that time has run the sign when it no longer concerns it.
    One sign is dealt with at a time.

    Three things differ from scenario_runner. It looks ahead along the first of the ways through a junction, and so
    finds signs on roads that the car does not take; here the look ends where ways part. It looks at a place every
    metre, here every half metre, so that no small volume is missed. And it turns trigger volumes along the world's
    axes; here they lie as they stand.

    Args:
        roads: the map that is driven on.
        signs: the trigger volumes of all stop signs on the map.
    """

    def __init__(self, roads: RoadMap, signs: Sequence[TriggerVolume]) -> None:
        self._roads, self._signs = roads, tuple(signs)
        self._middles = np.array([(sign.x_m, sign.y_m) for sign in signs]).reshape(-1, 2)
        self._concerned_by: int | None = None
        self._stopped = False

    def watch(self, state: VehicleState, time_s: float) -> tuple[Event, ...]:
        """Stop signs that have been run now.

        Args:
            state: where the car is now.
            time_s: seconds since the start.
        """
        near = _near(self._middles, (state.x_m, state.y_m), SIGN_REACH_M)
        ahead = places_ahead(self._roads, state) if near else np.zeros((0, 2))
        concerning = [i for i in near if self._signs[i].holds(ahead).any()]
        events: tuple[Event, ...] = ()
        if self._concerned_by is not None and self._concerned_by not in concerning:
            if not self._stopped:
                events = (Event(EventKind.STOP_SIGN, time_s, _named("stop sign", self._signs[self._concerned_by])),)
            self._concerned_by = None
        if self._concerned_by is None and concerning:
            self._concerned_by, self._stopped = concerning[0], False
        self._stopped |= abs(state.speed_mps) < STOPPED_MPS
        return events


def stop_line(roads: RoadMap, light: TriggerVolume) -> StopLine:
    """Where the lane under a light's trigger volume enters its junction, or at the volume where no junction follows.

    The line is across the lane, as far beside its centre as the volume, and 0.9 times as long as the volume is wide:
    volumes that were placed by hand reach a little into the next lane.
    """
    # The nearest lane depends on the direction asked for, and that of the lane is not known yet.
    lane, station_m = min(
        (_lane_at(roads, light, light.yaw_rad + k * math.pi / 2) for k in range(4)),
        key=lambda found: math.dist(found[0].at(found[1])[:2], (light.x_m, light.y_m)),
    )
    x, y, _, heading = lane.at(station_m)
    left_m = (light.y_m - y) * math.cos(heading) - (light.x_m - x) * math.sin(heading)
    turned = light.yaw_rad - heading
    half_m = light.half_x_m * abs(math.sin(turned)) + light.half_y_m * abs(math.cos(turned))
    entered, entered_m = _entry(roads, lane, station_m)
    x, y, _, heading = entered.at(entered_m)
    return StopLine(x - left_m * math.sin(heading), y + left_m * math.cos(heading), heading, LINE_SHARE * half_m)


def places_ahead(roads: RoadMap, state: VehicleState) -> Float[np.ndarray, "n 2"]:
    """World x, y of the car, and of places on its lane up to 20 m ahead or to where ways part, half a metre apart."""
    here = roads.nearest_lane(state.x_m, state.y_m, state.yaw_rad)
    lane, station_m, left_m = roads.lanes[here.lane], here.arclength_m, LOOK_AHEAD_M
    places = [np.array([[state.x_m, state.y_m]])]
    while True:
        stations = np.arange(station_m, min(station_m + left_m, lane.length_m), LOOK_STEP_M)
        places.append(interpolated(stations, lane.stations_m, lane.centre[:, :2]))
        left_m -= lane.length_m - station_m
        if left_m <= 0.0 or len(lane.successors) != 1:
            return np.concatenate(places)
        lane, station_m = roads.lanes[lane.successors[0]], 0.0


def _lane_at(roads: RoadMap, light: TriggerVolume, yaw_rad: float) -> tuple[Lane, float]:
    found = roads.nearest_lane(light.x_m, light.y_m, yaw_rad)
    return roads.lanes[found.lane], found.arclength_m


def _entry(roads: RoadMap, lane: Lane, station_m: float) -> tuple[Lane, float]:
    """Where the way on enters a junction; the place itself where it lies in one or none follows."""
    way, way_m, seen = lane, station_m, {lane.index}
    while way.junction is None:
        if not way.successors or way.successors[0] in seen:
            return lane, station_m
        way, way_m = roads.lanes[way.successors[0]], 0.0
        seen.add(way.index)
    return way, way_m


def _near(middles: Float[np.ndarray, "n d"], place: tuple[float, ...], reach_m: float) -> list[int]:
    """Indices of the middles within reach of a place."""
    return np.flatnonzero(((middles - place) ** 2).sum(axis=1) <= reach_m**2).tolist()


def _named(what: str, volume: TriggerVolume) -> str:
    """A name for a light or sign by its place, which stays the same when a server renumbers its actors."""
    return f"{what} at ({volume.x_m:.1f}, {volume.y_m:.1f})"
