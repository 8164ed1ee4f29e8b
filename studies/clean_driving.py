"""How do the shipped controllers drive where nothing is painted?

    python studies/clean_driving.py --json OUT [--controllers cil pilotnet] [--processes N]

Every controller drives, closed loop: the 40 built-in scenarios in four weathers, alone; the same at clear noon with 20
cars and 20 people; 40 random ways through the town it learnt in; and 40 through the second town, which it never saw. A
drive is clean when it arrives in time without any event. Drives that OUT already holds are not repeated, unless a
controller has other weights now.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.progress import Progress

from roadproof.controllers import shipped_names
from roadproof.controllers.shipped import shipped_weights
from roadproof.datatypes import PAPER_WEATHERS, Command
from roadproof.io.files import write_json
from roadproof.io.identity import digest
from roadproof.machine import made_with
from roadproof.roads.maps import load_map
from roadproof.scenarios import Scenario, builtin_scenarios
from roadproof.training.random_scenarios import random_scenario
from roadproof.training.scores import BareDrive, DrivingScore, score_drives

AGENTS = 20
RANDOM_WAYS = 40
RANDOM_SEED = 99
COMMANDS = (Command.LEFT, Command.RIGHT, Command.STRAIGHT, Command.FOLLOW)


def random_ways(map_name: str) -> list[Scenario]:
    """Ways that no drive to learn from was drawn with."""
    roads = load_map(map_name)
    return [
        random_scenario(
            roads,
            map_name,
            np.random.default_rng([RANDOM_SEED, number]),
            name=f"{map_name}-{number:02d}",
            command=COMMANDS[number % len(COMMANDS)],
        )
        for number in range(RANDOM_WAYS)
    ]


def conditions() -> dict[str, list[BareDrive]]:
    """What is driven, by name."""
    built_in = builtin_scenarios()
    every = {weather.value: [BareDrive(scenario=s, weather=weather) for s in built_in] for weather in PAPER_WEATHERS}
    every["traffic"] = [BareDrive(scenario=s, cars=AGENTS, pedestrians=AGENTS) for s in built_in]
    every["random ways, town"] = [BareDrive(scenario=s) for s in random_ways("town")]
    every["random ways, second town"] = [BareDrive(scenario=s) for s in random_ways("second")]
    return every


def row(score: DrivingScore) -> dict[str, Any]:
    """A score as JSON."""
    return {
        "clean": score.clean,
        "arrived": score.arrived,
        "events": [event.kind.value for event in score.events],
        "seconds": round(score.seconds, 2),
        "lateral_m": round(score.lateral_m, 3),
        "mean_lateral_m": round(score.mean_lateral_m, 3),
        "steer_change": round(score.steer_change, 5),
        "turns": score.turns,
        "turns_taken": score.turns_taken,
        "failed_at_m": score.failed_at_m,
    }


def summary(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Counts and means of a condition."""
    events = Counter(event for one in rows for event in one["events"])
    return {
        "drives": len(rows),
        "clean": sum(one["clean"] for one in rows),
        "arrived": sum(one["arrived"] for one in rows),
        "events": dict(events),
        "collisions_per_drive": round(sum(n for kind, n in events.items() if kind.startswith("coll")) / len(rows), 3),
        "mean_lateral_m": round(statistics.mean(one["mean_lateral_m"] for one in rows), 3),
        "steer_change": round(statistics.mean(one["steer_change"] for one in rows), 5),
        "turns": sum(one["turns"] for one in rows),
        "turns_taken": sum(one["turns_taken"] for one in rows),
    }


def study(controllers: Sequence[str], names: Sequence[str], processes: int, out: Path) -> None:
    """Drive what is missing, write after every drive."""
    begin = time.perf_counter()
    content: dict[str, Any] = json.loads(out.read_text(encoding="utf-8")) if out.exists() else {"drives": {}}
    drives: dict[str, dict[str, dict[str, Any]]] = content["drives"]
    weights: dict[str, str] = content.setdefault("weights", {})
    with Progress() as bar:
        for controller in controllers:
            now = digest(shipped_weights(controller).read_bytes())[:16]
            if weights.get(controller) != now:
                drives.pop(controller, None)  # of other weights of this name, or nobody knows of which
                weights[controller] = now
            for name, wanted in conditions().items():
                if name not in names:
                    continue
                done = drives.setdefault(controller, {}).setdefault(name, {})
                missing = [drive for drive in wanted if drive.scenario.name not in done]
                task = bar.add_task(f"{controller}, {name}", total=len(wanted), completed=len(done))
                for drive, score in score_drives(missing, str(shipped_weights(controller)), processes=processes):
                    done[drive.scenario.name] = row(score)
                    bar.advance(task)
                    keep(content, out)
                found = summary(list(done.values()))
                bar.console.print(f"{controller}, {name}: {found['clean']} of {found['drives']} clean, {found}")
    content["seconds"] = round(content.get("seconds", 0.0) + time.perf_counter() - begin, 1)
    keep(content, out)


def keep(content: dict[str, Any], out: Path) -> None:
    """Summarise and write."""
    content["made_with"] = made_with()
    content["summary"] = {
        controller: {name: summary(list(rows.values())) for name, rows in every.items() if rows}
        for controller, every in content["drives"].items()
    }
    write_json(out, content)


def main() -> None:
    """Read the options and go."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path, required=True, help="file to write the numbers to, or to go on with")
    parser.add_argument("--controllers", nargs="+", default=list(shipped_names()), help="which; by default all")
    parser.add_argument(
        "--conditions", nargs="+", choices=list(conditions()), default=list(conditions()), help="which; by default all"
    )
    parser.add_argument("--processes", type=int, default=os.cpu_count() or 1, help="simulators at once")
    options = parser.parse_args()
    study(options.controllers, options.conditions, options.processes, options.json)


if __name__ == "__main__":
    main()
