"""What each limit on paint costs an attack, in metres: what a search finds without it, beside one with all of them.

FOLDER/LIMIT/         the search without a limit, or without any (`attacks.kept_attack`)
FOLDER/selection/     a drive over what each of them found, where it was driven
FOLDER/limits.json    what came of it
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

import torch

from roadproof.attacks import AttackResult, Objective, PathDeviation, kept_attack
from roadproof.attacks.groups import Group
from roadproof.controllers import Controller
from roadproof.errors import PatternError, RoadproofError
from roadproof.io.records import RecordFile, Saved
from roadproof.paint import Conspicuousness, PaintLimits
from roadproof.paint.limits import ANY
from roadproof.pipeline.selection import Selection
from roadproof.processes import Pool
from roadproof.recordings import RecordingSet
from roadproof.search_space import SearchSpace

LIMIT_COSTS = "limits/limits.json"
"""The file of a run with what its limits cost; in its folder lie the searches."""

OnStep: TypeAlias = Callable[[int, int, str], object]
"""Called with the steps done, all of them, and a word on the search."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Unlimited:
    """What a search found without a limit.

    Args:
        without: the limit that it did without, such as "area", or "any"; empty for the search with all of them.
        predicted_m: the paper's deviation in the recorded world, metres, mean over recorded weathers and small errors.
        predicted_range_m: least and largest of these predicted deviations, metres.
        conspicuousness: how conspicuous the pattern is on this road.
        driven_m: the paper's deviation in one drive over the pattern, metres; None where nothing was driven.
    """

    without: str
    predicted_m: float
    predicted_range_m: tuple[float, float]
    conspicuousness: Conspicuousness | None
    driven_m: float | None = None

    @staticmethod
    def of(without: str, found: AttackResult) -> Unlimited:
        """What a search in the recorded world found."""
        assert found.predicted_m is not None
        assert found.predicted_range_m is not None
        return Unlimited(
            without=without,
            predicted_m=found.predicted_m,
            predicted_range_m=found.predicted_range_m,
            conspicuousness=found.conspicuousness,
        )


@dataclass(frozen=True, kw_only=True, slots=True)
class LimitCosts(Saved):
    """What limits on paint cost an attack. One search each: a cost below zero is chance.

    Args:
        searches: what was found with all limits, then without each, then without any.

    Raises:
        RoadproofError: there are no searches, or some patterns alone were driven over.
    """

    searches: tuple[Unlimited, ...]

    def __post_init__(self) -> None:
        driven = sum(each.driven_m is not None for each in self.searches)
        if not self.searches or driven not in (0, len(self.searches)):
            raise RoadproofError(
                f"{len(self.searches)} searches, {driven} driven over; expected one or more, and all driven or none"
            )

    @staticmethod
    def of(found: AttackResult, searched: Mapping[str, AttackResult]) -> LimitCosts:
        """What a search with all limits found, and others by the limit left out; nobody has driven over it yet."""
        return LimitCosts(searches=tuple(Unlimited.of(name, each) for name, each in {"": found, **searched}.items()))

    def predicted_cost_m(self, one: Unlimited) -> float:
        """The predicted metres that a search found more than the one with all limits."""
        return one.predicted_m - self.searches[0].predicted_m

    def driven_cost_m(self, one: Unlimited) -> float | None:
        """The driven metres that its pattern deviated more than that of the search with all limits."""
        given = self.searches[0].driven_m
        return None if one.driven_m is None or given is None else one.driven_m - given

    @property
    def sentences(self) -> tuple[str, ...]:
        """What each limit costs, for people."""
        told: list[str] = []
        for each in self.searches[1:]:
            driven, more_m = each.driven_m, self.driven_cost_m(each)
            limit = "any limit on paint" if each.without == ANY else f"the limit on {each.without}"
            told.append(
                f"Without {limit}: predicted {each.predicted_m:.2f} m, {self.predicted_cost_m(each):+.2f} m"
                + ("" if driven is None or more_m is None else f"; driven {driven:.2f} m, {more_m:+.2f} m")
            )
        return tuple(told)

    def driven(self, selection: Selection) -> LimitCosts:
        """The same with the drives over the patterns, which are in the order of the searches."""
        metres = [None if selection.predicted else each.trial.deviation_m for each in selection.driven]
        return LimitCosts(
            searches=tuple(replace(each, driven_m=m) for each, m in zip(self.searches, metres, strict=True))
        )


LimitCosts.FILE = RecordFile(
    kind=LimitCosts,
    name="roadproof-limit-costs",
    error=RoadproofError,
    remedy="remove it to make it again",
)


def search_without(
    folder: Path,
    recordings: RecordingSet,
    controller: Controller,
    found: AttackResult,
    *,
    objective: Objective,
    groups: Sequence[Group],
    device: torch.device | str = "cpu",
    pool: Pool[Any] | None = None,
    on_step: OnStep = lambda _done, _total, _word: None,
) -> dict[str, AttackResult]:
    """Search afresh without each limit on paint, and without any, as the search with all of them.

    Args:
        folder: folder that keeps each search, which goes on there.
        recordings: the calibrated recordings that were searched.
        controller: the controller that was attacked, on `device`.
        found: result of the search with all limits.
        objective: objective of that search, a path deviation.
        groups: the groups of drives of that search.
        device: torch device on which the searches compute.
        pool: processes that search the groups side by side.
        on_step: called after every step of every search.

    Returns:
        What was found, by the limit left out.
    """
    relaxed, steps = relaxed_limits(found.space, objective), found.method.steps(objective)
    results: dict[str, AttackResult] = {}
    for name, rest in relaxed.items():
        done = len(results) * steps
        results[name] = kept_attack(
            folder / name.replace(" ", "-"),
            recordings,
            controller,
            replace(found.space, limits=None if rest == PaintLimits() else rest, site=None),
            objective=objective,
            method=found.method,
            groups=groups,
            seed=found.seed,
            device=device,
            pool=pool,
            on_step=partial(_tell, on_step, done, len(relaxed) * steps, f"without {name}"),
        )
    return results


def relaxed_limits(space: SearchSpace, objective: Objective) -> Mapping[str, PaintLimits]:
    """The limits of a space without each of them, by its name, and without any, where that is asked for.

    Raises:
        PatternError: there is no limit, or the space has one of its own.
        RoadproofError: the search is not for a path deviation.
    """
    if not isinstance(objective, PathDeviation):
        raise RoadproofError(
            f"limit costs are in metres of deviation, the search is for the {objective.name}; leave one of them out"
        )
    if space.max_painted_share is not None:
        raise PatternError(
            f"limit costs know no max_painted_share, which is {space.max_painted_share:g}; limit the area in m² instead"
        )
    if space.limits is None or not space.limits.relaxed:
        raise PatternError("limit costs were asked for, but there is no limit on paint; give one, such as --max-area")
    return space.limits.relaxed


def _tell(on_step: OnStep, before: int, total: int, word: str, step: int, _best: float) -> None:
    on_step(before + step, total, word)
