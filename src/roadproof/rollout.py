"""Driving a scenario closed loop, and the episode that comes of it.

    with TownSimulator() as town:
        episode = rollout(town, controller, scenario, weather=Weather.RAINY_NOON, pattern=pattern)

An episode is one file that explains itself: a NumPy archive of named arrays and a JSON header. Nothing is pickled.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, fields
from itertools import chain
from pathlib import Path
from typing import Any, TypeAlias, TypeVar

import numpy as np
from jaxtyping import Float, Int

from roadproof.controllers import Controller
from roadproof.controllers.asking import act_of, frame_size_of
from roadproof.datatypes import Control, Ending, Event, Observation, VehicleState, Weather
from roadproof.errors import ControllerError, EpisodeError, SimulatorError
from roadproof.io.arrays import read_record, write_archive
from roadproof.patterns import Pattern, raster
from roadproof.scenarios import Scenario
from roadproof.simulators.protocol import PaintKind, PatternImage, Pictures, Simulator

FORMAT = "roadproof-episode"
FORMAT_VERSION = 1
_UNITS = {
    "time_s": "seconds since the start, one value an observation, as for all up to command",
    "x_m, y_m, z_m, yaw_rad": "pose of the car in the world, right-handed, z up, yaw 0 along x, left positive",
    "speed_mps": "m/s",
    "command": "2 follow, 3 left, 4 right, 5 straight",
    "steer": "in [-1, 1], positive = right, given after each observation but the last, as throttle and brake in [0, 1]",
}
_SEEN = ("time_s", *VehicleState.__slots__, "command")
_GIVEN = ("steer", "throttle", "brake")

SimulatorT = TypeVar("SimulatorT", bound=Simulator)
Policy: TypeAlias = Callable[[Observation], Control]
"""What one drive is driven by: what is seen in, what is done out."""

Driver: TypeAlias = Callable[[SimulatorT], Policy]
"""Gets into a simulator after its reset and gives the policy of this one drive."""

OnStep: TypeAlias = Callable[[Observation, Control | None], object]
"""Told of each observation and the control that answers it, before it is carried out; the last has none."""


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
        for name in (*_SEEN, *_GIVEN):
            values: np.ndarray = getattr(self, name)
            expected = (count if name in _SEEN else count - 1,)
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
        header |= {field.name: getattr(self, field.name) for field in fields(self) if field.name not in _SEEN + _GIVEN}
        header |= {"events": [asdict(event) for event in self.events], "units": _UNITS}
        write_archive(path, {name: getattr(self, name) for name in (*_SEEN, *_GIVEN)}, header)

    @classmethod
    def load(cls, path: Path) -> Episode:
        """Read an episode written by `save`.

        Raises:
            EpisodeError: the file is missing, damaged, no episode, or of a newer version.
        """
        remedy, known = "check the path, or drive it again", (FORMAT, FORMAT_VERSION)
        header, stored = read_record(path, (*_SEEN, *_GIVEN), EpisodeError, remedy, format_version=known)
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


def rollout(
    simulator: SimulatorT,
    driver: Controller | Driver[SimulatorT],
    scenario: Scenario,
    *,
    weather: Weather = Weather.CLEAR_NOON,
    pattern: Pattern | PatternImage | None = None,
    cars: int = 0,
    pedestrians: int = 0,
    seed: int = 0,
    full_pictures: Pictures = False,
    on_step: OnStep | None = None,
    until: Callable[[Observation], bool] | None = None,
) -> Episode:
    """Drive a scenario until it ends.

    Args:
        simulator: an open simulator.
        driver: a controller, or whoever gets in after the reset, such as `training.expert.expert` or `replay`.
        scenario: start, goal, canvas, time limit and map.
        weather: of the drive.
        pattern: painted on the canvas; None leaves the road bare.
        cars: others on the road.
        pedestrians: people about.
        seed: of cars and people.
        full_pictures: which observations show the full camera picture to driver and `on_step`.
        on_step: told of each step; the simulator still is where the observation was made.
        until: stops the drive at the first observation it says yes to.

    Raises:
        SimulatorError: the simulator is not open, an argument does not fit, or a driver's control is not finite.
        ScenarioError: the scenario does not fit its map.
        PatternError: the pattern is a batch.
        ControllerError: the controller takes frames of another size, raises, or answers with something that is no
            control; the message names its author's line.
    """
    if isinstance(driver, Controller):
        _check_size(driver, simulator)
    seen = simulator.reset(
        scenario,
        weather=weather,
        pattern=raster(pattern) if isinstance(pattern, Pattern) else pattern,
        cars=cars,
        pedestrians=pedestrians,
        seed=seed,
        full_pictures=full_pictures,
    )
    policy = policy_of(driver, simulator)
    rows, controls, events = [_row(seen)], list[Control](), list(seen.events)
    while not (stopped := until is not None and until(seen)) and not seen.done:
        control = policy(seen)
        if not isinstance(control, Control):  # pyright: ignore[reportUnnecessaryIsInstance]  # drivers are the user's
            raise ControllerError(f"the driver answered {control!r}, expected a roadproof.datatypes.Control")
        controls.append(control.clipped())
        if on_step is not None:
            on_step(seen, controls[-1])
        seen = simulator.step(controls[-1])
        rows.append(_row(seen))
        events += seen.events
    if on_step is not None:
        on_step(seen, None)
    late = seen.time_s >= scenario.time_limit_s - 0.5 * simulator.dt_s
    ending = Ending.STOPPED if stopped else seen.ending or (Ending.TIME_LIMIT if late else Ending.GOAL_REACHED)
    *observed, command = np.array(rows, np.float64).T
    given = [np.array([getattr(control, name) for control in controls], np.float64) for name in _GIVEN]
    return Episode(
        scenario=scenario.name,
        weather=Weather(weather),
        painted=pattern is not None,
        paint=simulator.paint,
        cars=cars,
        pedestrians=pedestrians,
        seed=seed,
        dt_s=simulator.dt_s,
        ending=ending,
        events=tuple(events),
        command=command.astype(np.int64),
        **dict(zip((*_SEEN[:-1], *_GIVEN), chain(observed, given), strict=True)),
    )


def replay(episode: Episode) -> Driver[Simulator]:
    """A driver that gives an episode's controls again: same scenario and seed, same states, whatever is painted.

    After the last of them it brakes.
    """

    def begin(_: Simulator) -> Policy:
        given = zip(episode.steer.tolist(), episode.throttle.tolist(), episode.brake.tolist(), strict=True)
        stop = Control(0.0, brake=1.0)

        def policy(_: Observation) -> Control:
            values = next(given, None)
            return stop if values is None else Control(*values)

        return policy

    return begin


def policy_of(driver: Controller | Driver[SimulatorT], simulator: SimulatorT) -> Policy:
    """What a driver does in a drive that has just begun."""
    if not isinstance(driver, Controller):
        return driver(simulator)
    return lambda seen: act_of(driver, seen.frame, seen.state.speed_mps, int(seen.command))


def _check_size(controller: Controller, simulator: Simulator) -> None:
    """Before the town is built, and also for controllers that would not complain themselves."""
    size, view = frame_size_of(controller), simulator.input
    if size is not None and size != (view.height_px, view.width_px):
        raise ControllerError(
            f"the controller takes frames of {size[1]}×{size[0]}, the simulator gives {view.width_px}×{view.height_px} "
            "(width×height); give the simulator another `input`"
        )


def _row(seen: Observation) -> tuple[float, ...]:
    return seen.time_s, *(float(getattr(seen.state, name)) for name in _SEEN[1:-1]), float(seen.command)
