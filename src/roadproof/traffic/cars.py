"""Cars that follow the lanes and each other and take turns at junctions.

A junction is claimed before it is entered: a car is let in when nobody holds a way that crosses its own, the driven car
is neither in the junction nor about to be, and there is room behind it. So two cars never meet in a junction and none
stops inside for want of room, which is what gridlock is made of.
"""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Bool, Float, Int

from roadproof.datatypes import VehicleState
from roadproof.errors import SimulatorError
from roadproof.roads.roadmap import RoadMap
from roadproof.traffic.agents import (
    CAR_LENGTH_M,
    CAR_WIDTH_M,
    NOBODY,
    Agents,
    first_in_way,
    idm_acceleration,
    obstacles,
)
from roadproof.traffic.tracks import Tracks

PLAN = 4
AHEAD_M = np.arange(2.5, 32.0, 1.5)
STOP_LINE_M = 5.5
CLEAR_M = 2.6
SPACING_M = 14.0
FIRST_M = 4.0
FROM_EGO_M = 25.0
ROOM_M = 9.0


class Cars:
    """All other cars of a drive; the same seed and the same ego give the same traffic."""

    def __init__(self, road_map: RoadMap, count: int, seed: int, ego: VehicleState) -> None:
        """Place the cars.

        Raises:
            SimulatorError: so many cars do not fit on the map.
        """
        self._map = road_map
        self._tracks = Tracks(road_map, "driving")
        self._conflict = self._tracks.conflicts(CLEAR_M)
        self._dead_end: Bool[np.ndarray, " t"] = np.array([not after for after in self._tracks.successors], dtype=bool)
        self._choosers = [np.random.default_rng([seed, 1, car]) for car in range(count)]
        rng = np.random.default_rng([seed, 0])
        self._wanted = rng.uniform(6.0, 8.5, count)
        self._look = rng.integers(0, 65536, count)
        self._plan: Int[np.ndarray, "n p"] = np.zeros((count, PLAN), dtype=np.intp)
        self._s_m = np.zeros(count)
        self._place(rng, ego)
        self._speed = 0.6 * self._wanted
        self._travelled = np.zeros(count)
        self._claim: list[int | None] = [None] * count
        self._waiting = np.zeros(count)

    def _place(self, rng: np.random.Generator, ego: VehicleState) -> None:
        tracks = self._tracks
        last_m = tracks.length_m - STOP_LINE_M - 3.0
        streets = [t for t, junction in enumerate(tracks.junction) if junction is None and last_m[t] > FIRST_M]
        if len(self._s_m) and not streets:
            raise SimulatorError(f"{len(self._s_m)} cars do not fit on the map, which has no street; ask for none")
        share = tracks.length_m[streets] / tracks.length_m[streets].sum()
        taken = [(ego.x_m, ego.y_m, FROM_EGO_M)]
        for car in range(len(self._s_m)):
            for _ in range(500):
                track = streets[int(rng.choice(len(streets), p=share))]
                s = float(rng.uniform(FIRST_M, float(last_m[track])))
                x, y, _ = tracks.points(np.array([track]), np.array([s]))
                if all(math.dist((float(x[0]), float(y[0])), (px, py)) > free for px, py, free in taken):
                    break
            else:
                raise SimulatorError(f"{len(self._s_m)} cars do not fit on the map; ask for fewer")
            taken.append((float(x[0]), float(y[0]), SPACING_M))
            self._s_m[car] = s
            self._plan[car, 0] = track
            for step in range(1, PLAN):
                self._plan[car, step] = self._choose(car, int(self._plan[car, step - 1]))

    def _choose(self, car: int, track: int) -> int:
        """Where the car goes after a track; the track itself where it leads nowhere."""
        after = self._tracks.successors[track]
        return after[int(self._choosers[car].integers(len(after)))] if after else track

    @property
    def agents(self) -> Agents:
        """The cars as they are now."""
        if len(self._s_m) == 0:
            return NOBODY
        x, y, _ = self._tracks.points(self._plan[:, 0], self._s_m)
        yaw = self._tracks.yaws(self._plan[:, 0], self._s_m)
        return Agents(x, y, yaw, self._speed.copy(), self._travelled.copy(), self._look)

    def step(self, dt_s: float, now: Agents, people: Agents, ego: VehicleState) -> None:
        """Drive on for dt_s seconds, seeing the cars and people as they are now."""
        if len(self._s_m) == 0:
            return
        x, y, limit = self._ahead()
        things = obstacles(now, people, ego)
        own = np.arange(len(now))
        free_m, leader = first_in_way(x, y, AHEAD_M, things, own, margin_m=0.5 * CAR_WIDTH_M)
        # Slow in time for a bend: v² ≤ limit² + 2·b·d.
        bend = np.sqrt((limit * limit + 2.0 * 1.5 * AHEAD_M).min(axis=1))
        wanted = np.minimum(self._wanted, bend)
        acceleration = idm_acceleration(self._speed, wanted, free_m - 0.5 * CAR_LENGTH_M, leader)
        stop_m = self._junction_stops(now, ego)
        gap = np.maximum(stop_m, 0.0) + 2.0
        acceleration = np.minimum(acceleration, idm_acceleration(self._speed, wanted, gap, np.zeros_like(gap)))
        after = np.maximum(self._speed + acceleration * dt_s, 0.0)
        moved = 0.5 * (self._speed + after) * dt_s
        self._speed = after
        self._waiting = np.where(after < 0.3, self._waiting + dt_s, 0.0)
        self._s_m += moved
        self._travelled += moved
        for car in np.flatnonzero(self._s_m > self._tracks.length_m[self._plan[:, 0]]).tolist():
            self._enter_next(car)

    def _ahead(self) -> tuple[Float[np.ndarray, "n k"], Float[np.ndarray, "n k"], Float[np.ndarray, "n k"]]:
        """Points along the way of each car, and the speed allowed there."""
        length = self._tracks.length_m[self._plan]
        ends = np.cumsum(length, axis=1)
        # Beyond a dead end the way goes straight on.
        onward = np.where(self._dead_end[self._plan], np.inf, ends)
        s = self._s_m[:, None] + AHEAD_M
        step = (s[:, :, None] >= onward[:, None, :-1]).sum(axis=2)
        rows = np.arange(len(s))[:, None]
        return self._tracks.points(self._plan[rows, step], s - (ends - length)[rows, step])

    def _enter_next(self, car: int) -> None:
        track = int(self._plan[car, 0])
        if not self._tracks.successors[track]:
            self._s_m[car] = self._tracks.length_m[track]  # a dead end: stay
            self._speed[car] = 0.0
            return
        self._s_m[car] -= self._tracks.length_m[track]
        self._plan[car, :-1] = self._plan[car, 1:]
        self._plan[car, -1] = self._choose(car, int(self._plan[car, -2]))

    def _junction_stops(self, now: Agents, ego: VehicleState) -> Float[np.ndarray, " n"]:
        """How far each car may go before it must wait at a junction or a dead end; inf where it need not."""
        tracks = self._tracks
        current, following = self._plan[:, 0].tolist(), self._plan[:, 1].tolist()
        to_end = (tracks.length_m[self._plan[:, 0]] - self._s_m).tolist()
        taken = self._ego_junction(ego)
        stops = np.full(len(current), np.inf)
        asking: list[int] = []
        for car, track in enumerate(current):
            claim = self._claim[car]
            if tracks.junction[track] is not None:
                self._claim[car] = track
                continue
            if claim is not None and claim != following[car]:
                if self._s_m[car] < 0.5 * CAR_LENGTH_M + 0.5:
                    continue
                self._claim[car] = claim = None
            if self._dead_end[track]:
                stops[car] = to_end[car] - 0.5 * CAR_LENGTH_M
                continue
            if tracks.junction[following[car]] is None:
                continue
            to_line = to_end[car] - 0.5 * CAR_LENGTH_M - STOP_LINE_M
            speed = float(self._speed[car])
            if claim is not None and (tracks.junction[claim] != taken or to_line < speed * speed / 8.0):
                continue
            self._claim[car] = None
            stops[car] = to_line
            if to_line < 6.0 + speed * speed / 4.0 and tracks.junction[following[car]] != taken:
                asking.append(car)
        for car in sorted(asking, key=lambda car: (-float(self._waiting[car]), car)):
            if self._may_enter(car, now):
                self._claim[car] = following[car]
                stops[car] = np.inf
        return stops

    def _may_enter(self, car: int, now: Agents) -> bool:
        way = int(self._plan[car, 1])
        held = [claim for other, claim in enumerate(self._claim) if claim is not None and other != car]
        if any(self._conflict[way, claim] for claim in held):
            return False
        behind: Bool[np.ndarray, " n"] = (self._plan[:, 0] == self._plan[car, 2]) & (self._s_m < ROOM_M)
        coming = [other for other, claim in enumerate(self._claim) if claim == way and other != car]
        return not (behind & (now.speed_mps < 2.0)).any() and not any(now.speed_mps[other] < 1.0 for other in coming)

    def _ego_junction(self, ego: VehicleState) -> str | None:
        """The junction the driven car is in or about to enter."""
        found = self._map.nearest_lane(ego.x_m, ego.y_m, ego.yaw_rad)
        lane = self._map.lanes[found.lane]
        if lane.junction is not None:
            return lane.junction
        track, start_m = self._tracks.place[found.lane]
        to_end = float(self._tracks.length_m[track]) - start_m - found.arclength_m
        if to_end > max(10.0, 3.5 * ego.speed_mps) or abs(found.heading_error_rad) > math.pi / 3:
            return None
        return next((self._tracks.junction[after] for after in self._tracks.successors[track]), None)
