"""What every simulator offers to rollouts, calibration and training, whatever runs behind it."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import replace
from enum import StrEnum
from types import TracebackType
from typing import Literal, Protocol, TypeAlias, runtime_checkable

import numpy as np
from jaxtyping import UInt8

from roadproof.datatypes import Control, Observation, Obstacle, Weather
from roadproof.errors import SimulatorError
from roadproof.geometry import CANVAS_SIZE_PX, CameraModel, CropResize
from roadproof.homographies import Homography
from roadproof.io.identity import digest, stated
from roadproof.io.known import known_by
from roadproof.roads.routes import Route
from roadproof.scenarios import Scenario
from roadproof.traffic.agents import Agents

PatternImage = UInt8[np.ndarray, "400 400 4"]
"""What is painted on the canvas: RGBA with straight (not premultiplied) alpha; y = 0 is the far edge."""


def uniform(red: int, green: int, blue: int) -> PatternImage:
    """A canvas painted all over with one colour, each channel in 0…255."""
    return np.full((CANVAS_SIZE_PX, CANVAS_SIZE_PX, 4), (red, green, blue, 255), np.uint8)


def check_image(paint: np.ndarray) -> None:
    """See that an array is what can be painted on a canvas.

    Raises:
        SimulatorError: the array has another shape or type.
    """
    shape = (CANVAS_SIZE_PX, CANVAS_SIZE_PX, 4)
    if paint.shape != shape or paint.dtype != np.uint8:
        raise SimulatorError(
            f"the pattern is {paint.dtype} of shape {paint.shape}, expected uint8 of shape {shape} (RGBA)"
        )


class PaintKind(StrEnum):
    """How a simulator puts a pattern on the road; every result says it."""

    RENDERED = "rendered"
    """Part of the simulator's own world, as in the town."""

    NATIVE = "native"
    """Part of the world of a CARLA server: the texture of a piece of its road."""

    INJECT = "inject"
    """Put into the pictures of the car's camera."""

    COMPOSITED = "composited"
    """Composited into pictures made from recorded frames: nothing was driven for real."""

    @property
    def predicted(self) -> bool:
        """Whether drives over such paint are predictions, not drives."""
        return self is PaintKind.COMPOSITED


Pictures: TypeAlias = bool | frozenset[int]
"""Which observations of a drive have a picture: all, none, or those after so many steps."""

PaintChoice: TypeAlias = Literal["inject", "native", "auto"]
"""How a CARLA server may be asked to paint; "auto" is "native" where that works, else "inject"."""


@runtime_checkable
class Simulator(Protocol):
    """A world with one car that is driven step by step.

    A simulator is a context manager: entering starts it, leaving frees everything it holds. Several may live at once,
    each in its own process. The same calls with the same seed give the same pixels and states.
    """

    @property
    def camera(self) -> CameraModel:
        """The camera on the car; full pictures have its size."""
        ...

    @property
    def input(self) -> CropResize:
        """How the controller's frame is cut from the camera picture."""
        ...

    @property
    def dt_s(self) -> float:
        """Simulated seconds per step."""
        ...

    @property
    def paint(self) -> PaintKind:
        """How patterns are put on the road."""
        ...

    def __enter__(self) -> Simulator: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...

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
        """Begin a drive: nothing of the one before is left.

        Args:
            scenario: start, goal, canvas, time limit and map.
            weather: one of the eight weathers.
            pattern: RGBA of the canvas, painted on it; None leaves the road bare.
            cars: how many other cars are on the road.
            pedestrians: how many people are about.
            seed: the seed of the other cars and the people.
            frames: which observations have the controller's frame; the others may have it too, or a black one, which
                costs nothing.
            full_pictures: which observations have the full camera picture too; where steps are given, others may have
                it as well.

        Raises:
            SimulatorError: the simulator is not open, or an argument does not fit.
        """
        ...

    def step(self, control: Control) -> Observation:
        """Drive on for `dt_s`.

        Raises:
            SimulatorError: there was no reset.
        """
        ...

    def image_from_canvas(self) -> Homography:
        """The exact homography of the current state: canvas px to px of the camera without its lens."""
        ...


SimulatorFactory: TypeAlias = Callable[[], AbstractContextManager[Simulator]]
"""Makes a simulator for a with-block, as `TownSimulator` does."""


@runtime_checkable
class OpenWorld(Protocol):
    """A simulator that hides nothing of the drive under way; the town is one."""

    @property
    def route(self) -> Route:
        """The way to the goal."""
        ...

    @property
    def cars(self) -> Agents:
        """The other cars as they are now."""
        ...

    @property
    def pedestrians(self) -> Agents:
        """The people as they are now."""
        ...


@runtime_checkable
class Furnished(Protocol):
    """A simulator that knows what stands beside its roads."""

    def obstacles(self, scenario: Scenario) -> tuple[Obstacle, ...] | None:
        """What a car could run into, within `BESIDE_M` of a scenario's canvas; None if that cannot be found out."""
        ...


BESIDE_M = 40.0
"""Obstacles further from the canvas than this are out of reach while it is in view."""


def obstacles_of(simulator: object, scenario: Scenario) -> tuple[Obstacle, ...] | None:
    """What stands beside a scenario's canvas; None where the simulator does not know.

    Raises:
        SimulatorError: the simulator does not answer.
        ScenarioError: the simulator has no such map.
    """
    return simulator.obstacles(scenario) if isinstance(simulator, Furnished) else None


@runtime_checkable
class Recorded(Protocol):
    """A world that begins where its recordings do."""

    @property
    def scenario(self) -> Scenario:
        """The recorded stretch as a scenario."""
        ...


def begun_in(simulator: Simulator, scenario: Scenario) -> Scenario:
    """The scenario as it is driven in an open simulator: in recordings it begins where they do."""
    if simulator.paint.predicted and isinstance(simulator, Recorded):
        return replace(scenario, start=simulator.scenario.start)
    return scenario


@runtime_checkable
class Identified(Protocol):
    """A simulator that differs from others of its kind in more than camera, input and time step."""

    @property
    def identity(self) -> str:
        """A text that is the same for every simulator with the same world, and another for every other."""
        ...


def world_of(simulator: object) -> str:
    """What tells a world from others: its simulator's identity or type; empty for the town as software draws it.

    A simulator of the user's own is known by its source and by what its constructor took as well.
    """
    named = simulator.identity if isinstance(simulator, Identified) else type(simulator).__qualname__
    return f"{named} {own_digest(simulator)}".strip()


def own_digest(simulator: object) -> str:
    """What tells a simulator of the user's own from others of its class (`io.known.known_by`); empty for ours."""
    ours = type(simulator).__module__.partition(".")[0] == __name__.partition(".")[0]
    return "" if ours else digest(stated(known_by(simulator)))[:16]
