"""Driving over a pattern in many conditions, and over the bare road in the same ones.

    evaluation = evaluate(TownSimulator, controller, scenario, pattern, folder=Path("out/evaluation"))

Every drive is kept under a name that ends in a hash of all that it depends on, so a drive that is there is not made
again, and one of other inputs is never mistaken for it.
"""

from __future__ import annotations

import hashlib
import json
import multiprocessing
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, wait
from contextlib import AbstractContextManager, ExitStack
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, TypeAlias, cast

import numpy as np
import torch

import roadproof
from roadproof.controllers import Controller
from roadproof.datatypes import Weather
from roadproof.errors import EpisodeError, PatternError
from roadproof.evaluation.result import ATTACK, Evaluation, Trial, judge
from roadproof.patterns import Pattern, raster
from roadproof.rollout import Driver, Episode, rollout
from roadproof.scenarios import Scenario, identity
from roadproof.search_space import SearchSpace
from roadproof.simulators.protocol import PaintKind, PatternImage, Simulator

PAPER_WEATHERS = (Weather.CLEAR_NOON, Weather.CLOUDY_NOON, Weather.RAINY_NOON, Weather.CLEAR_SUNSET)
CLEAN = "clean"
_LOOK_S = 0.5

AnyDriver: TypeAlias = Controller | Driver[Any]
Opening: TypeAlias = Callable[[], AbstractContextManager[Simulator]]
"""Makes a simulator for a with-block, as `TownSimulator` does."""


@dataclass(frozen=True, kw_only=True, slots=True)
class _Drive:
    """One drive to be made."""

    file: str
    paint: str
    weather: Weather
    cars: int
    pedestrians: int
    seed: int


@dataclass(frozen=True, kw_only=True, slots=True)
class _Work:
    """What a process needs to make drives."""

    simulator: Opening | Simulator
    driver: AnyDriver
    scenario: Scenario
    paints: dict[str, PatternImage]
    folder: Path


def evaluate(
    simulator: Opening | Simulator,
    driver: AnyDriver,
    scenario: Scenario,
    pattern: Pattern | PatternImage,
    *,
    folder: Path,
    driver_name: str = "",
    weathers: Sequence[Weather] = PAPER_WEATHERS,
    runs: int = 10,
    cars: int = 20,
    pedestrians: int = 20,
    seed: int = 0,
    baseline: Sequence[Pattern] = (),
    processes: int = 1,
    on_drive: Callable[[int, int], object] = lambda _done, _total: None,
) -> Evaluation:
    """Drive a scenario with and without a pattern: once a weather alone, then `runs` times with cars and people.

    Args:
        simulator: an open one, or a function that makes one, such as `TownSimulator`; needed for several processes.
        driver: a controller, or a function as `training.expert.expert`; for several processes it must be picklable.
        scenario: where.
        pattern: what is painted.
        folder: keeps every drive; an interrupted evaluation goes on from it.
        driver_name: what reports call the driver; by default its type or name.
        weathers: in which; the paper's four by default.
        runs: drives with traffic a weather, each with a seed of its own.
        cars: others on the road in those.
        pedestrians: people about in those.
        seed: of the first run.
        baseline: other patterns to compare with: all of them driven alone, and in turn with traffic.
        processes: drives made at once, each in a process with a simulator of its own.
        on_drive: told after each drive how many are done, and of how many.

    Raises:
        EpisodeError: there is nothing to drive, several processes are asked for with an open simulator, or a drive in
            the folder is damaged.
        SimulatorError: the simulator refuses the conditions.
        OutputError: the folder cannot be written.
    """
    if not weathers or min(runs, cars, pedestrians) < 0 or processes < 1:
        raise EpisodeError(
            f"{len(weathers)} weathers, {runs} runs, {cars} cars, {pedestrians} pedestrians, {processes} processes; "
            "expected at least one weather and process, and nothing below 0"
        )
    if runs and not cars + pedestrians:
        raise EpisodeError(f"{runs} runs with traffic but no cars and no pedestrians; ask for some, or for 0 runs")
    if processes > 1 and not callable(simulator):
        raise EpisodeError(f"{processes} processes need a simulator each; give a function that makes one")
    paints = {ATTACK: _raster(pattern)} | {f"random-{k + 1}": raster(each) for k, each in enumerate(baseline)}
    name = driver_name or _name(driver)
    started = time.perf_counter()
    with ExitStack() as stack:
        world = stack.enter_context(simulator()) if callable(simulator) else simulator
        common = _identity(world, driver, name, scenario)
        planned = _planned(common, paints, weathers, runs, cars, pedestrians, seed)
        drives = list({drive.file: drive for pair in planned for drive in pair}.values())
        work = _Work(simulator=simulator, driver=driver, scenario=scenario, paints=paints, folder=folder / "episodes")
        missing = [drive for drive in drives if not (work.folder / drive.file).exists()]
        made = len(drives) - len(missing)
        on_drive(made, len(drives))
        if processes == 1 or len(missing) < 2:
            for k, drive in enumerate(missing):
                _make(world, work, drive)
                on_drive(made + k + 1, len(drives))
        else:
            _make_together(work, missing, processes, lambda done: on_drive(made + done, len(drives)))
    evaluation = Evaluation(
        scenario=scenario,
        controller=name,
        weathers=tuple(weathers),
        runs=runs,
        cars=cars,
        pedestrians=pedestrians,
        seed=seed,
        trials=_judged(planned, scenario, work.folder),
        simulator_calls=len(drives),
        seconds=time.perf_counter() - started,
        paint=world.paint,
    )
    evaluation.save(folder, paints[ATTACK])
    return evaluation


