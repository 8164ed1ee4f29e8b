"""What came of a check, as check.json keeps it; one that is kept is the reference of those that follow."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import roadproof
from roadproof.datatypes import Weather
from roadproof.driving.intervals import Estimate
from roadproof.driving.starts import StartOffset
from roadproof.errors import CheckError
from roadproof.gate.plan import MEASURES, BudgetName, CheckPlan, Key
from roadproof.gate.verdict import Kind, Status
from roadproof.io.files import AnyPath, as_path
from roadproof.io.records import RecordFile

AGAIN = "make it again with --accept, from a controller that you trust"


@dataclass(frozen=True, kw_only=True, slots=True)
class JudgedDrive:
    """One drive of a case.

    Args:
        seed: the seed that the drive's start was drawn with.
        start: where the drive began, relative to the scenario's start.
        wrong: what went wrong, in words; empty where nothing did.
        clean: the file name of the drive on the bare road.
        painted: the file name of the drive over paint; empty in a case without paint.
        paint: the file of the pattern; empty in a case without paint.
        deviation_m: the deviation of the painted drive from the clean one, metres; 0 in a case without paint.
        lateral_m: largest offset of the painted drive from the clean one's path, metres, left positive.
    """

    seed: int
    start: StartOffset
    wrong: str
    clean: str
    painted: str = ""
    paint: str = ""
    deviation_m: float = 0.0
    lateral_m: float = 0.0


def worst_of(drives: Sequence[JudgedDrive]) -> JudgedDrive | None:
    """The drive that went furthest astray; None where there is none."""
    return max(drives, key=lambda each: (each.deviation_m, bool(each.wrong)), default=None)


@dataclass(frozen=True, kw_only=True, slots=True)
class Case:
    """One scenario in one weather over one kind of paint.

    Args:
        scenario: the scenario's name.
        weather: the weather of the drives.
        kind: the kind of paint, or "bare" for none.
        name: the pattern's name, or words for all patterns of the kind, such as "random patterns".
        conditions: a hash of all that the drives depend on, apart from the controller.
        measures: the case's measures, each with its interval.
        status: whether the case passes.
        reasons: why the case does not pass; empty where it does.
        command: the command to drive over the paint of the worst drive again, from all starts of its seed, and to film
            the first.
        drives: all drives that were judged.
    """

    scenario: str
    weather: Weather
    kind: Kind
    name: str
    conditions: str
    measures: dict[str, Estimate]
    status: Status
    reasons: tuple[str, ...]
    command: str
    drives: tuple[JudgedDrive, ...]

    @property
    def key(self) -> Key:
        """What tells a case from the other cases of a check."""
        return self.scenario, self.weather, self.kind, self.name

    def __str__(self) -> str:
        return f"{self.scenario}, {self.weather}, {self.name}"


@dataclass(frozen=True, kw_only=True, slots=True)
class CheckResult:
    """A whole check.

    Args:
        roadproof: the version of roadproof that made the check.
        controller: the spec of the controller that was checked.
        architecture: the architecture of the controller (`architecture_of`).
        budget: "smoke" or "full".
        compared: whether there was a reference to compare with.
        cases: the judged cases, in the order of the plan.
    """

    roadproof: str
    controller: str
    architecture: str
    budget: BudgetName
    compared: bool
    cases: tuple[Case, ...]

    @property
    def status(self) -> Status:
        """Failed where a case did; passed where all did."""
        found = {case.status for case in self.cases}
        return next((each for each in (Status.FAILED, Status.TOO_FEW) if each in found), Status.PASSED)

    @property
    def predicted(self) -> bool:
        """Whether it drove in recordings, and nothing was driven for real."""
        return self.budget == "smoke"

    @property
    def not_passed(self) -> tuple[Case, ...]:
        """The cases that failed, or had too few drives."""
        return tuple(case for case in self.cases if case.status is not Status.PASSED)

    def save(self, path: AnyPath) -> None:
        """Write check.json; the same bytes for the same result.

        Raises:
            OutputError: the file cannot be written.
        """
        CHECK_FILE.write(
            as_path(path), self, kind="predicted" if self.predicted else "closed loop", verdict=self.status
        )


CHECK_FILE = RecordFile(kind=CheckResult, name="roadproof-check-result", error=CheckError, remedy=AGAIN)


def load_reference(path: Path, architecture: str, plan: CheckPlan) -> dict[Key, Case]:
    """The cases of a stored check.json, which those of a check are compared with.

    Args:
        path: the stored check.json.
        architecture: the architecture of the controller that is checked (`architecture_of`).
        plan: the plan of the check.

    Raises:
        CheckError: the file is missing, damaged, made by another version, architecture or budget, did not pass, or has
            a case that the plan leaves out.
    """
    if not path.is_file():
        raise CheckError(f"the reference {path} is not there; make it with --accept, from a controller that you trust")
    stored = CHECK_FILE.read(path)
    told = (
        ("roadproof", stored.roadproof, roadproof.__version__),
        ("a controller of architecture", stored.architecture, architecture),
        ("budget", stored.budget, plan.budget),
    )
    for what, before, now in told:
        if before != now:
            raise CheckError(f"the reference {path} was made with {what} {before}, this check has {now}; {AGAIN}")
    if not stored.cases or stored.not_passed:
        why = f"{stored.not_passed[0]}: {stored.not_passed[0].status}" if stored.cases else "it has no case"
        raise CheckError(f"the reference {path} did not pass ({why}), so nothing is measured by it; {AGAIN}")
    for case in stored.cases:
        if tuple(case.measures) != MEASURES[case.kind] or any(not each.value >= 0 for each in case.measures.values()):
            told = ", ".join(f"{name} {each.value:g}" for name, each in case.measures.items()) or "nothing"
            raise CheckError(
                f"the reference {path} has measured {told} for {case}, expected {' and '.join(MEASURES[case.kind])} "
                f"from 0 on; {AGAIN}"
            )
    if left_out := [case for case in stored.cases if case.key not in plan.keys]:
        raise CheckError(f"the reference {path} has {left_out[0]}, which the plan leaves out; put it back, or {AGAIN}")
    return {case.key: case for case in stored.cases}
