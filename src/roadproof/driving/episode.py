"""One drive closed loop, in one file that explains itself: named NumPy arrays and a JSON header. Nothing is pickled."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from roadproof.datatypes import Ending, Event, VehicleState, Weather
from roadproof.errors import EpisodeError
from roadproof.io.html import table
from roadproof.io.records import RecordFile, Saved, check_arrays
from roadproof.simulators.protocol import PaintKind

_UNITS = {
    "time_s": "seconds since the start, one value an observation, as for all up to command",
    "x_m, y_m, z_m, yaw_rad": "pose of the car in the world, right-handed, z up, yaw 0 along x, left positive",
    "speed_mps": "m/s",
    "command": "2 follow, 3 left, 4 right, 5 straight",
    "steer": "in [-1, 1], positive = right, given after each observation but the last, as throttle and brake in [0, 1]",
}
SEEN = ("time_s", *VehicleState.__slots__, "command")
GIVEN = ("steer", "throttle", "brake")


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Episode(Saved):
    """One drive closed loop: n observations and the n − 1 controls between them.

    Args:
        scenario: name of the scenario.
        weather: the weather of the drive.
        painted: whether there was a pattern on the canvas.
        paint: how the simulator put the pattern on the road; rendered in older files, which are all of the town.
        cars: number of other cars that were asked for.
        pedestrians: number of pedestrians that were asked for.
        seed: seed of cars and pedestrians.
        dt_s: seconds per step.
        ending: why the drive ended.
        events: events of the drive, in order.
        time_s: seconds since the reset at each observation, (n,).
        x_m: world x of the car at each observation in metres, (n,); y_m and z_m likewise.
        yaw_rad: heading at each observation in radians, left positive, (n,).
        speed_mps: speed at each observation in m/s, (n,).
        command: what the route asks, in CARLA's codes (`datatypes.Command`), (n,).
        steer: steering given after each observation but the last, in [−1, 1], right positive, (n − 1,).
        throttle: throttle given with each steering, in [0, 1], (n − 1,).
        brake: brake given with each steering, in [0, 1], (n − 1,).

    Raises:
        EpisodeError: there is no observation, lengths differ, or a value is not finite.
    """

    scenario: str
    weather: Weather
    painted: bool
    cars: int
    pedestrians: int
    seed: int
    dt_s: float
    ending: Ending
    events: tuple[Event, ...]
    time_s: Float[np.ndarray, "..."]
    x_m: Float[np.ndarray, "..."]
    y_m: Float[np.ndarray, "..."]
    z_m: Float[np.ndarray, "..."]
    yaw_rad: Float[np.ndarray, "..."]
    speed_mps: Float[np.ndarray, "..."]
    command: Int[np.ndarray, "..."]
    steer: Float[np.ndarray, "..."]
    throttle: Float[np.ndarray, "..."]
    brake: Float[np.ndarray, "..."]
    paint: PaintKind = PaintKind.RENDERED

    def __post_init__(self) -> None:
        count = len(self)
        if count == 0:
            raise EpisodeError("the episode has no observation, expected at least the one after the reset")
        check_arrays(self, SEEN, (count,), "of the episode", EpisodeError)
        check_arrays(self, GIVEN, (count - 1,), "of the episode", EpisodeError)

    def __len__(self) -> int:
        """How many observations there are."""
        return self.time_s.size

    def _repr_html_(self) -> str:
        """How a notebook shows it: what was driven, and how it ended."""
        events = ", ".join(f"{each.kind} at {each.time_s:.1f} s" for each in self.events)
        rows = (
            ("scenario", f"{self.scenario}, {self.weather}"),
            ("paint", self.paint if self.painted else "none"),
            ("others on the road", f"{self.cars} cars, {self.pedestrians} pedestrians, seed {self.seed}"),
            ("ended", f"{self.ending}, after {self.time_s[-1] - self.time_s[0]:.1f} s"),
            ("events", events or "none"),
        )
        return table(("drive", ""), rows)

    def state(self, step: int) -> VehicleState:
        """Pose and speed of the car at an observation."""
        return VehicleState(*(float(getattr(self, name)[step]) for name in VehicleState.__slots__))


Episode.FILE = RecordFile(
    kind=Episode,
    name="roadproof-episode",
    error=EpisodeError,
    remedy="check the path, or drive it again",
    notes={"units": _UNITS},
)
