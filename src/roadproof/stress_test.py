"""The whole loop for one scenario: record, calibrate, attack, choose by driving, evaluate.

    RUN/record/        drives past the bare canvas (`drives.record`)
    RUN/calibration/   replays over painted targets, and how good they are (`calibration.calibrate`)
    RUN/recordings/    the drives, calibrated (`recordings`)
    RUN/attack/        what the search found (`attacks.attack`)
    RUN/selection/     which of it was strongest when driven (`evaluation.select_by_driving`)
    RUN/evaluation/    how bad that is, by weather, alone and in traffic (`evaluation.evaluate`)

Every stage goes on from what its folder holds.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TypeAlias

from roadproof.attacks import AttackResult, Schedule, attack
from roadproof.calibration import Calibrated, Method, calibrate, replays_needed
from roadproof.controllers import Controller
from roadproof.datatypes import Weather
from roadproof.drives import Drives, Scheme, Swerve, Trajectories, Window, record
from roadproof.errors import RoadproofError
from roadproof.evaluation import PAPER_WEATHERS, Evaluation, Selection, evaluate, select_by_driving
from roadproof.files import check_writable, read_json, write_atomically
from roadproof.objectives import LEFT_GROUP, RIGHT_GROUP, Group, parse_groups
from roadproof.patterns import Pattern
from roadproof.recordings import Push, RecordingSet
from roadproof.scenarios import Scenario
from roadproof.search_space import SearchSpace
from roadproof.simulators.protocol import Simulator

FORMAT = "roadproof-run"
FORMAT_VERSION = 1
STAGES = ("record", "calibrate", "attack", "select", "evaluate")

OnProgress: TypeAlias = Callable[[str, int, int, str], object]
"""Told of a stage's name, how much of it is done, of how much, and a word on it."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Budget:
    """How much is spent on one scenario.

    Args:
        deviations_m: how far recorded drives are pushed aside; a pair, right and left, for each; T = 1 without.
        scheme: whether those pairs are pushed right and left, or each drive to both sides at random.
        pooled: attack all drives together also where they were pushed right and left: the paper's Group-All.
        frames: kept of every recorded drive.
        calibration: how the drives are calibrated.
        schedule: steps of the search.
        restarts: starts of it, for each side; of those that came through the heats, where there are some.
        select: candidates driven once each, of which the strongest is kept; 0 believes the surrogate.
        weathers: of the evaluation; everything before is done in the first.
        runs: drives with traffic in each weather.
    """

    deviations_m: tuple[float, ...] = (1.5,)
    scheme: Scheme = Scheme.GROUP
    pooled: bool = False
    frames: int = 24
    calibration: Method = Method.TWO_PAINT
    schedule: Schedule = field(default_factory=Schedule)
    restarts: int = 4
    select: int = 6
    weathers: tuple[Weather, ...] = PAPER_WEATHERS
    runs: int = 10

    @property
    def trajectories(self) -> int:
        """T: a clean drive, and a pair for each deviation."""
        return 1 + 2 * len(self.deviations_m)


QUICK = Budget(frames=14, schedule=Schedule.in_heats(30), runs=0)
"""Minutes on a laptop: fewer frames and steps, driven alone."""

PAPER = Budget(calibration=Method.PUBLISHED)
"""As much as the paper spends: 61 calls to calibrate, 4 × 250 iterations, ten runs in traffic a weather."""

BUDGETS = {"quick": QUICK, "paper": PAPER}


@dataclass(frozen=True, slots=True)
class StageCost:
    """What a stage took.

    Args:
        seconds: wall time.
        simulator_calls: drives.
    """

    seconds: float = 0.0
    simulator_calls: int = 0


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class StressTest:
    """What came of the whole loop.

    Args:
        attack: the search; its numbers are the surrogate's.
        selection: the drives over its candidates; None where the surrogate was believed.
        evaluation: the drives over the chosen pattern; closed loop.
        cost: of each stage, since the run began.
    """

    attack: AttackResult
    selection: Selection | None
    evaluation: Evaluation
    cost: dict[str, StageCost]

    @property
    def pattern(self) -> Pattern:
        """The one that was chosen in the end."""
        return self.attack.pattern if self.selection is None else self.selection.pattern


def stress_test(
    simulator: Simulator,
    controller: Controller,
    scenario: Scenario,
    folder: Path,
    *,
    budget: Budget = QUICK,
    space: SearchSpace | None = None,
    seed: int = 0,
    controller_name: str = "",
    device: str = "cpu",
    on_progress: OnProgress = lambda _stage, _done, _total, _word: None,
) -> StressTest:
    """Find the paint that makes a controller leave its lane in one scenario, and say how bad it is.

    Args:
        simulator: an open simulator.
        controller: what is tested.
        scenario: where.
        folder: keeps every stage; the same call goes on from it.
        budget: how much is spent.
        space: which patterns; five rectangles of the published family by default.
        seed: of recording, search and traffic.
        controller_name: what reports call it.
        device: where to search.
        on_progress: told of every step of every stage.

    Raises:
        RoadproofError: the folder holds a run of something else, or a stage refuses; the message says why.
    """
    run = _Run(
        simulator=simulator,
        controller=controller,
        scenario=scenario,
        folder=folder,
        budget=budget,
        space=space or SearchSpace(figures=5),
        seed=seed,
        controller_name=controller_name,
        device=device,
        on_progress=on_progress,
    )
    check_writable(folder)
    ledger = _Ledger(run)
    with ledger.stage("record"):
        drives = _record(run)
        ledger.calls("record", drives.calls)
    with ledger.stage("calibrate"):
        calibrated = _calibrate(run, drives)
        ledger.calls("calibrate", calibrated.report.calls - drives.calls)
    with ledger.stage("attack"):
        found = _attack(run, calibrated.recordings)
    selection = None
    if budget.select:
        with ledger.stage("select"):
            selection = _select(run, found)
            ledger.calls("select", selection.simulator_calls)
    with ledger.stage("evaluate"):
        evaluation = _evaluate(run, found.pattern if selection is None else selection.pattern)
        ledger.calls("evaluate", evaluation.simulator_calls)
    return StressTest(attack=found, selection=selection, evaluation=evaluation, cost=ledger.cost)


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class _Run:
    """The arguments of `stress_test`."""

    simulator: Simulator
    controller: Controller
    scenario: Scenario
    folder: Path
    budget: Budget
    space: SearchSpace
    seed: int
    controller_name: str
    device: str
    on_progress: OnProgress

    @property
    def identity(self) -> str:
        """What tells this run from another."""
        told = (asdict(self.scenario), asdict(self.budget), asdict(self.space), self.seed, self.controller_name)
        return json.dumps(told, default=str)


