"""How fast is the town, how soon does it start, how much memory does it take?

    python benchmarks/simulator_speed.py --json OUT [--graphics egl]

Frames per second are those of closed-loop drives of the expert at 200×88, rendered at 400×176: expert, traffic,
physics, events, rendering and read-back. Each figure is the median over drives of a scenario each; two processes run
at the same time. Start-up is measured in a fresh process, from the import to the first frame, with nothing cached.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import resource
import statistics
import subprocess
import sys
import time
from importlib.metadata import version
from pathlib import Path

from roadproof.io.files import write_json
from roadproof.machine import made_with

GOALS = {"alone_fps": 500.0, "traffic_fps": 300.0, "start_s": 2.0, "memory_mb": 400.0}
AGENTS = 20
SCENARIOS = ("straight-01", "left-05", "right-03", "straight-08", "left-02", "right-07")

STARTED = """
import sys, time; began = time.perf_counter()
from roadproof.scenarios import builtin_scenarios
from roadproof.simulators.town.simulator import TownSimulator
with TownSimulator(graphics=sys.argv[1]) as simulator:
    simulator.reset(builtin_scenarios()[0])
    print(time.perf_counter() - began)
"""


def speeds(agents: int, graphics: str, frames: bool) -> tuple[list[float], float]:
    """Steps per second of a drive of each scenario in this process, and its peak memory in MB."""
    from roadproof.scenarios import find_scenario
    from roadproof.simulators.town.simulator import TownSimulator
    from roadproof.training.expert import Expert

    found: list[float] = []
    with TownSimulator(graphics=graphics) as simulator:
        for name in ("straight-01", *SCENARIOS):  # the first only warms up
            scenario = find_scenario(name)
            seen = simulator.reset(scenario, cars=agents, pedestrians=agents, seed=0, frames=frames)
            expert, steps, began = Expert(simulator.route), 0, time.perf_counter()
            while not seen.done:
                seen = simulator.step(expert.drive(seen.state, simulator.cars, simulator.pedestrians))
                steps += 1
            found.append(steps / (time.perf_counter() - began))
    return found[1:], resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def measured(processes: int, agents: int, graphics: str, *, frames: bool = True) -> dict[str, float]:
    """Median frames per second of a process while as many run, or steps without any, and the largest peak memory."""
    with multiprocessing.get_context("spawn").Pool(processes) as pool:
        results = pool.starmap(speeds, [(agents, graphics, frames)] * processes, chunksize=1)
    every = [fps for found, _ in results for fps in found]
    return {
        "median_fps": statistics.median(every),
        "slowest_fps": min(every),
        "fastest_fps": max(every),
        "memory_mb": max(memory for _, memory in results),
    }


def start_seconds(repeats: int, graphics: str) -> float:
    """Median seconds from import to first frame in fresh processes."""
    runs = [
        float(
            subprocess.run([sys.executable, "-c", STARTED, graphics], check=True, capture_output=True, text=True).stdout
        )
        for _ in range(repeats)
    ]
    return statistics.median(runs)


def main() -> None:
    """Measure, print and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, required=True)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--graphics", default="software", choices=["software", "egl"])
    arguments = parser.parse_args()
    load_before = os.getloadavg()[0] if hasattr(os, "getloadavg") else None
    result: dict[str, object] = {
        "one_process_alone": measured(1, 0, arguments.graphics),
        "one_process_traffic": measured(1, AGENTS, arguments.graphics),
        "two_processes_alone": measured(2, 0, arguments.graphics),
        "two_processes_traffic": measured(2, AGENTS, arguments.graphics),
        "one_process_without_frames": measured(1, 0, arguments.graphics, frames=False),
        "start_s": start_seconds(arguments.repeats, arguments.graphics),
        "goals": GOALS,
        "graphics": arguments.graphics,
        "agents": {"cars": AGENTS, "pedestrians": AGENTS},
        "load_before": load_before,
        "made_with": made_with() | {"panda3d": version("panda3d")},
    }
    for name, value in result.items():
        print(f"{name}: {value}")
    write_json(arguments.json, result)


if __name__ == "__main__":
    main()
