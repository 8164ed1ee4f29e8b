"""The methods that a study's plan can name, each with its own settings and no others.

[[method]]
name = "GradOpt"                          # stands in the tables
search = "gradopt"
objective = "deviation"                   # the path in the recorded world; or "steering", the shift on frames
trajectories = 5                          # T, recorded drives; scheme: group, group-all or random
swerves_m = [1.5]                         # how far pairs of them are pushed aside, in turn; then those that weave
weaves_m = [0.5]
noise_deg = [4, 20]                       # pushed by steering noise instead, as published
frames = 40                               # kept of every recorded drive
calibration = "two-paint"                 # or published, or pose
restarts = 3
iterations = 32                           # left out, what suits the objective
halving = true                            # whether many starts compete first
select = 1                                # candidates driven, of which the strongest is kept; 0 believes the first
rounds = 0

[[method]]
name = "GradOpt as published"
search = "published"                      # the paper's choices; see docs/published-and-improved.md
masks = "binary"                          # of its code; or "antialiased", of its text
trajectories = 3
noise_deg = [4, 20]
restarts = 4

[[method]]
name = "BO"
search = "published-bo"                   # or random, tpe, gp, cma-es: patterns chosen by their values alone
calls = 1000                              # patterns tried, each in a whole drive
random_calls = 400                        # published-bo: before the model guides
objective = "steering"                    # as published; or "deviation", what is reported
where = "simulator"                       # or "recorded", where drives cost no simulator
start = 4                                 # tries first as many patterns that GradOpt found, by the steering shift
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, TypeAlias

from roadproof.errors import StudyError
from roadproof.limits import MANY
from roadproof.study.reading import build, one_of, within

GRADOPT, PUBLISHED = "gradopt", "published"
SCHEMES = ("group", "group-all", "random")


@dataclass(frozen=True, kw_only=True, slots=True)
class GradOptPlan:
    """GradOpt with exact gradients; see the head of this module."""

    name: str
    search: str = GRADOPT
    objective: str = "deviation"
    trajectories: int = 5
    scheme: str = "group"
    swerves_m: tuple[float, ...] = (1.5,)
    weaves_m: tuple[float, ...] = (0.5,)
    noise_deg: tuple[int, int] | None = None
    frames: int = 40
    calibration: str = "two-paint"
    restarts: int = 3
    iterations: int | None = None
    halving: bool = True
    select: int = 1
    rounds: int = 0

    def __post_init__(self) -> None:
        # Late, since torch comes with it; a process that only passes plans on is spared.
        from roadproof.attacks import OBJECTIVES
        from roadproof.calibration import METHODS as CALIBRATIONS

        one_of(self.objective, "objective", tuple(OBJECTIVES))
        one_of(self.scheme, "scheme", SCHEMES)
        one_of(self.calibration, "calibration", CALIBRATIONS)
        within(self.restarts, "restarts", 1, 1000)
        within(self.frames, "frames", 1, MANY)
        within(self.iterations or 1, "iterations", 1, MANY)
        within(self.select, "select", 0, 1000)
        within(self.rounds, "rounds", 0, 100)
        _check_count(self.trajectories)
        if self.objective == "deviation" and (self.scheme != "group" or self.trajectories == 1):
            raise StudyError(
                "objective deviation is searched for each side apart; expected scheme group and trajectories 3 or more"
            )


@dataclass(frozen=True, kw_only=True, slots=True)
class PublishedPlan:
    """GradOpt as published; see the head of this module."""

    name: str
    search: str = PUBLISHED
    masks: str = "binary"
    trajectories: int = 3
    scheme: str = "group"
    noise_deg: tuple[int, int] = (4, 20)
    restarts: int = 4

    def __post_init__(self) -> None:
        from roadproof.attacks.published import MASKS

        one_of(self.masks, "masks", MASKS)
        one_of(self.scheme, "scheme", SCHEMES)
        within(self.restarts, "restarts", 1, 1000)
        _check_count(self.trajectories)


@dataclass(frozen=True, kw_only=True, slots=True)
class BlackBoxPlan:
    """A search without gradients; see the head of this module."""

    name: str
    search: str
    calls: int = 1000
    random_calls: int = 400
    objective: str = "deviation"
    where: str = "simulator"
    start: int = 0

    def __post_init__(self) -> None:
        from roadproof.pipeline.driven_objective import MEASURES

        one_of(self.objective, "objective", MEASURES)
        one_of(self.where, "where", ("simulator", "recorded"))
        within(self.calls, "calls", 1, MANY)
        within(self.random_calls, "random_calls", 1, MANY)
        within(self.start, "start", 0, 1000)
        if self.search == "published-bo" and self.random_calls >= self.calls:
            raise StudyError(f"random_calls is {self.random_calls} of {self.calls} calls; leave some for the model")
        if self.start and self.where == "recorded":
            raise StudyError(f"start is {self.start} with where recorded; expected 0, or where simulator")


MethodPlan: TypeAlias = GradOptPlan | PublishedPlan | BlackBoxPlan


def method_plan(values: Mapping[str, Any]) -> MethodPlan:
    """A method from its table.

    Raises:
        StudyError: it lacks a name or a known search, has a key that its search does not know, or a value makes no
            sense.
    """
    from roadproof.attacks import METHODS

    for name in ("name", "search"):
        if name not in values:
            raise StudyError(f"method lacks {name}")
    one_of(str(values["search"]), "search", tuple(METHODS))
    kinds = {GRADOPT: GradOptPlan, PUBLISHED: PublishedPlan}
    kind = kinds.get(str(values["search"]), BlackBoxPlan)
    return build(kind, values, f"method {values['name']}")


def _check_count(trajectories: int) -> None:
    from roadproof.drives.trajectories import COUNTS

    if trajectories not in COUNTS:
        raise StudyError(f"trajectories is {trajectories}, expected {', '.join(map(str, COUNTS))}")
