"""The work of a study: finding a pattern in one of many ways, and driving over it in all the study's conditions."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import cast

import numpy as np
import torch

from roadproof.attacks import site_of
from roadproof.attacks.blackbox import blackbox_search
from roadproof.attacks.driven import DrivenMeasure, InSimulator
from roadproof.attacks.objective import OBJECTIVES
from roadproof.controllers import Controller, load_controller
from roadproof.datatypes import Weather
from roadproof.driving.deviation import path_of
from roadproof.driving.drive_store import load_episodes
from roadproof.driving.evaluate import evaluate
from roadproof.driving.evaluation import Evaluation
from roadproof.driving.starts import require_on_road
from roadproof.errors import StudyError
from roadproof.io.arrays import packed
from roadproof.paint import Site, conspicuousness
from roadproof.patterns import Pattern, raster, save_pattern
from roadproof.pipeline.budget import STEERING, Budget
from roadproof.pipeline.rerecording import best_of
from roadproof.pipeline.selection import first_of_each_group
from roadproof.pipeline.stress_test import StressTest, stress_test
from roadproof.recordings import load_recordings
from roadproof.roads.marks import site_at
from roadproof.search_space import SearchSpace
from roadproof.simulators.loading import open_simulator
from roadproof.simulators.protocol import Simulator
from roadproof.study.history import History, Progress
from roadproof.study.methods import BlackBoxPlan, black_box, budget_of, family_of, tries_by_driving
from roadproof.study.passages import passages
from roadproof.study.plan import BLACK, Job, TrafficPlan, weights_digest
from roadproof.study.rows import CostColumns, JobResult, Row, drive_columns, job_columns, paint_columns
from roadproof.study.shared import SharedRecordings, bare_drives, bring_bare_drives, keep_bare_drives


@dataclass(frozen=True, slots=True, eq=False)
class _Found:
    """What a search gave and took; `evaluation_s` are seconds of drives that belong to the evaluation already."""

    pattern: Pattern
    calls: int
    seconds: float
    evaluation_s: float
    history: History
    site: Site


PARTS = ("evaluation", "evaluation-alone")
"""Folders of a job's evaluations."""


def run_job(job: Job, scratch: Path) -> JobResult:
    """Find a pattern and evaluate it; the `Work` of a study.

    Args:
        job: the pattern to find, and the conditions to evaluate it in.
        scratch: the job's own folder; what an interrupted run left there is gone on from.

    Raises:
        RoadproofError: the simulator or controller is not there, its files are not those of the job, or a stage
            refuses; the message says why.
    """
    key = job.key
    _check_files(job, key)
    controller = load_controller(job.controller)
    with open_simulator(job.simulator) as world:
        require_on_road(job.starts.range, job.scenario, world)
        drives = tries_by_driving(job.method)
        bare = bare_drives(job, world, controller, scratch.parent)
        for name, *_ in _conditions(job):
            bring_bare_drives(bare, scratch / name)
        found = (_by_driving if drives else _in_recordings)(job, world, controller, scratch)
        parts = _evaluate(job, world, controller, found.pattern, scratch)
        for name, part in zip(PARTS, parts, strict=False):
            keep_bare_drives(bare, scratch / name, part)
        shown = parts[0].shown()
        clean, painted = load_episodes(scratch / PARTS[0], [shown.clean, shown.painted])
        paint, pictures = raster(found.pattern), dict[str, bytes]()
        for name, part in zip(PARTS, parts, strict=False):
            pictures |= passages(world, part, scratch / name, paint)
    # What was loaded lies between two looks at the files.
    _check_files(job, key)
    costs: CostColumns = {
        "search_calls": found.calls,
        "search_seconds": found.seconds,
        "evaluation_calls": sum(part.simulator_calls for part in parts),
        "seconds": found.seconds + found.evaluation_s + sum(part.seconds for part in parts),
    }
    told = paint_columns(conspicuousness(found.pattern, found.site))
    rows = tuple(
        Row(**job_columns(job), controller=job.controller, **drive_columns(trial), **told, **costs)
        for part in parts
        for trial in part.trials
    )
    save_pattern(found.pattern, scratch / "pattern.json")
    files = {name: (scratch / name).read_bytes() for name in ("pattern.json", "pattern.png")}
    files["paths.npz"] = packed({"clean_xy": path_of(clean), "painted_xy": path_of(painted)})
    files["history.json"] = found.history.to_json()
    return JobResult(rows, files | pictures)


def _check_files(job: Job, key: str) -> None:
    """See that the files of controller and map are those of the job; they may be written again while a study runs.

    Raises:
        StudyError: they are others, or gone.
    """
    if weights_digest(job.controller) != job.weights:
        raise StudyError(
            f"the files of {job.controller} are no longer those that the study began with; run it again for those of "
            "now, or put the old ones back"
        )
    if job.key != key:
        raise StudyError(f"the map {job.scenario.map_name} has changed while the job ran; run the study again")


def space_of(job: Job) -> SearchSpace:
    """The patterns a job searches."""
    family = family_of(job.method)
    if job.figures == BLACK:
        return SearchSpace(figures=1, family=family, colour=False, limits=job.paint)
    return SearchSpace(figures=int(job.figures), family=family, limits=job.paint)


