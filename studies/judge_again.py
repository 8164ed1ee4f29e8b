"""Does a hardened controller withstand attacks of another seed, of a larger budget, and on streets of another town?

    python studies/judge_again.py --controller CONTROLLER --seed N --json OUT --keep FOLDER
        [--budget full] [--scenarios studies/scenarios/second-town.toml] [--streets right-11]
        [--weathers cloudy-noon rainy-noon clear-sunset]

Each of the twelve streets that `studies/harden.py` judges on, or of any others that it does not train on, is attacked
afresh with the searches of its judging: by gradient, by a black box and with ellipses. With the seed of a hardening
these are its searches and starts, with any other one fresh ones. What was found against another controller before is
not driven over. What was found is driven over in other weathers too, from the same starts, where these are given.
FOLDER keeps everything, and an interrupted study goes on there.
"""

from __future__ import annotations

import argparse
from dataclasses import asdict
from pathlib import Path

from harden import CROSSINGS, JUDGE_ON, TRAIN_ON, in_words, streets
from roadproof.cli.progress import stages
from roadproof.controllers.loading import files_digest
from roadproof.datatypes import Weather
from roadproof.errors import CanvasNotReachedError
from roadproof.hardening.budget import HARDENING_BUDGETS, check_streets
from roadproof.hardening.judgement import JudgedAttack, StreetJudge, most_out_of, strongest_of
from roadproof.hardening.plan import HardeningPlan
from roadproof.io.files import write_json
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
    parser.add_argument("--controller", required=True, help="controller that is judged")
    parser.add_argument("--seed", type=int, required=True, help="seed of the searches and of the starts")
    parser.add_argument("--budget", choices=HARDENING_BUDGETS, default="quick", help="of the judging; default quick")
    parser.add_argument("--scenarios", type=Path, help="TOML file of scenarios; by default the built-in ones")
    parser.add_argument("--streets", nargs="+", help="names; by default all of the file, or harden.py's held-out ones")
    parser.add_argument("--weathers", nargs="+", type=Weather, default=(), help="others in which to drive over it")
    given = parser.parse_args()
    given.weathers = list(dict.fromkeys(given.weathers))
    learnt = [*streets(TRAIN_ON), *load_scenarios(CROSSINGS)]
    own = load_scenarios(given.scenarios) if given.scenarios else None
    asked = [find_scenario(name, own) for name in given.streets] if given.streets else own or streets(JUDGE_ON)
    check_streets(learnt, asked)
    plan = HardeningPlan(
        spec=given.controller,
        scenarios=tuple(learnt),
        folder=given.keep,
        budget=HARDENING_BUDGETS[given.budget],
        space=SearchSpace(figures=5),
        seed=given.seed,
        device="cpu",
    )
    weights = files_digest(given.controller)
    keep_freed_memory()
    judged: list[JudgedAttack] = []
    elsewhere: list[JudgedAttack] = []
    unjudged: dict[str, str] = {}
    with open_simulator("town") as town, stages() as show:
        for street in asked:
            judge = StreetJudge(plan, town, 0, street, show)
            try:
                judged += judge.judge()
            except CanvasNotReachedError as reason:
                unjudged[street.name] = str(reason)
                continue
            if given.weathers:
                elsewhere += judge.judge_in(given.weathers)
    found = {
        "made_with": made_with(),
        "controller": given.controller,
        "weights": weights,
        "seed": given.seed,
        "budget": given.budget,
        "judged": rows(judged),
        "weathers": given.weathers,
        "judged_there": rows(elsewhere),
        "unjudged": unjudged,
    }
    write_json(given.json, found)
    print(table(judged))
    if elsewhere:
        print(f"In {', '.join(given.weathers)}:\n{table(elsewhere)}")
    for name, reason in unjudged.items():
        print(f"{name} could not be judged: {reason}")


def rows(judged: list[JudgedAttack]) -> object:
    """What was judged, for JSON: one controller, neither before nor after."""
    return plain([{key: value for key, value in asdict(each).items() if key != "after"} for each in judged])


def table(judged: list[JudgedAttack]) -> str:
    """What each kind of attack did, and the strongest on each street, as Markdown."""
    kinds = {each.kind: [one for one in judged if one.kind == each.kind] for each in judged}
    on_street = {each.scenario: [one for one in judged if one.scenario == each.scenario] for each in judged}
    strongest = [strongest_of(each) for each in on_street.values()]
    told = [f"| {kind} | {in_words(each)} |" for kind, each in {**kinds, "strongest on each street": strongest}.items()]
    left = [out for each in on_street.values() for out in most_out_of(each)]
    head = ["| kind of attack | median (range) | leaves its lane |", "|---|---|---|"]
    last = f"Leaves its lane in {sum(left)} of {len(left)} drives."
    if lost := sum(each.left_out for each in judged):
        last += f" In {lost} more of all kinds it never came to the canvas."
    return "\n".join([*head, *told, "", last])


if __name__ == "__main__":
    main()
