"""One drive closed loop, in one file that explains itself: named NumPy arrays and a JSON header. Nothing is pickled."""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from roadproof.datatypes import Ending, Event, VehicleState, Weather
from roadproof.errors import EpisodeError, SimulatorError
from roadproof.io.arrays import read_record, write_archive
from roadproof.simulators.protocol import PaintKind

FORMAT = "roadproof-episode"


FORMAT_VERSION = 1


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
class Episode:
    """One drive closed loop: n observations and the n − 1 controls between them.

    Args:
        scenario: its name.
        weather: of the drive.
        painted: whether there was a pattern on the canvas.
        paint: how the simulator puts one there.
        cars: how many others were asked for.
        pedestrians: how many people were asked for.
        seed: of cars and people.
        dt_s: seconds per step.
        ending: why it ended.
        events: what happened, in order.
        time_s: of each observation.
        x_m: of the car in the world, as y_m and z_m.
        yaw_rad: its heading, left positive.
        speed_mps: its speed.
        command: CARLA's codes (`datatypes.Command`).
        steer: given after each observation but the last, as throttle and brake; inside its range, right positive.

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
        count = self.time_s.size
        if count == 0:
            raise EpisodeError("the episode has no observation, expected at least the one after the reset")
        for name in (*SEEN, *GIVEN):
            values: np.ndarray = getattr(self, name)
            expected = (count if name in SEEN else count - 1,)
            if values.shape != expected:
                raise EpisodeError(
                    f"{name} of the episode has shape {values.shape}, expected {expected} for {count} observations"
                )
            if not np.isfinite(values).all():
                raise EpisodeError(f"{name} of the episode has NaN or infinite values")

    def __len__(self) -> int:
        """How many observations there are."""
        return self.time_s.size

    def state(self, step: int) -> VehicleState:
        """Where the car was at an observation, and how fast."""
        return VehicleState(*(float(getattr(self, name)[step]) for name in VehicleState.__slots__))

    def save(self, path: Path) -> None:
        """Write the episode to one file, all or nothing.

        Raises:
            OutputError: the file cannot be written.
        """
        header: dict[str, Any] = {"format": FORMAT, "version": FORMAT_VERSION}
        header |= {field.name: getattr(self, field.name) for field in fields(self) if field.name not in SEEN + GIVEN}
        header |= {"events": [asdict(event) for event in self.events], "units": _UNITS}
        write_archive(path, {name: getattr(self, name) for name in (*SEEN, *GIVEN)}, header)

    @classmethod
    def load(cls, path: Path) -> Episode:
        """Read an episode written by `save`.

        Raises:
            EpisodeError: the file is missing, damaged, no episode, or of a newer version.
        """
        remedy, known = "check the path, or drive it again", (FORMAT, FORMAT_VERSION)
        header, stored = read_record(path, (*SEEN, *GIVEN), EpisodeError, remedy, format_version=known)
        arrays = {name: values.astype(np.int64 if name == "command" else np.float64) for name, values in stored.items()}
        try:
            return cls(
                scenario=str(header["scenario"]),
                weather=Weather(header["weather"]),
                painted=bool(header["painted"]),
                cars=int(header["cars"]),
                pedestrians=int(header["pedestrians"]),
                seed=int(header["seed"]),
                dt_s=float(header["dt_s"]),
                ending=Ending(header["ending"]),
                # Files that do not say it are older than the word, when the town alone was driven.
                paint=PaintKind(header.get("paint", PaintKind.RENDERED)),
                events=tuple(map(Event.of, header["events"])),
                **arrays,
            )
        except (KeyError, TypeError, ValueError, SimulatorError) as error:
            reason = f"{error} is missing" if isinstance(error, KeyError) else error
            raise EpisodeError(f"{path} is incomplete or damaged: {reason}") from None
