"""Several streets attacked at once, each in a process with a simulator of its own; the folder keeps all of it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import TypeAlias

from roadproof.errors import TrainingError
from roadproof.hardening.judgement import Judge
from roadproof.hardening.run import Run
from roadproof.processes import Opened, spread, stopping
from roadproof.scenarios import Scenario
from roadproof.simulators.protocol import Simulator, SimulatorFactory

StreetWork: TypeAlias = Callable[[Run, Simulator, int, Scenario], object]
"""What is done on a street with a round's controller: `attack_street` or `judge_street`."""


def together(
    work: StreetWork,
    run: Run,
    number: int,
    scenarios: Sequence[Scenario],
    factory: SimulatorFactory,
    processes: int,
) -> Iterator[Scenario]:
    """Do a work on several streets at once.

    Args:
        work: what is done on each street; a module's own function.
        run: the hardening.
        number: the number of the round whose controller drives.
        scenarios: the scenarios of the streets.
        factory: opens a simulator in each process.
        processes: the largest number of processes.

    Yields:
        Each scenario once its street is done.

    Raises:
        RoadproofError: a stage of a street refuses, or a process died; the message says why.
    """
    done = spread(partial(_on_street, work, run, number), scenarios, Opened(factory), processes=processes)
    return (scenario for scenario, _ in done)


def attack_street(run: Run, simulator: Simulator, number: int, scenario: Scenario) -> None:
    """Attack a round's controller afresh on a street for training."""
    run.attack(simulator, number, scenario, _go_on)


def judge_street(run: Run, simulator: Simulator, number: int, scenario: Scenario) -> None:
    """Judge a round's controller on a street for judging."""
    Judge(run, simulator, number, scenario, _go_on).judge()


def _on_street(work: StreetWork, run: Run, number: int, opened: Opened[Simulator], scenario: Scenario) -> None:
    work(run, opened.inside, number, scenario)


def _go_on(_stage: str, _done: int, _total: int, _word: str) -> None:
    if stopping():
        raise TrainingError("another street failed")
