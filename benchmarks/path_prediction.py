"""Does the recorded world foretell where the car goes? Predicted against driven deviation, pattern by pattern.

    python benchmarks/path_prediction.py --json OUT [--scenarios left-03 …] [--controllers pilotnet cil] [--seed 0]
        [--simulator town | carla://HOST:PORT]

For each cell, a controller on a scenario: five drives are recorded and calibrated as `roadproof demo` does
(15 simulator calls), and patterns are taken from four sources: drawn at random, found by open-loop searches of 2, 12
and 30 steps, and found by a search in the recorded world. Each is driven over once in the recorded world and once in
the simulator, alone at clear noon, from the same start. Nothing of its drives over paint is known to the prediction.

The JSON has one record a cell and one with cell = "pooled": how many patterns, Spearman's rank correlation, R² to the
identity line (not to a fitted one), mean absolute error in metres; and every pattern's source and both numbers. Cells
that stand in OUT already are not done again.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.stats import spearmanr

import roadproof
from roadproof.attacks import GradOpt, PathDeviation, Surrogate
from roadproof.attacks.deviation import DeviationMeasure
from roadproof.attacks.driven import DrivenMeasure, InSimulator
from roadproof.attacks.gradopt import Rung, gradopt
from roadproof.attacks.groups import LEFT_GROUP, RIGHT_GROUP
from roadproof.calibration import calibrate
from roadproof.drives import record
from roadproof.io.files import write_json
from roadproof.machine import keep_freed_memory, made_with
from roadproof.patterns import Pattern
from roadproof.pipeline.budget import QUICK
from roadproof.recordings import RecordingSet
from roadproof.scenarios import Scenario, find_scenario
from roadproof.search_space import SearchSpace
from roadproof.simulators.loading import open_simulator

SCENARIOS = ("left-03", "right-05", "straight-04", "left-07", "right-02", "straight-09")
GROUPS = (RIGHT_GROUP, LEFT_GROUP)
OPEN_LOOP_STEPS = (2, 12, 30)
RANDOM = 4
CLOSED_LOOP = GradOpt(iterations=10, restarts=3)


def patterns(
    recordings: RecordingSet, controller: roadproof.Controller, space: SearchSpace, seed: int
) -> tuple[list[str], Pattern, DeviationMeasure]:
    """Patterns with the names of their sources, and the recorded world."""
    names, points = ["random"] * RANDOM, [space.random((1, RANDOM), torch.Generator().manual_seed(seed + 5))[0]]
    three = replace(recordings, recordings=recordings.recordings[:3])
    frames = Surrogate(three, controller, GROUPS).thinned(5)
    for steps in OPEN_LOOP_STEPS:
        found = gradopt(frames, space, (Rung(4, steps),), seed=seed + 1)
        points.append(found.best_unit.flatten(0, 1))
        names += [f"open loop, {steps} steps"] * len(points[-1])
    objective = PathDeviation()
    world = objective.measure(recordings, controller, GROUPS, device="cpu")
    found = gradopt(world, space, CLOSED_LOOP.ladder(objective), seed=seed)
    points.append(found.best_unit.flatten(0, 1))
    names += ["recorded world"] * len(points[-1])
    return names, space.pattern(torch.cat(points)), world


def cell(controller_name: str, scenario: Scenario, seed: int, spec: str) -> dict[str, Any]:
    """One controller on one scenario."""
    began = time.perf_counter()
    space = SearchSpace(figures=5)
    controller = roadproof.load_controller(controller_name)
    with open_simulator(spec) as simulator:
        drives = record(
            simulator,
            controller,
            scenario,
            trajectories=QUICK.trajectories,
            window=QUICK.window,
            seed=seed,
        )
        calibrated = calibrate(simulator, drives, QUICK.calibration)
        names, painted, world = patterns(calibrated.recordings, controller, space, seed)
        rolling = time.perf_counter()
        predicted = world.worlds[0].predict(controller, painted).deviation_m[:, 0]
        rolled_s = time.perf_counter() - rolling
        driving = DrivenMeasure(InSimulator(simulator, scenario), controller, PathDeviation())
        driven = [driving.effect(painted[k]).deviation for k in range(len(names))]
    return {
        "cell": f"{controller_name} {scenario.name}",
        "seed": seed,
        "calls": calibrated.report.calls,
        "vehicle_r2": world.worlds[0].vehicle.r2,
        "seconds": time.perf_counter() - began,
        "roll_ms_a_picture": 1000 * rolled_s / (len(names) * world.worlds[0].course.count),
        "each": [
            {"source": name, "predicted_m": round(p, 4), "driven_m": round(d, 4)}
            for name, p, d in zip(names, predicted, driven, strict=True)
        ],
    }


def summary(name: str, each: list[dict[str, Any]]) -> dict[str, Any]:
    """How predicted and driven numbers agree; None where all are the same."""
    predicted, driven = (np.array([one[key] for one in each]) for key in ("predicted_m", "driven_m"))
    left, spread = (float(np.square(driven - other).sum()) for other in (predicted, driven.mean()))
    alike = not spread or not np.ptp(predicted)
    return {
        "cell": name,
        "patterns": len(each),
        "spearman": None if alike else float(spearmanr(predicted, driven)[0]),
        "r2": None if alike else 1.0 - left / spread,
        "mae_m": float(np.abs(predicted - driven).mean()),
    }


def main() -> None:
    """Measure, cell by cell."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, required=True)
    parser.add_argument("--scenarios", nargs="+", default=SCENARIOS)
    parser.add_argument("--controllers", nargs="+", default=("pilotnet", "cil"))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--simulator", default="town")
    args = parser.parse_args()
    keep_freed_memory()  # as the command line does
    stored = json.loads(args.json.read_text()) if args.json.exists() else {"records": []}
    # Older files are of seed 0.
    simulator = args.simulator.split(":")[0]
    known = stored.get("simulator", simulator), stored.get("seed", 0 if stored["records"] else args.seed)
    if known != (simulator, args.seed):
        parser.error(f"{args.json} is of simulator {known[0]}, seed {known[1]}; choose another file")
    cells = {one["cell"]: one for one in stored["records"] if "each" in one}
    for name in args.controllers:
        for scenario in (find_scenario(each) for each in args.scenarios):
            if f"{name} {scenario.name}" in cells:
                continue
            found = cell(name, scenario, args.seed, args.simulator)
            cells[found["cell"]] = summary(found["cell"], found["each"]) | found
            print({key: value for key, value in cells[found["cell"]].items() if key != "each"}, flush=True)
            every = [one for each in cells.values() for one in each["each"]]
            content = {
                "made_with": made_with(),
                "simulator": simulator,
                "seed": args.seed,
                "records": [*cells.values(), summary("pooled", every)],
            }
            write_json(args.json, content)
    print(summary("pooled", [one for each in cells.values() for one in each["each"]]))


if __name__ == "__main__":
    main()
