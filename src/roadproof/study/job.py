"""The work of a study: finding a pattern in one of many ways, and driving over it in all the study's conditions.

A row is one drive over the pattern against the same drive without it. Its columns, after `rows.JOB_COLUMNS`:

    column              unit      meaning
    controller                    spec of who drove
    weather                       of both drives, as "clear-noon"
    traffic                       whether there were cars and people
    traffic_seed                  of cars and people
    start_right_m       m         how both drives begin beside the scenario's start: to the right,
    start_turned_rad    rad       turned, left positive,
    start_faster_mps    m/s       and faster
    deviation_m         m         the paper's deviation between the two drives
    lateral_m           m         largest offset from the clean path, left positive
    points                        the CARLA challenge's infraction points with paint
    clean_points                  the same without
    leaderboard                   the CARLA Leaderboard's factor with paint, 1 where nothing happened
    clean_leaderboard             the same without
    first_event_s       s         when something first went wrong with paint; none where nothing did
    left_lane                     whether the car left its lane (`driving.evaluation.Trial`)
    ending                        why the painted drive ended
    events                        of the painted drive, those that count, as JSON: kind, seconds, with what or where
    clean_events                  of the clean one
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

from roadproof.attacks import OBJECTIVES, BayesianOptimisation, BlackBox, GradOpt, Published, method_of
from roadproof.attacks.blackbox import blackbox_search
from roadproof.calibration import Method as Calibration
from roadproof.controllers import Controller, load_controller
from roadproof.datatypes import Event, Weather
from roadproof.drives import Scheme, SteeringNoise, Swerve, Trajectories, Window
from roadproof.driving.drive_store import load_episodes
from roadproof.driving.evaluate import evaluate
from roadproof.driving.evaluation import Evaluation, Trial, path_of
from roadproof.driving.starts import StartRange
from roadproof.io.arrays import packed
from roadproof.patterns import Pattern, save_pattern
from roadproof.pipeline.budget import PUBLISHED, QUICK, STEERING, Budget
from roadproof.pipeline.driven_objective import DrivenObjective, Measure
from roadproof.pipeline.selection import first_of_each_group
from roadproof.pipeline.stress_test import StressTest, stress_test
from roadproof.search_space import SearchSpace
from roadproof.simulators.loading import open_simulator
from roadproof.simulators.protocol import Simulator
from roadproof.study.methods import BlackBoxPlan, GradOptPlan, MethodPlan, PublishedPlan
from roadproof.study.plan import BLACK, Job
from roadproof.study.rows import JobResult, Row, job_columns
from roadproof.study.views import views

MEASURED = (
    "controller",
    "weather",
    "traffic",
    "traffic_seed",
    "start_right_m",
    "start_turned_rad",
    "start_faster_mps",
    "deviation_m",
    "lateral_m",
    "points",
    "clean_points",
    "leaderboard",
    "clean_leaderboard",
    "first_event_s",
    "left_lane",
    "ending",
    "events",
    "clean_events",
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
        drives = isinstance(job.method, BlackBoxPlan) and job.method.where == "simulator"
        found = (_by_driving if drives else _in_recordings)(job, world, controller, scratch)
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
        "start_right_m": trial.start.right_m,
        "start_turned_rad": trial.start.turned_rad,
        "start_faster_mps": trial.start.faster_mps,
        "deviation_m": trial.deviation_m,
        "lateral_m": trial.lateral_m,
        "points": trial.points,
        "clean_points": trial.clean_points,
        "leaderboard": trial.leaderboard,
        "clean_leaderboard": trial.clean_leaderboard,
        "first_event_s": trial.first_event_s,
        "left_lane": trial.leaves_lane,
        "ending": trial.ending,
        "events": _told(trial.events),
        "clean_events": _told(trial.clean_events),
    }


def _told(events: Sequence[Event]) -> str:
    return json.dumps([(each.kind, each.time_s, each.detail) for each in events])


def start_range(job: Job) -> StartRange:
    """What the starts of a job's evaluation are drawn from."""
    plan = job.starts
    return StartRange(right_m=plan.right_m, turned_rad=plan.turned_rad, faster_mps=plan.faster_mps)


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
    """What a method that searches in recordings spends on finding a pattern."""
    found: dict[str, Any] = {}
    match method:
        case GradOptPlan():
            deviation = method.objective == "deviation"
            swerve = Swerve(method.swerves_m, method.weaves_m)
            how = swerve if method.noise_deg is None else SteeringNoise(*method.noise_deg)
            found = {
                "method": GradOpt(iterations=method.iterations, restarts=method.restarts, halving=method.halving),
                "objective": OBJECTIVES[method.objective],
                "trajectories": _trajectories(method, how),
                "window": Window(
                    frames=method.frames, least_px=QUICK.window.least_px if deviation else Window().least_px
                ),
                "pooled": method.scheme != "group",
                "calibration": Calibration(method.calibration),
                "select": method.select,
                "rounds": method.rounds,
            }
        case PublishedPlan():
            how = SteeringNoise(*method.noise_deg)
            found = {
                "method": Published(masks=method.masks, restarts=method.restarts),
                "trajectories": _trajectories(method, how),
                "pooled": method.scheme != "group",
            }
            return replace(PUBLISHED, weathers=(weather,), runs=0, **found)
        case BlackBoxPlan():
            found = {"method": _black_box(method), "objective": OBJECTIVES[method.objective]}
    return replace(QUICK, weathers=(weather,), **found)


