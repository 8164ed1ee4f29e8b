"""How strong is a search's first choice, and is it the best of what the search found?

    python studies/closed_loop.py --json OUT --keep FOLDER [--controllers pilotnet cil] [--seeds 0 1] [--processes 2]

For every controller, scenario and seed, five drives are recorded and calibrated as `roadproof demo` does (15 calls of
the simulator), and searched twice:
  steering    the steering shift on those recorded frames, competing starts and 30 steps
  deviation   the path in the recorded world, competing starts and 32 steps
Each search's six candidates, best first in its own order, are driven once at clear noon, alone. So every row holds what
the search thought, what its first choice did when driven, what the best of its six did, and which it was; the first
choice is driven in the paper's other weathers too. Nothing driven chose a pattern.

Everything is kept in FOLDER; an interrupted study goes on there, and writes what it has after every cell.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from concurrent.futures import as_completed
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

import roadproof
from roadproof.attacks import GradOpt, Objective, PathDeviation, SteeringShift, kept_attack
from roadproof.calibration import Calibrated, calibrate
from roadproof.drives import record
from roadproof.driving.evaluate import evaluate
from roadproof.driving.intervals import mean_95
from roadproof.io.files import write_json
from roadproof.machine import keep_freed_memory, made_with
from roadproof.pipeline.budget import QUICK
from roadproof.pipeline.selection import select_by_driving
from roadproof.processes import processes_beside
from roadproof.scenarios import find_scenario
from roadproof.search_space import SearchSpace
from roadproof.simulators.town.simulator import TownSimulator

SCENARIOS = ("left-03", "right-05", "straight-04", "left-07", "right-02", "straight-09")
PLACES = 3
SEARCHES: dict[str, tuple[Objective, GradOpt]] = {
    "steering": (SteeringShift(), GradOpt(iterations=30, restarts=PLACES)),
    "deviation": (PathDeviation(), GradOpt(restarts=PLACES)),
}
SIX = 2 * PLACES

Row = dict[str, Any]


@dataclass(frozen=True, kw_only=True)
class Cell:
    """One controller in one scenario with one seed; `keep` is the study's folder."""

    controller: str
    scenario: str
    seed: int
    keep: Path

    @property
    def folder(self) -> Path:
        """Where its drives and searches are."""
        return self.keep / self.controller / self.scenario / f"seed-{self.seed}"


def rows_of(cell: Cell) -> list[Row]:
    """Both searches in one cell."""
    torch.set_num_threads(1)
    keep_freed_memory()  # as the command line does
    kept = {name: cell.folder / name / "row.json" for name in SEARCHES}
    if all(path.exists() for path in kept.values()):
        return [json.loads(path.read_text(encoding="utf-8")) for path in kept.values()]
    controller = roadproof.load_controller(cell.controller)
    scenario, space = find_scenario(cell.scenario), SearchSpace(figures=5)
    rows: list[Row] = []
    with TownSimulator() as town:
        drives = record(
            town,
            controller,
            scenario,
            trajectories=QUICK.trajectories,
            window=QUICK.window,
            seed=cell.seed,
            driver_name=cell.controller,
            folder=cell.folder / "record",
        )
        calibrated = Calibrated.kept(cell.folder, drives, QUICK.calibration)
        if calibrated is None:
            calibrated = calibrate(town, drives, QUICK.calibration, folder=cell.folder / "calibration")
            calibrated.save(cell.folder)
        for name, (objective, method) in SEARCHES.items():
            if kept[name].exists():
                rows.append(json.loads(kept[name].read_text(encoding="utf-8")))
                continue
            place = cell.folder / name
            found = kept_attack(
                place / "attack",
                calibrated.recordings,
                controller,
                space,
                objective=objective,
                method=method,
                seed=cell.seed,
            )
            selection = select_by_driving(
                town,
                controller,
                scenario,
                found.candidates,
                best=SIX,
                folder=place / "selection",
                clean=drives.drives[0].episode,
            )
            judged = evaluate(
                town, controller, scenario, found.pattern, folder=place / "evaluation", starts=1, runs=0,
                driver_name=cell.controller,
            )  # fmt: skip
            row = {
                "controller": cell.controller,
                "scenario": cell.scenario,
                "seed": cell.seed,
                "search": name,
                "predicted_m": found.predicted_m,
                "candidates_m": [each.predicted_m for each in found.candidates],
                "driven_m": [each.trial.deviation_m for each in selection.driven],
                "by_weather_m": {trial.weather: trial.deviation_m for trial in judged.of(traffic=False)},
                "recording_calls": calibrated.report.calls,
                "search_seconds": found.cost.seconds,
            }
            rows.append(row)
            write_json(kept[name], row)
    return rows


