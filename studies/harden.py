"""Does hardening help on held-out streets?

    python studies/harden.py --json OUT --keep FOLDER [--controller cil] [--budget full] [--steps 1500] [--rounds 2]
        [--weathers clear-noon rainy-noon] [--processes N]

A controller is hardened on 26 streets, thirteen of the built-in scenarios and thirteen crossings, and judged on twelve
other built-in scenarios, four of each kind, on other streets: attacked afresh as in training, by a black box and with
ellipses, and driven over what was found against it before. Then all forty scenarios are driven over the bare road,
before and after, in the paper's four weathers. That is `roadproof harden` with these lists; the tables of its page are
printed as Markdown. FOLDER keeps everything, and an interrupted study goes on there.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from roadproof.cli.progress import stages
from roadproof.datatypes import Weather
from roadproof.hardening import Hardened, harden, write_hardening
from roadproof.hardening.budget import HARDENING_BUDGETS
from roadproof.hardening.judgement import JudgedAttack
from roadproof.io.files import write_text
from roadproof.machine import keep_freed_memory
from roadproof.scenarios import Scenario, builtin_scenarios, find_scenario, load_scenarios
from roadproof.simulators.loading import open_simulator

TRAIN_ON = {"straight": (1, 6, 8, 10, 16), "left": (1, 6, 11, 12), "right": (1, 6, 10, 12)}
CROSSINGS = Path(__file__).parent / "scenarios" / "crossings.toml"
JUDGE_ON = {"straight": (2, 4, 9, 12), "left": (2, 3, 4, 5), "right": (2, 4, 5, 11)}


def streets(numbers: Mapping[str, Sequence[int]]) -> list[Scenario]:
    """Built-in scenarios by their kind and numbers."""
    return [find_scenario(f"{kind}-{number:02}") for kind, each in numbers.items() for number in each]


def main() -> None:
    """Run the study from the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, required=True, help="file for the results")
    parser.add_argument("--keep", type=Path, required=True, help="folder that keeps everything")
    parser.add_argument("--controller", default="pilotnet", help="controller that is hardened")
    parser.add_argument("--budget", choices=HARDENING_BUDGETS, default="quick")
    parser.add_argument("--steps", type=int, help="batches of a tuning; by default the budget's")
    parser.add_argument("--rounds", type=int, default=1)
    parser.add_argument("--weathers", nargs="+", type=Weather, default=[Weather.CLEAR_NOON], help="of all attacks")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--processes", type=int, default=1, help="streets attacked at once")
    given = parser.parse_args()
    budget = HARDENING_BUDGETS[given.budget].in_weathers(tuple(given.weathers))
    if given.steps is not None:
        budget = replace(budget, tuning=replace(budget.tuning, steps=given.steps))
    keep_freed_memory()
    with open_simulator("town") as town, stages() as show:
        found = harden(
            town,
            given.controller,
            [*streets(TRAIN_ON), *load_scenarios(CROSSINGS)],
            given.keep,
            judge_on=streets(JUDGE_ON),
            clean_on=builtin_scenarios(),
            rounds=given.rounds,
            budget=budget,
            seed=given.seed,
            factory=partial(open_simulator, "town"),
            processes=given.processes,
            on_progress=show,
        )
    write_hardening(found, given.keep)
    write_text(given.json, (given.keep / "hardening.json").read_text(encoding="utf-8"))
    print(table(found))


def table(found: Hardened) -> str:
    """What came of a hardening as Markdown."""
    assert found.judgement is not None
    lines = ["| tunings | attacked afresh on the streets trained on, mean (range) | leaves its lane |", "|---|---|---|"]
    for each in found.rounds:
        low, high = min(each.deviation_m.values()), max(each.deviation_m.values())
        lines.append(f"| {each.number} | {each.mean_m:.2f} m ({low:.2f}–{high:.2f}) | {each.left_lane:.0%} |")
    lines += [
        "",
        "| on other streets | before, median (range) | leaves its lane | after | leaves its lane |",
        "|" + "---|" * 5,
    ]
    judged = found.judgement.judged
    for kind in dict.fromkeys(each.kind for each in judged):
        sides = ([each for each in judged if (each.kind, each.after) == (kind, after)] for after in (False, True))
        lines.append(f"| {kind} | {' | '.join(in_words(side) for side in sides)} |")
    lines += ["", found.judgement.verdict().sentence]
    for each, when in zip(found.judgement.clean, ("before", "after"), strict=True):
        lines.append(f"Bare road {when}: {each.clean} of {each.drives} clean {', '.join(each.failed)}".rstrip())
    lines += [
        f"{stage}: {cost.simulator_calls} drives, {cost.seconds / 60:.0f} min" for stage, cost in found.cost.items()
    ]
    return "\n".join(lines)


def in_words(streets: Sequence[JudgedAttack]) -> str:
    """Deviation over streets, and the share of drives that leave their lane."""
    if not streets:
        return "– | –"
    metres = [each.mean_m for each in streets]
    left = np.mean([left for each in streets for left in each.left_lane])
    return f"{np.median(metres):.2f} m ({min(metres):.2f}–{max(metres):.2f}) | {left:.0%}"


if __name__ == "__main__":
    main()
