"""The work of a study: finding a pattern in one of many ways, and driving over it in all the study's conditions.

A row is one drive over the pattern against the same drive without it. Its columns, after `rows.JOB_COLUMNS`:

    column              unit      meaning
    controller                    spec of who drove
    weather                       of both drives, as "clear-noon"
    traffic                       whether there were cars and people
    traffic_seed                  of cars and people
    deviation_m         m         the paper's deviation between the two drives
    lateral_m           m         largest offset from the clean path, left positive
    points                        the CARLA challenge's infraction points with paint
    clean_points                  the same without
    leaderboard                   the CARLA Leaderboard's factor with paint, 1 where nothing happened
    clean_leaderboard             the same without
    first_event_s       s         when something first went wrong with paint; none where nothing did
    ending                        why the painted drive ended
    events                        of the painted drive, those that count, as JSON: kind, seconds, with what or where
    search_calls        drives    of the simulator before the evaluation: recording, calibration and selection; in a
                                  black-box search one for each pattern tried and a clean one, and what its start took
    search_seconds      s         that finding the pattern took
    evaluation_calls    drives    of the evaluation, clean ones included
    seconds             s         of the whole job; of an evaluation that was interrupted, only of what was left

All numbers of a row but the costs are of driving. Files beside the rows:

    pattern.json, .png  what was painted
    paths.npz           clean_xy and painted_xy, metres in the world: both drives alone in the first weather
    history.json        how the search went, see `history`
    view-WEATHER.jpg    what the car's camera sees of the pattern, from one place before it, see `study.views`
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np
import torch

from roadproof.attacks import OBJECTIVES, Schedule
from roadproof.attacks.blackbox import Method as BlackBox
from roadproof.attacks.blackbox import blackbox_search
from roadproof.calibration import Method as Calibration
from roadproof.controllers import Controller, load_controller
from roadproof.datatypes import Weather
from roadproof.drives import Scheme
from roadproof.evaluation import DrivenObjective, Evaluation, evaluate
from roadproof.evaluation.episodes import load_episodes
from roadproof.evaluation.objective import Measure
from roadproof.evaluation.result import Trial, path_of
from roadproof.evaluation.selection import first_of_each_group
from roadproof.io.arrays import packed
from roadproof.loop import Budget, StressTest, stress_test
from roadproof.patterns import Pattern, save_pattern
from roadproof.search_space import SearchSpace
from roadproof.simulators.loading import open_simulator
from roadproof.simulators.protocol import Simulator
from roadproof.study.plan import BLACK, Job, MethodPlan
from roadproof.study.rows import JobResult, Row, job_columns
from roadproof.study.views import views

SWERVES_M = (1.5, 0.8, 1.2)
"""How far the first, second and third pair of perturbed drives are pushed aside."""

MEASURED = (
    "controller",
    "weather",
    "traffic",
    "traffic_seed",
    "deviation_m",
    "lateral_m",
    "points",
    "clean_points",
    "leaderboard",
    "clean_leaderboard",
    "first_event_s",
    "ending",
    "events",
    "search_calls",
    "search_seconds",
    "evaluation_calls",
    "seconds",
)

HISTORY_FORMAT = "roadproof-study-history"
HISTORY_VERSION = 1


@dataclass(frozen=True, slots=True, eq=False)
class _Answer:
    """What a search gave.

    Args:
        pattern: it.
        calls: drives of the simulator.
        seconds: of the search.
        evaluation_s: of drives made already that belong to the evaluation.
        history: how it went.
    """

    pattern: Pattern
    calls: int
    seconds: float
    evaluation_s: float
    history: dict[str, Any]


def run_job(job: Job, scratch: Path) -> JobResult:
    """Find a pattern and evaluate it; the `Work` of a study.

    Args:
        job: what to do.
        scratch: its own folder; what an interrupted run left there is gone on from.

    Raises:
        RoadproofError: the simulator or controller is not there, or a stage refuses; the message says why.
    """
    controller = load_controller(job.controller)
    with open_simulator(job.simulator) as world:
        search = _by_gradient if job.method.search == "gradopt" else _by_black_box
        found = search(job, world, controller, scratch)
        parts = _evaluate(job, world, controller, found.pattern, scratch)
        (clean,) = load_episodes(scratch / "evaluation", [parts[0].shown().clean])
        seen = views(world, job.scenario, found.pattern, clean, job.weathers)
    costs = {
        "search_calls": found.calls,
        "search_seconds": found.seconds,
        "evaluation_calls": sum(part.simulator_calls for part in parts),
        "seconds": found.seconds + found.evaluation_s + sum(part.seconds for part in parts),
    }
    rows = [
        {**job_columns(job), "controller": job.controller, **measured(trial), **costs}
        for part in parts
        for trial in part.trials
    ]
    save_pattern(found.pattern, scratch / "pattern.json")
    files = {name: (scratch / name).read_bytes() for name in ("pattern.json", "pattern.png")}
    files |= {"paths.npz": _paths(parts[0], scratch / "evaluation"), "history.json": _json(found.history)}
    return JobResult(tuple(rows), files | seen)


def measured(trial: Trial) -> Row:
    """The columns of one drive over a pattern, from weather to ending."""
    return {
        "weather": str(trial.weather),
        "traffic": trial.traffic,
        "traffic_seed": trial.seed,
        "deviation_m": trial.deviation_m,
        "lateral_m": trial.lateral_m,
        "points": trial.points,
        "clean_points": trial.clean_points,
        "leaderboard": trial.leaderboard,
        "clean_leaderboard": trial.clean_leaderboard,
        "first_event_s": trial.first_event_s,
        "ending": trial.ending,
        "events": json.dumps([(each.kind, each.time_s, each.detail) for each in trial.events]),
    }


def history(
    kind: Literal["closed loop", "surrogate"],
    calls: Sequence[int],
    seconds: Sequence[float],
    best: Sequence[float],
    **more: object,
) -> dict[str, Any]:
    """How a search went, as it is kept.

    Args:
        kind: where the values come from: drives, or composited frames.
        calls: of the simulator, before each value was known.
        seconds: since the search began, of each.
        best: the highest value so far, in the search's own measure.
        more: black box: `measure`, and `deviation_m`, closed loop, of the pattern that was best by then. gradopt:
            `driven`, the same three lists for the deviation in metres of the candidates that were driven in the end.
    """
    own = {"kind": kind, "calls": list(calls), "seconds": list(seconds), "best": list(best)}
    return {"format": HISTORY_FORMAT, "version": HISTORY_VERSION, **own, **more}


def budget_of(method: MethodPlan, weather: Weather) -> Budget:
    """What a gradopt method spends on finding a pattern."""
    # A black box's objective is of its own drives; the search that it begins with stays the published one.
    objective = method.objective if method.search == "gradopt" else "steering"
    heats = Schedule.closed_loop if objective == "deviation" else Schedule.in_heats
    schedule = heats if method.schedule == "heats" else Schedule.stretched
    return Budget(
        objective=OBJECTIVES[objective],
        deviations_m=SWERVES_M[: (method.trajectories - 1) // 2],
        scheme=Scheme.RANDOM if method.scheme == "random" else Scheme.GROUP,
        pooled=method.scheme != "group",
        frames=method.frames,
        calibration=Calibration(method.calibration),
        schedule=schedule(method.iterations),
        restarts=method.restarts,
        select=method.select,
        weathers=(weather,),
        runs=0,
    )


def space_of(job: Job) -> SearchSpace:
    """The patterns a job searches: published rectangles, in its own bounds for the published baseline."""
    family = "published-bo" if job.method.search == "published-bo" else "published"
    if job.figures == BLACK:
        return SearchSpace(figures=1, family=family, colour=False)
    return SearchSpace(figures=int(job.figures), family=family)


def _by_gradient(job: Job, world: Simulator, controller: Controller, folder: Path) -> _Answer:
    # Its own evaluation, one pair of drives, is the first of the study's conditions and kept where those are.
    found, calls, seconds = _searched(job, world, controller, folder, select=job.method.select)
    strongest = found.attack.history.max((1, 2))
    before = [found.cost[stage] for stage in ("record", "calibrate")]
    # All steps cost much the same, so the time of the search is spread evenly over them.
    steps = found.cost["attack"].seconds * np.arange(1, len(strongest) + 1) / len(strongest)
    driven = int(found.selection is not None)
    return _Answer(
        found.pattern,
        calls,
        seconds,
        found.cost["evaluate"].seconds,
        history(
            "surrogate",
            [sum(cost.simulator_calls for cost in before)] * len(strongest),
            cast("list[float]", (sum(cost.seconds for cost in before) + steps).tolist()),
            cast("list[float]", np.maximum.accumulate(strongest).tolist()),
            measure=found.attack.objective,
            driven={
                "calls": [calls] * driven,
                "seconds": [seconds] * driven,
                "best": [found.evaluation.shown().deviation_m] * driven,
            },
        ),
    )


def _searched(
    job: Job, world: Simulator, controller: Controller, folder: Path, *, select: int
) -> tuple[StressTest, int, float]:
    """A gradopt search with so many candidates driven; its simulator calls and seconds without the evaluation."""
    found = stress_test(
        world,
        controller,
        job.scenario,
        folder,
        budget=replace(budget_of(job.method, job.weathers[0]), select=select),
        space=space_of(job),
        seed=job.seed,
        controller_name=job.controller,
    )
    costs = [cost for stage, cost in found.cost.items() if stage != "evaluate"]
    return found, sum(cost.simulator_calls for cost in costs), sum(cost.seconds for cost in costs)


def _by_black_box(job: Job, world: Simulator, controller: Controller, folder: Path) -> _Answer:
    space = space_of(job)
    start = _started(job, world, controller, folder / "start") if job.method.start else None
    calls_before, seconds_before = (start.calls, start.seconds) if start else (0, 0.0)
    objective = DrivenObjective(
        world,
        controller,
        job.scenario,
        space,
        measure=cast("Measure", job.method.objective),
        weather=job.weathers[0],
        seed=job.seed,
        keep=folder / "driven.json",
    )
    trials = blackbox_search(
        objective,
        space,
        method=cast("BlackBox", job.method.search),
        calls=job.method.calls,
        random_calls=job.method.random_calls,
        seed=job.seed,
        first=torch.stack([space.point(pattern) for pattern in start.patterns]) if start else None,
        checkpoint=folder / "trials.safetensors",
    )
    patterns = space.pattern(trials.unit.float())
    best = [int(trials.value[: count + 1].argmax()) for count in range(len(trials))]
    seconds = cast("list[float]", (seconds_before + trials.seconds).tolist())
    return _Answer(
        patterns[trials.best],
        calls_before + 1 + len(trials),
        seconds[-1],
        0.0,
        history(
            "closed loop",
            [calls_before + 2 + count for count in range(len(trials))],
            seconds,
            cast("list[float]", trials.best_so_far.tolist()),
            measure=job.method.objective,
            deviation_m=[objective.effect(patterns[index]).deviation for index in best],
        ),
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Start:
    """What a black-box search begins with, and what finding it took."""

    patterns: tuple[Pattern, ...]
    calls: int
    seconds: float


def _started(job: Job, world: Simulator, controller: Controller, folder: Path) -> _Start:
    """Record, calibrate and search; the candidates are for the black box to drive."""
    found, calls, seconds = _searched(job, world, controller, folder, select=0)
    chosen = first_of_each_group(found.attack.candidates, job.method.select)
    return _Start(tuple(candidate.pattern for _, candidate in chosen), calls, seconds)


def _evaluate(
    job: Job, world: Simulator, controller: Controller, pattern: Pattern, scratch: Path
) -> tuple[Evaluation, ...]:
    """All the study's conditions; where traffic is for the first weather alone, the others are a part of their own."""
    traffic = job.traffic
    split = traffic is not None and traffic.weathers == "first" and len(job.weathers) > 1
    parts = [("evaluation", job.weathers[:1] if split else job.weathers, traffic)]
    if split:
        parts.append(("evaluation-alone", job.weathers[1:], None))
    return tuple(
        evaluate(
            world,
            controller,
            job.scenario,
            pattern,
            folder=scratch / name,
            driver_name=job.controller,
            weathers=weathers,
            runs=others.runs if others else 0,
            cars=others.cars if others else 0,
            pedestrians=others.pedestrians if others else 0,
            seed=job.seed,
        )
        for name, weathers, others in parts
    )


def _paths(evaluation: Evaluation, folder: Path) -> bytes:
    trial = evaluation.shown()
    clean, painted = load_episodes(folder, [trial.clean, trial.painted])
    return packed({"clean_xy": path_of(clean), "painted_xy": path_of(painted)})


def _json(content: object) -> bytes:
    return (json.dumps(content) + "\n").encode()
