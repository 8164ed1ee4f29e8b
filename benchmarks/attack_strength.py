"""How strong a pattern GradOpt finds on a set of recordings, against random search, over seeds.

    python benchmarks/attack_strength.py RECORDINGS --controller SPEC --json OUT [--figures 5] [--seeds 0,1,2]

All figures are surrogate figures: mean steering shift a frame on all composited frames in float32, not driven.
"""

import argparse
import json
import statistics
import time
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

from roadproof.attacks import GradOpt, SteeringShift, Surrogate
from roadproof.attacks.gradopt import dropping, gradopt, random_search
from roadproof.attacks.groups import LEFT_GROUP, RIGHT_GROUP
from roadproof.controllers import load_controller
from roadproof.io.files import write_json
from roadproof.machine import keep_freed_memory, made_with
from roadproof.recordings import load_recordings
from roadproof.search_space import SearchSpace

GROUPS = (RIGHT_GROUP, LEFT_GROUP)
LADDERS = {
    "halving": lambda restarts: GradOpt(restarts=restarts).ladder(SteeringShift()),
    "published": lambda restarts: dropping(restarts, 250, 0.1, after=(0.4, 0.8), factor=0.1),
}
"""Starts that compete first, or the paper's steps from random ones."""


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
    parser.add_argument("--steps", choices=list(LADDERS), default="halving")
    parser.add_argument("--restarts", type=int, default=4)
    parser.add_argument("--dtype", default="float32", help="of the controller while searching")
    parser.add_argument("--seeds", default="0,1,2")
    parser.add_argument("--random-patterns", type=int, default=500, help="of the random search, 0 for none")
    args = parser.parse_args()
    keep_freed_memory()  # as the command line does
    recordings = load_recordings(args.recordings)
    judge = Surrogate(recordings, load_controller(args.controller), GROUPS)
    searched = Surrogate(recordings, load_controller(args.controller, dtype=args.dtype), GROUPS)
    space, rungs = SearchSpace(figures=args.figures), LADDERS[args.steps](args.restarts)
    names = [str(group) for group in GROUPS]
    runs = []
    for seed in (int(word) for word in args.seeds.split(",")):
        search = lambda s=seed: gradopt(searched, space, rungs, seed=s)  # noqa: E731
        found, cost = timed(search)
        restarts = judge.values(space, found.best_unit)
        run = {
            "seed": seed,
            "gradopt": dict(zip(names, restarts.amax(1).tolist(), strict=True)),
            "gradopt_restarts": dict(zip(names, restarts.tolist(), strict=True)),
            "gradopt_cost": cost,
        }
        if args.random_patterns:
            chance = lambda s=seed: random_search(judge, space, patterns=args.random_patterns, seed=s)  # noqa: E731
            (_, best), cost = timed(chance)
            run |= {"random_search": dict(zip(names, best.tolist(), strict=True)), "random_search_cost": cost}
        runs.append(run)
        print(json.dumps(run), flush=True)
    methods = ("gradopt", "random_search") if args.random_patterns else ("gradopt",)
    result = {
        "benchmark": "attack_strength",
        "kind": "surrogate: mean steering shift a frame on composited frames",
        "made_with": made_with(),
        "figures": args.figures,
        "dtype": args.dtype,
        "rungs": [asdict(rung) for rung in rungs],
        "restarts": args.restarts,
        "random_patterns": args.random_patterns,
        "runs": runs,
        "spread": {m: {name: spread([run[m][name] for run in runs]) for name in names} for m in methods},
    }
    write_json(args.json, result)


if __name__ == "__main__":
    main()