def _in_recordings(job: Job, world: Simulator, controller: Controller, folder: Path) -> _Found:
    # Its own evaluation is a part of the study's conditions and kept where those are.
    budget = budget_of(job.method, job.weathers[0], job.variation)
    budget = replace(budget, starts=job.starts.count, start_range=job.starts.range)
    found, calls, seconds = _searched(job, world, controller, folder, budget)
    strongest = found.attack.history.max((1, 2))
    before = [found.cost[stage] for stage in ("record", "calibrate")]
    # All steps cost much the same, so the time of the search is spread evenly over them.
    steps = found.cost["attack"].seconds * np.arange(1, len(strongest) + 1) / len(strongest)
    chosen = best_of(found.selection, found.rounds)
    history = History(
        kind="predicted" if budget.is_predicted else "surrogate",
        calls=(sum(cost.simulator_calls for cost in before),) * len(strongest),
        seconds=tuple((sum(cost.seconds for cost in before) + steps).tolist()),
        best=tuple(np.maximum.accumulate(strongest).tolist()),
        measure=found.attack.objective,
        driven=Progress(calls=(), seconds=(), best=())
        if chosen is None
        else Progress(calls=(calls,), seconds=(seconds,), best=(chosen.deviation_m,)),
    )
    site = site_of(load_recordings(folder / "recordings"))
    return _Found(found.pattern, calls, seconds, found.cost["evaluate"].seconds, history, _said(job, site))


def _searched(
    job: Job, world: Simulator, controller: Controller, scratch: Path, budget: Budget, name: str = ""
) -> tuple[StressTest, int, float]:
    """A search in recordings; its simulator calls and seconds without the evaluation.

    Its run is in the scratch folder, or in one of a name there. Drives that another job has recorded and calibrated
    cost what they cost that one.
    """
    folder, shared = scratch / name, SharedRecordings.of(job, world, controller, budget, scratch.parent)
    shared.bring(folder)
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
    shared.keep(folder)
    found = replace(found, cost=found.cost | shared.cost)
    costs = [cost for stage, cost in found.cost.items() if stage != "evaluate"]
    return found, sum(cost.simulator_calls for cost in costs), sum(cost.seconds for cost in costs)


def _by_driving(job: Job, world: Simulator, controller: Controller, folder: Path) -> _Found:
    plan, space = cast("BlackBoxPlan", job.method), space_of(job).on(site_at(world, job.scenario))
    first, calls_before, seconds_before = None, 0, 0.0
    if plan.start:
        # Record, calibrate and search the steering shift; the candidates are for the black box to drive.
        budget = replace(STEERING, select=0, starts=0, weathers=job.weathers[:1])
        found, calls_before, seconds_before = _searched(job, world, controller, folder, budget, "start")
        chosen = first_of_each_group(found.attack.candidates, plan.start)
        first = torch.stack([candidate.point_in(space) for _, candidate in chosen])
    stretch = InSimulator(world, job.scenario, job.weathers[0], job.seed, keep=folder / "driven.json")
    measure = DrivenMeasure(stretch, controller, OBJECTIVES[plan.objective])
    trials = blackbox_search(
        lambda unit: measure.values(space, unit[None])[0],
        space,
        black_box(plan),
        seed=job.seed,
        first=first,
        checkpoint=folder / "trials.safetensors",
    )
    patterns = space.pattern(trials.unit.float())
    best = [int(trials.value[: count + 1].argmax()) for count in range(len(trials))]
    history = History(
        kind="closed loop",
        calls=tuple(range(calls_before + 2, calls_before + 2 + len(trials))),
        seconds=tuple(map(float, seconds_before + trials.seconds)),
        best=tuple(map(float, trials.best_so_far)),
        measure=plan.objective,
        deviation_m=tuple(measure.effect(patterns[index]).deviation for index in best),
    )
    site = _said(job, site_at(world, job.scenario))
    return _Found(patterns[trials.best], history.calls[-1], history.seconds[-1], 0.0, history, site)


def _said(job: Job, site: Site) -> Site:
    """A site with what the plan's limits say of it."""
    return site if job.paint is None else job.paint.site(site)


def _evaluate(
    job: Job, world: Simulator, controller: Controller, pattern: Pattern, scratch: Path
) -> tuple[Evaluation, ...]:
    """All the study's conditions."""
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
            start_range=job.starts.range,
            runs=others.runs if others else 0,
            cars=others.cars if others else 0,
            pedestrians=others.pedestrians if others else 0,
            seed=job.seed,
        )
        for name, weathers, others in _conditions(job)
    )


def _conditions(job: Job) -> tuple[tuple[str, tuple[Weather, ...], TrafficPlan | None], ...]:
    """Folder, weathers and traffic of each evaluation; where traffic is for the first weather alone, there are two."""
    traffic = job.traffic
    if traffic is None or traffic.weathers == "all" or len(job.weathers) == 1:
        return ((PARTS[0], job.weathers, traffic),)
    return (PARTS[0], job.weathers[:1], traffic), (PARTS[1], job.weathers[1:], None)
