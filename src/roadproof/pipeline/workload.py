"""What work will take, before it begins: drives, seconds, disk.

Steps are counted as the work itself counts them. What one costs is measured for the controller, here and now, and
otherwise the figures below, which were taken on two cores of a server: expect a factor of two either way.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, replace

import torch
from torch.nn import Module

from roadproof.attacks import TPE, BayesianOptimisation, GaussianProcess, GradOpt, Method, Objective, Published
from roadproof.attacks.blackbox import AT_ONCE
from roadproof.attacks.cheapest import AFRESH, MOST_LEVELS, RUNGS
from roadproof.attacks.gradopt import DRAWN, Rung
from roadproof.attacks.objective import ClosedLoop, SpeedChange, variation_of
from roadproof.calibration import replays_needed
from roadproof.controllers import Controller
from roadproof.controllers.asking import steer_of
from roadproof.controllers.checks import require_usable
from roadproof.controllers.precision import for_climbing
from roadproof.machine import threads
from roadproof.pipeline.budget import Budget
from roadproof.recorded.world import UNSURE

DRIVE_S, CROWDED_S = 2.0, 3.0
"""A drive of a built-in scenario in the town, alone and among 20 cars and 20 people."""

STRETCH_STEPS = 75
"""Steps of a drive through recordings."""

COMPOSITING = 1.3
"""What a frame of a search takes of what the controller alone takes."""

DRIVE_MB, FILM_MB, EPISODE_MB = 1.1, 7.0, 0.1
"""A recorded drive, or a replay of one; the film and the report; a drive of an evaluation."""

PUBLISHED_S, PROCESS_S = (0.4, 8e-6), (0.1, 1e-5)
"""A guided proposal, of Bayesian optimisation as published and of Optuna's Gaussian process on one thread, takes a
constant, and so much times the trials squared."""

SEARCHED_AFRESH = 6
"""Limits of the area under which a search for less paint begins afresh."""

FURTHER = 0.25
"""Of what grows with the trials, Optuna's further proposals of a batch take a part: they go on from what was fitted."""

TOLD_S = 6e-4
"""A batch of proposals of TPE takes so much times the trials."""

_BATCH, _ROUNDS = 8, 3
_USUAL, _MEASURED = "from usual costs", "the controller measured here, drives from usual costs"


@dataclass(frozen=True, kw_only=True, slots=True)
class Workload:
    """Drives, time and disk space that some work takes, estimated before it begins.

    Args:
        drives: number of simulator drives.
        seconds: wall time, seconds.
        megabytes: disk space, megabytes.
        basis: what the seconds were measured on, in words.
    """

    drives: int = 0
    seconds: float = 0.0
    megabytes: float = 0.0
    basis: str = _USUAL

    def __add__(self, other: Workload) -> Workload:
        return replace(
            other if self.basis == _USUAL else self,
            drives=self.drives + other.drives,
            seconds=self.seconds + other.seconds,
            megabytes=self.megabytes + other.megabytes,
        )

    def times(self, count: int, *, at_once: int = 1) -> Workload:
        """The same work done `count` times, `at_once` of them side by side."""
        seconds = self.seconds * math.ceil(count / at_once)
        return replace(self, drives=self.drives * count, seconds=seconds, megabytes=self.megabytes * count)


RECORDED_DRIVE = Workload(drives=1, seconds=DRIVE_S, megabytes=DRIVE_MB)
"""A drive past the bare canvas, or a replay of one, whose pictures are kept."""


def frame_seconds(controller: Controller, *, gradients: bool = True) -> float:
    """What a frame of a search takes: compositing, and the controller, there and back, measured here and now.

    It is the least of a few tries, with all threads and with one: beside other work, threads wait for each other.

    Raises:
        ControllerError: the controller raises or answers wrongly.
    """
    size, device = controller.input_size or (88, 200), _device_of(controller)
    require_usable(controller, size=size, device=str(device), drives=False, gradients=gradients)
    frames = torch.rand(_BATCH, 3, *size, device=device, requires_grad=gradients)
    speed, command = torch.full((_BATCH,), 7.0, device=device), torch.full((_BATCH,), 2, device=device)
    took_s = math.inf
    for used in sorted({1, torch.get_num_threads()}) * _ROUNDS:
        with threads(used):
            began = time.perf_counter()
            answer = steer_of(controller, frames, speed, command)
            if gradients:
                answer.sum().backward()
            took_s = min(took_s, time.perf_counter() - began)
    return COMPOSITING * took_s / _BATCH


def of_search(
    method: Method, objective: Objective, frames: int, controller: Controller, *, groups: int = 2, worlds: int = 1
) -> Workload:
    """Estimate a search for patterns.

    Args:
        method: search method.
        objective: objective of the search; for one in the recorded world the car is driven step by step.
        frames: number of frames in a group of drives.
        controller: controller that is timed.
        groups: number of groups searched.
        worlds: number of recorded worlds, one a weather, each of which is driven in.
    """
    if isinstance(method, GradOpt):
        rungs = method.ladder(objective)
    elif isinstance(method, Published):
        rungs = method.ladder
    else:
        rungs = (Rung(1, method.steps(objective), 1.0),)
    # A start that is only valued takes a third of a step.
    count = sum(
        (rung.starts * rung.iterations + ((DRAWN if rung.screened else 0) + rung.offspring) / 3)
        * _pictures(rung, objective, frames, worlds)
        for rung in rungs
    )
    timed = for_climbing(controller, _device_of(controller)) if isinstance(method, GradOpt) else controller
    seconds = groups * count * _looks(objective) * frame_seconds(timed, gradients=method.by_gradient)
    return Workload(seconds=seconds, megabytes=1.0, basis=_MEASURED) + of_proposals(method, at_once=AT_ONCE)


