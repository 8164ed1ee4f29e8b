"""How a pattern is searched, as objects: GradOpt, GradOpt as published, and searches without gradients.

    attack(recordings, controller, space, method=GradOpt(restarts=3), objective=PathDeviation())
    attack(recordings, controller, space, method=CMAES(calls=1000), objective=PathDeviation())
    attack(recordings, controller, space, method=Published(), objective=SteeringShift())

A method knows what to make large only by its measure; where a pattern's value comes from is the objective's.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields, is_dataclass, replace
from typing import Any, ClassVar, Unpack, cast

import torch

from roadproof.attacks.blackbox import CMAES, TPE, BayesianOptimisation, GaussianProcess, RandomSearch, at_least_one
from roadproof.attacks.gradopt import Ladder, Rung, Running, Search, dropping, gradopt
from roadproof.attacks.groups import Group
from roadproof.attacks.method import Method
from roadproof.attacks.objective import Measure, Objective, RecordedMeasure, SteeringShift
from roadproof.attacks.published import MASKS, PublishedMeasure
from roadproof.controllers import Controller
from roadproof.errors import PatternError, RoadproofError
from roadproof.io.known import known_by
from roadproof.recordings import RecordingSet
from roadproof.search_space import SearchSpace


@dataclass(frozen=True, kw_only=True, slots=True)
class GradOpt(Method):
    """Exact gradients, and starts that compete (successive halving) before the best of them are searched to the end.

    Args:
        iterations: number of steps of the full search; by default 100 for a steering shift and 32 for a path deviation
            or a speed change.
        restarts: number of starts per group that are searched to the end.
        halving: whether many starts compete for these places (successive halving); otherwise the starts are random.

    Raises:
        RoadproofError: `iterations` or `restarts` is below 1.
    """

    word: ClassVar[str] = "gradopt"
    iterations: int | None = None
    restarts: int = 4
    halving: bool = True

    def __post_init__(self) -> None:
        at_least_one(self, "iterations", "restarts")
        most = min(rung.starts for rung in (*SHIFT_RUNGS, *PATH_RUNGS))
        if self.halving and self.restarts > most:
            raise RoadproofError(
                f"restarts is {self.restarts}, expected 1 to {most} places to compete for; or no halving"
            )

    def ladder(self, objective: Objective) -> Ladder:
        """The rungs of the search for an objective.

        A search in the recorded world takes smaller steps, since a loop amplifies. It begins where the steering shift
        is large: a controller that holds its lane well brings the car back from what a random pattern does, and the
        path has hardly a gradient there, while what also turns the wheel where a car is aside takes it further
        (measured). Random patterns join them, for controllers that need no such help. Most starts are the best of many
        that are valued once, which helps with controllers that random patterns hardly move, and the others at random,
        which helps with those that nearly every pattern moves (measured). Figures of two good patterns together are
        often better than either (measured). A side to which the car hardly goes gives its places to the other. Where
        it goes to neither, as happens with CIL and chance alone decides, all begins once more from other points.
        """
        shift = isinstance(objective, SteeringShift)
        rate, usual, first = (0.1, 100, SHIFT_RUNGS) if shift else (0.05, 32, PATH_RUNGS)
        proper = dropping(
            self.restarts,
            self.iterations or usual,
            rate,
            after=(0.5, 0.8),
            factor=0.3,
        )
        if not self.halving:
            return proper
        if not shift:
            proper = replace(proper[0], groups_compete=True, needs=NOWHERE), *proper[1:]
        return *first, *proper

    def steps(self, objective: Objective, /) -> int:
        """Number of iterations of all rungs together."""
        return sum(rung.iterations for rung in self.ladder(objective))

    def search(self, measure: Measure, space: SearchSpace, **running: Unpack[Running]) -> Search:
        """Climb all rungs of the search by gradient."""
        ladder = self.ladder(running.get("objective", SteeringShift()))
        return gradopt(cast("RecordedMeasure", measure), space, ladder, **running)


NOWHERE = 0.2
"""Metres aside on average, or m/s, below which a car has hardly been moved."""

SHIFT_RUNGS = (Rung(24, 30, every=4), Rung(8, 30, every=2))
PATH_RUNGS = (
    Rung(24, 12, every=8, open_loop=True, screened=16),
    Rung(32, 4, every=6),
    Rung(6, 10, every=4, offspring=128),
)
"""On which starts compete before a search of the steering shift, and of the path; most for their cost (measured)."""


@dataclass(frozen=True, slots=True)
class _OnGrid(Rung):
    """Steps with gradients linearised on a grid of px and degrees."""

    grid: float = 1.0

    def view(self, measure: RecordedMeasure) -> RecordedMeasure:
        """The published measure, linearised on this rung's grid."""
        return cast("PublishedMeasure", measure).on_grid(self.grid)


