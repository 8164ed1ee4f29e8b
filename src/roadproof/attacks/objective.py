"""What a search makes large, as an object: a steering shift as published, a path deviation, a change of the speed.

    attack(recordings, controller, space, objective=PathDeviation())

An objective is a description, also one of the user's own; `measure` makes of it what values patterns on a set of
recordings.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Protocol, TypeAlias, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from roadproof.attacks.closed_loop import Rolling
from roadproof.attacks.deviation import DeviationMeasure
from roadproof.attacks.groups import Group, Points, Values
from roadproof.attacks.speed import SpeedMeasure, require_pedals
from roadproof.attacks.surrogate import Surrogate
from roadproof.compositing.variation import Variation
from roadproof.controllers import Controller
from roadproof.errors import RoadproofError
from roadproof.io.known import known_by
from roadproof.limits import is_whole
from roadproof.recorded.world import BiasedStart
from roadproof.recordings import RecordingSet
from roadproof.search_space import SearchSpace

Readings: TypeAlias = tuple[Values, Float[Tensor, "g r s"] | None]
"""Of each pattern: the mean steering shift on recorded frames, and the deviation predicted in metres, where it is (for
a `SpeedMeasure` the change of the speed in m/s): in each of some drives that differ by as little as a prediction may be
wrong."""


@runtime_checkable
class Measure(Protocol):
    """Gives patterns their values, for every group at once; all that a search without gradients needs."""

    groups: tuple[Group, ...]
    frames_evaluated: int

    @property
    def device(self) -> torch.device:
        """The torch device on which patterns are valued."""
        ...

    def values(self, space: SearchSpace, unit: Points) -> Values:
        """Values (G, R) of R points per group of a search space, without gradients."""
        ...

    def fingerprint(self) -> str:
        """A text that tells this measure from every other, so that an interrupted search goes on only with its own."""
        ...


@runtime_checkable
class RecordedMeasure(Measure, Protocol):
    """A measure on recordings: it also has gradients, for `gradopt` to climb, and predictions for what was found."""

    def thinned(self, every: int) -> RecordedMeasure:
        """A cheaper measure, on every n-th frame or step, whose order of starts is much the same."""
        ...

    def open_loop(self) -> RecordedMeasure:
        """The steering shift on the same recorded frames, from which a search may begin."""
        ...

    def values_and_gradients(self, space: SearchSpace, unit: Points) -> tuple[Values, Points]:
        """Values (G, R) of R points per group, and their gradients or the directions in which they rise."""
        ...

    def readings(self, space: SearchSpace, unit: Points) -> Readings:
        """Steering shift and predicted deviation of R points per group, for the result of a search."""
        ...


@runtime_checkable
class Objective(Protocol):
    """What a search makes large, such as a steering shift or a path deviation."""

    @property
    def name(self) -> str:
        """The name of the objective in words, for results and reports."""
        ...

    def measure(
        self, recordings: RecordingSet, controller: Controller, groups: Sequence[Group], *, device: torch.device | str
    ) -> RecordedMeasure:
        """The measure of patterns on a set of recordings.

        Raises:
            RoadproofError: the recordings or the controller do not allow this objective.
        """
        ...


@dataclass(frozen=True, slots=True)
class SteeringShift:
    """How far steering moves on recorded frames, open loop, as published; its value is steer units a frame.

    Args:
        variation: variation of paint and camera over which the mean is taken; None for paint and camera as recorded.
    """

    # Runs know their objective by its repr, which is older than variations; those are told beside it.
    variation: Variation | None = field(default=None, repr=False)

    @property
    def name(self) -> str:
        """The name of the objective in words, for results and reports."""
        return "steering shift" + _over(self.variation)

    def measure(
        self, recordings: RecordingSet, controller: Controller, groups: Sequence[Group], *, device: torch.device | str
    ) -> Surrogate:
        """The surrogate, which measures the steering shift on the groups' recorded frames."""
        return Surrogate(recordings, controller, groups, device=device, variation=self.variation)


