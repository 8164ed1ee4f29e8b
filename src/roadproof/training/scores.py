"""How well a controller drives: did it arrive, what went wrong, how smooth was it, did it turn where it was told."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from roadproof.controllers import Controller
from roadproof.controllers.asking import act_of
from roadproof.datatypes import Event, Observation, Weather
from roadproof.driving.rollout import Policy
from roadproof.roads.routes import Crossing
from roadproof.scenarios import Scenario
from roadproof.simulators.town.simulator import TownSimulator
from roadproof.training.expert import expert
from roadproof.training.workers import Seat, spread

STEP_S = 0.05
ASTRAY_M = 6.0
TAKEN_M = 2.5


@dataclass(frozen=True, kw_only=True, slots=True)
class Trial:
    """One drive to be scored.

    Args:
        scenario: what to drive.
        weather: of the drive.
        cars: others on the road.
        pedestrians: people about.
        seed: of cars and people.
    """

    scenario: Scenario
    weather: Weather = Weather.CLEAR_NOON
    cars: int = 0
    pedestrians: int = 0
    seed: int = 0


@dataclass(frozen=True, kw_only=True, slots=True)
class DrivingScore:
    """What came of a trial.

    Args:
        arrived: the goal was reached in time.
        events: what happened, in order.
        seconds: how long it drove.
        lateral_m: largest distance from the route.
        mean_lateral_m: mean of it.
        steer_change: mean change of the steering from step to step, the smoothness of the drive.
        turns: junctions that were reached.
        turns_taken: those that were left where the command said.
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
        """Arrived, and nothing happened."""
        return self.arrived and not self.events

    @property
    def collisions(self) -> int:
        """How many things, cars and people were hit."""
        return sum(event.kind.startswith("collision") for event in self.events)


def score_drives(
    trials: Sequence[Trial], spec: str | None, *, processes: int = 1
) -> Iterator[tuple[Trial, DrivingScore]]:
    """Drive trials and score them, as they come.

    Args:
        trials: what to drive.
        spec: of the controller; None is the expert.
        processes: how many simulators drive at once.

    Raises:
        ControllerError: the controller cannot be loaded, or does not fit the simulator.
    """
    return spread(_score, trials, Seat(spec, STEP_S), processes=processes)


def score_drive(town: TownSimulator, controller: Controller | None, trial: Trial) -> DrivingScore:
    """Drive one trial; alone on the road it ends at the first event, since the score is known then.

    Args:
        town: an open simulator.
        controller: who drives; None is the expert.
        trial: what to drive.
    """
    seen = town.reset(
        trial.scenario, weather=trial.weather, cars=trial.cars, pedestrians=trial.pedestrians, seed=trial.seed
    )
    policy = expert(town) if controller is None else _acting(controller)
    alone = trial.cars + trial.pedestrians == 0
    events, steers = list(seen.events), list[float]()
    at, aside = np.zeros(0), np.zeros(0)
    failed_at: tuple[float, float] | None = None
    place = town.route.locate(seen.state.x_m, seen.state.y_m)
    track = [(place.arclength_m, abs(place.lateral_m))]
    while not (seen.done or track[-1][1] > ASTRAY_M or (alone and events)):
        control = policy(seen).clipped()
        steers.append(control.steer)
        seen = town.step(control)
        events += seen.events
        place = town.route.locate(seen.state.x_m, seen.state.y_m, track[-1][0])
        track.append((place.arclength_m, abs(place.lateral_m)))
        if events and failed_at is None:
            failed_at = _where(seen)
    at, aside = np.array(track).T
    arrived = seen.done and seen.time_s < trial.scenario.time_limit_s - 0.5 * town.dt_s
    reached = [crossing for crossing in town.route.crossings if at.max() > crossing.enters_m]
    return DrivingScore(
        arrived=arrived,
        events=tuple(events),
        seconds=seen.time_s,
        lateral_m=float(aside.max()),
        mean_lateral_m=float(aside.mean()),
        steer_change=float(np.abs(np.diff(steers)).mean()) if len(steers) > 1 else 0.0,
        turns=len(reached),
        turns_taken=sum(_taken(crossing, at, aside, arrived) for crossing in reached),
        failed_at_m=failed_at if events or arrived else _where(seen),
    )


def _score(seat: Seat, trial: Trial) -> DrivingScore:
    return score_drive(seat.town, seat.controller, trial)


def _acting(controller: Controller) -> Policy:
    return lambda seen: act_of(controller, seen.frame, seen.state.speed_mps, int(seen.command))


def _taken(crossing: Crossing, at: np.ndarray, aside: np.ndarray, arrived: bool) -> bool:
    """Whether the car came out of a junction on its route; one in which the route ends counts when it arrived."""
    beyond = at >= crossing.leaves_m - 1.0
    return bool((aside[beyond] < TAKEN_M).any()) if beyond.any() else arrived


def _where(seen: Observation) -> tuple[float, float]:
    return round(seen.state.x_m, 1), round(seen.state.y_m, 1)