@dataclass(frozen=True, kw_only=True, slots=True)
class Published(Method):
    """GradOpt as its authors published it: to compare with, not to use.

    Locally linearised gradients, Adam without momentum, random starts of 250 iterations each with rates of 0.1, 0.01
    and 0.001, each rate beginning at the best point so far; differences of steering summed over frames. A grid of 10 px
    or degrees at the first rate and of 1 after it, as the released code was run.

    Args:
        masks: "binary", the masks of the released code, or "antialiased", those of the paper's text.
        restarts: number of starts per group; the paper's text has four, its code one.

    Raises:
        RoadproofError: `masks` is another word, or `restarts` is below 1.

    References:
        "Attack Optimization" of the paper; run.sh of the released code. There TensorFlow's Adam corrects its bias
        twice an iteration, which makes early steps up to 1.4 times larger; that is not done here.
    """

    word: ClassVar[str] = "published"
    masks: str = "binary"
    restarts: int = 4

    def __post_init__(self) -> None:
        at_least_one(self, "restarts")
        if self.masks not in MASKS:
            raise RoadproofError(f"masks is {self.masks!r}, expected {' or '.join(MASKS)}")

    def steps(self, _: Objective, /) -> int:
        """The number of iterations, 250."""
        return sum(rung.iterations for rung in self.ladder)

    @property
    def ladder(self) -> Ladder:
        """The rungs of the three published learning rates."""
        stages = ((100, 0.1, 10.0), (100, 0.01, 1.0), (50, 0.001, 1.0))
        return tuple(_OnGrid(self.restarts, count, rate, grid=grid) for count, rate, grid in stages)

    def measure(
        self,
        objective: Objective,
        recordings: RecordingSet,
        controller: Controller,
        groups: Sequence[Group],
        *,
        device: torch.device | str,
    ) -> PublishedMeasure:
        """The published divergence, a sum over frames, as the measure.

        Raises:
            RoadproofError: the objective is not a steering shift without variation, or the recordings have pixel maps,
                which binary masks know nothing of.
        """
        self.check_objective(objective)
        if self.masks == "binary" and any(drive.maps is not None for drive in recordings.recordings):
            raise RoadproofError(
                "the published search knows light by a colour transform alone, and these recordings have it in pixel "
                "maps; calibrate with --method published, or choose antialiased masks"
            )
        return PublishedMeasure(recordings, controller, groups, masks=self.masks, device=device)

    def check_space(self, space: SearchSpace) -> None:
        """Check that the patterns are those of the publication: its rectangles, in any colour, without limits.

        Raises:
            PatternError: the space has limits on paint or colour, or a family that the search had not.
        """
        limited = space.max_painted_share is not None or space.limits is not None or space.albedo != (0.0, 1.0)
        if space.family not in ("published", "published-canvas-centre") or limited:
            raise PatternError(
                "the published search knows the families published and published-canvas-centre alone, without limits "
                "on paint or albedo; change them, or search with method gradopt"
            )

    def check_objective(self, objective: Objective) -> None:
        """Check that what is made large is what the publication made large.

        Raises:
            RoadproofError: the objective is not a steering shift, or one in expectation.
        """
        if not isinstance(objective, SteeringShift):
            raise RoadproofError(f"the published search enlarges the steering shift, not the {objective.name}")
        if objective.variation is not None:
            raise RoadproofError("the published search knows no variation; leave it out, or search with method gradopt")

    def search(self, measure: Measure, space: SearchSpace, **running: Unpack[Running]) -> Search:
        """Search by gradient as published."""
        return gradopt(cast("RecordedMeasure", measure), space, self.ladder, momentum=0.0, **running)


METHODS: dict[str, type[Any]] = {
    kind.word: kind for kind in (GradOpt, Published, RandomSearch, TPE, GaussianProcess, CMAES, BayesianOptimisation)
}
"""Every method by its word."""


def method_of(word: str, **given: object) -> Method:
    """The method of a word such as "gradopt", with values for its fields.

    Raises:
        RoadproofError: no method has that word, it has no such field, or a value is out of range.
    """
    if word not in METHODS:
        raise RoadproofError(f"method is {word!r}, expected one of {', '.join(METHODS)}")
    kind = METHODS[word]
    known = [field.name for field in fields(kind)]
    for name in given:
        if name not in known:
            raise RoadproofError(f"method {word} has no {name}; it has {', '.join(known)}")
    return kind(**given)


def stored(method: Method) -> dict[str, Any]:
    """A method as its word and its fields, as files store it; of one of the user's own, without fields, what it is."""
    if not is_dataclass(method):
        return {"method": method.word, "own": known_by(method)}
    return {"method": method.word, **asdict(cast("Any", method))}
