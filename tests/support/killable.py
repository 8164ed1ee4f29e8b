"""Commands that keep what they have done, each with a tiny budget on a short drive, in processes that can be killed."""

from __future__ import annotations

import json
import multiprocessing
import os
import random
import shutil
import signal
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from safetensors.numpy import load_file

from carla_serving import straight_map
from paint_shy import along_a_street
from recorded_drives import drivable_set
from roadproof.attacks import GradOpt, RandomSearch, SteeringShift, methods
from roadproof.attacks.gradopt import Rung
from roadproof.cli import main
from roadproof.datatypes import VehicleState, Weather
from roadproof.drives import Swerve, Trajectories, Window
from roadproof.geometry import CanvasPlacement
from roadproof.hardening.budget import ALONE, HARDENING_BUDGETS, HardeningBudget
from roadproof.hardening.tuning import Tuning
from roadproof.pipeline import film
from roadproof.pipeline.budget import BUDGETS, Budget
from roadproof.recordings import save_recordings
from roadproof.scenarios import Scenario, save_scenarios
from team_folder import write_team

CLEAR = (Weather.CLEAR_NOON,)
TINY = Budget(
    objective=SteeringShift(),
    method=GradOpt(iterations=6, restarts=2),
    trajectories=Trajectories(perturbation=Swerve((0.5,))),
    window=Window(frames=4),
    select=2,
    weathers=CLEAR,
    starts=0,
    runs=0,
)
ONE_STEP = replace(
    ALONE,
    method=GradOpt(iterations=1, restarts=1, halving=False),
    trajectories=Trajectories(count=1),
    window=Window(frames=8, least_px=8),
    starts=0,
)
HARDENING = HardeningBudget(
    attack=ONE_STEP,
    judge=replace(ONE_STEP, starts=2),
    tuning=Tuning(steps=2, repeats=2, batch=8),
    town_drives=0,
    unseen=RandomSearch(calls=2),
    clean_weathers=CLEAR,
)
STUDY = """
format = "roadproof-study"
version = 2
controller = "pilotnet"
scenario_file = "scenarios.toml"
scenarios = ["street"]
figures = [1, 2]
starts = { count = 1 }

[[method]]
name = "chance"
search = "random"
calls = 2
"""
"""Two jobs, side by side."""


def demo(given: Path) -> list[str]:
    save_scenarios([along_a_street(given, 2.4)], given / "scenarios.toml")
    where = ["--scenarios", f"{given}/scenarios.toml", "--scenario", "street"]
    return ["demo", *where, "--controller", "pilotnet", "--rounds", "1", "--figures", "1"]


def beside(given: Path) -> list[str]:
    return [*demo(given), "--processes", "2"]


def attack(given: Path) -> list[str]:
    if not (given / "set").exists():
        whole = drivable_set()
        save_recordings(replace(whole, recordings=tuple(each.thinned(4) for each in whole.recordings)), given / "set")
    tiny = ["--iterations", "12", "--restarts", "2", "--figures", "2", "--random-patterns", "3"]
    return ["attack", f"{given}/set", "--controller", "pilotnet", "--objective", "steering", *tiny]


def check(given: Path) -> list[str]:
    if not (given / "check.toml").exists():
        write_team(given)
    return ["check", f"{given}/check.toml", "--trust"]


def study(given: Path) -> list[str]:
    save_scenarios([along_a_street(given, 2.0)], given / "scenarios.toml")
    (given / "plan.toml").write_text(STUDY)
    return ["study", "run", f"{given}/plan.toml", "--workers", "2"]


def train(given: Path) -> list[str]:
    del given
    return ["train", *["--width", "0.05", "--drives", "1", "--samples", "512", "--rounds", "0", "--processes", "1"]]


def harden(given: Path) -> list[str]:
    roads = str(straight_map(given, length_m=220.0))
    streets = [
        Scenario(
            name=name,
            kind="straight",
            map_name=roads,
            start=VehicleState(x_m=begin_m, y_m=-1.75, z_m=0.0, yaw_rad=0.0, speed_mps=6.0),
            goal_m=(begin_m + 30.0, -1.75),
            canvas=CanvasPlacement(x_m=begin_m + 17.0, y_m=0.0, width_m=6.6),
            time_limit_s=8.0,
        )
        for name, begin_m in (("near", 15.0), ("far", 115.0))
    ]
    save_scenarios(streets, given / "scenarios.toml")
    where = ["--train-on", "near", "--judge-on", "far", "--scenarios", f"{given}/scenarios.toml"]
    return ["harden", "pilotnet", *where, "--rounds", "1", "--figures", "1", "--device", "cpu"]


COMMANDS: dict[str, Callable[[Path], list[str]]] = {
    each.__name__: each for each in (demo, beside, attack, check, study, train, harden)
}
EXPECTED = {name: 1 if name == "check" else 0 for name in COMMANDS}
"""How each ends: the team's controller fails its check."""
REFUSED = {name: 1 if name == "study" else 2 for name in COMMANDS}
"""How each ends that finds a damaged file: a study does its other jobs first, and says which job failed and why."""


