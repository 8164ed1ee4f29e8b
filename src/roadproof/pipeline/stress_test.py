"""The whole loop for one scenario: record, calibrate, attack, verify by driving, evaluate.

    RUN/record/        drives past the bare canvas (`drives.record`)
    RUN/calibration/   replays over painted targets, and how good they are (`calibration.calibrate`)
    RUN/recordings/    the drives, calibrated (`recordings`)
    RUN/attack/        what the search found (`attacks.attack`)
    RUN/selection/     which of it was strongest when driven (`pipeline.selection`)
    RUN/prediction.npz the chosen pattern's predicted path beside the driven one (`pipeline.prediction`)
    RUN/round-1/       searching on where the attacked car went (`pipeline.rerecording`), where rounds are asked for
    RUN/cheapest/      the least paint for a deviation and the drive over it, where one is asked for
    RUN/limits/        what each limit on paint costs, where that is asked for (`pipeline.limit_costs`)
    RUN/pattern.json   the pattern that was chosen in the end
    RUN/evaluation/    how bad that is, by weather, alone and in traffic (`driving.evaluate`), with the film of two
                       drives (`pipeline.film`) and composites beside renders (`pipeline.fidelity`)
    RUN/run.json       what the stages took (`pipeline.stage_costs`)

Every stage goes on from what its folder holds. A search in expectation over several weathers has the drives of each
weather but the first in RUN/WEATHER/, as those of the first are in RUN.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

from roadproof.attacks import AttackResult, Cheapest, PathDeviation, SpeedChange
from roadproof.attacks.cheapest import check_wanted
from roadproof.attacks.speed import require_pedals
from roadproof.calibration import replays_needed
from roadproof.controllers import Controller
from roadproof.controllers.checks import require_usable
from roadproof.driving.evaluation import Evaluation
from roadproof.errors import RoadproofError
from roadproof.io.files import AnyPath, as_path
from roadproof.io.html import html_of, table
from roadproof.io.locks import working_in
from roadproof.limits import check_seed
from roadproof.patterns import Pattern, save_pattern
from roadproof.pipeline.budget import QUICK, Budget
from roadproof.pipeline.fidelity import FIDELITY, Fidelity
from roadproof.pipeline.limit_costs import LIMIT_COSTS, LimitCosts, relaxed_limits
from roadproof.pipeline.prediction import Prediction
from roadproof.pipeline.rerecording import Rounds, best_of
from roadproof.pipeline.selection import Selection
from roadproof.pipeline.stage_costs import Ledger, StageCost, read_cost
from roadproof.pipeline.stages import CHEAPEST, OnProgress, Stages, check_street
from roadproof.processes import here_or_beside, require_opened, require_picklable
from roadproof.recordings import pooled
from roadproof.scenarios import Scenario
from roadproof.search_space import SearchSpace
from roadproof.simulators.protocol import Simulator, SimulatorFactory

STAGES = ("record", "calibrate", "attack", "select", "rounds", "cheapest", "limits", "predict", "evaluate", "film")


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class StressTest:
    """The outcome of a whole stress test.

    Args:
        attack: result of the search; its numbers are predictions of the surrogate.
        selection: outcome of the drives over its candidates; None if no candidate was driven over.
        rounds: outcome of the re-recording rounds; None if none was asked for.
        prediction: where the recorded world says the chosen pattern takes the car, beside where it went; None where
            the search did not drive there, or nothing was driven to compare.
        evaluation: evaluation of the chosen pattern by drives over it, closed loop.
        fidelity: composited frames of the clean drive beside rendered ones; None without `film`, or where no frame
            shows any paint.
        cost: cost of each stage since the run began, by its name.
        cheapest: the least paint for the deviation that was asked for, and the drive over it; None where none was
            asked for, or nothing found reaches it.
        limit_costs: what each limit on paint costs; None where nobody asked.
    """

    attack: AttackResult
    selection: Selection | None
    rounds: Rounds | None
    prediction: Prediction | None
    evaluation: Evaluation
    fidelity: Fidelity | None
    cost: dict[str, StageCost]
    cheapest: tuple[Cheapest, Selection] | None = None
    limit_costs: LimitCosts | None = None

    @property
    def pattern(self) -> Pattern:
        """The pattern that was chosen in the end."""
        return _chosen(self.attack, self.selection, self.rounds)

    def _repr_html_(self) -> str:
        """How a notebook shows it: the search, its prediction beside the drive, and the drives that judge it."""
        told = self.prediction
        rows = [] if told is None else [(f"{told.predicted_m:.2f}", f"{told.driven_m:.2f}")]
        search, judged = map(html_of, (self.attack, self.evaluation))
        return search + table(("predicted m", "driven m, to verify"), rows) + judged

    @staticmethod
    def load(folder: AnyPath) -> StressTest:
        """Read the folder of a finished stress test, which keeps all of it.

        Rounds are there as far as they came; why there are fewer than asked for is not kept.

        Raises:
            RoadproofError: a stage is missing or damaged; the message names it.
        """
        folder = as_path(folder)
        place, less = folder / "selection", folder / CHEAPEST
        selection = Selection.load(place) if place.is_dir() else None
        prediction, fidelity = folder / "prediction.npz", folder / "evaluation" / FIDELITY
        costs = folder / LIMIT_COSTS
        return StressTest(
            attack=AttackResult.load(folder / "attack"),
            selection=selection,
            rounds=None if selection is None else Rounds.kept(folder, selection),
            prediction=Prediction.load(prediction) if prediction.exists() else None,
            evaluation=Evaluation.load(folder / "evaluation"),
            fidelity=Fidelity.load(fidelity) if fidelity.exists() else None,
            cost=read_cost(folder),
            cheapest=(Cheapest.load(less), Selection.load(less / "selection"))
            if (less / "cheapest.json").exists()
            else None,
            limit_costs=LimitCosts.load(costs) if costs.exists() else None,
        )


def stress_test(
    simulator: Simulator,
    controller: Controller,
    scenario: Scenario,
    folder: AnyPath,
    *,
    budget: Budget = QUICK,
    space: SearchSpace | None = None,
    seed: int = 0,
    controller_name: str = "",
    device: str = "cpu",
    factory: SimulatorFactory | None = None,
    processes: int = 1,
    film: bool = True,
    cheapest_m: float | None = None,
    limit_costs: bool = False,
    on_progress: OnProgress = lambda _stage, _done, _total, _word: None,
) -> StressTest:
    """Find the paint that makes a controller leave its lane in one scenario, and say how bad it is.

    Args:
        simulator: an open simulator.
        controller: the controller that is tested; it computes on `device`.
        scenario: the scenario that is driven, with the canvas that is painted.
        folder: the run folder, which keeps every stage; the same call goes on from it.
        budget: how much is spent, and on which search.
        space: the patterns that are searched; five rectangles of the published family by default.
        seed: the seed of recording, search and traffic.
        controller_name: name of the controller in reports.
        device: torch device on which the search computes, "cpu" or "cuda:0".
        factory: opens one more simulator of the same kind; needed for several processes.
        processes: how many drives are made at once; the controller must be picklable for several.
        film: whether to film the two drives that the report shows, and to render the recorded frames over the paint,
            which takes three drives more.
        cheapest_m: the deviation, in metres, for which the least paint is looked for and driven over once; None for
            no such search.
        limit_costs: whether to search without each limit on paint besides, and without any, and to drive once over what
            each search found.
        on_progress: called after every step of every stage with the stage, steps done, all steps, and a word.

    Raises:
        RoadproofError: the folder holds another run, another process works in it, or a stage refuses; it says why.
        PatternError: the limits on paint leave no pattern, or the search method cannot search the patterns.
        ControllerError: the controller raises, answers wrongly or gives no gradient; nothing is driven then.
    """
    folder = as_path(folder)
    check_seed(seed, "seed", RoadproofError)
    require_opened(processes, factory)
    stages = Stages(
        simulator=simulator,
        controller=controller,
        scenario=scenario,
        folder=folder,
        budget=budget,
        space=space or SearchSpace(figures=5),
        seed=seed,
        controller_name=controller_name,
        device=device,
        pool=here_or_beside(simulator, factory, processes),
        on_progress=on_progress,
    )
    check_asked(budget, stages.space, cheapest_m=cheapest_m, limit_costs=limit_costs)
    check_street(simulator, scenario, stages.space, budget)
    view = simulator.input
    if processes > 1:
        require_picklable(controller)
    by_gradient = budget.method.by_gradient or cheapest_m is not None
    require_usable(controller, size=(view.height_px, view.width_px), device=device, gradients=by_gradient)
    if isinstance(budget.objective, SpeedChange):
        require_pedals(controller)
    with working_in(folder), stages.pool:
        return _all_of(stages, film=film, cheapest_m=cheapest_m, limit_costs=limit_costs)


def check_asked(budget: Budget, space: SearchSpace, *, cheapest_m: float | None, limit_costs: bool) -> None:
    """Check that a budget's search can give what is asked for, which needs no simulator.

    Raises:
        PatternError: the method cannot search the patterns, or costs of limits are asked for and there are none.
        RoadproofError: the least paint, or costs of limits, are asked for without a path deviation.
    """
    budget.method.check_space(space)
    if cheapest_m is not None:
        check_wanted(cheapest_m)
        if not isinstance(budget.objective, PathDeviation):
            raise RoadproofError("the cheapest pattern is looked for in the recorded world; search a path deviation")
    if limit_costs:
        relaxed_limits(space, budget.objective)


def _reset(scenario: Scenario, simulator: Simulator, _: None) -> None:
    """Let a simulator build what it drives in."""
    simulator.reset(scenario)


def _all_of(run: Stages, *, film: bool, cheapest_m: float | None, limit_costs: bool) -> StressTest:
    """Run all stages, one after another."""
    budget, on_progress = run.budget, run.on_progress
    ledger = Ledger(run.folder, run.made_of, STAGES)
    if not (run.folder / "recordings").exists():
        # All of them together, while this one reads; it draws nothing itself.
        run.pool.begin(partial(_reset, run.scenario))

    def note_progress(stage: str, done: int, total: int, word: str) -> None:
        ledger.step()
        on_progress(stage, done, total, word)

    run = replace(run, on_progress=note_progress)
    with ledger.stage("record"):
        drives = [run.record(number) for number in range(len(budget.recorded_in))]
        ledger.calls("record", sum(each.calls for each in drives))
    with ledger.stage("calibrate"):
        calibrated = [run.calibrate(number, each) for number, each in enumerate(drives)]
        ledger.calls("calibrate", sum(replays_needed(len(each.drives), budget.calibration) for each in drives))
        recordings = pooled({str(d.settings.weather): c for d, c in zip(drives, calibrated, strict=True)})
    with ledger.stage("attack"):
        found = run.attack(recordings)
    selection, rounds = None, None
    if budget.select:
        with ledger.stage("select"):
            selection = run.select(found, drives[0])
            ledger.calls("select", selection.simulator_calls)
    if selection is not None and budget.rounds:
        with ledger.stage("rounds"):
            rounds = run.search_on(drives[0], recordings, found, selection)
            ledger.calls("rounds", rounds.simulator_calls)
    pattern = _chosen(found, selection, rounds)
    save_pattern(pattern, run.folder / "pattern.json")
    less = None
    if cheapest_m is not None:
        with ledger.stage("cheapest"):
            less = run.cheapest(recordings, found, cheapest_m, drives[0])
            ledger.calls("cheapest", 0 if less is None else less[1].simulator_calls)
    costs = None
    if limit_costs:
        with ledger.stage("limits"):
            costs, calls = run.limit_costs(recordings, found, drives[0])
            ledger.calls("limits", calls)
    with ledger.stage("predict"):
        prediction = run.predict(recordings, pattern, selection, rounds)
    with ledger.stage("evaluate"):
        evaluation = run.evaluate(pattern)
        ledger.calls("evaluate", evaluation.simulator_calls)
    fidelity = None
    if film:
        with ledger.stage("film"):
            fidelity = run.film(evaluation, pattern, drives[0], calibrated[0])
            ledger.calls("film", 2 if fidelity is None else 3)
    return StressTest(
        attack=found,
        selection=selection,
        rounds=rounds,
        prediction=prediction,
        evaluation=evaluation,
        fidelity=fidelity,
        cost=ledger.cost,
        cheapest=less,
        limit_costs=costs,
    )


def _chosen(found: AttackResult, selection: Selection | None, rounds: Rounds | None) -> Pattern:
    chosen = best_of(selection, rounds)
    return found.pattern if chosen is None else chosen.pattern
