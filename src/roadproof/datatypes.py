"""The nouns that pass between simulators, controllers and rollouts.

Convention:
    Right-handed world, metres, radians, z up; yaw 0 looks along x, y points left. `steer` is in [−1, 1] and
    positive to the right. Images are RGB, (H, W, 3) uint8.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import IntEnum, StrEnum

import numpy as np
from jaxtyping import UInt8

from roadproof.errors import SimulatorError


class Command(IntEnum):
    """What the route asks at the next junction, with CARLA's codes."""

    FOLLOW = 2
    LEFT = 3
    RIGHT = 4
    STRAIGHT = 5


class Weather(StrEnum):
    """Sky, light and road of a drive: the paper's (`PAPER_WEATHERS`), and four more for robustness."""

    CLEAR_NOON = "clear-noon"
    CLOUDY_NOON = "cloudy-noon"
    RAINY_NOON = "rainy-noon"
    CLEAR_SUNSET = "clear-sunset"
    CLOUDY_SUNSET = "cloudy-sunset"
    WET_NOON = "wet-noon"
    HARD_RAIN_NOON = "hard-rain-noon"
    FOGGY_MORNING = "foggy-morning"

    @classmethod
    def _missing_(cls, value: object) -> Weather:
        raise SimulatorError(f"weather {value!r} is unknown, expected one of {', '.join(cls)}")


PAPER_WEATHERS = (Weather.CLEAR_NOON, Weather.CLOUDY_NOON, Weather.RAINY_NOON, Weather.CLEAR_SUNSET)


@dataclass(frozen=True, slots=True)
class Control:
    """What a driver does to the car for one step.

    Args:
        steer: steering, from −1 (full left) to 1 (full right).
        throttle: throttle, 0 to 1.
        brake: brake, 0 to 1.

    Raises:
        SimulatorError: a value is not finite. Values outside their range are the caller's to clip (`clipped`).
    """

    steer: float
    throttle: float = 0.0
    brake: float = 0.0

    def __post_init__(self) -> None:
        for name in ("steer", "throttle", "brake"):
            if not math.isfinite(getattr(self, name)):
                raise SimulatorError(
                    f"control {name} is {getattr(self, name)}, expected a finite number; check the controller"
                )

    def clipped(self) -> Control:
        """The same control with every value inside its range."""
        return Control(
            steer=min(max(self.steer, -1.0), 1.0),
            throttle=min(max(self.throttle, 0.0), 1.0),
            brake=min(max(self.brake, 0.0), 1.0),
        )


@dataclass(frozen=True, slots=True)
class VehicleState:
    """Where the car is (centre of its rear-to-front axis, on the ground) and how it moves, in the world frame."""

    x_m: float
    y_m: float
    z_m: float = 0.0
    yaw_rad: float = 0.0
    speed_mps: float = 0.0


@dataclass(frozen=True, kw_only=True, slots=True)
class Obstacle:
    """A box on the ground that stops a car, such as a piece of a guard rail, a wall or a post.

    Args:
        x_m: world x of its middle, metres; y_m likewise.
        yaw_rad: direction of its length, radians, left positive.
        half_length_m: half its length, metres, 0 to 1,000.
        half_width_m: half its width, metres, 0 to 1,000.

    Raises:
        SimulatorError: a value is out of its range.
    """

    x_m: float
    y_m: float
    yaw_rad: float
    half_length_m: float
    half_width_m: float

    def __post_init__(self) -> None:
        placed = all(abs(value) < 1e9 for value in (self.x_m, self.y_m, self.yaw_rad))
        if not (placed and 0 <= self.half_length_m <= 1e3 and 0 <= self.half_width_m <= 1e3):
            raise SimulatorError(f"{self} is no obstacle; expected finite numbers, and half sizes of 0 to 1,000 m")


class EventKind(StrEnum):
    """What can go wrong on a drive, in the words of the 2019 CARLA challenge."""

    COLLISION_STATIC = "collision-static"
    COLLISION_VEHICLE = "collision-vehicle"
    COLLISION_PEDESTRIAN = "collision-pedestrian"
    RED_LIGHT = "red-light"
    STOP_SIGN = "stop-sign"
    WRONG_LANE = "wrong-lane"
    SIDEWALK = "sidewalk"
    OFF_ROAD = "off-road"

    @property
    def departure(self) -> str:
        """What tells a departure from others: leaving the road is one, over the sidewalk or not."""
        return "off" if self in (EventKind.SIDEWALK, EventKind.OFF_ROAD) else self


RECOUNT_S = 2.0
"""The same fault again within this time is still the same fault: the 20 frames at 10 Hz of CARLA's first benchmark."""


@dataclass(frozen=True, slots=True)
class Event:
    """One event of a drive: its kind, when it happened, and what or who was involved, or where, as free text."""

    kind: EventKind
    time_s: float
    detail: str = ""


class Ending(StrEnum):
    """Why a drive ended."""

    GOAL_REACHED = "goal reached"
    TIME_LIMIT = "time limit"
    OFF_ROUTE = "off the route"
    STANDS = "standing after a collision"
    BLOCKED = "blocked"
    STOPPED = "stopped"
    LEFT_RECORDED = "left the recorded stretch"


@dataclass(frozen=True, slots=True, eq=False)
class Observation:
    """What a simulator shows after a reset or a step.

    Args:
        frame: the controller's input, (H, W, 3) uint8 RGB.
        state: state of the vehicle in the world.
        command: what the route asks at the next junction.
        time_s: seconds since the reset.
        events: what happened since the last observation.
        done: whether the drive is over.
        picture: full camera picture, RGB; None where it was not asked for.
        ending: why the drive is over; if a simulator does not say, it is the goal or the time limit.
    """

    frame: UInt8[np.ndarray, "h w 3"]
    state: VehicleState
    command: Command
    time_s: float
    events: tuple[Event, ...] = ()
    done: bool = False
    picture: UInt8[np.ndarray, "hc wc 3"] | None = None
    ending: Ending | None = None

    @property
    def shown(self) -> UInt8[np.ndarray, "hs ws 3"]:
        """The most detailed picture there is: the full camera picture, or the frame without one."""
        return self.frame if self.picture is None else self.picture

    def copied(self) -> Observation:
        """The same with pictures of its own: a driver may write into what it is given."""
        picture = None if self.picture is None else self.picture.copy()
        return replace(self, frame=self.frame.copy(), picture=picture)
