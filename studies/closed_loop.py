"""What does each part of the attack bring when the car really drives, and what does it cost?

    python studies/closed_loop.py --json OUT --keep FOLDER [--scenarios 6] [--figures 5] [--controllers pilotnet]

For every controller, scenario and seed, closed loop, alone on the road, in the paper's four weathers:
  no paint       penalty points of the bare road; its deviation is 0, since the others' is taken from it
  random         patterns drawn as the searches' starts are
  T=1            GradOpt on the clean drive alone, the surrogate's strongest
  T=3 published  on a Group of three drives pushed by steering noise of some degrees, the surrogate's strongest
  T=3 metres     the same, pushed aside by metres, the surrogate's strongest
  + driven       of its candidates the one that deviates most when driven at noon
  + rounds       searched on along the way the attacked car took, the best driven of all (`pipeline.rerecording`)
  + weathers     as "+ driven", searched in expectation over a dry and a rainy noon instead, half the frames of each
All searches have the same steps and two-paint calibration, so that rows differ in what they are named after. All
enlarge the steering shift; `first_choice.py` compares that with the search in the recorded world.

Numbers are means over weathers, then over scenarios and seeds, with 95 % intervals over the latter. Simulator calls
and seconds are those of finding the pattern; judging it takes 8 drives more. Everything is kept in FOLDER; an
interrupted study goes on there, and writes what it has after every cell.
"""

from __future__ import annotations

import argparse
import json
import platform
import time
from collections.abc import Sequence
from concurrent.futures import as_completed
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

import roadproof
from roadproof.attacks import GradOpt
from roadproof.controllers import Controller, load_controller
from roadproof.datatypes import Weather
from roadproof.drives import SteeringNoise, Trajectories, Window, load_drives
from roadproof.driving.evaluate import evaluate, random_patterns
from roadproof.driving.evaluation import Evaluation
from roadproof.driving.intervals import mean_95
from roadproof.errors import RoadproofError
from roadproof.io.files import write_atomically
from roadproof.patterns import Pattern
from roadproof.pipeline.budget import STEERING, Budget
from roadproof.pipeline.stage_costs import StageCost
from roadproof.pipeline.stress_test import StressTest, stress_test
from roadproof.processes import processes_beside
from roadproof.scenarios import Scenario, find_scenario
from roadproof.search_space import SearchSpace
from roadproof.simulators.town.simulator import TownSimulator

SCENARIOS = ("left-03", "right-05", "straight-04", "left-07", "right-02", "straight-09")
METHODS = (
    "no paint",
    "random",
    "T=1",
    "T=3 published",
    "T=3 metres",
    "+ driven",
    "+ rounds",
    "+ weathers",
)
OTHERS = ("T=1", "T=3 published", "+ weathers")
FOUND_BY = ("record", "calibrate", "attack")
BASE = replace(STEERING, method=GradOpt(iterations=24), window=Window(frames=14))


@dataclass(frozen=True, kw_only=True)
class Cell:
    """One controller in one scenario with one seed.

    Args:
        controller: a shipped one.
        scenario: where.
        seed: of recording, search and random patterns.
        figures: K.
        rounds: of re-recording.
        noise_deg: of the published perturbation.
        others: which of the methods are tried that search on recordings of their own.
        keep: the study's folder.
    """

    controller: str
    scenario: str
    seed: int
    figures: int
    rounds: int
    noise_deg: tuple[int, int]
    others: tuple[str, ...]
    keep: Path

    @property
    def folder(self) -> Path:
        """Where its runs are."""
        return self.keep / self.controller / self.scenario / f"seed-{self.seed}-K{self.figures}"


Row = dict[str, Any]


def row(cell: Cell, method: str, evaluation: Evaluation, pattern: str = "attack", **more: object) -> Row:
    """One method's numbers in one cell."""
    trials = evaluation.of(pattern, traffic=False)
    return {
        "controller": cell.controller,
        "scenario": cell.scenario,
        "seed": cell.seed,
        "method": method,
        "deviation_m": float(np.mean([trial.deviation_m for trial in trials])),
        "lateral_m": float(np.mean([abs(trial.lateral_m) for trial in trials])),
        "points": float(np.mean([trial.points for trial in trials])),
        "failed": float(np.mean([trial.points > trial.clean_points for trial in trials])),
        "by_weather": {
            weather: float(np.mean([trial.deviation_m for trial in trials if trial.weather == weather]))
            for weather in evaluation.weathers
        },
        **more,
    }


