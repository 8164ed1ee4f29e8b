"""How does cost grow with frames, figures, starts, drives and processes, and does an estimate say so beforehand?

    python benchmarks/scale.py --json OUT [--plot PNG] [--controllers pilotnet cil] [--repeats 5]

One step of the steering search is timed on a drive of 22 to 352 frames, with 1 to 16 figures, and from 1 to 16 starts,
beside the bare controller's passes to as many frames; drives over a painted road are timed by their number and by how
many processes make them, and must be the same for any number; a guided proposal of Bayesian optimisation as published
by the trials before it. A whole search of each size is held against what `roadproof attack --dry-run` would say of it.
Nothing else may run meanwhile. The plot has one panel for each question.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import tempfile
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
import torch

import roadproof
from gradopt_step import milliseconds, synthetic_drive
from roadproof.attacks import GradOpt, SteeringShift, Surrogate, attack, parse_groups, proposals
from roadproof.controllers import Controller
from roadproof.datatypes import Weather
from roadproof.driving.evaluate import evaluate
from roadproof.io.files import write_json
from roadproof.machine import keep_freed_memory, made_with
from roadproof.pipeline.workload import of_search
from roadproof.scenarios import find_scenario
from roadproof.search_space import SearchSpace
from roadproof.simulators.town.simulator import TownSimulator

FRAMES, FIGURES, STARTS = 88, 5, 1
SIZES = {"frames": (22, 44, 88, 176, 352), "figures": (1, 2, 4, 8, 16), "starts": (1, 2, 4, 8, 16)}
DRIVES = (2, 4, 8)
TRIALS = (60, 140, 400, 1000)

Record = dict[str, Any]


def step(controller: Controller, repeats: int, *, frames: int, figures: int, starts: int) -> Record:
    """One step of the steering search beside the bare controller's passes: medians of alternating repeats."""
    recordings, space = synthetic_drive(frames), SearchSpace(figures=figures)
    surrogate = Surrogate(recordings, controller, parse_groups("all", recordings))
    unit = space.random((1, starts), torch.Generator().manual_seed(0))
    bare_frames = surrogate.views[0].clean_frames.repeat(starts, 1, 1, 1).contiguous(memory_format=torch.channels_last)
    speed, command = torch.full((starts * frames,), 6.0), torch.full((starts * frames,), 2)

    def bare() -> None:
        leaf = bare_frames.requires_grad_()
        torch.autograd.grad(controller.steer(leaf, speed, command).sum(), leaf)

    times = medians(repeats, step=lambda: surrogate.values_and_gradients(space, unit), bare=bare)
    return {"step_ms": times["step"], "bare_ms": times["bare"], "ratio": times["step"] / times["bare"]}


def medians(repeats: int, **runs: Callable[[], object]) -> dict[str, float]:
    """Median milliseconds of each, in turn, after one of each to warm up."""
    taken = [{name: milliseconds(run, "cpu")[0] for name, run in runs.items()} for _ in range(repeats + 1)][1:]
    return {name: statistics.median(each[name] for each in taken) for name in runs}


def search(controller: Controller, *, frames: int, figures: int, starts: int) -> Record:
    """A whole search, short, beside its estimate."""
    recordings, method = synthetic_drive(frames), GradOpt(iterations=10, restarts=starts, halving=False)
    groups = parse_groups("all", recordings)
    told = of_search(method, SteeringShift(), frames, controller, groups=len(groups)).seconds
    began = time.perf_counter()
    attack(recordings, controller, SearchSpace(figures=figures), method=method, groups=groups)
    return {"estimated_s": told, "took_s": time.perf_counter() - began}


def drives(controller: str, count: int, processes: int) -> tuple[Record, np.ndarray]:
    """So many drives over one pattern, of which half are over the bare road; and how far each went astray."""
    space = SearchSpace(figures=FIGURES)
    pattern = space.pattern(space.random((), torch.Generator().manual_seed(0)))
    with tempfile.TemporaryDirectory() as folder:
        began = time.perf_counter()
        found = evaluate(
            TownSimulator,
            roadproof.load_controller(controller),
            find_scenario("left-03"),
            pattern,
            folder=Path(folder),
            weathers=(Weather.CLEAR_NOON,),
            starts=count // 2,
            runs=0,
            processes=processes,
        )
        took_s = time.perf_counter() - began
    return {"drives": count, "processes": processes, "took_s": took_s}, np.array([t.deviation_m for t in found.trials])


