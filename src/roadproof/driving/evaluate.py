"""Driving over a pattern in many conditions, and over the bare road in the same ones.

evaluation = evaluate(TownSimulator, controller, scenario, pattern, folder=Path("out/evaluation"))
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack
from dataclasses import replace
from itertools import cycle

from roadproof.datatypes import PAPER_WEATHERS, Weather
from roadproof.driving.deviation import canvas_missed
from roadproof.driving.drive_store import CLEAN, AnyDriver, DriveConditions, Episodes, driver_in_words, make_missing
from roadproof.driving.evaluation import ATTACK, Evaluation
from roadproof.driving.starts import NOMINAL, USUAL_STARTS, StartOffset, StartRange, require_on_road
from roadproof.driving.trial import Trial
from roadproof.errors import EpisodeError
from roadproof.io.files import AnyPath, as_path
from roadproof.io.tables import each_once
from roadproof.limits import check_seed, is_whole
from roadproof.patterns import Pattern, raster, require_visible
from roadproof.processes import Pool, here_or_beside, require_picklable
from roadproof.scenarios import Scenario
from roadproof.search_space import SearchSpace
from roadproof.simulators.protocol import PatternImage, Simulator, SimulatorFactory, begun_in, check_image


def evaluate(
    simulator: SimulatorFactory | Simulator,
    driver: AnyDriver,
    scenario: Scenario,
    pattern: Pattern | PatternImage,
    *,
    folder: AnyPath,
    driver_name: str = "",
    weathers: Sequence[Weather] = PAPER_WEATHERS,
    starts: int = 5,
    start_range: StartRange = USUAL_STARTS,
    runs: int = 10,
    cars: int = 20,
    pedestrians: int = 20,
    seed: int = 0,
    baseline: Sequence[Pattern] = (),
    processes: int = 1,
    pool: Pool[Simulator] | None = None,
    on_drive: Callable[[int, int], object] = lambda _done, _total: None,
) -> Evaluation:
    """Drive a scenario with and without a pattern, from several starts alone, and with cars and people.

    A pattern is chosen from the scenario's own start; it is judged from others, so that what chose it never reports it.

    Args:
        simulator: an open one, or a function that makes one, such as `TownSimulator`; needed for several processes.
            What a recorded world answers is predicted, and the evaluation says so.
        driver: a controller, or a function as `training.expert.expert`; for several processes it must be picklable.
        scenario: scenario that is driven.
        pattern: pattern that is painted, or a picture of the canvas.
        folder: folder that keeps every drive, so that an interrupted evaluation goes on from it.
        driver_name: name of the driver in reports; by default its type or name.
        weathers: weathers of the drives; the paper's four by default.
        starts: number of drives alone per weather, each from a drawn start; 0 for one from the scenario's own start.
        start_range: range of the starts; by default 0.3 m and 0.05 rad to either side and up to 2 m/s faster.
        runs: number of drives with traffic per weather, each with a seed of its own, from the starts in turn.
        cars: number of other cars in drives with traffic.
        pedestrians: number of pedestrians in drives with traffic.
        seed: seed of the first run with traffic, from which the others count on, and of the starts.
        baseline: other patterns to compare with, driven alone from the starts in turn, and in turn with traffic.
        processes: number of drives made at once, each in a process with a simulator of its own.
        pool: processes that are open already and drive instead.
        on_drive: called after each drive with the number of drives done and of all drives.

    Raises:
        EpisodeError: there is nothing to drive, the starts reach off the road, several processes are asked for with an
            open simulator, a drive in the folder is damaged, or no drive alone without paint comes to the canvas.
        ControllerError: the driver raises, answers wrongly, or cannot travel to several processes.
        SimulatorError: the simulator refuses the conditions, or a process died.
        OutputError: the folder cannot be written.
    """
    folder = as_path(folder)
    check_seed(seed, "seed", EpisodeError)
    _check_numbers(weathers, starts, runs, cars, pedestrians, processes)
    # A range of nothing draws one start again and again.
    begins = tuple(dict.fromkeys(start_range.draw(starts, seed))) if starts else (NOMINAL,)
    if processes > 1 and not callable(simulator):
        raise EpisodeError(f"{processes} processes need a simulator each; give a function that makes one")
    if processes > 1:
        require_picklable(driver)
    paints = {ATTACK: _raster(pattern)} | {f"random-{k + 1}": raster(each) for k, each in enumerate(baseline)}
    started = time.perf_counter()
    with ExitStack() as stack:
        world = stack.enter_context(simulator()) if callable(simulator) else simulator
        scenario = begun_in(world, scenario)
        if starts:
            require_on_road(start_range, scenario, world)
        episodes = Episodes.of(world, driver, scenario, paints, folder)
        planned = _planned(list(paints), weathers, begins, runs, cars, pedestrians, seed)
        drives = list(dict.fromkeys(drive for pair in planned for drive in pair))
        if pool is None:
            pool = stack.enter_context(here_or_beside(world, simulator if callable(simulator) else None, processes))
        make_missing(pool, episodes, drives, lambda done: on_drive(done, len(drives)))
    trials = _compared(episodes, planned)
    evaluation = Evaluation(
        scenario=scenario,
        controller=driver_name or driver_in_words(driver),
        weathers=tuple(weathers),
        runs=runs,
        cars=cars,
        pedestrians=pedestrians,
        seed=seed,
        trials=trials,
        left_out=len(planned) - len(trials),
        simulator_calls=0 if world.paint.predicted else len(drives),
        seconds=time.perf_counter() - started,
        paint=world.paint,
        starts=len(begins) if starts else 0,
        start_range=start_range,
    )
    evaluation.save(folder, paints[ATTACK])
    return evaluation


def _check_numbers(
    weathers: Sequence[Weather], starts: int, runs: int, cars: int, pedestrians: int, processes: int
) -> None:
    numbers = (starts, runs, cars, pedestrians, processes)
    if not weathers or not all(map(is_whole, numbers)) or min(numbers) < 0 or processes < 1:
        raise EpisodeError(
            f"{len(weathers)} weathers, {starts} starts, {runs} runs, {cars} cars, {pedestrians} pedestrians, "
            f"{processes} processes; expected whole numbers, at least one weather and process, and nothing below 0"
        )
    each_once(weathers, "weathers", EpisodeError)
    if runs and not cars + pedestrians:
        raise EpisodeError(f"{runs} runs with traffic but no cars and no pedestrians; ask for some, or for 0 runs")


def _compared(episodes: Episodes, planned: Sequence[tuple[DriveConditions, DriveConditions]]) -> tuple[Trial, ...]:
    """The trials of all pairs of drives of which the one without paint came to the canvas."""
    seen = {clean for clean in dict.fromkeys(clean for clean, _ in planned) if episodes.sees_canvas(clean)}
    trials = tuple(episodes.trial(clean, painted) for clean, painted in planned if clean in seen)
    if all(trial.traffic for trial in trials):
        raise canvas_missed(episodes.scenario.name)
    return trials


def random_patterns(pattern: Pattern, count: int, *, seed: int = 0) -> tuple[Pattern, ...]:
    """Patterns with as many figures as another, drawn as the paper's searches start: what chance alone does."""
    drawn = SearchSpace(figures=len(pattern.shapes)).drawn(count, seed)
    return tuple(drawn[k] for k in range(count))


