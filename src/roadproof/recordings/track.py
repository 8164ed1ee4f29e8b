"""Where a car was at every step of a drive, and what it was told to do there: what a vehicle is identified from."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from itertools import pairwise

import numpy as np
from jaxtyping import Float, Int

from roadproof.datatypes import VehicleState
from roadproof.errors import RecordingError
from roadproof.io.records import check_arrays

FASTEST_MPS = 70.0
"""No car of a recording moves faster between two steps: a pose that jumps further is wrong."""

SHORTEST_S = 1e-3
"""No recording has shorter steps; gaps between known ones, which are filled, are told in seconds."""


_RANGES = (
    ("steer", -1, 1),
    ("throttle", 0, 1),
    ("brake", 0, 1),
    ("speed_mps", -1, FASTEST_MPS),
    ("x_m", -1e10, 1e10),
    ("y_m", -1e10, 1e10),
    ("yaw_rad", -1e4, 1e4),
)


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Track:
    """The n steps of a drive whose poses are known.

    Args:
        dt_s: seconds from one step to the next, from `SHORTEST_S` to 1.
        step: numbers of the steps, rising, (n,); of a number that is left out, nothing is known.
        x_m: world x of the vehicle's origin at each step, metres, (n,).
        y_m: world y of the vehicle's origin at each step, metres, (n,).
        yaw_rad: heading at each step, radians, left positive, (n,).
        speed_mps: forward speed at each step, m/s, from −1 (rolling back) to `FASTEST_MPS`, (n,).
        steer: steer given at each step and held until the next, in [−1, 1], right positive, (n,).
        throttle: throttle given at each step and held until the next, in [0, 1], (n,).
        brake: brake given at each step and held until the next, in [0, 1], (n,).

    Raises:
        RecordingError: lengths differ, a value is not finite or outside its range, steps do not rise, or a pose jumps.
    """

    dt_s: float
    step: Int[np.ndarray, "..."]
    x_m: Float[np.ndarray, "..."]
    y_m: Float[np.ndarray, "..."]
    yaw_rad: Float[np.ndarray, "..."]
    speed_mps: Float[np.ndarray, "..."]
    steer: Float[np.ndarray, "..."]
    throttle: Float[np.ndarray, "..."]
    brake: Float[np.ndarray, "..."]

    def __post_init__(self) -> None:
        if not SHORTEST_S <= self.dt_s <= 1.0:
            raise RecordingError(f"dt_s of the track is {self.dt_s}, expected {SHORTEST_S:g} to 1 seconds")
        count = self.step.size
        if count == 0:
            raise RecordingError("the track has no step, expected at least one")
        check_arrays(self, [field.name for field in fields(self)[1:]], (count,), "of the track", RecordingError)
        for name, low, high in _RANGES:
            values: np.ndarray = getattr(self, name)
            if values.min() < low or values.max() > high:
                raise RecordingError(
                    f"{name} of the track goes from {values.min():g} to {values.max():g}, expected [{low}, {high}]"
                )
        passed = np.diff(self.step)
        if count > 1 and passed.min() < 1:
            raise RecordingError("steps of the track do not rise; order its rows by step, each once")
        moved = np.hypot(np.diff(self.x_m), np.diff(self.y_m))
        jumps = np.flatnonzero(moved > FASTEST_MPS * self.dt_s * passed)
        if jumps.size:
            at = int(jumps[0])
            raise RecordingError(
                f"the pose jumps by {moved[at]:.1f} m from step {self.step[at]} to {self.step[at + 1]}; "
                "check positions and step numbers"
            )

    def __len__(self) -> int:
        """How many steps are known."""
        return self.step.size

    def rows(self, numbers: Int[np.ndarray, " f"]) -> Int[np.ndarray, " f"]:
        """Index of each of the steps with the given numbers.

        Raises:
            RecordingError: a step is not known.
        """
        found = np.searchsorted(self.step, numbers).clip(0, len(self) - 1)
        missing = np.flatnonzero(self.step[found] != numbers)
        if missing.size:
            raise RecordingError(f"the track has no pose for frame {numbers[missing[0]]}; drop the frame or add it")
        return found

    def state(self, row: int) -> VehicleState:
        """Pose and speed at one row, as a vehicle state on the ground."""
        return VehicleState(
            float(self.x_m[row]), float(self.y_m[row]), 0.0, float(self.yaw_rad[row]), float(self.speed_mps[row])
        )

    def filled(self, longest_s: float) -> Track:
        """The same drive with the steps that are left out in gaps of at most so many seconds, evenly between others."""
        ends = self.step.tolist()
        parts = [
            range(one, other) if (other - one) * self.dt_s <= longest_s else [one] for one, other in pairwise(ends)
        ]
        step = np.concatenate([*parts, ends[-1:]]).astype(np.int64)
        known = {field.name: getattr(self, field.name) for field in fields(self)[2:]}
        known["yaw_rad"] = np.unwrap(self.yaw_rad)
        return replace(self, step=step, **{name: np.interp(step, ends, values) for name, values in known.items()})

    def stretches(self) -> Iterator[slice]:
        """Slices of the rows whose steps follow each other without a gap."""
        ends = np.flatnonzero(np.diff(self.step) != 1) + 1
        bounds = [0, *ends.tolist(), len(self)]
        yield from (slice(first, last) for first, last in pairwise(bounds))
