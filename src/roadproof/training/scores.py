"""How well a controller drives: did it arrive, what went wrong, how smooth was it, did it turn where it was told."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from roadproof.controllers import Controller
from roadproof.datatypes import Ending, Event, Observation, Weather
from roadproof.driving.rollout import rollout
from roadproof.processes import spread
from roadproof.roads.routes import Crossing
from roadproof.scenarios import Scenario
from roadproof.simulators.town.simulator import TownSimulator
from roadproof.training.expert import expert
from roadproof.training.workers import Driving, driving

STEP_S = 0.05
ASTRAY_M = 6.0
TAKEN_M = 2.5


@dataclass(frozen=True, kw_only=True, slots=True)
class BareDrive:
    """A drive over the bare road that is to be scored.

    Args:
        scenario: the scenario to drive.
        weather: the weather of the drive.
        cars: how many other cars are on the road.
        pedestrians: how many people are about.
        seed: the seed of cars and people.
    """

    scenario: Scenario
    weather: Weather = Weather.CLEAR_NOON
    cars: int = 0
    pedestrians: int = 0
    seed: int = 0


@dataclass(frozen=True, kw_only=True, slots=True)
class DrivingScore:
    """What came of a drive.

    Args:
        arrived: whether the goal was reached in time.
        events: what went wrong, in order.
        seconds: how long the car drove, simulated seconds.
        lateral_m: largest distance from the route, metres.
        mean_lateral_m: mean distance from the route, metres.
        steer_change: mean change of the steering from step to step, the smoothness of the drive.
        turns: how many junctions were reached.
        turns_taken: how many junctions were left where the command said.
        failed_at_m: (x, y) of the first event, or of the end where it did not arrive; None when all went well.
    """

    arrived: bool
    events: tuple[Event, ...]
    seconds: float
    lateral_m: float
    mean_lateral_m: float
    steer_change: float
    turns: int
    turns_taken: int
    failed_at_m: tuple[float, float] | None

    @property
    def clean(self) -> bool:
        """Whether the car arrived, and nothing happened."""
        return self.arrived and not self.events

    @property
    def collisions(self) -> int:
        """How many things, cars and people were hit."""
        return sum(event.kind.startswith("collision") for event in self.events)


def score_drives(
    drives: Sequence[BareDrive], spec: str | None, *, processes: int = 1
) -> Iterator[tuple[BareDrive, DrivingScore]]:
    """Make the drives and score them, as they come.

    Args:
        drives: the drives to be scored.
        spec: spec of the controller that drives; None for the expert.
        processes: how many simulators drive at once.

    Raises:
        ControllerError: the controller cannot be loaded, or does not fit the simulator.
    """
    return spread(_score, drives, partial(driving, spec, STEP_S), processes=processes)


def score_drive(town: TownSimulator, controller: Controller | None, wanted: BareDrive) -> DrivingScore:
    """Make one drive; alone on the road it ends at the first event, since the score is known then.

    Args:
        town: an open simulator.
        controller: the controller that drives; None for the expert.
        wanted: the drive to be scored.
    """
    alone = wanted.cars + wanted.pedestrians == 0
    track: list[tuple[float, float]] = []
    events: list[Event] = []

    def is_over(seen: Observation) -> bool:
        track.append((town.place.arclength_m, abs(town.place.lateral_m)))
        events.extend(seen.events)
        return not seen.done and (track[-1][1] > ASTRAY_M or (alone and bool(events)))

    drive = rollout(
        town,
        expert if controller is None else controller,
        wanted.scenario,
        weather=wanted.weather,
        cars=wanted.cars,
        pedestrians=wanted.pedestrians,
        seed=wanted.seed,
        until=is_over,
    )
    at, aside = np.array(track).T
    arrived = drive.ending is Ending.GOAL_REACHED
    reached = [crossing for crossing in town.route.crossings if at.max() > crossing.enters_m]
    failed = int(np.searchsorted(drive.time_s, events[0].time_s)) if events else -1
    return DrivingScore(
        arrived=arrived,
        events=drive.events,
        seconds=float(drive.time_s[-1]),
        lateral_m=float(aside.max()),
        mean_lateral_m=float(aside.mean()),
        steer_change=float(np.abs(np.diff(drive.steer)).mean()) if len(drive.steer) > 1 else 0.0,
        turns=len(reached),
        turns_taken=sum(_taken(crossing, at, aside, arrived) for crossing in reached),
        failed_at_m=(round(float(drive.x_m[failed]), 1), round(float(drive.y_m[failed]), 1))
        if events or not arrived
        else None,
    )


def _score(inside: Driving, drive: BareDrive) -> DrivingScore:
    return score_drive(inside.town, inside.controller, drive)


def _taken(crossing: Crossing, at: np.ndarray, aside: np.ndarray, arrived: bool) -> bool:
    """Whether the car came out of a junction on its route; one in which the route ends counts when it arrived."""
    beyond = at >= crossing.leaves_m - 1.0
    return bool((aside[beyond] < TAKEN_M).any()) if beyond.any() else arrived
