"""Does the gate pass a good controller and stop a spoilt one, every time, and how long does a smoke check take?

    python benchmarks/gate_verdicts.py --json OUT --keep FOLDER [--times 20] [--noise 0.5]

In FOLDER a team's gate is made once: two streets recorded with PilotNet and calibrated, and for each of them the random
pattern out of eight that moves PilotNet least in the recorded world, which a good controller has to stand. Then
`roadproof check` is run in a process of its own, so many times over starts drawn from other seeds: on PilotNet as it is
shipped, and on PilotNet with noise on its weights, in shares of each tensor's standard deviation. Noise alone spoils
nothing for sure: each time it is drawn until the controller, driven over the bare road in the town, fails on one of the
streets. Expected: exit code 0 for the good one, 1 for the spoilt one. A check that is done is kept and not repeated.
"""

from __future__ import annotations

import argparse
import json
import shutil
import statistics
import subprocess
import sys
import time
from itertools import count
from pathlib import Path
from typing import Any, cast

import torch

import roadproof
from roadproof.controllers import ConditionalPilotNet, save_controller
from roadproof.controllers.shipped import shipped_weights
from roadproof.datatypes import Ending
from roadproof.driving.rollout import rollout
from roadproof.io.files import write_json
from roadproof.io.identity import digest
from roadproof.machine import made_with
from roadproof.patterns import Pattern, save_pattern
from roadproof.recorded.world import RecordedWorld
from roadproof.recordings import load_recordings
from roadproof.scenarios import find_scenario
from roadproof.search_space import SearchSpace
from roadproof.simulators.town.simulator import TownSimulator

STREETS = ("left-03", "straight-02")
PATTERNS = 8
GOAL_S = 120.0
PLAN = """
format = "roadproof-check"
version = 1
controller = "{controller}"
scenarios = [{scenarios}]
budget = "smoke"
patterns = "patterns"
random = 3
seeds = [{first}, {second}]

[starts]
count = 3

[smoke]
recordings = ["recordings"]

[limits]
stored = {{ deviation_m = 0.5, left_lane = 0.0 }}
random = {{ deviation_m = 0.8 }}
"""


def roadproof_command(*words: object, folder: Path) -> int:
    """Exit code of a command, which prints into a log in the folder."""
    with (folder / "log.txt").open("a") as log:
        line = [sys.executable, "-c", "from roadproof.cli import main; main()", *map(str, words)]
        return subprocess.run(line, cwd=folder, stdout=log, stderr=log, check=False).returncode


def make_team(folder: Path) -> None:
    """Recordings and stored patterns, where the folder does not hold them yet."""
    folder.mkdir(parents=True, exist_ok=True)
    for street in STREETS:
        run = folder / "recordings" / street
        if not (run / "recordings").is_dir():
            recorded = roadproof_command("record", street, "--driver", "pilotnet", "--out", "recordings", folder=folder)
            if recorded or roadproof_command("calibrate", run, folder=folder):
                raise SystemExit(f"{street} could not be recorded: see {folder / 'log.txt'}")
        stored = folder / "patterns" / street / "mild.json"
        if not stored.exists():
            save_pattern(mildest(run / "recordings"), stored)


def mildest(recordings: Path) -> Pattern:
    """Of some random patterns the one that moves PilotNet least."""
    controller, space = roadproof.load_controller("pilotnet"), SearchSpace(figures=5)
    patterns = space.drawn(PATTERNS, 0)
    world = RecordedWorld(load_recordings(recordings))
    world.fit(controller)
    with torch.no_grad():
        return patterns[int(world.predict(controller, patterns).deviation_m.mean(1).argmin())]


def spoilt(town: TownSimulator, seed: int, noise: float) -> tuple[ConditionalPilotNet, int]:
    """PilotNet with noise on its weights that fails when it drives, and how many draws of noise that took."""
    generator = torch.Generator().manual_seed(seed)
    for draws in count(1):
        controller = cast("ConditionalPilotNet", roadproof.load_controller("pilotnet"))
        with torch.no_grad():
            for weight in controller.parameters():
                if weight.ndim > 1:
                    weight += noise * weight.std() * torch.randn(weight.shape, generator=generator)
        if any(fails(town, controller, street) for street in STREETS):
            return controller, draws
    raise AssertionError


def fails(town: TownSimulator, controller: ConditionalPilotNet, street: str) -> bool:
    """Whether it does not reach the goal of a bare street, or not without an infraction."""
    drive = rollout(town, controller, find_scenario(street))
    return bool(drive.events) or drive.ending is not Ending.GOAL_REACHED


def checked(team: Path, name: str, controller: str, seed: int) -> dict[str, Any]:
    """One check: its exit code and its seconds."""
    # A controller of the same name may be another: its weights tell.
    weights = team / controller if (team / controller).is_file() else shipped_weights(controller)
    told = digest(weights.read_bytes())[:16]
    kept = team / "done" / f"{name}-{seed}-{told}.json"
    if kept.exists():
        return json.loads(kept.read_text())
    shutil.rmtree(team / f"out-{name}-{seed}", ignore_errors=True)  # of one that was ended: its seconds are not known
    plan = team / f"{name}-{seed}.toml"
    scenarios = ", ".join(f'"{street}"' for street in STREETS)
    plan.write_text(PLAN.format(controller=controller, scenarios=scenarios, first=2 * seed, second=2 * seed + 1))
    began = time.perf_counter()
    code = roadproof_command("check", plan.name, "--out", f"out-{name}-{seed}", folder=team)
    found = {"controller": name, "seed": seed, "exit_code": code, "seconds": time.perf_counter() - began}
    write_json(kept, found)
    return found


def main() -> None:
    """Make the team's folder, check, count."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, required=True)
    parser.add_argument("--keep", type=Path, required=True)
    parser.add_argument("--times", type=int, default=20)
    parser.add_argument("--noise", type=float, default=0.5)
    given = parser.parse_args()
    team = given.keep.resolve()
    make_team(team)
    checks: list[dict[str, Any]] = []
    draws: list[int] = []
    for seed in range(given.times):
        bad = f"spoilt-{seed}.safetensors"
        with TownSimulator() as town:
            controller, drawn = spoilt(town, seed, given.noise)
        draws.append(drawn)
        save_controller(controller, team / bad)
        for name, controller, expected in (("good", "pilotnet", 0), ("spoilt", bad, 1)):
            found = checked(team, name, controller, seed)
            checks.append(found | {"expected": expected})
            print(
                f"{name} {seed}: exit {found['exit_code']} (expected {expected}), {found['seconds']:.0f} s", flush=True
            )
    wrong = [each for each in checks if each["exit_code"] != each["expected"]]
    median_s = statistics.median(each["seconds"] for each in checks)
    content = {
        "made_with": made_with(),
        "noise": given.noise,
        "draws_of_noise": draws,
        "goal_s": GOAL_S,
        "wrong": wrong,
        "median_s": median_s,
        "longest_s": max(each["seconds"] for each in checks),
        "checks": checks,
    }
    write_json(given.json, content)
    print(f"{len(wrong)} of {len(checks)} verdicts wrong; median {median_s:.0f} s a check")


if __name__ == "__main__":
    main()
