"""What came of a hardening, as hardening.json keeps it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from roadproof.driving.evaluation import ATTACK
from roadproof.errors import TrainingError
from roadproof.hardening.judgement import Judgement
from roadproof.io.files import AnyPath, as_path
from roadproof.io.html import table
from roadproof.io.records import RecordFile
from roadproof.pipeline.stage_costs import StageCost
from roadproof.pipeline.stress_test import StressTest


@dataclass(frozen=True, slots=True)
class Round:
    """What an attack afresh reached on the streets for training, driven.

    Args:
        number: the round's number; 0 is the round before anything was learnt.
        deviation_m: mean deviation over the drives of each scenario's evaluation, metres, by the scenario's name.
        left_lane: share of all the evaluations' drives that leave their lane, 0 to 1.
        left_out: share of the evaluations' planned drives that were not made, since without paint the car never came
            to the canvas.
    """

    number: int
    deviation_m: dict[str, float]
    left_lane: float
    left_out: float = 0.0

    @property
    def failed(self) -> float:
        """Share of the planned drives that leave their lane, or whose car never comes to the canvas without paint."""
        return self.left_out + (1.0 - self.left_out) * self.left_lane

    @property
    def mean_m(self) -> float:
        """The mean deviation over the scenarios, metres."""
        return float(np.mean(list(self.deviation_m.values())))

    @staticmethod
    def of(number: int, tests: Sequence[StressTest]) -> Round:
        """The round of this number, of its stress tests on the streets for training."""
        trials = {test.evaluation.scenario.name: test.evaluation.of(ATTACK, traffic=False) for test in tests}
        left = [trial.leaves_lane for each in trials.values() for trial in each]
        deviations = {name: float(np.mean([trial.deviation_m for trial in each])) for name, each in trials.items()}
        lost = sum(test.evaluation.left_out for test in tests)
        return Round(number, deviations, float(np.mean(left)), lost / (lost + len(left)))


def best_of(rounds: Sequence[Round]) -> int:
    """The number of the tuned round that fails least often; of equals, of the least mean deviation."""
    return min(rounds[1:], key=lambda each: (each.failed, each.mean_m)).number


@dataclass(frozen=True, kw_only=True, slots=True)
class Hardened:
    """What came of a hardening.

    Args:
        controller: the spec of the controller that it began with.
        hardened: the spec of the hardened controller, for `load_controller` and every verb.
        rounds: the re-tests on the streets for training, round 0 first.
        best: number of the round whose controller is kept (`best_of`).
        judgement: before and after on other streets; None where none were given.
        cost: cost of each stage since the hardening began, by its name.
    """

    controller: str
    hardened: str
    rounds: tuple[Round, ...]
    best: int
    judgement: Judgement | None
    cost: dict[str, StageCost]

    def _repr_html_(self) -> str:
        """How a notebook shows it: a row for each round, and the verdict."""
        rows = [(f"round {r.number}", f"{r.mean_m:.2f} m, leaves its lane in {r.left_lane:.0%}") for r in self.rounds]
        told = [] if self.judgement is None else [("on other streets", self.judgement.verdict().sentence)]
        return table(("attacked afresh", "driven deviation, mean"), [*rows, ("kept", f"round {self.best}"), *told])

    def save(self, folder: AnyPath) -> None:
        """Write hardening.json.

        Raises:
            OutputError: the folder cannot be written.
        """
        verdict = {} if self.judgement is None else {"verdict": self.judgement.verdict()}
        _FILE.write(as_path(folder) / "hardening.json", self, **verdict)

    @staticmethod
    def load(folder: AnyPath) -> Hardened:
        """Read what `save` wrote, from the folder of `harden`.

        Raises:
            TrainingError: the file is missing, damaged or of another format.
        """
        return _FILE.read(as_path(folder) / "hardening.json")


_FILE = RecordFile(
    kind=Hardened,
    name="roadproof-hardening",
    error=TrainingError,
    remedy="harden again",
    notes={"kind": "closed loop"},
)
