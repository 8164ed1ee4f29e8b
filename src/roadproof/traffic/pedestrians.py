"""People who walk round the blocks and, now and then, cross the road where no car is near."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float

from roadproof.datatypes import VehicleState
from roadproof.errors import SimulatorError
from roadproof.roads.polylines import interpolated
from roadproof.roads.roadmap import RoadMap
from roadproof.traffic.agents import NOBODY, Agents
from roadproof.traffic.tracks import Tracks

CROSSINGS_PER_S = 1.0 / 40.0
FROM_JUNCTION_M = 7.0
SIDEWAYS_M = 0.8
LOOK_OUT_S = 4.5
LOOK_OUT_M = 7.0
STEP_BACK_M = 2.2


class Pedestrians:
    """All people of a drive; the same seed and the same cars give the same people."""

    def __init__(self, road_map: RoadMap, count: int, seed: int) -> None:
        """Place the people.

        Raises:
            SimulatorError: the map has no sidewalks to walk on.
        """
        self._map = road_map
        self._tracks = Tracks(road_map, "sidewalk")
        if count and not self._tracks.chains:
            raise SimulatorError(f"{count} pedestrians were asked for, but the map has no sidewalks; ask for none")
        self._rng = np.random.default_rng([seed, 2])
        length = self._tracks.length_m
        share = length / length.sum() if len(length) else None
        self._track = self._rng.choice(max(len(length), 1), count, p=share).astype(np.intp)
        self._s_m = self._rng.random(count) * (length[self._track] if len(length) else 0.0)
        self._sense = self._rng.choice([-1.0, 1.0], count)
        self._aside_m = self._rng.uniform(-SIDEWAYS_M, SIDEWAYS_M, count)
        self._pace = self._rng.uniform(1.0, 1.6, count)
        self._look = self._rng.integers(0, 65536, count)
        self._speed = self._pace.copy()
        self._travelled = np.zeros(count)
        # A crossing is a straight line; `_left_m` of it is still to go.
        self._from = np.zeros((count, 2))
        self._to = np.zeros((count, 2))
        self._left_m = np.zeros(count)
        self._pairs = _opposite_sidewalks(road_map)

    @property
    def agents(self) -> Agents:
        """The people as they are now."""
        if len(self._s_m) == 0:
            return NOBODY
        x, y, yaw = self._walking()
        crossing = self._left_m > 0
        if crossing.any():
            way = self._to - self._from
            length = np.maximum(np.hypot(way[:, 0], way[:, 1]), 1e-9)
            done = 1.0 - self._left_m / length
            x = np.where(crossing, self._from[:, 0] + done * way[:, 0], x)
            y = np.where(crossing, self._from[:, 1] + done * way[:, 1], y)
            yaw = np.where(crossing, np.arctan2(way[:, 1], way[:, 0]), yaw)
        return Agents(x, y, yaw, self._speed.copy(), self._travelled.copy(), self._look)

    def _walking(self) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
        x, y, _ = self._tracks.points(self._track, self._s_m)
        yaw = self._tracks.yaws(self._track, self._s_m)
        x, y = x - self._aside_m * np.sin(yaw), y + self._aside_m * np.cos(yaw)
        return x, y, np.where(self._sense > 0, yaw, yaw + math.pi)

    def step(self, dt_s: float, now: Agents, cars: Agents, ego: VehicleState) -> None:
        """Walk on for dt_s seconds, seeing people and cars as they are now."""
        if len(self._s_m) == 0:
            return
        car_x, car_y = np.append(cars.x_m, ego.x_m), np.append(cars.y_m, ego.y_m)
        car_speed = np.append(cars.speed_mps, ego.speed_mps)
        crossing = self._left_m > 0
        # Nobody walks into a car: who has one right before him waits.
        ahead_x, ahead_y = now.x_m + 1.2 * np.cos(now.yaw_rad), now.y_m + 1.2 * np.sin(now.yaw_rad)
        near = np.hypot(ahead_x[:, None] - car_x, ahead_y[:, None] - car_y).min(axis=1) < STEP_BACK_M
        self._speed = np.where(crossing & near, 0.0, self._pace)
        moved = self._speed * dt_s
        self._travelled += moved
        self._s_m = np.where(crossing, self._s_m, self._s_m + self._sense * moved)
        self._left_m = np.where(crossing, np.maximum(self._left_m - moved, 0.0), 0.0)
        starting = (self._rng.random(len(moved)) < CROSSINGS_PER_S * dt_s) & ~crossing
        for who in np.flatnonzero((self._s_m < 0) | (self._s_m > self._tracks.length_m[self._track])).tolist():
            self._go_round(who)
        for who in np.flatnonzero(starting).tolist():
            self._cross(who, now, car_x, car_y, car_speed)

    def _go_round(self, who: int) -> None:
        """Go onto the next sidewalk, or back where there is none."""
        track, sense = int(self._track[who]), float(self._sense[who])
        onward = self._tracks.successors[track] if sense > 0 else self._tracks.predecessors[track]
        length = float(self._tracks.length_m[track])
        over = float(self._s_m[who]) - length if sense > 0 else -float(self._s_m[who])
        if not onward:
            self._sense[who] = -sense
            self._s_m[who] = length - over if sense > 0 else over
            return
        self._track[who] = onward[0]
        self._s_m[who] = over if sense > 0 else float(self._tracks.length_m[onward[0]]) - over

    def _cross(
        self,
        who: int,
        now: Agents,
        car_x: Float[np.ndarray, " c"],
        car_y: Float[np.ndarray, " c"],
        car_speed: Float[np.ndarray, " c"],
    ) -> None:
        """Start across the road, if it has a sidewalk on the other side and no car is near."""
        lane_index, at_m = self._tracks.lane_at(int(self._track[who]), float(self._s_m[who]))
        lane = self._map.lanes[lane_index]
        other = self._pairs.get(lane_index)
        if other is None or not FROM_JUNCTION_M < at_m < lane.length_m - FROM_JUNCTION_M:
            return
        across = self._map.lanes[other]
        arrives_m = across.length_m * (1.0 - at_m / lane.length_m)
        track, start_m = self._tracks.place[other]
        there = interpolated(arrives_m, across.stations_m, across.centre[:, :2])
        here = np.array([now.x_m[who], now.y_m[who]])
        middle = 0.5 * (here + there)
        apart = np.hypot(car_x - middle[0], car_y - middle[1])
        if (apart < LOOK_OUT_M + LOOK_OUT_S * car_speed).any():
            return
        self._from[who], self._to[who] = here, there
        self._left_m[who] = float(np.hypot(*(there - here)))
        self._track[who], self._s_m[who], self._aside_m[who] = track, start_m + arrives_m, 0.0


def _opposite_sidewalks(road_map: RoadMap) -> dict[int, int]:
    """For each sidewalk beside a road, the one on the other side."""
    walks = [lane for lane in road_map.lanes if lane.kind == "sidewalk" and lane.junction is None]
    by_side = {(lane.road, lane.section, lane.number > 0): lane.index for lane in walks}
    pairs = {lane.index: by_side.get((lane.road, lane.section, lane.number < 0)) for lane in walks}
    return {one: other for one, other in pairs.items() if other is not None}
