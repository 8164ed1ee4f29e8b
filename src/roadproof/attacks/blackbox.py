"""Searches without gradients: patterns chosen by their values alone, one whole drive each, predicted, or composited.

Every kind is a function from the trials so far to the next points. It keeps nothing between calls, and what is random
in it comes from the seed and the number of trials; a search that was killed therefore goes on exactly as it would have.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, ClassVar, TypeAlias, Unpack, cast

import torch
from jaxtyping import Float
from torch import Tensor

from roadproof.attacks import proposals
from roadproof.attacks.checkpoint import Checkpoint
from roadproof.attacks.driven import DrivenMeasure
from roadproof.attacks.gradopt import Running, Search, aim_of
from roadproof.attacks.method import Method
from roadproof.attacks.objective import Measure, Objective
from roadproof.errors import RoadproofError
from roadproof.search_space import Family, SearchSpace

AT_ONCE = 16
"""Patterns that are valued side by side on recordings."""

KEPT = 6
"""Of the patterns tried on recordings, so many stand in the result."""

Value: TypeAlias = Callable[[Float[Tensor, "b k n"]], Float[Tensor, " b"]]
"""Values of points of a search space, to be made large; a batch is what may be measured side by side."""


@dataclass(frozen=True, kw_only=True, slots=True)
class BlackBox(Method):
    """A search that knows patterns by their values alone; the base class of all methods without gradients.

    Args:
        calls: number of patterns tried, 1 or more.

    Raises:
        RoadproofError: a field is below 1.
    """

    by_gradient: ClassVar[bool] = False
    at_once: ClassVar[int] = AT_ONCE
    calls: int = 1000

    def __post_init__(self) -> None:
        at_least_one(self, "calls")

    def proposer(self, space: SearchSpace, seed: int) -> proposals.Propose:
        """The function that proposes the next points of a space."""
        raise NotImplementedError

    def proposer_after(self, _: int, /, space: SearchSpace, seed: int) -> proposals.Propose:
        """The same where so many first trials come from another search; by default they count as its own."""
        return self.proposer(space, seed)

    def steps(self, _: Objective, /) -> int:
        """The number of patterns tried, since `on_step` is called once for each."""
        return self.calls

    def search(self, measure: Measure, space: SearchSpace, **running: Unpack[Running]) -> Search:
        """Try patterns, on recordings several at once; the value of each is that of its best group."""
        groups = len(measure.groups)

        def value(unit: Float[Tensor, "b k n"]) -> Float[Tensor, " b"]:
            return measure.values(space, unit.to(measure.device).expand(groups, -1, -1, -1)).amax(0)

        given = running.get("starts", ())
        trials = blackbox_search(
            value,
            space,
            self,
            seed=running["seed"],
            at_once=1 if isinstance(measure, DrivenMeasure) else self.at_once,
            first=torch.cat(list(given)) if sum(map(len, given)) else None,
            world=measure.fingerprint(),
            measure=measure,
            checkpoint=running.get("checkpoint"),
            aim=aim_of(running),
            on_step=running.get("on_step", lambda _calls, _best: None),
        )
        best = trials.value.topk(min(KEPT, len(trials))).indices
        unit = trials.unit[best].float().to(measure.device).expand(groups, -1, -1, -1)
        return Search(unit, measure.values(space, unit), trials.best_so_far.float()[:, None, None])


@dataclass(frozen=True, kw_only=True, slots=True)
class RandomSearch(BlackBox):
    """Points drawn as the authors draw the starts of their gradient search."""

    word: ClassVar[str] = "random"

    def proposer(self, space: SearchSpace, seed: int) -> proposals.Propose:
        """Independent random points."""
        return proposals.random(space, seed)


@dataclass(frozen=True, kw_only=True, slots=True)
class TPE(BlackBox):
    """Optuna's tree of Parzen estimators."""

    word: ClassVar[str] = "tpe"

    def proposer(self, space: SearchSpace, seed: int) -> proposals.Propose:
        """Optuna's TPE sampler on the unit cube."""
        return proposals.optuna("tpe", space.figures * len(space.names), seed)


