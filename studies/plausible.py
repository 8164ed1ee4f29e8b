"""What does each limit on paint cost, in driven metres, and how little paint is enough?

    python studies/plausible.py --json OUT --keep FOLDER [--scenarios straight-02 …] [--controllers pilotnet cil]
        [--limits NAME …]

For every controller and scenario one recording of five drives; then for every row of LIMITS a search of its own in the
recorded world, whose first choice is driven from five starts at noon: the median of the paper's deviation, the share of
drives that leave the lane, how conspicuous the pattern is. The cost of a limit is the deviation of `no limit` less its
own. `cheapest` is the fewest square metres that are predicted to deviate by 0.8 m, driven from the same starts.

Everything is kept in FOLDER; an interrupted study goes on there, and writes what it has after every row. Rows of other
cells and limits that OUT holds stay there.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from roadproof.attacks import AttackResult, kept_attack, kept_cheapest, site_of
from roadproof.attacks.cheapest import cheapest_in_words
from roadproof.attacks.objective import varied
from roadproof.compositing import Variation
from roadproof.controllers import Controller, load_controller
from roadproof.datatypes import Weather
from roadproof.driving.evaluate import evaluate
from roadproof.io.files import write_json
from roadproof.machine import made_with
from roadproof.paint import Conspicuousness, PaintLimits, conspicuousness
from roadproof.patterns import Pattern
from roadproof.pipeline.budget import QUICK
from roadproof.pipeline.stress_test import stress_test
from roadproof.recordings import RecordingSet, load_recordings
from roadproof.scenarios import Scenario, find_scenario
from roadproof.search_space import SearchSpace
from roadproof.simulators.town.simulator import TownSimulator

SCENARIOS = ("straight-02", "left-03", "right-05", "straight-09")
ROAD_PAINTS = ("#dededa", "#d6a83d", "#2b2b2b")
"""White and yellow of lane marks, and bitumen."""

NO_LIMIT, ROBUST, CHEAPEST = "no limit", "robust", "cheapest for 0.8 m"
WANTED_M = 0.8
EVERYTHING = PaintLimits(max_area_m2=4.0, printable=True, contrast=(0.0, 0.25), keep_out_m=0.3)
LIMITS: dict[str, PaintLimits | None] = {
    NO_LIMIT: None,
    "8 m²": PaintLimits(max_area_m2=8.0),
    "4 m²": PaintLimits(max_area_m2=4.0),
    "2 m²": PaintLimits(max_area_m2=2.0),
    "printable": PaintLimits(printable=True),
    "white, yellow, bitumen": PaintLimits(colours=ROAD_PAINTS),
    "contrast below 0.25": PaintLimits(contrast=(0.0, 0.25)),
    "contrast below 0.1": PaintLimits(contrast=(0.0, 0.1)),
    "0.3 m from marks": PaintLimits(keep_out_m=0.3),
    "0.6 m from marks": PaintLimits(keep_out_m=0.6),
    "4 m², printable, below 0.25, 0.3 m": EVERYTHING,
    ROBUST: None,
    "4 m², printable, below 0.25, 0.3 m, robust": EVERYTHING,
}
STARTS = 5
BUDGET = replace(QUICK, weathers=(Weather.CLEAR_NOON,), starts=STARTS, select=0)

Row = dict[str, Any]


@dataclass(frozen=True, kw_only=True)
class Cell:
    """One controller in one scenario, recorded once."""

    town: TownSimulator
    spec: str
    controller: Controller
    scenario: Scenario
    folder: Path
    seed: int

    def rows(self, names: list[str]) -> Iterator[Row]:
        """One a limit, each as soon as it is known."""
        plain = stress_test(
            self.town,
            self.controller,
            self.scenario,
            self.folder,
            budget=BUDGET,
            space=SearchSpace(figures=5),
            seed=self.seed,
            controller_name=self.spec,
            film=False,
        )
        recordings = load_recordings(self.folder / "recordings")
        print(f"{self.spec}, {self.scenario.name}: recorded, searched without limits", flush=True)
        for name in names:
            if name == CHEAPEST:
                yield from self._cheapest(recordings, plain.attack)
                continue
            found = plain.attack if name == NO_LIMIT else self._searched(recordings, name)
            yield self._driven(recordings, name, found.pattern, predicted_m=found.predicted_m)

    def _searched(self, recordings: RecordingSet, name: str) -> AttackResult:
        variation = Variation() if name.endswith(ROBUST) else None
        return kept_attack(
            self.folder / _folder(name) / "attack",
            recordings,
            self.controller,
            SearchSpace(figures=5, limits=LIMITS[name]),
            objective=varied(BUDGET.objective, variation),
            method=BUDGET.method,
            groups=BUDGET.method.groups(recordings),
            seed=self.seed,
        )

    def _cheapest(self, recordings: RecordingSet, found: AttackResult) -> Iterator[Row]:
        place, groups = self.folder / _folder(CHEAPEST), BUDGET.method.groups(recordings)
        less = kept_cheapest(place, recordings, self.controller, found, WANTED_M, groups=groups)
        if less is None:
            print(f"{self.spec}, {self.scenario.name}: {cheapest_in_words(None, WANTED_M)}", flush=True)
            return
        levels = [asdict(level) for level in less.levels]
        yield self._driven(recordings, CHEAPEST, less.pattern, predicted_m=less.predicted_m, levels=levels)

    def _driven(self, recordings: RecordingSet, name: str, pattern: Pattern, **more: object) -> Row:
        judged = evaluate(
            self.town,
            self.controller,
            self.scenario,
            pattern,
            folder=self.folder / "evaluation",  # of all limits, so that nothing is driven twice
            driver_name=self.spec,
            weathers=BUDGET.weathers,
            starts=STARTS,
            start_range=BUDGET.start_range,
            runs=0,
            seed=self.seed,
        )
        trials = judged.of(traffic=False)
        told: Conspicuousness = conspicuousness(pattern, site_of(recordings))
        return {
            "controller": self.spec,
            "scenario": self.scenario.name,
            "seed": self.seed,
            "limit": name,
            "deviation_m": float(np.median([trial.deviation_m for trial in trials])),
            "deviations_m": [trial.deviation_m for trial in trials],
            "left_lane": float(np.mean([trial.leaves_lane for trial in trials])),
            **asdict(told),
            **more,
        }


def _folder(name: str) -> str:
    return "".join(letter if letter.isalnum() else "-" for letter in name)


def _cell(row: Row) -> tuple[object, ...]:
    return row["controller"], row["scenario"], row["seed"]


def _key(row: Row) -> tuple[object, ...]:
    return *_cell(row), row["limit"]


def table(rows: list[Row]) -> str:
    """The cost of every limit, over cells, as Markdown."""
    bare = {_cell(row): row["deviation_m"] for row in rows if row["limit"] == NO_LIMIT}
    lines = [
        "| limit | cells | deviation, driven (m) | cost (m) | leave the lane | paint (m²) | contrast |",
        "|---|---|---|---|---|---|---|",
    ]
    for name in (*LIMITS, CHEAPEST):
        some = [row for row in rows if row["limit"] == name]
        if not some:
            continue
        cost = [bare[_cell(row)] - row["deviation_m"] for row in some if _cell(row) in bare]
        mean = {key: np.mean([row[key] for row in some]) for key in ("deviation_m", "left_lane", "area_m2", "contrast")}
        told = f"{np.mean(cost):+.2f}" if cost else "–"
        lines.append(
            f"| {name} | {len(some)} | {mean['deviation_m']:.2f} | {told} | {mean['left_lane']:.0%} | "
            f"{mean['area_m2']:.1f} | {mean['contrast']:.2f} |"
        )
    return "\n".join(lines)


def main() -> None:
    """Every cell, every limit."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, required=True, help="the rows")
    parser.add_argument("--keep", type=Path, required=True, help="folder that an interrupted study goes on in")
    parser.add_argument("--scenarios", nargs="+", default=list(SCENARIOS))
    parser.add_argument("--controllers", nargs="+", default=["pilotnet", "cil"])
    parser.add_argument("--limits", nargs="+", default=[*LIMITS, CHEAPEST], choices=[*LIMITS, CHEAPEST])
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    stored: list[Row] = json.loads(asked.json.read_text(encoding="utf-8"))["rows"] if asked.json.exists() else []
    rows = {_key(row): row for row in stored}
    with TownSimulator() as town:
        for spec in asked.controllers:
            for name in asked.scenarios:
                cell = Cell(
                    town=town,
                    spec=spec,
                    controller=load_controller(spec),
                    scenario=find_scenario(name),
                    folder=asked.keep / _folder(spec) / name / f"seed-{asked.seed}",
                    seed=asked.seed,
                )
                for row in cell.rows(asked.limits):
                    rows[_key(row)] = row
                    write_json(asked.json, {"made_with": made_with(), "rows": list(rows.values())})
                    print(f"{spec}, {name}, {row['limit']}: {row['deviation_m']:.2f} m", flush=True)
    print(table(list(rows.values())))


if __name__ == "__main__":
    main()
