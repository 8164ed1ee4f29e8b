"""Black-box search: patterns chosen by their values alone, however those are had, one whole drive each or composited.

Every method is a function from the trials so far to the next points. It keeps nothing between calls, and what is random
in it comes from the seed and the number of trials; a search that was killed therefore goes on exactly as it would have.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeAlias, cast, get_args

import torch
from jaxtyping import Float
from torch import Tensor

from roadproof.attacks import proposals
from roadproof.attacks.checkpoint import load_checkpoint, save_checkpoint
from roadproof.errors import RoadproofError
from roadproof.search_space import SearchSpace

Method = Literal["random", "published-bo", "gp", "tpe", "cma-es"]
METHODS: tuple[Method, ...] = get_args(Method)
PUBLISHED_RANDOM = 400
"""Random points before the published Bayesian optimisation is guided by its model; of 1000 in all."""

Objective: TypeAlias = Callable[[Float[Tensor, "b k n"]], Float[Tensor, " b"]]
"""Values of points of a search space, to be made large; a batch is what may be measured side by side."""


@dataclass(frozen=True, slots=True, eq=False)
class Trials:
    """What a search has tried, in order.

    Args:
        unit: the points.
        value: of each.
        seconds: since the search began, when each was known; time in which it was not running does not count.
    """

    unit: Float[Tensor, "t k n"]
    value: Float[Tensor, " t"]
    seconds: Float[Tensor, " t"]

    def __len__(self) -> int:
        """How many."""
        return len(self.value)

    @property
    def best(self) -> int:
        """Index of the best one."""
        return int(self.value.argmax())

    @property
    def best_so_far(self) -> Float[Tensor, " t"]:
        """The highest value up to each trial."""
        return self.value.cummax(0).values


def blackbox_search(
    objective: Objective,
    space: SearchSpace,
    *,
    method: Method,
    calls: int,
    random_calls: int = PUBLISHED_RANDOM,
    seed: int = 0,
    at_once: int = 1,
    first: Float[Tensor, "f k n"] | None = None,
    checkpoint: Path | None = None,
    on_step: Callable[[int, float], object] = lambda _calls, _best: None,
) -> Trials:
    """Find the point of a search space with the largest value, without gradients.

    Args:
        objective: gives the values.
        space: where to look; the authors' Bayesian optimisation had the "published-bo" family.
        method: "random"; "published-bo", as the authors had it; "gp", "tpe" (Optuna) and "cma-es" (cmaes), of today.
        calls: how many points are tried.
        random_calls: "published-bo" only: how many of them are random, before the model guides.
        seed: of everything random.
        at_once: how many points are proposed before their values are asked for, for simulators side by side.
        first: points to begin with, as those of another search; the method goes on from what they are worth.
        checkpoint: a file that keeps the trials after every call of the objective; a search that finds its own goes on.
        on_step: told how many points have been tried, and the best value.

    Raises:
        RoadproofError: an argument makes no sense, or a value is not finite.
    """
    for name, number in (("calls", calls), ("random_calls", random_calls), ("at_once", at_once)):
        if number < 1:
            raise RoadproofError(f"{name} is {number}, expected 1 or more")
    if method == "published-bo" and at_once > 1:
        raise RoadproofError(
            f"at_once is {at_once}, but published-bo proposes one point at a time; run several scenarios side by side"
        )
    given = None if first is None else cast("list[Any]", first.tolist())
    propose = _proposer(method, space, random_calls, seed, len(given or ()))
    identity = repr((space, method, random_calls, seed, at_once, given))
    trials = _resumed(checkpoint, space, identity)
    before_s = float(trials.seconds[-1]) if len(trials) else 0.0
    started = time.perf_counter()
    while len(trials) < calls:
        flat, value = trials.unit.flatten(1).numpy(), trials.value.numpy()
        wanted = min(at_once, calls - len(trials))
        if first is not None and len(trials) < len(first):
            unit = first[len(trials) : len(trials) + wanted].double()
        else:
            proposed = propose(flat, value, wanted)
            unit = torch.as_tensor(proposed).view(-1, space.figures, len(space.names))
        found = objective(unit.float()).double().cpu()
        if not bool(found.isfinite().all()):
            raise RoadproofError(f"the objective is NaN or infinite at call {len(trials) + 1}; check the controller")
        now = torch.full_like(found, before_s + time.perf_counter() - started)
        trials = Trials(
            torch.cat([trials.unit, unit]), torch.cat([trials.value, found]), torch.cat([trials.seconds, now])
        )
        if checkpoint:
            state = {"unit": trials.unit, "value": trials.value, "seconds": trials.seconds}
            save_checkpoint(checkpoint, identity, state)
        on_step(len(trials), float(trials.value.max()))
    return trials


def _proposer(method: Method, space: SearchSpace, random_calls: int, seed: int, given: int) -> proposals.Propose:
    dimensions = space.figures * len(space.names)
    match method:
        case "random":
            return proposals.random(space, seed)
        case "published-bo":
            return proposals.published_bo(proposals.natural_ranges(space), random_calls, seed)
        case "gp" | "tpe":
            return proposals.optuna(method, dimensions, seed)
        case "cma-es":
            return proposals.cma_es(dimensions, seed, given)


def _resumed(checkpoint: Path | None, space: SearchSpace, identity: str) -> Trials:
    state = load_checkpoint(checkpoint, identity, torch.device("cpu")) if checkpoint else None
    if state is not None:
        return Trials(state["unit"], state["value"], state["seconds"])
    nothing = torch.empty(0, dtype=torch.float64)
    return Trials(nothing.new_empty(0, space.figures, len(space.names)), nothing, nothing)