def cost(result: StressTest, *stages: str) -> Row:
    """Calls and seconds of some stages."""
    spent = [result.cost.get(stage, StageCost()) for stage in stages]
    return {"simulator_calls": sum(s.simulator_calls for s in spent), "seconds": sum(s.seconds for s in spent)}


def rows_of(cell: Cell) -> list[Row]:
    """All methods in one cell."""
    torch.set_num_threads(1)
    path = cell.folder / "rows.json"
    if path.exists():
        return json.loads(path.read_text(encoding="utf-8"))
    controller = load_controller(cell.controller)
    with TownSimulator() as town:
        rows = _rows(cell, town, controller, find_scenario(cell.scenario))
    write_atomically(path, lambda part: part.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8"))
    return rows


def _rows(cell: Cell, town: TownSimulator, controller: Controller, scenario: Scenario) -> list[Row]:
    def run(name: str, budget: Budget) -> StressTest:
        share_drives(cell, name, "evaluation")
        return stress_test(
            town,
            controller,
            scenario,
            cell.folder / name,
            budget=budget,
            space=SearchSpace(figures=cell.figures),
            seed=cell.seed,
            controller_name=cell.controller,
            film=False,
        )

    def judge(name: str, pattern: Pattern, baseline: Sequence[Pattern] = ()) -> Evaluation:
        share_drives(cell, name)
        return evaluate(
            town, controller, scenario, pattern, folder=cell.folder / name, runs=0, baseline=baseline,
            driver_name=cell.controller,
        )  # fmt: skip

    rows: list[Row] = []
    metres = run("metres", replace(BASE, rounds=cell.rounds))
    drawn = random_patterns(metres.attack.pattern, 2, seed=cell.seed)
    judged = judge("surrogate", metres.attack.pattern, drawn)
    clean = judged.of(traffic=False)
    rows.append(row(cell, "random", judged, "random", simulator_calls=0, seconds=0.0))
    bare = {
        "method": "no paint",
        "deviation_m": 0.0,
        "lateral_m": 0.0,
        "points": float(np.mean([trial.clean_points for trial in clean])),
        "failed": 0.0,
        "by_weather": dict.fromkeys(judged.weathers, 0.0),
    }
    rows.append(rows[0] | bare)
    rows.append(row(cell, "T=3 metres", judged, **cost(metres, *FOUND_BY), pushed_m=_pushed(cell, "metres")))
    if metres.selection is not None:
        driven = judge("driven", metres.selection.pattern)
        rows.append(row(cell, "+ driven", driven, **cost(metres, *FOUND_BY, "select")))
    if metres.rounds is not None:
        told = {"stopped": metres.rounds.stopped, "noon_deviation_m": _noon(metres)}
        rows.append(row(cell, "+ rounds", metres.evaluation, **cost(metres, *FOUND_BY, "select", "rounds"), **told))
    noisy = Trajectories(perturbation=SteeringNoise(*cell.noise_deg))
    others = {
        "T=1": replace(BASE, trajectories=Trajectories(count=1), select=0),
        "T=3 published": replace(BASE, trajectories=noisy, select=0),
        "+ weathers": replace(
            BASE, window=Window(frames=7), attack_weathers=(Weather.CLEAR_NOON, Weather.RAINY_NOON)
        ),
    }  # fmt: skip
    for method, budget in others.items():
        if method not in cell.others:
            continue
        name = method.strip("+ ").replace(" ", "-").replace("=", "")
        try:
            result = run(name, budget)
        except RoadproofError as error:
            # A published push may leave the road before the canvas, however small it is made.
            rows.append(rows[0] | {"method": method, "error": str(error)})
            continue
        told = {"pushed_m": _pushed(cell, name)}
        rows.append(row(cell, method, result.evaluation, **cost(result, *FOUND_BY, "select"), **told))
    return sorted(rows, key=lambda each: METHODS.index(each["method"]))


def share_drives(cell: Cell, *place: str) -> None:
    """Let all evaluations of a cell keep their drives in one folder, so that the bare road is driven once."""
    link = cell.folder.joinpath(*place, "episodes")
    link.parent.mkdir(parents=True, exist_ok=True)
    drives = cell.folder / "episodes"
    drives.mkdir(exist_ok=True)
    if not link.is_symlink():
        link.symlink_to(drives.resolve(), target_is_directory=True)


def _pushed(cell: Cell, name: str) -> list[float]:
    """How far the recorded drives were aside."""
    return [round(drive.offset_m, 2) for drive in load_drives(cell.folder / name / "record").drives]


def _noon(result: StressTest) -> list[float]:
    """What was driven at noon before the rounds and after each."""
    assert result.rounds is not None
    return [each.deviation_m for each in (result.rounds.first, *(one.selection for one in result.rounds.done))]


def summary(rows: Sequence[Row]) -> list[Row]:
    """Means over scenarios and seeds."""
    found: list[Row] = []
    for controller in dict.fromkeys(each["controller"] for each in rows):
        for method in METHODS:
            those = [each for each in rows if (each["controller"], each["method"]) == (controller, method)]
            those = [each for each in those if "error" not in each]
            if not those:
                continue
            means = {name: asdict(mean_95([r[name] for r in those])) for name in ("deviation_m", "lateral_m", "points")}
            others = ("failed", "simulator_calls", "seconds")
            plain = {name: float(np.mean([each[name] for each in those])) for name in others}
            found.append({"controller": controller, "method": method, **means, **plain})
    return found


def write(arguments: argparse.Namespace, rows: Sequence[Row], seconds: float) -> None:
    """All that is known so far."""
    versions = {"roadproof": roadproof.__version__, "torch": torch.__version__, "numpy": np.__version__}
    content = {
        "study": "closed loop",
        "version": 1,
        "settings": {k: v for k, v in vars(arguments).items() if k not in ("json", "keep")},
        "method": repr(BASE.method),
        "summary": summary(rows),
        "rows": list(rows),
        "seconds": seconds,
        "versions": versions | {"python": platform.python_version()},
    }
    text = json.dumps(content, indent=1) + "\n"
    write_atomically(arguments.json, lambda part: part.write_text(text, encoding="utf-8"))


def tell(rows: Sequence[Row]) -> None:
    """The table."""
    for each in summary(rows):
        parts = [f"{each['controller']:11} {each['method']:14}"]
        for name, unit in (("deviation_m", "m"), ("points", "points")):
            mean = each[name]
            half = "" if mean["low"] is None else f" ± {mean['high'] - mean['value']:.2f}"
            parts.append(f"{mean['value']:6.2f}{half} {unit}")
        parts.append(f"{each['simulator_calls']:5.1f} calls {each['seconds']:5.0f} s")
        print("  ".join(parts), flush=True)


def main() -> None:
    """Read the options, do the cells."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, required=True)
    parser.add_argument("--keep", type=Path, required=True)
    parser.add_argument("--scenarios", type=int, default=6, help=f"the first so many of {', '.join(SCENARIOS)}")
    parser.add_argument("--controllers", default="pilotnet", help="shipped ones, with commas")
    parser.add_argument("--seeds", default="0")
    parser.add_argument("--figures", type=int, default=5)
    parser.add_argument("--rounds", type=int, default=1)
    parser.add_argument("--noise-deg", type=int, nargs=2, default=(0, 10), help="of the published perturbation")
    parser.add_argument("--others", nargs="*", choices=OTHERS, default=OTHERS, help="searches on their own recordings")
    parser.add_argument("--processes", type=int, default=1)
    arguments = parser.parse_args()
    cells = [
        Cell(
            controller=controller,
            scenario=scenario,
            seed=int(seed),
            figures=arguments.figures,
            rounds=arguments.rounds,
            noise_deg=(arguments.noise_deg[0], arguments.noise_deg[1]),
            others=tuple(arguments.others),
            keep=arguments.keep,
        )
        for seed in arguments.seeds.split(",")
        for controller in arguments.controllers.split(",")
        for scenario in SCENARIOS[: arguments.scenarios]
    ]
    began = time.perf_counter()
    rows: dict[Cell, list[Row]] = {}
    with processes_beside(arguments.processes) as pool:
        running = {pool.submit(rows_of, cell): cell for cell in cells}
        for done in as_completed(running):
            cell = running[done]
            try:
                rows[cell] = done.result()
            except RoadproofError as error:
                print(f"{cell.controller} in {cell.scenario}, seed {cell.seed}: {error}", flush=True)
                continue
            found = [row for each in cells for row in rows.get(each, [])]
            write(arguments, found, time.perf_counter() - began)
            print(f"{len(rows)} of {len(cells)} cells, {time.perf_counter() - began:.0f} s", flush=True)
            tell(found)


if __name__ == "__main__":
    main()