def summary(rows: Sequence[Row]) -> list[Row]:
    """Means over scenarios and seeds, with 95 % intervals over scenarios: seeds of one are not independent."""
    found: list[Row] = []
    for controller in dict.fromkeys(each["controller"] for each in rows):
        for search in SEARCHES:
            those = [each for each in rows if (each["controller"], each["search"]) == (controller, search)]
            driven = np.array([each["driven_m"] for each in those])
            first, best = driven[:, 0], driven.max(1)
            where = np.array([each["scenario"] for each in those])
            first_m, best_m = (
                mean_95([float(metres[where == name].mean()) for name in dict.fromkeys(where)])
                for metres in (first, best)
            )
            found.append(
                {
                    "controller": controller,
                    "search": search,
                    "cells": len(those),
                    "first_m": asdict(first_m),
                    "best_of_six_m": asdict(best_m),
                    "mean_of_six_m": float(driven.mean()),
                    "first_is_best": float((first == best).mean()),
                    "first_within_5_percent": float((first >= 0.95 * best).mean()),
                    "four_weathers_m": float(np.mean([list(each["by_weather_m"].values()) for each in those])),
                    "search_seconds": float(np.mean([each["search_seconds"] for each in those])),
                }
            )
    return found


def write(path: Path, rows: Sequence[Row]) -> None:
    """All that is known so far."""
    content = {
        "study": "first choice",
        "version": 1,
        "summary": summary(rows),
        "rows": list(rows),
        "made_with": made_with(),
    }
    write_json(path, content)


def main() -> None:
    """Read the options, do the cells."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, required=True)
    parser.add_argument("--keep", type=Path, required=True)
    parser.add_argument("--controllers", nargs="+", default=("pilotnet", "cil"))
    parser.add_argument("--scenarios", nargs="+", default=SCENARIOS)
    parser.add_argument("--seeds", type=int, nargs="+", default=(0, 1))
    parser.add_argument("--processes", type=int, default=1)
    arguments = parser.parse_args()
    cells = [
        Cell(controller=controller, scenario=scenario, seed=seed, keep=arguments.keep)
        for seed in arguments.seeds
        for controller in arguments.controllers
        for scenario in arguments.scenarios
    ]
    began = time.perf_counter()
    rows: dict[Cell, list[Row]] = {}
    with processes_beside(arguments.processes) as pool:
        running = {pool.submit(rows_of, cell): cell for cell in cells}
        for done in as_completed(running):
            rows[running[done]] = done.result()
            found = [row for each in cells for row in rows.get(each, [])]
            write(arguments.json, found)
            print(f"{len(rows)} of {len(cells)} cells, {time.perf_counter() - began:.0f} s", flush=True)
            for each in summary(found):
                print(
                    f"  {each['controller']:9} {each['search']:10} first {each['first_m']['value']:.2f} m, best of six "
                    f"{each['best_of_six_m']['value']:.2f} m, first is best in {each['first_is_best']:.0%}",
                    flush=True,
                )


if __name__ == "__main__":
    main()