@dataclass(frozen=True, kw_only=True, slots=True)
class GaussianProcess(BlackBox):
    """Optuna's Gaussian process: Bayesian optimisation of today."""

    word: ClassVar[str] = "gp"

    def proposer(self, space: SearchSpace, seed: int) -> proposals.Propose:
        """Optuna's Gaussian process sampler on the unit cube."""
        return proposals.optuna("gp", space.figures * len(space.names), seed)


@dataclass(frozen=True, kw_only=True, slots=True)
class CMAES(BlackBox):
    """Covariance matrix adaptation."""

    word: ClassVar[str] = "cma-es"

    def proposer(self, space: SearchSpace, seed: int) -> proposals.Propose:
        """CMA-ES, begun at the middle of the unit cube."""
        return self.proposer_after(0, space, seed)

    def proposer_after(self, given: int, /, space: SearchSpace, seed: int) -> proposals.Propose:
        """CMA-ES, begun at the best of the points given."""
        return proposals.cma_es(space.figures * len(space.names), seed, given)


@dataclass(frozen=True, kw_only=True, slots=True)
class BayesianOptimisation(BlackBox):
    """Bayesian optimisation as the paper's baseline had it.

    Args:
        random_calls: number of the calls that are drawn at random before the model guides the rest; 0 takes two
            fifths, as published 400 of 1,000.
    """

    word: ClassVar[str] = "published-bo"
    family: ClassVar[Family] = "published-bo"
    at_once: ClassVar[int] = 1
    random_calls: int = 0

    def __post_init__(self) -> None:
        at_least_one(self, "calls")
        if self.random_calls == 0:
            object.__setattr__(self, "random_calls", max(1, self.calls * 2 // 5))
        at_least_one(self, "random_calls")

    def proposer(self, space: SearchSpace, seed: int) -> proposals.Propose:
        """The paper's Bayesian optimisation, on parameters in natural units (px, degrees, colour levels).

        Raises:
            RoadproofError: no call is left for the model.
        """
        # Not where it is made: results of such searches, which were all random, are still read.
        if self.random_calls >= self.calls > 1:
            raise RoadproofError(f"random_calls is {self.random_calls} of {self.calls} calls; leave some for the model")
        return proposals.published_bo(proposals.natural_ranges(space), self.random_calls, seed)


@dataclass(frozen=True, slots=True, eq=False)
class Trials:
    """What a search has tried, in order.

    Args:
        unit: the points tried, in the unit cube, (T, K, N) for T trials, K figures and N parameters each.
        value: value of each point, (T,).
        seconds: time at which each value was known, in seconds since the search began, (T,); pauses do not count.
        spent: frames through the controller and drives until each value was known, (T, 2); 0 where nobody counts.
    """

    unit: Float[Tensor, "t k n"]
    value: Float[Tensor, " t"]
    seconds: Float[Tensor, " t"]
    spent: Float[Tensor, "t 2"]

    def __len__(self) -> int:
        """How many points have been tried."""
        return len(self.value)

    @property
    def tensors(self) -> dict[str, Tensor]:
        """All of it by name, as a checkpoint keeps it."""
        return {each.name: getattr(self, each.name) for each in fields(self)}

    @property
    def best(self) -> int:
        """Index of the trial with the largest value."""
        return int(self.value.argmax())

    @property
    def best_so_far(self) -> Float[Tensor, " t"]:
        """The highest value up to each trial."""
        return self.value.cummax(0).values


def blackbox_search(
    value: Value,
    space: SearchSpace,
    method: BlackBox,
    *,
    seed: int = 0,
    at_once: int = 1,
    first: Float[Tensor, "f k n"] | None = None,
    world: str = "",
    measure: Measure | None = None,
    checkpoint: Path | None = None,
    aim: str = "",
    on_step: Callable[[int, float], object] = lambda _calls, _best: None,
) -> Trials:
    """Find the point of a search space with the largest value, without gradients.

    Args:
        value: function from points (P, K, N) of the unit cube to their values (P,), larger being better.
        space: the search space; the authors' Bayesian optimisation had the "published-bo" family.
        method: the black-box method that proposes the points.
        seed: seed of everything random, 0 by default.
        at_once: number of points proposed before their values are asked for, 1 or more.
        first: points (F, K, N) to try first, such as those of another search; the method goes on from their values.
        world: text that identifies what computes the values, so that a checkpoint of other values is not resumed.
        measure: what computes the values; a search that goes on counts its frames and drives on from those kept.
        checkpoint: file that keeps the trials after every call of `value`, so that an interrupted search goes on.
        aim: name of what is made large, which the checkpoint says; a search for another is refused there.
        on_step: called after every batch with the number of points tried and the best value so far.

    Raises:
        RoadproofError: `at_once` is out of range for the method, a value is not finite, or the checkpoint is of another
            objective.
    """
    if at_once < 1:
        raise RoadproofError(f"at_once is {at_once}, expected 1 or more")
    if at_once > 1 == method.at_once:
        raise RoadproofError(
            f"at_once is {at_once}, but {method.word} proposes one point at a time; run several scenarios side by side"
        )
    given = None if first is None else cast("list[Any]", first.tolist())
    propose = method.proposer_after(len(given or ()), space, seed)
    # More calls are the same search, gone on with, unless more are drawn at random for them.
    settings = {name: each for name, each in asdict(method).items() if name != "calls"}
    identity = repr((space, method.word, settings, seed, at_once, given, world))
    keeping = Checkpoint(checkpoint, identity, aim)
    nothing = torch.empty(0, dtype=torch.float64)
    none = {"unit": nothing.new_empty(0, space.figures, len(space.names)), "value": nothing, "seconds": nothing}
    kept = keeping.load(torch.device("cpu")) or none
    count = len(kept["value"])
    kept.setdefault("spent", nothing.new_zeros(count, 2))  # of an older version
    if count < method.calls:  # a batch that fewer calls had cut short is proposed again as a whole
        count -= max(0, count - len(given or ())) % at_once
    trials = Trials(**{name: each[: min(count, method.calls)] for name, each in kept.items()})
    before_s = float(trials.seconds[-1]) if len(trials) else 0.0
    if measure is not None and len(trials):
        _count_on(measure, trials.spent[-1])
    started = time.perf_counter()
    while len(trials) < method.calls:
        flat, known = trials.unit.flatten(1).numpy(), trials.value.numpy()
        wanted = min(at_once, method.calls - len(trials))
        if first is not None and len(trials) < len(first):
            unit = first[len(trials) : len(trials) + wanted].double()
        else:
            proposed = propose(flat, known, wanted)
            unit = torch.as_tensor(proposed).view(-1, space.figures, len(space.names))
        found = value(unit.float()).double().cpu()
        if not bool(found.isfinite().all()):
            raise RoadproofError(f"the value is NaN or infinite at call {len(trials) + 1}; check the controller")
        now = torch.full_like(found, before_s + time.perf_counter() - started)
        more = Trials(unit, found, now, _spent(measure).expand(len(found), 2)).tensors
        trials = Trials(**{name: torch.cat([before, more[name]]) for name, before in trials.tensors.items()})
        keeping.save(trials.tensors)
        on_step(len(trials), float(trials.value.max()))
    return trials


def _spent(measure: Measure | None) -> Float[Tensor, "2"]:
    """Frames through the controller and drives so far."""
    drives = measure.calls if isinstance(measure, DrivenMeasure) else 0
    return torch.tensor([0 if measure is None else measure.frames_evaluated, drives], dtype=torch.float64)


def _count_on(measure: Measure, spent: Float[Tensor, "2"]) -> None:
    """Have a measure count on from what a search had spent when it was interrupted."""
    measure.frames_evaluated = int(spent[0])
    if isinstance(measure, DrivenMeasure):
        measure.calls = int(spent[1])


def at_least_one(method: object, *names: str) -> None:
    """Check that fields of a method are whole numbers from 1, or None.

    Raises:
        RoadproofError: a field is something else; the message names it.
    """
    for name in names:
        number = getattr(method, name)
        if number is not None and (isinstance(number, bool) or not isinstance(number, int) or number < 1):
            raise RoadproofError(f"{name} is {number!r}, expected a whole number from 1")
