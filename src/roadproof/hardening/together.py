"""What is done on one of several streets at once, in a process with a simulator of its own; the folder keeps it."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

from roadproof.errors import TrainingError
from roadproof.hardening.judgement import Judge
from roadproof.hardening.run import Run
from roadproof.processes import stopping
from roadproof.scenarios import Scenario
from roadproof.simulators.protocol import Simulator

StreetWork: TypeAlias = Callable[[Run, int, Simulator, Scenario], object]
"""What is done on a street with a round's controller: `attack_street` or `judge_street`."""


def attack_street(run: Run, number: int, simulator: Simulator, scenario: Scenario) -> None:
    """Attack a round's controller afresh on a street for training."""
    run.attack(simulator, number, scenario, _go_on)


def judge_street(run: Run, number: int, simulator: Simulator, scenario: Scenario) -> None:
    """Judge a round's controller on a street for judging."""
    Judge(run, simulator, number, scenario, _go_on).judge()


def _go_on(_stage: str, _done: int, _total: int, _word: str) -> None:
    if stopping():
        raise TrainingError("another street failed")
