"""Does the expert complete the built-in scenarios, alone and in traffic?

    python benchmarks/expert_drives.py --json OUT

Every drive is closed loop in the town: its physics, its traffic, its judge. A drive counts as clean when it reaches the
goal within the time limit without any event.
"""

from __future__ import annotations

import argparse
import json
import platform
import statistics
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

from roadproof.scenarios import Scenario, builtin_scenarios
from roadproof.simulators.town.simulator import TownSimulator
from roadproof.training.expert import Expert

TRAFFIC_SEEDS = (0, 1, 2)
AGENTS = 20


@dataclass(frozen=True)
class Drive:
    """What came of one drive."""

    scenario: str
    arrived: bool
    events: tuple[str, ...]
    seconds: float
    lateral_m: float

    @property
    def clean(self) -> bool:
        """Arrived, and nothing happened."""
        return self.arrived and not self.events


def drive(simulator: TownSimulator, scenario: Scenario, agents: int, seed: int) -> Drive:
    """One drive of the expert."""
    seen = simulator.reset(scenario, cars=agents, pedestrians=agents, seed=seed)
    route = simulator.route
    expert = Expert(route)
    events = [event.kind.value for event in seen.events]
    at = lateral = 0.0
    while not seen.done:
        control = expert.drive(seen.state, simulator.cars, simulator.pedestrians)
        seen = simulator.step(control)
        events += [event.kind.value for event in seen.events]
        place = route.locate(seen.state.x_m, seen.state.y_m, at)
        at, lateral = place.arclength_m, max(lateral, abs(place.lateral_m))
    arrived = seen.time_s < scenario.time_limit_s - 1e-6
    return Drive(scenario.name, arrived, tuple(events), seen.time_s, lateral)


def summary(drives: list[Drive]) -> dict[str, object]:
    """Counts and spreads of a set of drives."""
    return {
        "drives": len(drives),
        "clean": sum(one.clean for one in drives),
        "not_arrived": [one.scenario for one in drives if not one.arrived],
        "events": dict(Counter(event for one in drives for event in one.events)),
        "with_events": [one.scenario for one in drives if one.events],
        "seconds_median": round(statistics.median(one.seconds for one in drives), 2),
        "seconds_longest": round(max(one.seconds for one in drives), 2),
        "lateral_m_largest": round(max(one.lateral_m for one in drives), 3),
    }


def main() -> None:
    """Drive all, print and write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path, required=True, help="file to write the numbers to")
    out: Path = parser.parse_args().json
    scenarios = builtin_scenarios()
    results: dict[str, object] = {"python": platform.python_version(), "machine": platform.machine()}
    begin = time.perf_counter()
    with TownSimulator() as simulator:
        conditions = [("alone", 0, 0), *((f"traffic, seed {seed}", AGENTS, seed) for seed in TRAFFIC_SEEDS)]
        for name, agents, seed in conditions:
            result = summary([drive(simulator, scenario, agents, seed) for scenario in scenarios])
            results[name] = result
            print(f"{name}: {result['clean']} of {result['drives']} clean, events {result['events']}")
    results["wall_s"] = round(time.perf_counter() - begin, 1)
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
