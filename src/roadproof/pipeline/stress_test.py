"""The whole loop for one scenario: record, calibrate, attack, verify by driving, evaluate.

    RUN/record/        drives past the bare canvas (`drives.record`)
    RUN/calibration/   replays over painted targets, and how good they are (`calibration.calibrate`)
    RUN/recordings/    the drives, calibrated (`recordings`)
    RUN/attack/        what the search found (`attacks.attack`)
    RUN/selection/     which of it was strongest when driven (`pipeline.selection`)
    RUN/prediction.npz the chosen pattern's predicted path beside the driven one (`pipeline.prediction`)
    RUN/round-1/       searching on where the attacked car went (`rounds`), where rounds are asked for
    RUN/pattern.json   the pattern that was chosen in the end
    RUN/evaluation/    how bad that is, by weather, alone and in traffic (`driving.evaluate`)
    RUN/run.json       what the stages took (`ledger`)

Every stage goes on from what its folder holds. A search in expectation over several weathers has the drives of each
weather but the first in RUN/WEATHER/, as those of the first are in RUN.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeAlias

from roadproof.attacks import AttackResult, kept_attack
from roadproof.attacks.groups import Group, parse_groups
from roadproof.calibration import Calibrated, calibrate, replays_needed
from roadproof.controllers import Controller
from roadproof.controllers.checks import require_usable
from roadproof.controllers.identity import identity_of
from roadproof.drives import Drives, record
from roadproof.driving.drive_store import load_episodes
from roadproof.driving.evaluate import Opening, evaluate
from roadproof.driving.evaluation import Evaluation
from roadproof.errors import RoadproofError
from roadproof.io.identity import ANSWERS
from roadproof.io.locks import working_in
from roadproof.patterns import Pattern, save_pattern
from roadproof.pipeline.budget import QUICK, Budget
from roadproof.pipeline.prediction import Prediction, predict
from roadproof.pipeline.rerecording import Rounds, search_on
from roadproof.pipeline.selection import Selection, select_by_driving
from roadproof.pipeline.stage_costs import Ledger, StageCost
from roadproof.processes import require_picklable
from roadproof.recordings import Push, RecordingSet, pooled
from roadproof.scenarios import Scenario
from roadproof.search_space import SearchSpace
from roadproof.simulators.protocol import Simulator

STAGES = ("record", "calibrate", "attack", "select", "rounds", "evaluate")

OnProgress: TypeAlias = Callable[[str, int, int, str], object]
"""Told of a stage's name, how much of it is done, of how much, and a word on it."""


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class StressTest:
    """What came of the whole loop.

    Args:
        attack: the search; its numbers are the surrogate's.
        selection: the drives over its candidates; None where the surrogate was believed.
        rounds: what came of searching on; None where that was not asked for.
        prediction: where the recorded world says the chosen pattern takes the car, beside where it went; None where
            the search did not drive there, or nothing was driven to compare.
        evaluation: the drives over the chosen pattern; closed loop.
        cost: of each stage, since the run began.
    """

    attack: AttackResult
    selection: Selection | None
    rounds: Rounds | None
    prediction: Prediction | None
    evaluation: Evaluation
    cost: dict[str, StageCost]

    @property
    def pattern(self) -> Pattern:
        """The one that was chosen in the end."""
        return _chosen(self.attack, self.selection, self.rounds)


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
    another: Opening | None = None,
    processes: int = 1,
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
        another: opens one more simulator of the same kind; needed for several processes.
        processes: drives of the evaluation made at once; the controller must be picklable where there are several.
        on_progress: told of every step of every stage.

    Raises:
        RoadproofError: the folder holds a run of something else, another process works in it, or a stage refuses; the
            message says why.
        ControllerError: the controller raises, answers wrongly or gives no gradient; nothing is driven then.
    """
    if processes < 1 or (processes > 1 and another is None):
        raise RoadproofError(
            f"{processes} processes; expected 1, or more with a function that opens another simulator for each"
        )
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
    view = simulator.input
    if processes > 1:
        require_picklable(controller)
    require_usable(controller, size=(view.height_px, view.width_px), device=device, gradients=budget.method.by_gradient)
    with working_in(folder):
        return _stages(run, another if another and processes > 1 else simulator, processes)


def _stages(run: _Run, simulator: Opening | Simulator, processes: int) -> StressTest:
    """All of them, one after another; the simulator, or what opens one for each process, is the evaluation's."""
    ledger = Ledger(run.folder, run.made_of, STAGES)
    on_progress = run.on_progress

    def tell(stage: str, done: int, total: int, word: str) -> None:
        ledger.step()
        on_progress(stage, done, total, word)

    run = replace(run, on_progress=tell)
    with ledger.stage("record"):
        drives = [_record(run, number) for number in range(len(run.budget.recorded_in))]
        ledger.calls("record", sum(each.calls for each in drives))
    with ledger.stage("calibrate"):
        calibrated = [_calibrate(run, number, each) for number, each in enumerate(drives)]
        ledger.calls("calibrate", sum(replays_needed(each, run.budget.calibration) for each in drives))
        recordings = pooled(
            {str(each.settings.weather): c.recordings for each, c in zip(drives, calibrated, strict=True)}
        )
    groups = groups_of(recordings, run.budget)
    with ledger.stage("attack"):
        found = _attack(run, recordings, groups)
    selection, rounds = None, None
    if run.budget.select:
        with ledger.stage("select"):
            selection = _select(run, found, drives[0])
            ledger.calls("select", selection.simulator_calls)
    if selection is not None and run.budget.rounds:
        with ledger.stage("rounds"):
            rounds = _search_on(run, drives[0], recordings, groups, found, selection)
            ledger.calls("rounds", rounds.simulator_calls)
    pattern = _chosen(found, selection, rounds)
    save_pattern(pattern, run.folder / "pattern.json")
    prediction = _predict(run, recordings, pattern, selection, rounds)
    with ledger.stage("evaluate"):
        evaluation = _evaluate(run, pattern, simulator, processes)
        ledger.calls("evaluate", evaluation.simulator_calls)
    return StressTest(
        attack=found,
        selection=selection,
        rounds=rounds,
        prediction=prediction,
        evaluation=evaluation,
        cost=ledger.cost,
    )


