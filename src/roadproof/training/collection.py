"""Collecting drives to learn from: the expert drives, or a controller drives and the expert says what it would do.

Each drive follows from the plan and its number alone, so that processes can share the work, and a folder with some of
the drives can be filled up later.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch

from roadproof.controllers import Controller
from roadproof.controllers.asking import act_of
from roadproof.datatypes import Command, Control, Event, Observation, Weather
from roadproof.driving.rollout import Policy
from roadproof.errors import TrainingError
from roadproof.patterns import raster
from roadproof.roads.maps import load_map
from roadproof.scenarios import Scenario
from roadproof.search_space import SearchSpace
from roadproof.simulators.protocol import PatternImage
from roadproof.simulators.town.simulator import TownSimulator
from roadproof.training.expert import Expert
from roadproof.training.shards import Shard
from roadproof.training.ways import Displacement, Knocks, random_scenario
from roadproof.training.workers import Seat, spread

STEP_S = 0.1
FURTHEST_M = 2.6
STILL_S = 2.0
COMMANDS = (Command.LEFT, Command.RIGHT, Command.STRAIGHT, Command.LEFT, Command.RIGHT, Command.FOLLOW)
WEATHERS = (*tuple(Weather)[:4] * 2, *tuple(Weather)[4:])
"""The paper's four weathers twice as often as the others."""

MOST_FIGURES = 5


@dataclass(frozen=True, kw_only=True, slots=True)
class CollectionPlan:
    """Which drives to record.

    Args:
        drives: how many.
        seed: of everything: ways, weathers, traffic, knocks, paint.
        map_name: the map driven on.
        controller: spec of who drives; None is the expert.
        knocked: share of the drives that are disturbed.
        traffic: share of the drives with others on the road.
        painted: share of the drives with a random pattern on the canvas.

    Raises:
        TrainingError: a share is not in [0, 1], or there is no drive.
    """

    drives: int
    seed: int
    map_name: str = "town"
    controller: str | None = None
    knocked: float = 0.7
    traffic: float = 0.4
    painted: float = 0.0

    def __post_init__(self) -> None:
        if self.drives < 1:
            raise TrainingError(f"drives is {self.drives}, expected at least 1")
        for name in ("knocked", "traffic", "painted"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise TrainingError(f"{name} is {getattr(self, name)}, expected a share in [0, 1]")


@dataclass(frozen=True, slots=True, eq=False)
class _Conditions:
    """What a drive is like; follows from plan and number."""

    scenario: Scenario
    weather: Weather
    cars: int
    pedestrians: int
    pattern: PatternImage | None
    knocks: Knocks | None


def collect(
    plan: CollectionPlan, folder: Path, *, processes: int = 1, on_drive: Callable[[int], object] | None = None
) -> tuple[Path, ...]:
    """Record the drives of a plan that the folder does not hold yet.

    Args:
        plan: which drives.
        folder: where the shards go, one a drive.
        processes: how many simulators drive at once.
        on_drive: told how many drives the folder holds, after each.

    Returns:
        The shards of the plan, in order.

    Raises:
        TrainingError: the plan is not valid.
        ControllerError: the controller cannot be loaded.
        OutputError: a shard cannot be written.
    """
    paths = tuple(folder / f"drive-{number:05d}.npz" for number in range(plan.drives))
    missing = [(plan, number, path) for number, path in enumerate(paths) if not path.exists()]
    done = plan.drives - len(missing)
    for _ in spread(_record, missing, Seat(plan.controller, STEP_S), processes=processes):
        done += 1
        if on_drive is not None:
            on_drive(done)
    return paths


def record_drive(town: TownSimulator, plan: CollectionPlan, number: int, controller: Controller | None) -> Shard:
    """Drive number so-and-so of a plan.

    It ends at the goal, after its time, when something is hit, or when the car is too far off for the expert's answer
    to mean anything.
    """
    given = _conditions(plan, number)
    seen = town.reset(
        given.scenario,
        weather=given.weather,
        pattern=given.pattern,
        cars=given.cars,
        pedestrians=given.pedestrians,
        seed=number,
    )
    expert, policy = Expert(town.route), None if controller is None else _acting(controller)
    rows: list[tuple[Observation, Control, float]] = []
    at_m, still_s, step = 0.0, 0.0, 0
    while not seen.done:
        place = town.route.locate(seen.state.x_m, seen.state.y_m, at_m if step else None)
        at_m = place.arclength_m
        if abs(place.lateral_m) > FURTHEST_M or any(_collided(event) for event in seen.events):
            break
        answer = expert.drive(seen.state, town.cars, town.pedestrians)
        still_s = still_s + town.dt_s if seen.state.speed_mps < 0.1 and answer.throttle == 0.0 else 0.0
        if still_s <= STILL_S:
            rows.append((seen, answer, place.lateral_m))
        control = answer if policy is None else policy(seen)
        seen = town.step(control if given.knocks is None else given.knocks.on(control, step))
        step += 1
    return _shard(rows, plan, number, given)


def _record(seat: Seat, work: tuple[CollectionPlan, int, Path]) -> None:
    plan, number, path = work
    record_drive(seat.town, plan, number, seat.controller).save(path)


def _conditions(plan: CollectionPlan, number: int) -> _Conditions:
    generator = np.random.default_rng([plan.seed, number])
    # First what does not depend on the shares, so that plans that differ in them alone share weathers and numbers.
    knocked, busy, painted = generator.uniform(size=3) < (plan.knocked, plan.traffic, plan.painted)
    weather = WEATHERS[int(generator.integers(len(WEATHERS)))]
    cars, pedestrians = (int(generator.integers(10, 41)) for _ in range(2))
    scenario = random_scenario(
        load_map(plan.map_name),
        plan.map_name,
        generator,
        name=f"drive-{number:05d}",
        command=COMMANDS[number % len(COMMANDS)],
        displacement=Displacement() if knocked else None,
    )
    steps = int(scenario.time_limit_s / STEP_S) + 2
    return _Conditions(
        scenario=scenario,
        weather=weather,
        cars=cars if busy else 0,
        pedestrians=pedestrians if busy else 0,
        pattern=_random_paint(generator) if painted else None,
        knocks=Knocks(steps, STEP_S, generator) if knocked else None,
    )


def _random_paint(generator: np.random.Generator) -> PatternImage:
    space = SearchSpace(figures=int(generator.integers(1, MOST_FIGURES + 1)), family="free")
    draw = torch.Generator().manual_seed(int(generator.integers(2**31)))
    return raster(space.pattern(space.random((), draw)))


def _acting(controller: Controller) -> Policy:
    return lambda seen: act_of(controller, seen.frame, seen.state.speed_mps, int(seen.command))


def _collided(event: Event) -> bool:
    return event.kind.startswith("collision")


def _shard(
    rows: list[tuple[Observation, Control, float]], plan: CollectionPlan, number: int, given: _Conditions
) -> Shard:
    seen, answers, lateral = zip(*rows, strict=True)
    return Shard(
        frames=np.stack([one.frame for one in seen]),
        speed_mps=np.array([one.state.speed_mps for one in seen], np.float32),
        command=np.array([int(one.command) for one in seen], np.int8),
        expert=np.array([(a.steer, a.throttle, a.brake) for a in answers], np.float32),
        lateral_m=np.array(lateral, np.float32),
        about={
            "plan": asdict(plan),
            "number": number,
            "weather": given.weather,
            "cars": given.cars,
            "pedestrians": given.pedestrians,
            "knocked": given.knocks is not None,
            "painted": given.pattern is not None,
        },
    )
