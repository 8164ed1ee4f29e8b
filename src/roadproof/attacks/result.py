"""What came of an attack, and its file."""

from __future__ import annotations

import json
from dataclasses import asdict, astuple, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from roadproof.attacks.checks import Check
from roadproof.attacks.method import Method
from roadproof.attacks.methods import GradOpt, method_of, stored
from roadproof.errors import RoadproofError
from roadproof.io.files import read_json, write_atomically
from roadproof.io.records import record
from roadproof.patterns import Pattern, load_pattern, save_pattern
from roadproof.search_space import SearchSpace

FORMAT = "roadproof-attack"
FORMAT_VERSION = 2


@dataclass(frozen=True, kw_only=True, slots=True)
class Cost:
    """What an attack took.

    Args:
        controller_frames: frames the controller was shown, forward or forward and backward.
        seconds: wall time of the search, without loading and checks.
    """

    controller_frames: int
    seconds: float


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """Where one start of the search came to.

    Args:
        pattern: its best.
        group: the drives it was found on.
        surrogate_shift: its mean steering shift a frame towards that group's side, on recorded frames.
        predicted_m: the paper's deviation in the recorded world, mean over small errors of steering; None where nothing
            was driven there.
        predicted_range_m: least and most of it over those errors.
    """

    pattern: Pattern
    group: str
    surrogate_shift: float
    predicted_m: float | None = None
    predicted_range_m: tuple[float, float] | None = None


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class AttackResult:
    """The pattern an attack found on recorded drives, and how it was found.

    Its numbers come from composited frames: the *surrogate*'s of single recorded ones, *predicted* ones of drives in
    the recorded world. What the car does is for driving to say.

    Args:
        pattern: the strongest pattern.
        group: the group it was found for, e.g. "clean+right".
        objective: what was made large: "steering shift", "path deviation", or the name of the user's own.
        surrogate_shift: its mean steering shift a frame towards that group's side, in steer units.
        predicted_m: the paper's deviation in the recorded world, mean over small errors of steering; None where the
            search did not drive there.
        predicted_range_m: least and most of it over those errors.
        by_group: the best value of every group, in the objective's unit: steer a frame, or metres; the published
            method's is a sum over frames.
        candidates: every start's best, the strongest first: by the least predicted deviation where there is one. The
            steering shift ranks only coarsely, so that driving over its first few finds a stronger one than the first.
        history: value at every iteration after the first rungs, (iterations, groups, restarts); without gradients the
            best so far, (calls, 1, 1).
        cost: what it took.
        checks: what the attack found when it distrusted itself.
        space: where it looked.
        method: how it searched.
        seed: of everything random.
    """

    pattern: Pattern
    group: str
    surrogate_shift: float
    by_group: dict[str, float]
    candidates: tuple[Candidate, ...]
    history: Float[np.ndarray, "i g r"]
    cost: Cost
    checks: tuple[Check, ...]
    space: SearchSpace
    method: Method
    seed: int
    objective: str = "steering shift"
    predicted_m: float | None = None
    predicted_range_m: tuple[float, float] | None = None

    def save(self, folder: Path) -> None:
        """Write pattern.json, pattern.png, candidates/ and result.json.

        Raises:
            OutputError: the folder cannot be written.
        """
        save_pattern(self.pattern, folder / "pattern.json")
        for rank, candidate in enumerate(self.candidates, 1):
            save_pattern(candidate.pattern, folder / "candidates" / f"{rank}.json")
        told: dict[str, Any] = asdict(self)
        del told["pattern"]
        told |= {
            "candidates": [
                [each.group, each.surrogate_shift, each.predicted_m, each.predicted_range_m] for each in self.candidates
            ],
            "history": np.round(self.history.astype(float), 6).tolist(),
            "method": stored(self.method),
        }
        kind = "surrogate and predicted: composited frames, not driving"
        content = {"format": FORMAT, "version": FORMAT_VERSION, "kind": kind, **told}
        write_atomically(folder / "result.json", lambda part: part.write_text(json.dumps(content, indent=1) + "\n"))

    @staticmethod
    def load(folder: Path) -> AttackResult:
        """Read what `save` wrote.

        Raises:
            RoadproofError: a file is missing, damaged or of another format.
        """
        path, remedy = folder / "result.json", "search again"
        content = read_json(path, FORMAT, FORMAT_VERSION, RoadproofError)
        told = record(content, _Stored, path, RoadproofError, remedy)
        try:
            history = np.array(told.history, dtype=np.float64)
        except ValueError as error:
            raise RoadproofError(f"{path} is incomplete or damaged ({error}); {remedy}") from None
        candidates: list[Candidate] = []
        for rank, each in enumerate(told.candidates, 1):
            ranked = record(dict(zip(_Ranked.__slots__, each, strict=False)), _Ranked, path, RoadproofError, remedy)
            candidates.append(Candidate(load_pattern(folder / "candidates" / f"{rank}.json"), *astuple(ranked)))
        return AttackResult(
            pattern=load_pattern(folder / "pattern.json"),
            candidates=tuple(candidates),
            history=history,
            method=_method(told, path, remedy),
            **{name: getattr(told, name) for name in _Stored.__slots__ if name not in _MADE},
        )


@dataclass(frozen=True, slots=True)
class _Ranked:
    """A candidate but for its pattern; older results lack the last one or two."""

    group: str
    surrogate_shift: float
    predicted_m: float | None = None
    predicted_range_m: tuple[float, float] | None = None


@dataclass(frozen=True, kw_only=True, slots=True)
class _Stored:
    """result.json; of version 1 with schedule and restarts instead of a method, and at first without an objective."""

    group: str
    surrogate_shift: float
    by_group: dict[str, float]
    seed: int
    candidates: list[list[Any]]
    history: list[list[list[float]]]
    cost: Cost
    checks: tuple[Check, ...]
    space: SearchSpace
    method: dict[str, Any] = field(default_factory=dict[str, Any])
    schedule: dict[str, Any] = field(default_factory=dict[str, Any])
    restarts: int = 0
    objective: str = "steering shift"
    predicted_m: float | None = None
    predicted_range_m: tuple[float, float] | None = None


_MADE = ("candidates", "history", "method", "schedule", "restarts")


def _method(told: _Stored, path: Path, remedy: str) -> Method:
    given = dict(told.method)
    try:
        if not given:
            halving, iterations = bool(told.schedule.get("heats")), told.schedule.get("iterations")
            return GradOpt(iterations=iterations, restarts=told.restarts, halving=halving)
        return method_of(str(given.pop("method", "")), **given)
    except RoadproofError as error:
        raise RoadproofError(f"{path} is incomplete or damaged ({error}); {remedy}") from None