def _record(run: _Run) -> Drives:
    budget = run.budget
    swerve = Swerve(budget.deviations_m) if budget.deviations_m else Swerve()
    wanted = Trajectories(count=budget.trajectories, scheme=budget.scheme, perturbation=swerve)
    return record(
        run.simulator,
        run.controller,
        run.scenario,
        weather=run.budget.weathers[0],
        trajectories=wanted,
        window=Window(frames=run.budget.frames),
        seed=run.seed,
        driver_name=run.controller_name,
        folder=run.folder / "record",
        on_drive=lambda done: run.on_progress("Recording", done, wanted.count, ""),
    )


def _calibrate(run: _Run, drives: Drives) -> Calibrated:
    done = Calibrated.load(run.folder)
    if done is not None:
        return done
    total = replays_needed(drives, run.budget.calibration)
    result = calibrate(
        run.simulator,
        drives,
        run.budget.calibration,
        folder=run.folder / "calibration",
        on_call=lambda made: run.on_progress("Calibrating", made, total, ""),
    )
    result.save(run.folder)
    return result


def _attack(run: _Run, recordings: RecordingSet) -> AttackResult:
    place, steps = run.folder / "attack", run.budget.schedule.steps
    if (place / "result.json").exists():
        return AttackResult.load(place)
    result = attack(
        recordings,
        run.controller,
        run.space,
        groups=parse_groups("all", recordings) if run.budget.pooled else groups_of(recordings),
        schedule=run.budget.schedule,
        restarts=run.budget.restarts,
        seed=run.seed,
        device=run.device,
        checkpoint=place / "search.safetensors",
        on_step=lambda step, best: run.on_progress("Searching", step, steps, f"shift {best:.3f}"),
    )
    result.save(place)
    (place / "search.safetensors").unlink(missing_ok=True)
    return result


def _select(run: _Run, found: AttackResult) -> Selection:
    total = 1 + min(run.budget.select, len(found.candidates))
    return select_by_driving(
        run.simulator,
        run.controller,
        run.scenario,
        found.candidates,
        best=run.budget.select,
        weather=run.budget.weathers[0],
        folder=run.folder / "selection",
        on_drive=lambda done, best: run.on_progress("Choosing by driving", done, total, f"{best:.2f} m"),
    )


def _evaluate(run: _Run, pattern: Pattern) -> Evaluation:
    return evaluate(
        run.simulator,
        run.controller,
        run.scenario,
        pattern,
        folder=run.folder / "evaluation",
        driver_name=run.controller_name,
        weathers=run.budget.weathers,
        runs=run.budget.runs,
        seed=run.seed,
        on_drive=lambda done, total: run.on_progress("Evaluating", done, total, ""),
    )


def groups_of(recordings: RecordingSet) -> tuple[Group, ...]:
    """The paper's two groups where drives were pushed to both sides, else all drives pooled."""
    if {Push.LEFT, Push.RIGHT} <= {recording.push for recording in recordings.recordings}:
        return (RIGHT_GROUP, LEFT_GROUP)
    return parse_groups("all", recordings)


class _Ledger:
    """What the stages of a run took, kept in its folder.

    Args:
        run: whose.

    Raises:
        RoadproofError: the folder is another run's.
    """

    def __init__(self, run: _Run) -> None:
        self._path, self._identity = run.folder / "run.json", run.identity
        self.cost = {stage: StageCost() for stage in STAGES}
        if not self._path.exists():
            self._write()
            return
        stored = read_json(self._path, FORMAT, FORMAT_VERSION, RoadproofError)
        if stored.get("identity") != self._identity:
            raise RoadproofError(f"{run.folder} holds a run with other settings; choose another folder, or remove it")
        self.cost |= {stage: StageCost(**cost) for stage, cost in stored.get("cost", {}).items()}

    @contextmanager
    def stage(self, name: str) -> Generator[None]:
        """Time a stage; one that is gone on with adds to what it took before."""
        began = time.perf_counter()
        try:
            yield
        finally:
            before = self.cost[name]
            self.cost[name] = replace(before, seconds=before.seconds + time.perf_counter() - began)
            self._write()

    def calls(self, name: str, simulator_calls: int) -> None:
        """Say how many drives a stage took, from its beginning."""
        self.cost[name] = replace(self.cost[name], simulator_calls=simulator_calls)

    def _write(self) -> None:
        cost = {stage: asdict(cost) for stage, cost in self.cost.items()}
        content = {"format": FORMAT, "version": FORMAT_VERSION, "identity": self._identity, "cost": cost}
        write_atomically(self._path, lambda part: part.write_text(json.dumps(content, indent=1) + "\n"))