@dataclass(frozen=True, kw_only=True, slots=True)
class ClosedLoop:
    """What an objective in the recorded world, closed loop, is described by; the base class of those that drive there.

    Args:
        starts: offsets from the clean drive at which drives begin, one or more; several make the result more general.
        every: number of steps from one picture to the next during the search; a prediction has a picture at every step.
        variation: variation of paint and camera over which the mean is taken; None for paint and camera as recorded.

    Raises:
        RoadproofError: `starts` is empty, or `every` is not positive.
    """

    word: ClassVar[str]
    starts: tuple[BiasedStart, ...] = (BiasedStart(),)
    every: int = 2
    variation: Variation | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        if not self.starts or not is_whole(self.every) or self.every < 1:
            raise RoadproofError(
                f"{self.word} with {len(self.starts)} starts, a picture every {self.every} steps; expected one start "
                "or more, and 1 or more"
            )

    @property
    def name(self) -> str:
        """The name of the objective in words, for results and reports."""
        return self.word + _over(self.variation)

    def rolling(self, device: torch.device | str) -> Rolling:
        """How a measure drives over patterns on a device."""
        return {"starts": self.starts, "every": self.every, "variation": self.variation, "device": device}


@dataclass(frozen=True, kw_only=True, slots=True)
class PathDeviation(ClosedLoop):
    """How far aside the car goes in the recorded world, closed loop; its value is metres.

    Args:
        saturation_m: offset in metres, above 0, beyond which a larger one hardly counts more; the others are those of
            `ClosedLoop`.

    Raises:
        RoadproofError: `starts` is empty, or `every` or `saturation_m` is not positive, or this is infinite.
    """

    word: ClassVar[str] = "path deviation"
    saturation_m: float = 3.0

    def __post_init__(self) -> None:
        # Dataclasses with slots are made anew, which super() without arguments does not know.
        super(PathDeviation, self).__post_init__()
        if not 0 < self.saturation_m < math.inf:
            raise RoadproofError(f"path deviation with saturation {self.saturation_m} m; expected above 0 and finite")

    def measure(
        self, recordings: RecordingSet, controller: Controller, groups: Sequence[Group], *, device: torch.device | str
    ) -> DeviationMeasure:
        """The measure in the recorded world of the whole set, closed loop."""
        rolling = self.rolling(device)
        return DeviationMeasure(recordings, controller, groups, saturation_m=self.saturation_m, **rolling)


@dataclass(frozen=True, kw_only=True, slots=True)
class SpeedChange(ClosedLoop):
    """How much slower, or faster, the car goes in the recorded world, closed loop; its value is m/s.

    It is the mean over the passage of the speed less that of the drive over the bare road there. The controller must
    say throttle and brake (`PedalController`). The groups are "slower" and "faster". Arguments and errors are those of
    `ClosedLoop`.
    """

    word: ClassVar[str] = "speed change"

    def measure(
        self, recordings: RecordingSet, controller: Controller, groups: Sequence[Group], *, device: torch.device | str
    ) -> SpeedMeasure:
        """The measure in the recorded world of the whole set, closed loop.

        Raises:
            ControllerError: the controller only steers.
        """
        require_pedals(controller)
        return SpeedMeasure(recordings, controller, groups, **self.rolling(device))


def _over(variation: Variation | None) -> str:
    return "" if variation is None else " over variations"


def varied(objective: Objective, variation: Variation | None) -> Objective:
    """The objective in expectation over a variation; unchanged if the variation is None.

    Raises:
        RoadproofError: the objective is the user's own, which has to take the mean itself.
    """
    if variation is None:
        return objective
    if isinstance(objective, SteeringShift | ClosedLoop):
        return replace(objective, variation=variation)
    raise RoadproofError(f"the objective {objective.name} knows no variation; take its mean in its own measure")


def variation_of(objective: Objective) -> Variation | None:
    """The variation of an objective; None if it has none, or is the user's own."""
    return objective.variation if isinstance(objective, SteeringShift | ClosedLoop) else None


def own_objective(objective: Objective) -> dict[str, Any] | None:
    """What tells an objective of the user's own from others of its name, as JSON has it; None for those here."""
    return None if isinstance(objective, SteeringShift | ClosedLoop) else known_by(objective)


OBJECTIVES: dict[str, Objective] = {
    "deviation": PathDeviation(),
    "speed": SpeedChange(),
    "steering": SteeringShift(),
}
"""Those that a command or a plan can name."""
