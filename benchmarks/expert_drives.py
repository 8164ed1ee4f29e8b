"""Does the expert complete the built-in scenarios, alone and in traffic?

    python benchmarks/expert_drives.py --json OUT

Every drive is closed loop in the town: its physics, its traffic, its judge. A drive counts as clean when it reaches the
goal within the time limit without any event; alone on the road, it ends at the first one.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections import Counter
from pathlib import Path

from roadproof.io.files import write_json
from roadproof.machine import made_with
from roadproof.scenarios import builtin_scenarios
from roadproof.training.scores import BareDrive, DrivingScore, score_drives

TRAFFIC_SEEDS = (0, 1, 2)
AGENTS = 20


def summary(drives: list[tuple[BareDrive, DrivingScore]]) -> dict[str, object]:
    """Counts and spreads of a set of drives."""
    scores = [score for _, score in drives]
    return {
        "drives": len(drives),
        "clean": sum(one.clean for one in scores),
        "not_arrived": [drive.scenario.name for drive, one in drives if not one.arrived],
        "events": dict(Counter(event.kind.value for one in scores for event in one.events)),
        "with_events": [drive.scenario.name for drive, one in drives if one.events],
        "seconds_median": round(statistics.median(one.seconds for one in scores), 2),
        "seconds_longest": round(max(one.seconds for one in scores), 2),
        "lateral_m_largest": round(max(one.lateral_m for one in scores), 3),
    }


def main() -> None:
    """Drive all, print and write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path, required=True, help="file to write the numbers to")
    out: Path = parser.parse_args().json
    scenarios = builtin_scenarios()
    results: dict[str, object] = {"made_with": made_with()}
    begin = time.perf_counter()
    conditions = [("alone", 0, 0), *((f"traffic, seed {seed}", AGENTS, seed) for seed in TRAFFIC_SEEDS)]
    for name, agents, seed in conditions:
        wanted = [BareDrive(scenario=scenario, cars=agents, pedestrians=agents, seed=seed) for scenario in scenarios]
        result = summary(list(score_drives(wanted, None)))
        results[name] = result
        print(f"{name}: {result['clean']} of {result['drives']} clean, events {result['events']}")
    results["wall_s"] = round(time.perf_counter() - begin, 1)
    write_json(out, results)


if __name__ == "__main__":
    main()