def random_patterns(pattern: Pattern, count: int, *, seed: int = 0) -> tuple[Pattern, ...]:
    """Patterns with as many figures as another, drawn as the paper's searches start: what chance alone does."""
    space = SearchSpace(figures=len(pattern.shapes))
    drawn = space.pattern(space.random((count,), torch.Generator().manual_seed(seed)))
    return tuple(drawn[k] for k in range(count))


def _raster(pattern: Pattern | PatternImage) -> PatternImage:
    paint = raster(pattern) if isinstance(pattern, Pattern) else pattern
    if not paint[..., 3].any():
        raise PatternError("the pattern paints nothing, so there is nothing to evaluate; give another")
    return paint


def _planned(
    common: str,
    paints: dict[str, PatternImage],
    weathers: Sequence[Weather],
    runs: int,
    cars: int,
    pedestrians: int,
    seed: int,
) -> list[tuple[_Drive, _Drive]]:
    """Every clean drive with each painted one that is compared with it."""
    digests = {name: hashlib.sha256(paint.tobytes()).hexdigest() for name, paint in paints.items()} | {CLEAN: ""}
    random = [name for name in paints if name != ATTACK]

    def drive(paint: str, weather: Weather, cars: int, pedestrians: int, seed: int) -> _Drive:
        inputs = json.dumps([common, digests[paint], weather, cars, pedestrians, seed])
        among = f"traffic-{seed}" if cars + pedestrians else "alone"
        file = f"{weather}-{among}-{paint}-{hashlib.sha256(inputs.encode()).hexdigest()[:12]}.npz"
        return _Drive(file=file, paint=paint, weather=weather, cars=cars, pedestrians=pedestrians, seed=seed)

    pairs: list[tuple[_Drive, _Drive]] = []
    for weather in weathers:
        clean = drive(CLEAN, weather, 0, 0, seed)
        pairs += [(clean, drive(paint, weather, 0, 0, seed)) for paint in paints]
        for run in range(runs):
            painted = [ATTACK, *random[run % len(random) : run % len(random) + 1]] if random else [ATTACK]
            clean = drive(CLEAN, weather, cars, pedestrians, seed + run)
            pairs += [(clean, drive(paint, weather, cars, pedestrians, seed + run)) for paint in painted]
    return pairs


def _make(world: Simulator, work: _Work, drive: _Drive) -> None:
    episode = rollout(
        world,
        work.driver,
        work.scenario,
        weather=drive.weather,
        pattern=work.paints.get(drive.paint),
        cars=drive.cars,
        pedestrians=drive.pedestrians,
        seed=drive.seed,
    )
    episode.save(work.folder / drive.file)


def _make_together(work: _Work, drives: Sequence[_Drive], processes: int, on_done: Callable[[int], object]) -> None:
    """Deal the drives out to processes; what is done shows in the folder."""
    shares = [list(drives[k::processes]) for k in range(min(processes, len(drives)))]
    # Spawned, since graphics and torch's threads do not survive a fork.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(len(shares), mp_context=context) as pool:
        running = [pool.submit(_make_share, work, share) for share in shares]
        while (waiting := wait(running, timeout=_LOOK_S, return_when="FIRST_EXCEPTION")).not_done:
            on_done(sum((work.folder / drive.file).exists() for drive in drives))
            for future in waiting.done:
                future.result()
        for future in running:
            future.result()
    on_done(len(drives))


def _make_share(work: _Work, drives: Sequence[_Drive]) -> None:
    """What one process does."""
    torch.set_num_threads(1)
    assert callable(work.simulator)
    with work.simulator() as world:
        for drive in drives:
            _make(world, work, drive)


def _judged(planned: Sequence[tuple[_Drive, _Drive]], scenario: Scenario, folder: Path) -> tuple[Trial, ...]:
    return tuple(
        judge(
            Episode.load(folder / clean.file),
            Episode.load(folder / painted.file),
            scenario.canvas,
            pattern=painted.paint,
            clean_file=clean.file,
            painted_file=painted.file,
        )
        for clean, painted in planned
    )


def _name(driver: AnyDriver) -> str:
    return type(driver).__name__ if isinstance(driver, Controller) else str(getattr(driver, "__qualname__", driver))


def _identity(simulator: Simulator, driver: AnyDriver, name: str, scenario: Scenario) -> str:
    """Everything that all drives depend on, as text. A controller is known by what it answers."""
    view = simulator.input
    answers: list[tuple[float, ...]] = []
    if isinstance(driver, Controller):
        rng = np.random.default_rng(0)
        size = driver.input_size or (view.height_px, view.width_px)
        for _ in range(4):
            coarse = rng.integers(0, 256, (6, 8, 3), np.uint8)
            frame = np.repeat(np.repeat(coarse, -(-size[0] // 6), 0), -(-size[1] // 8), 1)[: size[0], : size[1]]
            control = driver.act(np.ascontiguousarray(frame), 6.0, 2)
            answers.append(tuple(round(value, 4) for value in (control.steer, control.throttle, control.brake)))
    parts: dict[str, object] = {
        "version": roadproof.__version__,
        "simulator": f"{type(simulator).__module__}.{type(simulator).__qualname__}",
        "camera": asdict(simulator.camera),
        "input": asdict(view),
        "dt_s": simulator.dt_s,
        "driver": [name, answers],
        "scenario": identity(scenario),
    }
    if simulator.paint is not PaintKind.RENDERED:
        parts["paint"] = simulator.paint
    return json.dumps(parts, sort_keys=True, default=cast("Callable[[object], str]", str))