def _chosen(found: AttackResult, selection: Selection | None, rounds: Rounds | None) -> Pattern:
    chosen = selection if rounds is None else rounds.best
    return found.pattern if chosen is None else chosen.pattern


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
    def made_of(self) -> dict[str, object]:
        """What tells this run from another."""
        size = self.simulator.input.height_px, self.simulator.input.width_px
        return {
            "scenario": self.scenario,
            "budget": repr(self.budget),
            "space": self.space,
            "seed": self.seed,
            "controller": self.controller_name,
            ANSWERS: identity_of(self.controller, size),
            "paint": self.simulator.paint,
        }

    def folder_of(self, number: int) -> Path:
        """Where the drives of a weather are."""
        return self.folder / self.budget.recorded_in[number] if number else self.folder


def _record(run: _Run, number: int) -> Drives:
    budget, wanted = run.budget, run.budget.trajectories
    total = wanted.count * len(budget.recorded_in)
    return record(
        run.simulator,
        run.controller,
        run.scenario,
        weather=budget.recorded_in[number],
        trajectories=wanted,
        window=budget.window,
        seed=run.seed,
        driver_name=run.controller_name,
        folder=run.folder_of(number) / "record",
        on_drive=lambda done: run.on_progress("Recording", number * wanted.count + done, total, ""),
    )


