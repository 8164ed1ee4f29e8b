"""Where a check drives: each scenario in a simulator, or in the recordings of each weather."""

from __future__ import annotations

import shlex
from dataclasses import astuple, dataclass, replace
from functools import partial
from pathlib import Path

from roadproof.datatypes import Weather
from roadproof.gate.plan import CheckPlan
from roadproof.recorded.simulator import RecordedSimulator
from roadproof.recordings import load_recordings
from roadproof.scenarios import Scenario
from roadproof.simulators.loading import open_simulator
from roadproof.simulators.protocol import Simulator, SimulatorFactory


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

    def begun_in(self, world: Simulator) -> Scenario:
        """The scenario as it is driven: in recordings it begins where they do."""
        recorded = isinstance(world, RecordedSimulator)
        return replace(self.scenario, start=world.scenario.start) if recorded else self.scenario


def places_of(plan: CheckPlan, device: str) -> tuple[Place, ...]:
    """The places of a check, in the order of its plan.

    Args:
        plan: the plan of the check.
        device: the torch device on which recorded worlds make their pictures.
    """
    if plan.budget == "full":
        factory = partial(open_simulator, plan.simulator)
        return tuple(
            Place(scenario=each, weathers=plan.weathers, factory=factory, where=plan.simulator)
            for each in plan.scenarios
        )
    return tuple(
        Place(
            scenario=each,
            weathers=(weather,),
            factory=partial(_in_recordings, plan.recordings[each.name, weather], weather, device),
            where=f"recorded:{plan.recordings[each.name, weather]}",
        )
        for each in plan.scenarios
        for weather in plan.weathers
    )


def _in_recordings(run: Path, weather: Weather, device: str) -> RecordedSimulator:
    return RecordedSimulator(load_recordings(run / "recordings"), weather=weather, device=device)


def command_of(plan: CheckPlan, place: Place, weather: Weather, pattern: str, seed: int, out: Path) -> str:
    """The command that drives over a pattern, and past the bare road, from the starts of one seed, and films it."""
    words = ["roadproof", "evaluate", pattern, "--controller", plan.controller, "--simulator", place.where]
    if plan.budget == "full":
        words += ["--scenario", place.scenario.name, "--weathers", weather, "--runs", "0"]
        words += [] if plan.scenario_file is None else ["--scenarios", str(plan.scenario_file)]
    words += ["--starts", str(plan.starts.count), "--start-range", *map(str, astuple(plan.starts.range))]
    return shlex.join([*words, "--seed", str(seed), "--out", str(out)])
