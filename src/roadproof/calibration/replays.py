"""Recorded drives, driven again open loop over calibration targets; each replay is one call of the simulator."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from operator import attrgetter
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from roadproof.datatypes import Control, Observation, VehicleState
from roadproof.drives import Drive, Drives
from roadproof.driving.rollout import drive_again
from roadproof.errors import CalibrationError
from roadproof.homographies import Homographies
from roadproof.io.arrays import read_record, write_archive
from roadproof.io.identity import digest
from roadproof.processes import Pool
from roadproof.simulators.protocol import PatternImage, Simulator

ASTRAY_M, ASTRAY_RAD = 0.02, 0.003


@dataclass(frozen=True, slots=True, eq=False)
class Target:
    """What a drive is replayed over, and what is kept of it. It travels between processes.

    Args:
        name: name of what is painted and seen, for the file that keeps the result.
        paint: picture of the paint on the canvas.
        see: what is kept of the observation at each kept frame, such as a function of a module; by default the frame.
        full_pictures: whether `see` needs full camera pictures.
    """

    name: str
    paint: PatternImage
    see: Callable[[Observation], np.ndarray] = attrgetter("frame")
    full_pictures: bool = False


class Replays:
    """Runs replays, counts them, and keeps what was seen.

    Args:
        simulator: an open simulator, the one the drives were recorded in.
        drives: recorded drives that are replayed.
        folder: folder that keeps what each replay saw, so that it is not driven again; None keeps nothing.
        on_call: called after each replay, made or read, with the number of replays so far.
    """

    def __init__(
        self,
        simulator: Simulator,
        drives: Drives,
        folder: Path | None = None,
        on_call: Callable[[int], object] = lambda _done: None,
    ) -> None:
        self.calls = 0
        self._simulator, self._drives, self._folder, self._on_call = simulator, drives, folder, on_call
        self._stated: dict[str, Homographies] = {}

    def stated(self, drive: Drive) -> Homographies | None:
        """The homographies the simulator itself states, for reports alone; None before the first replay of a drive."""
        return self._stated.get(drive.name)

    def look(self, drive: Drive, target: Target) -> np.ndarray:
        """What is kept of each kept frame of a drive with a target on the canvas, stacked.

        Args:
            drive: the drive to replay, one of the drives.
            target: the paint on the canvas during the replay.

        Raises:
            CalibrationError: the replay goes another way than the drive.
        """
        path = None if self._folder is None else self._folder / f"{drive.name}-{target.name}.npz"
        made_of = digest(
            repr((self._drives.settings, drive.name, str(self._simulator.paint))), *told_apart(drive), target.paint
        )
        kept = None if path is None else _read(path, made_of)
        if kept is None:
            kept = self._drive_again(drive, target)
            if path is not None:
                write_archive(path, kept, {"of": made_of})
        self.calls += 1
        self._stated[drive.name] = kept["stated"]
        self._on_call(self.calls)
        return kept["seen"]

    def _drive_again(self, drive: Drive, target: Target) -> dict[str, np.ndarray]:
        wanted = dict(zip(drive.frame_number.tolist(), drive.states, strict=True))
        seen_there: list[np.ndarray] = []
        stated: list[np.ndarray] = []
        step, last = 0, int(drive.frame_number[-1])

        def keep(seen: Observation, _: Control | None) -> None:
            nonlocal step
            if step in wanted:
                _check_same_way(drive.name, step, seen.state, wanted[step])
                seen_there.append(target.see(seen))
                stated.append(self._simulator.image_from_canvas())
            step += 1

        settings = self._drives.settings
        drive_again(
            self._simulator,
            drive.episode,
            settings.scenario,
            pattern=target.paint,
            looked_at=frozenset(wanted),
            full_pictures=target.full_pictures,
            on_step=keep,
        )
        if len(seen_there) != len(wanted):
            raise CalibrationError(
                f"a replay of drive {drive.name} ended after {step} steps, before step {last}; record it again"
            )
        return {"seen": np.stack(seen_there), "stated": np.stack(stated)}


Wanted: TypeAlias = tuple[Drive, Target]
"""One replay: a drive, and what it is replayed over."""


def replay_in(
    pool: Pool[Simulator], drives: Drives, folder: Path, wanted: Sequence[Wanted], on_call: Callable[[int], object]
) -> None:
    """Make replays in other processes; a folder keeps them.

    Args:
        pool: the processes.
        drives: the recorded drives.
        folder: folder that gets the replays; what it holds is not driven again.
        wanted: the replays.
        on_call: called with the number of replays so far.

    Raises:
        CalibrationError: a replay goes astray.
        SimulatorError: a process died.
    """
    work = [(drive.name, target) for drive, target in wanted]
    for done, _ in enumerate(pool.each(partial(_replay, drives, folder), work), 1):
        on_call(done)


def _replay(drives: Drives, folder: Path, simulator: Simulator, wanted: tuple[str, Target]) -> None:
    name, target = wanted
    drive = next(each for each in drives.drives if each.name == name)
    Replays(simulator, drives, folder).look(drive, target)


def _check_same_way(name: str, step: int, state: VehicleState, wanted: VehicleState) -> None:
    away = math.hypot(state.x_m - wanted.x_m, state.y_m - wanted.y_m)
    turned = abs(math.remainder(state.yaw_rad - wanted.yaw_rad, math.tau))
    if away > ASTRAY_M or turned > ASTRAY_RAD:
        raise CalibrationError(
            f"a replay of drive {name} is {away:.2f} m and {math.degrees(turned):.1f}° astray at step {step}; the "
            "simulator does not repeat itself, or is not the one it was recorded in"
        )


def told_apart(drive: Drive) -> tuple[np.ndarray, ...]:
    """What tells a drive from others: its controls, and the steps of its kept frames."""
    episode = drive.episode
    return episode.steer, episode.throttle, episode.brake, drive.frame_number


def _read(path: Path, made_of: str) -> dict[str, Any] | None:
    """The stored result of a replay; None if there is none that can be used."""
    try:
        of, arrays = read_record(path, ("seen", "stated"), CalibrationError, "drive it again")
    except CalibrationError:
        # Driving it again costs seconds and mends whatever it was.
        return None
    return arrays if of == {"of": made_of} else None