def _calibrate(run: _Run, number: int, drives: Drives) -> Calibrated:
    place = run.folder_of(number)
    done = Calibrated.kept(place, drives, run.budget.calibration)
    if done is not None:
        return done
    each = replays_needed(drives, run.budget.calibration)
    total = each * len(run.budget.recorded_in)
    result = calibrate(
        run.simulator,
        drives,
        run.budget.calibration,
        folder=place / "calibration",
        on_call=lambda made: run.on_progress("Calibrating", number * each + made, total, ""),
    )
    result.save(place)
    return result


def _attack(run: _Run, recordings: RecordingSet, groups: tuple[Group, ...]) -> AttackResult:
    budget = run.budget
    steps = budget.method.steps(budget.objective)
    return kept_attack(
        run.folder / "attack",
        recordings,
        run.controller,
        run.space,
        objective=budget.objective,
        method=budget.method,
        groups=groups,
        seed=run.seed,
        device=run.device,
        on_step=lambda step, best: run.on_progress("Searching", step, steps, f"{best:.2f}"),
    )


def _search_on(
    run: _Run,
    drives: Drives,
    recordings: RecordingSet,
    groups: tuple[Group, ...],
    found: AttackResult,
    selection: Selection,
) -> Rounds:
    return search_on(
        run.simulator,
        run.controller,
        drives,
        recordings,
        groups,
        found,
        selection,
        objective=run.budget.objective,
        rounds=run.budget.rounds,
        best=run.budget.select,
        method=run.budget.calibration,
        folder=run.folder,
        device=run.device,
        on_step=lambda done, total, word: run.on_progress("Searching on", done, total, word),
    )


def _select(run: _Run, found: AttackResult, drives: Drives) -> Selection:
    total = 1 + min(run.budget.select, len(found.candidates))
    return select_by_driving(
        run.simulator,
        run.controller,
        run.scenario,
        found.candidates,
        best=run.budget.select,
        weather=run.budget.recorded_in[0],
        folder=run.folder / "selection",
        # The simulator repeats itself, so the recorded clean drive is the one to compare with.
        clean=drives.drives[0].episode,
        on_drive=lambda done, best: run.on_progress("Verifying by driving", done, total, f"{best:.2f} m"),
    )


def _predict(
    run: _Run, recordings: RecordingSet, pattern: Pattern, selection: Selection | None, rounds: Rounds | None
) -> Prediction | None:
    """The predicted path of the chosen pattern beside the one driven over it; kept with the run."""
    chosen = selection if rounds is None else rounds.best
    if chosen is None or not run.budget.is_predicted:
        return None
    path = run.folder / "prediction.npz"
    if path.exists():
        return Prediction.load(path)
    number = 0 if rounds is None else next((k for k, each in enumerate(rounds.done, 1) if each.selection is chosen), 0)
    place = run.folder / f"round-{number}" if number else run.folder
    trial = chosen.driven[chosen.chosen].trial
    clean, painted = load_episodes(place / "selection", (trial.clean, trial.painted))
    prediction = predict(recordings, run.controller, pattern, clean, painted, device=run.device)
    prediction.save(path)
    return prediction


def _evaluate(run: _Run, pattern: Pattern, simulator: Opening | Simulator, processes: int) -> Evaluation:
    return evaluate(
        simulator,
        run.controller,
        run.scenario,
        pattern,
        folder=run.folder / "evaluation",
        driver_name=run.controller_name,
        weathers=run.budget.weathers,
        starts=run.budget.starts,
        start_range=run.budget.start_range,
        runs=run.budget.runs,
        seed=run.seed,
        processes=processes,
        on_drive=lambda done, total: run.on_progress("Evaluating", done, total, ""),
    )


def groups_of(recordings: RecordingSet, budget: Budget) -> tuple[Group, ...]:
    """The method's own groups where drives were pushed to both sides, else all drives pooled."""
    sides = {Push.LEFT, Push.RIGHT} <= {recording.push for recording in recordings.recordings}
    return budget.method.groups(recordings) if sides and not budget.pooled else parse_groups("all", recordings)