def _raster(pattern: Pattern | PatternImage) -> PatternImage:
    paint = raster(pattern) if isinstance(pattern, Pattern) else pattern
    check_image(paint)
    require_visible(paint, "the pattern")
    return paint


def _planned(
    paints: Iterable[str],
    weathers: Sequence[Weather],
    starts: Sequence[StartOffset],
    runs: int,
    cars: int,
    pedestrians: int,
    seed: int,
) -> list[tuple[DriveConditions, DriveConditions]]:
    """Pairs of every clean drive with each painted drive that is compared with it."""
    random = [name for name in paints if name != ATTACK]
    pairs: list[tuple[DriveConditions, DriveConditions]] = []
    for weather in weathers:
        alone = [DriveConditions(paint=CLEAN, weather=weather, seed=seed, start=start) for start in starts]
        pairs += [(clean, replace(clean, paint=ATTACK)) for clean in alone]
        pairs += [(clean, replace(clean, paint=paint)) for clean, paint in zip(cycle(alone), random, strict=False)]
        for run in range(runs):
            painted = [ATTACK, *random[run % len(random) : run % len(random) + 1]] if random else [ATTACK]
            clean = replace(alone[run % len(alone)], cars=cars, pedestrians=pedestrians, seed=seed + run)
            pairs += [(clean, replace(clean, paint=paint)) for paint in painted]
    return pairs
