"""What came of an attack, and its file."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from roadproof.attacks.checks import Check
from roadproof.attacks.gradopt import Heat, Schedule
from roadproof.coverage import Shape
from roadproof.errors import RoadproofError
from roadproof.io.files import read_json, write_atomically
from roadproof.patterns import Pattern, load_pattern, save_pattern
from roadproof.search_space import SearchSpace

FORMAT = "roadproof-attack"
FORMAT_VERSION = 1
_LATER = ("objective", "predicted_m")
_PLAIN = ("group", "surrogate_shift", "by_group", "stopped", "restarts", "seed", *_LATER)


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
        by_group: the best value of every group, in the objective's unit: steer a frame, or metres.
        candidates: every start's best, the strongest first: by the predicted deviation where there is one. The
            steering shift ranks only coarsely, so that driving over its first few finds a stronger one than the first.
        history: value at every iteration after the heats, (iterations, groups, restarts).
        stopped: why the search ended.
        cost: what it took.
        checks: what the attack found when it distrusted itself.
        space: where it looked.
        schedule: its steps.
        restarts: of every group.
        seed: of the random starts.
    """

    pattern: Pattern
    group: str
    surrogate_shift: float
    by_group: dict[str, float]
    candidates: tuple[Candidate, ...]
    history: Float[np.ndarray, "i g r"]
    stopped: str
    cost: Cost
    checks: tuple[Check, ...]
    space: SearchSpace
    schedule: Schedule
    restarts: int
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
        content = {
            "format": FORMAT,
            "version": FORMAT_VERSION,
            "kind": "surrogate and predicted: composited frames, not driving",
            **{name: getattr(self, name) for name in _PLAIN},
            "predicted_range_m": self.predicted_range_m,
            "candidates": [
                [each.group, each.surrogate_shift, each.predicted_m, each.predicted_range_m] for each in self.candidates
            ],
            "cost": asdict(self.cost),
            "checks": [asdict(check) for check in self.checks],
            "space": asdict(self.space),
            "schedule": asdict(self.schedule),
            "history": np.round(self.history.astype(float), 6).tolist(),
        }
        write_atomically(folder / "result.json", lambda part: part.write_text(json.dumps(content, indent=1) + "\n"))

    @staticmethod
    def load(folder: Path) -> AttackResult:
        """Read what `save` wrote.

        Raises:
            RoadproofError: a file is missing, damaged or of another format.
        """
        fields = read_json(folder / "result.json", FORMAT, FORMAT_VERSION, RoadproofError)
        try:
            return AttackResult(
                pattern=load_pattern(folder / "pattern.json"),
                candidates=tuple(
                    Candidate(load_pattern(folder / "candidates" / f"{rank}.json"), str(each[0]), *_numbers(each[1:]))
                    for rank, each in enumerate(fields["candidates"], 1)
                ),
                cost=Cost(**fields["cost"]),
                checks=tuple(Check(**check) for check in fields["checks"]),
                space=_space(fields["space"]),
                schedule=_schedule(fields["schedule"]),
                history=np.array(fields["history"], dtype=np.float64),
                # Results that do not name their objective are older than the word.
                predicted_range_m=_pair(fields.get("predicted_range_m")),
                **{name: fields[name] for name in _PLAIN if name in fields or name not in _LATER},
            )
        except (KeyError, TypeError, ValueError) as error:
            raise RoadproofError(f"{folder / 'result.json'} is incomplete or damaged: {error}") from None


def _numbers(stored: list[Any]) -> tuple[float, float | None, tuple[float, float] | None]:
    predicted, spread = (*stored[1:], None, None)[:2]  # older results lack the last one or two
    return float(stored[0]), None if predicted is None else float(predicted), _pair(spread)


def _pair(stored: Any) -> tuple[float, float] | None:  # noqa: ANN401
    if stored is None:
        return None
    low, high = stored
    return float(low), float(high)


def _schedule(stored: dict[str, Any]) -> Schedule:
    heats = tuple(Heat(**heat) for heat in stored.get("heats", ()))
    fields: dict[str, Any] = {**stored, "drops": tuple(stored["drops"]), "heats": heats}
    return Schedule(**fields)


def _space(stored: dict[str, Any]) -> SearchSpace:
    darkest, brightest = stored["albedo"]
    fields: dict[str, Any] = {**stored, "albedo": (darkest, brightest), "shape": Shape(stored["shape"])}
    return SearchSpace(**fields)
