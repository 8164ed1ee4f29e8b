"""Collecting drives to learn from: the expert drives, or a controller drives and the expert says what it would do.

Each drive follows from the plan and its number alone, so that processes can share the work, and a folder with some of
the drives can be filled up later.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import NamedTuple, cast

import numpy as np
import torch
from jaxtyping import Float

from roadproof.controllers import Controller
from roadproof.controllers.waypoint import PATH_M
from roadproof.datatypes import PAPER_WEATHERS, Command, Control, Observation, VehicleState, Weather
from roadproof.driving.rollout import Policy, policy_of, rollout
from roadproof.errors import TrainingError
from roadproof.patterns import raster
from roadproof.processes import spread
from roadproof.roads.maps import load_map
from roadproof.scenarios import Scenario
from roadproof.search_space import SearchSpace
from roadproof.simulators.protocol import PatternImage
from roadproof.simulators.town.simulator import TownSimulator
from roadproof.training.expert import expert
from roadproof.training.random_scenarios import Disturbance, random_scenario
from roadproof.training.shards import Shard
from roadproof.training.workers import Driving, driving

STEP_S = 0.1
FURTHEST_M = 2.6
STILL_S = 2.0
COMMANDS = (Command.LEFT, Command.RIGHT, Command.STRAIGHT, Command.LEFT, Command.RIGHT, Command.FOLLOW)
WEATHERS = (*PAPER_WEATHERS * 2, *(weather for weather in Weather if weather not in PAPER_WEATHERS))
"""The paper's four weathers twice as often as the others."""

MAP_NAME = "town"
MOST_FIGURES = 5