def of_proposals(method: Method, *, at_once: int = 1) -> Workload:
    """Estimate what a search takes to choose what to try next; it shows where a model of the trials chooses.

    Args:
        method: search method.
        at_once: number of patterns proposed in a batch.
    """
    if isinstance(method, TPE):
        return Workload(seconds=TOLD_S * method.calls**2 / (2 * at_once))
    if isinstance(method, BayesianOptimisation):
        first, (each_s, later_s) = min(method.random_calls, method.calls), PUBLISHED_S
    elif isinstance(method, GaussianProcess):
        first, (each_s, later_s) = 0, PROCESS_S
        later_s *= FURTHER + (1 - FURTHER) / at_once
    else:
        return Workload()
    last = method.calls
    return Workload(seconds=each_s * (last - first) + later_s * (last**3 - first**3) / 3)


def of_cheapest(figures: int, objective: Objective, controller: Controller) -> Workload:
    """Estimate the search for less paint, where every limit of the area is tried.

    Args:
        figures: number of figures of the pattern that is begun with.
        objective: objective of the search before.
        controller: controller that is timed.
    """
    frame_s = frame_seconds(for_climbing(controller, _device_of(controller)))
    climbed = sum(rung.starts * rung.iterations * _pictures(rung, objective, STRETCH_STEPS, 1) for rung in RUNGS)
    # Below each limit the pattern, and what it is without each of its figures, is only valued.
    valued = len(UNSURE) * STRETCH_STEPS * (1 + figures) / 3
    seconds = MOST_LEVELS * (climbed * _looks(objective) + valued) * frame_s
    afresh = of_search(AFRESH, objective, STRETCH_STEPS, controller).times(SEARCHED_AFRESH)
    return Workload(seconds=seconds, basis=_MEASURED) + replace(afresh, megabytes=0.0)


def _device_of(controller: Controller) -> torch.device:
    weights = controller.parameters() if isinstance(controller, Module) else ()
    return next((each.device for each in weights), torch.device("cpu"))


def _looks(objective: Objective) -> int:
    variation = variation_of(objective)
    return 1 if variation is None else variation.draws


def _pictures(rung: Rung, objective: Objective, frames: int, worlds: int) -> int:
    """What one start of a rung takes at a step."""
    climbs_frames = rung.open_loop and not isinstance(objective, SpeedChange)
    if climbs_frames or not isinstance(objective, ClosedLoop):
        return math.ceil(frames / rung.every)
    return worlds * math.ceil(STRETCH_STEPS / (rung.every if rung.every > 1 else objective.every))


def of_drives(alone: int, crowded: int = 0, *, processes: int = 1) -> Workload:
    """Estimate drives in the town, alone and in traffic."""
    seconds = (alone * DRIVE_S + crowded * CROWDED_S) / processes
    return Workload(drives=alone + crowded, seconds=seconds, megabytes=(alone + crowded) * EPISODE_MB)


def of_evaluation(
    weathers: int, starts: int, runs: int, *, random: int = 0, film: bool = True, processes: int = 1
) -> Workload:
    """Estimate an evaluation: every clean drive, every painted one, and the film made after them."""
    alone = weathers * (2 * max(starts, 1) + random)
    crowded = weathers * runs * (3 if random else 2)
    return of_drives(alone, crowded, processes=processes) + Workload(
        seconds=2 * DRIVE_S * film, megabytes=FILM_MB * film
    )


def of_run(budget: Budget, controller: Controller, *, film: bool = True, processes: int = 1) -> Workload:
    """Estimate a whole stress test of one scenario.

    Args:
        budget: budget of the stress test.
        controller: controller that is timed.
        film: whether the film of two drives is made.
        processes: number of replays and of drives of the evaluation made at once.
    """
    judged = of_evaluation(len(budget.weathers), budget.starts, budget.runs, film=film, processes=processes)
    return of_finding(budget, controller) + of_recording(budget, processes=processes) + judged


def of_recording(budget: Budget, *, processes: int = 1) -> Workload:
    """Estimate the drives that a stress test records, and their calibration."""
    count, weathers = budget.trajectories.count, len(budget.recorded_in)
    replays = weathers * replays_needed(count, budget.calibration)
    return RECORDED_DRIVE.times(weathers * count) + RECORDED_DRIVE.times(replays, at_once=processes)


def of_finding(budget: Budget, controller: Controller) -> Workload:
    """Estimate the search of a stress test, and the drives over what it finds."""
    worlds = len(budget.recorded_in)
    frames = budget.window.frames * (1 + budget.trajectories.count // 2) * worlds
    searched = of_search(budget.method, budget.objective, frames, controller, worlds=worlds)
    return searched.times(1 + budget.rounds) + of_drives(budget.select + budget.rounds * (1 + budget.select))
