"""Does a hardened controller withstand attacks of another seed, and on streets of another town?

    python studies/judge_again.py --json OUT --keep FOLDER [--controller cil-hardened] [--seed 1]
        [--scenarios studies/scenarios/second-town.toml] [--streets right-11]

Each of the twelve streets that `studies/harden.py` judges on, or of any others that it does not train on, is attacked
afresh with the searches of its judging: by gradient, by a black box and with ellipses, and driven over from other
starts. FOLDER keeps everything, and an interrupted study goes on there.
"""

from __future__ import annotations

import argparse
from dataclasses import asdict
from pathlib import Path

import numpy as np

from harden import CROSSINGS, JUDGE_ON, TRAIN_ON, in_words, streets
from roadproof.cli.progress import stages
from roadproof.controllers.shipped import shipped_weights
from roadproof.hardening.budget import HARDENING_BUDGETS, check_streets
from roadproof.hardening.judgement import JudgedAttack, StreetJudge
from roadproof.hardening.plan import HardeningPlan
from roadproof.io.files import write_json
from roadproof.io.identity import digest
from roadproof.io.records import plain
from roadproof.machine import keep_freed_memory, made_with
from roadproof.scenarios import find_scenario, load_scenarios
from roadproof.search_space import SearchSpace
from roadproof.simulators.loading import open_simulator


def main() -> None:
    """Run the study from the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, required=True, help="file for the results")
    parser.add_argument("--keep", type=Path, required=True, help="folder that keeps everything")
    parser.add_argument("--controller", default="cil-hardened", help="shipped controller that is judged")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--scenarios", type=Path, help="TOML file of scenarios; by default the built-in ones")
    parser.add_argument("--streets", nargs="+", help="names; by default all of the file, or harden.py's held-out ones")
    given = parser.parse_args()
    learnt = [*streets(TRAIN_ON), *load_scenarios(CROSSINGS)]
    own = load_scenarios(given.scenarios) if given.scenarios else None
    asked = [find_scenario(name, own) for name in given.streets] if given.streets else own or streets(JUDGE_ON)
    check_streets(learnt, asked)
    plan = HardeningPlan(
        spec=given.controller,
        scenarios=tuple(learnt),
        folder=given.keep,
        budget=HARDENING_BUDGETS["quick"],
        space=SearchSpace(figures=5),
        seed=given.seed,
        device="cpu",
    )
    keep_freed_memory()
    judged: list[JudgedAttack] = []
    with open_simulator("town") as town, stages() as show:
        for street in asked:
            judged += StreetJudge(plan, town, 0, street, show).judge()
    rows = [{key: value for key, value in asdict(each).items() if key != "after"} for each in judged]
    found = {
        "made_with": made_with(),
        "controller": given.controller,
        "weights": digest(shipped_weights(given.controller).read_bytes())[:16],
        "seed": given.seed,
        "judged": plain(rows),
    }
    write_json(given.json, found)
    print(table(judged))


def table(judged: list[JudgedAttack]) -> str:
    """What each kind of attack did, and the strongest on each street, as Markdown."""
    kinds = {each.kind: [one for one in judged if one.kind == each.kind] for each in judged}
    on_street = {each.scenario: [one for one in judged if one.scenario == each.scenario] for each in judged}
    strongest = [max(each, key=lambda one: one.mean_m) for each in on_street.values()]
    rows = [f"| {kind} | {in_words(each)} |" for kind, each in {**kinds, "strongest on each street": strongest}.items()]
    # As the verdict of a hardening counts it: the attack that leads most drives out of their lane, street by street.
    left = [out for each in on_street.values() for out in max((one.left_lane for one in each), key=np.mean)]
    head = ["| kind of attack | median (range) | leaves its lane |", "|---|---|---|"]
    return "\n".join([*head, *rows, "", f"Leaves its lane in {sum(left)} of {len(left)} drives."])


if __name__ == "__main__":
    main()