@dataclass(frozen=True, kw_only=True, slots=True)
class CollectionPlan:
    """Which drives to record.

    Args:
        drives: how many drives to record, at least 1.
        seed: the seed of everything drawn, at least 0: scenarios, weathers, numbers of others, disturbances, paint.
            Where those others are follows from the drive's number alone.
        controller: spec of the controller that drives; None for the expert.
        disturbed: share of the drives that start beside the lane's middle and are disturbed, 0 to 1.
        traffic: share of the drives with others on the road, 0 to 1.
        painted: share of the drives with a random pattern on the canvas, 0 to 1.

    Raises:
        TrainingError: a share is not in [0, 1], the seed is below 0, or there is no drive.
    """

    drives: int
    seed: int
    controller: str | None = None
    disturbed: float = 0.7
    traffic: float = 0.4
    painted: float = 0.0

    def __post_init__(self) -> None:
        if self.drives < 1:
            raise TrainingError(f"drives is {self.drives}, expected at least 1")
        if self.seed < 0:
            raise TrainingError(f"seed is {self.seed}, expected 0 or more")
        for name in ("disturbed", "traffic", "painted"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise TrainingError(f"{name} is {getattr(self, name)}, expected a share in [0, 1]")


class _Row(NamedTuple):
    """What is kept of one frame."""

    seen: Observation
    expert: Control
    lateral_m: float
    path_m: Float[np.ndarray, "p 2"]


@dataclass(frozen=True, slots=True, eq=False)
class _Conditions:
    """What a drive is like; follows from plan and number."""

    scenario: Scenario
    weather: Weather
    cars: int
    pedestrians: int
    pattern: PatternImage | None
    disturbance: Disturbance | None


def collect(
    plan: CollectionPlan, folder: Path, *, processes: int = 1, on_drive: Callable[[int], object] = lambda _done: None
) -> tuple[Path, ...]:
    """Record the drives of a plan that the folder does not hold yet.

    Args:
        plan: the drives to record.
        folder: the folder for the shards, one a drive.
        processes: how many simulators drive at once.
        on_drive: called after each drive with how many drives the folder holds.

    Returns:
        The shards of the plan, in order.

    Raises:
        TrainingError: the plan is not valid, or the folder holds drives of another.
        ControllerError: the controller cannot be loaded.
        OutputError: a shard cannot be written.
    """
    paths = tuple(folder / f"drive-{number:05d}.npz" for number in range(plan.drives))
    missing = [(plan, number, path) for number, path in enumerate(paths) if not _is_there(path, plan, number)]
    done = plan.drives - len(missing)
    for _ in spread(_record, missing, partial(driving, plan.controller, STEP_S), processes=processes):
        done += 1
        on_drive(done)
    return paths


def _is_there(path: Path, plan: CollectionPlan, number: int) -> bool:
    """Whether a folder holds a drive of a plan; how many drives the plan has does not matter."""
    if not path.exists():
        return False
    about = Shard.about_of(path)
    made = about.get("plan")
    there = _known(cast("dict[str, object]", made)) if isinstance(made, dict) else None
    if there != _known(asdict(plan)) or about.get("number") != number:
        raise TrainingError(f"{path} is a drive of another plan, {made}; choose another folder")
    return True


def _known(plan: Mapping[str, object]) -> dict[str, object]:
    """What tells a plan's drives: not how many there are, nor where the network lies, since folders move."""
    who = plan.get("controller")
    return {**plan, "drives": 0, "controller": Path(who).name if isinstance(who, str) else who}


def record_drive(town: TownSimulator, plan: CollectionPlan, number: int, controller: Controller | None) -> Shard:
    """Record one drive of a plan.

    The drive ends at the goal, after its time, when something is hit, or when the car is too far off for the expert's
    answer to mean anything.

    Args:
        town: an open simulator.
        plan: the plan that the drive belongs to.
        number: the drive's number in the plan, from 0.
        controller: the controller that drives; None for the expert.
    """
    given = _conditions(plan, number, town.dt_s)
    rows: list[_Row] = []

    def driver(town: TownSimulator) -> Policy:
        expert_of, policy = expert(town), None if controller is None else policy_of(controller, town)
        still_s, steps = 0.0, itertools.count()

        def drive(seen: Observation) -> Control:
            nonlocal still_s
            answer = expert_of(seen)
            still_s = still_s + town.dt_s if seen.state.speed_mps < 0.1 and answer.throttle == 0.0 else 0.0
            if still_s <= STILL_S:
                rows.append(_Row(seen, answer, town.place.lateral_m, path_ahead(town, seen.state)))
            control = answer if policy is None else policy(seen)
            return control if given.disturbance is None else given.disturbance.on(control, next(steps))

        return drive

    def is_over(seen: Observation) -> bool:
        collided = any(event.kind.startswith("collision") for event in seen.events)
        return collided or abs(town.place.lateral_m) > FURTHEST_M

    rollout(
        town,
        driver,
        given.scenario,
        weather=given.weather,
        pattern=given.pattern,
        cars=given.cars,
        pedestrians=given.pedestrians,
        seed=number,
        until=is_over,
    )
    return _shard(rows, plan, number, given)


def _record(inside: Driving, work: tuple[CollectionPlan, int, Path]) -> None:
    plan, number, path = work
    record_drive(inside.town, plan, number, inside.controller).save(path)


def _conditions(plan: CollectionPlan, number: int, dt_s: float) -> _Conditions:
    generator = np.random.default_rng([plan.seed, number])
    # First what does not depend on the shares, so that plans that differ in them alone share weathers and numbers.
    disturbed, busy, painted = generator.uniform(size=3) < (plan.disturbed, plan.traffic, plan.painted)
    weather = WEATHERS[int(generator.integers(len(WEATHERS)))]
    cars, pedestrians = (int(generator.integers(10, 41)) for _ in range(2))
    scenario = random_scenario(
        load_map(MAP_NAME),
        MAP_NAME,
        generator,
        name=f"drive-{number:05d}",
        command=COMMANDS[number % len(COMMANDS)],
        displaced=bool(disturbed),
    )
    steps = int(scenario.time_limit_s / dt_s) + 2
    return _Conditions(
        scenario=scenario,
        weather=weather,
        cars=cars if busy else 0,
        pedestrians=pedestrians if busy else 0,
        pattern=_random_paint(generator) if painted else None,
        disturbance=Disturbance(steps, dt_s, generator) if disturbed else None,
    )


def _random_paint(generator: np.random.Generator) -> PatternImage:
    space = SearchSpace(figures=int(generator.integers(1, MOST_FIGURES + 1)), family="free")
    draw = torch.Generator().manual_seed(int(generator.integers(2**31)))
    return raster(space.pattern(space.random((), draw)))


def path_ahead(town: TownSimulator, state: VehicleState) -> Float[np.ndarray, "p 2"]:
    """Points of the route, `PATH_M` ahead of the place beside the car: metres ahead of and left of the car."""
    apart = town.route.ahead(town.place.arclength_m + np.array(PATH_M)) - (state.x_m, state.y_m)
    c, s = math.cos(state.yaw_rad), math.sin(state.yaw_rad)
    return apart @ np.array([[c, -s], [s, c]])


def _shard(rows: list[_Row], plan: CollectionPlan, number: int, given: _Conditions) -> Shard:
    seen, answers, lateral, paths = zip(*rows, strict=True)
    return Shard(
        frames=np.stack([one.frame for one in seen]),
        speed_mps=np.array([one.state.speed_mps for one in seen], np.float32),
        command=np.array([int(one.command) for one in seen], np.int8),
        expert=np.array([(a.steer, a.throttle, a.brake) for a in answers], np.float32),
        lateral_m=np.array(lateral, np.float32),
        path_m=np.array(paths, np.float32),
        about={
            "plan": asdict(plan),
            "number": number,
            "weather": given.weather,
            "cars": given.cars,
            "pedestrians": given.pedestrians,
            "disturbed": given.disturbance is not None,
            "painted": given.pattern is not None,
        },
    )
