"""Work done again and again in one process, to see what it keeps."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

from paint_shy import PaintShy
from recorded_drives import drivable_set
from roadproof.attacks import GradOpt, PathDeviation, attack
from roadproof.datatypes import Weather
from roadproof.driving.evaluate import evaluate
from roadproof.recorded import RecordedSimulator
from roadproof.search_space import SearchSpace
from team_folder import BAR


def evaluations(folder: Path) -> Iterator[None]:
    """Evaluations of a pattern in the recorded world, each from nothing."""
    while True:
        with RecordedSimulator(drivable_set()) as world:
            clear = (Weather.CLEAR_NOON,)
            evaluate(world, PaintShy(), world.scenario, BAR, folder=folder, weathers=clear, starts=1, runs=0)
        shutil.rmtree(folder)
        yield


def searches(folder: Path) -> Iterator[None]:
    """Searches by gradient in the recorded world, each from nothing."""
    method, space = GradOpt(iterations=2, restarts=1, halving=False), SearchSpace(figures=1)
    while True:
        found = attack(drivable_set(), PaintShy(), space, objective=PathDeviation(), method=method, random_patterns=0)
        found.save(folder)
        yield