def run(name: str, folder: Path) -> None:
    """A command in a process of its own; what it prints goes to a file beside the folder."""
    with folder.with_suffix(".log").open("a") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    # As in a terminal: what a shell runs in the background ignores Ctrl-C, and so would its children.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    BUDGETS["quick"], HARDENING_BUDGETS["quick"] = TINY, HARDENING
    methods.SHIFT_RUNGS = (Rung(3, 6, every=2),)
    film.PICTURE_S, film.MOMENTS = 0.5, 7
    # One place for what all runs of a command are given: it is a part of what they leave.
    given = folder.parent / f"given-{name}"
    given.mkdir(exist_ok=True)
    sys.path.append(str(Path(__file__).parent))
    sys.argv = ["roadproof", *COMMANDS[name](given), "--out", str(folder)]
    main()


def starter() -> Callable[[str, Path], Any]:
    """What begins a command, in a process that finds everything imported."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["killable"])

    def begin(name: str, folder: Path) -> Any:
        process = context.Process(target=run, args=(name, folder))
        process.start()
        return process

    return begin


TIMES = frozenset({"seconds", "cost", "calibration", "name", "created", "search_seconds"})
"""Keys of JSON files that hold times, or the name of the folder; what else is in them is compared."""

OF_TIMES = frozenset({"report.html", "hardening.html", "junit.xml", "commands.txt", "rows.parquet", "driven.json"})
"""Files made of others, in which times or the folder's own name are written out."""


def differences(one: Path, two: Path) -> list[str]:
    """Which files of two results differ in anything but times."""
    left, right = (dict(_files(folder)) for folder in (one, two))
    told = [f"only one has {name}" for name in sorted(left.keys() ^ right.keys())]
    same = left.keys() & right.keys()
    return told + [f"{name} differs" for name in sorted(same) if _content(one, name) != _content(two, name)]


def _content(folder: Path, name: str) -> object:
    """What a file holds but for times and the folder's name."""
    path = folder / name
    if path.suffix == ".npz":
        with np.load(path) as archive:
            arrays = dict(archive)
        header = json.loads(str(arrays.pop("header", "{}")))
        return _without_times(header), _without_times({key: each.tobytes() for key, each in arrays.items()})
    if path.suffix == ".safetensors":
        return _without_times({key: each.tobytes() for key, each in load_file(path).items()})
    if path.suffix == ".json":
        return json.dumps(_without_times(json.loads(path.read_bytes()))).replace(str(folder), "OUT")
    return path.read_bytes().replace(str(folder).encode(), b"OUT")


def _files(folder: Path) -> Iterator[tuple[str, Path]]:
    for path in folder.rglob("*"):
        parts = path.relative_to(folder).parts
        if path.is_file() and path.name not in OF_TIMES and not any(part.startswith(".") for part in parts):
            yield "/".join(parts), path


def _without_times(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _without_times(each) for key, each in value.items() if key not in TIMES}
    return [_without_times(each) for each in value] if isinstance(value, list) else value


def kill_and_resume(
    begin: Callable[[str, Path], Any], name: str, straight: Path, whole_s: float, rng: random.Random
) -> str:
    """Kill a command at a random time, now and then lose the end of its last file, and give it again.

    Args:
        begin: of `starter`.
        name: of the command.
        straight: what it left where it was not killed; its name is no beginning of that of another folder there.
        whole_s: how long it took.
        rng: when, by which signal, and how much of the file is lost.

    Returns:
        What was lost or went wrong; empty where the result is the same.
    """
    folder = straight.with_name(f"killed-{name}")
    shutil.rmtree(folder, ignore_errors=True)
    folder.with_suffix(".log").unlink(missing_ok=True)
    process, how = begin(name, folder), rng.choice((signal.SIGKILL, signal.SIGTERM, signal.SIGINT))
    process.join(rng.uniform(0.0, whole_s))
    if process.is_alive():
        os.kill(process.pid, how)
    process.join(60)
    if process.is_alive():
        process.kill()
        return f"{name}: {how.name} does not end it"
    time.sleep(1.5)  # workers end with it, and look for that once a second
    lost = _lose_the_end(folder, rng) if rng.random() < 0.5 else None
    code, said = _again(begin, name, folder)
    if lost is not None and code == REFUSED[name] and lost.name in said and "Traceback" not in said:
        lost.unlink()
        code, said = _again(begin, name, folder)
    if code != EXPECTED[name]:
        return f"{name}, {how.name}, lost {lost}: ended with {code}: {said[-500:]}"
    log = folder.with_suffix(".log").read_text()
    wrong = differences(straight, folder) + (["a traceback"] if "Traceback" in log else [])
    return f"{name}, {how.name}, lost {lost}: {'; '.join(wrong)}" if wrong else ""


def _again(begin: Callable[[str, Path], Any], name: str, folder: Path) -> tuple[int, str]:
    log = folder.with_suffix(".log")
    before = len(log.read_text()) if log.exists() else 0
    process = begin(name, folder)
    process.join(600)
    if process.is_alive():
        process.kill()
        return -1, "still at work after 600 s"
    return process.exitcode or 0, log.read_text()[before:]


def _lose_the_end(folder: Path, rng: random.Random) -> Path | None:
    """Cut the file written last, as a power cut does on a disk that keeps no order."""
    paths = [path for _, path in _files(folder)]
    if not paths:
        return None
    last = max(paths, key=lambda path: path.stat().st_mtime_ns)
    os.truncate(last, rng.randrange(last.stat().st_size))
    return last
