"""What moves in the town besides the car that is driven, as arrays; and who stands in whose way."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from roadproof.datatypes import VehicleState

CAR_LENGTH_M, CAR_WIDTH_M, CAR_WHEELBASE_M = 4.5, 1.9, 2.8
"""An ordinary car's: that of the controller, and of others."""
MAX_STEER_RAD = 0.65
"""How far its front wheels turn to either side."""

CAR_DISC_M = 1.0
CAR_DISCS_M = (-1.6, 0.0, 1.6)
PERSON_M = 0.35
FORESIGHT_S = 1.0
COMFORT_MPS2, HEADWAY_S, STANDSTILL_M = 2.5, 1.2, 2.0
"""Of a driver: the deceleration aimed at, the time kept to the car ahead, and the distance kept to it at rest."""


@dataclass(frozen=True, slots=True, eq=False)
class Agents:
    """Cars or people at one moment.

    Args:
        x_m: world x of each one's middle, metres.
        y_m: world y of each one's middle, metres.
        yaw_rad: direction in which each one faces.
        speed_mps: speed of each one in the direction it faces.
        travelled_m: how far each one has come, for the turning of wheels and the swing of legs.
        look: a number that picks each one's colour and shape, 0 to 65535.
    """

    x_m: Float[np.ndarray, " n"]
    y_m: Float[np.ndarray, " n"]
    yaw_rad: Float[np.ndarray, " n"]
    speed_mps: Float[np.ndarray, " n"]
    travelled_m: Float[np.ndarray, " n"]
    look: Int[np.ndarray, " n"]

    def __len__(self) -> int:
        return len(self.x_m)


NOBODY = Agents(*(np.zeros(0) for _ in range(5)), look=np.zeros(0, dtype=np.int64))


@dataclass(frozen=True, slots=True, eq=False)
class Obstacles:
    """Discs that stand in the way: where, how large, how fast, and whose they are (index of the car; −1: none)."""

    x_m: Float[np.ndarray, " m"]
    y_m: Float[np.ndarray, " m"]
    radius_m: Float[np.ndarray, " m"]
    vx_mps: Float[np.ndarray, " m"]
    vy_mps: Float[np.ndarray, " m"]
    owner: Int[np.ndarray, " m"]


def obstacles(cars: Agents, people: Agents, ego: VehicleState | None) -> Obstacles:
    """Three discs for each car and for the driven one (last), two for each person: here, and a second ahead."""
    x, y, yaw, speed = cars.x_m, cars.y_m, cars.yaw_rad, cars.speed_mps
    owner = np.arange(len(cars))
    if ego is not None:
        x, y = np.append(x, ego.x_m), np.append(y, ego.y_m)
        yaw, speed, owner = np.append(yaw, ego.yaw_rad), np.append(speed, ego.speed_mps), np.append(owner, -1)
    c, s = np.cos(yaw), np.sin(yaw)
    pc, ps = np.cos(people.yaw_rad) * people.speed_mps, np.sin(people.yaw_rad) * people.speed_mps
    still = np.zeros(2 * len(people))
    return Obstacles(
        x_m=np.concatenate([*(x + d * c for d in CAR_DISCS_M), people.x_m, people.x_m + FORESIGHT_S * pc]),
        y_m=np.concatenate([*(y + d * s for d in CAR_DISCS_M), people.y_m, people.y_m + FORESIGHT_S * ps]),
        radius_m=np.concatenate([np.full(3 * len(x), CAR_DISC_M), np.full(2 * len(people), PERSON_M)]),
        vx_mps=np.concatenate([np.tile(speed * c, 3), still]),
        vy_mps=np.concatenate([np.tile(speed * s, 3), still]),
        owner=np.concatenate([np.tile(owner, 3), np.full(2 * len(people), -1)]),
    )


def first_in_way(
    path_x: Float[np.ndarray, "n k"],
    path_y: Float[np.ndarray, "n k"],
    ahead_m: Float[np.ndarray, " k"],
    things: Obstacles,
    own: Int[np.ndarray, " n"],
    *,
    margin_m: float,
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """How far each path is free, and how fast what ends it goes along it.

    Args:
        path_x: x of points along each path, metres.
        path_y: y of points along each path, metres.
        ahead_m: how far along a path its points lie.
        things: what may stand in the way.
        own: index of the car on each path, which does not stand in its own way; −2 where there is none.
        margin_m: half the width that must be free beside a disc.

    Returns:
        Distances (inf where nothing is in the way), and speeds along the path, at least 0, of the slowest there.
    """
    n, k = path_x.shape
    free_m, leader = np.full(n, np.inf), np.zeros(n)
    # Only what lies within reach of some path's own stretch is looked at closely.
    middle = k // 2
    reach = ahead_m[-1] - ahead_m[middle] + things.radius_m + margin_m + 1.0
    dx, dy = things.x_m - path_x[:, middle, None], things.y_m - path_y[:, middle, None]
    path, thing = np.nonzero((dx * dx + dy * dy < reach * reach) & (things.owner != own[:, None]))
    if len(path) == 0:
        return free_m, leader
    dx, dy = path_x[path] - things.x_m[thing, None], path_y[path] - things.y_m[thing, None]
    clear = things.radius_m[thing, None] + margin_m
    hit = dx * dx + dy * dy < clear * clear
    point: Int[np.ndarray, " p"] = hit.argmax(axis=1)
    point[~hit.any(axis=1)] = k
    nearest = np.full(n, k)
    np.minimum.at(nearest, path, point)
    first = np.flatnonzero((point < k) & (point == nearest[path]))
    path, thing, point = path[first], thing[first], point[first]
    after, before = np.minimum(point + 1, k - 1), np.maximum(point - 1, 0)
    ux, uy = path_x[path, after] - path_x[path, before], path_y[path, after] - path_y[path, before]
    along = (things.vx_mps[thing] * ux + things.vy_mps[thing] * uy) / np.maximum(np.hypot(ux, uy), 1e-6)
    free_m[path] = ahead_m[point]
    leader[path] = np.inf
    np.minimum.at(leader, path, np.maximum(along, 0.0))
    return free_m, leader


def idm_acceleration(
    speed: Float[np.ndarray, " n"],
    wanted: Float[np.ndarray, " n"],
    gap_m: Float[np.ndarray, " n"],
    leader: Float[np.ndarray, " n"],
    *,
    gain: float = 1.8,
) -> Float[np.ndarray, " n"]:
    """Acceleration of the intelligent driver model, m/s², not below −8.

    Args:
        speed: own speed of each car, m/s.
        wanted: speed that each car takes on a free road, m/s.
        gap_m: free distance to the leader; inf where there is none.
        leader: speed of the leader, m/s.
        gain: acceleration on a free road from rest, m/s².

    References:
        Treiber, Hennecke, Helbing (2000), Congested traffic states in empirical observations, eqs. 2 and 3.
    """
    closing = speed * (speed - leader) / (2 * np.sqrt(gain * COMFORT_MPS2))
    wish = STANDSTILL_M + np.maximum(speed * HEADWAY_S + closing, 0.0)
    closeness = wish / np.maximum(gap_m, 0.1)
    return np.maximum(gain * (1.0 - (speed / np.maximum(wanted, 0.1)) ** 4 - closeness * closeness), -8.0)
