"""What came of an attack, and its file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import msgspec
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from roadproof.attacks.driven import Effect
from roadproof.attacks.method import Method
from roadproof.attacks.methods import Published, method_of, stored
from roadproof.checks import Check
from roadproof.driving.speed import speed_in_words, speeds_in_words
from roadproof.errors import RoadproofError
from roadproof.io.files import AnyPath, as_path, remove
from roadproof.io.html import picture, table
from roadproof.io.records import Form, RecordFile, plain
from roadproof.paint import Conspicuousness
from roadproof.patterns import Pattern, load_pattern, raster, save_pattern
from roadproof.search_space import SearchSpace

_UNITS = {"steering shift": "steer a frame", "path deviation": "predicted m", "speed change": "predicted m/s"}
_DRIVEN = {"steering shift": "steer, summed over the drives that chose", "path deviation": "m in the drives that chose"}


@dataclass(frozen=True, kw_only=True, slots=True)
class Cost:
    """The cost of an attack.

    Args:
        controller_frames: number of frames the search showed the controller, forward or forward and backward; what its
            best patterns are predicted to do takes some more.
        seconds: wall time of the search and of those predictions, seconds, without loading and checks; of one that was
            interrupted, in the process that ended it.
        simulator_calls: number of drives in a simulator, the clean one included; 0 on recordings.
    """

    controller_frames: int
    seconds: float
    simulator_calls: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """The best pattern of one start of a search.

    Args:
        pattern: the best pattern of this start.
        group: name of the group of drives that it was found on, such as "clean+right", or "slower".
        surrogate_shift: mean steering shift per frame towards that group's side on recorded frames, in steer units;
            None without recorded frames.
        predicted_m: the paper's deviation in the recorded world, metres, mean over recorded weathers and small errors;
            None if the search did not drive there.
        predicted_range_m: least and largest of these predicted deviations, metres; None if nothing was driven there.
        driven: effect in the drive that chose the pattern; None if nothing was driven in a simulator.
        predicted_mps: mean change of the speed in the recorded world, m/s, negative where the car is slower, mean over
            recorded weathers and small errors; None if the search was not for a change of the speed.
        predicted_range_mps: least and largest of these predicted changes, m/s; None if there are none.
        point: point of the search space where a pattern was found under limits on paint, K rows of N parameters; None
            without limits, where the pattern says it.
    """

    pattern: Pattern
    group: str
    surrogate_shift: float | None = None
    predicted_m: float | None = None
    predicted_range_m: tuple[float, float] | None = None
    driven: Effect | None = None
    predicted_mps: float | None = None
    predicted_range_mps: tuple[float, float] | None = None
    point: tuple[tuple[float, ...], ...] | None = None

    def point_in(self, space: SearchSpace) -> Float[Tensor, "k n"]:
        """The point of a space from which to search on: where the pattern was found, if it is the same there."""
        nearest, pattern = space.point(self.pattern), self.pattern
        if [len(row) for row in self.point or ()] != [len(space.names)] * space.figures:
            return nearest
        found = torch.tensor(self.point)
        made = space.pattern(found)
        same = torch.allclose(made.boxes, pattern.boxes, atol=1e-3) and torch.allclose(made.colours, pattern.colours)
        return found if same else nearest

    @property
    def predicted(self) -> str | None:
        """What is predicted, in words with its unit; None if the search did not drive in the recorded world."""
        if self.predicted_mps is not None:
            return speed_in_words(self.predicted_mps)
        return None if self.predicted_m is None else f"{self.predicted_m:.2f} m"


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class AttackResult(Candidate):
    """The pattern an attack found, which is that of its first candidate, and how it was found.

    On recordings its numbers come from composited frames: the *surrogate*'s of single recorded ones, *predicted* ones
    of drives in the recorded world. What the car does is for driving to say. In a simulator they are *driven*, in the
    drives that chose the pattern: other drives have to report it.

    Args:
        objective: what was made large: "steering shift", "path deviation", "speed change", or the name of the user's
            own.
        by_group: best value of every group, in the objective's unit: steer units per frame, metres, or m/s; for the
            published method a sum over frames. Without gradients only the candidates count, which are the best for
            whichever group, so that another group may have a lower value here than patterns that were tried.
        candidates: best pattern of every start, the strongest first, by the least predicted effect if there is one.
            The steering shift ranks only coarsely, so that driving over the first few finds a stronger one than the
            first.
        history: value at every iteration after the first rungs, (iterations, groups, restarts); without gradients the
            best value so far, (calls, 1, 1).
        cost: controller frames, seconds and simulator calls that the attack took.
        checks: outcomes of the attack's self-checks.
        space: the search space.
        method: the search method.
        seed: seed of everything random.
        conspicuousness: how conspicuous the strongest pattern is on this road.
        made_of: identity of the search, by name (`io.identity`); empty in a simulator. The others are those of
            `Candidate`.
    """

    by_group: dict[str, float]
    candidates: tuple[Candidate, ...]
    history: Float[np.ndarray, "i g r"]
    cost: Cost
    checks: tuple[Check, ...]
    space: SearchSpace
    method: Method
    seed: int
    objective: str = "steering shift"
    conspicuousness: Conspicuousness | None = None
    made_of: Mapping[str, Any] = field(default_factory=dict[str, Any])

    @property
    def made_large(self) -> str:
        """What was made large, with the unit of its values: "path deviation, predicted m"."""
        aim = self.objective.removesuffix(" over variations")
        unit = (_UNITS if self.driven is None else _DRIVEN).get(aim, "its own unit")
        if isinstance(self.method, Published):
            unit = "steer, summed over frames"
        return f"{self.objective}, {unit}"

    def _repr_html_(self) -> str:
        """How a notebook shows it: the pattern, and what each kind of number says."""
        known = (
            ("made large", f"{self.objective}, for {self.group}, by {self.method.word}"),
            ("surrogate", None if self.surrogate_shift is None else f"{self.surrogate_shift:+.3f} steer a frame"),
            ("predicted", (told := self.predicted_with_spread) and "{} ({})".format(*told)),
            ("driven, to choose it", self.driven and f"{self.driven.deviation:.2f} m of deviation"),
            ("took", f"{self.cost.seconds:.0f} s, {self.cost.simulator_calls} simulator calls"),
            *(("look at", f"{each.name}: {each.finding}") for each in self.checks if not each.passed),
        )
        shown = picture(raster(self.pattern), "the strongest pattern", 200)
        return shown + table(("attack", ""), [(name, value) for name, value in known if value])

    @property
    def predicted_with_spread(self) -> tuple[str, str] | None:
        """What is predicted and its spread, in words with units; None if nothing was driven in recordings."""
        if self.predicted is None:
            return None
        if self.predicted_mps is not None:
            spread = self.predicted_range_mps or (self.predicted_mps, self.predicted_mps)
            return self.predicted, speeds_in_words(*spread)
        low, high = self.predicted_range_m or (self.predicted_m, self.predicted_m)
        return f"{self.predicted} of deviation", f"{low:.2f} to {high:.2f}"

    def save(self, folder: AnyPath) -> None:
        """Write pattern.json, pattern.png, candidates/ and result.json.

        Raises:
            OutputError: the folder cannot be written.
        """
        folder = as_path(folder)
        # The result goes first and comes last: a folder that was cut off between holds none.
        remove(folder / "result.json")
        save_pattern(self.pattern, folder / "pattern.json")
        for rank, candidate in enumerate(self.candidates, 1):
            save_pattern(candidate.pattern, folder / "candidates" / f"{rank}.json")
        RESULT_FILE.write(
            folder / "result.json",
            self,
            candidates=[[plain(getattr(each, name)) for name in _Ranked.__struct_fields__] for each in self.candidates],
        )

    @staticmethod
    def load(folder: AnyPath) -> AttackResult:
        """Read what `save` wrote.

        Raises:
            RoadproofError: a file is missing, damaged or of another format.
        """
        folder = as_path(folder)
        path = folder / "result.json"
        content = RESULT_FILE.content(path)
        ranked = _ROWS_FILE.made(path, content).candidates
        candidates = tuple(
            Candidate(load_pattern(folder / "candidates" / f"{rank}.json"), *msgspec.structs.astuple(each))
            for rank, each in enumerate(ranked, 1)
        )
        return RESULT_FILE.made(path, content, pattern=load_pattern(folder / "pattern.json"), candidates=candidates)


class _Ranked(msgspec.Struct, array_like=True, frozen=True):
    """A candidate without its pattern, as a list; older files have no point."""

    group: str
    surrogate_shift: float | None
    predicted_m: float | None
    predicted_range_m: tuple[float, float] | None
    driven: Effect | None
    predicted_mps: float | None
    predicted_range_mps: tuple[float, float] | None
    point: tuple[tuple[float, ...], ...] | None = None


@dataclass(frozen=True, slots=True)
class _Rows:
    """The candidates as result.json lists them."""

    candidates: tuple[_Ranked, ...]


def _rounded(history: Float[np.ndarray, "i g r"]) -> Float[np.ndarray, "i g r"]:
    return np.round(history.astype(float), 6)


def _method(stated: dict[str, Any]) -> Method:
    return method_of(str(stated.get("method", "")), **{name: stated[name] for name in stated if name != "method"})


RESULT_FILE = RecordFile(
    kind=AttackResult,
    name="roadproof-attack",
    version=2,
    error=RoadproofError,
    remedy="search again",
    elsewhere=("pattern", "candidates"),
    forms={
        "method": Form(dict[str, Any], stored, _method),
        "history": Form(Float[np.ndarray, "i g r"], _rounded, _rounded),
    },
    notes={"kind": "surrogate and predicted: composited frames, not driving; driven: the drives that chose"},
)
_ROWS_FILE = RecordFile(kind=_Rows, error=RoadproofError, remedy="search again")
