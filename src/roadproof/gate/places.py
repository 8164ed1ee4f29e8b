"""Where a check drives: each scenario in a simulator, or in the recordings of each weather."""

from __future__ import annotations

import shlex
from dataclasses import astuple, dataclass
from functools import partial
from pathlib import Path

from roadproof.datatypes import Weather
from roadproof.gate.plan import CheckPlan
from roadproof.pipeline.worlds import open_world
from roadproof.scenarios import Scenario
from roadproof.simulators.loading import RECORDED
from roadproof.simulators.protocol import SimulatorFactory


@dataclass(frozen=True, kw_only=True, slots=True)
class Place:
    """A scenario in the world that it is driven in.

    Args:
        scenario: the scenario that is driven.
        weathers: the weathers in which it is driven there.
        factory: opens the world; its result is used in a with-block.
        where: the world as `--simulator` names it.
    """

    scenario: Scenario
    weathers: tuple[Weather, ...]
    factory: SimulatorFactory
    where: str


def places_of(plan: CheckPlan, device: str) -> tuple[Place, ...]:
    """The places of a check, in the order of its plan.

    Args:
        plan: the plan of the check.
        device: the torch device on which recorded worlds make their pictures.
    """

    def place(scenario: Scenario, weathers: tuple[Weather, ...], where: str) -> Place:
        return Place(scenario=scenario, weathers=weathers, factory=partial(open_world, where, device), where=where)

    if plan.budget == "full":
        return tuple(place(each, plan.weathers, plan.simulator) for each in plan.scenarios)
    return tuple(
        place(each, (weather,), f"{RECORDED}{plan.recordings[each.name, weather]}")
        for each in plan.scenarios
        for weather in plan.weathers
    )


def command_of(plan: CheckPlan, place: Place, weather: Weather, pattern: str, seed: int, out: Path) -> str:
    """The command to drive over a pattern, and the bare road, from the starts of one seed, and to film the first."""
    words = ["roadproof", "evaluate", pattern, "--controller", plan.controller, "--simulator", place.where]
    if plan.budget == "full":
        words += ["--scenario", place.scenario.name, "--weathers", weather, "--runs", "0"]
        words += [] if plan.scenario_file is None else ["--scenarios", str(plan.scenario_file)]
    words += ["--starts", str(plan.starts.count), "--start-range", *map(str, astuple(plan.starts.range))]
    return shlex.join([*words, "--seed", str(seed), "--out", str(out)])