def _trajectories(method: GradOptPlan | PublishedPlan, how: Swerve | SteeringNoise) -> Trajectories:
    scheme = Scheme.RANDOM if method.scheme == "random" else Scheme.GROUP
    return Trajectories(count=method.trajectories, scheme=scheme, perturbation=how)


def _black_box(method: BlackBoxPlan) -> BlackBox:
    more = {"random_calls": method.random_calls} if method.search == BayesianOptimisation.word else {}
    return cast("BlackBox", method_of(method.search, calls=method.calls, **more))


def space_of(job: Job) -> SearchSpace:
    """The patterns a job searches: published rectangles, in its own bounds for the published baseline."""
    family = BayesianOptimisation.family if job.method.search == BayesianOptimisation.word else "published"
    if job.figures == BLACK:
        return SearchSpace(figures=1, family=family, colour=False)
    return SearchSpace(figures=int(job.figures), family=family)


def _in_recordings(job: Job, world: Simulator, controller: Controller, folder: Path) -> _Answer:
    # Its own evaluation is a part of the study's conditions and kept where those are.
    budget = replace(budget_of(job.method, job.weathers[0]), starts=job.starts.count, start_range=start_range(job))
    found, calls, seconds = _searched(job, world, controller, folder, budget)
    strongest = found.attack.history.max((1, 2))
    before = [found.cost[stage] for stage in ("record", "calibrate")]
    # All steps cost much the same, so the time of the search is spread evenly over them.
    steps = found.cost["attack"].seconds * np.arange(1, len(strongest) + 1) / len(strongest)
    chosen = found.selection if found.rounds is None else found.rounds.best
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
                "calls": [] if chosen is None else [calls],
                "seconds": [] if chosen is None else [seconds],
                "best": [] if chosen is None else [chosen.deviation_m],
            },
        ),
    )


def _searched(
    job: Job, world: Simulator, controller: Controller, folder: Path, budget: Budget
) -> tuple[StressTest, int, float]:
    """A search in recordings; its simulator calls and seconds without the evaluation."""
    found = stress_test(
        world,
        controller,
        job.scenario,
        folder,
        budget=budget,
        space=space_of(job),
        seed=job.seed,
        controller_name=job.controller,
        film=False,
    )
    costs = [cost for stage, cost in found.cost.items() if stage != "evaluate"]
    return found, sum(cost.simulator_calls for cost in costs), sum(cost.seconds for cost in costs)


def _by_driving(job: Job, world: Simulator, controller: Controller, folder: Path) -> _Answer:
    plan, space = cast("BlackBoxPlan", job.method), space_of(job)
    start = _started(job, world, controller, folder / "start", plan.start) if plan.start else None
    calls_before, seconds_before = (start.calls, start.seconds) if start else (0, 0.0)
    objective = DrivenObjective(
        world,
        controller,
        job.scenario,
        space,
        measure=cast("Measure", plan.objective),
        weather=job.weathers[0],
        seed=job.seed,
        keep=folder / "driven.json",
    )
    trials = blackbox_search(
        objective,
        space,
        _black_box(plan),
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
            measure=plan.objective,
            deviation_m=[objective.effect(patterns[index]).deviation for index in best],
        ),
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Start:
    """What a black-box search begins with, and what finding it took."""

    patterns: tuple[Pattern, ...]
    calls: int
    seconds: float


def _started(job: Job, world: Simulator, controller: Controller, folder: Path, count: int) -> _Start:
    """Record, calibrate and search the steering shift; the candidates are for the black box to drive."""
    budget = replace(STEERING, select=0, weathers=job.weathers[:1])
    found, calls, seconds = _searched(job, world, controller, folder, budget)
    chosen = first_of_each_group(found.attack.candidates, count)
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
            starts=job.starts.count,
            start_range=start_range(job),
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
