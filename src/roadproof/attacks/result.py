"""What came of an attack, and its file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from jaxtyping import Float

from roadproof.attacks.checks import Check
from roadproof.attacks.method import Method
from roadproof.attacks.methods import GradOpt, method_of, stored
from roadproof.errors import RoadproofError
from roadproof.io.records import RecordFile
from roadproof.patterns import Pattern, load_pattern, save_pattern
from roadproof.search_space import SearchSpace


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

    def save(self, folder: Path, made_of: Mapping[str, object] | None = None) -> None:
        """Write pattern.json, pattern.png, candidates/ and result.json.

        Args:
            folder: folder of the result.
            made_of: what tells the search from another (`kept_attack`).

        Raises:
            OutputError: the folder cannot be written.
        """
        save_pattern(self.pattern, folder / "pattern.json")
        for rank, candidate in enumerate(self.candidates, 1):
            save_pattern(candidate.pattern, folder / "candidates" / f"{rank}.json")
        rows = [
            [each.group, each.surrogate_shift, each.predicted_m, each.predicted_range_m] for each in self.candidates
        ]
        RESULT_FILE.write(
            folder / "result.json",
            self,
            kind="surrogate and predicted: composited frames, not driving",
            made_of=made_of or {},
            candidates=rows,
            history=np.round(self.history.astype(float), 6),
            method=stored(self.method),
        )

    @staticmethod
    def load(folder: Path) -> AttackResult:
        """Read what `save` wrote.

        Raises:
            RoadproofError: a file is missing, damaged or of another format.
        """
        path = folder / "result.json"
        content = RESULT_FILE.content(path)
        own = replace(RESULT_FILE, kind=_OwnForm).made(path, content)
        candidates = tuple(
            Candidate(
                load_pattern(folder / "candidates" / f"{rank}.json"),
                each.group,
                each.surrogate_shift,
                each.predicted_m,
                each.predicted_range_m,
            )
            for rank, each in enumerate(own.candidates, 1)
        )
        pattern = load_pattern(folder / "pattern.json")
        return RESULT_FILE.made(path, content, pattern=pattern, candidates=candidates, method=own.searched)


RESULT_FILE = RecordFile(AttackResult, "roadproof-attack", 2, RoadproofError, "search again", elsewhere=("pattern",))


class _Ranked(msgspec.Struct, array_like=True, frozen=True):
    """A candidate but for its pattern, as a list; older results lack the last one or two."""

    group: str
    surrogate_shift: float
    predicted_m: float | None = None
    predicted_range_m: tuple[float, float] | None = None


@dataclass(frozen=True, kw_only=True, slots=True)
class _OwnForm:
    """What result.json has in a form of its own; in version 1 schedule and restarts instead of a method."""

    candidates: tuple[_Ranked, ...]
    method: dict[str, Any] = field(default_factory=dict[str, Any])
    schedule: dict[str, Any] = field(default_factory=dict[str, Any])
    restarts: int = 0

    def __post_init__(self) -> None:
        _ = self.searched  # says whether there is such a method

    @property
    def searched(self) -> Method:
        if self.method:
            given = dict(self.method)
            return method_of(str(given.pop("method", "")), **given)
        halving = bool(self.schedule.get("heats"))
        return GradOpt(iterations=self.schedule.get("iterations"), restarts=self.restarts, halving=halving)
