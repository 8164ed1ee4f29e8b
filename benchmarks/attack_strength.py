"""How strong a pattern GradOpt finds on a set of recordings, over seeds and by the digits it climbs with.

    python benchmarks/attack_strength.py RECORDINGS --controller SPEC --json OUT [--figures 5] [--seeds 0,1,2]
        [--objective steering|deviation] [--digits few,all]

Few digits are a search's own choice: bfloat16 where the processor has arithmetic for it. What is found is always judged
in float32. The steering shift is a surrogate figure: mean shift a frame on all composited frames, beside that of random
patterns. The deviation is predicted: metres in the recorded world, of the pattern that an attack would name first.
Nothing is driven.
"""

import argparse
import json
import math
import statistics
import time
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

from roadproof.attacks import GradOpt, PathDeviation, SteeringShift
from roadproof.attacks.checks import random_search
from roadproof.attacks.gradopt import dropping, gradopt
from roadproof.attacks.groups import LEFT_GROUP, RIGHT_GROUP
from roadproof.controllers import load_controller
from roadproof.io.files import write_json
from roadproof.machine import keep_freed_memory, made_with
from roadproof.recordings import load_recordings
from roadproof.search_space import SearchSpace

GROUPS = (RIGHT_GROUP, LEFT_GROUP)
OBJECTIVES = {"steering": (SteeringShift(), 4), "deviation": (PathDeviation(), 3)}
"""What is made large, and how many starts of a side are searched to the end."""


def timed(function: Callable[[], Any]) -> tuple[Any, dict[str, float]]:
    """What a function answers, and its seconds: by the clock, and of processor time over all threads."""
    clock, processor = time.perf_counter(), time.process_time()
    answer = function()
    spent = {"seconds": time.perf_counter() - clock, "cpu_seconds": time.process_time() - processor}
    return answer, {name: round(value, 1) for name, value in spent.items()}


def spread(values: list[float]) -> dict[str, float]:
    """Mean, least and most."""
    return {"mean": statistics.mean(values), "min": min(values), "max": max(values)}


def main() -> None:
    """Attack with every seed and write what was found, with its spread."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings", type=Path)
    parser.add_argument("--controller", required=True)
    parser.add_argument("--json", type=Path, required=True)
    parser.add_argument("--figures", type=int, default=5)
    parser.add_argument("--objective", choices=list(OBJECTIVES), default="steering")
    parser.add_argument("--digits", choices=("few", "all", "few,all"), default="few")
    parser.add_argument("--one-rung", action="store_true", help="the paper's 250 steps from random starts")
    parser.add_argument("--seeds", default="0,1,2")
    parser.add_argument("--random-patterns", type=int, default=500, help="of the random search, 0 for none")
    args = parser.parse_args()
    keep_freed_memory()  # as the command line does
    objective, restarts = OBJECTIVES[args.objective]
    steering = args.objective == "steering"
    recordings, space = load_recordings(args.recordings), SearchSpace(figures=args.figures)
    judge = objective.measure(recordings, load_controller(args.controller), GROUPS, device="cpu")
    rungs = GradOpt(restarts=restarts).ladder(objective)
    if args.one_rung:
        rungs = dropping(restarts, 250, 0.1, after=(0.4, 0.8), factor=0.1)
    runs = []
    for seed in (int(word) for word in args.seeds.split(",")):
        for digits in args.digits.split(","):
            search = lambda s=seed, d=digits: gradopt(judge, space, rungs, seed=s, all_digits=d == "all")  # noqa: E731
            found, cost = timed(search)
            run = {"seed": seed, "digits": digits, "cost": cost, "values": found.best.tolist()}
            if steering:
                run["best"] = max(map(max, run["values"]))
            else:
                kept = [k for k in range(len(GROUPS)) if k not in found.gave_way]
                metres = judge.of_groups(kept).readings(space, found.best_unit)[1].flatten(0, 1)
                first = metres.amin(1).argmax()
                run |= {"best": float(metres[first].mean()), "least": float(metres[first].min())}
            runs.append(run)
            print(json.dumps(run), flush=True)
        if args.random_patterns and steering:
            chance = lambda s=seed: random_search(judge, space, patterns=args.random_patterns, seed=s)  # noqa: E731
            (_, best), cost = timed(chance)
            runs.append({"seed": seed, "digits": "random search", "cost": cost, "best": float(best.max())})
            print(json.dumps(runs[-1]), flush=True)
    result = {
        "benchmark": "attack_strength",
        "kind": "surrogate: mean steering shift a frame on composited frames" if steering else "predicted: metres",
        "made_with": made_with(),
        "recordings": args.recordings.parent.name,
        "controller": args.controller,
        "figures": args.figures,
        # A rung that needs nothing says so by −∞, which JSON has not.
        "rungs": [{name: each for name, each in asdict(rung).items() if each != -math.inf} for rung in rungs],
        "random_patterns": args.random_patterns if steering else 0,
        "runs": runs,
        "spread": {
            kind: spread([run["best"] for run in runs if run["digits"] == kind])
            for kind in dict.fromkeys(run["digits"] for run in runs)
        },
    }
    write_json(args.json, result)


if __name__ == "__main__":
    main()
