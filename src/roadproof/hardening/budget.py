"""What a hardening spends, and the streets it may not mix up."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

from roadproof.attacks import TPE, GradOpt, Method
from roadproof.attacks.blackbox import BlackBox
from roadproof.attacks.objective import varied
from roadproof.compositing import Variation
from roadproof.coverage import Shape
from roadproof.datatypes import PAPER_WEATHERS, Weather
from roadproof.errors import TrainingError
from roadproof.hardening.tuning import Tuning
from roadproof.limits import is_whole
from roadproof.pipeline.budget import QUICK, Budget
from roadproof.scenarios import Scenario
from roadproof.search_space import SearchSpace

APART_M = 40.0
"""Canvases nearer than this lie on one street: a driver sees the one from 25 m on, and it is up to 10 m long."""

ALONE = replace(QUICK, weathers=(Weather.CLEAR_NOON,))


@dataclass(frozen=True, kw_only=True, slots=True)
class HardeningBudget:
    """How much is spent.

    Args:
        attack: the attack on each street for training, in each round; its evaluation is the round's re-test.
        tuning: the fine-tuning in each round, after the attacks.
        town_drives: drives through the built-in town before each tuning, by the controller as it is then, whose frames
            keep clean driving as it was; none are made in another simulator.
        judge: the fresh attack on each street for judging.
        unseen: a method that training did not use, for judging; its patterns are tried in the recorded world.
        unseen_shape: a shape that training does not use, for judging.
        clean_weathers: the weathers in which drives over the bare road are counted.

    Raises:
        TrainingError: an attack does not drive in the recorded world, training attacks by the method that is to be
            unseen, a number of drives is below 0, or no weather is given for drives over the bare road.
    """

    attack: Budget = field(default_factory=lambda: replace(ALONE, method=GradOpt(restarts=1)))
    tuning: Tuning = field(default_factory=Tuning)
    town_drives: int = 80
    judge: Budget = field(default_factory=lambda: replace(ALONE, starts=4))
    unseen: Method = field(default_factory=lambda: TPE(calls=100))
    unseen_shape: Shape = Shape.ELLIPSE
    clean_weathers: tuple[Weather, ...] = PAPER_WEATHERS

    def __post_init__(self) -> None:
        if not (self.attack.is_predicted and self.judge.is_predicted):
            raise TrainingError("hardening searches in the recorded world; give attack and judge a path deviation")
        if self.unseen == self.attack.method:
            raise TrainingError(
                f"unseen is {self.unseen.word}, by which training attacks; give another method or budget"
            )
        if not is_whole(self.town_drives) or self.town_drives < 0 or not self.clean_weathers:
            raise TrainingError(
                f"{self.town_drives!r:.40} drives through the town, {len(self.clean_weathers)} weathers of clean "
                "drives; expected 0 or more, and at least one"
            )

    def varied(self, variation: Variation | None) -> HardeningBudget:
        """The same budget with all searches in expectation over a variation."""
        attack, judge = (
            replace(each, objective=varied(each.objective, variation)) for each in (self.attack, self.judge)
        )
        return replace(self, attack=attack, judge=judge)

    def in_weathers(self, weathers: tuple[Weather, ...]) -> HardeningBudget:
        """The same budget with attacks, learning and judging in the mean over these weathers.

        A budget whose patterns are driven over in several weathers, when they are judged, still does so in those.
        """
        attack, judge = (
            replace(
                each,
                weathers=tuple(dict.fromkeys((*weathers, *(each.weathers if len(each.weathers) > 1 else ())))),
                attack_weathers=weathers if len(weathers) > 1 else (),
            )
            for each in (self.attack, self.judge)
        )
        return replace(self, attack=attack, judge=judge)

    def require_unseen(self, space: SearchSpace) -> None:
        """See that judging can attack as training does not.

        Raises:
            TrainingError: training paints the shape that is to be unseen.
            RoadproofError: the library of the black-box method is not installed.
        """
        if space.shape is self.unseen_shape:
            raise TrainingError(
                f"{space.shape}s are painted in training, so none are unseen in judging; give another unseen_shape"
            )
        if isinstance(self.unseen, BlackBox):
            self.unseen.proposer(space, 0)

    def learnt(self, space: SearchSpace) -> tuple[SearchSpace, ...]:
        """What training paints from: the space of its attacks without limits, and free figures of each shape seen."""
        own = space.unlimited
        if space.limits is not None and space.limits.keep_out_m is not None:
            # What keeps clear of lane marks was moved and cut, which the published families cannot say.
            own = replace(own, family="free")
        free = [replace(own, family="free", shape=shape) for shape in Shape if shape is not self.unseen_shape]
        return own, *(each for each in free if each != own)

    def kinds(self, space: SearchSpace) -> dict[str, tuple[Method, SearchSpace]]:
        """What judging searches besides `judge`: method and search space by the name of the kind."""
        shapes = replace(space, family="free", shape=self.unseen_shape)
        return {
            f"{self.unseen.word}, {self.unseen.steps(self.judge.objective)} patterns tried": (self.unseen, space),
            f"{self.unseen_shape}s {self._how}": (self.judge.method, shapes),
        }

    @property
    def searched(self) -> str:
        """The kind of attack of `judge`, in words."""
        return f"{self._how}, as in training" if self.judge.method.word == self.attack.method.word else self._how

    @property
    def _how(self) -> str:
        return "by gradient" if self.judge.method.by_gradient else f"by {self.judge.method.word}"


HARDENING_BUDGETS = {
    "quick": HardeningBudget(),
    "full": HardeningBudget(
        attack=replace(ALONE, method=GradOpt(restarts=6), select=3),
        tuning=Tuning(steps=10_000),
        town_drives=160,
        judge=replace(QUICK, select=4, starts=2),
        unseen=TPE(calls=400),
    ),
}
"""Named budgets; docs/hardening.md says what they take, by streets and rounds."""


def check_streets(training: Sequence[Scenario], judging: Sequence[Scenario]) -> None:
    """See that there is something to train on, and that no street is trained on and judged on.

    Raises:
        TrainingError: there is no scenario to train on, one is given twice, or two canvases lie on one street.
    """
    if not training:
        raise TrainingError("there is no scenario to train on; give at least one")
    for given in (training, judging):
        names = [each.name for each in given]
        if len(set(names)) < len(names):
            raise TrainingError(f"scenarios {', '.join(names)} name one twice; give each once")
    for one in training:
        for other in judging:
            if (apart_m := _apart_m(one, other)) < APART_M:
                raise TrainingError(
                    f"{one.name} is trained on and {other.name} judged on, but their canvases lie {apart_m:.0f} m "
                    f"apart, on one street; expected at least {APART_M:.0f} m: choose another street for judging"
                )


def by_street(scenarios: Sequence[Scenario]) -> tuple[tuple[str, ...], ...]:
    """The names of the scenarios, those together that lie on one street: each less than `APART_M` from another."""
    found: list[list[Scenario]] = []
    for each in scenarios:
        near = [street for street in found if any(_apart_m(each, other) < APART_M for other in street)]
        found = [street for street in found if street not in near] + [
            [*(other for street in near for other in street), each]
        ]
    return tuple(tuple(each.name for each in street) for street in found)


def _apart_m(one: Scenario, other: Scenario) -> float:
    """How far apart two canvases are, metres; on two maps they are nowhere near."""
    if one.map_name != other.map_name:
        return math.inf
    return math.dist((one.canvas.x_m, one.canvas.y_m), (other.canvas.x_m, other.canvas.y_m))
