"""What simulators share beside graphics and physics: they are opened before a reset, and reset before a step."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Set
from functools import cached_property
from numbers import Integral
from types import TracebackType
from typing import Any, Generic, TypeVar, cast

import numpy as np
from jaxtyping import UInt8

from roadproof.datatypes import Control, Observation, VehicleState, Weather
from roadproof.errors import SimulatorError
from roadproof.geometry import CameraModel, CropResize
from roadproof.roads.routes import Route, RoutePosition
from roadproof.scenarios import Scenario
from roadproof.simulators.protocol import PatternImage, Pictures, check_image
from roadproof.simulators.tracker.drive import DriveTracker, Request, RouteTracker
from roadproof.traffic.agents import Agents

DriveT = TypeVar("DriveT", bound=DriveTracker)
RouteDriveT = TypeVar("RouteDriveT", bound=RouteTracker)
Opened = TypeVar("Opened", bound="TrackedSimulator[Any]")


class TrackedSimulator(ABC, Generic[DriveT]):
    """A simulator whose drives are tracked; a subclass opens and closes its world, moves the car and sees.

    Args:
        camera: the camera on the car; full pictures have its size.
        input: how the controller's frame is cut from the camera picture.
        dt_s: simulated seconds per step.

    Raises:
        SimulatorError: the crop leaves the camera picture.
    """

    def __init__(self, camera: CameraModel, input: CropResize, dt_s: float) -> None:  # noqa: A002
        if input.right_px > camera.width_px or input.bottom_px > camera.height_px:
            raise SimulatorError(
                f"the crop ends at ({input.right_px}, {input.bottom_px}), expected it inside the camera picture of "
                f"{camera.width_px}×{camera.height_px} pixels"
            )
        self.camera, self.input, self.dt_s = camera, input, dt_s
        self._is_open = False
        self._drive: DriveT | None = None

    @property
    def state(self) -> VehicleState:
        """Where the car is now.

        Raises:
            SimulatorError: there was no reset.
        """
        return self._running().state

    def __enter__(self: Opened) -> Opened:
        try:
            self._open()
        except BaseException:
            # What was opened, and changed on a server, is put back: nobody leaves a `with` that was not entered.
            self._close()
            raise
        self._is_open = True
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            self._end_drive()
        finally:
            self._close()
            self._is_open = False

    def reset(
        self,
        scenario: Scenario,
        *,
        weather: Weather = Weather.CLEAR_NOON,
        pattern: PatternImage | None = None,
        cars: int = 0,
        pedestrians: int = 0,
        seed: int = 0,
        frames: Pictures = True,
        full_pictures: Pictures = False,
    ) -> Observation:
        """Begin a drive; see `roadproof.simulators.protocol.Simulator.reset`.

        Raises:
            SimulatorError: the simulator is not open, cannot begin, or an argument does not fit.
            ScenarioError: the scenario does not fit its map.
        """
        if not self._is_open:
            raise SimulatorError("the simulator is closed; use it in a with-block")
        if pattern is not None:
            check_image(pattern)
        asked = _steps("frames", frames), _steps("full_pictures", full_pictures)
        request = Request(scenario, Weather(weather), pattern, cars, pedestrians, seed, *asked)
        self._drive = self._begin(request)
        return self._observe(self._drive)

    def step(self, control: Control) -> Observation:
        """Drive on for `dt_s`; values of the control outside their range are clipped.

        Raises:
            SimulatorError: there was no reset, or the simulator does not answer.
        """
        drive = self._running()
        self._advance(drive, control.clipped())
        drive.steps += 1
        return self._observe(drive)

    @cached_property
    def _black(self) -> UInt8[np.ndarray, "h w 3"]:
        """The frame of observations of which no frame is asked for."""
        return np.broadcast_to(np.uint8(0), (self.input.height_px, self.input.width_px, 3))

    def _running(self) -> DriveT:
        if self._drive is None:
            raise SimulatorError("there is no drive; call reset first")
        return self._drive

    def _end_drive(self) -> None:
        """Free what the drive under way holds, if there is one."""
        self._drive = None

    def _open(self) -> None:
        """Make the world ready for the first reset."""

    def _close(self) -> None:
        """Free everything that is held."""

    @abstractmethod
    def _begin(self, request: Request) -> DriveT:
        """End the drive under way and begin another; pattern and weather are known to be valid."""

    @abstractmethod
    def _advance(self, drive: DriveT, control: Control) -> None:
        """Take a step."""

    @abstractmethod
    def _observe(self, drive: DriveT) -> Observation:
        """What is seen, and what happened in the last step."""


def _steps(name: str, asked: object) -> Pictures:
    """What a reset asks to see: all, nothing, or the steps of a set."""
    if isinstance(asked, bool):
        return asked
    if not isinstance(asked, Set):
        kind = type(asked).__name__
        raise SimulatorError(f"{name} is of type {kind}, expected True, False or a set of steps, counted from 0")
    steps = cast("Set[object]", asked)
    for step in steps:
        if isinstance(step, bool) or not isinstance(step, Integral) or step < 0:
            raise SimulatorError(f"{name} asks for step {step!r}, expected whole numbers from 0")
    return frozenset(cast("Set[int]", steps))


class RouteSimulator(TrackedSimulator[RouteDriveT]):
    """A simulator with a map: its drives follow a route among traffic and are judged.

    Route, place, cars and pedestrians are those of the current drive; without one they raise a SimulatorError.
    """

    @property
    def route(self) -> Route:
        """The way to the goal."""
        return self._running().route

    @property
    def place(self) -> RoutePosition:
        """Where the car is along the route."""
        return self._running().place

    @property
    def cars(self) -> Agents:
        """The other cars as they are now."""
        return self._running().cars

    @property
    def pedestrians(self) -> Agents:
        """The people as they are now."""
        return self._running().pedestrians
