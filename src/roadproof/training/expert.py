"""A driver that sees everything: the route, the other cars, the people. Training learns from what it would do.

Steering is pure pursuit from the rear axle; speed is the lowest of what is wanted, what bends ahead allow, and what the
intelligent driver model allows behind whatever stands or moves in the way.

References:
    Coulter (1992), Implementation of the pure pursuit path tracking algorithm.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from roadproof.datatypes import Control, Observation, VehicleState
from roadproof.roads.routes import Route
from roadproof.simulators.protocol import OpenWorld
from roadproof.traffic.agents import (
    CAR_LENGTH_M,
    CAR_WHEELBASE_M,
    CAR_WIDTH_M,
    MAX_STEER_RAD,
    NOBODY,
    Agents,
    first_in_way,
    idm_acceleration,
    obstacles,
)

FULL_THROTTLE_MPS2 = 4.2
FULL_BRAKE_MPS2 = 7.9
DRAG_PER_S = 0.025
STOP_LINE_M = 5.5
NEVER = -2
AHEAD_M = np.arange(1.0, 36.0, 1.0)
CRUISE_MPS = 7.5
"""Speed on a free, straight road."""
SIDE_MPS2, SLOW_MPS2 = 2.2, 1.8
"""Lateral acceleration that bends are taken with, and deceleration before them."""
SIGHT_S, SIGHT_M = 0.75, 4.5
"""How far ahead of its rear axle the expert steers to, in seconds of travel, and at least."""


def expert(world: OpenWorld) -> Callable[[Observation], Control]:
    """The expert as the driver of a `rollout`: made after the reset, it drives what is under way."""
    driver = Expert(world.route)
    return lambda seen: driver.drive(seen.state, world.cars, world.pedestrians)


class Expert:
    """Drives one route; make a new one for every drive."""

    def __init__(self, route: Route) -> None:
        self._route = route
        self._limit_mps = speed_limits(route)
        self._at_m: float | None = None

    def drive(self, state: VehicleState, cars: Agents = NOBODY, pedestrians: Agents = NOBODY) -> Control:
        """What to do for the next step.

        Args:
            state: pose and speed of the driven car now.
            cars: the other cars as they are now.
            pedestrians: the people as they are now.
        """
        place = self._route.locate(state.x_m, state.y_m, self._at_m)
        self._at_m = place.arclength_m
        wanted = float(np.interp(self._at_m + 0.2 * state.speed_mps, self._route.arclengths_m, self._limit_mps))
        acceleration = float(np.clip(1.5 * (wanted - state.speed_mps), -4.0, 2.5))
        acceleration = min(acceleration, self._behind(state, wanted, cars, pedestrians))
        acceleration = min(acceleration, self._before_junction(state, wanted, cars))
        throttle, brake = pedals(acceleration, state.speed_mps)
        return Control(steer=self._steer(state), throttle=throttle, brake=brake)

    def _steer(self, state: VehicleState) -> float:
        """Pure pursuit: the arc from the rear axle through a point of the route ahead; positive to the right."""
        assert self._at_m is not None
        c, s = math.cos(state.yaw_rad), math.sin(state.yaw_rad)
        rear_x, rear_y = state.x_m - 0.5 * CAR_WHEELBASE_M * c, state.y_m - 0.5 * CAR_WHEELBASE_M * s
        sight = max(SIGHT_M, SIGHT_S * state.speed_mps)
        x, y = self._route.ahead(np.array([self._at_m - 0.5 * CAR_WHEELBASE_M + sight]))[0].tolist()
        dx, dy = x - rear_x, y - rear_y
        aside, apart = dy * c - dx * s, math.hypot(dx, dy)
        wheel = math.atan(2.0 * CAR_WHEELBASE_M * aside / max(apart * apart, 1e-6))
        return min(max(-wheel / MAX_STEER_RAD, -1.0), 1.0)

    def _behind(self, state: VehicleState, wanted: float, cars: Agents, pedestrians: Agents) -> float:
        """Acceleration that keeps clear of the first thing in the way."""
        if len(cars) + len(pedestrians) == 0:
            return math.inf
        assert self._at_m is not None
        x, y = self._route.ahead(self._at_m + AHEAD_M).T
        free_m, leader = first_in_way(
            x[None],
            y[None],
            AHEAD_M,
            obstacles(cars, pedestrians, None),
            np.array([NEVER]),
            margin_m=0.5 * CAR_WIDTH_M + 0.2,
        )
        return _idm(state.speed_mps, wanted, float(free_m[0]) - 0.5 * CAR_LENGTH_M, float(leader[0]))

    def _before_junction(self, state: VehicleState, wanted: float, cars: Agents) -> float:
        """Acceleration that stops at the line of a junction while another car is inside."""
        assert self._at_m is not None
        for crossing in self._route.crossings:
            line_m = crossing.enters_m - STOP_LINE_M - 0.5 * CAR_LENGTH_M - self._at_m
            if line_m < -1.0 or line_m > 30.0:
                continue
            inside = np.hypot(cars.x_m - crossing.x_m, cars.y_m - crossing.y_m) < crossing.radius_m
            # Who drives on before us leaves the junction as we do: the distance to him is kept, not to the line.
            along = np.cos(cars.yaw_rad - self._route.at(self._at_m)[3]) > 0.9
            if (inside & ~along).any():
                return _idm(state.speed_mps, wanted, max(line_m, 0.0) + 2.0, 0.0)
        return math.inf


def speed_limits(route: Route) -> Float[np.ndarray, " n"]:
    """Speed at each point of a route so that bends are entered slowly enough, m/s."""
    ds = np.diff(route.arclengths_m)
    smooth = np.convolve(np.pad(np.diff(route.headings_rad) / ds, 3, mode="edge"), np.full(7, 1 / 7), mode="valid")
    curvature = np.abs(np.concatenate([smooth, smooth[-1:]]))
    limit = np.minimum(np.sqrt(SIDE_MPS2 / np.maximum(curvature, 1e-6)), CRUISE_MPS)
    # v² may fall by 2·a·ds a point at most: the lower envelope of rising lines, from the end.
    budget = 2.0 * SLOW_MPS2 * route.arclengths_m
    return np.sqrt(np.minimum.accumulate((limit**2 + budget)[::-1])[::-1] - budget)


def pedals(acceleration_mps2: float, speed_mps: float) -> tuple[float, float]:
    """Throttle and brake for an acceleration."""
    push = acceleration_mps2 + DRAG_PER_S * speed_mps
    if push >= 0.0:
        return min(push / FULL_THROTTLE_MPS2, 1.0), 0.0
    return 0.0, min(-acceleration_mps2 / FULL_BRAKE_MPS2, 1.0)


def _idm(speed: float, wanted: float, gap_m: float, leader: float) -> float:
    one = (np.array([value]) for value in (speed, wanted, gap_m, leader))
    return float(idm_acceleration(*one, gain=2.5)[0])