def proposal(trials: int) -> Record:
    """The next point of Bayesian optimisation as published, after so many trials of a smooth value."""
    space = SearchSpace(figures=FIGURES, family="published-bo")
    ranges = proposals.natural_ranges(space)
    tried = np.random.default_rng(0).uniform(size=(trials, len(ranges)))
    propose = proposals.published_bo(ranges, 1, 0)
    began = time.perf_counter()
    propose(tried, np.sin(3 * tried).sum(1), 1)
    return {"trials": trials, "took_s": time.perf_counter() - began}


def sizes() -> Iterable[tuple[str, dict[str, int]]]:
    """Every size of a search, with what it is that grows."""
    for against, values in SIZES.items():
        for value in values:
            yield against, {"frames": FRAMES, "figures": FIGURES, "starts": STARTS} | {against: value}


def draw(records: list[Record], path: Path) -> None:
    """One panel for each question, logarithmic both ways."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import LogLocator

    panels = [*SIZES, "drives", "processes", "trials", "estimate"]
    figure = Figure(figsize=(14, 6.5), layout="constrained")
    every = figure.subplots(2, 4)
    every[-1, -1].axis("off")
    for axes, against in zip(every.flat, panels, strict=False):
        mine = [each for each in records if each["against"] == against]
        for name in sorted({each["controller"] for each in mine}):
            of = [each for each in mine if each["controller"] == name]
            if against == "estimate":
                axes.plot([e["took_s"] for e in of], [e["estimated_s"] for e in of], "o", label=name)
            elif against in SIZES:
                (line,) = axes.plot([e[against] for e in of], [e["step_ms"] for e in of], "o-", label=name)
                bare = [e["bare_ms"] for e in of]
                axes.plot([e[against] for e in of], bare, "--", color=line.get_color(), label=f"{name}, bare")
            else:
                axes.plot([e[against] for e in of], [e["took_s"] for e in of], "o-", label=name)
        unit = "estimated s" if against == "estimate" else "ms a step" if against in SIZES else "s"
        axes.set(xscale="log", yscale="log", xlabel="took s" if against == "estimate" else against, ylabel=unit)
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
            axis.set_major_formatter("{x:g}")
        if against != "estimate":
            axes.set_xticks(sorted({each[against] for each in mine}))
        axes.minorticks_off()
        if against == "estimate":
            axes.axline((1, 1), (10, 10), color="0.7", linewidth=1)
        if mine:
            axes.legend(fontsize=8)
    figure.savefig(path, dpi=110)


def main() -> None:
    """Measure every size, and write after each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, required=True)
    parser.add_argument("--plot", type=Path)
    parser.add_argument("--controllers", nargs="+", default=["pilotnet", "cil"])
    parser.add_argument("--repeats", type=int, default=5)
    given = parser.parse_args()
    keep_freed_memory()  # as the command line does
    records: list[Record] = []

    def keep(record: Record) -> None:
        records.append(record)
        print(json.dumps(record), flush=True)
        write_json(given.json, {"benchmark": "scale", "made_with": made_with(), "records": records})

    for trials in TRIALS:
        keep({"against": "trials", "controller": "BO as published"} | proposal(trials))
    for name in given.controllers:
        controller = roadproof.load_controller(name)
        for against, size in sizes():
            keep({"against": against, "controller": name} | size | step(controller, given.repeats, **size))
            keep({"against": "estimate", "controller": name} | size | search(controller, **size))
        for count in DRIVES:
            keep({"against": "drives", "controller": name} | drives(name, count, 1)[0])
        seen: list[np.ndarray] = []
        for processes in sorted({1, 2, os.cpu_count() or 1}):
            record, astray = drives(name, max(DRIVES), processes)
            seen.append(astray)
            same = bool(np.array_equal(seen[0], astray))
            keep({"against": "processes", "controller": name} | record | {"same_drives": same})
    if given.plot:
        draw(records, given.plot)


if __name__ == "__main__":
    main()
