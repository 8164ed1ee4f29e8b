"""The methods that a study's plan can name, each with its own settings and no others.

Every class is a `[[method]]` of the plan; docs/studies.md shows one of each. A job is known by a hash of these fields
and their values: rename one, and finished jobs are unknown.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Annotated, Any, Literal, TypeAlias, TypeGuard, cast

import msgspec

from roadproof.attacks import METHODS, OBJECTIVES, BayesianOptimisation, BlackBox, GradOpt, Published, method_of
from roadproof.attacks.objective import varied
from roadproof.calibration import CalibrationMethod
from roadproof.compositing import Variation
from roadproof.datatypes import Weather
from roadproof.drives import Scheme, SteeringNoise, Swerve, Trajectories, Window
from roadproof.errors import StudyError
from roadproof.io.tables import build
from roadproof.limits import MANY
from roadproof.pipeline.budget import PUBLISHED, QUICK, Budget
from roadproof.search_space import Family

# What begins a number is checked by the object that it goes into; a plan may come from anyone, so it also has an end.
Hundred: TypeAlias = Annotated[int, msgspec.Meta(le=100)]
Thousand: TypeAlias = Annotated[int, msgspec.Meta(le=1000)]
Many: TypeAlias = Annotated[int, msgspec.Meta(le=MANY)]
RANDOM_CALLS = BayesianOptimisation().random_calls
Groups: TypeAlias = Literal["group", "group-all", "random"]


@dataclass(frozen=True, kw_only=True, slots=True)
class GradOptPlan:
    """GradOpt with exact gradients.

    Raises:
        RoadproofError: a value is out of its range, or does not go with another.
    """

    name: str  # stands in the tables
    search: str = GradOpt.word
    objective: Literal["deviation", "steering"] = "deviation"  # the path in the recorded world, or the shift on frames
    trajectories: int = 5  # T, recorded drives
    scheme: Groups = "group"  # group-all: one pool; random: each drive perturbed to both sides
    swerves_m: tuple[float, ...] = (1.5,)  # offsets of pairs of drives, in turn; then those of pairs that weave
    weaves_m: tuple[float, ...] = (0.5,)
    noise_deg: tuple[int, int] | None = None  # perturbed by steering noise instead, as published
    frames: Many = 40  # kept of every recorded drive
    calibration: CalibrationMethod = CalibrationMethod.TWO_PAINT
    restarts: Thousand = 3
    iterations: Many | None = None  # None: what suits the objective
    halving: bool = True  # whether many starts compete first
    select: Thousand = 1  # candidates driven, of which the strongest is kept; 0 believes the first
    rounds: Hundred = 0  # of searching on along the way that the attacked car took
    attack_weathers: tuple[Weather, ...] = ()  # recorded in each, searched for their mean; empty: the study's first

    def __post_init__(self) -> None:
        if self.objective == "deviation" and (self.scheme != "group" or self.trajectories == 1):
            raise StudyError(
                "objective deviation is searched for each side apart; expected scheme group and trajectories 3 or more"
            )
        budget_of(self, Weather.CLEAR_NOON)


@dataclass(frozen=True, kw_only=True, slots=True)
class PublishedPlan:
    """GradOpt as published (docs/published-and-improved.md).

    Raises:
        RoadproofError: a value is out of its range.
    """

    name: str
    search: str = Published.word
    masks: str = "binary"  # of the authors' code; or antialiased, of the paper's text
    trajectories: int = 3
    scheme: Groups = "group"
    noise_deg: tuple[int, int] = (4, 20)
    restarts: Thousand = 4

    def __post_init__(self) -> None:
        budget_of(self, Weather.CLEAR_NOON)


@dataclass(frozen=True, kw_only=True, slots=True)
class BlackBoxPlan:
    """A search without gradients: it knows patterns by their values alone.

    Raises:
        RoadproofError: a value is out of its range, or does not go with another.
    """

    name: str
    search: str  # published-bo, random, tpe, gp or cma-es
    calls: Many = 1000  # patterns tried, each in a whole drive
    random_calls: int = RANDOM_CALLS  # published-bo alone: before the model guides
    objective: Literal["steering", "deviation"] = "deviation"  # as published, or what is reported
    where: Literal["simulator", "recorded"] = "simulator"  # recorded: drives cost no simulator
    start: Annotated[int, msgspec.Meta(ge=0, le=1000)] = 0  # of GradOpt's patterns, by steering, are tried first

    def __post_init__(self) -> None:
        budget_of(self, Weather.CLEAR_NOON)
        guided = self.search == BayesianOptimisation.word
        if not guided and self.random_calls != RANDOM_CALLS:
            raise StudyError(f"random_calls is {self.random_calls}, which search {self.search} has not; leave it out")
        if guided and self.random_calls >= self.calls:
            raise StudyError(f"random_calls is {self.random_calls} of {self.calls} calls; leave some for the model")
        if self.start and self.where == "recorded":
            raise StudyError(f"start is {self.start} with where recorded; expected 0, or where simulator")


MethodPlan: TypeAlias = GradOptPlan | PublishedPlan | BlackBoxPlan


def tries_by_driving(method: MethodPlan) -> TypeGuard[BlackBoxPlan]:
    """Whether a method drives over each of its patterns in the simulator, where nothing is recorded or measured."""
    return isinstance(method, BlackBoxPlan) and method.where == "simulator"


def family_of(method: MethodPlan) -> Family:
    """Where the figures of a method lie: published rectangles, in bounds of its own for the published baseline."""
    return METHODS[method.search].family


def method_plan(values: Mapping[str, Any]) -> MethodPlan:
    """Read a method from its table in a plan.

    Raises:
        StudyError: the table lacks a name or a known search, has a key that its search does not know, or a value makes
            no sense.
    """
    for name in ("name", "search"):
        if name not in values:
            raise StudyError(f"method lacks {name}")
    name = values["name"]
    if not isinstance(name, str) or not name.strip() or not name.isprintable():
        raise StudyError(f"name of a method is {name!r:.60}, expected letters that can be printed")
    word = str(values["search"])
    if word not in METHODS:
        raise StudyError(f"search is {word!r:.60}, expected one of {', '.join(METHODS)}")
    kinds = {GradOpt.word: GradOptPlan, Published.word: PublishedPlan}
    kind = kinds.get(word, BlackBoxPlan)
    others = {each.name for other in (GradOptPlan, PublishedPlan, BlackBoxPlan) for each in fields(other)}
    for key in values:
        if key in others - {each.name for each in fields(kind)}:
            raise StudyError(f"method {name}: search {word} has no {key}; leave it out, or choose another search")
    return build(kind, values, f"method {name}", StudyError)


def budget_of(method: MethodPlan, weather: Weather, variation: Variation | None = None) -> Budget:
    """What a method spends on finding a pattern in recordings, in one weather, in expectation over a variation.

    Raises:
        RoadproofError: a value of the method is out of its range.
    """
    match method:
        case GradOptPlan():
            swerve = Swerve(method.swerves_m, method.weaves_m)
            least_px = (QUICK.window if method.objective == "deviation" else Window()).least_px
            budget = replace(
                QUICK,
                weathers=(weather,),
                method=GradOpt(iterations=method.iterations, restarts=method.restarts, halving=method.halving),
                objective=OBJECTIVES[method.objective],
                trajectories=_trajectories(
                    method, swerve if method.noise_deg is None else SteeringNoise(*method.noise_deg)
                ),
                window=Window(frames=method.frames, least_px=least_px),
                pooled=method.scheme != "group",
                calibration=method.calibration,
                select=method.select,
                rounds=method.rounds,
                attack_weathers=method.attack_weathers,
            )
        case PublishedPlan():
            budget = replace(
                PUBLISHED,
                weathers=(weather,),
                runs=0,
                method=Published(masks=method.masks, restarts=method.restarts),
                trajectories=_trajectories(method, SteeringNoise(*method.noise_deg)),
                pooled=method.scheme != "group",
            )
        case BlackBoxPlan():
            budget = replace(
                QUICK, weathers=(weather,), method=black_box(method), objective=OBJECTIVES[method.objective]
            )
    return replace(budget, objective=varied(budget.objective, variation))


def black_box(method: BlackBoxPlan) -> BlackBox:
    """The black-box search that a plan's method means.

    Raises:
        RoadproofError: a value of the method is out of its range.
    """
    more = {"random_calls": method.random_calls} if method.search == BayesianOptimisation.word else {}
    return cast("BlackBox", method_of(method.search, calls=method.calls, **more))


def _trajectories(method: GradOptPlan | PublishedPlan, how: Swerve | SteeringNoise) -> Trajectories:
    scheme = Scheme.RANDOM if method.scheme == "random" else Scheme.GROUP
    return Trajectories(count=method.trajectories, scheme=scheme, perturbation=how)
